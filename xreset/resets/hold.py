"""Which states are grasps that hold: lifted, at full gravity, with the targets unchanged."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from xreset.geometry.rotations import quat_angle
from xreset.resets.bank import ResetBank
from xreset.resets.config import HoldConfig
from xreset.resets.filter import spawn
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec


@dataclass(frozen=True, kw_only=True)
class Held:
    """How many lifted states hold."""

    backend: str
    object_name: str
    """``all`` in a sum over objects."""
    lifted: int
    held: int
    alike: dict[str, int]
    """Other engine -> how many end as they do there: held or not."""


def hold_bank(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    backends: Sequence[str],
    *,
    num_envs: int = 64,
    device: str = "cpu",
    config: HoldConfig | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Held]:
    """Let the lifted states of a bank hold on in every engine.

    Args:
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        config: how long, and how far an object may move.
        progress: called with (states done, states in all).

    Returns:
        For each engine one entry per object, in the order of their names, and their sum.
    """
    config = config or HoldConfig()
    lifted = np.flatnonzero(
        bank.post_contact & (bank.object_pos[:, 2] - bank.start_pos[bank.sequence_index, 2] > config.lift)
    )
    names = bank.object_name[lifted]
    used = tuple(o for o in objects if o.name in set(names.tolist()))
    held = {name: np.zeros(len(lifted), dtype=bool) for name in backends}
    for number, name in enumerate(backends):
        if len(lifted):
            scene, index = (
                SceneSpec(robot=robot, objects=used),
                np.array([[o.name for o in used].index(n) for n in names]),
            )
            states = [array[lifted] for array in (bank.joint_pos, bank.object_pos, bank.object_quat_wxyz, bank.targets)]

            def report(done: int, before: int = number * len(lifted)) -> None:
                progress(before + done, len(backends) * len(lifted))

            rounds = spawn(name, scene, index, states, num_envs=num_envs, device=device, progress=report)
            for backend, start, items, fresh in rounds:
                backend.set_object_gravity(torch.ones(len(items), device=backend.device))
                backend.set_state(start)
                for _ in range(round(config.seconds / scene.control_dt)):
                    backend.step()
                state, health = backend.state(), backend.health()
                stays = (state.object_pos - start.object_pos).norm(dim=-1) < config.distance
                stays &= (
                    (quat_angle(state.object_quat, start.object_quat) < config.angle)
                    & ~health.nonfinite
                    & ~health.overflow
                )
                held[name][items[fresh]] = stays.cpu().numpy()[fresh]
    groups = [*((name, names == name) for name in np.unique(names).tolist()), ("all", np.ones(len(lifted), dtype=bool))]
    return [
        Held(
            backend=name,
            object_name=label,
            lifted=int(mine.sum()),
            held=int((held[name] & mine).sum()),
            alike={other: int(((held[name] == held[other]) & mine).sum()) for other in held if other != name},
        )
        for name in backends
        for label, mine in groups
    ]
