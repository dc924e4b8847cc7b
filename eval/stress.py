"""How robust a policy is: the same episodes while one property of the world at a time is swept over a range.

A property is a field of the task's randomization, held at one value: what a training may draw at random and what is
tried here are one list. Everything else is as in an evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from xreset.checks import from_dict
from xreset.errors import XResetError
from xreset.eval.plots import COLORS, picture
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.rollout import Episode, roll_out
from xreset.eval.sensitivity import SWEEPS, Effect, Interval, Property, amount, nominal_task
from xreset.eval.trial import Engine, Trial
from xreset.files import read_json, write_json
from xreset.plugins import backend_class

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCHEMA = "xreset-stress/1"
COSTLY = 0.10
"""Loss of task progress that limits the range in which a policy counts as robust."""


@dataclass(frozen=True, kw_only=True)
class Point(Effect):
    """Task progress with one property at one value."""

    value: float


@dataclass(frozen=True, kw_only=True)
class Curve:
    """Task progress against one property in one engine."""

    property: str
    unit: str
    nominal: float
    points: tuple[Point, ...]
    """In ascending order of the value, the nominal one included."""
    lower: float | None
    """Value below the nominal one at which ten points are lost, interpolated; None: no tried value loses as much."""
    upper: float | None
    """The same above the nominal value."""

    def tolerated(self) -> str:
        """Return the range in which fewer than ten points are lost, as far as was tried."""
        low = self.points[0].value
        high = self.points[-1].value
        words = []
        if self.lower is not None:
            words.append(f"from {self.lower:.2g}")
        elif low < self.nominal:
            words.append(f"from {low:g} or less")
        if self.upper is not None:
            words.append(f"up to {self.upper:.2g}")
        elif high > self.nominal:
            words.append(f"up to {high:g} or more")
        if self.unit != "x":
            words.append(self.unit)
        return " ".join(words)

    def is_certain(self, limit: float) -> bool:
        """Whether the loss at the first value beyond a limit is more than chance."""
        if limit < self.nominal:
            beyond = [p for p in self.points if p.value <= limit]
        else:
            beyond = [p for p in self.points if p.value >= limit]
        nearest = min(beyond, key=lambda p: abs(p.value - limit))
        return nearest.difference_ci95[1] < 0


@dataclass(frozen=True, kw_only=True)
class Stress:
    """Contents of ``stress/BACKEND.json``: a policy's curves in one engine."""

    schema: str = SCHEMA
    policy: str = ""
    robot: str = ""
    seed: int = 0
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the files of policy and demonstrations."""
    backend: str
    backend_version: str
    episodes: int
    task_progress: float
    ci95: Interval
    published_success: float | None = None
    """None: an earlier version did not measure it."""
    curves: tuple[Curve, ...]
    left_out: tuple[str, ...]
    """Properties that the engine cannot set."""

    @classmethod
    def of(cls, policy: PolicySpec, trial: Trial, place: Engine, nominal: Sequence[Episode], **rest: Any) -> Self:
        """Return the card of a policy in an engine.

        Args:
            nominal: episodes with nothing changed.
            rest: the fields that do not follow from them.
        """
        as_is = Effect.of(nominal, nominal)
        return cls(
            policy=policy.name,
            robot=trial.robot.name,
            seed=trial.seed,
            inputs=trial.inputs,
            backend=place.name,
            backend_version=place.version,
            episodes=len(nominal),
            task_progress=as_is.task_progress,
            ci95=as_is.ci95,
            published_success=as_is.published_success,
            **rest,
        )

    def sentence(self) -> str:
        """Return one line: the smallest changes that cost ten points, and how many properties cost less."""
        sure: list[tuple[float, str]] = []
        perhaps: list[tuple[float, str]] = []
        harmless = 0
        for curve in self.curves:
            limits = [value for value in (curve.lower, curve.upper) if value is not None]
            harmless += not limits
            for value in limits:
                size = abs(math.log(value)) if curve.unit == "x" else math.inf
                found = sure if curve.is_certain(value) else perhaps
                found.append((size, f"{curve.property} {amount(curve.unit, value)}"))
        points = f"{100 * COSTLY:.0f} points"
        parts = [f"{100 * self.task_progress:.0f} %"]
        if sure:
            parts.append(f"{points} less with {_smallest_first(sure)}")
        if perhaps:
            parts.append(f"perhaps {points} less, within chance, with {_smallest_first(perhaps)}")
        if harmless:
            parts.append(
                f"fewer than {points} less with {harmless} of {len(self.curves)} properties, as far as was tried"
            )
        return f"{self.backend}, {self.episodes} episodes: {'; '.join(parts)}."


def _smallest_first(costs: list[tuple[float, str]]) -> str:
    ordered = sorted(costs, key=lambda cost: cost[0])
    return ", or ".join(text for _, text in ordered)


def stress(
    policy: PolicySpec,
    trial: Trial,
    engines: Sequence[Engine],
    out: Path,
    *,
    sweeps: Sequence[Property] = SWEEPS,
    repetitions: int = 2,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[Stress]:
    """Sweep properties in each engine and write ``OUT/BACKEND.json`` after each property, so that a stopped command
    keeps its results.

    Args:
        policy: what is tried.
        trial: what is played, from :func:`~xreset.eval.trial.load_trial`.
        engines: where it is tried.
        out: folder for the results.
        sweeps: properties and values.
        repetitions: episodes of each demonstration, the same for every value.
        progress: called with (engine, runs done, runs in all).

    Returns:
        The results that were written, in the order of the engines.

    Raises:
        PolicyError: the seed chose this checkpoint.
        XResetError: a property cannot have a value; nothing was played then.
    """
    policy.check_seed(trial.seed)
    if not trial.task.vision.cameras:
        sweeps = [prop for prop in sweeps if not prop.of_cameras]
        if not sweeps:
            raise XResetError(f"The policy {policy.name!r} has no cameras to change. Choose other properties.")
    task = nominal_task(trial.task)
    for prop in sweeps:
        for value in prop.values:
            prop.set_in(task, value)
    found = []
    for engine in engines:
        able = backend_class(engine.name).capabilities
        usable = [prop for prop in sweeps if prop.needs is None or prop.needs in able]
        total = 1 + sum(len(prop.values) for prop in usable)
        done = 0

        def run(
            prop: Property | None, value: float, engine: Engine = engine, total: int = total
        ) -> tuple[Episode, ...]:
            nonlocal done
            changed = replace(trial, task=task if prop is None else prop.set_in(task, value))
            episodes = roll_out(policy.start(trial.motion), engine, changed, repetitions=repetitions).episodes
            done += 1
            progress(engine.name, done, total)
            return episodes

        nominal = run(None, 1.0)
        left_out = tuple(prop.option for prop in sweeps if prop not in usable)
        card = Stress.of(policy, trial, engine, nominal, curves=(), left_out=left_out)
        path = out / f"{engine.name}.json"
        write_json(path, asdict(card))
        for prop in usable:
            swept = {value: run(prop, value) for value in prop.values}
            card = replace(card, curves=(*card.curves, curve(prop, nominal, swept)))
            write_json(path, asdict(card))
        found.append(card)
    return found


def read_stress(folder: Path, policy: str | None = None) -> tuple[Stress, ...]:
    """Read the results ``FOLDER/ENGINE.json``, in order of name; none if there is no such folder.

    Args:
        folder: folder that ``xreset stress`` wrote.
        policy: SHA-256 of a policy; results of another policy, or of an earlier checkpoint, are left out. None: all
            results.

    Raises:
        FileFormatError: a file is damaged, or of another version.
    """
    found = [from_dict(Stress, read_json(path, SCHEMA), str(path)) for path in sorted(folder.glob("*.json"))]
    return tuple(card for card in found if policy is None or card.inputs.get("policy", policy) == policy)


def curve(prop: Property, nominal: Sequence[Episode], swept: dict[float, tuple[Episode, ...]]) -> Curve:
    """Compare the episodes of each value with the nominal ones."""
    every = {prop.nominal: nominal} | swept
    points = []
    for value in sorted(every):
        points.append(Point(value=value, **vars(Effect.of(every[value], nominal))))
    return Curve(
        property=prop.option,
        unit=prop.unit,
        nominal=prop.nominal,
        points=tuple(points),
        lower=_limit([p for p in reversed(points) if p.value <= prop.nominal]),
        upper=_limit([p for p in points if p.value >= prop.nominal]),
    )


def _limit(outwards: Sequence[Point]) -> float | None:
    """Return the value at which ten points are lost on the way outwards, between two values that were tried."""
    for near, far in pairwise(outwards):
        if far.difference <= -COSTLY < near.difference:
            share = (near.difference + COSTLY) / (near.difference - far.difference)
            return near.value + share * (far.value - near.value)
    return None


def write_plot(path: Path, found: Sequence[Stress], title: str) -> None:
    """Draw task progress against each property, a line for each engine, as a picture."""
    with picture(path, plot_size(found), dpi=110, font_size=9) as figure:
        draw_curves(figure, found)
        note = "(shaded: difference to the nominal value, 95 %; dashed: ten points less)"
        figure.suptitle(f"{title}\n{note}", fontsize="medium", fontweight="bold")


def _names(found: Sequence[Stress]) -> list[str]:
    names: list[str] = []
    for card in found:
        names += [curve.property for curve in card.curves if curve.property not in names]
    return names


def plot_size(found: Sequence[Stress]) -> tuple[float, float]:
    """Return the size of the drawing of :func:`draw_curves` [inches]."""
    columns = min(4, len(_names(found)))
    rows = math.ceil(len(_names(found)) / columns)
    return max(2.9 * columns, 5.0), 0.8 + 2.3 * rows


def draw_curves(figure: Figure, found: Sequence[Stress]) -> None:
    """Draw task progress against each property, a line for each engine."""
    names = _names(found)
    columns = min(4, len(names))
    rows = math.ceil(len(names) / columns)
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax, name in zip(axes.flat, names, strict=False):
        ax.set_title(name)
        ax.set_ylim(0, 100)
        for card, color in zip(found, COLORS, strict=False):
            ax.axhline(100 * (card.task_progress - COSTLY), color=color, linewidth=0.7, linestyle="--")
            for curve in card.curves:
                if curve.property == name:
                    _draw(ax, card, curve, color)
    axes[0, 0].legend(loc="lower left", fontsize=8)
    for row in axes:
        row[0].set_ylabel("task progress [%]")


def _draw(ax: Axes, card: Stress, curve: Curve, color: str) -> None:
    x = [p.value for p in curve.points]
    low = [100 * (card.task_progress + p.difference_ci95[0]) for p in curve.points]
    high = [100 * (card.task_progress + p.difference_ci95[1]) for p in curve.points]
    mean = [100 * p.task_progress for p in curve.points]
    ax.fill_between(x, low, high, color=color, alpha=0.15, linewidth=0)
    ax.plot(x, mean, color=color, marker="o", markersize=3, label=card.backend)
    ax.axvline(curve.nominal, color="grey", linewidth=0.7, linestyle=":")
    ax.set_xlabel("factor" if curve.unit == "x" else curve.unit)
