"""``xreset frontier``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rich.table import Table

from xreset.cli._common import Engines, Flat, PolicyOrBaseline, chosen_engines, engine_bars
from xreset.cli._terminal import console
from xreset.errors import PolicyError
from xreset.eval import frontier as frontiers
from xreset.eval import policy_spec, trial
from xreset.eval.setting import Setting


def frontier(
    policy: PolicyOrBaseline,
    *,
    resets: Path,
    backend: Engines = (),
    states: int = 400,
    setting: Flat[Setting] = Setting(),
    out: Path | None = None,
) -> None:
    """Show from which demonstrated states a policy reaches the goal, and so where its training is stuck.

    Args:
        resets: Reset bank (xreset resets) whose states are tried, at full gravity.
        states: Number of states to try.
        setting: Robot, meshes, seed of the choice of states, device and worlds.
        out: Folder for the results; default: frontier/ in the run folder or next to the policy.
    """
    if policy == "ik":
        raise PolicyError("The baseline ik cannot continue from a state. Give a policy, zero or random.")
    engines = chosen_engines(backend, setting.device)
    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    folder = out or spec.folder.parent / "frontier"
    played = trial.load_trial(
        spec, resets, objects=setting.objects, seed=setting.seed, num_envs=setting.num_envs, accept=("bank",)
    )
    with engine_bars([e.name for e in engines]) as progress:
        results = frontiers.frontier(spec, played, engines, folder, states=states, progress=progress)
    title = f"{spec.name} on {spec.robot.name} continues from {len(results[0]['tried'])} demonstrated states:"
    table = Table(
        "the episode begins with", title=f"{title}\nof them, at the goal at any time / at the end", title_justify="left"
    )
    for result in results:
        table.add_column(result["backend"], justify="right", no_wrap=True)
    by_stage = [{row["stage"]: _shares(row) for row in result["stages"]} for result in results]  # noqa: XR002
    for stage in frontiers.STAGES:  # a state between two stages may count to another one in another engine
        if any(stage in shares for shares in by_stage):
            table.add_row(stage, *(shares.get(stage, "-") for shares in by_stage))
    console.print(table)
    console.print(f"results in {folder}")


def _shares(row: dict[str, Any]) -> str:
    return f"{row['states']}: {row['reached']:.0%} / {row['stayed']:.0%}"


COMMAND = frontier
