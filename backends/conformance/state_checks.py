"""Checks of what is set and read: states, links, joint order, mimic joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from xreset.backends.conformance.harness import (
    Bench,
    named,
    small_motion,
    stacked,
    state_errors,
)
from xreset.backends.conformance.results import Measured, Skipped
from xreset.backends.conformance.scene import reorder_joints
from xreset.cameras.config import CameraConfig, VisionConfig
from xreset.errors import XResetError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat, quat_angle
from xreset.geometry.urdf import robot_tree
from xreset.physics import Links, State
from xreset.spec import SceneSpec

if TYPE_CHECKING:
    from xreset.cameras.sensor import Cameras

_SAME_DEPTH = 2e-4
"""Difference between two depths of one pixel that counts as none [m]."""


def state_round_trip(bench: Bench) -> Measured:
    """Set a random state in every world and read it back."""
    worlds = bench.worlds()
    state = bench.random_state(seed=1)
    worlds.set(state)
    return state_errors(worlds.state(), state)


def same_pixels(bench: Bench) -> Measured:
    """Draw with the project's own renderer, from the states that the engine gives back, and from those that were
    set."""
    try:
        from xreset.cameras.sensor import Cameras
    except XResetError as error:  # Warp cannot be imported
        raise Skipped(str(error)) from error
    worlds = bench.worlds()
    vision = VisionConfig(cameras=(_view_of_object(bench), _view_of_hand(bench)))
    cameras = Cameras(bench.scene, torch.tensor(bench.object_index), vision)
    differing = []
    for seed in range(3):
        state = bench.random_state(seed)
        expected = _depths(cameras, state)
        worlds.set(state)
        differs = (_depths(cameras, worlds.state()) - expected).abs() > _SAME_DEPTH
        differing.append(differs.float().mean(dim=(-2, -1)))
    return {"pixels that differ": torch.stack(differing)}


def links_after_set(bench: Bench) -> Measured:
    """Set random states and compare the tracked links with the URDF's kinematics, without a step."""
    worlds = bench.worlds()
    errors = []
    for seed in range(100, 110):
        state = bench.random_state(seed)
        worlds.set(state)
        errors.append(_link_errors(bench.kinematics, state, worlds.links()))
    return _by_link(bench, stacked(errors))


def links_after_steps(bench: Bench) -> Measured:
    """Move every joint and compare the tracked links with the kinematics of the joints on the way: J(q) v."""
    return _errors_on_the_way(bench, ~_moved_by_mimics(bench.scene))


def mimic_joints(bench: Bench) -> Measured:
    """Do the same for links that a mimic joint moves; a stiff coupling lets it follow its source."""
    moved = _moved_by_mimics(bench.scene)
    if not moved.any():
        raise Skipped("no tracked link of this robot is moved by a mimic joint")
    errors = _errors_on_the_way(bench, moved)
    return {what: errors[what] for what in ("pos", "angle")}


def joint_order(bench: Bench) -> Measured:
    """Name the joints in another order: states still go by name, and a target moves the joint that it names."""
    scene = reorder_joints(bench.scene)
    kinematics = Kinematics(scene.robot)
    count = len(scene.robot.joints)
    object_index = [0] * count
    with bench.other(scene, object_index) as worlds:
        state = bench.random_state(3, scene.robot, count)
        worlds.set(state)
        links = _link_errors(kinematics, state, worlds.links())
        found = state_errors(worlds.state(), state)

        start = bench.initial(scene, object_index)
        motion = small_motion(kinematics)
        worlds.set(start)
        worlds.set_targets(start.joint_pos + torch.diag(motion))  # world i moves joint i
        # until they rest, a second for soft drives: an arm in motion shakes its fingers
        worlds.step(240)
        moved = (worlds.state().joint_pos - start.joint_pos) / motion
    wrong = moved - torch.eye(count)
    of_joints = {
        "joint_pos": found["joint_pos"],
        "joint_vel": found["joint_vel"],
        "way missing of the joint named": wrong.diagonal(),
        "way of others": wrong - torch.diag(wrong.diagonal()),
    }
    return {
        "pos": links["pos"],
        "angle": links["angle"],
        **named(scene.robot.joint_names, of_joints, dim=-1),
    }


def _view_of_object(bench: Bench) -> CameraConfig:
    """Return a camera that looks at the object of random states, from above the table."""
    x, y = bench.place
    return CameraConfig(pos=(x + 0.4, y + 0.4, 1.8), target=(x, y, 1.5))


def _view_of_hand(bench: Bench) -> CameraConfig:
    """Return a camera that looks at the palm at home, from beyond what the robot reaches."""
    robot = bench.scene.robot
    palm = bench.kinematics.points(bench.kinematics.home, [robot.palm])[0].numpy()
    ahead = palm[:2] - robot.base_pos[:2]
    ahead /= max(float(np.linalg.norm(ahead)), 1e-6)
    away = (*0.8 * ahead, 0.4) if ahead.any() else (0.8, 0.0, 0.4)
    return CameraConfig(pos=tuple((palm + away).tolist()), target=tuple(palm.tolist()))


def _depths(cameras: Cameras, state: State) -> Tensor:
    """Return the depths [N, C, H, W] that cameras would measure without errors."""
    everywhere = torch.ones(len(state.joint_pos), dtype=torch.bool)
    cameras.aim(state, state.object_pos, state.object_quat, everywhere)
    cameras.cast()
    return cameras.rays.depth.clone()


def _link_errors(kinematics: Kinematics, state: State, links: Links) -> dict[str, Tensor]:
    """Return the errors of the tracked links against the project's own kinematics of the same state."""
    q = state.joint_pos.double()
    qd = state.joint_vel.double()[:, None, :, None]
    tracked = kinematics.robot.tracked_links
    poses = kinematics.link_poses(q, tracked)
    jacobian = kinematics.jacobian(q, tracked)
    return {
        "pos": links.pos.double() - poses[..., :3, 3],
        "angle": quat_angle(links.quat.double(), matrix_to_quat(poses[..., :3, :3])),
        "linvel": links.linvel.double() - (jacobian.linear @ qd)[..., 0],
        "angvel": links.angvel.double() - (jacobian.angular @ qd)[..., 0],
    }


def _moved_by_mimics(scene: SceneSpec) -> Tensor:
    """[K] whether a mimic joint moves each tracked link."""
    tree = robot_tree(scene.robot)
    moved = set()
    for mimic in scene.robot.mimics:
        moved.update(tree.below(tree.joint(mimic.joint).child))
    return torch.tensor([link in moved for link in scene.robot.tracked_links])


def _errors_on_the_way(bench: Bench, chosen: Tensor) -> Measured:
    """Return the errors of some tracked links' poses and velocities, [T, N, ...], while every joint moves."""
    worlds = bench.worlds()
    worlds.set_targets(bench.start().joint_pos + small_motion(bench.kinematics))
    errors = []
    for _ in range(6):
        worlds.step(4)
        now = _link_errors(bench.kinematics, worlds.state(), worlds.links())
        errors.append(now)
    return _by_link(bench, stacked(errors), chosen.tolist())


def _by_link(
    bench: Bench, errors: Mapping[str, Tensor], chosen: Sequence[bool] | None = None
) -> Measured:
    """Return errors [T, N, K, ...] of the tracked links, or of those chosen [K], by their names."""
    links = np.array(bench.scene.robot.tracked_links)
    keep = np.ones(len(links), dtype=bool) if chosen is None else np.array(chosen)
    kept = {what: error[:, :, keep] for what, error in errors.items()}
    return named(links[keep].tolist(), kept, dim=2)
