"""The reset bank: retargeted hand-object states that a physics engine found stable, and the demonstrations' starts and
goals.

Starts and goals do not depend on the states: a demonstration whose states were all rejected still has its start and its
goal (the paper's appendix D.c). Shape letters: L states, C rejected candidates, S sequences, J joints.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from xreset.demos.archive import (
    ObjectMotions,
    OneText,
    SequencePositions,
    SequenceQuaternions,
    SequenceTexts,
)
from xreset.errors import FileFormatError, XResetError
from xreset.files.checks import frozen
from xreset.files.records import (
    JOINT,
    POSITION,
    Arrays,
    Field,
    read_record,
    schema_of,
    unique_problem,
    write_record,
)
from xreset.files.text import Brief, quantity, shown
from xreset.retarget.accounts import Account, accounts
from xreset.retarget.file import JointNames, ReasonNames
from xreset.spec import ObjectSpec, RobotSpec, check_robot, first_difference

SCHEMA = "xreset-resets/1"

_EMPTY_TYPES = {"f": np.float32, "i": np.int32, "b": np.bool_, "U": np.str_}
"""Kind of a field -> type of its array in a bank without states."""

StateJoints = Annotated[np.ndarray, Field(("L", "J"), "f", within=JOINT)]
StateIndices = Annotated[np.ndarray, Field(("L",), "i", within=(0, inf))]
ObjectTexts = Annotated[tuple[str, ...], Field(("O",), "U")]
RejectedIndices = Annotated[np.ndarray, Field(("C",), "i", within=(0, inf))]


@frozen
class ResetBank(Brief):
    """Contents of a reset bank: starts and goals of demonstrations [S], stable states [L] and rejected candidates
    [C].

    A state is ``joint_pos`` [L, J], ``object_pos`` [L, 3] and ``object_quat_wxyz`` [L, 4], in the world frame. It was
    made from the frame ``frame_index`` [L] of the demonstration ``sequence_index`` [L]; ``transferred`` states [L] have
    the object's pose of that frame only.
    """

    robot: OneText
    robot_fingerprint: OneText
    """:attr:`xreset.spec.RobotSpec.fingerprint` of the robot that the bank was made for."""
    engines: Annotated[tuple[str, ...], Field(("B",), "U", earlier="backends")]
    """Engines in which every state was stable."""
    joint_names: JointNames

    # States
    joint_pos: StateJoints
    object_pos: Annotated[np.ndarray, Field(("L", 3), "f", within=POSITION)]
    object_quat_wxyz: Annotated[np.ndarray, Field(("L", 4), "f", unit=True)]
    object_name: Annotated[np.ndarray, Field(("L",), "U")]
    sequence_index: StateIndices
    frame_index: StateIndices
    post_contact: Annotated[np.ndarray, Field(("L",), "b")]
    """[L] bool: whether the human hand had touched the object by that frame."""

    # Starts and goals
    sequence_name: SequenceTexts
    sequence_object: SequenceTexts
    start_pos: SequencePositions
    """[S, 3] object position in frame 0."""
    start_quat_wxyz: SequenceQuaternions
    goal_pos: SequencePositions
    """[S, 3] object position in the last frame."""
    goal_quat_wxyz: SequenceQuaternions
    object_names: ObjectTexts
    """Objects of the sequences, sorted."""
    object_sources: ObjectTexts
    """Where each object's geometry came from (:attr:`xreset.spec.ObjectSpec.source`)."""

    # Rejected candidates
    rejected_sequence_index: RejectedIndices
    rejected_frame_index: RejectedIndices
    rejected_post_contact: Annotated[np.ndarray, Field(("C",), "b")]
    rejected_reason: RejectedIndices
    """[C] index into ``reason_names``."""
    reason_names: ReasonNames

    # What files of earlier versions do not have
    object_mass: Annotated[np.ndarray, Field(("O",), "f", within=(0.0, inf))] | None = None
    """[O] mass of each object [kg]; 0: not known."""
    object_friction: Annotated[np.ndarray, Field(("O",), "f", within=(0.0, inf))] | None = None
    """[O] friction of each object's material; 0: it has none of its own."""
    joint_target: StateJoints | None = None
    """[L, J] drive targets; None: the joints' positions (:attr:`targets`)."""
    frame_part: Annotated[np.ndarray, Field(("L",), "f", within=(0.0, 1.0))] | None = None
    """[L] how far a state is on the way from its frame to the next, in [0, 1); None: every state is a frame."""
    rejected_frame_part: Annotated[np.ndarray, Field(("C",), "f", within=(0.0, 1.0))] | None = None
    object_depth: Annotated[np.ndarray, Field(("L",), "f", within=(0.0, inf))] | None = None
    """[L] depth of the robot in the object [m] (:func:`xreset.geometry.collision.object_depth`), 0 outside it."""
    transferred: Annotated[np.ndarray, Field(("L",), "b")] | None = None
    """[L] bool: whether the hand has a grasp of another demonstration, which holds the object at full weight in all
    ``engines`` (:func:`xreset.resets.transfer.add_transfers`); None: no state has (:attr:`own_grasp`)."""

    def __repr__(self) -> str:
        states = quantity(self.num_states, "state")
        sequences = quantity(len(self.sequence_name), "sequence")
        objects = quantity(len(self.object_names), "object")
        return f"{type(self).__name__}({self.robot!r}, {states}, {sequences}, {objects})"

    @property
    def num_states(self) -> int:
        """Number of stable states (L)."""
        return len(self.joint_pos)

    @property
    def targets(self) -> np.ndarray:
        """[L, J] drive targets."""
        return self.joint_pos if self.joint_target is None else self.joint_target

    @property
    def num_pressing(self) -> int:
        """Number of states whose drive targets differ from the joints' positions."""
        return int((self.targets != self.joint_pos).any(axis=1).sum())

    @property
    def own_grasp(self) -> np.ndarray:
        """[L] bool: whether a state follows its own demonstration, in place of a grasp of another one."""
        if self.transferred is None:
            return np.ones(self.num_states, dtype=bool)
        return ~self.transferred

    def accounts(self) -> list[Account]:
        """Count the demonstrated frames that were kept and lost, by object and phase. States between frames, and
        states in grasps of other demonstrations, do not count."""
        object_name = np.concatenate(
            (self.object_name, self.sequence_object[self.rejected_sequence_index])
        )
        post_contact = np.concatenate((self.post_contact, self.rejected_post_contact))
        lost = np.asarray(self.reason_names)[self.rejected_reason]
        reason = np.concatenate((np.full(self.num_states, ""), lost))
        is_frame = np.ones(len(reason), dtype=bool)
        if self.frame_part is not None and self.rejected_frame_part is not None:
            is_frame = np.concatenate((self.frame_part, self.rejected_frame_part)) == 0
        is_frame[: self.num_states] &= self.own_grasp
        return accounts(object_name[is_frame], post_contact[is_frame], reason[is_frame])

    def with_states(self, rows: np.ndarray) -> ResetBank:
        """Return a bank with some of the states, given as a mask [L]; sequences stay listed."""
        changes = {}
        for name, schema in schema_of(ResetBank).items():
            value = getattr(self, name)
            if schema.shape[:1] == ("L",) and value is not None:
                changes[name] = value[rows]
        return replace(self, **changes)


def no_states(robot: RobotSpec) -> dict[str, Any]:
    """Return the fields of a bank of a robot without states and without rejected candidates."""
    empty: dict[str, Any] = {
        "robot": robot.name,
        "robot_fingerprint": robot.fingerprint,
        "joint_names": robot.joint_names,
        "engines": (),
        "reason_names": (),
    }
    lengths: dict[Any, Any] = {"L": 0, "C": 0, "J": len(robot.joints)}
    for name, schema in schema_of(ResetBank).items():
        if schema.required and schema.shape[:1] in (("L",), ("C",)):
            shape = [lengths.get(size, size) for size in schema.shape]
            empty[name] = np.zeros(shape, _EMPTY_TYPES[schema.kind])
    return empty


def starts_and_goals(
    motions: ObjectMotions, robot: RobotSpec, objects: Sequence[ObjectSpec] = ()
) -> ResetBank:
    """Return a bank of demonstrations or trajectories without states; ``objects`` state the sources of their
    geometry."""
    start_pos, start_quat = motions.start_pose
    goal_pos, goal_quat = motions.goal_pose
    return ResetBank(
        **no_states(robot),
        sequence_name=motions.sequence_name,
        sequence_object=motions.object_name,
        start_pos=start_pos.astype(np.float32),
        start_quat_wxyz=start_quat.astype(np.float32),
        goal_pos=goal_pos.astype(np.float32),
        goal_quat_wxyz=goal_quat.astype(np.float32),
        **object_columns(motions.object_names, objects),
    )


def object_columns(names: tuple[str, ...], objects: Iterable[ObjectSpec]) -> dict[str, Any]:
    """Return the fields of a bank that describe its objects [O]: their names, and what is known of them."""
    known = {obj.name: obj for obj in objects}
    listed = [known.get(name) for name in names]
    return {
        "object_names": names,
        "object_sources": tuple(obj.source if obj else "" for obj in listed),
        "object_mass": np.array([obj.mass if obj else 0.0 for obj in listed]),
        "object_friction": np.array([(obj.friction if obj else 0.0) or 0.0 for obj in listed]),
    }


def write_bank(
    path: str | Path,
    bank: ResetBank,
    *,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> None:
    """Write a bank. The file states the configuration that made it, and name -> SHA-256 of the input files."""
    write_record(ResetBank, path, SCHEMA, bank, check=bank_problem, config=config, inputs=inputs)


def read_bank(path: str | Path, *, robot: RobotSpec | None = None) -> ResetBank:
    """Read a bank.

    Args:
        path: npz file.
        robot: if given, the bank must be made for this robot.

    Raises:
        FileFormatError: the file is damaged, inconsistent, or for another robot.
    """
    bank = read_record(ResetBank, path, SCHEMA, what="a reset bank", check=bank_problem)
    if robot is not None:
        check_robot(path, "reset bank", bank, robot)
    return bank


def check_states(bank: ResetBank, robot: RobotSpec, objects: tuple[ObjectSpec, ...]) -> None:
    """Refuse a bank whose states have other joints or other object geometry; ``FileFormatError``."""
    if not isinstance(bank, ResetBank):
        raise XResetError(f"bank is {shown(bank)}, expected a ResetBank: xreset.read_bank(FILE).")
    if not bank.num_states:
        return
    if differs := first_difference(bank.joint_names, robot.joint_names):
        raise FileFormatError(
            f"The reset bank is for the robot {bank.robot!r}, whose joints are not those of {robot.name!r}: {differs}. "
            "Use one robot."
        )
    check_objects("The reset bank", bank, objects)


_SAME = 0.1
"""Relative difference of masses or frictions that counts as the same object: what a scale and a table of materials
give."""


def check_objects(path: str | Path, bank: ResetBank, objects: tuple[ObjectSpec, ...]) -> None:
    """Refuse objects whose geometry, mass or friction is not what the bank was made with; ``FileFormatError``."""
    check_sources(path, stated_sources(bank), {o.name: o.source for o in objects})
    for obj in objects:
        if obj.name not in bank.object_names:
            continue
        index = bank.object_names.index(obj.name)
        for what, unit, made, now in (
            ("mass", " kg", bank.object_mass, obj.mass),
            ("friction", "", bank.object_friction, obj.friction),
        ):
            if made is None or now is None or not made[index] > 0:  # files of 0.3 do not state it
                continue
            if abs(now / made[index] - 1) > _SAME:
                raise FileFormatError(
                    f"{path} was made with a {what} of {made[index]:.3g}{unit} of {obj.name}, but it is {now:.3g}{unit}"
                    " now. Make the file again, or restore the value in the mesh's NAME.toml."
                )


def stated_sources(bank: ResetBank) -> dict[str, str]:
    """Return the name of each object of a bank -> its ``source``."""
    return dict(zip(bank.object_names, bank.object_sources, strict=True))


def check_sources(path: str | Path, stated: Mapping[str, str], given: Mapping[str, str]) -> None:
    """Refuse objects whose geometry is not what a file states; ``FileFormatError``.

    Args:
        path: the file, for messages.
        stated: name of an object -> its ``source``, as the file states it.
        given: the same of the objects as they are.
    """
    for name, source in stated.items():
        given_source = given.get(name, source)
        if same_source(source, given_source):
            continue
        used = _described(source)
        found = _described(given_source)
        if found == used:
            found = "another mesh, or has another tolerance in NAME.toml"
        raise FileFormatError(
            f"{path} was made with {used} of {name}, but the given one is {found}. Give the same folder of meshes "
            "(--meshes), or make it again."
        )


def same_source(one: str, other: str) -> bool:
    """Return whether two sources are of the same geometry. Files of 0.3 do not state the tolerance."""
    parts = zip(one.split(" "), other.split(" "), strict=False)
    return all(a == b for a, b in parts)


def _described(source: str) -> str:
    return "the built-in stand-in" if source == "stand-in" else "an imported mesh"


def bank_problem(arrays: Arrays) -> str | None:
    """Return what contradicts itself between the arrays of a bank, or None."""
    if problem := unique_problem(arrays["sequence_name"]):
        return problem
    for name, target in (
        ("sequence_index", "sequence_name"),
        ("rejected_sequence_index", "sequence_name"),
        ("rejected_reason", "reason_names"),
    ):
        if (arrays[name] >= len(arrays[target])).any():
            return f"array {name!r} points beyond {target!r}."
    if (arrays["sequence_object"][arrays["sequence_index"]] != arrays["object_name"]).any():
        return "a state names another object than its sequence."
    missing = set(arrays["sequence_object"].tolist()) - set(arrays["object_names"].tolist())
    return f"'object_names' does not list {sorted(missing)}." if missing else None
