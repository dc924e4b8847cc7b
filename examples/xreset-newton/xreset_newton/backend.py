"""Newton on the CPU with its Steel solver: reduced coordinates, projected Gauss-Seidel in impulse space, single precision.

What differs from Newton's defaults, and why:

- Drives are rows of the solver, which bound the effort; by default only the explicit part of a drive is bounded.
- Joint limits are enforced, and bodies that spin are not braked: Newton does neither and the other by itself.
- Weights are forces at centres of mass, so the object can have a gravity fraction and a compensated robot none.

Newton's velocities are those of centres of mass; the interface's are those of frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from typing import get_args

import numpy as np

from xreset.backends.pool import PoolBackend, World, is_finite
from xreset.backends.rigid import (
    Inertia,
    MovingJoints,
    TrackedFrames,
    cross,
    mechanism,
    nearer,
    object_inertia,
    principal,
    rotate,
)
from xreset.errors import XResetError
from xreset.physics import Capability, KnownDifference, unavailable
from xreset.spec import GRAVITY, SceneSpec

try:
    import newton
    import warp as wp
except ImportError as error:
    raise unavailable("newton", "'newton>=1.8,<1.9'", error) from error

from xreset_newton.model import NewtonSettings, build_model

wp.config.log_level = wp.LOG_WARNING  # else a line for each of some hundred kernels
_DEFAULTS = NewtonSettings()
_FORCE = newton.solvers.SolverSteel.ObservableKind.CONTACT_F


class NewtonWorld(World):
    """One world of Newton. Arrays of Warp on the CPU are views of numpy's memory, and are written and read as such."""

    def __init__(
        self, scene: SceneSpec, object_index: int, *, settings: NewtonSettings = _DEFAULTS
    ) -> None:
        """See :class:`World`."""
        robot = mechanism(scene.robot)
        obj = scene.objects[object_index]
        self._inertia = object_inertia(obj)
        self._at = at = build_model(scene, robot, obj, self._inertia, settings)
        model = self._model = at.model
        self._tips = len(scene.robot.fingertips)
        self._joints = MovingJoints(scene.robot, robot.joint_names)
        self._frames = TrackedFrames(robot)
        self._pipeline = newton.CollisionPipeline(
            model,
            broad_phase="explicit",
            shape_pairs_filtered=wp.array(at.pairs, dtype=wp.vec2i, device="cpu"),
            deterministic=True,
        )
        self._contacts = self._pipeline.contacts()
        self._solver = newton.solvers.SolverSteel(
            model,
            iterations=settings.iterations,
            baumgarte=settings.baumgarte,
            drive_mode="rows",
            enable_joint_limits=True,
            joint_limit_activation_gap=0.1,
            articulation_constraint_max=settings.rows,
            free_body_constraint_max=settings.rows,
            warn_constraint_overflow=False,
            deterministic=wp.DeterministicMode.RUN_TO_RUN,
        )
        self.forces = self._solver.observables({_FORCE}, contacts=self._contacts)
        self._states = [model.state(), model.state()]
        self._control = model.control()
        roles = np.array([surface.role for surface in at.surfaces])
        self._roles = {role: roles == role for role in ("tip", "link", "table", "object")}
        self._tip_of_shape = np.array([surface.tip for surface in at.surfaces])
        self._base = np.array([*scene.robot.base_pos, *np.roll(scene.robot.base_quat, -1)])
        masses = np.array([body.inertia.mass for body in robot.bodies if body.inertia is not None])
        self._robot_weight = masses * (0.0 if scene.robot.gravity_compensated else GRAVITY)
        self._graph = self._captured(
            scene.timestep / settings.internal_steps, settings.internal_steps
        )
        self._target = scene.robot.home
        self._quat = np.array([1.0, 0.0, 0.0, 0.0])
        self._stepped = False
        self.set_friction(np.array([scene.friction.tip, scene.friction.link, scene.friction.table]))

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """See :meth:`World.set_state`."""
        now = self._states[0]
        q = now.joint_q.numpy()
        v = now.joint_qd.numpy()
        q[:-7], v[:-6] = self._joints.spread(state["joint_pos"], state["joint_vel"])
        self._quat = state["object_quat"] / np.linalg.norm(state["object_quat"])
        q[-7:-4] = state["object_pos"]
        q[-4:] = np.roll(self._quat, -1)
        v[-6:-3] = state["object_linvel"] + cross(
            state["object_angvel"], rotate(self._quat, self._inertia.com)
        )
        v[-3:] = state["object_angvel"]
        newton.eval_fk(self._model, now.joint_q, now.joint_qd, now)
        self._states[1].assign(now)
        self._solver.reset(now)
        self.set_joint_targets(state["joint_target"])
        self._stepped = False

    def get_state(self) -> dict[str, np.ndarray]:
        """See :meth:`World.get_state`."""
        now = self._states[0]
        joints = self._joints.driven
        q = now.joint_q.numpy().astype(float)
        v = now.joint_qd.numpy().astype(float)
        self._quat = nearer(np.roll(q[-4:], 1), self._quat)
        return {
            "joint_pos": q[joints],
            "joint_vel": v[joints],
            "joint_target": self._target,
            "object_pos": q[-7:-4],
            "object_quat": self._quat,
            "object_linvel": v[-6:-3] - cross(v[-3:], rotate(self._quat, self._inertia.com)),
            "object_angvel": v[-3:],
        }

    def set_joint_targets(self, targets: np.ndarray) -> None:
        """See :meth:`World.set_joint_targets`."""
        self._target = np.array(targets)
        self._control.joint_target_q.numpy()[self._joints.driven] = targets

    def step(self, n: int) -> None:
        """See :meth:`World.step`."""
        for state in self._states:
            load = state.body_f.numpy()
            load[:-1, 2] = -self._robot_weight
            load[-1, :3] = self.force
            load[-1, 3:] = self.torque
        for _ in range(n):
            wp.capture_launch(self._graph)
        self._stepped = True

    def _captured(self, dt: float, internal_steps: int) -> wp.Graph:
        """A physics step as a graph, from the first state to the first state: 146 launches from Python take nine times as long."""

        def step() -> None:
            for index in range(internal_steps):
                now = self._states[index % 2]
                after = self._states[1 - index % 2]
                self._pipeline.collide(now, self._contacts)
                self._solver.step(
                    now, after, self._control, self._contacts, dt, observables=self.forces
                )

        step()  # what is allocated or decided once
        with wp.ScopedCapture(device="cpu") as capture:
            step()
        return capture.graph

    def links(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.links`."""
        bodies = self._frames.bodies
        now = self._states[0]
        pose = np.vstack((self._base, now.body_q.numpy()))[bodies]
        motion = np.vstack((np.zeros(6), now.body_qd.numpy()))[bodies]
        return self._frames.locate(
            pose[:, :3], np.roll(pose[:, 3:], 1, axis=1), motion[:, :3], motion[:, 3:]
        )

    def contacts(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See :meth:`World.contacts`: of the last internal step."""
        tip_force = np.zeros((self._tips, 3))
        tip_touch = np.zeros(self._tips, dtype=bool)
        table_force = np.zeros(3)
        count = int(self._contacts.rigid_contact_count.numpy()[0]) if self._stepped else 0
        first, second = (
            shape.numpy()[:count]
            for shape in (self._contacts.rigid_contact_shape0, self._contacts.rigid_contact_shape1)
        )
        force = self.forces.contact_f.numpy()[:count, :3].astype(float)  # on the first shape's body
        mine = self._roles["object"]
        for other, forces in ((second, force), (first, -force)):
            at = mine[first] if other is second else mine[second]
            table_force += forces[at & self._roles["table"][other]].sum(axis=0)
            for tip in range(self._tips):
                on_tip = forces[at & (self._tip_of_shape[other] == tip)]
                tip_force[tip] += on_tip.sum(axis=0)
                tip_touch[tip] |= bool(on_tip.any())
        return tip_force, tip_touch, table_force

    def health(self, state: Mapping[str, np.ndarray]) -> tuple[bool, bool]:
        """See :meth:`World.health`."""
        return not is_finite(state), bool(self._solver.constraint_overflow.numpy().any())

    def mass_properties(self) -> list[Inertia]:
        """See :meth:`World.mass_properties`."""
        model = self._model
        values = zip(
            model.body_mass.numpy(),
            model.body_com.numpy(),
            model.body_inertia.numpy(),
            model.body_label,
            strict=True,
        )
        return [
            principal(float(m), c.astype(float), i.astype(float), XResetError, f"Newton's {name!r}")
            for m, c, i, name in values
        ]

    def set_object_inertia(self, inertia: Inertia) -> None:
        """See :meth:`World.set_object_inertia`."""
        self._inertia = inertia
        model = self._model
        matrix = inertia.matrix
        model.body_mass.numpy()[-1] = inertia.mass
        model.body_inv_mass.numpy()[-1] = 1.0 / inertia.mass
        model.body_inertia.numpy()[-1] = matrix
        model.body_inv_inertia.numpy()[-1] = np.linalg.inv(matrix)
        model.body_com.numpy()[-1] = inertia.com
        self._solver.notify_model_changed(newton.ModelFlags.BODY_INERTIAL_PROPERTIES)

    def set_friction(self, friction: np.ndarray) -> None:
        """See :meth:`World.set_friction`."""
        for role, mu in zip(("tip", "link", "table"), friction, strict=True):
            self._model.shape_material_mu.numpy()[self._roles[role]] = 2.0 * mu
        self._solver.notify_model_changed(newton.ModelFlags.SHAPE_PROPERTIES)

    def set_drives(self, scale: np.ndarray) -> None:
        """See :meth:`World.set_drives`."""
        model = self._model
        joints = self._joints
        arrays = model.joint_target_ke, model.joint_target_kd, model.joint_effort_limit
        for array, value in zip(arrays, joints.nominal * scale, strict=True):
            array.numpy()[joints.driven] = value
        self._solver.notify_model_changed(newton.ModelFlags.JOINT_DOF_PROPERTIES)


_DAMPED = "drives are integrated by implicit Euler steps, which damp: the difference shrinks with the step"
_KNOWN_DIFFERENCES = (
    KnownDifference(check="joint_tracking", measure="hand, sine, rms", bound=0.003, reason=_DAMPED),
    KnownDifference(
        check="effort_limit", measure="hand, weak step, peak", bound=0.014, reason=_DAMPED
    ),
    KnownDifference(
        check="torsional_friction",
        measure="spin lost",
        bound=1.01,
        reason="the solver has torsional friction on CUDA only",
    ),
)


class NewtonBackend(PoolBackend):
    """N worlds of Newton; the keyword ``settings`` takes :class:`NewtonSettings`."""

    name = "newton"
    capabilities = frozenset(get_args(Capability)) - {"torsional_friction"}
    known_differences = _KNOWN_DIFFERENCES
    world_class = NewtonWorld

    @classmethod
    def engine_version(cls) -> str:
        """See :meth:`Backend.engine_version`."""
        return version("newton")
