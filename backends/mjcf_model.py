"""Where the parts of a scene are in a MuJoCo model: addresses of joints, bodies, shapes and sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from xreset.backends.rigid import Body, Mechanism

TABLE, OTHER_LINK, OBJECT = -1, -2, -3
"""Values of :attr:`SceneModel.geom_role` beside the fingertip indices 0..E-1."""

MIN_FRICTION = 1e-4
"""Sliding friction of the object's own geoms, and the smallest of any pair."""


@dataclass(frozen=True, kw_only=True)
class SceneModel:
    """A compiled model and where the scene's parts are in it.

    Letters: J actuated joints, Q mimic joints, K tracked links, E fingertips, G geoms.
    """

    model: mujoco.MjModel
    joint_qpos: np.ndarray
    """[J] addresses in qpos, in joint order."""
    joint_dof: np.ndarray
    """[J] addresses in qvel. Actuator i drives joint i."""
    mimic_qpos: np.ndarray
    """[Q]"""
    mimic_dof: np.ndarray
    """[Q]"""
    mimic_source: np.ndarray
    """[Q] index of the source in joint order."""
    mimic_multiplier: np.ndarray
    """[Q]"""
    mimic_offset: np.ndarray
    """[Q]"""
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
    """[S] fingertip of each geom that has a contact sensor; empty without sensors (see :func:`xreset.backends.mjcf.compile_scene`)."""

    @property
    def friction_column(self) -> np.ndarray:
        """[G] which of the frictions (object-tip, object-other link, object-table) a geom decides; 3 for the object's own geoms.

        MuJoCo gives a pair the larger friction of its geoms, and the object's own stays at :data:`MIN_FRICTION`.
        """
        return np.select(
            [self.geom_role >= 0, self.geom_role == OTHER_LINK, self.geom_role == TABLE], [0, 1, 2], default=3
        )


def body_name(body: Body) -> str:
    """The name of a body of the robot."""
    return f"robot/{body.name}"


def pos_quat(T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position [3] and quaternion [4] (w, x, y, z) of a pose [4, 4]."""
    return T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True)


_NET_FORCE = (
    1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE),
    3,
    1,
)  # intprm of a contact sensor: what, reduced to the net force, once


def add_sensors(spec: mujoco.MjSpec, robot: Mechanism, roles: dict[str, int]) -> list[int]:
    """Add what :func:`xreset.backends.mjcf.compile_scene` says; returns the fingertip of each geom sensed."""
    sites = []
    for i, link in enumerate(robot.robot.tracked_links):
        body, T = robot.frames[link]
        pos, quat = pos_quat(T)
        sites.append(spec.body(body_name(robot.bodies[body])).add_site(name=f"link/{i}", pos=pos, quat=quat).name)
    kind, site = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_SITE
    for quantity in (kind.mjSENS_FRAMEPOS, kind.mjSENS_FRAMEQUAT, kind.mjSENS_FRAMELINVEL, kind.mjSENS_FRAMEANGVEL):
        for name in sites:
            spec.add_sensor(type=quantity, objtype=site, objname=name)
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


def locate(
    robot: Mechanism, model: mujoco.MjModel, roles: dict[str, int], parked: set[str], sensed: list[int]
) -> SceneModel:
    """Find the parts; ``roles``: geom -> its role, ``sensed``: fingertip of each geom that has a sensor."""
    joints, mimics = robot.robot.joint_names, robot.robot.mimics
    names = [model.geom(i).name for i in range(model.ngeom)]
    frames = [robot.frames[link] for link in robot.robot.tracked_links]
    poses = [pos_quat(T) for _, T in frames]
    qpos = {model.joint(i).name: int(model.jnt_qposadr[i]) for i in range(model.njnt)}
    dof = {model.joint(i).name: int(model.jnt_dofadr[i]) for i in range(model.njnt)}

    def addresses(table: dict[str, int], joints: Sequence[str]) -> np.ndarray:
        return np.array([table[name] for name in joints], dtype=np.int64)

    return SceneModel(
        model=model,
        joint_qpos=addresses(qpos, joints),
        joint_dof=addresses(dof, joints),
        mimic_qpos=addresses(qpos, [mimic.joint for mimic in mimics]),
        mimic_dof=addresses(dof, [mimic.joint for mimic in mimics]),
        mimic_source=np.array([joints.index(mimic.source) for mimic in mimics], dtype=np.int64),
        mimic_multiplier=np.array([mimic.multiplier for mimic in mimics], dtype=np.float64),
        mimic_offset=np.array([mimic.offset for mimic in mimics], dtype=np.float64),
        link_body=np.array([model.body(body_name(robot.bodies[i])).id for i, _ in frames], dtype=np.int64),
        link_pos=np.array([pos for pos, _ in poses]),
        link_quat=np.array([quat for _, quat in poses]),
        moving_bodies=np.array([model.body(body_name(body)).id for body in robot.bodies[1:]], dtype=np.int64),
        object_body=model.body("object").id,
        object_qpos=qpos["object"],
        object_dof=dof["object"],
        geom_role=np.array([roles.get(name, OBJECT) for name in names], dtype=np.int64),
        parked=np.array([name in parked for name in names]),
        sensed_tip=np.array(sensed, dtype=np.int64),
    )
