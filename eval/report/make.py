"""From folders to pages and pictures: the report of a run, and the comparison of several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from xreset.description import load_robot
from xreset.errors import RunError, XResetError
from xreset.eval.pages import render
from xreset.eval.report import fairness, lifting, tables
from xreset.eval.report.clips import (
    Clip,
    Strip,
    camera_for,
    choose_failures,
    choose_sequence,
    draw_clip,
    draw_strip,
    recorded_episode,
)
from xreset.eval.report.figures import write_overview, write_picture
from xreset.eval.report.groups import Group, grouped, scores, singles
from xreset.eval.report.page import headline, page
from xreset.eval.report.progress import X
from xreset.eval.report.read import ReportData, Training, collect, read_trainings
from xreset.eval.results import EvalResult, mesh_folder, read_traces
from xreset.eval.table import Rows
from xreset.files import claim_folder, write_whole
from xreset.objects.catalogue import load_object
from xreset.text import short_name


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


def _make(
    data: ReportData, out: Path, robot: str | None, objects: Path | None, progress: Callable[[int, int], None]
) -> Report:
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
    write_whole(html, content)
    return Report(html=html, overview=overview, summaries=data.summaries, headline=headline(data), notes=data.notes)


_FAILURES = 4
"""Most failures that the page shows."""


def _draw(
    data: ReportData, robot: str | None, objects: Path | None, progress: Callable[[int, int], None]
) -> tuple[list[Clip], list[Strip]]:
    """One episode in every engine, and the first engine's failures."""
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
        clips.append(
            draw_clip(
                engine, recorded_episode(data.episodes[engine], sequence), trace, spec, things[trace.object], camera
            )
        )
    for episode, trace in missed:
        progress(len(clips) + len(strips), total)
        strips.append(draw_strip(episode, trace, spec, things[trace.object]))
    progress(total, total)
    return clips, strips


# Comparisons -----------------------------------------------------------------------------------------------------------------------------


CURVES = ("task/success", "task/success_from_home")
"""What is drawn if nothing else is asked for."""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What was made."""

    picture: Path
    page: Path
    groups: tuple[Group, ...]
    results: Rows
    """Empty if nothing was evaluated."""
    lifted: Rows
    """When each training passed 1, 10 and 50 % success from home; empty if that is not known of any."""
    different: Rows
    """Fields in which the trainings are not equal; without a column if none has a configuration or curves."""
    notes: tuple[str, ...]
    """What is unfair, missing or doubtful."""
    captions: tuple[str, ...]
    """What the figures are."""


def compare(
    runs: Sequence[str], out: Path, *, x: X = "minutes", curves: Sequence[str] = (), apart: bool = False
) -> Comparison:
    """Write ``compare.png`` and ``compare.md``.

    Args:
        runs: folders, as ``FOLDER`` or ``LABEL=FOLDER``.
        x: horizontal axis of the learning curves.
        curves: names of curves as in TensorBoard; default: :data:`CURVES`.
        apart: show trainings that differ in their seed only one by one, not as one.

    Raises:
        RunError: there is nothing to compare, labels are not unique, or there is no such curve.
        FileFormatError: a file is damaged.
        XResetError: the files cannot be written, or a package for curves or plots is missing.
    """
    trainings = read_trainings(runs)
    groups, notes = (singles(trainings), ()) if apart else grouped(trainings)
    tags = choose_curves(trainings, curves)
    found = scores(groups)
    notes = (
        *notes,
        *fairness.notes(trainings),
        *fairness.begun(trainings),
        *fairness.health(found),
        *fairness.missing(groups, tags),
        *lifting.notes(groups),
    )
    made = Comparison(
        picture=out / "compare.png",
        page=out / "compare.md",
        groups=groups,
        results=tables.results(groups, found),
        lifted=tables.lifted(groups, x),
        different=tables.different(groups),
        notes=notes,
        captions=(*_captions(trainings, groups), *([tables.LIFTED] if any(map(lifting.lift_of, trainings)) else [])),
    )
    content = render("compare.md.j2", **vars(made))
    write_picture(made.picture, groups, tags, found, x)
    write_whole(made.page, content)
    return made


def choose_curves(trainings: Sequence[Training], wanted: Sequence[str]) -> tuple[str, ...]:
    """The curves to draw: those that are wanted, without repetition; none if no training has any.

    Raises:
        RunError: no training has one of them.
    """
    known = sorted({tag for t in trainings for tag in t.scalars})
    if not known and not wanted:
        return ()
    chosen = tuple(dict.fromkeys(wanted or CURVES))
    if unknown := [tag for tag in chosen if tag not in known]:
        there = f"there are {', '.join(known)}" if known else "none of these runs has learning curves"
        raise RunError(f"there is no curve {', '.join(unknown)}; {there}. Choose with --curve.")
    return chosen


def _captions(trainings: Sequence[Training], groups: Sequence[Group]) -> tuple[str, ...]:
    evaluated = [next(iter(t.summaries.values())) for t in trainings if t.summaries]
    captions = []
    if evaluated:
        numbers = sorted({s.episodes for s in evaluated})
        count = str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
        captions.append(
            f"From home at full gravity, {count} episodes of each training in each engine. "
            "The 95 % interval is a bootstrap over demonstrations."
        )
    for group in groups:
        if len(group.members) > 1:
            names = ", ".join(m.label for m in group.members)
            text = f"{group.label} is {len(group.members)} trainings that differ in the seed only ({names}): curves are their mean"
            text += ", bands go from the lowest to the highest"
            if sum(bool(m.summaries) for m in group.members) > 1:
                text += ", and the interval is a bootstrap over trainings and demonstrations, which is too narrow for few trainings"
            captions.append(text + ".")
    return tuple(captions)
