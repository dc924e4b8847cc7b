"""The command line: ``xreset COMMAND ...``.

The first word selects a module of this package. Only this module is imported, so that ``xreset --help`` is instant. A
command module holds typed functions; tyro turns their signatures and docstrings into flags.

The help of a command must be instant, too. Therefore command modules import only light modules at their top, such as
configurations and errors; their functions import the rest.
"""

from __future__ import annotations

import re
import sys
from importlib import import_module
from io import TextIOWrapper
from typing import Any, NoReturn

COMMANDS = {
    "run": "Take demonstrations to a trained, evaluated policy: all steps with one command.",
    "demos": "Import, synthesize, select, merge and describe human demonstrations.",
    "objects": "List objects, import meshes, and make random shapes.",
    "robots": "List, check, import, place and judge robots.",
    "engines": "List, check and compare physics engines, and trace where they diverge.",
    "retarget": "Turn human demonstrations into robot motion.",
    "resets": "Test robot states in physics and keep the stable ones.",
    "goals": "Give any object goals, without demonstrations.",
    "view": "Show demonstrations, robot motion, resets or goals in a browser, or as pictures.",
    "play": "Play with a policy in a browser: drag the goal, push the robot, change the engine.",
    "train": "Train a policy.",
    "distill": "Train a policy that sees, by imitating one that is told the object's pose.",
    "policies": "List the policies that ship with xreset.",
    "eval": "Evaluate a policy or a baseline in one or several engines.",
    "stress": "Measure robustness: change stiffness, latency, friction or a robot's faults, one at a time.",
    "serve": "Serve a policy to a robot's computer over the network.",
    "select": "Choose the checkpoint that is best in its worst engine.",
    "study": "Run a study: trainings by object and seed, evaluations, and tables next to the paper's.",
    "export": "Write a policy for a robot, or recorded episodes as a LeRobot data set or as plain arrays.",
    "report": "Make an HTML page of a run, or of several side by side.",
}
"""Command -> one line of help.

The module ``xreset.cli.NAME`` has ``COMMAND``, a function or a dictionary of sub-commands. If defaults depend on the
arguments, it has ``command_for`` instead, which returns the function for some arguments."""

INVOCATION: list[str] = []
"""Arguments of the command that is running."""


def main(argv: list[str] | None = None) -> None:
    """Run the command line. It exits with 1 after an error, 2 after wrong usage, and 128 + N after signal N: 130 after
    Ctrl-C, 143 after SIGTERM.

    Args:
        argv: arguments, without the program; default: those of this process.
    """
    from xreset.errors import Stopped, XResetError

    argv = _with_present_flags(sys.argv[1:] if argv is None else argv)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # characters that the terminal lacks are written as escapes
            stream.reconfigure(errors="backslashreplace")
    if argv[:1] == ["--version"]:
        from xreset.files.storage import code_version

        print(f"xreset {code_version()}")
        return
    INVOCATION[:] = argv
    try:
        _run(argv)
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


_RENAMED = {
    "--backend": "--engine",
    "--objects": "--meshes",
    "--like": "--recipe",
    "--hand.jaw": "--jaw",
    "--fault": "--property",
}
"""Flag of earlier versions -> its present name."""
_MOVED = {"rehearse": ["stress", "--faults"], "compare": ["report"]}
"""Command of earlier versions -> its present words."""
_NAME_OBJECTS = (["demos", "synth"], ["demos", "select"], ["demos", "split"])
"""Commands whose ``--objects`` are names of objects, and always were."""


def _with_present_flags(argv: list[str]) -> list[str]:
    """Return the arguments with the present names of commands and flags, and print what was renamed."""
    if argv and argv[0] in _MOVED:
        earlier = argv[0]
        present = _MOVED[earlier]
        print(
            f"xreset: {earlier} is now {' '.join(present)}. The next release removes {earlier}.",
            file=sys.stderr,
        )
        argv = [*present, *argv[1:]]
    changed = dict(_RENAMED)
    if argv[:2] in _NAME_OBJECTS:
        del changed["--objects"]
    words = []
    used = {}
    for word in argv:
        flag, equals, value = word.partition("=")
        if flag in changed:
            used[flag] = changed[flag]
        words.append(changed.get(flag, flag) + equals + value)
    for earlier, flag in used.items():
        print(
            f"xreset: {earlier} is now {flag}. The next release removes {earlier}.", file=sys.stderr
        )
    return words


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


def _run(argv: list[str]) -> None:
    """Run the command that the first argument names."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage())
        return
    name = argv[0]
    arguments = argv[1:]
    if name not in COMMANDS:
        print(f"xreset: Unknown command {name!r}.\n\n{_usage()}", file=sys.stderr)
        raise SystemExit(2)
    module = import_module(f"xreset.cli.{name}")
    import tyro

    from xreset.cli._options import OPTIONAL, checked

    command = module.command_for(arguments) if hasattr(module, "command_for") else module.COMMAND
    how: dict[str, Any] = {
        "prog": f"xreset {name}",
        "description": COMMANDS[name],
        "registry": OPTIONAL,
    }
    if not isinstance(command, dict):
        tyro.cli(checked(command), args=arguments, **how)
        return
    for words in (2, 1):  # a verb may have two words
        verb = " ".join(arguments[:words])
        if verb in command:
            tyro.cli(
                checked(command[verb]),
                args=arguments[words:],
                prog=f"xreset {name} {verb}",
                registry=OPTIONAL,
            )
            return
    verbs = {verb: checked(function) for verb, function in command.items()}
    tyro.extras.subcommand_cli_from_dict(verbs, args=arguments, **how)


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = "\n".join(f"  {name:<{width}}  {text}" for name, text in COMMANDS.items())
    return f"usage: xreset COMMAND ...\n\n{lines}\n\nxreset COMMAND --help shows the options of one command."
