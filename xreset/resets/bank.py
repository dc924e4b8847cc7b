"""The reset bank: retargeted hand-object states that a physics engine has found stable, and the demonstrations' starts and goals.

Object poses are kept apart from the states: a demonstration whose every robot state was rejected still gives its start and its goal
(the paper's appendix D.c). Shape letters: L states, C candidates that were rejected, S sequences, J joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from xreset.accounts import Account, accounts
from xreset.errors import FileFormatError
from xreset.files import JOINT, POSITION, Field, Schema, read_npz, unique_problem, write_npz
from xreset.spec import ObjectSpec, RobotSpec

SCHEMA = "xreset-resets/1"

_FIELDS: Schema = {
    "robot": Field((), "U"),
    "robot_fingerprint": Field((), "U"),
    "backends": Field(("B",), "U"),
    "joint_names": Field(("J",), "U"),
    "joint_pos": Field(("L", "J"), "f", within=JOINT),
    "object_pos": Field(("L", 3), "f", within=POSITION),
    "object_quat_wxyz": Field(("L", 4), "f", unit=True),
    "object_name": Field(("L",), "U"),
    "sequence_index": Field(("L",), "i"),
    "frame_index": Field(("L",), "i"),
    "post_contact": Field(("L",), "b"),
    "sequence_name": Field(("S",), "U"),
    "sequence_object": Field(("S",), "U"),
    "start_pos": Field(("S", 3), "f", within=POSITION),
    "start_quat_wxyz": Field(("S", 4), "f", unit=True),
    "goal_pos": Field(("S", 3), "f", within=POSITION),
    "goal_quat_wxyz": Field(("S", 4), "f", unit=True),
    "object_names": Field(("O",), "U"),
    "object_sources": Field(("O",), "U"),
    "rejected_sequence_index": Field(("C",), "i"),
    "rejected_frame_index": Field(("C",), "i"),
    "rejected_post_contact": Field(("C",), "b"),
    "rejected_reason": Field(("C",), "i"),
    "reason_names": Field(("R",), "U"),
}


@dataclass(frozen=True, kw_only=True)
class ResetBank:
    """Contents of a reset bank; array shapes as in this module's schema."""

    robot: str
    robot_fingerprint: str
    """:attr:`xreset.spec.RobotSpec.fingerprint` of the robot that it was made for."""
    backends: tuple[str, ...]
    """Engines in which every state was stable."""
    joint_names: tuple[str, ...]
    joint_pos: np.ndarray
    object_pos: np.ndarray
    object_quat_wxyz: np.ndarray
    object_name: np.ndarray
    sequence_index: np.ndarray
    frame_index: np.ndarray
    post_contact: np.ndarray
    """[L] bool: whether the human hand had touched the object by that frame."""
    sequence_name: np.ndarray
    sequence_object: np.ndarray
    start_pos: np.ndarray
    """[S, 3] object position in frame 0."""
    start_quat_wxyz: np.ndarray
    goal_pos: np.ndarray
    """[S, 3] object position in the last frame."""
    goal_quat_wxyz: np.ndarray
    object_names: tuple[str, ...]
    """Objects of the sequences, sorted."""
    object_sources: tuple[str, ...]
    """Where each object's geometry came from (:attr:`xreset.spec.ObjectSpec.source`)."""
    rejected_sequence_index: np.ndarray
    rejected_frame_index: np.ndarray
    rejected_post_contact: np.ndarray
    rejected_reason: np.ndarray
    """[C] index into ``reason_names``."""
    reason_names: tuple[str, ...]

    @property
    def num_states(self) -> int:
        """L"""
        return len(self.joint_pos)

    def accounts(self) -> list[Account]:
        """What became of every state that was tried, by object and phase."""
        lost = np.asarray(self.sequence_object)[self.rejected_sequence_index]
        return accounts(
            np.concatenate((self.object_name, lost)),
            np.concatenate((self.post_contact, self.rejected_post_contact)),
            np.concatenate((np.full(self.num_states, ""), np.asarray(self.reason_names)[self.rejected_reason])),
        )

    def select(self, *, sequences: np.ndarray | None = None, pre_contact_only: bool = False) -> ResetBank:
        """A bank with the states of some sequences [bool mask over S], or only those before first contact; sequences stay listed."""
        keep = np.ones(self.num_states, dtype=bool)
        if sequences is not None:
            keep &= sequences[self.sequence_index]
        if pre_contact_only:
            keep &= ~self.post_contact
        names = ("joint_pos", "object_pos", "object_quat_wxyz", "object_name", "sequence_index", "frame_index", "post_contact")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})


def write_bank(path: str | Path, bank: ResetBank, *, config: Mapping[str, Any], inputs: Mapping[str, str]) -> None:
    """Write a bank; see :func:`xreset.files.write_npz`."""
    write_npz(path, SCHEMA, {f.name: _array(getattr(bank, f.name)) for f in fields(bank)}, config=config, inputs=inputs)


def read_bank(path: str | Path, *, robot: RobotSpec | None = None) -> ResetBank:
    """Read a bank.

    Args:
        path: file.
        robot: if given, the bank must be made for this robot.

    Raises:
        FileFormatError: the file is damaged, inconsistent, or for another robot.
    """
    arrays = read_npz(path, SCHEMA, _FIELDS, what="a reset bank", check=_check)
    values: dict[str, Any] = {}
    for f in fields(ResetBank):
        value = arrays[f.name]
        values[f.name] = str(value) if value.ndim == 0 else tuple(value.tolist()) if f.type == "tuple[str, ...]" else value
    bank = ResetBank(**values)
    if robot is not None:
        check_robot(path, "reset bank", robot, name=bank.robot, joint_names=bank.joint_names, fingerprint=bank.robot_fingerprint)
    return bank


def check_robot(path: str | Path, what: str, robot: RobotSpec, *, name: str, joint_names: tuple[str, ...], fingerprint: str) -> None:
    """Refuse a file that was made for another robot, or for another version of this one."""
    if name != robot.name or joint_names != robot.joint_names:
        raise FileFormatError(
            f"{path} is a {what} for the robot {name!r} with {len(joint_names)} joints; "
            f"{robot.name!r} has {len(robot.joints)}. Make it again with --robot {robot.name}, or use --robot {name}."
        )
    if fingerprint != robot.fingerprint:
        raise FileFormatError(f"{path} is a {what} for another version of {name!r}: its URDF or robot.toml has changed. Make it again.")


def check_objects(path: str | Path, bank: ResetBank, objects: tuple[ObjectSpec, ...]) -> None:
    """Refuse objects whose geometry is not what the bank was made with."""
    found = {o.name: o.source for o in objects}
    for name, source in zip(bank.object_names, bank.object_sources, strict=True):
        if name in found and found[name] != source:
            described = {True: "the built-in stand-in", False: "an imported mesh"}
            raise FileFormatError(
                f"{path} was made with {described[source == 'stand-in']} of {name}, but here is {described[found[name] == 'stand-in']}"
                " (or another one). Give the same --objects folder, or make the bank again."
            )


def _array(value: Any) -> np.ndarray:
    return np.asarray(value, dtype=np.str_) if isinstance(value, str) or (isinstance(value, tuple) and not value) else np.asarray(value)


def _check(arrays: dict[str, np.ndarray]) -> str | None:
    if problem := unique_problem(arrays["sequence_name"]):
        return problem
    for name in ("frame_index", "rejected_frame_index"):
        if (arrays[name] < 0).any():
            return f"array {name!r} holds negative numbers."
    for name, owner, what in (
        ("sequence_index", "sequence_name", "sequences"),
        ("rejected_sequence_index", "sequence_name", "sequences"),
        ("rejected_reason", "reason_names", "reasons"),
    ):
        if (arrays[name] >= len(arrays[owner])).any() or (arrays[name] < 0).any():
            return f"array {name!r} points beyond the {len(arrays[owner])} {what}."
    if (arrays["sequence_object"][arrays["sequence_index"]] != arrays["object_name"]).any():
        return "a state names another object than its sequence."
    missing = set(arrays["sequence_object"].tolist()) - set(arrays["object_names"].tolist())
    return f"'object_names' does not list {sorted(missing)}." if missing else None
