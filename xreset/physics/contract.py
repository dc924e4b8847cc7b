"""The physics interface: state in, state out. No reward, no observation, no viewer.

Shape letters: N worlds, M selected worlds, J actuated joints, E fingertips, K = 1 + E tracked links (the palm, then the
fingertips). Tensors are float32 on the backend's device. World frame, SI units, quaternions (w, x, y, z), joint order
of ``scene.robot.joints``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, get_args

from xreset.errors import BackendUnavailableError, CapabilityError, WrongValueError, XResetError
from xreset.files.checks import frozen
from xreset.files.text import shown
from xreset.physics.tensors import Tensors
from xreset.spec import RobotSpec, SceneSpec, lowest_point

if TYPE_CHECKING:  # functions import torch, because engines with one world play without it
    from torch import Tensor

Parameter = Literal[
    "friction",
    "torsional_friction",
    "object_mass",
    "object_inertia",
    "object_com",
    "object_gravity",
    "drives",
]
"""A physical parameter with a value per world, set by ``Backend.set_...``."""
_POSITIVE = ("object_mass", "object_inertia")
_NOT_NEGATIVE = ("friction", "torsional_friction", "drives")
Capability = Literal[Parameter, "object_wrench", "mass_properties"]
"""A feature that some backends lack: set a parameter per world, apply a wrench, read back masses, centers of mass and
inertias."""


@frozen
class State(Tensors):
    """The full state of worlds. Setting it removes everything else: warm starts, old targets, external forces."""

    joint_pos: Tensor
    """[N, J] rad (m)."""
    joint_vel: Tensor
    """[N, J] rad/s (m/s)."""
    joint_target: Tensor
    """[N, J] drive targets, rad (m)."""
    object_pos: Tensor
    """[N, 3] origin of the object's mesh frame."""
    object_quat: Tensor
    """[N, 4]"""
    object_linvel: Tensor
    """[N, 3] velocity of the mesh-frame origin."""
    object_angvel: Tensor
    """[N, 3] world frame, rad/s."""

    @classmethod
    def at_rest(
        cls,
        joint_pos: Tensor,
        object_pos: Tensor,
        object_quat: Tensor,
        joint_target: Tensor | None = None,
    ) -> Self:
        """Return a state in which nothing moves. ``joint_target`` [N, J] defaults to the joint positions [N, J]."""
        import torch

        q = joint_pos.float()
        pos = object_pos.float()
        if joint_target is None:
            joint_target = q.clone()
        return cls(
            joint_pos=q,
            joint_vel=torch.zeros_like(q),
            joint_target=joint_target.float(),
            object_pos=pos,
            object_quat=object_quat.float(),
            object_linvel=torch.zeros_like(pos),
            object_angvel=torch.zeros_like(pos),
        )

    @classmethod
    def initial(cls, scene: SceneSpec, object_index: Tensor) -> Self:
        """Return the first state of worlds with these objects [N]: nothing moves, the robot at home, the object upright
        in the table's middle."""
        import torch

        places = torch.tensor(
            [(*scene.table.center, -lowest_point(spec.pieces)) for spec in scene.objects]
        )
        home = torch.as_tensor(scene.robot.home).repeat(len(object_index), 1)
        upright = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(object_index), 1)
        return cls.at_rest(home, places[object_index.cpu()], upright)


@frozen
class Parameters(Tensors):
    """Physical parameters of worlds, as their setters take them; None: unchanged."""

    friction: Tensor | None = None
    """[N, 3] of the pairs object-fingertip, object-other link, object-table."""
    torsional_friction: Tensor | None = None
    """[N] m."""
    object_mass: Tensor | None = None
    """[N] kg."""
    object_inertia: Tensor | None = None
    """[N] factor on the object's inertia."""
    object_com: Tensor | None = None
    """[N, 3] offset of the object's centre of mass, mesh frame, m."""
    object_gravity: Tensor | None = None
    """[N] share of the object's weight that acts."""
    drives: Tensor | None = None
    """[N, 3, J] factors on stiffness, damping and effort limit."""

    @classmethod
    def nominal(cls, scene: SceneSpec, object_index: Tensor) -> Self:
        """Return the parameters that the scene states for worlds with these objects [N]."""
        import torch

        n = len(object_index)
        friction = scene.friction
        # The dtype is stated because whole numbers would give integer tensors.
        masses = torch.tensor([spec.mass for spec in scene.objects], dtype=torch.float32)
        pairs = torch.tensor([friction.tip, friction.link, friction.table], dtype=torch.float32)
        return cls(
            friction=pairs.repeat(n, 1),
            torsional_friction=torch.full((n,), float(friction.torsional)),
            object_mass=masses[object_index.cpu()],
            object_inertia=torch.ones(n),
            object_com=torch.zeros(n, 3),
            object_gravity=torch.ones(n),
            drives=torch.ones(n, 3, len(scene.robot.joints)),
        )

    def given(self) -> dict[Parameter, Tensor]:
        """Return the parameters that are not None, by name."""
        return {
            name: value
            for name in get_args(Parameter)
            if (value := getattr(self, name)) is not None
        }


@frozen
class Links(Tensors):
    """Poses and velocities of the tracked links (palm, then fingertips)."""

    pos: Tensor
    """[N, K, 3] origin of the link's frame."""
    quat: Tensor
    """[N, K, 4]"""
    linvel: Tensor
    """[N, K, 3] velocity of this origin."""
    angvel: Tensor
    """[N, K, 3] world frame, rad/s."""


@frozen
class Contacts(Tensors):
    """Contact forces *on the object*, world frame, of the last internal step (zero right after a state is set).

    An engine takes one or several internal steps in a physics step.
    """

    tip_force: Tensor
    """[N, E, 3] net force of each finger's contact links on the object [N]."""
    tip_touch: Tensor
    """[N, E] bool: whether a contact link of the finger touches the object (with a non-zero normal force)."""
    table_force: Tensor
    """[N, 3] net force of the table on the object [N]; a resting object reads +m g along z."""


@frozen
class Health(Tensors):
    """What went wrong in a world since its state was last set."""

    nonfinite: Tensor
    """[N] bool: a position or velocity is not finite."""
    overflow: Tensor
    """[N] bool: contacts or constraints were dropped because a buffer was full."""


def no_readings(robot: RobotSpec, num_worlds: int) -> tuple[Links, Contacts, Health]:
    """Return readings of N worlds that are all zero."""
    import torch

    links = torch.zeros(num_worlds, len(robot.tracked_links), 3)
    tips = torch.zeros(num_worlds, len(robot.fingertips), 3)
    none = torch.zeros(num_worlds, dtype=torch.bool)
    quat = torch.zeros(*links.shape[:2], 4)
    return (
        Links(pos=links, quat=quat, linvel=links, angvel=links).clone(),
        Contacts(
            tip_force=tips, tip_touch=tips[..., 0] > 0, table_force=torch.zeros(num_worlds, 3)
        ),
        Health(nonfinite=none, overflow=none).clone(),
    )


@frozen
class MassProperties(Tensors):
    """Masses in the engine, of the robot's B moving bodies and then the object.

    Links that are fixed to one another are one body. The robot's bodies are in the order of
    :func:`xreset.backends.rigid.mechanism`, without the base.
    """

    mass: Tensor
    """[N, B + 1] kg."""
    com: Tensor
    """[N, B + 1, 3] centre of mass in the body's frame [m]; the object's body frame is its mesh frame."""
    inertia: Tensor
    """[N, B + 1, 3, 3] about the centre of mass, along the body frame's axes [kg m^2]."""


@frozen
class KnownDifference:
    """A check of the conformance suite for which an engine has a wider tolerance, and why.

    Beyond the bound the check still fails.
    """

    check: str
    """Name of the check."""
    measure: str
    """Which of its measures: :attr:`xreset.backends.conformance.Measure.what`."""
    bound: float
    """The largest value that is accepted, in the unit of the measure."""
    reason: str
    """Why the engine cannot do better."""
    robot: str | None = None
    """The robot with which it differs; None: any."""


class Backend(ABC):
    """N worlds of one scene in one physics engine. World i holds object ``scene.objects[object_index[i]]``.

    Contracts that the conformance suite checks:

    - After :meth:`set_state`, :meth:`state` and :meth:`links` report it at once, without a step.
    - Tensors that a getter returns are snapshots, or views that are valid until the next call that changes the worlds;
      they are read-only.
    - A joint target stays until it is replaced. Drives, joint limits, dry friction and armature are as the robot spec
      says.
    - Mimic joints follow their source, and are set with it.
    - Worlds never influence one another.
    """

    name: ClassVar[str]
    """Name in the registry."""
    capabilities: ClassVar[frozenset[Capability]]
    """Features of this backend that others may lack."""
    known_differences: ClassVar[tuple[KnownDifference, ...]] = ()
    """Checks for which this engine has a wider tolerance."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)
        unknown = set(getattr(cls, "capabilities", ())).difference(get_args(Capability))
        if unknown:
            raise XResetError(
                f"{cls.__name__}.capabilities has unknown names: {', '.join(sorted(map(str, unknown)))}. "
                f"Choose from: {', '.join(sorted(get_args(Capability)))}."
            )

    def __init__(
        self,
        scene: SceneSpec,
        num_worlds: int,
        *,
        object_index: Tensor | None = None,
        device: str = "cpu",
    ) -> None:
        """Build the worlds; every world starts with the robot at home and its object at rest height at the table's
        centre.

        Args:
            scene: robot, objects and table.
            num_worlds: N.
            object_index: [N] which of ``scene.objects`` each world holds; default: world i holds object i modulo their
                number.
            device: ``cpu`` or ``cuda[:i]``.

        Raises:
            WrongValueError: there is no world or no object, an index is not one of an object, or ``scene`` is no scene.
        """
        import torch

        if not isinstance(scene, SceneSpec):
            raise WrongValueError(f"scene is {shown(scene)}, expected a SceneSpec")
        if num_worlds < 1:
            raise WrongValueError(f"num_worlds is {num_worlds}, expected at least 1")
        count = len(scene.objects)
        if not count:
            raise WrongValueError("the scene has no object; each world holds exactly one")
        self.scene = scene
        self.num_worlds = num_worlds
        self.device = torch.device(device)
        if object_index is None:
            object_index = torch.arange(num_worlds) % count
        index = torch.as_tensor(object_index)
        is_valid = index.shape == (num_worlds,) and not index.is_floating_point()
        if not is_valid or not ((index >= 0) & (index < count)).all():
            raise WrongValueError(
                f"object_index is {shown(index)}, expected [{num_worlds}] indices below {count}"
            )
        self.object_index = index.long().to(self.device)

    # Availability ----------------------------------------------------------------------------------------------------

    @classmethod
    @abstractmethod
    def engine_version(cls) -> str:
        """Return the version of the engine.

        Raises:
            BackendUnavailableError: the engine cannot be imported or used here. The message has reason and remedy.
        """

    @classmethod
    def devices(cls) -> list[str]:
        """Return the kinds of devices that can be used here, the best first: ``cuda``, ``cpu``."""
        return ["cpu"]

    # State -----------------------------------------------------------------------------------------------------------

    @abstractmethod
    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        """Set the full state of the selected worlds.

        Args:
            state: [M, ...] one state per selected world.
            worlds: [M] long indices without repetition; None means all (M = N).
        """

    def state(self) -> State:
        """Return the state of all worlds."""
        self._must_be_open()
        return self._state

    def set_joint_targets(self, targets: Tensor) -> None:
        """Set the drive targets of all worlds: [N, J] rad (m)."""
        self._must_be_open()
        present = self._state.joint_target
        present.copy_(self._checked("joint_target", targets, present.shape))

    @abstractmethod
    def step(self, substeps: int | None = None) -> None:
        """Advance all worlds by that many physics steps (default: ``scene.substeps``, one control step)."""

    # Readings --------------------------------------------------------------------------------------------------------

    def links(self) -> Links:
        """Return poses and velocities of the tracked links, up to date with :meth:`state`."""
        self._must_be_open()
        return self._links

    def contacts(self) -> Contacts:
        """Return contact forces on the object."""
        self._must_be_open()
        return self._contacts

    def health(self) -> Health:
        """Return what went wrong since each world's state was last set."""
        self._must_be_open()
        return self._health

    def mass_properties(self) -> MassProperties:
        """Return masses, centres of mass and inertias in the engine, with all changes of them."""
        self._require("mass_properties")
        raise NotImplementedError

    # Physical parameters: set_state keeps them, but ends the wrench. CapabilityError if the backend lacks one

    def set_object_mass(self, mass: Tensor, worlds: Tensor | None = None) -> None:
        """Set the object's mass [M] kg; its inertia scales with it, its centre of mass stays."""
        self._set("object_mass", mass, worlds)

    def set_friction(self, friction: Tensor, worlds: Tensor | None = None) -> None:
        """Set the friction of the pairs object-fingertip, object-other link, object-table: [M, 3].

        Pairs without the object follow: see :class:`~xreset.spec.PairFriction`.
        """
        self._set("friction", friction, worlds)

    def set_torsional_friction(self, torsional: Tensor, worlds: Tensor | None = None) -> None:
        """Set the torsional friction of the object's pairs: [M], a length as in :class:`~xreset.spec.PairFriction`."""
        self._set("torsional_friction", torsional, worlds)

    def set_object_inertia(self, scale: Tensor, worlds: Tensor | None = None) -> None:
        """Set the factor [M] on the object's inertia about its centre of mass, in addition to the change with its mass;
        1 is the spec's inertia."""
        self._set("object_inertia", scale, worlds)

    def set_object_com(self, offset: Tensor, worlds: Tensor | None = None) -> None:
        """Move the object's centre of mass by [M, 3] m from its place in the spec, in the mesh frame. The inertia about
        it stays.

        If the object moves, set its state again.
        """
        self._set("object_com", offset, worlds)

    def set_object_gravity(self, fraction: Tensor, worlds: Tensor | None = None) -> None:
        """Set the object's gravity fraction [M]: an upward force (1 - fraction) m g acts at its centre of mass.

        The robot is not affected (the paper, appendix D.e).
        """
        self._set("object_gravity", fraction, worlds)

    def set_drives(self, scale: Tensor, worlds: Tensor | None = None) -> None:
        """Set factors [M, 3, J] on the stiffness, damping and effort limit of the drives; 1 is the value of the robot
        spec."""
        self._set("drives", scale, worlds)

    def set_object_wrench(self, force: Tensor, torque: Tensor) -> None:
        """Set an external force [N, 3] N at the object's centre of mass and a torque [N, 3] N m, world frame.

        It stays until it is replaced, or the world's state is set.
        """
        self._require("object_wrench")
        self._must_be_open()
        force = self._checked("force", force, (self.num_worlds, 3))
        self._wrench[:, 3:] = self._checked("torque", torque, force.shape)
        self._wrench[:, :3] = force

    # Many worlds at once ---------------------------------------------------------------------------------------------

    def set_where(self, mask: Tensor, state: State, parameters: Parameters) -> None:
        """Set state and physical parameters of the worlds of a mask, as the single setters do.

        Values are given for all worlds, and ignored outside the mask. A backend on a GPU overrides this method so that
        the GPU does not wait for the number of worlds.

        Args:
            mask: [N] bool.
            state: [N, ...]
            parameters: [N, ...]
        """
        worlds = self._checked_mask(mask).nonzero().squeeze(-1)
        if not len(worlds):
            return
        for name, value in parameters.given().items():
            getattr(self, f"set_{name}")(value[worlds], worlds)
        self.set_state(state[worlds], worlds)

    # The end ---------------------------------------------------------------------------------------------------------

    @abstractmethod
    def close(self) -> None:
        """Free what the worlds hold. Calling it twice does no harm."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_) -> None:
        self.close()

    # For implementers ------------------------------------------------------------------------------------------------
    # The getters return these tensors, and two setters write to them. A backend without these tensors overrides the
    # getters and the two setters.

    _state: State
    _links: Links
    _contacts: Contacts
    _health: Health
    _wrench: Tensor
    """[N, 6] force and torque on the object."""
    _closed = False

    def _must_be_open(self) -> None:
        if self._closed:
            raise XResetError(f"The engine {self.name!r} is closed. Build a new one.")

    def _indices(self, worlds: Tensor | None) -> Tensor:
        """Return indices of worlds [M] on the backend's device, of all if None; ``WrongValueError`` for anything else.
        On a GPU, which would have to be waited for, their range is not checked."""
        import torch

        if worlds is None:
            return torch.arange(self.num_worlds, device=self.device)
        index = torch.as_tensor(worlds, device=self.device)
        is_whole = index.dtype != torch.bool and not index.is_floating_point()
        is_valid = index.ndim == 1 and (is_whole or not len(index))
        if is_valid and self.device.type == "cpu":
            is_valid = bool(((index >= 0) & (index < self.num_worlds)).all())
        if not is_valid:
            raise WrongValueError(
                f"worlds is {shown(worlds)}, expected [M] indices from 0 to {self.num_worlds - 1}. "
                "For a mask, call set_where, or give mask.nonzero().squeeze(-1)."
            )
        return index.long()

    def _checked_mask(self, mask: Tensor) -> Tensor:
        """Return a mask of worlds; ``WrongValueError`` for anything else."""
        import torch

        mask = torch.as_tensor(mask)
        if mask.shape != (self.num_worlds,) or mask.dtype != torch.bool:
            raise WrongValueError(f"mask is {shown(mask)}, expected [{self.num_worlds}] bool")
        return mask

    def _checked_state(self, state: State, rows: int) -> State:
        """Return a state on the backend's device; ``WrongValueError`` if it has another number of rows."""
        checked = {}
        for name, present in vars(self._state).items():
            checked[name] = self._checked(name, getattr(state, name), (rows, *present.shape[1:]))
        return State(**checked)

    def _checked(self, name: str, value: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Return values on the backend's device; ``WrongValueError`` if they have another shape."""
        import torch

        value = torch.as_tensor(value, dtype=torch.float32, device=self.device).detach()
        if value.shape != shape:
            raise WrongValueError(f"{name} has shape {tuple(value.shape)}, expected {tuple(shape)}")
        return value.contiguous()

    def _checked_parameter(self, name: Parameter, value: Tensor, shape: tuple[int, ...]) -> Tensor:
        """Return values of a physical parameter on the backend's device; ``WrongValueError`` if they have another shape
        or, on a CPU, if they are too small: Bullet would fix an object without mass in space."""
        value = self._checked(name, value, shape)
        if self.device.type == "cpu":
            if name in _POSITIVE and not (value > 0).all():
                raise WrongValueError(f"{name} is {shown(value)}, expected numbers above 0")
            if name in _NOT_NEGATIVE and not (value >= 0).all():
                raise WrongValueError(f"{name} is {shown(value)}, expected numbers of at least 0")
        return value

    def _checked_substeps(self, substeps: int | None) -> int:
        """Return the number of physics steps to take; default: those of one control step."""
        if substeps is None:
            return self.scene.substeps
        if substeps < 1 or substeps % 1:
            raise WrongValueError(f"substeps is {substeps}, expected a whole number of at least 1")
        return substeps

    def _require(self, capability: Capability) -> None:
        """Raise the error that the contract asks for if a capability is missing."""
        if capability not in self.capabilities:
            what = capability.replace("_", " ")
            raise CapabilityError(
                f"The engine {self.name!r} does not support {what}. Use another engine."
            )

    def _set(self, name: Parameter, value: Tensor, worlds: Tensor | None) -> None:
        """Set a physical parameter [M, ...]. A backend overrides this method, or the setters, which all call it."""
        self._require(name)
        raise NotImplementedError(
            f"The engine {self.name!r} declares {name!r} but does not set it."
        )


def unavailable(package: str, install: str, error: Exception) -> BackendUnavailableError:
    """Return the error for an engine that cannot be imported; ``install`` follows ``pip install`` in its message."""
    return BackendUnavailableError(
        f"{package} cannot be imported ({error}). Install it with: pip install {install}"
    )
