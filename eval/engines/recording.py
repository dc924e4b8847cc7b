"""Play an open-loop episode in an engine, and record it: starts of G worlds, and joint targets of each control step.

Shape letters: G worlds, J joints, E fingertips, T control steps, P surface points.
"""

from __future__ import annotations

from collections import defaultdict

import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.physics import Backend, State


@frozen
class Recording:
    """States of an episode in an engine, after each control step, on the CPU. Poses are in the world frame."""

    start: State
    """[G, ...] the start of the episode."""
    joint_pos: Tensor
    """[T, G, J] rad (m)"""
    joint_target: Tensor
    """[T, G, J] rad (m)"""
    object_pos: Tensor
    """[T, G, 3] m"""
    object_quat: Tensor
    """[T, G, 4]"""
    palm_pos: Tensor
    """[T, G, 3] m"""
    palm_quat: Tensor
    """[T, G, 4]"""
    tip_force: Tensor
    """[T, G, E, 3] force of each fingertip on the object, world frame [N]."""
    tip_touch: Tensor
    """[T, G, E] bool"""
    broken: Tensor
    """[G] bool: a number was not finite, or contacts overflowed."""

    @property
    def lifted(self) -> Tensor:
        """[G] height of the object at the end above its start [m]."""
        return self.object_pos[-1, :, 2] - self.start.object_pos[:, 2]

    def state_after(self, step: int) -> State:
        """Return the states [G] after a control step, brought to rest: positions and targets, without velocities."""
        return State.at_rest(
            self.joint_pos[step],
            self.object_pos[step],
            self.object_quat[step],
            self.joint_target[step],
        )

    def in_palm(self, points: Tensor) -> Tensor:
        """Transform points [G, P, 3] from the objects' mesh frames to the palm's frame at the end [m]."""
        world = self.object_pos[-1, :, None] + quat_rotate(self.object_quat[-1, :, None], points)
        return quat_rotate_inverse(self.palm_quat[-1, :, None], world - self.palm_pos[-1, :, None])


def play(backend: Backend, start: State, targets: Tensor) -> Recording:
    """Set each world to its start [G, ...], give the drives the targets [T, G, J], and record every control step."""
    backend.set_state(start.to(backend.device))
    frames: dict[str, list[Tensor]] = defaultdict(list)
    for target in targets.to(backend.device):
        backend.set_joint_targets(target)
        backend.step()
        state = backend.state()
        links = backend.links()
        contacts = backend.contacts()
        now = {
            "joint_pos": state.joint_pos,
            "object_pos": state.object_pos,
            "object_quat": state.object_quat,
            "palm_pos": links.pos[:, 0],
            "palm_quat": links.quat[:, 0],
            "tip_force": contacts.tip_force,
            "tip_touch": contacts.tip_touch,
        }
        for name, value in now.items():
            frames[name].append(value.cpu().clone())
    health = backend.health()
    return Recording(
        start=start.to("cpu"),
        joint_target=targets.cpu(),
        broken=(health.nonfinite | health.overflow).cpu(),
        **{name: torch.stack(values) for name, values in frames.items()},
    )
