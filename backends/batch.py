"""Worlds of an engine that steps all of them at once, behind :class:`~xreset.physics.Backend`.

An engine on a GPU is added by writing a :class:`BatchBackend`. Nothing here waits for the device.

Shape letters are those of :mod:`xreset.physics`; C room for contacts.
"""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch
from torch import Tensor

from xreset.backends.rigid import TABLE, Mechanism, TrackedFrames
from xreset.geometry.rotations import quat_multiply, quat_rotate
from xreset.physics import (
    Backend,
    Contacts,
    Health,
    Links,
    MassProperties,
    Parameter,
    Parameters,
    State,
    no_readings,
)
from xreset.physics.plugins import existing_device
from xreset.physics.tensors import where
from xreset.spec import GRAVITY, SceneSpec


class BatchBackend(Backend):
    """N worlds in one batch.

    A subclass builds its worlds and then calls :meth:`begin`. It writes :meth:`begin`, :meth:`apply_parameters`,
    ``step`` and ``close``, and fills the tensors that the getters return: ``_state``, ``_links``, ``_contacts``,
    ``_health``. It may put views of the engine's own memory in their place, and in that of ``_wrench`` [N, 6], the
    force and torque that ``set_object_wrench`` has set.
    """

    chosen: Tensor
    """[N] bool: the worlds that the present call sets."""
    coming: State
    """[N, ...] what the chosen worlds are set to."""
    parameters: dict[Parameter, Tensor]
    """[N, ...] the present value of each physical parameter."""

    def __init__(
        self,
        scene: SceneSpec,
        num_worlds: int,
        *,
        object_index: Tensor | None = None,
        device: str = "cpu",
    ) -> None:
        """Make the tensors. All worlds are chosen, with the first state and the scene's parameters.

        Args:
            scene: see :class:`Backend`.
            num_worlds: see :class:`Backend`.
            object_index: see :class:`Backend`.
            device: ``cuda[:i]`` or ``cpu``.

        Raises:
            BackendUnavailableError: the device does not exist.
        """
        super().__init__(
            scene, num_worlds, object_index=object_index, device=existing_device(device)
        )
        self.coming = State.initial(scene, self.object_index).to(self.device).clone()
        self.parameters = Parameters.nominal(scene, self.object_index).to(self.device).given()
        self.chosen = torch.ones(num_worlds, dtype=torch.bool, device=self.device)
        self._state = self.coming.clone()
        links, contacts, health = no_readings(scene.robot, num_worlds)
        self._links: Links = links.to(self.device)
        self._contacts: Contacts = contacts.to(self.device)
        self._health: Health = health.to(self.device)
        self._wrench = torch.zeros(num_worlds, 6, device=self.device)
        specs = [scene.objects[i] for i in self.object_index.tolist()]

        def of_objects(values: list[np.ndarray]) -> Tensor:
            return torch.as_tensor(np.stack(values), dtype=torch.float32, device=self.device)

        self._object_specs = MassProperties(
            mass=self.parameters["object_mass"].clone(),
            com=of_objects([spec.com for spec in specs]),
            inertia=of_objects([spec.inertia for spec in specs]),
        )

    # What an engine does ----------------------------------------------------------------------------------------------

    @abstractmethod
    def begin(self) -> None:
        """Give the chosen worlds the state :attr:`coming` and their parameters, let nothing of their past remain, and
        read the state and links of all worlds."""

    @abstractmethod
    def apply_parameters(self) -> None:
        """Give the chosen worlds their present parameters."""

    # What an engine can use -------------------------------------------------------------------------------------------

    def forget(self) -> None:
        """End wrench, contacts, and what was reported of the health of the chosen worlds, and take their state from
        :attr:`coming`, with quaternions of unit length: for engines that fill this class's own tensors."""
        quat = self.coming.object_quat
        quat.div_(quat.norm(dim=-1, keepdim=True))
        self._state.map(Tensor.copy_, where(self.chosen, self.coming, self._state))
        self._wrench.masked_fill_(self.chosen[:, None], 0.0)
        for readings in (self._contacts, self._health):
            for tensor in vars(readings).values():
                tensor.masked_fill_(self._mask_for(tensor), 0)

    def object_properties(self) -> MassProperties:
        """Return mass [N], centre of mass [N, 3] and inertia [N, 3, 3] of the objects with the present parameters; the
        inertia is about the centre of mass, along the axes of the mesh frame."""
        mass = self.parameters["object_mass"]
        growth = mass / self._object_specs.mass * self.parameters["object_inertia"]
        return MassProperties(
            mass=mass,
            com=self._object_specs.com + self.parameters["object_com"],
            inertia=growth[:, None, None] * self._object_specs.inertia,
        )

    def object_load(self) -> Tensor:
        """Return the force at the object's centre of mass, its weight included, and the torque [N, 6], world frame: for
        engines whose own gravity is off."""
        load = self._wrench.clone()
        load[:, 2] -= GRAVITY * self.parameters["object_gravity"] * self.parameters["object_mass"]
        return load

    # The contract -----------------------------------------------------------------------------------------------------

    def set_state(self, state: State, worlds: Tensor | None = None) -> None:
        self._must_be_open()
        index = self._choose(worlds)
        self.coming[index] = self._checked_state(state, len(index))
        self.begin()

    def set_where(self, mask: Tensor, state: State, parameters: Parameters) -> None:
        self._must_be_open()
        self.chosen.copy_(self._checked_mask(mask))
        for name, value in parameters.given().items():
            self._require(name)
            present = self.parameters[name]
            new = self._checked(name, value, present.shape)
            torch.where(self._mask_for(present), new, present, out=present)
        self.coming.map(Tensor.copy_, self._checked_state(state, self.num_worlds))
        self.begin()

    def _set(self, name: Parameter, value: Tensor, worlds: Tensor | None) -> None:
        self._require(name)
        self._must_be_open()
        index = self._choose(worlds)
        present = self.parameters[name]
        shape = (len(index), *present.shape[1:])
        present[index] = self._checked_parameter(name, value, shape)
        self.apply_parameters()

    def _mask_for(self, tensor: Tensor) -> Tensor:
        """Return the chosen worlds as a mask [N, 1, ...] that fits a tensor."""
        return self.chosen.view(-1, *[1] * (tensor.ndim - 1))

    def _choose(self, worlds: Tensor | None) -> Tensor:
        """Set the mask of the worlds to change, and return their indices [M]."""
        index = self._indices(worlds)
        self.chosen.zero_()
        self.chosen[index] = True
        return index


class LinkFrames:
    """The tracked links of a robot as frames on its bodies, for many worlds at once."""

    def __init__(self, robot: Mechanism, device: torch.device) -> None:
        frames = TrackedFrames(robot)
        self.bodies = torch.tensor(frames.bodies, device=device)
        """[K] index of the body of each tracked link; 0 is the robot's base."""
        self._pos, self._quat, self._lever = (
            torch.as_tensor(values, dtype=torch.float32, device=device)
            for values in (frames.pos, frames.quat, frames.lever)
        )

    def locate(self, pos: Tensor, quat: Tensor, com_velocity: Tensor, angvel: Tensor) -> Links:
        """Return the tracked links.

        Args:
            pos: [N, K, 3] position of their bodies' frames.
            quat: [N, K, 4] orientation of their bodies' frames.
            com_velocity: [N, K, 3] velocity of their bodies' centres of mass.
            angvel: [N, K, 3] angular velocity of their bodies.
        """
        lever = quat_rotate(quat, self._lever)
        return Links(
            pos=pos + quat_rotate(quat, self._pos),
            quat=quat_multiply(quat, self._quat.expand_as(quat)),
            linvel=com_velocity + torch.linalg.cross(angvel, lever),
            angvel=angvel,
        )


def sum_contacts(contacts: Contacts, world: Tensor, owner: Tensor, force: Tensor) -> None:
    """Sum the contacts of the objects into the readings of N worlds.

    Args:
        contacts: where the sums are written.
        world: [C] the world of each contact.
        owner: [C] what touches the object: the index of a fingertip, or ``TABLE`` or another negative number, such as
            ``OTHER_LINK``, of :mod:`~xreset.backends.rigid`. A row that is no contact of the object has ``OTHER_LINK``.
        force: [C, 3] its force on the object [N]; all zero: no touch.
    """
    tips = contacts.tip_force.shape[1]
    is_tip = owner >= 0
    finger = world * tips + owner.clamp_min(0)
    on_tip = torch.where(is_tip[:, None], force, 0.0)
    on_table = torch.where((owner == TABLE)[:, None], force, 0.0)
    contacts.tip_force.zero_().view(-1, 3).index_add_(0, finger, on_tip)
    contacts.table_force.zero_().index_add_(0, world, on_table)
    touches = torch.zeros_like(contacts.tip_touch, dtype=torch.float32)
    touches.view(-1).index_add_(0, finger, (on_tip != 0).any(dim=-1).float())
    torch.gt(touches, 0.0, out=contacts.tip_touch)
