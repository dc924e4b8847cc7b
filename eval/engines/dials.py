"""Dials of the built-in engines that no scene can set: which there are, and why others are missing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class ContactDial:
    """How an engine's contacts are made softer."""

    options: Callable[[float], dict[str, Any]]
    """Keywords of the backend for a factor on the time constant."""
    smallest: float
    """The smallest factor that the engine allows."""
    limit: str
    """Why it does not allow less."""


NO_CONTACT_DIAL = {
    "pybullet": "Bullet's sequential impulses have no stiffness: how much a contact gives follows from its iterations and steps",
    "sapien": "PhysX's contacts are rigid: how much one gives follows from its solver's iterations",
}
"""Why an engine has no dial for contacts."""


def contact_dial(backend: str) -> ContactDial | None:
    """The dial of a backend; None if there is none."""
    if backend not in ("mujoco", "mujoco-warp"):
        return None
    from xreset.backends.mjcf import MIN_TIME_CONSTANT_STEPS, MujocoSettings

    nominal = MujocoSettings().time_constant_steps
    return ContactDial(
        options=lambda factor: {"settings": MujocoSettings(time_constant_steps=nominal * factor)},
        smallest=MIN_TIME_CONSTANT_STEPS / nominal,
        limit="MuJoCo's contacts are as stiff as its timestep allows (a time constant of two timesteps)",
    )
