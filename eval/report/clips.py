"""Recorded episodes as pictures, drawn without any engine: one as a film in every engine, and those that got least far as strips."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xreset.errors import XResetError, needs
from xreset.eval.rollout import Episode, Trace
from xreset.pictures.render import Camera, Renderer, pose_matrix
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

SIZE = (400, 300)
"""Width and height [pixels]; even, as video encoders ask."""
FRAMES_PER_SECOND = 10.0
STRIP_SIZE = (240, 180)
"""Width and height of one picture [pixels]."""
MOMENTS = 6
"""Pictures in a strip, evenly over the episode, first and last state included."""


@dataclass(frozen=True, kw_only=True)
class Clip:
    """One episode in one engine, as a film at the episode's own speed."""

    engine: str
    episode: Episode
    """Its result."""
    frames: np.ndarray
    """[T, H, W, 3] uint8"""
    fps: float
    """Frames per second."""
    finite: bool
    """False where the state stopped being finite: the film stands still from there on."""


def choose_sequence(episodes: dict[str, tuple[Episode, ...]], traces: dict[str, tuple[Trace, ...]]) -> int | None:
    """The recorded demonstration that went best over all engines, None if no demonstration was recorded in every engine.

    Best is the mean task progress of the recorded episodes, then their mean reorientation progress, then the lower index.
    """
    common = set.intersection(*({t.sequence for t in found} for found in traces.values())) if traces else set()

    def quality(sequence: int) -> tuple[float, float, int]:
        shown = [recorded_episode(episodes[engine], sequence) for engine in traces]
        progress, reorientation = (
            float(np.mean([getattr(e, n) for e in shown])) for n in ("task_progress", "reorientation_progress")
        )
        return progress, reorientation, -sequence

    return max(common, key=quality, default=None)


def recorded_episode(episodes: tuple[Episode, ...], sequence: int) -> Episode:
    """The episode of a demonstration that its trace shows: the first repetition."""
    return min((e for e in episodes if e.sequence == sequence), key=lambda e: e.repetition)


def camera_for(traces: list[Trace], *, distance: float = 1.0) -> Camera:
    """A camera that shows the table between the object's start and its goal, and the hand above them.

    Args:
        traces: all start and end alike; the first decides.
        distance: factor on the camera's distance.
    """
    start, goal = traces[0].object_pos[0].astype(float), traces[0].goal_pos.astype(float)
    return camera_at(
        (start + goal) / 2 + (0.0, 0.0, 0.06),
        distance * float(np.clip(0.75 + 1.2 * np.linalg.norm(goal - start), 0.85, 1.3)),
    )


def camera_at(center: np.ndarray, distance: float) -> Camera:
    """A camera in the default direction that looks at a point [3] from a distance [m]."""
    default = Camera()
    away = np.subtract(default.eye, default.target)
    eye = center + away / np.linalg.norm(away) * distance
    return Camera(eye=tuple(eye.tolist()), target=tuple(center.tolist()), fov=default.fov)


def draw_clip(engine: str, episode: Episode, trace: Trace, robot: RobotSpec, obj: ObjectSpec, camera: Camera) -> Clip:
    """Draw a trace with the goal as a translucent object.

    Args:
        trace: states of the episode; what comes after a state that is not finite is drawn as the last finite one.
    """
    interval = float(trace.time[1] - trace.time[0]) if len(trace.time) > 1 else 1.0 / FRAMES_PER_SECOND
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * interval)))
    rows = np.arange(0, len(trace.time), every)
    sound = np.isfinite(np.concatenate((trace.joint_pos, trace.object_pos, trace.object_quat), axis=1)).all(axis=1)
    last = len(trace.time) - 1 if sound.all() else max(int(np.argmin(sound)) - 1, 0)
    renderer = Renderer(SceneSpec(robot=robot, objects=(obj,)), size=SIZE, camera=camera)
    goal = pose_matrix(trace.goal_pos, trace.goal_quat)
    pictures: dict[int, np.ndarray] = {}
    for row in np.unique(np.minimum(rows, last)).tolist():
        pose = pose_matrix(trace.object_pos[row], trace.object_quat[row])
        pictures[row] = renderer.draw(trace.joint_pos[row], pose, goal_pose=goal)
    frames = np.stack([pictures[row] for row in np.minimum(rows, last).tolist()])
    return Clip(engine=engine, episode=episode, frames=frames, fps=1.0 / (every * interval), finite=bool(sound.all()))


@dataclass(frozen=True, kw_only=True)
class Strip:
    """One episode as a row of pictures."""

    episode: Episode
    picture: np.ndarray
    """[H, MOMENTS * W, 3] uint8"""
    times: tuple[float, ...]
    """[MOMENTS] when each was taken [s]."""


def choose_failures(episodes: Sequence[Episode], traces: Sequence[Trace], count: int) -> list[tuple[Episode, Trace]]:
    """The recorded episodes of one engine that missed the goal, worst first, at most ``count``.

    Worst is the lowest stage, then the least of the way to the goal, then the lower index of the demonstration. Objects take turns, so that
    a hard one does not hide the others.
    """
    found = [(recorded_episode(tuple(episodes), trace.sequence), trace) for trace in traces]
    missed = sorted(
        ((e, t) for e, t in found if not e.reorient),
        key=lambda x: (x[0].task_progress, x[0].reorientation_progress, x[0].sequence),
    )
    seen: dict[str, int] = {}
    turns = []
    for place, (_, trace) in enumerate(missed):
        turns.append((seen.setdefault(trace.object, 0), place))
        seen[trace.object] += 1
    return [missed[place] for place in sorted(place for _, place in sorted(turns)[:count])]


def count_failures(episodes: Sequence[Episode]) -> dict[str, int]:
    """How many episodes ended below each stage, by what was missing."""
    return {
        "never near the object": sum(not e.approach for e in episodes),
        "near it, but no grasp": sum(e.approach and not e.grasp for e in episodes),
        "grasped, never at the goal": sum(e.grasp and not e.reorient_once for e in episodes),
        "at the goal, but not in the end": sum(e.reorient_once and not e.reorient for e in episodes),
    }


def draw_strip(episode: Episode, trace: Trace, robot: RobotSpec, obj: ObjectSpec) -> Strip:
    """Draw an episode's strip, the goal as a translucent object; states that are not finite are left grey."""
    renderer = Renderer(
        SceneSpec(robot=robot, objects=(obj,)), size=STRIP_SIZE, camera=camera_for([trace], distance=0.7)
    )
    goal = pose_matrix(trace.goal_pos, trace.goal_quat)
    rows = np.linspace(0, len(trace.time) - 1, MOMENTS).round().astype(int)
    pictures = []
    for row in rows.tolist():
        state = (trace.joint_pos[row], trace.object_pos[row], trace.object_quat[row])
        if all(np.isfinite(part).all() for part in state):
            pictures.append(renderer.draw(state[0], pose_matrix(*state[1:]), goal_pose=goal))
        else:
            pictures.append(np.full((STRIP_SIZE[1], STRIP_SIZE[0], 3), 128, dtype=np.uint8))
    return Strip(
        episode=episode, picture=np.concatenate(pictures, axis=1), times=tuple(float(trace.time[row]) for row in rows)
    )


def encode_mp4(frames: np.ndarray, fps: float, *, keyframes: int | None = None) -> bytes:
    """H.264 in an mp4 file that every browser plays.

    Args:
        frames: [T, H, W, 3] uint8 with even H and W.
        keyframes: how many frames lie between two that can be shown without others; None: the encoder's choice.

    Raises:
        XResetError: the encoder is not installed or fails.
    """
    with needs("imageio-ffmpeg", "eval"):
        import imageio_ffmpeg
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"
        settings = ["-crf", "24", "-preset", "veryfast", "-movflags", "+faststart", "-threads", "1", "-bitexact"]
        settings += [] if keyframes is None else ["-g", str(keyframes)]
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
            raise XResetError(f"the clips cannot be encoded: {error}") from error
