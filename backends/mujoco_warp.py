"""MuJoCo-Warp: thousands of worlds on a GPU (or a few on the CPU, for tests), sharing memory with torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from itertools import chain
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from torch import Tensor

from xreset.errors import XResetError
from xreset.geometry.rotations import quat_to_matrix
from xreset.physics import (
    Backend,
    Capability,
    Contacts,
    Health,
    KnownDifference,
    Links,
    MassProperties,
    Parameter,
    Parameters,
    State,
    unavailable,
)
from xreset.spec import SceneSpec

try:
    import mujoco_warp as mjw
    import warp as wp
except ImportError as error:
    raise unavailable("mujoco_warp", "'xreset[mujoco-warp]'", error) from error

from xreset.backends import mujoco_warp_kernels as kernels
from xreset.backends.mjcf import KNOWN_DIFFERENCES, MujocoSettings, compile_scene
from xreset.backends.mjcf_model import MIN_FRICTION
from xreset.backends.mujoco_warp_setup import (
    TorchStream,
    announced,
    contact_room,
    differing_fields,
    engine_step,
    existing_device,
    fill_batched,
    prepare_engine,
)

_SET_PER_WORLD = (
    "body_mass", "body_inertia", "body_ipos", "body_subtreemass", "body_invweight0", "body_gravcomp", "geom_friction",
    "actuator_gainprm", "actuator_biasprm", "actuator_forcerange",
)  # fmt: skip
"""Model fields that the setters change: they and all that MuJoCo derives from them must be batched, or every world gets world 0's."""

_OVERFLOW = int(
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
    | mjw.OverflowType.EPA_HORIZON
)
"""Overflows that lose a contact or a constraint."""


class MujocoWarpBackend(Backend):
    """MuJoCo-Warp.

    The worlds share one model; what differs between worlds (the object's shapes, masses, friction) is a batched field of it. A captured
    CUDA graph holds pointers to the arrays that existed when it was captured: ``__init__`` allocates all, and none is ever replaced.

    All work is queued on torch's current stream; no method waits for the GPU.
    """

    name: ClassVar[str] = "mujoco-warp"
    capabilities: ClassVar[frozenset[Capability]] = frozenset(get_args(Capability))
    known_differences: ClassVar[tuple[KnownDifference, ...]] = KNOWN_DIFFERENCES

    def __init__(
        self,
        scene: SceneSpec,
        num_worlds: int,
        *,
        object_index: Tensor | None = None,
        device: str = "cpu",
        contacts_per_world: int | None = None,
        convex_contacts_per_world: int | None = None,
        constraints_per_world: int | None = None,
        solver_iterations: int = 8,
        settings: MujocoSettings | None = None,
    ) -> None:
        """Build the worlds, compile the kernels and capture the CUDA graphs.

        Args:
            scene: what to simulate.
            num_worlds: N.
            object_index: [N] which object each world holds.
            device: ``cuda[:i]`` or ``cpu``.
            contacts_per_world: contacts are pooled: all worlds together may have N times as many. Pairs of shapes that are near each other
                count while contacts are being found, so more are needed than touch.
            convex_contacts_per_world: likewise, pairs of a type that overlap and need the general convex algorithm.
            constraints_per_world: rows of constraints (4 a contact, 1 a dry friction, joint limit or mimic joint) in any one world.
                None, of any of the three: by the object with the most pieces (:func:`~xreset.backends.mujoco_warp_setup.contact_room`).
            solver_iterations: most Newton iterations; worlds that have converged stop earlier, but a step waits for the slowest. With 8 the
                conformance checks come out as with 30, at 240 and at 120 Hz.
            settings: further dials.

        Raises:
            BackendUnavailableError: there is no such device.
        """
        super().__init__(scene, num_worlds, object_index=object_index, device=existing_device(device))
        prepare_engine()
        self._warp_device = wp.device_from_torch(self.device)
        self._on_stream = TorchStream(self.device)
        held = self.object_index.unique().tolist()
        scenes = {i: compile_scene(scene, i, slots_for=held, settings=settings or MujocoSettings()) for i in held}
        self._at = at = next(iter(scenes.values()))
        asked = (contacts_per_world, convex_contacts_per_world, constraints_per_world)
        usual = contact_room(max(len(scene.objects[i].pieces) for i in held))
        contacts, convex, rows = (u if a is None else a for a, u in zip(asked, usual, strict=True))
        at.model.opt.iterations = solver_iterations
        with self._on_stream():
            differing = differing_fields([s.model for s in scenes.values()])
            self._model: Any = mjw.put_model(
                at.model, batch_sizes=dict.fromkeys((*_SET_PER_WORLD, *differing), num_worlds)
            )
            self._model.opt.warn_overflow = (
                0  # overflows are counted, see health(); printing them from the GPU would flood the terminal
            )
            self._data: Any = mjw.make_data(
                at.model,
                nworld=num_worlds,
                nconmax=contacts,
                nccdmax=min(convex, contacts),
                njmax=rows,
            )
            fill_batched(self._model, scenes, self.object_index, differing)
            self._allocate()
            with announced(self._warp_device):
                self._prepare()
        self.set_state(State.initial(scene, self.object_index).to(self.device))

    # Availability -----------------------------------------------------------------------------------------------------

    @classmethod
    def engine_version(cls) -> str:
        """See :meth:`Backend.engine_version`."""
        return mjw.__version__

    @classmethod
    def devices(cls) -> list[str]:
        """Kinds of devices that can be used here."""
        return ["cuda", "cpu"] if torch.cuda.is_available() else ["cpu"]

    # State ------------------------------------------------------------------------------------------------------------

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        """See :meth:`Backend.set_state`. The external wrench of those worlds ends."""
        self._must_be_open()
        index = self._every_world if worlds is None else torch.as_tensor(worlds, dtype=torch.int64, device=self.device)
        new = {f.name: self._checked(f.name, getattr(state, f.name), len(index)) for f in fields(State)}
        if not len(index):
            return
        with self._on_stream():
            self._write_state(index.contiguous(), self._everything[: len(index)], new)
            self._run("refresh")

    def state(self) -> State:
        """See :meth:`Backend.state`: views of the engine's memory."""
        self._must_be_open()
        return self._state

    def set_joint_targets(self, targets: Tensor) -> None:
        """See :meth:`Backend.set_joint_targets`."""
        self._must_be_open()
        self._ctrl.copy_(self._checked("joint_target", targets, self.num_worlds))

    def step(self, substeps: int | None = None) -> None:
        """See :meth:`Backend.step`."""
        self._must_be_open()
        substeps = self.scene.substeps if substeps is None else substeps
        if substeps < 1:
            raise ValueError(f"substeps is {substeps}, expected at least 1")
        with self._on_stream():
            for _ in range(substeps):
                self._run("step")
            self._run("read")

    # Readings ---------------------------------------------------------------------------------------------------------

    def links(self) -> Links:
        """See :meth:`Backend.links`: views of the engine's memory."""
        self._must_be_open()
        return self._links

    def contacts(self) -> Contacts:
        """See :meth:`Backend.contacts`: views of the engine's memory."""
        self._must_be_open()
        return self._contacts

    def health(self) -> Health:
        """See :meth:`Backend.health`. Contacts are pooled: when the pool is full, every world reports an overflow."""
        self._must_be_open()
        return Health(nonfinite=self._nonfinite, overflow=(self._overflow & _OVERFLOW) != 0)

    def set_where(self, mask: Tensor, state: State, parameters: Parameters) -> None:
        """See :meth:`Backend.set_where`: a few copies and one graph."""
        self._must_be_open()
        self._mask.copy_(mask)
        for name, value in parameters.given().items():
            present = self._parameters[name]
            mine = self._mask.view(-1, *[1] * (present.ndim - 1))
            torch.where(mine, self._rows(value, present.shape), present, out=present)
        for f in fields(State):
            self._coming[f.name].copy_(self._checked(f.name, getattr(state, f.name), self.num_worlds))
        with self._on_stream():
            self._run("begin")

    def mass_properties(self) -> MassProperties:
        """See :meth:`Backend.mass_properties`."""
        self._must_be_open()
        bodies = [*self._at.moving_bodies.tolist(), self._at.object_body]
        mass, com, quat, moments = (
            wp.to_torch(getattr(self._model, name))[:, bodies].expand(self.num_worlds, *([-1] * rank))
            for name, rank in (("body_mass", 1), ("body_ipos", 2), ("body_iquat", 2), ("body_inertia", 2))
        )
        axes = quat_to_matrix(quat)
        return MassProperties(mass=mass.clone(), com=com.clone(), inertia=axes @ torch.diag_embed(moments) @ axes.mT)

    # Physical parameters ----------------------------------------------------------------------------------------------

    def _set(self, name: Parameter, value: Tensor, worlds: Tensor | None) -> None:
        self._must_be_open()
        index = self._every_world if worlds is None else torch.as_tensor(worlds, dtype=torch.int64, device=self.device)
        present = self._parameters[name]
        present[index] = self._rows(value, (len(index), *present.shape[1:]))
        self._mask.zero_()
        self._mask[index] = True
        with self._on_stream():
            self._run("parameters")

    def set_object_wrench(self, force: Tensor, torque: Tensor) -> None:
        """See :meth:`Backend.set_object_wrench`."""
        self._must_be_open()
        wrench = torch.cat((self._rows(force, (self.num_worlds, 3)), self._rows(torque, (self.num_worlds, 3))), dim=-1)
        self._xfrc_applied[:, self._at.object_body] = wrench

    def close(self) -> None:
        """Free the worlds' memory once nobody else holds a view of it."""
        self._graphs.clear()
        self._model = self._data = None

    # Building ---------------------------------------------------------------------------------------------------------

    def _allocate(self) -> None:
        """Allocate what the worlds are read into, and name what setters write to."""
        n, joints, tips = self.num_worlds, len(self.scene.robot.joints), len(self.scene.robot.fingertips)
        at = self._at

        def ints(values: np.ndarray) -> Any:
            return wp.array(values.astype(np.int32), dtype=int)

        self._out = kernels.outputs(n, joints, tips)
        self._addresses = [ints(at.joint_qpos), ints(at.joint_dof)]
        self._mimic = [
            ints(at.mimic_qpos), ints(at.mimic_dof), ints(at.mimic_source),
            wp.array(at.mimic_multiplier, dtype=float), wp.array(at.mimic_offset, dtype=float),
        ]  # fmt: skip
        self._link_arrays = [
            ints(at.link_body),
            wp.array(at.link_pos, dtype=wp.vec3),
            wp.array(at.link_quat, dtype=wp.quat),
        ]
        self._geom_role, self._friction_columns = ints(at.geom_role), ints(at.friction_column)

        view = {name: wp.to_torch(array) for name, array in self._out.items()}
        self._ctrl, self._xfrc_applied = wp.to_torch(self._data.ctrl), wp.to_torch(self._data.xfrc_applied)
        self._overflow, self._nonfinite = wp.to_torch(self._data.overflow), view["nonfinite"]
        self._state = State(
            joint_target=self._ctrl,
            **{
                name: view[name]
                for name in ("joint_pos", "joint_vel", "object_pos", "object_quat", "object_linvel", "object_angvel")
            },
        )
        self._links = Links(
            pos=view["link_pos"], quat=view["link_quat"], linvel=view["link_linvel"], angvel=view["link_angvel"]
        )
        self._contacts = Contacts(
            tip_force=view["tip_force"], tip_touch=view["tip_touch"], table_force=view["table_force"]
        )
        self._every_world = torch.arange(n, device=self.device)
        self._everything = torch.ones(n, dtype=torch.bool, device=self.device)
        self._mask = torch.zeros_like(self._everything)
        self._coming = {f.name: torch.zeros_like(getattr(self._state, f.name)) for f in fields(State)}
        self._coming["object_quat"][:, 0] = 1.0
        self._name_parameters()

    def _name_parameters(self) -> None:
        """Name what the parameters of the worlds start from, and what they are now."""
        n, body = self.num_worlds, self._at.object_body
        field = {name: wp.to_torch(getattr(self._model, name)) for name in _SET_PER_WORLD}
        self._drive_fields = [wp.from_torch(field[f"actuator_{name}"]) for name in ("gainprm", "biasprm", "forcerange")]
        gain, bias, force_range = (field[f"actuator_{name}"][0] for name in ("gainprm", "biasprm", "forcerange"))
        nominal = {
            "mass": field["body_mass"][:, body],
            "inertia": field["body_inertia"][:, body],
            "com": field["body_ipos"][:, body],
            "total": field["body_subtreemass"][:, 0],
            "invweight": field["body_invweight0"][:, body],
            # stiffness, damping, effort limit, and what the followers' offsets make of the stiffness
            "drive": torch.stack((gain[:, 0], -bias[:, 2], force_range[:, 1], bias[:, 0]), dim=1),
        }
        self._nominal = {name: value.clone() for name, value in nominal.items()}
        friction = self.scene.friction
        pairs = torch.tensor([friction.tip, friction.link, friction.table], device=self.device)
        one = torch.ones(n, device=self.device)
        self._parameters: dict[Parameter, Tensor] = {
            "friction": pairs.repeat(n, 1),
            "torsional_friction": friction.torsional * one,
            "object_mass": self._nominal["mass"].clone(),
            "object_inertia": one.clone(),
            "object_com": torch.zeros_like(self._nominal["com"]),
            "object_gravity": one.clone(),
            "drives": torch.ones(n, 3, len(self.scene.robot.joints), device=self.device),
        }
        """What each world has now."""

    def _prepare(self) -> None:
        """Run each sequence of kernels once, which compiles it, then capture it as a graph: even on the CPU that saves most of the time."""
        step = partial(engine_step(self._warp_device), self._model, self._data)
        begin = partial(self._write_state, self._every_world, self._mask, self._coming)
        # The kinematics of the present positions are always there: a step begins after them, and whatever changes them ends with them.
        kinematics = partial(mjw.fwd_kinematics, self._model, self._data)
        sequences: dict[str, tuple[Callable[[], None], ...]] = {
            "refresh": (kinematics, self._read_motion),
            "step": (step, kinematics),
            "read": (self._read_contacts, self._read_motion),
            "begin": (begin, self._write_parameters, kinematics, self._read_motion),
            "parameters": (self._write_parameters, kinematics),
        }
        for part in chain.from_iterable(sequences.values()):
            part()
        wp.synchronize_device(self._warp_device)
        self._graphs: dict[str, Any] = {}
        side_stream = (
            wp.Stream(self._warp_device) if self._warp_device.is_cuda else None
        )  # torch's default stream cannot be captured
        with wp.ScopedStream(side_stream):
            for name, sequence in sequences.items():
                with wp.ScopedCapture(device=self._warp_device) as capture:
                    for part in sequence:
                        part()
                self._graphs[name] = capture.graph
        wp.synchronize_device(self._warp_device)

    # What the graphs hold ---------------------------------------------------------------------------------------------

    def _read_contacts(self) -> None:
        """Read the forces of the last step's contacts; their arrays stay until the next step."""
        d, out = self._data, self._out
        for name in ("tip_force", "tip_touch", "table_force"):
            out[name].zero_()
        wp.launch(
            kernels.read_contacts,
            dim=d.naconmax,
            inputs=[
                self._geom_role, d.nacon, d.naconmax, d.njmax, d.contact.worldid, d.contact.geom, d.contact.frame, d.contact.efc_address,
                d.efc.force,
            ],
            outputs=[out["tip_force"], out["tip_touch"], out["table_force"]],
        )  # fmt: skip

    def _read_motion(self) -> None:
        """Translate positions and velocities of joints, object and links."""
        m, d, out, at = self._model, self._data, self._out, self._at
        mjw.com_vel(m, d)
        wp.launch(
            kernels.read_state,
            dim=self.num_worlds,
            inputs=[*self._addresses, at.object_qpos, at.object_dof, d.qpos, d.qvel],
            outputs=[
                out["joint_pos"], out["joint_vel"], out["object_pos"], out["object_quat"], out["object_linvel"], out["object_angvel"],
                out["nonfinite"],
            ],
        )  # fmt: skip
        wp.launch(
            kernels.read_links,
            dim=out["link_pos"].shape,
            inputs=[*self._link_arrays, m.body_rootid, d.xpos, d.xquat, d.cvel, d.subtree_com],
            outputs=[out["link_pos"], out["link_quat"], out["link_linvel"], out["link_angvel"]],
        )

    def _write_parameters(self) -> None:
        """Have the engine take over the parameters of the worlds of the mask."""
        m, nominal = self._model, self._nominal
        vectors = {"friction": wp.vec3, "object_com": wp.vec3, "inertia": wp.vec3, "com": wp.vec3, "invweight": wp.vec2}
        given = [wp.from_torch(self._parameters[name], dtype=vectors.get(name)) for name in get_args(Parameter)]
        start = [wp.from_torch(value, dtype=vectors.get(name)) for name, value in nominal.items()]
        wp.launch(
            kernels.write_parameters,
            dim=self.num_worlds,
            inputs=[wp.from_torch(self._mask), *given, *start, self._friction_columns, MIN_FRICTION, self._at.object_body],
            outputs=[
                m.body_mass, m.body_inertia, m.body_ipos, m.body_subtreemass, m.body_invweight0, m.body_gravcomp, m.geom_friction,
                *self._drive_fields,
            ],
        )  # fmt: skip

    def _write_state(self, worlds: Tensor, chosen: Tensor, new: dict[str, Tensor]) -> None:
        """Write the chosen ones of M new states into ``worlds`` [M]."""
        d, out, at = self._data, self._out, self._at
        wp.launch(
            kernels.write_state,
            dim=len(worlds),
            inputs=[
                wp.from_torch(worlds), wp.from_torch(chosen), wp.from_torch(new["joint_pos"]), wp.from_torch(new["joint_vel"]),
                wp.from_torch(new["joint_target"]), wp.from_torch(new["object_pos"], dtype=wp.vec3),
                wp.from_torch(new["object_quat"], dtype=wp.quat), wp.from_torch(new["object_linvel"], dtype=wp.vec3),
                wp.from_torch(new["object_angvel"], dtype=wp.vec3), *self._addresses, *self._mimic, at.object_qpos, at.object_dof,
                at.object_body,
            ],
            outputs=[
                d.qpos, d.qvel, d.ctrl, d.qacc_warmstart, d.xfrc_applied, d.overflow, out["nonfinite"], out["tip_force"],
                out["tip_touch"], out["table_force"],
            ],
        )  # fmt: skip

    def _run(self, name: str) -> None:
        wp.capture_launch(self._graphs[name])

    # Checking ---------------------------------------------------------------------------------------------------------

    def _rows(self, value: Tensor, shape: tuple[int, ...]) -> Tensor:
        value = torch.as_tensor(value, dtype=torch.float32, device=self.device).detach()
        if value.shape != shape:
            raise ValueError(f"found shape {tuple(value.shape)}, expected {tuple(shape)}")
        return value.contiguous()

    def _checked(self, name: str, value: Tensor, rows: int) -> Tensor:
        try:
            return self._rows(value, (rows, *getattr(self._state, name).shape[1:]))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None

    def _must_be_open(self) -> None:
        if self._data is None:
            raise XResetError(f"the backend {self.name!r} is closed. Build a new one.")
