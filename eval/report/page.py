"""The report as one HTML page that needs nothing else: no network, no files beside it."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Sequence
from html import escape

from xreset import __version__
from xreset.eval.pages import percent, render
from xreset.eval.plots import COLORS
from xreset.eval.report import figures
from xreset.eval.report.clips import Clip, Strip, count_failures, encode_mp4
from xreset.eval.report.read import ReportData
from xreset.eval.rollout import Episode
from xreset.eval.table import FIGURES
from xreset.pictures.render import encode_png
from xreset.text import short_name


def page(data: ReportData, clips: Sequence[Clip], strips: Sequence[Strip] = ()) -> str:
    """The whole page; clips and strips (of the first engine's failures) may be empty. It runs no script but its own."""
    s, script = data.summaries[0], render("report.js")
    found = [{row.sequence: row for row in s.per_demo} for s in data.summaries]
    return render(
        "report.html.j2",
        data=data, figures=FIGURES, title=f"{s.policy} on {s.robot}", headline=headline(data), facts=_facts(data), colors=COLORS,
        script=script, script_hash=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode(),
        clips=clips, strips=strips, outcome_of=outcome_of,
        mp4=lambda clip: base64.b64encode(encode_mp4(clip.frames, clip.fps)).decode(),
        png=lambda strip: base64.b64encode(encode_png(strip.picture)).decode(),
        failures={what: count for what, count in count_failures(data.episodes[data.engines[0]]).items() if count},
        charts=_charts(data),
        stressed={
            name: [next((c for c in card.curves if c.property == name), None) for card in data.stress]
            for name in dict.fromkeys(curve.property for card in data.stress for curve in card.curves)
        },
        demonstrations={name: [of.get(name) for of in found] for name in dict.fromkeys(name for of in found for name in of)},
        inputs=_inputs(data),
    )  # fmt: skip


def headline(data: ReportData) -> str:
    """The result in one or two sentences."""
    ranked = sorted(data.summaries, key=lambda s: -s.task_progress.mean)
    best, worst = ranked[0], ranked[-1]
    high, low = (percent(x.task_progress.mean) for x in (best, worst))
    if len(ranked) == 1:
        text = f"Task progress is {high} in {best.backend}"
    elif high == low:
        text = f"Task progress is {high} in each of the {len(ranked)} engines"
    else:
        number = f"{len(ranked)} engines" if len(ranked) > 2 else "the two engines"
        text = f"Task progress is {high} in {best.backend} and {low} in {worst.backend}, the best and the worst of {number}"
    text += f". The object is grasped in {_between([s.grasp_rate for s in ranked])} of the episodes and at its goal at the end of "
    text += f"{_between([s.reorient_rate for s in ranked])}."
    trained = data.run and next((s for s in ranked if s.backend == data.run.backend), None)
    if trained and len(ranked) > 1:
        text += f" The policy was trained in {trained.backend}."
    return text


def _facts(data: ReportData) -> dict[str, str]:
    """What was evaluated, where and how it was trained."""
    s, run = data.summaries[0], data.run
    demos, each = len(s.per_demo), s.episodes_per_demo
    facts = {
        "Robot": s.robot,
        "Policy": s.policy,
        "Engines": ", ".join(f"{x.backend} {x.backend_version}" for x in data.summaries),
        "Objects": ", ".join(map(short_name, s.objects))
        + (" (meshes)" if s.objects_folder else " (built-in stand-ins)"),
        "Episodes": f"{s.episodes} in each engine: {demos} demonstration{'s' * (demos != 1)}, {each} start{'s' * (each != 1)} each",
        "Seed": str(s.seed),
    }
    if run is not None:
        facts["Trained in"] = f"{run.backend} {run.backend_version} on {run.device}, {run.num_envs:,} worlds"
        done = f"{int(data.curves[0].iteration[-1]):,} of " if data.curves else ""
        facts["Training"] = f"{done}{run.config.iterations:,} iterations, seed {run.seed}, xreset {data.trained_with}"
    if data.choice is not None:
        facts["Checkpoint"] = data.choice.sentence()
    return facts | {"Report by": f"xreset {__version__}"}


def outcome_of(e: Episode) -> str:
    """What an episode reached, in words."""
    stage = (
        "object at its goal"
        if e.reorient
        else "grasped and lifted"
        if e.grasp
        else "approached"
        if e.approach
        else "no stage reached"
    )
    return f"{stage}, {e.reorientation_progress:.0%} of the way to the goal"


def _charts(data: ReportData) -> dict[str, str]:
    """SVG by name, each with what it shows in words."""
    s = data.summaries

    def listing(text) -> str:
        return "; ".join(f"{x.backend}{text(x)}" for x in s)

    stages = listing(lambda x: " " + ", ".join(f"{label} {percent(getattr(x, key))}" for key, label in figures.STAGES))
    charts = {
        "progress": (
            figures.figure_progress(s),
            f"Bar chart of task progress. {listing(lambda x: ' ' + percent(x.task_progress.mean))}.",
        ),
        "stages": (figures.figure_stages(s), f"Bar chart of stage rates. {stages}."),
    }
    if len(s[0].objects) > 1:
        by_object = listing(
            lambda x: ": " + ", ".join(f"{short_name(o)} {percent(p)}" for o, p in figures.object_progress(x).items())
        )
        charts["objects"] = figures.figure_objects(s), f"Dot chart of task progress by object. {by_object}."
    if data.curves:
        ends = "; ".join(
            f"{c.label} from {c.value[0]:.3g} to {c.value[-1]:.3g} at iteration {c.iteration[-1]}" for c in data.curves
        )
        charts["curves"] = figures.figure_curves(data.curves), f"Line charts: {ends}."
    return {
        name: svg.replace("<svg", f'<svg role="img" aria-label="{escape(alt)}"', 1)
        for name, (svg, alt) in charts.items()
    }


def _inputs(data: ReportData) -> dict[str, str]:
    """Files and their hashes."""
    lines = {f"SHA-256 of the {name}": value for name, value in data.summaries[0].inputs.items()}
    if data.run is not None:
        lines |= {"Reset bank": data.run.resets, "SHA-256 of the reset bank": data.run.resets_hash}
        if data.run.weights is not None:
            lines |= {"Networks at the beginning": data.run.weights, "SHA-256 of these": str(data.run.weights_hash)}
    return lines


def _between(values: Sequence[float]) -> str:
    low, high = percent(min(values)), percent(max(values))
    return low if low == high else f"{low} to {high}"
