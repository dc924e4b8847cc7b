"""The Warp kernel that sums up MuJoCo-Warp's contacts, on the device."""

# Warp compiles these functions from their source; to a type checker of Python they make no sense.
# pyright: reportIndexIssue=false, reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false
# pyright: reportAttributeAccessIssue=false, reportGeneralTypeIssues=false, reportAssignmentType=false

from __future__ import annotations

import warp as wp

from xreset.backends.mjcf_model import OBJECT
from xreset.backends.rigid import TABLE

_OBJECT = wp.constant(OBJECT)
_TABLE = wp.constant(TABLE)


@wp.kernel(enable_backward=False)
def read_contacts(
    geom_role: wp.array[int],
    nacon: wp.array[int],
    naconmax: int,
    njmax: int,
    contact_world: wp.array[int],
    contact_geom: wp.array[wp.vec2i],
    contact_frame: wp.array[wp.mat33],
    contact_efc: wp.array2d[int],
    efc_force: wp.array2d[float],
    # Out: must be zero before.
    tip_force: wp.array2d[wp.vec3],
    tip_touch: wp.array2d[wp.bool],
    table_force: wp.array[wp.vec3],
):
    """Sum up the forces on the object, one thread a contact (elliptic cone: normal and two tangential forces)."""
    contact = wp.tid()
    if contact >= wp.min(nacon[0], naconmax):
        return
    geoms = contact_geom[contact]
    first = geom_role[geoms[0]]
    second = geom_role[geoms[1]]
    if (first == _OBJECT) == (second == _OBJECT):
        return
    world = contact_world[contact]
    local = wp.vec3(0.0)
    for i in range(3):
        row = contact_efc[contact, i]
        if row >= 0 and row < njmax:
            local[i] = efc_force[world, row]
    force = wp.transpose(contact_frame[contact]) * local  # on the second geom
    other = first
    if first == _OBJECT:
        force = -force
        other = second
    if other == _TABLE:
        wp.atomic_add(table_force, world, force)
    elif other >= 0:
        wp.atomic_add(tip_force, world, other, force)
        if local[0] > 0.0:
            tip_touch[world, other] = True
