"""A hand as retargeting sees it: a floating tree, the links that follow human keypoints, and the balls that keep it out of things.

Shape letters: B frames, P mapped keypoints, C pairs of keypoints, J hand joints, n = J + 6 variables, L links, Q balls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.balls import hand_balls
from xreset.geometry.collision import SelfCollision
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_to_matrix
from xreset.retarget.hand.pads import pads_of
from xreset.spec import FINGERS, KEYPOINTS, RobotSpec, TableSpec


@dataclass(frozen=True)
class Bodies:
    """Links of the hand and how they move with the variables."""

    pos: Tensor
    """[B, L, 3]"""
    rot: Tensor
    """[B, L, 3, 3]"""
    linear: Tensor
    """[B, L, 3, n] derivative of the position."""
    angular: Tensor
    """[B, L, 3, n] angular velocity per variable."""


class HandModel:
    """A robot's hand as a floating tree, and which of its links follow which human keypoints."""

    def __init__(self, robot: RobotSpec, *, device: torch.device | str = "cpu") -> None:
        """Prepare the hand.

        Raises:
            RobotError: the description does not allow retargeting; the message says which entry is wrong.
        """
        self.robot = robot
        self.kinematics = Kinematics(robot, root=robot.hand_root, device=device)
        self.device = self.kinematics.device
        if not np.array_equal(self.kinematics.joint_indices, robot.hand_indices):
            below, group = self.kinematics.joint_names, [robot.joint_names[i] for i in robot.hand_indices]
            raise RobotError(
                f"robot {robot.name!r}: the joints below the hand root {robot.hand_root!r} are {', '.join(below)}, but the hand group is "
                f"{', '.join(group)}. Choose the last link that the arm moves as hand_root."
            )
        self.names: tuple[str, ...] = tuple(spec.keypoint for spec in robot.keypoints)
        """Human keypoint of each mapped keypoint (length P)."""
        self.links: tuple[str, ...] = tuple(spec.link for spec in robot.keypoints)
        """Link of each mapped keypoint."""
        for name, link in zip(self.names, self.links, strict=True):
            if name not in KEYPOINTS:
                raise RobotError(
                    f"robot {robot.name!r}: there is no human keypoint {name!r}; there are {', '.join(KEYPOINTS)}."
                )
            self.kinematics.link_index(link)
        if len(set(self.links)) < 3:
            raise RobotError(
                f"robot {robot.name!r}: {len(set(self.links))} links follow keypoints, expected 3 or more (wrist, thumb, finger)."
            )
        self.keypoint_indices = np.array([KEYPOINTS.index(name) for name in self.names])
        """[P] indices into the 21 human keypoints."""
        tips = {tip.keypoint for tip in robot.fingertips}
        self.is_tip = torch.tensor([name in tips for name in self.names], device=self.device)
        """[P] whether a fingertip follows the keypoint."""
        self.pairs = torch.tensor(keypoint_pairs(self.names, self.links), device=self.device)
        """[C, 2] pairs of mapped keypoints whose difference is matched."""
        self.home = torch.as_tensor(robot.home[robot.hand_indices], device=self.device)
        """[J] home configuration of the hand."""
        upright = self.home.new_tensor([1.0, 0.0, 0.0, 0.0])
        self.at_home = self.keypoints(self.kinematics.clamp(self.home), self.home.new_zeros(3), upright)
        """[P, 3] keypoints at home, in the root's frame."""
        self.table = TableSpec()

        on_cpu = (
            self.kinematics if self.device.type == "cpu" else Kinematics(robot, root=robot.hand_root)
        )  # as coal wants it
        collision = SelfCollision(robot, on_cpu, only=robot.self_collision_links)
        self.balls = hand_balls(robot, on_cpu, collision).to(self.device)
        """What keeps the hand out of the object, the table and itself."""
        self.pads = pads_of(robot.fingertips, self.kinematics, self.balls, self.home)
        """Those of a jaw; empty for any other hand."""
        self._bodies = tuple(dict.fromkeys((*self.links, *self.balls.links)))
        self._keypoint_bodies = torch.tensor([self._bodies.index(link) for link in self.links], device=self.device)
        self.group_body = torch.tensor(
            [self._bodies.index(link) for link in self.balls.links], dtype=torch.long, device=self.device
        )
        """[G] index among the bodies of each link with balls."""

    def keypoints(self, joints: Tensor, root_pos: Tensor, root_quat: Tensor) -> Tensor:
        """[..., P, 3] positions of the keypoint links."""
        return self.kinematics.points(joints, self.links, base=_pose(root_pos, root_quat))

    def bodies(self, joints: Tensor, root_pos: Tensor, root_quat: Tensor) -> Bodies:
        """Links of the hand at joints [B, J] and root poses, and their Jacobians by the variables.

        Variables: joints, then translation of the root, then rotation of the root about its origin (both along the world's axes).
        """
        links = self.kinematics.jacobian(joints, self._bodies, base=_pose(root_pos, root_quat))
        identity = torch.eye(3, dtype=links.pos.dtype, device=links.pos.device).expand(*links.pos.shape[:-1], 3, 3)
        turn = torch.linalg.cross(identity, (links.pos - root_pos[:, None])[..., None, :])  # row i: e_i x r
        return Bodies(
            pos=links.pos,
            rot=links.rot,
            linear=torch.cat((links.linear, identity, turn.mT), dim=-1),
            angular=torch.cat((links.angular, torch.zeros_like(identity), identity), dim=-1),
        )

    def keypoints_of(self, bodies: Bodies) -> tuple[Tensor, Tensor]:
        """Keypoints [B, P, 3] and their Jacobian [B, P, 3, n]."""
        return bodies.pos[:, self._keypoint_bodies], bodies.linear[:, self._keypoint_bodies]

    def ball_centers(self, bodies: Bodies, frame: Tensor, ball: Tensor) -> Tensor:
        """[..., 3] centres in the world of balls [...] in frames [...]."""
        body = self.group_body[self.balls.link[ball]]
        return bodies.pos[frame, body] + (bodies.rot[frame, body] @ self.balls.centers[ball][..., None])[..., 0]

    def point_slope(self, bodies: Bodies, frame: Tensor, group: Tensor, point: Tensor, direction: Tensor) -> Tensor:
        """[A, n] how a point of a link moves along a direction: n . (v + w x r) = n . v + (r x n) . w.

        Args:
            frame: [A]
            group: [A] the point's link, among the links with balls.
            point: [A, 3] in the world.
            direction: [A, 3] unit vectors n.
        """
        body = self.group_body[group]
        lever = torch.linalg.cross(point - bodies.pos[frame, body], direction)
        along = direction[:, None] @ bodies.linear[frame, body] + lever[:, None] @ bodies.angular[frame, body]
        return along[:, 0]


def predicted_gigabytes(model: HandModel) -> float:
    """Memory that hand retargeting on the CPU will take [GB], all balls of a chunk of 256 frames being near something: an upper bound."""
    return 0.5 + 256 * 400e-9 * len(model.balls.radii)


def keypoint_pairs(names: Sequence[str], links: Sequence[str]) -> list[tuple[int, int]]:
    """Pairs of mapped keypoints: along each finger from the wrist, between neighbouring knuckles, and from the thumb's tip to the others.

    Works for any subset of the 21 keypoints; pairs on one and the same link say nothing and are left out.
    """
    wrist = [i for i, name in enumerate(names) if name == "wrist"]
    fingers = [
        sorted((i for i, name in enumerate(names) if name.startswith(f)), key=lambda i: names[i]) for f in FINGERS
    ]  # base to tip
    pairs = [pair for finger in fingers for pair in pairwise(wrist + finger)]
    thumb, others = fingers[0], [finger for finger in fingers[1:] if finger]
    for left, right in pairwise(others):
        pairs += [(left[0], right[0]), (left[-1], right[-1])]
    pairs += [(thumb[-1], finger[-1]) for finger in others if thumb]
    return [(a, b) for a, b in dict.fromkeys(pairs) if links[a] != links[b]]


def _pose(pos: Tensor, quat: Tensor) -> Tensor:
    T = pos.new_zeros(*pos.shape[:-1], 4, 4)
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = quat_to_matrix(quat), pos, 1.0
    return T
