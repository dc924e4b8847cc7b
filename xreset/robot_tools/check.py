"""Checks a robot in one go, without an engine: its description, its URDF and its drives."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from xreset.errors import RobotError, XResetError
from xreset.files.text import quantity
from xreset.geometry.collision import SelfCollision, table_clearance
from xreset.geometry.description import load_robot
from xreset.geometry.dynamics import damping_ratio, drive_inertia
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.urdf import RobotTree, load_urdf, mismatches
from xreset.physics.plugins import DESCRIPTION, robot_folder
from xreset.retarget.hand.model import HandModel, predicted_gigabytes
from xreset.robot_tools.draft import hand_side, link_places
from xreset.robot_tools.opposition import heights_over_palm, opposition
from xreset.robot_tools.sources import is_solid, largest_moment, plausible
from xreset.spec import RobotSpec, SceneSpec, TableSpec

Level = Literal["ok", "skipped", "warning", "error"]

_MIN_CLEARANCE = 0.005
"""Clearance [m] from the table that the home configuration should have."""
_SAMPLES = 200
MOST_TOUCHING = 0.2
"""Share of the joint positions around home at which a robot may touch itself without a warning."""
_LIMIT_SLACK = 1e-3
"""[rad or m] How far a mimic joint's limits may fall short of its source's: published figures are rounded."""
_LAST = "retargeting"
"""Topic of the last finding about a robot that can be loaded."""
_LISTED = 4
"""Pairs of links that are named, most frequent first."""
_PALM = 0.12
"""[m] Largest distance from the palm's frame to the nearest joint of a finger: a human palm is 10 cm long."""


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    level: Level
    topic: str
    """What was looked at, such as ``joints``."""
    message: str
    """What was found, what was expected, and what to do."""


def check(name_or_folder: str | Path) -> list[Finding]:
    """Check a robot without an engine; ``xreset engines check --robot`` tries it in physics.

    Args:
        name_or_folder: a registered name or a folder.

    Returns:
        At least one finding for each topic; an ``error`` of ``description`` or ``URDF`` is the last one.
    """
    try:
        folder = robot_folder(name_or_folder)
        spec = load_robot(name_or_folder)
    except XResetError as error:
        return [Finding("error", "description", str(error))]
    parts = (
        quantity(len(spec.arm_indices), "arm joint"),
        quantity(len(spec.hand_indices), "hand joint"),
        quantity(len(spec.fingertips), "fingertip"),
    )
    content = ", ".join(parts)
    found = [Finding("ok", "description", f"{folder / DESCRIPTION}: {content}")]
    try:
        tree = load_urdf(spec.urdf)
    except XResetError as error:
        return [*found, Finding("error", "URDF", str(error))]
    shapes = sum(len(link.collisions) for link in tree.links)
    mass = sum(link.mass for link in tree.links)
    content = f"{len(tree.links)} links, {len(tree.joints)} joints, {shapes} collision shapes, {mass:.1f} kg"
    found.append(Finding("ok", "URDF", content))
    wrong = mismatches(spec, tree)
    found += _topic(
        "joints",
        _joints(spec, tree, wrong["joints"]),
        f"{len(spec.joints)} actuated joints are at home within limits",
    )
    found += _topic(
        "mimic joints", _mimics(spec, tree), f"{len(spec.mimics)} follow an actuated joint"
    )
    found += _topic(
        "links",
        _links(spec, tree, wrong["links"]),
        "palm, fingertips, keypoints and collision links exist",
    )
    found += _topic(
        "inertias", _inertias(tree), "masses are positive, inertias are those of solid bodies"
    )
    if any(finding.level == "error" for finding in found):
        return [*found, Finding("skipped", "home", "fix the errors above first")]
    kinematics = Kinematics(spec)
    q = _around_home(kinematics)
    found += _topic("drives", _drives(spec), "damping ratios at home are between 0.5 and 5")
    palm = f"{hand_side(spec)} palm".strip()
    found += _topic(
        "frames",
        _frames(spec, tree),
        f"the palm frame is in the {palm}, and looks along the fingers",
    )
    found += _topic(
        "fingers", _fingers(spec, tree), "no fingertip opposes the others more than the thumb"
    )
    found += _topic("home and table", _above_table(kinematics, q))
    found += _topic("home and self", _free_of_itself(kinematics, q))
    found += _topic(_LAST, _size(spec))
    return found


def can_be_drawn(findings: Sequence[Finding]) -> bool:
    """Return whether a check got to its end: the robot can be loaded, and has a home."""
    return findings[-1].topic == _LAST


Problems = Iterator[tuple[Level, str]]
"""Level and message of everything that is wrong with a topic."""


def _topic(topic: str, problems: Problems, otherwise: str = "") -> list[Finding]:
    """Return the findings of a topic; what needs a package that is not installed is skipped."""
    try:
        found = [Finding(level, topic, message) for level, message in problems]
    except RobotError as error:
        return [Finding("error", topic, str(error))]
    except XResetError as error:
        return [Finding("skipped", topic, str(error))]
    return found or [Finding("ok", topic, otherwise)]


# Description against URDF ---------------------------------------------------------------------------------------------


def _joints(spec: RobotSpec, tree: RobotTree, wrong: list[str]) -> Problems:
    for problem in wrong:
        yield "error", problem
    known = {joint.name: joint for joint in tree.moved_by.values()}
    inside = set(tree.below(spec.hand_root)[1:])
    for joint in spec.joints:
        if joint.name not in known:
            continue
        found = known[joint.name]
        limits = f"{found.lower:g}..{found.upper:g}"
        if not np.isfinite((found.lower, found.upper)).all() or found.lower >= found.upper:
            yield (
                "error",
                f"{joint.name!r} has the limits {limits}; expected finite ones, the lower one first.",
            )
        elif not found.lower <= joint.home <= found.upper:
            yield (
                "error",
                f"{joint.name!r} is at home at {joint.home:g}, outside its limits {limits}.",
            )
        elif (found.child in inside) != (joint.group == "hand"):
            where = "below" if found.child in inside else "not below"
            text = f"{joint.name!r} is of group {joint.group!r} but is {where} the hand's root {spec.hand_root!r}."
            yield "warning", text


def _mimics(spec: RobotSpec, tree: RobotTree) -> Problems:
    """Look for mimic joints that their own limits would stop."""
    known = {joint.name: joint for joint in tree.moved_by.values()}
    for mimic in spec.mimics:
        if not {mimic.joint, mimic.source} <= known.keys():
            yield "skipped", f"{mimic.joint!r}: fix the errors of joints first"
            continue
        own = known[mimic.joint]
        source = known[mimic.source]
        low, high = sorted(
            mimic.multiplier * limit + mimic.offset for limit in (source.lower, source.upper)
        )
        if low < own.lower - _LIMIT_SLACK or high > own.upper + _LIMIT_SLACK:
            yield (
                "error",
                f"{mimic.joint!r} goes from {low:.4g} to {high:.4g} with {mimic.source!r}, beyond its own limits "
                f"{own.lower:.4g}..{own.upper:.4g}: the two would hold each other up. Widen its limits, or narrow "
                "those of the source.",
            )


def _links(spec: RobotSpec, tree: RobotTree, wrong: list[str]) -> Problems:
    for problem in wrong:
        yield "error", problem
    if wrong:
        return
    solid = {link.name for link in tree.links if link.collisions}
    inside = tree.below(spec.hand_root)[1:]
    for tip in spec.fingertips:
        if solid.isdisjoint(tip.contact_links):
            links = ", ".join(tip.contact_links) or "its links"
            yield (
                "error",
                f"fingertip {tip.name!r}: none of {links} has a collision shape, so it can touch nothing. Give the "
                "last link of the finger one.",
            )
        if tip.link not in inside:
            text = f"{tip.link!r} is not below the hand's root {spec.hand_root!r}."
            yield "error", f"fingertip {tip.name!r}: {text}"
    for link in spec.self_collision_links:
        if link not in solid:
            yield "warning", f"collision.self: {link!r} has no collision shape."


def _inertias(tree: RobotTree) -> Problems:
    for link in tree.links:
        name = link.name
        if link.mass <= 0:
            if name in tree.moved_by:
                yield (
                    "error",
                    f"{name!r} moves but has the mass {link.mass:g} kg; every moving link needs a mass and an "
                    "inertia.",
                )
            continue
        moments = ", ".join(f"{moment:.3g}" for moment in np.linalg.eigvalsh(link.inertia))
        has = f"{name!r} has the principal moments {moments} kg m^2"
        if not is_solid(link):
            text = "Expected those of a solid body: positive ones, the largest at most the sum of the others."
            yield "error", f"{has}. {text}"
        elif not plausible(link):
            text = f"{link.mass:.3g} kg of its size can have {largest_moment(link):.2g} at most"
            yield (
                "warning",
                f"{has}; {text}. Is it a placeholder? `xreset robots import` replaces such.",
            )


# Physics --------------------------------------------------------------------------------------------------------------


def _drives(spec: RobotSpec) -> Problems:
    step = SceneSpec.timestep
    ratios = damping_ratio(spec, spec.home)
    inertias = drive_inertia(spec, spec.home)
    for joint, ratio, inertia in zip(spec.joints, ratios, inertias, strict=True):
        if not 0.5 <= ratio <= 5:
            yield (
                "warning",
                f"{joint.name!r} has the damping ratio {ratio:.2f} at home. It swings below 0.5 and creeps above 5; "
                "0.7 to 1.5 is usual. Change kd.",
            )
        if joint.drive.kd * step > inertia:
            yield (
                "warning",
                f"{joint.name!r}: kd = {joint.drive.kd:g} is too much for its inertia {inertia:.3g} at a step of "
                f"1/{1 / step:.0f} s; engines that integrate drives explicitly become unstable. Lower kp and kd, or "
                "state the rotor as the joint's armature.",
            )


def _frames(spec: RobotSpec, tree: RobotTree) -> Problems:
    places = link_places(spec, {})
    palm = np.linalg.inv(places[spec.palm])
    tips = np.array([(palm @ places[tip.link])[:3, 3] for tip in spec.fingertips])
    along = tips[1:].mean(axis=0) if len(tips) > 1 else tips[0]
    if np.abs(along).argmax() != 0 or tips[:, 0].mean() <= 0:
        yield (
            "warning",
            f"the fingers do not point along x of the palm {spec.palm!r}. Its x should point towards them, its z out "
            "of its inner side.",
        )
    palm_body = tree.moving_ancestor(spec.palm)
    if palm_body != tree.moving_ancestor(spec.hand_root):
        yield (
            "warning",
            f"the palm {spec.palm!r} is not fixed to the hand's root {spec.hand_root!r}, but to "
            f"{palm_body!r}. Fix it to the body that carries the fingers.",
        )
    knuckles = [(palm @ places[chain[0]])[:3, 3] for chain in _chains(spec, tree)[1:]]
    distance = min(np.linalg.norm(knuckles, axis=1)) if knuckles else 0.0
    if distance > _PALM:
        yield (
            "error",
            f"the palm {spec.palm!r} is {1e3 * distance:.0f} mm from the nearest finger, expected {1e3 * _PALM:.0f} mm "
            "at most: it is not in the palm. Move its frame.",
        )


def _chains(spec: RobotSpec, tree: RobotTree) -> list[list[str]]:
    """Return for each fingertip the moving links from the hand's body to it, the body's neighbor first."""
    inside = tree.below(tree.moving_ancestor(spec.hand_root))[1:]
    moving = [link for link in inside if link in tree.moved_by]
    chains = []
    for tip in spec.fingertips:
        chains.append([link for link in moving if tip.link in tree.below(link)])
    return chains


def _fingers(spec: RobotSpec, tree: RobotTree) -> Problems:
    chains = _chains(spec, tree)
    shared = set(chains[0]).intersection(*chains)
    wrist = [joint.name for joint in tree.joints if joint.child in shared]
    if wrist and len(chains) > 1:
        yield (
            "error",
            f"{', '.join(wrist)} move every fingertip: joints of a wrist belong to the arm. Give them the group "
            "'arm', and let hand.root be the link after them.",
        )
    elif len(chains) > 2 and len(spec.hand_indices):  # two jaws are alike
        yield from _thumb(spec)


def _thumb(spec: RobotSpec) -> Problems:
    tips = [tip.link for tip in spec.fingertips]
    names = spec.fingertip_names
    meetings = opposition(spec, tips, np.zeros((len(tips), 3)))
    scores = np.sqrt(meetings).sum(axis=1)
    best = scores.argmax()

    def met(tip: int) -> str:
        return ", ".join(names[i] for i in np.flatnonzero(meetings[tip])) or "no other"

    heights = heights_over_palm(spec)
    if heights[0] < 0 < heights[1:].min():
        yield (
            "warning",
            f"the thumb {tips[0]!r} works on the back of the hand: at half of its joint positions it is more than "
            f"{-1e3 * heights[0]:.0f} mm behind the palm, where no other finger is. Its file may have the sign of an "
            "axis or a limit wrong, as after mirroring a hand; else turn the palm.",
        )
    elif scores[best] == 0:
        yield (
            "warning",
            "no fingertip can come near another and press against it. Are the joints' limits right?",
        )
    elif scores[0] == 0:
        yield (
            "warning",
            f"the thumb {tips[0]!r} can meet no other fingertip pad to pad. Are its joints' limits right?",
        )
    elif best:
        yield (
            "ok",
            f"the thumb {tips[0]!r}, as the description has it, can meet {met(0)} pad to pad; {names[best]} "
            f"{tips[best]!r} can meet {met(best)} more often",
        )


def _around_home(kinematics: Kinematics) -> torch.Tensor:
    """[1 + samples, J] home, and joint positions spread around it as at the start of episodes."""
    home = kinematics.home
    spread = torch.tensor(np.where(kinematics.robot.is_arm, *kinematics.robot.home_std))
    noise = torch.randn(
        _SAMPLES, len(home), generator=torch.Generator().manual_seed(0), dtype=home.dtype
    )
    return torch.cat((home[None], kinematics.clamp(home + spread * noise)))


def _above_table(kinematics: Kinematics, q: torch.Tensor) -> Problems:
    height = table_clearance(kinematics, q, TableSpec())
    share = float((height < 0).double().mean())
    level: Level = "ok"
    if height[0] < 0:
        level = "error"
    elif height[0] < _MIN_CLEARANCE or share > 0.01:
        level = "warning"
    lowest = f"lowest at {1e3 * height[0]:.0f} mm above the table"
    if height[0].isinf():
        lowest = "no shape that may not touch the table is above it"
    yield level, f"{lowest}; {100 * share:.0f} % of the spread below it"


def touching_itself(robot: RobotSpec, *, moved_by_arm: bool = False) -> float:
    """Return the share of the joint positions around home, as at the start of episodes, at which a robot touches
    itself.

    Args:
        robot: the robot with its home.
        moved_by_arm: count only pairs of links whose relative pose depends on an arm joint.
    """
    kinematics = Kinematics(robot)
    q = _around_home(kinematics)
    collision = SelfCollision(kinematics, moved_by_arm=moved_by_arm)
    return _share(collision.near(kinematics.link_poses(q).numpy(), 0.0), len(q))


def _share(near: Iterable[tuple[int, str, str]], count: int) -> float:
    """Return the share of ``count`` configurations in which two links touch; ``near``: (configuration, link, link)."""
    return len({configuration for configuration, _, _ in near}) / count


def _free_of_itself(kinematics: Kinematics, q: torch.Tensor) -> Problems:
    collision = SelfCollision(kinematics)
    for pair in collision.overlapping_at_home:
        yield (
            "error",
            f"{' and '.join(pair)} overlap at home: move home, or add the pair to collision.exclude.",
        )
    near = collision.near(kinematics.link_poses(q).numpy(), 0.0)
    share = 100 * _share(near, len(q))
    if share > 100 * MOST_TOUCHING:
        pairs = Counter(f"{a} and {b}" for _, a, b in near).most_common(_LISTED)
        often = ", ".join(f"{pair} ({100 * count / len(q):.0f} %)" for pair, count in pairs)
        text = "episodes that start so are pushed apart. Move home away, spread less, or exclude what always meets."
        yield "warning", f"{share:.0f} % of the spread around home touches itself: {often}; {text}"
    elif not collision.overlapping_at_home:
        yield "ok", f"free at home; {share:.0f} % of the spread around it touches itself"


def _size(spec: RobotSpec) -> Problems:
    """Say what retargeting makes of the collision shapes, and the memory that it will take."""
    model = HandModel(spec)
    size = f"{len(model.balls.radii)} balls on {len(model.balls.links)} links of the hand"
    yield "ok", f"{size}; about {predicted_gigabytes(model):.1f} GB"
