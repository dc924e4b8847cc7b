"""The support matrix: a page of what was measured of the engines, made from files of ``xreset engines check``.

Nothing on the page is written by hand: every number is read from a file, and every file names the command that made it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from jinja2 import UndefinedError

from xreset.backends.conformance.results import SCHEMA as CONFORMANCE
from xreset.errors import FileFormatError, XResetError
from xreset.eval.pages import render
from xreset.eval.table import markdown
from xreset.files import read_json
from xreset.physics import Capability
from xreset.text import shown

_NONE = "-"
Json = Mapping[str, Any]


Checks = dict[str, dict[str, Json]]
"""Checks of each engine on each device, by title of its column and by name, as in the file."""


def read(paths: Iterable[Path]) -> list[Json]:
    """Read the files.

    Raises:
        FileFormatError: a file is of another kind, or incomplete.
        XResetError: there is no file.
    """
    files = []
    for path in paths:
        data = read_json(path, CONFORMANCE)
        try:
            page([data])  # asks the file for everything that the page needs
        except (
            KeyError,
            TypeError,
            AttributeError,
            ValueError,
            IndexError,
            OverflowError,
            UndefinedError,
        ) as error:
            what = f"{type(error).__name__} {shown(str(error))}"
            raise FileFormatError(
                f"{path} is no complete {CONFORMANCE}: {what}. Make it again."
            ) from error
        files.append(data)
    if not files:
        raise XResetError(
            "there is nothing to make a page of. Give files of xreset engines check --json."
        )
    return files


def page(files: Iterable[Json]) -> str:
    """Return the page of the contents of files, in Markdown.

    A later check replaces one of the same engine, version, device and robot.
    """
    commands = []
    capabilities: dict[str, set[str]] = {}
    robots: dict[str, Checks] = {}
    for data in files:
        covers = []
        for run in data["runs"]:
            engine = f"{run['engine']} {run['engine_version']}"
            covers.append(f"{engine} with {run['robot']} on {run['device']}")
            column = engine if run["device"] == "cpu" else f"{engine}, {run['device']}"
            found = robots.setdefault(run["robot"], {}).setdefault(column, {})
            found.update({check["check"]: check for check in run["checks"]})
            capabilities.setdefault(column, set()).update(run["capabilities"])
        command = f"`{data['command']}`" if data.get("command") else "not recorded"
        commands.append(("; ".join(covers), command, data.get("xreset_version", "")))
    known = []
    not_done = []
    for robot, checks in robots.items():
        for column in _order(checks):
            for name, check in checks[column].items():
                where = (column, robot)
                for m in check["measures"]:
                    if m["verdict"] == "known difference":
                        amounts = [_amount(m[key], m) for key in ("measured", "tolerance", "bound")]
                        known.append((*where, f"`{name}`: {m['what']}", *amounts, m["reason"]))
                if check["verdict"] in ("failed", "unsupported", "skipped"):
                    not_done.append(
                        (
                            *where,
                            f"`{name}`",
                            check["verdict"],
                            check["problem"] or _failures(check),
                        )
                    )
    measured = ("engine", "robot", "measure", "measured", "tolerance", "accepted up to", "why")
    return render(
        "engines.md.j2",
        commands=_table(("what", "command", "xreset"), commands),
        capabilities=_capabilities(capabilities),
        summaries={robot: _summary(checks) for robot, checks in robots.items()},
        known_differences=_table(measured, known),
        not_done=_table(("engine", "robot", "check", "", "why"), not_done),
    )


def _order(columns: Iterable[str]) -> list[str]:
    """Engines in the order of the files, with each one's versions and devices next to each other."""
    known = list(columns)
    engines = list(dict.fromkeys(column.split()[0] for column in known))
    return sorted(known, key=lambda column: engines.index(column.split()[0]))


def _capabilities(found: Mapping[str, set[str]]) -> str:
    columns = _order(found)
    others = sorted(set().union(*found.values()))
    rows = []
    for name in dict.fromkeys((*get_args(Capability), *others)) if found else ():
        rows.append(
            (
                name.replace("_", " "),
                *("yes" if name in found[column] else "no" for column in columns),
            )
        )
    return _table(("", *columns), rows)


def _summary(checks: Checks) -> str:
    columns = _order(checks)
    every: dict[str, Json] = {}
    for column in columns:
        every = every | checks[column] | every  # an earlier column wins
    rows = []
    group = None
    for name, check in every.items():
        if check["group"] != group:
            group = check["group"]
            rows.append((f"**{group}**", *[""] * (1 + len(columns))))
        rows.append(
            (
                f"`{name}`",
                check["statement"],
                *(_verdict(checks[column].get(name)) for column in columns),
            )
        )
    return _table(("check", "what must hold", *columns), rows)


def _verdict(check: Json | None) -> str:
    if check is None or check["verdict"] == "skipped":
        return _NONE
    if check["verdict"] == "unsupported":
        return "none"
    worst = max((_share(m) for m in check["measures"]), default=0.0)
    share = "< 0.01" if 0 < worst < 0.01 else f"{worst:.2f}" if worst < 10 else f"{worst:.3g}"
    return {"passed": share, "known difference": f"known, {share}"}.get(
        check["verdict"], f"**failed, {share}**"
    )


def _failures(check: Json) -> str:
    parts = []
    for m in check["measures"]:
        if m["verdict"] == "failed":
            parts.append(
                f"{m['what']}: {_amount(m['measured'], m)}, tolerance {_amount(m['tolerance'], m)}"
            )
    return "; ".join(parts)


def _share(measure: Json) -> float:
    measured = float(measure["measured"])
    tolerance = measure["tolerance"]
    if not math.isfinite(measured):
        return math.inf
    if tolerance:
        return measured / tolerance
    return 0.0 if measured == 0 else math.inf


def _amount(value: Any, measure: Json) -> str:
    """Two digits that matter, with the unit; numbers that are not finite are text in the file."""
    return f"{float(value):.2g} {measure['unit']}".rstrip()


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    """A table in Markdown, whose cells may hold Markdown; empty without a row."""

    def escape(cell: str) -> str:
        return " ".join(cell.replace("|", "\\|").split())

    return markdown([head, *rows], escape=escape) if rows else ""
