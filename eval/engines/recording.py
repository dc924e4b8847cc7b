"""Playing an episode in an engine, and what is kept of it.

Shape letters: G grasps (one per world), J joints, E fingertips, T control steps, P surface points.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.eval.engines.episodes import Episode
from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.physics import Backend, State


@dataclass(frozen=True, kw_only=True)
class Recording:
    """What an engine did with an episode, after each control step, on the CPU."""

    start: State
    """[G, ...] where it began."""
    joint_pos: Tensor
    """[T, G, J] rad (m)"""
    joint_target: Tensor
    """[T, G, J]"""
    object_pos: Tensor
    """[T, G, 3]"""
    object_quat: Tensor
    """[T, G, 4]"""
    palm_pos: Tensor
    """[T, G, 3]"""
    palm_quat: Tensor
    """[T, G, 4]"""
    tip_force: Tensor
    """[T, G, E, 3] on the object, world frame [N]."""
    tip_touch: Tensor
    """[T, G, E] bool"""
    broken: Tensor
    """[G] bool: not finite, or contacts overflowed."""

    def state_after(self, step: int) -> State:
        """[G] the state after a control step, brought to rest: positions and targets, without velocities."""
        return State.at_rest(self.joint_pos[step], self.object_pos[step], self.object_quat[step], self.joint_target[step])

    def in_palm(self, step: int, points: Tensor) -> Tensor:
        """[G, P, 3] where points [G, P, 3] of the objects (in their mesh frames) are in the palm's frame after a control step [m]."""
        world = self.object_pos[step][:, None] + quat_rotate(self.object_quat[step][:, None], points)
        return quat_rotate_inverse(self.palm_quat[step][:, None], world - self.palm_pos[step][:, None])


def play(backend: Backend, episode: Episode) -> Recording:
    """Set each world to its start and give the drives the episode's targets."""
    backend.set_state(episode.start.to(backend.device))
    rows: list[tuple[Tensor, ...]] = []
    targets = episode.targets.to(backend.device)
    for target in targets:
        backend.set_joint_targets(target)
        backend.step()
        state, links, contacts = backend.state(), backend.links(), backend.contacts()
        now = (
            state.joint_pos, state.object_pos, state.object_quat, links.pos[:, 0], links.quat[:, 0], contacts.tip_force, contacts.tip_touch,
        )  # fmt: skip
        rows.append(tuple(value.cpu().clone() for value in now))
    health = backend.health()
    joint_pos, object_pos, object_quat, palm_pos, palm_quat, tip_force, tip_touch = (
        torch.stack(column) for column in zip(*rows, strict=True)
    )
    return Recording(
        start=episode.start.to("cpu"),
        joint_pos=joint_pos,
        joint_target=episode.targets.cpu(),
        object_pos=object_pos,
        object_quat=object_quat,
        palm_pos=palm_pos,
        palm_quat=palm_quat,
        tip_force=tip_force,
        tip_touch=tip_touch,
        broken=(health.nonfinite | health.overflow).cpu(),
    )
