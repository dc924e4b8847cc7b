"""Evaluation results for tests: two demonstrations, two episodes each, of known outcome; and folders of runs."""

from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from tests import data
from tests.toy_bank import SOUP, SPAM
from xreset import TrainConfig
from xreset.eval.metrics import Episode
from xreset.eval.results import EvalResult, Rollouts, Trace, episode_table, write_result
from xreset.learning.run import RunInfo, write_run
from xreset.task.config import TaskConfig
from xreset.task.contract import Contract

OBJECTS = (SOUP, SPAM)
ENGINES = ("mujoco", "mujoco-warp", "pybullet", "sapien")

CONTRACT = Contract(
    schema="xreset-policy/1",
    robot="openarm",
    robot_fingerprint="aa",
    joint_names=("a",),
    fingertip_names=("thumb",),
    objects=(SOUP,),
    observation_layout={"policy": {"x": 1}, "proprio": {"y": 1}},
    control_dt=1 / 60,
    task=TaskConfig(),
)


def toy_episode(sequence, repetition, *reached, object_name="", **changes):
    """An episode of a demonstration that reached some stages; nothing else is special but for ``changes``."""
    flags = "approach grasp reorient reorient_once out_of_bounds nonfinite overflow"
    distances = "least_distance final_distance final_position_error final_angle"
    distance = 0.01 if "reorient_once" in reached else 0.1
    values = {name: name in reached for name in flags.split()}
    values |= dict.fromkeys(distances.split(), distance)
    values |= dict.fromkeys(("reorientation_progress", "task_progress"), 0.0)
    values |= {"published_success": distance < 0.02, "object": object_name or OBJECTS[sequence]}
    return Episode(
        sequence=sequence,
        sequence_name=f"demo_{sequence}",
        repetition=repetition,
        **(values | changes),
    )


def episodes(scores):
    """Two episodes of each demonstration, with these task progresses; above 0.5 with a grasp."""
    found = []
    for i, score in enumerate(scores):
        reached = ("approach", "grasp") if score > 0.5 else ("approach",)
        found.append(toy_episode(i // 2, i % 2, *reached, object_name=SOUP, task_progress=score))
    return tuple(found)


def toy_rollouts(joint_pos=None):
    """Return rollouts in which demonstration 0 (soup) reaches the goal once and the approach once, demonstration 1 (spam) a grasp and nothing.

    Args:
        joint_pos: [J] joint positions of the traces; default: three joints at 0.
    """
    joints = np.zeros(3) if joint_pos is None else joint_pos
    time = np.arange(5) * 0.05
    traces = []
    for sequence, name in enumerate(OBJECTS):
        trace = Trace(
            sequence=sequence,
            object=name,
            goal_pos=np.array([0.5, 0.35, 0.15]),
            goal_quat=np.array([1.0, 0, 0, 0]),
            time=time,
            joint_pos=joints + 0.01 * sequence * time[:, None],
            object_pos=np.array([0.5, 0.3, 0.05])
            + np.outer(np.linspace(0, 1, 5), [0.0, 0.05, 0.1]),
            object_quat=np.tile([1.0, 0, 0, 0], (5, 1)),
            joint_target=joints + 0.01 * np.arange(12)[:, None],
        )
        traces.append(trace)
    lifted = ("approach", "grasp")
    done = ("reorient", "reorient_once")
    episodes = (
        toy_episode(0, 0, *lifted, *done, reorientation_progress=0.9, task_progress=1.0),
        toy_episode(0, 1, "approach", "overflow", reorientation_progress=0.1, task_progress=0.33),
        toy_episode(1, 0, *lifted, "out_of_bounds", reorientation_progress=0.5, task_progress=0.66),
        toy_episode(1, 1, "nonfinite"),
    )
    return Rollouts(episodes=episodes, traces=tuple(traces), control_steps_per_second=1234.56)


def rollouts_with(*progress):
    """Return the toy's four episodes with other task progress."""
    rollouts = toy_rollouts()
    both = zip(rollouts.episodes, progress, strict=True)
    return replace(rollouts, episodes=tuple(replace(e, task_progress=p) for e, p in both))


def toy_result(engine="mujoco", rollouts=None, sweep=None, **changes):
    """Return the result of the rollouts in an engine; ``changes`` replace its fields.

    Args:
        engine: name of the engine.
        rollouts: unchanged episodes; default: the toy's.
        sweep: (property, value) -> episodes, of conditions.
    """
    rollouts = rollouts or toy_rollouts()
    arguments: dict[str, Any] = {
        "engine_version": "4.0.0",
        "robot": "toy",
        "policy": "zero",
        "seed": 3,
        "inputs": {"demos": "ab"},
        "meshes": None,
        "control_steps_per_second": round(rollouts.control_steps_per_second, 1),
    }
    tables = [episode_table(rollouts.episodes)]
    for (name, value), own in (sweep or {}).items():
        tables.append(episode_table(own, name, value))
    episodes = pd.concat(tables, ignore_index=True)
    return EvalResult(engine=engine, episodes=episodes, **(arguments | changes))


def swept(base, sweep, engine="mujoco", **changes):
    """Return the result of a sweep: episodes with these task progresses, unchanged and for each (property, value)."""
    rollouts = Rollouts(episodes=episodes(base), traces=(), control_steps_per_second=1.0)
    own = {condition: episodes(scores) for condition, scores in sweep.items()}
    return toy_result(engine, rollouts, own, **changes)


class InFolder(data.InFolder):
    """A test with a folder of runs and results."""

    def write_results(
        self, name, rollouts=None, engines=("mujoco",), joints=("a", "b", "c"), **changes
    ):
        rollouts = rollouts or toy_rollouts()
        for engine in engines:
            result = toy_result(engine, rollouts, **changes)
            write_result(self.folder / name / "eval", result, rollouts.traces, joints)
        return self.folder / name

    def write_run(self, name, config=None, **changes):
        info = {
            "robot": "openarm",
            "resets": "resets.npz",
            "resets_hash": "ef" * 32,
            "meshes": None,
            "engine": "mujoco-warp",
            "engine_version": "4.0.0",
            "device": "cuda",
            "num_envs": 64,
            "seed": 0,
            "config": config or TrainConfig(),
            "contract": CONTRACT,
        }
        write_run(self.folder / name, RunInfo(**(info | changes)))
        return self.folder / name
