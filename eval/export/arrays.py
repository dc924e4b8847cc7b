"""Recorded episodes as plain arrays in one npz file; ``docs/rollouts.md`` has its schema."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xreset.eval.export.recorded import Recording
from xreset.records import write_npz

SCHEMA_NAME = "xreset-rollouts/1"


def write_arrays(path: str | Path, recording: Recording) -> None:
    """Write ``xreset-rollouts/1``: episodes behind one another, E of them, F frames in all.

    Raises:
        XResetError: the file cannot be written.
    """
    episodes = recording.episodes
    traces = [e.trace for e in episodes]
    per_frame = {
        "time": [t.time for t in traces],
        "joint_pos": [t.joint_pos for t in traces],
        "joint_target": [e.action for e in episodes],
        "object_pos": [t.object_pos for t in traces],
        "object_quat_wxyz": [t.object_quat for t in traces],
    }
    arrays = {name: np.concatenate(parts).astype(np.float32) for name, parts in per_frame.items()} | {
        "frame_offsets": recording.offsets,
        "fps": np.array(recording.fps),
        "robot": np.array(recording.robot.name),
        "joint_names": np.array(recording.robot.joint_names),
        "goal_pos": np.stack([t.goal_pos for t in traces]).astype(np.float32),
        "goal_quat_wxyz": np.stack([t.goal_quat for t in traces]).astype(np.float32),
        "engine": np.array([e.engine for e in episodes]),
        "policy": np.array([e.policy for e in episodes]),
        "task": np.array([e.task for e in episodes]),
        "seed": np.array([e.seed for e in episodes]),
        "object_name": np.array([t.object for t in traces]),
        "sequence_name": np.array([e.episode.sequence_name for e in episodes]),
        "success": np.array([e.episode.reorient for e in episodes]),
        "task_progress": np.array([e.episode.task_progress for e in episodes]),
    }
    write_npz(path, SCHEMA_NAME, arrays)
