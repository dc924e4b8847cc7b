"""How a change of the world changes a policy's score, and the physical properties that are changed.

Sweeps (:mod:`xreset.eval.stress`) and the attribution to differences of engines
(:mod:`xreset.eval.engines.attribution`) share both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xreset.eval.rollout import Episode
from xreset.eval.stats import bootstrap_ci95, mean_of_known
from xreset.physics import Capability

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
    def of(cls, episodes: Sequence[Episode], nominal: Sequence[Episode], metric: str = "task_progress") -> Effect:
        """Compare episodes one by one; whole demonstrations are drawn for the intervals."""
        score = np.array([float(getattr(e, metric)) for e in episodes])
        difference = score - np.array([float(getattr(e, metric)) for e in nominal])
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
    """One physical property. No task can set one without ``task_field``; one without ``measured`` is not measured."""

    name: str
    task_field: str = ""
    """Field of :class:`~xreset.task.config.RandomizationConfig` that a sweep holds at one value."""
    values: tuple[float, ...] = ()
    """Values of a sweep, ascending, without the nominal one."""
    nominal: float = 1.0
    """Value of an evaluation; of the frictions, with the default materials."""
    unit: str = "x"
    """Unit of the values; ``x`` for a factor."""
    needs: Capability | None = None
    """What an engine must be able to set in a sweep."""
    measured: str = ""
    """Field of :class:`~xreset.eval.engines.measure.Measured`."""
    resolution: float = 0.0
    """Differences of engines below this cannot be measured: a share of the larger value, with ``absolute`` a number."""
    absolute: bool = False
    shown_unit: str = ""
    """Unit in which the measured number is shown."""
    scale: float = 1.0
    """Factor from the measured number to that unit."""
    altered: str = ""
    """Field of :class:`~xreset.eval.engines.alteration.Alteration`."""
    what_if: tuple[float, ...] = ()
    """Changes of a usual size, which show how much a skill depends on the property."""
    of_cameras: bool = False
    """Whether only policies that see have the property."""
    at_most: str = ""
    """Why the possible change goes farther than the other engine does, so that its cost is a bound; else empty."""

    @property
    def option(self) -> str:
        """Name of the property in options and in files of sweeps."""
        return self.name.replace(" ", "-")


_SCALES = (0.6, 0.8, 1.25, 1.6)


def _friction(name: str) -> Property:
    return Property(
        name=f"{name} friction",
        measured=f"{name}_friction",
        resolution=0.03,
        altered=f"{name}_friction",
        what_if=(0.8,),
    )


def _drive(part: str, name: str, resolution: float) -> Property:
    field = f"{part}_{name}"
    return Property(
        name=f"{part} {name}",
        task_field=field,
        values=_SCALES,
        needs="drives",
        measured=field,
        resolution=resolution,
        altered=field,
        what_if=(0.8,),
    )


def _camera(name: str, values: tuple[float, ...], unit: str) -> Property:
    nominal = 1.0 if unit == "x" else 0.0
    field = f"camera_{name}"
    return Property(name=f"camera {name}", task_field=field, values=values, nominal=nominal, unit=unit, of_cameras=True)


PROPERTIES = (
    _friction("tip"),
    _friction("link"),
    _friction("table"),
    Property(
        name="object friction",
        task_field="friction",
        values=(0.4, 0.55, 0.95, 1.2),
        nominal=0.75,
        unit="coefficient",
        needs="friction",
    ),
    Property(
        name="hand friction",
        task_field="hand_friction",
        values=(0.4, 0.8),
        nominal=0.1,
        unit="coefficient",
        needs="friction",
    ),
    Property(
        name="torsional friction",
        task_field="torsional_friction",
        values=(0.0, 0.3, 2.0),
        needs="torsional_friction",
        measured="torsional_friction",
        resolution=5e-5,
        absolute=True,
        shown_unit="mm",
        scale=1e3,
        altered="torsional_friction",
        what_if=(0.0, 2.0),
    ),
    Property(
        name="patch torsional friction",
        measured="patch_torsional_friction",
        resolution=0.05,
        absolute=True,
        at_most="changed in every contact, where the engines differ only beside a second point",
    ),
    Property(
        name="object mass",
        task_field="mass_scale",
        values=(0.5, 0.7, 1.3, 2.0),
        needs="object_mass",
        measured="mass",
        resolution=0.005,
        altered="mass",
        what_if=(1.2,),
    ),
    Property(
        name="object inertia",
        task_field="object_inertia",
        values=(0.5, 2.0),
        needs="object_inertia",
        measured="inertia",
        resolution=0.02,
        altered="inertia",
        what_if=(1.2,),
    ),
    Property(
        name="object com",
        task_field="object_com",
        values=(0.005, 0.01, 0.02),
        nominal=0.0,
        unit="m",
        needs="object_com",
    ),
    _drive("arm", "stiffness", 0.02),
    _drive("arm", "damping", 0.02),
    _drive("hand", "stiffness", 0.03),
    _drive("hand", "damping", 0.02),
    Property(name="effort", task_field="effort", values=(0.4, 0.6, 0.8), needs="drives"),
    Property(
        name="timestep",
        measured="timestep",
        resolution=0.05,
        shown_unit="ms",
        scale=1e3,
        altered="timestep",
        what_if=(0.5,),
    ),
    Property(
        name="contact softness",
        measured="contact_give",
        resolution=2e-5,
        absolute=True,
        shown_unit="mm",
        scale=1e3,
        altered="contact_time",
        what_if=(1.5,),
    ),
    Property(
        name="latency",
        measured="delay",
        resolution=0.5,
        absolute=True,
        shown_unit="control steps",
        altered="delay",
        what_if=(1,),
    ),
    Property(
        name="action latency", task_field="action_latency", values=(0.5, 1.0, 2.0), nominal=0.0, unit="control steps"
    ),
    Property(
        name="observation latency",
        task_field="observation_latency",
        values=(0.5, 1.0, 2.0),
        nominal=0.0,
        unit="control steps",
    ),
    Property(name="force gain", task_field="force_gain", values=(0.5, 2.0)),
    _camera("shift", (0.01, 0.03), "m"),
    _camera("turn", (0.035, 0.087), "rad"),
    _camera("noise", (2.0,), "x"),
    _camera("latency", (3.0,), "control steps"),
)
"""In the order of tables."""

SWEEPS = tuple(p for p in PROPERTIES if p.task_field)
"""The properties that can be swept."""
COMPARED = {p.name: p for p in PROPERTIES if p.measured}
"""The properties in which engines are compared, by name."""
