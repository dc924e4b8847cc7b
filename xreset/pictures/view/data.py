"""Rows of states, the same for demonstrations, robot trajectories, banks and goal sets, and how to choose among them.

Shape letters: N rows (frames of trajectories, or states of a bank), S sequences, J joints, E fingertips, 21 keypoints.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from xreset.demos.hand import PARENTS
from xreset.errors import XResetError
from xreset.files.checks import frozen
from xreset.spec import ObjectSpec, RobotSpec

Kind = Literal["demonstrations", "robot trajectories", "reset states", "starts"]
GOOD: dict[Kind, str] = {
    "demonstrations": "annotated",
    "robot trajectories": "valid",
    "reset states": "stable in physics",
    "starts": "start, at rest",
}
"""Name of a row without a reason against it."""
PHASES = ("before contact", "after contact")
BONES = np.column_stack((PARENTS, np.arange(1, 21)))
"""[20, 2] keypoints at the ends of each bone of the human hand."""


@frozen
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
    post_contact: np.ndarray
    """[N] bool: at or after the sequence's first contact."""
    reason: tuple[str, ...]
    """[N] why a row is not valid (not stable, not annotated); empty text for a good row."""
    joint_pos: np.ndarray | None = None
    """[N, J]"""
    fingertips: np.ndarray | None = None
    """[N, E, 3] of the robot."""
    hand_error: np.ndarray | None = None
    """[N] mean distance of the robot's fingertips from the human's [m]."""
    wrist_error: np.ndarray | None = None
    """[N] distance of the hand from its target [m]."""
    notes: tuple[str, ...] = ()
    """Doubts about the demonstrations."""
    own_grasp: np.ndarray | None = None
    """[N] bool: False where the robot has a grasp of another demonstration."""
    human_keypoints: np.ndarray | None = None
    """[N, 21, 3] of the demonstrating hand; NaN where not annotated."""
    human_touching: np.ndarray | None = None
    """[N, 21] bool: keypoints in contact with the object."""

    @property
    def is_motion(self) -> bool:
        """Whether the rows of a sequence follow one another in time."""
        return self.kind in ("demonstrations", "robot trajectories")

    @property
    def has_hand(self) -> np.ndarray:
        """[N] bool: whether a row shows a human hand; where the file has none, whether the robot's state is good."""
        if self.human_keypoints is not None:
            return np.asarray(np.isfinite(self.human_keypoints).all(axis=(1, 2)))
        return np.array([not reason for reason in self.reason], dtype=bool)

    def choose(self, *, sequence: int | None = None, reason: str | None = None) -> np.ndarray:
        """Return the indices of the rows of a sequence, or with a reason, in order; may be empty.

        Args:
            sequence: None: all sequences.
            reason: a reason; empty text for good rows; None: all rows.

        Raises:
            XResetError: unknown sequence.
        """
        keep = np.ones(len(self.frame), dtype=bool)
        if sequence is not None:
            count = len(self.sequence_name)
            if not 0 <= sequence < count:
                raise XResetError(
                    f"There is no sequence {sequence}: the file has {count}, counted from 0."
                )
            keep &= self.sequence == sequence
        if reason is not None:
            keep &= np.array(self.reason) == reason
        return np.flatnonzero(keep)

    def some_rows(self, sequence: int | None, frame: int | None = None) -> np.ndarray:
        """Return the indices of the rows of a sequence, in order; None: of all, or of the first one of a motion.

        Raises:
            XResetError: there is no such sequence or frame, or no row.
        """
        if sequence is None and self.is_motion:
            sequence = 0
        rows = self.choose(sequence=sequence)
        if not len(rows):
            raise XResetError(f"Sequence {sequence} has no state. Choose another sequence.")
        if frame is not None and not 0 <= frame < len(rows):
            raise XResetError(f"There is no frame {frame}: there are {len(rows)}, counted from 0.")
        return rows

    def text(self, row: int) -> tuple[str, ...]:
        """Return lines that describe a row, the most important one first."""
        sequence = int(self.sequence[row])
        state = GOOD[self.kind]
        if reason := self.reason[row]:
            state = reason if self.robot is None else f"not valid: {reason}"
        lines = [
            state,
            self.objects[self.object_index[row]].name,
            f"sequence {sequence}: {self.sequence_name[sequence]}",
        ]
        if self.kind != "starts":
            lines += [f"frame {int(self.frame[row])}", PHASES[int(self.post_contact[row])]]
        if self.own_grasp is not None and not self.own_grasp[row]:
            lines.append("grasp of another demonstration")
        if (
            self.hand_error is not None
            and self.wrist_error is not None
            and np.isfinite(self.hand_error[row])
        ):
            tips = 1e3 * self.hand_error[row]
            wrist = 1e3 * self.wrist_error[row]
            lines.append(f"off by {tips:.0f} mm (fingertips), {wrist:.0f} mm (wrist)")
        return tuple(lines)
