"""Learning curves: the amount of training at each iteration, the mean curves of several trainings, and their drawing.

The seconds of an iteration are its logged ``speed/collect_seconds`` + ``speed/learn_seconds``, and its steps are these
seconds times ``speed/env_steps_per_second``, over all processes. Pauses before a run is continued, iterations that were
lost and repeated, and the time before the first iteration do not count. An iteration without a log counts like the
next one with a log.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import ceil
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd

from xreset.eval.plots import COLORS, INK, svg
from xreset.eval.report.groups import Groups
from xreset.eval.report.read import Training
from xreset.eval.stats import Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

X = Literal["minutes", "steps", "iterations"]
"""Measure of the length of a training."""
AXES: dict[X, tuple[str, int]] = {
    "minutes": ("minutes of training", 1),
    "steps": ("million environment steps", 1),
    "iterations": ("iterations of training", 0),
}
"""Label of a measure, and digits in tables."""
_SPEED = ["speed/collect_seconds", "speed/learn_seconds", "speed/env_steps_per_second"]
CURVES = {
    "task/success": "at the goal",
    "task/success_from_home": "at the goal, from home",
    "task/grasped": "thumb and a finger press",
    "episode/return": "episode return",
}
"""Curve that a report draws if a training has it, as TensorBoard names it -> title of its panel."""
_STYLES = ("-", (0, (5, 2)), (0, (1, 1.5)), (0, (5, 2, 1, 2)))
"""Line styles; the next one begins when the colors repeat: at the ninth training, the seventeenth, and so on."""
_WIDTH = 10.6
"""Width of the drawing [inches]."""
_PANEL = 2.7
"""Height of a row of panels [inches]."""
_COLUMNS = 2
"""Panels in a row."""


def usual_axis(trainings: Sequence[Training]) -> X:
    """Return minutes if every training logged its speed, else iterations."""
    logged = [training for training in trainings if len(training.curves)]
    is_known = all(amounts(training, "minutes") is not None for training in logged)
    return "minutes" if is_known else "iterations"


def amounts(training: Training, x: X) -> Table | None:
    """Return the amount of ``x`` after each iteration, in the unit of :data:`AXES`; the index is the iteration, rising.
    None: the training did not log its speed, by which minutes and steps are known.
    """
    curves = training.curves
    if x == "iterations":
        return pd.Series(curves.index.to_numpy(float), index=curves.index)
    if any(tag not in curves for tag in _SPEED):
        return None
    speed = curves[_SPEED].dropna()
    seconds = speed[_SPEED[0]] + speed[_SPEED[1]]
    each = seconds / 60 if x == "minutes" else seconds * speed[_SPEED[2]] * 1e-6
    return (each * np.diff(speed.index, prepend=0)).cumsum()


def line(members: Sequence[Training], tag: str, x: X) -> Table | None:
    """Return the curve of one training; or mean, minimum and maximum of several, in the range that all have logged.

    Trainings without such a curve, or whose ``x`` is not known, are left out; None if no training is left.

    Returns:
        Columns mean, low and high; the index is the amount of ``x``, rising.
    """
    curves = []
    for training in members:
        values = training.curves.get(tag, pd.Series()).dropna()
        done = amounts(training, x)
        if len(values) and done is not None:  # a training that broke down logs no number
            curves.append((np.interp(values.index, done.index, done), values))
    if not curves:
        return None
    at = max((own for own, _ in curves), key=len)
    start = max(own[0] for own, _ in curves)
    end = min(own[-1] for own, _ in curves)
    at = at[(at >= start) & (at <= end)]
    values = np.stack([np.interp(at, own, value) for own, value in curves])
    return pd.DataFrame(
        {"mean": values.mean(axis=0), "low": values.min(axis=0), "high": values.max(axis=0)},
        index=at,
    )


# The drawing ---------------------------------------------------------------------------------------------------------


def color(index: int) -> str:
    """Return the color of an engine or a training."""
    return COLORS[index % len(COLORS)]


def draw_training(groups: Groups, x: X) -> str:
    """Return the drawing of :data:`CURVES` as SVG, a panel for each; empty if no training has one.

    Args:
        groups: the groups, each with a color of its own.
        x: horizontal axis of the curves.
    """
    logged: set[str] = set()
    for members in groups.values():
        logged = logged.union(*(member.curves for member in members))
    tags = [tag for tag in CURVES if tag in logged]
    if not tags:
        return ""
    order = list(groups)
    rows = ceil(len(tags) / _COLUMNS)

    def draw(figure: Figure) -> None:
        from matplotlib.lines import Line2D

        panels = figure.subplots(rows, min(len(tags), _COLUMNS), squeeze=False).flat
        for ax in panels[len(tags) :]:
            ax.set_axis_off()
        for ax, tag in zip(panels, tags, strict=False):
            lines = {label: line(members, tag, x) for label, members in groups.items()}
            known = {label: curve for label, curve in lines.items() if curve is not None}
            draw_lines(ax, tag, known, x, order)
        if len(order) > 1:
            handles = []
            for i, label in enumerate(order):
                look = {"color": color(i), "linestyle": _style(i)}
                # matplotlib leaves out labels that begin with an underscore
                handles.append(Line2D([], [], linewidth=2.5, label=f" {label}", **look))
            figure.legend(handles=handles, loc="outside upper center", ncols=3, frameon=False)

    legend = 0.1 + 0.25 * ceil(len(order) / 3) if len(order) > 1 else 0.0
    return svg(draw, (_WIDTH, _PANEL * rows + legend), "curves")


def draw_lines(ax: Axes, tag: str, lines: Mapping[str, Table], x: X, order: Sequence[str]) -> None:
    """Draw one line for each group, with a band from ``low`` to ``high`` where they differ. Curves of the task are
    shares, and are drawn in percent.

    Args:
        ax: axes to draw in.
        tag: name of the curve.
        lines: label -> :func:`line`.
        x: kind of the horizontal axis.
        order: labels of all groups: the position decides the color.
    """
    percent = tag.startswith("task/")
    for label, curve in lines.items():
        index = order.index(label)
        values = curve * (100 if percent else 1)
        at = curve.index
        if (curve["high"] > curve["low"]).any():
            ax.fill_between(
                at, values["low"], values["high"], color=color(index), linewidth=0, alpha=0.2
            )
        # Above the axis, because many curves stay at zero.
        look: dict[str, Any] = {"marker": "o" if len(at) < 10 else "", "markersize": 4, "zorder": 3}
        ax.plot(
            at, values["mean"], color=color(index), linestyle=_style(index), linewidth=1.5, **look
        )
    ax.set_title(CURVES[tag], fontsize="medium", loc="left")
    ax.grid(axis="y", color=INK, alpha=0.12)
    if percent:
        ax.yaxis.set_major_formatter(lambda value, _: f"{value:g} %")
    ax.set_xlabel(AXES[x][0])
    ax.set_xlim(left=0)
    if percent:
        ax.set_ylim(bottom=0)


def _style(index: int) -> Any:
    """Return the line style of a training."""
    return _STYLES[index // len(COLORS) % len(_STYLES)]
