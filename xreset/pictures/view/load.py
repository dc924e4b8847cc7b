"""Read the files that can be shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from xreset.demos.archive import Demos, ObjectMotions, read_demos, rest_on_table
from xreset.demos.examine import examine, human_contacts
from xreset.errors import XResetError
from xreset.files.records import stated_doubts
from xreset.files.text import quantity
from xreset.geometry.surface import prepared_surface
from xreset.objects.catalogue import canonical_name
from xreset.pictures.view.data import View
from xreset.resets.bank import ResetBank
from xreset.resets.goals import GoalSet
from xreset.resets.inputs import Inputs, load_inputs
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec

_BANK_RATE = 5.0
"""States of a bank that are played per second: they are no motion, and are looked at one by one."""


def load_view(
    path: str | Path,
    *,
    demos: str | Path | None = None,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
) -> View:
    """Read demonstrations, robot trajectories, a reset bank or a goal set.

    Args:
        path: the file.
        demos: demonstrations that trajectories or a bank were made from: shows the human hand too.
        robot: name or folder of the robot; default: the one that the file names.
        meshes: folder of real meshes; None for the stand-ins.

    Raises:
        XResetError: a file, the robot or an object cannot be used, or the files do not belong together.
    """
    inputs = load_inputs(path, robot=robot, meshes=meshes)
    data = inputs.data
    if isinstance(data, Demos):
        if demos is not None or robot is not None:
            raise XResetError(
                f"{path} holds demonstrations only. Omit --demos and --robot, or give a retargeted file."
            )
        return _demos_view(data, inputs)
    if isinstance(data, Retargeted):
        view = _retargeted_view(data, inputs)
    elif isinstance(data, GoalSet):
        view = replace(_bank_view(_at_home(data, inputs.robot), inputs), kind="starts")
    else:
        if not data.num_states:
            raise XResetError(f"{path} holds no state: physics rejected all of them.")
        view = _bank_view(data, inputs)
    view = replace(view, notes=tuple(stated_doubts(path)))
    if demos is not None:
        view = replace(view, **_human_of(path, demos, view))
    return view


def _demos_view(demos: Demos, inputs: Inputs) -> View:
    surfaces = {spec.name: prepared_surface(spec) for spec in inputs.objects}
    notes = [str(finding) for finding in examine(demos, surfaces)]
    demos, human = _human(demos, inputs.objects)
    contact = human["human_touching"].any(axis=1)
    touched = [np.logical_or.accumulate(contact[demos.frames(s)]) for s in range(len(demos))]
    return View(
        kind="demonstrations",
        robot=None,
        notes=tuple(notes),
        **_motion(demos, inputs.objects),
        post_contact=np.concatenate(touched),
        reason=tuple("" if valid else "not annotated" for valid in demos.hand_valid),
        **human,
    )


def _motion(data: ObjectMotions, objects: Sequence[ObjectSpec]) -> dict[str, Any]:
    """Return the fields of a view that come from the objects' motions."""
    sequence = data.sequence_of_frame
    goal_pos, goal_quat = data.goal_pose
    return {
        "objects": tuple(objects),
        "rate": data.fps,
        "sequence_name": tuple(data.sequence_name.tolist()),
        "sequence": sequence,
        "frame": np.arange(len(sequence)) - data.frame_offsets[sequence],
        "object_index": _object_index(data.object_name, objects)[sequence],
        "object_pos": data.object_pos,
        "object_quat": data.object_quat_wxyz,
        "goal_pos": goal_pos,
        "goal_quat": goal_quat,
    }


def _object_index(names: np.ndarray, objects: Sequence[ObjectSpec]) -> np.ndarray:
    known = [spec.name for spec in objects]
    return np.array(
        [known.index(canonical_name(name, known)) for name in names.tolist()], dtype=int
    )


def _retargeted_view(data: Retargeted, inputs: Inputs) -> View:
    names = ("", *data.reason_names[1:])
    return View(
        kind="robot trajectories",
        robot=inputs.robot,
        **_motion(data, inputs.objects),
        post_contact=data.post_contact,
        reason=tuple(names[reason] for reason in data.reason.tolist()),
        joint_pos=data.joint_pos,
        fingertips=data.fingertip_pos,
        hand_error=data.hand_error,
        wrist_error=data.wrist_error,
    )


def _bank_view(bank: ResetBank, inputs: Inputs) -> View:
    return View(
        kind="reset states",
        robot=inputs.robot,
        objects=inputs.objects,
        rate=_BANK_RATE,
        sequence_name=tuple(bank.sequence_name.tolist()),
        sequence=bank.sequence_index,
        frame=bank.frame_index,
        object_index=_object_index(bank.object_name, inputs.objects),
        object_pos=bank.object_pos,
        object_quat=bank.object_quat_wxyz,
        goal_pos=bank.goal_pos,
        goal_quat=bank.goal_quat_wxyz,
        post_contact=bank.post_contact,
        reason=("",) * bank.num_states,
        joint_pos=bank.joint_pos,
        own_grasp=bank.own_grasp,
    )


def _at_home(goals: GoalSet, robot: RobotSpec) -> GoalSet:
    """Return a goal set with its starts as states, the robot at home."""
    count = len(goals.sequence_name)
    return replace(
        goals,
        joint_pos=np.tile(robot.home, (count, 1)),
        object_pos=goals.start_pos,
        object_quat_wxyz=goals.start_quat_wxyz,
        object_name=goals.sequence_object,
        sequence_index=np.arange(count),
        frame_index=np.zeros(count, dtype=int),
        post_contact=np.zeros(count, dtype=bool),
    )


def _human(demos: Demos, objects: Sequence[ObjectSpec]) -> tuple[Demos, dict[str, Any]]:
    """Return the demonstrations with the objects on the table, as retargeting uses them, and the fields of a view of
    their hands."""
    demos = rest_on_table(demos, objects)
    keypoints = np.where(
        demos.hand_valid[:, None, None], demos.hand_keypoints.astype(np.float64), np.nan
    )
    surfaces = {
        spec.name: prepared_surface(spec) for spec in objects if spec.name in demos.object_name
    }
    _, touching = human_contacts(demos, surfaces)
    return demos, {"human_keypoints": keypoints, "human_touching": touching}


def _human_of(path: str | Path, demos_path: str | Path, view: View) -> dict[str, np.ndarray]:
    """Return the fields of the hands of a view's rows, found in demonstrations by the name of the sequence and the
    frame within it."""
    demos = read_demos(demos_path)
    used = [view.sequence_name[number] for number in np.unique(view.sequence)]
    missing = sorted(set(used) - set(demos.sequence_name.tolist()))
    if missing:
        raise XResetError(
            f"{demos_path} lacks {quantity(len(missing), 'sequence')} of {path}, such as {missing[0]!r}."
            " Give the demonstrations that the file was made from."
        )
    demos = demos.select(sequences=used)
    found = demos.sequence_name.tolist()
    index = np.array([found.index(view.sequence_name[number]) for number in view.sequence])
    if (view.frame >= np.diff(demos.frame_offsets)[index]).any():
        raise XResetError(
            f"The sequences of {path} are longer than those of {demos_path}."
            " Give the demonstrations that the file was made from."
        )
    _, human = _human(demos, view.objects)
    return {name: values[demos.frame_offsets[index] + view.frame] for name, values in human.items()}
