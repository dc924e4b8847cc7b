"""retarget: hand retargeting on one real sequence per object, next to PyRoki's contact-aware example, and seconds for a whole archive."""

from __future__ import annotations

from argparse import _ArgumentGroup
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from benchlib import Options, seconds_of
from rich.console import Console
from rich.table import Table
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from xreset import robots
from xreset.demos.archive import Demos, demo_objects, read_demos, rest_on_table
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.model import HandModel
from xreset.retarget.pipeline import HandMotions, RetargetConfig, follow
from xreset.spec import ObjectSpec

_CONTACT = 0.020
_EDGE = 0.005
_LONGEST = 74
_REFERENCE = (
    "PyRoki, same weights",
    "14.8 / 25.4",
    "16.1",
    "18.5",
    "16-61 %",
    "0.10-0.32",
    "45 per sequence",
)
"""Measured on two CPU cores with the Sharpa hand on the same nine sequences, after 70 s of compiling."""
_CONFIGS = {
    "default": HandWeights(),
    "contact weight 20": HandWeights(contact_weight=20.0),
    "paper's terms and the jump wall": HandWeights(clearance_weight=0.0),
}


@dataclass(frozen=True, kw_only=True)
class Errors:
    """What one configuration reaches, over annotated frames."""

    tips: np.ndarray
    """Fingertip frame to fingertip keypoint [m]."""
    keypoints: np.ndarray
    """Link origin to keypoint [m]."""
    contacts: np.ndarray
    """Link origin to contact point, of keypoints in contact [m]."""
    human: np.ndarray
    """The keypoints themselves to the contact points [m]."""
    jumps: np.ndarray
    """Change of a hand joint between neighbouring frames [rad]."""
    beyond_limits: float
    """Furthest that a joint is beyond its limits [rad]."""


def add_arguments(group: _ArgumentGroup) -> None:
    group.add_argument(
        "--retarget-demos",
        type=Path,
        help="archive of real right-hand demonstrations (default: the section is left out)",
    )
    group.add_argument("--retarget-objects", type=Path, help="folder of their meshes")


def run(options: Options, console: Console) -> None:
    path = options.extra["retarget_demos"]
    folder = options.extra["retarget_objects"]
    if not isinstance(path, Path) or not isinstance(folder, Path):
        console.print("retarget: left out. Give --retarget-demos and --retarget-objects.")
        return
    demos = read_demos(path)
    objects = demo_objects(demos, folder)
    nine = one_per_object(demos)
    table = Table(
        "",
        "fingertips: mean / p95 [mm]",
        "keypoints",
        "contacts",
        "beyond 20 mm",
        "largest jump [rad]",
        "time [s]",
    )
    for name, config in _CONFIGS.items():
        found: list[Errors] = []
        seconds = seconds_of(
            lambda found=found, config=config: found.append(errors(nine, objects, options, config))
        )
        table.add_row(name, *_row(found[0]), f"{seconds:.0f} for {len(nine)}")
    table.add_row(*_REFERENCE)
    console.print(table)
    console.print(
        f"human keypoints to their contact points: {1e3 * found[0].human.mean():.1f} mm; {len(nine)} sequences, {nine.num_frames} frames"
    )
    if found[0].beyond_limits > 0:
        raise AssertionError(f"a hand joint is {found[0].beyond_limits} rad beyond its limits")
    robot = robots.load(options.robot)
    given = (demos, robot, list(objects.values()))
    hands = seconds_of(lambda: list(HandMotions(*given, device=options.device).batches()))
    whole = seconds_of(lambda: follow(*given, device=options.device))
    frames = demos.hand_valid.sum()
    console.print(
        f"{len(demos)} sequences, {frames} annotated frames: {whole:.0f} s, {1e3 * whole / frames:.1f} ms a frame, "
        f"of which the hand takes {hands / whole:.0%}"
    )


def one_per_object(demos: Demos) -> Demos:
    """The first sequence of each object in which the hand is always annotated and which has at most 74 frames."""
    chosen: dict[str, int] = {}
    for i, name in enumerate(demos.object_name.tolist()):
        rows = demos.frames(i)
        if (
            name not in chosen
            and demos.hand_valid[rows].all()
            and rows.stop - rows.start <= _LONGEST
        ):
            chosen[name] = i
    return demos.select(indices=[chosen[name] for name in sorted(chosen)])


def errors(
    demos: Demos, objects: Mapping[str, ObjectSpec], options: Options, config: HandWeights
) -> Errors:
    """Retarget the hand and measure."""
    robot = robots.load(options.robot)
    hand = HandModel(robot)
    keypoint = hand.keypoint_indices
    tip = hand.is_tip.numpy()
    specs = list(objects.values())
    on_table = rest_on_table(demos, specs)
    points, touching = vertex_contacts(on_table, objects)
    parts: list[tuple[np.ndarray, ...]] = []
    beyond = 0.0
    hands = HandMotions(demos, robot, specs, RetargetConfig(hand=config), device=options.device)
    for part in hands.batches():
        motion = part.motion
        followed = hand.keypoints(motion).numpy()
        beyond = max(
            beyond,
            float(
                torch.maximum(
                    hand.kinematics.lower - motion.joints, motion.joints - hand.kinematics.upper
                ).max()
            ),
        )
        for slot, i in enumerate(np.unique(on_table.sequence_of_frame[part.rows])):
            rows = on_table.frames(i)
            seen = on_table.hand_valid[rows]
            robot_points = followed[slot, : len(seen)]
            human = on_table.hand_keypoints[rows][:, keypoint]
            contact_points = points[rows][:, keypoint]
            contact = touching[rows][:, keypoint] & seen[:, None]
            off = np.linalg.norm(robot_points - human, axis=-1)[seen]
            jumps = np.abs(np.diff(motion.joints[slot, : len(seen)].numpy(), axis=0))[
                seen[1:] & seen[:-1]
            ]
            to_contact = (
                np.linalg.norm(x - contact_points, axis=-1)[contact] for x in (robot_points, human)
            )
            parts.append((off[:, tip].ravel(), off.ravel(), *to_contact, jumps.ravel()))
    tips, keypoints, contacts, human_contacts, jumps = (
        np.concatenate(values) for values in zip(*parts, strict=True)
    )
    return Errors(
        tips=tips,
        keypoints=keypoints,
        contacts=contacts,
        human=human_contacts,
        jumps=jumps,
        beyond_limits=beyond,
    )


def vertex_contacts(
    demos: Demos, objects: Mapping[str, ObjectSpec]
) -> tuple[np.ndarray, np.ndarray]:
    """Nearest mesh vertex [F, 21, 3] of every keypoint, edges of the mesh being at most 5 mm, and whether it is nearer than 20 mm."""
    import trimesh

    points = np.zeros((demos.num_frames, 21, 3))
    touching = np.zeros((demos.num_frames, 21), dtype=bool)
    vertices = {
        name: trimesh.remesh.subdivide_to_size(spec.vertices, spec.faces, _EDGE)[0]
        for name, spec in objects.items()
    }
    trees = {name: cKDTree(v) for name, v in vertices.items()}
    for i, name in enumerate(demos.object_name.tolist()):
        rows = demos.frames(i)
        turn = Rotation.from_quat(demos.object_quat_wxyz[rows], scalar_first=True).as_matrix()
        pos = demos.object_pos[rows][:, None]
        local = np.einsum(
            "fij,fki->fkj", turn, np.nan_to_num(demos.hand_keypoints[rows], nan=1e3) - pos
        )
        distance, nearest = trees[name].query(local)
        points[rows] = np.einsum("fij,fkj->fki", turn, vertices[name][nearest]) + pos
        touching[rows] = distance < _CONTACT
    return points, touching


def _row(found: Errors) -> list[str]:
    return [
        f"{1e3 * found.tips.mean():.1f} / {1e3 * np.percentile(found.tips, 95):.1f}",
        f"{1e3 * found.keypoints.mean():.1f}",
        f"{1e3 * found.contacts.mean():.1f}",
        f"{(found.contacts > _CONTACT).mean():.0%}",
        f"{found.jumps.max():.2f}",
    ]
