"""Bullet, through PyBullet, on the CPU.

What differs from PyBullet's defaults, and why:

- Gravity is off, and every step applies the object's weight as a force at its centre of mass: the robot is then compensated exactly and
  gravity fractions cost nothing. (A robot without compensation gets its weight from the engine.)
- Drives are torques computed here (``bullet_drives``). PyBullet's own position control holds objects with a wrong force.
- Friction of a pair is the *product* of its bodies' coefficients, and its torsional friction is s_a mu_b + s_b mu_a. With mu = 1 and s = 0
  on the object, the other body's coefficients are the pair's.
- Poses and linear velocities of bodies refer to the centre of mass and the principal axes; they are converted here.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.backends.bullet_drives import BulletDrives
from xreset.backends.bullet_models import WEIGHTLESS, Model, Part, inertial_frame, link_groups, robot_parts, robot_urdf
from xreset.backends.pool import PoolBackend, World, is_finite
from xreset.backends.rigid import (
    Arms,
    Inertia,
    Mechanism,
    TrackedFrames,
    conjugate,
    cross,
    mechanism,
    multiply,
    nearer,
    object_inertia,
    rotate,
)
from xreset.errors import XResetError
from xreset.physics import Capability, unavailable
from xreset.spec import GRAVITY, Geometry, SceneSpec, Shape


@dataclass(frozen=True, kw_only=True)
class PybulletSettings:
    """Bullet's dials."""

    internal_steps: int = 2
    """Bullet steps per physics step. Objects creep in a grasp by 2 mm in 2 s with 2, by 4 mm with 1, which is 1.6 times as fast."""
    solver_iterations: int = 50
    """Sweeps of the contact solver."""
    friction_cone: bool = True
    """Whether friction is limited by a cone instead of a pyramid. Without it objects slide 30 % less far along the pyramid's diagonals, and
    Bullet leaves out torsional friction altogether. Grasps hold equally well with either."""
    mass_matrix_steps: int = 8
    """Bullet steps between two updates of the mass matrix that the drives need."""


_DEFAULTS = PybulletSettings()
_GEOM_INITIALIZE_SAT_FEATURES = 4
"""Bullet's flag of a collision shape, to which PyBullet gives no name: contacts between polyhedra are found on their faces."""
_FAR = 100.0
"""A height [m] where nothing touches the object."""


class PybulletWorld(World):
    """One world of Bullet, in a client of its own."""

    def __init__(self, scene: SceneSpec, object_index: int, *, settings: PybulletSettings = _DEFAULTS) -> None:
        self._arguments = scene, scene.objects[object_index], settings
        self._inertia = object_inertia(scene.objects[object_index])
        self._build()

    def _build(self) -> None:
        scene, thing, settings = self._arguments
        self._mechanism = robot = mechanism(scene.robot)
        self._p = p = _engine()
        self._client = p.connect(p.DIRECT)
        if self._client < 0:
            raise XResetError(
                "PyBullet gives this process no further client. Use more workers, or close backends that are done."
            )
        self._internal_steps = settings.internal_steps
        dt = scene.timestep / settings.internal_steps
        p.setPhysicsEngineParameter(
            fixedTimeStep=dt,
            numSubSteps=0,
            numSolverIterations=settings.solver_iterations,
            enableConeFriction=int(settings.friction_cone),
            deterministicOverlappingPairs=1,  # or a world would depend on what was in it before
            enableSAT=1,  # a hull at rest on a face gets all the contacts of that face, instead of one
            enableFileCaching=0,
            physicsClientId=self._client,
        )
        self._world_gravity = 0.0 if scene.robot.gravity_compensated else -GRAVITY
        p.setGravity(0, 0, self._world_gravity, physicsClientId=self._client)

        with tempfile.TemporaryDirectory(prefix="xreset-") as folder:
            self._robot = self._load_robot(robot, Path(folder))
        self._object = self._load_rigid(link_groups(thing.pieces), self._inertia, (0.0, 0.0, _FAR))
        table = Shape(geometry=Geometry(kind="box", size=scene.table.half_size))
        self._table = self._load_rigid([(table,)], None, (*scene.table.center, -scene.table.half_size[2]))
        for model in (self._robot, self._object, self._table):
            self._remove_defaults(model)
        self._set_collision_pairs()

        self._drives = BulletDrives(p, self._client, self._robot.body, robot, dt, settings.mass_matrix_steps)
        self._frames = TrackedFrames(robot)
        self._arm = Arms(self._inertia.com[None])
        self._from_principal = conjugate(self._inertia.quat)
        self._torsional, self._drive_scale = scene.friction.torsional, None
        self.set_friction(np.array([scene.friction.tip, scene.friction.link, scene.friction.table]))
        self._fresh = True
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._clean = p.saveState(physicsClientId=self._client)

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        if not is_finite(self.get_state()):
            self._rebuild()
        p, client = self._p, self._client
        p.restoreState(self._clean, physicsClientId=client)
        p.performCollisionDetection(
            physicsClientId=client
        )  # with the object far away: what touched it before is forgotten
        self._drives.reset(state["joint_pos"], state["joint_vel"], state["joint_target"])
        self._quat = np.array(state["object_quat"])
        arm = rotate(self._quat, self._inertia.com)
        turn = multiply(self._quat, self._inertia.quat)
        p.resetBasePositionAndOrientation(
            self._object.body, state["object_pos"] + arm, _xyzw(turn), physicsClientId=client
        )
        omega = state["object_angvel"]
        p.resetBaseVelocity(
            self._object.body, state["object_linvel"] + cross(omega, arm), omega, physicsClientId=client
        )
        self._fresh = True

    def get_state(self) -> dict[str, np.ndarray]:
        p, client = self._p, self._client
        com, turn = p.getBasePositionAndOrientation(self._object.body, physicsClientId=client)
        linear, angular = (np.array(v) for v in p.getBaseVelocity(self._object.body, physicsClientId=client))
        self._quat = nearer(multiply(_wxyz(turn), self._from_principal), self._quat)
        arm = self._arm.turned(self._quat)[0]
        position, velocity = self._drives.read()
        return {
            "joint_pos": position[self._drives.driven],
            "joint_vel": velocity[self._drives.driven],
            "joint_target": self._drives.target,
            "object_pos": np.array(com) - arm,
            "object_quat": self._quat,
            "object_linvel": linear - cross(angular, arm),
            "object_angvel": angular,
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._drives.target = targets

    def step(self, n: int) -> None:
        p, client = self._p, self._client
        weight = np.array([0.0, 0.0, self._inertia.mass * (-GRAVITY * self.gravity_fraction - self._world_gravity)])
        force = (weight + self.force).tolist()
        turned = bool(self.torque.any())
        for _ in range(n * self._internal_steps):
            self._drives.apply()
            com, _ = p.getBasePositionAndOrientation(self._object.body, physicsClientId=client)
            p.applyExternalForce(self._object.body, -1, force, com, p.WORLD_FRAME, physicsClientId=client)
            if turned:
                p.applyExternalTorque(self._object.body, -1, self.torque, p.WORLD_FRAME, physicsClientId=client)
            p.stepSimulation(physicsClientId=client)
        self._fresh = False

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        states = self._p.getLinkStates(
            self._robot.body,
            self._frames.bodies,
            computeLinkVelocity=1,
            computeForwardKinematics=1,
            physicsClientId=self._client,
        )
        rows = np.array([state[4] + state[5] + state[6] + state[7] for state in states])
        return self._frames.locate(rows[:, :3], rows[:, [6, 3, 4, 5]], rows[:, 7:10], rows[:, 10:])

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.contacts`: of the last internal step."""
        tips = len(self._mechanism.robot.fingertips)
        tip_force, tip_touch, table_force = np.zeros((tips, 3)), np.zeros(tips, dtype=bool), np.zeros(3)
        if self._fresh:
            return tip_force, tip_touch, table_force
        for contact in self._p.getContactPoints(physicsClientId=self._client):
            # Bullet's own order of the two bodies: when asked for a body, PyBullet swaps them and the normal, but not the friction.
            bodies, links = contact[1:3], contact[3:5]
            if self._object.body not in bodies:
                continue
            other = 1 if bodies[0] == self._object.body else 0
            force = _force_on_first(contact) if other == 1 else -_force_on_first(contact)
            if bodies[other] == self._table.body:
                table_force += force
            elif (tip := self._robot.parts[links[other]].tip) is not None and contact[9] > 0:
                tip_force[tip] += force
                tip_touch[tip] = True
        return tip_force, tip_touch, table_force

    def mass_properties(self) -> list[Inertia]:
        """See :meth:`World.mass_properties`. The object is loaded in the frame of its inertia."""
        moving = [(self._robot.body, link) for link in range(1, len(self._mechanism.bodies))]
        infos = [
            self._p.getDynamicsInfo(*place, physicsClientId=self._client)
            for place in (*moving, (self._object.body, -1))
        ]
        found = [Inertia(mass=i[0], com=np.array(i[3]), quat=_wxyz(i[4]), moments=np.array(i[2])) for i in infos]
        thing, own = found[-1], self._inertia
        in_mesh = replace(thing, com=own.com + rotate(own.quat, thing.com), quat=multiply(own.quat, thing.quat))
        return [*found[:-1], in_mesh]

    def set_object_inertia(self, inertia: Inertia) -> None:
        """See :meth:`World.set_object_inertia`. Bullet's bodies have their origin at the centre of mass: with another, all is made anew."""
        moved, self._inertia = not np.array_equal(inertia.com, self._inertia.com), inertia
        if moved:
            state = self.get_state()
            self._rebuild()
            self.set_state(state)
        else:
            self._p.changeDynamics(
                self._object.body, -1, mass=inertia.mass, physicsClientId=self._client
            )  # also invents an inertia
            self._p.changeDynamics(
                self._object.body, -1, localInertiaDiagonal=inertia.moments, physicsClientId=self._client
            )

    def set_friction(self, friction: np.ndarray) -> None:
        self._friction = friction
        tip, link, table = (float(mu) for mu in friction)
        self._set_surface(self._object, {None: 1.0}, torsional=0.0)
        self._set_surface(self._table, {None: table}, torsional=self._torsional)
        self._set_surface(
            self._robot,
            {None: link} | dict.fromkeys(range(len(self._mechanism.robot.fingertips)), tip),
            self._torsional,
        )

    def set_torsional_friction(self, torsional: float) -> None:
        self._torsional = torsional
        self.set_friction(self._friction)

    def set_drives(self, scale: np.ndarray) -> None:
        self._drive_scale = scale
        self._drives.scale(scale.astype(np.float64))

    def close(self) -> None:
        if self._client >= 0:
            self._p.disconnect(physicsClientId=self._client)
            self._client = -1

    def _rebuild(self) -> None:
        """Begin with a new client: in Bullet's broad phase, numbers that are not finite stay, and the body touches nothing any more."""
        drives, friction, torsional = self._drive_scale, self._friction, self._torsional
        self.close()
        self._build()
        self._torsional = torsional
        self.set_friction(friction)
        if drives is not None:
            self.set_drives(drives)

    # Building ---------------------------------------------------------------------------------------------------------

    def _load_robot(self, robot: Mechanism, folder: Path) -> Model:
        parts = robot_parts(robot)
        spec = robot.robot
        body = self._load(robot_urdf(robot, parts, folder), pos=spec.base_pos, quat=spec.base_quat, fixed=True)
        return Model(body, 0, parts)

    def _load_rigid(
        self, groups: list[tuple[Shape, ...]], inertia: Inertia | None, pos: tuple[float, float, float]
    ) -> Model:
        """Make a single body, in the frame of its inertia; fixed if it has none. Its further groups are links without mass to speak of."""
        p = self._p
        T = np.eye(4) if inertia is None else np.linalg.inv(inertial_frame(inertia))
        base, *others = [
            self._shape([replace(shape, T_body_shape=T @ shape.T_body_shape) for shape in group]) for group in groups
        ]
        n, still, upright = len(others), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
        body = p.createMultiBody(
            baseMass=0.0 if inertia is None else inertia.mass,
            baseCollisionShapeIndex=base,
            basePosition=pos,
            linkMasses=[WEIGHTLESS.mass] * n,
            linkCollisionShapeIndices=others,
            linkVisualShapeIndices=[-1] * n,
            linkPositions=[still] * n,
            linkOrientations=[upright] * n,
            linkInertialFramePositions=[still] * n,
            linkInertialFrameOrientations=[upright] * n,
            linkParentIndices=[0] * n,
            linkJointTypes=[p.JOINT_FIXED] * n,
            linkJointAxis=[(0.0, 0.0, 1.0)] * n,
            physicsClientId=self._client,
        )
        if inertia is not None:
            p.changeDynamics(body, -1, localInertiaDiagonal=inertia.moments, physicsClientId=self._client)
        return Model(body, -1, [Part(body=0, link="", shapes=group) for group in groups])

    def _shape(self, shapes: Sequence[Shape]) -> int:
        """A collision shape: a hull, or primitives.

        Bullet inflates a hull by a margin of 1 mm against anything round, and takes it away from the base of a body only. But bodies share
        the shape, so one that is made for that alone does for all.
        """
        p, client = self._p, self._client
        if shapes[0].geometry.vertices is not None:
            (shape,) = shapes
            vertices = (shape.geometry.vertices @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3]).tolist()
            index = p.createCollisionShape(
                p.GEOM_MESH, vertices=vertices, flags=_GEOM_INITIALIZE_SAT_FEATURES, physicsClientId=client
            )
            alone = p.createMultiBody(0.0, index, physicsClientId=client)
            p.changeDynamics(alone, -1, collisionMargin=0.0, physicsClientId=client)
            p.removeBody(alone, physicsClientId=client)
            return index
        kinds = {"box": p.GEOM_BOX, "sphere": p.GEOM_SPHERE, "capsule": p.GEOM_CAPSULE, "cylinder": p.GEOM_CYLINDER}
        sizes = [(*shape.geometry.size, 0.0, 0.0)[:3] for shape in shapes]
        return p.createCollisionShapeArray(
            shapeTypes=[kinds[shape.geometry.kind] for shape in shapes],
            halfExtents=sizes,
            radii=[size[0] for size in sizes],
            lengths=[2.0 * size[1] for size in sizes],
            collisionFramePositions=[shape.T_body_shape[:3, 3].tolist() for shape in shapes],
            collisionFrameOrientations=[
                Rotation.from_matrix(shape.T_body_shape[:3, :3]).as_quat().tolist() for shape in shapes
            ],
            flags=[_GEOM_INITIALIZE_SAT_FEATURES] * len(shapes),
            physicsClientId=client,
        )

    def _load(self, urdf: Path, *, pos: Sequence[float], quat: Sequence[float], fixed: bool) -> int:
        p = self._p
        return p.loadURDF(
            str(urdf),
            basePosition=pos,
            baseOrientation=_xyzw(quat),
            useFixedBase=fixed,
            flags=p.URDF_USE_INERTIA_FROM_FILE
            | p.URDF_USE_SELF_COLLISION
            | p.URDF_MAINTAIN_LINK_ORDER
            | p.URDF_USE_IMPLICIT_CYLINDER
            | p.URDF_INITIALIZE_SAT_FEATURES,
            physicsClientId=self._client,
        )

    def _remove_defaults(self, model: Model) -> None:
        """Take away the damping, sleep and margins that Bullet gives every link."""
        p, client = self._p, self._client
        for link, part in model.links:
            p.changeDynamics(
                model.body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, physicsClientId=client
            )
            p.changeDynamics(
                model.body, link, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client
            )
            if part.is_hull:
                p.changeDynamics(model.body, link, collisionMargin=0.0, physicsClientId=client)

    def _set_surface(self, model: Model, lateral: Mapping[int | None, float], torsional: float) -> None:
        """Set friction by the fingertip that a part belongs to."""
        for link, part in model.links:
            mu = lateral[part.tip]
            self._p.changeDynamics(
                model.body, link, lateralFriction=mu, spinningFriction=torsional, physicsClientId=self._client
            )

    def _set_collision_pairs(self) -> None:
        def allow(a: Model, link_a: int, b: Model, link_b: int, yes: bool) -> None:
            self._p.setCollisionFilterPair(a.body, b.body, link_a, link_b, int(yes), physicsClientId=self._client)

        robot = self._mechanism
        for piece, _ in self._object.links:
            allow(self._object, piece, self._table, -1, True)
        for link, part in self._robot.links:
            allow(self._robot, link, self._table, -1, part.link not in robot.robot.table_exclude)
            for piece, _ in self._object.links:
                allow(self._robot, link, self._object, piece, True)
            for other, other_part in self._robot.links[:link]:
                allow(self._robot, link, self._robot, other, robot.may_collide(part.link, other_part.link))


class PybulletBackend(PoolBackend):
    """N worlds of Bullet; the keyword ``settings`` takes :class:`PybulletSettings`."""

    name = "pybullet"
    capabilities = frozenset(get_args(Capability))
    world_class = PybulletWorld

    @classmethod
    def engine_version(cls) -> str:
        _engine()
        return version("pybullet")


# Bullet's habits ------------------------------------------------------------------------------------------------------


def _xyzw(q: Sequence[float] | np.ndarray) -> tuple[float, float, float, float]:
    return (q[1], q[2], q[3], q[0])


def _wxyz(q: Sequence[float]) -> np.ndarray:
    return np.array((q[3], q[0], q[1], q[2]))


def _force_on_first(contact: Sequence[Any]) -> np.ndarray:
    """[3] force of a contact point on the first of its two bodies."""
    normal, force, side, along, other_side, other = (
        contact[7],
        contact[9],
        contact[10],
        contact[11],
        contact[12],
        contact[13],
    )
    return force * np.array(normal) + side * np.array(along) + other_side * np.array(other)


def _engine() -> Any:
    """The module ``pybullet``; ``BackendUnavailableError`` if it cannot be imported."""
    try:
        with _silent():
            import pybullet
    except ImportError as error:
        raise unavailable("pybullet", "'xreset[pybullet]'", error) from error
    return pybullet


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Swallow what C code prints: PyBullet announces its build time whenever it is imported."""
    saved = [(stream, os.dup(stream)) for stream in (1, 2)]
    with open(os.devnull, "w") as nowhere:
        for stream, _ in saved:
            os.dup2(nowhere.fileno(), stream)
    try:
        yield
    finally:
        for stream, copy in saved:
            os.dup2(copy, stream)
            os.close(copy)
