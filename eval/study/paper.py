"""The paper's figures, from ``paper.toml``, where they stand once."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

from xreset.checks import from_dict
from xreset.objects.catalogue import canonical_name

FILE = Path(__file__).parent / "paper.toml"
METRICS = {
    "task_progress": "task progress",
    "approach": "approach",
    "grasp": "grasp",
    "reorient": "reorient",
    "reorient_once": "at the goal at any time",
    "reorientation_progress": "reorientation progress",
}
"""Field of an episode -> what tables call it."""
ALL = "all"
"""In place of an object: the mean over all of them."""


@dataclass(frozen=True, kw_only=True)
class PaperTable:
    """A table of the paper."""

    title: str
    rows: Literal["object", "method", "metric"]
    columns: Literal["object", "method", "metric"]
    names: tuple[str, ...]
    """Of the columns."""
    values: dict[str, tuple[float, ...]]
    """Row -> a figure for each column, percent."""
    standard_error: dict[str, tuple[float, ...]]
    """The same for those rows that have one; not an interval: 1.96 of it on either side is."""
    object: str | None = None
    """Where objects are no axis: which one; None: all."""
    metric: str | None = None
    """Where metrics are no axis: which one."""

    @property
    def methods(self) -> tuple[str, ...]:
        """What the paper compares, in its order."""
        return tuple(self.values) if self.rows == "method" else self.names

    def figure(self, method: str, thing: str, metric: str) -> float | None:
        """What the paper reports, percent; None where it does not.

        Args:
            method: as the paper calls it.
            thing: official name of the object, or :data:`ALL`.
            metric: of :data:`METRICS`.
        """
        if self.metric not in (None, metric) or (
            "object" not in (self.rows, self.columns) and (self.object or ALL) != thing
        ):
            return None
        key = {"method": method, "object": thing, "metric": metric}
        if key[self.rows] not in self.values or key[self.columns] not in self.names:
            return None
        return self.values[key[self.rows]][self.names.index(key[self.columns])]


@cache
def paper_tables() -> dict[str, PaperTable]:
    """Number -> table."""
    raw = tomllib.loads(FILE.read_text())["tables"]
    return {
        number: _official(from_dict(PaperTable, {"standard_error": {}} | table, f"{FILE}: {number}"))
        for number, table in raw.items()
    }


@cache
def paper_training() -> str:
    """How long the paper's policies were trained, as it says."""
    return tomllib.loads(FILE.read_text())["training"]


def _official(table: PaperTable) -> PaperTable:
    """With the official names of the objects."""

    def name(axis: str, text: str) -> str:
        return canonical_name(text) if axis == "object" and text != ALL else text

    return replace(
        table,
        names=tuple(name(table.columns, n) for n in table.names),
        values={name(table.rows, n): v for n, v in table.values.items()},
        standard_error={name(table.rows, n): v for n, v in table.standard_error.items()},
        object=canonical_name(table.object) if table.object else None,
    )
