"""Whether a robot can hold an object at two poses in the same grasp: at the start of an episode and at its goal.

No grasp is planned. The hand keeps the shape that it has at home, and the point between its thumb and its fingers goes
to the object's centre. N objects are tried at a time.
"""

from __future__ import annotations

from itertools import product

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.geometry.rotations import homogeneous
from xreset.retarget.arm.config import QUICK
from xreset.retarget.arm.model import ArmModel
from xreset.retarget.arm.solve import reach_poses
from xreset.retarget.validity import Thresholds
from xreset.spec import RobotSpec

_TILTS = (0.0, 30.0, -30.0)
"""Angles by which a grasp's fingers point further down than at home [degrees]."""
_YAWS = (0.0, 40.0, -40.0, 80.0, -80.0)
"""Angles by which a grasp is turned about the vertical [degrees]."""
_LOWEST = 0.05
"""Least height of the point between the fingers [m]: nearer to the table the shape of a real grasp matters."""
_THRESHOLDS = Thresholds(wrist_position=0.02, wrist_orientation=float(np.radians(15.0)))
"""A policy can choose its grasp, so the hand need not be exact."""


class Reach:
    """What one robot can hold."""

    def __init__(self, robot: RobotSpec) -> None:
        """Prepare the arm, and the grasps to try: home's orientation of the hand first, then others around it."""
        self._model = ArmModel(robot)
        self._hand_joints = self._model.hand.home
        tips = self._model.hand.points(self._hand_joints, [tip.link for tip in robot.fingertips])
        self._center = (tips[0] + tips[1:].mean(dim=0)).numpy() / 2
        kinematics = self._model.kinematics
        root = kinematics.link_poses(kinematics.home, [robot.hand_root])[0, :3, :3]
        at_home = Rotation.from_matrix(root.numpy())
        tilt_axis = np.cross((0.0, 0.0, 1.0), at_home.apply(self._center))
        tilt_axis /= max(np.linalg.norm(tilt_axis), 1e-9)
        turns = np.radians(list(product(_TILTS, _YAWS)))
        tilted = Rotation.from_rotvec(turns[:, :1] * tilt_axis) * at_home
        self._grasps = (Rotation.from_rotvec(turns[:, 1:] * (0.0, 0.0, 1.0)) * tilted).as_quat()
        self._base = np.array(robot.base_pos)
        self._stretch = float(np.linalg.norm(self._center)) + _THRESHOLDS.wrist_position
        link = robot.hand_root
        while link != kinematics.root:
            joint = kinematics.tree.above[link]
            self._stretch += float(np.linalg.norm(joint.T_parent_joint[:3, 3]))
            if joint.type == "prismatic":
                self._stretch += max(abs(joint.lower), abs(joint.upper))
            link = joint.parent

    def stretches_to(self, places: np.ndarray) -> np.ndarray:
        """[N] bool: whether places [N, 3] in the world are no farther from the base than the stretched arm, whether
        or not it can hold anything there."""
        return np.linalg.norm(places - self._base, axis=1) <= self._stretch

    def holds(self, start: np.ndarray, goal: np.ndarray, turn: Rotation) -> np.ndarray:
        """[N] bool: whether one of the grasps can be reached both at the start and at the goal.

        Args:
            start: [N, 3] centre of each object at the start, world frame [m].
            goal: [N, 3] its centre at the goal.
            turn: N rotations from the start to the goal.
        """
        held = np.zeros(len(start), dtype=bool)
        turns = turn.as_quat()
        tried = 0
        while tried < len(self._grasps) and not held.all():
            left = np.flatnonzero(~held)
            # the fewer objects are left, the more grasps at once
            grasps = self._grasps[tried : tried + max(1, len(self._grasps) // len(left))]
            tried += len(grasps)
            rows = np.repeat(left, len(grasps))
            hands = np.tile(grasps, (len(left), 1))
            can = self._reached(start[rows], Rotation.from_quat(hands))
            rows = rows[can]
            if len(rows):
                at_goal = Rotation.from_quat(turns[rows]) * Rotation.from_quat(hands[can])
                held[rows[self._reached(goal[rows], at_goal)]] = True
        return held

    def _reached(self, center: np.ndarray, hand: Rotation) -> np.ndarray:
        """[N] bool: whether the arm carries the hand to N orientations with the point between its fingers at [N, 3]."""
        center = np.column_stack((center[:, :2], np.maximum(center[:, 2], _LOWEST)))
        origin = torch.as_tensor(center - hand.apply(self._center))
        root = homogeneous(torch.as_tensor(hand.as_matrix()), origin)
        _, reason = reach_poses(self._model, root, self._hand_joints, _THRESHOLDS, QUICK)
        return (reason == 0).numpy()
