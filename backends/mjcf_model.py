"""Where the parts of a scene are in a MuJoCo model: addresses of joints, bodies, shapes and sensors."""

from __future__ import annotations

import mujoco
import numpy as np

from xreset.backends.rigid import (
    OTHER_LINK,
    TABLE,
    Body,
    Mechanism,
    MovingJoints,
    TrackedFrames,
    matrix_to_quat,
)
from xreset.files.checks import frozen
from xreset.spec import SceneSpec

OBJECT = -3
"""Value of :attr:`SceneModel.geom_role` for the geoms of the object itself."""

MIN_FRICTION = 1e-4
"""Sliding friction of the object's own geoms, and the smallest of any pair."""

MOST_BRAKING = 50.0
"""Fastest deceleration [m/s^2] of sliding that a contact demands from the solver.

MuJoCo solves contacts with friction as a convex problem. Its solution meets, for a contact that slides, not "no motion
along the normal" but "a motion along the normal of mu times the slip that friction could not remove" (Anitescu 2006,
Optimization-based simulation of nonsmooth rigid multibody dynamics; Castro et al. 2022, An unconstrained convex
formulation of compliant contact). So a slab that starts to slide at 1 m/s hops by 10 mm, and a pushed one loses the
finger and the table. De Saxce and Feng (1998, The bipotential method) give the cure: take mu times the slip from the
motion along the normal that the contact asks for. Both engines do that with the slip at the beginning of a step, after
they have limited it to what this deceleration removes. Without the limit, fast impacts would press deeper.
"""


@frozen
class SceneModel:
    """A compiled model and where the scene's parts are in it.

    Letters: J actuated joints, Q mimic joints, K tracked links, E fingertips, G geoms.
    """

    scene: SceneSpec
    spec: mujoco.MjSpec
    """What the model was compiled from, for other builds of MuJoCo. Its text has fewer digits than the model, and the
    object's centre of mass is elsewhere in it: copy the arrays of the model into one that is made from the text."""
    model: mujoco.MjModel
    joints: MovingJoints
    """The actuated joints, then the mimic joints. Actuator i drives actuated joint i."""
    qpos: np.ndarray
    """[J + Q] addresses of these joints in qpos."""
    dof: np.ndarray
    """[J + Q] addresses of these joints in qvel."""
    link_body: np.ndarray
    """[K] body that each tracked link is part of."""
    link_pos: np.ndarray
    """[K, 3] position of the tracked link in that body's frame."""
    link_quat: np.ndarray
    """[K, 4]"""
    moving_bodies: np.ndarray
    """[B] the robot's bodies that move, in the order of the mechanism."""
    object_body: int
    """Its frame is the object's mesh frame."""
    object_qpos: int
    """First of 7 addresses in qpos."""
    object_dof: int
    """First of 6 addresses in qvel."""
    geom_role: np.ndarray
    """[G] what a geom is: index of the fingertip it belongs to, or TABLE, OTHER_LINK, OBJECT."""
    parked: np.ndarray
    """[G] bool: an object's shape slot that this object does not use."""
    sensed_tip: np.ndarray
    """[S] fingertip of each geom that has a contact sensor; empty without sensors, see ``mjcf.compile_scene``."""

    @property
    def friction_column(self) -> np.ndarray:
        """[G] which friction (object-tip, object-other link, object-table) a geom sets; 3 for the object's own geoms.

        MuJoCo gives a pair the larger friction of its geoms, and the object's own stays at :data:`MIN_FRICTION`.
        """
        roles = self.geom_role
        return np.select([roles >= 0, roles == OTHER_LINK, roles == TABLE], [0, 1, 2], default=3)


def body_name(body: Body) -> str:
    """Return the name of a body of the robot."""
    return f"robot/{body.name}"


def pos_quat(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return position [3] and quaternion [4] (w, x, y, z) of a pose [4, 4]."""
    return T[:3, 3], matrix_to_quat(T[:3, :3])


_NET_FORCE = (1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 3, 1)
"""Parameters of a contact sensor: the force, reduced to the net force, once."""


def add_sensors(
    spec: mujoco.MjSpec, robot: Mechanism, frames: TrackedFrames, roles: dict[str, int]
) -> list[int]:
    """Add the sensors that ``mjcf.compile_scene`` describes; return the fingertip of each geom that has one."""
    sites = []
    for i, body in enumerate(frames.bodies):
        site = spec.body(body_name(robot.bodies[body])).add_site(
            name=f"link/{i}", pos=frames.pos[i], quat=frames.quat[i]
        )
        sites.append(site.name)
    kind = mujoco.mjtSensor
    for quantity in (
        kind.mjSENS_FRAMEPOS,
        kind.mjSENS_FRAMEQUAT,
        kind.mjSENS_FRAMELINVEL,
        kind.mjSENS_FRAMEANGVEL,
    ):
        for name in sites:
            spec.add_sensor(type=quantity, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=name)
    tips = {geom: role for geom, role in roles.items() if role >= 0}
    for geom in ("table", *tips):
        spec.add_sensor(
            type=kind.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname="object",
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=geom,
            intprm=_NET_FORCE,
        )
    return list(tips.values())
