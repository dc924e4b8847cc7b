"""What physics an engine really has, measured through the interface: eight short experiments, all at once, each in a world of its own.

Nothing here knows any engine, so plugins and altered engines are measured alike. Gravity is off except where an object rests on the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from xreset.backends.conformance.harness import free_place
from xreset.backends.conformance.scene import shape, solid
from xreset.errors import XResetError
from xreset.eval.trial import Engine
from xreset.geometry.dynamics import mass_matrix
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_rotate_inverse
from xreset.geometry.shapes import hull
from xreset.geometry.urdf import robot_tree
from xreset.physics import State
from xreset.pictures.meshes import link_meshes
from xreset.spec import GRAVITY, ObjectSpec, SceneSpec


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What an engine was found to have. Shares are of what the scene says, so they are 1 where the engine does as it is told."""

    tip_friction: float
    """Pair friction of object and fingertip."""
    link_friction: float
    """Pair friction of object and another link."""
    table_friction: float
    """Pair friction of object and table."""
    torsional_friction: float
    """Torsional friction of object and table, where they touch in one point [m]; NaN where it stops the object at once."""
    patch_torsional_friction: float
    """Share of it that is left where a second point, 2 mm beside the one that presses, comes as near as 0.5 mm to the table; NaN where
    there is none to begin with."""
    mass: float
    """Share of the object's mass."""
    inertia: float
    """Share of the object's inertia, at its mass."""
    arm_stiffness: float
    """Share of kp, median over the arm's joints."""
    arm_damping: float
    """Share of kd."""
    hand_stiffness: float
    """Share of kp, median over the hand's joints."""
    hand_damping: float
    """Share of kd."""
    timestep: float
    """Step with which motion is integrated [s]."""
    contact_give: float
    """How far an object sinks into the table under ten times its weight [m]."""
    delay: float
    """Control steps until a new target acts."""


_SLAB_HALF = (0.06, 0.06, 0.02)
_SLAB_MASS = 0.5
_SPEED = 0.5  # [m/s] of a slab that slides
_LOAD = 10.0  # on a slab at rest, in its weight
_PRESS = 3.0  # [N] of the paddle on a link
_PULL = 3.0  # along the link, in what friction should carry
_STEP = 0.03  # [rad, m] of the drives, where that is within two fifths of their effort
_SETTLE = 0.25  # [s] before loads and pulls
_TIME = 0.40  # [s] of all
_PULL_WINDOW = (0.05, 0.12)  # [s] after the pull begins
_PUSH_STEPS = 24  # physics steps of constant force on the free object
_TOP_HEIGHT, _TOP_RADIUS = 0.04, 0.02  # [m] of a cone that stands on its point
_TOP_INERTIA = (1.0, 1.0, 1e-3)  # [kg m^2]: it can hardly fall, and turns easily
_SECOND_POINT = (2e-3, 0.0, 5e-4)  # [m]; PhysX takes two that are 1 mm apart for one
_LEAST_TORSION = 1e-4  # [m] below which torsional friction counts as none


def measure(engine: Engine, scene: SceneSpec) -> Measured:
    """Put an engine through the experiments.

    - A slab slides over the table from 0.5 m/s, along x and along the diagonal: its way d tells the friction,
      (v0^2 - v1^2) / (2 g (d + v0 h / 2)) with h the step of the integration. (Its deceleration does not tell it: MuJoCo's contacts lift
      what slides, so it patters.)
    - A top that can hardly fall spins on its point: what it loses, I dw, tells the torsional friction, I dw / int(N) dt with the load's
      impulse from the momentum (contacts may patter). A second one has another point beside the first that does not reach the table: there
      some engines let sliding friction act at both points, instead of torsional friction at one.
    - A slab at rest is loaded with ten times its weight: how much it gives.
    - A paddle that can hardly turn is pressed onto a fingertip, and onto the farthest other link, with 3 N and then pulled sideways with
      three times what friction should carry: the friction is the ratio of the impulses that were missing along and across.
    - A force on the free object: its acceleration is F / m, and its distance x after n steps, x = a t (t + h) / 2, tells the step h of the
      integration. A torque about each of its axes tells its inertia.
    - Every drive gets a small step of its target q*. M v = kp int(q* - q) dt - kd (q - q0), fitted over the response, tells kp and kd (of
      what moves, so an integrator's numerical damping counts as damping); when it begins tells the delay.

    Args:
        scene: robot and object (the first) of the skill, and its friction and timestep.

    Raises:
        XResetError: the state is not finite, or no link can be reached from outside.
    """
    bench = _Bench(scene)
    with engine.make(bench.scene, bench.count, bench.object_index) as backend:
        log = bench.run(backend)
    return bench.evaluate(log)


_SLABS, _TOPS = ("slide x", "slide xy", "load"), ("one point", "two points")
"""Worlds in which an object rests on the table."""


class _Bench:
    """The worlds of the experiments."""

    def __init__(self, scene: SceneSpec) -> None:
        robot, thing = scene.robot, scene.objects[0]
        slab = _block("slab", inertia=_SLAB_MASS / 3 * (sum(h * h for h in _SLAB_HALF) - np.square(_SLAB_HALF)))
        paddle = _block("paddle", inertia=np.ones(3))
        tops = _top("top", ((0.0, 0.0, 0.0),)), _top("top with two points", ((0.0, 0.0, 0.0), _SECOND_POINT))
        self.scene = replace(scene, objects=(slab, paddle, thing, *tops))
        self._thing, self._robot = thing, robot
        self._names = (*_SLABS, *_TOPS, "tip", "link", "force", "torque x", "torque y", "torque z", "drives")
        objects = (0, 0, 0, 3, 4, 1, 1, 2, 2, 2, 2, 2)
        self.count, self.object_index = len(objects), torch.tensor(objects)
        self._presses = {"tip": _reachable(scene, tip=True), "link": _reachable(scene, tip=False)}
        self._dt = scene.timestep
        self._place = free_place(scene)
        _, axes = np.linalg.eigh(thing.inertia)
        self._axes = axes.T  # principal axes in the object's frame: the torque about the first acts along it, and so on

    def run(self, backend) -> dict[str, Tensor]:
        """Play all experiments; returns what the worlds did: [T, N, ...] after each physics step, the start first."""
        start = self._start()
        n, device = self.count, backend.device
        grounded = torch.tensor([name in _SLABS + _TOPS for name in self._names])
        backend.set_object_gravity(grounded.float().to(device))
        backend.set_state(start.to(device))
        targets = start.joint_target.clone()
        targets[-1] += self._drive_step()
        substeps = self.scene.substeps
        rows = {f.name: [getattr(start, f.name)] for f in fields(State)}
        for step in range(round(_TIME / self._dt)):
            force, torque = self._loads(step)
            backend.set_object_wrench(force.to(device), torque.to(device))
            if step % substeps == 0:
                backend.set_joint_targets(targets.to(device))
            backend.step(1)
            state = backend.state()
            for name, values in rows.items():
                values.append(getattr(state, name).cpu().clone())
        log = {name: torch.stack(values).double() for name, values in rows.items()}
        broken = [
            self._names[i] for i in range(n) if not all(bool(torch.isfinite(v[:, i]).all()) for v in log.values())
        ]
        if broken:
            raise XResetError(
                f"{backend.name}: the experiments {', '.join(broken)} are not finite, so nothing can be measured."
            )
        return log

    def evaluate(self, log: dict[str, Tensor]) -> Measured:
        """The numbers."""
        dt, at = self._dt, {name: i for i, name in enumerate(self._names)}
        t, row = _PUSH_STEPS * dt, at["force"]
        velocity = float(log["object_linvel"][_PUSH_STEPS, row, 0])
        distance = float(log["object_pos"][_PUSH_STEPS, row, 0] - log["object_pos"][0, row, 0])
        mass, step = self._push_force() * t / velocity / self._thing.mass, 2.0 * distance / velocity - t
        slides = [self._slid(log, at[name], step) for name in ("slide x", "slide xy")]
        height = log["object_pos"][:, at["load"], 2]
        give = float(height[round(_SETTLE / dt)] - height[-1])

        def pulled(name: str) -> float:
            _, normal, along = self._presses[name]
            begin, end = (round((_SETTLE + t) / dt) for t in _PULL_WINDOW)
            gained = (
                mass
                * _SLAB_MASS
                * (log["object_linvel"][end, at[name]] - log["object_linvel"][begin, at[name]]).numpy()
            )
            time = (end - begin) * dt
            carried = self._pull(name) * time - float(gained @ along)
            pressed = _PRESS * time + float(gained @ normal)  # the press pushes against the normal
            return carried / pressed if pressed > 0.05 * _PRESS * time else float("nan")

        shares = []
        for i, name in enumerate(("torque x", "torque y", "torque z")):
            turned = quat_rotate_inverse(
                log["object_quat"][_PUSH_STEPS, at[name]], log["object_angvel"][_PUSH_STEPS, at[name]]
            ).numpy()
            shares.append(self._push_torque(i) * t / float(turned @ self._axes[i]) / self._principal(i))
        stiffness, damping, delay = self._drives(log["joint_pos"][:, -1].numpy(), log["joint_vel"][:, -1].numpy())
        inertia = float(np.median(shares)) / mass
        point, patch = (inertia * self._torsion(log, at[name]) for name in _TOPS)
        arm, hand = self._robot.arm_indices, self._robot.hand_indices
        return Measured(
            tip_friction=pulled("tip"),
            link_friction=pulled("link"),
            table_friction=sum(slides) / len(slides),
            torsional_friction=point,
            patch_torsional_friction=patch / point if point > _LEAST_TORSION else float("nan"),
            mass=mass,
            inertia=inertia,
            arm_stiffness=_median(stiffness[arm]),
            arm_damping=_median(damping[arm]),
            hand_stiffness=_median(stiffness[hand]),
            hand_damping=_median(damping[hand]),
            timestep=step,
            contact_give=give,
            delay=float(delay),
        )

    def _slid(self, log: dict[str, Tensor], world: int, step: float) -> float:
        """Friction from how far a slab has slid."""
        end = log["object_linvel"][-1, world, :2].norm()
        way = (log["object_pos"][-1, world, :2] - log["object_pos"][0, world, :2]).norm()
        return float((_SPEED**2 - end**2) / (2 * GRAVITY * (way + _SPEED * step / 2)))

    def _torsion(self, log: dict[str, Tensor], world: int) -> float:
        """Torsional friction [m] from the spin that a top has lost, if its inertia at its mass is as stated.

        It is measured while the top has half of its spin. What takes that in one step cannot be measured.
        """
        spin = log["object_angvel"][:, world, 2]
        steps = int((spin > spin[0] / 2).long().cumprod(0).sum()) - 1
        if steps < 1:
            return float("nan")
        load = GRAVITY * steps * self._dt + float(log["object_linvel"][steps, world, 2])  # its impulse, for the mass
        return _TOP_INERTIA[2] / _SLAB_MASS * float(spin[0] - spin[steps]) / load

    # What is done to the worlds ----------------------------------------------------------------------------------------------------------

    def _start(self) -> State:
        start = State.initial(self.scene, self.object_index)
        pos, quat, linvel = start.object_pos, start.object_quat, start.object_linvel
        for i, name in enumerate(self._names):
            if name in _SLABS:
                pos[i] = torch.tensor([*self._place, _SLAB_HALF[2]])
            elif name in _TOPS:
                pos[i] = torch.tensor([*self._place, 0.0])
                start.object_angvel[i, 2] = self._spin()
            elif name in self._presses:
                point, normal, _ = self._presses[name]
                pos[i] = torch.as_tensor(point + (_SLAB_HALF[2] + 5e-4) * normal)
                quat[i] = torch.as_tensor(_z_to(normal))
            else:
                pos[i] = torch.tensor([*self._place, 0.6])
        linvel[0, 0] = _SPEED
        linvel[1, :2] = _SPEED * np.sqrt(0.5)
        return start

    def _loads(self, step: int) -> tuple[Tensor, Tensor]:
        """Force and torque [N, 3] on the objects in a physics step."""
        force, torque = np.zeros((self.count, 3)), np.zeros((self.count, 3))
        late = step * self._dt >= _SETTLE
        for i, name in enumerate(self._names):
            if name == "load" and late:
                force[i, 2] = -_LOAD * _SLAB_MASS * GRAVITY
            elif name in self._presses:
                _, normal, along = self._presses[name]
                force[i] = -_PRESS * normal + (self._pull(name) * along if late else 0.0)
            elif name == "force" and step < _PUSH_STEPS:
                force[i, 0] = self._push_force()
            elif name.startswith("torque") and step < _PUSH_STEPS:
                axis = "xyz".index(name[-1])
                torque[i] = (
                    self._push_torque(axis) * self._axes[axis]
                )  # the object starts unturned, and turns about this axis only
        return torch.as_tensor(force, dtype=torch.float32), torch.as_tensor(torque, dtype=torch.float32)

    def _pull(self, name: str) -> float:
        friction = self.scene.friction
        return _PULL * _PRESS * max(friction.tip if name == "tip" else friction.link, 0.1)

    def _spin(self) -> float:
        """[rad/s] four times what the stated torsional friction takes; not so much that a contact patters."""
        return 4.0 * max(self.scene.friction.torsional, 1e-3) * _SLAB_MASS * GRAVITY / _TOP_INERTIA[2] * _TIME

    def _push_force(self) -> float:
        return 2.0 * self._thing.mass  # 2 m/s^2

    def _push_torque(self, axis: int) -> float:
        return 10.0 * self._principal(axis)  # 10 rad/s^2

    def _principal(self, axis: int) -> float:
        return float(self._axes[axis] @ self._thing.inertia @ self._axes[axis])

    def _drive_step(self) -> Tensor:
        """[J] change of the targets, away from the nearer joint limit."""
        robot, tree = self._robot, robot_tree(self._robot)
        out = []
        for joint in robot.joints:
            limits = tree.joint(joint.name)
            size = min(_STEP, 0.4 * joint.drive.effort / joint.drive.kp)
            size = min(size, 0.2 * (limits.upper - limits.lower))
            out.append(size if limits.upper - joint.home >= joint.home - limits.lower else -size)
        return torch.tensor(out, dtype=torch.float32)

    def _drives(self, position: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
        """Shares [J] of kp and kd, and the delay in control steps, from [T, J] positions and velocities after a step of the targets."""
        robot, dt = self._robot, self._dt
        drives = [joint.drive for joint in robot.joints]
        change = self._drive_step().double().numpy()
        moved = np.flatnonzero((np.abs(position - position[0]) > 1e-3 * np.abs(change)).any(axis=1))
        if not len(moved):
            raise XResetError("no joint follows its target, so its drives cannot be measured.")
        late = (int(moved[0]) - 1) // self.scene.substeps * self.scene.substeps
        position, velocity = position[late:], velocity[late:]
        M = mass_matrix(robot, robot.home) + np.diag([drive.armature for drive in drives])
        loss = np.array([drive.friction_loss for drive in drives])
        momentum = velocity @ M + np.cumsum(loss * np.sign(velocity), axis=0) * dt
        lag = position[0] + change - position
        pulled = np.concatenate((np.zeros((1, len(drives))), np.cumsum((lag[1:] + lag[:-1]) / 2 * dt, axis=0)))
        kp, kd = np.empty(len(drives)), np.empty(len(drives))
        for j in range(len(drives)):
            columns = np.stack((pulled[:, j], position[0, j] - position[:, j]), axis=1)
            (kp[j], kd[j]), *_ = np.linalg.lstsq(columns, momentum[:, j], rcond=None)
        return kp / [d.kp for d in drives], kd / [d.kd for d in drives], late // self.scene.substeps


def _block(name: str, *, inertia: np.ndarray) -> ObjectSpec:
    return replace(
        solid(name, _SLAB_MASS, (shape("box", _SLAB_HALF, (0, 0, 0)),)), com=np.zeros(3), inertia=np.diag(inertia)
    )


def _top(name: str, points: Sequence[Sequence[float]]) -> ObjectSpec:
    """A cone upside down, with these points [m] at its lower end; the mesh's origin is on the floor, and so is the centre of mass."""
    angle = np.arange(8) * np.pi / 4
    rim = np.stack((_TOP_RADIUS * np.cos(angle), _TOP_RADIUS * np.sin(angle), np.full(8, _TOP_HEIGHT)), axis=1)
    cone = solid(name, _SLAB_MASS, (hull(np.concatenate((np.array(points), rim))),))
    return replace(cone, com=np.zeros(3), inertia=np.diag(_TOP_INERTIA))


def _reachable(scene: SceneSpec, *, tip: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a paddle can be pressed on a fingertip (or on another link) of the robot at home, and nothing else is in its way.

    Of many directions, the one in which the link sticks out farthest beyond links of the other kind.

    Returns:
        The point [3] that sticks out, the direction [3] it does in, and a direction [3] along the paddle's face.
    """
    robot = scene.robot
    kinematics = Kinematics(robot)
    poses = kinematics.link_poses(torch.as_tensor(robot.home, dtype=torch.float64)).numpy()
    contact_links = {link for finger in robot.fingertips for link in finger.contact_links}
    points: dict[bool, list[np.ndarray]] = {True: [], False: []}
    for name, mesh, T in zip(kinematics.link_names, link_meshes(robot), poses, strict=True):
        if mesh is not None:
            points[name in contact_links].append(mesh.vertices @ T[:3, :3].T + T[:3, 3])
    mine, others = np.concatenate(points[tip]), np.concatenate(points[not tip])
    best: tuple[float, np.ndarray, np.ndarray, np.ndarray] | None = None
    for normal in _directions(400):
        reach = mine @ normal
        margin = float(reach.max() - (others @ normal).max())
        point = mine[reach.argmax()]
        along = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
        along /= np.linalg.norm(along)
        if along[2] < 0:
            along = -along  # away from the table
        lowest = (
            point[2]
            + min(0.0, 2 * _SLAB_HALF[2] * normal[2])
            - np.hypot(*_SLAB_HALF[:2]) * np.sqrt(max(0.0, 1 - normal[2] ** 2))
        )
        if lowest > 0.03 and (best is None or margin > best[0]):
            best = margin, point, normal, along
    if best is None or best[0] <= 0.002:
        what = "fingertip" if tip else "link beside the fingertips"
        raise XResetError(
            f"no {what} of {robot.name!r} at home can be reached from outside, so its friction cannot be measured."
        )
    return best[1:]


def _directions(count: int) -> np.ndarray:
    """[count, 3] unit vectors spread over the sphere (a Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.stack((r * np.cos(angle), r * np.sin(angle), z), axis=1)


def _z_to(direction: np.ndarray) -> np.ndarray:
    """[4] a rotation that turns z into a unit vector."""
    x = np.cross(np.eye(3)[np.abs(direction).argmin()], direction)
    x /= np.linalg.norm(x)
    return Rotation.from_matrix(np.stack((x, np.cross(direction, x), direction), axis=1)).as_quat(scalar_first=True)


def _median(values: Sequence[float] | np.ndarray) -> float:
    """NaN if there are none."""
    return float(np.median(values)) if len(values) else float("nan")
