"""The report as one HTML page that needs nothing else: no network, no other files."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

from xreset.eval.pages import percent, render
from xreset.eval.plots import COLORS
from xreset.eval.report import figures
from xreset.eval.report.clips import Clip, Strip, count_failures, encode_mp4
from xreset.eval.report.read import ReportData
from xreset.eval.results import EvalResult
from xreset.eval.stress import by_property
from xreset.eval.table import FIGURES, caption, distance_text
from xreset.files import code_version
from xreset.pictures.render import encode_png
from xreset.text import short_name


def page(data: ReportData, clips: Sequence[Clip], strips: Sequence[Strip] = ()) -> str:
    """Return the whole page; clips, and strips of failures, may be empty. The page runs no script but its own."""
    script = render("report.js")
    first = data.engines[0]
    failures = count_failures(data.episodes_in(first))
    demonstrations: dict[str, list[Any]] = {}
    for i, result in enumerate(data.results):
        for row in result.per_demo:
            demonstrations.setdefault(row.sequence, [None] * len(data.results))[i] = row
    return render(
        "report.html.j2",
        data=data,
        figures=FIGURES,
        versions=caption(result.policy for result in data.results),
        title=data.title,
        headline=headline(data),
        facts=_facts(data),
        colors=COLORS,
        script=script,
        script_hash=_base64(hashlib.sha256(script.encode()).digest()),
        clips=clips,
        strips=strips,
        outcome_of=outcome_of,
        mp4=lambda clip: _base64(encode_mp4(clip.frames, clip.fps)),
        png=lambda strip: _base64(encode_png(strip.picture)),
        failures={what: count for what, count in failures.items() if count},
        charts=_charts(data),
        stressed=by_property(data.stress),
        demonstrations=demonstrations,
        inputs=_inputs(data),
    )


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode()


def headline(data: ReportData) -> str:
    """Return the result in one or two sentences."""
    ranked = sorted(data.results, key=lambda s: -s.task_progress.mean)
    best = ranked[0]
    worst = ranked[-1]
    high = percent(best.task_progress.mean)
    low = percent(worst.task_progress.mean)
    if len(ranked) == 1:
        text = f"Task progress is {high} in {best.backend}"
    elif high == low:
        text = f"Task progress is {high} in each of the {len(ranked)} engines"
    else:
        number = f"{len(ranked)} engines" if len(ranked) > 2 else "the two engines"
        text = f"Task progress is {high} in {best.backend} and {low} in {worst.backend}, "
        text += f"the best and the worst of {number}"
    grasped = _between([s.grasp_rate for s in ranked])
    at_goal = _between([s.reorient_rate for s in ranked])
    text += f". The object is grasped in {grasped} of the episodes and at its goal at the end of {at_goal}."
    successes = [s.published_success_rate for s in ranked if s.published_success_rate is not None]
    if len(successes) == len(ranked):
        text += f" By the published paper's measure {_between(successes)} of the episodes succeed."
    if data.run is not None and data.run.backend in data.engines and len(ranked) > 1:
        text += f" The policy was trained in {data.run.backend}."
    return text


def _facts(data: ReportData) -> dict[str, str]:
    """Return what was evaluated, where and how it was trained."""
    s = data.results[0]
    run = data.run
    demos = len(s.per_demo)
    starts = s.episodes_per_demo
    meshes = "meshes" if s.objects_folder else "built-in stand-ins"
    facts = {
        "Robot": s.robot,
        "Policy": s.policy,
        "Engines": ", ".join(f"{x.backend} {x.backend_version}" for x in data.results),
        "Objects": f"{', '.join(map(short_name, s.objects))} ({meshes})",
        "Episodes": f"{s.episodes} in each engine: {_count(demos, 'demonstration')}, {_count(starts, 'start')} each",
        "Seed": str(s.seed),
    }
    if run is not None:
        facts["Trained in"] = f"{run.backend} {run.backend_version} on {run.device}, {run.num_envs:,} worlds"
        done = f"{int(data.curves[0].iteration[-1]):,} of " if data.curves else ""
        facts["Training"] = f"{done}{run.config.iterations:,} iterations, seed {run.seed}, xreset {data.trained_with}"
    if data.choice is not None:
        facts["Checkpoint"] = data.choice.sentence()
    return facts | {"Report by": f"xreset {code_version()}"}


def _count(number: int, what: str) -> str:
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


def outcome_of(episode: Any) -> str:
    """Return what an episode reached, in words."""
    stage = "no stage reached"
    if episode.reorient:
        stage = "object at its goal"
    elif episode.grasp:
        stage = "grasped and lifted"
    elif episode.approach:
        stage = "approached"
    text = f"{stage}, {episode.reorientation_progress:.0%} of the way to the goal"
    if episode.least_distance == episode.least_distance:  # an earlier version did not measure it
        text += f", {distance_text(episode.least_distance)} from it at best"
    return text


def _charts(data: ReportData) -> dict[str, str]:
    """Return SVG by name, each with its content in words."""
    results = data.results

    def listing(text: Callable[[EvalResult], str]) -> str:
        return "; ".join(s.backend + text(s) for s in results)

    def stages(s: EvalResult) -> str:
        return " " + ", ".join(f"{label} {percent(getattr(s, key))}" for key, label in figures.STAGES.items())

    charts = {
        "progress": (
            figures.figure_progress(results),
            f"Bar chart of task progress. {listing(lambda s: ' ' + percent(s.task_progress.mean))}.",
        ),
        "stages": (figures.figure_stages(results), f"Bar chart of stage rates. {listing(stages)}."),
    }
    if len(results[0].objects) > 1:
        progress = figures.object_progress(data.episodes)

        def objects(s: EvalResult) -> str:
            known = progress[s.backend].dropna()
            return ": " + ", ".join(f"{short_name(name)} {percent(value)}" for name, value in known.items())

        text = f"Dot chart of task progress by object. {listing(objects)}."
        charts["objects"] = (figures.figure_objects(progress), text)
    if data.curves:
        ends = []
        for c in data.curves:
            ends.append(f"{c.label} from {c.value[0]:.3g} to {c.value[-1]:.3g} at iteration {c.iteration[-1]}")
        charts["curves"] = (figures.figure_curves(data.curves), f"Line charts: {'; '.join(ends)}.")
    labeled = {}
    for name, (svg, text) in charts.items():
        labeled[name] = svg.replace("<svg", f'<svg role="img" aria-label="{escape(text)}"', 1)
    return labeled


def _inputs(data: ReportData) -> dict[str, str]:
    """Return files and their hashes."""
    lines = {f"SHA-256 of the {name}": value for name, value in data.results[0].inputs.items()}
    run = data.run
    if run is not None:
        lines["Reset bank"] = run.resets
        lines["SHA-256 of the reset bank"] = run.resets_hash
        if run.weights is not None:
            lines["Networks at the beginning"] = run.weights
            lines["SHA-256 of these"] = str(run.weights_hash)
    return lines


def _between(values: Sequence[float]) -> str:
    low = percent(min(values))
    high = percent(max(values))
    return low if low == high else f"{low} to {high}"
