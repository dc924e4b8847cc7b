"""The support matrix: a page of what was measured of the engines, made from files of ``xreset engines check`` and ``... compare``.

Nothing on the page is written by hand: every number is read from a file, and every file names the command that made it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, get_args

from xreset.backends.conformance.results import SCHEMA as CONFORMANCE
from xreset.errors import FileFormatError, XResetError
from xreset.eval.engines.agreement import SCHEMA as PARITY
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
    xreset_version: str
    covers: str
    """What it measured, in words."""


@dataclass(frozen=True)
class Checks:
    """Results of the conformance suite with one robot."""

    robot: str
    results: dict[Column, dict[str, dict[str, Any]]]
    """Of each engine on each device, its checks by name, as in the file."""

    @property
    def columns(self) -> list[Column]:
        """The engines, each one's devices side by side."""
        return list(self.results)

    @property
    def rows(self) -> dict[str, dict[str, Any]]:
        """Every check that any engine has run, in the order of the suite, with statement and group."""
        rows: dict[str, dict[str, Any]] = {}
        for checks in self.results.values():
            rows |= {name: check for name, check in checks.items() if name not in rows}
        return rows


@dataclass(frozen=True)
class Parity:
    """A comparison of grasps, as in the file."""

    source: Source
    data: Mapping[str, Any]


@dataclass(frozen=True)
class Results:
    """All that the page is made of."""

    sources: list[Source] = field(default_factory=list)
    checks: dict[str, Checks] = field(default_factory=dict)
    """By robot."""
    capabilities: dict[Column, set[str]] = field(default_factory=dict)
    parities: list[Parity] = field(default_factory=list)


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
            raise FileFormatError(f"{path} has the schema {schema!r}, expected {CONFORMANCE} or {PARITY}. Make it again with --json.")
        add = _add_conformance if schema == CONFORMANCE else _add_parity
        try:
            alone = Results()
            add(alone, path.name, data)
            page(alone)  # whatever the page asks of a file is there
        except (KeyError, TypeError, AttributeError, ValueError, IndexError, OverflowError) as error:
            what = f"{type(error).__name__} {shown(str(error))}"
            raise FileFormatError(f"{path} is no complete {schema}: {what}. Make it again.") from error
        add(results, path.name, data)
    if not results.sources:
        raise XResetError(
            "there is nothing to make a page of. Give files that `xreset engines check` or `xreset engines compare` wrote with --json."
        )
    checks = {robot: Checks(robot, _side_by_side(found.results)) for robot, found in results.checks.items()}
    return replace(results, checks=checks, capabilities=_side_by_side(results.capabilities))


def _side_by_side(columns: Mapping[Column, _T]) -> dict[Column, _T]:
    """Engines in the order of the files, and each one's versions and devices next to each other, whatever files they came in."""
    engines = list(dict.fromkeys(column.engine for column in columns))
    return {column: columns[column] for column in sorted(columns, key=lambda column: engines.index(column.engine))}


def _add_conformance(results: Results, name: str, data: Mapping[str, Any]) -> None:
    covers = []
    for run in data["runs"]:
        column = Column(run["engine"], run["engine_version"], run["device"])
        checks = results.checks.setdefault(run["robot"], Checks(run["robot"], {}))
        checks.results.setdefault(column, {}).update({check["check"]: check for check in run["checks"]})
        results.capabilities.setdefault(column, set()).update(run["capabilities"])
        covers.append(f"{column.engine} {column.version} with {run['robot']} on {column.device}")
    results.sources.append(Source(name, data["command"], data["xreset_version"], "; ".join(covers)))


def _add_parity(results: Results, name: str, data: Mapping[str, Any]) -> None:
    engines = ", ".join(_column(engine).title for engine in data["engines"])
    covers = f"grasps of {data['robot']}: {engines} against {_column(data['reference']).title}"
    source = Source(name, data.get("command", ""), data.get("xreset_version", ""), covers)
    results.sources.append(source)
    results.parities.append(Parity(source, data))


def _column(engine: Mapping[str, Any]) -> Column:
    """Of an engine as in the file of a comparison."""
    return Column(engine["backend"], engine["version"], engine["device"])


# The page --------------------------------------------------------------------------------------------------------------------------------


def page(results: Results) -> str:
    """The page, in Markdown."""
    parts = [
        "# Engines: what each can do, and how far they agree",
        "Made by `xreset engines` from the results of the commands below; do not edit it, run them again.",
        "Every check states what must hold, and compares with something independent of the engine: the URDF's kinematics, equations of "
        "motion, m g, or MuJoCo, the reference. What cannot agree is declared by the engine's backend with a bound and a reason, is still "
        "measured, and fails beyond the bound. Where no device is named, the engine ran on the CPU.",
        *_commands(results),
        *_capabilities(results),
    ]
    for checks in results.checks.values():
        parts += _summary(checks)
    parts += _known_differences(results)
    parts += _not_done(results)
    for parity in results.parities:
        parts += _parity(parity)
    for checks in results.checks.values():
        parts += _every_number(checks)
    return "\n\n".join(parts) + "\n"


def _commands(results: Results) -> list[str]:
    rows = [
        [source.covers, f"`{source.command}`" if source.command else "not recorded", source.xreset_version] for source in results.sources
    ]
    return ["## The commands", _table(["what", "command", "xreset"], rows)]


def _capabilities(results: Results) -> list[str]:
    if not results.capabilities:
        return []
    names = [*get_args(Capability), *sorted(set().union(*results.capabilities.values()) - set(get_args(Capability)))]
    columns = list(results.capabilities)
    rows = [[name.replace("_", " "), *("yes" if name in results.capabilities[column] else "no" for column in columns)] for name in names]
    text = "States, drives, steps, links, contact forces and health every engine has. These it may lack, and then refuses."
    return ["## Capabilities", text, _table(["", *(column.title for column in columns)], rows)]


def _summary(checks: Checks) -> list[str]:
    rows, group = [], None
    for name, check in checks.rows.items():
        if check["group"] != group:
            group = check["group"]
            rows.append([f"**{group}**", *[""] * (1 + len(checks.columns))])
        rows.append([f"`{name}`", check["statement"], *(_verdict(found.get(name)) for found in checks.results.values())])
    text = (
        "The number is what was measured as a share of its tolerance, of the measure that came nearest to it: up to 1 is passed. "
        "*Known*: beyond the tolerance, within the bound declared below. *None*: the engine lacks the capability, and says so. "
        "A hyphen: not done with this robot or on this device."
    )
    return [f"## Conformance with {checks.robot}", text, _table(["check", "what must hold", *(c.title for c in checks.columns)], rows)]


def _verdict(check: Mapping[str, Any] | None) -> str:
    if check is None or check["verdict"] == "skipped":
        return _NONE
    if check["verdict"] == "unsupported":
        return "none"
    worst = max((_share(m) for m in check["measures"]), default=0.0)
    share = "< 0.01" if 0 < worst < 0.01 else f"{worst:.2f}" if worst < 10 else f"{worst:.3g}"
    return {"passed": share, "known difference": f"known, {share}"}.get(check["verdict"], f"**failed, {share}**")


def _known_differences(results: Results) -> list[str]:
    rows = []
    for checks, column, name, check in _all(results):
        for m in check["measures"]:
            if m["verdict"] == "known difference":
                sizes = [_amount(m[key], m) for key in ("measured", "tolerance", "bound")]
                rows.append([column.title, checks.robot, f"`{name}`: {m['what']}", *sizes, m["reason"]])
    header = ["engine", "robot", "measure", "measured", "tolerance", "accepted up to", "why"]
    return ["## Known differences", _table(header, rows) if rows else "None was measured."]


def _not_done(results: Results) -> list[str]:
    wanted = ("failed", "unsupported", "skipped")
    rows = [
        [column.title, checks.robot, f"`{name}`", check["verdict"], check["problem"] or _failures(check)]
        for checks, column, name, check in _all(results)
        if check["verdict"] in wanted
    ]
    return ["## Failed, unsupported or left out", _table(["engine", "robot", "check", "", "why"], rows)] if rows else []


def _failures(check: Mapping[str, Any]) -> str:
    failed = [m for m in check["measures"] if m["verdict"] == "failed"]
    return "; ".join(f"{m['what']}: {_amount(m['measured'], m)}, tolerance {_amount(m['tolerance'], m)}" for m in failed)


def _parity(parity: Parity) -> list[str]:
    data = parity.data
    columns = [data["floor"], *data["engines"]]
    known = {metric["metric"]: metric for engine in columns for metric in engine["metrics"]}
    rows = []
    for name, metric in known.items():
        found = [next((m for m in engine["metrics"] if m["metric"] == name), None) for engine in columns]
        cells = [_NONE if m is None else _missed(m, f"{_amount(m['measured'], m)} ({m['n']})") for m in found]
        rows.append([metric["claim"], f"{metric['sense']} {_amount(metric['target'], metric)}", *cells])
    objects = ", ".join(thing["name"] for thing in data["objects"])
    text = (
        f"{len(data['grasps']['closing'])} closings and {len(data['grasps']['hold'])} holds of {objects}, against "
        f"{_column(data['reference']).title}. In brackets: how many numbers it is taken over. *{data['floor']['backend']}* shows how far "
        f"two honest solutions of the same equations differ. Made by `{parity.source.command or parity.source.name}`."
    )
    titles = [_column(engine).title for engine in columns]
    heading = f"## Agreement on grasps: {data['robot']} in {' and '.join(titles[1:])}"
    return [heading, text, _table(["what is compared", "target", *titles], rows)]


def _missed(metric: Mapping[str, Any], text: str) -> str:
    return text if metric["verdict"] == "met" else f"**missed: {text}**"


def _every_number(checks: Checks) -> list[str]:
    rows = []
    for name in checks.rows:
        by_column = [{m["what"]: m for m in found[name]["measures"]} if name in found else {} for found in checks.results.values()]
        for what, measure in {what: m for measures in by_column for what, m in measures.items()}.items():
            cells = [_number(measures[what]["measured"]) if what in measures else _NONE for measures in by_column]
            rows.append([f"`{name}`", what, _amount(measure["tolerance"], measure), *cells])
    table = _table(["check", "measure", "tolerance", *(c.title for c in checks.columns)], rows)
    return [f"## Every number with {checks.robot}", f"<details><summary>{len(rows)} measures</summary>", table, "</details>"]


def _all(results: Results) -> Iterable[tuple[Checks, Column, str, Mapping[str, Any]]]:
    for checks in results.checks.values():
        for column, found in checks.results.items():
            for name, check in found.items():
                yield checks, column, name, check


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


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(" ".join(cell.replace("|", "\\|").split()) for cell in line) + " |" for line in lines)
