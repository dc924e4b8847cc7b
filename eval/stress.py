"""Measure how robust a policy is: play the same episodes while one property of the world is swept over a range.

A property is a field of the task's randomization that is held at one value, so every property that a training can draw
at random can be swept. Everything else is as in an evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np

from xreset.errors import XResetError
from xreset.eval.plots import COLORS, picture
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.results import Episode, check_name
from xreset.eval.rollout import Engine, Trial, roll_out
from xreset.eval.sensitivity import SWEEPS, Effect, Property, amount, nominal_task
from xreset.eval.stats import Interval
from xreset.files.checks import frozen
from xreset.files.progress import NamedProgress, unseen
from xreset.files.storage import claim_folder, read_typed, write_json
from xreset.physics.plugins import backend_class

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SCHEMA = "xreset-stress/1"
COSTLY = 0.10
"""Loss of task progress that ends the range in which a policy counts as robust."""


@frozen
class Point(Effect):
    """Task progress with one property at one value."""

    value: float


@frozen
class Curve:
    """Task progress against one property in one engine."""

    property: str
    unit: str
    nominal: float
    points: tuple[Point, ...]
    """In ascending order of the value, the nominal one included."""
    lower: float | None
    """Value below the nominal one at which ten points are lost, interpolated; None: no tried value loses them."""
    upper: float | None
    """The same above the nominal value."""

    def costs(self) -> str:
        """Return the values nearest to the nominal one that cost ten points, as text."""
        values = [value for value in (self.lower, self.upper) if value is not None]
        if not values:
            return "none that was tried"
        chance = "" if all(self.loses_beyond(value) for value in values) else ", or chance"
        return " and ".join(amount(self.unit, float(f"{value:.2g}")) for value in values) + chance

    def loses_beyond(self, limit: float) -> bool:
        """Whether the loss at the first value beyond a limit is more than chance."""
        if limit < self.nominal:
            beyond = [p for p in self.points if p.value <= limit]
        else:
            beyond = [p for p in self.points if p.value >= limit]
        nearest = min(beyond, key=lambda p: abs(p.value - limit))
        return nearest.difference_ci95[1] < 0


@frozen
class Stress:
    """Contents of ``stress/ENGINE.json``: a policy's curves in one engine."""

    RENAMED: ClassVar = {"backend": "engine", "backend_version": "engine_version"}
    schema: str = SCHEMA
    policy: str = ""
    robot: str = ""
    seed: int = 0
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the files of policy and demonstrations."""
    engine: str
    engine_version: str
    episodes: int
    task_progress: float
    ci95: Interval
    published_success: float | None = None
    """None: an earlier version did not measure it."""
    curves: tuple[Curve, ...]
    left_out: tuple[str, ...]
    """Properties that the engine cannot set."""


Card = TypeVar("Card", bound=Stress)


def stress(
    policy: PolicySpec,
    trial: Trial,
    engines: Sequence[Engine],
    out: Path,
    *,
    sweeps: Sequence[Property] = SWEEPS,
    episodes: int = 2,
    progress: NamedProgress = unseen,
) -> list[Stress]:
    """Sweep properties in each engine, and write ``OUT/BACKEND.json`` when an engine has played all of them.

    Args:
        policy: the policy.
        trial: what is played, from :func:`~xreset.eval.rollout.load_trial`.
        engines: the engines.
        out: folder for the results.
        sweeps: properties and values.
        episodes: episodes of each demonstration, the same for every value.
        progress: called with (engine, runs done, runs in all).

    Returns:
        The results that were written, in the order of the engines.

    Raises:
        PolicyError: the seed chose this checkpoint.
        XResetError: a property cannot have a value, or another command is writing there; nothing was played then.
    """
    policy.check_seed(trial.seed)
    if not trial.task.vision.cameras:
        sweeps = [prop for prop in sweeps if not prop.of_cameras]
        if not sweeps:
            raise XResetError(
                f"The policy {policy.name!r} has no cameras to change. Choose other properties."
            )
    task = nominal_task(trial.task)
    for prop in sweeps:
        for value in prop.values:
            prop.set_in(task, value)

    def play(engine: Engine, prop: Property | None, value: float) -> tuple[Episode, ...]:
        changed = replace(trial, task=prop.set_in(task, value) if prop else task)
        player = policy.start(trial.motion)
        return roll_out(player, engine, changed, episodes=episodes).episodes

    found = []
    with claim_folder(out):
        for engine in engines:
            found.append(sweep(Stress, policy, trial, engine, sweeps, play, out, progress))
            write_card(out, found[-1])
    return found


def sweep(
    card_type: type[Card],
    policy: PolicySpec,
    trial: Trial,
    engine: Engine,
    properties: Sequence[Property],
    play: Callable[[Engine, Property | None, float], Sequence[Episode]],
    out: Path,
    progress: NamedProgress,
) -> Card:
    """Play episodes with each value of the properties that an engine can set, and return the results (the card).

    ``ENGINE.partial`` has the results so far, in case that the command is stopped; :func:`write_card` removes it.

    Args:
        card_type: type of the card.
        policy: policy that the card names.
        trial: trial whose robot, seed and inputs the card states.
        engine: where episodes are played.
        properties: properties and values.
        play: plays the episodes in an engine with one property at a value; None instead of a property: unchanged.
        out: folder of the card.
        progress: called with (engine, runs done, runs in all).
    """
    able = backend_class(engine.name).capabilities
    usable = [prop for prop in properties if prop.needs is None or prop.needs in able]
    total = 1 + sum(len(prop.values) for prop in usable)
    done = 1
    nominal = play(engine, None, 1.0)
    progress(engine.name, done, total)
    as_is = Effect.of(nominal, nominal)
    card = card_type(
        policy=policy.name,
        robot=trial.robot.name,
        seed=trial.seed,
        inputs=trial.inputs,
        engine=engine.name,
        engine_version=engine.version,
        episodes=len(nominal),
        task_progress=as_is.task_progress,
        ci95=as_is.ci95,
        published_success=as_is.published_success,
        curves=(),
        left_out=tuple(prop.option for prop in properties if prop not in usable),
    )
    for prop in usable:
        swept = {}
        for value in prop.values:
            swept[value] = play(engine, prop, value)
            done += 1
            progress(engine.name, done, total)
        card = replace(card, curves=(*card.curves, curve(prop, nominal, swept)))
        write_json(out / f"{engine.name}.partial", asdict(card))
    return card


def write_card(folder: Path, card: Stress) -> None:
    """Write complete results as ``ENGINE.json``."""
    write_json(folder / f"{card.engine}.json", asdict(card))
    (folder / f"{card.engine}.partial").unlink(missing_ok=True)


def read_stress(folder: Path, policy: str | None = None) -> tuple[Stress, ...]:
    """Read the results ``FOLDER/ENGINE.json``, in order of name; none if the folder does not exist.

    Args:
        folder: folder that ``xreset stress`` wrote.
        policy: SHA-256 of a policy; results of another policy, or of an earlier checkpoint, are left out. None: all
            results.

    Raises:
        FileFormatError: a file is damaged, or of another version.
    """
    found = []
    for path in sorted(folder.glob("*.json")):
        card = read_typed(Stress, path, SCHEMA)
        check_name(path, card.engine)
        found.append(card)
    return tuple(
        card for card in found if policy is None or card.inputs.get("policy", policy) == policy
    )


def curve(
    prop: Property, nominal: Sequence[Episode], swept: dict[float, Sequence[Episode]]
) -> Curve:
    """Return the curve of a property: the episodes of each value, compared with the nominal ones."""
    every = {prop.nominal: nominal} | swept
    points = tuple(Point(value=v, **vars(Effect.of(every[v], nominal))) for v in sorted(every))
    return Curve(
        property=prop.option,
        unit=prop.unit,
        nominal=prop.nominal,
        points=points,
        lower=_limit([p for p in reversed(points) if p.value <= prop.nominal]),
        upper=_limit([p for p in points if p.value >= prop.nominal]),
    )


def _limit(outwards: Sequence[Point]) -> float | None:
    """Return the value at which ten points are lost, interpolated; None if none of the points loses as much. The points
    are in order from the nominal value outwards."""
    for near, far in pairwise(outwards):
        if far.difference <= -COSTLY < near.difference:
            share = (near.difference + COSTLY) / (near.difference - far.difference)
            return near.value + share * (far.value - near.value)
    return None


def write_plot(path: Path, found: Sequence[Stress], title: str) -> None:
    """Draw task progress against each property, a line for each engine, as a picture."""
    with picture(path, plot_size(found)) as figure:
        draw_curves(figure, found)
        note = "(shaded: difference to the nominal value, 95 %; dashed: ten points less)"
        figure.suptitle(f"{title}\n{note}", fontsize="small", fontweight="bold")


def by_property(found: Sequence[Stress]) -> dict[str, list[Curve | None]]:
    """Return the curve of each property in each engine; None where the engine cannot set it."""
    curves: dict[str, list[Curve | None]] = {}
    for i, card in enumerate(found):
        for each in card.curves:
            curves.setdefault(each.property, [None] * len(found))[i] = each
    return curves


_COLUMNS = 4


def plot_size(found: Sequence[Stress]) -> tuple[float, float]:
    """Return the size of the drawing of :func:`draw_curves` [inches]."""
    count = len(by_property(found))
    width = max(2.9 * min(_COLUMNS, count), 5.0)
    height = 0.8 + 2.3 * math.ceil(count / _COLUMNS)
    return width, height


def draw_curves(figure: Figure, found: Sequence[Stress]) -> None:
    """Draw task progress against each property, a line for each engine; nothing if no engine can set any of them."""
    curves = by_property(found)
    if not curves:
        return
    columns = min(_COLUMNS, len(curves))
    axes = figure.subplots(math.ceil(len(curves) / columns), columns, squeeze=False, sharey=True)
    for ax in axes.flat[len(curves) :]:
        ax.set_visible(False)
    for ax, name in zip(axes.flat, curves, strict=False):
        ax.set_title(name)
        ax.set_ylim(0, 100)
        for card, each, color in zip(found, curves[name], COLORS, strict=False):
            ax.axhline(
                100 * (card.task_progress - COSTLY), color=color, linewidth=0.7, linestyle="--"
            )
            if each is not None:
                _draw(ax, card, each, color)
    axes[0, 0].legend(loc="lower left", fontsize=8)
    for row in axes:
        row[0].set_ylabel("task progress [%]")


def _draw(ax: Axes, card: Stress, curve: Curve, color: str) -> None:
    x = [p.value for p in curve.points]
    ends = np.array([p.difference_ci95 for p in curve.points]).T
    mean = [100 * p.task_progress for p in curve.points]
    ax.fill_between(x, *(100 * (card.task_progress + ends)), color=color, alpha=0.15, linewidth=0)
    ax.plot(x, mean, color=color, marker="o", markersize=3, label=card.engine)
    ax.axvline(curve.nominal, color="grey", linewidth=0.7, linestyle=":")
    ax.set_xlabel("factor" if curve.unit == "x" else curve.unit)
    ax.locator_params(axis="x", nbins=5)
