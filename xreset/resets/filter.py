"""The physics filter: which retargeted states stay put when they are spawned (the paper's appendix D.c).

Each candidate is spawned at rest, the drives hold its joint positions, gravity on the object is off, and eight control steps pass. It is
rejected if it leaves the scene or still moves: object faster than 0.10 m/s or 1.0 rad/s, or a joint faster than 2.0 rad/s.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from xreset.errors import DemoError
from xreset.physics import Backend, State
from xreset.plugins import device_for, make_backend
from xreset.resets.bank import ResetBank
from xreset.retarget.pipeline import Retargeted
from xreset.schedule import schedule
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task.config import TerminationConfig
from xreset.task.terminations import out_of_bounds

REASONS = ("out of bounds", "object linear velocity", "object angular velocity", "joint velocity", "not finite", "overflow")
"""Why a candidate is rejected; the first that applies, from the right: a state that is not finite is nothing else."""


@dataclass(frozen=True, kw_only=True)
class FilterConfig:
    """The paper's thresholds."""

    steps: int = 8
    """Control steps with the drives holding."""
    linear_velocity: float = 0.10
    """Largest residual speed of the object's origin [m/s]."""
    angular_velocity: float = 1.0
    """Largest residual angular speed of the object [rad/s]."""
    joint_velocity: float = 2.0
    """Largest residual joint speed [rad/s or m/s]."""


def try_states(
    backend: Backend, joint_pos: torch.Tensor, object_pos: torch.Tensor, object_quat: torch.Tensor, config: FilterConfig
) -> torch.Tensor:
    """Spawn one state per world and let the steps pass.

    Args:
        backend: N worlds.
        joint_pos: [N, J]
        object_pos: [N, 3]
        object_quat: [N, 4]
        config: steps and thresholds.

    Returns:
        [N] long: index into :data:`REASONS`, -1 where the state is accepted.
    """
    n = backend.num_worlds
    backend.set_object_gravity(torch.zeros(n, device=backend.device))
    backend.set_state(State.at_rest(joint_pos, object_pos, object_quat))
    for _ in range(config.steps):
        backend.step()
    state, health = backend.state(), backend.health()
    tests = (
        out_of_bounds(state.object_pos, backend.scene.table, TerminationConfig()),
        state.object_linvel.norm(dim=-1) > config.linear_velocity,
        state.object_angvel.norm(dim=-1) > config.angular_velocity,
        state.joint_vel.abs().amax(dim=-1) > config.joint_velocity,
        health.nonfinite,
        health.overflow,
    )
    reason = torch.full((n,), -1, dtype=torch.long, device=backend.device)
    for i, test in reversed(list(enumerate(tests))):
        reason[test & (reason < 0)] = i
    return reason


def make_bank(
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    backends: Sequence[str],
    *,
    num_envs: int = 64,
    device: str = "cpu",
    config: FilterConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResetBank:
    """Try every valid frame in every engine and keep those that all accept.

    Args:
        retargeted: robot trajectories.
        robot: the robot they are for.
        objects: geometry of the objects that they name.
        backends: engines, tried in this order; a rejection carries the first one's reason.
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        config: steps and thresholds.
        progress: called with (candidates tried, candidates in all).

    Raises:
        DemoError: no frame is valid.
    """
    config = config or FilterConfig()
    frames = np.flatnonzero(retargeted.valid)
    if not len(frames):
        raise DemoError(
            "no frame of the retargeted trajectories is valid, so there is no state to try; look at the reasons of xreset retarget."
        )
    sequence = retargeted.sequence_of_frame[frames]
    names = np.asarray(retargeted.object_name)[sequence]
    used = tuple(o for o in objects if o.name in set(names.tolist()))
    reason = np.full(len(frames), -1, dtype=np.int64)
    scene = SceneSpec(robot=robot, objects=used)
    object_of = np.array([[o.name for o in used].index(name) for name in names])
    for number, name in enumerate(backends):
        left = np.flatnonzero(reason < 0)
        if not len(left):
            break
        plan = schedule(object_of[left], num_envs)
        worlds = torch.as_tensor(plan.object_index)
        with make_backend(name, scene, len(worlds), object_index=worlds, device=device_for(name, device)) as backend:
            tried = 0
            for items, fresh in plan:
                rows = frames[left[items]]
                joint_pos, object_pos, object_quat = (
                    torch.as_tensor(array[rows], dtype=torch.float32, device=backend.device)
                    for array in (retargeted.joint_pos, retargeted.object_pos, retargeted.object_quat_wxyz)
                )
                found = try_states(backend, joint_pos, object_pos, object_quat, config).cpu().numpy()
                reason[left[items[fresh]]] = found[fresh]
                tried += int(fresh.sum())
                progress(number * len(frames) + tried, len(backends) * len(frames))
    progress(len(backends) * len(frames), len(backends) * len(frames))
    return _bank(retargeted, robot, objects, tuple(backends), frames, sequence, reason)


def _bank(
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    backends: tuple[str, ...],
    frames: np.ndarray,
    sequence: np.ndarray,
    reason: np.ndarray,
) -> ResetBank:
    local = frames - retargeted.frame_offsets[sequence]
    post = retargeted.post_contact[frames]
    keep, reject = reason < 0, reason >= 0
    rows = frames[keep]
    starts, ends = retargeted.frame_offsets[:-1], retargeted.frame_offsets[1:] - 1
    named = sorted({*map(str, retargeted.object_name)})
    sources = {o.name: o.source for o in objects}
    f32 = np.float32
    return ResetBank(
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        backends=backends,
        joint_names=robot.joint_names,
        joint_pos=retargeted.joint_pos[rows].astype(f32),
        object_pos=retargeted.object_pos[rows].astype(f32),
        object_quat_wxyz=retargeted.object_quat_wxyz[rows].astype(f32),
        object_name=np.asarray(retargeted.object_name)[sequence[keep]],
        sequence_index=sequence[keep].astype(np.int32),
        frame_index=local[keep].astype(np.int32),
        post_contact=post[keep],
        sequence_name=np.asarray(retargeted.sequence_name),
        sequence_object=np.asarray(retargeted.object_name),
        start_pos=retargeted.object_pos[starts].astype(f32),
        start_quat_wxyz=retargeted.object_quat_wxyz[starts].astype(f32),
        goal_pos=retargeted.object_pos[ends].astype(f32),
        goal_quat_wxyz=retargeted.object_quat_wxyz[ends].astype(f32),
        object_names=tuple(named),
        object_sources=tuple(sources[name] for name in named),
        rejected_sequence_index=sequence[reject].astype(np.int32),
        rejected_frame_index=local[reject].astype(np.int32),
        rejected_post_contact=post[reject],
        rejected_reason=reason[reject].astype(np.int32),
        reason_names=REASONS,
    )
