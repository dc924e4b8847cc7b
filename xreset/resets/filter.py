"""Make a reset bank: the physics filter keeps the retargeted states that stay put (the paper's appendix D.c).

Each candidate is spawned at rest, the drives hold its joint positions, the object has no weight, and a few control
steps pass. It is rejected if it leaves the scene or still moves.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from xreset.errors import DemoError
from xreset.files.checks import PositiveInt, obeys_rules
from xreset.files.progress import Progress, unseen
from xreset.physics import State
from xreset.resets.bank import ResetBank, starts_and_goals
from xreset.resets.closing import closing_states
from xreset.resets.config import ClosingConfig, FilterConfig, SqueezeConfig, TransferConfig
from xreset.resets.fingers import fingers_of, squeeze_targets
from xreset.resets.probe import REASONS, probe, rejection
from xreset.resets.transfer import add_transfers
from xreset.retarget.file import Retargeted
from xreset.spec import (
    ObjectSpec,
    RobotSpec,
    SceneSpec,
    check_joints,
    checked_objects,
    objects_named,
)


@obeys_rules
def make_bank(
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    engine: str | Sequence[str] = "mujoco",
    *,
    num_envs: PositiveInt = 64,
    device: str = "cpu",
    limits: FilterConfig | None = None,
    closing: ClosingConfig | None = ClosingConfig(),
    squeeze: SqueezeConfig | None = SqueezeConfig(),
    transfer: TransferConfig | None = TransferConfig(),
    progress: Callable[[float, int], None] = unseen,
) -> ResetBank:
    """Try every valid frame in every engine and keep those that all engines accept; then add states in grasps of other
    demonstrations.

    Args:
        retargeted: robot trajectories.
        robot: the robot of the trajectories.
        objects: the objects of the trajectories.
        engine: name of an engine, or several names, tried in this order; a rejection states the first engine's reason.
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        limits: time and speeds by which states are judged; None: the draft paper's.
        closing: states to add between frames in which the hand closes in on the object; None: none.
        squeeze: with which force the drive targets of states after contact press on the object; None: targets are the
            joints' positions. Accepted states are tried once more with the targets, and an engine that rejects this
            leaves the targets where they were.
        transfer: states to add in grasps of other demonstrations (:func:`xreset.resets.transfer.add_transfers`); None:
            none. If no targets press, there are none, either.
        progress: called with (candidates tried, candidates in all); then again for ``transfer``.

    Raises:
        DemoError: no frame is valid, or an object of a valid frame is not among ``objects``.
        FileFormatError: the trajectories are for a robot with other joints.
    """
    objects = checked_objects(robot, objects)
    check_joints("The motion is", retargeted, robot)
    owner = retargeted.sequence_of_frame
    used = objects_named(objects, retargeted.object_name[owner[retargeted.valid]])
    engines = (engine,) if isinstance(engine, str) else tuple(engine)
    limits = limits or FilterConfig()
    squeeze = squeeze or SqueezeConfig(force=0.0, weight=0.0)
    if not retargeted.valid.any():
        raise DemoError(
            "no frame of the retargeted trajectories is valid, so there is no state to try. "
            "Look at the reasons of xreset retarget."
        )
    scene = SceneSpec(robot=robot, objects=tuple(used.values()))
    frame, part, poses = closing_states(
        retargeted, robot, objects, closing or ClosingConfig(spacing=None)
    )
    sequence = owner[frame]
    post_contact = retargeted.post_contact[frame]
    object_name = retargeted.object_name[sequence]
    states = State.at_rest(*map(torch.as_tensor, poses))
    work = len(engines) * len(frame)

    def try_candidates(rows: np.ndarray, report: Progress = unseen) -> np.ndarray:
        """Return the reasons for which candidates [rows] are rejected, -1 where every engine accepts them."""
        reason = np.full(len(rows), -1, dtype=np.int64)
        for number, name in enumerate(engines):
            left = np.flatnonzero(reason < 0)
            if not len(left):
                break
            before = number * len(rows)
            reason[left] = probe(
                name,
                scene,
                object_name[rows[left]],
                states[rows[left]],
                partial(rejection, limits=limits),
                gravity=0.0,
                steps=limits.steps,
                num_envs=num_envs,
                device=device,
                progress=lambda done, before=before: report(before + done, work),
            )
        return reason

    reason = try_candidates(np.arange(len(frame)), progress)
    if squeeze.presses:
        rows = np.flatnonzero((reason < 0) & post_contact)
        touching = [values[rows] for values in poses]
        fingers = fingers_of(robot, scene.objects, object_name[rows], *touching)
        targets = squeeze_targets(robot, fingers, touching[0], squeeze)
        states.joint_target[rows] = torch.as_tensor(targets, dtype=torch.float32)
        refused = rows[try_candidates(rows) >= 0]
        states.joint_target[refused] = states.joint_pos[refused]
    progress(work, work)

    keep = reason < 0
    stable = states[keep]
    columns = {
        "sequence_index": sequence.astype(np.int32),
        "frame_index": (frame - retargeted.frame_offsets[sequence]).astype(np.int32),
        "post_contact": post_contact,
    }
    if part.any():
        columns["frame_part"] = part.astype(np.float32)
    kept = {name: values[keep] for name, values in columns.items()}
    rejected = {f"rejected_{name}": values[~keep] for name, values in columns.items()}
    bank = replace(
        starts_and_goals(retargeted, robot, objects),
        engines=engines,
        joint_pos=stable.joint_pos.numpy(),
        joint_target=stable.joint_target.numpy() if squeeze.presses else None,
        object_pos=stable.object_pos.numpy(),
        object_quat_wxyz=stable.object_quat.numpy(),
        object_name=object_name[keep],
        rejected_reason=reason[~keep].astype(np.int32),
        reason_names=REASONS,
        **kept,
        **rejected,
    )
    if transfer is None or not squeeze.presses:
        return bank
    return add_transfers(
        bank,
        retargeted,
        robot,
        objects,
        transfer,
        num_envs=num_envs,
        device=device,
        progress=progress,
    )
