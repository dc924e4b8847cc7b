"""``xreset stress``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from xreset.cli._common import Engines, Flat, PolicyOrBaseline, Several
from xreset.cli._terminal import Progress, console, show_table
from xreset.eval.setting import Setting

if TYPE_CHECKING:
    from xreset.eval import stress as sweeps


def stress(
    policy: PolicyOrBaseline,
    *,
    demos: Path,
    engine: Engines = (),
    property: Several = (),
    episodes: int = 2,
    setting: Flat[Setting] = Setting(),
    out: Path | None = None,
) -> None:
    """Measure robustness: the same episodes with changed stiffness, latency, friction, mass and more, one at a time.

    Args:
        demos: Demonstrations whose starts and goals are played.
        property: Property to change, or NAME=VALUE,VALUE... for values of your own (factors, latencies in control
            steps; the table shows each unit); give it again for more. Default: all.
        episodes: Episodes of each demonstration, the same for every value.
        setting: Robot, meshes, seed, device and worlds.
        out: Folder for the results; default: stress/ in the run folder or next to the policy.
    """
    from xreset.eval import sensitivity

    properties = sensitivity.chosen(property)  # refuses wrong ones before torch is loaded
    from xreset.eval import policy_spec, rollout
    from xreset.eval import stress as sweeps

    engines = rollout.chosen_engines(engine or "mujoco", setting.device)
    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    folder = out or spec.folder.parent / "stress"
    played = rollout.load_trial(
        spec, demos, meshes=setting.meshes, seed=setting.seed, num_envs=setting.num_envs
    )
    with Progress() as bar:
        found = sweeps.stress(
            spec,
            played,
            engines,
            folder,
            sweeps=properties,
            episodes=episodes,
            progress=bar.stages(),
        )
    sweeps.write_plot(folder / "stress.png", found, f"{spec.name}: robustness")
    table = [("property", "value", *(result.engine for result in found))]
    swept = sweeps.by_property(found)
    tried = set(swept).union(*(result.left_out for result in found))
    for prop in properties:
        if prop.option not in tried:  # a property of cameras, and the policy has none
            continue
        for i, value in enumerate(sorted({*prop.values, prop.nominal})):
            cells = []
            for curve in swept.get(prop.option, [None] * len(found)):
                text = _cell(curve.points[i], value == prop.nominal) if curve else "cannot be set"
                cells.append(text)
            table.append((prop.option, f"{value:g} {prop.unit}", *cells))
    show_table(
        table,
        title=f"{spec.name}: task progress, and its difference to the same episodes in points (95 %)\n"
        f"{found[0].episodes} episodes, seed {setting.seed}",
    )
    for result in found:
        if result.left_out:
            console.print(
                f"left out in {result.engine}, which cannot set them: {', '.join(result.left_out)}"
            )
    console.print(f"results and picture in {folder}")


def _cell(point: sweeps.Point, nominal: bool) -> str:
    """Return task progress as text; at other than the nominal value, with the difference to it and its interval."""
    text = f"{100 * point.task_progress:.1f} %"
    if nominal:
        return text
    low, high = point.difference_ci95
    return f"{text} ({100 * point.difference:+.1f}; {100 * low:+.1f} to {100 * high:+.1f})"


COMMAND = stress
