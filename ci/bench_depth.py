"""depth: how deep the hand of retargeted states is in the object, between collision shapes, exactly (coal)."""

from __future__ import annotations

from argparse import _ArgumentGroup
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
from benchlib import Options
from rich.console import Console
from rich.table import Table

from xreset import robots
from xreset.geometry.collision import coal_geometry, support_points
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_to_matrix
from xreset.objects.catalogue import load_objects
from xreset.retarget.file import Retargeted, read_retargeted
from xreset.spec import ObjectSpec, RobotSpec, Shape

_DEPTHS = (0.001, 0.003, 0.005)


def add_arguments(group: _ArgumentGroup) -> None:
    group.add_argument(
        "--depth-file",
        type=Path,
        help="what xreset retarget made (default: the section is left out)",
    )
    group.add_argument("--depth-objects", type=Path, help="folder of meshes")


def run(options: Options, console: Console) -> None:
    path = options.extra["depth_file"]
    folder = options.extra["depth_objects"]
    if not isinstance(path, Path):
        console.print("depth: left out. Give --depth-file and --depth-objects.")
        return
    robot = robots.load(options.robot)
    states = read_retargeted(path)
    specs = load_objects(
        sorted(set(states.object_name.tolist())), folder if isinstance(folder, Path) else None
    )
    links, name, depth = depths(states, robot, {spec.name: spec for spec in specs})
    table = Table(
        "",
        "valid frames",
        "deepest [mm]",
        *(f"> {1e3 * limit:g} mm" for limit in _DEPTHS),
        f"> {1e3 * _DEPTHS[1]:g} mm by link",
    )
    for one in [*dict.fromkeys(name.tolist()), "all"]:
        mine = depth[name == one] if one != "all" else depth
        worst = mine.max(axis=1)
        by_link = ((link, (mine[:, k] > _DEPTHS[1]).mean()) for k, link in enumerate(links))
        shares = [f"{(worst > limit).mean():.1%}" for limit in _DEPTHS]
        table.add_row(
            one,
            str(len(mine)),
            f"{1e3 * worst.max():.1f}",
            *shares,
            ", ".join(f"{link} {s:.1%}" for link, s in by_link if s),
        )
    console.print(table)


def depths(
    states: Retargeted, robot: RobotSpec, objects: dict[str, ObjectSpec]
) -> tuple[list[str], np.ndarray, np.ndarray]:
    """Links with shapes; object [M] and depth [M, links] in it [m] of every valid frame, 0 where they are apart."""
    import coal

    request = coal.DistanceRequest()
    result = coal.DistanceResult()
    request.enable_signed_distance = True
    kinematics = Kinematics(robot)
    links = [
        link
        for link in Kinematics(robot, root=robot.hand_root).link_names
        if kinematics.tree.link(link).collisions
    ]
    T_links = kinematics.link_poses(torch.as_tensor(states.joint_pos), links).numpy()
    T_objects = np.tile(np.eye(4), (len(states.valid), 1, 1))
    T_objects[:, :3, :3] = quat_to_matrix(torch.as_tensor(states.object_quat_wxyz)).numpy()
    T_objects[:, :3, 3] = states.object_pos
    hand = [_prepared(coal, kinematics.tree.link(link).collisions) for link in links]
    pieces = {name: _prepared(coal, spec.pieces) for name, spec in objects.items()}
    names = states.object_name[states.sequence_of_frame]
    frames = np.flatnonzero(states.valid)
    depth = np.zeros((len(frames), len(links)))
    for row, frame in enumerate(frames):
        for k, shapes in enumerate(hand):
            for T_shape, shape, center, radius in shapes:
                for T_piece, piece, middle, reach in pieces[names[frame]]:
                    a = T_links[frame, k]
                    b = T_objects[frame]
                    if np.linalg.norm(a @ center - b @ middle) < radius + reach:
                        poses = [
                            coal.Transform3s(T[:3, :3].copy(), T[:3, 3].copy())
                            for T in (a @ T_shape, b @ T_piece)
                        ]
                        result.clear()
                        distance = coal.distance(shape, poses[0], piece, poses[1], request, result)
                        depth[row, k] = max(depth[row, k], -distance)
    return links, names[frames], depth


def _prepared(coal, shapes: Iterable[Shape]) -> list[tuple[np.ndarray, object, np.ndarray, float]]:
    """Pose of each shape, coal's geometry, and centre (homogeneous) and radius of a ball about it."""
    prepared = []
    for shape in shapes:
        points, radius = support_points(shape)
        center = (points.max(axis=0) + points.min(axis=0)) / 2
        reach = radius + float(np.linalg.norm(points - center, axis=1).max())
        geometry = coal_geometry(coal, shape.geometry)
        prepared.append((shape.T_body_shape, geometry, np.array([*center, 1.0]), reach))
    return prepared
