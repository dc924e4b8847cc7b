"""The MuJoCo C engine: the reference, and fast on CPUs."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from typing import get_args
from weakref import WeakValueDictionary

import numpy as np

from xreset.backends.pool import PoolBackend, World
from xreset.backends.rigid import (
    ContactArrays,
    Inertia,
    LinkArrays,
    StateArrays,
    conjugate,
    object_inertia,
)
from xreset.physics import Capability, unavailable
from xreset.spec import SceneSpec

try:
    import mujoco
except ImportError as error:
    raise unavailable("mujoco", "'xreset[mujoco]'", error) from error

from xreset.backends.mjcf import KNOWN_DIFFERENCES, compile_scene
from xreset.backends.mjcf_model import MIN_FRICTION, MOST_BRAKING, SceneModel

_FULL = (mujoco.mjtWarning.mjWARN_CONTACTFULL, mujoco.mjtWarning.mjWARN_CNSTRFULL)
"""The engine's warnings that a buffer for contacts or constraints was full."""


class MujocoWorld(World):
    """One world in MuJoCo.

    The engine's step has two halves: what follows from positions and velocities (``mj_step1``: kinematics, contacts),
    and forces and motion (``mj_step2``). Reading the links does the first half of the next step in advance. The links
    are then up to date, and nothing is done twice unless a parameter changes before that step.
    """

    def __init__(self, scene: SceneSpec, object_index: int) -> None:
        # the default writes a log file into the current folder
        if mujoco.get_mju_user_warning() is None:
            mujoco.set_mju_user_warning(lambda _: None)
        self._at = at = _compiled(scene, object_index)
        """Where the scene's parts are in the engine's model."""
        self._model = model = copy(at.model)  # each world has parameters of its own
        self._data = data = mujoco.MjData(model)
        self._option = model.opt
        # A broken world must be reported, not reset silently. Sensors are read on demand, not in each step.
        self._sensing = model.opt.disableflags | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._silent = self._sensing | mujoco.mjtDisableBit.mjDSBL_SENSOR
        self._option.disableflags = self._silent
        self._ahead = False
        """Whether the first half of the next step is done, with the present parameters."""
        self._overflowed = False
        self._overflows = 0

        # Views of the engine's own memory, which stays where it is: making one costs as much as reading it.
        self._ctrl = data.ctrl
        self._qpos = data.qpos
        self._qvel = data.qvel
        self._wrench = data.xfrc_applied[at.object_body]
        self._object_pos, self._object_quat = np.split(
            data.qpos[at.object_qpos : at.object_qpos + 7], [3]
        )
        self._object_linvel, self._object_spin = np.split(
            data.qvel[at.object_dof : at.object_dof + 6], [3]
        )
        self._joint_qpos = at.qpos[at.joints.driven]
        self._joint_dof = at.dof[at.joints.driven]
        links = len(at.link_body)
        sizes = np.cumsum((3 * links, 4 * links, 3 * links, 3 * links, 3))
        *link_arrays, self._table_force, tip_forces = np.split(data.sensordata, sizes)
        pos, quat, linvel, angvel = (array.reshape(links, -1) for array in link_arrays)
        self._links = (pos, quat, linvel, angvel)
        self._geom_forces = tip_forces.reshape(-1, 3)
        mine = at.sensed_tip == np.arange(links - 1)[:, None]
        # minus, because the forces of the object are sensed
        self._sum_by_tip = -mine.astype(np.float64)
        self._full = [data.warning[int(kind)] for kind in _FULL]
        self._com = object_inertia(scene.objects[object_index]).com
        self._q_ones = np.ones(model.nq)
        self._v_ones = np.ones(model.nv)

    def set_state(self, state: StateArrays) -> None:
        at = self._at
        mujoco.mj_resetData(self._model, self._data)
        self._overflowed = False
        self._overflows = 0
        self._qpos[at.qpos], self._qvel[at.dof] = at.joints.spread(
            state["joint_pos"], state["joint_vel"]
        )
        self._ctrl[:] = state["joint_target"]
        self._object_pos[:] = state["object_pos"]
        self._object_quat[:] = quat = state["object_quat"] / np.linalg.norm(state["object_quat"])
        self._object_linvel[:] = state["object_linvel"]
        self._object_spin[:] = _rotate(conjugate(quat), state["object_angvel"])
        self._ahead = False

    def get_state(self) -> StateArrays:
        return {
            "joint_pos": self._qpos.take(self._joint_qpos),
            "joint_vel": self._qvel.take(self._joint_dof),
            "joint_target": self._ctrl,
            "object_pos": self._object_pos,
            "object_quat": self._object_quat,
            "object_linvel": self._object_linvel,
            # MuJoCo has the angular velocity of a free joint in the body's frame
            "object_angvel": _rotate(self._object_quat, self._object_spin),
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._ctrl[:] = targets

    def step(self, n: int) -> None:
        for _ in range(n):
            if not self._ahead:
                mujoco.mj_step1(self._model, self._data)
            self._ahead = False
            keep_sliding_contacts(self._data)
            mujoco.mj_step2(self._model, self._data)
        before = self._overflows
        self._overflows = sum(warning.number for warning in self._full)
        self._overflowed = self._overflows > before

    def contacts(self) -> ContactArrays:
        self._with_sensors(mujoco.mj_sensorAcc)
        tip_force = self._sum_by_tip @ self._geom_forces
        # A contact in which no force acts is no touch.
        return tip_force, tip_force.any(axis=1), -self._table_force

    def links(self) -> LinkArrays:
        self._with_sensors(mujoco.mj_step1)
        self._ahead = True
        return self._links

    def health(self, state: StateArrays) -> tuple[bool, bool]:
        """See :meth:`World.health`. Reads the engine's own memory: two arrays, which include the mimic joints."""
        # One bad number spoils a sum, which costs less than looking at each.
        finite = math.isfinite(self._qpos.dot(self._q_ones) + self._qvel.dot(self._v_ones))
        return not finite, self._overflowed

    def mass_properties(self) -> list[Inertia]:
        model = self._model
        found = []
        for i in (*self._at.moving_bodies, self._at.object_body):
            inertia = Inertia(
                mass=model.body_mass[i],
                com=model.body_ipos[i],
                quat=model.body_iquat[i],
                moments=model.body_inertia[i],
            )
            found.append(inertia)
        return found

    def set_object_inertia(self, inertia: Inertia) -> None:
        """See :meth:`World.set_object_inertia`. A free body's solver weights are the inverse of mass and inertia."""
        body = self._at.object_body
        model = self._model
        nominal = self._at.model
        model.body_mass[body] = inertia.mass
        model.body_subtreemass[body] = inertia.mass
        model.body_subtreemass[0] = (
            nominal.body_subtreemass[0] + inertia.mass - nominal.body_mass[body]
        )
        model.body_inertia[body] = inertia.moments
        model.body_ipos[body] = nominal.body_ipos[body] + (inertia.com - self._com)
        growth = inertia.mass / nominal.body_mass[body]
        # exactly 1 if only the mass changed
        turning = inertia.moments[0] / (growth * nominal.body_inertia[body, 0])
        model.body_invweight0[body] = nominal.body_invweight0[body] / (growth, growth * turning)
        self._ahead = False

    def set_friction(self, friction: np.ndarray) -> None:
        model = self._model
        of_roles = np.maximum((*friction, 0.0), MIN_FRICTION)
        of_geoms = of_roles[self._at.friction_column]
        model.geom_friction[:, 0] = of_geoms
        rougher = np.maximum(of_geoms[model.pair_geom1], of_geoms[model.pair_geom2])
        model.pair_friction[:, :2] = rougher[:, None]
        self._ahead = False

    def set_torsional_friction(self, torsional: float) -> None:
        self._model.geom_friction[:, 1] = torsional
        self._ahead = False

    def set_object_gravity(self, fraction: float) -> None:
        self._model.body_gravcomp[self._at.object_body] = 1.0 - fraction
        self._ahead = False

    def set_drives(self, scale: np.ndarray) -> None:
        model = self._model
        nominal = self._at.model
        stiffness, damping, effort = scale
        model.actuator_gainprm[:, 0] = stiffness * nominal.actuator_gainprm[:, 0]
        model.actuator_biasprm[:, :2] = stiffness[:, None] * nominal.actuator_biasprm[:, :2]
        model.actuator_biasprm[:, 2] = damping * nominal.actuator_biasprm[:, 2]
        model.actuator_forcerange[:] = effort[:, None] * nominal.actuator_forcerange
        self._ahead = False

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        self._wrench[:3] = force
        self._wrench[3:] = torque

    def _with_sensors(self, stage: Callable[[mujoco.MjModel, mujoco.MjData], None]) -> None:
        self._option.disableflags = self._sensing
        stage(self._model, self._data)
        self._option.disableflags = self._silent


class MujocoBackend(PoolBackend):
    """MuJoCo on the CPU."""

    name = "mujoco"
    capabilities = frozenset(get_args(Capability))
    known_differences = KNOWN_DIFFERENCES
    world_class = MujocoWorld

    @classmethod
    def engine_version(cls) -> str:
        return mujoco.__version__


_MODELS: WeakValueDictionary[tuple[int, int], SceneModel] = WeakValueDictionary()
"""Compiled models that are in use: compiling takes longer than copying, and the worlds of a process share a scene."""


def _compiled(scene: SceneSpec, object_index: int) -> SceneModel:
    """Return the model of a scene. Scenes hold arrays, so they are told apart by identity and not by content."""
    key = (id(scene), object_index)
    model = _MODELS.get(key)
    if model is None:
        model = _MODELS[key] = compile_scene(scene, object_index, sensors=True)
    return model


def keep_sliding_contacts(data: mujoco.MjData) -> None:
    """Lower the reference accelerations of contacts by what would throw sliding bodies up.

    :data:`~xreset.backends.mjcf_model.MOST_BRAKING` has the reason. Call it between ``mj_step1`` and ``mj_step2``.
    """
    first = data.ne + data.nf + data.nl  # the rows of contacts come last
    if first == data.nefc:
        return
    # of each contact: along the normal, two of sliding, one of spinning
    reference = data.efc_aref[first:].reshape(-1, 4)
    contact = data.contact
    friction = contact.friction
    if len(friction) > len(reference):
        friction = friction[contact.efc_address >= 0]
    braking = np.hypot(reference[:, 1], reference[:, 2])
    if braking.max() > MOST_BRAKING:
        reference[:, 1:3] *= (MOST_BRAKING / np.maximum(braking, MOST_BRAKING))[:, None]
        braking = np.minimum(braking, MOST_BRAKING)
    reference[:, 0] -= np.hypot(friction[:, 0] * braking, friction[:, 2] * reference[:, 3])


def _rotate(quat: np.ndarray, vector: np.ndarray) -> np.ndarray:
    out = np.empty(3)
    mujoco.mju_rotVecQuat(out, vector, quat)
    return out
