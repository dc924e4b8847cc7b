"""One world of an engine in this process, in numpy: what ``xreset play`` needs, where torch need not be installed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from xreset.backends.pool import PoolBackend, World, lacks_weight
from xreset.backends.rigid import ContactArrays, StateArrays, sum_contacts
from xreset.physics import Backend
from xreset.physics.plugins import backend_class
from xreset.spec import GRAVITY, SceneSpec

if TYPE_CHECKING:
    from torch import Tensor

State = dict[str, np.ndarray]
"""A value in double precision for each field of :class:`~xreset.physics.State`, without the dimension of worlds."""


class SingleWorld:
    """A scene with its first object in an engine.

    Attributes:
        engine: name of the engine.
        state: the present state, a copy.
        tip_force: [E, 3] force of each finger on the object in the last physics step [N].
        is_finite: whether all numbers of the state are finite.
        capabilities: features of the engine that others may lack.
    """

    def __init__(self, engine: str, scene: SceneSpec, state: State) -> None:
        """Build the world and set its state.

        Raises:
            BackendUnavailableError: there is no such engine, or it cannot be used here.
        """
        cls = backend_class(engine)
        cls.engine_version()  # fails with reason and remedy where the engine is missing
        self.engine = engine
        self.capabilities = cls.capabilities
        self._tips = len(scene.robot.fingertips)
        self._mass = float(scene.objects[0].mass)
        self._gravity = 1.0
        if issubclass(cls, PoolBackend):
            self._world: World = cls.world_class(scene, 0)
        else:
            self._world = _BatchWorld(cls(scene, 1))
        self._adds_weight = lacks_weight(type(self._world))
        self.set_state(state)

    def set_state(self, state: State) -> None:
        """Set the state; no contact is known until the next step."""
        self._world.set_state({name: np.array(value, float) for name, value in state.items()})
        self.tip_force = np.zeros((self._tips, 3))
        self._read()

    def set_object_gravity(self, fraction: float) -> None:
        """Set the share of the object's weight that acts."""
        self._gravity = fraction
        if not self._adds_weight:
            self._world.set_object_gravity(fraction)

    def step(
        self, targets: np.ndarray, substeps: int, force: np.ndarray, torque: np.ndarray
    ) -> None:
        """Advance by some physics steps.

        Args:
            targets: [J] targets of the drives [rad, m].
            substeps: number of physics steps.
            force: [3] at the object's center of mass [N]; ignored by engines without the capability ``object_wrench``.
            torque: [3] on the object [N m].
        """
        if "object_wrench" not in self.capabilities:
            force = torque = np.zeros(3)
        if self._adds_weight:
            force = force - np.array((0.0, 0.0, self._mass * GRAVITY * self._gravity))
        self._world.set_joint_targets(np.asarray(targets, float))
        self._world.set_object_wrench(np.asarray(force, float), np.asarray(torque, float))
        self._world.step(substeps)
        self._read()
        tip_force, *_ = sum_contacts(self._tips, self._world.contacts())
        self.tip_force = np.array(tip_force, float)

    def _read(self) -> None:
        state = self._world.get_state()
        self.state = {name: np.array(value, float) for name, value in state.items()}
        self.is_finite = not self._world.health(state)[0]

    def close(self) -> None:
        """Free what the engine holds."""
        self._world.close()


class _BatchWorld(World):
    """The only world of an engine that simulates many worlds at once, in tensors."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend

    def set_state(self, state: StateArrays) -> None:
        from xreset.physics import State

        self._backend.set_state(State(**{name: self._tensor(state[name]) for name in state}))

    def get_state(self) -> StateArrays:
        found = vars(self._backend.state())
        return {name: value[0].cpu().numpy().astype(float) for name, value in found.items()}

    def set_joint_targets(self, targets: np.ndarray) -> None:
        self._backend.set_joint_targets(self._tensor(targets))

    def step(self, n: int) -> None:
        self._backend.step(n)

    def contacts(self) -> ContactArrays:
        found = vars(self._backend.contacts())
        tip_force, tip_touch, table_force = (value[0].cpu().numpy() for value in found.values())
        return tip_force, tip_touch, table_force

    def set_object_gravity(self, fraction: float) -> None:
        self._backend.set_object_gravity(self._tensor(np.array(fraction)))

    def set_object_wrench(self, force: np.ndarray, torque: np.ndarray) -> None:
        if "object_wrench" in self._backend.capabilities:
            self._backend.set_object_wrench(self._tensor(force), self._tensor(torque))

    def set_object_inertia(self, inertia) -> None:
        raise NotImplementedError

    def set_friction(self, friction: np.ndarray) -> None:
        raise NotImplementedError

    def close(self) -> None:
        self._backend.close()

    def _tensor(self, value: np.ndarray) -> Tensor:
        """Return a value of the world as that of all worlds."""
        import torch

        return torch.as_tensor(value, dtype=torch.float32, device=self._backend.device)[None]
