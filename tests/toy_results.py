"""Evaluation results for tests: two demonstrations, two episodes each, of known outcome."""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.toy_bank import SOUP, SPAM
from xreset.eval.results import EvalResult, summarize
from xreset.eval.rollout import Episode, Rollouts, Trace

OBJECTS = (SOUP, SPAM)


def toy_rollouts(joint_pos: np.ndarray | None = None) -> Rollouts:
    """Demonstration 0 (soup) reaches the goal once and the approach once, demonstration 1 (spam) a grasp and nothing.

    Args:
        joint_pos: [J] where the robot of the traces stands; default: three joints at 0.
    """
    joints = np.zeros(3) if joint_pos is None else joint_pos

    def episode(sequence: int, repetition: int, **changes: Any) -> Episode:
        flags = dict.fromkeys(
            ("approach", "grasp", "reorient", "reorient_once", "out_of_bounds", "nonfinite", "overflow"), False
        )
        values = flags | {"reorientation_progress": 0.0, "task_progress": 0.0} | changes
        return Episode(
            sequence=sequence,
            sequence_name=f"demo_{sequence}",
            object=OBJECTS[sequence],
            repetition=repetition,
            **values,
        )

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

    episodes = (
        episode(
            0,
            0,
            approach=True,
            grasp=True,
            reorient=True,
            reorient_once=True,
            reorientation_progress=0.9,
            task_progress=1.0,
        ),
        episode(0, 1, approach=True, reorientation_progress=0.1, task_progress=0.33, overflow=True),
        episode(1, 0, approach=True, grasp=True, reorientation_progress=0.5, task_progress=0.66, out_of_bounds=True),
        episode(1, 1, nonfinite=True),
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
