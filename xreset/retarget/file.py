"""The file that retargeting writes, for the reset bank: robot trajectories and the validity of every frame.

Shape letters: S sequences, F frames of all sequences, J joints, E fingertips, R reasons.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from xreset.demos.archive import (
    FrameFlags,
    FramePositions,
    FrameQuaternions,
    ObjectMotions,
    OneText,
    SequencePositions,
    SequenceQuaternions,
    SequenceTexts,
    sequences_problem,
)
from xreset.errors import FileFormatError
from xreset.files.checks import frozen
from xreset.files.records import (
    JOINT,
    POSITION,
    RATE,
    Arrays,
    Field,
    read_record,
    write_record,
)
from xreset.geometry.urdf import joint_limits
from xreset.retarget.accounts import Account, accounts
from xreset.spec import RobotSpec, check_robot

SCHEMA = "xreset-retargeted/1"

JointNames = Annotated[tuple[str, ...], Field(("J",), "U")]
ReasonNames = Annotated[tuple[str, ...], Field(("R",), "U")]
FrameDistances = Annotated[np.ndarray, Field(("F",), "f", within=None)]


@frozen
class Retargeted(ObjectMotions):
    """Robot trajectories of demonstrations, in the table frame.

    ``palm_pos`` [F, 3], ``palm_quat_wxyz`` [F, 4] and ``fingertip_pos`` [F, E, 3] follow from ``joint_pos``.
    """

    robot: OneText
    robot_fingerprint: OneText
    """:attr:`xreset.spec.RobotSpec.fingerprint` of the robot."""
    sequence_name: SequenceTexts
    object_name: SequenceTexts
    hand_side: SequenceTexts
    """Side of the human hand: ``right`` or ``left``."""
    frame_offsets: Annotated[np.ndarray, Field(("S+1",), "i")]
    """Sequence i owns frames ``frame_offsets[i] : frame_offsets[i + 1]``."""
    fps: Annotated[float, Field((), "f", within=RATE)]
    """Frames per second."""
    joint_names: JointNames
    joint_pos: Annotated[np.ndarray, Field(("F", "J"), "f", within=JOINT)]
    """[F, J] within the joint limits; meaningful where ``valid``."""
    palm_pos: FramePositions
    palm_quat_wxyz: FrameQuaternions
    fingertip_names: Annotated[tuple[str, ...], Field(("E",), "U")]
    fingertip_pos: Annotated[np.ndarray, Field(("F", "E", 3), "f", within=POSITION)]
    object_pos: FramePositions
    """[F, 3] object position of the demonstration, put onto the table; meaningful in every frame, valid or not."""
    object_quat_wxyz: FrameQuaternions
    goal_pos: SequencePositions
    """[S, 3] object position in the last frame."""
    goal_quat_wxyz: SequenceQuaternions
    annotated: FrameFlags
    """[F] whether the human hand was annotated."""
    valid: FrameFlags
    """[F] whether the frame may be used as a reset."""
    reason: Annotated[np.ndarray, Field(("F",), "i")]
    """[F] index into ``reason_names``; 0 where valid."""
    reason_names: ReasonNames
    contact: FrameFlags
    """[F] whether a human keypoint touches the object."""
    first_contact: Annotated[np.ndarray, Field(("S",), "i")]
    """[S] frame within the sequence in which the human first touches the object; -1 if never."""
    hand_error: FrameDistances
    """[F] mean distance of the robot's fingertips from the human's [m]; infinite where not annotated."""
    wrist_error: FrameDistances
    """[F] distance of the hand root from its target of hand retargeting [m]; infinite where not annotated."""

    # What files of earlier versions do not have
    contact_error: FrameDistances | None = None
    """[F] mean distance between the points of the object that keypoints touch and the surfaces of the links that follow
    these [m]; infinite where none touches."""
    object_depth: FrameDistances | None = None
    """[F] depth of the robot in the object [m] (:func:`xreset.geometry.collision.object_depth`), 0 outside it; infinite
    where not annotated."""

    @property
    def post_contact(self) -> np.ndarray:
        """[F] bool: whether the human has touched the object by that frame."""
        owner = self.sequence_of_frame
        first = self.first_contact[owner]
        return (first >= 0) & (np.arange(len(owner)) - self.frame_offsets[owner] >= first)

    def accounts(self) -> list[Account]:
        """Count valid frames and the reasons of invalid ones, by object and phase."""
        reason = np.where(self.valid, "", np.asarray(self.reason_names)[self.reason])
        return accounts(self.object_name[self.sequence_of_frame], self.post_contact, reason)


def write_retargeted(
    path: str | Path,
    retargeted: Retargeted,
    *,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> None:
    """Write trajectories, the configuration that made them, and the inputs: name -> SHA-256 of a file."""
    write_record(Retargeted, path, SCHEMA, retargeted, check=_check, config=config, inputs=inputs)


def read_retargeted(path: str | Path) -> Retargeted:
    """Read trajectories; the whole file is checked before any of it is used.

    Raises:
        FileFormatError: the file is missing, damaged, of another kind, or inconsistent.
    """
    return read_record(Retargeted, path, SCHEMA, what="a file of xreset retarget", check=_check)


_TOLERANCE = 1e-4
"""Largest excess over a joint limit that is put down to single precision [rad or m]."""


def check_retargeted(path: str | Path, data: Retargeted, robot: RobotSpec) -> None:
    """Raise ``FileFormatError`` if trajectories are of another robot, or have joints outside this robot's limits."""
    check_robot(path, "retargeted file", data, robot)
    lower, upper = joint_limits(robot)
    outside = np.maximum(lower - data.joint_pos, data.joint_pos - upper)
    beyond = np.where(data.valid[:, None], outside, -np.inf)
    frame, joint = np.unravel_index(beyond.argmax(), beyond.shape)
    if beyond[frame, joint] > _TOLERANCE:
        raise FileFormatError(
            f"{path} holds {data.joint_names[joint]} = {data.joint_pos[frame, joint]:.4g} in frame {frame}, but the "
            f"joint goes from {lower[joint]:.4g} to {upper[joint]:.4g}. Make the file again: xreset retarget."
        )


def object_sources(inputs: Mapping[str, str]) -> dict[str, str]:
    """Return object name -> :attr:`~xreset.spec.ObjectSpec.source` of the objects among the inputs that a file
    states."""
    objects = [name for name in inputs if name.startswith("object ")]
    return {name.removeprefix("object "): inputs[name] for name in objects}


def _check(arrays: Arrays) -> str | None:
    offsets = arrays["frame_offsets"]
    if problem := sequences_problem(arrays):
        return problem
    if ((arrays["reason"] < 0) | (arrays["reason"] >= len(arrays["reason_names"]))).any():
        return "array 'reason' points beyond 'reason_names'."
    if (arrays["valid"] != (arrays["reason"] == 0)).any():
        return "'valid' and 'reason' contradict each other."
    for name in ("hand_error", "wrist_error", "contact_error", "object_depth"):
        if name in arrays and not (arrays[name] >= 0).all():
            return f"array {name!r} contains negative or NaN distances, expected 0 or more."
    if ((arrays["first_contact"] < -1) | (arrays["first_contact"] >= np.diff(offsets))).any():
        return "array 'first_contact' points beyond its sequence."
    return None
