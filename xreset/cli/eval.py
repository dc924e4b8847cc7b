"""``xreset eval``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Engines, Flat, PolicyOrBaseline
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console
from xreset.eval.setting import Setting
from xreset.files.checks import PositiveInt


def evaluate(
    policy: PolicyOrBaseline,
    *,
    engine: Engines = (),
    demos: Path,
    episodes: PositiveInt = 5,
    settle: bool = False,
    episode_seconds: float | None = None,
    setting: Flat[Setting] = Setting(),
    out: Output | None = None,
) -> None:
    """Evaluate a policy or a baseline in one or several engines.

    A task progress of the baseline ik near 33 % means that the hand gets to the object and does not grasp it.

    Args:
        demos: Starts and goals, and the path of ik: demonstrations (xreset demos), retargeted trajectories (xreset
            retarget) or a goal set (xreset goals).
        episodes: Episodes of each demonstration, each with another perturbation of robot and object.
        settle: Let objects come to rest before episodes begin. Default: the recorded poses, as in the paper, from which
            one object in eleven turns by more than 10 degrees.
        episode_seconds: Length of an episode [s], such as 12, as in the published paper. Default: as in the policy's
            training.
        setting: Robot, meshes, seed, device and worlds.
        out: Folder for the results; default: eval/ in the run folder or next to the policy, runs/NAME/eval for a policy
            that ships with xreset, runs/BASELINE-ROBOT/eval for a baseline.
    """
    from xreset.eval import experiment, policy_spec, table

    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    with Progress() as bar:
        results = experiment.evaluate(
            spec,
            demos,
            tuple(dict.fromkeys(engine or ("mujoco",))),
            episodes=episodes,
            settle=settle,
            episode_seconds=episode_seconds,
            out=out,
            progress=bar.stages(),
            **vars(setting),
        )
    console.print(table.results_table(results))
    if unseen := results[0].unseen:
        console.print(f"not in the policy's training: {', '.join(unseen)}")
    console.print(f"results in {out or spec.folder}")


COMMAND = evaluate
