"""What a policy bears: the same episodes while one property of the world at a time is swept over a range.

A property is a field of the task's randomisation, held at one value: what a training may draw at random and what is tried here are one
list. Everything else is as in an evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from xreset.checks import from_dict
from xreset.errors import XResetError
from xreset.eval.plots import COLORS, picture
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.rollout import Episode, roll_out
from xreset.eval.stats import bootstrap_ci95
from xreset.eval.trial import Engine, Trial
from xreset.files import read_json, write_json
from xreset.physics import Capability
from xreset.plugins import backend_class
from xreset.task.config import RandomizationConfig, TaskConfig

SCHEMA = "xreset-stress/1"
COSTLY = 0.10
"""Task progress whose loss a stress card calls the limit of what a policy bears."""


@dataclass(frozen=True, kw_only=True)
class Property:
    """Something that may differ from what a policy is evaluated with."""

    name: str
    field: str
    """Of :class:`~xreset.task.config.RandomizationConfig`."""
    values: tuple[float, ...]
    """Swept by default, ascending; the nominal value is not among them."""
    nominal: float = 1.0
    unit: str = "x"
    needs: Capability | None = None
    """What an engine must be able to do."""


_SCALES = (0.6, 0.8, 1.25, 1.6)
PROPERTIES = (
    Property(name="arm-stiffness", field="arm_stiffness", values=_SCALES, needs="drives"),
    Property(name="arm-damping", field="arm_damping", values=_SCALES, needs="drives"),
    Property(name="hand-stiffness", field="hand_stiffness", values=_SCALES, needs="drives"),
    Property(name="hand-damping", field="hand_damping", values=_SCALES, needs="drives"),
    Property(name="effort", field="effort", values=(0.4, 0.6, 0.8), needs="drives"),
    Property(name="action-latency", field="action_latency", values=(0.5, 1.0, 2.0), nominal=0.0, unit="control steps"),
    Property(
        name="observation-latency",
        field="observation_latency",
        values=(0.5, 1.0, 2.0),
        nominal=0.0,
        unit="control steps",
    ),
    Property(name="force-gain", field="force_gain", values=(0.5, 2.0)),
    Property(
        name="object-friction",
        field="friction",
        values=(0.4, 0.55, 0.95, 1.2),
        nominal=0.75,
        unit="coefficient",
        needs="friction",
    ),
    Property(
        name="hand-friction",
        field="hand_friction",
        values=(0.4, 0.8),
        nominal=0.1,
        unit="coefficient",
        needs="friction",
    ),
    Property(name="torsional-friction", field="torsional_friction", values=(0.0, 0.3, 2.0), needs="torsional_friction"),
    Property(name="object-inertia", field="object_inertia", values=(0.5, 2.0), needs="object_inertia"),
    Property(
        name="object-com", field="object_com", values=(0.005, 0.01, 0.02), nominal=0.0, unit="m", needs="object_com"
    ),
    Property(name="object-mass", field="mass_scale", values=(0.5, 0.7, 1.3, 2.0), needs="object_mass"),
)
"""What can be swept. Nominal values of the frictions are those of an evaluation with the default materials."""


@dataclass(frozen=True, kw_only=True)
class Point:
    """Task progress with one property at one value."""

    value: float
    task_progress: float
    ci95: tuple[float, float]
    difference: float
    """To the same episodes as they are."""
    difference_ci95: tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Task progress against one property in one engine."""

    property: str
    unit: str
    nominal: float
    points: tuple[Point, ...]
    """In ascending order of the value, the nominal one included."""
    lower: float | None
    """Value below the nominal one at which ten points are lost, between two that were tried; None: none that was tried loses so much."""
    upper: float | None
    """The same above it."""

    def bears(self) -> str:
        """The range in which fewer than ten points are lost, as far as was tried."""
        low, high = self.points[0].value, self.points[-1].value
        below = (
            f"from {self.lower:.2g}"
            if self.lower is not None
            else f"from {low:g} or less"
            if low < self.nominal
            else ""
        )
        above = (
            f"up to {self.upper:.2g}"
            if self.upper is not None
            else f"up to {high:g} or more"
            if high > self.nominal
            else ""
        )
        return " ".join(filter(None, (below, above, "" if self.unit == "x" else self.unit)))

    def is_certain(self, limit: float) -> bool:
        """Whether the loss that a limit comes from is more than chance: its interval leaves out zero."""
        beyond = [p for p in self.points if (p.value <= limit if limit < self.nominal else p.value >= limit)]
        return min(beyond, key=lambda p: abs(p.value - limit)).difference_ci95[1] < 0


@dataclass(frozen=True, kw_only=True)
class Stress:
    """A policy's curves in one engine."""

    backend: str
    backend_version: str
    episodes: int
    task_progress: float
    ci95: tuple[float, float]
    curves: tuple[Curve, ...]
    left_out: tuple[str, ...]
    """Properties that the engine cannot set."""

    def sentence(self) -> str:
        """What it bears, in one line: the smallest changes that cost ten points, those that may, and how many properties cost less."""
        costs: dict[bool, list[tuple[float, str]]] = {True: [], False: []}
        for curve in self.curves:
            for value in (curve.lower, curve.upper):
                if value is not None:
                    size = abs(math.log(value)) if curve.unit == "x" else math.inf
                    costs[curve.is_certain(value)].append((size, f"{curve.property} {_amount(curve.unit, value)}"))
        sure, perhaps = (
            ", or ".join(text for _, text in sorted(costs[certain], key=lambda c: c[0])) for certain in (True, False)
        )
        borne = sum(curve.lower is None and curve.upper is None for curve in self.curves)
        points = f"{100 * COSTLY:.0f} points"
        parts = [f"{points} less with {sure}"] if sure else []
        parts += [f"perhaps {points} less, within chance, with {perhaps}"] if perhaps else []
        parts += (
            [f"fewer than {points} less with {borne} of {len(self.curves)} properties, as far as was tried"]
            if borne
            else []
        )
        return f"{self.backend}, {self.episodes} episodes: {'; '.join((f'{100 * self.task_progress:.0f} %', *parts))}."


def _amount(unit: str, *values: float) -> str:
    """A value of a property, or the range between two."""
    text = " to ".join(f"{float(f'{v:.2g}'):g}" for v in values)
    return f"x {text}" if unit == "x" else f"of {text} {unit}"


def chosen(wanted: Sequence[str]) -> tuple[Property, ...]:
    """Properties by ``NAME`` or ``NAME=VALUE,VALUE...``; all for none.

    Raises:
        XResetError: there is no such property, or a value cannot be.
    """
    known = {p.name: p for p in PROPERTIES}
    found = []
    for text in wanted:
        name, _, values = text.partition("=")
        if name not in known:
            raise XResetError(f"there is no property {name!r}. Properties: {', '.join(known)}.")
        prop = known[name]
        if values:
            try:
                numbers = sorted({float(v) for v in values.split(",")} - {prop.nominal})
            except ValueError:
                raise XResetError(
                    f"{text!r} states values that are no numbers, expected {name}=VALUE,VALUE..."
                ) from None
            if not numbers or not all(0 <= v < float("inf") for v in numbers):
                raise XResetError(
                    f"{text!r}: expected finite values, 0 or more, other than the nominal one, which is {prop.nominal:g}."
                )
            prop = replace(prop, values=tuple(numbers))
        found.append(prop)
    return tuple(found) or PROPERTIES


def stressed(task: TaskConfig, prop: Property | None = None, value: float = 1.0) -> TaskConfig:
    """An evaluation's task with one property at a value, and nothing drawn at random; None: as evaluations are.

    Raises:
        XResetError: the property cannot have the value.
    """
    r = task.randomization
    middle = sum(r.friction) / 2
    still = RandomizationConfig(
        friction=(middle, middle), mass_scale=(1.0, 1.0), elastomer=r.elastomer, metal=r.metal, table=r.table
    )
    if prop is not None:
        try:
            return replace(task, randomization=replace(still, **{prop.field: (value, value)}))
        except ValueError as error:
            raise XResetError(f"{prop.name} {_amount(prop.unit, value)} cannot be tried: {error}.") from None
    return replace(task, randomization=still)


def stress(
    policy: PolicySpec,
    trial: Trial,
    engines: Sequence[Engine],
    out: Path,
    *,
    properties: Sequence[Property] = PROPERTIES,
    repetitions: int = 2,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[Stress]:
    """Sweep properties in each engine and write ``OUT/BACKEND.json``, after each property anew: one that is stopped keeps what it has.

    Args:
        trial: what is played, from :func:`~xreset.eval.trial.load_trial`.
        repetitions: episodes per demonstration, the same for every value.
        progress: called with (engine, runs done, runs in all).

    Returns:
        What was written, in the order of the engines.
    """
    policy.check_seed(trial.seed)
    tasks = {
        (p.name, v): stressed(trial.task, p, v) for p in properties for v in p.values
    }  # all are checked before the first is played
    about: dict[str, Any] = {
        "schema": SCHEMA,
        "policy": policy.name,
        "robot": trial.robot.name,
        "seed": trial.seed,
        "inputs": trial.inputs,
    }

    def keep(card: Stress) -> None:
        write_json(out / f"{card.backend}.json", about | asdict(card))

    found = []
    for engine in engines:
        able = backend_class(engine.name).capabilities
        usable = [p for p in properties if p.needs is None or p.needs in able]
        total = 1 + sum(len(p.values) for p in usable)

        def run(task: TaskConfig, engine: Engine = engine) -> tuple[Episode, ...]:
            return roll_out(
                policy.start(trial.motion), engine, replace(trial, task=task), repetitions=repetitions
            ).episodes

        nominal = run(stressed(trial.task))
        progress(engine.name, 1, total)
        score, groups = _scores(nominal)
        card = Stress(
            backend=engine.name,
            backend_version=engine.version,
            episodes=len(nominal),
            task_progress=float(score.mean()),
            ci95=bootstrap_ci95(score, groups),
            curves=(),
            left_out=tuple(p.name for p in properties if p not in usable),
        )
        keep(card)
        done = 1
        for p in usable:
            swept: dict[float, tuple[Episode, ...]] = {p.nominal: nominal}
            for value in p.values:
                swept[value] = run(tasks[p.name, value])
                done += 1
                progress(engine.name, done, total)
            card = replace(card, curves=(*card.curves, _curve(p, swept)))
            keep(card)
        found.append(card)
    return found


def read_stress(folder: Path) -> tuple[Stress, ...]:
    """The cards ``FOLDER/ENGINE.json``, in order of name; none if there is no such folder.

    Raises:
        FileFormatError: a file is damaged, or of another version.
    """
    names, found = {f.name for f in fields(Stress)}, []
    for path in sorted(folder.glob("*.json")):
        data = read_json(path, SCHEMA)
        found.append(from_dict(Stress, {name: value for name, value in data.items() if name in names}, str(path)))
    return tuple(found)


def _scores(episodes: Sequence[Episode]) -> tuple[np.ndarray, np.ndarray]:
    """[E] task progress and demonstration of each episode."""
    return np.array([e.task_progress for e in episodes]), np.array([e.sequence for e in episodes])


def _curve(prop: Property, swept: dict[float, tuple[Episode, ...]]) -> Curve:
    base, groups = _scores(swept[prop.nominal])
    points = []
    for value in sorted(swept):
        score, _ = _scores(swept[value])
        points.append(
            Point(
                value=value,
                task_progress=float(score.mean()),
                ci95=bootstrap_ci95(score, groups),
                difference=float((score - base).mean()),
                difference_ci95=bootstrap_ci95(score - base, groups),
            )
        )
    below = [p for p in reversed(points) if p.value <= prop.nominal]
    above = [p for p in points if p.value >= prop.nominal]
    return Curve(
        property=prop.name, unit=prop.unit, nominal=prop.nominal, points=tuple(points), lower=_limit(below), upper=_limit(above)
    )  # fmt: skip


def _limit(outwards: Sequence[Point]) -> float | None:
    """Where ten points are lost on the way from the nominal value outwards, on the line between two values that were tried."""
    for near, far in pairwise(outwards):
        if far.difference <= -COSTLY < near.difference:
            share = (near.difference + COSTLY) / (near.difference - far.difference)
            return near.value + share * (far.value - near.value)
    return None


def write_plot(path: Path, found: Sequence[Stress], title: str) -> None:
    """Draw task progress against each property, a line for each engine."""
    names = list(dict.fromkeys(curve.property for stress in found for curve in stress.curves))
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    with picture(path, (max(2.9 * columns, 5.0), 0.8 + 2.3 * rows), dpi=110, font_size=9) as figure:
        axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
        for ax, name in zip(axes.flat, names, strict=False):
            for stress, color in zip(found, COLORS, strict=False):
                for curve in (c for c in stress.curves if c.property == name):
                    x = [p.value for p in curve.points]
                    band = ([100 * (stress.task_progress + p.difference_ci95[i]) for p in curve.points] for i in (0, 1))
                    ax.fill_between(x, *band, color=color, alpha=0.15, linewidth=0)
                    ax.plot(
                        x,
                        [100 * p.task_progress for p in curve.points],
                        color=color,
                        marker="o",
                        markersize=3,
                        label=stress.backend,
                    )
                    ax.axvline(curve.nominal, color="grey", linewidth=0.7, linestyle=":")
                    ax.set_xlabel(curve.unit if curve.unit != "x" else "factor")
            ax.set_title(name)
            ax.set_ylim(0, 100)
        for ax in list(axes.flat)[len(names) :]:
            ax.set_visible(False)
        for stress, color in zip(found, COLORS, strict=False):
            for ax in list(axes.flat)[: len(names)]:
                ax.axhline(100 * (stress.task_progress - COSTLY), color=color, linewidth=0.7, linestyle="--")
        axes[0, 0].legend(loc="lower left", fontsize=8)
        for row in axes:
            row[0].set_ylabel("task progress [%]")
        figure.suptitle(
            f"{title}\n(shaded: difference to the nominal value, 95 %; dashed: ten points less)",
            fontsize="medium",
            fontweight="bold",
        )
