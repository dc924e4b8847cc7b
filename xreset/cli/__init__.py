"""The command line: ``xreset COMMAND ...``.

The first word picks a module of this package, which is only then imported, so that ``xreset --help`` is instant. A command module holds
typed functions; tyro turns their signatures and docstrings into flags.
"""

from __future__ import annotations

import sys
from importlib import import_module
from io import TextIOWrapper
from typing import NoReturn

COMMANDS: dict[str, str] = {
    "demos": "Import, make and describe human demonstrations.",
    "objects": "List objects and import meshes.",
    "robots": "List robots, and check one.",
    "backends": "List physics engines and whether they can be used here.",
    "conformance": "Test that a physics engine keeps the interface's contracts.",
    "engines": "Make the support matrix: what every engine can do and how far they agree, from measured results.",
    "parity": "Measure how far physics engines agree on grasps.",
    "retarget": "Turn human demonstrations into robot trajectories.",
    "resets": "Try retargeted states in physics and keep the stable ones.",
    "view": "Look at demonstrations, robot trajectories or a reset bank in a browser, or as pictures.",
    "train": "Train a policy.",
    "policies": "List the policies that ship with xreset, and make exported ones smaller.",
    "eval": "Evaluate a policy, or a baseline, in one or several engines.",
    "frontier": "Tell from which demonstrated states a policy reaches the goal, and where its training is stuck.",
    "trace": "Replay one action sequence in several engines, and see when, where and by how much they part.",
    "attribute": "Tell which physical difference between two engines costs a policy its skill.",
    "compare": "Put several trainings side by side: curves, results in every engine, and what differs between them.",
    "report": "Make a self-contained HTML page of a run's evaluations.",
}
"""Command -> one line of help. ``xreset.cli.NAME`` has ``COMMAND``: a function, or a dictionary of sub-commands, each of one or
two words. One whose defaults depend on an argument has ``command_for`` instead: arguments -> such a function."""


def main(argv: list[str] | None = None) -> None:
    """Entry point of the console script. Exits with 1 after an error that the user can mend, 2 after wrong usage, 130 after Ctrl-C."""
    from xreset.errors import XResetError

    argv = sys.argv[1:] if argv is None else argv
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what the terminal has no character for is written as an escape
            stream.reconfigure(errors="backslashreplace")
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage())
        return
    if argv[0] == "--version":
        from xreset import __version__

        print(f"xreset {__version__}")
        return
    if argv[0] not in COMMANDS:
        print(f"xreset: there is no command {argv[0]!r}.\n\n{_usage()}", file=sys.stderr)
        raise SystemExit(2)
    try:
        _run(argv[0], argv[1:])
    except XResetError as error:
        _fail(argv[0], str(error))
    except KeyboardInterrupt:
        print("\nstopped.", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:  # `xreset ... | head`
        sys.stderr.close()
        raise SystemExit(0) from None
    except OSError as error:  # a name too long, a folder that may not be read, a port that is taken
        if error.strerror is None:
            raise
        _fail(argv[0], f"{error.strerror}: {error.filename}" if error.filename else error.strerror)
    except MemoryError:
        _fail(argv[0], "there is too little memory for this. Use fewer worlds (--num-envs) or a smaller file.")


def _fail(command: str, message: str) -> NoReturn:
    from xreset.text import plain

    print(f"xreset {command}: {plain(message)}", file=sys.stderr)
    raise SystemExit(1) from None


def _run(name: str, arguments: list[str]) -> None:
    import tyro

    from xreset.cli._options import checked

    module = import_module(f"xreset.cli.{name}")
    command = module.command_for(arguments) if hasattr(module, "command_for") else module.COMMAND
    program = f"xreset {name}"
    if isinstance(command, dict):
        verbs = {verb: checked(function) for verb, function in command.items()}
        two = " ".join(arguments[:2])
        arguments = [two, *arguments[2:]] if two in verbs else arguments
        tyro.extras.subcommand_cli_from_dict(verbs, prog=program, description=COMMANDS[name], args=arguments)
    else:
        tyro.cli(checked(command), prog=program, description=COMMANDS[name], args=arguments)


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {text}" for name, text in COMMANDS.items()]
    return "\n".join(["usage: xreset COMMAND ...", "", *lines, "", "xreset COMMAND --help shows the options of one command."])
