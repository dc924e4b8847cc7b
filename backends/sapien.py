"""PhysX, through SAPIEN, on the CPU.

What differs from SAPIEN's defaults, and why:

- The TGS solver, a contact offset of 1 mm (the default of 10 mm loses grasps), no sleeping, no damping, no joint
  friction (the default of 0.05 is no torque, and brakes).
- Friction of a pair is the *average* of its materials. With 0 on the object, the other material has twice the pair's
  coefficient. Robots touch tables of their own and copies of their links, whose materials make up the difference.
  Torsional friction is mu times ``min_patch_radius``, so that radius is torsional / mu. PhysX omits it where a patch
  has two points and lets half of the sliding friction act at each (``docs/sim-to-sim.md``).
- Tendons couple mimic joints. They are soft and act on the links above, too (``sapien_robot``), or a jaw of coupled
  joints would press 2.6 times too hard.
- The robot feels no gravity (if it is compensated), nor does the object, whose weight is part of its force.
- PhysX reports the normal forces of contacts only; friction is computed from the object's momentum
  (:func:`~xreset.backends.rigid.friction_forces`).
- Lengths are in 1/32 m. PhysX's search for nearest points (GJK) treats a simplex that is thinner than 1e-4 as flat. In
  metres, it misses contacts at the edges of small hulls.
- Boxes are hulls. In any unit of length, PhysX's depth between two boxes is wrong by millimetres.
- Linear velocities refer to the centre of mass; they are converted here. Those of links belong to the poses before the
  last step, so links are computed from the joints. PhysX computes in single precision.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import Any, get_args

import numpy as np

from xreset.backends.pool import PoolBackend, World
from xreset.backends.rigid import (
    EYE,
    OTHER_LINK,
    TABLE,
    Inertia,
    LinkArrays,
    StateArrays,
    TrackedLinks,
    cross,
    friction_forces,
    matrix_to_quat,
    mechanism,
    nearer,
    object_inertia,
    rotate,
    vertices,
)
from xreset.backends.sapien_robot import (
    LENGTH,
    OBJECT_BIT,
    TABLE_OF_LINKS_BIT,
    TABLE_OF_TIPS_BIT,
    SapienJoints,
    joint_unit,
    self_collision_bits,
)
from xreset.geometry.shapes import perpendicular, transform
from xreset.geometry.urdf import Joint
from xreset.physics import Capability, KnownDifference, unavailable
from xreset.spec import GRAVITY, Geometry, SceneSpec, Shape

_POSITION_ITERATIONS = 20
"""Substeps of the TGS solver. With 10, objects creep out of grasps by centimetres in seconds; 40 is no better and twice
as slow."""
_CONTACT_OFFSET = 0.001
"""Distance [m] at which contacts are generated."""
_PARTING_SPEED = 1.0
"""Speed [m/s] with which the solver parts shapes that overlap (``PxRigidBody::setMaxDepenetrationVelocity``; the lower
one of a pair's two bodies counts). By default PhysX has no limit: it parts them within a step, and shoots away objects
that it falsely reports centimetres deep in a fingertip. With 0.5 and 2 m/s a policy does as well."""


class SapienWorld(World):
    """One world of PhysX, in a scene of its own."""

    def __init__(self, scene: SceneSpec, object_index: int) -> None:
        self._sapien = sapien = _engine()
        self._dt = scene.timestep
        self._mechanism = robot = mechanism(scene.robot)
        self._inertia = object_inertia(scene.objects[object_index])
        self._torsional = scene.friction.torsional
        names = ("tip", "link", "table", "bare", "table of tips", "table of links", "link of tips")
        self._materials = {name: sapien.physx.PhysxMaterial(0.0, 0.0, 0.0) for name in names}
        self._owners: dict[Any, int] = {}
        """Collision shape -> what it belongs to."""
        self._entities: list[Any] = []
        self._scene: Any = None
        self._system: Any = None
        self._steps = 0
        with _configured(sapien.physx):
            self._add_table(scene)
            self._bodies = self._add_robot()
            self._object = self._add_object(scene.objects[object_index].pieces)
        self._renew_scene()
        self._joints = SapienJoints(
            self._bodies, robot, scene.timestep, scene.timestep / _POSITION_ITERATIONS
        )
        self._tracked = TrackedLinks(robot)
        self.set_friction(np.array([scene.friction.tip, scene.friction.link, scene.friction.table]))
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._last_step: tuple[np.ndarray, ...] = ()
        """The object's velocity, angular velocity and orientation before the last physics step, and the force and
        torque that were given."""

    def set_state(self, state: StateArrays) -> None:
        if self._steps % 2:  # an articulation remembers that, and would differ in the last bits
            self.step(1)
        self._renew_scene()
        self._joints.reset(state["joint_pos"], state["joint_vel"], state["joint_target"])
        self._quat = np.array(state["object_quat"])
        self._object.entity.pose = self._pose(state["object_pos"], self._quat)
        omega = state["object_angvel"]
        com_velocity = state["object_linvel"] + cross(omega, rotate(self._quat, self._inertia.com))
        self._object.linear_velocity = LENGTH * com_velocity
        self._object.angular_velocity = omega

    def get_state(self) -> StateArrays:
        pose = self._object.entity_pose
        self._quat = nearer(pose.q.astype(np.float64), self._quat)
        omega = self._object.angular_velocity.astype(np.float64)
        position, velocity = self._joints.read(self._joints.driven)
        return {
            "joint_pos": position,
            "joint_vel": velocity,
            "joint_target": self._joints.target,
            "object_pos": pose.p / LENGTH,
            "object_quat": self._quat,
            "object_linvel": self._object.linear_velocity / LENGTH
            - cross(omega, rotate(self._quat, self._inertia.com)),
            "object_angvel": omega,
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._joints.set_targets(targets)

    def step(self, n: int) -> None:
        body = self._object
        self._steps += n
        for remaining in reversed(range(n)):
            self._joints.brake()
            body.add_force_torque(LENGTH * self.force, LENGTH**2 * self.torque)
            if not remaining:
                motion = (body.linear_velocity / LENGTH, body.angular_velocity, body.entity_pose.q)
                self._last_step = (*motion, self.force, self.torque)
            self._system.step()

    def links(self) -> LinkArrays:
        return self._tracked.locate(*self._joints.read(self._joints.by_body))

    def contacts(self) -> list[tuple[int, np.ndarray]]:
        owners, points, forces = self._contact_points()
        if owners:
            pose = self._object.entity_pose
            arms = points - pose.p / LENGTH - rotate(pose.q, self._inertia.com)
            coefficients = np.array([self._friction[_material(owner)] for owner in owners])
            missing = self._missing_wrench(arms, forces)
            forces = forces + friction_forces(arms, forces, coefficients, *missing)
        return list(zip(owners, forces, strict=True))

    def mass_properties(self) -> list[Inertia]:
        found = []
        for body in (*self._bodies[1:], self._object):
            frame = body.cmass_local_pose
            inertia = Inertia(
                mass=body.mass,
                com=frame.p.astype(float) / LENGTH,
                quat=frame.q.astype(float),
                moments=body.inertia.astype(float) / LENGTH**2,
            )
            found.append(inertia)
        return found

    def set_object_inertia(self, inertia: Inertia) -> None:
        self._inertia = inertia
        self._set_inertia(self._object, inertia)

    def set_friction(self, friction: np.ndarray) -> None:
        self._friction: dict[str, float] = dict(
            zip(("tip", "link", "table"), friction.tolist(), strict=True)
        )
        tip, link, table = friction.tolist()
        coefficients = self._friction | {
            "table of tips": max(tip, table) - tip,
            "table of links": max(link, table) - link,
            "link of tips": max(tip, link) - tip,
        }
        for name, mu in coefficients.items():
            self._materials[name].static_friction = 2.0 * mu
            self._materials[name].dynamic_friction = 2.0 * mu
        self.set_torsional_friction(self._torsional)

    def set_torsional_friction(self, torsional: float) -> None:
        self._torsional = torsional
        for shape, owner in self._owners.items():
            mu = self._friction[_material(owner)]
            shape.min_patch_radius = LENGTH * torsional / mu if mu > 0 else 0.0

    def set_drives(self, scale: np.ndarray) -> None:
        self._joints.set_drives(scale.astype(np.float64))

    # Building ---------------------------------------------------------------------------------------------------------

    def _add_table(self, scene: SceneSpec) -> None:
        body = self._sapien.physx.PhysxRigidStaticComponent()
        shape = Shape(geometry=Geometry(kind="box", size=scene.table.half_size))
        self._attach(body, shape, TABLE, (0, OBJECT_BIT))
        self._attach(body, shape, None, (TABLE_OF_TIPS_BIT, 0), "table of tips")
        self._attach(body, shape, None, (TABLE_OF_LINKS_BIT, 0), "table of links")
        self._add(body, "table", self._pose([*scene.table.center, -scene.table.half_size[2]]))

    def _add_object(self, pieces: Sequence[Shape]) -> Any:
        body = self._sapien.physx.PhysxRigidDynamicComponent()
        for piece in pieces:
            self._attach(body, piece, None, (OBJECT_BIT, 0), "bare")
        self._set_inertia(body, self._inertia)
        body.disable_gravity = True
        self._add(body, "object", self._sapien.Pose())
        return body

    def _add_robot(self) -> list[Any]:
        robot = self._mechanism.robot
        self_bits = self_collision_bits(self._mechanism)
        links: list[Any] = []
        for body in self._mechanism.bodies:
            parent = links[body.parent] if body.parent >= 0 else None
            link = self._sapien.physx.PhysxArticulationLinkComponent(parent)
            for part in body.shapes:
                owner = self._mechanism.tip_of.get(part.link, OTHER_LINK)
                table_bit = TABLE_OF_LINKS_BIT if owner == OTHER_LINK else TABLE_OF_TIPS_BIT
                if part.link in robot.table_exclude:
                    table_bit = 0
                bit, of_same_kind, of_tips = self_bits.get(part.link, (0, 0, 0))
                self._attach(link, part.shape, owner, (bit, OBJECT_BIT | table_bit))
                for partners, material in ((of_same_kind, "bare"), (of_tips, "link of tips")):
                    if partners:
                        self._attach(link, part.shape, None, (0, partners), material)
            if body.inertia is not None:
                self._set_inertia(link, body.inertia)
            link.disable_gravity = robot.gravity_compensated
            if body.joint is None:
                link.joint.type = "fixed"
            else:
                self._set_joint(link.joint, body.joint, body.T_parent_body)
            links.append(link)
        base = self._pose(robot.base_pos, robot.base_quat)
        for link, body in zip(links, self._mechanism.bodies, strict=True):
            # the pose of the root decides; joints place the others
            self._add(link, body.name, base)
        return links

    def _set_joint(self, made: Any, joint: Joint, T_parent_body: np.ndarray) -> None:
        T_joint_axis = transform(_x_to(joint.axis), np.zeros(3))
        made.name = joint.name
        made.type = "prismatic" if joint.type == "prismatic" else "revolute_unwrapped"
        made.pose_in_parent = self._frame(T_parent_body @ T_joint_axis)
        made.pose_in_child = self._frame(T_joint_axis)
        made.limit = joint_unit(made) * np.array([[joint.lower, joint.upper]])

    def _attach(
        self,
        body: Any,
        shape: Shape,
        owner: int | None,
        groups: tuple[int, int],
        material_name: str = "",
    ) -> None:
        """Add a collision shape.

        Args:
            body: what it is part of.
            shape: the shape.
            owner: what touches the object with it: the table, a fingertip or another link. None: nothing.
            groups: which others it touches: see ``sapien_robot``.
            material_name: its material; default: that of its owner.
        """
        physx = self._sapien.physx
        geometry = shape.geometry
        size = LENGTH * np.asarray(geometry.size)
        material = self._materials[material_name if owner is None else _material(owner)]
        T = shape.T_body_shape
        if geometry.kind == "sphere":
            made = physx.PhysxCollisionShapeSphere(radius=size[0], material=material)
        elif geometry.kind in ("box", "hull"):
            made = physx.PhysxCollisionShapeConvexMesh(
                vertices=LENGTH * vertices(shape), scale=np.ones(3), material=material
            )
            T = np.eye(4)
        else:
            kind = physx.PhysxCollisionShapeCylinder
            if geometry.kind == "capsule":
                kind = physx.PhysxCollisionShapeCapsule
            made = kind(radius=size[0], half_length=size[1], material=material)
            along_x = _x_to(np.array([0.0, 0.0, 1.0]))  # as PhysX has them
            T = transform(T[:3, :3] @ along_x, T[:3, 3])
        made.local_pose = self._frame(T)
        made.set_collision_groups([*groups, 0, 0])
        body.attach(made)
        if owner is not None:
            self._owners[made] = owner

    def _set_inertia(self, body: Any, inertia: Inertia) -> None:
        body.mass = inertia.mass
        body.cmass_local_pose = self._pose(inertia.com, inertia.quat)
        body.inertia = LENGTH**2 * inertia.moments
        body.linear_damping = body.angular_damping = 0.0
        body.max_linear_velocity = LENGTH * _NO_LIMIT
        body.max_angular_velocity = _NO_LIMIT
        body.max_depenetration_velocity = LENGTH * _PARTING_SPEED

    def _add(self, body: Any, name: str, pose: Any) -> None:
        entity = self._sapien.Entity()
        entity.name = name
        entity.add_component(body)
        entity.pose = pose
        self._entities.append(entity)

    def _renew_scene(self) -> None:
        """Move everything to a new scene: PhysX then forgets the order in which pairs came into contact."""
        if self._scene:
            for entity in self._entities:
                self._scene.remove_entity(entity)
        with _configured(self._sapien.physx):
            self._system = self._sapien.physx.PhysxCpuSystem()
        self._system.timestep = self._dt
        self._scene = self._sapien.Scene([self._system])
        for entity in self._entities:
            self._scene.add_entity(entity)

    def _pose(self, pos: Any, quat: Any = (1.0, 0.0, 0.0, 0.0)) -> Any:
        return self._sapien.Pose(LENGTH * np.asarray(pos), quat)

    def _frame(self, T: np.ndarray) -> Any:
        return self._pose(T[:3, 3], matrix_to_quat(T[:3, :3]))

    # Contacts ---------------------------------------------------------------------------------------------------------

    def _contact_points(self) -> tuple[list[int], np.ndarray, np.ndarray]:
        """Return the contacts of the last step: owners, points [n, 3], normal forces on the object [n, 3]."""
        owners = []
        points = []
        impulses = []
        for contact in self._system.get_contacts():
            first, second = contact.bodies
            if self._object not in (first, second):
                continue
            is_first = first == self._object
            sign = 1.0 if is_first else -1.0  # an impulse acts on the first body
            owner = self._owners[contact.shapes[1 if is_first else 0]]
            for point in contact.points:
                x, y, z = point.impulse.tolist()
                if x or y or z:
                    owners.append(owner)
                    points.append(point.position.tolist())
                    impulses.append((sign * x, sign * y, sign * z))
        return owners, np.array(points) / LENGTH, np.array(impulses) / (LENGTH * self._dt)

    def _missing_wrench(
        self, arms: np.ndarray, contact_forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the force and torque [3] about the centre of mass that explain the rest of the change of momentum.

        Args:
            arms: [n, 3] contact points from the centre of mass.
            contact_forces: [n, 3] known forces at these points.
        """
        linvel, angvel, quat, force, torque = self._last_step
        R = rotate(quat, EYE).T
        omega = angvel.astype(np.float64)
        inertia = R @ self._inertia.matrix @ R.T
        gained = self._inertia.mass * (self._object.linear_velocity / LENGTH - linvel) / self._dt
        turned = inertia @ (self._object.angular_velocity - omega) / self._dt
        turned = turned + cross(omega, inertia @ omega)
        contact_torques = cross(arms, contact_forces)
        return (
            gained - force - contact_forces.sum(axis=0),
            turned - torque - contact_torques.sum(axis=0),
        )


KNOWN_DIFFERENCES = (
    *(
        KnownDifference(
            check="drive_equation",
            measure=f"step of {step} m, stiffer and weaker",
            bound=0.06,
            reason="a drive that leaves its effort limit lags, in proportion to the timestep",
        )
        for step in ("+0.08", "-0.08")
    ),
    KnownDifference(
        check="joint_friction",
        measure="way within friction",
        bound=0.4,
        reason="PhysX applies a torque at the beginning of a step and the drive during it, so a joint that dry "
        "friction holds creeps, by 2.5 mm/s, until the drive alone balances the friction",
    ),
    KnownDifference(
        check="slope",
        measure="creep, mu 1.2, 0 degrees",
        bound=1e-3,
        reason="PhysX's patch friction gives way a little in every step, the more the nearer the load is to the cone",
    ),
)
"""Checks that PhysX misses with these settings."""


class SapienBackend(PoolBackend):
    """N worlds of PhysX."""

    name = "sapien"
    capabilities = frozenset(get_args(Capability))
    known_differences = KNOWN_DIFFERENCES
    world_class = SapienWorld

    @classmethod
    def engine_version(cls) -> str:
        _engine()
        return version("sapien")


# SAPIEN's conventions -------------------------------------------------------------------------------------------------

_NO_LIMIT = 1e3
"""Speed limit of bodies [m/s, rad/s]: PhysX has lower ones of its own."""


def _material(owner: int) -> str:
    """Return the material of what a shape belongs to."""
    return {TABLE: "table", OTHER_LINK: "link"}.get(owner, "tip")


def _x_to(axis: np.ndarray) -> np.ndarray:
    """[3, 3] a rotation that turns x into a unit vector: joints, capsules and cylinders are along x in PhysX."""
    y = perpendicular(axis)
    return np.stack([axis, y, np.cross(axis, y)], axis=1)


@contextmanager
def _configured(physx: Any) -> Iterator[None]:
    """Set the process-wide configuration that systems, bodies and shapes take when they are made; put it back after."""
    scene = physx.get_scene_config()
    body = physx.get_body_config()
    shape = physx.get_shape_config()
    physx.set_scene_config(
        gravity=np.array([0.0, 0.0, -LENGTH * GRAVITY]),
        enable_tgs=True,
        enable_pcm=True,
        enable_enhanced_determinism=True,  # or a world would depend on what was in it before
        enable_friction_every_iteration=True,
        cpu_workers=0,
    )
    physx.set_body_config(
        solver_position_iterations=_POSITION_ITERATIONS,
        solver_velocity_iterations=1,
        sleep_threshold=0.0,
    )
    physx.set_shape_config(contact_offset=LENGTH * _CONTACT_OFFSET, rest_offset=0.0)
    try:
        yield
    finally:
        physx.set_scene_config(scene)
        physx.set_body_config(body)
        physx.set_shape_config(shape)


def _engine() -> Any:
    """Return the module ``sapien``; ``BackendUnavailableError`` if it cannot be imported."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about Vulkan, which nothing here renders with
            import sapien
            import sapien.physx
    except ImportError as error:
        raise unavailable("sapien", "'xreset[sapien]'", error) from error
    return sapien
