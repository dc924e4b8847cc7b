"""The MuJoCo C engine: the reference, and fast on CPUs."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from xreset.backends.base import Capability, unavailable
from xreset.backends.pool import PoolBackend, World
from xreset.spec import SceneSpec

try:
    import mujoco
except ImportError as error:
    raise unavailable("mujoco", "mujoco", error) from error

from xreset.backends.mjcf import MIN_FRICTION, OBJECT, TABLE, SceneModel, compile_scene


class MujocoWorld(World):
    """One world in MuJoCo."""

    def __init__(self, scene: SceneSpec, object_index: int) -> None:
        """See :class:`World`."""
        if mujoco.get_mju_user_warning() is None:  # the default writes a log file into the current folder
            mujoco.set_mju_user_warning(lambda _: None)
        self._at: SceneModel = _compiled(_Same(scene), object_index)
        self._model = copy(self._at.model)  # each world has parameters of its own
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a broken world must be seen, not silently put back
        self._data = mujoco.MjData(self._model)
        self._stepped = False
        self._overflows_before = 0

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """See :meth:`World.set_state`."""
        at, data = self._at, self._data
        mujoco.mj_resetData(self._model, data)
        self._stepped, self._overflows_before = False, 0
        q, v = data.qpos, data.qvel
        q[at.joint_qpos] = state["joint_pos"]
        v[at.joint_dof] = state["joint_vel"]
        q[at.mimic_qpos] = at.mimic_multiplier * state["joint_pos"][at.mimic_source] + at.mimic_offset
        v[at.mimic_dof] = at.mimic_multiplier * state["joint_vel"][at.mimic_source]
        data.ctrl[:] = state["joint_target"]
        quat = state["object_quat"] / np.linalg.norm(state["object_quat"])
        q[at.object_qpos : at.object_qpos + 3] = state["object_pos"]
        q[at.object_qpos + 3 : at.object_qpos + 7] = quat
        v[at.object_dof : at.object_dof + 3] = state["object_linvel"]
        v[at.object_dof + 3 : at.object_dof + 6] = _rotate_inverse(quat, state["object_angvel"])
        self._update_kinematics()

    def get_state(self) -> dict[str, np.ndarray]:
        """See :meth:`World.get_state`."""
        at, q, v = self._at, self._data.qpos, self._data.qvel
        quat = q[at.object_qpos + 3 : at.object_qpos + 7].copy()
        return {
            "joint_pos": q[at.joint_qpos],
            "joint_vel": v[at.joint_dof],
            "joint_target": self._data.ctrl.copy(),
            "object_pos": q[at.object_qpos : at.object_qpos + 3].copy(),
            "object_quat": quat,
            "object_linvel": v[at.object_dof : at.object_dof + 3].copy(),
            "object_angvel": _rotate(quat, v[at.object_dof + 3 : at.object_dof + 6]),  # a free joint's is in the body's frame
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        """See :meth:`World.set_joint_targets`."""
        self._data.ctrl[:] = targets

    def step(self, n: int) -> None:
        """See :meth:`World.step`."""
        self._overflows_before = self._overflows()
        mujoco.mj_step(self._model, self._data, n)
        self._stepped = True
        self._update_kinematics()

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.links`."""
        at, data = self._at, self._data
        body = at.link_body
        rotation = data.xmat[body].reshape(-1, 3, 3)
        pos = data.xpos[body] + np.einsum("kij,kj->ki", rotation, at.link_pos)
        quat = _multiply(data.xquat[body], at.link_quat)
        angvel, about_com = data.cvel[body, :3], data.cvel[body, 3:]
        arm = pos - data.subtree_com[self._model.body_rootid[body]]  # MuJoCo refers velocities to the centre of mass of the whole tree
        return pos, quat, about_com + np.cross(angvel, arm), angvel.copy()

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.contacts`."""
        at, data = self._at, self._data
        tips = len(at.link_body) - 1
        tip_force, touch, table_force = np.zeros((tips, 3)), np.zeros(tips, dtype=bool), np.zeros(3)
        if not self._stepped or data.ncon == 0:
            return tip_force, touch, table_force
        contact = data.contact
        roles = at.geom_role[contact.geom]  # [C, 2]
        first, second = roles.T
        mine = ((first == OBJECT) != (second == OBJECT)) & (contact.efc_address >= 0)
        if not mine.any():
            return tip_force, touch, table_force
        rows = contact.efc_address[mine]
        local = data.efc_force[rows[:, None] + np.arange(3)]  # elliptic cone: normal and two tangential forces
        # A contact's force acts on the second geom, its frame's rows are the normal and the tangents.
        force = np.einsum("ci,cij->cj", local, contact.frame[mine].reshape(-1, 3, 3))
        on_object = np.where((second[mine] == OBJECT)[:, None], force, -force)
        other = np.where(second[mine] == OBJECT, first[mine], second[mine])
        table_force = on_object[other == TABLE].sum(axis=0)
        for tip in range(tips):
            by = other == tip
            tip_force[tip] = on_object[by].sum(axis=0)
            touch[tip] = (local[by, 0] > 0.0).any()
        return tip_force, touch, table_force

    def health(self) -> tuple[bool, bool]:
        """See :meth:`World.health`."""
        data = self._data
        finite = np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()
        return not finite, self._overflows() > self._overflows_before

    def set_object_mass(self, mass: float) -> None:
        """See :meth:`World.set_object_mass`."""
        at, model, nominal = self._at, self._model, self._at.model
        body, dofs = at.object_body, slice(at.object_dof, at.object_dof + 6)
        ratio = mass / nominal.body_mass[body]
        model.body_mass[body] = model.body_subtreemass[body] = mass
        model.body_subtreemass[0] = nominal.body_subtreemass[0] + mass - nominal.body_mass[body]
        model.body_inertia[body] = ratio * nominal.body_inertia[body]
        model.body_invweight0[body] = nominal.body_invweight0[body] / ratio  # of a free body: the inverse of mass and inertia
        model.dof_invweight0[dofs] = nominal.dof_invweight0[dofs] / ratio

    def set_friction(self, friction: np.ndarray) -> None:
        """See :meth:`World.set_friction`."""
        pairs = np.maximum((*friction, 0.0), MIN_FRICTION)
        self._model.geom_friction[:, 0] = pairs[self._at.friction_column]

    def set_object_gravity(self, fraction: float) -> None:
        """See :meth:`World.set_object_gravity`."""
        self._model.body_gravcomp[self._at.object_body] = 1.0 - fraction

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        """See :meth:`World.set_object_wrench`."""
        wrench = self._data.xfrc_applied[self._at.object_body]
        wrench[:3], wrench[3:] = force, torque

    def _overflows(self) -> int:
        """How often contacts or constraints have found no room so far."""
        kinds = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
        return sum(int(self._data.warning[int(kind)].number) for kind in kinds)

    def _update_kinematics(self) -> None:
        """Bring link poses and velocities up to date with qpos and qvel; contact forces stay those of the last step."""
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_comVel(self._model, self._data)


class MujocoBackend(PoolBackend):
    """MuJoCo on the CPU, worlds in a pool of processes."""

    name: ClassVar[str] = "mujoco"
    capabilities: ClassVar[frozenset[Capability]] = frozenset(("object_mass", "friction", "object_gravity", "object_wrench", "overflow"))
    world_class: ClassVar[type[World]] = MujocoWorld

    @classmethod
    def engine_version(cls) -> str:
        """See :meth:`Backend.engine_version`."""
        return mujoco.__version__


# Compiling takes longer than copying, and the worlds of one process share a scene --------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Same:
    """A scene that equals itself only: scenes hold arrays and cannot be hashed by content."""

    scene: SceneSpec

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.scene is self.scene

    def __hash__(self) -> int:
        return id(self.scene)


@lru_cache(maxsize=32)
def _compiled(key: _Same, object_index: int) -> SceneModel:
    return compile_scene(key.scene, object_index)


# Quaternions (numpy) -------------------------------------------------------------------------------------------------------------------


def _rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    out = np.empty(3)
    mujoco.mju_rotVecQuat(out, vector, quat)
    return out


def _rotate_inverse(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return _rotate(quat * np.array([1.0, -1.0, -1.0, -1.0]), vector)


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[K, 4] quaternion products."""
    out = np.empty_like(a)
    for row, left, right in zip(out, a, b, strict=True):
        mujoco.mju_mulQuat(row, left, right)
    return out
