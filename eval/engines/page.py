"""Make the page of engine checks (the support matrix) from files of ``xreset engines check``.

Every number on the page is read from a file, and every file names the command that made it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, get_args

from jinja2 import UndefinedError

from xreset.backends.conformance.results import SCHEMA as CONFORMANCE
from xreset.backends.conformance.results import share_of
from xreset.errors import FileFormatError, XResetError
from xreset.eval.pages import render
from xreset.files.storage import read_json
from xreset.files.text import shown
from xreset.physics import Capability

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
                f"{path} is not a complete {CONFORMANCE}: {what}. Make it again."
            ) from error
        files.append(data)
    if not files:
        raise XResetError(
            "there is nothing to make a page of. Give files of xreset engines check --json."
        )
    return files


def page(files: Sequence[Json]) -> str:
    """Return the page of the contents of files, in Markdown.

    A later check replaces one of the same engine, version, device and robot.
    """
    capabilities: dict[str, set[str]] = {}
    """Title of a column, an engine on a device -> capabilities."""
    robots: dict[str, dict[str, dict[str, Json]]] = {}
    """Robot -> name of a check -> title of a column -> the check as in the file."""
    tested: dict[str, set[str]] = {}
    """Robot -> titles of the columns with checks of the robot."""
    for run in chain(*(data["runs"] for data in files)):
        column = f"{run['engine']} {run['engine_version']}"
        if run["device"] != "cpu":
            column += f", {run['device']}"
        capabilities.setdefault(column, set()).update(run["capabilities"])
        checks = robots.setdefault(run["robot"], {})
        for check in run["checks"]:
            checks.setdefault(check["check"], {})[column] = check
            tested.setdefault(run["robot"], set()).add(column)
    # In the order of the files, with each engine's versions and devices next to each other.
    engines = [column.split()[0] for column in capabilities]
    others = sorted(set().union(*capabilities.values()))
    return render(
        "engines.md.j2",
        files=files,
        names=dict.fromkeys((*get_args(Capability), *others)),
        columns=sorted(capabilities, key=lambda column: engines.index(column.split()[0])),
        capabilities=capabilities,
        tested=tested,
        robots=robots,
        verdict=_verdict,
        amount=_amount,
    )


def _verdict(check: Json | None) -> str:
    """Return the verdict as text, with the measure's largest share of its tolerance."""
    if check is None or check["verdict"] == "skipped":
        return "-"
    if check["verdict"] == "unsupported":
        return "none"
    shares = [share_of(float(m["measured"]), m["tolerance"]) for m in check["measures"]]
    worst = max(shares, default=0.0)
    share = f"{worst:.2f}" if worst < 10 else f"{worst:.3g}"
    if 0 < worst < 0.01:
        share = "< 0.01"
    if check["verdict"] == "passed":
        return share
    if check["verdict"] == "known difference":
        return f"known, {share}"
    return f"**failed, {share}**"


def _amount(measure: Json, entry: str, digits: int = 2) -> str:
    """Return a number with its unit; a number that is not finite is a text in the file."""
    return f"{float(measure[entry]):.{digits}g} {measure['unit']}".rstrip()
