"""``xreset train``."""

from __future__ import annotations

import inspect
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from typing import Annotated, Any

from xreset.cli import asks_for_help
from xreset.cli._terminal import show_table
from xreset.cli._terms import take_terms
from xreset.cli._verbs import verb
from xreset.errors import RunError
from xreset.learning import verbs
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import starting_config

_HELP_CONFIG = "--help-config"


def command_for(arguments: list[str]) -> Callable[..., None]:
    """Return the command with the defaults of ``--recipe``, which must be known before the other flags are read.

    Flags of terms are taken from the arguments.
    """
    parser = ArgumentParser(add_help=False, allow_abbrev=False)
    for flag in ("--recipe", "--weights", "--resets", "--goals", "--teacher"):
        parser.add_argument(flag, nargs="?")  # tyro reports a missing value
    parser.add_argument("--camera", action="append")
    parser.add_argument(_HELP_CONFIG, nargs="?", const="")
    given = parser.parse_known_args(arguments)[0]
    recipe = given.recipe
    changes = any(word.startswith("--config.") for word in arguments)
    continues = not given.resets and not given.goals
    if continues and given.help_config is None:
        config = TrainConfig()
    elif given.teacher and not recipe:
        from xreset.learning.train import config_of_student

        config = config_of_student(given.teacher, given.camera or "front")
    else:
        recipe = recipe or given.weights or "default"
        config = starting_config(recipe)
    config = take_terms(config, arguments)
    if given.help_config is not None:
        _show_config(given.help_config.removeprefix("config."), config)
        raise SystemExit(0)
    if asks_for_help(arguments):
        return verb(
            verbs.train, recipe=recipe or "default"
        )  # the configuration has a help of its own

    def prepare(options: dict[str, Any]) -> None:
        """Leave out what the configuration holds already, and a configuration that nobody gave."""
        if continues:
            options["config"] = options["config"] if changes else None
        elif given.teacher:
            options["cameras"] = ()
        else:
            options["recipe"] = None

    return verb(verbs.train, prepare=prepare, config=config)


def _show_config(part: str, config: TrainConfig) -> None:
    """Print the options of a part of the configuration, such as ``task.reward``; or, without a part, all parts."""
    import tyro

    from xreset.cli._options import RULES

    parts = {"all": config, **dict(_parts(config))}
    if part and part not in parts:
        raise RunError(f"The configuration has no part {part!r}. Choose from: {', '.join(parts)}.")
    if not part:
        show_table([("PART", "options"), *((name, _summary(each)) for name, each in parts.items())])
        return

    def options(chosen: Any) -> None: ...

    named = Annotated[
        type(parts[part]), tyro.conf.arg(name="config" if part == "all" else f"config.{part}")
    ]
    options.__annotations__["chosen"] = named
    options.__defaults__ = (parts[part],)
    tyro.cli(options, prog="xreset train", args=["--help"], registry=RULES)


def _parts(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the names of a configuration's parts, and the parts, in order."""
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            yield prefix + field.name, value
            yield from _parts(value, f"{prefix}{field.name}.")


def _summary(part: Any) -> str:
    return (inspect.getdoc(type(part)) or "").partition("\n")[0]
