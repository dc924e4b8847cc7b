"""What there is to see in a file, the same for demonstrations, robot trajectories and reset banks: rows of states, and their choice.

Shape letters: N rows (frames of trajectories, or states of a bank), S sequences, J joints, E fingertips, 21 keypoints.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from xreset.errors import FileFormatError, XResetError
from xreset.spec import ObjectSpec, RobotSpec

if TYPE_CHECKING:
    from xreset.demos.archive import Demos

Phase = Literal["before contact", "after contact"]
PHASES: tuple[Phase, ...] = ("before contact", "after contact")
BONES = np.array([(0 if i % 4 == 1 else i - 1, i) for i in range(1, 21)])
"""[20, 2] keypoints that a bone of the human hand joins."""
_BANK_RATE = 5.0
"""States of a bank that are played per second: they are no motion, and are looked at one by one."""


@dataclass(frozen=True, kw_only=True)
class Human:
    """The demonstrating hand in each row."""

    keypoints: np.ndarray
    """[N, 21, 3] NaN where not annotated."""
    touching: np.ndarray
    """[N, 21] bool: keypoints in contact with the object."""


@dataclass(frozen=True, kw_only=True)
class View:
    """Everything that is shown of a file, in the table frame."""

    kind: Literal["demonstrations", "robot trajectories", "reset states"]
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
    """[N] why a row is not valid; empty text where it is."""
    joint_pos: np.ndarray | None = None
    """[N, J]"""
    fingertips: np.ndarray | None = None
    """[N, E, 3] of the robot."""
    human: Human | None = None

    def choose(self, *, sequence: int | None = None, object_name: str | None = None, phase: Phase | None = None) -> np.ndarray:
        """Indices of the rows that meet every condition given, in order; may be empty.

        Raises:
            XResetError: there is no such sequence, or no such object.
        """
        keep = np.ones(len(self.frame), dtype=bool)
        if sequence is not None:
            if not 0 <= sequence < len(self.sequence_name):
                raise XResetError(f"there is no sequence {sequence}; the file has {len(self.sequence_name)}, counted from 0.")
            keep &= self.sequence == sequence
        if object_name is not None:
            names = [spec.name for spec in self.objects]
            if object_name not in names:
                raise XResetError(f"the file has no object {object_name!r}; it has {', '.join(names)}.")
            keep &= self.object_index == names.index(object_name)
        if phase is not None:
            keep &= self.post_contact == (phase == "after contact")
        return np.flatnonzero(keep)

    def text(self, row: int) -> tuple[str, ...]:
        """Lines that say what a row is, the most important one first."""
        sequence = int(self.sequence[row])
        if self.kind == "reset states":
            state = "stable in physics"
        elif self.reason[row]:
            state = f"not valid: {self.reason[row]}" if self.kind == "robot trajectories" else self.reason[row]
        else:
            state = "valid" if self.kind == "robot trajectories" else "annotated"
        phase = PHASES[int(self.post_contact[row])]
        if self.contact[row] and self.kind != "reset states":
            count = f" ({int(self.human.touching[row].sum())} keypoints)" if self.human is not None else ""
            phase += f", human touches{count}"
        return (
            state,
            self.objects[self.object_index[row]].name,
            f"sequence {sequence}: {self.sequence_name[sequence]}",
            f"frame {int(self.frame[row])}",
            phase,
        )


def load_view(path: Path, *, demos: Path | None = None, robot: str | None = None, objects: Path | None = None) -> View:
    """Read a file of any of the three kinds.

    Args:
        path: demonstrations, robot trajectories or reset bank.
        demos: demonstrations that trajectories or bank were made from: shows the human hand too.
        robot: name or folder of the robot; default: the one that the file names.
        objects: folder of real meshes; None for the stand-ins.

    Raises:
        XResetError: a file, the robot or an object cannot be used, or the files do not belong together.
    """
    schema = _schema(path)
    readers = {"xreset-demos": _demos_view, "xreset-retargeted": _retargeted_view, "xreset-resets": _bank_view}
    name = schema.rpartition("/")[0]
    if name not in readers:
        raise FileFormatError(f"{path} states schema {schema!r}; what can be shown is {', '.join(readers)}.")
    if name == "xreset-demos":
        if demos is not None or robot is not None:
            raise XResetError(f"{path} holds demonstrations only: leave out --demos and --robot, or give a retargeted file.")
        return _demos_view(path, objects)
    return readers[name](path, objects, robot, demos)


def _schema(path: Path) -> str:
    """What the file says it is; its reader checks the rest."""
    import zipfile

    if not path.is_file():
        raise FileFormatError(f"there is no file {path}. Check the path, or make the file first.")
    try:
        with np.load(path, allow_pickle=False) as file:
            return str(file["schema"])
    except (ValueError, OSError, EOFError, KeyError, AttributeError, TypeError, zipfile.BadZipFile) as error:
        raise FileFormatError(f"{path} is not one of xreset's npz files ({error}), or it is damaged.") from error


def _demos_view(path: Path, folder: Path | None) -> View:
    from xreset.demos.archive import demo_objects, read_demos

    demos = read_demos(path)
    objects = tuple(demo_objects(demos, folder).values())
    demos, human = _human(demos, objects)
    owner = demos.sequence_of_frame
    contact = np.asarray(human.touching.any(axis=1))
    touched = np.array([contact[demos.frames(s)][: i + 1].any() for s in range(len(demos)) for i in range(_length(demos, s))])
    names = [spec.name for spec in objects]
    goal_pos, goal_quat = demos.goal_pose
    return View(
        kind="demonstrations",
        robot=None,
        objects=objects,
        rate=demos.fps,
        sequence_name=tuple(demos.sequence_name.tolist()),
        sequence=owner,
        frame=np.arange(demos.num_frames) - demos.frame_offsets[owner],
        object_index=np.array([names.index(name) for name in demos.object_name.tolist()])[owner],
        object_pos=demos.object_pos,
        object_quat=demos.object_quat_wxyz,
        goal_pos=goal_pos,
        goal_quat=goal_quat,
        contact=contact,
        post_contact=touched,
        reason=tuple("" if valid else "hand not annotated" for valid in demos.hand_valid),
        human=human,
    )


def _retargeted_view(path: Path, folder: Path | None, robot: str | None, demos: Path | None) -> View:
    from xreset import robots
    from xreset.objects import load_objects
    from xreset.resets.bank import check_robot
    from xreset.retarget.file import read_retargeted

    data = read_retargeted(path)
    spec = robots.load(robot or data.robot)
    check_robot(path, "retargeted file", spec, name=data.robot, joint_names=data.joint_names, fingerprint=data.robot_fingerprint)
    objects = load_objects(sorted(set(data.object_name.tolist())), folder)
    names = [o.name for o in objects]
    owner = np.repeat(np.arange(len(data.sequence_name)), np.diff(data.frame_offsets))
    frame = np.arange(len(data.valid)) - data.frame_offsets[owner]
    first = data.first_contact[owner]
    return View(
        kind="robot trajectories",
        robot=spec,
        objects=objects,
        rate=data.fps,
        sequence_name=tuple(data.sequence_name.tolist()),
        sequence=owner,
        frame=frame,
        object_index=np.array([names.index(name) for name in data.object_name.tolist()])[owner],
        object_pos=data.object_pos,
        object_quat=data.object_quat_wxyz,
        goal_pos=data.goal_pos,
        goal_quat=data.goal_quat_wxyz,
        contact=data.contact,
        post_contact=(first >= 0) & (frame >= first),
        reason=tuple("" if reason == 0 else data.reason_names[reason] for reason in data.reason.tolist()),
        joint_pos=data.joint_pos,
        fingertips=data.fingertip_pos,
        human=None if demos is None else _human_of(path, demos, objects, data.sequence_name[owner], frame),
    )


def _bank_view(path: Path, folder: Path | None, robot: str | None, demos: Path | None) -> View:
    from xreset import robots
    from xreset.objects import load_objects
    from xreset.resets.bank import check_objects, read_bank

    found = read_bank(path)
    spec = robots.load(robot or found.robot)
    bank = read_bank(path, robot=spec)
    objects = load_objects(bank.object_names, folder)
    check_objects(path, bank, objects)
    if bank.num_states == 0:
        raise XResetError(f"{path} holds no state: physics rejected all of them. `xreset resets` says why.")
    return View(
        kind="reset states",
        robot=spec,
        objects=objects,
        rate=_BANK_RATE,
        sequence_name=tuple(bank.sequence_name.tolist()),
        sequence=bank.sequence_index,
        frame=bank.frame_index,
        object_index=np.array([bank.object_names.index(name) for name in bank.object_name.tolist()]),
        object_pos=bank.object_pos,
        object_quat=bank.object_quat_wxyz,
        goal_pos=bank.goal_pos,
        goal_quat=bank.goal_quat_wxyz,
        contact=bank.post_contact,
        post_contact=bank.post_contact,
        reason=("",) * bank.num_states,
        joint_pos=bank.joint_pos,
        human=None if demos is None else _human_of(path, demos, objects, bank.sequence_name[bank.sequence_index], bank.frame_index),
    )


def _human(demos: Demos, objects: tuple[ObjectSpec, ...]) -> tuple[Demos, Human]:
    """The demonstrations as retargeting sees them (object on the table), and their hands with the contacts of retargeting."""
    from xreset.retarget.pipeline import RetargetConfig, rest_on_table
    from xreset.retarget.surface import Surface, keypoint_contacts

    demos = rest_on_table(demos, objects)
    keypoints = np.where(demos.hand_valid[:, None, None], demos.hand_keypoints.astype(np.float64), np.nan)
    touching = np.zeros(keypoints.shape[:2], dtype=bool)
    for spec in objects:
        rows = (demos.object_name == spec.name)[demos.sequence_of_frame]
        if rows.any():
            pos, quat = demos.object_pos[rows].astype(np.float64), demos.object_quat_wxyz[rows].astype(np.float64)
            _, touching[rows] = keypoint_contacts(Surface(spec), keypoints[rows], pos, quat, RetargetConfig().contact_distance)
    return demos, Human(keypoints=keypoints, touching=touching)


def _human_of(path: Path, demos_path: Path, objects: tuple[ObjectSpec, ...], sequence: np.ndarray, frame: np.ndarray) -> Human:
    """The hands of some frames, found by the name [N] of their sequence and the frame [N] within it."""
    from xreset.demos.archive import read_demos

    demos = read_demos(demos_path)
    wanted = set(sequence.tolist())
    if missing := sorted(wanted - set(demos.sequence_name.tolist())):
        raise XResetError(
            f"{demos_path} does not have {len(missing)} sequences of {path}, such as {missing[0]!r}: was it made from others?"
        )
    demos = demos.select(names=wanted)
    index = {name: s for s, name in enumerate(demos.sequence_name.tolist())}
    owner = np.array([index[name] for name in sequence.tolist()])
    if (frame >= np.diff(demos.frame_offsets)[owner]).any():
        raise XResetError(f"the sequences of {path} are longer than those of {demos_path}: was it made from others?")
    _, human = _human(demos, objects)
    rows = demos.frame_offsets[owner] + frame
    return Human(keypoints=human.keypoints[rows], touching=human.touching[rows])


def _length(demos: Demos, sequence: int) -> int:
    return int(demos.frame_offsets[sequence + 1] - demos.frame_offsets[sequence])
