"""Warp kernels that translate between MuJoCo-Warp's arrays and the project's, on the device.

Letters are those of :mod:`xreset.physics`; Q mimic joints. Quaternions are stored (w, x, y, z) in a ``wp.quat``, as in
MuJoCo.
"""

from __future__ import annotations

import warp as wp

from xreset.backends.mjcf_model import MOST_BRAKING, OBJECT
from xreset.backends.rigid import TABLE

_OBJECT = wp.constant(OBJECT)
_TABLE = wp.constant(TABLE)
_MOST_BRAKING = wp.constant(MOST_BRAKING)
_Frictions = wp.types.vector(length=5, dtype=float)


@wp.func
def _multiply(a: wp.quat, b: wp.quat) -> wp.quat:
    return wp.quat(
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@wp.func
def _rotate(q: wp.quat, v: wp.vec3) -> wp.vec3:
    u = wp.vec3(q[1], q[2], q[3])
    t = 2.0 * wp.cross(u, v)
    return v + q[0] * t + wp.cross(u, t)


@wp.func
def _conjugate(q: wp.quat) -> wp.quat:
    return wp.quat(q[0], -q[1], -q[2], -q[3])


@wp.kernel(enable_backward=False)
def write_state(
    # The new state of each world; only the chosen ones take it.
    chosen: wp.array[wp.bool],
    joint_pos: wp.array2d[float],
    joint_vel: wp.array2d[float],
    joint_target: wp.array2d[float],
    object_pos: wp.array[wp.vec3],
    object_quat: wp.array[wp.quat],
    object_linvel: wp.array[wp.vec3],
    object_angvel: wp.array[wp.vec3],
    # Where it goes.
    joint_qpos: wp.array[int],
    joint_dof: wp.array[int],
    mimic_qpos: wp.array[int],
    mimic_dof: wp.array[int],
    mimic_source: wp.array[int],
    mimic_multiplier: wp.array[float],
    mimic_offset: wp.array[float],
    object_qpos: int,
    object_dof: int,
    object_body: int,
    # Out.
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    ctrl: wp.array2d[float],
    qacc_warmstart: wp.array2d[float],
    xfrc_applied: wp.array2d[wp.spatial_vector],
    overflow: wp.array[int],
    nonfinite: wp.array[wp.bool],
    tip_force: wp.array2d[wp.vec3],
    tip_touch: wp.array2d[wp.bool],
    table_force: wp.array[wp.vec3],
):
    """Set the state of some worlds and clear what remains of their past."""
    world = wp.tid()
    if not chosen[world]:
        return
    for j in range(joint_qpos.shape[0]):
        qpos[world, joint_qpos[j]] = joint_pos[world, j]
        qvel[world, joint_dof[j]] = joint_vel[world, j]
        ctrl[world, j] = joint_target[world, j]
    for i in range(mimic_qpos.shape[0]):
        j = mimic_source[i]
        qpos[world, mimic_qpos[i]] = mimic_multiplier[i] * joint_pos[world, j] + mimic_offset[i]
        qvel[world, mimic_dof[i]] = mimic_multiplier[i] * joint_vel[world, j]
    quat = object_quat[world]
    length = wp.sqrt(quat[0] * quat[0] + quat[1] * quat[1] + quat[2] * quat[2] + quat[3] * quat[3])
    unit = wp.quat(quat[0] / length, quat[1] / length, quat[2] / length, quat[3] / length)
    # a free joint's angular velocity is in the body's frame
    local_angvel = _rotate(_conjugate(unit), object_angvel[world])
    for k in range(3):
        qpos[world, object_qpos + k] = object_pos[world][k]
        qvel[world, object_dof + k] = object_linvel[world][k]
        qvel[world, object_dof + 3 + k] = local_angvel[k]
    for k in range(4):
        qpos[world, object_qpos + 3 + k] = unit[k]
    for k in range(qacc_warmstart.shape[1]):
        qacc_warmstart[world, k] = 0.0
    xfrc_applied[world, object_body] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    overflow[world] = 0
    nonfinite[world] = False
    for e in range(tip_force.shape[1]):
        tip_force[world, e] = wp.vec3(0.0)
        tip_touch[world, e] = False
    table_force[world] = wp.vec3(0.0)


@wp.kernel(enable_backward=False)
def write_parameters(
    # Which worlds take the parameters that there are for each.
    chosen: wp.array[wp.bool],
    friction: wp.array[wp.vec3],
    torsional_friction: wp.array[float],
    object_mass: wp.array[float],
    object_inertia: wp.array[float],
    object_com: wp.array[wp.vec3],
    object_gravity: wp.array[float],
    drives: wp.array3d[float],
    # What they start from.
    nominal_mass: wp.array[float],
    nominal_inertia: wp.array[wp.vec3],
    nominal_com: wp.array[wp.vec3],
    nominal_total: wp.array[float],
    nominal_invweight: wp.array[wp.vec2],
    nominal_drive: wp.array2d[float],
    friction_column: wp.array[int],
    min_friction: float,
    object_body: int,
    # Out.
    body_mass: wp.array2d[float],
    body_inertia: wp.array2d[wp.vec3],
    body_ipos: wp.array2d[wp.vec3],
    body_subtreemass: wp.array2d[float],
    body_invweight: wp.array2d[wp.vec2],
    body_gravcomp: wp.array2d[float],
    geom_friction: wp.array2d[wp.vec3],
    gain: wp.array3d[float],
    bias: wp.array3d[float],
    force_range: wp.array3d[float],
):
    """Set the physical parameters of some worlds, and all that MuJoCo derives from them."""
    world = wp.tid()
    if not chosen[world]:
        return
    mass = object_mass[world]
    ratio = mass / nominal_mass[world]
    turning = ratio * object_inertia[world]
    body_mass[world, object_body] = mass
    body_inertia[world, object_body] = nominal_inertia[world] * turning
    body_ipos[world, object_body] = nominal_com[world] + object_com[world]
    body_subtreemass[world, object_body] = mass
    body_subtreemass[world, 0] = nominal_total[world] + mass - nominal_mass[world]
    weight = nominal_invweight[world]  # of a free body: the inverse of mass and inertia
    body_invweight[world, object_body] = wp.vec2(weight[0] / ratio, weight[1] / turning)
    body_gravcomp[world, object_body] = 1.0 - object_gravity[world]
    for g in range(friction_column.shape[0]):
        column = friction_column[g]
        slide = min_friction
        if column < 3:
            slide = wp.max(friction[world][column], min_friction)
        geom_friction[world, g] = wp.vec3(
            slide, torsional_friction[world], geom_friction[world, g][2]
        )
    for j in range(nominal_drive.shape[0]):
        stiffness = drives[world, 0, j] * nominal_drive[j, 0]
        effort = drives[world, 2, j] * nominal_drive[j, 2]
        gain[world, j, 0] = stiffness
        bias[world, j, 0] = drives[world, 0, j] * nominal_drive[j, 3]
        bias[world, j, 1] = -stiffness
        bias[world, j, 2] = -drives[world, 1, j] * nominal_drive[j, 1]
        force_range[world, j, 0] = -effort
        force_range[world, j, 1] = effort


@wp.kernel(enable_backward=False)
def read_state(
    joint_qpos: wp.array[int],
    joint_dof: wp.array[int],
    object_qpos: int,
    object_dof: int,
    qpos: wp.array2d[float],
    qvel: wp.array2d[float],
    # Out.
    joint_pos: wp.array2d[float],
    joint_vel: wp.array2d[float],
    object_pos: wp.array[wp.vec3],
    object_quat: wp.array[wp.quat],
    object_linvel: wp.array[wp.vec3],
    object_angvel: wp.array[wp.vec3],
    nonfinite: wp.array[wp.bool],
):
    """Translate qpos and qvel, one thread a world."""
    world = wp.tid()
    for j in range(joint_qpos.shape[0]):
        joint_pos[world, j] = qpos[world, joint_qpos[j]]
        joint_vel[world, j] = qvel[world, joint_dof[j]]
    q = object_qpos
    v = object_dof
    quat = wp.quat(qpos[world, q + 3], qpos[world, q + 4], qpos[world, q + 5], qpos[world, q + 6])
    object_pos[world] = wp.vec3(qpos[world, q], qpos[world, q + 1], qpos[world, q + 2])
    object_quat[world] = quat
    object_linvel[world] = wp.vec3(qvel[world, v], qvel[world, v + 1], qvel[world, v + 2])
    object_angvel[world] = _rotate(
        quat, wp.vec3(qvel[world, v + 3], qvel[world, v + 4], qvel[world, v + 5])
    )
    for i in range(qpos.shape[1]):
        if not wp.isfinite(qpos[world, i]):
            nonfinite[world] = True
    for i in range(qvel.shape[1]):
        if not wp.isfinite(qvel[world, i]):
            nonfinite[world] = True


@wp.kernel(enable_backward=False)
def read_links(
    link_body: wp.array[int],
    link_pos: wp.array[wp.vec3],
    link_quat: wp.array[wp.quat],
    body_rootid: wp.array[int],
    xpos: wp.array2d[wp.vec3],
    xquat: wp.array2d[wp.quat],
    cvel: wp.array2d[wp.spatial_vector],
    subtree_com: wp.array2d[wp.vec3],
    # Out.
    pos: wp.array2d[wp.vec3],
    quat: wp.array2d[wp.quat],
    linvel: wp.array2d[wp.vec3],
    angvel: wp.array2d[wp.vec3],
):
    """Poses and velocities of the tracked links, one thread a link."""
    world, k = wp.tid()
    body = link_body[k]
    body_quat = xquat[world, body]
    point = xpos[world, body] + _rotate(body_quat, link_pos[k])
    velocity = cvel[world, body]  # angular, then linear at the centre of mass of the whole tree
    omega = wp.spatial_top(velocity)
    pos[world, k] = point
    quat[world, k] = _multiply(body_quat, link_quat[k])
    angvel[world, k] = omega
    linvel[world, k] = wp.spatial_bottom(velocity) + wp.cross(
        omega, point - subtree_com[world, body_rootid[body]]
    )


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


@wp.kernel(enable_backward=False)
def keep_sliding_contacts(
    nacon: wp.array[int],
    naconmax: int,
    contact_world: wp.array[int],
    contact_efc: wp.array2d[int],
    contact_friction: wp.array[_Frictions],
    # In and out.
    reference: wp.array2d[float],
):
    """Take from a contact's reference acceleration what would throw sliding bodies up; see ``MOST_BRAKING``."""
    contact = wp.tid()
    if contact >= wp.min(nacon[0], naconmax):
        return
    normal = contact_efc[contact, 0]
    first = contact_efc[contact, 1]
    second = contact_efc[contact, 2]
    spin = contact_efc[contact, 3]
    if normal < 0 or spin < 0:  # the contact is too far, or there was no room for it
        return
    world = contact_world[contact]
    friction = contact_friction[contact]
    slip = wp.vec2(reference[world, first], reference[world, second])
    braking = wp.length(slip)
    if braking > _MOST_BRAKING:
        slip = slip * (_MOST_BRAKING / braking)
        reference[world, first] = slip[0]
        reference[world, second] = slip[1]
    sliding = friction[0] * wp.length(slip)
    spinning = friction[2] * reference[world, spin]
    reference[world, normal] -= wp.sqrt(sliding * sliding + spinning * spinning)
