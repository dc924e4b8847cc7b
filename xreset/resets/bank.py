"""The reset bank: retargeted hand-object states that a physics engine has found stable, and the demonstrations' starts and goals.

Object poses are kept apart from the states: a demonstration whose every robot state was rejected still gives its start and its goal
(the paper's appendix D.c). Shape letters: L states, C candidates that were rejected, S sequences, J joints.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from xreset.accounts import Account, accounts
from xreset.demos.archive import ObjectMotions
from xreset.errors import FileFormatError
from xreset.geometry.urdf import robot_tree
from xreset.records import JOINT, POSITION, Field, read_record, schema_of, unique_problem, write_record
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec

SCHEMA = "xreset-resets/1"

BANDS = (0.10, 0.05, 0.02, 0.01, 0.001)
"""Distances [m] between a finger and the object by which states are counted where the hand closes in; nearer is contact."""


@dataclass(frozen=True, kw_only=True)
class Band:
    """States whose nearest finger is between two distances from the object."""

    nearer: float | None
    """[m] nearer than this ...; None: however far."""
    farther: float | None
    """[m] ... and not nearer than this; None: in contact."""
    tried: int
    """Demonstrated frames."""
    kept: int
    added: int
    """States between frames (:mod:`xreset.resets.closing`)."""
    added_kept: int


@dataclass(frozen=True, kw_only=True)
class ResetBank:
    """Contents of a reset bank."""

    robot: Annotated[str, Field((), "U")]
    robot_fingerprint: Annotated[str, Field((), "U")]
    """:attr:`xreset.spec.RobotSpec.fingerprint` of the robot that it was made for."""
    backends: Annotated[tuple[str, ...], Field(("B",), "U")]
    """Engines in which every state was stable."""
    joint_names: Annotated[tuple[str, ...], Field(("J",), "U")]
    joint_pos: Annotated[np.ndarray, Field(("L", "J"), "f", within=JOINT)]
    object_pos: Annotated[np.ndarray, Field(("L", 3), "f", within=POSITION)]
    object_quat_wxyz: Annotated[np.ndarray, Field(("L", 4), "f", unit=True)]
    object_name: Annotated[np.ndarray, Field(("L",), "U")]
    sequence_index: Annotated[np.ndarray, Field(("L",), "i")]
    frame_index: Annotated[np.ndarray, Field(("L",), "i")]
    post_contact: Annotated[np.ndarray, Field(("L",), "b")]
    """[L] bool: whether the human hand had touched the object by that frame."""
    sequence_name: Annotated[np.ndarray, Field(("S",), "U")]
    sequence_object: Annotated[np.ndarray, Field(("S",), "U")]
    start_pos: Annotated[np.ndarray, Field(("S", 3), "f", within=POSITION)]
    """[S, 3] object position in frame 0."""
    start_quat_wxyz: Annotated[np.ndarray, Field(("S", 4), "f", unit=True)]
    goal_pos: Annotated[np.ndarray, Field(("S", 3), "f", within=POSITION)]
    """[S, 3] object position in the last frame."""
    goal_quat_wxyz: Annotated[np.ndarray, Field(("S", 4), "f", unit=True)]
    object_names: Annotated[tuple[str, ...], Field(("O",), "U")]
    """Objects of the sequences, sorted."""
    object_sources: Annotated[tuple[str, ...], Field(("O",), "U")]
    """Where each object's geometry came from (:attr:`xreset.spec.ObjectSpec.source`)."""
    rejected_sequence_index: Annotated[np.ndarray, Field(("C",), "i")]
    rejected_frame_index: Annotated[np.ndarray, Field(("C",), "i")]
    rejected_post_contact: Annotated[np.ndarray, Field(("C",), "b")]
    rejected_reason: Annotated[np.ndarray, Field(("C",), "i")]
    """[C] index into ``reason_names``."""
    reason_names: Annotated[tuple[str, ...], Field(("R",), "U")]
    joint_target: Annotated[np.ndarray, Field(("L", "J"), "f", within=JOINT)] | None = None
    """[L, J] drive targets; None: they are the joints' positions, as in files of earlier versions (:attr:`targets`)."""
    frame_part: Annotated[np.ndarray, Field(("L",), "f", within=(0.0, 1.0))] | None = None
    """[L] how far a state lies on the way from its frame to the next, in [0, 1); None: every state is a frame."""
    rejected_frame_part: Annotated[np.ndarray, Field(("C",), "f", within=(0.0, 1.0))] | None = None
    """[C]"""
    finger_gap: Annotated[np.ndarray, Field(("L",), "f", within=POSITION)] | None = None
    """[L] distance of the nearest finger from the object [m] (:mod:`xreset.resets.fingers`); None in files of earlier versions."""
    rejected_finger_gap: Annotated[np.ndarray, Field(("C",), "f", within=POSITION)] | None = None
    """[C]"""

    @property
    def num_states(self) -> int:
        """L"""
        return len(self.joint_pos)

    @property
    def targets(self) -> np.ndarray:
        """[L, J] drive targets."""
        return self.joint_pos if self.joint_target is None else self.joint_target

    def accounts(self) -> list[Account]:
        """What became of every frame that was tried, by object and phase; states between frames are counted by :meth:`bands`."""
        lost = np.asarray(self.sequence_object)[self.rejected_sequence_index]
        frame = ~self._added
        return accounts(
            np.concatenate((self.object_name, lost))[frame],
            np.concatenate((self.post_contact, self.rejected_post_contact))[frame],
            np.concatenate((np.full(self.num_states, ""), np.asarray(self.reason_names)[self.rejected_reason]))[frame],
        )

    @property
    def num_pressing(self) -> int:
        """States whose drive targets are not the joints' positions."""
        return int((self.targets != self.joint_pos).any(axis=1).sum())

    def bands(self) -> list[Band]:
        """How many states were tried and accepted by how near a finger is, the farthest first; none if that is not known."""
        if self.finger_gap is None or self.rejected_finger_gap is None:
            return []
        gap, added = np.concatenate((self.finger_gap, self.rejected_finger_gap)), self._added
        accepted = np.arange(len(gap)) < self.num_states
        return [
            Band(
                nearer=high,
                farther=low,
                tried=int((mine & ~added).sum()),
                kept=int((mine & ~added & accepted).sum()),
                added=int((mine & added).sum()),
                added_kept=int((mine & added & accepted).sum()),
            )
            for high, low in pairwise((None, *BANDS, None))
            for mine in [(gap >= (-np.inf if low is None else low)) & (gap < (np.inf if high is None else high))]
        ]

    @property
    def _added(self) -> np.ndarray:
        """[L + C] bool: whether a state that was tried lies between frames; those that were accepted come first."""
        parts = ((self.frame_part, self.num_states), (self.rejected_frame_part, len(self.rejected_reason)))
        return np.concatenate([np.zeros(count, dtype=bool) if part is None else part > 0 for part, count in parts])

    def select(self, *, sequences: np.ndarray | None = None, pre_contact_only: bool = False) -> ResetBank:
        """A bank with the states of some sequences [bool mask over S], or only those before first contact; sequences stay listed."""
        keep = np.ones(self.num_states, dtype=bool)
        if sequences is not None:
            keep &= sequences[self.sequence_index]
        if pre_contact_only:
            keep &= ~self.post_contact
        of_states = [name for name, field in schema_of(ResetBank).items() if field.shape[:1] == ("L",)]
        return replace(self, **{name: value[keep] for name in of_states if (value := getattr(self, name)) is not None})


_DTYPES = {"f": np.float32, "i": np.int32, "b": np.bool_, "U": np.str_}


def starts_and_goals(motions: ObjectMotions, robot: RobotSpec, sources: Mapping[str, str] | None = None) -> ResetBank:
    """A bank of demonstrations or trajectories without any state; ``sources``: of the objects, where banks are kept."""
    schema, named = schema_of(ResetBank), tuple(sorted({*map(str, motions.object_name)}))
    of_states = {
        name: field for name, field in schema.items() if field.required and field.shape[0:1] in (("L",), ("C",))
    }
    (start_pos, start_quat), (goal_pos, goal_quat) = motions.start_pose, motions.goal_pose
    return ResetBank(
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        backends=(),
        joint_names=robot.joint_names,
        sequence_name=np.asarray(motions.sequence_name),
        sequence_object=np.asarray(motions.object_name),
        start_pos=start_pos.astype(np.float32),
        start_quat_wxyz=start_quat.astype(np.float32),
        goal_pos=goal_pos.astype(np.float32),
        goal_quat_wxyz=goal_quat.astype(np.float32),
        object_names=named,
        object_sources=tuple((sources or {}).get(name, "") for name in named),
        reason_names=(),
        **{
            name: np.zeros(
                [{"J": len(robot.joints)}.get(n, 0) if isinstance(n, str) else n for n in field.shape],
                _DTYPES[field.kind],
            )
            for name, field in of_states.items()
        },
    )


def write_bank(path: str | Path, bank: ResetBank, *, config: Mapping[str, Any], inputs: Mapping[str, str]) -> None:
    """Write a bank; see :func:`xreset.records.write_record`."""
    write_record(path, SCHEMA, bank, config=config, inputs=inputs)


def read_bank(path: str | Path, *, robot: RobotSpec | None = None) -> ResetBank:
    """Read a bank.

    Args:
        robot: if given, the bank must be made for this robot.

    Raises:
        FileFormatError: the file is damaged, inconsistent, or for another robot.
    """
    bank = read_record(ResetBank, path, SCHEMA, what="a reset bank", check=_check)
    if robot is not None:
        check_robot(
            path, "reset bank", robot, name=bank.robot, joint_names=bank.joint_names, fingerprint=bank.robot_fingerprint
        )
    return bank


def check_robot(
    path: str | Path, what: str, robot: RobotSpec, *, name: str, joint_names: tuple[str, ...], fingerprint: str
) -> None:
    """Refuse a file that was made for another robot, or for another version of this one."""
    if name != robot.name or joint_names != robot.joint_names:
        raise FileFormatError(
            f"{path} is a {what} for the robot {name!r} with {len(joint_names)} joints; "
            f"{robot.name!r} has {len(robot.joints)}. Make it again with --robot {robot.name}, or use --robot {name}."
        )
    if not robot.has_fingerprint(fingerprint):
        raise FileFormatError(
            f"{path} is a {what} for another version of {name!r}: its URDF, meshes or robot.toml have changed. Make it again."
        )


def check_retargeted(path: str | Path, data: Retargeted, robot: RobotSpec) -> None:
    """Refuse trajectories of another robot, or with joints outside this one's limits; ``FileFormatError``."""
    check_robot(
        path,
        "retargeted file",
        robot,
        name=data.robot,
        joint_names=data.joint_names,
        fingerprint=data.robot_fingerprint,
    )
    tree = robot_tree(robot)
    lower, upper = np.array([(tree.joint(name).lower, tree.joint(name).upper) for name in data.joint_names]).T
    beyond = np.where(data.valid[:, None], np.maximum(lower - data.joint_pos, data.joint_pos - upper), -np.inf)
    frame, joint = np.unravel_index(int(beyond.argmax()), beyond.shape)
    if beyond[frame, joint] > _BEYOND:
        raise FileFormatError(
            f"{path} holds {data.joint_names[joint]} = {data.joint_pos[frame, joint]:.4g} in frame {frame}, but it goes from "
            f"{lower[joint]:.4g} to {upper[joint]:.4g}. Make the file again: xreset retarget."
        )


_BEYOND = 1e-4
"""[rad or m] How far single precision may carry a joint beyond its limits."""


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
