"""Checks of the robot: kinematics, mass properties, drives, limits, weight. All but one run with any robot.

Joints move in free space here: the robot's links collide neither with one another nor with the table.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from xreset.backends.conformance.harness import (
    Bench,
    advanced,
    largest,
    replace_fields,
    rotation_angle,
    snapshot,
    worst_of,
)
from xreset.backends.conformance.results import Measure, Skipped, checks_of
from xreset.backends.conformance.scene import without_collisions
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.urdf import robot_tree
from xreset.physics import Backend, Parameters, State
from xreset.spec import GRAVITY, RobotSpec, SceneSpec

check = checks_of("robot")

_CONFIGURATIONS = 200
_WAY = 0.2  # rad, of a joint's step and of the amplitude of its sine
_SLIDE_WAY = 0.02  # m, the same of a prismatic joint
_DURATION = 1.5  # s
_FREQUENCY = 1.0  # Hz


# Kinematics ------------------------------------------------------------------------------------------------------------------------------


@check(
    "palm and fingertips are where the URDF and MuJoCo have them, in 200 configurations",
    "a joint's axis, origin, sign or offset is wrong; frames refer to a centre of mass; joints are in another order",
)
def forward_kinematics(bench: Bench) -> list[Measure]:
    """Set many configurations and compare palm and fingertips with the URDF's kinematics, and with the reference engine's."""
    scene, n = bench.scene, bench.NUM_WORLDS
    random = torch.Generator().manual_seed(7)
    lower, upper = bench.kinematics.lower.clamp_min(-3.0), bench.kinematics.upper.clamp_max(3.0)
    q = lower + (upper - lower) * torch.rand(_CONFIGURATIONS, len(lower), generator=random, dtype=torch.float64)
    q = q.float().double()  # what an interface in single precision can carry

    def links_of(backend: Backend) -> tuple[Tensor, Tensor]:
        start, pos, quat = bench.start(), [], []
        for some in q.split(n):
            backend.set_state(replace_fields(start, joint_pos=some, joint_target=some).to(backend.device))
            links = backend.links()
            pos.append(links.pos.cpu().double().clone())
            quat.append(links.quat.cpu().double().clone())
        return torch.cat(pos), torch.cat(quat)

    pos, quat = links_of(bench.backend())
    poses = bench.kinematics.link_poses(q, scene.robot.tracked_links)
    measures = [
        Measure("pos against the URDF", largest(pos - poses[..., :3, 3]), 1e-5, "m"),
        Measure("angle against the URDF", largest(rotation_angle(quat, matrix_to_quat(poses[..., :3, :3]))), 1e-5,
                "rad"),
    ]  # fmt: skip
    with bench.reference(scene, n, bench.object_index) as (reference, _):
        other_pos, other_quat = links_of(reference)
    return [
        *measures,
        Measure("pos against MuJoCo", largest(pos - other_pos), 1e-5, "m"),
        Measure("angle against MuJoCo", largest(rotation_angle(quat, other_quat)), 1e-5, "rad"),
    ]


@check(
    "the engine holds the masses, centres of mass and inertias of the URDF and of the objects",
    "masses are invented for links without <inertial>, fixed links are lost or counted twice, principal axes are dropped or transposed",
    capabilities=("mass_properties",),
)
def mass_properties(bench: Bench) -> list[Measure]:
    """Read masses, centres of mass and inertias back from the engine, of every moving body and of the objects."""
    found = bench.backend().mass_properties()
    bodies = _bodies(bench.scene.robot)
    rows = [(0, i, name, *values) for i, (name, values) in enumerate(bodies.items())]
    rows += [
        (world, len(bodies), o.name, o.mass, np.asarray(o.com), np.asarray(o.inertia))
        for world, o in enumerate(bench.objects)
    ]
    limits = {
        "mass": (1e-5, "of it"),
        "centre of mass": (1e-6, "m"),
        "principal inertia": (1e-5, "of it"),
        "inertia matrix": (1e-5, "of it"),
    }
    errors = []
    for world, i, _, mass, com, inertia in rows:
        matrix = found.inertia[world, i].double().cpu().numpy()
        moments = np.linalg.eigvalsh(inertia)
        errors.append((
            abs(float(found.mass[world, i]) / mass - 1.0),
            np.abs(found.com[world, i].double().cpu().numpy() - com).max(),
            np.abs(np.linalg.eigvalsh(matrix) / moments - 1.0).max(),
            np.abs(matrix - inertia).max() / moments[-1],
        ))  # fmt: skip
    names = [row[2] for row in rows]
    return [
        worst_of(what, values, *limits[what], names)
        for what, values in zip(limits, zip(*errors, strict=True), strict=True)
    ]


def _bodies(robot: RobotSpec) -> dict[str, tuple[float, np.ndarray, np.ndarray]]:
    """Mass, centre of mass and inertia about it of each moving body, in its frame, from the URDF's links one by one."""
    kinematics = Kinematics(robot)
    poses = kinematics.link_poses(torch.as_tensor(robot.home, dtype=torch.float64)).numpy()
    place = dict(zip(kinematics.link_names, poses, strict=True))
    members: dict[str, list] = {}
    for link in kinematics.tree.links:
        members.setdefault(kinematics.tree.moving_ancestor(link.name), []).append(link)
    members.pop(kinematics.tree.moving_ancestor(kinematics.tree.root))
    bodies = {}
    for name, links in members.items():
        # Second moments of mass add up about any one point; those about the centre of mass follow from them.
        total, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
        for link in links:
            T = np.linalg.inv(place[name]) @ place[link.name]
            R, c = T[:3, :3], T[:3, :3] @ link.com + T[:3, 3]
            total, first = total + link.mass, first + link.mass * c
            spread = np.trace(link.inertia) / 2 * np.eye(3) - link.inertia
            second += R @ spread @ R.T + link.mass * np.outer(c, c)
        com = first / total
        spread = second - total * np.outer(com, com)
        bodies[name] = (total, com, np.trace(spread) * np.eye(3) - spread)
    return bodies


# Drives ----------------------------------------------------------------------------------------------------------------------------------


@check(
    "every joint by itself follows a step and a sine of 0.2 rad as in the reference (the reference: as with 8 times finer steps)",
    "gains are scaled by the timestep, the drive is explicit or for accelerations, armature is missing, joints are damped by default",
)
def joint_tracking(bench: Bench) -> list[Measure]:
    """Move every joint by itself, by a step and by a sine, and compare its path with the reference engine's."""
    scene = without_collisions(bench.scene)
    start, way = _alone(bench, scene)
    steps = round(_DURATION / scene.control_dt)
    time = scene.control_dt * torch.arange(steps)  # of the beginning of each control step
    step = torch.ones(steps)
    sine = torch.sin(2.0 * torch.pi * _FREQUENCY * time)
    return _against_reference(bench, scene, start, way, {"step": step, "sine": sine})


def _alone(bench: Bench, scene: SceneSpec) -> tuple[State, Tensor]:
    """[J] worlds: in world i joint i has room for its way on both sides, the others are at home; and each joint's way [J]."""
    kinematics = Kinematics(scene.robot)
    count = len(scene.robot.joints)
    slides = torch.tensor(
        [robot_tree(scene.robot).joint(joint.name).type == "prismatic" for joint in scene.robot.joints]
    )
    lower, upper = kinematics.lower, kinematics.upper
    way = torch.where(slides, _SLIDE_WAY, _WAY).double().minimum(0.3 * (upper - lower))
    home = torch.as_tensor(scene.robot.home)
    middle = torch.minimum(torch.maximum(home, lower + 1.5 * way), upper - 1.5 * way)
    start = bench.placed(State.initial(scene, torch.zeros(count, dtype=torch.long)))
    pos = start.joint_pos.clone()
    pos[range(count), range(count)] = middle.float()
    return replace_fields(start, joint_pos=pos, joint_target=pos), way.float()


def _against_reference(
    bench: Bench, scene: SceneSpec, start: State, way: Tensor, signals: dict[str, Tensor]
) -> list[Measure]:
    """Root mean square and peak of the difference between a joint's path and that in the reference engine, of the worst joint of a group.

    A slide's path counts in proportion to its way, as if that were 0.2 rad.
    """
    count = len(way)
    which = torch.zeros(count, dtype=torch.long)

    def paths(backend: Backend, finer: int) -> dict[str, Tensor]:
        return {name: _paths(backend, start, way, signal, scene.substeps * finer) for name, signal in signals.items()}

    with bench.other(scene, count, which) as backend:
        found = paths(backend, 1)
    with bench.reference(scene, count, which) as (reference, finer):
        expected = paths(reference, finer)
    measures = []
    for name in signals:
        off = (found[name] - expected[name]) * (_WAY / way)
        rms, peak = off.square().mean(dim=0).sqrt(), off.abs().amax(dim=0)
        for group in ("arm", "hand"):
            mine = [i for i, joint in enumerate(scene.robot.joints) if joint.group == group]
            for kind, values, tolerance in (("rms", rms, 2.5e-3), ("peak", peak, 12e-3)):
                if mine:
                    names = [scene.robot.joints[i].name for i in mine]
                    measures.append(worst_of(f"{group}, {name}, {kind}", values[mine], tolerance, "rad", names))
    return measures


def _paths(backend: Backend, start: State, way: Tensor, signal: Tensor, substeps: int) -> Tensor:
    """[T, J] path of joint i in world i whose target moves by ``signal`` [T] times its way."""
    backend.set_state(start.to(backend.device))
    path = []
    for value in signal.tolist():
        backend.set_joint_targets((start.joint_pos + torch.diag(way * value)).to(backend.device))
        backend.step(substeps)
        path.append(backend.state().joint_pos.diagonal().cpu().clone())
    return torch.stack(path)


_DRIVE_SCALES = ((1.0, 1.0, 1.0), (0.7, 1.4, 1.0), (1.3, 0.8, 0.5))  # of stiffness, damping and effort limit


@check(
    "a drive is a PD position drive with effort limit and armature",
    "gains are scaled, armature or effort limit are missing, joint damping or friction is added, or gravity is not compensated",
    own_robot_only=True,
)
def drive_equation(bench: Bench) -> list[Measure]:
    """Step the target of the vertical slide and compare with the drive's differential equation, effort limit and armature included.

    (m + armature) x'' = clip(kp (target - x) - kd x', effort). The robot's weight is compensated, so it does not appear.
    """
    robot = bench.scene.robot
    index = robot.joint_names.index("lift")
    drive = robot.joints[index].drive
    tree = robot_tree(robot)
    carried = sum(tree.link(name).mass for name in ("carriage", "wrist", "palm", "jaw_a", "jaw_b", "finger_b"))
    steps = torch.tensor([0.01, -0.01, 0.08, -0.08])  # the last two run into the effort limit
    backend = bench.backend()
    target = bench.start().joint_pos.clone()
    target[:, index] += steps
    backend.set_joint_targets(target.to(backend.device))
    found = []
    for _ in range(12):
        backend.step(4)
        found.append(snapshot(backend.state()).joint_pos[:, index].double().numpy())
    times = 4 * bench.scene.timestep * np.arange(1, 13)
    measures = []
    for i, step in enumerate(steps.tolist()):

        def motion(_, y: np.ndarray, goal: float = step) -> list[float]:
            effort = np.clip(drive.kp * (goal - y[0]) - drive.kd * y[1], -drive.effort, drive.effort)
            return [y[1], effort / (carried + drive.armature)]

        exact = solve_ivp(motion, (0.0, times[-1]), [0.0, 0.0], t_eval=times, rtol=1e-6, atol=1e-9, max_step=1e-3).y[0]
        error = np.abs(np.array([x[i] for x in found]) - robot.joints[index].home - exact).max() / abs(step)
        measures.append(Measure(f"step of {step:+.2f} m", float(error), 0.06, "of the step"))
    return measures


@check(
    "factors on stiffness, damping and effort limit act as in a robot that was built with such drives",
    "a factor is applied to what the last one left, to all worlds, or not to what an implicit drive was factorised with",
    capabilities=("drives",),
)
def drive_scale(bench: Bench) -> list[Measure]:
    """Scale the drives of some worlds, and compare with engines that were built with a robot of such drives.

    All joints step at once. Factors set through a mask must do the same, and worlds outside of it must keep theirs.
    """
    scene = without_collisions(bench.scene)
    scales = torch.tensor(_DRIVE_SCALES)
    count, joints = len(scales), len(scene.robot.joints)
    which = torch.zeros(count, dtype=torch.long)
    _, way = _alone(bench, scene)
    start = bench.placed(State.initial(scene, which))
    limits = bench.kinematics
    target = (start.joint_pos + way).minimum(limits.upper.float()).maximum(limits.lower.float())
    factors = scales[:, :, None].expand(count, 3, joints)

    def path(backend: Backend, rows: slice) -> Tensor:
        backend.set_state(start[rows].to(backend.device))
        backend.set_joint_targets(target[rows].to(backend.device))
        found = []
        for _ in range(30):
            backend.step()
            found.append(backend.state().joint_pos.cpu().clone())
        return torch.stack(found, dim=1)

    expected = []
    for i, (stiffness, damping, effort) in enumerate(_DRIVE_SCALES):
        scaled = tuple(
            replace(joint, drive=replace(
                joint.drive, kp=stiffness * joint.drive.kp, kd=damping * joint.drive.kd, effort=effort * joint.drive.effort
            ))
            for joint in scene.robot.joints
        )  # fmt: skip
        with bench.other(replace(scene, robot=replace(scene.robot, joints=scaled)), 1, which[:1]) as backend:
            expected.append(path(backend, slice(i, i + 1)))
    with bench.other(scene, count, which) as backend:
        backend.set_drives(factors.to(backend.device))
        at_once = path(backend, slice(None))
        backend.set_drives(factors.flip(0).to(backend.device))
        mask = torch.tensor([True, False, True], device=backend.device)
        ones = torch.ones(count, device=backend.device)
        mass = torch.full_like(ones, scene.objects[0].mass)
        friction = torch.tensor(
            [[scene.friction.tip, scene.friction.link, scene.friction.table]], device=backend.device
        ).expand(count, 3)
        parameters = Parameters(
            friction=friction, object_mass=mass, object_gravity=ones, drives=factors.to(backend.device)
        )
        backend.set_where(mask, start.to(backend.device), parameters)
        masked = path(backend, slice(None))
    return [
        Measure("set at once", largest(at_once - torch.cat(expected)), 1e-4, "rad, m"),
        Measure("set through a mask", largest(masked - torch.cat(expected)), 1e-4, "rad, m"),
    ]


@check(
    "a drive that asks for more than its effort limit gives that limit, as in the reference",
    "the effort limit is missing, is an impulse per step instead of a torque, or limits the sum with gravity compensation",
)
def effort_limit(bench: Bench) -> list[Measure]:
    """Step every joint by itself with an effort limit of 30 % of what its drive asks for, and compare with the reference engine."""
    scene = without_collisions(bench.scene)
    _, way = _alone(bench, scene)
    weak = tuple(
        replace(joint, drive=replace(joint.drive, effort=min(joint.drive.effort, 0.3 * joint.drive.kp * abs(float(w)))))
        for joint, w in zip(scene.robot.joints, way, strict=True)
    )
    scene = replace(scene, robot=replace(scene.robot, joints=weak))
    start, way = _alone(bench, scene)
    return _against_reference(bench, scene, start, way, {"weak step": torch.ones(round(_DURATION / scene.control_dt))})


# Limits and weight -----------------------------------------------------------------------------------------------------------------------


@check(
    "a joint sent beyond a limit comes to rest at it",
    "limits are not set, are those of another joint, or so soft that the drive overcomes them",
)
def joint_limits(bench: Bench) -> list[Measure]:
    """Send every joint beyond its limits: it must come to rest there."""
    scene = without_collisions(bench.scene)
    kinematics, count = Kinematics(scene.robot), len(scene.robot.joints)
    start, way = _alone(bench, scene)
    joints = range(count)
    which = torch.zeros(count, dtype=torch.long)
    measures = []
    with bench.other(scene, count, which) as backend:
        for name, limit, side in (("upper", kinematics.upper.float(), 1.0), ("lower", kinematics.lower.float(), -1.0)):
            limited = limit.isfinite()
            if not limited.any():
                continue
            pos, target = start.joint_pos.clone(), start.joint_pos.clone()
            inside, beyond = limit - side * 0.5 * way, limit + side * 0.5 * way
            pos[joints, joints] = torch.where(limited, inside, pos.diagonal())
            target[joints, joints] = torch.where(limited, beyond, pos.diagonal())
            end = advanced(
                backend, replace_fields(start, joint_pos=pos, joint_target=target), round(1.0 / scene.timestep)
            )
            off = ((end.joint_pos.diagonal() - limit).abs() / way).where(limited, torch.tensor(0.0))
            measures.append(worst_of(f"way off the {name} limit", off, 0.1, "of the way", scene.robot.joint_names))
    if not measures:
        raise Skipped("no joint of this robot has limits")
    return measures


@check(
    "a robot whose weight is compensated does not sag",
    "the engine's gravity acts on the robot, or on links that were fused into others",
)
def gravity_compensation(bench: Bench) -> list[Measure]:
    """Hold several configurations for 2 s: an arm whose weight is compensated does not sag."""
    if not bench.scene.robot.gravity_compensated:
        raise Skipped("this robot's weight is not compensated")
    scene = without_collisions(bench.scene)
    kinematics, n = bench.kinematics, bench.NUM_WORLDS
    random = torch.Generator().manual_seed(8)
    lower, upper = kinematics.lower.clamp_min(-2.0), kinematics.upper.clamp_max(2.0)
    q = lower + (upper - lower) * (0.2 + 0.6 * torch.rand(n, len(lower), generator=random, dtype=torch.float64))
    q[0] = torch.as_tensor(scene.robot.home)
    with bench.other(scene, n, bench.object_index) as backend:
        start = replace_fields(bench.start(), joint_pos=q, joint_target=q)
        off = (advanced(backend, start, round(2.0 / scene.timestep)).joint_pos - start.joint_pos).abs().amax(dim=0)
    return [worst_of("sag", off, 1e-4, "rad, m", scene.robot.joint_names)]


@check(
    "a robot whose weight is not compensated carries all of it, whatever gravity fraction its object has",
    "the gravity fraction scales the gravity of the whole world; or the robot's weight is compensated although it should not be",
    capabilities=("object_gravity",),
    own_robot_only=True,
)
def own_weight(bench: Bench) -> list[Measure]:
    """Leave the weight to the drives and give the objects gravity fractions: the robot sags as its own whole weight asks, in every world.

    At rest kp (target - q) = sum over links of m g dz/dq.
    """
    scene = without_collisions(replace(bench.scene, robot=replace(bench.scene.robot, gravity_compensated=False)))
    kinematics, n = bench.kinematics, bench.NUM_WORLDS
    with bench.other(scene, n, bench.object_index) as backend:
        backend.set_object_gravity(torch.tensor([0.0, 0.5, 1.0, 0.25], device=backend.device))
        start = bench.start()
        q = advanced(backend, start, round(2.0 / scene.timestep)).joint_pos.double()
    links = [kinematics.tree.link(name) for name in kinematics.link_names]
    com = torch.tensor(np.stack([link.com for link in links]))
    mass = torch.tensor([link.mass for link in links], dtype=torch.float64)
    rise = kinematics.jacobian(q, kinematics.link_names, com).linear[:, :, 2]  # [N, L, J]
    stiffness = torch.tensor([joint.drive.kp for joint in scene.robot.joints], dtype=torch.float64)
    sag = GRAVITY * torch.einsum("l,nlj->nj", mass, rise) / stiffness
    off = start.joint_pos.double() - q - sag
    return [
        Measure("sag", largest(off), 1e-4, "rad, m"),
        Measure("difference between worlds", largest(q - q[:1]), 1e-6, "rad, m"),
    ]
