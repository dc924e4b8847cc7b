"""The command line: ``xreset COMMAND ...``.

The first word selects a module of this package, which is imported only then, so that ``xreset --help`` is instant. A
command module holds typed functions; tyro turns their signatures and docstrings into flags.

The help of a command must be instant too. Therefore command modules import at their top only what is light, such as
configurations and errors; their functions import the rest."""

from __future__ import annotations

import sys
from importlib import import_module
from io import TextIOWrapper
from typing import NoReturn

COMMANDS: dict[str, str] = {
    "demos": "Import, synthesize, select, merge and describe human demonstrations.",
    "objects": "List objects, import meshes, and make random shapes.",
    "robots": "List, check, import, place and judge robots.",
    "engines": "List, check and compare physics engines, and trace where they diverge.",
    "retarget": "Turn human demonstrations into robot motion.",
    "resets": "Test robot states in physics and keep the stable ones.",
    "goals": "Give any object goals, without demonstrations.",
    "view": "Show demonstrations, robot motion or a reset bank in a browser, or as pictures.",
    "play": "Play with a policy in a browser: drag the goal, push the robot, change the engine.",
    "train": "Train a policy.",
    "distill": "Train a policy that sees, by imitating one that is told the object's pose.",
    "policies": "List the policies that ship with xreset.",
    "eval": "Evaluate a policy or a baseline in one or several engines.",
    "stress": "Measure robustness: change stiffness, latency, friction and more, one at a time.",
    "rehearse": "Rehearse a policy for a robot: late poses and actions, lost frames, pushes, in every engine.",
    "serve": "Serve a policy to a robot's computer over the network.",
    "select": "Choose the checkpoint that is best in its worst engine.",
    "compare": "Compare trainings: learning curves, results in every engine, and configurations.",
    "study": "Run a study: trainings by object and seed, evaluations, and tables next to the paper's.",
    "export": "Write a policy for a robot, or recorded episodes as a LeRobot data set or as plain arrays.",
    "report": "Make an HTML page of a run's evaluations.",
}
"""Command -> one line of help.

The module ``xreset.cli.NAME`` has one of: ``COMMAND``, a function or a dictionary of sub-commands; ``command_for``,
which makes the function from the arguments, if defaults depend on them; or ``COMMANDS`` of its own, whose modules are
in its folder."""

INVOCATION: list[str] = []
"""Arguments of the command that is running."""


def main(argv: list[str] | None = None) -> None:
    """Run the command line. Exits with 1 after an error of the user, 2 after wrong usage, 130 after Ctrl-C."""
    from xreset.errors import XResetError

    argv = sys.argv[1:] if argv is None else argv
    for stream in (sys.stdout, sys.stderr):
        if isinstance(
            stream, TextIOWrapper
        ):  # write an escape for a character that the terminal lacks
            stream.reconfigure(errors="backslashreplace")
    if argv[:1] == ["--version"]:
        from xreset.files import code_version

        print(f"xreset {code_version()}")
        return
    INVOCATION[:] = argv
    try:
        _run("", COMMANDS, argv)
    except XResetError as error:
        _fail(argv, str(error))
    except KeyboardInterrupt:
        print("\nstopped.", file=sys.stderr)
        raise SystemExit(130) from None
    except BrokenPipeError:  # `xreset ... | head`
        sys.stderr.close()
        raise SystemExit(0) from None
    except OSError as error:  # a name too long, a folder that may not be read, a port that is taken
        if error.strerror is None:
            raise
        _fail(argv, f"{error.strerror}: {error.filename}" if error.filename else error.strerror)
    except MemoryError:
        _fail(argv, "Out of memory. Use fewer worlds (--num-envs) or a smaller file.")


def _fail(argv: list[str], message: str) -> NoReturn:
    from xreset.text import plain

    words = argv[:2] if argv[0] == "engines" else argv[:1]
    print(f"xreset {' '.join(words)}: {plain(message)}", file=sys.stderr)
    raise SystemExit(1) from None


def _run(group: str, commands: dict[str, str], argv: list[str]) -> None:
    """Run the command of a group that the first argument names."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(group, commands))
        return
    name = argv[0]
    arguments = argv[1:]
    if name not in commands:
        print(
            f"xreset{group}: Unknown command {name!r}.\n\n{_usage(group, commands)}",
            file=sys.stderr,
        )
        raise SystemExit(2)
    module = import_module(f"xreset.cli{group.replace(' ', '.')}.{name}")
    if hasattr(module, "COMMANDS"):
        _run(f"{group} {name}", module.COMMANDS, arguments)
        return
    import tyro

    from xreset.cli._options import checked

    command = module.command_for(arguments) if hasattr(module, "command_for") else module.COMMAND
    program = f"xreset{group} {name}"
    about = commands[name]
    if isinstance(command, dict):
        verbs = {verb: checked(function) for verb, function in command.items()}
        two = " ".join(arguments[:2])
        if two in verbs:  # a verb may have two words
            arguments = [two, *arguments[2:]]
        tyro.extras.subcommand_cli_from_dict(verbs, prog=program, description=about, args=arguments)
    else:
        tyro.cli(checked(command), prog=program, description=about, args=arguments)


def _usage(group: str, commands: dict[str, str]) -> str:
    width = max(map(len, commands))
    lines = [f"  {name:<{width}}  {text}" for name, text in commands.items()]
    return "\n".join(
        [
            f"usage: xreset{group} COMMAND ...",
            "",
            *lines,
            "",
            f"xreset{group} COMMAND --help shows the options of one command.",
        ]
    )
