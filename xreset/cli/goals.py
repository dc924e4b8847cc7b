"""``xreset goals``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from xreset.cli._terminal import console
from xreset.cli._verbs import REQUIRED, verb
from xreset.files.text import quantity
from xreset.resets import verbs

if TYPE_CHECKING:
    from xreset.resets.goals import GoalSet


def _show(goals: GoalSet, options: Mapping[str, Any]) -> None:
    counts = Counter(goals.family.tolist())
    listing = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    console.print(
        f"{quantity(len(goals.family), 'goal')} of {quantity(len(goals.object_names), 'object')} ({listing}) in "
        f"{options['out']}"
    )


COMMAND = verb(verbs.make_goals, _show, out=REQUIRED)
