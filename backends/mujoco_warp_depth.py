"""Correct the depth of contacts that MuJoCo-Warp clips to one point, so that it is as in MuJoCo.

Where a flat face or an edge is on a face, both engines clip the one with the other and place contacts at the corners of
what is left (multi-CCD). Often one corner alone is in the other body: of a finger, say, across the rim of a can. MuJoCo
takes place and depth of such a contact from that corner. MuJoCo-Warp 4.0.0 takes the place from the corner, but the
depth from the pair's deepest point, which is elsewhere. In three of five grasps the depths were 82, 186 and 211 um
instead of 34, 126 and 156 um, and the held objects moved differently in the two engines within one step. With the
corner's depth the joints follow MuJoCo's to 1.6e-5 rad (median over a second) instead of 6.9e-4.

No setting changes the depth, and no place in the step between collision and constraints still knows it. So the engine's
function is wrapped before any kernel is made of it. This module reads the engine's private modules.
"""

from __future__ import annotations

import warp as wp
from mujoco_warp._src import collision_convex
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import multicontact
from mujoco_warp._src.types import mat43

_APART = wp.constant(1e6)
"""Distance [m] at which no contact is written."""
KNOWN_SOURCE = "9587990e6dd180da"
"""Digest of the source of :data:`ORIGINAL` that has the fault."""
ORIGINAL = (multicontact.func,)
"""The engine's function that is wrapped."""


@wp.func
def multicontact_with_depth(
    polygon: wp.array[wp.vec3],
    clipped: wp.array[wp.vec3],
    plane_normal: wp.array[wp.vec3],
    plane_dist: wp.array[float],
    idx1: wp.array[int],
    idx2: wp.array[int],
    n1: wp.array[wp.vec3],
    n2: wp.array[wp.vec3],
    endvert: wp.array[wp.vec3],
    face1: wp.array[wp.vec3],
    face2: wp.array[wp.vec3],
    epa_vert: wp.array[wp.vec3],
    epa_vert_index: wp.array[int],
    epa_face: int,
    x1: wp.vec3,
    x2: wp.vec3,
    geom1: Geom,
    geom2: Geom,
    geomtype1: int,
    geomtype2: int,
) -> tuple[int, mat43, mat43, wp.vec4]:
    """Add a corner that is apart to a single corner, because the caller uses the depths of two and more."""
    count, witness1, witness2, depth = multicontact(
        polygon, clipped, plane_normal, plane_dist, idx1, idx2, n1, n2, endvert, face1, face2, epa_vert, epa_vert_index,
        epa_face, x1, x2, geom1, geom2, geomtype1, geomtype2,
    )  # fmt: skip
    # zero: nothing was clipped, and the depth of the pair is right
    if count == 1 and depth[0] != 0.0:
        depth[1] = _APART
        return 2, witness1, witness2, depth
    return count, witness1, witness2, depth


def correct_depths() -> None:
    """Make the engine's collision use :func:`multicontact_with_depth`. Kernels that exist already keep the fault."""
    collision_convex.multicontact = multicontact_with_depth
