"""Newton with its Steel solver: N worlds in one model, reduced coordinates, projected Gauss-Seidel in impulse space, single precision.

What differs from Newton's defaults, and why:

- Drives are rows of the solver, which bound the effort; by default only the explicit part of a drive is bounded.
- Joint limits are enforced, and bodies that spin are not braked: Newton does neither and the other by itself.
- Weights are forces at centres of mass, so the object can have a gravity fraction and a compensated robot none.

Newton's velocities are those of centres of mass; the interface's are those of frames. Its arrays and torch's are the same memory: nothing is
copied to the host, and nothing waits for the device.
"""

from __future__ import annotations

from importlib.metadata import version
from typing import ClassVar, get_args

import numpy as np
import torch
from torch import Tensor

from xreset.backends.batch import BatchBackend, LinkFrames, sum_contacts
from xreset.backends.rigid import OTHER_LINK, MovingJoints, mechanism
from xreset.geometry.rotations import quat_rotate
from xreset.physics import Capability, KnownDifference, MassProperties, unavailable
from xreset.spec import GRAVITY, SceneSpec

try:
    import newton
    import warp as wp

    from xreset.physics.torch_warp import TorchStream, quiet
except ImportError as error:
    raise unavailable("newton", "'newton>=1.8,<1.9'", error) from error

from xreset_newton.model import NewtonSettings, build_model

_DEFAULTS = NewtonSettings()
_FORCE = newton.solvers.SolverSteel.ObservableKind.CONTACT_F
_KNOWN_DIFFERENCES = (
    *(
        KnownDifference(
            check="drive_equation",
            measure=f"step of {step} m, stiffer and weaker",
            bound=0.05,
            reason="drives are integrated by implicit Euler steps, which damp: the difference shrinks with the step",
        )
        for step in ("+0.08", "-0.08")
    ),
    KnownDifference(
        check="torsional_friction",
        measure="spin lost",
        bound=1.01,
        reason="the solver has no torsional friction on the CPU",
    ),
    *(
        KnownDifference(
            check="robot_friction",
            measure=f"on the {part}",
            bound=0.3,
            reason="the friction of a pair without the object is the mean of two coefficients, not the larger",
        )
        for part in ("table", "shelf")
    ),
)


class NewtonBackend(BatchBackend):
    """N worlds of Newton, on the CPU or on a GPU; the keyword ``settings`` takes :class:`NewtonSettings`."""

    name: ClassVar[str] = "newton"
    capabilities: ClassVar[frozenset[Capability]] = frozenset(get_args(Capability)) - {
        "torsional_friction"
    }
    known_differences: ClassVar[tuple[KnownDifference, ...]] = _KNOWN_DIFFERENCES

    def __init__(
        self,
        scene: SceneSpec,
        num_worlds: int,
        *,
        object_index: Tensor | None = None,
        device: str = "cpu",
        settings: NewtonSettings = _DEFAULTS,
    ) -> None:
        """See :class:`BatchBackend`. The first worlds compile kernels, for minutes."""
        super().__init__(scene, num_worlds, object_index=object_index, device=device)
        robot = mechanism(scene.robot)
        with quiet():
            self._on_stream = TorchStream(self.device)
            with self._on_stream():
                on = str(wp.device_from_torch(self.device))
                self._at = build_model(scene, robot, self.object_index.tolist(), settings, on)
                self._model = model = self._at.model
                self._pipeline = newton.CollisionPipeline(
                    model,
                    broad_phase="explicit",
                    shape_pairs_filtered=wp.array(self._at.pairs, dtype=wp.vec2i, device=on),
                    deterministic=True,
                )
                self._touching = self._pipeline.contacts()
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
                self._forces = self._solver.observables({_FORCE}, contacts=self._touching)
                self._now, self._after = model.state(), model.state()
                self._control = model.control()
                self._name_arrays(LinkFrames(robot, self.device))
                joints = MovingJoints(scene.robot, robot.joint_names)
                self._name_joints(joints)
                masses = [body.inertia.mass for body in robot.bodies if body.inertia is not None]
                if not scene.robot.gravity_compensated:
                    for state in (self._now, self._after):
                        weight = -GRAVITY * torch.tensor(masses, device=self.device)
                        self._per_world(state.body_f)[:, :-1, 2] = weight
                self._graph = self._captured(scene.timestep, settings.internal_steps)
        self.begin()

    @classmethod
    def engine_version(cls) -> str:
        """See :meth:`Backend.engine_version`."""
        return version("newton")

    @classmethod
    def devices(cls) -> list[str]:
        """See :meth:`Backend.devices`."""
        return ["cuda", "cpu"] if torch.cuda.is_available() else ["cpu"]

    # Building ---------------------------------------------------------------------------------------------------------

    def _per_world(self, array: wp.array) -> Tensor:
        """[N, n, ...] view of a Newton array that has n entries for each world."""
        values = wp.to_torch(array)
        return values.view(self.num_worlds, -1, *values.shape[1:])

    def _name_arrays(self, frames: LinkFrames) -> None:
        """Name the arrays of state, contacts and parameters as tensors [N, ...], or by shape [S] and contact [C]."""
        model, now, touching = self._model, self._now, self._touching
        self._frames = frames
        robot = self.scene.robot
        base = np.concatenate([robot.base_pos, np.roll(robot.base_quat, -1)])
        self._base = torch.tensor(base, dtype=torch.float32, device=self.device)
        self._q, self._v = self._per_world(now.joint_q), self._per_world(now.joint_qd)
        self._pose, self._motion = self._per_world(now.body_q), self._per_world(now.body_qd)
        self._loads = [self._per_world(state.body_f)[:, -1] for state in (self._now, self._after)]
        self._com = self._per_world(model.body_com)[:, -1]
        surfaces = self._at.surfaces

        def of_shapes(values: list) -> Tensor:
            return torch.tensor(values, device=self.device)

        self._world = of_shapes(self._at.worlds.tolist())
        self._owner = of_shapes([surface.owner for surface in surfaces])
        self._is_object = of_shapes([surface.role == "object" for surface in surfaces])
        self._friction_column = of_shapes([surface.friction_column for surface in surfaces])
        self._friction_scale = of_shapes([surface.friction_scale for surface in surfaces])
        self._count = wp.to_torch(touching.rigid_contact_count)
        self._first = wp.to_torch(touching.rigid_contact_shape0)
        self._second = wp.to_torch(touching.rigid_contact_shape1)
        self._force = wp.to_torch(self._forces.contact_f)
        self._row = torch.arange(len(self._first), device=self.device)
        self._overflow = wp.to_torch(self._solver.constraint_overflow)[: self.num_worlds]
        self._mask = torch.zeros(self.num_worlds + 1, dtype=torch.bool, device=self.device)
        """The chosen worlds as Newton wants them: the last entry is for what no world holds."""

    def _name_joints(self, joints: MovingJoints) -> None:
        """Name what the drives need. In each world, the joints' entries come before the object's."""
        self._driven = torch.tensor(joints.driven, device=self.device)
        matrix, offset = (
            torch.as_tensor(values, dtype=torch.float32, device=self.device)
            for values in joints.couplings
        )
        self._couplings = matrix, offset
        self._drives = torch.as_tensor(joints.nominal, dtype=torch.float32, device=self.device)
        self._target = self._per_world(self._control.joint_target_q)

    def _captured(self, timestep: float, internal_steps: int) -> wp.Graph:
        """A physics step as a graph, from one state to the same: launches from Python take nine times as long."""

        def step() -> None:
            for index in range(internal_steps):
                now, after = (self._now, self._after)[:: -1 if index % 2 else 1]
                self._pipeline.collide(now, self._touching)
                dt = timestep / internal_steps
                self._solver.step(
                    now, after, self._control, self._touching, dt, observables=self._forces
                )

        device = self._model.device
        step()  # what is allocated or decided once
        # torch's default stream cannot be captured
        stream = wp.Stream(device) if device.is_cuda else None
        with wp.ScopedStream(stream), wp.ScopedCapture(device=device) as capture:
            step()
        return capture.graph

    # State ------------------------------------------------------------------------------------------------------------

    def begin(self) -> None:
        """See :meth:`BatchBackend.begin`."""
        with self._on_stream():
            self._apply()
            self.forget()
            state = self._state
            quat = state.object_quat
            matrix, offset = self._couplings
            position = state.joint_pos @ matrix.T + offset
            q = torch.cat((position, state.object_pos, quat.roll(-1, dims=-1)), dim=-1)
            spin = state.object_angvel
            linvel = state.object_linvel + torch.linalg.cross(spin, quat_rotate(quat, self._com))
            v = torch.cat((state.joint_vel @ matrix.T, linvel, spin), dim=-1)
            chosen = self.chosen[:, None]
            torch.where(chosen, q, self._q, out=self._q)
            torch.where(chosen, v, self._v, out=self._v)
            now = self._now
            newton.eval_fk(self._model, now.joint_q, now.joint_qd, now)
            self._after.assign(now)
            self._solver.reset(now, world_mask=wp.from_torch(self._mask))
            self._read_motion()

    def step(self, substeps: int | None = None) -> None:
        """See :meth:`Backend.step`."""
        self._must_be_open()
        with self._on_stream():
            self._target[:, self._driven] = self._state.joint_target
            load = self.object_load()
            for given in self._loads:
                given.copy_(load)
            for _ in range(self._checked_substeps(substeps)):
                wp.capture_launch(self._graph)
            self._read_motion()
            self._read_contacts()

    def _read_motion(self) -> None:
        """Read state, links and health of all worlds."""
        state, q, v = self._state, self._q, self._v
        state.joint_pos.copy_(q[:, self._driven])
        state.joint_vel.copy_(v[:, self._driven])
        state.object_pos.copy_(q[:, -7:-4])
        state.object_quat.copy_(q[:, -4:].roll(1, dims=-1))
        state.object_angvel.copy_(v[:, -3:])
        lever = quat_rotate(state.object_quat, self._com)
        state.object_linvel.copy_(v[:, -6:-3] - torch.linalg.cross(v[:, -3:], lever))
        base = self._base.expand(self.num_worlds, 1, -1)
        pose = torch.cat((base, self._pose), dim=1)[:, self._frames.bodies]
        still = torch.zeros(self.num_worlds, 1, 6, device=self.device)
        motion = torch.cat((still, self._motion), dim=1)[:, self._frames.bodies]
        turn = pose[..., 3:].roll(1, dims=-1)
        found = self._frames.locate(pose[..., :3], turn, motion[..., :3], motion[..., 3:])
        self._links.map(Tensor.copy_, found)
        finite = torch.isfinite(q).all(dim=-1) & torch.isfinite(v).all(dim=-1)
        self._health.nonfinite.logical_or_(~finite)
        self._health.overflow.copy_(self._overflow)

    def _read_contacts(self) -> None:
        """Sum the contacts of the last Newton step. Newton gives the force on the first shape's body."""
        is_contact = self._row < self._count
        first, second = (torch.where(is_contact, x, 0).long() for x in (self._first, self._second))
        on_first = self._is_object[first]
        mine = is_contact & (on_first != self._is_object[second])
        owner = torch.where(on_first, self._owner[second], self._owner[first])
        force = self._force[:, :3]
        force = torch.where(on_first[:, None], force, -force)
        owner = torch.where(mine, owner, OTHER_LINK)
        sum_contacts(self._contacts, self._world[first], owner, force)

    # Physical parameters ----------------------------------------------------------------------------------------------

    def apply_parameters(self) -> None:
        """See :meth:`BatchBackend.apply_parameters`."""
        with self._on_stream():
            self._apply()

    def _apply(self) -> None:
        """Write the parameters of all worlds, of which those that are not chosen have not changed."""
        model = self._model
        self._mask[:-1] = self.chosen
        obj = self.object_properties()
        for array, value in (
            (model.body_mass, obj.mass),
            (model.body_inv_mass, 1.0 / obj.mass),
            (model.body_com, obj.com),
            (model.body_inertia, obj.inertia),
            (model.body_inv_inertia, torch.linalg.inv_ex(obj.inertia)[0]),
        ):
            self._per_world(array)[:, -1] = value
        friction = self.parameters["friction"][self._world, self._friction_column]
        wp.to_torch(model.shape_material_mu).copy_(friction * self._friction_scale)
        arrays = model.joint_target_ke, model.joint_target_kd, model.joint_effort_limit
        for row, array in enumerate(arrays):
            scale = self.parameters["drives"][:, row]
            self._per_world(array)[:, self._driven] = scale * self._drives[row]
        flags = newton.ModelFlags
        changed = (
            flags.BODY_INERTIAL_PROPERTIES | flags.SHAPE_PROPERTIES | flags.JOINT_DOF_PROPERTIES
        )
        self._solver.notify_model_changed(changed, world_mask=wp.from_torch(self._mask))

    def mass_properties(self) -> MassProperties:
        """See :meth:`Backend.mass_properties`."""
        self._must_be_open()
        model = self._model
        arrays = model.body_mass, model.body_com, model.body_inertia
        mass, com, inertia = (self._per_world(array).clone() for array in arrays)
        return MassProperties(mass=mass, com=com, inertia=inertia)

    def close(self) -> None:
        """See :meth:`Backend.close`."""
        self._closed = True
