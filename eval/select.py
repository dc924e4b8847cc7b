"""Select one of a training's checkpoints: the one whose score in its worst engine is highest.

A policy that is selected by the score in one engine is fitted to that engine. The selection plays other starts than
evaluations do, and ``xreset eval`` refuses the seed of the selection.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from xreset.eval.conditions import Condition
from xreset.eval.experiment import play
from xreset.eval.policy_spec import load_policy
from xreset.eval.rollout import Engine, load_trial
from xreset.eval.setting import Setting
from xreset.files.storage import file_hash, write_whole
from xreset.learning.export import export_checkpoint
from xreset.learning.run import (
    Candidate,
    Choice,
    checkpoints,
    latest_checkpoint,
    read_run,
    write_choice,
)


def candidates_in(folder: Path, most: int) -> list[Path]:
    """Return checkpoints of a run folder, the newest first.

    Args:
        most: largest number, spread evenly over all; the newest is among them.

    Raises:
        RunError: the folder has no checkpoint.
    """
    latest_checkpoint(folder)  # refuses a folder without checkpoints
    found = checkpoints(folder)
    picks = np.linspace(len(found) - 1, 0, min(most, len(found))).round().astype(int)
    return [found[i] for i in picks]


def select(
    folder: Path,
    engines: Sequence[Engine],
    demos: Path,
    setting: Setting,
    *,
    most: int = 8,
    episodes: int = 2,
    progress: Callable[[str, str, float], None] = lambda name, engine, score: None,
) -> Choice:
    """Play the checkpoints and write ``RUN/choice.json``; the run's ``policy.onnx`` becomes the chosen one.

    The newest checkpoint is played in all engines. Another is given up as soon as one of its scores is not above the
    lowest score of the best checkpoint so far. The engine in which the best checkpoint scores lowest is played first.

    Args:
        folder: run folder.
        demos: demonstrations whose starts and goals are played.
        setting: robot, meshes, seed of the starts, worlds.
        most: checkpoints at most.
        progress: called with (candidate, engine, task progress).

    Raises:
        RunError: the folder has no checkpoint.
    """
    run = read_run(folder)
    meshes = setting.meshes or run.meshes
    played: list[Candidate] = []
    best: Candidate | None = None
    order = engines
    with tempfile.TemporaryDirectory(prefix="xreset-") as scratch:
        chosen = Path(scratch)
        for path in candidates_in(folder, most):
            file = Path(scratch) / f"{path.stem}.onnx"
            export_checkpoint(path, file)
            policy = load_policy(file, robot=setting.robot or run.robot)
            trial = load_trial(
                policy, demos, meshes=meshes, seed=setting.seed, num_envs=setting.num_envs
            )
            scores: dict[str, float] = {}
            score_to_beat = best.worst if best else -1.0
            for engine in order:
                nominal = [Condition(task=trial.task)]
                result, _ = play(policy, trial, engine, nominal, episodes=episodes)
                scores[engine.name] = result.mean("task_progress")
                progress(path.name, engine.name, scores[engine.name])
                if scores[engine.name] <= score_to_beat:  # the newer of two equal ones wins
                    break
            candidate = Candidate(name=path.name, task_progress=scores)
            played.append(candidate)
            if candidate.worst > score_to_beat:
                best = candidate
                chosen = file
                order = sorted(engines, key=lambda engine: scores[engine.name])
        assert best is not None
        choice = Choice(
            chosen=best.name,
            policy_hash=file_hash(chosen),
            candidates=tuple(played),
            engines={e.name: e.version for e in engines},
            seed=setting.seed,
            episodes_per_demo=episodes,
            demos=file_hash(demos),
        )
        # A kill after this line does no harm: a run whose policy is not the chosen checkpoint's exports it again.
        write_choice(folder, choice)
        write_whole(folder / "policy.onnx", chosen.read_bytes())
    return choice
