"""Make the report of one run or of several: one HTML page that needs no network and no other files, and its figures as
CSV."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from xreset.errors import XResetError
from xreset.eval import effects
from xreset.eval.metrics import METRICS
from xreset.eval.pages import percent, render
from xreset.eval.plots import COLORS
from xreset.eval.report import fairness, tables
from xreset.eval.report.clips import Clip, draw_report
from xreset.eval.report.curves import draw_training, usual_axis
from xreset.eval.report.goals import goal_distances
from xreset.eval.report.groups import (
    COUNTED,
    Groups,
    differences,
    grouped,
    scores,
)
from xreset.eval.report.read import Training
from xreset.eval.stats import Table
from xreset.eval.table import Rows, caption
from xreset.files.checks import frozen
from xreset.files.storage import write_whole
from xreset.files.text import Brief
from xreset.pictures.render import encode_mp4, encode_png


@frozen
class PageTable:
    """A table of a report that its caller made."""

    title: str
    rows: Rows
    """The first row is the head."""
    note: str


@frozen
class Report(Brief):
    """What a page shows."""

    title: str
    trainings: tuple[Training, ...]
    groups: Groups
    notes: tuple[str, ...]
    """Sentences about unfair comparisons and missing results."""
    scores: Table
    """:func:`xreset.eval.report.groups.scores`, and the differences to the first group."""
    curves: str
    """Drawing of the learning curves; empty if there are none."""
    clips: Sequence[Clip] = ()
    strips: Sequence[Clip] = ()
    """Failures."""
    tables: Sequence[PageTable] = field(default_factory=tuple)
    page: Path | None = None
    """File of the page; None: it is not written."""
    filmed: tuple[str, ...] = ()
    """Objects of the film that goes with the page, from the left."""

    @property
    def evaluated(self) -> list[Training]:
        """The runs with results."""
        return [training for training in self.trainings if training.results]


def collect(
    trainings: Sequence[Training],
    *,
    title: str = "",
    notes: Sequence[str] | None = None,
    page_tables: Sequence[PageTable] = (),
) -> Report:
    """Return what a page of runs shows, without films.

    Args:
        trainings: the runs.
        title: title of the page; default: the policy, or the runs.
        notes: sentences about what is unfair; None: they are found here.
        page_tables: tables to show first.
    """
    groups, reasons = grouped(trainings)
    found = scores(groups)
    if notes is None:
        notes = [*reasons, *fairness.doubts(trainings, groups)]
    notes = [*notes, *fairness.remarks(trainings)]
    if not title and len(trainings) == 1 and trainings[0].results:
        first = trainings[0].first
        title = f"{first.policy} on {first.robot}"
    return Report(
        title=title or ", ".join(groups),
        trainings=tuple(trainings),
        groups=groups,
        notes=tuple(dict.fromkeys(notes)),  # each sentence once
        scores=pd.concat([found, differences(groups)], ignore_index=True),
        curves=draw_training(groups, usual_axis(trainings)),
        tables=page_tables,
    )


def write_report(
    report: Report, out: Path, *, robot: str | None = None, meshes: Path | None = None
) -> Report:
    """Draw the films and write ``index.html`` and ``results.csv``; return what the page shows."""
    evaluated = report.evaluated
    if evaluated:
        try:
            if len({t.first.inputs.get("demos") for t in evaluated}) > 1:
                raise XResetError("the runs were evaluated with different demonstrations.")
            clips, strips = draw_report(evaluated, robot, meshes)
            report = replace(report, clips=clips, strips=strips)
        except XResetError as error:
            # the page has the numbers all the same, and says why films are missing
            report = replace(report, notes=(*report.notes, f"There are no films: {error}"))
    write_whole(out / "results.csv", report.scores.map(_without_formula).to_csv(index=False))
    write_whole(out / "index.html", page(report))
    return replace(report, page=out / "index.html")


def _without_formula(cell: Any) -> Any:
    """Return a cell that a spreadsheet does not take for a formula: names come from files."""
    is_formula = isinstance(cell, str) and cell.startswith(("=", "+", "-", "@", "\t", "\r"))
    return f"'{cell}" if is_formula else cell


# The page -------------------------------------------------------------------------------------------------------------


def page(report: Report) -> str:
    """Return the whole page. It allows no script but its own."""
    script = render("report.js")
    groups = report.groups
    evaluated = report.evaluated
    places = list(_places(evaluated))
    failures = []
    for training in evaluated:
        own = training.episodes[training.episodes["engine"] == training.first.engine]
        counts = {what: count for what, count in count_failures(own).items() if count}
        if counts:
            failures.append((training, len(own), counts))
    return render(
        "report.html.j2",
        report=report,
        trainings=report.trainings,
        evaluated=evaluated,
        groups=groups,
        single=len(report.trainings) == 1,
        metrics=METRICS,
        counted=COUNTED,
        rows=tables.results(groups, report.scores),
        versions=caption(t.first.policy for t in evaluated),
        headline=headline(evaluated),
        colors=COLORS,
        engines=sorted(set().union(*(t.results for t in evaluated))),
        script=script,
        script_hash=_base64(hashlib.sha256(script.encode()).digest()),
        mp4=lambda clip: _base64(encode_mp4(clip.frames, clip.fps)),
        png=lambda strip: _base64(encode_png(np.hstack(strip.frames))),
        failures=failures,
        sweeps=list(_sweeps(evaluated)),
        costly=effects.COSTLY,
        places=places,
        objects=_by(places, ["object"]),
        turns=_by_class(places, "turn", TURNS),
        goals=_by_class(places, "goal_distance", GOALS),
        demonstrations=_by(places, ["sequence_name", "object"]),
        different=tables.different(groups) if len(report.trainings) > 1 else (),
    )


def _places(trainings: Sequence[Training]) -> Iterator[tuple[str, Table]]:
    """Yield the name and the episodes of each run in each engine, with the column ``goal_distance``
    (:func:`~xreset.eval.report.goals.goal_distances`). Results in another folder than their run's are of the run with
    the same policy."""
    runs = {}
    for training in trainings:
        if training.run is not None and "policy" in training.first.inputs:
            runs[training.first.inputs["policy"]] = training.run
    for training in trainings:
        run = runs.get(training.first.inputs.get("policy"))
        episodes = training.episodes.assign(goal_distance=goal_distances(training, run))
        for engine in training.results:
            name = engine if len(trainings) == 1 else f"{training.label} in {engine}"
            yield name, episodes[episodes["engine"] == engine]


def _by(places: Sequence[tuple[str, Table]], keys: list[str]) -> list[tuple[Any, list[Any]]]:
    """Return the means of the metrics of each object or demonstration in each place; None where it was not played."""
    found: dict[Any, list[Any]] = {}
    for i, (_, episodes) in enumerate(places):
        for key, own in episodes.groupby(keys, sort=keys == ["object"]):
            cells = found.setdefault(key, [None] * len(places))
            cells[i] = {name: own[name].mean() for name in METRICS}
            cells[i]["demonstrations"] = own["sequence_name"].nunique()
    return list(found.items())


TURNS = {
    np.radians(20): "under 20°",
    np.radians(45): "20 to 45°",
    np.radians(90): "45 to 90°",
    np.radians(120): "90 to 120°",
    np.inf: "over 120°",
}
"""Upper limit of a class of turns [rad] -> its name."""
GOALS = {
    0.02: "under 2 cm",
    0.05: "2 to 5 cm",
    0.1: "5 to 10 cm",
    0.15: "10 to 15 cm",
    np.inf: "over 15 cm",
}
"""Upper limit of a class of distances from the goals of the training [m] -> its name. Under 2 cm, an object at the goal
of the training is a published success."""


def _by_class(
    places: Sequence[tuple[str, Table]], column: str, classes: dict[float, str]
) -> list[tuple[Any, list[Any]]]:
    """Return the means of the metrics, and the number of demonstrations, of each class of a column's values in each
    place, without classes that no place has, and without episodes whose value is not known. ``classes``: upper limit of
    a class -> its name, in ascending order.
    """
    classed = []
    for name, episodes in places:
        values = episodes[column].astype(float)
        names = pd.cut(values, [0, *classes], labels=list(classes.values()), right=False)
        own = episodes.assign(**{column: names.astype(object)})
        classed.append((name, own.dropna(subset=column)))
    found = dict(_by(classed, [column]))
    return [((name,), found[(name,)]) for name in classes.values() if (name,) in found]


def _sweeps(trainings: Sequence[Training]) -> Iterator[dict[str, Any]]:
    """Yield what the page shows of each sweep."""
    for training in trainings:
        for i, sweep in enumerate(training.sweeps):
            sentence, reasons = effects.verdict(sweep)
            yield {
                "label": training.label,
                "results": sweep,
                "properties": effects.by_property(sweep),
                "verdict": sentence,
                "reasons": reasons,
                "picture": effects.picture(sweep, f"{training.label} {i}"),
            }


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def count_failures(episodes: Table) -> dict[str, int]:
    """Return the number of episodes that failed in each stage, keyed by the failure in words. An object that is pushed
    to its goal needs no grasp."""
    never = ~episodes["reorient_once"]
    missed = {
        "never near the object": never & ~episodes["approach"],
        "near it, but no grasp": never & episodes["approach"] & ~episodes["grasp"],
        "grasped, never at the goal": never & episodes["grasp"],
        "at the goal, but not in the end": episodes["reorient_once"] & ~episodes["reorient"],
    }
    return {what: int(rows.sum()) for what, rows in missed.items()}


def headline(trainings: Sequence[Training]) -> str:
    """Return the result of a single run in one or two sentences; empty for several."""
    if len(trainings) != 1:
        return ""
    training = trainings[0]
    progress = {name: r.mean("task_progress") for name, r in training.results.items()}
    ranked = sorted(progress, key=lambda name: -progress[name])
    listing = ", ".join(f"{percent(progress[name])} in {name}" for name in ranked)
    text = f"Task progress is {listing}."
    if training.run is not None and len(ranked) > 1:
        text += f" The policy was trained in {training.run.engine}."
    return text
