"""Play a policy under conditions: one experiment, from which evaluations and sweeps are group-bys.

:func:`play` is the only player: policy x trial x conditions give one table of episodes for each engine.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd

from xreset.errors import XResetError
from xreset.eval.conditions import Condition, property_of
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.results import (
    EvalResult,
    Evaluation,
    Trace,
    episode_table,
    read_result,
    write_result,
)
from xreset.eval.rollout import Engine, Trial, roll_out
from xreset.files.progress import NamedProgress, Progress, unseen
from xreset.files.storage import claim_folder
from xreset.physics.plugins import backend_class


def play(
    policy: PolicySpec,
    trial: Trial,
    engines: Sequence[Engine],
    conditions: Sequence[Condition],
    folder: Path | None,
    *,
    episodes: int,
    on_robot: bool = False,
    progress: NamedProgress = unseen,
) -> Evaluation:
    """Play every demonstration under every condition in every engine, and write the results and the recorded episodes;
    a robot's control loop records none.

    Args:
        policy: the policy.
        trial: what is played; conditions replace its task.
        engines: the engines. Each leaves out the properties that it cannot set.
        conditions: the first one, in which nothing is changed, is recorded.
        folder: where the results are written; None: nowhere.
        episodes: episodes of each demonstration, each with another perturbation, the same under every condition.
        on_robot: whether a robot's control loop plays, as faults need.
        progress: called with the engine, what is done and what is to be done in all; for one condition control steps,
            else conditions.
    """
    found = Evaluation()
    found.folder = folder
    with claim_folder(folder) if folder else nullcontext():
        for engine in engines:
            if folder:
                _refuse_to_replace(folder / f"{engine.name}.json", policy, trial)
        for engine in engines:
            result, traces = _play_in(
                engine,
                policy,
                trial,
                conditions,
                episodes=episodes,
                on_robot=on_robot,
                progress=partial(progress, engine.name),
            )
            if folder:
                write_result(folder, result, traces, trial.robot.joint_names)
            found.append(result)
    return found


def _can_set(engine: Engine, condition: Condition) -> bool:
    needed = property_of(condition.property).needs
    return needed is None or needed in backend_class(engine.name).capabilities


def _play_in(
    engine: Engine,
    policy: PolicySpec,
    trial: Trial,
    conditions: Sequence[Condition],
    *,
    episodes: int,
    on_robot: bool,
    progress: Progress,
) -> tuple[EvalResult, tuple[Trace, ...]]:
    """Return the result in one engine, and the recorded episodes; arguments as for :func:`play`."""
    played = []
    skipped = []
    for condition in conditions:
        if _can_set(engine, condition):
            played.append(condition)
        else:
            skipped.append(condition.property)
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
    for i, condition in enumerate(played):
        changed = _under(condition, trial)
        if controller is None:
            rollouts = roll_out(
                policy.start(trial.motion),
                engine,
                changed,
                episodes=episodes,
                progress=progress if len(played) == 1 else unseen,
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
        if len(played) > 1:
            progress(i + 1, len(played))
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
        object_frame=trial.task.object_frame,
        left_out=dict.fromkeys(skipped, f"{engine.name} cannot set it"),
        stopped=dict(stopped),
        episodes=pd.concat(tables, ignore_index=True),
    )
    return result, traces


def _under(condition: Condition, trial: Trial) -> Trial:
    """Return what is played under a condition. A changed friction replaces those that objects have of their own."""
    objects = trial.objects
    if property_of(condition.property).changed_field == "friction":
        objects = tuple(replace(each, friction=None) for each in objects)
    return replace(trial, task=condition.task, objects=objects)


def _length(trial: Trial) -> float:
    """Return the length of an episode [s]."""
    return float(trial.task.termination.episode_seconds)  # JSON has no numbers of NumPy


def _refuse_to_replace(file: Path, policy: PolicySpec, trial: Trial) -> None:
    """Raise ``XResetError`` if a file has results of another policy, of other demonstrations or of episodes of another
    length. A policy that was trained on has the same name."""
    try:
        known = read_result(file)
    except XResetError:  # the file does not exist, or is damaged
        return
    what = ""
    if known.policy != policy.name and policy.hash not in known.inputs.values():
        what = f"another policy, {known.policy}"
    elif known.inputs.get("demos") != trial.inputs.get("demos"):
        what = "other demonstrations"
    elif known.episode_seconds not in (None, _length(trial)):
        what = "episodes of another length"
    if what:
        raise XResetError(
            f"{file} has results of {what}. Choose another folder (--out; in Python: out), or remove the file."
        )
