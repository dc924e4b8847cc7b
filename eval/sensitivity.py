"""The physical properties of the world that can be changed, and the effect of a change on a policy's score.

Sweeps (:mod:`xreset.eval.stress`), rehearsals (:mod:`xreset.eval.rehearse`) and the attribution to differences of
engines (:mod:`xreset.eval.engines.attribution`) share both.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset.errors import XResetError
from xreset.eval.stats import Interval, bootstrap_ci95, mean_of_known
from xreset.files.checks import frozen
from xreset.task.config import RandomizationConfig, TaskConfig

if TYPE_CHECKING:  # a command checks names of properties before it loads torch
    from xreset.eval.results import Episode
    from xreset.physics import Capability


@frozen
class Effect:
    """Task progress of some episodes, and its difference to the same episodes unchanged; intervals of 95 %."""

    task_progress: float
    ci95: Interval
    difference: float
    difference_ci95: Interval
    published_success: float | None = None
    """Share of the episodes that succeed in the sense of the published paper; None: an earlier version did not measure
    it."""

    @classmethod
    def of(cls, episodes: Sequence[Episode], nominal: Sequence[Episode]) -> Effect:
        """Compare episodes one by one. The intervals are bootstraps over demonstrations."""
        score = np.array([e.task_progress for e in episodes])
        difference = score - np.array([e.task_progress for e in nominal])
        groups = np.array([e.sequence for e in episodes])
        return cls(
            task_progress=float(score.mean()),
            ci95=bootstrap_ci95(score, groups),
            difference=float(difference.mean()),
            difference_ci95=bootstrap_ci95(difference, groups),
            published_success=mean_of_known([e.published_success for e in episodes]),
        )

    @property
    def is_certain(self) -> bool:
        """Whether the interval of the difference excludes zero."""
        low, high = self.difference_ci95
        return low > 0 or high < 0


@frozen
class Property:
    """One physical property, or a fault of a rehearsal. The fields are explained in ``properties.toml``."""

    name: str
    task_field: str = ""
    values: tuple[float, ...] = ()
    nominal: float = 1.0
    unit: str = "x"
    needs: Capability | None = None
    measured: str = ""
    """Field of :class:`~xreset.eval.engines.measure.Measured`."""
    resolution: float = 0.0
    absolute: bool = False
    shown_unit: str = ""
    of_cameras: bool = False
    scaled: dict[str, float] = field(default_factory=dict)
    fixed: dict[str, Any] = field(default_factory=dict)

    @property
    def option(self) -> str:
        """Name of the property in options and in files of sweeps."""
        return self.name.replace(" ", "-")

    @property
    def changed_field(self) -> str:
        """Field of the task's randomization."""
        return self.task_field or self.name.replace(" ", "_")

    def shown(self, value: float) -> str:
        """Return a measured number as text, in ``shown_unit``."""
        scale = 1e3 if self.shown_unit in ("mm", "ms") else 1.0
        return f"{value * scale:.3g} {self.shown_unit}".rstrip()

    def set_in(self, task: TaskConfig, value: float) -> TaskConfig:
        """Return the task with the property at one value.

        Raises:
            XResetError: the property cannot have the value.
        """
        drawn = value
        if self.unit == "ms":
            drawn /= 1000 * task.control_dt  # the task counts control steps
        try:
            changed = replace(task.randomization, **{self.changed_field: (drawn, drawn)})
            return replace(task, randomization=changed)
        except ValueError as error:
            raise self.impossible(value, error) from None

    def impossible(self, value: float, error: ValueError) -> XResetError:
        """Return the error that the property cannot have a value."""
        return XResetError(f"{self.option} {amount(self.unit, value)} cannot be tried: {error}.")


def amount(unit: str, value: float) -> str:
    """Return a value with its unit, such as ``33 ms`` or ``x 0.7``."""
    number = f"{float(f'{value:.3g}'):g}"
    return f"x {number}" if unit == "x" else f"{number} {unit}"


TABLE = tomllib.loads(Path(__file__).with_name("properties.toml").read_text())
"""The tables ``properties`` and ``faults``, by name of the row."""


def _rows(table: str) -> tuple[Property, ...]:
    """Return the rows of a table, in its order."""
    rows = []
    for name, row in TABLE[table].items():
        values = tuple(row.get("values", ()))
        rows.append(Property(**row | {"name": name, "values": values}))
    return tuple(rows)


PROPERTIES = _rows("properties")
FAULTS = _rows("faults")
"""Faults between a policy and a robot."""
SWEEPS = tuple(p for p in PROPERTIES if p.values)
"""The properties that can be swept."""
COMPARED = {p.name: p for p in PROPERTIES if p.measured}
"""The properties in which engines are compared, by name."""
_PHYSICAL = {prop.name: prop for prop in SWEEPS}
REHEARSED: tuple[Property, ...] = (
    *FAULTS,
    _PHYSICAL["object mass"],
    _PHYSICAL["object friction"],
    replace(_PHYSICAL["force gain"], values=(0.0, 0.5, 2.0)),
)
"""Faults and physical properties of a rehearsal, in the order of its page. A force gain of 0 is a robot that does not
measure forces."""


def chosen(
    wanted: str | Sequence[str], properties: Sequence[Property] = SWEEPS
) -> tuple[Property, ...]:
    """Return the wanted properties, given as ``NAME`` or ``NAME=VALUE,VALUE...``; all if ``wanted`` is empty.

    Raises:
        XResetError: a property is unknown, or a value is impossible.
    """
    known = {prop.option: prop for prop in properties}
    found = []
    for text in (wanted,) if isinstance(wanted, str) else wanted:
        name, _, values = text.partition("=")
        name = name.replace("_", "-")
        if name not in known:
            raise XResetError(f"Unknown property {name!r}. Choose from: {', '.join(known)}.")
        prop = known[name]
        if values:
            prop = replace(prop, values=_values(text, values, prop))
        found.append(prop)
    return tuple(found or properties)


def _values(text: str, values: str, prop: Property) -> tuple[float, ...]:
    try:
        numbers = sorted({float(v) for v in values.split(",")} - {prop.nominal})
    except ValueError:
        raise XResetError(
            f"{text!r} holds values that are not numbers. Write {prop.option}=VALUE,VALUE..."
        ) from None
    if not numbers or not all(0 <= v < math.inf for v in numbers):
        raise XResetError(
            f"{text!r}: expected finite values of at least 0, other than the nominal {prop.nominal:g}."
        )
    return tuple(numbers)


def nominal_task(task: TaskConfig) -> TaskConfig:
    """Return the task without random draws, so that :meth:`Property.set_in` can set its properties."""
    r = task.randomization
    middle = sum(r.friction) / 2
    still = RandomizationConfig(
        friction=(middle, middle),
        mass_scale=(1.0, 1.0),
        elastomer=r.elastomer,
        metal=r.metal,
        table=r.table,
    )
    return replace(task, randomization=still)
