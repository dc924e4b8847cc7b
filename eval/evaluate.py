"""Evaluate a policy or a baseline on demonstrations, in one or several physics engines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from xreset.errors import XResetError
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.eval.results import (
    Evaluation,
    episode_table,
    read_result,
    summarize,
    write_results,
)
from xreset.eval.rollout import Engine, chosen_engines, load_trial, roll_out
from xreset.files.checks import PositiveInt, Seed
from xreset.files.progress import unseen
from xreset.files.storage import claim_folder
from xreset.resets.inputs import Data


def evaluate(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data,
    engines: str | Engine | Sequence[str | Engine] = "mujoco",
    *,
    episodes: PositiveInt = 5,
    seed: Seed = 0,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    num_envs: PositiveInt = 64,
    device: str = "cpu",
    settle: bool = False,
    episode_seconds: float | None = None,
    out: str | Path | None = None,
    progress: Callable[[str, float, int], None] = unseen,
) -> Evaluation:
    """Play every demonstration in every engine, from the same starts, and write the results.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`.
        demos: starts and goals: demonstrations, retargeted motion or a goal set, or a file of one of these.
        engines: a physics engine or its name, or several.
        episodes: episodes of each demonstration, each with another perturbation of robot and object.
        seed: seed of the perturbations.
        robot: name or folder of the robot; default: the policy's own. Baselines need it.
        meshes: folder of object meshes; default: the folder of the policy's training.
        num_envs: worlds that run at the same time.
        device: where GPU engines run: cpu or cuda.
        settle: whether objects come to rest before episodes begin, instead of starting as recorded.
        episode_seconds: length of an episode [s]; default: as in the policy's training.
        out: folder for the results; default: ``eval`` in the run folder, or ``runs/NAME/eval`` here for a policy that
            ships with xreset.
        progress: called with (engine, control steps done, control steps in all).

    Returns:
        The results that were written, in the order of the engines. They print as a table; ``to_frame()`` has a row for
        each episode.

    Raises:
        PolicyError: the policy is unknown, or the seed chose this checkpoint.
        XResetError: another process is writing the folder, or a number is out of range.
    """
    if episodes < 1:
        raise XResetError(f"episodes is {episodes}, expected at least 1.")
    policy = load_policy(policy, robot=robot, seed=seed)
    policy.check_seed(seed)
    chosen = chosen_engines(engines, device)
    trial = load_trial(
        policy,
        demos,
        meshes=meshes,
        seed=seed,
        num_envs=num_envs,
        settle=settle,
        episode_seconds=episode_seconds,
    )
    length = float(trial.task.termination.episode_seconds)  # JSON has no numbers of NumPy
    folder = Path(out) if out else policy.folder
    results = []
    tables = []
    with claim_folder(folder):
        files = [folder / f"{engine.name}.json" for engine in chosen]
        _warn_of_replaced(files, trial.inputs, length)
        for engine in chosen:
            player = policy.start(trial.motion)
            rollouts = roll_out(
                player, engine, trial, episodes=episodes, progress=partial(progress, engine.name)
            )
            result = summarize(
                rollouts,
                engine=engine.name,
                engine_version=engine.version,
                robot=trial.robot.name,
                policy=policy.name,
                seed=seed,
                inputs=trial.inputs,
                meshes=str(trial.meshes) if trial.meshes else None,
                unseen=policy.unseen(trial.names),
                vision=trial.task.vision if trial.task.vision.cameras else None,
                episode_seconds=length,
            )
            write_results(folder, result, rollouts, trial.robot.joint_names)
            results.append(result)
            tables.append(episode_table(result, rollouts.episodes))
    return Evaluation(results, tables)


def _warn_of_replaced(files: Sequence[Path], inputs: dict[str, str], length: float) -> None:
    """Warn, before any episode, of results that the evaluation will replace although they are of other demonstrations
    or of episodes of another length [s]."""
    of_other_demos = []
    of_other_length = []
    for file in files:
        try:
            known = read_result(file)
        except XResetError:  # the file does not exist, or is damaged
            continue
        if known.inputs.get("demos") != inputs.get("demos"):
            of_other_demos.append(str(file))
        elif known.episode_seconds not in (None, length):
            of_other_length.append(str(file))
    for others, what in (
        (of_other_demos, "other demonstrations"),
        (of_other_length, "episodes of another length"),
    ):
        if others:
            print(
                f"{', '.join(others)}: results of {what}, which this evaluation replaces. "
                "To keep them, stop it now and name another folder (--out).",
                file=sys.stderr,
            )
