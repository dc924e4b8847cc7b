"""What there is to see, the same for demonstrations, robot trajectories and reset banks: rows of states, and their choice.

Shape letters: N rows (frames of trajectories, or states of a bank), S sequences, J joints, E fingertips, 21 keypoints.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Literal

import numpy as np

from xreset.errors import XResetError
from xreset.spec import ObjectSpec, RobotSpec

Kind = Literal["demonstrations", "robot trajectories", "reset states"]
GOOD: dict[Kind, str] = {
    "demonstrations": "annotated",
    "robot trajectories": "valid",
    "reset states": "stable in physics",
}
"""What a row is called that has no reason against it."""
_BAD: dict[Kind, str] = {"demonstrations": "", "robot trajectories": "not valid: ", "reset states": "rejected: "}
Phase = Literal["before contact", "after contact"]
PHASES: tuple[Phase, ...] = ("before contact", "after contact")
BONES = np.array([(0 if i % 4 == 1 else i - 1, i) for i in range(1, 21)])
"""[20, 2] keypoints that a bone of the human hand joins."""


@dataclass(frozen=True, kw_only=True)
class Human:
    """The demonstrating hand in each row."""

    keypoints: np.ndarray
    """[N, 21, 3] NaN where not annotated."""
    touching: np.ndarray
    """[N, 21] bool: keypoints in contact with the object."""
    contacts: np.ndarray
    """[N, 21, 3] the point of the object's surface that each of those touches; NaN for the others."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Everything that is shown of a file, in the table frame."""

    kind: Kind
    robot: RobotSpec | None
    """None where only humans are shown."""
    objects: tuple[ObjectSpec, ...]
    rate: float
    """Rows per second when played."""
    sequence_name: tuple[str, ...]
    """[S]"""
    sequence: np.ndarray
    """[N] index of the row's sequence."""
    frame: np.ndarray
    """[N] frame within that sequence."""
    object_index: np.ndarray
    """[N] index into ``objects``."""
    object_pos: np.ndarray
    """[N, 3]"""
    object_quat: np.ndarray
    """[N, 4] (w, x, y, z)"""
    goal_pos: np.ndarray
    """[S, 3]"""
    goal_quat: np.ndarray
    """[S, 4]"""
    contact: np.ndarray
    """[N] bool: the human touches the object in this row; for a bank: has touched it by then."""
    post_contact: np.ndarray
    """[N] bool: at or after the sequence's first contact."""
    reason: tuple[str, ...]
    """[N] why a row is not valid (not stable, not annotated); empty text where it is."""
    reasons: tuple[str, ...]
    """Every reason that there could have been, in the order in which they are tested."""
    joint_pos: np.ndarray | None = None
    """[N, J]"""
    fingertips: np.ndarray | None = None
    """[N, E, 3] of the robot."""
    hand_error: np.ndarray | None = None
    """[N] mean distance of the robot's fingertips from the human's [m]."""
    wrist_error: np.ndarray | None = None
    """[N] distance of the hand from where it ought to be [m]."""
    human: Human | None = None

    def choose(
        self,
        *,
        sequence: int | None = None,
        object_name: str | None = None,
        phase: Phase | None = None,
        reason: str | None = None,
    ) -> np.ndarray:
        """Indices of the rows that meet every condition given, in order; may be empty.

        Args:
            reason: one of :attr:`reasons`; empty text for the rows without any.

        Raises:
            XResetError: there is no such sequence, object or reason.
        """
        keep = np.ones(len(self.frame), dtype=bool)
        if sequence is not None:
            if not 0 <= sequence < len(self.sequence_name):
                raise XResetError(
                    f"there is no sequence {sequence}; the file has {len(self.sequence_name)}, counted from 0."
                )
            keep &= self.sequence == sequence
        if object_name is not None:
            names = [spec.name for spec in self.objects]
            if object_name not in names:
                raise XResetError(f"the file has no object {object_name!r}; it has {', '.join(names)}.")
            keep &= self.object_index == names.index(object_name)
        if phase is not None:
            keep &= self.post_contact == (phase == "after contact")
        if reason is not None:
            if reason and reason not in self.reasons:
                raise XResetError(f"there is no reason {reason!r}; there are {', '.join(self.reasons) or 'none'}.")
            keep &= np.array(self.reason) == reason
        return np.flatnonzero(keep)

    def counts(self) -> dict[str, int]:
        """Number of rows with each reason, those without any under the empty text; reasons that no row has count 0."""
        found = Counter(self.reason)
        return {reason: found[reason] for reason in ("", *self.reasons)}

    def state(self, row: int) -> str:
        """Whether a row is good, or why not, in words."""
        reason = self.reason[row]
        return f"{_BAD[self.kind]}{reason}" if reason else GOOD[self.kind]

    def text(self, row: int) -> tuple[str, ...]:
        """Lines that say what a row is, the most important one first."""
        sequence = int(self.sequence[row])
        phase = PHASES[int(self.post_contact[row])]
        if self.contact[row] and self.kind != "reset states":
            count = f" ({int(self.human.touching[row].sum())} keypoints)" if self.human is not None else ""
            phase += f", human touches{count}"
        lines = (
            self.state(row),
            self.objects[self.object_index[row]].name,
            f"sequence {sequence}: {self.sequence_name[sequence]}",
            f"frame {int(self.frame[row])}",
            phase,
        )
        if self.hand_error is None or self.wrist_error is None or not np.isfinite(self.hand_error[row]):
            return lines
        return (
            *lines,
            f"off by {1e3 * self.hand_error[row]:.0f} mm (fingertips), {1e3 * self.wrist_error[row]:.0f} mm (wrist)",
        )
