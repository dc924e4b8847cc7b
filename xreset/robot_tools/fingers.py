"""What the geometry of a hand says: which chain of links is which finger, where the palm looks, which links follow which human keypoint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from xreset.errors import RobotError
from xreset.geometry.shapes import surface_of
from xreset.geometry.urdf import RobotTree
from xreset.geometry.urdf_writer import fixed, frame
from xreset.robot_tools.draft import below, draft_spec, link_places
from xreset.spec import FingertipSpec, KeypointSpec, MimicSpec

_FINGERS = ("index", "middle", "ring", "little")
_HUMAN = (0.0, 0.45, 0.73)
"""Where a human finger's joints lie between its first one and its tip: knuckle, middle joint, last joint (rounded averages)."""
_BESIDE = 0.003
"""[m] A joint's origin that lies farther from the middle of the finger, along the joint's axis, gets a frame there for its keypoint."""
_WRIST_BEHIND = 0.095
"""[m] The human wrist behind the knuckles."""
_PALM_BEHIND = 0.04
"""[m] The palm's centre behind the knuckles."""
_BEND = 0.15
"""Share of its range by which a finger's joint is bent at home."""


@dataclass(frozen=True, kw_only=True)
class Finger:
    """A chain of moving links from the palm to a tip."""

    name: str
    links: tuple[str, ...]
    """Its moving links from the palm on."""
    joints: tuple[str, ...]
    rest: tuple[str, ...]
    """Links fixed to the last one."""


def find_fingers(
    tree: RobotTree, mimics: Sequence[MimicSpec], hand_root: str, folder: Path, thumb: str | None, notes: list[str]
) -> list[Finger]:
    """The hand's fingers, thumb first, then from the thumb's side on."""
    by_child = {joint.child: joint for joint in tree.joints}
    inside = below(tree, hand_root)
    moving = [name for name in inside if name != hand_root and by_child[name].type != "fixed"]
    carriers = {tree.moving_ancestor(by_child[name].parent) for name in moving}
    chains = []
    for end in (name for name in moving if name not in carriers):
        links, link = [], end
        while link != hand_root and link in by_child:
            if by_child[link].type != "fixed":
                links.insert(0, link)
            link = by_child[link].parent
        rest = tuple(name for name in inside if name != end and tree.moving_ancestor(name) == end)
        chains.append(
            Finger(name="", links=tuple(links), joints=tuple(by_child[name].name for name in links), rest=rest)
        )
    if len(chains) < 2:
        raise RobotError(
            f"below {hand_root!r} there are {len(chains)} chains of moving links, expected a thumb and at least one finger."
        )

    words = [
        " ".join((*c.links, *c.joints, *c.rest, *(by_child[name].name for name in c.rest))).lower() for c in chains
    ]
    spec = draft_spec(tree, mimics, hand_root, folder)
    at = link_places(spec, {})
    bases = np.array([at[chain.links[0]][:3, 3] for chain in chains])
    ends = np.array([_end(tree, chain, at) for chain in chains])
    if thumb is not None:
        marked = [i for i, chain in enumerate(chains) if thumb in (*chain.links, *chain.joints, *chain.rest)]
        if len(marked) != 1:
            raise RobotError(
                f"--thumb {thumb!r} is in {len(marked)} fingers; their links are {'; '.join(', '.join(c.links) for c in chains)}."
            )
    else:
        marked = [i for i, text in enumerate(words) if "thumb" in text]
    if len(marked) == 1:
        first = marked[0]
    else:
        directions = (ends - bases) / np.linalg.norm(ends - bases, axis=1, keepdims=True)
        first = int(
            np.argmin([np.delete(directions, i, axis=0).sum(axis=0) @ directions[i] for i in range(len(chains))])
        )
        if len(chains) > 2:
            ahead = [np.delete(directions, i, axis=0).mean(axis=0) for i in range(len(chains))]
            behind = [
                float((bases[i] - np.delete(bases, i, axis=0).mean(axis=0)) @ ahead[i]) for i in range(len(chains))
            ]
            first = int(np.argmin(behind))
        notes.append(
            f"the thumb is the finger of {', '.join(chains[first].links)}: its base is farthest back (--thumb says another)"
        )
    others = [i for i in range(len(chains)) if i != first]
    alias = {"index": ("index", "fore"), "middle": ("middle",), "ring": ("ring",), "little": ("little", "pinky")}
    named = {
        i: next((finger for finger in _FINGERS if any(word in words[i] for word in alias[finger])), "") for i in others
    }
    if sorted(named.values()) != sorted(set(named.values()) - {""}):
        across = np.linalg.svd(bases[others] - bases[others].mean(axis=0))[2][0]
        across *= np.sign((ends[first] - bases[others].mean(axis=0)) @ across) or 1.0
        others.sort(key=lambda i: -float(bases[i] @ across))
        if len(others) > len(_FINGERS):
            raise RobotError(
                f"the hand has {len(others)} fingers beside the thumb; xreset knows {', '.join(_FINGERS)}."
            )
        named = dict(zip(others, _FINGERS, strict=False))
        notes.append(
            "fingers are named from the thumb's side on: "
            + "; ".join(f"{named[i]} is {chains[i].links[-1]}" for i in others)
        )
    others.sort(key=lambda i: _FINGERS.index(named[i]))
    return [replace(chains[first], name="thumb"), *(replace(chains[i], name=named[i]) for i in others)]


def find_palm(
    tree: RobotTree, mimics: Sequence[MimicSpec], hand_root: str, fingers: list[Finger], folder: Path
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, float]]:
    """The palm's frame [4, 4] in the hand root's, poses of links with straight fingers, and bending of every joint in radians at home."""
    spec = draft_spec(tree, mimics, hand_root, folder)
    straight = link_places(spec, {})
    others = fingers[1:]
    bases = np.array([_on_axis(tree, finger.links[0], straight) for finger in others])
    ends = np.array([_end(tree, finger, straight) for finger in others])
    x = ((ends - bases) / np.linalg.norm(ends - bases, axis=1, keepdims=True)).mean(axis=0)
    x /= np.linalg.norm(x)
    bent, moved = {}, np.zeros(3)
    for finger in fingers:
        for name in finger.joints:
            joint = tree.joint(name)
            if name not in spec.joint_names:
                continue
            zero = float(np.clip(0.0, joint.lower, joint.upper))
            far = joint.upper if joint.upper - zero > zero - joint.lower else joint.lower
            lopsided = abs(joint.upper + joint.lower - 2 * zero) / (joint.upper - joint.lower)
            if lopsided > 0.4:  # spreading joints go about as far to either side
                bent[name] = _BEND * (far - zero)
                if finger.name != "thumb":
                    at = link_places(spec, {name: zero + 0.5 * (far - zero)})
                    moved += _end(tree, finger, at) - _end(tree, finger, straight)
    z = moved - (moved @ x) * x
    if np.linalg.norm(z) < 0.01:
        raise RobotError(
            "the fingers do not bend to one side when their joints move, so the palm's inner side cannot be told."
        )
    z /= np.linalg.norm(z)
    T = np.eye(4)
    T[:3, :3] = np.stack((x, np.cross(z, x), z), axis=1)
    T[:3, 3] = bases.mean(axis=0) - _PALM_BEHIND * x
    return T, straight, bent


def with_frames(
    tree: RobotTree,
    hand_root: str,
    fingers: list[Finger],
    palm: np.ndarray,
    folder: Path,
    mimics: Sequence[MimicSpec],
    straight: dict[str, np.ndarray],
) -> tuple[RobotTree, list[FingertipSpec], list[KeypointSpec]]:
    """The tree with frames for palm, wrist and fingertips; the fingertips; and which link follows which human keypoint."""
    wrist = palm.copy()
    wrist[:3, 3] -= (_WRIST_BEHIND - _PALM_BEHIND) * palm[:3, 0]
    frames = [("palm_frame", hand_root, palm), ("wrist_frame", hand_root, wrist)]
    tips, keypoints = [], [KeypointSpec(keypoint="wrist", link="wrist_frame")]
    for finger in fingers:
        last = finger.links[-1]
        end = _end(tree, finger, straight)
        T = np.eye(4)
        T[:3, :3] = straight[last][:3, :3].T @ palm[:3, :3]
        T[:3, 3] = straight[last][:3, :3].T @ (end - straight[last][:3, 3])
        frames.append((f"{finger.name}_tip_frame", last, T))
        tip = FingertipSpec(
            name=finger.name,
            link=f"{finger.name}_tip_frame",
            contact_links=tuple(name for name in (last, *finger.rest) if tree.link(name).collisions),
            keypoint=f"{finger.name}4",
        )
        tips.append(tip)
        points = np.array([*(_on_axis(tree, name, straight) for name in finger.links), end])
        along = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))))
        share = along[:-1] / along[-1]
        taken: set[int] = set()
        for number, human in enumerate(_HUMAN, start=1):
            near = min(
                (i for i in range(len(share)) if i not in taken),
                key=lambda i: (round(abs(share[i] - human), 2), -i),
                default=None,
            )
            if near is not None and abs(share[near] - human) < 0.2:
                taken |= set(range(near + 1))
                link, keypoint = finger.links[near], f"{finger.name}{number}"
                beside = straight[link][:3, :3].T @ (points[near] - straight[link][:3, 3])
                if np.linalg.norm(beside) > _BESIDE:
                    T = np.eye(4)
                    T[:3, 3] = beside
                    frames.append((f"{keypoint}_frame", link, T))
                    link = frames[-1][0]
                keypoints.append(KeypointSpec(keypoint=keypoint, link=link))
        keypoints.append(KeypointSpec(keypoint=f"{finger.name}4", link=tip.link))
    for name, parent, T in frames:
        if name in tree.link_names:
            raise RobotError(f"the hand has a link {name!r} already; rename it.")
        tree = replace(tree, links=(*tree.links, frame(name)), joints=(*tree.joints, fixed(parent, name, T)))
    return tree, tips, keypoints


def _end(tree: RobotTree, finger: Finger, at: dict[str, np.ndarray]) -> np.ndarray:
    """[3] the tip of a finger in the hand root's frame: a fixed link called so, or the point of its shapes farthest from its last joint."""
    last = finger.links[-1]
    for name in finger.rest:
        if "tip" in name.lower():
            return at[name][:3, 3]
    points = [
        surface_of(tree.link(name).collisions)[0] @ at[name][:3, :3].T + at[name][:3, 3]
        for name in (last, *finger.rest)
        if tree.link(name).collisions
    ]
    if not points:
        raise RobotError(f"the last link of a finger, {last!r}, has no collision shape, so it can touch nothing.")
    cloud = np.concatenate(points)
    middle = (cloud.max(axis=0) + cloud.min(axis=0)) / 2
    away = middle - _on_axis(tree, last, at, middle)
    away /= max(float(np.linalg.norm(away)), 1e-9)
    return middle + away * float(((cloud - middle) @ away).max())


def _on_axis(tree: RobotTree, link: str, at: dict[str, np.ndarray], near: np.ndarray | None = None) -> np.ndarray:
    """[3] the point of the axis before a link that is nearest to the middle of its shapes: makers put origins anywhere along an axis."""
    shapes = tree.link(link).collisions
    if near is None:
        if not shapes:
            return at[link][:3, 3]
        cloud = surface_of(shapes)[0] @ at[link][:3, :3].T + at[link][:3, 3]
        near = (cloud.max(axis=0) + cloud.min(axis=0)) / 2
    axis = at[link][:3, :3] @ next(joint.axis for joint in tree.joints if joint.child == link)
    return at[link][:3, 3] + axis * float((near - at[link][:3, 3]) @ axis)
