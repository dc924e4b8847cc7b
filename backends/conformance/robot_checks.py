"""Checks of the robot: mass properties, drives, limits, weight. All but two run with any robot.

Joints move in free space here: the robot's links collide neither with one another nor with the table.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from xreset.backends.conformance.harness import (
    Bench,
    Worlds,
    finite_limits,
    named,
    replace_fields,
)
from xreset.backends.conformance.results import Measured, Skipped
from xreset.backends.rigid import mechanism, object_inertia
from xreset.geometry.dynamics import com_jacobian, drive_values
from xreset.geometry.urdf import prismatic_joints, robot_tree
from xreset.physics import State
from xreset.spec import GRAVITY, DriveSpec, RobotSpec, SceneSpec

_WAY = 0.2  # rad, of a joint's step and of the amplitude of its sine
_SLIDE_WAY = 0.02  # m, the same of a prismatic joint
_DURATION = 1.5  # s
_FREQUENCY = 1.0  # Hz
# of stiffness, damping and effort limit
_DRIVE_SCALES = ((1.0, 1.0, 1.0), (0.7, 1.4, 1.0), (1.3, 0.8, 0.5))


def mass_properties(bench: Bench) -> Measured:
    """Read masses, centres of mass and inertias back from the engine, of every moving body and of the objects."""
    found = bench.worlds().backend.mass_properties().to("cpu").map(Tensor.double)
    bodies = mechanism(bench.scene.robot).bodies[1:]
    robot = [(body.name, body.inertia) for body in bodies]
    errors = defaultdict(list)
    for world, obj in enumerate(bench.objects):
        for i, (name, expected) in enumerate([*robot, (obj.name, object_inertia(obj))]):
            matrix = found.inertia[world, i].numpy()
            off = {
                "mass": found.mass[world, i] / expected.mass - 1.0,
                "centre of mass": found.com[world, i].numpy() - expected.com,
                "principal inertia": np.linalg.eigvalsh(matrix) / expected.moments - 1.0,
                "inertia matrix": (matrix - expected.matrix) / expected.moments[-1],
            }
            for what, error in off.items():
                errors[what].append((name, error))
    return errors


# Drives ---------------------------------------------------------------------------------------------------------------


def joint_tracking(bench: Bench) -> Measured:
    """Move every joint by itself, by a step and by a sine, and compare its path with the reference engine's."""
    scene = bench.free_scene
    steps = round(_DURATION / scene.control_dt)
    time = scene.control_dt * torch.arange(steps)  # of the beginning of each control step
    sine = torch.sin(2.0 * torch.pi * _FREQUENCY * time)
    return _against_reference(bench, scene, {"step": torch.ones(steps), "sine": sine})


def effort_limit(bench: Bench) -> Measured:
    """Step every joint with an effort limit of 30 % of what its drive asks for; compare with the reference engine."""
    scene = bench.free_scene
    _, way = _each_joint_alone(bench)
    asked = 0.3 * drive_values(scene.robot, "kp") * way.abs().numpy()
    weak = with_drives(scene, effort=np.minimum(drive_values(scene.robot, "effort"), asked))
    step = torch.ones(round(_DURATION / scene.control_dt))
    return _against_reference(bench, weak, {"weak step": step})


def _each_joint_alone(bench: Bench) -> tuple[State, Tensor]:
    """[J] worlds: in world i joint i has room for its way on both sides, the others are at home; and each way [J]."""
    slides = torch.tensor(prismatic_joints(bench.scene.robot))
    lower = bench.kinematics.lower
    upper = bench.kinematics.upper
    way = torch.where(slides, _SLIDE_WAY, _WAY).double().minimum(0.3 * (upper - lower))
    middle = bench.kinematics.home.clamp(lower + 1.5 * way, upper - 1.5 * way)
    start = bench.initial(bench.scene, [0] * len(slides))
    start.joint_pos.diagonal().copy_(middle.float())
    return replace_fields(start, joint_target=start.joint_pos), way.float()


def _against_reference(bench: Bench, scene: SceneSpec, signals: dict[str, Tensor]) -> Measured:
    """Return root mean square and peak of the difference between each joint's path and its path in the reference.

    A slide's path counts in proportion to its way, as if that were 0.2 rad.
    """
    start, way = _each_joint_alone(bench)
    object_index = [0] * len(way)

    def paths(worlds: Worlds) -> list[Tensor]:
        """[T, J] for each signal: the path of joint i in world i."""
        found = []
        for signal in signals.values():
            targets = (start.joint_pos + torch.diag(way * value) for value in signal)
            path = worlds.path(start, targets, scene.substeps)
            found.append(path.diagonal(dim1=1, dim2=2))
        return found

    with bench.other(scene, object_index) as worlds:
        found = paths(worlds)
    with bench.reference(scene, object_index) as reference:
        expected = paths(reference)
    errors = defaultdict(list)
    for signal, path, path_there in zip(signals, found, expected, strict=True):
        off = (path - path_there) * (_WAY / way)
        for joint, error in zip(scene.robot.joints, off.T, strict=True):
            case = f"{joint.group}, {signal}"
            errors[f"{case}, rms"].append((joint.name, error.square().mean().sqrt()))
            errors[f"{case}, peak"].append((joint.name, error))
    return errors


def drive_equation(bench: Bench) -> Measured:
    """Step the target of the vertical slide and compare with the drive's differential equation.

    (m + armature) x'' = clip(kp (target - x) - kd x', effort). The robot's weight is compensated, so it is absent.
    Two of the steps begin at the effort limit. So do those of a drive that is stiffer and weaker, and leaves it fast.
    """
    scene = bench.scene
    index = scene.robot.joint_names.index("lift")
    stiffer = {}
    for name, factor in (("kp", 3.0), ("kd", 2.0), ("effort", 0.3)):
        stiffer[name] = factor * drive_values(scene.robot, name)
    steps = torch.tensor([0.01, -0.01, 0.08, -0.08])
    errors = {}
    for what, driven in (
        ("", scene),
        (", stiffer and weaker", with_drives(scene, **stiffer)),
    ):
        start = bench.start()
        target = start.joint_pos.clone()
        target[:, index] += steps
        with bench.other(driven, bench.object_index) as worlds:
            found = worlds.path(start, [target] * 24, 4)[..., index]
        joint = driven.robot.joints[index]
        times = 4 * scene.timestep * np.arange(1, 25)
        for i, step in enumerate(steps.tolist()):
            way = found[:, i].double().numpy() - joint.home
            exact = _drive_path(driven.robot, joint.drive, step, times)
            errors[f"step of {step:+.2f} m{what}"] = (way - exact) / step
    return errors


def _drive_path(robot: RobotSpec, drive: DriveSpec, step: float, times: np.ndarray) -> np.ndarray:
    """Return the way of the gripper's lift at some times after a step of its target."""
    tree = robot_tree(robot)
    carried = sum(
        tree.link(name).mass for name in ("carriage", "wrist", "palm", "jaw_a", "jaw_b", "finger_b")
    )

    def motion(_, y: np.ndarray) -> list[float]:
        effort = np.clip(drive.kp * (step - y[0]) - drive.kd * y[1], -drive.effort, drive.effort)
        return [y[1], effort / (carried + drive.armature)]

    options = {"t_eval": times, "rtol": 1e-6, "atol": 1e-9, "max_step": 1e-3}
    return solve_ivp(motion, (0.0, times[-1]), [0.0, 0.0], **options).y[0]


def drive_scale(bench: Bench) -> Measured:
    """Scale the drives of some worlds, and compare with engines that were built with a robot of such drives.

    All joints step at once.
    """
    scene = bench.free_scene
    scales = torch.tensor(_DRIVE_SCALES)
    object_index = [0] * len(scales)
    _, way = _each_joint_alone(bench)
    start = bench.initial(scene, object_index)
    limits = bench.kinematics
    target = (start.joint_pos + way).clamp(limits.lower.float(), limits.upper.float())

    def path(worlds: Worlds, rows: slice) -> Tensor:
        return worlds.path(start[rows], [target[rows]] * 30, scene.substeps)

    expected = []
    for i, factors in enumerate(_DRIVE_SCALES):
        drives = {}
        for name, factor in zip(("kp", "kd", "effort"), factors, strict=True):
            drives[name] = factor * drive_values(scene.robot, name)
        with bench.other(with_drives(scene, **drives)) as worlds:
            expected.append(path(worlds, slice(i, i + 1)))
    with bench.other(scene, object_index) as worlds:
        # What was set before must not matter.
        for factors in (scales.flip(0), scales):
            worlds.set_parameter("drives", factors[:, :, None].expand(-1, -1, len(way)))
        off = path(worlds, slice(None)) - torch.cat(expected, dim=1)
    return named(scene.robot.joint_names, {"path": off}, dim=-1)


def with_drives(scene: SceneSpec, **values: np.ndarray) -> SceneSpec:
    """Return the scene with other values [J] of its robot's drives."""
    joints = []
    for i, joint in enumerate(scene.robot.joints):
        drive = {name: float(value[i]) for name, value in values.items()}
        joints.append(replace(joint, drive=replace(joint.drive, **drive)))
    return replace(scene, robot=replace(scene.robot, joints=tuple(joints)))


# Limits and weight ----------------------------------------------------------------------------------------------------


def joint_limits(bench: Bench) -> Measured:
    """Send every joint beyond its limits: it must come to rest there."""
    scene = bench.free_scene
    names = scene.robot.joint_names
    start, way = _each_joint_alone(bench)
    errors = {}
    with bench.other(scene, [0] * len(way)) as worlds:
        for name, side in (("upper", 1.0), ("lower", -1.0)):
            limit = getattr(bench.kinematics, name).float()
            limited = limit.isfinite()
            if not limited.any():
                continue
            sent = start.clone()
            pos = torch.where(limited, limit - side * 0.5 * way, start.joint_pos.diagonal())
            target = torch.where(limited, limit + side * 0.5 * way, pos)
            sent.joint_pos.diagonal().copy_(pos)
            sent.joint_target.diagonal().copy_(target)
            end = worlds.advance(sent, round(1.0 / scene.timestep)).joint_pos.diagonal()
            off = ((end - limit).abs() / way).where(limited, torch.tensor(0.0))
            errors[f"way off the {name} limit"] = zip(names, off)
    if not errors:
        raise Skipped("no joint of this robot has limits")
    return errors


def gravity_compensation(bench: Bench) -> Measured:
    """Hold several configurations for 2 s: an arm whose weight is compensated does not sag."""
    if not bench.scene.robot.gravity_compensated:
        raise Skipped("this robot's weight is not compensated")
    scene = bench.free_scene
    random = torch.Generator().manual_seed(8)
    lower, upper = finite_limits(bench.kinematics, 2.0)
    share = 0.2 + 0.6 * torch.rand(
        bench.NUM_WORLDS, len(lower), generator=random, dtype=torch.float64
    )
    q = lower + (upper - lower) * share
    q[0] = bench.kinematics.home
    start = replace_fields(bench.start(), joint_pos=q, joint_target=q)
    with bench.other(scene, bench.object_index) as worlds:
        end = worlds.advance(start, round(2.0 / scene.timestep))
    return {"sag": zip(scene.robot.joint_names, (end.joint_pos - start.joint_pos).T)}


def own_weight(bench: Bench) -> Measured:
    """Leave the weight to the drives and give the objects gravity fractions: the robot sags by its whole own weight.

    At rest kp (target - q) = sum over links of m g dz/dq, in every world.
    """
    scene = bench.free_scene
    scene = replace(scene, robot=replace(scene.robot, gravity_compensated=False))
    start = bench.start()
    with bench.other(scene, bench.object_index) as worlds:
        worlds.set_parameter("object_gravity", torch.tensor([0.0, 0.5, 1.0, 0.25]))
        q = worlds.advance(start, round(2.0 / scene.timestep)).joint_pos.double()
    links, jacobian = com_jacobian(bench.kinematics, q)
    mass = torch.tensor([link.mass for link in links], dtype=torch.float64)
    rise = jacobian.linear[:, :, 2]  # [N, L, J]
    stiffness = torch.as_tensor(drive_values(scene.robot, "kp"))
    sag = GRAVITY * torch.einsum("l,nlj->nj", mass, rise) / stiffness
    off = {
        "sag": start.joint_pos.double() - q - sag,
        "difference between worlds": q - q[:1],
    }
    return named(scene.robot.joint_names, off, dim=-1)
