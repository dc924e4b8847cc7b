"""Recorded episodes as a LeRobot data set, format v3.0: parquet files, films and meta (github.com/huggingface/lerobot, ``docs/source/
lerobot-dataset-v3.mdx``). Written without that package, which reads it.

Shape letters: T frames of an episode, J actuated joints.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from xreset.errors import XResetError, needs
from xreset.eval.export.recorded import Recorded, Recording
from xreset.eval.report.clips import encode_mp4
from xreset.files import atomic_folder, write_json
from xreset.objects.catalogue import load_object
from xreset.pictures.render import Renderer, pose_matrix
from xreset.spec import SceneSpec

VERSION = "v3.0"
VIDEO = "observation.images.front"
_POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
_ENVIRONMENT = tuple(f"{what}.{axis}" for what in ("object", "goal") for axis in _POSE)
_INDICES = ("frame_index", "episode_index", "index", "task_index")
_CHUNK = 1000
"""Files of a folder."""
_FILE = "chunk-{chunk:03d}/file-{file:03d}"
_KEYFRAMES = 2
"""Every second frame can be shown without those before it, as LeRobot films are: training draws frames at random."""
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}

Stats = dict[str, np.ndarray]


def write_lerobot(
    folder: Path,
    recording: Recording,
    *,
    video: bool = True,
    size: tuple[int, int] = (320, 240),
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Write a data set; ``docs/rollouts.md`` has its features.

    Args:
        folder: where to; must not exist, or be empty. It appears whole or not at all.
        video: whether films are drawn: from one camera for all episodes, the goal as a translucent object.
        size: width and height of the films [pixels], even.
        progress: called with (episodes done, all of them).

    Raises:
        XResetError: pyarrow or the encoder of films is missing, the folder holds something, or it cannot be written.
    """
    pa = _pyarrow()
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise XResetError(f"{folder} is there already. Nothing was changed; choose another --out.")
    if video and (min(size) < 16 or size[0] % 2 or size[1] % 2):
        raise XResetError(
            f"films of {size[0]} x {size[1]} pixels cannot be encoded; width and height must be even, from 16 on."
        )
    try:
        with atomic_folder(folder) as part:
            _write(pa, part, recording, _Films(recording, size) if video else None, progress)
    except OSError as error:
        raise XResetError(
            f"cannot write {folder}: {error.strerror or error}. Nothing was changed; choose another place."
        ) from error


def _write(
    pa: ModuleType, root: Path, recording: Recording, films: _Films | None, progress: Callable[[int, int], None]
) -> None:
    import pyarrow.parquet as parquet

    def write(name: str, table: Any) -> None:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        parquet.write_table(table, root / name)

    episodes, offsets = recording.episodes, recording.offsets
    tasks = list(dict.fromkeys(e.task for e in episodes))
    features = _features(recording, films)
    rows, samples, data = [], [], []
    for i, episode in enumerate(episodes):
        progress(i, len(episodes))
        arrays = _arrays(episode, i, int(offsets[i]), tasks.index(episode.task), recording.fps)
        sample = dict(arrays)
        place = {
            "data/chunk_index": 0,
            "data/file_index": 0,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        if films is not None:
            chunk, file = divmod(i, _CHUNK)
            sample[VIDEO] = films.write(
                root / f"videos/{VIDEO}" / (_FILE.format(chunk=chunk, file=file) + ".mp4"), episode
            )
            place |= {f"videos/{VIDEO}/{key}": value for key, value in (("chunk_index", chunk), ("file_index", file))}
            place |= {
                f"videos/{VIDEO}/from_timestamp": 0.0,
                f"videos/{VIDEO}/to_timestamp": len(episode.action) / recording.fps,
            }
        rows.append(
            {
                "episode_index": i,
                "tasks": [episode.task],
                "length": len(episode.action),
                "dataset_from_index": int(offsets[i]),
                "dataset_to_index": int(offsets[i + 1]),
                "engine": episode.engine,
                "policy": episode.policy,
                "seed": episode.seed,
                "object": episode.trace.object,
                "demonstration": episode.episode.sequence_name,
                "success": episode.episode.reorient,
                "task_progress": episode.episode.task_progress,
                **place,
                **{
                    f"stats/{key}/{name}": value.tolist()
                    for key, some in sample.items()
                    for name, value in _stats(key, some).items()
                },
            }
        )
        samples.append(sample)
        data.append(arrays | {"engine": [episode.engine] * len(episode.action)})
    columns = {key: _column(pa, features[key], [some[key] for some in data]) for key in data[0]}
    write("data/" + _FILE.format(chunk=0, file=0) + ".parquet", pa.table(columns))
    write("meta/episodes/" + _FILE.format(chunk=0, file=0) + ".parquet", pa.Table.from_pylist(rows))
    write("meta/tasks.parquet", _task_table(pa, tasks))
    stats = {key: _stats(key, np.concatenate([sample[key] for sample in samples])) for key in samples[0]}
    write_json(
        root / "meta/stats.json", {key: {name: v.tolist() for name, v in some.items()} for key, some in stats.items()}
    )
    write_json(root / "meta/info.json", _info(recording, len(tasks), features, films is not None))
    progress(len(episodes), len(episodes))


def _info(recording: Recording, tasks: int, features: dict[str, dict[str, Any]], video: bool) -> dict[str, Any]:
    fps = int(recording.fps) if recording.fps.is_integer() else recording.fps
    file = _FILE.replace("chunk:", "chunk_index:").replace("file:", "file_index:")
    return {
        "codebase_version": VERSION,
        "robot_type": recording.robot.name,
        "total_episodes": len(recording.episodes),
        "total_frames": int(recording.offsets[-1]),
        "total_tasks": tasks,
        "chunks_size": _CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(recording.episodes)}"},
        "data_path": f"data/{file}.parquet",
        "video_path": f"videos/{{video_key}}/{file}.mp4" if video else None,
        "features": features,
    }


def _features(recording: Recording, films: _Films | None) -> dict[str, dict[str, Any]]:
    joints = list(recording.robot.joint_names)
    vectors = {"observation.state": joints, "observation.environment_state": list(_ENVIRONMENT), "action": joints}
    features: dict[str, dict[str, Any]] = {
        key: {"dtype": "float32", "shape": [len(names)], "names": names} for key, names in vectors.items()
    }
    if films is not None:
        width, height = films.size
        info = {
            "video.height": height,
            "video.width": width,
            "video.codec": "h264",
            "video.pix_fmt": "yuv420p",
            "video.is_depth_map": False,
            "video.fps": recording.fps,
            "video.channels": 3,
            "has_audio": False,
        }
        features[VIDEO] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": info,
        }
    kinds = {"engine": "string", "timestamp": "float32"} | dict.fromkeys(_INDICES, "int64")
    return features | {key: {"dtype": kind, "shape": [1], "names": None} for key, kind in kinds.items()}


def _arrays(episode: Recorded, index: int, first: int, task: int, fps: float) -> dict[str, np.ndarray]:
    """The numbers of an episode's frames, each [T, n]."""
    trace, count = episode.trace, len(episode.action)
    goal = np.concatenate((trace.goal_pos, trace.goal_quat))
    frame = np.arange(count)
    return {
        "observation.state": trace.joint_pos.astype(np.float32),
        "observation.environment_state": np.hstack(
            (trace.object_pos, trace.object_quat, np.tile(goal, (count, 1)))
        ).astype(np.float32),
        "action": episode.action.astype(np.float32),
        "timestamp": (frame[:, None] / fps).astype(np.float32),
        "frame_index": frame[:, None],
        "episode_index": np.full((count, 1), index),
        "index": first + frame[:, None],
        "task_index": np.full((count, 1), task),
    }


def _column(pa: ModuleType, feature: dict[str, Any], parts: Sequence[Any]) -> Any:
    if feature["dtype"] == "string":
        return pa.array([text for part in parts for text in part])
    rows = np.concatenate(parts)
    flat = pa.array(rows.reshape(-1).astype(feature["dtype"]))
    return flat if rows.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, rows.shape[1])


def _task_table(pa: ModuleType, tasks: list[str]) -> Any:
    """Tasks and their numbers as pandas would write a frame whose index is the task: that is how they are looked up."""
    meta = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {
                "name": "task_index",
                "field_name": "task_index",
                "pandas_type": "int64",
                "numpy_type": "int64",
                "metadata": None,
            },
            {"name": "task", "field_name": "task", "pandas_type": "unicode", "numpy_type": "object", "metadata": None},
        ],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": tasks})
    return table.replace_schema_metadata({"pandas": json.dumps(meta)})


def _stats(key: str, rows: np.ndarray) -> Stats:
    """Statistics of numbers [n, k]; of pixels [n, 3] as shares of white, each [3, 1, 1]."""
    rows = rows.astype(np.float64)
    found = {name: np.asarray(getattr(rows, name)(axis=0)) for name in ("min", "max", "mean", "std")}
    found |= dict(zip(_QUANTILES, np.quantile(rows, list(_QUANTILES.values()), axis=0), strict=True))
    shape = (3, 1, 1) if key == VIDEO else (-1,)
    return {name: value.reshape(shape) for name, value in found.items()} | {"count": np.array([len(rows)])}


class _Films:
    """Draws episodes from one camera, so that pictures of different episodes can be compared."""

    def __init__(self, recording: Recording, size: tuple[int, int]) -> None:
        self.size = size
        self._robot, self._fps = recording.robot, recording.fps
        self._renderers: dict[tuple[str, Path | None], Renderer] = {}

    def write(self, path: Path, episode: Recorded) -> np.ndarray:
        """Write a film; returns some of its pixels [n, 3], as shares of white, for statistics."""
        trace, key = episode.trace, (episode.trace.object, episode.objects)
        if key not in self._renderers:
            thing = load_object(trace.object, episode.objects)
            self._renderers[key] = Renderer(SceneSpec(robot=self._robot, objects=(thing,)), size=self.size)
        renderer, goal = self._renderers[key], pose_matrix(trace.goal_pos, trace.goal_quat)
        states = zip(trace.joint_pos, trace.object_pos, trace.object_quat, strict=True)
        frames = np.stack(
            [renderer.draw(joints, pose_matrix(pos, quat), goal_pose=goal) for joints, pos, quat in states]
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_mp4(frames, self._fps, keyframes=_KEYFRAMES))
        return frames[::10, ::8, ::8].reshape(-1, 3) / 255.0


def _pyarrow() -> ModuleType:
    with needs("pyarrow, which writes LeRobot data sets,", "lerobot"):
        import pyarrow
    return pyarrow
