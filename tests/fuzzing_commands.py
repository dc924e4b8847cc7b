"""Command lines of junk: every command, its own options, and what must hold for any value and any file name."""

import os
import resource
import signal
import tempfile
import traceback
from argparse import Action
from contextlib import chdir, redirect_stderr, redirect_stdout
from importlib import import_module
from io import BytesIO, TextIOWrapper
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest import mock

import tyro

from tests.test_view import toy_demos
from xreset import write_demos
from xreset.cli import COMMANDS, main
from xreset.cli._options import checked

SECONDS = 20.0
"""Most processor time of a command."""
GIGABYTES = 1.0
"""Most memory that a command adds to the process."""
CHARACTERS = 1000
"""Longest message: a message may repeat a name of 300 letters."""
NAMES = (
    "", " ", "-", "-x", "..", ".", "folder", "file.npz", "file.npz/x.npz", "folder/new.npz", "missing.npz", "no/x.npz", "new", "new.png",
    "null.npz", "a" * 300, "a" * 300 + ".npz", "ü漢.npz", "\udcff\udc80.npz", "a\nb.npz", "\x1b[31m.png", "[/bold].npz", "%s{0}.npz", "~",
)  # fmt: skip
"""Names of files and folders, for input and output: none is absolute, and ``..`` stays in the temporary folder.

``null.npz`` is a link to /dev/null: a command of root that replaces it does no harm."""
NUMBERS = (
    "-1", "0", "1", "2", "0.5", "-0.0", "nan", "inf", "-inf", "1e308", "-1e30", "1e-320", "99999", "1000000000", "4294967295", "4294967296",
    "9" * 400, "1" * 5000, "1_0", "٣",
)  # fmt: skip
"""Values of numbers."""
VALUES = (
    "True", "None", "\r\n", "\u202e", "x=1", "x=nan,inf", "cuda:99999999999", "[]", "{}", "a" * 5000, *NUMBERS, *NAMES,
)  # fmt: skip
"""Values of any option."""
WRITTEN = ("out", "rest", "picture", "film")
"""Options that name a file or folder that a command writes."""
WAIT_OR_WORK = {"engines check"}
"""Commands that need no file and work for minutes."""
FIRST = {"play": ["no-policy"], "demos synth": ["--objects", "no-object"]}
"""Arguments without which a command serves a page for ever, or works for minutes."""
READ_DEMOS = ("demos", "objects", "robots check", "export", "report", "compare")
"""Commands that may get a valid archive: others would compute for minutes, or serve a page for ever."""


class TooSlow(BaseException):
    """A command took more than its processor time; no handler of the library catches this."""


def commands():
    """Return the options of each command, from its own parser, by the command's words."""
    found: dict[str, list[Action]] = {}
    for name in COMMANDS:
        module = import_module(f"xreset.cli.{name}")
        command = module.command_for([]) if hasattr(module, "command_for") else module.COMMAND
        verbs = command if isinstance(command, dict) else {"": command}
        for verb, function in verbs.items():
            words = f"{name} {verb}".strip()
            if words not in WAIT_OR_WORK:
                found[words] = tyro.extras.get_parser(checked(function))._actions
    return found


def draw(random, options):
    """Draw a command line: mostly the required options, some others, values of junk."""
    words = random.choice(sorted(options))
    names = [*NAMES, *["demos.npz"] * 20] if words.startswith(READ_DEMOS) else NAMES
    line = [*words.split(), *FIRST.get(words, [])]
    for action in options[words]:
        needed = action.required or not action.option_strings
        if "--help" in action.option_strings or random.random() > (
            0.95 if needed else 3 / len(options[words])
        ):
            continue
        if action.option_strings:
            line.append(random.choice(action.option_strings))
        kind = str(action.metavar)
        if random.random() < 0.1:
            values = VALUES
        elif action.choices:
            values = list(action.choices)
        elif "PATH" in kind or not action.option_strings:
            values = names
        else:
            values = NUMBERS if "INT" in kind or "FLOAT" in kind else VALUES
        count = max(1, kind.count("FLOAT")) if action.nargs != 0 else 0
        line += random.choices(values, k=count)
    if random.random() < 0.05:
        line.insert(random.randrange(len(line)), random.choice(VALUES))
    return line


def outcome_of_command(line):
    """``refused`` or ``ran``; raises ``AssertionError`` if a command broke, took too much, or wrote what it must not.

    The command runs in this process, in a temporary folder that also has the home folder and the cache."""
    with tempfile.TemporaryDirectory() as name, mock.patch.dict(os.environ, HOME=f"{name}/home"):
        os.environ.pop("XDG_CACHE_HOME", None)
        os.environ.pop("XRESET_CACHE", None)
        work = Path(name) / "work"
        _fill(work)
        before = _files(Path(name))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with chdir(work):
            code, message = _called(line)
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 2**20
        written = {
            path for path, content in _files(Path(name)).items() if before.get(path) != content
        }
        outputs = [
            (work / value).resolve()
            for flag, value in pairwise(line)
            if flag.lstrip("-") in WRITTEN
        ]
        stray = []
        for path in sorted(written):
            if not any(path.is_relative_to(out) for out in outputs):
                stray.append(path)
        is_device = (work / "null.npz").is_char_device()
    assert is_device, "it replaced a device"
    assert code in (0, 1, 2), f"exit status {code!r}"
    assert "Traceback" not in message, message[-300:]
    assert code != 1 or len(message) <= CHARACTERS, f"a message of {len(message)} characters"
    assert grown < GIGABYTES, f"it took {grown:.1f} GB"
    assert not stray or not outputs, f"it wrote {stray[:3]}"
    return "refused" if code else "ran"


def _fill(work):
    """Make the folder in which a command runs, with the files that :data:`NAMES` names."""
    work.mkdir()
    (work / "folder").mkdir()
    (work / "file.npz").write_bytes(b"x")
    (work / "null.npz").symlink_to("/dev/null")
    write_demos(work / "demos.npz", toy_demos())


def _called(line):
    """Call a command; return its exit status and what it said on standard error."""
    streams = [TextIOWrapper(BytesIO(), encoding="utf-8") for _ in range(2)]
    signal.signal(signal.SIGVTALRM, _too_slow)
    signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
    code: Any = 0
    try:
        with redirect_stdout(streams[0]), redirect_stderr(streams[1]):
            main(line)
    except SystemExit as end:
        code = end.code or 0
    except (Exception, TooSlow) as error:
        raise AssertionError(
            f"{type(error).__name__}: {str(error)[:200]} {_place(error)}"
        ) from error
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    streams[1].flush()
    return code, streams[1].buffer.getvalue().decode()


def _files(folder):
    """Return the content of every file below a folder, without the home folder."""
    paths = [
        path
        for path in folder.rglob("*")
        if path.is_file() and not path.is_relative_to(folder / "home")
    ]
    return {path.resolve(): path.read_bytes() for path in paths}


def _too_slow(*_):
    raise TooSlow(f"more than {SECONDS:g} s")


def _place(error):
    own = [
        frame for frame in traceback.extract_tb(error.__traceback__) if "xreset" in frame.filename
    ]
    return f"{Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""
