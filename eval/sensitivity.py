"""How a change of the world changes a policy's score, and the physical properties that are changed.

Sweeps (:mod:`xreset.eval.stress`), rehearsals (:mod:`xreset.eval.rehearse`) and the attribution to differences of
engines (:mod:`xreset.eval.engines.attribution`) share both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from xreset.errors import XResetError
from xreset.eval.rollout import Episode
from xreset.eval.stats import bootstrap_ci95, mean_of_known
from xreset.physics import Capability
from xreset.task.config import RandomizationConfig, TaskConfig

Interval = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Task progress of some episodes, and its difference to the same episodes as they are; intervals of 95 %."""

    task_progress: float
    ci95: Interval
    difference: float
    difference_ci95: Interval
    published_success: float | None = None
    """Share of the episodes that succeed in the sense of the published paper; None: an earlier version did not measure
    it."""

    @classmethod
    def of(cls, episodes: Sequence[Episode], nominal: Sequence[Episode]) -> Effect:
        """Compare episodes one by one; whole demonstrations are drawn for the intervals."""
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
        """Whether the interval of the difference leaves out zero."""
        low, high = self.difference_ci95
        return low > 0 or high < 0


@dataclass(frozen=True, kw_only=True)
class Property:
    """One physical property. One without ``values`` is not swept; one without ``measured`` is not compared."""

    name: str
    task_field: str = ""
    """Field of :class:`~xreset.task.config.RandomizationConfig` that sets it; default: the name."""
    values: tuple[float, ...] = ()
    """Values of a sweep, ascending, without the nominal one."""
    nominal: float = 1.0
    """Value of an evaluation; of the frictions, with the default materials."""
    unit: str = "x"
    """Unit of the values; ``x`` for a factor."""
    needs: Capability | None = None
    """What an engine must be able to set."""
    measured: str = ""
    """Field of :class:`~xreset.eval.engines.measure.Measured`."""
    resolution: float = 0.0
    """Differences of engines below this cannot be measured: a share of the larger value, with ``absolute`` a number."""
    absolute: bool = False
    shown_unit: str = ""
    """Unit in which the measured number is shown."""
    of_cameras: bool = False
    """Whether only policies that see have the property."""

    @property
    def option(self) -> str:
        """Name of the property in options and in files of sweeps."""
        return self.name.replace(" ", "-")

    @property
    def field(self) -> str:
        """Field of the task's randomization."""
        return self.task_field or self.name.replace(" ", "_")

    def shown(self, value: float) -> str:
        """Return a measured number in the unit in which it reads best."""
        scale = 1e3 if self.shown_unit in ("mm", "ms") else 1.0
        return f"{value * scale:.3g} {self.shown_unit}".rstrip()

    def set_in(self, task: TaskConfig, value: float) -> TaskConfig:
        """Return the task with the property at one value.

        Raises:
            XResetError: the property cannot have the value.
        """
        if self.unit == "ms":
            value /= 1000 * task.timestep * task.substeps  # the task counts control steps
        try:
            return replace(task, randomization=replace(task.randomization, **{self.field: (value, value)}))
        except ValueError as error:
            raise XResetError(f"{self.option} {amount(self.unit, value)} cannot be tried: {error}.") from None


def amount(unit: str, value: float) -> str:
    """Return a value with its unit, such as ``33 ms`` or ``x 0.7``."""
    number = f"{float(f'{value:.3g}'):g}"
    return f"x {number}" if unit == "x" else f"{number} {unit}"


def _drive(part: str, name: str, resolution: float) -> Property:
    return Property(
        name=f"{part} {name}",
        values=(0.6, 0.8, 1.25, 1.6),
        needs="drives",
        measured=f"{part}_{name}",
        resolution=resolution,
    )


def _friction(pair: str, material: str) -> Property:
    return Property(
        name=f"{pair} friction",
        task_field=material,
        needs="friction",
        measured=f"{pair}_friction",
        resolution=0.03,
    )


def _camera(name: str, values: tuple[float, ...], unit: str) -> Property:
    return Property(
        name=f"camera {name}", values=values, nominal=1.0 if unit == "x" else 0.0, unit=unit, of_cameras=True
    )


PROPERTIES = (
    _friction("tip", "elastomer"),
    _friction("link", "metal"),
    _friction("table", "table"),
    Property(
        name="object friction",
        task_field="friction",
        values=(0.4, 0.55, 0.95, 1.2),
        nominal=0.75,
        unit="coefficient",
        needs="friction",
    ),
    Property(name="hand friction", values=(0.4, 0.8), nominal=0.1, unit="coefficient", needs="friction"),
    Property(
        name="torsional friction",
        values=(0.0, 0.3, 2.0),
        needs="torsional_friction",
        measured="torsional_friction",
        resolution=5e-5,
        absolute=True,
        shown_unit="mm",
    ),
    Property(
        name="object mass",
        task_field="mass_scale",
        values=(0.5, 0.7, 1.3, 2.0),
        needs="object_mass",
        measured="mass",
        resolution=0.005,
    ),
    Property(name="object inertia", values=(0.5, 2.0), needs="object_inertia", measured="inertia", resolution=0.02),
    Property(name="object com", values=(0.005, 0.01, 0.02), nominal=0.0, unit="m", needs="object_com"),
    _drive("arm", "stiffness", 0.02),
    _drive("arm", "damping", 0.02),
    _drive("hand", "stiffness", 0.03),
    _drive("hand", "damping", 0.02),
    Property(name="effort", values=(0.4, 0.6, 0.8), needs="drives"),
    Property(name="timestep", measured="timestep", resolution=0.05, shown_unit="ms"),
    Property(name="contact softness", measured="contact_give", resolution=2e-5, absolute=True, shown_unit="mm"),
    Property(
        name="action latency",
        values=(0.5, 1.0, 2.0),
        nominal=0.0,
        unit="control steps",
        measured="delay",
        resolution=0.5,
        absolute=True,
        shown_unit="control steps",
    ),
    Property(name="observation latency", values=(0.5, 1.0, 2.0), nominal=0.0, unit="control steps"),
    Property(name="force gain", values=(0.5, 2.0)),
    _camera("shift", (0.01, 0.03), "m"),
    _camera("turn", (0.035, 0.087), "rad"),
    _camera("noise", (2.0,), "x"),
    _camera("latency", (50.0,), "ms"),
)
"""In the order of tables."""

SWEEPS = tuple(p for p in PROPERTIES if p.values)
"""The properties that can be swept."""
COMPARED = {p.name: p for p in PROPERTIES if p.measured}
"""The properties in which engines are compared, by name."""


def chosen(wanted: Sequence[str], properties: Sequence[Property] = SWEEPS) -> tuple[Property, ...]:
    """Return some of the properties, by ``NAME`` or ``NAME=VALUE,VALUE...``; all if nothing is wanted.

    Raises:
        XResetError: a property is unknown, or a value is impossible.
    """
    known = {prop.option: prop for prop in properties}
    found = []
    for text in wanted:
        name, _, values = text.partition("=")
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
        raise XResetError(f"{text!r} holds values that are no numbers. Write {prop.option}=VALUE,VALUE...") from None
    if not numbers or not all(0 <= v < math.inf for v in numbers):
        raise XResetError(f"{text!r}: expected finite values of at least 0, other than the nominal {prop.nominal:g}.")
    return tuple(numbers)


def nominal_task(task: TaskConfig) -> TaskConfig:
    """Return an evaluation's task in which :meth:`Property.set_in` can set properties: nothing is drawn at random."""
    r = task.randomization
    middle = sum(r.friction) / 2
    still = RandomizationConfig(
        friction=(middle, middle), mass_scale=(1.0, 1.0), elastomer=r.elastomer, metal=r.metal, table=r.table
    )
    return replace(task, randomization=still)
