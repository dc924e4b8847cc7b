"""Checks a robot in one go: its description, its URDF, its physics, and how the engines build it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from xreset.description import DESCRIPTION, load_robot
from xreset.errors import BackendUnavailableError, XResetError
from xreset.geometry.collision import SelfCollision, height_above_table, table_points
from xreset.geometry.dynamics import damping_ratio, drive_inertia
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import surface_of
from xreset.geometry.urdf import Link, RobotTree, robot_tree
from xreset.objects.catalogue import load_object
from xreset.physics import Backend
from xreset.plugins import backend_names, make_backend, robot_folder
from xreset.retarget.hand.model import HandModel, predicted_gigabytes
from xreset.robot_tools.draft import link_places
from xreset.robot_tools.opposition import opposition, opposition_scores
from xreset.robot_tools.sources import largest_moment
from xreset.spec import RobotSpec, SceneSpec, TableSpec

Level = Literal["ok", "skipped", "warning", "error"]

MIN_CLEARANCE = 0.005
"""Clearance [m] from the table that the home configuration should have."""
_ROUNDING = 1e-3
"""Relative slack of the triangle inequality: published inertias are rounded."""
_SAMPLES = 200
_POSE_TOLERANCE = 1e-3
_LIMIT_SLACK = 1e-3
"""[rad or m] By which a mimic joint's limits may fall short of its source's: published figures are rounded."""
_OFF = 0.01
"""[m] From the middle of a link's shapes: a centre of mass in the joint that is farther away is doubted."""
_LISTED = 4
"""Pairs of links that are named, most frequent first."""
_PALM = 0.12
"""[m] From the palm's frame to the nearest joint of a finger: a human palm is 10 cm long."""
_LESS_OPPOSED = 0.75
"""Share of the best fingertip's opposition that a thumb has at least. Index fingers have up to 0.73 (Allegro)."""
_HOLD_STEPS = 30
_HOLD_TOLERANCE = 0.02


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at."""

    level: Level
    topic: str
    """What was looked at, such as ``joints``."""
    message: str
    """What was found, what was expected, and what to do."""


def check_description(name_or_folder: str | Path) -> tuple[RobotSpec | None, list[Finding]]:
    """Check everything that needs no engine.

    Returns:
        The robot, or None if its description or its URDF cannot be read; and the findings, one ``ok`` for each topic
        without a problem.
    """
    try:
        folder = robot_folder(name_or_folder)
        spec = load_robot(name_or_folder)
    except XResetError as error:
        return None, [Finding("error", "description", str(error))]
    counts = (
        f"{len(spec.arm_indices)} arm joints, {len(spec.hand_indices)} hand joints, {len(spec.fingertips)} fingertips"
    )
    found = [Finding("ok", "description", f"{folder / DESCRIPTION}: {counts}")]
    try:
        tree = robot_tree(spec)
    except XResetError as error:
        return None, [*found, Finding("error", "URDF", str(error))]
    shapes = sum(len(link.collisions) for link in tree.links)
    mass = sum(link.mass for link in tree.links)
    content = f"{len(tree.links)} links, {len(tree.joints)} joints, {shapes} collision shapes, {mass:.1f} kg"
    found.append(Finding("ok", "URDF", content))
    joints = f"{len(spec.joints)} actuated joints exist, have limits, and are at home within them"
    found += _topic("joints", _joints(spec, tree), joints)
    found += _topic("mimic joints", _mimics(spec, tree), f"{len(spec.mimics)} follow an actuated joint")
    found += _topic("links", _links(spec, tree), "palm, fingertips, keypoints and collision links exist")
    found += _topic("inertias", _inertias(tree), "masses are positive, inertias are those of solid bodies")
    if any(finding.level == "error" for finding in found):
        return spec, [*found, Finding("skipped", "home", "fix the errors above first")]
    ratio = damping_ratio(spec, spec.home)
    found += _topic("drives", _drives(spec), f"damping ratios at home are {ratio.min():.2f}..{ratio.max():.2f}")
    found += _topic("frames", _frames(spec, tree), "the palm frame is in the palm, and looks along the fingers")
    found += _topic("fingers", _fingers(spec, tree), "the thumb can oppose every other fingertip")
    found += _home(spec)
    found.append(_size(spec))
    if spec.placement is not None:
        place = spec.placement
        stated = f"reaches {place.reached:.1%} and follows {place.followed:.1%} of {place.frames} frames"
        found.append(Finding("ok", "placement", f"{stated}, says {DESCRIPTION}: {place.command}"))
    return spec, found


def check_engine(spec: RobotSpec, backend: str) -> Finding:
    """Build the robot in an engine, compare its link poses with xreset's own kinematics, and let it hold its home
    configuration."""
    topic = f"engine {backend}"
    try:
        with make_backend(backend, SceneSpec(robot=spec, objects=(load_object("soup"),)), 1) as engine:
            problem = _links_disagree(spec, engine) or _does_not_hold(spec, engine)
    except BackendUnavailableError as error:
        return Finding("skipped", topic, str(error))
    except Exception as error:  # whatever an engine says about this robot is what its author needs to read
        return Finding("error", topic, f"{type(error).__name__}: {error}")
    if problem:
        return Finding("error", topic, problem)
    return Finding("ok", topic, f"link poses agree within {_POSE_TOLERANCE * 1e3:g} mm; home is held")


def check(
    name_or_folder: str | Path, *, report: Callable[[Finding], None] = lambda _: None, engines: bool = True
) -> list[Finding]:
    """Check a robot.

    Args:
        name_or_folder: a registered name or a folder.
        report: called with each finding as soon as there is one (building a scene can take a minute in some engines).
        engines: whether to build the robot in every installed engine.

    Returns:
        All findings.
    """
    spec, found = check_description(name_or_folder)
    for finding in found:
        report(finding)
    if spec is None or not engines:
        return found
    if any(finding.level == "error" for finding in found):
        found.append(Finding("skipped", "engines", "fix the errors above first"))
        report(found[-1])
        return found
    for backend in backend_names():
        found.append(check_engine(spec, backend))
        report(found[-1])
    return found


Problems = Iterator[tuple[Level, str]]


def _topic(topic: str, problems: Problems, otherwise: str) -> list[Finding]:
    found = [Finding(level, topic, message) for level, message in problems]
    return found or [Finding("ok", topic, otherwise)]


# Description against URDF ---------------------------------------------------------------------------------------------


def _joints(spec: RobotSpec, tree: RobotTree) -> Problems:
    known = {joint.name: joint for joint in tree.joints}
    moving = [joint.name for joint in tree.joints if joint.type != "fixed"]
    inside = set(tree.below(spec.hand_root)[1:])
    for joint in spec.joints:
        found = known.get(joint.name)
        if found is None:
            yield "error", f"{joint.name!r} is not in the URDF, which has {', '.join(moving)}."
            continue
        limits = f"{found.lower:g}..{found.upper:g}"
        if found.type == "fixed":
            yield "error", f"{joint.name!r} is fixed in the URDF; an actuated joint must move."
        elif not np.isfinite((found.lower, found.upper)).all() or found.lower >= found.upper:
            yield "error", f"{joint.name!r} has the limits {limits}; expected finite ones, the lower one first."
        elif not found.lower <= joint.home <= found.upper:
            yield "error", f"{joint.name!r} is at home at {joint.home:g}, outside its limits {limits}."
        elif (found.child in inside) != (joint.group == "hand"):
            where = "below" if found.child in inside else "not below"
            text = f"{joint.name!r} is of group {joint.group!r} but lies {where} the hand's root {spec.hand_root!r}."
            yield "warning", text
    moved = {*spec.joint_names, *(mimic.joint for mimic in spec.mimics)}
    for name in moving:
        if name not in moved:
            text = "moves but is neither actuated nor a mimic joint; add it to either, or make it fixed."
            yield "error", f"the URDF's {name!r} {text}"


def _mimics(spec: RobotSpec, tree: RobotTree) -> Problems:
    known = {joint.name: joint for joint in tree.joints if joint.type != "fixed"}
    for mimic in spec.mimics:
        own = known.get(mimic.joint)
        source = known.get(mimic.source)
        if own is None:
            yield "error", f"{mimic.joint!r} is not a moving joint of the URDF."
        elif source is not None:
            low, high = sorted(mimic.multiplier * limit + mimic.offset for limit in (source.lower, source.upper))
            if low < own.lower - _LIMIT_SLACK or high > own.upper + _LIMIT_SLACK:
                yield (
                    "error",
                    f"{mimic.joint!r} goes from {low:.4g} to {high:.4g} with {mimic.source!r}, beyond its own limits "
                    f"{own.lower:.4g}..{own.upper:.4g}: the two would hold each other up. Widen its limits, or narrow "
                    "those of the source.",
                )


def _links(spec: RobotSpec, tree: RobotTree) -> Problems:
    known = {link.name: link for link in tree.links}
    wanted = {"hand.root": [spec.hand_root], "hand.palm": [spec.palm]}
    for tip in spec.fingertips:
        wanted[f"fingertip {tip.name!r}"] = [tip.link]
        wanted[f"contact_links of {tip.name!r}"] = [*tip.contact_links]
    for point in spec.keypoints:
        wanted[f"keypoint {point.keypoint!r}"] = [point.link]
    wanted["collision.self"] = [*spec.self_collision_links]
    wanted["collision.exclude"] = [link for pair in spec.collision_exclude for link in pair]  # noqa: XR002
    wanted["collision.table_exclude"] = [*spec.table_exclude]
    absent = [(where, link) for where, links in wanted.items() for link in links if link not in known]  # noqa: XR002
    for where, link in absent:
        yield "error", f"{where}: the URDF has no link {link!r}. Choose from: {', '.join(known)}."
    if absent:
        return
    inside = set(tree.below(spec.hand_root)[1:])
    for tip in spec.fingertips:
        if not any(known[link].collisions for link in tip.contact_links):
            links = ", ".join(tip.contact_links)
            yield "error", f"fingertip {tip.name!r}: none of {links} has a collision shape, so it can touch nothing."
        if tip.link not in inside:
            text = f"{tip.link!r} does not lie below the hand's root {spec.hand_root!r}."
            yield "error", f"fingertip {tip.name!r}: {text}"
    for link in spec.self_collision_links:
        if not known[link].collisions:
            yield "warning", f"collision.self: {link!r} has no collision shape."


def _inertias(tree: RobotTree) -> Problems:
    at_joints = []
    for link in tree.links:
        if link.mass > 0 and link.collisions and not link.com.any() and _off_middle(link) > _OFF:
            at_joints.append(link.name)
    if at_joints:
        yield (
            "warning",
            f"the centre of mass of {', '.join(at_joints)} lies in the joint, more than {1e3 * _OFF:.0f} mm from the "
            "middle of the link's "
            "shapes. Is it a placeholder?",
        )
    moved = {joint.child for joint in tree.joints if joint.type != "fixed"}
    for link in tree.links:
        name = link.name
        if link.mass <= 0:
            if name in moved:
                text = (
                    f"{name!r} moves but has the mass {link.mass:g} kg; every moving link needs a mass and an inertia."
                )
                yield "error", text
            continue
        moments = np.linalg.eigvalsh(link.inertia)
        listed = ", ".join(f"{moment:.3g}" for moment in moments)
        if moments[0] <= 0 or moments[2] > (moments[0] + moments[1]) * (1 + _ROUNDING):
            yield (
                "error",
                f"{name!r} has the principal moments {listed} kg m^2. Expected those of a solid body: positive ones, "
                "the largest at most the sum of the others.",
            )
        elif link.collisions and moments[2] > largest_moment(link):
            yield (
                "warning",
                f"{name!r} has a moment of {moments[2]:.3g} kg m^2; {link.mass:.3g} kg of its size can have "
                f"{largest_moment(link):.2g} at "
                "most. Is it a placeholder? `xreset robots import` replaces such.",
            )


def _off_middle(link: Link) -> float:
    """Distance of a link's center of mass from the middle of its shapes' bounding box [m]."""
    vertices, _ = surface_of(link.collisions)
    return float(np.linalg.norm((vertices.min(axis=0) + vertices.max(axis=0)) / 2 - link.com))


# Physics --------------------------------------------------------------------------------------------------------------


def _drives(spec: RobotSpec) -> Problems:
    for joint in spec.joints:
        drive = joint.drive
        if drive.kp <= 0 or drive.effort <= 0 or min(drive.kd, drive.armature, drive.friction_loss) < 0:
            text = "kp and effort must be positive; kd, armature and friction_loss must not be negative."
            yield "error", f"{joint.name!r}: {text}"
            return
    step = SceneSpec.timestep
    ratios = damping_ratio(spec, spec.home)
    inertias = drive_inertia(spec, spec.home)
    for joint, ratio, inertia in zip(spec.joints, ratios, inertias, strict=True):
        has = f"{joint.name!r} has the damping ratio"
        if ratio < 0.5:
            yield "warning", f"{has} {ratio:.2f} at home and will swing; 0.7 to 1.5 is usual: raise kd."
        if ratio > 5:
            yield "warning", f"{has} {ratio:.1f} at home and will creep; 0.7 to 1.5 is usual: lower kd."
        if joint.drive.kd * step > inertia:
            yield (
                "warning",
                f"{joint.name!r}: kd = {joint.drive.kd:g} is too much for its inertia {inertia:.3g} at a step of "
                f"1/{1 / step:.0f} s; "
                "engines that integrate drives explicitly become unstable. Lower kp and kd, or state the rotor as the "
                "joint's armature.",
            )


def _frames(spec: RobotSpec, tree: RobotTree) -> Problems:
    places = link_places(spec, {})
    palm = np.linalg.inv(places[spec.palm])
    tips = np.array([(palm @ places[tip.link])[:3, 3] for tip in spec.fingertips])
    along = tips[1:].mean(axis=0) if len(tips) > 1 else tips[0]
    longest = int(np.abs(along).argmax())
    if longest != 0 or tips[:, 0].mean() <= 0:
        axis = ("-" if along[longest] < 0 else "") + "xyz"[longest]
        yield (
            "warning",
            f"the fingers lie along {axis} of the palm {spec.palm!r}: its x should point towards them, z out of its "
            "inner side.",
        )
    body = tree.moving_ancestor(spec.hand_root)
    if tree.moving_ancestor(spec.palm) != body:
        yield (
            "warning",
            f"the palm {spec.palm!r} is not fixed to the hand's root {spec.hand_root!r}, but to "
            f"{tree.moving_ancestor(spec.palm)!r}. Fix it to the body that carries the fingers.",
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
    moving = [joint.child for joint in tree.joints if joint.type != "fixed" and joint.child in inside]
    return [[link for link in moving if tip.link in tree.below(link)] for tip in spec.fingertips]  # noqa: XR002


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
    scores = opposition_scores(meetings)
    best = int(scores.argmax())
    met = [", ".join(names[i] for i in np.flatnonzero(row)) or "no other" for row in meetings]  # noqa: XR002
    if scores[best] == 0:
        yield "warning", "no fingertip can come near another and press against it. Are the joints' limits right?"
    elif scores[0] < _LESS_OPPOSED * scores[best]:
        yield (
            "error",
            f"the thumb {tips[0]!r} can meet {met[0]} pad to pad, {names[best]} {tips[best]!r} can meet {met[best]} "
            "more often: is that the thumb? Then import again with "
            f"--thumb {tips[best]}, or make it the first fingertip, with keypoint thumb4.",
        )
    elif not meetings[0, 1:].all():
        yield "ok", f"the thumb can meet {met[0]} pad to pad"


def _home(spec: RobotSpec) -> list[Finding]:
    """Check home, and configurations spread around it as at the start of episodes, against the table and the robot
    itself."""
    kinematics = Kinematics(spec)
    home = torch.tensor(spec.home)
    spread = torch.zeros_like(home)
    spread[spec.arm_indices], spread[spec.hand_indices] = spec.home_std
    noise = torch.randn(_SAMPLES, len(home), generator=torch.Generator().manual_seed(0), dtype=home.dtype)
    q = torch.cat((home[None], kinematics.clamp(home + spread * noise)))
    return [_above_table(spec, kinematics, q), *_free_of_itself(spec, kinematics, q)]


def _above_table(spec: RobotSpec, kinematics: Kinematics, q: torch.Tensor) -> Finding:
    support = table_points(spec, kinematics)
    points = kinematics.points(q, support.links, torch.tensor(support.points))
    height = height_above_table(points, torch.tensor(support.radii), TableSpec())
    clearance, lowest = height[0].min(dim=0)
    share = 100 * float((height.min(dim=1).values < 0).double().mean())
    level: Level = "ok"
    if clearance < 0:
        level = "error"
    elif clearance < MIN_CLEARANCE or share > 1:
        level = "warning"
    link = support.links[int(lowest)]
    text = f"lowest at {clearance * 1e3:.0f} mm above the table ({link}); {share:.0f} % of the spread below it"
    return Finding(level, "home and table", text)


def _free_of_itself(spec: RobotSpec, kinematics: Kinematics, q: torch.Tensor) -> list[Finding]:
    topic = "home and self"
    try:
        collision = SelfCollision(spec, kinematics)
    except XResetError as error:
        return [Finding("skipped", topic, str(error))]
    found = []
    for pair in collision.overlapping_at_home:
        text = f"{' and '.join(pair)} overlap at home: move home, or add the pair to collision.exclude."
        found.append(Finding("error", topic, text))
    near = collision.near(kinematics.link_poses(q).numpy(), 0.0)
    share = 100 * len(np.unique(near.configuration)) / len(q)
    if share > 20:
        names = np.array(kinematics.link_names)
        meetings = set()
        for configuration, pair in zip(near.configuration, near.links, strict=True):
            meetings.add((int(configuration), " and ".join(names[pair])))
        pairs = Counter(pair for _, pair in meetings).most_common(_LISTED)
        often = ", ".join(f"{pair} ({100 * count / len(q):.0f} %)" for pair, count in pairs)
        text = (
            f"{share:.0f} % of the spread around home touches itself: {often}; episodes that start so are pushed "
            "apart. Move home away, spread less (home_std), or exclude what always meets."
        )
        found.append(Finding("warning", topic, text))
    elif not found:
        text = f"free at home; {share:.0f} % of the spread around it touches itself"
        found.append(Finding("ok", topic, text))
    return found


def _size(spec: RobotSpec) -> Finding:
    """Say what retargeting makes of the collision shapes, and the memory that it will take."""
    try:
        model = HandModel(spec)
    except XResetError as error:
        return Finding("skipped", "retargeting", str(error))
    balls = model.balls
    text = (
        f"{len(balls.radii)} balls on {len(balls.links)} links of the hand, {len(balls.guards)} of them kept out of "
        "other links in"
        f" {len(balls.link_pairs) // 2} pairs of links; about {predicted_gigabytes(model):.1f} GB"
    )
    return Finding("ok", "retargeting", text)


def _links_disagree(spec: RobotSpec, engine: Backend) -> str | None:
    state = engine.state()
    expected = Kinematics(spec).link_poses(state.joint_pos[0].double().cpu(), spec.tracked_links)[:, :3, 3]
    away = (engine.links().pos[0].double().cpu() - expected).norm(dim=-1)
    if bool(torch.isfinite(away).all()) and float(away.max()) < _POSE_TOLERANCE:
        return None
    link = spec.tracked_links[int(away.argmax())]
    return f"at home {link!r} is {float(away.max()) * 1e3:.1f} mm from where xreset's kinematics has it."


def _does_not_hold(spec: RobotSpec, engine: Backend) -> str | None:
    home = torch.tensor(spec.home, dtype=torch.float32)
    engine.set_joint_targets(home.to(engine.device)[None])
    for _ in range(_HOLD_STEPS):
        engine.step()
    away = (engine.state().joint_pos[0].cpu() - home).abs()
    if bool(torch.isfinite(away).all()) and float(away.max()) < _HOLD_TOLERANCE:
        return None
    joint = spec.joint_names[int(away.nan_to_num(torch.inf).argmax())]
    return (
        f"after {_HOLD_STEPS} control steps with home as the target {joint!r} is {float(away.max()):.3f} rad (m) away "
        "from it."
    )
