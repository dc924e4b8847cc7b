"""Play a policy under conditions: one experiment, from which evaluations, sweeps and attributions are group-bys.

:func:`play` is the only player: policy x trial x conditions give one table of episodes for each engine.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import pandas as pd

from xreset.demos.synth import synthesize
from xreset.errors import XResetError
from xreset.eval.conditions import FAULTS, SWEPT, Condition, Property, chosen, nominal_task
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.eval.results import (
    EvalResult,
    Evaluation,
    Trace,
    episode_table,
    read_result,
    write_result,
)
from xreset.eval.rollout import Engine, Trial, chosen_engines, load_trial, roll_out
from xreset.files.checks import PositiveInt, Seed, obeys_rules
from xreset.files.progress import Progress, unseen
from xreset.files.storage import claim_folder
from xreset.physics.plugins import backend_class
from xreset.resets.inputs import Data


@obeys_rules
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
        PolicyError: the policy is unknown.
        XResetError: another process is writing the folder, or a number is out of range.
    """
    spec = load_policy(policy, robot=robot, seed=seed)
    chosen_ones = chosen_engines(engines, device)
    trial = load_trial(
        spec,
        demos,
        meshes=meshes,
        seed=seed,
        num_envs=num_envs,
        settle=settle,
        episode_seconds=episode_seconds,
    )
    folder = Path(out) if out else spec.folder
    found = Evaluation()
    found.folder = folder
    with claim_folder(folder):
        _warn_of_replaced([folder / f"{each.name}.json" for each in chosen_ones], trial)
        for each in chosen_ones:
            nominal = [Condition(task=trial.task)]
            result, traces = play(
                spec, trial, each, nominal, episodes=episodes, progress=partial(progress, each.name)
            )
            write_result(folder, result, traces, trial.robot.joint_names)
            found.append(result)
    return found


@obeys_rules
def stress(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data | None = None,
    engines: str | Engine | Sequence[str | Engine] = "mujoco",
    *,
    properties: str | Sequence[str] = (),
    faults: bool = False,
    episodes: PositiveInt = 2,
    seed: Seed = 0,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    num_envs: PositiveInt = 64,
    device: str = "cpu",
    out: str | Path | None = None,
    progress: Callable[[str, float, int], None] = unseen,
) -> Evaluation:
    """Play the same episodes with one property of the world, or one fault of a robot, changed at a time, and write the
    results.

    If a fault is among the properties, all episodes are played through a robot's control loop
    (:mod:`xreset.eval.robot_loop`), also those without a change.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`; a baseline has no faults.
        demos: as for :func:`evaluate`; default: two synthetic demonstrations of each of the policy's objects.
        engines: a physics engine or its name, or several.
        properties: properties and faults, as ``NAME`` or ``NAME=VALUE,VALUE...`` (SI units); default: all physical
            ones.
        faults: whether ``properties`` are all faults by default.
        episodes: episodes of each demonstration, the same for every value.
        seed: seed of starts and faults.
        robot: name or folder of the robot; default: the policy's own. Baselines need it.
        meshes: folder of object meshes; default: the folder of the policy's training.
        num_envs: worlds that run at the same time.
        device: where GPU engines run: cpu or cuda.
        out: folder for the results; default: ``stress`` next to the policy's evaluations, or ``faults`` if there are
            faults.
        progress: called with (engine, conditions done, conditions in all).

    Returns:
        The results that were written, in the order of the engines: the unchanged episodes, and those of every value.
        :mod:`xreset.eval.effects` compares them.

    Raises:
        PolicyError: the policy is unknown, or a baseline shall have faults.
        XResetError: a property is unknown or cannot have a value; nothing was played then.
    """
    wanted = chosen(properties, FAULTS if faults else SWEPT)
    on_robot = faults or any(prop.is_fault for prop in wanted)
    spec = load_policy(policy, robot=robot, seed=seed)
    if on_robot:
        spec.exported()  # refuses a baseline
    if demos is None:
        own_meshes = spec.meshes_folder(meshes)
        demos = synthesize(spec.objects_of(own_meshes), 2, meshes=own_meshes)
    trial = load_trial(spec, demos, meshes=meshes, seed=seed, num_envs=num_envs)
    if not trial.task.vision.cameras:
        wanted = tuple(prop for prop in wanted if not prop.of_cameras)
        if not wanted:
            raise XResetError(
                f"The policy {spec.name!r} has no cameras to change. Choose other properties."
            )
    task = nominal_task(trial.task)
    conditions: list[tuple[Property, list[Condition]]] = []
    for prop in wanted:
        conditions.append((prop, [prop.at(value, task) for value in prop.values]))
    default = "faults" if on_robot else "stress"
    folder = Path(out) if out else spec.folder.parent / default
    found = Evaluation()
    found.folder = folder
    played_engines = chosen_engines(engines, device)
    with claim_folder(folder):
        for each in played_engines:
            usable = [Condition(task=task)]
            left_out = {}
            for prop, own in conditions:
                if can_set(each, prop):
                    usable += own
                else:
                    left_out[prop.option] = f"{each.name} cannot set it"
            result, traces = play(
                spec,
                trial,
                each,
                usable,
                episodes=episodes,
                on_robot=on_robot,
                progress=partial(progress, each.name),
            )
            result = replace(result, left_out=left_out)
            write_result(folder, result, traces, trial.robot.joint_names)
            found.append(result)
    return found


def can_set(engine: Engine, prop: Property) -> bool:
    """Return whether an engine can set a property."""
    return prop.needs is None or prop.needs in backend_class(engine.name).capabilities


def play(
    policy: PolicySpec,
    trial: Trial,
    engine: Engine,
    conditions: Sequence[Condition],
    *,
    episodes: int,
    on_robot: bool = False,
    progress: Progress = unseen,
) -> tuple[EvalResult, tuple[Trace, ...]]:
    """Play every demonstration under every condition in one engine.

    Args:
        policy: the policy.
        trial: what is played; conditions replace its task.
        engine: the engine.
        conditions: the first one is recorded.
        episodes: episodes of each demonstration, each with another perturbation, the same under every condition.
        on_robot: whether a robot's control loop plays, as faults need.
        progress: called with what is done and what is to be done in all; for one condition control steps, else
            conditions.

    Returns:
        The result, and the recorded episodes; none from the control loop of a robot.
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
        stopped=dict(stopped),
        episodes=pd.concat(tables, ignore_index=True),
    )
    return result, traces


def _length(trial: Trial) -> float:
    """Return the length of an episode [s]."""
    return float(trial.task.termination.episode_seconds)  # JSON has no numbers of NumPy


def _warn_of_replaced(files: Sequence[Path], trial: Trial) -> None:
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
