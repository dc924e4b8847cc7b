"""One labelled film of many objects in every engine: objects side by side, engines below one another."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np

from xreset.description import load_robot
from xreset.errors import RunError
from xreset.eval.report.clips import camera_for, choose_sequence, draw_clip, encode_mp4, recorded_episode, trace_of
from xreset.eval.report.read import collect
from xreset.eval.results import mesh_folder, read_traces
from xreset.files import write_whole
from xreset.objects.catalogue import load_object
from xreset.pictures.render import add_caption
from xreset.text import short_name


def make_film(
    folder: Path,
    out: Path,
    *,
    robot: str | None = None,
    objects: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Write an mp4 with the episode of each object that went best over all engines, all at their own speed.

    Args:
        folder: a run folder, or a folder of results.
        robot: name or folder of the robot; default: as the results name it.
        objects: folder of meshes; default: as the results name it.
        progress: called with (clips drawn, clips in all).

    Returns:
        The engines, from above, and the objects, from the left.

    Raises:
        RunError: there are no results, or no object was recorded in every engine.
        FileFormatError: a file of the results is damaged.
        XResetError: the film cannot be encoded or written.
    """
    data = collect(folder)
    spec = load_robot(robot or data.robot)
    traces = {engine: read_traces(data.folder, engine, spec.joint_names) for engine in data.engines}
    meshes = mesh_folder(objects, data.results[0].objects_folder)
    names = set()
    for found in traces.values():
        names.update(trace.object for trace in found)
    columns = {}
    rate = 0.0
    for number, name in enumerate(sorted(names)):
        own = {}
        for engine, found in traces.items():
            own[engine] = [trace for trace in found if trace.object == name]
        sequence = choose_sequence(data.episodes, own)
        if sequence is None:
            continue
        shown = {engine: trace_of(found, sequence) for engine, found in own.items()}
        camera = camera_for(list(shown.values()))
        obj = load_object(name, meshes)
        columns[name] = []
        for row, (engine, trace) in enumerate(shown.items()):
            progress(number * len(shown) + row, len(names) * len(shown))
            episode = recorded_episode(data.episodes, engine, sequence)
            clip = draw_clip(engine, episode, trace, spec, obj, camera)
            label = f"{short_name(name)}, {engine}"
            half = clip.frames[:, ::2, ::2]
            columns[name].append(np.stack([add_caption(picture, [label], 1) for picture in half]))
            rate = clip.fps
    if not columns:
        raise RunError(
            f"no demonstration in {data.folder} was recorded in every engine. Evaluate all engines in one command."
        )
    length = max(map(len, chain(*columns.values())))
    films = []
    for column in columns.values():
        lasting = [frames[np.minimum(np.arange(length), len(frames) - 1)] for frames in column]
        films.append(np.concatenate(lasting, axis=1))
    write_whole(out, encode_mp4(np.concatenate(films, axis=2), rate))
    return data.engines, tuple(columns)
