"""MuJoCo-Warp: thousands of worlds on a GPU (or a few on the CPU, for tests), sharing memory with torch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from torch import Tensor

from xreset.capture import GraphRunner
from xreset.errors import XResetError
from xreset.geometry.rotations import quat_multiply, quat_rotate, quat_rotate_inverse, quat_to_matrix
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
from xreset.tensors import where

try:
    import mujoco_warp as mjw
    import warp as wp
except ImportError as error:
    raise unavailable("mujoco_warp", "'xreset[mujoco-warp]'", error) from error

from xreset.backends import mujoco_warp_kernels as kernels
from xreset.backends.mjcf import KNOWN_DIFFERENCES, compile_scene
from xreset.backends.mjcf_model import MIN_FRICTION
from xreset.backends.mujoco_warp_setup import (
    announced,
    contact_room,
    correct_engine,
    differing_fields,
    engine_step,
    existing_device,
    fill_batched,
)
from xreset.torch_warp import TorchStream, quiet

_SET_PER_WORLD = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "body_gravcomp",
    "geom_friction",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
)
"""Model fields that the setters change.

They, and all that MuJoCo derives from them, must be batched, or every world gets the values of world 0.
"""

_SOLVER_ITERATIONS = 8
"""Most Newton iterations; worlds that have converged stop earlier, but a step waits for the slowest. With 8 the
conformance checks give the same results as with 30, at 240 and at 120 Hz."""
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

    The worlds share one model; what differs between worlds (the object's shapes, masses, friction) is a batched field
    of the model. A captured CUDA graph holds pointers to the arrays that existed when it was captured: ``__init__``
    allocates all of them, and none is ever replaced.

    All work is queued on torch's current stream; no method waits for the GPU. Getters return views of the engine's
    memory. Contacts are pooled: when the pool is full, every world reports an overflow.
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
    ) -> None:
        """Build the worlds, compile the kernels and capture the CUDA graphs.

        Args:
            scene: see :class:`Backend`.
            num_worlds: see :class:`Backend`.
            object_index: see :class:`Backend`.
            device: ``cuda[:i]`` or ``cpu``.

        Raises:
            BackendUnavailableError: the device does not exist.
        """
        super().__init__(scene, num_worlds, object_index=object_index, device=existing_device(device))
        held = self.object_index.unique().tolist()
        scenes = {i: compile_scene(scene, i, slots_for=held) for i in held}
        self._at = at = next(iter(scenes.values()))
        at.model.opt.iterations = _SOLVER_ITERATIONS
        contacts, convex, rows = contact_room(max(len(scene.objects[i].pieces) for i in held))
        with quiet():
            correct_engine()
            self._warp_device = wp.device_from_torch(self.device)
            self._on_stream = TorchStream(self.device)
            with self._on_stream():
                differing = differing_fields([scene.model for scene in scenes.values()])
                batched = dict.fromkeys((*_SET_PER_WORLD, *differing), num_worlds)
                self._model: Any = mjw.put_model(at.model, batch_sizes=batched)
                # Overflows are counted, see health(); printing them from the GPU would flood the terminal.
                self._model.opt.warn_overflow = 0
                self._data: Any = mjw.make_data(
                    at.model, nworld=num_worlds, nconmax=contacts, nccdmax=convex, njmax=rows
                )
                fill_batched(self._model, scenes, self.object_index, differing)
                self._allocate()
                with announced(self._warp_device):
                    self._prepare()
            self.set_state(State.initial(scene, self.object_index).to(self.device))

    @classmethod
    def engine_version(cls) -> str:
        return mjw.__version__

    @classmethod
    def devices(cls) -> list[str]:
        return ["cuda", "cpu"] if torch.cuda.is_available() else ["cpu"]

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        self._must_be_open()
        index = self._selected(worlds)
        self._coming[index] = self._checked_state(state, len(index))
        self._mask.zero_()
        self._mask[index] = True
        self._begin()

    def state(self) -> State:
        self._must_be_open()
        return self._state

    def set_joint_targets(self, targets: Tensor) -> None:
        self._must_be_open()
        present = self._state.joint_target
        present.copy_(self._checked("joint_target", targets, present.shape))

    def step(self, substeps: int | None = None) -> None:
        self._must_be_open()
        substeps = self._checked_substeps(substeps)
        with self._on_stream():
            for _ in range(substeps):
                self._run("step")
            self._run("read")
        self._captured.run(self._read_motion)

    # Readings ---------------------------------------------------------------------------------------------------------

    def links(self) -> Links:
        self._must_be_open()
        return self._links

    def contacts(self) -> Contacts:
        self._must_be_open()
        return self._contacts

    def health(self) -> Health:
        self._must_be_open()
        return Health(nonfinite=self._nonfinite, overflow=(self._array["overflow"] & _OVERFLOW) != 0)

    def set_where(self, mask: Tensor, state: State, parameters: Parameters) -> None:
        self._must_be_open()
        for name, value in parameters.given().items():
            present = self._parameters[name]
            present.copy_(where(mask, self._checked(name, value, present.shape), present))
        self._coming.map(Tensor.copy_, self._checked_state(state, self.num_worlds))
        self._mask.copy_(mask)
        self._begin()

    def mass_properties(self) -> MassProperties:
        self._must_be_open()
        bodies = [*self._at.moving_bodies.tolist(), self._at.object_body]

        def of_bodies(name: str) -> Tensor:
            values = wp.to_torch(getattr(self._model, name))[:, bodies]
            return values.expand(self.num_worlds, *values.shape[1:]).clone()

        axes = quat_to_matrix(of_bodies("body_iquat"))
        moments = torch.diag_embed(of_bodies("body_inertia"))
        inertia = axes @ moments @ axes.mT
        return MassProperties(mass=of_bodies("body_mass"), com=of_bodies("body_ipos"), inertia=inertia)

    # Physical parameters ----------------------------------------------------------------------------------------------

    def _set(self, name: Parameter, value: Tensor, worlds: Tensor | None) -> None:
        self._must_be_open()
        index = self._selected(worlds)
        present = self._parameters[name]
        present[index] = self._checked(name, value, (len(index), *present.shape[1:]))
        self._mask.zero_()
        self._begin()

    def set_object_wrench(self, force: Tensor, torque: Tensor) -> None:
        self._must_be_open()
        wrench = torch.cat((torch.as_tensor(force), torch.as_tensor(torque)), dim=-1)
        self._wrench.copy_(self._checked("wrench", wrench, (self.num_worlds, 6)))

    def close(self) -> None:
        """Free the worlds' memory once nobody else holds a view of it."""
        self._graphs.clear()
        self._model = self._data = None

    # Building ---------------------------------------------------------------------------------------------------------

    def _allocate(self) -> None:
        """Allocate the tensors that the worlds are read into, and view the engine's arrays."""
        n = self.num_worlds
        at = self._at
        joints = at.joints
        tips = len(self.scene.robot.fingertips)

        def on_device(values: np.ndarray) -> Tensor:
            return torch.as_tensor(values, device=self.device)

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
            return torch.zeros(shape, dtype=dtype, device=self.device)

        self._object_qpos = slice(at.object_qpos, at.object_qpos + 7)
        self._object_dof = slice(at.object_dof, at.object_dof + 6)
        self._geom_role = wp.array(at.geom_role.astype(np.int32), dtype=int)
        self._qpos_address = on_device(at.qpos)
        self._dof_address = on_device(at.dof)
        self._mimic_source = on_device(joints.source)
        self._mimic_multiplier = on_device(joints.multiplier).float()
        self._mimic_offset = on_device(joints.offset).float()
        self._friction_column = on_device(at.friction_column)
        self._link_body = on_device(at.link_body)
        self._link_root = on_device(at.model.body_rootid[at.link_body]).long()
        self._link_pos = on_device(at.link_pos).float()
        self._link_quat = on_device(at.link_quat).float()

        names = ("qpos", "qvel", "ctrl", "qacc_warmstart", "overflow", "xpos", "xquat", "cvel", "subtree_com")
        self._array = {name: wp.to_torch(getattr(self._data, name)) for name in names}
        self._wrench = wp.to_torch(self._data.xfrc_applied)[:, at.object_body]
        self._coming = State.initial(self.scene, self.object_index).to(self.device).clone()
        self._state = replace(self._coming.clone(), joint_target=self._array["ctrl"])
        links = (n, 1 + tips)
        self._links = Links(
            pos=zeros(*links, 3), quat=zeros(*links, 4), linvel=zeros(*links, 3), angvel=zeros(*links, 3)
        )
        touch = zeros(n, tips, dtype=torch.bool)
        self._contacts = Contacts(tip_force=zeros(n, tips, 3), tip_touch=touch, table_force=zeros(n, 3))
        self._nonfinite = zeros(n, dtype=torch.bool)
        self._mask = zeros(n, dtype=torch.bool)
        self._captured = GraphRunner(self.device)
        self._every_world = torch.arange(n, device=self.device)
        self._model_field = {name: wp.to_torch(getattr(self._model, name)) for name in _SET_PER_WORLD}
        self._nominal = {name: value.clone() for name, value in self._model_field.items()}
        self._parameters = Parameters.nominal(self.scene, self.object_index).to(self.device).given()
        """The present values of each world."""

    def _prepare(self) -> None:
        """Run each sequence of kernels once, which compiles it, then capture it as a graph.

        Even on the CPU a graph saves most of the time.
        """
        step = partial(engine_step(self._warp_device, self._model), self._model, self._data)
        # The kinematics of the present positions are always there: a step begins after them, and all that changes them
        # ends with them.
        kinematics = partial(mjw.fwd_kinematics, self._model, self._data)
        velocities = partial(mjw.com_vel, self._model, self._data)
        sequences: dict[str, tuple[Callable[[], None], ...]] = {
            "step": (step, kinematics),
            "read": (self._read_contacts, velocities),
            "begin": (kinematics, velocities),
        }
        for part in chain.from_iterable(sequences.values()):
            part()
        wp.synchronize_device(self._warp_device)
        self._graphs: dict[str, Any] = {}
        # torch's default stream cannot be captured
        side_stream = wp.Stream(self._warp_device) if self._warp_device.is_cuda else None
        with wp.ScopedStream(side_stream):
            for name, sequence in sequences.items():
                with wp.ScopedCapture(device=self._warp_device) as capture:
                    for part in sequence:
                        part()
                self._graphs[name] = capture.graph
        wp.synchronize_device(self._warp_device)

    # Reading and writing ----------------------------------------------------------------------------------------------

    def _read_contacts(self) -> None:
        """Read the forces of the last step's contacts; their arrays stay until the next step."""
        d = self._data
        outputs = []
        for name, dtype in (("tip_force", wp.vec3), ("tip_touch", None), ("table_force", wp.vec3)):
            array = wp.from_torch(getattr(self._contacts, name), dtype=dtype)
            array.zero_()
            outputs.append(array)
        contact = d.contact
        found = [d.nacon, d.naconmax, d.njmax, contact.worldid, contact.geom, contact.frame, contact.efc_address]
        wp.launch(
            kernels.read_contacts,
            dim=d.naconmax,
            inputs=[self._geom_role, *found, d.efc.force],
            outputs=outputs,
        )

    def _read_motion(self) -> None:
        """Translate positions and velocities of joints, object and links."""
        array = self._array
        driven = len(self.scene.robot.joints)
        qpos = array["qpos"]
        qvel = array["qvel"]
        pos, quat = qpos[:, self._object_qpos].split((3, 4), dim=1)
        linvel, spin = qvel[:, self._object_dof].split((3, 3), dim=1)
        state = State(
            joint_pos=qpos[:, self._qpos_address[:driven]],
            joint_vel=qvel[:, self._dof_address[:driven]],
            joint_target=array["ctrl"],
            object_pos=pos,
            object_quat=quat,
            object_linvel=linvel,
            object_angvel=quat_rotate(quat, spin),
        )
        self._state.map(Tensor.copy_, state)
        self._nonfinite |= ~(qpos.isfinite().all(dim=1) & qvel.isfinite().all(dim=1))

        turn = array["xquat"][:, self._link_body]
        point = array["xpos"][:, self._link_body] + quat_rotate(turn, self._link_pos)
        omega, velocity = array["cvel"][:, self._link_body].split((3, 3), dim=-1)
        arm = point - array["subtree_com"][:, self._link_root]  # velocities refer to the centre of mass of the tree
        links = Links(
            pos=point,
            quat=quat_multiply(turn, self._link_quat.expand_as(turn)),
            linvel=velocity + torch.linalg.cross(omega, arm),
            angvel=omega,
        )
        self._links.map(Tensor.copy_, links)

    def _begin(self) -> None:
        """Write the coming state of the worlds of the mask and the parameters of all, and read the worlds."""
        self._captured.run(self._write)
        with self._on_stream():
            self._run("begin")
        self._captured.run(self._read_motion)

    def _write(self) -> None:
        self._write_state()
        self._write_parameters()

    def _write_state(self) -> None:
        """Write the coming state of the worlds of the mask, and clear what remains of their past."""
        state = self._coming
        driven = len(self.scene.robot.joints)
        source = self._mimic_source
        multiplier = self._mimic_multiplier
        quat = state.object_quat / state.object_quat.norm(dim=1, keepdim=True)
        qpos = torch.empty_like(self._array["qpos"])
        qpos[:, self._qpos_address[:driven]] = state.joint_pos
        qpos[:, self._qpos_address[driven:]] = multiplier * state.joint_pos[:, source] + self._mimic_offset
        qpos[:, self._object_qpos] = torch.cat((state.object_pos, quat), dim=1)
        qvel = torch.empty_like(self._array["qvel"])
        qvel[:, self._dof_address[:driven]] = state.joint_vel
        qvel[:, self._dof_address[driven:]] = multiplier * state.joint_vel[:, source]
        spin = quat_rotate_inverse(quat, state.object_angvel)  # of a free joint: in the body's frame
        qvel[:, self._object_dof] = torch.cat((state.object_linvel, spin), dim=1)
        for name, new in (("qpos", qpos), ("qvel", qvel), ("ctrl", state.joint_target)):
            present = self._array[name]
            present.copy_(where(self._mask, new, present))
        array = self._array
        contacts = vars(self._contacts).values()
        for past in (array["qacc_warmstart"], self._wrench, array["overflow"], self._nonfinite, *contacts):
            past.masked_fill_(self._mask.view(-1, *[1] * (past.ndim - 1)), 0)

    def _write_parameters(self) -> None:
        """Write the present parameters of all worlds into the engine's model, and all that MuJoCo derives from them."""
        body = self._at.object_body
        field = self._model_field
        nominal = self._nominal
        present = self._parameters
        mass = present["object_mass"]
        nominal_mass = nominal["body_mass"][:, body]
        ratio = mass / nominal_mass
        turning = ratio * present["object_inertia"]
        field["body_mass"][:, body] = mass
        field["body_inertia"][:, body] = nominal["body_inertia"][:, body] * turning[:, None]
        field["body_ipos"][:, body] = nominal["body_ipos"][:, body] + present["object_com"]
        field["body_subtreemass"][:, body] = mass
        field["body_subtreemass"][:, 0] = nominal["body_subtreemass"][:, 0] + mass - nominal_mass
        weight = nominal["body_invweight0"][:, body]  # of a free body: the inverse of mass and inertia
        field["body_invweight0"][:, body] = weight / torch.stack((ratio, turning), dim=1)
        field["body_gravcomp"][:, body] = 1.0 - present["object_gravity"]
        pairs = torch.nn.functional.pad(present["friction"], (0, 1)).clamp_min(MIN_FRICTION)
        field["geom_friction"][..., 0] = pairs[:, self._friction_column]
        field["geom_friction"][..., 1] = present["torsional_friction"][:, None]
        stiffness, damping, effort = present["drives"][..., None].unbind(1)
        field["actuator_gainprm"][..., :1] = stiffness * nominal["actuator_gainprm"][..., :1]
        field["actuator_biasprm"][..., :2] = stiffness * nominal["actuator_biasprm"][..., :2]
        field["actuator_biasprm"][..., 2:3] = damping * nominal["actuator_biasprm"][..., 2:3]
        field["actuator_forcerange"][:] = effort * nominal["actuator_forcerange"]

    def _run(self, name: str) -> None:
        wp.capture_launch(self._graphs[name])

    # Checking ---------------------------------------------------------------------------------------------------------

    def _selected(self, worlds: Tensor | None) -> Tensor:
        if worlds is None:
            return self._every_world
        return torch.as_tensor(worlds, dtype=torch.int64, device=self.device)

    def _checked_state(self, state: State, rows: int) -> State:
        checked = {}
        for name, present in vars(self._state).items():
            checked[name] = self._checked(name, getattr(state, name), (rows, *present.shape[1:]))
        return State(**checked)

    def _must_be_open(self) -> None:
        if self._data is None:
            raise XResetError(f"The backend {self.name!r} is closed. Build a new one.")
