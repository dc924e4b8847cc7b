"""An engine whose physics is changed by known factors, through the interface alone: any backend can be altered, a plugin's too."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from xreset.backends.mjcf import MIN_TIME_CONSTANT_STEPS, MujocoSettings
from xreset.errors import CapabilityError
from xreset.eval.trial import Engine, engine
from xreset.physics import Backend, State
from xreset.spec import JointSpec, SceneSpec


@dataclass(frozen=True, kw_only=True)
class ContactDial:
    """How an engine's contacts are made softer."""

    options: Callable[[float], dict[str, Any]]
    """Keywords of the backend for a factor on the time constant."""
    smallest: float
    """The smallest factor that the engine allows."""
    limit: str
    """Why it does not allow less."""


_NO_CONTACT_DIAL = {
    "pybullet": "Bullet's sequential impulses have no stiffness: how much a contact gives follows from its iterations and steps",
    "sapien": "PhysX's contacts are rigid: how much one gives follows from its solver's iterations",
}


def no_contact_dial(backend: str) -> str:
    """Why a backend has no dial for contacts."""
    return f"not changeable in {backend}: {_NO_CONTACT_DIAL.get(backend, 'no dial of its contacts is known')}"


def contact_dial(backend: str) -> ContactDial | None:
    """The dial of a backend; None if there is none."""
    if backend not in ("mujoco", "mujoco-warp"):
        return None
    nominal = MujocoSettings().time_constant_steps
    return ContactDial(
        options=lambda factor: {"settings": MujocoSettings(time_constant_steps=nominal * factor)},
        smallest=MIN_TIME_CONSTANT_STEPS / nominal,
        limit="MuJoCo's contacts are as stiff as its timestep allows (a time constant of two timesteps)",
    )


@dataclass(frozen=True, kw_only=True)
class Alteration:
    """Factors on what a scene says, and what it cannot say. The default changes nothing."""

    tip_friction: float = 1.0
    """Factor on the pair friction of object and fingertips."""
    link_friction: float = 1.0
    """Factor on the pair friction of object and other links."""
    table_friction: float = 1.0
    """Factor on the pair friction of object and table."""
    torsional_friction: float = 1.0
    """Factor on the torsional friction of every pair; 0: none."""
    mass: float = 1.0
    """Factor on the object's mass; its inertia scales with it."""
    inertia: float = 1.0
    """Factor on the object's inertia at its mass."""
    arm_stiffness: float = 1.0
    """Factor on kp of the arm's drives."""
    arm_damping: float = 1.0
    """Factor on kd of the arm's drives."""
    hand_stiffness: float = 1.0
    """Factor on kp of the hand's drives."""
    hand_damping: float = 1.0
    """Factor on kd of the hand's drives."""
    timestep: float = 1.0
    """Factor on the physics timestep; the nearest that divides a control step is taken."""
    contact_time: float = 1.0
    """Factor on the time constant of contacts: the engine's own dial (:func:`contact_dial`)."""
    delay: int = 0
    """Control steps by which joint targets come late."""

    def and_(self, other: Alteration) -> Alteration:
        """Both at once."""
        values = {f.name: getattr(self, f.name) * getattr(other, f.name) for f in fields(self) if f.name != "delay"}
        return Alteration(**values, delay=self.delay + other.delay)

    def scene(self, scene: SceneSpec) -> SceneSpec:
        """The scene with everything changed that a scene says."""
        friction = scene.friction
        substeps = max(1, round(scene.substeps / self.timestep))
        return replace(
            scene,
            robot=replace(scene.robot, joints=tuple(self._joint(joint) for joint in scene.robot.joints)),
            objects=tuple(
                replace(o, mass=o.mass * self.mass, inertia=o.inertia * (self.mass * self.inertia))
                for o in scene.objects
            ),
            friction=replace(
                friction,
                tip=friction.tip * self.tip_friction,
                link=friction.link * self.link_friction,
                table=friction.table * self.table_friction,
                torsional=friction.torsional * self.torsional_friction,
            ),
            timestep=scene.control_dt / substeps,
            substeps=substeps,
        )

    def _joint(self, joint: JointSpec) -> JointSpec:
        arm = joint.group == "arm"
        kp, kd = (self.arm_stiffness, self.arm_damping) if arm else (self.hand_stiffness, self.hand_damping)
        return replace(joint, drive=replace(joint.drive, kp=joint.drive.kp * kp, kd=joint.drive.kd * kd))


def altered_engine(base: Engine, alteration: Alteration) -> Engine:
    """The engine with other physics; to its caller the scene is the one that was asked for.

    Raises:
        CapabilityError: the contact's time constant is to change, and the engine has no dial for it.
    """
    if alteration.contact_time != 1.0:
        dial = contact_dial(base.name)
        if dial is None:
            raise CapabilityError(
                f"the backend {base.name!r} has no dial for the softness of contacts. Leave contact_time at 1."
            )
        base = engine(base.name, device=base.device, **dial.options(alteration.contact_time))

    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return AlteredBackend(base.make(alteration.scene(scene), num_worlds, object_index), scene, alteration)

    return replace(base, make=make)


def _of_inner(name: str) -> Any:
    """A method that does what that of the worlds inside does."""
    return lambda self, *arguments: getattr(self._inner, name)(*arguments)


class AlteredBackend(Backend):
    """A backend that shows the scene that was asked for, and whose worlds are of another one."""

    name = "altered"
    capabilities = frozenset()

    def __init__(self, inner: Backend, scene: SceneSpec, alteration: Alteration) -> None:
        """Wrap.

        Args:
            inner: the worlds, of ``alteration.scene(scene)``.
        """
        super().__init__(scene, inner.num_worlds, object_index=inner.object_index, device=str(inner.device))
        self.name, self.capabilities = inner.name, inner.capabilities  # pyright: ignore[reportAttributeAccessIssue]
        self._inner, self._alteration = inner, alteration
        self._late: deque[Tensor] = deque()
        self._targets = inner.state().joint_target.clone()

    @classmethod
    def engine_version(cls) -> str:
        """An altered backend is made from one that exists, and has no version of its own."""
        return "altered"

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_state`. Targets that are on their way to those worlds are forgotten."""
        self._inner.set_state(state, worlds)
        chosen = slice(None) if worlds is None else worlds
        for targets in (self._targets, *self._late):
            targets[chosen] = state.joint_target.to(targets)

    def state(self) -> State:
        """See :meth:`Backend.state`; the targets are those that were set, though they may act late."""
        return replace(self._inner.state(), joint_target=self._targets)

    def set_joint_targets(self, targets: Tensor) -> None:
        """See :meth:`Backend.set_joint_targets`: it counts as the beginning of a control step."""
        self._late.append(self._targets)
        self._targets = targets.clone()
        while len(self._late) > self._alteration.delay:
            self._late.popleft()
        self._inner.set_joint_targets(self._late[0] if self._late else self._targets)

    def step(self, substeps: int | None = None) -> None:
        inner, outer = self._inner.scene.substeps, self.scene.substeps
        self._inner.step(None if substeps is None else max(1, round(substeps * inner / outer)))

    def set_object_mass(self, mass: Tensor, worlds: Tensor | None = None) -> None:
        self._inner.set_object_mass(mass * self._alteration.mass, worlds)

    def set_friction(self, friction: Tensor, worlds: Tensor | None = None) -> None:
        a = self._alteration
        factors = torch.tensor([a.tip_friction, a.link_friction, a.table_friction]).to(friction)
        self._inner.set_friction(friction * factors, worlds)

    def set_torsional_friction(self, torsional: Tensor, worlds: Tensor | None = None) -> None:
        self._inner.set_torsional_friction(torsional * self._alteration.torsional_friction, worlds)

    links, contacts, health, mass_properties, set_object_wrench, close = map(
        _of_inner, ("links", "contacts", "health", "mass_properties", "set_object_wrench", "close")
    )
    set_object_inertia, set_object_com, set_object_gravity, set_drives = map(  # the altered inertia is what counts as 1
        _of_inner, ("set_object_inertia", "set_object_com", "set_object_gravity", "set_drives")
    )
