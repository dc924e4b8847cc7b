"""The paper's figures, from ``paper.toml``."""

from __future__ import annotations

import tomllib
from dataclasses import field
from functools import cache
from pathlib import Path
from typing import Literal

from xreset.files.checks import from_dict, frozen

FILE = Path(__file__).parent / "paper.toml"
ALL = "all"
"""Name that stands for the mean over all objects."""

TRAINING = "10,000 iterations of 16 steps in 4,096 worlds on four GPUs (Table VIII), an unstated number of seeds"
"""How long the paper's policies were trained, in the paper's words."""

Axis = Literal["object", "method", "metric"]


@frozen
class PaperTable:
    """A table of the paper; or a table of a study, which has no figures.

    Objects have their official names, metrics those of :data:`xreset.eval.metrics.METRICS`.
    """

    title: str
    rows: Axis
    columns: Axis
    names: tuple[str, ...]
    """Names of the columns."""
    values: dict[str, tuple[float, ...]]
    """Row -> a figure for each column, percent."""
    standard_error: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Row -> a standard error for each column, percent, for the rows that have them. The 95 % interval is 1.96 standard
    errors on either side."""
    object: str = ALL
    """The object of all figures, where objects are not an axis."""
    metric: str = "task_progress"
    """The metric of all figures, where metrics are not an axis."""

    @property
    def objects(self) -> set[str]:
        """The objects of the table's means."""
        if "object" not in (self.rows, self.columns):
            return paper_tables()["I"].objects
        return {*(self.values if self.rows == "object" else self.names)} - {ALL}

    def figures(self) -> dict[tuple[str, str, str], str]:
        """Return method, object and metric -> figure, percent, as text with the standard error if it is stated."""
        found = {}
        fixed = {"object": self.object, "metric": self.metric}
        for row, values in self.values.items():
            errors = self.standard_error.get(row, (None,) * len(values))
            for column, value, error in zip(self.names, values, errors, strict=True):
                key = fixed | {self.rows: row, self.columns: column}
                text = f", paper {value:.1f}"
                if error is not None:
                    text += f" \N{PLUS-MINUS SIGN} {error:.1f}"
                found[key["method"], key["object"], key["metric"]] = text
        return found


@cache
def paper_tables() -> dict[str, PaperTable]:
    """Return the paper's tables by number."""
    tables = tomllib.loads(FILE.read_text())["tables"]
    return {
        number: from_dict(PaperTable, content, f"{FILE}: {number}")
        for number, content in tables.items()
    }
