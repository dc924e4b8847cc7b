"""Finds out from a hand's geometry which chain of links is which finger, where the palm looks, and which links follow
which human keypoint."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.spatial.distance import cdist

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.geometry.collision import bounding_ball
from xreset.geometry.shapes import surface_of, transform, transformed
from xreset.geometry.urdf import RobotTree
from xreset.geometry.urdf_writer import FRAME_MASS, axes, fixed, frame
from xreset.robot_tools.draft import draft_spec, link_places
from xreset.robot_tools.opposition import closing_range, opposition
from xreset.robot_tools.sources import ARM_JOINTS, is_camera, with_fixed, without
from xreset.spec import FingertipSpec, KeypointSpec

_FINGERS = ("index", "middle", "ring", "little")
_NAMES = {
    "thumb": ("thumb", "th"),
    "index": ("index|forefinger", "ff"),
    "ring": ("ring", "rf"),
    "little": ("little|pink", "lf"),
    "middle": ("middle", "mf"),
}
"""What words in the names of a finger's links and joints begin with, after a letter for the side or none, and the codes
in names such as ``rh_FFdistal`` and ``THJ5``, as the Shadow hand has them; "middle" may also be a bone, or be between
two others, so it comes last."""
_BONE = r"(?=_?(j\d|base|hub|knuckle|meta|prox|mid|dist|tip))"
_HUMAN = (0.0, 0.45, 0.73)
"""Positions of a human finger's joints between its first one and its tip: knuckle, middle joint, last joint (rounded
averages)."""
_OFF_MIDDLE = 0.003
"""[m] Distance of a joint's origin from the middle of the finger, along the joint's axis, beyond which its keypoint
gets a frame in the middle."""
_WRIST_BEHIND = 0.095
"""[m] The human wrist behind the knuckles."""
_PALM_BEHIND = 0.04
"""[m] The palm's center behind the knuckles."""
_END = 0.005
"""[m] Length of the end of a finger."""
_SIDE = 0.1
"""A thumb that is less than this share of the fingers' width beside their middle is opposite it."""
_NARROW = 0.7
"""Share of the thumb's points from which another finger may be the thumb as well."""
_SPREAD = 0.01
"""Spread of the directions of parallel fingers: 1 - length of the mean of the unit vectors."""
_HANDS_APART = 0.2
"""[m] Distance of the fingers of two hands."""
_SHORTEST = 1e-6
"""[m] Length of a finger from which its direction is known."""
_BEND = 0.15
"""Share of its range by which a finger's joint is bent at home."""


@frozen
class Finger:
    """A chain of moving links from the palm to a tip."""

    name: str
    """What it is called; empty if its names do not tell."""
    links: tuple[str, ...]
    """Its moving links from the palm on."""
    joints: tuple[str, ...]
    fixed_links: tuple[str, ...]
    """Links fixed to the last one."""
    points: np.ndarray
    """[links + 1, 3] its joints, in the middle of the finger, and its tip in the frame of the hand's root, straight."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of its links and joints."""
        return (*self.links, *self.joints, *self.fixed_links)


class Hand:
    """A hand, with what its geometry tells of palm and fingers."""

    def __init__(self, tree: RobotTree, folder: Path, thumb: str | None, notes: list[str]) -> None:
        """Find palm and fingers.

        Args:
            tree: the hand.
            folder: where its URDF is written.
            thumb: a link or joint of the thumb.
            notes: what is guessed is appended.
        """
        self._notes = notes
        if not tree.moved_by:
            raise RobotError("the hand has no joint that moves. Are its joints fixed in the file?")
        self._take(tree, folder)
        while True:  # a hand of several hands, and its fingers of several limbs
            tree = self._one_hand(thumb)
            still = [] if tree is not self.tree else self._joints_of_other_parts()
            loose = self._loose_bodies(still)
            if loose:
                notes.append(f"left out: what moves next to the hand: {', '.join(loose)}")
                tree = without(tree, loose)
                names = [joint.name for joint in tree.joints]
                still = [joint for joint in still if joint in names]
            if still:
                notes.append(f"joints that move no finger are fixed at 0: {', '.join(still)}")
                tree = with_fixed(tree, still)
            if tree is self.tree:
                break
            self._take(tree, folder)
        wrist = [
            joint.name for link, joint in tree.moved_by.items() if self.root in tree.below(link)
        ]
        if wrist:
            notes.append(
                f"last joints of the arm, because they move the whole hand: {', '.join(wrist)}; the hand begins "
                f"with {self.root!r}. In the hand's file, make a joint fixed to keep it still, or if it moves no "
                "finger but another part, such as a camera"
            )
        fingers = self._find_fingers(thumb)
        self.bent: dict[str, float] = {}
        """Joint -> angle by which it is bent at home [rad]."""
        self.palm_in_hand = self._find_palm(fingers)
        """[4, 4] pose of the palm in the frame of the hand's root."""
        self.tips: list[FingertipSpec] = []
        """Thumb first."""
        self.keypoints = [KeypointSpec(keypoint="wrist", link="wrist_frame")]
        self._add_frames(fingers)
        T_root_hand = np.linalg.inv(self._at[tree.root])
        self.palm = T_root_hand @ self.palm_in_hand
        """[4, 4] pose of the palm in the frame of the tree's root, with a straight wrist."""
        body = [name for name in self._at if tree.moving_ancestor(name) == tree.root]
        self.body = transformed(self._surface(body), T_root_hand)
        """[V, 3] vertices of the shapes that are fixed to the tree's root, in its frame."""

    def _take(self, tree: RobotTree, folder: Path) -> None:
        """Take a tree as the hand, with straight fingers."""
        self.tree = tree
        """Its links, with frames for palm, wrist, fingertips and keypoints."""
        self.root = self._palm_link()
        """Link after which the fingers part."""
        self._spec = draft_spec(tree, self.root, folder)
        self._at = link_places(self._spec, {})
        """Link -> pose [4, 4] in the frame of the hand's root, with straight fingers."""

    def _palm_link(self) -> str:
        """Return the link after which the fingers part, behind the joints of a wrist: the first one of its body that
        has shapes, or more than one child."""
        tree = self.tree
        link = tree.root
        while True:
            moving = [
                joint
                for joint in tree.moved_by.values()
                if tree.moving_ancestor(joint.parent) == link
            ]
            if len(moving) != 1:
                break
            link = moving[0].child
        while not tree.link(link).collisions:
            children = [joint.child for joint in tree.joints if joint.parent == link]
            if len(children) != 1:
                break
            link = children[0]
        return link

    def _joints_of_other_parts(self) -> list[str]:
        """Return the joints that move no finger, such as that of a camera on the arm.

        Chains that :meth:`_cameras` names move no finger. If chains can meet below one child of the root only, they are
        the hand, and other chains move no finger. Below a root that is only a frame, chains with a thumb are the hand,
        too. But if the names of another chain state a finger, or a drive of the hand moves it, nothing is certain: no
        joint is returned.
        """
        if cameras := self._cameras():
            return cameras
        hands = []
        for own in self._hands().values():
            has_thumb = any(finger.name == "thumb" for finger in own)
            if (has_thumb and self._is_scene()) or self._can_meet(own):
                hands.append(own)
        if len(hands) != 1:
            return []
        drives = set.union(*map(self._drives_of, hands[0]))
        still = []
        for chain in self._chains():
            if chain.links in [finger.links for finger in hands[0]]:
                continue
            if chain.name or drives & self._drives_of(chain):
                return []
            still += [joint for joint in chain.joints if joint not in still]
        return still

    def _cameras(self) -> list[str]:
        """Return the joints of chains that are called cameras or have no shapes, if no name states a finger, and no
        drive moves a finger as well."""
        fingers = []
        others = []
        for chain in self._chains():
            bodies = [self.tree.link(name) for name in (*chain.links, *chain.fixed_links)]
            solid = any(body.collisions for body in bodies)
            is_finger = bool(chain.name) or (solid and not is_camera(chain.names))
            (fingers if is_finger else others).append(chain)
        if len(fingers) < 2:
            return []
        drives = set.union(*map(self._drives_of, fingers))
        still = []
        for chain in others:
            if not drives & self._drives_of(chain):
                still += [joint for joint in chain.joints if joint not in still]
        return still

    def _is_scene(self) -> bool:
        """Return whether the tree's root is only a frame, such as the world of a scene, from which the hand and other
        things branch off."""
        root = self.tree.link(self.tree.root)
        return self.root == root.name and not root.collisions and root.mass <= FRAME_MASS

    def _loose_bodies(self, still: Sequence[str]) -> list[str]:
        """Return the objects of a scene: what is connected to its root by one of some joints that move no finger."""
        if not self._is_scene():
            return []
        joints = [joint for joint in self.tree.joints if joint.parent == self.root]
        return [joint.child for joint in joints if joint.name in still]

    def _hands(self) -> dict[str, list[Finger]]:
        """Return the fingers below each child of the root that has several."""
        chains = self._chains()
        hands = {}
        for joint in self.tree.joints:
            if joint.parent == self.root:
                inside = self.tree.below(joint.child)
                own = [chain for chain in chains if chain.links[-1] in inside]
                if len(own) > 1:
                    hands[joint.child] = own
        return hands

    def _one_hand(self, thumb: str | None) -> RobotTree:
        """Return the tree, without the other hands if it has several."""
        hands = self._hands()
        if len(hands) < 2:
            return self.tree
        tips = []
        drives = []
        begins = []
        arms = []
        for own in hands.values():
            tips.append(", ".join(finger.links[-1] for finger in own))
            drives.append(set.union(*map(self._drives_of, own)))
            arm = set.intersection(*(set(finger.joints) for finger in own))
            arms.append(len(arm))
            begins.append([self._at[finger.links[len(arm)]][:3, 3] for finger in own])
        gap = min(cdist(a, b).min() for a, b in combinations(begins, 2))
        thumbs = [one for one in self._chains() if one.name == "thumb"]
        is_one = gap < _HANDS_APART and len(thumbs) < 2 and min(arms) < ARM_JOINTS
        if is_one or any(a & b for a, b in combinations(drives, 2)):
            return self.tree
        for child, own in hands.items():
            if any(thumb in one.names for one in own):
                others = [root for root in hands if root != child]
                self._notes.append(
                    f"left out, because {thumb} is of another hand: {', '.join(others)}"
                )
                return without(self.tree, others)
        raise RobotError(
            f"the file has {len(hands)} hands, with the fingers {'; '.join(tips)}. Choose one with --thumb, the name "
            "of a link of its thumb."
        )

    def _can_meet(self, chains: list[Finger]) -> bool:
        """Return whether the tips of any two chains can meet. Only joints below the last link of all chains move."""
        chains = [replace(chain, points=self._points(chain)) for chain in chains]
        common = self.root
        for link in chains[0].links:
            if all(link in chain.links for chain in chains):
                common = link
        return bool(self._meetings(chains, common).any())

    def _meetings(self, chains: list[Finger], root: str) -> np.ndarray:
        """Return how much the tips of chains oppose each other, see :func:`opposition`. Only joints below the root
        move."""
        ends = [chain.links[-1] for chain in chains]
        tips = np.array([self._in_link(chain.links[-1], chain.points[-1]) for chain in chains])
        return opposition(replace(self._spec, hand_root=root), ends, tips)

    def _find_fingers(self, thumb: str | None) -> list[Finger]:
        """Return the hand's fingers, thumb first, then from the thumb's side on."""
        chains = self._without_bars(self._chains())
        if len(chains) < 2:
            raise RobotError(
                f"below {self.root!r} there are {len(chains)} chains of moving links, expected a thumb and at least "
                "one finger. Of a gripper, both jaws must move."
            )
        chains = [replace(chain, points=self._points(chain)) for chain in chains]
        for chain in chains:
            if np.linalg.norm(chain.points[-1] - chain.points[0]) < _SHORTEST:
                raise RobotError(
                    f"the tip of {chain.links[-1]!r} is at the finger's first joint {chain.joints[0]!r}, so where it "
                    f"points is unknown. If it is no finger, make {chain.joints[0]!r} fixed."
                )
        first = self._find_thumb(chains, thumb)
        others = [chain for chain in chains if chain is not first]
        names = {chain.name for chain in others}
        # lf and rf may be a left and a right jaw
        is_jaw = len(others) == 1 and first.name != "thumb"
        if not names <= set(_FINGERS) or len(names) < len(others) or is_jaw:
            if len(others) > len(_FINGERS):
                raise RobotError(
                    f"the hand has {len(others)} fingers and a thumb; xreset knows {', '.join(_FINGERS)}."
                )
            toward_index, why = _index_side(first, others)
            bases, _ = _bases_and_ends(others)
            order = np.argsort(-(bases @ toward_index), kind="stable")
            others = [
                replace(others[i], name=name) for i, name in zip(order, _FINGERS, strict=False)
            ]
            listed = "; ".join(f"{finger.name} is {finger.links[-1]}" for finger in others)
            self._notes.append(f"fingers are named {why}: {listed}")
        others.sort(key=lambda finger: _FINGERS.index(finger.name))
        return [replace(first, name="thumb"), *others]

    def _find_thumb(self, chains: list[Finger], thumb: str | None) -> Finger:
        """Return the chain with the stated link or joint, the one that is called so, or the one that opposes the
        others."""
        links = [", ".join(one.links) for one in chains]
        known = "; ".join(links)
        unnamed = [one for one in chains if not one.name]
        if thumb is not None:
            marked = [one for one in chains if thumb in one.names]
            if len(marked) != 1:
                raise RobotError(
                    f"--thumb {thumb!r} is in {len(marked)} fingers; their links are {known}."
                )
        else:
            marked = [one for one in chains if one.name == "thumb"]
            if not marked and len(chains) > 2 and len(unnamed) == 1:
                marked = unnamed
        if len(marked) == 1:
            return marked[0]
        scores = np.sqrt(self._meetings(chains, self.root)).sum(axis=1)
        if len(chains) == 2:
            why = "it can oppose the others" if scores[0] else "the two are alike"
            self._notes.append(
                f"the thumb is the finger of {links[0]}: {why} (--thumb chooses another)"
            )
            return chains[0]
        if not scores.any():
            raise RobotError(
                f"no finger can oppose the others. Name a link of the thumb with --thumb: {known}."
            )
        points = scores / scores.max() + _beside_others(chains) + _first_of_five(chains)
        named = {one.name for one in chains} - {"", "middle"}
        for i, one in enumerate(chains):
            if unnamed and named and one.name:
                points[i] = 0.0
        second, first = points.argsort()[-2:]
        note = f"the thumb is the finger of {links[first]}: it can oppose the others, beside which it begins"
        if points[second] > _NARROW * points[first]:
            note += (
                f". The vote is narrow: {chains[second].links[-1]} has {points[second]:.2f} points, "
                f"{chains[first].links[-1]} {points[first]:.2f}. The picture shows which is right"
            )
        self._notes.append(f"{note} (--thumb chooses another)")
        return chains[first]

    def _chains(self) -> list[Finger]:
        """Return the chains of moving links below the hand's root; each ends in a link that carries no moving one.

        Their points are not known yet.
        """
        tree = self.tree
        moving = [name for name in tree.below(self.root)[1:] if name in tree.moved_by]
        chains = []
        for end in moving:
            rest = tree.below(end)[1:]
            if tree.moved_by.keys() & set(rest):
                continue
            links = [name for name in moving if end in tree.below(name)]
            joints = [tree.moved_by[name].name for name in links]
            fixed_joints = [tree.above[name].name for name in rest]
            chain = Finger(
                name=_stated_finger(" ".join((*links, *joints, *rest, *fixed_joints))),
                links=tuple(links),
                joints=tuple(joints),
                fixed_links=tuple(rest),
                points=np.empty(0),
            )
            chains.append(chain)
        return chains

    def _drives_of(self, finger: Finger) -> set[str]:
        """Return the joints with a drive that move a finger."""
        sources = {mimic.joint: mimic.source for mimic in self._spec.mimics}
        return {sources.get(joint, joint) for joint in finger.joints}

    def _without_bars(self, chains: list[Finger]) -> list[Finger]:
        """Return the chains without the bars of linkages: shorter chains of the same drive that no name calls a
        finger."""
        bars = []
        for chain in chains:
            drives = self._drives_of(chain)
            same = [len(other.links) for other in chains if self._drives_of(other) == drives]
            if not chain.name and len(chain.links) < max(same):
                bars.append(chain)
        if bars:
            self._notes.append(
                f"not fingers, but bars of a linkage: {', '.join(bar.links[-1] for bar in bars)}"
            )
        return [chain for chain in chains if chain not in bars]

    def _find_palm(self, fingers: list[Finger]) -> np.ndarray:
        """Return the palm's frame [4, 4] in the hand root's, and note how far each joint is bent at home."""
        is_jaw = len(fingers) == 2 and self._is_jaw(fingers)
        along = fingers if is_jaw else fingers[1:]
        bases, ends = _bases_and_ends(along)
        x = ((ends - bases) / np.linalg.norm(ends - bases, axis=1, keepdims=True)).mean(axis=0)
        x /= np.linalg.norm(x)
        moved = np.zeros(3)
        for finger in fingers:
            last = finger.links[-1]
            tip = self._in_link(last, finger.points[-1])
            for name in finger.joints:
                joint = self.tree.joint(name)
                closing = closing_range(joint.lower, joint.upper)
                if name not in self._spec.joint_names or closing is None:
                    continue
                self.bent[name] = _BEND * closing
                if finger.name != "thumb":
                    halfway = np.clip(0.0, joint.lower, joint.upper) + 0.5 * closing
                    T = link_places(self._spec, {name: halfway})[last]
                    moved += transformed(tip, T) - finger.points[-1]
        z = moved - (moved @ x) * x
        if is_jaw:
            # as in a right hand, whose thumb is against the palm's y
            apart = ends[1] - ends[0]
            opened = self._opened(fingers)
            if np.linalg.norm(opened) > np.linalg.norm(apart):  # closed where its joints are at 0
                apart = opened
                self.bent = {name: bend * (1 / _BEND - 1) for name, bend in self.bent.items()}
            z = np.cross(x, apart)
        if not self.bent and not is_jaw:
            raise RobotError(
                "no joint of a finger has limits that say to which side it bends, such as 0..1.5 rad: they are "
                "continuous, or go as far to either side. State the limits in the hand's file."
            )
        if np.linalg.norm(z) < 0.01:
            raise RobotError(
                "the fingers do not bend to one side when their joints move, so the palm's inner side is unknown."
            )
        z /= np.linalg.norm(z)
        T = axes(x=x, z=z)
        T[:3, 3] = bases.mean(axis=0) - _PALM_BEHIND * x
        return T

    def _is_jaw(self, fingers: list[Finger]) -> bool:
        """Return whether one drive moves two fingers, or both only slide."""
        names = [*fingers[0].joints, *fingers[1].joints]
        slide = all(self.tree.joint(name).type == "prismatic" for name in names)
        return slide or len(set.union(*map(self._drives_of, fingers))) == 1

    def _opened(self, jaw: list[Finger]) -> np.ndarray:
        """[3] from the thumb's tip to the other finger's where the jaw's drive is in the middle of its range."""
        middle = {
            name: (self.tree.joint(name).lower + self.tree.joint(name).upper) / 2
            for name in set.union(*map(self._drives_of, jaw))
        }
        places = link_places(self._spec, middle)
        thumb, finger = (
            transformed(self._in_link(part.links[-1], part.points[-1]), places[part.links[-1]])
            for part in jaw
        )
        return finger - thumb

    def _add_frames(self, fingers: list[Finger]) -> None:
        """Add frames for palm, wrist, fingertips and keypoints, and note which link follows which human keypoint."""
        palm = self.palm_in_hand
        wrist = palm.copy()
        wrist[:3, 3] -= (_WRIST_BEHIND - _PALM_BEHIND) * palm[:3, 0]
        self._add_frame("palm_frame", self.root, palm)
        self._add_frame("wrist_frame", self.root, wrist)
        absent = []
        for finger in fingers:
            last = finger.links[-1]
            ends = (last, *finger.fixed_links)
            tip = FingertipSpec(
                name=finger.name,
                link=f"{finger.name}_tip_frame",
                contact_links=tuple(name for name in ends if self.tree.link(name).collisions),
                keypoint=f"{finger.name}4",
            )
            self.tips.append(tip)
            R = self._at[last][:3, :3].T @ palm[:3, :3]
            self._add_frame(tip.link, last, transform(R, self._in_link(last, finger.points[-1])))
            follow = _keypoint_joints(finger)
            for number in range(1, 4):
                if f"{finger.name}{number}" not in follow:
                    absent.append(f"{finger.name}{number}")
            for keypoint, near in follow.items():
                link = finger.links[near]
                middle = self._in_link(link, finger.points[near])
                if np.linalg.norm(middle) > _OFF_MIDDLE:
                    self._add_frame(f"{keypoint}_frame", link, transform(np.eye(3), middle))
                    link = f"{keypoint}_frame"
                self.keypoints.append(KeypointSpec(keypoint=keypoint, link=link))
            self.keypoints.append(KeypointSpec(keypoint=tip.keypoint, link=tip.link))
        if absent:
            self._notes.append(
                f"no link follows these joints of a person (1 is a finger's base, 4 its tip): {', '.join(absent)}"
            )

    def _add_frame(self, name: str, parent: str, T: np.ndarray) -> None:
        tree = self.tree
        if name in tree.link_names:
            raise RobotError(f"the hand has a link {name!r} already; rename it.")
        joints = (*tree.joints, fixed(parent, name, T))
        self.tree = replace(tree, links=(*tree.links, frame(name)), joints=joints)

    def _in_link(self, link: str, points: np.ndarray) -> np.ndarray:
        """[..., 3] points of the hand root's frame, in a link's."""
        pose = self._at[link]
        return (points - pose[:3, 3]) @ pose[:3, :3]

    def _middle(self, link: str, points: np.ndarray) -> np.ndarray:
        """[3] the middle of the box around points [V, 3] along the axes of a link."""
        return transformed(bounding_ball(self._in_link(link, points))[0], self._at[link])

    def _surface(self, links: Iterable[str]) -> np.ndarray:
        """[V, 3] vertices of the shapes of links in the hand root's frame."""
        points = [np.zeros((0, 3))]
        for name in links:
            if shapes := self.tree.link(name).collisions:
                points.append(transformed(surface_of(shapes)[0], self._at[name]))
        return np.concatenate(points)

    def _points(self, finger: Finger) -> np.ndarray:
        """[links + 1, 3] the joints and the tip of a finger.

        A joint is the point of its axis that is nearest to the middle of its link's shapes: makers put origins anywhere
        along an axis. The tip is a fixed link called so, or the middle of the shapes' end, far from the last joint.
        """
        points = [self._on_axis(link, self._surface([link])) for link in finger.links]
        tips = [name for name in finger.fixed_links if "tip" in name.lower()]
        if tips:
            return np.array([*points, self._at[tips[0]][:3, 3]])
        last = finger.links[-1]
        cloud = self._surface((last, *finger.fixed_links))
        if not len(cloud):
            raise RobotError(
                f"the last link of a finger, {last!r}, has no collision shape, so it can touch nothing. If it is no "
                f"finger, make {finger.joints[-1]!r} fixed."
            )
        middle = self._middle(last, cloud)
        away = middle - self._on_axis(last, cloud)
        away /= max(np.linalg.norm(away), 1e-9)
        along = (cloud - middle) @ away
        # jaws may taper to one side
        end = self._middle(last, cloud[along > along.max() - _END])
        return np.array([*points, end + away * (along.max() - (end - middle) @ away)])

    def _on_axis(self, link: str, cloud: np.ndarray) -> np.ndarray:
        """[3] the point of the axis before a link that is nearest to the middle of points; the origin if there is
        none."""
        origin = self._at[link][:3, 3]
        if not len(cloud):
            return origin
        axis = self._at[link][:3, :3] @ self.tree.above[link].axis
        return origin + axis * ((self._middle(link, cloud) - origin) @ axis)


def _bases_and_ends(fingers: Sequence[Finger]) -> tuple[np.ndarray, np.ndarray]:
    """[F, 3] the first joint and the tip of each finger."""
    points = np.array([(finger.points[0], finger.points[-1]) for finger in fingers])
    return points[:, 0], points[:, 1]


def _beside_others(chains: list[Finger]) -> np.ndarray:
    """[F] from 0 to 2: how parallel the other fingers are, and how far a finger begins beside the line on which the
    others begin."""
    bases, ends = _bases_and_ends(chains)
    directions = (ends - bases) / np.linalg.norm(ends - bases, axis=1, keepdims=True)
    spreads = []
    beside = []
    for i in range(len(chains)):
        spreads.append(1 - np.linalg.norm(np.delete(directions, i, axis=0).mean(axis=0)) + _SPREAD)
        others = np.delete(bases, i, axis=0)
        middle = others.mean(axis=0)
        off = np.linalg.svd(others - middle)[2][1:]  # directions across the line
        own = np.linalg.norm(off @ (bases[i] - middle))
        rest = np.linalg.norm((others - middle) @ off.T) / len(others) ** 0.5
        beside.append(own / max(own + rest, _SHORTEST))
    return min(spreads) / np.array(spreads) + np.array(beside)


def _first_of_five(chains: list[Finger]) -> np.ndarray:
    """[F] 1 for the first finger of a hand of five whose names count the fingers from 0 or 1 on."""
    texts = [re.split(r"(\d+)", one.links[-1]) for one in chains]
    for parts in zip(*texts, strict=False):
        if set(parts) in (set("01234"), set("12345")):
            return np.array([float(part == min(parts)) for part in parts])
    return np.zeros(len(chains))


def _index_side(thumb: Finger, others: list[Finger]) -> tuple[np.ndarray, str]:
    """Return the direction [3] across the fingers in which the index finger is, and how it was found, in words.

    It is the thumb's side. A thumb opposite the middle of the fingers has none; then it is that of a right hand.
    """
    bases, ends = _bases_and_ends(others)
    middle = bases.mean(axis=0)
    across = np.linalg.svd(bases - middle)[2][0]
    to_thumb = thumb.points[-1] - middle
    side = to_thumb @ across
    if abs(side) >= _SIDE * np.ptp(bases @ across):
        return across * (np.sign(side) or 1.0), "from the thumb's side on"
    right = np.cross((ends - bases).mean(axis=0), to_thumb) @ across
    return across * (np.sign(right) or 1.0), "as in a right hand"


def _stated_finger(names: str) -> str:
    """Return the finger that the names of links and joints state, or an empty text."""
    text = re.sub("(?<=[a-z])(?=[A-Z][a-z])", "_", names).lower()  # leftThumb
    for finger, (words, code) in _NAMES.items():
        if re.search(rf"(?<![a-z])([lr]?({words})|{code}{_BONE})", text):
            return finger
    return ""


def _keypoint_joints(finger: Finger) -> dict[str, int]:
    """Return the index of the joint that is where a human finger's joint is, by keypoint; a joint serves once, and in
    order."""
    along = np.cumsum([0.0, *np.linalg.norm(np.diff(finger.points, axis=0), axis=1)])
    share = along[:-1] / along[-1]
    found = {}
    first = 0
    for number, human in enumerate(_HUMAN, start=1):
        distances = [(round(abs(share[i] - human), 2), -i) for i in range(first, len(share))]
        if not distances:
            break
        near = -min(distances)[1]
        if abs(share[near] - human) < 0.2:
            found[f"{finger.name}{number}"] = near
            first = near + 1
    return found
