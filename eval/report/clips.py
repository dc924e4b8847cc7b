"""Draw recorded episodes, without an engine: one as a film in every engine, and failures as strips of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from xreset.cameras.config import VisionConfig
from xreset.errors import RunError, XResetError
from xreset.eval.report.read import Training
from xreset.eval.results import Trace
from xreset.eval.stats import Table
from xreset.files.checks import frozen
from xreset.files.progress import Progress, unseen
from xreset.files.storage import write_whole
from xreset.files.text import short_name
from xreset.geometry.description import load_robot
from xreset.geometry.shapes import pose_matrix
from xreset.objects.catalogue import load_object
from xreset.physics import State
from xreset.pictures.render import Camera, Renderer, add_caption, encode_mp4
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

if TYPE_CHECKING:
    from xreset.cameras.sensor import Cameras

SIZE = (400, 300)
"""Width and height of a film [pixels]; even, because video encoders need it."""
FRAMES_PER_SECOND = 10.0
STRIP_SIZE = (240, 180)
"""Width and height of one picture of a strip [pixels]."""
FAILURES = 4
"""Largest number of failures that a report shows."""
MOST_FILMS = 8
"""Largest number of runs that a report shows films of."""
MOMENTS = 6
"""Pictures in a strip, evenly spread over the episode from its first to its last state."""


@frozen
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


def best_everywhere(shown: Table) -> Table:
    """Return the episodes, one for each run and engine, of the demonstration that went best; empty if none was recorded
    everywhere.

    Best is the highest mean task progress over all of these, then the highest mean reorientation progress, then the
    first. A demonstration is known by its name, because its index may be another one in each run.

    Args:
        shown: :func:`xreset.eval.results.recorded`.
    """
    places = len(shown.drop_duplicates(["run", "engine"]))
    everywhere = shown.groupby("sequence_name").filter(lambda own: len(own) == places)
    metrics = ["task_progress", "reorientation_progress"]
    quality = (
        everywhere.groupby("sequence_name", sort=False)[metrics]
        .mean()
        .sort_values(metrics, ascending=False, kind="stable")
    )
    return everywhere[everywhere["sequence_name"].isin(quality.index[:1])]


def worst_episodes(shown: Table, count: int) -> Table:
    """Return the recorded episodes of one engine that missed the goal, worst first, at most ``count``.

    Worst is the lowest stage, then the least reorientation progress, then the lowest index of the demonstration.
    Objects take turns, so that a hard object does not hide the others.
    """
    order = ["task_progress", "reorientation_progress", "sequence"]
    missed = shown[~shown["reorient"]].sort_values(order, ignore_index=True)
    turns = missed.groupby("object").cumcount().sort_values(kind="stable")
    return missed.loc[sorted(turns.index[:count])]


# Drawing --------------------------------------------------------------------------------------------------------------


def camera_for(trace: Trace, obj: ObjectSpec, *, distance: float = 1.0) -> Camera:
    """Return a camera that shows the table between the object's start and its goal, and the hand above them.

    Args:
        distance: factor on the camera's distance.
    """
    com = (*obj.com, 1.0)
    start = (pose_matrix(trace.object_pos[0], trace.object_quat[0]) @ com)[:3]
    goal = (pose_matrix(trace.goal_pos, trace.goal_quat) @ com)[:3]
    center = (start + goal) / 2 + (0.0, 0.0, 0.06)
    default = Camera()
    away = np.subtract(default.eye, default.target)
    wanted = distance * np.clip(0.75 + 1.2 * np.linalg.norm(goal - start), 0.85, 1.3)  # [m]
    away *= wanted / np.linalg.norm(away)
    return Camera(eye=tuple((center + away).tolist()), target=tuple(center.tolist()))


def draw_state(renderer: Renderer, trace: Trace, row: int) -> np.ndarray:
    """Return an image [H, W, 3] uint8 of one state of a trace, with the goal as a translucent object."""
    pose = (trace.object_pos[row], trace.object_quat[row])
    goal = (trace.goal_pos, trace.goal_quat)
    return renderer.draw(trace.joint_pos[row], pose, goal_pose=goal)


def draw_view(
    cameras: Cameras, trace: Trace, row: int, width: int, *, goal: bool = True
) -> np.ndarray:
    """Return the images of one state of a trace that cameras of one world show, joined as by :meth:`Cameras.picture`.

    Args:
        cameras: cameras of one world.
        trace: the episode.
        row: index of the state.
        width: width of the joined image [pixels].
        goal: whether the object at its goal is shown.
    """
    now = (
        trace.joint_pos[row],
        trace.object_pos[row],
        trace.object_quat[row],
        trace.goal_pos,
        trace.goal_quat,
    )
    import torch

    joints, pos, quat, goal_pos, goal_quat = (
        torch.as_tensor(value, dtype=torch.float32)[None] for value in now
    )
    state = State.at_rest(joints, pos, quat)
    cameras.aim(state, goal_pos, goal_quat, torch.ones(1, dtype=torch.bool))
    cameras.cast()
    cameras.observe(torch.Generator().manual_seed(row))
    return cameras.picture(0, width, goal=goal)


def policy_cameras(scene: SceneSpec, vision: VisionConfig) -> Cameras:
    """Return the cameras of a policy, for one world."""
    import torch

    from xreset.cameras.sensor import Cameras  # imports Warp, which other policies do not need

    return Cameras(scene, torch.zeros(1, dtype=torch.long), vision)


def draw_clips(
    episodes: Table,
    robot: RobotSpec,
    meshes: Path | None,
    vision: VisionConfig | None = None,
    *,
    strips: bool = False,
) -> list[Clip]:
    """Draw recorded episodes: as films, all with the camera of the first; or as strips, each with its own camera.

    Args:
        episodes: rows of :func:`xreset.eval.results.recorded`.
        robot: the robot.
        meshes: folder of object meshes; None: the stand-ins.
        vision: cameras of the policy, whose images are drawn below; None: it has none.
        strips: draw :data:`MOMENTS` states of each episode instead of a film.
    """
    rows = list(episodes.itertuples())
    clips = []
    for episode in rows:
        trace = episode.trace
        interval = float(trace.time[1] - trace.time[0])
        every = max(1, round(1.0 / (FRAMES_PER_SECOND * interval)))
        obj = load_object(episode.object, meshes)
        if strips:
            size = STRIP_SIZE
            camera = camera_for(trace, obj, distance=0.7)
            shown = np.linspace(0, len(trace.time) - 1, MOMENTS).round().astype(int)
        else:
            size = SIZE
            camera = camera_for(rows[0].trace, obj)
            shown = np.arange(0, len(trace.time), every)
        broken = np.flatnonzero(~trace.finite)
        last = broken[0] - 1 if len(broken) else len(trace.time)
        drawn = np.minimum(shown, last).tolist()
        scene = SceneSpec(robot=robot, objects=(obj,))
        renderer = Renderer(scene, size=size, camera=camera)
        pictures = {row: draw_state(renderer, trace, row) for row in set(drawn)}
        if vision is not None:
            cameras = policy_cameras(scene, vision)
            for row, picture in pictures.items():
                pictures[row] = np.vstack((picture, draw_view(cameras, trace, row, size[0])))
        clip = Clip(
            episode=episode,
            frames=np.stack([pictures[row] for row in drawn]),
            times=trace.time[shown],
            fps=1.0 / (every * interval),
            finite=not len(broken),
        )
        clips.append(clip)
    return clips


def draw_report(
    trainings: Sequence[Training], robot: str | None, meshes: Path | None
) -> tuple[list[Clip], list[Clip]]:
    """Draw one episode: of one run in every engine; of several runs in the first engine that all were evaluated in. And
    draw failures of a single run in its first engine as strips.

    Args:
        trainings: the evaluated runs.
        robot: name or folder of the robot; default: as the results name it.
        meshes: folder of meshes; default: as the results name it.

    Raises:
        XResetError: no demonstration was recorded everywhere, or the robot or an object cannot be loaded.
    """
    shown = recorded_in(trainings, robot)
    if len(trainings) > 1:
        engines = [set(training.results) for training in trainings]
        shared = sorted(set.intersection(*engines))
        shown = shown[shown["engine"] == (shared[0] if shared else "")]
        shown = shown[shown["run"].isin([t.label for t in trainings[:MOST_FILMS]])]
    clips = _draw_runs(best_everywhere(shown), trainings, robot, meshes)
    if not clips:
        raise XResetError(
            "no demonstration was recorded everywhere. Evaluate all engines in one command, and all runs with the same "
            "demonstrations."
        )
    if len(trainings) > 1:
        return clips, []
    worst = worst_episodes(shown[shown["engine"] == trainings[0].first.engine], FAILURES)
    return clips, _draw_runs(worst, trainings, robot, meshes, strips=True)


def _draw_runs(
    episodes: Table,
    trainings: Sequence[Training],
    robot: str | None,
    meshes: Path | None,
    *,
    strips: bool = False,
) -> list[Clip]:
    """Draw episodes as :func:`draw_clips`, each with the robot, the meshes and the cameras of its run."""
    clips = []
    for training in trainings:
        own = episodes[episodes["run"] == training.label]
        if own.empty:
            continue
        spec = load_robot(robot or training.robot)
        folder = training.first.meshes_folder(meshes)
        clips += draw_clips(own, spec, folder, training.vision, strips=strips)
    return clips


def recorded_in(trainings: Sequence[Training], robot: str | None) -> Table:
    """Return the recorded episodes of runs (:meth:`~xreset.eval.report.read.Training.recorded`)."""
    parts = [t.recorded(robot or t.robot) for t in trainings]
    return pd.concat(parts, ignore_index=True)


def make_film(
    trainings: Sequence[Training],
    out: Path,
    *,
    robot: str | None = None,
    meshes: Path | None = None,
    progress: Progress = unseen,
) -> tuple[str, ...]:
    """Write an mp4 with the best episode of each object in every run and engine (:func:`best_everywhere`), at its own
    speed. ``progress`` is called with the objects drawn and the objects in all.

    Returns:
        The objects, from the left; from above are the runs, each in its engines.

    Raises:
        RunError: no object was recorded everywhere.
        XResetError: the film cannot be encoded or written.
    """
    columns = {}
    episodes_of = recorded_in(trainings, robot).groupby("object")
    for i, (name, own) in enumerate(episodes_of):
        progress(i, len(episodes_of))
        if clips := _draw_runs(best_everywhere(own), trainings, robot, meshes):
            columns[str(name)] = clips
    if not columns:
        raise RunError(
            f"no demonstration in {trainings[0].results_folder} was recorded in every engine. "
            "Evaluate all engines in one command."
        )
    shown, fps = at_one_rate(list(chain(*columns.values())))
    films = []
    for name, clips in columns.items():
        column = []
        for clip in clips:
            half = clip.frames[shown.pop(0), ::2, ::2]
            run = f"{clip.episode.run}, " if len(trainings) > 1 else ""
            label = f"{short_name(name)}, {run}{clip.episode.engine}"
            column.append(np.stack([add_caption(picture, [label], 1) for picture in half]))
        films.append(np.concatenate(column, axis=1))
    write_whole(out, encode_mp4(np.concatenate(films, axis=2), fps))
    return tuple(columns)


def at_one_rate(clips: Sequence[Clip]) -> tuple[list[np.ndarray], float]:
    """Return the frames of each clip that one film of all shows, each clip at its own speed, and the film's frames per
    second. A clip that is over ends with a still."""
    fps = max(clip.fps for clip in clips)
    length = 1 + max(round((len(clip.frames) - 1) * fps / clip.fps) for clip in clips)
    shown = []
    for clip in clips:
        nearest = np.rint(np.arange(length) * clip.fps / fps).astype(int)
        shown.append(np.minimum(nearest, len(clip.frames) - 1))
    return shown, fps
