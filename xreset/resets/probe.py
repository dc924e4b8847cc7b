"""Put states into an engine, take control steps, and judge what became of each state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xreset.files.progress import Progress, unseen
from xreset.geometry.rotations import quat_angle
from xreset.physics import Backend, State
from xreset.physics.plugins import device_for, make_backend
from xreset.resets.config import FilterConfig
from xreset.resets.schedule import schedule
from xreset.spec import SceneSpec
from xreset.task.reading import at_point
from xreset.task.terminations import out_of_bounds

Judge = Callable[[Backend, State], Tensor]
"""Function that returns verdicts [N] or [N, K] on the worlds of an engine, given the states with which they started."""
REASONS = (
    "out of bounds",
    "object linear velocity",
    "object angular velocity",
    "joint velocity",
    "not finite",
    "overflow",
    "object collision",
)
"""Why a candidate is rejected. Where several reasons apply, the last one is stated. ``object collision``: the robot is
deeper in the object than retargeting allows; such a candidate is not tried."""


def probe(
    engine: str,
    scene: SceneSpec,
    object_name: np.ndarray,
    states: State,
    judge: Judge,
    *,
    gravity: float,
    steps: int,
    num_envs: int,
    device: str,
    progress: Callable[[int], None],
) -> np.ndarray:
    """Try states in an engine, as many at a time as it has worlds, and return the verdicts on them: [M] or [M, K].

    Args:
        engine: name of the engine.
        scene: robot and objects.
        object_name: [M] which of the scene's objects each state has.
        states: [M, ...]
        judge: called after the last step of each round.
        gravity: fraction of the objects' weight.
        steps: control steps.
        num_envs: worlds at a time.
        device: where the engine runs if it can.
        progress: called with the number of states done.
    """
    names = [spec.name for spec in scene.objects]
    plan = schedule(np.array([names.index(name) for name in object_name]), num_envs)
    worlds = torch.as_tensor(plan.object_index)
    rows = []
    verdicts = []
    done = 0
    with make_backend(
        engine, scene, len(worlds), object_index=worlds, device=device_for(engine, device)
    ) as backend:
        for items, fresh in plan:
            start = states[torch.as_tensor(items)].to(backend.device)
            share = torch.full((backend.num_worlds,), gravity, device=backend.device)
            backend.set_object_gravity(share)
            backend.set_state(start)
            # at once, because only the last state is read
            backend.step(steps * scene.substeps)
            rows.append(items[fresh])
            verdicts.append(judge(backend, start).cpu().numpy()[fresh])
            done += len(rows[-1])
            progress(done)
    order = np.argsort(np.concatenate(rows))
    return np.concatenate(verdicts)[order]


def rejections(
    engines: Sequence[str],
    scene: SceneSpec,
    object_name: np.ndarray,
    states: State,
    judge: Judge,
    *,
    progress: Progress = unseen,
    **options: Any,
) -> np.ndarray:
    """Return the reasons [M] for which states are rejected, -1 where every engine accepts them.

    Args:
        engines: names of the engines; each tries the states that those before it accept.
        scene: robot and objects.
        object_name: [M] object of each state.
        states: [M, ...]
        judge: returns the reasons of an engine's worlds, -1 where accepted.
        progress: called with (states tried, states to try in all engines).
        options: others of :func:`probe`.
    """
    count = len(object_name)
    reason = np.full(count, -1, dtype=np.int64)
    for number, name in enumerate(engines):
        left = np.flatnonzero(reason < 0)
        if not len(left):
            break
        before = number * count
        reason[left] = probe(
            name,
            scene,
            object_name[left],
            states[torch.as_tensor(left)],
            judge,
            progress=lambda done, before=before: progress(before + done, len(engines) * count),
            **options,
        )
    return reason


def of_center(backend: Backend, state: State) -> State:
    """Return the states of an engine's worlds with each object's origin at its center of mass: the origin of its mesh
    may be anywhere."""
    coms = torch.as_tensor(np.stack([obj.com for obj in backend.scene.objects]))
    return at_point(state, coms.to(state.object_pos)[backend.object_index])


def stays(backend: Backend, start: State, *, moved: float, turned: float) -> Tensor:
    """[N] bool: whether a world's object is where it was at the start, its center of mass within ``moved`` [m] and its
    orientation within ``turned`` [rad]; False if the engine has failed."""
    state = of_center(backend, backend.state())
    shift = state.object_pos - of_center(backend, start).object_pos
    angle = quat_angle(state.object_quat, start.object_quat)
    health = backend.health()
    return (shift.norm(dim=-1) < moved) & (angle < turned) & ~health.nonfinite & ~health.overflow


def rejection(backend: Backend, start: State, limits: FilterConfig) -> Tensor:
    """Return why the present states of an engine's worlds are rejected: [N] index into :data:`REASONS`, -1 where
    accepted."""
    state = of_center(backend, backend.state())
    health = backend.health()
    tests = (
        out_of_bounds(state.object_pos, backend.scene.table),
        state.object_linvel.norm(dim=-1) > limits.linear_velocity,
        state.object_angvel.norm(dim=-1) > limits.angular_velocity,
        state.joint_vel.abs().amax(dim=-1) > limits.joint_velocity,
        health.nonfinite,
        health.overflow,
    )
    reason = torch.full((backend.num_worlds,), -1, dtype=torch.long, device=backend.device)
    for i, test in enumerate(tests):
        reason[test] = i
    return reason
