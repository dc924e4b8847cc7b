"""MuJoCo-Warp: thousands of worlds on a GPU (or a few on the CPU, for tests), sharing memory with torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Any, ClassVar, get_args

import numpy as np
import torch
from torch import Tensor

from xreset.geometry.rotations import quat_to_matrix
from xreset.physics import (
    Capability,
    Health,
    KnownDifference,
    MassProperties,
    Parameter,
    unavailable,
)
from xreset.spec import SceneSpec

try:
    import mujoco_warp as mjw
    import warp as wp
except ImportError as error:
    raise unavailable("mujoco_warp", "'xreset[mujoco-warp]'", error) from error

from xreset.backends import mujoco_warp_kernels as kernels
from xreset.backends.batch import BatchBackend
from xreset.backends.mjcf import KNOWN_DIFFERENCES, compile_scene
from xreset.backends.mjcf_model import MIN_FRICTION
from xreset.backends.mujoco_warp_setup import (
    announced,
    compile_kernels,
    contact_room,
    correct_engine,
    differing_fields,
    engine_step,
    fill_batched,
    order_pairs,
)
from xreset.physics.torch_warp import TorchStream, quiet

_DRIVE_FIELDS = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange")
_SET_PER_WORLD = (
    "body_mass",
    "body_inertia",
    "body_ipos",
    "body_subtreemass",
    "body_invweight0",
    "body_gravcomp",
    "geom_friction",
    *_DRIVE_FIELDS,
)
"""Model fields that the setters change.

They, and all that MuJoCo derives from them, must be batched, or every world gets the values of world 0.
"""

_VECTORS = (
    "pos",
    "linvel",
    "angvel",
    "object_pos",
    "object_linvel",
    "object_angvel",
    "tip_force",
    "table_force",
    "friction",
    "object_com",
    "inertia",
    "com",
)
_TYPES: dict[str, Any] = dict.fromkeys(_VECTORS, wp.vec3)
_TYPES |= {"quat": wp.quat, "object_quat": wp.quat, "invweight": wp.vec2}
"""Types for Warp of values that are no plain numbers."""

_SOLVER_ITERATIONS = 8
"""Most Newton iterations; worlds that have converged stop earlier, but a step waits for the slowest. With 8 the
conformance checks give the same results as with 30, at 240 and at 120 Hz."""
_MANY_WORLDS = 256
"""Number of worlds from which on one world always takes all iterations, because a tenth of all worlds do. Then the
question whether all worlds have converged, after each iteration, costs 1.4 % of a step and never ends it early."""
_OVERFLOW = int(
    mjw.OverflowType.NEFC
    | mjw.OverflowType.NJMAX_NNZ
    | mjw.OverflowType.BROADPHASE
    | mjw.OverflowType.NARROWPHASE
    | mjw.OverflowType.CCD
    | mjw.OverflowType.EPA_HORIZON
)
"""Overflows that lose a contact or a constraint."""


class MujocoWarpBackend(BatchBackend):
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
        super().__init__(scene, num_worlds, object_index=object_index, device=device)
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
                self._model.opt.graph_conditional = num_worlds < _MANY_WORLDS
                self._data: Any = mjw.make_data(
                    at.model, nworld=num_worlds, nconmax=contacts, nccdmax=convex, njmax=rows
                )
                fill_batched(self._model, scenes, self.object_index, differing)
                order_pairs(self._model)
                self._allocate()
                with announced(self._warp_device):
                    self._prepare()
            self.begin()

    @classmethod
    def engine_version(cls) -> str:
        return mjw.__version__

    @classmethod
    def devices(cls) -> list[str]:
        return ["cuda", "cpu"] if torch.cuda.is_available() else ["cpu"]

    def begin(self) -> None:
        with self._on_stream():
            self._run("begin")

    def apply_parameters(self) -> None:
        with self._on_stream():
            self._run("parameters")

    def step(self, substeps: int | None = None) -> None:
        self._must_be_open()
        substeps = self._checked_substeps(substeps)
        with self._on_stream():
            for _ in range(substeps):
                self._run("step")
            self._run("read")

    # Readings ---------------------------------------------------------------------------------------------------------

    def health(self) -> Health:
        self._must_be_open()
        return Health(nonfinite=self._nonfinite, overflow=(self._overflow & _OVERFLOW) != 0)

    def mass_properties(self) -> MassProperties:
        self._must_be_open()
        bodies = [*self._at.moving_bodies.tolist(), self._at.object_body]

        def of_bodies(name: str) -> Tensor:
            values = wp.to_torch(getattr(self._model, name))[:, bodies]
            return values.expand(self.num_worlds, *values.shape[1:]).clone()

        axes = quat_to_matrix(of_bodies("body_iquat"))
        moments = torch.diag_embed(of_bodies("body_inertia"))
        inertia = axes @ moments @ axes.mT
        return MassProperties(
            mass=of_bodies("body_mass"), com=of_bodies("body_ipos"), inertia=inertia
        )

    def close(self) -> None:
        """Free the worlds' memory once nobody else holds a view of it."""
        self._closed = True
        self._graphs.clear()
        self._model = self._data = None

    # Building ---------------------------------------------------------------------------------------------------------

    def _allocate(self) -> None:
        """Allocate the arrays that the worlds are read into, and name the arrays that setters write to."""
        at = self._at

        def ints(values: np.ndarray) -> Any:
            return wp.array(values.astype(np.int32), dtype=int)

        joints = at.joints
        self._addresses = [ints(at.qpos[joints.driven]), ints(at.dof[joints.driven])]
        self._mimic = [
            ints(at.qpos[joints.mimic]),
            ints(at.dof[joints.mimic]),
            ints(joints.source),
            wp.array(joints.multiplier, dtype=float),
            wp.array(joints.offset, dtype=float),
        ]
        self._link_arrays = [
            ints(at.link_body),
            wp.array(at.link_pos, dtype=wp.vec3),
            wp.array(at.link_quat, dtype=wp.quat),
        ]
        self._geom_role = ints(at.geom_role)
        self._friction_columns = ints(at.friction_column)

        self._wrench = wp.to_torch(self._data.xfrc_applied)[:, at.object_body]
        self._overflow = wp.to_torch(self._data.overflow)
        self._state = replace(self._state, joint_target=wp.to_torch(self._data.ctrl))
        self._nonfinite = self._health.nonfinite
        self._name_parameters()

    def _name_parameters(self) -> None:
        """Name the values that the parameters of the worlds start from."""
        body = self._at.object_body
        field = {name: wp.to_torch(getattr(self._model, name)) for name in _SET_PER_WORLD}
        self._drive_fields = [wp.from_torch(field[name]) for name in _DRIVE_FIELDS]
        gain, bias, force_range = (field[name][0] for name in _DRIVE_FIELDS)
        nominal = {
            "mass": field["body_mass"][:, body],
            "inertia": field["body_inertia"][:, body],
            "com": field["body_ipos"][:, body],
            "total": field["body_subtreemass"][:, 0],
            "invweight": field["body_invweight0"][:, body],
            # stiffness, damping, effort limit, and the followers' offsets times the stiffness
            "drive": torch.stack((gain[:, 0], -bias[:, 2], force_range[:, 1], bias[:, 0]), dim=1),
        }
        self._nominal = {name: value.clone() for name, value in nominal.items()}

    def _prepare(self) -> None:
        """Compile the kernels, run each sequence of them once, then capture it as a graph.

        Even on the CPU a graph saves most of the time.
        """
        step = partial(engine_step(self._warp_device), self._model, self._data)
        # The kinematics of the present positions are always there: a step begins after them, and all that changes them
        # ends with them.
        kinematics = partial(mjw.fwd_kinematics, self._model, self._data)
        sequences: dict[str, tuple[Callable[[], None], ...]] = {
            "step": (step, kinematics),
            "read": (self._read_contacts, self._read_motion),
            "begin": (self._write_state, self._write_parameters, kinematics, self._read_motion),
            "parameters": (self._write_parameters, kinematics),
        }

        def run() -> None:
            for part in chain.from_iterable(sequences.values()):
                part()

        compile_kernels(self._warp_device, run)
        run()
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

    # What the graphs hold ---------------------------------------------------------------------------------------------

    def _read_contacts(self) -> None:
        """Read the forces of the last step's contacts; their arrays stay until the next step."""
        d = self._data
        outputs = _arrays(vars(self._contacts))
        for array in outputs:
            array.zero_()
        contact = d.contact
        found = [
            d.nacon,
            d.naconmax,
            d.njmax,
            contact.worldid,
            contact.geom,
            contact.frame,
            contact.efc_address,
        ]
        wp.launch(
            kernels.read_contacts,
            dim=d.naconmax,
            inputs=[self._geom_role, *found, d.efc.force],
            outputs=outputs,
        )

    def _read_motion(self) -> None:
        """Translate positions and velocities of joints, object and links."""
        m = self._model
        d = self._data
        mjw.com_vel(m, d)
        state = {name: value for name, value in vars(self._state).items() if name != "joint_target"}
        wp.launch(
            kernels.read_state,
            dim=self.num_worlds,
            inputs=[*self._addresses, self._at.object_qpos, self._at.object_dof, d.qpos, d.qvel],
            outputs=_arrays(state | {"nonfinite": self._nonfinite}),
        )
        wp.launch(
            kernels.read_links,
            dim=self._links.pos.shape[:2],
            inputs=[*self._link_arrays, m.body_rootid, d.xpos, d.xquat, d.cvel, d.subtree_com],
            outputs=_arrays(vars(self._links)),
        )

    def _write_parameters(self) -> None:
        """Write the parameters of the worlds of the mask into the engine's model."""
        m = self._model
        values = {name: self.parameters[name] for name in get_args(Parameter)} | self._nominal
        wp.launch(
            kernels.write_parameters,
            dim=self.num_worlds,
            inputs=[
                wp.from_torch(self.chosen),
                *_arrays(values),
                self._friction_columns,
                MIN_FRICTION,
                self._at.object_body,
            ],
            outputs=[
                m.body_mass,
                m.body_inertia,
                m.body_ipos,
                m.body_subtreemass,
                m.body_invweight0,
                m.body_gravcomp,
                m.geom_friction,
                *self._drive_fields,
            ],
        )

    def _write_state(self) -> None:
        """Write the coming state of the worlds of the mask."""
        d = self._data
        at = self._at
        wp.launch(
            kernels.write_state,
            dim=self.num_worlds,
            inputs=[
                wp.from_torch(self.chosen),
                *_arrays(vars(self.coming)),
                *self._addresses,
                *self._mimic,
                at.object_qpos,
                at.object_dof,
                at.object_body,
            ],
            outputs=[
                d.qpos,
                d.qvel,
                d.ctrl,
                d.qacc_warmstart,
                d.xfrc_applied,
                d.overflow,
                *_arrays({"nonfinite": self._nonfinite} | vars(self._contacts)),
            ],
        )

    def _run(self, name: str) -> None:
        wp.capture_launch(self._graphs[name])


def _arrays(values: Mapping[str, Tensor]) -> list[Any]:
    """Return Warp's views of named tensors."""
    return [wp.from_torch(value, dtype=_TYPES.get(name)) for name, value in values.items()]
