"""From folders to pages and pictures: the report of a run, and the comparison of several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from xreset.description import load_robot
from xreset.errors import RunError, XResetError
from xreset.eval.pages import render
from xreset.eval.report import clips as drawing
from xreset.eval.report import fairness, tables
from xreset.eval.report.clips import Clip, Strip
from xreset.eval.report.curves import X
from xreset.eval.report.figures import write_overview, write_picture
from xreset.eval.report.groups import Group, grouped, scores, singles
from xreset.eval.report.page import headline, page
from xreset.eval.report.read import ReportData, Training, collect, read_trainings
from xreset.eval.results import EvalResult, mesh_folder, read_traces
from xreset.eval.table import Rows, caption
from xreset.files import claim_folder, write_whole
from xreset.objects.catalogue import load_object
from xreset.text import short_name

CURVES = ("task/success", "task/success_from_home")
"""Curves that a comparison draws by default."""
_FAILURES = 4
"""Most failures that a report shows."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class Report:
    """A report that was written."""

    html: Path
    overview: Path
    results: tuple[EvalResult, ...]
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
    progress: Progress = lambda done, total: None,
) -> Report:
    """Write ``index.html`` and ``overview.png``.

    Args:
        folder: a run folder, or a folder of results.
        out: folder of the report; default: ``report`` in the folder.
        robot: name or folder of the robot, for the clips; default: as the run and the results name it.
        objects: folder of meshes, for the clips; default: as the results name it.
        progress: called with (clips and strips drawn, clips and strips in all).

    Raises:
        RunError: there are no results.
        FileFormatError: a file of the results is damaged.
        XResetError: the page cannot be written, another command is writing it, or a package for plots is missing.
    """
    out = folder / "report" if out is None else out
    data = collect(folder)
    html = out / "index.html"
    overview = out / "overview.png"
    with claim_folder(out):
        clips = []
        strips = []
        try:
            clips, strips = _draw(data, robot, objects, progress)
        except XResetError as error:  # numbers are worth a page without films; the page says why
            data = replace(data, notes=(*data.notes, f"There are no clips: {error}"))
        content = page(data, clips, strips)
        caption = ""
        if clips:
            caption = f"{short_name(clips[0].episode.object)}: middle and end of the same episode in each engine"
        write_overview(overview, data.title, data.results, clips, caption)
        write_whole(html, content)
    return Report(html=html, overview=overview, results=data.results, headline=headline(data), notes=data.notes)


def _draw(
    data: ReportData, robot: str | None, objects: Path | None, progress: Progress
) -> tuple[list[Clip], list[Strip]]:
    """Draw one episode in every engine, and the failures in the first engine."""
    spec = load_robot(robot or data.robot)
    recorded = {engine: read_traces(data.folder, engine, spec.joint_names) for engine in data.engines}
    sequence = drawing.choose_sequence(data.episodes, recorded)
    if sequence is None:
        raise XResetError("no demonstration was recorded in every engine. Evaluate all engines in one command.")
    traces = {engine: drawing.trace_of(found, sequence) for engine, found in recorded.items()}
    first = data.engines[0]
    missed = drawing.choose_failures(data.episodes_in(first), recorded[first], _FAILURES)
    meshes = mesh_folder(objects, data.results[0].objects_folder)
    names = {trace.object for _, trace in missed} | {trace.object for trace in traces.values()}
    loaded = {name: load_object(name, meshes) for name in sorted(names)}
    vision = data.run.config.task.vision if data.run else None
    eyes = {name: drawing.policy_cameras(spec, obj, vision) for name, obj in loaded.items()}
    camera = drawing.camera_for(list(traces.values()))
    total = len(traces) + len(missed)
    clips = []
    for engine, trace in traces.items():
        progress(len(clips), total)
        episode = drawing.recorded_episode(data.episodes, engine, sequence)
        clips.append(drawing.draw_clip(engine, episode, trace, spec, loaded[trace.object], camera, eyes[trace.object]))
    strips = []
    for episode, trace in missed:
        progress(len(clips) + len(strips), total)
        strips.append(drawing.draw_strip(episode, trace, spec, loaded[trace.object], eyes[trace.object]))
    progress(total, total)
    return clips, strips


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A comparison that was written."""

    picture: Path
    page: Path
    groups: tuple[Group, ...]
    results: Rows
    """Empty if nothing was evaluated."""
    lifted: Rows
    """When each training passed 1, 10 and 50 % success from home; empty if it is not known of any."""
    different: Rows
    """Fields in which the trainings differ; without a column if none has a configuration or curves."""
    notes: tuple[str, ...]
    """What is unfair, missing or doubtful."""
    captions: tuple[str, ...]
    """Explanation of the figures."""


def compare(
    runs: Sequence[str], out: Path, *, x: X = "minutes", curves: Sequence[str] = (), apart: bool = False
) -> Comparison:
    """Write ``compare.png`` and ``compare.md``.

    Args:
        runs: folders, as ``FOLDER`` or ``LABEL=FOLDER``.
        x: horizontal axis of the learning curves.
        curves: names of curves as in TensorBoard; default: :data:`CURVES`.
        apart: show trainings that differ in their seed only one by one, not as a group.

    Raises:
        RunError: there is nothing to compare, labels are not unique, or a curve is unknown.
        FileFormatError: a file is damaged.
        XResetError: the files cannot be written, or a package for curves or plots is missing.
    """
    trainings = read_trainings(runs)
    groups, notes = (singles(trainings), ()) if apart else grouped(trainings)
    tags = choose_curves(trainings, curves)
    found = scores(groups)
    captions = _captions(trainings, groups)
    if any(t.lift for t in trainings):
        captions.append(tables.LIFTED)
    made = Comparison(
        picture=out / "compare.png",
        page=out / "compare.md",
        groups=groups,
        results=tables.results(groups, found),
        lifted=tables.lifted(groups, x),
        different=tables.different(groups),
        notes=(
            *notes,
            *fairness.notes(trainings),
            *fairness.begun(trainings),
            *fairness.health(found),
            *fairness.missing(groups, tags),
        ),
        captions=tuple(captions),
    )
    content = render("compare.md.j2", **vars(made))
    write_picture(made.picture, groups, tags, found, x)
    write_whole(made.page, content)
    return made


def choose_curves(trainings: Sequence[Training], wanted: Sequence[str]) -> tuple[str, ...]:
    """Return the curves to draw: the wanted ones, without repetition; none if no training has any.

    Raises:
        RunError: no training has one of the wanted curves.
    """
    known = sorted(set().union(*(t.scalars for t in trainings)))
    if not known and not wanted:
        return ()
    chosen = tuple(dict.fromkeys(wanted or CURVES))
    unknown = [tag for tag in chosen if tag not in known]
    if unknown:
        there = f"there are {', '.join(known)}" if known else "none of these runs has learning curves"
        raise RunError(f"there is no curve {', '.join(unknown)}; {there}. Choose with --curve.")
    return chosen


def _captions(trainings: Sequence[Training], groups: Sequence[Group]) -> list[str]:
    captions = []
    numbers = sorted({next(iter(t.results.values())).episodes for t in trainings if t.results})
    if numbers:
        count = str(numbers[0]) if len(numbers) == 1 else f"{numbers[0]} to {numbers[-1]}"
        captions.append(
            f"From home at full gravity, {count} episodes of each training in each engine. "
            "The 95 % interval is a bootstrap over demonstrations."
        )
        policies = []
        for training in trainings:
            policies += [result.policy for result in training.results.values()]
        captions.append(caption(policies))
    for group in groups:
        if len(group.members) > 1:
            names = ", ".join(m.label for m in group.members)
            text = (
                f"{group.label} is {len(group.members)} trainings that differ in the seed only ({names}): "
                "curves are their mean, bands go from the lowest to the highest"
            )
            if sum(bool(m.results) for m in group.members) > 1:
                text += ", and the interval is a bootstrap over trainings and demonstrations, "
                text += "which is too narrow for few trainings"
            captions.append(text + ".")
    return captions
