"""The file between retargeting and reset bank: robot trajectories, frame by frame, with their validity.

Shape letters: S sequences, F frames of all sequences, J joints, E fingertips, R reasons.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from xreset.accounts import Account, accounts
from xreset.demos.archive import SIDES
from xreset.files import JOINT, POSITION, RATE, Field, Schema, offsets_problem, read_npz, write_npz
from xreset.text import shown

SCHEMA = "xreset-retargeted/1"

_FIELDS: Schema = {
    "robot": Field((), "U"),
    "robot_fingerprint": Field((), "U"),
    "sequence_name": Field(("S",), "U"),
    "object_name": Field(("S",), "U"),
    "hand_side": Field(("S",), "U"),
    "frame_offsets": Field(("S+1",), "i"),
    "fps": Field((), "f", within=RATE),
    "joint_names": Field(("J",), "U"),
    "joint_pos": Field(("F", "J"), "f", within=JOINT),
    "palm_pos": Field(("F", 3), "f", within=POSITION),
    "palm_quat_wxyz": Field(("F", 4), "f", unit=True),
    "fingertip_names": Field(("E",), "U"),
    "fingertip_pos": Field(("F", "E", 3), "f", within=POSITION),
    "object_pos": Field(("F", 3), "f", within=POSITION),
    "object_quat_wxyz": Field(("F", 4), "f", unit=True),
    "goal_pos": Field(("S", 3), "f", within=POSITION),
    "goal_quat_wxyz": Field(("S", 4), "f", unit=True),
    "annotated": Field(("F",), "b"),
    "valid": Field(("F",), "b"),
    "reason": Field(("F",), "i"),
    "reason_names": Field(("R",), "U"),
    "contact": Field(("F",), "b"),
    "first_contact": Field(("S",), "i"),
    "hand_error": Field(("F",), "f", within=None),
    "wrist_error": Field(("F",), "f", within=None),
}


@dataclass(frozen=True, kw_only=True)
class Retargeted:
    """Robot trajectories of demonstrations, in the table frame; array shapes as in this module's schema."""

    robot: str
    robot_fingerprint: str
    """:attr:`xreset.spec.RobotSpec.fingerprint` of the robot that they were made for."""
    sequence_name: np.ndarray
    object_name: np.ndarray
    hand_side: np.ndarray
    """Side of the human hand: ``right`` or ``left``."""
    frame_offsets: np.ndarray
    """Sequence i owns frames ``frame_offsets[i] : frame_offsets[i + 1]``."""
    fps: float
    """Frames per second."""
    joint_names: tuple[str, ...]
    joint_pos: np.ndarray
    """[F, J] within the joint limits; meaningful where ``valid``."""
    palm_pos: np.ndarray
    palm_quat_wxyz: np.ndarray
    fingertip_names: tuple[str, ...]
    fingertip_pos: np.ndarray
    object_pos: np.ndarray
    """[F, 3] the demonstration's, put onto the table; meaningful in every frame, whether ``valid`` or not."""
    object_quat_wxyz: np.ndarray
    goal_pos: np.ndarray
    """[S, 3] object position in the last frame."""
    goal_quat_wxyz: np.ndarray
    annotated: np.ndarray
    """[F] whether the human hand was annotated."""
    valid: np.ndarray
    """[F] whether the frame may be used as a reset."""
    reason: np.ndarray
    """[F] index into ``reason_names``; 0 where valid."""
    reason_names: tuple[str, ...]
    contact: np.ndarray
    """[F] whether a human keypoint touches the object."""
    first_contact: np.ndarray
    """[S] frame within the sequence in which the human first touches the object; -1 if never."""
    hand_error: np.ndarray
    """[F] mean distance of the robot's fingertips from the human's [m]; infinite where not annotated."""
    wrist_error: np.ndarray
    """[F] distance of the hand root from where hand retargeting wants it [m]; infinite where not annotated."""

    @property
    def sequence_of_frame(self) -> np.ndarray:
        """[F] index of every frame's sequence."""
        return np.repeat(np.arange(len(self.sequence_name)), np.diff(self.frame_offsets))

    @property
    def post_contact(self) -> np.ndarray:
        """[F] bool: whether the human has touched the object by that frame."""
        owner = self.sequence_of_frame
        first = np.asarray(self.first_contact)[owner]
        return (first >= 0) & (np.arange(len(owner)) - self.frame_offsets[owner] >= first)

    def accounts(self) -> list[Account]:
        """What became of every frame, by object and phase."""
        reason = np.where(self.valid, "", np.asarray(self.reason_names)[self.reason])
        return accounts(np.asarray(self.object_name)[self.sequence_of_frame], self.post_contact, reason)


def write_retargeted(path: str | Path, retargeted: Retargeted, *, config: Mapping[str, Any], inputs: Mapping[str, str]) -> None:
    """Write trajectories; see :func:`xreset.files.write_npz` for ``config`` and ``inputs``."""
    write_npz(path, SCHEMA, {f.name: np.asarray(getattr(retargeted, f.name)) for f in fields(retargeted)}, config=config, inputs=inputs)


def read_retargeted(path: str | Path) -> Retargeted:
    """Read trajectories; all of the file is checked before any of it is used.

    Raises:
        FileFormatError: the file is missing, damaged, of another kind, or inconsistent.
    """
    arrays = read_npz(path, SCHEMA, _FIELDS, what="retargeted trajectories", check=_check)
    values: dict[str, Any] = {name: arrays[name] for name in _FIELDS}
    for name in ("joint_names", "fingertip_names", "reason_names"):
        values[name] = tuple(values[name].tolist())
    return Retargeted(
        **values | {"robot": str(values["robot"]), "robot_fingerprint": str(values["robot_fingerprint"]), "fps": float(values["fps"])}
    )


def _check(arrays: dict[str, np.ndarray]) -> str | None:
    offsets = arrays["frame_offsets"]
    if problem := offsets_problem(arrays, len(arrays["joint_pos"])):
        return problem
    if (wrong := ~np.isin(arrays["hand_side"], SIDES)).any():
        return f"array 'hand_side' holds {shown(str(arrays['hand_side'][wrong][0]))}, expected right or left."
    if ((arrays["reason"] < 0) | (arrays["reason"] >= len(arrays["reason_names"]))).any():
        return "array 'reason' points beyond 'reason_names'."
    if (arrays["valid"] != (arrays["reason"] == 0)).any():
        return "'valid' and 'reason' contradict each other."
    for name in ("hand_error", "wrist_error"):
        if not (arrays[name] >= 0).all():
            return f"array {name!r} holds negative distances, or some that are no number."
    if ((arrays["first_contact"] < -1) | (arrays["first_contact"] >= np.diff(offsets))).any():
        return "array 'first_contact' points beyond its sequence."
    return None
