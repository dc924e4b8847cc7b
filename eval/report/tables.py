"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from xreset.errors import RunError
from xreset.eval.report.curves import Fate, X, amounts, fates, share_of_runs
from xreset.eval.report.groups import Group, members_of
from xreset.eval.report.read import Fact, Training
from xreset.eval.results import Table
from xreset.eval.table import Rows, distance_text, success_text
from xreset.learning.clock import SHARES

LIFTED = (
    "First success from home: share of runs (95 % interval) in which 1, 10 and 50 % of the steps of worlds that began "
    "at home have been at the goal, and when that was first so in each. A run that ended without (>) counts until it "
    "ended (Kaplan-Meier); the interval is Wilson's, of as many runs as were watched so long."
)
_LENGTHS: dict[str, X] = {
    "iterations trained": "iterations",
    "million environment steps": "steps",
    "minutes of training": "minutes",
}
_ABSENT = Fact(None, "-")


def results(groups: Sequence[Group], found: Table) -> Rows:
    """Return five rows for each group (six for several trainings), one column for each engine; ``-`` where it was not
    evaluated.

    Args:
        found: :func:`xreset.eval.report.groups.scores`.
    """
    if found.empty:
        return Rows(title="evaluation", head=("", ""), body=())
    engines = sorted(found["engine"].unique())
    head = ["", ""]
    for engine in engines:
        versions = {m.results[engine].backend_version for m in members_of(groups) if engine in m.results}
        head.append(f"{engine} {', '.join(sorted(versions))}")
    body = []
    for label, own in found.groupby("group", sort=False):
        several = bool((own["each"].map(len) > 1).any())
        texts = {row["engine"]: _score_texts(row, several) for row in own.to_dict("records")}
        for i, name in enumerate(next(iter(texts.values()))):
            cells = [texts[engine][name] if engine in texts else "-" for engine in engines]
            body.append((str(label) if i == 0 else "", name, *cells))
    return Rows(title="evaluation", head=tuple(head), body=tuple(body))


def _score_texts(s: dict[str, Any], several: bool) -> dict[str, str]:
    """Return name and text of the rows of one score."""
    progress = f"{_percent(s['task_progress'], 1)} {_interval(s['task_progress_ci95'])}"
    texts = {"task progress (95 % interval)": progress}
    if several:
        texts["task progress of each seed"] = ", ".join(f"{100 * x:.1f}" for x in s["each"].values()) + " %"
    stages = " / ".join(f"{100 * s[stage]:.0f}" for stage in ("approach", "grasp", "reorient"))
    texts["approach / grasp / reorient"] = f"{stages} %"
    texts["at the goal at any time; reorientation progress"] = (
        f"{_percent(s['reorient_once'])}; {_percent(s['reorientation_progress'], 1)}"
    )
    success = success_text(s["published_success"])
    if success != "missing":
        success = f"{_percent(s['published_success'], 1)} {_interval(s['published_success_ci95'])}"
    texts["published success (95 % interval)"] = success
    texts["published distance"] = distance_text(s["least_distance"])
    return texts


def _interval(ci95: tuple[float, float]) -> str:
    return f"({100 * ci95[0]:.0f}-{100 * ci95[1]:.0f})"


def lifted(groups: Sequence[Group], x: X) -> Rows:
    """Return one row for each group, one column for each share of success: how many of its trainings passed it, and
    when each did."""
    scale = 1e6 if x == "steps" else 1.0
    unit = {"minutes": "min", "steps": "M steps", "iterations": "iterations"}[x]
    digits = 0 if x == "iterations" else 1
    body = []
    for group in groups:
        known = [fates(group.members, share, x) for share in SHARES]
        if any(known):
            cells = [_lifted(found, scale, digits) for found in known]
            body.append((group.label, str(len(group.members)), *cells))
    head = ("", "runs", *(f"{100 * share:g} % [{unit}]" for share in SHARES))
    return Rows(title="first success from home", head=head, body=tuple(body))


def _lifted(found: Sequence[Fate], scale: float, digits: int) -> str:
    line = share_of_runs(found)
    share, low, high = (f"{100 * value[-1]:.0f}" for value in (line.mean, line.low, line.high))
    times = []
    for fate in found:
        mark = "" if fate.passed else ">"
        times.append(f"{mark}{fate.at / scale:.{digits}f}")
    return f"{share} % ({low}-{high}); {', '.join(times)}"


def different(groups: Sequence[Group]) -> Rows:
    """Return the fields in which trainings differ, a column for each group, and how long each was trained.

    Baselines, which have no configuration, have no column.
    """
    columns = [g for g in groups if g.members[0].facts or g.members[0].scalars]
    facts = {member.label: member.facts | _lengths(member) for member in members_of(columns)}
    configured = [member.facts for member in members_of(columns) if member.facts]
    names: dict[str, None] = {}
    for known in configured:
        names |= dict.fromkeys(known)
    rows = []
    for name in names:
        values = [known.get(name, _ABSENT).value for known in configured]
        if any(value != values[0] for value in values):
            rows.append(name)
    rows += [name for name in _LENGTHS if name in set().union(*facts.values())]
    body = []
    for name in rows:
        cells = []
        for group in columns:
            cells.append(_values(facts[member.label].get(name, _ABSENT).text for member in group.members))
        body.append((name, *cells))
    head = ("", *(g.label for g in columns))
    return Rows(title="what differs between the trainings", head=head, body=tuple(body))


def _lengths(member: Training) -> dict[str, Fact]:
    """Return how long was trained; nothing that was not logged."""
    lengths = {}
    for name, x in _LENGTHS.items() if member.scalars else ():
        try:
            done = float(amounts(member, x)[1][-1])
        except RunError:
            continue
        text = f"{done:,.0f}" if x == "iterations" else f"{done / 1e6 if x == 'steps' else done:.1f}"
        lengths[name] = Fact(done, text)
    return lengths


def _values(texts: Iterable[str]) -> str:
    """Return one text if all are the same, else all of them."""
    texts = list(texts)
    return texts[0] if len(set(texts)) == 1 else "; ".join(texts)


def _percent(value: float, digits: int = 0) -> str:
    return f"{value:.{digits}%}".replace("%", " %")
