"""Where frames and states go: how many are kept and why the others are lost, by object and phase of the demonstration.

Nothing is lost without a reason: ``total == kept + sum(lost.values())`` in every account.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from xreset.files import write_json

SCHEMA = "xreset-accounts/1"

Phase = Literal["pre-contact", "post-contact"]
PHASES: tuple[Phase, ...] = ("pre-contact", "post-contact")
"""Before the human hand first touches the object, and from then on."""


@dataclass(frozen=True, kw_only=True)
class Account:
    """What became of some frames or states."""

    object_name: str
    """``all`` in a sum over objects."""
    phase: Phase | Literal["both"]
    total: int
    kept: int
    lost: dict[str, int]
    """Reason -> number, the most frequent first."""

    @property
    def share(self) -> float:
        """Kept of total; NaN if there was nothing."""
        return self.kept / self.total if self.total else float("nan")

    def without(self, reason: str) -> Account:
        """The account of what was not lost for that reason."""
        lost = {name: n for name, n in self.lost.items() if name != reason}
        return Account(
            object_name=self.object_name,
            phase=self.phase,
            total=self.kept + sum(lost.values()),
            kept=self.kept,
            lost=lost,
        )


def accounts(object_name: np.ndarray, post_contact: np.ndarray, reason: np.ndarray) -> list[Account]:
    """An account of every object and phase, objects in alphabetical order.

    Args:
        object_name: [N] text.
        post_contact: [N] bool
        reason: [N] text: why it is lost, empty where it is kept.
    """
    rows = []
    for name in np.unique(object_name).tolist():
        for phase, post in zip(PHASES, (False, True), strict=True):
            mine = reason[(object_name == name) & (post_contact == post)]
            lost = Counter(mine[mine != ""].tolist())
            rows.append(
                Account(
                    object_name=name,
                    phase=phase,
                    total=len(mine),
                    kept=len(mine) - lost.total(),
                    lost=dict(lost.most_common()),
                )
            )
    return rows


def summed(parts: Iterable[Account], object_name: str, phase: Phase | Literal["both"]) -> Account:
    """The sum of accounts, under another name."""
    parts = list(parts)
    lost: Counter[str] = Counter()
    for part in parts:
        lost.update(part.lost)
    return Account(
        object_name=object_name,
        phase=phase,
        total=sum(p.total for p in parts),
        kept=sum(p.kept for p in parts),
        lost=dict(lost.most_common()),
    )


def with_totals(rows: Sequence[Account]) -> list[Account]:
    """The accounts, then those of all objects: each phase, and both."""
    phases = [summed((row for row in rows if row.phase == phase), "all", phase) for phase in PHASES]
    return [*rows, *phases, summed(rows, "all", "both")]


def described(lost: dict[str, int]) -> str:
    """Such as ``arm jump 12, hand error 3``."""
    return ", ".join(f"{reason} {n}" for reason, n in lost.items())


def accounts_path(path: Path) -> Path:
    """Where the accounts of a file lie: beside it."""
    return path.with_name(f"{path.stem}.accounts.json")


def write_accounts(path: Path, *, of: str, rows: Sequence[Account], **more: Any) -> None:
    """Write accounts as JSON: ``of`` what (such as ``frames``), and ``more`` by name."""
    write_json(path, {"schema": SCHEMA, "of": of, "rows": [asdict(row) for row in with_totals(rows)]} | more)
