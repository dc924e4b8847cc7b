"""The MuJoCo C engine: the reference, and fast on CPUs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, get_args

import numpy as np

from xreset.backends.base import Capability, KnownDifference, unavailable
from xreset.backends.pool import PoolBackend, World
from xreset.backends.rigid import Inertia
from xreset.spec import SceneSpec

try:
    import mujoco
except ImportError as error:
    raise unavailable("mujoco", "mujoco", error) from error

from xreset.backends.mjcf import KNOWN_DIFFERENCES, MIN_FRICTION, MujocoSettings, SceneModel, compile_scene

_FULL = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
"""The engine's warnings that contacts or constraints have found no room."""


_DEFAULTS = MujocoSettings()


class MujocoWorld(World):
    """One world in MuJoCo.

    The engine's step has two halves: what follows from positions and velocities (``mj_step1``: kinematics, contacts), and forces and
    motion (``mj_step2``). The first half of the next step is always done in advance, so links are up to date at no cost.
    """

    def __init__(self, scene: SceneSpec, object_index: int, *, settings: MujocoSettings = _DEFAULTS) -> None:
        """See :class:`World`."""
        if mujoco.get_mju_user_warning() is None:  # the default writes a log file into the current folder
            mujoco.set_mju_user_warning(lambda _: None)
        self._at: SceneModel = _compiled(_Same(scene), object_index, settings)
        self._model = copy(self._at.model)  # each world has parameters of its own
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a broken world must be seen, not silently put back
        self._data = mujoco.MjData(self._model)
        self._option = self._model.opt
        self._silent = self._option.disableflags | mujoco.mjtDisableBit.mjDSBL_SENSOR
        self._sensing = self._option.disableflags
        self._option.disableflags = self._silent  # sensors are read once per step(), not computed in each physics step
        self._stale = False  # whether a parameter has changed since the first half of the next step was done
        self._overflowed, self._overflows = False, 0

        # Views of the engine's own memory, which stays where it is: making one costs as much as reading it.
        data, links = self._data, len(self._at.link_body)
        self._ctrl, self._qpos, self._qvel = data.ctrl, data.qpos, data.qvel
        self._wrench = data.xfrc_applied[self._at.object_body]
        sizes = np.cumsum((3 * links, 4 * links, 3 * links, 3 * links, 3))
        pos, quat, linvel, angvel, self._table_force, tip_forces = np.split(data.sensordata, sizes)
        self._links = pos.reshape(-1, 3), quat.reshape(-1, 4), linvel.reshape(-1, 3), angvel.reshape(-1, 3)
        self._geom_forces = tip_forces.reshape(-1, 3)
        self._sum_by_tip = -(self._at.sensed_tip == np.arange(links - 1)[:, None]).astype(np.float64)  # minus: of the tip on the object
        self._full = [data.warning[int(kind)] for kind in _FULL]
        self._ones = np.ones(len(data.qpos)), np.ones(len(data.qvel))

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """See :meth:`World.set_state`."""
        at, data = self._at, self._data
        mujoco.mj_resetData(self._model, data)
        self._overflowed, self._overflows = False, 0
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
        self._begin_next_step()

    def get_state(self) -> dict[str, np.ndarray]:
        """See :meth:`World.get_state`."""
        at, q, v = self._at, self._qpos, self._qvel
        quat = q[at.object_qpos + 3 : at.object_qpos + 7].copy()
        return {
            "joint_pos": q[at.joint_qpos],
            "joint_vel": v[at.joint_dof],
            "joint_target": self._ctrl.copy(),
            "object_pos": q[at.object_qpos : at.object_qpos + 3].copy(),
            "object_quat": quat,
            "object_linvel": v[at.object_dof : at.object_dof + 3].copy(),
            "object_angvel": _rotate(quat, v[at.object_dof + 3 : at.object_dof + 6]),  # a free joint's is in the body's frame
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        """See :meth:`World.set_joint_targets`."""
        self._ctrl[:] = targets

    def step(self, n: int) -> None:
        """See :meth:`World.step`."""
        if self._stale:
            mujoco.mj_step1(self._model, self._data)
        mujoco.mj_step2(self._model, self._data)
        if n > 1:
            mujoco.mj_step(self._model, self._data, n - 1)
        before, self._overflows = self._overflows, sum(warning.number for warning in self._full)
        self._overflowed = self._overflows > before
        self._option.disableflags = self._sensing
        mujoco.mj_sensorAcc(self._model, self._data)  # while the contacts are those of the last step
        self._begin_next_step()

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.links`."""
        return self._links

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.contacts`."""
        tip_force = self._sum_by_tip @ self._geom_forces
        # A contact in which no force acts is no touch.
        return tip_force, tip_force.any(axis=1), -self._table_force

    def health(self) -> tuple[bool, bool]:
        """See :meth:`World.health`."""
        q_ones, v_ones = self._ones
        finite = math.isfinite(self._qpos.dot(q_ones) + self._qvel.dot(v_ones))  # one bad number spoils a sum; cheaper than looking at each
        return not finite, self._overflowed

    def mass_properties(self) -> list[Inertia]:
        """See :meth:`World.mass_properties`."""
        m = self._model
        bodies = (*self._at.moving_bodies, self._at.object_body)
        return [Inertia(mass=m.body_mass[i], com=m.body_ipos[i], quat=m.body_iquat[i], moments=m.body_inertia[i]) for i in bodies]

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
        self._stale = True

    def set_friction(self, friction: np.ndarray) -> None:
        """See :meth:`World.set_friction`."""
        pairs = np.maximum((*friction, 0.0), MIN_FRICTION)
        self._model.geom_friction[:, 0] = pairs[self._at.friction_column]
        self._stale = True

    def set_object_gravity(self, fraction: float) -> None:
        """See :meth:`World.set_object_gravity`."""
        self._model.body_gravcomp[self._at.object_body] = 1.0 - fraction
        self._stale = True

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        """See :meth:`World.set_object_wrench`."""
        self._wrench[:3], self._wrench[3:] = force, torque

    def _begin_next_step(self) -> None:
        """Do the first half of the next step, and read the links; contact forces stay those of the last step."""
        self._option.disableflags = self._sensing
        mujoco.mj_step1(self._model, self._data)
        self._option.disableflags = self._silent
        self._stale = False


class MujocoBackend(PoolBackend):
    """MuJoCo on the CPU, worlds in a pool of processes; the keyword ``settings`` takes :class:`MujocoSettings`."""

    name: ClassVar[str] = "mujoco"
    capabilities: ClassVar[frozenset[Capability]] = frozenset(get_args(Capability))
    known_differences: ClassVar[tuple[KnownDifference, ...]] = KNOWN_DIFFERENCES
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
def _compiled(key: _Same, object_index: int, settings: MujocoSettings) -> SceneModel:
    return compile_scene(key.scene, object_index, sensors=True, settings=settings)


# Quaternions (numpy) -------------------------------------------------------------------------------------------------------------------


def _rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    out = np.empty(3)
    mujoco.mju_rotVecQuat(out, vector, quat)
    return out


def _rotate_inverse(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return _rotate(quat * np.array([1.0, -1.0, -1.0, -1.0]), vector)
