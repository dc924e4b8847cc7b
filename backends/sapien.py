"""PhysX, through SAPIEN, on the CPU.

What differs from SAPIEN's defaults, and why:

- The TGS solver, a contact offset of 1 mm (the default of 10 mm loses grasps), no sleeping, no damping, no joint friction (the default of
  0.05 is no torque, and brakes).
- Friction of a pair is the *average* of its materials. With 0 on the object, the other material has twice the pair's coefficient.
  Torsional friction is mu times ``min_patch_radius``, so that radius is torsional / mu. PhysX leaves it out where a patch has two points
  and lets half of the sliding friction act at each (``docs/sim-to-sim.md``; ``docs/lab-book.md`` has what that costs a policy).
- The robot feels no gravity (if it is compensated). The object's weight is applied as a force, which gives gravity fractions.
- PhysX reports the normal forces of contacts only; friction is worked out from the object's momentum
  (:func:`~xreset.backends.rigid.friction_forces`).
- Linear velocities refer to the centre of mass; they are converted here. PhysX computes in single precision.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from xreset.backends.pool import PoolBackend, World
from xreset.backends.rigid import (
    Arms,
    Inertia,
    TrackedFrames,
    cross,
    friction_forces,
    matrix_to_quat,
    mechanism,
    nearer,
    object_inertia,
    rotate,
)
from xreset.backends.sapien_robot import OBJECT_BIT, TABLE_BIT, SapienJoints, self_collision_bits
from xreset.physics import Capability, KnownDifference, unavailable
from xreset.spec import GRAVITY, Geometry, SceneSpec, Shape


@dataclass(frozen=True, kw_only=True)
class SapienSettings:
    """PhysX's dials."""

    position_iterations: int = 20
    """Substeps of the TGS solver. With 10, objects creep out of grasps by centimetres in seconds; 40 is no better and twice as slow."""
    velocity_iterations: int = 1
    """Sweeps of the solver over velocities."""
    contact_offset: float = 0.001
    """Distance [m] at which contacts are generated."""


_DEFAULTS = SapienSettings()


class SapienWorld(World):
    """One world of PhysX, in a scene of its own."""

    def __init__(self, scene: SceneSpec, object_index: int, *, settings: SapienSettings = _DEFAULTS) -> None:
        self._sapien = sapien = _engine()
        self._settings, self._dt = settings, scene.timestep
        _configure(sapien.physx, settings)
        self._mechanism = robot = mechanism(scene.robot)
        self._inertia = object_inertia(scene.objects[object_index])
        self._arm = Arms(self._inertia.com[None])
        self._torsional = scene.friction.torsional
        self._materials = {
            role: sapien.physx.PhysxMaterial(0.0, 0.0, 0.0) for role in ("tip", "link", "table", "object")
        }
        self._surfaces: dict[Any, _Surface] = {}
        self._entities: list[Any] = []
        self._add_table(scene)
        self._bodies = self._add_robot()
        self._object = self._add_object(scene.objects[object_index].pieces)
        self._scene: Any = None
        self._system: Any = None
        self._renew_scene()
        self._joints = SapienJoints(self._bodies, robot, scene.timestep)
        self._frames = TrackedFrames(robot)
        self._tracked = [self._bodies[i] for i in self._frames.bodies]
        self._axes = Arms(np.array([rotate(self._inertia.quat, axis) for axis in np.eye(3)]))
        self.set_friction(np.array([scene.friction.tip, scene.friction.link, scene.friction.table]))
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._last_step: tuple[_Motion, np.ndarray, np.ndarray] | None = None

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        self._renew_scene()
        self._joints.reset(state["joint_pos"], state["joint_vel"], state["joint_target"])
        self._quat = np.array(state["object_quat"])
        self._object.entity.pose = self._sapien.Pose(state["object_pos"], self._quat)
        omega = state["object_angvel"]
        self._object.linear_velocity = state["object_linvel"] + cross(omega, rotate(self._quat, self._inertia.com))
        self._object.angular_velocity = omega
        self._last_step = None

    def get_state(self) -> dict[str, np.ndarray]:
        pose = self._object.entity_pose
        self._quat = nearer(pose.q.astype(np.float64), self._quat)
        omega = self._object.angular_velocity.astype(np.float64)
        position, velocity = self._joints.read()
        return {
            "joint_pos": position,
            "joint_vel": velocity,
            "joint_target": self._joints.target,
            "object_pos": pose.p,
            "object_quat": self._quat,
            "object_linvel": self._object.linear_velocity - cross(omega, self._arm.turned(self._quat)[0]),
            "object_angvel": omega,
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._joints.set_targets(targets)

    def step(self, n: int) -> None:
        body = self._object
        force = self.force - np.array([0.0, 0.0, self._inertia.mass * GRAVITY * self.gravity_fraction])
        for remaining in reversed(range(n)):
            self._joints.brake()
            body.add_force_torque(force, self.torque)
            if not remaining:
                start = _Motion(body.linear_velocity, body.angular_velocity, body.entity_pose.q)
                self._last_step = start, force, self.torque
            self._system.step()

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        parts = []
        for body in self._tracked:
            pose = body.entity_pose
            parts += (pose.p, pose.q, body.linear_velocity, body.angular_velocity)
        rows = np.concatenate(parts, dtype=np.float64).reshape(-1, 13)
        return self._frames.locate(rows[:, :3], rows[:, 3:7], rows[:, 7:10], rows[:, 10:])

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        tips = len(self._mechanism.robot.fingertips)
        tip_force, tip_touch, table_force = np.zeros((tips, 3)), np.zeros(tips, dtype=bool), np.zeros(3)
        if self._last_step is None:
            return tip_force, tip_touch, table_force
        surfaces, points, normal_forces = self._contact_points()
        if surfaces:
            pose = self._object.entity_pose
            arms = points - (pose.p + self._arm.turned(pose.q)[0])
            limits = np.array([self._pair_friction[surface.role] for surface in surfaces])
            missing = self._missing_wrench(*self._last_step, arms, normal_forces)
            for surface, force in zip(
                surfaces, normal_forces + friction_forces(arms, normal_forces, limits, *missing), strict=True
            ):
                if surface.role == "table":
                    table_force += force
                elif surface.tip is not None:
                    tip_force[surface.tip] += force
                    tip_touch[surface.tip] = True
        return tip_force, tip_touch, table_force

    def mass_properties(self) -> list[Inertia]:
        bodies = (*self._bodies[1:], self._object)
        frames = [body.cmass_local_pose for body in bodies]
        return [
            Inertia(
                mass=body.mass,
                com=frame.p.astype(float),
                quat=frame.q.astype(float),
                moments=body.inertia.astype(float),
            )
            for body, frame in zip(bodies, frames, strict=True)
        ]

    def set_object_inertia(self, inertia: Inertia) -> None:
        self._inertia, self._arm = inertia, Arms(inertia.com[None])
        self._set_inertia(self._object, inertia)

    def set_friction(self, friction: np.ndarray) -> None:
        self._pair_friction = dict(zip(("tip", "link", "table"), (float(mu) for mu in friction), strict=True))
        for role, mu in self._pair_friction.items():
            self._materials[role].static_friction = self._materials[role].dynamic_friction = 2.0 * mu
        self.set_torsional_friction(self._torsional)

    def set_torsional_friction(self, torsional: float) -> None:
        self._torsional = torsional
        for shape, surface in self._surfaces.items():
            mu = self._pair_friction[surface.role]
            shape.min_patch_radius = torsional / mu if mu > 0 else 0.0

    def set_drives(self, scale: np.ndarray) -> None:
        self._joints.set_drives(scale.astype(np.float64))

    # Building ---------------------------------------------------------------------------------------------------------

    def _add_table(self, scene: SceneSpec) -> None:
        table = self._sapien.physx.PhysxRigidStaticComponent()
        self._attach(
            table,
            Shape(geometry=Geometry(kind="box", size=scene.table.half_size)),
            _Surface("table"),
            [TABLE_BIT, OBJECT_BIT, 0, 0],
        )
        self._add(table, "table", self._sapien.Pose([*scene.table.center, -scene.table.half_size[2]]))

    def _add_object(self, pieces: Sequence[Shape]) -> Any:
        body = self._sapien.physx.PhysxRigidDynamicComponent()
        for piece in pieces:
            self._attach(body, piece, None, [OBJECT_BIT, 0, 0, 0])
        self._set_inertia(body, self._inertia)
        body.disable_gravity = True
        self._add(body, "object", self._sapien.Pose())
        return body

    def _add_robot(self) -> list[Any]:
        sapien, robot = self._sapien, self._mechanism.robot
        self_bits = self_collision_bits(self._mechanism)
        links: list[Any] = []
        for body in self._mechanism.bodies:
            link = sapien.physx.PhysxArticulationLinkComponent(links[body.parent] if body.parent >= 0 else None)
            for part in body.shapes:
                tip = self._mechanism.tip_of.get(part.link)
                kind, affinity = self_bits.get(part.link, (0, 0))
                near_table = 0 if part.link in robot.table_exclude else TABLE_BIT
                surface = _Surface("link" if tip is None else "tip", tip)
                self._attach(link, part.shape, surface, [kind, affinity | OBJECT_BIT | near_table, 0, 0])
            if body.inertia is not None:
                self._set_inertia(link, body.inertia)
            link.disable_gravity = robot.gravity_compensated
            if body.joint is None:
                link.joint.type = "fixed"
            else:
                T_joint_axis = np.eye(4)
                T_joint_axis[:3, :3] = _x_to(body.joint.axis)
                link.joint.name = body.joint.name
                link.joint.type = "prismatic" if body.joint.type == "prismatic" else "revolute_unwrapped"
                link.joint.pose_in_parent = self._pose(body.T_parent_body @ T_joint_axis)
                link.joint.pose_in_child = self._pose(T_joint_axis)
                limited = np.isfinite(body.joint.lower) and np.isfinite(body.joint.upper)
                link.joint.limit = [[body.joint.lower, body.joint.upper] if limited else [-np.inf, np.inf]]
            links.append(link)
        base = sapien.Pose(robot.base_pos, robot.base_quat)
        for link, body in zip(links, self._mechanism.bodies, strict=True):
            self._add(link, body.name, base)  # the pose of the root decides; joints place the others
        return links

    def _attach(self, body: Any, shape: Shape, surface: _Surface | None, groups: list[int]) -> None:
        physx, geometry = self._sapien.physx, shape.geometry
        material = self._materials[surface.role if surface else "object"]
        T = shape.T_body_shape
        if geometry.kind == "box":
            made = physx.PhysxCollisionShapeBox(half_size=geometry.size, material=material)
        elif geometry.kind == "sphere":
            made = physx.PhysxCollisionShapeSphere(radius=geometry.size[0], material=material)
        elif geometry.kind == "hull":
            made = physx.PhysxCollisionShapeConvexMesh(vertices=geometry.vertices, scale=np.ones(3), material=material)
        else:
            kind = physx.PhysxCollisionShapeCapsule if geometry.kind == "capsule" else physx.PhysxCollisionShapeCylinder
            made = kind(radius=geometry.size[0], half_length=geometry.size[1], material=material)
            T = T.copy()
            T[:3, :3] = T[:3, :3] @ _x_to(np.array([0.0, 0.0, 1.0]))  # PhysX has them along x
        made.local_pose = self._pose(T)
        made.set_collision_groups(groups)
        body.attach(made)
        if surface is not None:
            self._surfaces[made] = surface

    def _set_inertia(self, body: Any, inertia: Inertia) -> None:
        body.mass = inertia.mass
        body.cmass_local_pose = self._sapien.Pose(inertia.com, inertia.quat)
        body.inertia = inertia.moments
        body.linear_damping = body.angular_damping = 0.0
        body.max_linear_velocity = body.max_angular_velocity = _NO_LIMIT

    def _add(self, body: Any, name: str, pose: Any) -> None:
        entity = self._sapien.Entity()
        entity.name = name
        entity.add_component(body)
        entity.pose = pose
        self._entities.append(entity)

    def _renew_scene(self) -> None:
        """Move everything to a new scene: the only way to make PhysX forget the order in which pairs came into contact."""
        for entity in self._entities if self._scene else ():
            self._scene.remove_entity(entity)
        _configure(self._sapien.physx, self._settings)
        self._system = self._sapien.physx.PhysxCpuSystem()
        self._system.timestep = self._dt
        self._scene = self._sapien.Scene([self._system])
        for entity in self._entities:
            self._scene.add_entity(entity)

    def _pose(self, T: np.ndarray) -> Any:
        return self._sapien.Pose(T[:3, 3], matrix_to_quat(T[:3, :3]))

    # Contacts ---------------------------------------------------------------------------------------------------------

    def _contact_points(self) -> tuple[list[_Surface], np.ndarray, np.ndarray]:
        """What pressed on the object in the last step: surfaces, points [n, 3], normal forces on the object [n, 3]."""
        surfaces, points, impulses = [], [], []
        for contact in self._system.get_contacts():
            first, second = contact.bodies
            if self._object not in (first, second):
                continue
            sign = 1.0 if first == self._object else -1.0  # an impulse acts on the first body
            surface = self._surfaces[contact.shapes[1 if first == self._object else 0]]
            for point in contact.points:
                x, y, z = point.impulse.tolist()
                if x or y or z:
                    surfaces.append(surface)
                    points.append(point.position.tolist())
                    impulses.append((sign * x, sign * y, sign * z))
        return surfaces, np.array(points), np.array(impulses) / self._dt

    def _missing_wrench(
        self, start: _Motion, force: np.ndarray, torque: np.ndarray, arms: np.ndarray, contact_forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Force and torque [3] about the centre of mass that the object's change of momentum shows beyond the forces given."""
        axes, omega = self._axes.turned(start.quat), start.angvel.astype(np.float64)
        inertia = (axes.T * self._inertia.moments) @ axes
        gained = self._inertia.mass * (self._object.linear_velocity - start.linvel) / self._dt
        turned = inertia @ (self._object.angular_velocity - omega) / self._dt + cross(omega, inertia @ omega)
        return gained - force - contact_forces.sum(axis=0), turned - torque - cross(arms, contact_forces).sum(axis=0)


KNOWN_DIFFERENCES = tuple(
    KnownDifference(
        check="slope",
        measure=f"creep, mu {mu}, {degrees} degrees",
        bound=1e-3,
        reason="PhysX's patch friction gives way a little in every step, the more the nearer the load is to the cone; twice the position "
        "iterations would bring it to 0.4 mm/s, at twice the time",
    )
    for mu in (0.8, 1.2)
    for degrees in (0, 45)
)
"""What PhysX cannot do with these settings."""


class SapienBackend(PoolBackend):
    """N worlds of PhysX; the keyword ``settings`` takes :class:`SapienSettings`."""

    name = "sapien"
    capabilities = frozenset(get_args(Capability))
    known_differences = KNOWN_DIFFERENCES
    world_class = SapienWorld

    @classmethod
    def engine_version(cls) -> str:
        _engine()
        return version("sapien")


class _Motion(NamedTuple):
    """Of the object at the start of a step."""

    linvel: np.ndarray
    """[3] velocity of the centre of mass."""
    angvel: np.ndarray
    """[3]"""
    quat: np.ndarray
    """[4] orientation."""


class _Surface(NamedTuple):
    """What a shape is to the object."""

    role: Literal["tip", "link", "table"]
    tip: int | None = None
    """Index of its fingertip."""


# SAPIEN's habits ------------------------------------------------------------------------------------------------------

_NO_LIMIT = 1e3
"""Speed limit of bodies [m/s, rad/s]: PhysX has lower ones of its own."""


def _x_to(axis: np.ndarray) -> np.ndarray:
    """[3, 3] a rotation that turns x into a unit vector: joints, capsules and cylinders lie along x in PhysX."""
    other = np.eye(3)[np.abs(axis).argmin()]
    y = np.cross(axis, other)
    y /= np.linalg.norm(y)
    return np.stack([axis, y, np.cross(axis, y)], axis=1)


def _configure(physx: Any, settings: SapienSettings) -> None:
    """Set the process-wide configuration that systems, bodies and shapes take when they are made."""
    physx.set_scene_config(
        gravity=np.array([0.0, 0.0, -GRAVITY]),
        enable_tgs=True,
        enable_pcm=True,
        enable_enhanced_determinism=True,  # or a world would depend on what was in it before
        enable_friction_every_iteration=True,
        cpu_workers=0,
    )
    physx.set_body_config(
        solver_position_iterations=settings.position_iterations,
        solver_velocity_iterations=settings.velocity_iterations,
        sleep_threshold=0.0,
    )
    physx.set_shape_config(contact_offset=settings.contact_offset, rest_offset=0.0)


def _engine() -> Any:
    """The module ``sapien``; ``BackendUnavailableError`` if it cannot be imported."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about Vulkan, which nothing here renders with
            import sapien
            import sapien.physx
    except ImportError as error:
        raise unavailable("sapien", "'xreset[sapien]'", error) from error
    return sapien
