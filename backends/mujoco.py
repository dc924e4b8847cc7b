"""The MuJoCo C engine: the reference, and fast on CPUs."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, get_args

import numpy as np

from xreset.backends.pool import PoolBackend, World
from xreset.backends.rigid import Inertia, object_inertia
from xreset.physics import Capability, KnownDifference, unavailable
from xreset.spec import SceneSpec

try:
    import mujoco
except ImportError as error:
    raise unavailable("mujoco", "'xreset[mujoco]'", error) from error

from xreset.backends.mjcf import KNOWN_DIFFERENCES, MujocoSettings, compile_scene
from xreset.backends.mjcf_model import MIN_FRICTION, SceneModel

_FULL = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
"""The engine's warnings that contacts or constraints have found no room."""


_DEFAULTS = MujocoSettings()


class MujocoWorld(World):
    """One world in MuJoCo.

    The engine's step has two halves: what follows from positions and velocities (``mj_step1``: kinematics, contacts), and forces and
    motion (``mj_step2``). When links are asked for, the first half of the next step is done in advance: they are then up to date, and
    nothing is done twice, unless a parameter changes before that step.
    """

    def __init__(self, scene: SceneSpec, object_index: int, *, settings: MujocoSettings = _DEFAULTS) -> None:
        if mujoco.get_mju_user_warning() is None:  # the default writes a log file into the current folder
            mujoco.set_mju_user_warning(lambda _: None)
        self._at: SceneModel = _compiled(_Same(scene), object_index, settings)
        self._model = copy(self._at.model)  # each world has parameters of its own
        self._model.opt.disableflags |= (
            mujoco.mjtDisableBit.mjDSBL_AUTORESET
        )  # a broken world must be seen, not silently put back
        self._data = mujoco.MjData(self._model)
        self._option = self._model.opt
        self._silent = self._option.disableflags | mujoco.mjtDisableBit.mjDSBL_SENSOR
        self._sensing = self._option.disableflags
        self._option.disableflags = (
            self._silent
        )  # sensors are read when they are asked for, not computed in each physics step
        self._ahead = False  # whether the first half of the next step is done, with the present parameters
        self._links_sensed = self._contacts_sensed = False
        self._overflowed, self._overflows = False, 0

        # Views of the engine's own memory, which stays where it is: making one costs as much as reading it.
        data, links = self._data, len(self._at.link_body)
        self._ctrl, self._qpos, self._qvel = data.ctrl, data.qpos, data.qvel
        at, q, v = self._at, self._qpos, self._qvel
        self._wrench = data.xfrc_applied[at.object_body]
        self._object_pos, self._object_quat = (
            q[at.object_qpos : at.object_qpos + 3],
            q[at.object_qpos + 3 : at.object_qpos + 7],
        )
        self._object_linvel, self._object_spin = (
            v[at.object_dof : at.object_dof + 3],
            v[at.object_dof + 3 : at.object_dof + 6],
        )
        sizes = np.cumsum((3 * links, 4 * links, 3 * links, 3 * links, 3))
        pos, quat, linvel, angvel, self._table_force, tip_forces = np.split(data.sensordata, sizes)
        self._links = pos.reshape(-1, 3), quat.reshape(-1, 4), linvel.reshape(-1, 3), angvel.reshape(-1, 3)
        self._geom_forces = tip_forces.reshape(-1, 3)
        self._sum_by_tip = -(self._at.sensed_tip == np.arange(links - 1)[:, None]).astype(
            np.float64
        )  # minus: of the tip on the object
        self._full = [data.warning[int(kind)] for kind in _FULL]
        self._com = object_inertia(scene.objects[object_index]).com
        self._ones = np.ones(len(data.qpos)), np.ones(len(data.qvel))

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
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
        self._ahead, self._links_sensed = False, False
        self._contacts_sensed = True  # resetting has made them zero

    def get_state(self) -> dict[str, np.ndarray]:
        return {
            "joint_pos": self._qpos.take(self._at.joint_qpos),
            "joint_vel": self._qvel.take(self._at.joint_dof),
            "joint_target": self._ctrl,
            "object_pos": self._object_pos,
            "object_quat": self._object_quat,
            "object_linvel": self._object_linvel,
            "object_angvel": _rotate(self._object_quat, self._object_spin),  # a free joint's is in the body's frame
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._ctrl[:] = targets

    def step(self, n: int) -> None:
        if self._ahead:
            mujoco.mj_step2(self._model, self._data)
            n -= 1
        if n:
            mujoco.mj_step(self._model, self._data, n)
        self._ahead = self._links_sensed = self._contacts_sensed = False
        before, self._overflows = self._overflows, sum(warning.number for warning in self._full)
        self._overflowed = self._overflows > before

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        if not self._links_sensed:
            self._sense_contacts()  # while the engine's contacts are those of the last step
            self._begin_next_step()
            self._links_sensed = True
        return self._links

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        self._sense_contacts()
        tip_force = self._sum_by_tip @ self._geom_forces
        # A contact in which no force acts is no touch.
        return tip_force, tip_force.any(axis=1), -self._table_force

    def health(self, state: Mapping[str, np.ndarray]) -> tuple[bool, bool]:
        """See :meth:`World.health`. The engine's own memory is looked at: in two pieces instead of seven, and with the mimic joints."""
        q_ones, v_ones = self._ones
        finite = math.isfinite(
            self._qpos.dot(q_ones) + self._qvel.dot(v_ones)
        )  # one bad number spoils a sum; cheaper than looking at each
        return not finite, self._overflowed

    def mass_properties(self) -> list[Inertia]:
        m = self._model
        bodies = (*self._at.moving_bodies, self._at.object_body)
        return [
            Inertia(mass=m.body_mass[i], com=m.body_ipos[i], quat=m.body_iquat[i], moments=m.body_inertia[i])
            for i in bodies
        ]

    def set_object_inertia(self, inertia: Inertia) -> None:
        """See :meth:`World.set_object_inertia`. Of a free body, the solver's weights are the inverse of mass and inertia."""
        body, model, nominal = self._at.object_body, self._model, self._at.model
        model.body_mass[body] = model.body_subtreemass[body] = inertia.mass
        model.body_subtreemass[0] = nominal.body_subtreemass[0] + inertia.mass - nominal.body_mass[body]
        model.body_inertia[body] = inertia.moments
        model.body_ipos[body] = nominal.body_ipos[body] + (inertia.com - self._com)
        growth = inertia.mass / nominal.body_mass[body]
        turning = inertia.moments[0] / (
            growth * nominal.body_inertia[body, 0]
        )  # exactly 1 where the mass alone is another
        model.body_invweight0[body] = nominal.body_invweight0[body] / (growth, growth * turning)
        self._ahead = False

    def set_friction(self, friction: np.ndarray) -> None:
        pairs = np.maximum((*friction, 0.0), MIN_FRICTION)
        self._model.geom_friction[:, 0] = pairs[self._at.friction_column]
        self._ahead = False

    def set_torsional_friction(self, torsional: float) -> None:
        self._model.geom_friction[:, 1] = torsional
        self._ahead = False

    def set_object_gravity(self, fraction: float) -> None:
        self._model.body_gravcomp[self._at.object_body] = 1.0 - fraction
        self._ahead = False

    def set_drives(self, scale: np.ndarray) -> None:
        model, nominal = self._model, self._at.model
        stiffness, damping, effort = scale
        model.actuator_gainprm[:, 0] = stiffness * nominal.actuator_gainprm[:, 0]
        model.actuator_biasprm[:, :2] = stiffness[:, None] * nominal.actuator_biasprm[:, :2]
        model.actuator_biasprm[:, 2] = damping * nominal.actuator_biasprm[:, 2]
        model.actuator_forcerange[:] = effort[:, None] * nominal.actuator_forcerange
        self._ahead = False

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        self._wrench[:3], self._wrench[3:] = force, torque

    def _begin_next_step(self) -> None:
        """Do the first half of the next step, which also senses the links; what was sensed of contacts stays that of the last step."""
        self._option.disableflags = self._sensing
        mujoco.mj_step1(self._model, self._data)
        self._option.disableflags = self._silent
        self._ahead = True

    def _sense_contacts(self) -> None:
        """Sense the contact forces of the last step, before the first half of the next one replaces the engine's contacts."""
        if not self._contacts_sensed:
            self._option.disableflags = self._sensing
            mujoco.mj_sensorAcc(self._model, self._data)
            self._option.disableflags = self._silent
            self._contacts_sensed = True


class MujocoBackend(PoolBackend):
    """MuJoCo on the CPU, worlds in a pool of processes; the keyword ``settings`` takes :class:`MujocoSettings`."""

    name: ClassVar[str] = "mujoco"
    capabilities: ClassVar[frozenset[Capability]] = frozenset(get_args(Capability))
    known_differences: ClassVar[tuple[KnownDifference, ...]] = KNOWN_DIFFERENCES
    world_class: ClassVar[type[World]] = MujocoWorld

    @classmethod
    def engine_version(cls) -> str:
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
