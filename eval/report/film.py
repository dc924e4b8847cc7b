"""Films of recorded episodes: the best one in every engine, and one labelled film of many objects in every engine."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from xreset.cameras.config import VisionConfig
from xreset.description import load_robot
from xreset.errors import RunError
from xreset.eval.report.clips import (
    Clip,
    best_everywhere,
    camera_for,
    draw_clip,
    encode_mp4,
    policy_cameras,
    recorded,
)
from xreset.eval.report.read import ReportData, collect, results_in
from xreset.eval.results import Table, mesh_folder, read_traces
from xreset.files import write_whole
from xreset.objects.catalogue import load_object
from xreset.pictures.render import add_caption
from xreset.spec import RobotSpec
from xreset.text import short_name


def draw_best(
    shown: Table, robot: RobotSpec, meshes: Path | None, vision: VisionConfig | None = None
) -> list[Clip]:
    """Draw the episode that went best over all engines, in each of them; empty if no demonstration was recorded in
    every engine.

    Args:
        shown: :func:`xreset.eval.report.clips.recorded`.
        meshes: folder of object meshes; None: the stand-ins.
        vision: cameras of a policy that sees, whose images are drawn below.
    """
    best = list(best_everywhere(shown).itertuples())
    clips = []
    for episode in best:
        camera = camera_for([best[0].trace])
        obj = load_object(episode.object, meshes)
        eyes = policy_cameras(robot, obj, vision)
        clips.append(draw_clip(episode, episode.trace, robot, obj, camera, eyes))
    return clips


def read_recorded(data: ReportData, robot: RobotSpec) -> Table:
    """Return the recorded episodes of a report; see :func:`xreset.eval.report.clips.recorded`."""
    training = data.training
    folder = results_in(training.folder)
    traces = {engine: read_traces(folder, engine, robot.joint_names) for engine in training.results}
    return recorded(training.episodes, traces)


def make_film(
    folder: Path, out: Path, *, robot: str | None = None, objects: Path | None = None
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Write an mp4 with the episode of each object that went best over all engines, all at their own speed.

    Args:
        folder: a run folder, or a folder of results.
        robot: name or folder of the robot; default: as the results name it.
        objects: folder of meshes; default: as the results name it.

    Returns:
        The engines, from above, and the objects, from the left.

    Raises:
        RunError: there are no results, or no object was recorded in every engine.
        FileFormatError: a file of the results is damaged.
        XResetError: the film cannot be encoded or written.
    """
    data = collect(folder)
    spec = load_robot(robot or data.robot)
    shown = read_recorded(data, spec)
    meshes = mesh_folder(objects, data.first.objects_folder)
    columns = {}
    for name, own in shown.groupby("object"):
        if clips := draw_best(own, spec, meshes):
            columns[str(name)] = clips
    if not columns:
        raise RunError(
            f"no demonstration in {folder} was recorded in every engine. Evaluate all engines in one command."
        )
    every = list(chain(*columns.values()))
    length = max(len(clip.frames) for clip in every)
    films = []
    for name, clips in columns.items():
        column = []
        for clip in clips:
            half = clip.frames[np.minimum(np.arange(length), len(clip.frames) - 1), ::2, ::2]
            label = f"{short_name(name)}, {clip.episode.engine}"
            column.append(np.stack([add_caption(picture, [label], 1) for picture in half]))
        films.append(np.concatenate(column, axis=1))
    write_whole(out, encode_mp4(np.concatenate(films, axis=2), every[-1].fps))
    return tuple(data.training.results), tuple(columns)
