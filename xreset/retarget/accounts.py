"""Counts frames and states: how many are kept and why the others are lost, by object and phase of the demonstration.

Nothing is lost without a reason: ``total == kept + sum(lost.values())`` in every account.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Literal

import numpy as np

from xreset.files.checks import frozen

Phase = Literal["pre-contact", "post-contact", "both"]
"""Before the human hand first touches the object, and from then on."""


@frozen
class Account:
    """What became of some frames or states."""

    object_name: str
    """``all`` in a sum over objects."""
    phase: Phase
    kept: int
    lost: dict[str, int]
    """Reason -> number, the most frequent first."""

    @property
    def total(self) -> int:
        """Number of frames or states, kept and lost."""
        return self.kept + sum(self.lost.values())

    def without(self, reason: str) -> Account:
        """Return the account of what was not lost for that reason."""
        return replace(self, lost={name: n for name, n in self.lost.items() if name != reason})


def accounts(
    object_name: np.ndarray, post_contact: np.ndarray, reason: np.ndarray
) -> list[Account]:
    """Return an account of every object and phase, objects in alphabetical order; then the sums over all objects: of
    each phase, and of both.

    Args:
        object_name: [N] text.
        post_contact: [N] bool
        reason: [N] text: why it is lost, empty where it is kept.
    """
    phases: dict[Phase, np.ndarray] = {"pre-contact": ~post_contact, "post-contact": post_contact}
    owners = {name: object_name == name for name in np.unique(object_name).tolist()}
    owners["all"] = np.ones_like(post_contact)
    rows = []
    for name, own in owners.items():
        rows += [_account(name, phase, reason[own & chosen]) for phase, chosen in phases.items()]
    return [*rows, _account("all", "both", reason)]


def _account(name: str, phase: Phase, reason: np.ndarray) -> Account:
    counts = Counter(reason.tolist())
    kept = counts.pop("", 0)
    return Account(object_name=name, phase=phase, kept=kept, lost=dict(counts.most_common()))


def described(lost: dict[str, int]) -> str:
    """Return the reasons as text, such as ``arm jump 12, hand error 3``."""
    return ", ".join(f"{reason} {n}" for reason, n in lost.items())
