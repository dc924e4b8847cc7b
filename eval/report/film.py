"""A labelled film of the best recorded episode of each object in every engine."""

from __future__ import annotations

from itertools import chain
from pathlib import Path

import numpy as np

from xreset.description import load_robot
from xreset.errors import RunError
from xreset.eval.report.clips import best_everywhere, draw_clips, encode_mp4
from xreset.eval.report.read import collect
from xreset.files import write_whole
from xreset.pictures.render import add_caption
from xreset.text import short_name


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
    meshes = data.first.meshes(objects)
    columns = {}
    for name, own in data.training.recorded(spec).groupby("object"):
        if clips := draw_clips(best_everywhere(own), spec, meshes):
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
