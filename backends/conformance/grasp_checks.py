"""Checks of a brick held by the suite's own robot: forces of fingers, friction of fingertips, and whether a grasp lasts."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from xreset.backends.conformance.harness import Bench, largest, replace_fields, rotation_angle, snapshot
from xreset.backends.conformance.results import Check, Measure
from xreset.geometry.rotations import matrix_to_quat, quat_conjugate, quat_multiply, quat_rotate
from xreset.physics import State
from xreset.spec import GRAVITY

_SETTLE = 120  # steps


def held_object(bench: Bench) -> list[Measure]:
    """Hold a brick between two jaws in the air: each finger's force points at the other finger, together they carry the weight."""
    backend = bench.backend()
    state, closing = grasp(bench)
    backend.set_state(state.to(backend.device))
    backend.step(_SETTLE)
    end, contacts = snapshot(backend.state()), backend.contacts()
    held = bricks(bench)
    force = contacts.tip_force.cpu()[held]
    weight = GRAVITY * bench.objects[0].mass
    total = force.sum(1)
    squeeze = torch.stack((force[:, 0] @ closing, -force[:, 1] @ closing), dim=1)  # of thumb and index finger, each towards the other
    return [
        Measure(what="vertical force", measured=largest(total[:, 2] / weight - 1.0), tolerance=0.05, unit="of m g"),
        Measure(what="horizontal force", measured=largest(total[:, :2] / weight), tolerance=0.05, unit="of m g"),
        Measure(what="squeeze missing", measured=float((3.0 - squeeze).clamp_min(0.0).max()), tolerance=1.5, unit="N"),
        Measure(what="fingers that do not say they touch", measured=float((~contacts.tip_touch.cpu()[held]).sum()), tolerance=0.5),
        Measure(what="force of the table", measured=largest(contacts.table_force[held]), tolerance=1e-6, unit="N"),
        Measure(what="slip", measured=largest(end.object_pos[held, 2] - state.object_pos[held, 2]), tolerance=5e-3, unit="m"),
    ]


def tip_friction(bench: Bench) -> list[Measure]:
    """Hold two bricks, one of them with slippery fingertips: that one must fall, the other must not."""
    backend = bench.altered()
    held, dropped = bricks(bench)
    friction = torch.tensor([0.9, 0.5, 0.6]).repeat(bench.NUM_WORLDS, 1)
    friction[dropped, 0] = 0.05
    backend.set_friction(friction.to(backend.device))
    state, _ = grasp(bench)
    backend.set_state(state.to(backend.device))
    backend.step(_SETTLE)
    fallen = state.object_pos[:, 2] - snapshot(backend.state()).object_pos[:, 2]
    return [
        Measure(what="slip at mu = 0.9", measured=abs(float(fallen[held])), tolerance=5e-3, unit="m"),
        Measure(what="fall missing at mu = 0.05", measured=max(0.0, 0.1 - float(fallen[dropped])), tolerance=0.05, unit="m"),
    ]


def shaken_grasp(bench: Bench) -> list[Measure]:
    """Hold a brick for half a second, then shake it for two, up and down and sideways: it must stay where it is in the palm."""
    backend = bench.backend()
    state, _ = grasp(bench)
    backend.set_state(state.to(backend.device))
    backend.step(_SETTLE)
    names, held = bench.scene.robot.joint_names, bricks(bench)
    lift, swing = names.index("lift"), names.index("swing")

    def in_palm() -> tuple[Tensor, Tensor]:
        """Position and orientation of the held objects in the palm's frame."""
        links, now = backend.links(), snapshot(backend.state())
        palm, inverse = links.pos[held, 0].cpu(), quat_conjugate(links.quat[held, 0].cpu())
        return quat_rotate(inverse, now.object_pos[held] - palm), quat_multiply(inverse, now.object_quat[held])

    before = in_palm()
    for k in range(120):
        target = state.joint_target.clone()
        target[:, lift] += 0.015 * math.sin(2 * math.pi * 2.0 * k / 60)
        target[:, swing] += 0.1 * math.sin(2 * math.pi * 1.5 * k / 60)
        backend.set_joint_targets(target.to(backend.device))
        backend.step(round(1 / 60 / bench.scene.timestep))
    after = in_palm()
    return [
        Measure(what="slip in the palm", measured=largest(after[0] - before[0]), tolerance=4e-3, unit="m"),
        Measure(what="turn in the palm", measured=largest(rotation_angle(after[1], before[1])), tolerance=0.1, unit="rad"),
        Measure(what="fingers that let go", measured=float((~backend.contacts().tip_touch.cpu()[held]).sum()), tolerance=0.5),
    ]


def bricks(bench: Bench) -> list[int]:
    """Worlds that hold the first object."""
    return [0, len(bench.scene.objects)]


def grasp(bench: Bench) -> tuple[State, Tensor]:
    """A state with the brick between the jaws of the suite's robot, which close; and the direction in which the thumb closes [3]."""
    robot = bench.scene.robot
    jaw = robot.joint_names.index("jaw_a_slide")
    state = bench.start()
    pos, target = state.joint_pos.clone(), state.joint_target.clone()
    pos[:, jaw], target[:, jaw] = 0.0201, 0.010  # the brick's box is 0.040 m wide
    T_world_wrist = bench.kinematics.link_poses(pos[0].double(), ["wrist"])[0]
    T_wrist_box = torch.eye(4, dtype=torch.float64)
    T_wrist_box[2, 3] = 0.075  # between the pads
    T_world_object = T_world_wrist @ T_wrist_box @ torch.linalg.inv(torch.as_tensor(bench.objects[0].pieces[0].T_body_shape))
    held = bricks(bench)
    object_pos, object_quat = state.object_pos.clone(), state.object_quat.clone()
    object_pos[held] = T_world_object[:3, 3].float()
    object_quat[held] = matrix_to_quat(T_world_object[:3, :3]).float()
    grasp = replace_fields(state, joint_pos=pos, joint_target=target, object_pos=object_pos, object_quat=object_quat)
    return grasp, -T_world_wrist[:3, 0].float()


CHECKS = (
    Check(
        name="held_object",
        group="contact",
        statement="fingers carry a held object; each one's force on it has the right sign and names the right finger",
        cause="forces are by the object, not on it; or go to the wrong finger; or the mimic jaw gives way; or the drive's force is wrong",
        run=held_object,
        own_robot_only=True,
    ),
    Check(
        name="shaken_grasp",
        group="contact",
        statement="a grasp holds its object for 2 s under shaking",
        cause="contacts creep: too few solver iterations, a friction pyramid, soft contacts, too large contact offsets; or weak drives",
        run=shaken_grasp,
        own_robot_only=True,
    ),
    Check(
        name="tip_friction",
        group="contact",
        statement="an object is held or slips by the friction of the pair with the fingertips",
        cause="the fingertips' friction is not set where their contact links are, or not world by world",
        run=tip_friction,
        capabilities=("friction",),
        own_robot_only=True,
    ),
)
