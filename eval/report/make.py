"""From a run folder to the page and the picture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from xreset.errors import XResetError
from xreset.eval.report.clips import Clip, camera_for, choose_sequence, draw_clip, recorded_episode
from xreset.eval.report.data import ReportData, collect
from xreset.eval.report.failures import Strip, choose_failures, draw_strip
from xreset.eval.report.page import headline, page
from xreset.eval.report.plots import short_name, write_overview
from xreset.eval.results import EvalResult, mesh_folder, read_traces
from xreset.files import atomic_write, claim_folder


@dataclass(frozen=True, kw_only=True)
class Report:
    """What was made."""

    html: Path
    overview: Path
    summaries: tuple[EvalResult, ...]
    """``BACKEND.json`` of every engine."""
    headline: str
    """The result in one or two sentences."""
    notes: tuple[str, ...]
    """What is missing or not comparable."""


def make_report(
    folder: Path,
    out: Path | None = None,
    *,
    robot: str | None = None,
    objects: Path | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Report:
    """Write ``index.html`` and ``overview.png``.

    Args:
        folder: a run folder, or a folder of results.
        out: where to; default: ``report`` in the folder.
        robot: name or folder of the robot, for the clips; default: as the run and the results name it.
        objects: folder of meshes, for the clips; default: as the results name it.
        progress: called with (clips and strips drawn, all of them).

    Raises:
        RunError: there are no results.
        FileFormatError: a file of the results is damaged.
        XResetError: the page cannot be written, another command is writing it, or a package for plots is missing.
    """
    out = folder / "report" if out is None else out
    data = collect(folder)
    with claim_folder(out):
        return _make(data, out, robot, objects, progress)


def _make(data: ReportData, out: Path, robot: str | None, objects: Path | None, progress: Callable[[int, int], None]) -> Report:
    clips, strips = [], []
    try:
        clips, strips = _draw(data, robot, objects, progress)
    except XResetError as error:  # numbers are worth a page without films; the page says why
        data = replace(data, notes=(*data.notes, f"There are no clips: {error}"))
    html, overview = out / "index.html", out / "overview.png"
    content = page(data, clips, strips)
    first = data.summaries[0]
    shown = clips[0].episode if clips else None
    caption = f"{short_name(shown.object)}: middle and end of the same episode in each engine" if shown else ""
    write_overview(overview, f"{first.policy} on {first.robot}", data.summaries, clips, caption)
    with atomic_write(html) as file:
        file.write(content.encode())
    return Report(html=html, overview=overview, summaries=data.summaries, headline=headline(data), notes=data.notes)


_FAILURES = 4
"""Most failures that the page shows."""


def _draw(
    data: ReportData, robot: str | None, objects: Path | None, progress: Callable[[int, int], None]
) -> tuple[list[Clip], list[Strip]]:
    """One episode in every engine, and the first engine's failures."""
    from xreset.description import load_robot
    from xreset.objects import load_object

    first = data.summaries[0]
    spec = load_robot(robot or (data.run.robot if data.run is not None else first.robot))
    recorded = {engine: read_traces(data.results, engine, spec.joint_names) for engine in data.engines}
    sequence = choose_sequence(data.episodes, recorded)
    if sequence is None:
        raise XResetError("no demonstration was recorded in every engine. Evaluate all engines in one command.")
    traces = {engine: next(t for t in found if t.sequence == sequence) for engine, found in recorded.items()}
    missed = choose_failures(data.episodes[data.engines[0]], recorded[data.engines[0]], _FAILURES)
    meshes = mesh_folder(objects, first.objects_folder)
    drawn = (*traces.values(), *(trace for _, trace in missed))
    things = {name: load_object(name, meshes) for name in dict.fromkeys(trace.object for trace in drawn)}
    camera = camera_for(list(traces.values()))
    clips, strips, total = [], [], len(traces) + len(missed)
    for engine, trace in traces.items():
        progress(len(clips), total)
        clips.append(draw_clip(engine, recorded_episode(data.episodes[engine], sequence), trace, spec, things[trace.object], camera))
    for episode, trace in missed:
        progress(len(clips) + len(strips), total)
        strips.append(draw_strip(episode, trace, spec, things[trace.object]))
    progress(total, total)
    return clips, strips
