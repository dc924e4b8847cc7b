"""Attribute the difference between a policy's scores in two engines to their physical properties.

The policy plays in engine A, in A with one property of B at a time, in A with all of these properties, and in B. Every
run plays the same episodes from the same starts, so runs are compared episode by episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, Literal

import numpy as np
from rich.table import Table

from xreset.errors import XResetError
from xreset.eval.engines.measure import measure
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.results import Episode
from xreset.eval.rollout import Engine, Trial, nominal_scene, roll_out
from xreset.eval.sensitivity import COMPARED, Effect, Property, nominal_task
from xreset.eval.table import success_text
from xreset.files.checks import frozen
from xreset.files.progress import NamedProgress, unseen
from xreset.physics.plugins import backend_class
from xreset.task.config import TaskConfig

SCHEMA = "xreset-attribution/2"

_METRICS = (
    "approach",
    "grasp",
    "reorient",
    "reorientation_progress",
    "nonfinite",
    "overflow",
    "out_of_bounds",
)

Kind = Literal["as it is", "towards", "all", "other"]


@frozen
class Row:
    """One run of the policy."""

    kind: Kind
    """``as it is``: A. ``towards``: A with one property of B. ``all``: A with all of these properties. ``other``: B."""
    name: str
    """Name of the property or of the engine."""
    episodes: tuple[Episode, ...]
    effect: Effect
    """Task progress, and its difference to A as it is."""

    def mean(self, metric: str) -> float:
        """Mean of one metric over the episodes."""
        return float(np.mean([float(getattr(e, metric)) for e in self.episodes]))


@frozen
class Attribution:
    """The outcome of :func:`attribute`."""

    a: str
    b: str
    measured: dict[str, tuple[float, float]]
    """Property -> its values in A and in B; NaN where it could not be measured."""
    rows: tuple[Row, ...]
    """The first is A as it is, the last B."""
    skipped: dict[str, str]
    """Property that was not tried -> reason."""

    @property
    def gap(self) -> Effect:
        """The difference between B and A."""
        return self.rows[-1].effect

    def share(self, row: Row) -> float:
        """Return the run's share of the gap; NaN if the interval of the gap includes zero."""
        return row.effect.difference / self.gap.difference if self.gap.is_certain else math.nan

    def costs(self) -> Row | None:
        """Return the run with the one changed property that has the largest share of the gap, among the runs whose
        difference is certain; None if there are none."""
        found = []
        for row in self.rows:
            if row.kind == "towards" and row.effect.is_certain and self.share(row) > 0:
                found.append(row)
        return max(found, key=self.share, default=None)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of ``attribution.json``."""
        properties = []
        for name, values in self.measured.items():
            a, b = map(_number, values)
            properties.append({"name": name, "a": a, "b": b, "not_tried": self.skipped.get(name)})
        costly = self.costs()
        return {
            "schema": SCHEMA,
            "a": self.a,
            "b": self.b,
            "episodes": len(self.rows[0].episodes),
            "properties": properties,
            "rows": [self._row(row) for row in self.rows],
            "costs_most": None if costly is None else costly.name,
        }

    def _row(self, row: Row) -> dict[str, Any]:
        means = {metric: round(row.mean(metric), 6) for metric in _METRICS}
        share = _number(self.share(row))
        return {
            "kind": row.kind,
            "name": row.name,
            **vars(row.effect),
            "share_of_gap": share,
            **means,
        }


def _number(value: float) -> float | None:
    return float(f"{value:.6g}") if math.isfinite(value) else None


def attribute(
    policy: PolicySpec,
    a: Engine,
    b: Engine,
    trial: Trial,
    *,
    episodes: int,
    only: Sequence[str] = (),
    progress: NamedProgress = unseen,
) -> Attribution:
    """Measure both engines, and play the policy in A, in A changed towards B, and in B.

    Args:
        policy: the policy.
        a: engine that is changed.
        b: engine towards which A is changed.
        trial: what is played; the mass and inertia of its first object are measured.
        episodes: episodes of each demonstration.
        only: names of the properties to try; empty: all.
        progress: called with (name of the run, control steps done, control steps in all).

    Raises:
        XResetError: a property is unknown, an engine cannot be measured, or the seed chose this checkpoint.
    """
    policy.check_seed(trial.seed)
    if unknown := sorted(set(only) - set(COMPARED)):
        raise XResetError(
            f"Unknown property {', '.join(unknown)}. Choose from: {', '.join(COMPARED)}."
        )
    scene = nominal_scene(trial.robot, trial.objects, trial.task)
    found = []
    for each in (a, b):
        progress(f"measuring {each.name}", 0, 0)
        found.append(measure(each, scene))
    measured = {
        name: (getattr(found[0], prop.measured), getattr(found[1], prop.measured))
        for name, prop in COMPARED.items()
    }
    rows: list[Row] = []

    def run(kind: Kind, name: str, engine: Engine, task: TaskConfig) -> None:
        label = name if kind in ("as it is", "other") else f"{a.name}, {name}"
        played = roll_out(
            policy.start(trial.motion),
            engine,
            replace(trial, task=task),
            episodes=episodes,
            progress=partial(progress, label),
        ).episodes
        effect = Effect.of(played, rows[0].episodes if rows else played)
        rows.append(Row(kind=kind, name=name, episodes=played, effect=effect))

    nominal = nominal_task(trial.task)
    run("as it is", a.name, a, nominal)
    everything = nominal
    skipped: dict[str, str] = {}
    for name, prop in COMPARED.items():
        if only and name not in only:
            skipped[name] = "not asked for"
            continue
        change = change_towards(prop, *measured[name], nominal, a.name)
        if isinstance(change, str):
            skipped[name] = change
            continue
        run("towards", name, a, change)
        both = change_towards(prop, *measured[name], everything, a.name)
        assert not isinstance(both, str), "a property can be changed alone, but not with others"
        everything = both
    changed = len(rows) - 1
    if changed > 1:
        run("all", f"all {changed} at once", a, everything)
    run("other", b.name, b, nominal)
    return Attribution(
        a=a.name,
        b=b.name,
        measured=measured,
        rows=tuple(rows),
        skipped=skipped,
    )


def change_towards(
    prop: Property, a: float, b: float, task: TaskConfig, engine: str
) -> TaskConfig | str:
    """Return the task in which a property of engine A has the value of engine B, or a text that says why there is none.

    A pair's friction is the mean of two materials, of which the one that is not the object's is changed. Other
    properties are changed by the factor B / A. MuJoCo's contacts, which count time in timesteps, become stiffer with a
    finer timestep, and its friction becomes harder below 1/200 s.

    Args:
        prop: the property.
        a: value that was measured in A.
        b: value that was measured in B.
        task: task from :func:`~xreset.eval.sensitivity.nominal_task`.
        engine: name of A.
    """
    unknown = [which for which, value in (("A", a), ("B", b)) if not math.isfinite(value)]
    if unknown:
        return f"could not be measured in {' and '.join(unknown)}"
    if abs(a - b) < prop.resolution * (1.0 if prop.absolute else max(abs(a), abs(b))):
        return "the same in both, within the resolution of the measurement"
    if prop.needs is not None and prop.needs not in backend_class(engine).capabilities:
        return f"cannot be set in {engine}"
    if prop.name == "timestep":
        substeps = max(1, round(task.substeps * a / b))
        if substeps == task.substeps:
            return f"with {substeps} physics steps per control step, no other timestep comes nearer"
        return replace(task, timestep=task.control_dt / substeps, substeps=substeps)
    if a <= 0:
        return f"there is none in {engine}, so no factor leads to the other value"
    ratio = max(b, 0.0) / a
    if prop.needs != "friction":
        return prop.set_in(task, ratio)
    material = task.randomization.friction[0]
    other = ratio * (material + getattr(task.randomization, prop.changed_field)) - material
    if other < 0:
        return "less than half of the object's own coefficient, which no other material gives"
    return replace(task, randomization=replace(task.randomization, **{prop.changed_field: other}))


# For a terminal -------------------------------------------------------------------------------------------------------


def rich_table(found: Attribution, title: str) -> Table:
    """Return a table with a row for each run. A row is bold if the interval of its difference to A excludes zero."""
    table = Table("", title=title, title_justify="left")
    names = (
        "value",
        "task progress",
        "grasp",
        "reorient",
        "published success",
        f"against {found.a}",
        "of gap",
    )
    for name in names:
        table.add_column(name, justify="right")
    for row in found.rows:
        effect = row.effect
        low, high = effect.ci95
        least, most = effect.difference_ci95
        share = found.share(row)
        values = " -> ".join(_shown(row.name, found)) if row.kind == "towards" else ""
        difference = ""
        share_text = ""
        if row is not found.rows[0]:
            difference = f"{100 * effect.difference:+.1f}\n{100 * least:+.1f} to {100 * most:+.1f}"
            share_text = "" if math.isnan(share) else f"{share:.0%}"
        table.add_row(
            row.name,
            values,
            f"{effect.task_progress:.1%}\n{100 * low:.0f}-{100 * high:.0f}",
            f"{row.mean('grasp'):.0%}",
            f"{row.mean('reorient'):.0%}",
            success_text(effect.published_success),
            difference,
            share_text,
            style="bold" if effect.is_certain else None,
        )
    return table


def _shown(name: str, found: Attribution) -> list[str]:
    """Return the measured values of a property in A and in B, as text."""
    shown = COMPARED[name].shown
    return [shown(value) if math.isfinite(value) else "unknown" for value in found.measured[name]]


def not_tried(found: Attribution) -> Iterator[str]:
    """Yield a line for each property that was not changed: its value in both engines, and the reason."""
    for name, reason in found.skipped.items():
        a, b = _shown(name, found)
        yield f"not tried: {name} ({a} in {found.a}, {b} in {found.b}): {reason}"


def verdict(found: Attribution) -> str:
    """Return the result in a sentence or two."""
    low, high = found.gap.difference_ci95
    size = f"{100 * found.gap.difference:+.1f} points of task progress ({100 * low:+.1f} to {100 * high:+.1f})"
    if not found.gap.is_certain:
        return (
            f"{found.b} and {found.a} do not differ for sure: {size} over {len(found.rows[0].episodes)} episodes. "
            "There is nothing to attribute. More episodes would show smaller differences."
        )
    row = found.costs()
    if row is None:
        return (
            f"{found.b} differs from {found.a} by {size}, and none of the properties that could be changed explains "
            "it."
        )
    best = f"{row.name!r} alone brings about {found.share(row):.0%} of it"
    for together in found.rows:
        if together.kind == "all":
            best += f", {together.name} {found.share(together):.0%}"
    return f"{found.b} differs from {found.a} by {size}; {best}."
