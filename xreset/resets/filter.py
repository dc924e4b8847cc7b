"""Make a reset bank: the physics filter keeps the retargeted states that stay put (the paper's appendix D.c).

Each candidate is spawned at rest, the drives hold its joint positions, the object has no weight, and a few control
steps pass. It is rejected if it leaves the scene or still moves. A candidate with the robot deep in the object is not
tried: states between two frames may be deeper than these.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from xreset.errors import DemoError
from xreset.files.progress import Progress
from xreset.files.text import quantity
from xreset.geometry.collision import object_depth
from xreset.physics import State
from xreset.resets.bank import ResetBank, starts_and_goals
from xreset.resets.closing import closing_states
from xreset.resets.config import ClosingConfig, FilterConfig
from xreset.resets.fingers import fingers_of, grip_forces, squeeze_targets
from xreset.resets.probe import REASONS, rejection, rejections
from xreset.retarget.accounts import accounts
from xreset.retarget.file import Retargeted
from xreset.retarget.validity import Thresholds
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec, objects_named

_SHARES = (1.0, 0.5, 0.25)
"""Shares of the force with which fingers try to press, one after the other, until the object stays where it is."""
_FEW = 0.1
"""A demonstration that keeps a smaller share of its frames after contact is doubted."""


def stable_states(
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    engines: tuple[str, ...],
    *,
    limits: FilterConfig,
    closing: ClosingConfig,
    force: float,
    num_envs: int,
    device: str,
    progress: Progress,
) -> ResetBank:
    """Return the bank of the states that all engines accept; see :func:`xreset.resets.verbs.make_bank`.

    ``force``: normal force of each finger that presses [N]; 0: none does.
    """
    named = objects_named(objects, retargeted.object_names)
    if not retargeted.valid.any():
        raise DemoError(
            "no frame of the retargeted trajectories is valid, so there is no state to try. "
            "Look at the reasons of xreset retarget."
        )
    scene = SceneSpec(robot=robot, objects=tuple(named.values()))
    frame, part, poses = closing_states(retargeted, robot, objects, closing)
    sequence = retargeted.sequence_of_frame[frame]
    post_contact = retargeted.post_contact[frame]
    object_name = retargeted.object_name[sequence]
    states = State.at_rest(*map(torch.as_tensor, poses))
    find = partial(
        rejections,
        engines,
        scene,
        judge=partial(rejection, limits=limits),
        gravity=0.0,
        steps=limits.steps,
        num_envs=num_envs,
        device=device,
    )
    depth = object_depth(robot, objects, object_name, *poses)
    shallow = np.flatnonzero(depth <= Thresholds().object_depth)
    reason = np.full(len(frame), REASONS.index("object collision"))
    reason[shallow] = find(object_name[shallow], states[shallow], progress=progress)
    if force:
        rows = np.flatnonzero((reason < 0) & post_contact)
        touching = [values[rows] for values in poses]
        fingers = fingers_of(robot, scene.objects, object_name[rows], *touching)
        forces = grip_forces(fingers, force)
        beyond = squeeze_targets(robot, fingers, touching[0], forces) - touching[0]
        push = torch.zeros_like(states.joint_pos)
        push[rows] = torch.as_tensor(beyond, dtype=push.dtype)
        for share in _SHARES:
            states.joint_target[rows] = states.joint_pos[rows] + share * push[rows]
            rows = rows[find(object_name[rows], states[rows]) >= 0]
        states.joint_target[rows] = states.joint_pos[rows]
    work = len(engines) * len(shallow)
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
    return replace(
        starts_and_goals(retargeted, robot, objects),
        engines=engines,
        joint_pos=stable.joint_pos.numpy(),
        joint_target=stable.joint_target.numpy() if force else None,
        object_pos=stable.object_pos.numpy(),
        object_quat_wxyz=stable.object_quat.numpy(),
        object_name=object_name[keep],
        object_depth=depth[keep].astype(np.float32),
        rejected_reason=reason[~keep].astype(np.int32),
        reason_names=REASONS,
        **kept,
        **rejected,
    )


def doubt_about_losses(bank: ResetBank, motion: Retargeted, file: str) -> str:
    """Return a doubt about demonstrations that lost almost all frames after contact, or nothing; ``file``: motion to
    look at."""
    reason = np.asarray(motion.reason_names, dtype=object)[motion.reason]
    start = motion.frame_offsets
    rejected = np.asarray(bank.reason_names, dtype=object)[bank.rejected_reason]
    reason[start[bank.rejected_sequence_index] + bank.rejected_frame_index] = rejected
    reason[start[bank.sequence_index] + bank.frame_index] = ""  # also if states between are lost
    numbers = motion.sequence_of_frame.astype(str)
    rows = [row.without("not annotated") for row in accounts(numbers, motion.post_contact, reason)]
    few = [r for r in rows[:-3] if r.phase == "post-contact" and r.kept < _FEW * r.total]
    if not few:
        return ""
    worst = min(few, key=lambda row: row.kept / row.total)
    return (
        f"{len(few)} of {quantity(len(motion.sequence_name), 'demonstration')} kept less than {_FEW:.0%} of the frames "
        f"after contact; the worst kept {worst.kept} of {worst.total}, mostly because of {next(iter(worst.lost))!r}: "
        f"xreset view {file} --sequence {worst.object_name}"
    )
