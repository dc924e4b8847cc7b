"""The paper's figures, from ``paper.toml``."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

from xreset.checks import from_dict
from xreset.objects.catalogue import canonical_name

FILE = Path(__file__).parent / "paper.toml"
ALL = "all"
"""In place of an object: the mean over all of them."""

Axis = Literal["object", "method", "metric"]


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of the paper."""

    title: str
    rows: Axis
    columns: Axis
    names: tuple[str, ...]
    """Names of the columns."""
    values: dict[str, tuple[float, ...]]
    """Row -> a figure for each column, percent."""
    standard_error: dict[str, tuple[float, ...]]
    """Row -> standard errors, for the rows that have them; 1.96 of it on either side is the 95 % interval."""
    object: str | None = None
    """The object of all figures, where objects are not an axis; None: all objects."""
    metric: str | None = None
    """The metric of all figures, where metrics are not an axis."""

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods that the paper compares, in its order."""
        return tuple(self.values) if self.rows == "method" else self.names

    def figure(self, method: str, object_name: str, metric: str) -> tuple[float | None, float | None]:
        """Return the figure that the paper reports and its standard error, percent; None where it reports none.

        Args:
            method: the paper's name of the method.
            object_name: official name of the object, or :data:`ALL`.
            metric: one of :data:`xreset.eval.table.METRICS`.
        """
        key = {"method": method, "object": object_name, "metric": metric}
        row = key[self.rows]
        column = key[self.columns]
        same_metric = self.metric in (None, metric)
        same_object = "object" in (self.rows, self.columns) or (self.object or ALL) == object_name
        if not (same_metric and same_object and row in self.values and column in self.names):
            return None, None
        index = self.names.index(column)
        error = self.standard_error[row][index] if row in self.standard_error else None
        return self.values[row][index], error


@cache
def paper_tables() -> dict[str, PaperTable]:
    """Return the paper's tables by number, with the official names of the objects."""
    tables = {}
    for number, content in tomllib.loads(FILE.read_text())["tables"].items():
        table = from_dict(PaperTable, {"standard_error": {}} | content, f"{FILE}: {number}")
        tables[number] = replace(
            table,
            names=tuple(_official(table.columns, name) for name in table.names),
            values={_official(table.rows, name): figures for name, figures in table.values.items()},
            standard_error={_official(table.rows, name): errors for name, errors in table.standard_error.items()},
            object=canonical_name(table.object) if table.object else None,
        )
    return tables


def _official(axis: Axis, name: str) -> str:
    return canonical_name(name) if axis == "object" and name != ALL else name


@cache
def paper_training() -> str:
    """Return how long the paper's policies were trained, in the paper's words."""
    return tomllib.loads(FILE.read_text())["training"]
