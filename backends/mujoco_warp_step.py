"""A physics step of MuJoCo-Warp that computes free motion next to collisions, and two kinds of collisions side by side.

Neither reads what the other writes, and neither fills a GPU: most of their kernels are short, and those of convex
collisions wait for their slowest thread. A test compares with the engine's step, in either order. This module reads the
engine's private modules.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any
from unittest.mock import patch

import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src import collision_convex, collision_core, collision_driver, forward, solver
from mujoco_warp._src.smooth import tendon_armature
from mujoco_warp._src.types import GeomType

from xreset.backends import mujoco_warp_kernels as kernels

ORIGINAL = (
    forward.step,
    forward._forward,
    forward.fwd_position,
    solver._jtdaj_groups_per_world,
    collision_driver._nxn_broadphase,
    collision_driver._narrowphase,
    collision_convex.convex_narrowphase,
    collision_convex.ccd_kernel_builder,
    collision_core.write_contact.func,
)
"""The engine's functions that :func:`forked_step` replaces or changes, or whose counters :func:`narrowphase` trusts."""
KNOWN_SOURCE = "5ab37c4949be85c7"
"""Digest of their source."""
HESSIAN_WAVES = 18
"""Blocks that add contacts to the solver's matrix, in multiples of those that a GPU runs at a time; the engine has 6.

Every world gets as many blocks, and a step waits for the world with the most contacts, which has ten times the mean.
With 18 a step takes 3.2 % less (docs/lab-book.md, "Speed").
"""
OWN_STREAM = (GeomType.CAPSULE, GeomType.MESH)
"""The kind of convex collisions that is found next to all others: links of the robot with the object."""
_find_contacts = collision_driver._narrowphase


def order_pairs(m: Any) -> None:
    """Put pairs of geoms that few worlds have behind the others, in a model that has its worlds' meshes.

    Every world tests the pairs of as many pieces as the object with the most has. In this order the threads of a warp
    have something to test or all of them end at once: with nine objects, 30 in place of 60 of a world's 135 warps have.
    """
    is_absent = (m.geom_type.numpy() == GeomType.MESH) & (m.geom_dataid.numpy() < 0)
    share_absent = is_absent.mean(axis=0)
    pairs = m.nxn_geom_pair_filtered.numpy()
    order = np.argsort(share_absent[pairs].max(axis=1), kind="stable")
    for array in (m.nxn_geom_pair_filtered, m.nxn_pairid_filtered):
        array.assign(array.numpy()[order])


def smooth_dynamics(m: Any, d: Any) -> None:
    """Compute inertia, forces other than those of constraints, and their accelerations."""
    mjw.crb(m, d)
    tendon_armature(m, d)
    mjw.transmission(m, d)
    mjw.fwd_velocity(m, d)
    mjw.fwd_actuation(m, d)
    mjw.fwd_acceleration(m, d, factorize=True)


def contacts(m: Any, d: Any, aside: wp.Stream | None = None) -> None:
    """Find contacts, those of :data:`OWN_STREAM` on a stream of their own if there is one."""
    if aside is None:
        mjw.collision(m, d)
    else:
        with patch.object(collision_driver, "_narrowphase", partial(narrowphase, aside)):
            mjw.collision(m, d)


def constraints(m: Any, d: Any, aside: wp.Stream | None = None) -> None:
    """Find contacts and rows of constraints."""
    contacts(m, d, aside)
    mjw.make_constraint(m, d)
    keep_contacts(d)


def narrowphase(aside: wp.Stream, m: Any, d: Any, ctx: Any) -> None:
    """Find contacts of the pairs that are near, those of :data:`OWN_STREAM` on a stream of their own.

    The engine lets the kinds of convex pairs follow one another, because they share scratch memory: each counts its
    rows from 0. Here the engine's function is called twice, and each call allocates its own, 0.5 MB a world with nine
    objects. Contacts of both get their places from one atomic counter, as the contacts of one kind do.
    """
    main = wp.get_stream()
    aside.wait_stream(main)
    with wp.ScopedStream(aside, sync_enter=False):
        collision_driver.convex_narrowphase(m, d, ctx, [OWN_STREAM])
    kinds = collision_driver.MJ_COLLISION_TABLE
    with patch.dict(kinds):
        del kinds[OWN_STREAM]
        _find_contacts(m, d, ctx)
    main.wait_stream(aside)


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


def forked_step(streams: Sequence[wp.Stream], m: Any, d: Any) -> None:
    """Queue ``mujoco_warp.step`` after its kinematics, which must be there, on Warp's current stream and two others.

    Args:
        streams: the two; none on the CPU.
        m: the engine's model.
        d: the engine's data.
    """
    if not streams:
        smooth_dynamics(m, d)
        constraints(m, d)
        finish(m, d)
    else:
        free_motion, aside = streams
        main = wp.get_stream()
        free_motion.wait_stream(main)
        with wp.ScopedStream(free_motion, sync_enter=False):
            smooth_dynamics(m, d)
        constraints(m, d, aside)
        main.wait_stream(free_motion)
        with more_blocks():
            finish(m, d)
