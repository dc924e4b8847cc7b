"""``xreset stress``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from xreset.cli._common import Engines, Flat, PolicyOrBaseline, Several
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console, show_table
from xreset.eval.setting import Setting
from xreset.files.checks import PositiveInt

if TYPE_CHECKING:
    from xreset.eval import effects


def stress(
    policy: PolicyOrBaseline,
    *,
    demos: Path | None = None,
    engine: Engines = (),
    property: Several = (),
    faults: bool = False,
    episodes: PositiveInt = 2,
    setting: Flat[Setting] = Setting(),
    out: Output | None = None,
) -> None:
    """Measure robustness: the same episodes with changed stiffness, latency, friction, mass and more, one at a time.

    With faults, a robot's control loop plays: late and wrong poses, late actions, lost frames, pushes. The result says
    whether the policy may be tried on a robot. xreset report draws every curve.

    Args:
        demos: Demonstrations whose starts and goals are played. Default: two synthetic demonstrations of each of the
            policy's objects.
        property: Property or fault to change, or NAME=VALUE,VALUE... for values of your own (factors, s, m, rad; the
            table shows each unit); give it again for more. Default: all physical properties.
        faults: Change the faults of a robot by default, in place of physics.
        episodes: Episodes of each demonstration, the same for every value.
        setting: Robot, meshes, seed, device and worlds.
        out: Folder for the results; default: stress/ in the run folder or next to the policy, faults/ if there are
            faults.
    """
    from xreset.eval import conditions

    conditions.chosen(property)  # refuses wrong ones before torch is loaded
    from xreset.eval import effects, experiment, policy_spec

    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    with Progress() as bar:
        found = experiment.stress(
            spec,
            demos,
            tuple(dict.fromkeys(engine or ("mujoco",))),
            properties=property,
            faults=faults,
            episodes=episodes,
            out=out,
            progress=bar.stages(),
            **vars(setting),
        )
    rows = [("property", "value", *(result.engine for result in found))]
    for name, curves in effects.by_property(found).items():
        known = next(filter(None, curves))
        for i, point in enumerate(known.points):
            cells = []
            for curve in curves:
                cells.append(_cell(curve, i) if curve else "cannot be set")
            rows.append((name, known.property.amount(point.value), *cells))
        limits = [curve.costs() if curve else "" for curve in curves]
        rows.append(("", "costs ten points", *limits))
    title = f"{spec.name}: task progress, and its difference to the same episodes in points (95 %)"
    show_table(rows, title=f"{title}\n{len(found[0].nominal)} episodes, seed {setting.seed}")
    for result in found:
        if result.left_out:
            console.print(
                f"left out in {result.engine}, which cannot set them: {', '.join(result.left_out)}"
            )
    sentence, reasons = effects.verdict(found)
    if sentence:
        console.print(sentence, style="bold")
    for reason in reasons:
        console.print(reason)
    console.print(f"results in {found.folder}; page with every curve: xreset report {found.folder}")


def _cell(curve: effects.Curve, index: int) -> str:
    """Return task progress as text; at other than the nominal value, with the difference to it and its interval."""
    point = curve.points[index]
    text = f"{100 * point.task_progress:.1f} %"
    if point.value == curve.property.nominal:
        return text
    return f"{text}, {point.difference_text()}"


COMMAND = stress
