"""State, contacts and distances of a control step, and the numbers that are logged about it."""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import torch
from torch import Tensor

from xreset.files.checks import frozen
from xreset.geometry.rotations import quat_rotate, quat_rotate_inverse
from xreset.physics import Backend, Contacts, Health, Links, State
from xreset.task.rewards import Reward


@frozen
class Reading:
    """State and contacts after a control step, and what follows from them."""

    state: State
    links: Links
    contacts: Contacts
    health: Health
    """Health of the engine. A world whose action was not finite counts as not finite."""
    tip_distance: Tensor
    """[N, E] distance from each fingertip to the object's surface points [m]."""
    task_state: State
    """The state with the object's origin where the task has it (``TaskConfig.object_frame``)."""

    @classmethod
    def of(
        cls, backend: Backend, surface_points: Tensor, bad_action: Tensor, center: Tensor | None
    ) -> Self:
        """Read a backend.

        Args:
            backend: the worlds.
            surface_points: [N, P, 3] on each world's object, in its mesh frame [m].
            bad_action: [N] bool, worlds whose action was not finite.
            center: [N, 3] origin of each world's object in the task, in its mesh frame [m]; None: the mesh's origin.
        """
        state = backend.state()
        links = backend.links()
        health = backend.health()
        from_object = links.pos[:, 1:] - state.object_pos[:, None]
        tips_in_mesh_frame = quat_rotate_inverse(state.object_quat[:, None], from_object)
        return cls(
            state=state,
            links=links,
            contacts=backend.contacts(),
            health=replace(health, nonfinite=health.nonfinite | bad_action),
            tip_distance=torch.cdist(tips_in_mesh_frame, surface_points).amin(dim=-1),
            task_state=state if center is None else at_point(state, center),
        )


def at_point(state: State, point: Tensor) -> State:
    """Return a state in which the object's origin is the point [N, 3] of its mesh frame [m]."""
    offset = quat_rotate(state.object_quat, point)
    spin = torch.linalg.cross(state.object_angvel, offset)
    return replace(
        state,
        object_pos=state.object_pos + offset,
        object_linvel=state.object_linvel + spin,
    )


def step_log(
    reward: Reward, done: Tensor, *, sound: Tensor, from_home: Tensor, totals: dict[str, Tensor]
) -> tuple[tuple[str, ...], Tensor]:
    """Return names and values [K] of a step's log: means over worlds. Values stay on the device, so nothing waits.

    Args:
        reward: rewards of N worlds. Its terms are averaged over the ``sound`` worlds.
        done: [N] bool, worlds whose episode has ended.
        sound: [N] bool, worlds whose simulation has not failed.
        from_home: [N] bool, worlds whose episode began at home.
        totals: further numbers [], by name, which follow the means.
    """
    all_worlds = torch.ones_like(sound)
    rows = {f"reward/{name}": (value, sound) for name, value in reward.terms.items()}
    rows |= {
        "task/grasped": (reward.grasped, all_worlds),
        "task/success": (reward.success, all_worlds),
        "task/grasped_from_home": (reward.grasped, from_home),
        "task/success_from_home": (reward.success, from_home),
        "episode/ended": (done, all_worlds),
    }
    values = torch.stack([value.float() for value, _ in rows.values()])
    masks = torch.stack([mask for _, mask in rows.values()])
    means = torch.where(masks, values, 0).sum(dim=-1) / masks.sum(dim=-1).clamp_min(1)
    further = torch.stack([value.float() for value in totals.values()])
    return (*rows, *totals), torch.cat((means, further))
