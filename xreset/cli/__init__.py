"""The command line: ``xreset COMMAND ...``.

The first word picks a module of this package, which is only then imported, so that ``xreset --help`` is instant. A command module holds
typed functions; tyro turns their signatures and docstrings into flags.

So that a command's own help is instant too, what it imports of xreset runs when something of it is first used. Command modules therefore
import modules (``from xreset.eval import trial``, then ``trial.engine(...)``), and names of light ones only: of configurations, of errors.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec, PathFinder
from io import TextIOWrapper
from types import ModuleType
from typing import Any, NoReturn

COMMANDS: dict[str, str] = {
    "demos": "Import, make and describe human demonstrations.",
    "objects": "List objects and import meshes.",
    "robots": "List robots, check one, make one from an arm and a hand, find its place.",
    "engines": "List physics engines, check them, compare them and trace where they diverge.",
    "retarget": "Turn human demonstrations into robot trajectories.",
    "resets": "Try retargeted states in physics and keep the stable ones.",
    "view": "Look at demonstrations, robot trajectories or a reset bank in a browser, or as pictures.",
    "train": "Train a policy.",
    "policies": "Show the policies that ship with xreset, and make exported ones smaller.",
    "eval": "Evaluate a policy, or a baseline, in one or several engines.",
    "frontier": "Tell from which demonstrated states a policy reaches the goal, and where its training is stuck.",
    "stress": "Tell what a policy bears: stiffness, latency, friction and more, swept one at a time.",
    "select": "Choose among a training's checkpoints by all engines: the best in its worst engine.",
    "compare": "Put several trainings side by side: curves, results in every engine, and what differs between them.",
    "study": "Run a study: trainings by object and seed, evaluations, and tables beside the paper's.",
    "export": "Write evaluation episodes as a LeRobot data set, or as plain arrays.",
    "report": "Make a self-contained HTML page of a run's evaluations.",
}
"""Command -> one line of help. ``xreset.cli.NAME`` has ``COMMAND``, a function or a dictionary of sub-commands; or ``command_for``,
arguments -> such a function, where defaults depend on an argument; or ``COMMANDS`` of its own, in modules below it."""

MOVED = {
    "backends": "engines list",
    "conformance": "engines check",
    "parity": "engines compare",
    "trace": "engines trace",
    "attribute": "engines attribute",
}
"""Earlier names of commands."""

INVOCATION: list[str] = []
"""The arguments of the command that is running."""


def main(argv: list[str] | None = None) -> None:
    """Entry point of the console script. Exits with 1 after an error that the user can mend, 2 after wrong usage, 130 after Ctrl-C."""
    from xreset.errors import XResetError

    argv = sys.argv[1:] if argv is None else argv
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # what the terminal has no character for is written as an escape
            stream.reconfigure(errors="backslashreplace")
    if argv[:1] == ["--version"]:
        from xreset import __version__

        print(f"xreset {__version__}")
        return
    if argv and argv[0] in MOVED:
        print(f"xreset: {argv[0]} is now called {MOVED[argv[0]]!r}: xreset {MOVED[argv[0]]} --help", file=sys.stderr)
        raise SystemExit(2)
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
        _fail(argv, "there is too little memory for this. Use fewer worlds (--num-envs) or a smaller file.")


def _fail(argv: list[str], message: str) -> NoReturn:
    from xreset.text import plain

    words = argv[:2] if argv[0] == "engines" else argv[:1]
    print(f"xreset {' '.join(words)}: {plain(message)}", file=sys.stderr)
    raise SystemExit(1) from None


def _run(group: str, commands: dict[str, str], argv: list[str]) -> None:
    """Run the command that the first of the arguments names, of a group of commands."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(group, commands))
        return
    name, arguments = argv[0], argv[1:]
    if name not in commands:
        print(f"xreset{group}: there is no command {name!r}.\n\n{_usage(group, commands)}", file=sys.stderr)
        raise SystemExit(2)
    sys.meta_path.insert(0, _Lazily)
    try:
        module = import_module(f"xreset.cli{group.replace(' ', '.')}.{name}")
    finally:
        sys.meta_path.remove(_Lazily)
    if hasattr(module, "COMMANDS"):
        _run(f"{group} {name}", module.COMMANDS, arguments)
        return
    import tyro

    from xreset.cli._options import checked

    command = module.command_for(arguments) if hasattr(module, "command_for") else module.COMMAND
    program, description = f"xreset{group} {name}", commands[name]
    if isinstance(command, dict):
        verbs = {verb: checked(function) for verb, function in command.items()}
        two = " ".join(arguments[:2])  # a verb may have two words
        arguments = [two, *arguments[2:]] if two in verbs else arguments
        tyro.extras.subcommand_cli_from_dict(verbs, prog=program, description=description, args=arguments)
    else:
        tyro.cli(checked(command), prog=program, description=description, args=arguments)


class _LazyModule(ModuleType):
    """A module that runs when one of its names is first asked for.

    ``importlib.util.LazyLoader`` runs it for the sake of ``__file__`` too, which ``inspect`` asks of all modules in the middle of imports.
    """

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(f"module {self.__name__!r} has not run yet and has no {name!r}")
        self.__class__ = ModuleType
        try:
            self.__loader__.loader.exec_module(self)
        except BaseException:
            self.__class__ = _LazyModule
            raise
        return getattr(self, name)


class _Lazily(Loader):
    """Finds xreset's modules, but for the commands' own, as lazy ones."""

    def __init__(self, loader: Loader) -> None:
        self.loader = loader

    @classmethod
    def find_spec(
        cls, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if not name.startswith("xreset.") or name.startswith("xreset.cli"):
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = cls(spec.loader)
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _LazyModule(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        pass


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
