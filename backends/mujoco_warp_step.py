"""A physics step of MuJoCo-Warp 4.0.0 in which what moves the bodies freely is worked out beside collisions and constraints.

Neither reads what the other writes, and neither fills a GPU: most of their kernels are short. A test compares with the engine's step, in
either order. Import this only with a version of which that is known.
"""

from __future__ import annotations

from typing import Any

import mujoco_warp as mjw
import warp as wp
from mujoco_warp._src.smooth import tendon_armature


def smooth_dynamics(m: Any, d: Any) -> None:
    """Inertia, forces that are not of constraints, and what they would accelerate."""
    mjw.crb(m, d)
    tendon_armature(m, d)
    mjw.transmission(m, d)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    mjw.fwd_acceleration(m, d, factorize=True)


def constraints(m: Any, d: Any) -> None:
    """Contacts and rows of constraints."""
    mjw.collision(m, d)
    mjw.make_constraint(m, d)


def finish(m: Any, d: Any) -> None:
    """Forces of the constraints, then the next positions and velocities."""
    mjw.solve(m, d)
    mjw.implicit(m, d)


class ForkedStep:
    """``mujoco_warp.step`` from after its kinematics on: those of the present positions must be there."""

    def __init__(self, device: Any) -> None:
        """Make the second stream."""
        self._beside = wp.Stream(device) if device.is_cuda else None

    def __call__(self, m: Any, d: Any) -> None:
        """Queue the step on Warp's current stream."""
        if self._beside is None:
            smooth_dynamics(m, d)
            constraints(m, d)
        else:
            main = wp.get_stream()
            self._beside.wait_stream(main)
            with wp.ScopedStream(self._beside, sync_enter=False):
                smooth_dynamics(m, d)
            constraints(m, d)
            main.wait_stream(self._beside)
        finish(m, d)
