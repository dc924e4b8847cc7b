"""Measure the physical properties of an engine through its interface, by short experiments.

No experiment depends on the engine, so plugins and altered engines are measured in the same way. Properties that
``xreset engines check`` tests, such as masses and the absence of delays, are not measured again. Gravity is off except
where an object rests on the table.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation
from torch import Tensor

from xreset.backends.conformance.harness import Worlds, free_place
from xreset.backends.conformance.scene import shape, solid
from xreset.errors import XResetError
from xreset.eval.rollout import Engine
from xreset.files.checks import frozen
from xreset.geometry.dynamics import drive_values, mass_matrix
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import hull, perpendicular, transformed
from xreset.geometry.urdf import joint_limits, link_meshes
from xreset.geometry.urdf_writer import axes
from xreset.physics import State
from xreset.spec import GRAVITY, ObjectSpec, SceneSpec, Shape


@frozen
class Measured:
    """Measured properties of an engine. A share of 1 means that the engine does what the scene states."""

    tip_friction: float
    """Pair friction of object and fingertip."""
    link_friction: float
    """Pair friction of object and another link."""
    table_friction: float
    """Pair friction of object and table."""
    torsional_friction: float
    """Torsional friction of object and table that touch in one point [m]; NaN if it stops the object at once."""
    arm_stiffness: float
    """Share of kp, median over the arm's joints."""
    arm_damping: float
    """Share of kd, median over the arm's joints."""
    hand_stiffness: float
    """Share of kp, median over the hand's joints."""
    hand_damping: float
    """Share of kd, median over the hand's joints."""
    timestep: float
    """Step with which motion is integrated [s]."""


_SLAB_HALF = (0.06, 0.06, 0.02)
"""Half sizes of the slab and of the paddle [m]."""
_SLAB_MASS = 0.5
"""[kg]"""
_SPEED = 0.5
"""Speed of the slab at the start [m/s]."""
_PRESS = 3.0
"""Force of the paddle on a link [N]."""
_PULL = 3.0
"""Pull along the link, as a factor on the force that friction should carry."""
_STEP = 0.03
"""Step of a drive's target [rad, m]; it is smaller where it would need more than two fifths of the drive's effort."""
_SETTLE = 0.25
"""Time before the pulls begin [s]."""
_TIME = 0.40
"""Duration of every experiment [s]."""
_PULL_WINDOW = (0.05, 0.12)
"""Time after the begin of the pull in which impulses are measured [s]."""
_PUSH_STEPS = 24
"""Physics steps of constant force on the free object."""
_TOP_HEIGHT = 0.04
"""Height of the top, a cone on its point [m]."""
_TOP_RADIUS = 0.02
"""[m]"""
_DIRECTIONS = 400
"""Directions in which links are looked for that a paddle can press on."""
_TOP_INERTIA = (1.0, 1.0, 1e-3)
"""Moments of inertia of the top [kg m^2]: it can hardly fall, and spins easily."""

_SLAB = 0
_PADDLE = 1
_THING = 2
_TOP = 3
_WORLDS = {
    "slide": _SLAB,
    "spin": _TOP,
    "tip": _PADDLE,
    "link": _PADDLE,
    "force": _THING,
    "drives": _THING,
}
"""Experiment -> index of its object; one world each."""
_AT = {name: i for i, name in enumerate(_WORLDS)}


def measure(engine: Engine, scene: SceneSpec) -> Measured:
    """Measure an engine with these experiments:

    - A slab slides over the table from 0.5 m/s. Its path d gives the friction, (v0^2 - v1^2) / (2 g (d + v0 h / 2)),
      with h the step of the integration. The deceleration would not do, because MuJoCo's contacts lift a sliding object
      again and again.
    - A top that can hardly fall spins on its point. Its loss of spin dw gives the torsional friction, I dw / int(N) dt.
      The impulse of the load N follows from the momentum, because contacts may come and go.
    - A paddle that can hardly turn is pressed with 3 N onto a fingertip, and another onto the farthest other link. Then
      it is pulled sideways with three times the force that friction should carry. The friction is the impulse of the
      link on the paddle along its face, divided by the impulse across it.
    - A constant force pushes the free object. Its distance x = a t (t + h) / 2 and velocity a t give the step h of the
      integration.
    - Every drive gets a small step of its target q*. The fit of M v = kp int(q* - q) dt - kd (q - q0) over the response
      gives kp and kd. An integrator's numerical damping counts as damping.

    Args:
        engine: engine to measure.
        scene: robot, friction, timestep, and the object that is pushed: the first.

    Raises:
        XResetError: a state is not finite, or a paddle cannot reach a link.
    """
    experiments = _Experiments(scene)
    objects = torch.tensor(list(_WORLDS.values()))
    with engine.make(experiments.scene, len(objects), objects) as backend:
        return experiments.measured(experiments.run(Worlds(backend)))


class _Experiments:
    """All experiments, each in a world of its own."""

    def __init__(self, scene: SceneSpec) -> None:
        self._robot = scene.robot
        half = np.square(_SLAB_HALF)
        slab = _solid("slab", shape("box", _SLAB_HALF), _SLAB_MASS / 3 * (half.sum() - half))
        paddle = _solid("paddle", shape("box", _SLAB_HALF), (1.0, 1.0, 1.0))
        angle = np.arange(8) * np.pi / 4
        rim = np.full((8, 3), _TOP_HEIGHT)
        rim[:, 0] = _TOP_RADIUS * np.cos(angle)
        rim[:, 1] = _TOP_RADIUS * np.sin(angle)
        top = _solid("top", hull(np.concatenate((np.zeros((1, 3)), rim))), _TOP_INERTIA)
        self.scene = replace(scene, objects=(slab, paddle, scene.objects[0], top))
        self._dt = scene.timestep
        self._place = free_place(scene)
        self._push = 2.0 * scene.objects[0].mass  # [N] for 2 m/s^2
        self._presses = {}
        self._pull = {}
        for link in ("tip", "link"):
            self._presses[link] = _reachable(scene, tip=link == "tip")
            self._pull[link] = _PULL * _PRESS * max(getattr(scene.friction, link), 0.1)
        # Four times the spin [rad/s] that the stated torsional friction takes; not so much that a contact patters.
        torsional = max(scene.friction.torsional, 1e-3)
        self._spin = 4.0 * torsional * _SLAB_MASS * GRAVITY / _TOP_INERTIA[2] * _TIME

    def run(self, worlds: Worlds) -> State:
        """Play all experiments; return states [T, N, ...] after each physics step, the start first."""
        start = self._start()
        grounded = [index in (_SLAB, _TOP) for index in _WORLDS.values()]
        worlds.set_parameter("object_gravity", torch.tensor(grounded))
        worlds.set(start)
        targets = start.joint_target.clone()
        targets[_AT["drives"]] += torch.as_tensor(self._drive_steps())
        states = []
        for step in range(round(_TIME / self._dt)):
            worlds.push(self._loads(step), torch.zeros(3))
            if step % self.scene.substeps == 0:
                worlds.set_targets(targets)
            worlds.step(1)
            states.append(worlds.state())
        log = start.map(lambda *values: torch.stack(values).double(), *states)
        sound = torch.cat(list(vars(log).values()), dim=-1).isfinite().all(-1).all(0)
        broken = [name for name, i in _AT.items() if not sound[i]]
        if broken:
            raise XResetError(
                f"{worlds.backend.name}: the experiments {', '.join(broken)} are not finite. Nothing can be measured."
            )
        return log

    def measured(self, log: State) -> Measured:
        """Return the engine's properties, from the states [T, N, ...] of all experiments."""
        dt = self._dt
        t = _PUSH_STEPS * dt
        row = _AT["force"]
        velocity = float(log.object_linvel[_PUSH_STEPS, row, 0])
        distance = float(log.object_pos[_PUSH_STEPS, row, 0] - log.object_pos[0, row, 0])
        step = 2.0 * distance / velocity - t
        stiffness, damping = self._drives(log)
        arm = self._robot.arm_indices
        hand = self._robot.hand_indices
        return Measured(
            tip_friction=self._pulled(log, "tip"),
            link_friction=self._pulled(log, "link"),
            table_friction=self._slid(log, step),
            torsional_friction=self._torsion(log),
            arm_stiffness=float(np.median(stiffness[arm])),
            arm_damping=float(np.median(damping[arm])),
            hand_stiffness=float(np.median(stiffness[hand])),
            hand_damping=float(np.median(damping[hand])),
            timestep=step,
        )

    def _pulled(self, log: State, name: str) -> float:
        """Return the friction of a paddle, from the link's impulses on it along and across its face."""
        _, normal, along = self._presses[name]
        begin = round((_SETTLE + _PULL_WINDOW[0]) / self._dt)
        end = round((_SETTLE + _PULL_WINDOW[1]) / self._dt)
        velocity = log.object_linvel[:, _AT[name]]
        gained = _SLAB_MASS * (velocity[end] - velocity[begin]).numpy()
        time = (end - begin) * self._dt
        carried = self._pull[name] * time - float(gained @ along)
        pressed = _PRESS * time + float(gained @ normal)  # the press pushes against the normal
        return carried / pressed if pressed > 0.05 * _PRESS * time else float("nan")

    def _slid(self, log: State, step: float) -> float:
        """Return the friction from the path of the slab; step: that of the integration [s]."""
        world = _AT["slide"]
        end = log.object_linvel[-1, world, :2].norm()
        way = (log.object_pos[-1, world, :2] - log.object_pos[0, world, :2]).norm()
        return float((_SPEED**2 - end**2) / (2 * GRAVITY * (way + _SPEED * step / 2)))

    def _torsion(self, log: State) -> float:
        """Return the torsional friction [m] from the spin that a top has lost.

        It is measured while the top has half of its spin; NaN if friction takes that in one step.
        """
        world = _AT["spin"]
        spin = log.object_angvel[:, world, 2]
        steps = int((spin > spin[0] / 2).long().cumprod(0).sum()) - 1
        if steps < 1:
            return float("nan")
        # impulse of the load, divided by the mass
        load = GRAVITY * steps * self._dt + float(log.object_linvel[steps, world, 2])
        return _TOP_INERTIA[2] / _SLAB_MASS * float(spin[0] - spin[steps]) / load

    def _start(self) -> State:
        start = State.initial(self.scene, torch.tensor(list(_WORLDS.values())))
        pos = start.object_pos
        pos[:, :2] = torch.tensor(self._place)
        pos[_AT["slide"], 2] = _SLAB_HALF[2]
        pos[_AT["spin"], 2] = 0.0
        for name in ("force", "drives"):
            pos[_AT[name], 2] = 0.6
        for name, (point, normal, _) in self._presses.items():
            pos[_AT[name]] = torch.as_tensor(point + (_SLAB_HALF[2] + 5e-4) * normal)
            turn = Rotation.from_matrix(axes(x=-perpendicular(normal), z=normal)[:3, :3])
            start.object_quat[_AT[name]] = torch.as_tensor(turn.as_quat(scalar_first=True))
        start.object_linvel[_AT["slide"], 0] = _SPEED
        start.object_angvel[_AT["spin"], 2] = self._spin
        return start

    def _loads(self, step: int) -> Tensor:
        """[N, 3] forces on the objects in a physics step."""
        force = np.zeros((len(_WORLDS), 3))
        late = step * self._dt >= _SETTLE
        for name, (_, normal, along) in self._presses.items():
            force[_AT[name]] = -_PRESS * normal + (self._pull[name] * along if late else 0.0)
        if step < _PUSH_STEPS:
            force[_AT["force"], 0] = self._push
        return torch.as_tensor(force, dtype=torch.float32)

    def _drive_steps(self) -> np.ndarray:
        """[J] change of each target, away from the nearer joint limit."""
        home = self._robot.home
        lower, upper = joint_limits(self._robot)
        effort = drive_values(self._robot, "effort") / drive_values(self._robot, "kp")
        steps = np.minimum(0.4 * effort, 0.2 * (upper - lower)).clip(max=_STEP)
        return np.where(upper - home < home - lower, -steps, steps).astype(np.float32)

    def _drives(self, log: State) -> np.ndarray:
        """[2, J] shares of kp and kd, fitted over the response to a step of the targets."""
        position = log.joint_pos[:, _AT["drives"]].numpy()
        velocity = log.joint_vel[:, _AT["drives"]].numpy()
        armature = np.diag(drive_values(self._robot, "armature"))
        M = mass_matrix(self._robot, self._robot.home) + armature
        loss = drive_values(self._robot, "friction_loss")
        momentum = velocity @ M + np.cumsum(loss * np.sign(velocity), axis=0) * self._dt
        lag = position[0] + self._drive_steps() - position
        pulled = cumulative_trapezoid(lag, dx=self._dt, axis=0, initial=0)
        gains = []
        for j, joint in enumerate(self._robot.joints):
            columns = np.stack((pulled[:, j], position[0, j] - position[:, j]), axis=1)
            fit, *_ = np.linalg.lstsq(columns, momentum[:, j], rcond=None)
            gains.append(fit / (joint.drive.kp, joint.drive.kd))
        return np.transpose(gains)


def _solid(name: str, piece: Shape, inertia: ArrayLike) -> ObjectSpec:
    """Return an object of the slab's mass whose centre of mass is its origin; inertia [3] along the axes."""
    obj = solid(name, _SLAB_MASS, (piece,))
    return replace(obj, com=np.zeros(3), inertia=np.diag(inertia))


def _reachable(scene: SceneSpec, *, tip: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find a point where a free way leads a paddle onto a fingertip (or onto another link) of the robot at home.

    The point is in the one of many directions in which links of this kind stick out farthest beyond the others.

    Returns:
        The point [3], this direction [3], and a direction [3] along the paddle's face.

    Raises:
        XResetError: no link of this kind sticks out.
    """
    robot = scene.robot
    kinematics = Kinematics(robot)
    meshes = link_meshes(robot)
    poses = kinematics.link_poses(kinematics.home, list(meshes)).numpy()
    contact_links = set().union(*(finger.contact_links for finger in robot.fingertips))
    points: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for (name, mesh), T in zip(meshes.items(), poses, strict=True):
        points[name in contact_links].append(transformed(mesh.vertices, T))
    mine = np.concatenate(points[tip])
    others = np.concatenate(points[not tip])
    i = np.arange(_DIRECTIONS) + 0.5  # spread over the sphere in a Fibonacci lattice
    normal_z = 1 - 2 * i / _DIRECTIONS
    angle = np.pi * (1 + np.sqrt(5)) * i
    flat = np.sqrt(1 - normal_z * normal_z)
    normals = np.stack((flat * np.cos(angle), flat * np.sin(angle), normal_z), axis=1)
    reach = mine @ normals.T
    margin = reach.max(axis=0) - (others @ normals.T).max(axis=0)
    below = np.minimum(0.0, 2 * _SLAB_HALF[2] * normals[:, 2])
    tilted = np.hypot(*_SLAB_HALF[:2]) * np.sqrt(np.maximum(0.0, 1 - normals[:, 2] ** 2))
    lowest = mine[reach.argmax(axis=0), 2] + below - tilted
    margin[lowest <= 0.03] = 0.0
    best = margin.argmax()
    if margin[best] <= 0.002:
        what = "fingertip" if tip else "link other than the fingertips"
        raise XResetError(
            f"no {what} of {robot.name!r} at home can be reached from outside, so its friction cannot be measured."
        )
    normal = normals[best]
    along = perpendicular(normal)
    if along[2] < 0:
        along = -along  # away from the table
    return mine[reach[:, best].argmax()], normal, along
