"""Make the report of a run, and the comparison of several runs.

A report is one HTML page that needs no network and no other files.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from xreset.errors import FileFormatError, RunError, XResetError
from xreset.eval.pages import percent, render
from xreset.eval.plots import COLORS
from xreset.eval.report import fairness, tables
from xreset.eval.report.clips import Clip, draw_report, encode_mp4
from xreset.eval.report.curves import AXES, X
from xreset.eval.report.figures import draw_training, write_picture
from xreset.eval.report.groups import by_engine, differences, grouped, scores, singles
from xreset.eval.report.read import (
    ReportData,
    Training,
    read_training,
    read_trainings,
    versions,
    without_results,
)
from xreset.eval.results import Table, read_evaluation
from xreset.eval.stress import by_property, read_stress
from xreset.eval.table import FIGURES, caption
from xreset.files.storage import claim_folder, write_whole
from xreset.learning.run import TEACHER, read_choice, read_run
from xreset.pictures.render import encode_png

DEFAULT_CURVES = ("task/success", "task/success_from_home")
"""Curves that a comparison draws by default."""


def make_report(
    folder: Path, out: Path | None = None, *, robot: str | None = None, meshes: Path | None = None
) -> tuple[Path, ReportData]:
    """Write ``index.html``; return its path, and what it shows.

    Args:
        folder: a run folder, or a folder of results.
        out: folder of the report; default: ``report`` in the folder.
        robot: name or folder of the robot, for the clips; default: as the run and the results name it.
        meshes: folder of meshes, for the clips; default: as the results name it.

    Raises:
        RunError: there are no results.
        FileFormatError: a file of the results is damaged.
        XResetError: the page cannot be written, another command is writing it, or a package for plots is missing.
    """
    out = folder / "report" if out is None else out
    data = collect(folder, robot, meshes)
    with claim_folder(out):
        clips = []
        strips = []
        try:
            clips, strips = draw_report(data)
        except XResetError as error:
            # the page has the numbers all the same, and says why films are missing
            data = replace(data, notes=(*data.notes, f"There are no clips: {error}"))
        write_whole(out / "index.html", page(data, clips, strips))
    return out / "index.html", data


def collect(folder: Path, robot: str | None = None, meshes: Path | None = None) -> ReportData:
    """Read everything that a report shows.

    Args:
        folder: a run folder, or a folder that holds ``ENGINE.json`` files, itself or in ``eval/``.
        robot: name or folder of the robot; default: as the run and the results name it.
        meshes: folder of meshes; default: as the results name it.

    Raises:
        RunError: the folder does not exist or holds no results.
        FileFormatError: a file is damaged or of another version.
    """
    training = read_training(folder)
    if not training.results:
        raise without_results(folder)
    run = None
    not_described = []
    if training.facts:
        try:
            run = read_run(folder)
        except FileFormatError as error:
            # results are shown even if an older configuration is unreadable
            not_described.append(f"The training is not described here: {error}")
    policy_folder = training.results_folder.parent
    choice = read_choice(policy_folder)
    policies = {result.inputs.get("policy") for result in training.results.values()}
    if choice is not None and choice.policy_hash not in policies:
        choice = None
    stress = read_stress(policy_folder / "stress", training.first.inputs.get("policy"))
    taught = read_evaluation(folder / "teacher")
    notes = fairness.uneven([training]) + not_described
    missed = ""
    if taught:
        missed = fairness.missed_by_student(training.episodes, taught.to_frame())
    if missed:
        notes.append(missed)
    elif run is not None and run.teacher is not None:
        notes.append(
            "The teacher was not evaluated from the same starts. Make its results first: "
            f"xreset eval {folder / TEACHER} --out {folder / 'teacher'} --demos DEMOS"
        )
    return ReportData(
        training=training,
        run=run,
        choice=choice,
        stress=stress,
        notes=tuple(notes),
        robot=robot or (run or training.first).robot,
        meshes=training.first.meshes_folder(meshes),
    )


def page(data: ReportData, clips: Sequence[Clip], strips: Sequence[Clip] = ()) -> str:
    """Return the whole page; clips, and strips of failures, may be empty. The page allows no script but its own."""
    script = render("report.js")
    episodes = data.training.episodes
    first = episodes[episodes["engine"] == data.training.first.engine]
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
    """Return the number of episodes that failed in each stage, keyed by the failure in words."""
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
    text = f"Task progress is {', '.join(f'{percent(s.task_progress.mean)} in {s.engine}' for s in ranked)}."
    if data.run is not None and len(ranked) > 1:
        text += f" The policy was trained in {data.run.engine}."
    return text


# Comparisons ----------------------------------------------------------------------------------------------------------


def compare(
    runs: Sequence[str],
    out: Path,
    *,
    x: X = "minutes",
    curves: Sequence[str] = (),
    apart: bool = False,
) -> Path:
    """Write ``compare.png``, ``compare.csv`` (shares, or metres) and ``compare.md``, and return the path of the latter.

    Args:
        runs: folders, as ``FOLDER`` or ``LABEL=FOLDER``.
        out: folder to write into.
        x: horizontal axis of the learning curves.
        curves: names of curves as in TensorBoard; default: :data:`DEFAULT_CURVES`.
        apart: show trainings that differ only in their seed separately, not as a group.

    Raises:
        RunError: there is nothing to compare, labels are not unique, or a curve is unknown.
        FileFormatError: a file is damaged.
        XResetError: the files cannot be written, or a package for curves or plots is missing.
    """
    trainings = read_trainings(runs)
    groups, reasons = (singles(trainings), []) if apart else grouped(trainings)
    tags = choose_curves(trainings, curves)
    found = scores(groups)
    above = differences(groups)
    notes = [*reasons, *fairness.uneven(trainings), *fairness.begun(trainings)]
    notes = list(dict.fromkeys(notes))  # each sentence once
    policies = []
    clocks = {}
    for label, members in groups.items():
        clocks[label] = [member.lift for member in members]
        notes += fairness.health(label, by_engine(members))
        policies += [result.policy for result in members[0].results.values()]
    content = render(
        "compare.md.j2",
        groups=groups,
        notes=notes,
        versions=caption(policies),
        engines=sorted(found["engine"].unique()),
        engine_versions=partial(versions, trainings),
        results=tables.results(groups, found, above),
        x=AXES[x][0],
        lifted=tables.lifted(clocks, x),
        different=tables.different(groups),
    )
    write_picture(out / "compare.png", groups, tags, found, x)
    write_whole(out / "compare.csv", pd.concat([found, above]).to_csv(index=False))
    write_whole(out / "compare.md", content)
    return out / "compare.md"


def choose_curves(trainings: Sequence[Training], wanted: Sequence[str]) -> tuple[str, ...]:
    """Return the names of the curves to draw: the wanted ones, or else :data:`DEFAULT_CURVES`, each once; none if no
    training has curves.

    Raises:
        RunError: no training has one of the wanted curves.
    """
    known = sorted(set().union(*(t.curves for t in trainings)))
    if not known and not wanted:
        return ()
    chosen = tuple(dict.fromkeys(wanted or DEFAULT_CURVES))
    if unknown := set(chosen) - set(known):
        raise RunError(
            f"Unknown curve {', '.join(sorted(unknown))}. Choose with --curve from: {', '.join(known) or 'none'}."
        )
    return chosen
