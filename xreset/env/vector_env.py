"""The environment with Gymnasium's vector interface, for other learning libraries."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from xreset.env.manipulation import ManipulationEnv, checked_env
from xreset.errors import XResetError, needs
from xreset.physics.tensors import where

with needs("gymnasium", "gymnasium"):
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space

if TYPE_CHECKING:
    from tensordict import TensorDict


class VectorEnv(gymnasium.vector.VectorEnv):
    """N worlds of the task in any engine.

    Observations are a dictionary of the environment's groups, [N, ...] float32 and always finite; actions are [N, J] in
    [-1, 1].

    An episode is truncated when its time is over: a learner bootstraps its value from the observation that the step
    returns, which is the episode's last. An episode is terminated when the object leaves the scene or the simulation
    fails. A world whose simulation fails repeats its last finite observation, gives no reward, and is marked in
    ``infos["faulty"]``.

    The step after an end ignores the world's action, gives no reward, and returns the first observation of the next
    episode (Gymnasium's ``AutoresetMode.NEXT_STEP``).

    Attributes:
        log: means over the worlds in the last step, by name: reward terms, grasps, successes.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, env: ManipulationEnv) -> None:
        """Wrap an environment, such as ``xreset.make_env`` makes, and reset it. :meth:`close` closes it.

        Raises:
            XResetError: ``env`` is no environment.
        """
        self.env = checked_env(env)
        self.num_envs = env.num_envs
        env.reset()
        self.single_observation_space = observation_space(env)
        self.single_action_space = action_space(env)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=env.device)
        self._observations = env.get_observations()
        self.log: dict[str, torch.Tensor] = {}

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode in every world.

        Args:
            seed: seed of all random numbers from now on; None: the generator continues.
            options: not used.

        Raises:
            XResetError: there are several seeds, but all worlds share one generator.
        """
        if isinstance(seed, list):
            raise XResetError(f"Got {len(seed)} seeds. Give one seed: all worlds share it.")
        super().reset(seed=seed)
        if seed is not None:
            set_seed(self.env, seed)
        self._ended.zero_()
        self.env.reset()
        self._observations = self.env.get_observations()
        return arrays(self._observations), {}

    def step(
        self, actions: Any
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Take one control step in every world.

        Args:
            actions: [N, J] real numbers, limited to [-1, 1]. A world whose numbers are not finite fails.

        Returns:
            Observations, reward [N], terminated [N], truncated [N], and a dictionary with ``faulty`` [N] (the
            simulation failed).

        Raises:
            XResetError: the actions have another shape, or are not real numbers.
        """
        action = checked_action(self.env, actions)
        # A world that begins a new episode ignores its action.
        action = torch.where(self._ended[:, None], 0.0, action)
        observations, reward, done, extras = self.env.step(action, begin=self._ended)
        faulty = extras["faulty"]
        reward = torch.where(self._ended | faulty, 0.0, reward)
        self.log = extras["log"]
        self._observations = with_sound_rows(observations, self._observations)
        self._ended = done.bool()
        truncated = self._ended & extras["time_outs"].bool() & ~faulty
        terminated = self._ended & ~truncated
        infos = {"faulty": array(faulty)}
        return arrays(self._observations), array(reward), array(terminated), array(truncated), infos

    def close_extras(self, **_: Any) -> None:
        """Close the engine."""
        self.env.close()


def set_seed(env: ManipulationEnv, seed: int) -> None:
    """Set the seed of all random numbers from now on, and forget how often each demonstration has succeeded: episodes
    are drawn by that, too."""
    env.generator.manual_seed(seed)
    env.resets.success_rate.zero_()


def observation_space(env: ManipulationEnv) -> gymnasium.spaces.Dict:
    """Return the space of one world's observations, by group."""
    boxes = {}
    for name, value in env.get_observations().items():
        boxes[name] = gymnasium.spaces.Box(-np.inf, np.inf, value.shape[1:])
    return gymnasium.spaces.Dict(boxes)


def action_space(env: ManipulationEnv) -> gymnasium.spaces.Box:
    """Return the space of one world's actions."""
    return gymnasium.spaces.Box(-1.0, 1.0, (env.num_actions,))


def checked_action(env: ManipulationEnv, actions: Any) -> torch.Tensor:
    """Return actions [N, J] on the environment's device.

    Raises:
        XResetError: the actions have another shape, or are not real numbers.
    """
    if isinstance(actions, torch.Tensor):
        actions = actions.detach().cpu()
    values = np.asarray(actions)
    expected = (env.num_envs, env.num_actions)
    if values.shape != expected or values.dtype.kind not in "fiu":
        raise XResetError(
            f"The actions are {values.dtype} of shape {values.shape}. Give real numbers of shape {expected}: "
            "one row for each world, one column for each joint."
        )
    return torch.as_tensor(values, dtype=torch.float32, device=env.device)


def with_sound_rows(observations: TensorDict, before: TensorDict) -> TensorDict:
    """Return observations in which each world with a number that is not finite repeats its row of ``before``."""
    finite = [value.flatten(1).isfinite().all(dim=1) for value in observations.values()]
    sound = torch.stack(finite).all(dim=0)
    return observations.apply(lambda new, old: where(sound, new, old), before)


def arrays(observations: TensorDict) -> dict[str, np.ndarray]:
    """Return observations as arrays, by group."""
    return {name: array(value) for name, value in observations.items()}


def array(value: Any) -> np.ndarray:
    """Return a tensor as an array."""
    return value.cpu().numpy()
