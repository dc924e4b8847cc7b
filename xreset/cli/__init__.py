"""The command line: ``xreset COMMAND ...``.

The first word selects a module of this package. Only this module and the small ``_earlier`` are imported, so that
``xreset --help`` is instant. A command module holds typed functions; tyro turns their signatures and docstrings into
flags.

The help of a command must be instant, too. Therefore command modules import only light modules at their top, such as
configurations and errors; their functions import the rest.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from importlib import import_module
from io import TextIOWrapper
from shutil import get_terminal_size
from textwrap import fill
from typing import NoReturn

COMMANDS = {
    "run": "Take demonstrations to a trained, evaluated policy: all steps with one command.",
    "demos": "Import, synthesize, describe and select human demonstrations.",
    "objects": "Import meshes, and make random shapes.",
    "robots": "Check, import, place and judge robots.",
    "engines": "Check and compare physics engines.",
    "retarget": "Turn human demonstrations into robot motion.",
    "resets": "Test robot states in physics and keep the stable ones.",
    "goals": "Give any object goals, without demonstrations.",
    "view": "Show demonstrations, robot motion, resets or goals in a browser, or as pictures.",
    "play": "Play with a policy in a browser: drag the goal, push the robot, change the engine.",
    "train": "Train a policy by its rewards, or a student that sees, from a teacher.",
    "policies": "List the policies that ship with xreset.",
    "eval": "Evaluate a policy or a baseline in one or several engines.",
    "stress": "Measure robustness: change stiffness, latency, friction or a robot's faults, one at a time.",
    "study": "Run a study: trainings by object and seed, evaluations, and tables next to the paper's.",
    "export": "Write a policy for a robot, or recorded episodes as a LeRobot data set or as plain arrays.",
    "report": "Make an HTML page of a run, or of several side by side.",
}
"""Command -> one line of help.

The module ``xreset.cli.NAME`` has ``COMMAND``, a function or a dictionary of sub-commands; the one without a name runs
if no verb is given. If defaults depend on the arguments, it has ``command_for`` instead, which returns the function for
some arguments."""


def main(argv: list[str] | None = None) -> None:
    """Run the command line. It exits with 1 after an error, 2 after wrong usage, and 128 + N after signal N: 130 after
    Ctrl-C, 143 after SIGTERM.

    Args:
        argv: arguments, without the program; default: those of this process.
    """
    from xreset.cli._earlier import with_present_words
    from xreset.errors import Stopped, XResetError

    argv = with_present_words(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # characters that the terminal lacks are written as escapes
            stream.reconfigure(errors="backslashreplace")
    if argv[:1] == ["--version"]:
        from xreset.files.storage import code_version

        print(f"xreset {code_version()}")
        return
    try:
        perform(argv)
    except XResetError as error:
        _fail(argv, str(error))
    except ModuleNotFoundError as error:
        extra = _extra_with(error.name or "")
        if extra is None:
            raise
        install = f"pip install 'xreset[{extra}]'"
        _fail(argv, f"{error.name} is not installed. Install it with: {install}")
    except Stopped as stop:  # it has said so
        raise SystemExit(128 + stop.number) from None
    except KeyboardInterrupt:
        print("\nstopped.", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:  # `xreset ... | head`
        sys.stderr.close()
        raise SystemExit(0) from None
    except OSError as error:  # such as a file name that is too long, a folder without permission, or a taken port
        if error.strerror is None:
            raise
        _fail(argv, f"{error.strerror}: {error.filename}" if error.filename else error.strerror)
    except MemoryError:
        _fail(argv, "Out of memory. Use fewer worlds (--num-envs) or a smaller file.")


def _extra_with(package: str) -> str | None:
    """Return an extra of xreset that brings a package; None: no extra does."""
    from importlib import metadata

    for line in metadata.requires("xreset") or ():
        requirement, _, extra = line.partition("; extra == ")
        if re.split(r"[^\w-]", requirement)[0].replace("-", "_") == package and extra:
            return extra.strip("\"'")
    return None


def _fail(argv: list[str], message: str) -> NoReturn:
    from xreset.files.text import plain

    print(f"xreset {argv[0]}: {plain(message)}", file=sys.stderr)
    raise SystemExit(1) from None


def perform(argv: list[str]) -> None:
    """Run the command that the first argument names. Its errors are raised."""
    if not argv or asks_for_help(argv[:1]):
        print(_usage())
        return
    name = argv[0]
    arguments = argv[1:]
    if name not in COMMANDS:
        print(f"xreset: Unknown command {name!r}.\n\n{_usage()}", file=sys.stderr)
        raise SystemExit(2)
    module = import_module(f"xreset.cli.{name}")
    import tyro

    from xreset.cli._options import (
        RULES,
        checked,
        description,
        fitted,
        refuse_empty,
        refuse_unclear,
    )
    from xreset.files import storage

    storage.INVOCATION[:] = argv

    def call(function: Callable[..., None], words: list[str], *verb: str) -> None:
        refuse_unclear(function, words)
        tyro.cli(
            checked(function),
            args=words,
            prog=" ".join(("xreset", name, *verb)),
            description=description(function),
            registry=RULES,
        )

    refuse_empty(arguments)
    command = module.command_for(arguments) if hasattr(module, "command_for") else module.COMMAND
    if arguments[:1] == ["list"]:  # as in earlier versions
        arguments = arguments[1:]
    if not isinstance(command, dict):
        call(command, arguments)
        return
    text = COMMANDS[name]
    if "" in command:
        if not arguments or (arguments[0].startswith("-") and not asks_for_help(arguments[:1])):
            call(command[""], arguments)
            return
        text += f"\n\nxreset {name} alone: {description(command[''])}"
    for count in (2, 1):  # a verb may have two words
        verb = " ".join(arguments[:count])
        if verb in command:
            call(command[verb], arguments[count:], verb)
            return
    tyro.extras.subcommand_cli_from_dict(
        {verb: checked(function) for verb, function in command.items() if verb},
        args=arguments,
        prog=f"xreset {name}",
        description=fitted(text),
        registry=RULES,
    )


def asks_for_help(arguments: list[str]) -> bool:
    """Return whether help is among the arguments."""
    return not {"-h", "--help"}.isdisjoint(arguments)


def _usage() -> str:
    width = max(map(len, COMMANDS))
    columns = get_terminal_size().columns
    lines = "\n".join(
        fill(f"  {name:<{width}}  {text}", columns, subsequent_indent=" " * (width + 4))
        for name, text in COMMANDS.items()
    )
    help = "xreset COMMAND --help shows the options of one command, xreset --version the version."
    return f"usage: xreset COMMAND ...\n\n{lines}\n\n{help}"
