"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain

from scipy.stats import binomtest

from xreset.errors import RunError
from xreset.eval.report.curves import AXES, X, amounts
from xreset.eval.report.groups import COUNTED, Groups, by_engine, counted
from xreset.eval.report.read import Training
from xreset.eval.results import Table
from xreset.eval.table import METRICS, Rows, estimate_text
from xreset.learning.clock import SHARES, Lift

_LIFT_FIELDS: dict[X, str] = {"minutes": "minutes", "steps": "env_steps", "iterations": "iteration"}


def results(groups: Groups, found: Table) -> Rows:
    """Return a row for each group and metric, a row with each group's number of episodes, and a column for each engine;
    ``-`` where it was not evaluated or measured.

    Args:
        found: :func:`xreset.eval.report.groups.scores`.
    """
    trainings = list(chain(*groups.values()))
    head = ["", ""]
    engines = sorted(found["engine"].unique())
    for engine in engines:
        versions = {m.results[engine].backend_version for m in trainings if engine in m.results}
        head.append(f"{engine} {', '.join(sorted(versions))}")
    texts = [
        estimate_text(*values) for values in found[["metric", "mean", "low", "high"]].to_numpy()
    ]
    cells = found.assign(text=texts).pivot_table(
        "text", ["group", "metric"], "engine", "first", "-", sort=False
    )
    rows = [head]
    for (label, metric), row in cells[engines].iterrows():
        if metric == next(iter(METRICS)):
            counts = {engine: counted(own) for engine, own in by_engine(groups[label])}
            rows.append([label, COUNTED, *(counts.get(engine, "-") for engine in engines)])
        rows.append(["", METRICS[metric], *row])
    return rows


def lifted(groups: Groups, x: X) -> Rows:
    """Return one row for each group, one column for each share of success: how many of its trainings passed it, and
    when each did."""
    rows = [["", "runs", *(f"{100 * share:g} %" for share in SHARES)]]
    for label, members in groups.items():
        clocks = [m.lift for m in members if m.lift.iteration]
        if clocks:
            cells = [_lifted(clocks, share, x) for share in SHARES]
            rows.append([label, str(len(members)), *cells])
    return rows


def _lifted(clocks: Sequence[Lift], share: float, x: X) -> str:
    _, scale, digits = AXES[x]
    times = []
    hits = 0
    for clock in clocks:
        passed = [passing for passing in clock.passed if passing.share == share]
        hits += len(passed)
        amount = getattr(passed[0] if passed else clock, _LIFT_FIELDS[x]) * scale
        times.append(f"{'' if passed else '>'}{amount:.{digits}f}")
    low, high = binomtest(hits, len(clocks)).proportion_ci(method="wilson")
    return f"{hits / len(clocks):.0%} ({100 * low:.0f}-{100 * high:.0f}); {', '.join(times)}"


def different(groups: Groups) -> Rows:
    """Return the fields in which trainings differ, a column for each group, and how long each was trained.

    Baselines, which have no configuration, have no column.
    """
    facts: dict[str, list[dict[str, str]]] = {}
    names: dict[str, None] = {}
    for label, members in groups.items():
        if members[0].facts or len(members[0].curves):
            facts[label] = [member.facts | _lengths(member) for member in members]
            for known in facts[label]:
                names |= dict.fromkeys(known)
    lengths = [label for label, *_ in AXES.values()]
    rows = [["", *facts]]
    for name in names:
        cells = []
        described = set()
        for columns in facts.values():
            texts = [known.get(name, "-") for known in columns]
            cells.append("; ".join(dict.fromkeys(texts)))
            described.update(
                text for text, known in zip(texts, columns, strict=True) if "seed" in known
            )
        if len(described) > 1 or name in lengths:
            rows.append([name, *cells])
    return rows


def _lengths(member: Training) -> dict[str, str]:
    """Return how long was trained; nothing that was not logged."""
    lengths = {}
    for x, (label, _, digits) in AXES.items() if len(member.curves) else ():
        try:
            lengths[label] = f"{amounts(member, x).iloc[-1]:,.{digits}f}"
        except RunError:
            continue
    return lengths
