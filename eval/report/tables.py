"""The tables of a comparison."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence

from scipy.stats import binomtest

from xreset.errors import RunError
from xreset.eval.report.curves import AXES, X, amounts
from xreset.eval.report.groups import COUNTED, Groups, by_engine, counted
from xreset.eval.report.read import Training
from xreset.eval.results import Table
from xreset.eval.table import METRICS, Rows, estimate_text
from xreset.learning.clock import SHARES, Lift


def results(groups: Groups, found: Table, above: Table) -> dict[str, dict[str, dict[str, str]]]:
    """Return group -> name of a row -> engine -> text. The rows are the numbers of episodes, every metric, and the
    difference to the first group where both were evaluated alike.

    Args:
        groups: the groups.
        found: :func:`xreset.eval.report.groups.scores`.
        above: :func:`xreset.eval.report.groups.differences`.
    """
    progress = f"task_progress minus {next(iter(groups))}"
    texts = {}
    for label, members in groups.items():
        own = defaultdict(dict)
        texts[label] = own
        for engine, episodes in by_engine(members):
            own[COUNTED][engine] = counted(episodes)
            scored = found[(found["group"] == label) & (found["engine"] == engine)]
            for _, _, metric, *values in scored.itertuples(index=False):
                own[METRICS[metric]][engine] = estimate_text(metric, *values)
        for _, engine, metric, *values in above[above["group"] == label].itertuples(index=False):
            if metric == progress:
                value, low, high = (f"{100 * share:+.1f}" for share in values)
                own[metric.replace("_", " ", 1)][engine] = f"{value} ({low} to {high})"
    return texts


def lifted(clocks: Mapping[str, Sequence[Lift]], x: X) -> Rows:
    """Return a table of first success: a row for each group of trainings, a column for each share of success.

    Args:
        clocks: label -> the lift clock of each training. Trainings without iterations are left out.
        x: unit of the times.
    """
    rows = [["", "runs", *(f"{100 * share:g} %" for share in SHARES)]]
    for label, every in clocks.items():
        begun = [clock for clock in every if clock.iteration]
        if begun:
            cells = [_lifted(begun, share, x) for share in SHARES]
            rows.append([label, str(len(every)), *cells])
    return rows


def _lifted(clocks: Sequence[Lift], share: float, x: X) -> str:
    """Return as text how many trainings passed a share of success, with the 95 % Wilson interval, and when each did;
    ``>``: not until then."""
    _, digits, field, scale = AXES[x]
    times = []
    hits = 0
    for clock in clocks:
        passed = [passing for passing in clock.passed if passing.share == share]
        hits += len(passed)
        amount = getattr(passed[0] if passed else clock, field) * scale
        times.append(f"{'' if passed else '>'}{amount:.{digits}f}")
    low, high = binomtest(hits, len(clocks)).proportion_ci(method="wilson")
    return f"{hits / len(clocks):.0%} ({100 * low:.0f}-{100 * high:.0f}); {', '.join(times)}"


def different(groups: Groups) -> Rows:
    """Return a table of the fields in which trainings differ, with a column for each group, and their lengths.

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
            texts = dict.fromkeys(known.get(name, "-") for known in columns)
            cells.append("; ".join(texts))
            if "seed" in columns[0]:
                described.update(texts)
        if len(described) > 1 or name in lengths:
            rows.append([name, *cells])
    return rows


def _lengths(member: Training) -> dict[str, str]:
    """Return the length of a training on each of :data:`AXES`, as text, where it was logged."""
    lengths = {}
    if not len(member.curves):
        return lengths
    for x, (label, digits, *_) in AXES.items():
        try:
            lengths[label] = f"{amounts(member, x).iloc[-1]:,.{digits}f}"
        except RunError:
            continue
    return lengths
