"""The paper's figures, from ``paper.toml``."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Literal

from xreset.checks import from_dict

FILE = Path(__file__).parent / "paper.toml"
ALL = "all"
"""In place of an object: the mean over all of them."""

Axis = Literal["object", "method", "metric"]


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of the paper. Objects have their official names, metrics those of :data:`xreset.eval.table.METRICS`."""

    title: str
    rows: Axis
    columns: Axis
    names: tuple[str, ...]
    """Names of the columns."""
    values: dict[str, tuple[float, ...]]
    """Row -> a figure for each column, percent."""
    standard_error: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Row -> standard errors, for the rows that have them; 1.96 of it on either side is the 95 % interval."""
    object: str = ALL
    """The object of all figures, where objects are not an axis."""
    metric: str = "task_progress"
    """The metric of all figures, where metrics are not an axis."""

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that the paper compares, in its order."""
        return tuple(self.values) if self.rows == "method" else self.names

    def figures(self) -> dict[tuple[str, str, str], tuple[float, float | None]]:
        """Return method, object and metric -> figure and its standard error, percent; None where none is stated."""
        found = {}
        for row, values in self.values.items():
            errors = self.standard_error.get(row, (None,) * len(values))
            for column, value, error in zip(self.names, values, errors, strict=True):
                key = {
                    "object": self.object,
                    "metric": self.metric,
                    self.rows: row,
                    self.columns: column,
                }
                found[key["method"], key["object"], key["metric"]] = (value, error)
        return found


@cache
def paper_tables() -> dict[str, PaperTable]:
    """Return the paper's tables by number."""
    tables = tomllib.loads(FILE.read_text())["tables"]
    return {
        number: from_dict(PaperTable, content, f"{FILE}: {number}")
        for number, content in tables.items()
    }


def paper_training() -> str:
    """Return how long the paper's policies were trained, in the paper's words."""
    return tomllib.loads(FILE.read_text())["training"]
