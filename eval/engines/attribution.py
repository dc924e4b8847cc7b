"""Attribute the difference between a policy's scores in two engines to their physical properties.

The policy plays in engine A, in A with one property of B at a time, in A with all of these properties, and in B. Every
run plays the same episodes from the same starts, so runs are compared episode by episode.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Literal

from rich.table import Table as RichTable

from xreset.errors import XResetError
from xreset.eval.conditions import COMPARED, Condition, Property, nominal_task, property_of
from xreset.eval.effects import Effect, effect
from xreset.eval.engines.measure import measure
from xreset.eval.experiment import can_set, play
from xreset.eval.metrics import METRICS
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.results import EvalResult
from xreset.eval.rollout import Engine, Trial, nominal_scene
from xreset.eval.stats import Table, mean
from xreset.files.checks import frozen
from xreset.files.progress import NamedProgress, unseen
from xreset.files.storage import claim_folder
from xreset.task.config import TaskConfig

ALL = "all"
"""Condition under which all properties that can be changed have B's values."""

Kind = Literal["as it is", "towards", "all", "other"]


@frozen
class Row:
    """Episodes of one condition."""

    kind: Kind
    """``as it is``: A. ``towards``: A with one property of B. ``all``: A with all of these properties. ``other``: B."""
    name: str
    """Name of the property or of the engine."""
    episodes: Table
    effect: Effect
    """Task progress, and its difference to A as it is."""


@frozen
class Attribution:
    """What :func:`attribute` found: a group-by of the results in both engines."""

    a: EvalResult
    """In A, also with properties of B."""
    b: EvalResult
    folder: Path | None = None
    """Folder of the files."""

    @cached_property
    def rows(self) -> tuple[Row, ...]:
        """The conditions; the first is A as it is, the last B."""
        parts: list[tuple[Kind, str, Table]] = [("as it is", self.a.engine, self.a.nominal)]
        changed = self.a.changed
        count = changed.loc[changed["property"] != ALL, "property"].nunique()
        for option, own in changed.groupby("property", sort=False):
            if option == ALL:
                parts.append(("all", f"all {count} at once", own))
            else:
                parts.append(("towards", property_of(str(option)).name, own))
        parts.append(("other", self.b.engine, self.b.nominal))
        return tuple(
            Row(kind=kind, name=name, episodes=own, effect=effect(own, self.a.nominal))
            for kind, name, own in parts
        )

    @property
    def gap(self) -> Effect:
        """The difference between B and A."""
        return self.rows[-1].effect

    def share(self, row: Row) -> float:
        """Return the row's share of the gap; NaN if the interval of the gap includes zero."""
        return row.effect.difference / self.gap.difference if self.gap.is_certain else math.nan

    def costs(self) -> Row | None:
        """Return the row with the one changed property that has the largest share of the gap, among the rows whose
        difference is certain; None if there are none."""
        found = []
        for row in self.rows:
            if row.kind == "towards" and row.effect.is_certain and self.share(row) > 0:
                found.append(row)
        return max(found, key=self.share, default=None)


def attribute(
    policy: PolicySpec,
    a: Engine,
    b: Engine,
    trial: Trial,
    out: Path,
    *,
    episodes: int,
    only: Sequence[str] = (),
    progress: NamedProgress = unseen,
) -> Attribution:
    """Measure both engines, play the policy in A, in A changed towards B, and in B, and write the results of both.

    Args:
        policy: the policy.
        a: engine that is changed.
        b: engine towards which A is changed.
        trial: what is played; the mass and inertia of its first object are measured.
        out: folder for the results.
        episodes: episodes of each demonstration.
        only: names of the properties to try; empty: all.
        progress: called with (name of the engine, conditions done, conditions in all).

    Raises:
        XResetError: a property is unknown, or an engine cannot be measured.
    """
    if unknown := sorted(set(only) - set(COMPARED)):
        raise XResetError(
            f"Unknown property {', '.join(unknown)}. Choose from: {', '.join(COMPARED)}."
        )
    scene = nominal_scene(trial.robot, trial.objects, trial.task)
    measured = []
    for each in (a, b):
        progress(f"measuring {each.name}", 0, 0)
        found = measure(each, scene)
        measured.append({name: getattr(found, prop.measured) for name, prop in COMPARED.items()})
    nominal = nominal_task(trial.task)
    conditions = [Condition(task=nominal)]
    everything = nominal
    left_out: dict[str, str] = {}
    for name, prop in COMPARED.items():
        if only and name not in only:
            left_out[prop.option] = "not asked for"
            continue
        values = (measured[0][name], measured[1][name])
        change = change_towards(prop, *values, nominal, a)
        if isinstance(change, str):
            left_out[prop.option] = change
            continue
        conditions.append(Condition(task=change, property=prop.option, value=values[1]))
        both = change_towards(prop, *values, everything, a)
        assert not isinstance(both, str), "a property can be changed alone, but not with others"
        everything = both
    if len(conditions) > 2:
        conditions.append(Condition(task=everything, property=ALL))
    results = []
    with claim_folder(out):
        for each, known, own in zip((a, b), measured, (conditions, conditions[:1]), strict=True):
            finite = {}
            for name, value in known.items():
                if math.isfinite(value):
                    finite[COMPARED[name].option] = value
            result = play(
                policy,
                trial,
                each,
                own,
                out,
                episodes=episodes,
                measured=finite,
                left_out=left_out,
                progress=partial(progress, each.name),
            )
            results.append(result)
    return Attribution(a=results[0], b=results[1], folder=out)


def change_towards(
    prop: Property, a: float, b: float, task: TaskConfig, engine: Engine
) -> TaskConfig | str:
    """Return the task in which a property of engine A has the value of engine B, or a text that says why there is none.

    A pair's friction is the mean of two materials, of which the one that is not the object's is changed. Other
    properties are changed by the factor B / A. MuJoCo's contacts, which count time in timesteps, become stiffer with a
    finer timestep, and its friction becomes harder below 1/200 s.

    Args:
        prop: the property.
        a: value that was measured in A.
        b: value that was measured in B.
        task: task from :func:`~xreset.eval.conditions.nominal_task`.
        engine: A.
    """
    unknown = [which for which, value in (("A", a), ("B", b)) if not math.isfinite(value)]
    if unknown:
        return f"could not be measured in {' and '.join(unknown)}"
    if abs(a - b) < prop.resolution * (1.0 if prop.absolute else max(abs(a), abs(b))):
        return "the same in both, within the resolution of the measurement"
    if not can_set(engine, prop):
        return f"cannot be set in {engine.name}"
    if prop.name == "timestep":
        substeps = max(1, round(task.substeps * a / b))
        if substeps == task.substeps:
            return f"with {substeps} physics steps per control step, no other timestep comes nearer"
        return replace(task, timestep=task.control_dt / substeps, substeps=substeps)
    if a <= 0:
        return f"there is none in {engine.name}, so no factor leads to the other value"
    ratio = max(b, 0.0) / a
    if prop.needs != "friction":
        return prop.set_in(task, ratio)
    material = task.randomization.friction[0]
    other = ratio * (material + getattr(task.randomization, prop.changed_field)) - material
    if other < 0:
        return "less than half of the object's own coefficient, which no other material gives"
    return replace(task, randomization=replace(task.randomization, **{prop.changed_field: other}))


# For a terminal -------------------------------------------------------------------------------------------------------


def rich_table(found: Attribution, title: str) -> RichTable:
    """Return a table with a row for each condition. A row is bold if the interval of its difference to A excludes
    zero."""
    table = RichTable("", title=title, title_justify="left")
    shown = ("grasp", "reorient", "published_success")
    names = ["value", "task progress", *(METRICS[name].title for name in shown)]
    for name in (*names, f"against {found.a.engine}", "of gap"):
        table.add_column(name, justify="right")
    for row in found.rows:
        effect = row.effect
        low, high = effect.ci95
        share = found.share(row)
        values = " -> ".join(_shown(row.name, found)) if row.kind == "towards" else ""
        is_first = row.kind == "as it is"
        table.add_row(
            row.name,
            values,
            f"{effect.task_progress:.1%}\n{100 * low:.0f}-{100 * high:.0f}",
            *(METRICS[name].text(mean(row.episodes, name), len(row.episodes)) for name in shown),
            "" if is_first else effect.difference_text().replace(" ", "\n", 1),
            "" if is_first or math.isnan(share) else f"{share:.0%}",
            style="bold" if effect.is_certain else None,
        )
    return table


def _shown(name: str, found: Attribution) -> list[str]:
    """Return the measured values of a property in A and in B, as text."""
    prop = COMPARED[name]
    values = [result.measured.get(prop.option) for result in (found.a, found.b)]
    return ["unknown" if value is None else prop.shown(value) for value in values]


def not_tried(found: Attribution) -> Iterator[str]:
    """Yield a line for each property that was not changed: its value in both engines, and the reason."""
    for option, reason in found.a.left_out.items():
        name = property_of(option).name
        a, b = _shown(name, found)
        yield f"not tried: {name} ({a} in {found.a.engine}, {b} in {found.b.engine}): {reason}"


def verdict(found: Attribution) -> str:
    """Return the result in a sentence or two."""
    a = found.a.engine
    b = found.b.engine
    size = found.gap.difference_text().replace(" ", " points of task progress ", 1)
    if not found.gap.is_certain:
        return (
            f"{b} and {a} do not differ for sure: {size} over {len(found.a.nominal)} episodes. "
            "There is nothing to attribute. More episodes would show smaller differences."
        )
    row = found.costs()
    if row is None:
        return f"{b} differs from {a} by {size}, and none of the properties that could be changed explains it."
    best = f"{row.name!r} alone brings about {found.share(row):.0%} of it"
    for together in found.rows:
        if together.kind == "all":
            best += f", {together.name} {found.share(together):.0%}"
    return f"{b} differs from {a} by {size}; {best}."
