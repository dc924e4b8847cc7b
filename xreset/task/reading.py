"""What an engine said after a step, what follows from it, and what of a step is logged."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from xreset.geometry.rotations import quat_rotate_inverse
from xreset.physics import Backend, Contacts, Health, Links, State
from xreset.task.rewards import Reward


@dataclass(frozen=True, kw_only=True)
class Reading:
    """What the backend said after a step, and what follows from it."""

    state: State
    links: Links
    contacts: Contacts
    health: Health
    """Of the engine; a world that was given an action that is not finite counts as not finite, too."""
    tip_distance: Tensor
    """[N, E] distance from each fingertip to the object's surface points [m]."""

    @classmethod
    def of(cls, backend: Backend, surface_points: Tensor, bad_action: Tensor) -> Self:
        """The present one.

        Args:
            surface_points: [N, P, 3] on each world's object, in its frame [m].
            bad_action: [N] bool, worlds that were given an action that is not finite.
        """
        state, links, health = backend.state(), backend.links(), backend.health()
        local = quat_rotate_inverse(state.object_quat[:, None], links.pos[:, 1:] - state.object_pos[:, None])
        return cls(
            state=state,
            links=links,
            contacts=backend.contacts(),
            health=replace(health, nonfinite=health.nonfinite | bad_action),
            tip_distance=torch.cdist(local, surface_points).amin(dim=-1),
        )


def step_log(
    reward: Reward, done: Tensor, *, sound: Tensor, from_home: Tensor, totals: dict[str, Tensor]
) -> tuple[tuple[str, ...], Tensor]:
    """Names and values [K] of what there is to say about a step: means over worlds, on the device, so that nothing waits for them.

    Args:
        reward: of N worlds. Its terms are means over the worlds that are ``sound``: the others' say nothing, and are counted.
        done: [N] bool, worlds whose episode has ended.
        sound: [N] bool.
        from_home: [N] bool, worlds whose episode began at home.
        totals: further numbers [], by name.
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
    return (*rows, *totals), torch.cat((means, torch.stack([value.float() for value in totals.values()])))
