"""The support matrix: a page of what was measured of the engines, made from files of ``xreset engines check``.

Nothing on the page is written by hand: every number is read from a file, and every file names the command that made it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_args

from jinja2 import UndefinedError

from xreset.backends.conformance.results import SCHEMA as CONFORMANCE
from xreset.backends.conformance.results import share_of
from xreset.errors import FileFormatError, XResetError
from xreset.eval.pages import render
from xreset.eval.table import Rows, markdown
from xreset.files import read_json
from xreset.physics import Capability
from xreset.text import shown

Json = Mapping[str, Any]


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
            LookupError,
            TypeError,
            AttributeError,
            ValueError,
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
    """Of each engine on each device, by title of its column."""
    robots: dict[str, dict[str, dict[str, Json]]] = {}
    """Robot -> name of a check -> title of a column -> the check as in the file."""
    for data in files:
        covers = []
        for run in data["runs"]:
            engine = f"{run['engine']} {run['engine_version']}"
            covers.append(f"{engine} with {run['robot']} on {run['device']}")
            column = engine if run["device"] == "cpu" else f"{engine}, {run['device']}"
            capabilities.setdefault(column, set()).update(run["capabilities"])
            checks = robots.setdefault(run["robot"], {})
            for check in run["checks"]:
                checks.setdefault(check["check"], {})[column] = check
        command = f"`{data['command']}`" if data.get("command") else "not recorded"
        commands.append(("; ".join(covers), command, data.get("xreset_version", "")))
    # In the order of the files, with each engine's versions and devices next to each other.
    engines = [column.split()[0] for column in capabilities]
    columns = sorted(capabilities, key=lambda column: engines.index(column.split()[0]))
    able = []
    for name in dict.fromkeys(
        (*get_args(Capability), *sorted(set().union(*capabilities.values())))
    ):
        cells = ["yes" if name in capabilities[column] else "no" for column in columns]
        able.append((name.replace("_", " "), *cells))
    summaries = {}
    known = []
    not_done = []
    for robot, checks in robots.items():
        tested_here = set().union(*checks.values())
        tested = [column for column in columns if column in tested_here]
        summaries[robot] = _summary(checks, tested)
        for column in tested:
            for name, results in checks.items():
                if column in results:
                    where = (column, robot, f"`{name}`")
                    known += _known_differences(results[column], *where)
                    not_done += _not_done(results[column], *where)
    measured = ("engine", "robot", "measure", "measured", "tolerance", "accepted up to", "why")
    return render(
        "engines.md.j2",
        commands=_table(("what", "command", "xreset"), commands),
        capabilities=_table(("", *columns), able),
        summaries=summaries,
        known_differences=_table(measured, known),
        not_done=_table(("engine", "robot", "check", "", "why"), not_done),
    )


def _known_differences(check: Json, engine: str, robot: str, name: str) -> list[tuple[str, ...]]:
    rows = []
    for m in check["measures"]:
        if m["verdict"] == "known difference":
            amounts = (_amount(m, key) for key in ("measured", "tolerance", "bound"))
            rows.append((engine, robot, f"{name}: {m['what']}", *amounts, m["reason"]))
    return rows


def _not_done(check: Json, *where: str) -> list[tuple[str, ...]]:
    if check["verdict"] in ("passed", "known difference"):
        return []
    failures = []
    for m in check["measures"]:
        if m["verdict"] == "failed":
            failures.append(
                f"{m['what']}: {_amount(m, 'measured')}, tolerance {_amount(m, 'tolerance')}"
            )
    return [(*where, check["verdict"], check["problem"] or "; ".join(failures))]


def _summary(checks: Mapping[str, Mapping[str, Json]], columns: Sequence[str]) -> str:
    rows = []
    group = None
    for name, results in checks.items():
        check = next(iter(results.values()))
        if check["group"] != group:
            group = check["group"]
            rows.append((f"**{group}**", *[""] * (1 + len(columns))))
        verdicts = [_verdict(results.get(column)) for column in columns]
        rows.append((f"`{name}`", check["statement"], *verdicts))
    return _table(("check", "what must hold", *columns), rows)


def _verdict(check: Json | None) -> str:
    if check is None or check["verdict"] == "skipped":
        return "-"
    if check["verdict"] == "unsupported":
        return "none"
    shares = [share_of(float(m["measured"]), m["tolerance"]) for m in check["measures"]]
    worst = max(shares, default=0.0)
    share = "< 0.01" if 0 < worst < 0.01 else f"{worst:.2f}" if worst < 10 else f"{worst:.3g}"
    return {"passed": share, "known difference": f"known, {share}"}.get(
        check["verdict"], f"**failed, {share}**"
    )


def _amount(measure: Json, entry: str) -> str:
    """Two digits that matter, with the unit; numbers that are not finite are text in the file."""
    return f"{float(measure[entry]):.2g} {measure['unit']}".rstrip()


def _table(head: tuple[str, ...], rows: Rows) -> str:
    """A table in Markdown, whose cells may hold Markdown; empty without a row."""

    def escape(cell: str) -> str:
        return " ".join(cell.replace("|", "\\|").split())

    return markdown([head, *rows], escape=escape) if rows else ""
