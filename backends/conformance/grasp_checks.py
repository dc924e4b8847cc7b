"""Checks of a brick held by the suite's own robot: forces of fingers, friction of fingertips, and whether a grasp lasts."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from xreset.backends.conformance.harness import Bench, advanced, largest, replace_fields, rotation_angle, snapshot
from xreset.backends.conformance.results import Measure, checks_of
from xreset.geometry.rotations import matrix_to_quat, quat_conjugate, quat_multiply, quat_rotate
from xreset.physics import State
from xreset.spec import GRAVITY

check = checks_of("contact")

_SETTLE = 120  # steps


@check(
    "fingers carry a held object; each one's force on it has the right sign and names the right finger",
    "forces are by the object, not on it; or go to the wrong finger; or the mimic jaw gives way; or the drive's force is wrong",
    own_robot_only=True,
)
def held_object(bench: Bench) -> list[Measure]:
    """Hold a brick between two jaws in the air: each finger's force points at the other finger, together they carry the weight."""
    backend = bench.backend()
    state, closing = grasp(bench)
    end, contacts = advanced(backend, state, _SETTLE), backend.contacts()
    held = bricks(bench)
    force = contacts.tip_force.cpu()[held]
    weight = GRAVITY * bench.objects[0].mass
    total = force.sum(1)
    squeeze = torch.stack(
        (force[:, 0] @ closing, -force[:, 1] @ closing), dim=1
    )  # of thumb and index finger, each towards the other
    return [
        Measure("vertical force", largest(total[:, 2] / weight - 1.0), 0.05, "of m g"),
        Measure("horizontal force", largest(total[:, :2] / weight), 0.05, "of m g"),
        Measure("squeeze missing", float((3.0 - squeeze).clamp_min(0.0).max()), 1.5, "N"),
        Measure("fingers that do not say they touch", float((~contacts.tip_touch.cpu()[held]).sum()), 0.5),
        Measure("force of the table", largest(contacts.table_force[held]), 1e-6, "N"),
        Measure("slip", largest(end.object_pos[held, 2] - state.object_pos[held, 2]), 5e-3, "m"),
    ]


@check(
    "a grasp holds its object for 2 s under shaking",
    "contacts creep: too few solver iterations, a friction pyramid, soft contacts, too large contact offsets; or weak drives",
    own_robot_only=True,
)
def shaken_grasp(bench: Bench) -> list[Measure]:
    """Hold a brick for half a second, then shake it for two, up and down and sideways: it must stay where it is in the palm."""
    backend = bench.backend()
    state, _ = grasp(bench)
    advanced(backend, state, _SETTLE)
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
        Measure("slip in the palm", largest(after[0] - before[0]), 4e-3, "m"),
        Measure("turn in the palm", largest(rotation_angle(after[1], before[1])), 0.1, "rad"),
        Measure("fingers that let go", float((~backend.contacts().tip_touch.cpu()[held]).sum()), 0.5),
    ]


@check(
    "an object is held or slips by the friction of the pair with the fingertips",
    "the fingertips' friction is not set where their contact links are, or not world by world",
    capabilities=("friction",),
    own_robot_only=True,
)
def tip_friction(bench: Bench) -> list[Measure]:
    """Hold two bricks, one of them with slippery fingertips: that one must fall, the other must not."""
    backend = bench.altered()
    held, dropped = bricks(bench)
    friction = torch.tensor([0.9, 0.5, 0.6]).repeat(bench.NUM_WORLDS, 1)
    friction[dropped, 0] = 0.05
    backend.set_friction(friction.to(backend.device))
    state, _ = grasp(bench)
    fallen = state.object_pos[:, 2] - advanced(backend, state, _SETTLE).object_pos[:, 2]
    return [
        Measure("slip at mu = 0.9", abs(float(fallen[held])), 5e-3, "m"),
        Measure("fall missing at mu = 0.05", max(0.0, 0.1 - float(fallen[dropped])), 0.05, "m"),
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
    T_world_object = (
        T_world_wrist @ T_wrist_box @ torch.linalg.inv(torch.as_tensor(bench.objects[0].pieces[0].T_body_shape))
    )
    held = bricks(bench)
    object_pos, object_quat = state.object_pos.clone(), state.object_quat.clone()
    object_pos[held] = T_world_object[:3, 3].float()
    object_quat[held] = matrix_to_quat(T_world_object[:3, :3]).float()
    grasp = replace_fields(state, joint_pos=pos, joint_target=target, object_pos=object_pos, object_quat=object_quat)
    return grasp, -T_world_wrist[:3, 0].float()
