"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from xreset.errors import RunError
from xreset.eval.report.groups import Group, Scores, engines_of
from xreset.eval.report.lifting import Fate, fates, share_of_runs
from xreset.eval.report.progress import X, amounts, processes
from xreset.eval.report.read import Fact, Training
from xreset.eval.table import Rows
from xreset.learning.clock import SHARES


def results(groups: Sequence[Group], found: Scores) -> Rows:
    """Three rows for each group (four if it has several trainings), one column for each engine; ``-`` where it was not evaluated."""
    engines = engines_of(found)
    versions: dict[str, set[str]] = {}
    for member in (m for group in groups for m in group.members):
        for engine, summary in member.summaries.items():
            versions.setdefault(engine, set()).add(summary.backend_version)
    body = []
    for label, row in found.items():
        several = max(len(s.each) for s in row.values()) > 1
        lines = {
            "task progress (95 % interval)": lambda s: (
                f"{_percent(s.task_progress, 1)} ({100 * s.ci95[0]:.0f}-{100 * s.ci95[1]:.0f})"
            ),
            **(
                {"task progress of each seed": lambda s: ", ".join(f"{100 * x:.1f}" for x in s.each.values()) + " %"}
                if several
                else {}
            ),
            "approach / grasp / reorient": lambda s: (
                " / ".join(f"{100 * x:.0f}" for x in (s.approach, s.grasp, s.reorient)) + " %"
            ),
            "at the goal at any time; reorientation progress": lambda s: (
                f"{_percent(s.reorient_once)}; {_percent(s.reorientation_progress, 1)}"
            ),
        }
        for i, (name, text) in enumerate(lines.items()):
            body.append(("" if i else label, name, *(text(row[e]) if e in row else "-" for e in engines)))
    return Rows(
        title="evaluation", head=("", "", *(f"{e} {', '.join(sorted(versions[e]))}" for e in engines)), body=tuple(body)
    )


LIFTED = (
    "First success from home: share of runs (95 % interval) in which 1, 10 and 50 % of the steps of worlds that began at home have been at "
    "the goal, and when that was first so in each. A run that ended without (>) counts until it ended (Kaplan-Meier); the interval is "
    "Wilson's, of as many runs as were watched so long."
)


def lifted(groups: Sequence[Group], x: X) -> Rows:
    """One row for each group, one column for each share of success: the share of its trainings that passed it, and when each did."""
    scale, unit, digits = {
        "minutes": (1.0, "min", 1),
        "steps": (1e6, "M steps", 1),
        "iterations": (1.0, "iterations", 0),
    }[x]
    body = []
    for group in groups:
        known = [fates(group.members, share, x) for share in SHARES]
        if any(known):
            body.append((group.label, str(len(group.members)), *(_lifted(found, scale, digits) for found in known)))
    return Rows(
        title="first success from home",
        head=("", "runs", *(f"{100 * share:g} % [{unit}]" for share in SHARES)),
        body=tuple(body),
    )


def _lifted(found: Sequence[Fate], scale: float, digits: int) -> str:
    if not found:
        return "-"
    line = share_of_runs(found)
    share, low, high = (f"{100 * value[-1]:.0f}" for value in (line.mean, line.low, line.high))
    return f"{share} % ({low}-{high}); " + ", ".join(
        f"{'' if passed else '>'}{at / scale:.{digits}f}" for at, passed, _ in found
    )


def different(groups: Sequence[Group]) -> Rows:
    """The fields in which not all trainings are equal, a column for each group; and how long each was trained.

    Baselines, which have no configuration, have no column.
    """
    columns = [g for g in groups if g.members[0].facts or g.members[0].scalars]
    configured = [m for g in columns for m in g.members if m.facts]
    names = dict.fromkeys(name for m in configured for name in m.facts)
    body = []
    for name in names:
        facts = [m.facts.get(name, _ABSENT) for m in configured]
        if any(fact.value != facts[0].value for fact in facts):
            body.append((name, *(_values(m.facts.get(name, _ABSENT).text for m in g.members) for g in columns)))
    body += [(name, *(_values(cells) for cells in column)) for name, column in _extent(columns)]
    return Rows(title="what differs between the trainings", head=("", *(g.label for g in columns)), body=tuple(body))


_ABSENT = Fact(None, "-")


def _extent(columns: Sequence[Group]) -> Iterator[tuple[str, list[list[str]]]]:
    """How long was trained: name, and for each group the text of every training."""

    def amount(member: Training, what: X) -> str:
        if not member.scalars:
            return "-"
        try:
            done = amounts(member, what)[1][-1]
        except RunError:
            return "-"
        return f"{done:,.0f}" if what == "iterations" else f"{done / 1e6 if what == 'steps' else done:.1f}"

    kinds: dict[str, X] = {
        "iterations trained": "iterations",
        "million environment steps": "steps",
        "minutes of training": "minutes",
    }
    for name, what in kinds.items():
        cells = [[amount(m, what) for m in g.members] for g in columns]
        if any(cell != "-" for column in cells for cell in column):
            yield name, cells
    cells = [["-" if (n := processes(m)) is None else str(n) for m in g.members] for g in columns]
    if len({cell for column in cells for cell in column} - {"-"}) > 1:
        yield "processes", cells


def _values(texts: Sequence[str] | Iterator[str]) -> str:
    """One text if all are the same, else all of them."""
    texts = list(texts)
    return texts[0] if len(set(texts)) == 1 else "; ".join(texts)


def _percent(value: float, digits: int = 0) -> str:
    return f"{value:.{digits}%}".replace("%", " %")
