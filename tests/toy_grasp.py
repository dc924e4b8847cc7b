"""A grasp for tests: the conformance suite's gripper with its jaws just around a brick in the air. It closes and lifts; how hard it presses
decides whether half the friction, or half the drive's stiffness, is still enough."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from tests.toy_bank import toy_bank
from xreset import PolicySpec
from xreset.backends.conformance.scene import gripper, objects
from xreset.eval.engines.recording import Recording
from xreset.eval.rollout import Trial
from xreset.geometry.kinematics import Kinematics
from xreset.physics import State
from xreset.spec import PairFriction, SceneSpec
from xreset.task.config import ResetConfig, TaskConfig

FRICTION = PairFriction(tip=0.9, link=0.5, table=0.6, torsional=0.002)
OPEN = 0.0201
CLOSED = 0.0141
"""Positions and targets [m] of a jaw: each finger then presses with 2.5 N, and 0.9 of that, twice, is 1.8 times the brick's weight."""
AT_HOME = ResetConfig(demo_probability=0.0, home_gravity_std=0.0, spawn_xy=0.0, spawn_yaw=0.0)
"""Every episode begins at home, with nothing at random. The robot has no spread at home."""
RAISED = 0.04
"""How far the lift goes [m]."""


def robot():
    """The gripper, at home with its jaws around the brick."""
    spec = gripper()
    return replace(
        spec,
        joints=tuple(replace(j, home=OPEN) if j.name == "jaw_a_slide" else j for j in spec.joints),
        home_std=(0.0, 0.0),
    )


def brick():
    return objects()[0]


def found(objects=()):
    """Let every file find the gripper and these objects (default: the brick), while it is entered."""
    return patch.multiple(
        "xreset.resets.inputs",
        load_robot=lambda _: robot(),
        load_objects=lambda *_: objects or (brick(),),
        object_source=lambda *_: "stand-in",
    )


def scene():
    return SceneSpec(robot=robot(), objects=(brick(),), friction=FRICTION)


def brick_pose(joints=None):
    """Where the brick is, between the pads of the robot with these joints (None: at home): position [3], quaternion [4]."""
    spec = robot()
    joints = spec.home if joints is None else joints
    T = Kinematics(spec).link_poses(torch.as_tensor(joints), ["wrist"])[0].numpy()
    T_wrist_box = np.eye(4)
    T_wrist_box[2, 3] = 0.075
    T = T @ T_wrist_box @ np.linalg.inv(brick().pieces[0].T_body_shape)
    return T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)


def start():
    """[1] the robot at home, the brick between its jaws, everything at rest."""
    pos, quat = brick_pose()
    return State.at_rest(
        torch.as_tensor(robot().home)[None], torch.as_tensor(pos)[None], torch.as_tensor(quat)[None]
    )


def targets(step):
    """[J] what the drives are told: close at once, and lift from step 15 to 45."""
    spec = robot()
    wanted = spec.home.copy()
    wanted[spec.joint_names.index("jaw_a_slide")] = CLOSED
    wanted[spec.joint_names.index("lift")] += RAISED * np.clip((step - 15) / 30, 0, 1)
    return wanted


def recording(*, steps=20, worlds=1, joints=5, **changes):
    """A recording with two fingertips in which nothing moves and nothing touches; ``changes`` replace fields."""
    upright = torch.tensor([1.0, 0, 0, 0])
    still = State.at_rest(
        torch.zeros(worlds, joints), torch.zeros(worlds, 3), upright.expand(worlds, 4)
    )
    fields = {
        "joint_pos": torch.zeros(steps, worlds, joints),
        "joint_target": torch.zeros(steps, worlds, joints),
        "object_pos": torch.zeros(steps, worlds, 3),
        "object_quat": upright.expand(steps, worlds, 4),
        "palm_pos": torch.zeros(steps, worlds, 3),
        "palm_quat": upright.expand(steps, worlds, 4),
        "tip_force": torch.zeros(steps, worlds, 2, 3),
        "tip_touch": torch.zeros(steps, worlds, 2, dtype=torch.bool),
        "broken": torch.zeros(worlds, dtype=torch.bool),
    }
    return Recording(start=still, **fields | changes)


def bank():
    """Three demonstrations whose starts are millimetres apart, and whose goals are where the lift ends."""
    pos, quat = brick_pose()
    start_pos = pos + np.array([[0, 0, -1e-3], [0, 0, 0], [0, 0, 1e-3]])
    return toy_bank(
        robot(),
        object_name=np.full(6, "brick"),
        sequence_object=np.full(3, "brick"),
        object_names=("brick",),
        object_sources=("stand-in",),
        start_pos=start_pos,
        start_quat_wxyz=np.tile(quat, (3, 1)),
        goal_pos=start_pos + np.array([0, 0, RAISED]),
        goal_quat_wxyz=np.tile(quat, (3, 1)),
    )


def grasps(**changes):
    """The bank with six states in which the brick is between the jaws of the robot at home; ``changes`` replace fields."""
    pos, quat = brick_pose()
    at_home = {"joint_pos": robot().home, "object_pos": pos, "object_quat_wxyz": quat}
    states = {name: np.tile(row, (6, 1)).astype(np.float32) for name, row in at_home.items()}
    return replace(bank(), **states | changes)


def trial(task, **setting):
    return Trial(robot=robot(), objects=(brick(),), bank=bank(), task=task, **setting)


def policy():
    """The policy :class:`OpenLoop` by name."""
    return PolicySpec(
        name="open-loop",
        start=lambda motion: OpenLoop(),
        robot=robot(),
        task=TaskConfig(),
        folder=Path("eval"),
    )


class OpenLoop:
    """The policy that gives :func:`targets`."""

    def begin(self, env):
        self._env = env
        self._step = 0

    def act(self, observations):
        wanted = torch.as_tensor(targets(self._step), dtype=torch.float32).expand(
            self._env.num_envs, -1
        )
        self._step += 1
        return self._env.actions.action_for(wanted, self._env.joint_target)


def with_scene(base, name, change):
    """The engine under another name, whose worlds are of ``change(scene)``: a deliberate mistake."""

    def make(scene, num_worlds, object_index):
        return base.make(change(scene), num_worlds, object_index)

    return replace(base, name=name, make=make)
