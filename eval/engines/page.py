"""Make the page of engine checks (the support matrix) from what ``xreset engines check`` has found."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, get_args

from xreset.backends.conformance.results import share_of
from xreset.eval.pages import render
from xreset.physics import Capability

Json = Mapping[str, Any]


def page(found: Json) -> str:
    """Return the page of the content of a file, in Markdown."""
    runs: dict[str, Json] = {}
    """Title of a column, an engine on a device -> its run."""
    checks: dict[str, dict[str, Json]] = {}
    """Name of a check -> title of a column -> the check as in the file."""
    for run in found["runs"]:
        column = f"{run['engine']} {run['engine_version']}"
        if run["device"] != "cpu":
            column += f", {run['device']}"
        runs[column] = run
        for check in run["checks"]:
            checks.setdefault(check["check"], {})[column] = check
    return render(
        "engines.md.j2",
        found=found,
        runs=runs,
        checks=checks,
        names=get_args(Capability),
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
