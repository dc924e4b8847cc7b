"""The report as one HTML page that needs nothing else: no network, no files beside it."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from xreset import __version__
from xreset.eval.report import plots
from xreset.eval.report.clips import Clip, encode_mp4
from xreset.eval.report.data import ReportData
from xreset.eval.report.failures import Strip, count_failures
from xreset.eval.rollout import Episode
from xreset.pictures.raster import encode_png

_CSS = """
:root { color-scheme: light dark; --ground: #fbfbf9; --card: #fff; --text: #1c2024; --soft: #5c6670; --line: #dfe3e6; --accent: #0072b2; }
@media (prefers-color-scheme: dark) {
  :root { --ground: #14171a; --card: #1c2024; --text: #e8eaec; --soft: #9aa4ae; --line: #333a41; --accent: #6cb8e6; }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--text); font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 2.5rem 1.25rem 4rem; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 .6rem; letter-spacing: -.01em; overflow-wrap: anywhere; }
h2 { font-size: 1.25rem; margin: 2.8rem 0 .8rem; }
p { max-width: 46rem; margin: .5rem 0; }
.eyebrow { color: var(--accent); font-weight: 600; margin: 0 0 .2rem; }
.lead { font-size: 1.1rem; }
.soft, figcaption, caption { color: var(--soft); font-size: .9rem; }
.note { border-left: 4px solid #d98a00; padding: .4rem .9rem; background: var(--card); }
dl { display: grid; grid-template-columns: repeat(auto-fill, minmax(15rem, 1fr)); gap: .9rem 1.5rem; margin: 1.5rem 0 0; }
dt { color: var(--soft); font-size: .85rem; }
dd { margin: 0; overflow-wrap: anywhere; }
.scroll { overflow-x: auto; background: var(--card); border: 1px solid var(--line); border-radius: 8px; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; font-size: .92rem; }
caption { text-align: left; padding: .6rem .65rem 0; }
th, td { padding: .5rem .65rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
thead th { color: var(--soft); font-weight: 600; vertical-align: bottom; white-space: normal; }
tbody tr:last-child > * { border-bottom: 0; }
th:first-child, td.text { text-align: left; }
small { color: var(--soft); font-weight: 400; }
.bar { background: linear-gradient(to right, color-mix(in srgb, var(--accent) 22%, transparent) calc(var(--share) * 1%), transparent 0); }
.swatch { display: inline-block; width: .75em; height: .75em; border-radius: 2px; margin-right: .5em; }
.tag { font-weight: 400; font-size: .8rem; color: var(--accent); border: 1px solid currentColor; border-radius: 99px; padding: 0 .5em; }
.bad { color: #c2410c; font-weight: 600; }
.grid { display: grid; gap: 1.25rem; grid-template-columns: repeat(auto-fit, minmax(min(100%, 240px), 1fr)); }
.wide { grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); }
figure { margin: 0; background: var(--card); border: 1px solid var(--line); border-radius: 8px; padding: .8rem; }
figure svg, figure video, figure img { display: block; width: 100%; height: auto; }
.strips { display: grid; gap: 1rem; }
video { border-radius: 4px; background: #e8edf3; }
figcaption { margin-top: .5rem; }
figcaption b { color: var(--text); }
summary { cursor: pointer; font-size: 1.25rem; font-weight: 600; margin: 2.8rem 0 .8rem; }
button { font: inherit; color: inherit; background: var(--card); border: 1px solid var(--line); border-radius: 6px; padding: .3rem .9rem; }
code { font-size: .85em; overflow-wrap: anywhere; }
@media print { .scroll { overflow: visible; } button { display: none; } }
"""

_SCRIPT = """
const films = [...document.querySelectorAll('video')];
const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
const together = () => films.forEach(film => { film.currentTime = 0; film.play(); });
document.getElementById('together')?.addEventListener('click', together);
if (!calm) addEventListener('load', together);
"""

_HASH = base64.b64encode(hashlib.sha256(_SCRIPT.encode()).digest()).decode()
_POLICY = f"default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; script-src 'sha256-{_HASH}'"
"""Of scripts, the page runs the one above and no other, whatever names may hold."""

_METRICS = """
<p class="soft">Every engine plays the same episodes: the same demonstrations, from the same perturbed starts at home, at full gravity.
<b>Approach</b>: a fingertip within 5 cm of the object. <b>Grasp</b>: thumb and another finger press while the object is lifted by 1 cm.
<b>Reorient</b>: within 2 cm and 15° of the goal at the episode's end. <b>Task progress</b> is 0, 33, 66 or 100 % for the highest stage,
with the 95 % bootstrap interval over demonstrations. <b>Reorientation progress</b>: the share of the way to the goal pose at the best
moment. <b>Not finite</b> and <b>overflow</b> count episodes in which the engine broke down or dropped contacts: where they are not zero,
the rest of the row means little.</p>
"""


def page(data: ReportData, clips: Sequence[Clip], strips: Sequence[Strip] = ()) -> str:
    """The whole page; clips and strips (of the first engine's failures) may be empty."""
    s = data.summaries[0]
    title = f"{s.policy} on {s.robot}"
    sections = [
        _header(title, data),
        _matrix(data),
        _clips(data, clips),
        _failures(data, strips),
        _plots(data),
        _training(data),
        _demonstrations(data),
        _inputs(data),
    ]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)} - xreset report</title>\n<style>{_CSS}</style>\n</head>\n<body>\n<main>\n"
        + "\n".join(section for section in sections if section)
        + f"\n</main>\n<script>{_SCRIPT}</script>\n</body>\n</html>\n"
    )


def headline(data: ReportData) -> str:
    """The result in one or two sentences."""
    ranked = sorted(data.summaries, key=lambda s: -s.task_progress.mean)
    best, worst = ranked[0], ranked[-1]
    high, low = (_percent(x.task_progress.mean) for x in (best, worst))
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


def _header(title: str, data: ReportData) -> str:
    s, run = data.summaries[0], data.run
    demos, each = len(s.per_demo), s.episodes_per_demo
    facts = {
        "Robot": s.robot,
        "Policy": s.policy,
        "Engines": ", ".join(f"{x.backend} {x.backend_version}" for x in data.summaries),
        "Objects": ", ".join(map(plots.short_name, s.objects)) + (" (meshes)" if s.objects_folder else " (built-in stand-ins)"),
        "Episodes": f"{s.episodes} in each engine: {demos} demonstration{'s' * (demos != 1)}, {each} start{'s' * (each != 1)} each",
        "Seed": str(s.seed),
    }
    if run is not None:
        facts["Trained in"] = f"{run.backend} {run.backend_version} on {run.device}, {run.num_envs:,} worlds"
        done = f"{int(data.curves[0].iteration[-1]):,} of " if data.curves else ""
        facts["Training"] = f"{done}{run.config.iterations:,} iterations, seed {run.seed}, xreset {data.trained_with}"
    facts["Report by"] = f"xreset {__version__}"
    items = "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in facts.items())
    notes = "".join(f'<p class="note" role="note">{escape(note)}</p>' for note in data.notes)
    return (
        f'<header>\n<p class="eyebrow">xreset report: {escape(data.name)}</p>\n<h1>{escape(title)}</h1>\n'
        f'<p class="lead">{escape(headline(data))}</p>\n{notes}<dl>{items}</dl>\n</header>'
    )


def _matrix(data: ReportData) -> str:
    names = ("engine", "task progress", "approach", "grasp", "reorient", "reorientation progress")
    head = _row("th", (*names, "not finite", "overflow", "left the scene", "control steps/s"), scope="col")
    body = []
    for i, s in enumerate(data.summaries):
        mean, (low, high), health = s.task_progress.mean, s.task_progress.ci95, s.health
        tag = ' <span class="tag">trained here</span>' if data.run and data.run.backend == s.backend else ""
        faults = [f'<td class="bad">{count}</td>' if count else f"<td>{count}</td>" for count in (health.nonfinite, health.overflow)]
        cells = [
            f'<th scope="row">{_swatch(i)}{escape(s.backend)}{tag}<br><small>{escape(s.backend_version)}</small></th>',
            _bar(mean, f"<b>{mean:.1%}</b><br><small>{100 * low:.1f} to {high:.1%}</small>"),
            *(f"<td>{getattr(s, key):.0%}</td>" for key, _ in plots.STAGES),
            _bar(s.reorientation_progress, f"{s.reorientation_progress:.1%}"),
            *faults,
            f"<td>{health.out_of_bounds}</td>",
            f"<td>{s.control_steps_per_second:,.0f}</td>",
        ]
        body.append(f"<tr>{''.join(cells)}</tr>")
    return _section("Engines side by side", _table(head, body, "One row per physics engine.") + _METRICS)


def _clips(data: ReportData, clips: Sequence[Clip]) -> str:
    if not clips:
        return ""
    episode = clips[0].episode
    figures = []
    for clip in clips:
        i = data.engines.index(clip.engine)
        still = "" if clip.finite else "; the state stopped being finite, and the film stands still from there"
        outcome = f"{outcome_of(clip.episode)}{still}"
        alt = f"Film of the episode in {clip.engine}: {outcome}"
        film = base64.b64encode(encode_mp4(clip.frames, clip.fps)).decode()
        figures.append(
            f'<figure><video muted loop playsinline controls preload="auto" width="{clip.frames.shape[2]}" height="{clip.frames.shape[1]}" '
            f'aria-label="{escape(alt)}" src="data:video/mp4;base64,{film}"></video>'
            f"<figcaption>{_swatch(i)}<b>{escape(clip.engine)}</b>: {escape(outcome)}</figcaption></figure>"
        )
    text = (
        f"<p>The same episode everywhere: {escape(plots.short_name(episode.object))}, demonstration "
        f"<code>{escape(episode.sequence_name)}</code>, from the same start. Of the recorded episodes (the first of each demonstration) it "
        "went best. The translucent object is the goal.</p>"
        '<p><button id="together" type="button">Play all from the start</button></p>'
    )
    return _section("One episode in each engine", f'{text}<div class="grid">{"".join(figures)}</div>')


def outcome_of(e: Episode) -> str:
    """What an episode reached, in words."""
    stage = "object at its goal" if e.reorient else "grasped and lifted" if e.grasp else "approached" if e.approach else "no stage reached"
    return f"{stage}, {e.reorientation_progress:.0%} of the way to the goal"


def _failures(data: ReportData, strips: Sequence[Strip]) -> str:
    engine = data.engines[0]
    missing = {what: count for what, count in count_failures(data.episodes[engine]).items() if count}
    if not missing:
        return ""
    total = len(data.episodes[engine])
    counts = "; ".join(f"{count} {escape(what)}" for what, count in missing.items())
    text = f"<p>Of {total} episodes in {escape(engine)}: {counts}.</p>"
    if strips:
        text += "<p>The recorded episodes (the first of each demonstration) that got least far. The translucent object is the goal.</p>"
    figures = []
    for strip in strips:
        e, times = strip.episode, ", ".join(f"{t:.1f}" for t in strip.times)
        where = f"{plots.short_name(e.object)}, demonstration {e.sequence_name}"
        image = base64.b64encode(encode_png(strip.picture)).decode()
        figures.append(
            f'<figure><img alt="{escape(f"Pictures of an episode at {times} s: {where}: {outcome_of(e)}")}" '
            f'width="{strip.picture.shape[1]}" height="{strip.picture.shape[0]}" src="data:image/png;base64,{image}">'
            f"<figcaption><b>{escape(outcome_of(e))}</b>: {escape(where)}; at {times} s</figcaption></figure>"
        )
    return _section("What goes wrong", f'{text}<div class="strips">{"".join(figures)}</div>')


def _plots(data: ReportData) -> str:
    s = data.summaries
    progress = "; ".join(f"{x.backend} {_percent(x.task_progress.mean)}" for x in s)
    stages = "; ".join(f"{x.backend} " + ", ".join(f"{label} {_percent(getattr(x, key))}" for key, label in plots.STAGES) for x in s)
    objects = "; ".join(
        f"{x.backend}: " + ", ".join(f"{plots.short_name(name)} {_percent(value)}" for name, value in plots.object_progress(x).items())
        for x in s
    )
    figures = _figure(plots.figure_progress(s, "progress"), f"Bar chart of task progress. {progress}.", "Task progress in each engine.")
    figures += _figure(plots.figure_stages(s, "stages"), f"Bar chart of stage rates. {stages}.", "How far the episodes get.")
    drawn = f'<div class="grid wide">{figures}</div>'
    if len(s[0].objects) > 1:
        chart = plots.figure_objects(s, "objects")
        drawn += "<br>" + _figure(
            chart, f"Dot chart of task progress by object. {objects}.", "Task progress by object; one dot per engine."
        )
    return _section("Results in pictures", drawn)


def _training(data: ReportData) -> str:
    if not data.curves:
        return ""
    ends = "; ".join(f"{c.label} from {c.value[0]:.3g} to {c.value[-1]:.3g} at iteration {c.iteration[-1]}" for c in data.curves)
    caption = "Learning curves from TensorBoard, over all training worlds: starts from demonstrated states and low gravity included."
    return _section("Training", _figure(plots.figure_curves(data.curves, "curves"), f"Line charts: {ends}.", caption))


def _demonstrations(data: ReportData) -> str:
    found = [{row.sequence: row for row in s.per_demo} for s in data.summaries]
    head = _row("th", ("demonstration", "object", *data.engines), scope="col")
    body = []
    for name in dict.fromkeys(name for rows_of in found for name in rows_of):
        known = next(rows_of[name] for rows_of in found if name in rows_of)
        cells = [f'<th scope="row">{escape(name)}</th><td class="text">{escape(plots.short_name(known.object))}</td>']
        for rows_of in found:
            row = rows_of.get(name)
            if row is None:
                cells.append("<td>-</td>")
                continue
            detail = f"grasp {row.grasp_rate:.0%}, reorient {row.reorient_rate:.0%}"
            cells.append(_bar(row.task_progress, f"{row.task_progress:.0%}<br><small>{detail}</small>"))
        body.append(f"<tr>{''.join(cells)}</tr>")
    table = _table(head, body, "Task progress of each demonstration in each engine, and the share of its episodes that grasp and reorient.")
    return f"<details>\n<summary>Every demonstration ({len(body)})</summary>\n{table}\n</details>"


def _inputs(data: ReportData) -> str:
    lines = {f"SHA-256 of the {name}": value for s in data.summaries[:1] for name, value in s.inputs.items()}
    if data.run is not None:
        lines |= {"Reset bank": data.run.resets, "SHA-256 of the reset bank": data.run.resets_hash}
        if data.run.weights is not None:
            lines |= {"Networks at the beginning": data.run.weights, "SHA-256 of these": str(data.run.weights_hash)}
    if not lines:
        return ""
    items = "".join(f"<div><dt>{escape(k)}</dt><dd><code>{escape(v)}</code></dd></div>" for k, v in lines.items())
    return f"<details>\n<summary>Inputs</summary>\n<dl>{items}</dl>\n</details>"


# Parts -------------------------------------------------------------------------------------------------------------------------------


def _section(title: str, content: str) -> str:
    return f"<section>\n<h2>{escape(title)}</h2>\n{content}\n</section>"


def _table(head: str, body: Sequence[str], caption: str) -> str:
    rows_of = "\n".join(body)
    content = f"<caption>{escape(caption)}</caption>\n<thead>{head}</thead>\n<tbody>\n{rows_of}\n</tbody>"
    return f'<div class="scroll"><table>\n{content}\n</table></div>'


def _row(tag: str, cells: Iterable[str], **attributes: Any) -> str:
    extra = "".join(f' {k}="{v}"' for k, v in attributes.items())
    return "<tr>" + "".join(f"<{tag}{extra}>{escape(cell)}</{tag}>" for cell in cells) + "</tr>"


def _bar(share: float, content: str) -> str:
    return f'<td class="bar" style="--share: {100 * share:.1f}">{content}</td>'


def _swatch(index: int) -> str:
    return f'<span class="swatch" style="background: {plots.COLORS[index % len(plots.COLORS)]}"></span>'


def _figure(svg: str, alt: str, caption: str) -> str:
    described = svg.replace("<svg", f'<svg role="img" aria-label="{escape(alt)}"', 1)
    return f"<figure>{described}<figcaption>{escape(caption)}</figcaption></figure>"


def _percent(value: float) -> str:
    return f"{value:.0%}"


def _between(values: Sequence[float]) -> str:
    low, high = _percent(min(values)), _percent(max(values))
    return low if low == high else f"{low} to {high}"
