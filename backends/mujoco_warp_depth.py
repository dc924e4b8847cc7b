"""The depth of contacts that MuJoCo-Warp 4.0.0 clips to one point, as MuJoCo 4.0.0 has it.

Where a flat face or an edge lies on a face, both engines clip the one with the other and place contacts at the corners of what is left
(multi-CCD). Often one corner alone is in the other body: of a finger, say, that lies across the rim of a can. MuJoCo takes place and depth
of such a contact from that corner. MuJoCo-Warp takes its place, and the depth of the pair's deepest point, which is elsewhere: 82, 186 and
211 um where 34, 126 and 156 um are right, in three of the five grasps with which ``docs/parity.md`` began. Held objects part within
one step; with the corner's depth the joints of those five follow MuJoCo's to 1.6e-5 rad (median over a second) instead of 6.9e-4.

No setting changes it, and the step offers no place between collision and constraints where the corner's depth is still known. So the
engine's function is wrapped, before any kernel is made of it. This module reads the engine's private modules: import it only with a version
that is known to need it.
"""

# Warp compiles these functions from their source; to a type checker of Python they make no sense.
# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false

from __future__ import annotations

import warp as wp
from mujoco_warp._src import collision_convex
from mujoco_warp._src.collision_core import Geom
from mujoco_warp._src.collision_gjk import multicontact
from mujoco_warp._src.types import mat43

_APART = wp.constant(1e6)
"""Distance [m] at which no contact is written."""


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
    """The engine's function; to a single corner it adds one that is apart, for the caller uses the depths of two and more."""
    count, witness1, witness2, depth = multicontact(
        polygon, clipped, plane_normal, plane_dist, idx1, idx2, n1, n2, endvert, face1, face2, epa_vert, epa_vert_index, epa_face,
        x1, x2, geom1, geom2, geomtype1, geomtype2,
    )  # fmt: skip
    if count == 1 and depth[0] != 0.0:  # zero: nothing was clipped, and the depth of the pair is right
        depth[1] = _APART
        return 2, witness1, witness2, depth
    return count, witness1, witness2, depth


def correct_depths() -> None:
    """Have the engine's collision use :func:`multicontact_with_depth`. Kernels made before keep the fault."""
    collision_convex.multicontact = multicontact_with_depth
