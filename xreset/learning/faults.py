"""End a training with too many broken worlds, and keep these worlds for a diagnosis."""

from __future__ import annotations

from collections import deque
from dataclasses import asdict
from pathlib import Path

import numpy as np

from xreset.env import ManipulationEnv
from xreset.errors import RunError
from xreset.learning.config import TrainConfig
from xreset.records import write_npz

MAX_SHARE = 1e-3
"""Largest share of world-steps that may break; the run ends beyond it."""
WINDOW = 200
"""Iterations over which the share is taken. The first iterations may use the allowance of the whole window."""

SCHEMA = "xreset-faults/1"


class FaultBudget:
    """The faults of the last :data:`WINDOW` iterations."""

    def __init__(self, steps_per_iteration: int) -> None:
        """Start with none; ``steps_per_iteration`` is the number of world-steps of an iteration, over all processes."""
        self.allowed = MAX_SHARE * WINDOW * steps_per_iteration
        self._window_steps = WINDOW * steps_per_iteration
        self._recent: deque[tuple[int, int]] = deque(maxlen=WINDOW)

    def add(self, nonfinite: int, overflow: int) -> str | None:
        """Add an iteration's faults; return a message if there are too many.

        Args:
            nonfinite: number of worlds that were ended because a position or velocity was not finite.
            overflow: number of worlds that were ended because contacts or constraints were dropped.
        """
        self._recent.append((nonfinite, overflow))
        nonfinite = sum(counts[0] for counts in self._recent)
        overflow = sum(counts[1] for counts in self._recent)
        if nonfinite + overflow <= self.allowed:
            return None
        return (
            f"{nonfinite} worlds were not finite and {overflow} dropped contacts or constraints in the last "
            f"{len(self._recent)} iterations, more than {MAX_SHARE:.1%} of the {self._window_steps} world-steps of "
            f"{WINDOW} iterations"
        )


def dump_faults(path: Path, env: ManipulationEnv, config: TrainConfig, *, iteration: int) -> None:
    """Write the last broken worlds of an environment.

    Args:
        path: npz file: arrays [F, ...] of :attr:`ManipulationEnv.faults`, ``joint_names``, ``object_names`` and
            ``iteration``; the configuration is in its ``meta``.
        env: the environment.
        config: what the run was started with.
        iteration: the iteration under way.
    """
    scene = env.backend.scene
    names = {
        "robot": np.array(scene.robot.name),
        "joint_names": np.array(scene.robot.joint_names),
        "object_names": np.array([spec.name for spec in scene.objects]),
        "backend": np.array(env.backend.name),
        "iteration": np.array(iteration),
    }
    write_npz(path, SCHEMA, env.faults.arrays() | names, config=asdict(config))


def too_many_faults(problem: str, path: Path, folder: Path) -> RunError:
    """Return the error that ends a run."""
    return RunError(
        f"the run ends: {problem}. Their states before and after the step, and the drives' targets, are in {path}. "
        "Look for what they have in common (object, reset, gravity fraction). Then continue from the last checkpoint: "
        f"xreset train --out {folder} --resume"
    )
