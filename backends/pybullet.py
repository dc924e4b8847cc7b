"""Bullet, through PyBullet, on the CPU.

What differs from PyBullet's defaults, and why:

- Gravity is off, and every step applies the object's weight as a force at its centre of mass: the robot is then compensated exactly and
  gravity fractions cost nothing. (A robot without compensation gets its weight from the engine.)
- Drives are torques computed here (:class:`_Drives`). PyBullet's own position control holds objects with a wrong force.
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


class PybulletWorld(World):
    """One world of Bullet, in a client of its own."""

    def __init__(self, scene: SceneSpec, object_index: int, *, settings: PybulletSettings = _DEFAULTS) -> None:
        self._arguments = scene, object_index, settings
        self._com_offset = np.zeros(3)
        self._build()

    def _build(self) -> None:
        scene, object_index, settings = self._arguments
        self._mechanism = robot = mechanism(scene.robot)
        thing = scene.objects[object_index]
        self._inertia = object_inertia(thing)
        self._inertia = replace(self._inertia, com=self._inertia.com + self._com_offset)
        self._p = p = _engine()
        self._client = p.connect(p.DIRECT)
        if self._client < 0:
            raise XResetError("PyBullet gives this process no further client. Use more workers, or close backends that are done.")
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
            self._object = self._load_rigid(_groups(thing.pieces), self._inertia, (0.0, 0.0, _FAR), Path(folder))
            table = Shape(geometry=Geometry(kind="box", size=scene.table.half_size))
            self._table = self._load_rigid([(table,)], None, (*scene.table.center, -scene.table.half_size[2]), Path(folder))
        for model in (self._robot, self._object, self._table):
            self._remove_defaults(model)
        self._set_collision_pairs()

        self._drives = _Drives(p, self._client, self._robot.body, robot, dt, settings)
        self._frames = TrackedFrames(robot)
        self._arm = Arms(self._inertia.com[None])
        self._from_principal = conjugate(self._inertia.quat)
        self._mass, self._inertia_scale, self._fraction = self._inertia.mass, 1.0, 1.0
        self._force, self._torque = np.zeros(3), np.zeros(3)
        self._torsional, self._drive_scale = scene.friction.torsional, None
        self.set_friction(np.array([scene.friction.tip, scene.friction.link, scene.friction.table]))
        self._fresh = True
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._clean = p.saveState(physicsClientId=self._client)

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """See :meth:`World.set_state`."""
        if not is_finite(self.get_state()):
            self._rebuild()
        p, client = self._p, self._client
        p.restoreState(self._clean, physicsClientId=client)
        p.performCollisionDetection(physicsClientId=client)  # with the object far away: what touched it before is forgotten
        self._drives.reset(state["joint_pos"], state["joint_vel"], state["joint_target"])
        self._quat = np.array(state["object_quat"])
        arm = rotate(self._quat, self._inertia.com)
        turn = multiply(self._quat, self._inertia.quat)
        p.resetBasePositionAndOrientation(self._object.body, state["object_pos"] + arm, _xyzw(turn), physicsClientId=client)
        omega = state["object_angvel"]
        p.resetBaseVelocity(self._object.body, state["object_linvel"] + cross(omega, arm), omega, physicsClientId=client)
        self._force, self._torque = np.zeros(3), np.zeros(3)
        self._fresh = True

    def get_state(self) -> dict[str, np.ndarray]:
        """See :meth:`World.get_state`."""
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
        """See :meth:`World.set_joint_targets`."""
        self._drives.target = targets

    def step(self, n: int) -> None:
        """See :meth:`World.step`."""
        p, client = self._p, self._client
        weight = np.array([0.0, 0.0, self._mass * (-GRAVITY * self._fraction - self._world_gravity)])
        force = (weight + self._force).tolist()
        turned = bool(self._torque.any())
        for _ in range(n * self._internal_steps):
            self._drives.apply()
            com, _ = p.getBasePositionAndOrientation(self._object.body, physicsClientId=client)
            p.applyExternalForce(self._object.body, -1, force, com, p.WORLD_FRAME, physicsClientId=client)
            if turned:
                p.applyExternalTorque(self._object.body, -1, self._torque, p.WORLD_FRAME, physicsClientId=client)
            p.stepSimulation(physicsClientId=client)
        self._fresh = False

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.links`."""
        states = self._p.getLinkStates(
            self._robot.body, self._frames.bodies, computeLinkVelocity=1, computeForwardKinematics=1, physicsClientId=self._client
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

    def health(self, state: Mapping[str, np.ndarray]) -> tuple[bool, bool]:
        """See :meth:`World.health`. Bullet allocates contacts as it needs them: none is ever dropped."""
        return not is_finite(state), False

    def mass_properties(self) -> list[Inertia]:
        """See :meth:`World.mass_properties`. The object is loaded in the frame of its inertia."""
        moving = [(self._robot.body, link) for link in range(1, len(self._mechanism.bodies))]
        infos = [self._p.getDynamicsInfo(*place, physicsClientId=self._client) for place in (*moving, (self._object.body, -1))]
        found = [Inertia(mass=i[0], com=np.array(i[3]), quat=_wxyz(i[4]), moments=np.array(i[2])) for i in infos]
        thing, own = found[-1], self._inertia
        in_mesh = replace(thing, com=own.com + rotate(own.quat, thing.com), quat=multiply(own.quat, thing.quat))
        return [*found[:-1], in_mesh]

    def set_object_mass(self, mass: float) -> None:
        """See :meth:`World.set_object_mass`."""
        self._mass = mass
        self._p.changeDynamics(self._object.body, -1, mass=mass, physicsClientId=self._client)  # also invents an inertia
        self.set_object_inertia(self._inertia_scale)

    def set_object_inertia(self, scale: float) -> None:
        """See :meth:`World.set_object_inertia`."""
        self._inertia_scale = scale
        moments = self._inertia.moments * (scale * self._mass / self._inertia.mass)
        self._p.changeDynamics(self._object.body, -1, localInertiaDiagonal=moments, physicsClientId=self._client)

    def set_object_com(self, offset: np.ndarray) -> None:
        """See :meth:`World.set_object_com`. Bullet's bodies have their origin there, so the object is made anew."""
        if not np.array_equal(offset, self._com_offset):
            state = self.get_state()
            self._com_offset = offset
            self._rebuild()
            self.set_state(state)

    def set_friction(self, friction: np.ndarray) -> None:
        """See :meth:`World.set_friction`."""
        self._friction = friction
        tip, link, table = (float(mu) for mu in friction)
        self._set_surface(self._object, {None: 1.0}, torsional=0.0)
        self._set_surface(self._table, {None: table}, torsional=self._torsional)
        self._set_surface(self._robot, {None: link} | dict.fromkeys(range(len(self._mechanism.robot.fingertips)), tip), self._torsional)

    def set_torsional_friction(self, torsional: float) -> None:
        """See :meth:`World.set_torsional_friction`."""
        self._torsional = torsional
        self.set_friction(self._friction)

    def set_object_gravity(self, fraction: float) -> None:
        """See :meth:`World.set_object_gravity`."""
        self._fraction = fraction

    def set_drives(self, scale: np.ndarray) -> None:
        """See :meth:`World.set_drives`."""
        self._drive_scale = scale
        self._drives.scale(scale.astype(np.float64))

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        """See :meth:`World.set_object_wrench`."""
        self._force, self._torque = force, torque

    def close(self) -> None:
        """See :meth:`World.close`."""
        if self._client >= 0:
            self._p.disconnect(physicsClientId=self._client)
            self._client = -1

    def _rebuild(self) -> None:
        """Begin with a new client: in Bullet's broad phase, numbers that are not finite stay, and the body touches nothing any more."""
        mass, inertia, fraction, drives = self._mass, self._inertia_scale, self._fraction, self._drive_scale
        friction, torsional = self._friction, self._torsional
        self.close()
        self._build()
        self._inertia_scale, self._torsional = inertia, torsional
        self.set_object_mass(mass)
        self.set_friction(friction)
        self.set_object_gravity(fraction)
        if drives is not None:
            self.set_drives(drives)

    # Building ----------------------------------------------------------------------------------------------------------------------------

    def _load_robot(self, robot: Mechanism, folder: Path) -> _Model:
        parts = _robot_parts(robot)
        spec = robot.robot
        body = self._load(_robot_urdf(robot, parts, folder), pos=spec.base_pos, quat=spec.base_quat, fixed=True)
        return _Model(body, 0, parts)

    def _load_rigid(
        self, groups: list[tuple[Shape, ...]], inertia: Inertia | None, pos: tuple[float, float, float], folder: Path
    ) -> _Model:
        """Load a single body, in the frame of its inertia; fixed if it has none."""
        if inertia is not None:
            T = np.linalg.inv(_inertial_frame(inertia))
            groups = [tuple(replace(shape, T_body_shape=T @ shape.T_body_shape) for shape in group) for group in groups]
        parts = [_Part(body=0, link="", shapes=group) for group in groups]
        urdf = _rigid_urdf(parts, inertia or _WEIGHTLESS, folder)
        return _Model(self._load(urdf, pos=pos, quat=(1.0, 0.0, 0.0, 0.0), fixed=inertia is None), -1, parts)

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

    def _remove_defaults(self, model: _Model) -> None:
        """Take away the damping, sleep and margins that Bullet gives every link."""
        p, client = self._p, self._client
        for link, part in model.links:
            p.changeDynamics(model.body, link, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, physicsClientId=client)
            p.changeDynamics(model.body, link, activationState=p.ACTIVATION_STATE_DISABLE_SLEEPING, physicsClientId=client)
            if part.is_hull:
                p.changeDynamics(model.body, link, collisionMargin=0.0, physicsClientId=client)

    def _set_surface(self, model: _Model, lateral: Mapping[int | None, float], torsional: float) -> None:
        """Set friction by the fingertip that a part belongs to."""
        for link, part in model.links:
            mu = lateral[part.tip]
            self._p.changeDynamics(model.body, link, lateralFriction=mu, spinningFriction=torsional, physicsClientId=self._client)

    def _set_collision_pairs(self) -> None:
        def allow(a: _Model, link_a: int, b: _Model, link_b: int, yes: bool) -> None:
            self._p.setCollisionFilterPair(a.body, b.body, link_a, link_b, int(yes), physicsClientId=self._client)

        robot = self._mechanism
        for piece, _ in self._object.links:
            allow(self._object, piece, self._table, -1, True)
            for other in range(-1, piece):
                allow(self._object, piece, self._object, other, False)
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
        """See :meth:`Backend.engine_version`."""
        _engine()
        return version("pybullet")


# Drives ----------------------------------------------------------------------------------------------------------------------------------


class _Drives:
    """Joint torques: PD drives with effort limits, armature, dry friction and mimic couplings.

    Arrays are over the D moving joints in the order of the bodies, which is Bullet's link order. With M the mass matrix and c the Coriolis
    torque, drives that have armature A and are implicit in their damping give the acceleration a = (M + B)^-1 (tau - c), where tau is the
    PD torque and B = diag(A + dt kd). Bullet integrates a = M^-1 (tau' - c), so it does the same when given tau' = tau - B a. Mimic joints
    are coupled by a stiff spring and damper, which add J^T (dt^2 k + dt b) J to B.

    In contact that alone is wrong: a held joint does not move with a, and would lack the torque B a. So the torque r of contacts and limits
    in the last step, seen as r = M dv / dt - (tau' - c), is expected again: a = (M + B)^-1 (tau - c + r). A held joint then gets the whole
    of tau, and an impact delivers the momentum of M + B, both after about 1 + B / M steps. That is one or two for ordinary drives; it is
    far too many where B dwarfs M, as with armature on the light links of a hand.
    """

    def __init__(self, engine: Any, client: int, body: int, robot: Mechanism, dt: float, settings: PybulletSettings) -> None:
        self._p, self._client, self._body, self._dt = engine, client, body, dt
        self._mass_matrix_age, self._mass_matrix_steps = 0, settings.mass_matrix_steps
        spec, names = robot.robot, robot.joint_names
        self._links = list(range(1, len(names) + 1))  # link 0 is the base
        self.driven = np.array([names.index(name) for name in spec.joint_names])
        """[J] position of each actuated joint among the moving ones."""
        self.target = spec.home
        """[J] drive targets."""
        self._mimic = np.array([names.index(mimic.joint) for mimic in spec.mimics], dtype=int)
        self._source = np.array([spec.joint_names.index(mimic.source) for mimic in spec.mimics], dtype=int)
        self._multiplier = np.array([mimic.multiplier for mimic in spec.mimics])
        self._offset = np.array([mimic.offset for mimic in spec.mimics])
        drives = [joint.drive for joint in spec.joints]
        self._nominal = np.array([[getattr(drive, field) for drive in drives] for field in ("kp", "kd", "effort")])
        self._kp, self._kd, self._effort = self._nominal
        self._armature, self._loss = (np.array([getattr(drive, field) for drive in drives]) for field in ("armature", "friction_loss"))
        self._brakes = bool(self._loss.any())

        self.reset(spec.home, np.zeros(len(drives)), spec.home)
        M = self._mass_matrix(spec.home)
        self._J = np.zeros((len(self._mimic), len(names)))
        """Rate of each mimic joint's lag behind its source, by joint."""
        rows = np.arange(len(self._mimic))
        self._J[rows, self._mimic] = -1.0
        self._J[rows, self.driven[self._source]] = self._multiplier
        inertia = 1.0 / np.diag(np.linalg.inv(M))[self._mimic]
        self._stiffness, self._damping = inertia / dt**2, 2.0 * inertia / dt  # critically damped, as stiff as one step can feel
        self._coupling = self._J.T @ ((dt**2 * self._stiffness + dt * self._damping)[:, None] * self._J)
        self._M, self._added, self._inverse = M, np.zeros_like(M), np.zeros_like(M)
        self._saturated = np.zeros(0, dtype=bool)

        # Bullet's joints start with a motor that brakes them.
        engine.setJointMotorControlArray(body, self._links, engine.VELOCITY_CONTROL, forces=np.zeros(len(names)), physicsClientId=client)

    def reset(self, position: np.ndarray, velocity: np.ndarray, target: np.ndarray) -> None:
        """Set positions, velocities and targets [J] of the actuated joints; mimic joints follow."""
        q, v = self._all(position, self._offset), self._all(velocity, np.zeros_like(self._offset))
        self._p.resetJointStatesMultiDof(
            self._body, self._links, [[x] for x in q], targetVelocities=[[x] for x in v], physicsClientId=self._client
        )
        self.target = target
        self._mass_matrix_age = 0
        self._last_step: tuple[np.ndarray, np.ndarray] | None = None

    def scale(self, factors: np.ndarray) -> None:
        """Set factors (3, J) on stiffness, damping and effort limit."""
        self._kp, self._kd, self._effort = factors * self._nominal
        self._mass_matrix_age = 0  # what is implicit in the damping has to be factorised anew

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities [D] of all moving joints."""
        states = self._p.getJointStates(self._body, self._links, physicsClientId=self._client)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def apply(self) -> None:
        """Apply the torques of one Bullet step."""
        q, v = self.read()
        dt, driven = self._dt, self.driven
        wanted = self._kp * (self.target - q[driven]) - self._kd * v[driven]
        tau = np.zeros(len(q))
        tau[driven] = np.minimum(np.maximum(wanted, -self._effort), self._effort)  # np.clip takes three times as long
        if len(self._mimic):
            lag = self._multiplier * q[driven[self._source]] + self._offset - q[self._mimic]
            rate = self._J @ v
            tau -= self._J.T @ (self._stiffness * (lag + dt * rate) + self._damping * rate)
        bias = np.array(self._p.calculateInverseDynamics(self._body, q.tolist(), v.tolist(), [0.0] * len(q), physicsClientId=self._client))
        net = tau - bias
        if self._last_step is not None:
            last_velocity, last_net = self._last_step
            net += self._M @ (v - last_velocity) / dt - last_net
        saturated = np.abs(wanted) > self._effort
        if self._mass_matrix_age == 0 or saturated.tobytes() != self._saturated.tobytes():
            self._factorise(q, saturated)
        self._mass_matrix_age = (self._mass_matrix_age + 1) % self._mass_matrix_steps
        if self._brakes:
            stopping = -(v / dt + self._inverse @ net)[driven] / np.diag(self._inverse)[driven]
            brake = np.clip(stopping, -self._loss, self._loss)
            tau[driven] += brake
            net[driven] += brake
        tau -= self._added @ (self._inverse @ net)
        self._last_step = v, tau - bias
        self._p.setJointMotorControlArray(
            self._body, self._links, self._p.TORQUE_CONTROL, forces=tau.tolist(), physicsClientId=self._client
        )

    def _all(self, actuated: np.ndarray, offset: np.ndarray) -> np.ndarray:
        values = np.zeros(len(self._links))
        values[self.driven] = actuated
        values[self._mimic] = self._multiplier * actuated[self._source] + offset
        return values

    def _mass_matrix(self, q: np.ndarray) -> np.ndarray:
        return np.array(self._p.calculateMassMatrix(self._body, q.tolist(), physicsClientId=self._client))

    def _factorise(self, q: np.ndarray, saturated: np.ndarray) -> None:
        """Invert M + B; a drive at its effort limit has no damping left to be implicit in."""
        added = np.zeros(len(q))
        added[self.driven] = self._armature + np.where(saturated, 0.0, self._dt * self._kd)
        self._added = self._coupling + np.diag(added)
        self._M = self._mass_matrix(q)
        self._inverse = np.linalg.inv(self._M + self._added)
        self._saturated = saturated


# Models ----------------------------------------------------------------------------------------------------------------------------------
# Bullet reads URDF files written here from the fused bodies, so every mass and inertia is the one of the other engines.


@dataclass(frozen=True, kw_only=True)
class _Part:
    """A link of a Bullet model: a moving body, or a fixed piece of one."""

    body: int
    """Index of the body that it is (part of)."""
    link: str
    """URDF link whose shapes it has; empty for objects and the table."""
    shapes: tuple[Shape, ...]
    tip: int | None = None
    """Index of the fingertip that it is part of."""

    @property
    def is_hull(self) -> bool:
        """Whether its only shape is a convex hull."""
        return any(shape.geometry.kind == "hull" for shape in self.shapes)


@dataclass(frozen=True)
class _Model:
    """A loaded URDF."""

    body: int
    """Bullet's number of it."""
    first: int
    """Bullet's number of its first part: -1 where that is the root of the URDF."""
    parts: list[_Part]

    @property
    def links(self) -> list[tuple[int, _Part]]:
        """Bullet's link number and description of every part."""
        return list(enumerate(self.parts, start=self.first))


# Bullet inflates a hull by a margin of 1 mm against anything round. The margin can be removed from the base of a body only, and only where
# the base has a single hull in the frame of its inertia; else Bullet wraps the hull, and sets the wrap's margin instead. So objects are
# loaded in the frame of their inertia. What remains inflated: an object's further hulls against round links, and a robot's hulls.


def _groups(shapes: Sequence[Shape]) -> list[tuple[Shape, ...]]:
    """Shapes that may share a Bullet link: the primitives together, every hull alone, for only then can its margin be removed."""
    hulls = [(shape,) for shape in shapes if shape.geometry.kind == "hull"]
    primitives = tuple(shape for shape in shapes if shape.geometry.kind != "hull")
    return [primitives, *hulls] if primitives or not hulls else hulls


def _robot_parts(robot: Mechanism) -> list[_Part]:
    """The base and the moving bodies, then the fixed pieces: so Bullet's link i is body i."""
    moving, fixed = [], []
    for i, body in enumerate(robot.bodies):
        for link in dict.fromkeys((body.name, *(s.link for s in body.shapes))):
            parts = [
                _Part(body=i, link=link, shapes=group, tip=robot.tip_of.get(link))
                for group in _groups([s.shape for s in body.shapes if s.link == link])
            ]
            if link == body.name:
                moving.append(parts.pop(0))
            fixed += parts
    return moving + fixed


_FAR = 100.0
"""A height [m] where nothing touches the object."""

_WEIGHTLESS = Inertia(mass=1e-9, com=np.zeros(3), quat=np.array([1.0, 0, 0, 0]), moments=np.full(3, 1e-14))
"""Of fixed pieces, whose mass is counted in their body: Bullet would invent one for a link without."""


def _robot_urdf(robot: Mechanism, parts: Sequence[_Part], folder: Path) -> Path:
    text = [_link_text("root", _WEIGHTLESS, (), folder)]  # Bullet does not count the root as a link, and tells less about it
    for i, part in enumerate(parts):
        body = robot.bodies[part.body]
        text.append(_link_text(f"link{i}", (body.inertia if i == part.body else None) or _WEIGHTLESS, part.shapes, folder))
        if i == 0 or i != part.body:
            text.append(_fixed_joint_text(i, f"link{part.body}" if i else "root"))
            continue
        joint = body.joint
        limited = np.isfinite(joint.lower) and np.isfinite(joint.upper)
        kind = "prismatic" if joint.type == "prismatic" else "revolute" if limited else "continuous"
        lower, upper = (joint.lower, joint.upper) if limited else (0.0, -1.0)
        text.append(
            f'<joint name="joint{i}" type="{kind}"><parent link="link{body.parent}"/><child link="link{i}"/>'
            f'{_origin(body.T_parent_body)}<axis xyz="{_numbers(joint.axis)}"/>'
            f'<limit lower="{lower!r}" upper="{upper!r}" effort="0" velocity="0"/></joint>'
        )
    return _write(folder / "robot.urdf", text)


def _rigid_urdf(parts: Sequence[_Part], inertia: Inertia, folder: Path) -> Path:
    """Of a body whose shapes are in the frame of its inertia."""
    text, inertia = [], replace(inertia, com=_WEIGHTLESS.com, quat=_WEIGHTLESS.quat)
    for i, part in enumerate(parts):
        text.append(_link_text(f"link{i}", _WEIGHTLESS if i else inertia, part.shapes, folder))
        text.append(_fixed_joint_text(i, "link0") if i else "")
    return _write(folder / "rigid.urdf", text)


def _fixed_joint_text(link: int, parent: str) -> str:
    return f'<joint name="joint{link}" type="fixed"><parent link="{parent}"/><child link="link{link}"/></joint>'


def _write(path: Path, text: Sequence[str]) -> Path:
    path.write_text("\n".join(['<robot name="xreset">', *text, "</robot>"]))
    return path


def _link_text(name: str, inertia: Inertia, shapes: Sequence[Shape], folder: Path) -> str:
    x, y, z = (float(m) for m in inertia.moments)
    text = [
        f'<link name="{name}"><inertial>{_origin(_inertial_frame(inertia))}<mass value="{inertia.mass!r}"/>'
        f'<inertia ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    ]
    for i, shape in enumerate(shapes):
        geometry = _geometry_text(shape, folder / f"{name}_{i}.obj")
        origin = _origin(np.eye(4) if shape.geometry.kind == "hull" else shape.T_body_shape)  # a hull's vertices are moved instead
        text.append(f"<collision>{origin}<geometry>{geometry}</geometry></collision>")
    return "".join([*text, "</link>"])


def _geometry_text(shape: Shape, mesh: Path) -> str:
    geometry = shape.geometry
    if geometry.vertices is not None and geometry.faces is not None:
        vertices = geometry.vertices @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3]
        lines = [f"v {_numbers(v)}" for v in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in geometry.faces]
        mesh.write_text("\n".join(lines) + "\n")
        return f'<mesh filename="{mesh.name}"/>'
    if geometry.kind == "box":
        return f'<box size="{_numbers(2.0 * np.array(geometry.size))}"/>'
    if geometry.kind == "sphere":
        return f'<sphere radius="{geometry.size[0]!r}"/>'
    radius, half = geometry.size
    return f'<{geometry.kind} radius="{radius!r}" length="{2.0 * half!r}"/>'


def _origin(T: np.ndarray) -> str:
    R = T[:3, :3]
    run = float(np.hypot(R[0, 0], R[1, 0]))  # cosine of the pitch: 0 where roll and yaw are one
    roll, yaw = (np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0])) if run > 1e-9 else (np.arctan2(-R[1, 2], R[1, 1]), 0.0)
    return f'<origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers((roll, np.arctan2(-R[2, 0], run), yaw))}"/>'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def _inertial_frame(inertia: Inertia) -> np.ndarray:
    """[4, 4] pose of the centre of mass and the principal axes in the body's frame."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = _matrix(inertia.quat), inertia.com
    return T


def _matrix(quat: np.ndarray) -> np.ndarray:
    return np.stack([rotate(quat, axis) for axis in np.eye(3)], axis=1)


# Bullet's habits ------------------------------------------------------------------------------------------------------------------------


def _xyzw(q: Sequence[float] | np.ndarray) -> tuple[float, float, float, float]:
    return (q[1], q[2], q[3], q[0])


def _wxyz(q: Sequence[float]) -> np.ndarray:
    return np.array((q[3], q[0], q[1], q[2]))


def _force_on_first(contact: Sequence[Any]) -> np.ndarray:
    """[3] force of a contact point on the first of its two bodies."""
    normal, force, side, along, other_side, other = contact[7], contact[9], contact[10], contact[11], contact[12], contact[13]
    return force * np.array(normal) + side * np.array(along) + other_side * np.array(other)


def _engine() -> Any:
    """The module ``pybullet``; ``BackendUnavailableError`` if it cannot be imported."""
    try:
        with _silent():
            import pybullet
    except ImportError as error:
        raise unavailable("pybullet", "pybullet", error) from error
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
