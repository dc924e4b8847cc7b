"""The physics filter: which retargeted states stay put when they are spawned (the paper's appendix D.c).

Each candidate is spawned at rest, the drives hold its joint positions, gravity on the object is off, and eight control steps pass. It is
rejected if it leaves the scene or still moves: object faster than 0.10 m/s or 1.0 rad/s, or a joint faster than 2.0 rad/s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from xreset.errors import DemoError
from xreset.physics import Backend, State
from xreset.plugins import device_for, make_backend
from xreset.resets.bank import ResetBank, starts_and_goals
from xreset.resets.closing import Closing, with_closing_frames
from xreset.resets.config import ClosingConfig, SqueezeConfig
from xreset.resets.fingers import fingers_of, squeeze_targets
from xreset.retarget.pipeline import Retargeted
from xreset.schedule import schedule
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task.config import TerminationConfig
from xreset.task.terminations import out_of_bounds

REASONS = (
    "out of bounds",
    "object linear velocity",
    "object angular velocity",
    "joint velocity",
    "not finite",
    "overflow",
)
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


def spawn(
    name: str,
    scene: SceneSpec,
    object_index: np.ndarray,
    states: Sequence[np.ndarray],
    *,
    num_envs: int,
    device: str,
    progress: Callable[[int], None],
) -> Iterator[tuple[Backend, State, np.ndarray, np.ndarray]]:
    """Let an engine have states, as many at a time as there are worlds.

    Args:
        object_index: [M] which of the scene's objects each state has.
        states: joint positions [M, J], object positions [M, 3] and orientations [M, 4], drive targets [M, J].
        num_envs: worlds at a time.
        device: where the engine runs if it can.
        progress: called with the number of states done.

    Yields:
        The engine, one state at rest for each of its N worlds, which states those are [N], and [N] False where one is only repeated.
    """
    plan, done = schedule(object_index, num_envs), 0
    worlds = torch.as_tensor(plan.object_index)
    with make_backend(name, scene, len(worlds), object_index=worlds, device=device_for(name, device)) as backend:
        for items, fresh in plan:
            start = (torch.as_tensor(array[items], dtype=torch.float32, device=backend.device) for array in states)
            yield backend, State.at_rest(*start), items, fresh
            done += int(fresh.sum())
            progress(done)


def try_states(backend: Backend, start: State, config: FilterConfig) -> torch.Tensor:
    """Spawn one state per world, let the steps pass, and look at what moves.

    Args:
        start: [N, ...] at rest.

    Returns:
        [N] long: index into :data:`REASONS`, -1 where the state is accepted.
    """
    n = backend.num_worlds
    backend.set_object_gravity(torch.zeros(n, device=backend.device))
    backend.set_state(start)
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
    closing: ClosingConfig | None = None,
    squeeze: SqueezeConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> ResetBank:
    """Try every valid frame in every engine and keep those that all accept.

    Args:
        backends: engines, tried in this order; a rejection carries the first one's reason.
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        closing: states between frames, which are tried like the others; None: none.
        squeeze: with which force the targets of states after contact press. Accepted states are tried with them once more, and where an
            engine does not accept that, the targets stay the joints' positions. None: all do.
        progress: called with (candidates tried, candidates in all).

    Raises:
        DemoError: no frame is valid.
    """
    config, closing, squeeze = config or FilterConfig(), closing or ClosingConfig(), squeeze or SqueezeConfig()
    if not retargeted.valid.any():
        raise DemoError(
            "no frame of the retargeted trajectories is valid, so there is no state to try; look at the reasons of xreset retarget."
        )
    dense = with_closing_frames(retargeted, robot, objects, closing)
    tried = dense.retargeted
    frames = np.flatnonzero(tried.valid)
    sequence = tried.sequence_of_frame[frames]
    names = np.asarray(tried.object_name)[sequence]
    used = tuple(o for o in objects if o.name in set(names.tolist()))
    object_index = np.array([[o.name for o in used].index(name) for name in names])
    scene = SceneSpec(robot=robot, objects=used)
    fingers = fingers_of(
        robot, used, object_index, tried.joint_pos[frames], tried.object_pos[frames], tried.object_quat_wxyz[frames]
    )
    target = tried.joint_pos[frames].astype(np.float32)

    def accepted(rows: np.ndarray, report: Callable[[int], None]) -> np.ndarray:
        """[len(rows)] reason of states, given as rows of ``frames``; -1 where every engine accepts them."""
        reason = np.full(len(rows), -1, dtype=np.int64)
        for number, name in enumerate(backends):
            left = np.flatnonzero(reason < 0)
            if not len(left):
                break
            chosen = rows[left]
            states = [array[frames[chosen]] for array in (tried.joint_pos, tried.object_pos, tried.object_quat_wxyz)]

            def begun(done: int, before: int = number * len(rows)) -> None:
                report(before + done)

            rounds = spawn(
                name,
                scene,
                object_index[chosen],
                (*states, target[chosen]),
                num_envs=num_envs,
                device=device,
                progress=begun,
            )
            for backend, start, items, fresh in rounds:
                reason[left[items[fresh]]] = try_states(backend, start, config).cpu().numpy()[fresh]
        return reason

    work = len(backends) * len(frames)
    reason = accepted(np.arange(len(frames)), lambda done: progress(done, work))
    if squeeze.force > 0:
        rows = np.flatnonzero((reason < 0) & tried.post_contact[frames])
        still = target[rows]
        target[rows] = squeeze_targets(robot, fingers, tried.joint_pos[frames], squeeze)[rows]
        work += len(backends) * len(rows)
        refused = accepted(rows, lambda done: progress(len(backends) * len(frames) + done, work)) >= 0
        target[rows[refused]] = still[refused]
    progress(work, work)
    return _bank(
        dense,
        retargeted,
        robot,
        objects,
        tuple(backends),
        frames,
        reason,
        fingers.nearest.numpy(),
        target if squeeze.force > 0 else None,
    )


def _bank(
    dense: Closing,
    original: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    backends: tuple[str, ...],
    frames: np.ndarray,
    reason: np.ndarray,
    gap: np.ndarray,
    target: np.ndarray | None,
) -> ResetBank:
    retargeted = dense.retargeted
    sequence = retargeted.sequence_of_frame[frames]
    keep, reject = reason < 0, reason >= 0
    rows, f32 = frames[keep], np.float32
    of_both = {
        "sequence_index": sequence.astype(np.int32),
        "frame_index": (dense.frame[frames] - original.frame_offsets[sequence]).astype(np.int32),
        "post_contact": retargeted.post_contact[frames],
        "finger_gap": gap.astype(f32),
    }
    if dense.part.any():
        of_both["frame_part"] = dense.part[frames].astype(f32)
    return replace(
        starts_and_goals(retargeted, robot, {o.name: o.source for o in objects}),
        backends=backends,
        joint_pos=retargeted.joint_pos[rows].astype(f32),
        object_pos=retargeted.object_pos[rows].astype(f32),
        object_quat_wxyz=retargeted.object_quat_wxyz[rows].astype(f32),
        object_name=np.asarray(retargeted.object_name)[sequence[keep]],
        rejected_reason=reason[reject].astype(np.int32),
        reason_names=REASONS,
        joint_target=None if target is None else target[keep],
        **{name: values[keep] for name, values in of_both.items()},
        **{f"rejected_{name}": values[reject] for name, values in of_both.items()},
    )
