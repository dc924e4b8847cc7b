"""Conditions of an experiment: a physical property with a value, a fault between policy and robot, or nothing.

``properties.toml`` lists what ``xreset stress`` can change.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xreset.errors import XResetError
from xreset.files.checks import frozen
from xreset.files.text import texts
from xreset.task.config import RandomizationConfig, TaskConfig

if TYPE_CHECKING:  # a command checks names of properties before it loads torch
    from xreset.live.faults import Faults
    from xreset.physics import Capability


@frozen
class Condition:
    """What differs from an evaluation."""

    task: TaskConfig
    """The task that is played."""
    property: str = ""
    """Name of the property as in options; empty: nothing is changed."""
    value: float | None = None
    faults: Faults | None = None
    """Faults between policy and robot."""


@frozen
class Property:
    """One physical property, or one fault. The fields are explained in ``properties.toml``."""

    name: str
    task_field: str = ""
    values: tuple[float, ...] = ()
    nominal: float = 1.0
    unit: str = "x"
    most: float = 1000.0
    needs: Capability | None = None
    in_steps: bool = False
    of_cameras: bool = False
    on_robot: bool = False
    scaled: dict[str, float] = field(default_factory=dict)
    fixed: dict[str, Any] = field(default_factory=dict)

    @property
    def option(self) -> str:
        """Name of the property in options and in files."""
        return self.name.replace(" ", "-")

    @property
    def is_fault(self) -> bool:
        """Whether it is a fault, which only the control loop of a robot can have."""
        return bool(self.scaled)

    @property
    def changed_field(self) -> str:
        """Field of the task's randomization."""
        return self.task_field or self.name.replace(" ", "_")

    def amount(self, value: float) -> str:
        """Return a value with its unit, such as ``0.033 s`` or ``x 0.7``."""
        number = f"{float(f'{value:.3g}'):g}"
        return f"x {number}" if self.unit == "x" else f"{number} {self.unit}".rstrip()

    def at(self, value: float, task: TaskConfig) -> Condition:
        """Return the condition that the property has a value and everything else is as in a task. Images are late by
        whole control steps, so the nearest of them is the value of their latency.

        Raises:
            XResetError: the property cannot have the value.
        """
        faults = None
        try:
            if self.is_fault:
                faults = self._faults(value)
            else:
                drawn = value / task.control_dt if self.in_steps else value
                if self.in_steps and self.of_cameras:
                    drawn = max(1.0, float(round(drawn)))
                    value = round(drawn * task.control_dt, 3)
                changed = replace(task.randomization, **{self.changed_field: (drawn, drawn)})
                task = replace(task, randomization=changed)
        except ValueError as error:
            raise XResetError(
                f"{self.option} {self.amount(value)} cannot be tried: {error}."
            ) from None
        return Condition(task=task, property=self.option, value=value, faults=faults)

    def _faults(self, value: float) -> Faults:
        from xreset.live.faults import Faults

        sizes: dict[str, Any] = {name: factor * value for name, factor in self.scaled.items()}
        return Faults(**self.fixed, **sizes)


def _properties() -> tuple[Property, ...]:
    table = tomllib.loads(Path(__file__).with_name("properties.toml").read_text())
    rows = []
    for name, row in table["properties"].items():
        values = tuple(row.get("values", ()))
        rows.append(Property(**row | {"name": name, "values": values}))
    return tuple(rows)


PROPERTIES = _properties()
SWEPT = tuple(p for p in PROPERTIES if not p.is_fault)
"""Physical properties."""
FAULTS = tuple(p for p in PROPERTIES if p.is_fault or p.on_robot)
"""Faults between a policy and a robot, and physical properties that are tried with them."""
_BY_OPTION = {p.option: p for p in PROPERTIES}


def property_of(option: str) -> Property:
    """Return the property of a name in files; one that this version does not know has no unit."""
    return _BY_OPTION.get(option) or Property(name=option.replace("-", " "), unit="")


def chosen_properties(
    wanted: str | Sequence[str], default: Sequence[Property] = SWEPT
) -> tuple[Property, ...]:
    """Return the wanted properties, given as ``NAME`` or ``NAME=VALUE,VALUE...``; ``default`` if ``wanted`` is empty.

    Raises:
        XResetError: a property is unknown, or a value is impossible.
    """
    found: dict[str, Property] = {}
    for text in texts(wanted):
        name, equals, values = text.partition("=")
        name = name.replace("_", "-")
        if name not in _BY_OPTION:
            raise XResetError(f"Unknown property {name!r}. Choose from: {', '.join(_BY_OPTION)}.")
        prop = _BY_OPTION[name]
        if equals:
            prop = replace(prop, values=_values(text, values, prop))
        if name in found:  # the values of both
            prop = replace(prop, values=tuple(sorted({*prop.values, *found[name].values})))
        found[name] = prop
    return tuple(found.values()) or tuple(default)


def plays_on_robot(properties: str | Sequence[str], faults: bool) -> bool:
    """Return whether a robot's control loop plays: faults are asked for, or a property is one; see
    :func:`chosen_properties` for errors."""
    return any(prop.is_fault for prop in chosen_properties(properties)) or faults


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
    if numbers[-1] > prop.most:
        raise XResetError(
            f"{text!r}: {numbers[-1]:g} is too much. Give {prop.unit}, at most {prop.most:g}."
        )
    return tuple(numbers)


def nominal_task(task: TaskConfig) -> TaskConfig:
    """Return the task without random draws, so that :meth:`Property.at` can set its properties."""
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
