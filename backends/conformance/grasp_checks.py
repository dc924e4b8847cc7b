"""Checks of grasps: forces of fingers, friction of fingertips, whether a grasp lasts.

The suite's own robot holds a brick; the jaw of any robot with couplings presses on a ball.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from xreset.backends.conformance.harness import SETTLE, Bench, Worlds
from xreset.backends.conformance.results import Measured, Skipped
from xreset.backends.conformance.scene import ball
from xreset.geometry.rotations import matrix_to_quat, quat_angle, relative_pose
from xreset.physics import State
from xreset.spec import GRAVITY, ObjectSpec

_BALL_WIDTH = 0.06  # m
_HEAVY = 1000.0  # times as heavy as the suite's ball, so that it hardly moves
_SQUEEZE = 0.2  # of the drive's effort limit


def held_object(bench: Bench) -> Measured:
    """Hold a brick between two jaws in the air: the fingers push against each other and carry the weight together."""
    worlds = bench.worlds()
    state, closing = grasp(bench)
    end = worlds.advance(state, SETTLE)
    held = bench.twins
    contacts = worlds.contacts()[held]
    force = contacts.tip_force
    weight = GRAVITY * bench.objects[0].mass
    total = force.sum(1)
    # of each finger towards the other
    squeeze = torch.stack((force[:, 0] @ closing, -force[:, 1] @ closing), dim=1)
    return {
        "vertical force": total[:, 2] / weight - 1.0,
        "horizontal force": total[:, :2] / weight,
        "squeeze missing": (3.0 - squeeze).clamp_min(0.0),
        "fingers that do not say they touch": float((~contacts.tip_touch).sum()),
        "force of the table": contacts.table_force,
        "slip": (end.object_pos - state.object_pos)[held, 2],
    }


def shaken_grasp(bench: Bench) -> Measured:
    """Hold a brick for half a second, then shake it for two, up and down and sideways: it must stay in the palm."""
    worlds = bench.worlds()
    state, _ = grasp(bench)
    worlds.advance(state, SETTLE)
    names = bench.scene.robot.joint_names
    pos_before, quat_before = _in_palm(bench, worlds)
    for k in range(120):
        target = state.joint_target.clone()
        target[:, names.index("lift")] += 0.015 * math.sin(2 * math.pi * 2.0 * k / 60)
        target[:, names.index("swing")] += 0.1 * math.sin(2 * math.pi * 1.5 * k / 60)
        worlds.set_targets(target)
        worlds.step(round(1 / 60 / bench.scene.timestep))
    pos, quat = _in_palm(bench, worlds)
    return {
        "slip in the palm": pos - pos_before,
        "turn in the palm": quat_angle(quat.double(), quat_before.double()),
        "fingers that let go": float((~worlds.contacts().tip_touch[bench.twins]).sum()),
    }


def _in_palm(bench: Bench, worlds: Worlds) -> tuple[Tensor, Tensor]:
    """Position and orientation of the held objects in the palm's frame."""
    links = worlds.links()[bench.twins]
    now = worlds.state()[bench.twins]
    return relative_pose(now.object_pos, now.object_quat, links.pos[:, 0], links.quat[:, 0])


def tip_friction(bench: Bench) -> Measured:
    """Hold two bricks, one of them with slippery fingertips: that one must fall, the other must not."""
    worlds = bench.worlds()
    held, dropped = bench.twins
    friction = torch.tensor([0.9, 0.5, 0.6]).repeat(bench.NUM_WORLDS, 1)
    friction[dropped, 0] = 0.05
    worlds.set_parameter("friction", friction)
    state, _ = grasp(bench)
    fallen = state.object_pos[:, 2] - worlds.advance(state, SETTLE).object_pos[:, 2]
    return {
        "slip at mu = 0.9": fallen[held],
        "fall missing at mu = 0.05": max(0.0, 0.1 - float(fallen[dropped])),
    }


def coupled_jaw(bench: Bench) -> Measured:
    """Close a jaw of coupled joints on a heavy ball, and compare the work of its fingers with that of its drive.

    A coupling makes no work. So at rest, when the drive's joint moves by dq, the work of all fingers on the ball, force
    times way of the tip, is the drive's kp (target - q) dq. How the fingers share the force does not matter.
    """
    robot = replace(bench.free_scene.robot, gravity_compensated=True)
    scene = replace(bench.free_scene, robot=robot, objects=(_heavy_ball(),))
    joint, opening, closing = _jaw(bench)
    drive = robot.joints[joint].drive
    start = bench.initial(scene, [0])
    start.joint_pos[0, joint] = opening
    start.joint_target[0] = start.joint_pos[0]
    start.joint_target[0, joint] += closing * _SQUEEZE * drive.effort / drive.kp
    tips = [tip.link for tip in robot.fingertips]
    start.object_pos[0] = bench.kinematics.points(start.joint_pos[0].double(), tips).mean(0)
    with bench.other(scene) as worlds:
        worlds.set_parameter("object_gravity", torch.zeros(1))
        end = worlds.advance(start, 2 * SETTLE)
        contacts = worlds.contacts()
    force = contacts.tip_force[0].double()
    rates = bench.kinematics.jacobian(end.joint_pos[0].double(), tips).linear[..., joint]
    asked = drive.kp * (end.joint_target - end.joint_pos)[0, joint]
    return {
        "fingers that do not touch": float((~contacts.tip_touch).sum()),
        "force of the fingers": (force * rates).sum() / asked - 1.0,
    }


def _heavy_ball() -> ObjectSpec:
    light = ball()
    return replace(light, mass=_HEAVY * light.mass, inertia=_HEAVY * light.inertia)


def _jaw(bench: Bench) -> tuple[int, float, float]:
    """Return index of the joint that closes two fingertips, where they are as far apart as the ball is wide, and the
    sign of its closing; ``Skipped`` if no joint with couplings does."""
    robot = bench.scene.robot
    kinematics = bench.kinematics
    tips = [tip.link for tip in robot.fingertips]
    for source in dict.fromkeys(mimic.source for mimic in robot.mimics):
        joint = robot.joint_names.index(source)
        moved = kinematics.jacobian(kinematics.home, tips).linear[..., joint]
        if len(tips) != 2 or not moved.any(dim=-1).all():
            continue
        q = kinematics.home.repeat(1000, 1)
        q[:, joint] = torch.linspace(kinematics.lower[joint], kinematics.upper[joint], len(q))
        pads = kinematics.points(q, tips)
        apart = (pads[:, 0] - pads[:, 1]).norm(dim=-1)
        nearest = int((apart - _BALL_WIDTH).abs().argmin())
        if abs(float(apart[nearest]) - _BALL_WIDTH) < 1e-3:
            return joint, float(q[nearest, joint]), float((apart[0] - apart[-1]).sign())
    raise Skipped("no joint with couplings of this robot closes two fingertips on a ball of 60 mm")


def grasp(bench: Bench) -> tuple[State, Tensor]:
    """Return a state with the brick between the jaws, which close; and the direction [3] in which the thumb closes."""
    jaw = bench.scene.robot.joint_names.index("jaw_a_slide")
    state = bench.start()
    state.joint_pos[:, jaw] = 0.0201  # the brick's box is 0.040 m wide
    state.joint_target[:, jaw] = 0.010
    T_world_wrist = bench.kinematics.link_poses(state.joint_pos[0].double(), ["wrist"])[0]
    T_wrist_box = torch.eye(4, dtype=torch.float64)
    T_wrist_box[2, 3] = 0.075  # between the pads
    T_box_object = torch.linalg.inv(torch.as_tensor(bench.objects[0].pieces[0].T_body_shape))
    T_world_object = T_world_wrist @ T_wrist_box @ T_box_object
    state.object_pos[bench.twins] = T_world_object[:3, 3].float()
    state.object_quat[bench.twins] = matrix_to_quat(T_world_object[:3, :3]).float()
    return state, -T_world_wrist[:3, 0].float()
