"""One film of many objects in every engine: objects side by side, engines below one another."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from xreset.description import load_robot
from xreset.errors import RunError
from xreset.eval.report.clips import camera_for, choose_sequence, draw_clip, encode_mp4, recorded_episode
from xreset.eval.report.read import collect
from xreset.eval.results import mesh_folder, read_traces
from xreset.files import write_whole
from xreset.objects.catalogue import load_object


@dataclass(frozen=True, kw_only=True)
class Film:
    """What a film shows."""

    engines: tuple[str, ...]
    """From above."""
    objects: tuple[str, ...]
    """From the left."""


def make_film(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    objects: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Film:
    """Write an mp4 with the episode of each object that went best over all engines, all at their own speed.

    Args:
        folder: a run folder, or a folder of results.
        robot: name or folder of the robot; default: as the run and the results name it.
        objects: folder of meshes; default: as the results name it.
        progress: called with (clips drawn, all of them).

    Raises:
        RunError: there are no results, or no object was recorded in every engine.
        FileFormatError: a file of the results is damaged.
        XResetError: the film cannot be encoded or written.
    """
    data = collect(folder)
    first = data.summaries[0]
    spec = load_robot(robot or (data.run.robot if data.run is not None else first.robot))
    recorded = {engine: read_traces(data.results, engine, spec.joint_names) for engine in data.engines}
    meshes, columns, rate = mesh_folder(objects, first.objects_folder), {}, 0.0
    names = sorted({trace.object for found in recorded.values() for trace in found})
    for number, name in enumerate(names):
        traces = {engine: tuple(t for t in found if t.object == name) for engine, found in recorded.items()}
        sequence = choose_sequence(data.episodes, traces)
        if sequence is None:
            continue
        shown = {engine: next(t for t in found if t.sequence == sequence) for engine, found in traces.items()}
        camera, thing = camera_for(list(shown.values())), load_object(name, meshes)
        columns[name] = []
        for row, (engine, trace) in enumerate(shown.items()):
            progress(number * len(shown) + row, len(names) * len(shown))
            clip = draw_clip(engine, recorded_episode(data.episodes[engine], sequence), trace, spec, thing, camera)
            columns[name].append(clip.frames[:, ::2, ::2])
            rate = clip.fps
    if not columns:
        raise RunError(
            f"no demonstration in {data.results} was recorded in every engine. Evaluate all engines in one command."
        )
    length = max(len(frames) for column in columns.values() for frames in column)
    whole = [
        np.concatenate([frames[np.minimum(np.arange(length), len(frames) - 1)] for frames in column], axis=1)
        for column in columns.values()
    ]
    film = encode_mp4(np.concatenate(whole, axis=2), rate)
    write_whole(out, film)
    return Film(engines=data.engines, objects=tuple(columns))
