"""The report as one HTML page that needs nothing else: no network, no other files."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from xreset.eval.pages import percent, render
from xreset.eval.plots import COLORS
from xreset.eval.report.clips import Clip, encode_mp4
from xreset.eval.report.figures import draw_training
from xreset.eval.report.read import ReportData
from xreset.eval.results import Table
from xreset.eval.stress import by_property
from xreset.eval.table import FIGURES, caption
from xreset.pictures.render import encode_png


def page(data: ReportData, clips: Sequence[Clip], strips: Sequence[Clip] = ()) -> str:
    """Return the whole page; clips, and strips of failures, may be empty. The page runs no script but its own."""
    script = render("report.js")
    episodes = data.training.episodes
    first = episodes[episodes["engine"] == data.training.first.backend]
    results = list(data.training.results.values())
    demonstrations: dict[str, list[Any]] = {}
    for i, result in enumerate(results):
        for row in result.per_demo:
            demonstrations.setdefault(row.sequence, [None] * len(results))[i] = row
    objects = episodes.pivot_table(index="object", columns="engine", values="task_progress")
    return render(
        "report.html.j2",
        data=data,
        results=results,
        engines=list(data.training.results),
        figures=FIGURES,
        versions=caption(result.policy for result in results),
        headline=headline(data),
        colors=COLORS,
        script=script,
        script_hash=_base64(hashlib.sha256(script.encode()).digest()),
        clips=clips,
        strips=strips,
        mp4=lambda clip: _base64(encode_mp4(clip.frames, clip.fps)),
        png=lambda strip: _base64(encode_png(np.hstack(strip.frames))),
        failed=len(first),
        failures={what: count for what, count in count_failures(first).items() if count},
        objects=objects,
        curves=draw_training(data.training.curves),
        stressed=by_property(data.stress),
        demonstrations=demonstrations,
    )


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def count_failures(episodes: Table) -> dict[str, int]:
    """Return the number of episodes that ended below each stage, by what was missing."""
    missed = {
        "never near the object": ~episodes["approach"],
        "near it, but no grasp": episodes["approach"] & ~episodes["grasp"],
        "grasped, never at the goal": episodes["grasp"] & ~episodes["reorient_once"],
        "at the goal, but not in the end": episodes["reorient_once"] & ~episodes["reorient"],
    }
    return {what: int(rows.sum()) for what, rows in missed.items()}


def headline(data: ReportData) -> str:
    """Return the result in one or two sentences."""
    ranked = sorted(data.training.results.values(), key=lambda s: -s.task_progress.mean)
    text = f"Task progress is {', '.join(f'{percent(s.task_progress.mean)} in {s.backend}' for s in ranked)}."
    if data.run is not None and len(ranked) > 1:
        text += f" The policy was trained in {data.run.backend}."
    return text
