"""An engine whose physics is changed by known factors, through the interface alone: any backend can be altered."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from xreset.backends.mjcf import MIN_TIME_CONSTANT_STEPS, MujocoSettings
from xreset.errors import CapabilityError
from xreset.eval.engines.measure import Measured
from xreset.eval.sensitivity import COMPARED
from xreset.eval.trial import Engine, engine
from xreset.physics import Backend, State
from xreset.spec import JointSpec, SceneSpec

NOMINAL_STEPS = MujocoSettings().time_constant_steps
"""Time constant of MuJoCo's contacts in an evaluation [timesteps]."""
SOFTEST = MIN_TIME_CONSTANT_STEPS / NOMINAL_STEPS
"""The smallest factor on this time constant that MuJoCo allows."""

_RIGID = {
    "pybullet": "Bullet's contacts have no stiffness: how much one gives follows from its iterations and steps",
    "sapien": "PhysX's contacts are rigid: how much one gives follows from its solver's iterations",
}


def has_contact_dial(backend: str) -> bool:
    """Whether the softness of a backend's contacts can be changed."""
    return backend in ("mujoco", "mujoco-warp")


def no_contact_dial(backend: str) -> str:
    """Return why the softness of a backend's contacts cannot be changed."""
    return f"not changeable in {backend}: {_RIGID.get(backend, 'no dial of its contacts is known')}"


@dataclass(frozen=True, kw_only=True)
class Alteration:
    """Factors on what a scene states, and what a scene cannot state. The default changes nothing."""

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
    """Factor on the physics timestep; the nearest timestep that divides a control step is taken."""
    contact_time: float = 1.0
    """Factor on the time constant of contacts, in engines with such a dial (:func:`has_contact_dial`)."""
    delay: int = 0
    """Control steps by which joint targets come late."""

    def and_(self, other: Alteration) -> Alteration:
        """Return both changes at once."""
        values = {f.name: getattr(self, f.name) * getattr(other, f.name) for f in fields(self)}
        return Alteration(**values | {"delay": self.delay + other.delay})

    def scene(self, scene: SceneSpec) -> SceneSpec:
        """Return the scene with everything changed that a scene states."""
        friction = replace(
            scene.friction,
            tip=scene.friction.tip * self.tip_friction,
            link=scene.friction.link * self.link_friction,
            table=scene.friction.table * self.table_friction,
            torsional=scene.friction.torsional * self.torsional_friction,
        )
        objects = []
        for o in scene.objects:
            objects.append(replace(o, mass=o.mass * self.mass, inertia=o.inertia * (self.mass * self.inertia)))
        joints = tuple(self._joint(joint) for joint in scene.robot.joints)
        substeps = max(1, round(scene.substeps / self.timestep))
        return replace(
            scene,
            robot=replace(scene.robot, joints=joints),
            objects=tuple(objects),
            friction=friction,
            timestep=scene.control_dt / substeps,
            substeps=substeps,
        )

    def _joint(self, joint: JointSpec) -> JointSpec:
        kp = self.arm_stiffness if joint.group == "arm" else self.hand_stiffness
        kd = self.arm_damping if joint.group == "arm" else self.hand_damping
        return replace(joint, drive=replace(joint.drive, kp=joint.drive.kp * kp, kd=joint.drive.kd * kd))


def change_towards(name: str, a: Measured, b: Measured, engine: str, scene: SceneSpec) -> Alteration | str:
    """Return the change of an engine that gives a property another engine's value, or why there is none.

    Args:
        name: name of the property.
        a: what was measured in the engine that is changed.
        b: what was measured in the other engine.
        engine: name of the engine that is changed.
        scene: what is simulated.
    """
    compared = COMPARED[name]
    x = getattr(a, compared.measured)
    y = getattr(b, compared.measured)
    unknown = [which for which, value in (("A", x), ("B", y)) if not math.isfinite(value)]
    if unknown:
        return f"could not be measured in {' and '.join(unknown)}"
    size = 1.0 if compared.absolute else max(abs(x), abs(y))
    if abs(x - y) < compared.resolution * size:
        return "the same in both, as far as is measured"
    match name:
        case "timestep":
            return _timestep(x / y, engine, scene)
        case "contact softness":
            return _contact_softness(x, y, engine)
        case "torsional friction":  # unlike other factors this one may be 0
            if x <= 0:
                return f"not changeable in {engine}: it has none, and nothing times any factor is nothing"
            return Alteration(torsional_friction=max(y, 0.0) / x)
        case "patch torsional friction":
            if y > x:
                return f"not changeable in {engine}: no friction of the scene restores what it omits at a second point"
            return Alteration(torsional_friction=max(y, 0.0) / x)
        case "latency":
            if y < x:
                return f"not changeable in {engine}: targets that come late cannot be made to come earlier"
            return Alteration(delay=round(y - x))
    if not (x > 0 and y > 0):
        return "is not positive in both, so there is no factor from one to the other"
    return Alteration(**{compared.altered: y / x})  # pyright: ignore[reportArgumentType]


def _timestep(ratio: float, engine: str, scene: SceneSpec) -> Alteration | str:
    """Change the physics steps per control step; contacts that count time in timesteps keep their time constant."""
    substeps = max(1, round(scene.substeps * ratio))
    if substeps == scene.substeps:
        return f"with {scene.substeps} physics steps per control step, no other timestep comes nearer"
    factor = scene.substeps / substeps
    return Alteration(timestep=factor, contact_time=max(SOFTEST, 1.0 / factor) if has_contact_dial(engine) else 1.0)


def _contact_softness(a: float, b: float, engine: str) -> Alteration | str:
    """Under a constant force a soft contact gives with the square of its time constant.

    MuJoCo's impedance grows with depth, which makes it up to a fifth less.
    """
    if not has_contact_dial(engine):
        return no_contact_dial(engine)
    if a <= 0:
        return f"not changeable in {engine}: its contacts do not give at all"
    factor = math.sqrt(max(b, 0.0) / a)
    if factor < SOFTEST:
        limit = "MuJoCo's contacts are as stiff as its timestep allows (a time constant of two timesteps)"
        return f"not changeable in {engine} towards stiffer: {limit}"
    return Alteration(contact_time=factor)


def altered_engine(base: Engine, alteration: Alteration) -> Engine:
    """Return the engine with other physics; its caller sees the scene that it asked for.

    Raises:
        CapabilityError: the softness of contacts is to change, and the engine has no dial for it.
    """
    if alteration.contact_time != 1.0:
        if not has_contact_dial(base.name):
            raise CapabilityError(
                f"the backend {base.name!r} has no dial for the softness of contacts. Leave contact_time at 1."
            )
        settings = MujocoSettings(time_constant_steps=NOMINAL_STEPS * alteration.contact_time)
        base = engine(base.name, device=base.device, settings=settings)

    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return AlteredBackend(base.make(alteration.scene(scene), num_worlds, object_index), scene, alteration)

    return replace(base, make=make)


def _inner(name: str) -> Callable[..., Any]:
    """Return a method that calls the method of the inner worlds."""
    return lambda self, *arguments: getattr(self._inner, name)(*arguments)


class AlteredBackend(Backend):
    """A backend that shows the scene that was asked for, and simulates an altered one."""

    name = "altered"
    capabilities = frozenset()

    def __init__(self, inner: Backend, scene: SceneSpec, alteration: Alteration) -> None:
        """Wrap ``inner``, the worlds of ``alteration.scene(scene)``."""
        super().__init__(scene, inner.num_worlds, object_index=inner.object_index, device=str(inner.device))
        self.name = inner.name  # pyright: ignore[reportAttributeAccessIssue]
        self.capabilities = inner.capabilities  # pyright: ignore[reportAttributeAccessIssue]
        self._inner = inner
        self._alteration = alteration
        self._late: deque[Tensor] = deque()
        self._targets = inner.state().joint_target.clone()

    @classmethod
    def engine_version(cls) -> str:
        """An altered backend is made from one that exists, and has no version of its own."""
        return "altered"

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        """Set the state, and forget targets that are still on their way to those worlds."""
        self._inner.set_state(state, worlds)
        chosen = slice(None) if worlds is None else worlds
        for targets in (self._targets, *self._late):
            targets[chosen] = state.joint_target.to(targets)

    def state(self) -> State:
        """Return the state, with the targets that were set, though they may act late."""
        return replace(self._inner.state(), joint_target=self._targets)

    def set_joint_targets(self, targets: Tensor) -> None:
        """Set targets that act ``delay`` control steps later; each call counts as the beginning of a control step."""
        self._late.append(self._targets)
        self._targets = targets.clone()
        while len(self._late) > self._alteration.delay:
            self._late.popleft()
        self._inner.set_joint_targets(self._late[0] if self._late else self._targets)

    def step(self, substeps: int | None = None) -> None:
        """Step as long as the scene that was asked for would."""
        if substeps is not None:
            substeps = max(1, round(substeps * self._inner.scene.substeps / self.scene.substeps))
        self._inner.step(substeps)

    def set_object_mass(self, mass: Tensor, worlds: Tensor | None = None) -> None:
        """Set the altered mass."""
        self._inner.set_object_mass(mass * self._alteration.mass, worlds)

    def set_friction(self, friction: Tensor, worlds: Tensor | None = None) -> None:
        """Set the altered friction."""
        a = self._alteration
        factors = torch.tensor([a.tip_friction, a.link_friction, a.table_friction]).to(friction)
        self._inner.set_friction(friction * factors, worlds)

    def set_torsional_friction(self, torsional: Tensor, worlds: Tensor | None = None) -> None:
        """Set the altered torsional friction."""
        self._inner.set_torsional_friction(torsional * self._alteration.torsional_friction, worlds)

    links = _inner("links")
    contacts = _inner("contacts")
    health = _inner("health")
    mass_properties = _inner("mass_properties")
    set_object_wrench = _inner("set_object_wrench")
    set_object_inertia = _inner("set_object_inertia")  # the altered inertia counts as 1
    set_object_com = _inner("set_object_com")
    set_object_gravity = _inner("set_object_gravity")
    set_drives = _inner("set_drives")
    close = _inner("close")
