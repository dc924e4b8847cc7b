"""Effects of conditions on a policy: group-bys of a table of episodes, the verdict about a robot, and their picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, pairwise
from typing import TYPE_CHECKING

import numpy as np

from xreset.eval.conditions import Property, property_of
from xreset.eval.plots import COLORS, svg
from xreset.eval.results import EvalResult
from xreset.eval.stats import Interval, Table, bootstrap_ci95, least_p, mean
from xreset.files.checks import frozen

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COSTLY = 0.10
"""Loss of task progress that ends the range in which a policy counts as robust."""
CRITERIA = (
    ("pose-delay", 0.2, 0.03),
    ("action-delay", 0.067, 0.04),
    ("action-delay", 0.133, 0.10),
    ("published-faults", 1.0, 0.10),
)
"""Fault, its value, and the largest acceptable loss of task progress. The values are those of the published training;
the losses are this project's choice."""
LEAST = 0.5
"""Least task progress without faults of a policy that may be tried on a robot."""


@frozen
class Effect:
    """Task progress of some episodes, and its difference to the same episodes unchanged, with the 95 % interval."""

    value: float
    """Value of the property."""
    task_progress: float
    difference: float
    difference_ci95: Interval
    demonstrations_suffice: bool
    """Whether there are enough demonstrations, six or more, to tell a loss from chance."""

    def loses_more_than(self, most: float) -> bool:
        """Whether the loss is above a number, and that is not chance."""
        return self.demonstrations_suffice and -self.difference_ci95[1] > most


def effect(episodes: Table, nominal: Table, value: float) -> Effect:
    """Compare episodes one by one with the same episodes unchanged. The interval is a bootstrap over demonstrations."""
    difference = episodes["task_progress"].to_numpy() - nominal["task_progress"].to_numpy()
    demonstrations = episodes["sequence"].to_numpy()
    return Effect(
        value=value,
        task_progress=mean(episodes, "task_progress"),
        difference=float(difference.mean()),
        difference_ci95=bootstrap_ci95(difference, demonstrations),
        demonstrations_suffice=least_p(difference, demonstrations) <= 0.05,
    )


@frozen
class Curve:
    """Task progress against one property in one engine."""

    property: Property
    points: tuple[Effect, ...]
    """In ascending order of the value, the nominal one included."""
    lower: float | None
    """Value below the nominal one at which ten points are lost, interpolated; None: no tried value loses them."""
    upper: float | None
    """The same above the nominal value."""

    def costs(self) -> str:
        """Return the values nearest to the nominal one that cost ten points, as text."""
        values = [value for value in (self.lower, self.upper) if value is not None]
        if not values:
            return "no tested value"
        chance = "" if all(self.loses_beyond(value) for value in values) else ", or chance"
        amounts = [self.property.amount(float(f"{value:.2g}")) for value in values]
        return " and ".join(amounts) + chance

    def loses_beyond(self, limit: float) -> bool:
        """Whether the loss at the first value beyond a limit is more than chance."""
        if limit < self.property.nominal:
            beyond = [p for p in self.points if p.value <= limit]
        else:
            beyond = [p for p in self.points if p.value >= limit]
        nearest = min(beyond, key=lambda p: abs(p.value - limit))
        return nearest.loses_more_than(0.0)


def curves(result: EvalResult) -> list[Curve]:
    """Return the curve of each property that an experiment changed in one engine, in the order of the episodes."""
    found = []
    for name, own in result.changed.groupby("property", sort=False):
        prop = property_of(str(name))
        points = [effect(result.nominal, result.nominal, prop.nominal)]
        for value, episodes in own.groupby("value"):
            points.append(effect(episodes, result.nominal, float(value)))  # pyright: ignore[reportArgumentType]
        points.sort(key=lambda point: point.value)
        curve = Curve(
            property=prop,
            points=tuple(points),
            lower=_limit([p for p in reversed(points) if p.value <= prop.nominal]),
            upper=_limit([p for p in points if p.value >= prop.nominal]),
        )
        found.append(curve)
    return found


def _limit(outwards: Sequence[Effect]) -> float | None:
    """Return the value at which ten points are lost, interpolated; None if none of the points loses as much. The points
    are in order from the nominal value outwards."""
    for near, far in pairwise(outwards):
        if far.difference <= -COSTLY < near.difference:
            share = (near.difference + COSTLY) / (near.difference - far.difference)
            return near.value + share * (far.value - near.value)
    return None


def by_property(results: Sequence[EvalResult]) -> dict[str, list[Curve | None]]:
    """Return the curve of each property in each engine; None where the engine cannot set it."""
    found: dict[str, list[Curve | None]] = {}
    for i, result in enumerate(results):
        for curve in curves(result):
            found.setdefault(curve.property.option, [None] * len(results))[i] = curve
    return found


# The verdict about a robot --------------------------------------------------------------------------------------------


def verdict(results: Sequence[EvalResult]) -> tuple[str, list[str]]:
    """Return a sentence that says whether the policy may be tried on a robot, and the reasons against it; nothing if no
    fault that decides was tried at any value.

    It may if every engine shows at least :data:`LEAST` without faults, and no loss beyond :data:`CRITERIA`, over enough
    demonstrations.
    """
    against = []
    unsure = []
    tried = 0
    few = False
    for result in results:
        progress = result.mean("task_progress")
        if progress < LEAST:
            against.append(f"{result.engine}: only {100 * progress:.0f} % without any fault.")
        for curve, point, most in _deciding_points(result):
            tried += 1
            few = few or not point.demonstrations_suffice
            if -point.difference <= most:
                continue
            low, high = (-100 * bound for bound in reversed(point.difference_ci95))
            text = (
                f"{result.engine}: {curve.property.name} {curve.property.amount(point.value)} costs "
                f"{-100 * point.difference:.1f} points (95 %: {round(low)} to {round(high)}). "
                f"At most {100 * most:.0f} are wanted."
            )
            reasons = against if point.loses_more_than(most) else unsure
            reasons.append(text)
    changed = set(chain.from_iterable(result.changed["property"].unique() for result in results))
    if not changed & {option for option, _, _ in CRITERIA}:
        return "", []
    sentence = "Ready for a first, careful trial on a robot."
    if against:
        sentence = "Not ready for a robot."
    elif unsure:
        sentence = "Not shown to be ready: some losses may be too large. Play more demonstrations."
    elif tried < len(CRITERIA) * len(results):
        sentence = "No verdict: not every fault that decides was tried."
    elif few:
        sentence = "Not shown to be ready by fewer than six demonstrations. Play more (--demos)."
    return sentence, [*against, *unsure]


def _deciding_points(result: EvalResult) -> Iterator[tuple[Curve, Effect, float]]:
    """Yield the curve, the point and the largest acceptable loss of each of the :data:`CRITERIA` that was tried."""
    found = {curve.property.option: curve for curve in curves(result)}
    for option, value, most in CRITERIA:
        for point in found[option].points if option in found else ():
            if point.value == value:
                yield found[option], point, most


# The picture ----------------------------------------------------------------------------------------------------------

_COLUMNS = 4


def picture(results: Sequence[EvalResult], salt: str) -> str:
    """Return the drawing of task progress against each property that was changed, a line for each engine, as SVG;
    ``salt`` as of :func:`~xreset.eval.plots.svg`."""
    found = by_property(results)
    width = max(2.9 * min(_COLUMNS, len(found)), 5.0)  # [inches]
    height = 0.8 + 2.3 * math.ceil(len(found) / _COLUMNS)
    return svg(lambda figure: _draw_all(figure, results, found), (width, height), f"sweep {salt}")


def _draw_all(
    figure: Figure, results: Sequence[EvalResult], found: Mapping[str, Sequence[Curve | None]]
) -> None:
    columns = min(_COLUMNS, len(found))
    axes = figure.subplots(math.ceil(len(found) / columns), columns, squeeze=False, sharey=True)
    for ax in axes.flat[len(found) :]:
        ax.set_visible(False)
    for ax, (name, of_engines) in zip(axes.flat, found.items(), strict=False):
        ax.set_title(name)
        ax.set_ylim(0, 100)
        for result, curve, color in zip(results, of_engines, COLORS, strict=False):
            nominal = result.mean("task_progress")
            ax.axhline(100 * (nominal - COSTLY), color=color, linewidth=0.7, linestyle="--")
            if curve is not None:
                _draw(ax, result.engine, nominal, curve, color)
    axes[0, 0].legend(loc="lower left", fontsize=8)
    for row in axes:
        row[0].set_ylabel("task progress [%]")


def _draw(ax: Axes, engine: str, nominal: float, curve: Curve, color: str) -> None:
    x = [p.value for p in curve.points]
    ends = np.array([p.difference_ci95 for p in curve.points]).T
    progress = [100 * p.task_progress for p in curve.points]
    ax.fill_between(x, *(100 * (nominal + ends)), color=color, alpha=0.15, linewidth=0)
    ax.plot(x, progress, color=color, marker="o", markersize=3, label=engine)
    ax.axvline(curve.property.nominal, color="grey", linewidth=0.7, linestyle=":")
    ax.set_xlabel("factor" if curve.property.unit == "x" else curve.property.unit)
    ax.locator_params(axis="x", nbins=5)
