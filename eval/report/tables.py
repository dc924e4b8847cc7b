"""The tables of a comparison."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from xreset.errors import RunError
from xreset.eval.report.curves import Fate, X, amounts, fates, processes, share_of_runs
from xreset.eval.report.groups import Group, Score, Scores, engines_of, members_of
from xreset.eval.report.read import Fact, Training
from xreset.eval.table import Rows, distance_text, success_text
from xreset.learning.clock import SHARES

LIFTED = (
    "First success from home: share of runs (95 % interval) in which 1, 10 and 50 % of the steps of worlds that began "
    "at home have been at the goal, and when that was first so in each. A run that ended without (>) counts until it "
    "ended (Kaplan-Meier); the interval is Wilson's, of as many runs as were watched so long."
)
_ABSENT = Fact(None, "-")


def results(groups: Sequence[Group], found: Scores) -> Rows:
    """Return five rows for each group (six for several trainings), one column for each engine; ``-`` where it was not
    evaluated."""
    engines = engines_of(found)
    versions: dict[str, set[str]] = {engine: set() for engine in engines}
    for member in members_of(groups):
        for engine, result in member.results.items():
            versions[engine].add(result.backend_version)
    body = []
    for label, row in found.items():
        several = any(len(s.each) > 1 for s in row.values())
        texts = {engine: _score_texts(s, several) for engine, s in row.items()}
        names = next(iter(texts.values()))
        for i, name in enumerate(names):
            cells = [texts[engine][name] if engine in texts else "-" for engine in engines]
            body.append((label if i == 0 else "", name, *cells))
    head = ("", "", *(f"{engine} {', '.join(sorted(versions[engine]))}" for engine in engines))
    return Rows(title="evaluation", head=head, body=tuple(body))


def _score_texts(s: Score, several: bool) -> dict[str, str]:
    """Return name and text of the rows of one score."""
    low, high = s.ci95
    texts = {"task progress (95 % interval)": f"{_percent(s.task_progress, 1)} ({100 * low:.0f}-{100 * high:.0f})"}
    if several:
        texts["task progress of each seed"] = ", ".join(f"{100 * x:.1f}" for x in s.each.values()) + " %"
    stages = " / ".join(f"{100 * x:.0f}" for x in (s.approach, s.grasp, s.reorient))
    texts["approach / grasp / reorient"] = f"{stages} %"
    texts["at the goal at any time; reorientation progress"] = (
        f"{_percent(s.reorient_once)}; {_percent(s.reorientation_progress, 1)}"
    )
    success = success_text(s.published_success)
    if s.published_success_ci95 is not None:
        low, high = s.published_success_ci95
        success = f"{success.replace('%', ' %')} ({100 * low:.0f}-{100 * high:.0f})"
    texts["published success (95 % interval)"] = success
    texts["published distance"] = distance_text(s.least_distance)
    return texts


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
    if not found:
        return "-"
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
    configured = [m for m in members_of(columns) if m.facts]
    names: dict[str, None] = {}
    for member in configured:
        names |= dict.fromkeys(member.facts)
    body = []
    for name in names:
        values = [m.facts.get(name, _ABSENT).value for m in configured]
        if any(value != values[0] for value in values):
            cells = []
            for g in columns:
                cells.append(_values(m.facts.get(name, _ABSENT).text for m in g.members))
            body.append((name, *cells))
    for name, cells in _lengths(columns):
        body.append((name, *map(_values, cells)))
    head = ("", *(g.label for g in columns))
    return Rows(title="what differs between the trainings", head=head, body=tuple(body))


def _lengths(columns: Sequence[Group]) -> Iterator[tuple[str, list[list[str]]]]:
    """Yield how long was trained: name, and for each group the text of every training."""
    kinds: dict[str, X] = {
        "iterations trained": "iterations",
        "million environment steps": "steps",
        "minutes of training": "minutes",
    }
    for name, x in kinds.items():
        cells = _cells(columns, lambda m, x=x: _amount(m, x))
        if _distinct(cells) - {"-"}:
            yield name, cells
    cells = _cells(columns, lambda m: str(processes(m) or "-"))
    if len(_distinct(cells) - {"-"}) > 1:
        yield "processes", cells


def _cells(columns: Sequence[Group], text: Callable[[Training], str]) -> list[list[str]]:
    """Return the text of every training of every group."""
    cells = []
    for group in columns:
        cells.append([text(member) for member in group.members])
    return cells


def _amount(member: Training, x: X) -> str:
    if not member.scalars:
        return "-"
    try:
        done = amounts(member, x)[1][-1]
    except RunError:
        return "-"
    if x == "iterations":
        return f"{done:,.0f}"
    return f"{done / 1e6 if x == 'steps' else done:.1f}"


def _distinct(cells: Sequence[Sequence[str]]) -> set[str]:
    return set().union(*cells)


def _values(texts: Iterable[str]) -> str:
    """Return one text if all are the same, else all of them."""
    texts = list(texts)
    return texts[0] if len(set(texts)) == 1 else "; ".join(texts)


def _percent(value: float, digits: int = 0) -> str:
    return f"{value:.{digits}%}".replace("%", " %")
