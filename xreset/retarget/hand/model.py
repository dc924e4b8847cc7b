"""The model of a hand for retargeting: a floating tree, the links that follow human keypoints, and the balls that keep
the hand out of the object, the table and itself.

Shape letters: S sequences padded to T frames, B frames, P mapped keypoints, C pairs of keypoints, J hand joints, n = J
+ 6 variables, L links, Q balls, N balls of pads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.geometry.balls import Balls, hand_balls
from xreset.geometry.collision import SelfCollision
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import homogeneous, matvec, quat_to_matrix
from xreset.geometry.solids import link_field
from xreset.geometry.urdf import robot_tree
from xreset.physics.tensors import Tensors
from xreset.spec import FINGERS, KEYPOINTS, RobotSpec, TableSpec

_PAD_DEPTH = 1e-3
"""A finger's pad consists of its balls at most this far behind the foremost one, towards the other finger [m]."""


@frozen
class HandTargets(Tensors):
    """Human motion that the hand follows; all tensors on one device."""

    keypoints: Tensor
    """[S, T, P, 3] human keypoints [m]; any finite values where not annotated."""
    annotated: Tensor
    """[S, T] bool: whether a frame has keypoints. Smoothness alone determines the other frames."""
    contact_points: Tensor
    """[S, T, P, 3] object surface points that the keypoints touch."""
    in_contact: Tensor
    """[S, T, P] bool"""
    held: Tensor
    """[S, T] bool: the human's thumb and another finger touch the object; False where not annotated."""
    object_pos: Tensor
    """[S, T, 3] origin of the object's mesh frame [m]."""
    object_quat: Tensor
    """[S, T, 4]"""
    object_index: Tensor
    """[S] object of each sequence, as an index into ``fields``."""
    fields: DistanceFields
    """Signed distances to the objects' surfaces."""

    @property
    def inside(self) -> Tensor:
        """[S, T] bool: from the first annotated frame to the last."""
        seen = self.annotated.int()
        return (seen.cumsum(1) > 0) & (seen.flip(1).cumsum(1) > 0).flip(1)


@dataclass(frozen=True)
class HandState(Tensors):
    """The variables: joints and root pose of every frame."""

    joints: Tensor
    """[S, T, J] rad (m)"""
    root_pos: Tensor
    """[S, T, 3] position of the link that carries the hand [m]."""
    root_quat: Tensor
    """[S, T, 4]"""

    @property
    def root(self) -> Tensor:
        """[S, T, 4, 4] pose of the root."""
        return homogeneous(quat_to_matrix(self.root_quat), self.root_pos)


@lru_cache(maxsize=8)
def _balls_of(robot: RobotSpec, fingerprint: str) -> Balls:
    """Fill a robot's hand, which takes a while, once in a process; the fingerprint is also of its files."""
    hand = Kinematics(robot, root=robot.hand_root)
    return hand_balls(hand, SelfCollision(hand, only=robot.self_collision_links))


@lru_cache(maxsize=8)
def _solids_of(robot: RobotSpec, fingerprint: str) -> DistanceFields:
    """Return the distances to the links that have balls, which take longer than the balls, once in a process."""
    tree = robot_tree(robot)
    links = _balls_of(robot, fingerprint).links
    return DistanceFields.join([link_field(tree.link(name).collisions) for name in links])


class HandModel:
    """A robot's hand as a floating tree, and the human keypoints that its links follow."""

    def __init__(self, robot: RobotSpec, *, device: torch.device | str = "cpu") -> None:
        """Prepare the hand.

        Raises:
            RobotError: the description does not allow retargeting; the message names the wrong entry.
        """
        self.robot = robot
        self.kinematics = Kinematics(robot, root=robot.hand_root, device=device)
        self.device = self.kinematics.device
        if not np.array_equal(self.kinematics.joint_indices, robot.hand_indices):
            below = ", ".join(self.kinematics.joint_names)
            group = ", ".join(robot.joint_names[i] for i in robot.hand_indices)
            raise RobotError(
                f"robot {robot.name!r}: the joints below the hand root {robot.hand_root!r} are {below}, but the hand "
                f"group is {group}. Choose the last link that the arm moves as hand_root."
            )
        self.keypoint_names = tuple(spec.keypoint for spec in robot.keypoints)
        """Human keypoint of each mapped keypoint (length P)."""
        self.keypoint_links = tuple(spec.link for spec in robot.keypoints)
        """Link of each mapped keypoint."""
        count = len(set(self.keypoint_links))
        if count < 3:
            raise RobotError(
                f"robot {robot.name!r}: {count} links follow keypoints, expected 3 or more (wrist, thumb, finger)."
            )
        self.keypoint_indices = np.array([KEYPOINTS.index(name) for name in self.keypoint_names])
        """[P] indices into the 21 human keypoints."""
        tips = [tip.keypoint for tip in robot.fingertips]
        self.is_tip = torch.tensor(
            [name in tips for name in self.keypoint_names], device=self.device
        )
        """[P] whether a fingertip follows the keypoint."""
        if not self.is_tip.any():
            raise RobotError(
                f"robot {robot.name!r}: no link follows a fingertip's keypoint. Add {', '.join(tips)} to keypoints."
            )
        self.pairs = torch.tensor(
            keypoint_pairs(self.keypoint_names, self.keypoint_links), device=self.device
        )
        """[C, 2] pairs of mapped keypoints whose difference is matched."""
        self.home = self.kinematics.home
        """[J] home configuration of the hand."""
        self.is_jaw = len(self.home) == 1 and len(robot.fingertips) == 2
        """Whether the hand is a jaw: one joint moves two fingers."""
        upright = self.home.new_tensor([1.0, 0.0, 0.0, 0.0])
        joints = self.kinematics.clamp(self.home)
        self.at_home = self.keypoints(HandState(joints, upright.new_zeros(3), upright))
        """[P, 3] keypoints at home, in the root's frame."""
        self.table = TableSpec()

        self.balls = _balls_of(robot, robot.fingerprint).to(self.device)
        """Balls that keep the hand out of the object, the table and itself."""
        pads = self._pads()
        self.pad_balls = torch.cat(pads)
        """[N] the balls of a jaw's two pads, as indices of the balls; empty for any other hand."""
        self.pad_shares = torch.cat(
            [self.home.new_full((len(pad),), 1.0 / max(len(pad), 1)) for pad in pads]
        )
        """[N] share of each of these balls in its pad: the shares of a pad add up to 1."""
        self._bodies = tuple(dict.fromkeys((*self.keypoint_links, *self.balls.links)))
        self.keypoint_body = self._body_indices(self.keypoint_links)
        """[P] index among the bodies of each keypoint's link."""
        self.group_body = self._body_indices(self.balls.links)
        """[G] index among the bodies of each link with balls."""
        self.keypoint_groups = [self._links_with(link) for link in self.keypoint_links]
        """Links with balls that move together with each keypoint's link, as indices of ``balls.links`` (length P)."""

    @cached_property
    def solids(self) -> DistanceFields:
        """Signed distances to the links with balls, in their frames; balls of other links stay out of them."""
        return _solids_of(self.robot, self.robot.fingerprint).to(self.device)

    def _links_with(self, link: str) -> list[int]:
        """Return the links with balls of a link's rigid body, as indices of ``balls.links``."""
        body = self.kinematics.tree.moving_ancestor
        return [i for i, other in enumerate(self.balls.links) if body(other) == body(link)]

    def _body_indices(self, links: Sequence[str]) -> Tensor:
        indices = [self._bodies.index(link) for link in links]
        return torch.tensor(indices, dtype=torch.long, device=self.device)

    def _pads(self) -> list[Tensor]:
        """Return the balls of a jaw's two pads, the sides of its fingers that face each other at home; empty for other
        hands.

        A jaw presses along one axis only. If it followed only the human's fingertips, it would touch the object at an
        angle, with an edge of each pad, and squeeze it out.
        """
        none = [torch.zeros(0, dtype=torch.long, device=self.device)]
        if not self.is_jaw:
            return none
        fingertips = self.robot.fingertips
        balls = self.balls
        first, second = self.kinematics.points(self.home, [tip.link for tip in fingertips])
        poses = self.kinematics.link_poses(self.home, balls.links)[balls.link]
        centers = matvec(poses[:, :3, :3], balls.centers) + poses[:, :3, 3]
        pads = []
        for tip, ahead in zip(fingertips, (second - first, first - second), strict=True):
            own = torch.tensor(
                [link in tip.contact_links for link in balls.links], device=self.device
            )[balls.link]
            if not own.any():
                return none
            front = centers @ (ahead / ahead.norm().clamp_min(1e-9)) + balls.radii
            pads.append((own & (front > front[own].max() - _PAD_DEPTH)).nonzero()[:, 0])
        return pads

    def keypoints(self, state: HandState) -> Tensor:
        """[..., P, 3] positions of the links that follow keypoints [m]."""
        return self.kinematics.points(state.joints, self.keypoint_links, base=state.root)

    def bodies(self, state: HandState) -> Bodies:
        """Compute the poses of the hand's links in B frames, and how they change with the variables.

        Variables: joints, then translation of the root, then rotation of the root about its origin (both along the
        world's axes).
        """
        links = self.kinematics.twists(state.joints, self._bodies, state.root)
        of_root = torch.eye(6, dtype=links.pos.dtype, device=links.pos.device)
        return Bodies(
            pos=links.pos,
            rot=links.rot,
            origin=state.root_pos,
            twists=torch.cat((links.twists, of_root.expand(len(links.pos), 6, 6)), dim=-1),
            carried=torch.nn.functional.pad(links.carried, (0, 6), value=1.0),
            coupling=torch.block_diag(links.coupling, of_root),
        )

    def ball_centers(self, bodies: Bodies, frame: Tensor, ball: Tensor) -> Tensor:
        """[A, 3] centers in the world of balls [A] in frames [A]."""
        body = self.group_body[self.balls.link[ball]]
        return bodies.pos[frame, body] + matvec(bodies.rot[frame, body], self.balls.centers[ball])


@frozen
class Bodies:
    """The hand's links in B frames, and how they change with the variables."""

    pos: Tensor
    """[B, L, 3] origin of each link."""
    rot: Tensor
    """[B, L, 3, 3] rotation of each link."""
    origin: Tensor
    """[B, 3] origin of the root."""
    twists: Tensor
    """[B, 6, m] velocity of the point at the root's origin, and angular velocity, of a body that a joint or the root
    moves: m moving joints and directions of the root."""
    carried: Tensor
    """[L, m] 1: the link is moved; 0: it is not."""
    coupling: Tensor
    """[m, n] velocities of the moving joints and the root by those of the variables."""

    def slope(
        self,
        frame: Tensor,
        point: Tensor,
        direction: Tensor,
        body: Tensor,
        other: Tensor | None = None,
    ) -> Tensor:
        """[A, n] derivative of a link's point along a direction: n . (v + w x r) = n . v + (r x n) . w.

        Args:
            frame: [A]
            point: [A, 3] in the world.
            direction: [A, 3] unit vectors n.
            body: [A] the point's link.
            other: [A] link whose movement at this point is subtracted.
        """
        lever = torch.linalg.cross(point - self.origin[frame], direction)
        along = torch.cat((direction, lever), dim=-1)[:, None] @ self.twists[frame]
        moved = self.carried[body]
        if other is not None:
            moved = moved - self.carried[other]
        return (along[:, 0] * moved) @ self.coupling

    def moves(self, body: Tensor) -> Tensor:
        """[B, P, 3, m] velocities of the origins of links [P], by those of the moving joints and the root."""
        lever = (self.pos[:, body] - self.origin[:, None])[..., None, :]
        identity = torch.eye(3, dtype=lever.dtype, device=lever.device).expand(
            *lever.shape[:2], 3, 3
        )
        by_rotation = torch.linalg.cross(identity, lever).mT
        per_twist = torch.cat((identity, by_rotation), dim=-1)
        moves = (per_twist.flatten(1, 2) @ self.twists).unflatten(1, (-1, 3))
        return moves.mul_(self.carried[body][:, None])


def predicted_gigabytes(model: HandModel) -> float:
    """Return an upper bound of the memory that hand retargeting on the CPU needs [GB]."""
    return 0.5 + 256 * 400e-9 * len(model.balls.radii)


def keypoint_pairs(names: Sequence[str], links: Sequence[str]) -> list[tuple[int, int]]:
    """Choose pairs of mapped keypoints: along each finger from the wrist, between neighboring knuckles, and thumb tip
    to other tips.

    Any subset of the 21 keypoints is possible. Pairs on the same link carry no information and are omitted.
    """
    from_base = sorted(range(len(names)), key=names.__getitem__)
    wrist = [i for i in from_base if names[i] == "wrist"]
    fingers = []
    pairs = []
    for finger in FINGERS:
        own = [i for i in from_base if names[i].startswith(finger)]
        fingers.append(own)
        pairs += pairwise(wrist + own)
    thumb = fingers[0]
    others = [finger for finger in fingers[1:] if finger]
    for left, right in pairwise(others):
        pairs += [(left[0], right[0]), (left[-1], right[-1])]
    if thumb:
        pairs += [(thumb[-1], finger[-1]) for finger in others]
    return [(a, b) for a, b in dict.fromkeys(pairs) if links[a] != links[b]]
