"""Finds arm joints that hold the hand at a place, clear of the table and of the robot itself: a home."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import torch

from xreset.geometry.collision import table_clearance
from xreset.retarget.arm.model import ArmModel
from xreset.retarget.arm.solve import reach_poses
from xreset.retarget.validity import Thresholds
from xreset.robot_tools.check import MOST_TOUCHING, touching_itself
from xreset.robot_tools.draft import rounded
from xreset.spec import RobotSpec

_STEPS = (-0.15, 0.0, 0.15)
"""[m] Steps along each axis to other places that are tried."""
_TRIED = 500
"""Random arm joints among which a home is sought that is clear of the table."""
_CLEAR = 0.10
"""[m] A home that is higher than this above the table keeps the spread around it clear of the table."""


def hold_near(robot: RobotSpec, T_world_root: np.ndarray) -> tuple[RobotSpec, str] | None:
    """Return the robot with a home that holds the hand's root at a pose [4, 4], or at the nearest pose next to it.

    A pose is preferred that has 10 cm of room above the table, and around which the arm rarely touches the robot.

    Returns:
        The robot, and where the hand is instead of the wanted pose (empty if it is there); or None if the arm reaches
        no pose.
    """
    steps = torch.tensor(list(product(_STEPS, _STEPS, _STEPS)), dtype=torch.float64)
    steps = steps[steps.norm(dim=1).argsort(stable=True)]
    found = _held_at(robot, T_world_root, steps[:1])
    if found is None or not found[2]:  # the others take time
        found = _held_at(robot, T_world_root, steps)
    if found is None:
        return None
    held, place, _ = found
    step = (100 * steps[place]).tolist()
    moved = f", moved by ({', '.join(f'{value:.0f}' for value in step)}) cm" if any(step) else ""
    return held, moved


def _held_at(
    robot: RobotSpec, T_world_root: np.ndarray, steps: torch.Tensor
) -> tuple[RobotSpec, int, bool] | None:
    """Return the robot with a home at the first place, of the pose [4, 4] moved by steps [S, 3], that is free; if there
    is none, at the first place that the arm reaches. Then the index of the place, and whether it is free: the arm is
    clear of the table and of itself."""
    model = ArmModel(robot)
    root = torch.as_tensor(T_world_root).repeat(len(steps), 1, 1)
    root[:, :3, 3] += steps
    hand = torch.as_tensor(robot.home[model.hand.joint_indices])
    joints, reason = reach_poses(model, root, hand, Thresholds())
    reached = np.flatnonzero(reason == 0)
    if not len(reached):
        return None
    height = table_clearance(model.kinematics, model.full(joints[reached], hand), model.table)
    clear = reached[(height > _CLEAR).numpy()]
    places = clear if len(clear) else reached
    for place in places:
        held = _with_arm_at(robot, model, joints[place].numpy())
        if touching_itself(held, moved_by_arm=True) <= MOST_TOUCHING:
            return held, int(place), len(clear) > 0
    return _with_arm_at(robot, model, joints[places[0]].numpy()), int(places[0]), False


def hold_up(robot: RobotSpec) -> RobotSpec:
    """Return the robot with the home, nearest to its own, that is clear of the table; its own if there is none."""
    model = ArmModel(robot)
    hand = torch.as_tensor(robot.home[model.hand.joint_indices])
    own = torch.as_tensor(robot.home[robot.arm_indices])
    draw = torch.rand(_TRIED, len(own), generator=torch.Generator().manual_seed(0), dtype=own.dtype)
    joints = torch.cat((own[None], model.lower + draw * (model.upper - model.lower)))
    joints = joints[(joints - own).norm(dim=1).argsort(stable=True)]
    height = table_clearance(model.kinematics, model.full(joints, hand), model.table)
    clear = (height > _CLEAR).numpy()
    return _with_arm_at(robot, model, joints[int(clear.argmax())].numpy())


def _with_arm_at(robot: RobotSpec, model: ArmModel, joints: np.ndarray) -> RobotSpec:
    positions = rounded(joints, model.lower.numpy(), model.upper.numpy())
    spec_joints = [*robot.joints]
    for index, position in zip(robot.arm_indices, positions.tolist(), strict=True):
        spec_joints[index] = replace(spec_joints[index], home=position)
    return replace(robot, joints=tuple(spec_joints))
