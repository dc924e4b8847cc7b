"""Reading the files that can be shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from xreset.demos.archive import Demos, ObjectMotions, demo_objects, read_demos
from xreset.description import load_robot
from xreset.errors import FileFormatError, XResetError
from xreset.geometry.surface import Surface, keypoint_contacts
from xreset.objects.catalogue import load_objects
from xreset.pictures.view.data import Human, View
from xreset.records import npz_schema
from xreset.resets.bank import ResetBank, check_objects, check_retargeted, read_bank
from xreset.retarget.file import read_retargeted
from xreset.retarget.pipeline import RetargetConfig, rest_on_table
from xreset.spec import ObjectSpec

_BANK_RATE = 5.0
"""States of a bank that are played per second: they are no motion, and are looked at one by one."""


def load_view(
    path: Path,
    *,
    demos: Path | None = None,
    retargeted: Path | None = None,
    robot: str | None = None,
    objects: Path | None = None,
) -> View:
    """Read a file of any of the three kinds.

    Args:
        path: demonstrations, robot trajectories or reset bank.
        demos: demonstrations that trajectories or bank were made from: shows the human hand too.
        retargeted: robot trajectories that a bank was made from: shows the states too that physics rejected.
        robot: name or folder of the robot; default: the one that the file names.
        objects: folder of real meshes; None for the stand-ins.

    Raises:
        XResetError: a file, the robot or an object cannot be used, or the files do not belong together.
    """
    schema = npz_schema(path)
    name = schema.rpartition("/")[0]
    if retargeted is not None and name != "xreset-resets":
        raise XResetError(
            f"{path} is no reset bank: leave out --retargeted, which shows what physics rejected of a bank."
        )
    if name == "xreset-demos":
        if demos is not None or robot is not None:
            raise XResetError(
                f"{path} holds demonstrations only: leave out --demos and --robot, or give a retargeted file."
            )
        return _demos_view(path, objects)
    if name == "xreset-retargeted":
        return _retargeted_view(path, objects, robot, demos)
    if name == "xreset-resets":
        return _bank_view(path, objects, robot, demos, retargeted)
    raise FileFormatError(
        f"{path} states schema {schema!r}; what can be shown is xreset-demos, xreset-retargeted and xreset-resets."
    )


def _demos_view(path: Path, folder: Path | None) -> View:
    demos = read_demos(path)
    objects = tuple(demo_objects(demos, folder).values())
    demos, human = _human(demos, objects)
    contact = np.asarray(human.touching.any(axis=1))
    touched = np.concatenate([np.logical_or.accumulate(contact[demos.frames(s)]) for s in range(len(demos))])
    return View(
        kind="demonstrations",
        robot=None,
        **_motions(demos, objects),
        contact=contact,
        post_contact=touched,
        reason=tuple("" if valid else "not annotated" for valid in demos.hand_valid),
        reasons=("not annotated",),
        human=human,
    )


def _motions(data: ObjectMotions, objects: Sequence[ObjectSpec]) -> dict[str, Any]:
    """What a view shows of files of frames."""
    names, owner, (goal_pos, goal_quat) = [spec.name for spec in objects], data.sequence_of_frame, data.goal_pose
    return {
        "objects": tuple(objects),
        "rate": data.fps,
        "sequence_name": tuple(data.sequence_name.tolist()),
        "sequence": owner,
        "frame": np.arange(len(owner)) - data.frame_offsets[owner],
        "object_index": np.array([names.index(name) for name in data.object_name.tolist()])[owner],
        "object_pos": data.object_pos,
        "object_quat": data.object_quat_wxyz,
        "goal_pos": goal_pos,
        "goal_quat": goal_quat,
    }


def _retargeted_view(path: Path, folder: Path | None, robot: str | None, demos: Path | None) -> View:
    data = read_retargeted(path)
    spec = load_robot(robot or data.robot)
    check_retargeted(path, data, spec)
    objects = load_objects(sorted(set(data.object_name.tolist())), folder)
    shown = _motions(data, objects)
    return View(
        kind="robot trajectories",
        robot=spec,
        **shown,
        contact=data.contact,
        post_contact=data.post_contact,
        reason=tuple("" if reason == 0 else data.reason_names[reason] for reason in data.reason.tolist()),
        reasons=data.reason_names[1:],
        joint_pos=data.joint_pos,
        fingertips=data.fingertip_pos,
        hand_error=data.hand_error,
        wrist_error=data.wrist_error,
        human=None
        if demos is None
        else _human_of(path, demos, objects, data.sequence_name[shown["sequence"]], shown["frame"]),
    )


def _bank_view(path: Path, folder: Path | None, robot: str | None, demos: Path | None, retargeted: Path | None) -> View:
    found = read_bank(path)
    spec = load_robot(robot or found.robot)
    bank = read_bank(path, robot=spec)
    objects = load_objects(bank.object_names, folder)
    check_objects(path, bank, objects)
    if bank.num_states == 0 and retargeted is None:
        raise XResetError(
            f"{path} holds no state: physics rejected all of them. With --retargeted they can be looked at."
        )
    view = View(
        kind="reset states",
        robot=spec,
        objects=objects,
        rate=_BANK_RATE,
        sequence_name=tuple(bank.sequence_name.tolist()),
        sequence=bank.sequence_index,
        frame=bank.frame_index,
        object_index=np.array([bank.object_names.index(name) for name in bank.object_name.tolist()], dtype=int),
        object_pos=bank.object_pos,
        object_quat=bank.object_quat_wxyz,
        goal_pos=bank.goal_pos,
        goal_quat=bank.goal_quat_wxyz,
        contact=bank.post_contact,
        post_contact=bank.post_contact,
        reason=("",) * bank.num_states,
        reasons=(),
        joint_pos=bank.joint_pos,
    )
    if retargeted is not None:
        view = _with_rejected(path, view, bank, retargeted)
    if demos is not None:
        view = replace(
            view, human=_human_of(path, demos, objects, np.array(view.sequence_name)[view.sequence], view.frame)
        )
    return view


def _with_rejected(path: Path, view: View, bank: ResetBank, retargeted: Path) -> View:
    """A bank's view with the states that physics rejected, each in its place within its sequence."""
    data = read_retargeted(retargeted)
    parts = (bank.frame_part, bank.rejected_frame_part)
    whole, whole_rejected = (  # states between frames are not in the file
        slice(None) if part is None else part == 0 for part in parts
    )
    sequence = np.concatenate((bank.sequence_index[whole], bank.rejected_sequence_index[whole_rejected]))
    frame = np.concatenate((bank.frame_index[whole], bank.rejected_frame_index[whole_rejected]))
    kept = bank.joint_pos[whole]
    rows = (
        data.frame_offsets[:-1][sequence] + frame
        if data.sequence_name.tolist() == bank.sequence_name.tolist()
        else np.zeros(0, int)
    )
    tried = bool(len(rows)) and rows.max() < len(data.valid) and data.joint_names == bank.joint_names
    if not tried or not np.allclose(data.joint_pos[rows[: len(kept)]], kept, atol=1e-6):
        raise XResetError(f"{path} was not made from {retargeted}: sequences or states differ.")
    order = np.lexsort((frame, sequence))
    rows, sequence, frame = rows[order], sequence[order], frame[order]
    post = np.concatenate((bank.post_contact[whole], bank.rejected_post_contact[whole_rejected]))[order]
    names = (*("",) * len(kept), *(bank.reason_names[i] for i in bank.rejected_reason[whole_rejected].tolist()))
    object_of = np.array([bank.object_names.index(name) for name in bank.sequence_object.tolist()])
    return replace(
        view,
        sequence=sequence,
        frame=frame,
        object_index=object_of[sequence],
        object_pos=data.object_pos[rows],
        object_quat=data.object_quat_wxyz[rows],
        contact=post,
        post_contact=post,
        reason=tuple(names[i] for i in order.tolist()),
        reasons=bank.reason_names,
        joint_pos=data.joint_pos[rows],
        fingertips=data.fingertip_pos[rows],
        hand_error=data.hand_error[rows],
        wrist_error=data.wrist_error[rows],
    )


def _human(demos: Demos, objects: tuple[ObjectSpec, ...]) -> tuple[Demos, Human]:
    """The demonstrations as retargeting sees them (object on the table), and their hands with the contacts of retargeting."""
    demos = rest_on_table(demos, objects)
    keypoints = np.where(demos.hand_valid[:, None, None], demos.hand_keypoints.astype(np.float64), np.nan)
    touching, contacts = np.zeros(keypoints.shape[:2], dtype=bool), np.full_like(keypoints, np.nan)
    for spec in objects:
        rows = (demos.object_name == spec.name)[demos.sequence_of_frame]
        if rows.any():
            pos, quat = demos.object_pos[rows].astype(np.float64), demos.object_quat_wxyz[rows].astype(np.float64)
            points, touching[rows] = keypoint_contacts(
                Surface(spec), keypoints[rows], pos, quat, RetargetConfig().contact_distance
            )
            contacts[rows] = np.where(touching[rows][..., None], points, np.nan)
    return demos, Human(keypoints=keypoints, touching=touching, contacts=contacts)


def _human_of(
    path: Path, demos_path: Path, objects: tuple[ObjectSpec, ...], sequence: np.ndarray, frame: np.ndarray
) -> Human:
    """The hands of some frames, found by the name [N] of their sequence and the frame [N] within it."""
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
    return Human(keypoints=human.keypoints[rows], touching=human.touching[rows], contacts=human.contacts[rows])
