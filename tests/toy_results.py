"""Evaluation results for tests: two demonstrations, two episodes each, of known outcome."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.toy_bank import SOUP, SPAM
from xreset.eval.results import EvalResult, summarize
from xreset.eval.rollout import Episode, Rollouts, Trace

OBJECTS = (SOUP, SPAM)


def toy_episode(sequence: int, repetition: int, *reached: str, thing: str = "", **changes: Any) -> Episode:
    """An episode of a demonstration that reached some stages; nothing else is special but for ``changes``."""
    flags = ("approach", "grasp", "reorient", "reorient_once", "out_of_bounds", "nonfinite", "overflow")
    values = {"reorientation_progress": 0.0, "task_progress": 0.0} | changes
    return Episode(
        sequence=sequence,
        sequence_name=f"demo_{sequence}",
        object=thing or OBJECTS[sequence],
        repetition=repetition,
        **{name: name in reached for name in flags},
        **values,
    )


def episodes(scores: list[float]) -> tuple[Episode, ...]:
    """Two episodes of each demonstration, with these task progresses; above 0.5 with a grasp."""
    found = []
    for i, score in enumerate(scores):
        reached = ("approach", "grasp") if score > 0.5 else ("approach",)
        found.append(toy_episode(i // 2, i % 2, *reached, thing=SOUP, task_progress=score))
    return tuple(found)


def toy_rollouts(joint_pos: np.ndarray | None = None) -> Rollouts:
    """Demonstration 0 (soup) reaches the goal once and the approach once, demonstration 1 (spam) a grasp and nothing.

    Args:
        joint_pos: [J] where the robot of the traces stands; default: three joints at 0.
    """
    joints = np.zeros(3) if joint_pos is None else joint_pos

    def trace(sequence: int) -> Trace:
        time = np.arange(5) * 0.05
        path = np.array([0.5, 0.3, 0.05]) + np.outer(np.linspace(0, 1, 5), [0.0, 0.05, 0.1])
        return Trace(
            sequence=sequence,
            object=OBJECTS[sequence],
            goal_pos=np.array([0.5, 0.35, 0.15]),
            goal_quat=np.array([1.0, 0, 0, 0]),
            time=time,
            joint_pos=joints + 0.01 * sequence * time[:, None],
            object_pos=path,
            object_quat=np.tile([1.0, 0, 0, 0], (5, 1)),
            joint_target=joints + 0.01 * np.arange(12)[:, None],
        )

    lifted = ("approach", "grasp")
    done = ("reorient", "reorient_once")
    episodes = (
        toy_episode(0, 0, *lifted, *done, reorientation_progress=0.9, task_progress=1.0),
        toy_episode(0, 1, "approach", "overflow", reorientation_progress=0.1, task_progress=0.33),
        toy_episode(1, 0, *lifted, "out_of_bounds", reorientation_progress=0.5, task_progress=0.66),
        toy_episode(1, 1, "nonfinite"),
    )
    return Rollouts(episodes=episodes, traces=(trace(0), trace(1)), control_steps_per_second=1234.56)


def toy_summary(backend: str = "mujoco", rollouts: Rollouts | None = None, **changes: Any) -> EvalResult:
    """``BACKEND.json`` of the rollouts; ``changes`` replace arguments of :func:`xreset.eval.results.summarize`."""
    arguments: dict[str, Any] = {
        "backend_version": "4.0.0",
        "robot": "toy",
        "policy": "zero",
        "seed": 3,
        "inputs": {"demos": "ab"},
        "objects_folder": None,
    }
    return summarize(rollouts or toy_rollouts(), backend=backend, **(arguments | changes))
