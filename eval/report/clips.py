"""Draw recorded episodes without an engine: one as a film in every engine, and failures as strips of pictures."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import torch

from xreset.cameras.config import VisionConfig
from xreset.errors import FileFormatError, XResetError, needs
from xreset.eval.results import Table
from xreset.eval.rollout import Trace
from xreset.physics import State
from xreset.pictures.render import Camera, Renderer, pose_matrix
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

if TYPE_CHECKING:
    from xreset.cameras.sensor import Cameras

SIZE = (400, 300)
"""Width and height of a film [pixels]; even, because video encoders need it."""
FRAMES_PER_SECOND = 10.0
STRIP_SIZE = (240, 180)
"""Width and height of one picture of a strip [pixels]."""
MOMENTS = 6
"""Pictures in a strip, evenly over the episode, first and last state included."""


@dataclass(frozen=True, kw_only=True)
class Clip:
    """One episode in one engine, drawn."""

    episode: Any
    """Row of the table of episodes."""
    frames: np.ndarray
    """[T, H, W, 3] uint8"""
    times: np.ndarray
    """[T] time of each frame [s]."""
    fps: float
    """Frames per second of a film at the episode's own speed."""
    finite: bool
    """False if the state stopped being finite: from there on, the last finite state is shown."""


# Which episodes -------------------------------------------------------------------------------------------------------


def recorded(episodes: Table, traces: Mapping[str, Sequence[Trace]]) -> Table:
    """Return the episodes that traces show, each with its ``trace``: the first repetition of a demonstration.

    Args:
        episodes: episodes in all engines.
        traces: recorded episodes by engine.

    Raises:
        FileFormatError: a trace shows a demonstration of which no episode is known.
    """
    parts = []
    for engine, found in traces.items():
        own = episodes[episodes["engine"] == engine].sort_values("repetition", kind="stable")
        own = own.drop_duplicates("sequence").set_index("sequence", drop=False)
        for trace in found:
            if trace.sequence not in own.index:
                raise FileFormatError(
                    f"{engine}.trace.npz has a trace of demonstration {trace.sequence}, of which no episode is known. "
                    "Evaluate again."
                )
        parts.append(own.loc[[trace.sequence for trace in found]].assign(trace=list(found)))
    return pd.concat(parts, ignore_index=True)


def best_everywhere(shown: Table) -> Table:
    """Return the episodes, one for each engine, of the demonstration that went best; empty if none was recorded in
    every engine.

    Best is the highest mean task progress over all engines, then the highest mean reorientation progress, then the
    lowest index.

    Args:
        shown: :func:`recorded`.
    """
    engines = shown["engine"].nunique()
    everywhere = shown.groupby("sequence").filter(lambda own: len(own) == engines)
    metrics = ["task_progress", "reorientation_progress"]
    quality = (
        everywhere.groupby("sequence")[metrics]
        .mean()
        .sort_values(metrics, ascending=False, kind="stable")
    )
    return everywhere[everywhere["sequence"].isin(quality.index[:1])]


def worst_episodes(shown: Table, count: int) -> Table:
    """Return the recorded episodes of one engine that missed the goal, worst first, at most ``count``.

    Worst is the lowest stage, then the least reorientation progress, then the lowest index of the demonstration.
    Objects take turns, so that a hard object does not hide the others.
    """
    order = ["task_progress", "reorientation_progress", "sequence"]
    missed = shown[~shown["reorient"]].sort_values(order, ignore_index=True)
    turns = missed.groupby("object").cumcount().sort_values(kind="stable")
    return missed.loc[sorted(turns.index[:count])]


def count_failures(episodes: Table) -> dict[str, int]:
    """Return the number of episodes that ended below each stage, by what was missing."""
    missed = {
        "never near the object": ~episodes["approach"],
        "near it, but no grasp": episodes["approach"] & ~episodes["grasp"],
        "grasped, never at the goal": episodes["grasp"] & ~episodes["reorient_once"],
        "at the goal, but not in the end": episodes["reorient_once"] & ~episodes["reorient"],
    }
    return {what: int(rows.sum()) for what, rows in missed.items()}


def missed_by_student(student: Table, teacher: Table) -> str:
    """Return one sentence: which objects a policy misses in episodes that its teacher ends at the goal.

    Args:
        student: episodes of the policy.
        teacher: episodes of its teacher from the same starts, in the same engines.
    """
    same = ["engine", "sequence_name", "repetition", "object"]
    both = student.merge(teacher, on=same, suffixes=("", "_teacher"))
    solved = both[both["reorient_teacher"]]
    missed = solved[~solved["reorient"]]
    parts = []
    for name, count in missed["object"].value_counts().items():
        parts.append(f"{name} {count} of {int((solved['object'] == name).sum())}")
    where = f": {', '.join(parts)}" if parts else ""
    return f"Of {len(solved)} episodes that the teacher ends at the goal, the student misses {len(missed)}{where}."


# Drawing --------------------------------------------------------------------------------------------------------------


def camera_for(traces: Sequence[Trace], *, distance: float = 1.0) -> Camera:
    """Return a camera that shows the table between the object's start and its goal, and the hand above them.

    Args:
        traces: traces with the same start and goal; the first decides.
        distance: factor on the camera's distance.
    """
    start = traces[0].object_pos[0].astype(float)
    goal = traces[0].goal_pos.astype(float)
    center = (start + goal) / 2 + (0.0, 0.0, 0.06)
    default = Camera()
    away = np.subtract(default.eye, default.target)
    away *= (
        distance
        * np.clip(0.75 + 1.2 * np.linalg.norm(goal - start), 0.85, 1.3)
        / np.linalg.norm(away)
    )
    return Camera(
        eye=tuple((center + away).tolist()), target=tuple(center.tolist()), fov=default.fov
    )


def finite_states(trace: Trace) -> np.ndarray:
    """Return which states [T] of a trace are finite."""
    state = np.concatenate((trace.joint_pos, trace.object_pos, trace.object_quat), axis=1)
    return np.asarray(np.isfinite(state).all(axis=1))


def draw_state(
    renderer: Renderer, trace: Trace, row: int, eyes: Cameras | None = None
) -> np.ndarray:
    """Draw one state of a trace, with the goal as a translucent object, above what the policy's cameras show."""
    pose = pose_matrix(trace.object_pos[row], trace.object_quat[row])
    picture = renderer.draw(
        trace.joint_pos[row], pose, goal_pose=pose_matrix(trace.goal_pos, trace.goal_quat)
    )
    if eyes is None:
        return picture
    return np.vstack((picture, draw_view(eyes, trace, row, picture.shape[1])))


def draw_view(eyes: Cameras, trace: Trace, row: int, width: int) -> np.ndarray:
    """Draw what cameras of one world show of one state of a trace; see :meth:`Cameras.picture`."""
    now = (
        trace.joint_pos[row],
        trace.object_pos[row],
        trace.object_quat[row],
        trace.goal_pos,
        trace.goal_quat,
    )
    joints, pos, quat, goal_pos, goal_quat = (
        torch.as_tensor(value, dtype=torch.float32)[None] for value in now
    )
    eyes.aim(State.at_rest(joints, pos, quat), goal_pos, goal_quat, torch.ones(1, dtype=torch.bool))
    eyes.cast()
    eyes.observe(torch.Generator().manual_seed(row))
    return eyes.picture(0, width)


def policy_cameras(
    robot: RobotSpec, obj: ObjectSpec, vision: VisionConfig | None
) -> Cameras | None:
    """Return the cameras of a policy that sees, to draw what they show."""
    if vision is None or not vision.cameras:
        return None
    from xreset.cameras.sensor import Cameras  # Warp, which other policies do not need

    return Cameras(SceneSpec(robot=robot, objects=(obj,)), torch.zeros(1, dtype=torch.long), vision)


def draw_clip(
    episode: Any,
    trace: Trace,
    robot: RobotSpec,
    obj: ObjectSpec,
    camera: Camera,
    eyes: Cameras | None = None,
    *,
    strip: bool = False,
) -> Clip:
    """Draw a trace.

    Args:
        strip: draw :data:`MOMENTS` states, evenly over the episode, in place of a film.
    """
    interval = float(trace.time[1] - trace.time[0])
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * interval)))
    rows = np.arange(0, len(trace.time), every)
    size = SIZE
    if strip:
        rows = np.linspace(0, len(trace.time) - 1, MOMENTS).round().astype(int)
        size = STRIP_SIZE
    finite = finite_states(trace)
    last = len(finite) - 1 if finite.all() else int(np.argmin(finite)) - 1
    drawn = np.minimum(rows, last).tolist()
    renderer = Renderer(SceneSpec(robot=robot, objects=(obj,)), size=size, camera=camera)
    pictures = {row: draw_state(renderer, trace, row, eyes) for row in set(drawn)}
    return Clip(
        episode=episode,
        frames=np.stack([pictures[row] for row in drawn]),
        times=trace.time[rows],
        fps=1.0 / (every * interval),
        finite=bool(finite.all()),
    )


def encode_mp4(frames: np.ndarray, fps: float, *, keyframes: int | None = None) -> bytes:
    """Encode a film as H.264 in an mp4 file that every browser plays.

    Args:
        frames: [T, H, W, 3] uint8 with even H and W.
        keyframes: distance of the frames that can be shown without others; None: the encoder's choice.

    Raises:
        XResetError: the encoder is not installed or fails.
    """
    with needs("imageio-ffmpeg", "eval"):
        import imageio_ffmpeg
    settings = [
        "-crf",
        "24",
        "-preset",
        "veryfast",
        "-movflags",
        "+faststart",
        "-threads",
        "1",
        "-bitexact",
    ]
    if keyframes is not None:
        settings += ["-g", str(keyframes)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        writer = imageio_ffmpeg.write_frames(  # its annotations are narrower than what it takes
            str(path),
            frames.shape[2:0:-1],
            fps=fps,  # pyright: ignore[reportArgumentType]
            codec="libx264",
            macro_block_size=2,
            quality=None,  # pyright: ignore[reportArgumentType]
            output_params=settings,
        )
        try:
            writer.send(None)
            for frame in frames:
                writer.send(np.ascontiguousarray(frame))
            writer.close()
            return path.read_bytes()
        except (OSError, RuntimeError) as error:
            raise XResetError(f"the film cannot be encoded: {error}") from error
