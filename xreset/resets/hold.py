"""Which states are grasps that hold: lifted, at full gravity, with the targets unchanged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from xreset.geometry.rotations import quat_angle
from xreset.physics import Backend, State
from xreset.resets.bank import ResetBank
from xreset.resets.probe import probe
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

LIFT = 0.01
"""Height of the object's origin above the demonstration's start from which a state is lifted [m]."""
SECONDS = 1.0
"""Time at full gravity [s]."""
DISTANCE = 0.02
"""Largest distance of the object's origin from where it was [m]."""
ANGLE = float(np.pi / 6)
"""Largest angle by which the object may be turned [rad]."""


@dataclass(frozen=True, kw_only=True)
class Held:
    """Number of lifted states that hold, of one object in one engine."""

    backend: str
    object_name: str
    """``all`` in a sum over objects."""
    lifted: int
    held: int


def stays(backend: Backend, start: State) -> Tensor:
    """[N] bool: whether the objects of an engine's worlds are still where they started, and the simulation is sound."""
    state = backend.state()
    health = backend.health()
    near = (state.object_pos - start.object_pos).norm(dim=-1) < DISTANCE
    upright = quat_angle(state.object_quat, start.object_quat) < ANGLE
    return near & upright & ~health.nonfinite & ~health.overflow


def hold_bank(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    backends: Sequence[str],
    *,
    num_envs: int = 64,
    device: str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Held]:
    """Count the lifted states of a bank that hold the object in each engine.

    Args:
        bank: states.
        robot: the bank's robot.
        objects: the bank's objects.
        backends: engines.
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        progress: called with (states done, states in all).

    Returns:
        For each engine one entry per object, in the order of their names, and their sum.
    """
    height = bank.object_pos[:, 2] - bank.start_pos[bank.sequence_index, 2]
    lifted = np.flatnonzero(bank.post_contact & (height > LIFT))
    object_name = bank.object_name[lifted]
    held = {name: np.zeros(len(lifted), dtype=bool) for name in backends}
    if len(lifted):
        used = tuple(o for o in objects if o.name in set(object_name.tolist()))
        names = [o.name for o in used]
        scene = SceneSpec(robot=robot, objects=used)
        arrays = (bank.joint_pos, bank.object_pos, bank.object_quat_wxyz, bank.targets)
        states = State.at_rest(*(torch.as_tensor(array[lifted], dtype=torch.float32) for array in arrays))
        for number, name in enumerate(backends):
            before = number * len(lifted)
            held[name] = probe(
                name,
                scene,
                np.array([names.index(n) for n in object_name]),
                states,
                stays,
                gravity=1.0,
                steps=round(SECONDS / scene.control_dt),
                num_envs=num_envs,
                device=device,
                progress=lambda done, before=before: progress(before + done, len(backends) * len(lifted)),
            )
    groups = {name: object_name == name for name in np.unique(object_name).tolist()}
    groups["all"] = np.ones(len(lifted), dtype=bool)
    rows = []
    for name in backends:
        for label, mine in groups.items():
            count = int((held[name] & mine).sum())
            rows.append(Held(backend=name, object_name=label, lifted=int(mine.sum()), held=count))
    return rows
