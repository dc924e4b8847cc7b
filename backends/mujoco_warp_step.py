"""A physics step of MuJoCo-Warp that computes free motion next to collisions and constraints.

Neither reads what the other writes, and neither fills a GPU: most of their kernels are short. A test compares with the
engine's step, in either order. This module reads the engine's private modules.
"""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import mujoco_warp as mjw
import warp as wp
from mujoco_warp._src import forward, solver
from mujoco_warp._src.smooth import tendon_armature

from xreset.backends import mujoco_warp_kernels as kernels

ORIGINAL = (
    forward.step,
    forward._forward,
    forward.fwd_position,
    solver._jtdaj_groups_per_world,
)
"""The engine's functions that :func:`forked_step` replaces or changes."""
KNOWN_SOURCE = "22908e55c0a3eb6f"
"""Digest of their source."""
HESSIAN_WAVES = 18
"""Blocks that add contacts to the solver's matrix, in multiples of those that a GPU runs at a time; the engine has 6.

Every world gets as many blocks, and a step waits for the world with the most contacts, which has ten times the mean.
With 18 a step takes 3.2 % less (docs/lab-book.md, "Speed").
"""


def smooth_dynamics(m: Any, d: Any) -> None:
    """Compute inertia, forces other than those of constraints, and their accelerations."""
    mjw.crb(m, d)
    tendon_armature(m, d)
    mjw.transmission(m, d)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    mjw.fwd_acceleration(m, d, factorize=True)


def constraints(m: Any, d: Any) -> None:
    """Find contacts and rows of constraints."""
    mjw.collision(m, d)
    mjw.make_constraint(m, d)
    keep_contacts(d)


def keep_contacts(d: Any) -> None:
    """Keep sliding objects on the table: see :data:`~xreset.backends.mjcf_model.MOST_BRAKING`."""
    contact = d.contact
    wp.launch(
        kernels.keep_sliding_contacts,
        dim=d.naconmax,
        inputs=[d.nacon, d.naconmax, contact.worldid, contact.efc_address, contact.friction],
        outputs=[d.efc.aref],
    )


def finish(m: Any, d: Any) -> None:
    """Compute forces of the constraints, then the next positions and velocities."""
    mjw.solve(m, d)
    mjw.implicit(m, d)


def more_blocks() -> Any:
    """Return a context in which the solver's matrix gets :data:`HESSIAN_WAVES`."""
    return patch.object(solver, "_JTDAJ_OVERSUBSCRIBE_WAVES", HESSIAN_WAVES)


def forked_step(second: wp.Stream | None, m: Any, d: Any) -> None:
    """Queue ``mujoco_warp.step`` after its kinematics, which must be there, on Warp's current stream and a second one.

    Args:
        second: None: there are no streams, as on the CPU.
        m: the engine's model.
        d: the engine's data.
    """
    if second is None:
        smooth_dynamics(m, d)
        constraints(m, d)
        finish(m, d)
    else:
        main = wp.get_stream()
        second.wait_stream(main)
        with wp.ScopedStream(second, sync_enter=False):
            smooth_dynamics(m, d)
        constraints(m, d)
        main.wait_stream(second)
        with more_blocks():
            finish(m, d)
