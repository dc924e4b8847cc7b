"""Play a policy under conditions: one experiment, from which evaluations and sweeps are group-bys.

:func:`play` is the only player: policy x trial x conditions give one table of episodes for each engine.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pandas as pd

from xreset.errors import XResetError
from xreset.eval.conditions import Condition, Property
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.results import (
    EvalResult,
    Trace,
    episode_table,
    read_result,
    write_result,
)
from xreset.eval.rollout import Engine, Trial, roll_out
from xreset.files.progress import Progress, unseen
from xreset.physics.plugins import backend_class


def can_set(engine: Engine, prop: Property) -> bool:
    """Return whether an engine can set a property."""
    return prop.needs is None or prop.needs in backend_class(engine.name).capabilities


def play(
    policy: PolicySpec,
    trial: Trial,
    engine: Engine,
    conditions: Sequence[Condition],
    folder: Path,
    *,
    episodes: int,
    on_robot: bool = False,
    left_out: dict[str, str] | None = None,
    progress: Progress = unseen,
) -> EvalResult:
    """Play every demonstration under every condition in one engine, and write the result and the recorded episodes; a
    robot's control loop records none.

    Args:
        policy: the policy.
        trial: what is played; conditions replace its task.
        engine: the engine.
        conditions: the first one is recorded.
        folder: where the result is written.
        episodes: episodes of each demonstration, each with another perturbation, the same under every condition.
        on_robot: whether a robot's control loop plays, as faults need.
        left_out: property that has no condition -> why.
        progress: called with what is done and what is to be done in all; for one condition control steps, else
            conditions.
    """
    tables = []
    stopped: Counter[str] = Counter()
    traces: tuple[Trace, ...] = ()
    speed = 0.0
    controller = None
    if on_robot:
        from xreset.eval.robot_loop import roll_out_on_robot
        from xreset.live.faults import Faults
        from xreset.runtime import Controller

        controller = Controller(policy.graph, policy.name)
    for i, condition in enumerate(conditions):
        changed = replace(trial, task=condition.task)
        if controller is None:
            rollouts = roll_out(
                policy.start(trial.motion),
                engine,
                changed,
                episodes=episodes,
                progress=progress if len(conditions) == 1 else unseen,
            )
        else:
            rollouts = roll_out_on_robot(
                controller,
                engine,
                changed,
                condition.faults or Faults(),
                episodes=episodes,
            )
        if i == 0:
            traces = rollouts.traces
            speed = rollouts.control_steps_per_second
        stopped.update(rollouts.stopped)
        tables.append(episode_table(rollouts.episodes, condition.property, condition.value))
        if len(conditions) > 1:
            progress(i + 1, len(conditions))
    vision = trial.task.vision
    result = EvalResult(
        engine=engine.name,
        engine_version=engine.version,
        robot=trial.robot.name,
        policy=policy.name,
        seed=trial.seed,
        inputs=trial.inputs,
        meshes=str(trial.meshes) if trial.meshes else None,
        control_steps_per_second=round(speed, 1),
        unseen=policy.unseen(trial.names),
        vision=vision if vision.cameras else None,
        episode_seconds=_length(trial),
        left_out=left_out or {},
        stopped=dict(stopped),
        episodes=pd.concat(tables, ignore_index=True),
    )
    write_result(folder, result, traces, trial.robot.joint_names)
    return result


def _length(trial: Trial) -> float:
    """Return the length of an episode [s]."""
    return float(trial.task.termination.episode_seconds)  # JSON has no numbers of NumPy


def warn_of_replaced(files: Sequence[Path], trial: Trial) -> None:
    """Warn, before any episode, of results that the evaluation will replace although they are of other demonstrations
    or of episodes of another length."""
    for file in files:
        try:
            known = read_result(file)
        except XResetError:  # the file does not exist, or is damaged
            continue
        what = ""
        if known.inputs.get("demos") != trial.inputs.get("demos"):
            what = "other demonstrations"
        elif known.episode_seconds not in (None, _length(trial)):
            what = "episodes of another length"
        if what:
            logging.getLogger(__name__).warning(
                "%s: results of %s, which this evaluation replaces. To keep them, stop it now and choose another "
                "folder (out).",
                file,
                what,
            )
