"""Flags that set terms of rewards and observations: ``--config.task.reward.terms.reach.width 0.4``."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import asdict, fields
from math import isfinite
from typing import Any

from xreset.errors import RunError
from xreset.files.checks import from_dict, merged
from xreset.learning.config import TrainConfig
from xreset.task.config import GROUPS
from xreset.task.legacy import ObservationOptions, RewardOptions

_TERM = re.compile(
    rf"--config\.task\.(reward|observation)\.(terms|gate|{'|'.join(GROUPS)})\.(?:(.+)\.)?(.+)"
)
_EARLIER = {f.name for f in (*fields(ObservationOptions), *fields(RewardOptions))}
_EARLIER -= {"cloud_points", "success_position", "scale"}
"""Options of 0.1 to 0.3, in place of which there are terms."""


def take_terms(config: TrainConfig, arguments: list[str]) -> TrainConfig:
    """Return the configuration with the terms that flags set, and remove these flags from the arguments.

    A flag names a parameter of a term and takes its value, or it names a term and takes ``true`` or ``false``, which
    adds or removes it. Studies have the same paths: ``task.reward.terms.reach.width = 0.4``.

    Raises:
        RunError: a flag is an option of xreset 0.1 to 0.3.
        FileFormatError: the configuration cannot have the value.
    """
    changes: dict[str, Any] = {}
    others = []
    words = iter(arguments)
    for word in words:
        flag, equals, value = word.partition("=")
        flag = flag[:2] + flag[2:].replace("-", "_")
        found = _TERM.fullmatch(flag)
        if found is None:
            _refuse_earlier(flag)
            others.append(word)
            continue
        part, table, name, last = found.groups()
        if name and ":" in last:  # the module of a term may have dots
            last = f"{name}.{last}"
            name = None
        given = _value(value if equals else next(words, ""))
        if isinstance(given, float) and not isfinite(given):
            raise RunError(f"{flag} is {given}, expected a finite number or a word.")
        terms = changes.setdefault(part, {}).setdefault(table, {})
        if name:
            terms.setdefault(name, {})[last] = given
        else:
            terms[last] = {} if given is True else given
    arguments[:] = others
    if not changes:
        return config
    return from_dict(TrainConfig, merged(asdict(config), {"task": changes}), "The configuration")


def _value(text: str) -> Any:
    """Return the number, the truth value or the word that a text means."""
    if text.lower() in ("true", "false"):
        return text.lower() == "true"
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return text


def _refuse_earlier(flag: str) -> None:
    part, _, option = flag.rpartition(".")
    if part in ("--config.task.reward", "--config.task.observation") and option in _EARLIER:
        raise RunError(
            f"{flag} is no option any more: rewards and observations are terms, such as "
            "--config.task.reward.terms.reach.width 0.4. Look at docs/own-reward.md."
        )
