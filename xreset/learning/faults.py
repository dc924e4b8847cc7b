"""When a training has too many broken worlds to go on."""

from __future__ import annotations

from collections import deque

MAX_SHARE = 1e-3
"""Largest share of world-steps that may break; the run ends beyond it."""
WINDOW = 200
"""Iterations over which the share is taken. The first iterations may use the allowance of the whole window."""


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
