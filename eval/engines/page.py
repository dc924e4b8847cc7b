"""The support matrix: a page of what was measured of the engines, made from files of ``xreset engines check`` and ``... compare``.

Nothing on the page is written by hand: every number is read from a file, and every file names the command that made it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

from jinja2 import UndefinedError

from xreset.backends.conformance.results import SCHEMA as CONFORMANCE
from xreset.errors import FileFormatError, XResetError
from xreset.eval.engines.agreement import SCHEMA as PARITY
from xreset.eval.pages import render
from xreset.eval.table import Rows, markdown
from xreset.files import read_json
from xreset.physics import Capability
from xreset.text import shown

_T = TypeVar("_T")


@dataclass(frozen=True)
class Column:
    """One engine on one device."""

    engine: str
    version: str
    device: str

    @property
    def title(self) -> str:
        """Such as ``mujoco 4.0.0``; the device is named where it is not the CPU."""
        return f"{self.engine} {self.version}" + ("" if self.device == "cpu" else f", {self.device}")


@dataclass(frozen=True)
class Source:
    """A file, and how it came about."""

    name: str
    command: str
    version: str
    """Of xreset."""
    covers: str
    """What it measured, in words."""


Checks = dict[Column, dict[str, dict[str, Any]]]
"""Of each engine on each device, side by side, its checks by name, as in the file."""


@dataclass(frozen=True)
class Results:
    """All that the page is made of."""

    sources: list[Source] = field(default_factory=list)
    checks: dict[str, Checks] = field(default_factory=dict)
    """By robot."""
    capabilities: dict[Column, set[str]] = field(default_factory=dict)
    parities: list[tuple[Source, Mapping[str, Any]]] = field(default_factory=list)
    """Comparisons of grasps, as in their files."""


def read(paths: Iterable[Path]) -> Results:
    """Read the files. Where two have the same check of the same engine, version, device and robot, the later one counts.

    Raises:
        FileFormatError: a file is neither of the two kinds, or lacks something.
        XResetError: there is no file.
    """
    results = Results()
    for path in paths:
        data = read_json(path)
        schema = data.get("schema")
        if schema not in (CONFORMANCE, PARITY):
            raise FileFormatError(
                f"{path} has the schema {schema!r}, expected {CONFORMANCE} or {PARITY}. Make it again with --json."
            )
        add = _add_conformance if schema == CONFORMANCE else _add_parity
        try:
            alone = Results()
            add(alone, path.name, data)
            page(alone)  # whatever the page asks of a file is there
        except (KeyError, TypeError, AttributeError, ValueError, IndexError, OverflowError, UndefinedError) as error:
            what = f"{type(error).__name__} {shown(str(error))}"
            raise FileFormatError(f"{path} is no complete {schema}: {what}. Make it again.") from error
        add(results, path.name, data)
    if not results.sources:
        raise XResetError(
            "there is nothing to make a page of. Give files that `xreset engines check` or `xreset engines compare` wrote with --json."
        )
    checks = {robot: _side_by_side(found) for robot, found in results.checks.items()}
    return replace(results, checks=checks, capabilities=_side_by_side(results.capabilities))


def _side_by_side(columns: Mapping[Column, _T]) -> dict[Column, _T]:
    """Engines in the order of the files, and each one's versions and devices next to each other, whatever files they came in."""
    engines = list(dict.fromkeys(column.engine for column in columns))
    return {column: columns[column] for column in sorted(columns, key=lambda column: engines.index(column.engine))}


def _add_conformance(results: Results, name: str, data: Mapping[str, Any]) -> None:
    covers = []
    for run in data["runs"]:
        column = Column(run["engine"], run["engine_version"], run["device"])
        results.checks.setdefault(run["robot"], {}).setdefault(column, {}).update(
            {check["check"]: check for check in run["checks"]}
        )
        results.capabilities.setdefault(column, set()).update(run["capabilities"])
        covers.append(f"{column.engine} {column.version} with {run['robot']} on {column.device}")
    results.sources.append(Source(name, data["command"], data["xreset_version"], "; ".join(covers)))


def _add_parity(results: Results, name: str, data: Mapping[str, Any]) -> None:
    engines = ", ".join(_column(engine).title for engine in data["engines"])
    covers = f"grasps of {data['robot']}: {engines} against {_column(data['reference']).title}"
    source = Source(name, data.get("command", ""), data.get("xreset_version", ""), covers)
    results.sources.append(source)
    results.parities.append((source, data))


def _column(engine: Mapping[str, Any]) -> Column:
    """Of an engine as in the file of a comparison."""
    return Column(engine["backend"], engine["version"], engine["device"])


def page(results: Results) -> str:
    """The page, in Markdown."""
    found = [
        (column.title, robot, name, check)
        for robot, checks in results.checks.items()
        for column, of in checks.items()
        for name, check in of.items()
    ]
    known = [
        (
            title,
            robot,
            f"`{name}`: {m['what']}",
            *(_amount(m[key], m) for key in ("measured", "tolerance", "bound")),
            m["reason"],
        )
        for title, robot, name, check in found
        for m in check["measures"]
        if m["verdict"] == "known difference"
    ]
    not_done = [
        (title, robot, f"`{name}`", check["verdict"], check["problem"] or _failures(check))
        for title, robot, name, check in found
        if check["verdict"] in ("failed", "unsupported", "skipped")
    ]
    commands = [(s.covers, f"`{s.command}`" if s.command else "not recorded", s.version) for s in results.sources]
    return render(
        "engines.md.j2",
        commands=_table(("what", "command", "xreset"), commands),
        capabilities=_capabilities(results.capabilities),
        summaries={robot: _summary(checks) for robot, checks in results.checks.items()},
        known_differences=_table(
            ("engine", "robot", "measure", "measured", "tolerance", "accepted up to", "why"), known
        ),
        not_done=_table(("engine", "robot", "check", "", "why"), not_done),
        parities=[_parity(source, data) for source, data in results.parities],
        numbers={robot: _every_number(checks) for robot, checks in results.checks.items()},
    )


def _capabilities(found: Mapping[Column, set[str]]) -> str:
    names = dict.fromkeys((*get_args(Capability), *sorted(set().union(*found.values()))))
    rows = [(name.replace("_", " "), *("yes" if name in able else "no" for able in found.values())) for name in names]
    return _table(("", *(column.title for column in found)), rows if found else ())


def _every_check(checks: Checks) -> dict[str, dict[str, Any]]:
    """What any engine has run, in the order of the suite."""
    found: dict[str, dict[str, Any]] = {}
    for of in checks.values():
        found |= {name: check for name, check in of.items() if name not in found}
    return found


def _summary(checks: Checks) -> str:
    rows, group = [], None
    for name, check in _every_check(checks).items():
        if check["group"] != group:
            group = check["group"]
            rows.append((f"**{group}**", *[""] * (1 + len(checks))))
        rows.append((f"`{name}`", check["statement"], *(_verdict(of.get(name)) for of in checks.values())))
    return _table(("check", "what must hold", *(c.title for c in checks)), rows)


def _verdict(check: Mapping[str, Any] | None) -> str:
    if check is None or check["verdict"] == "skipped":
        return _NONE
    if check["verdict"] == "unsupported":
        return "none"
    worst = max((_share(m) for m in check["measures"]), default=0.0)
    share = "< 0.01" if 0 < worst < 0.01 else f"{worst:.2f}" if worst < 10 else f"{worst:.3g}"
    return {"passed": share, "known difference": f"known, {share}"}.get(check["verdict"], f"**failed, {share}**")


def _failures(check: Mapping[str, Any]) -> str:
    failed = [m for m in check["measures"] if m["verdict"] == "failed"]
    return "; ".join(
        f"{m['what']}: {_amount(m['measured'], m)}, tolerance {_amount(m['tolerance'], m)}" for m in failed
    )


def _parity(source: Source, data: Mapping[str, Any]) -> dict[str, Any]:
    columns = [data["floor"], *data["engines"]]
    known = {metric["metric"]: metric for engine in columns for metric in engine["metrics"]}
    rows = []
    for name, metric in known.items():
        found = [next((m for m in engine["metrics"] if m["metric"] == name), None) for engine in columns]
        cells = [_NONE if m is None else _missed(m, f"{_amount(m['measured'], m)} ({m['n']})") for m in found]
        rows.append((metric["claim"], f"{metric['sense']} {_amount(metric['target'], metric)}", *cells))
    titles = [_column(engine).title for engine in columns]
    return {
        "robot": data["robot"], "engines": titles[1:], "closings": len(data["grasps"]["closing"]), "holds": len(data["grasps"]["hold"]),
        "objects": [thing["name"] for thing in data["objects"]], "reference": _column(data["reference"]).title,
        "floor": data["floor"]["backend"], "source": source.command or source.name,
        "table": _table(("what is compared", "target", *titles), rows),
    }  # fmt: skip


def _missed(metric: Mapping[str, Any], text: str) -> str:
    return text if metric["verdict"] == "met" else f"**missed: {text}**"


def _every_number(checks: Checks) -> tuple[int, str]:
    """How many, and the table."""
    rows = []
    for name in _every_check(checks):
        by_column = [{m["what"]: m for m in of[name]["measures"]} if name in of else {} for of in checks.values()]
        for what, measure in {what: m for measures in by_column for what, m in measures.items()}.items():
            cells = [_number(measures[what]["measured"]) if what in measures else _NONE for measures in by_column]
            rows.append((f"`{name}`", what, _amount(measure["tolerance"], measure), *cells))
    return len(rows), _table(("check", "measure", "tolerance", *(c.title for c in checks)), rows)


def _share(measure: Mapping[str, Any]) -> float:
    measured, tolerance = float(measure["measured"]), measure["tolerance"]
    if not math.isfinite(measured):
        return math.inf
    return measured / tolerance if tolerance else (0.0 if measured == 0 else math.inf)


def _amount(value: Any, measure: Mapping[str, Any]) -> str:
    return f"{_number(value)} {measure['unit']}".rstrip()


def _number(value: Any) -> str:
    """Two digits that matter; numbers that are not finite are text in the file."""
    return "not measured" if value is None else f"{float(value):.2g}"


_NONE = "-"


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """In Markdown, which cells may hold; empty without a row."""
    return (
        markdown(Rows(head=head, body=tuple(rows)), escape=lambda cell: " ".join(cell.replace("|", "\\|").split()))
        if rows
        else ""
    )
