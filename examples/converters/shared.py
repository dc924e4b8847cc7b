"""What all converters do: their command line, the table's frame, and the file of keypoints that they write."""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

START = (0.55, 0.25)
"""Where the object is put on the table [m]."""


@dataclass(frozen=True)
class Recording:
    """One hand and one object in F frames, in any frame of reference that does not move; metres."""

    points: np.ndarray
    """[F, 21, 3] keypoints, NaN where the hand is absent."""
    poses: np.ndarray
    """[F, 4, 4] poses of the object's mesh."""
    time: np.ndarray
    """[F] seconds."""
    order: str = "mano"
    """Order of the keypoints, see docs/demonstrations.md."""


def to_table(
    recording: Recording, vertices: np.ndarray, up: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints and object poses in the table's frame: the object stands on the table at the start, at
    :data:`START`, and the hand comes from +y.

    Args:
        recording: the recording.
        vertices: [n, 3] vertices of the object's mesh [m].
        up: [3] the table's normal in the recording's frame.

    Raises:
        ValueError: the object sinks into the table, so ``up`` is wrong or the recording starts too late.
    """
    z = np.asarray(up, dtype=float) / np.linalg.norm(up)
    wrist = np.nanmean(recording.points[:, 0], axis=0) - recording.poses[0, :3, 3]
    y = wrist - (wrist @ z) * z
    y /= np.linalg.norm(y)
    T = np.eye(4)
    T[:3, :3] = (np.cross(y, z), y, z)
    poses = T @ recording.poses
    heights = vertices @ poses[:, 2, :3].T + poses[:, 2, 3]
    T[:3, 3] = (*(np.array(START) - poses[0, :2, 3]), -heights[:, 0].min())
    sunk = heights[:, 0].min() - heights.min()
    if sunk > 0.02:
        raise ValueError(
            f"The object sinks {1e3 * sunk:.0f} mm below its start. State the table's normal (--up X Y Z), or begin"
            " where the object stands on the table (--frames FIRST LAST)."
        )
    return recording.points @ T[:3, :3].T + T[:3, 3], T @ recording.poses


def convert(
    read: Callable[[argparse.Namespace], Recording], description: str, up: str | None
) -> None:
    """Read the command line, then a recording, and write it for ``xreset demos import keypoints``.

    Args:
        read: returns the recording that the options name.
        description: what the command says about itself.
        up: the table's normal in the data set's frame, as text; None: must be given.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("sequence", type=Path, help="file or folder of the sequence")
    parser.add_argument("--object", required=True, help="the object's name in the files")
    parser.add_argument(
        "--mesh", type=Path, required=True, help="the object's mesh, in the frame of its poses"
    )
    parser.add_argument("--mesh-scale", type=float, default=1.0, help="metres per unit of the mesh")
    parser.add_argument("--side", choices=("right", "left"), default="right")
    parser.add_argument("--mano", type=Path, help="MANO_RIGHT.pkl or MANO_LEFT.pkl")
    parser.add_argument("--up", type=float, nargs=3, default=up and [*map(float, up.split())], required=up is None,
                        help="the table's normal in the recording's frame")  # fmt: skip
    parser.add_argument("--frames", type=int, nargs=2, default=(0, None), metavar=("FIRST", "LAST"))
    parser.add_argument("--out", type=Path, required=True, help="npz file to write")
    options = parser.parse_args()
    recording = read(options)
    own = slice(*options.frames)
    recording = Recording(
        recording.points[own], recording.poses[own], recording.time[own], recording.order
    )
    vertices = trimesh.load(options.mesh, force="mesh", process=False).vertices * options.mesh_scale
    points, poses = to_table(recording, np.asarray(vertices), np.array(options.up))
    np.savez(
        options.out,
        keypoints=points,
        object_pose=poses,
        time=recording.time - recording.time[0],
        object=np.array(options.object),
        side=np.array(options.side),
    )
    print(
        f"{options.out}: {len(points)} frames. Next: xreset demos import keypoints {options.out} --out demos.npz"
        f" --order {recording.order} --units m --coordinates table --meshes FOLDER"
    )
