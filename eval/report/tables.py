"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from scipy.stats import binomtest

from xreset.errors import RunError
from xreset.eval.report.curves import X, amounts
from xreset.eval.report.groups import Group, members_of
from xreset.eval.report.read import Training
from xreset.eval.results import Table
from xreset.eval.table import Rows, distance_text, success_text
from xreset.learning.clock import SHARES, Lift

LIFTED = (
    "First success from home: share of runs (95 % interval of Wilson) in which 1, 10 and 50 % of the steps of worlds "
    "that began at home have been at the goal, and when that was first so in each; > marks the end of a run without."
)
_LIFT_COLUMNS: dict[X, tuple[str, str, float, int]] = {
    "minutes": ("minutes", "min", 1.0, 1),
    "steps": ("env_steps", "M steps", 1e6, 1),
    "iterations": ("iteration", "iterations", 1.0, 0),
}
"""Field of a lift clock, its unit, its scale, and digits."""


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
        texts = {row["engine"]: _score_texts(row) for row in own.to_dict("records")}
        for i, name in enumerate(max(texts.values(), key=len)):
            cells = [texts.get(engine, {}).get(name, "-") for engine in engines]
            body.append((str(label) if i == 0 else "", name, *cells))
    return Rows(title="evaluation", head=tuple(head), body=tuple(body))


def _score_texts(s: dict[str, Any]) -> dict[str, str]:
    """Return name and text of the rows of one score."""
    success = success_text(s["published_success"])
    if success != "missing":
        success += _interval(s["published_success_ci95"])
    stages = " / ".join(f"{100 * s[stage]:.0f}" for stage in ("approach", "grasp", "reorient"))
    seeds = {}
    if len(s["each"]) > 1:
        seeds = {"task progress of each seed": ", ".join(f"{x:.1%}" for x in s["each"].values())}
    progress = f"{s['task_progress']:.1%}{_interval(s['task_progress_ci95'])}"
    return (
        {"task progress (95 % interval)": progress}
        | seeds
        | {
            "approach / grasp / reorient": f"{stages}%",
            "at the goal at any time; reorientation progress": (
                f"{s['reorient_once']:.0%}; {s['reorientation_progress']:.1%}"
            ),
            "published success (95 % interval)": success,
            "published distance": distance_text(s["least_distance"]),
        }
    )


def _interval(ci95: Sequence[float]) -> str:
    return f" ({100 * ci95[0]:.0f}-{100 * ci95[1]:.0f})"


def lifted(groups: Sequence[Group], x: X) -> Rows:
    """Return one row for each group, one column for each share of success: how many of its trainings passed it, and
    when each did."""
    body = []
    for group in groups:
        clocks = [m.lift for m in group.members if m.lift is not None and m.lift.iteration]
        if clocks:
            cells = [_lifted(clocks, share, x) for share in SHARES]
            body.append((group.label, str(len(group.members)), *cells))
    unit = _LIFT_COLUMNS[x][1]
    head = ("", "runs", *(f"{100 * share:g} % [{unit}]" for share in SHARES))
    return Rows(title="first success from home", head=head, body=tuple(body))


def _lifted(clocks: Sequence[Lift], share: float, x: X) -> str:
    field, _, scale, digits = _LIFT_COLUMNS[x]
    times = []
    hits = 0
    for clock in clocks:
        passed = [passing for passing in clock.passed if passing.share == share]
        hits += len(passed)
        amount = getattr(passed[0] if passed else clock, field) / scale
        times.append(f"{'' if passed else '>'}{amount:.{digits}f}")
    ci95 = binomtest(hits, len(clocks)).proportion_ci(method="wilson")
    return f"{hits / len(clocks):.0%}{_interval(ci95)}; {', '.join(times)}"


def different(groups: Sequence[Group]) -> Rows:
    """Return the fields in which trainings differ, a column for each group, and how long each was trained.

    Baselines, which have no configuration, have no column.
    """
    columns = [g for g in groups if g.members[0].facts or len(g.members[0].curves)]
    members = members_of(columns)
    facts = {member.label: member.facts | _lengths(member) for member in members}
    names: dict[str, None] = {}
    for known in facts.values():
        names |= dict.fromkeys(known)
    body = []
    for name in names:
        values = {facts[member.label].get(name, "-") for member in members if member.facts}
        if len(values) > 1 or name in _LENGTHS:
            cells = []
            for group in columns:
                cells.append(_values(facts[member.label].get(name, "-") for member in group.members))
            body.append((name, *cells))
    head = ("", *(g.label for g in columns))
    return Rows(title="what differs between the trainings", head=head, body=tuple(body))


_LENGTHS: dict[str, tuple[X, float, int]] = {
    "iterations trained": ("iterations", 1.0, 0),
    "million environment steps": ("steps", 1e6, 1),
    "minutes of training": ("minutes", 1.0, 1),
}
"""Row of the table -> amount, its scale, and digits."""


def _lengths(member: Training) -> dict[str, str]:
    """Return how long was trained; nothing that was not logged."""
    lengths = {}
    for name, (x, scale, digits) in _LENGTHS.items() if len(member.curves) else ():
        try:
            lengths[name] = f"{amounts(member, x).iloc[-1] / scale:,.{digits}f}"
        except RunError:
            continue
    return lengths


def _values(texts: Iterable[str]) -> str:
    """Return the different texts, each once."""
    return "; ".join(dict.fromkeys(texts))
