"""Bullet, through PyBullet, on the CPU.

What differs from PyBullet's defaults, and why:

- Gravity is off: the robot is then compensated exactly. A robot without compensation gets its weight from the engine,
  and the object, whose weight is part of its force, a force against this gravity.
- Drives are torques computed in ``bullet_drives``. PyBullet's own position control holds objects with a wrong force.
- Friction of a pair is the *product* of its bodies' coefficients, and its torsional friction is s_a mu_b + s_b mu_a.
  With mu = 1 and s = 0 on the object, the other body's coefficients are the pair's. Robots touch tables of their own
  and bare copies of their links, whose coefficients are solved for those pairs.
- Poses and linear velocities of bodies refer to the centre of mass and the principal axes; they are converted here.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.backends.bullet_drives import BulletDrives
from xreset.backends.bullet_models import (
    WEIGHTLESS,
    Part,
    inertial_frame,
    is_hull,
    link_groups,
    robot_parts,
    robot_urdf,
)
from xreset.backends.pool import PoolBackend, World, is_finite
from xreset.backends.rigid import (
    OTHER_LINK,
    TABLE,
    Inertia,
    LinkArrays,
    StateArrays,
    TrackedFrames,
    conjugate,
    cross,
    mechanism,
    multiply,
    nearer,
    object_inertia,
    rotate,
    vertices,
)
from xreset.errors import BackendUnavailableError, XResetError
from xreset.physics import Capability, unavailable
from xreset.physics.plugins import silence
from xreset.spec import GRAVITY, SceneSpec, Shape

INTERNAL_STEPS = 2
"""Internal steps per physics step. Objects creep in a grasp by 2 mm in 2 s with 2, by 4 mm with 1, which is 1.6 times
as fast."""
_SOLVER_ITERATIONS = 50
_GEOM_INITIALIZE_SAT_FEATURES = 4
"""Bullet's flag of a collision shape, which PyBullet does not name: contacts between polyhedra are found on faces."""
_NEWEST_PYTHON = (3, 11)
"""Newest Python for which PyBullet publishes wheels."""
_LEAST_FRICTION = 1e-4
"""Coefficient of a robot's link at least: 0 times any other would be 0."""
_FAR = 100.0
"""A height [m] where nothing touches the object."""


class PybulletWorld(World):
    """One world of Bullet, in a client of its own."""

    def __init__(self, scene: SceneSpec, object_index: int) -> None:
        self._scene = scene
        self._pieces = scene.objects[object_index].pieces
        self._mechanism = mechanism(scene.robot)
        self._inertia = object_inertia(scene.objects[object_index])
        self._friction = np.array([scene.friction.tip, scene.friction.link, scene.friction.table])
        self._torsional = scene.friction.torsional
        self._drive_scale = np.ones((3, len(scene.robot.joints)))
        self._build()

    def _build(self) -> None:
        """Make a client with robot, object and table in it."""
        scene = self._scene
        self._p = p = _Client()
        dt = scene.timestep / INTERNAL_STEPS
        p.setPhysicsEngineParameter(
            fixedTimeStep=dt,
            numSubSteps=0,
            numSolverIterations=_SOLVER_ITERATIONS,
            enableConeFriction=1,  # a pyramid lets objects slide 30 % less far along its diagonals
            deterministicOverlappingPairs=1,  # or a world would depend on what was in it before
            enableSAT=1,  # a hull at rest on a face gets all the contacts of that face, instead of one
            enableFileCaching=0,
        )
        self._world_gravity = 0.0 if scene.robot.gravity_compensated else -GRAVITY
        p.setGravity(0, 0, self._world_gravity)

        self._parts = robot_parts(self._mechanism)
        """The part of each link of the robot, by Bullet's link numbers."""
        groups = link_groups(self._pieces)
        self._pieces_of_object = range(-1, len(groups) - 1)
        """Bullet's link numbers of the object."""
        self._robot = self._load_robot()
        self._object = self._load_object(groups)
        self._table = self._add_table()
        self._table_of_tips = self._add_table()
        self._table_of_links = self._add_table()
        for link, part in enumerate(self._parts):
            self._remove_defaults(self._robot, link, part.shapes)
        for link, group in zip(self._pieces_of_object, groups, strict=True):
            self._remove_defaults(self._object, link, group)
        self._set_collision_pairs()

        with silence():  # a warning for each joint whose axis is rounded
            self._drives = BulletDrives(p, self._robot, self._mechanism, dt)
        self._drives.scale(self._drive_scale)
        self._frames = TrackedFrames(self._mechanism)
        self._from_principal = conjugate(self._inertia.quat)
        self.set_friction(self._friction)
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._clean = p.saveState()

    def set_state(self, state: StateArrays) -> None:
        if not is_finite(self.get_state()):
            self._rebuild()
        p = self._p
        p.restoreState(self._clean)
        p.performCollisionDetection()  # with the object far away: what touched it before is forgotten
        self._drives.reset(state["joint_pos"], state["joint_vel"], state["joint_target"])
        self._quat = np.array(state["object_quat"])
        arm = rotate(self._quat, self._inertia.com)
        principal = multiply(self._quat, self._inertia.quat)
        p.resetBasePositionAndOrientation(self._object, state["object_pos"] + arm, _xyzw(principal))
        omega = state["object_angvel"]
        p.resetBaseVelocity(self._object, state["object_linvel"] + cross(omega, arm), omega)

    def get_state(self) -> StateArrays:
        com, principal = self._p.getBasePositionAndOrientation(self._object)
        linear, angular = self._p.getBaseVelocity(self._object)
        angvel = np.array(angular)
        self._quat = nearer(multiply(_wxyz(principal), self._from_principal), self._quat)
        arm = rotate(self._quat, self._inertia.com)
        position, velocity = self._drives.read()
        return {
            "joint_pos": position[self._drives.driven],
            "joint_vel": velocity[self._drives.driven],
            "joint_target": self._drives.target,
            "object_pos": np.array(com) - arm,
            "object_quat": self._quat,
            "object_linvel": np.array(linear) - cross(angvel, arm),
            "object_angvel": angvel,
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._drives.target = targets

    def step(self, n: int) -> None:
        p = self._p
        force = np.array(self.force)
        force[2] -= self._inertia.mass * self._world_gravity
        turned = bool(self.torque.any())
        for _ in range(n * INTERNAL_STEPS):
            self._drives.apply()
            com, _ = p.getBasePositionAndOrientation(self._object)
            p.applyExternalForce(self._object, -1, force.tolist(), com, p.WORLD_FRAME)
            if turned:
                p.applyExternalTorque(self._object, -1, self.torque, p.WORLD_FRAME)
            p.stepSimulation()

    def links(self) -> LinkArrays:
        states = self._p.getLinkStates(
            self._robot, self._frames.bodies, computeLinkVelocity=1, computeForwardKinematics=1
        )
        rows = np.array([state[4] + state[5] + state[6] + state[7] for state in states])
        return self._frames.locate(rows[:, :3], rows[:, [6, 3, 4, 5]], rows[:, 7:10], rows[:, 10:])

    def contacts(self) -> list[tuple[int, np.ndarray]]:
        """See :meth:`World.contacts`. The forces are those of the last internal step."""
        found = []
        # All contacts: when asked for a body, PyBullet swaps the two bodies and the normal, but not the friction.
        for contact in self._p.getContactPoints():
            _, first, second, first_link, second_link, _, _, normal, _, press, *friction = contact
            if self._object not in (first, second):
                continue
            along, along_direction, across, across_direction = friction
            force = (
                press * np.array(normal)
                + along * np.array(along_direction)
                + across * np.array(across_direction)
            )
            link = second_link
            if first != self._object:  # the force is on the first body
                force = -force
                link = first_link
            if self._table in (first, second):
                found.append((TABLE, force))
            elif press > 0:
                found.append((self._parts[link].owner, force))
        return found

    def mass_properties(self) -> list[Inertia]:
        """See :meth:`World.mass_properties`. The object is loaded in the frame of its inertia."""
        found = [
            self._inertia_of(self._robot, link) for link in range(1, len(self._mechanism.bodies))
        ]
        obj = self._inertia_of(self._object, -1)
        own = self._inertia
        in_mesh = replace(
            obj, com=own.com + rotate(own.quat, obj.com), quat=multiply(own.quat, obj.quat)
        )
        return [*found, in_mesh]

    def _inertia_of(self, body: int, link: int) -> Inertia:
        mass, _, moments, com, quat, *_ = self._p.getDynamicsInfo(body, link)
        return Inertia(mass=mass, com=np.array(com), quat=_wxyz(quat), moments=np.array(moments))

    def set_object_inertia(self, inertia: Inertia) -> None:
        """See :meth:`World.set_object_inertia`.

        Bullet's bodies have their origin at the centre of mass, so another centre of mass needs a new client.
        """
        if not np.array_equal(inertia.com, self._inertia.com):
            state = self.get_state()
            self._inertia = inertia
            self._rebuild()
            self.set_state(state)
            return
        self._inertia = inertia
        self._p.changeDynamics(
            self._object, -1, mass=inertia.mass, localInertiaDiagonal=inertia.moments
        )

    def set_friction(self, friction: np.ndarray) -> None:
        tips_were_rougher = self._tips_are_rougher
        self._friction = friction
        if self._tips_are_rougher != tips_were_rougher:  # other copies of links touch
            state = self.get_state()
            self._rebuild()
            self.set_state(state)
            return
        tip, link, table = friction.tolist()
        for piece in self._pieces_of_object:
            self._set_surface(self._object, piece, 1.0, 0.0)
        self._set_surface(self._table, -1, table, self._torsional)
        for own, mu in ((self._table_of_tips, tip), (self._table_of_links, link)):
            self._set_surface(own, -1, max(mu, table) / max(mu, _LEAST_FRICTION), 0.0)
        for i, part in enumerate(self._parts):
            if part.bare:
                self._set_surface(self._robot, i, 1.0, 0.0)
            else:
                mu = link if part.owner == OTHER_LINK else tip
                self._set_surface(self._robot, i, max(mu, _LEAST_FRICTION), self._torsional)

    @property
    def _tips_are_rougher(self) -> bool:
        tip, link, _ = self._friction
        return bool(tip >= link)

    def _set_surface(self, body: int, link: int, friction: float, torsional: float) -> None:
        self._p.changeDynamics(body, link, lateralFriction=friction, spinningFriction=torsional)

    def set_torsional_friction(self, torsional: float) -> None:
        self._torsional = torsional
        self.set_friction(self._friction)

    def set_drives(self, scale: np.ndarray) -> None:
        self._drive_scale = scale.astype(np.float64)
        self._drives.scale(self._drive_scale)

    def close(self) -> None:
        if self._p.isConnected():
            self._p.disconnect()

    def _rebuild(self) -> None:
        """Begin with a new client.

        Numbers that are not finite stay in Bullet's broad phase, and the body then touches nothing any more.
        """
        self.close()
        self._build()

    # Building ---------------------------------------------------------------------------------------------------------

    def _load_robot(self) -> int:
        p = self._p
        flags = (
            p.URDF_USE_INERTIA_FROM_FILE
            | p.URDF_USE_SELF_COLLISION
            | p.URDF_MAINTAIN_LINK_ORDER
            | p.URDF_USE_IMPLICIT_CYLINDER
            | p.URDF_INITIALIZE_SAT_FEATURES
        )
        robot = self._scene.robot
        with tempfile.TemporaryDirectory(prefix="xreset-") as folder:
            urdf = str(robot_urdf(self._mechanism, self._parts, Path(folder)))
            orientation = _xyzw(robot.base_quat)
            return p.loadURDF(urdf, robot.base_pos, orientation, useFixedBase=True, flags=flags)

    def _load_object(self, groups: Sequence[tuple[Shape, ...]]) -> int:
        """Make the object in the frame of its inertia. Groups after the first are links with almost no mass."""
        p = self._p
        T = np.linalg.inv(inertial_frame(self._inertia))
        shapes = []
        for group in groups:
            moved = [replace(shape, T_body_shape=T @ shape.T_body_shape) for shape in group]
            shapes.append(self._shape(moved))
        n = len(shapes) - 1
        origin = [(0.0, 0.0, 0.0)] * n
        upright = [(0.0, 0.0, 0.0, 1.0)] * n
        body = p.createMultiBody(
            baseMass=self._inertia.mass,
            baseCollisionShapeIndex=shapes[0],
            basePosition=(0.0, 0.0, _FAR),
            linkMasses=[WEIGHTLESS.mass] * n,
            linkCollisionShapeIndices=shapes[1:],
            linkVisualShapeIndices=[-1] * n,
            linkPositions=origin,
            linkOrientations=upright,
            linkInertialFramePositions=origin,
            linkInertialFrameOrientations=upright,
            linkParentIndices=[0] * n,
            linkJointTypes=[p.JOINT_FIXED] * n,
            linkJointAxis=[(0.0, 0.0, 1.0)] * n,
        )
        p.changeDynamics(body, -1, localInertiaDiagonal=self._inertia.moments)
        return body

    def _shape(self, shapes: Sequence[Shape]) -> int:
        """Make a collision shape: a hull, or primitives.

        Bullet inflates a hull by a margin of 1 mm against anything round, and removes it from the base of a body only.
        Bodies share the shape, so one body that is made for that alone removes the margin for all.
        """
        p = self._p
        if is_hull(shapes):
            corners = vertices(shapes[0]).tolist()
            index = p.createCollisionShape(
                p.GEOM_MESH, vertices=corners, flags=_GEOM_INITIALIZE_SAT_FEATURES
            )
            alone = p.createMultiBody(0.0, index)
            p.changeDynamics(alone, -1, collisionMargin=0.0)
            p.removeBody(alone)
            return index
        kinds = {
            "box": p.GEOM_BOX,
            "sphere": p.GEOM_SPHERE,
            "capsule": p.GEOM_CAPSULE,
            "cylinder": p.GEOM_CYLINDER,
        }
        sizes = [(*shape.geometry.size, 0.0, 0.0)[:3] for shape in shapes]
        rotations = [Rotation.from_matrix(shape.T_body_shape[:3, :3]) for shape in shapes]
        return p.createCollisionShapeArray(
            shapeTypes=[kinds[shape.geometry.kind] for shape in shapes],
            halfExtents=sizes,
            radii=[size[0] for size in sizes],
            lengths=[2.0 * size[1] for size in sizes],
            collisionFramePositions=[shape.T_body_shape[:3, 3].tolist() for shape in shapes],
            collisionFrameOrientations=[rotation.as_quat().tolist() for rotation in rotations],
            flags=[_GEOM_INITIALIZE_SAT_FEATURES] * len(shapes),
        )

    def _remove_defaults(self, body: int, link: int, shapes: Sequence[Shape]) -> None:
        """Remove the damping, sleep and margins that Bullet gives every link."""
        p = self._p
        p.changeDynamics(
            body,
            link,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING,
        )
        if is_hull(shapes):
            p.changeDynamics(body, link, collisionMargin=0.0)

    def _add_table(self) -> int:
        """Add the table. The object, fingertips and other links touch one each, so that each pair has its friction."""
        p = self._p
        table = self._scene.table
        shape = p.createCollisionShape(
            p.GEOM_BOX, halfExtents=table.half_size, flags=_GEOM_INITIALIZE_SAT_FEATURES
        )
        place = (*table.center, -table.half_size[2])
        body = p.createMultiBody(0.0, shape, basePosition=place)
        self._remove_defaults(body, -1, ())
        return body

    def _set_collision_pairs(self) -> None:
        def allow(body: int, link: int, other: int, other_link: int, yes: bool) -> None:
            self._p.setCollisionFilterPair(body, other, link, other_link, int(yes))

        excluded = self._scene.robot.table_exclude
        for piece in self._pieces_of_object:
            allow(self._object, piece, self._table, -1, True)
            allow(self._object, piece, self._table_of_tips, -1, False)
            allow(self._object, piece, self._table_of_links, -1, False)
        for link, part in enumerate(self._parts):
            on_table = part.link not in excluded and not part.bare
            is_tip = part.owner != OTHER_LINK
            allow(self._robot, link, self._table, -1, False)
            allow(self._robot, link, self._table_of_tips, -1, on_table and is_tip)
            allow(self._robot, link, self._table_of_links, -1, on_table and not is_tip)
            for piece in self._pieces_of_object:
                allow(self._robot, link, self._object, piece, not part.bare)
            for other, other_part in enumerate(self._parts[:link]):
                allow(self._robot, link, self._robot, other, self._may_touch(part, other_part))

    def _may_touch(self, part: Part, other: Part) -> bool:
        """Return whether two parts of the robot touch: of two links, the rougher one and the bare copy of the other."""
        if part.bare == other.bare or not self._mechanism.may_collide(part.link, other.link):
            return False
        rough = other if part.bare else part
        bare = part if part.bare else other
        rough_is_tip = rough.owner != OTHER_LINK
        bare_is_tip = bare.owner != OTHER_LINK
        if rough_is_tip != bare_is_tip:
            return rough_is_tip == self._tips_are_rougher
        return rough.link < bare.link


class PybulletBackend(PoolBackend):
    """N worlds of Bullet."""

    name = "pybullet"
    capabilities = frozenset(get_args(Capability))
    world_class = PybulletWorld

    @classmethod
    def engine_version(cls) -> str:
        _engine()
        return version("pybullet")


# Bullet's conventions -------------------------------------------------------------------------------------------------


class _Client:
    """PyBullet's functions and constants, bound to a simulation of its own."""

    def __init__(self) -> None:
        self._engine = _engine()
        self._number = self._engine.connect(self._engine.DIRECT)
        if self._number < 0:
            raise XResetError(
                "PyBullet has no more client slots in this process. Use more workers, or close backends that are done."
            )

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._engine, name)
        if callable(value):
            value = partial(value, physicsClientId=self._number)
        setattr(self, name, value)
        return value


def _xyzw(q: Sequence[float] | np.ndarray) -> tuple[float, float, float, float]:
    return (q[1], q[2], q[3], q[0])


def _wxyz(q: Sequence[float]) -> np.ndarray:
    return np.array((q[3], q[0], q[1], q[2]))


@cache
def _engine() -> Any:
    """Return the module ``pybullet``; ``BackendUnavailableError`` if it cannot be imported."""
    try:
        with silence():  # it prints its build time
            import pybullet
    except ImportError as error:
        if sys.version_info[:2] > _NEWEST_PYTHON:
            here = ".".join(map(str, sys.version_info[:2]))
            newest = ".".join(map(str, _NEWEST_PYTHON))
            raise BackendUnavailableError(
                f"PyBullet has no wheel for Python {here}. Use Python {newest}, or another engine."
            ) from error
        raise unavailable("pybullet", "'xreset[pybullet]'", error) from error
    return pybullet
