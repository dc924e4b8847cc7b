"""Recorded episodes as a LeRobot data set, format v3.0: parquet files, films and meta (github.com/huggingface/lerobot,
``docs/source/lerobot-dataset-v3.mdx``). It is written without the package ``lerobot``, which reads it, because that
package pins another torch and gymnasium than xreset needs, and knows no facts of an episode such as its engine.

Shape letters: T frames of an episode, J actuated joints.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from xreset.cameras.config import CAMERAS, VisionConfig, camera_of, check_each_once
from xreset.errors import XResetError, needs
from xreset.eval.export.recorded import SCHEMA, RecordedEpisodes
from xreset.eval.report.clips import draw_state, draw_view, policy_cameras
from xreset.eval.results import Trace
from xreset.files.progress import Progress, unseen
from xreset.files.storage import atomic_folder, write_json
from xreset.objects.catalogue import load_object
from xreset.pictures.render import Renderer, Size, check_film_size, encode_mp4
from xreset.spec import RobotSpec, SceneSpec

_FORMAT = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
_IMAGES = "observation.images."
VIDEO = _IMAGES + "front"
_DEPTH = _IMAGES + "depth_"
"""Films of depth cameras, followed by the camera's name: near is bright, nothing is black."""
Painter = Callable[[Trace, int], np.ndarray]
"""Draws one state of a trace, [H, W, 3]."""
_FIRST = "chunk-000/file-000.parquet"
_KEYFRAMES = 2
"""Every second frame can be shown without the frames before it, as in films of LeRobot: training draws frames at
random."""
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


def write_lerobot(
    folder: Path,
    recording: RecordedEpisodes,
    *,
    video: bool = True,
    size: Size = (320, 240),
    cameras: Sequence[str] = (),
    progress: Progress = unseen,
) -> None:
    """Write a data set; ``docs/rollouts.md`` has its features.

    Args:
        folder: folder to write; must not exist, or be empty. It appears whole or not at all.
        video: whether films are drawn: from one camera for all episodes, the goal as a translucent object.
        size: width and height of the films [pixels], even.
        cameras: names of depth cameras (:data:`xreset.cameras.config.CAMERAS`), each of which gives a film.
        progress: called with (episodes written, episodes in all).

    Raises:
        XResetError: a camera is unknown or given twice, pyarrow or the encoder of films is missing, the folder is not
            empty, or it cannot be written.
    """
    with needs("pyarrow, which writes LeRobot data sets,", "lerobot"):
        import pyarrow.parquet  # noqa: F401
    check_each_once([camera_of(name) for name in cameras])
    if cameras and not video:
        raise XResetError(
            "Films of cameras are wanted and not wanted. Leave out --no-video or --camera."
        )
    videos = (VIDEO, *(_DEPTH + name for name in cameras)) if video else ()
    if video:
        check_film_size(size)
    with atomic_folder(folder) as part:
        _write(part, recording, videos, size, progress)


def _write(
    root: Path,
    recording: RecordedEpisodes,
    videos: tuple[str, ...],
    size: Size,
    progress: Progress,
) -> None:
    offsets = recording.offsets
    task_index, tasks = pd.factorize(recording.episodes["task"])
    samples: dict[str, list[np.ndarray]] = {}
    rows = []
    painter = cache(partial(_painter, recording.robot, size))
    for i, episode in enumerate(recording.episodes.to_dict("records")):
        arrays = _arrays(episode, i, int(offsets[i]), int(task_index[i]), recording.fps)
        row = _row(episode, i, int(offsets[i]), int(offsets[i + 1]))
        for video in videos:
            paint = painter(video, episode["trace"].object, episode["meshes"])
            film = np.stack([paint(episode["trace"], frame) for frame in range(row["length"])])
            row |= _write_film(root, video, i, film, recording.fps)
            arrays[video] = film[::10, ::8, ::8].reshape(-1, 3) / 255.0
        for key, values in arrays.items():
            samples.setdefault(key, []).append(values)
            row |= {f"stats/{key}/{name}": value for name, value in _stats(key, values).items()}
        rows.append(row)
        progress(i + 1, len(offsets) - 1)
    whole = {key: np.concatenate(parts) for key, parts in samples.items()}
    features = _features(recording, videos, size)
    engines = np.repeat(recording.episodes["engine"].tolist(), np.diff(offsets))
    numbers = {key: values for key, values in whole.items() if key not in videos}
    _write_tables(root, numbers, features, engines, rows)
    pd.DataFrame({"task_index": range(len(tasks))}, index=pd.Index(tasks, name="task")).to_parquet(
        root / "meta/tasks.parquet"
    )
    write_json(
        root / "meta/stats.json", {key: _stats(key, values) for key, values in whole.items()}
    )
    write_json(root / "meta/xreset.json", {"schema": SCHEMA})  # with the version of xreset
    write_json(root / "meta/info.json", _info(recording, len(tasks), features))


def _row(episode: dict[str, Any], index: int, begin: int, end: int) -> dict[str, Any]:
    """Return what the table of episodes states about an episode whose frames are ``begin`` to ``end``."""
    distance = episode["least_distance"]  # NaN: an earlier version did not measure it
    return {
        "episode_index": index,
        "tasks": [episode["task"]],
        "length": end - begin,
        "dataset_from_index": begin,
        "dataset_to_index": end,
        "engine": episode["engine"],
        "policy": episode["policy"],
        "seed": episode["seed"],
        "object": episode["object"],
        "demonstration": episode["sequence_name"],
        "success": episode["reorient"],
        "task_progress": episode["task_progress"],
        "published_success": None if pd.isna(distance) else bool(episode["published_success"]),
        "least_distance": None if pd.isna(distance) else distance,
        "data/chunk_index": 0,
        "data/file_index": 0,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }


def _write_film(root: Path, video: str, index: int, film: np.ndarray, fps: float) -> dict[str, Any]:
    """Write the film [T, H, W, 3] of an episode; return what the table of episodes states about it."""
    chunk, file = divmod(index, _FORMAT["info"]["chunks_size"])
    path = root / f"videos/{video}/chunk-{chunk:03d}/file-{file:03d}.mp4"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode_mp4(film, fps, keyframes=_KEYFRAMES))
    return {
        f"videos/{video}/chunk_index": chunk,
        f"videos/{video}/file_index": file,
        f"videos/{video}/from_timestamp": 0.0,
        f"videos/{video}/to_timestamp": len(film) / fps,
    }


def _write_tables(
    root: Path,
    numbers: dict[str, np.ndarray],
    features: dict[str, Any],
    engines: np.ndarray,
    rows: list[dict[str, Any]],
) -> None:
    """Write the tables of frames and of episodes.

    Args:
        root: folder of the data set.
        numbers: values [frames, .] by feature.
        features: the data set's features.
        engines: [frames] name of the engine.
        rows: what is stated about each episode.
    """
    import pyarrow as pa
    from pyarrow import parquet

    columns = {}
    for key, values in numbers.items():
        column = pa.array(values.reshape(-1).astype(features[key]["dtype"]))
        if values.shape[1] > 1:
            column = pa.FixedSizeListArray.from_arrays(column, values.shape[1])
        columns[key] = column
    columns["engine"] = pa.array(engines)
    for name, table in (("data", pa.table(columns)), ("meta/episodes", pa.Table.from_pylist(rows))):
        path = root / name / _FIRST
        path.parent.mkdir(parents=True)
        parquet.write_table(table, path)


def _info(recording: RecordedEpisodes, tasks: int, features: dict[str, Any]) -> dict[str, Any]:
    count = len(recording.episodes)
    info = _FORMAT["info"] | {
        "robot_type": recording.robot.name,
        "total_episodes": count,
        "total_frames": int(recording.offsets[-1]),
        "total_tasks": tasks,
        "fps": int(recording.fps) if recording.fps.is_integer() else recording.fps,
        "splits": {"train": f"0:{count}"},
        "features": features,
    }
    if VIDEO not in features:
        info["video_path"] = None
    return info


def _features(
    recording: RecordedEpisodes, videos: tuple[str, ...], size: Size
) -> dict[str, dict[str, Any]]:
    joints = list(recording.robot.joint_names)
    vector = {"dtype": "float32", "shape": [len(joints)], "names": joints}
    features = {
        "observation.state": vector,
        "observation.environment_state": _FORMAT["environment"],
        "action": vector,
    }
    width, height = size
    about = {"video.height": height, "video.width": width, "video.fps": recording.fps}
    for video in videos:
        features[video] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": _FORMAT["video"] | about,
        }
    for key, kind in _FORMAT["scalars"].items():
        features[key] = {"dtype": kind, "shape": [1], "names": None}
    return features


def _arrays(
    episode: dict[str, Any], index: int, offset: int, task: int, fps: float
) -> dict[str, np.ndarray]:
    """Return the numbers of an episode's frames, each [T, n]."""
    trace = episode["trace"]
    count = len(trace.time)
    goal = np.tile(np.concatenate((trace.goal_pos, trace.goal_quat)), (count, 1))
    frame = np.arange(count)[:, None]
    return {
        "observation.state": trace.joint_pos.astype(np.float32),
        "observation.environment_state": np.hstack(
            (trace.object_pos, trace.object_quat, goal)
        ).astype(np.float32),
        "action": episode["action"].astype(np.float32),
        "timestamp": (frame / fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": np.full((count, 1), index),
        "index": offset + frame,
        "task_index": np.full((count, 1), task),
    }


def _stats(key: str, rows: np.ndarray) -> dict[str, list[Any]]:
    """Return statistics of numbers [n, k]; of pixels [n, 3] as shares of white, each [3, 1, 1]."""
    rows = rows.astype(np.float64)
    stats = {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": rows.mean(axis=0),
        "std": rows.std(axis=0),
    }
    for name, share in _QUANTILES.items():
        stats[name] = np.quantile(rows, share, axis=0)
    shape = (3, 1, 1) if key.startswith(_IMAGES) else (-1,)
    lists = {name: value.reshape(shape).tolist() for name, value in stats.items()}
    return lists | {"count": [len(rows)]}


def _painter(
    robot: RobotSpec, size: Size, video: str, object_name: str, meshes: Path | None
) -> Painter:
    """Return what draws the episodes of an object for one of the films, always from the same camera, so that episodes
    can be compared."""
    obj = load_object(object_name, meshes)
    scene = SceneSpec(robot=robot, objects=(obj,))
    if video == VIDEO:
        return partial(draw_state, Renderer(scene, size=size))
    camera = CAMERAS[video.removeprefix(_DEPTH)]
    vision = VisionConfig(cameras=(camera,), width=size[0], height=size[1])
    return partial(draw_view, policy_cameras(scene, vision), width=size[0], goal=False)
