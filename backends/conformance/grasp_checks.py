"""Checks of a brick held by the suite's own robot: forces of fingers, friction of fingertips, whether a grasp lasts."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from xreset.backends.conformance.harness import SETTLE, Bench, Worlds
from xreset.backends.conformance.results import Measured
from xreset.geometry.rotations import matrix_to_quat, quat_angle, relative_pose
from xreset.physics import State
from xreset.spec import GRAVITY


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
