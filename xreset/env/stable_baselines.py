"""The environment as Stable-Baselines3 knows it."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from xreset.env.manipulation import ManipulationEnv, checked_env
from xreset.env.vector_env import (
    action_space,
    array,
    arrays,
    checked_action,
    observation_space,
    set_seed,
    with_sound_rows,
)
from xreset.errors import needs

with needs("stable_baselines3", "stable-baselines3"):
    from stable_baselines3.common.vec_env import VecEnv


class StableBaselinesEnv(VecEnv):
    """N worlds of the task in any engine, for learners of Stable-Baselines3 with a ``MultiInputPolicy``.

    Its networks share their observations, so ``privileged``, which a critic alone may have, is left out.

    A world is reset in the step that ends its episode, as Stable-Baselines3 expects. The last observation of the
    episode is ``infos[world]["terminal_observation"]``; ``infos[world]["TimeLimit.truncated"]`` says whether its value
    is to be bootstrapped. An episode whose simulation fails is terminated without reward, and
    ``infos[world]["faulty"]`` is True.

    Attributes:
        log: as of :class:`~xreset.env.vector_env.VectorEnv`.
    """

    def __init__(self, env: ManipulationEnv) -> None:
        """Wrap an environment, such as ``xreset.make_env`` makes. It belongs to this object from then on.

        Raises:
            XResetError: ``env`` is no environment.
        """
        self.env = checked_env(env)
        self.log: dict[str, torch.Tensor] = {}
        self._action = torch.zeros(env.num_envs, env.num_actions, device=env.device)
        spaces = observation_space(env)
        spaces.spaces.pop("privileged", None)
        super().__init__(env.num_envs, spaces, action_space(env))

    def reset(self) -> dict[str, np.ndarray]:
        """Begin an episode in every world and return the observations [N, ...] by group."""
        if self._seeds[0] is not None:
            set_seed(self.env, self._seeds[0])
        self._reset_seeds()
        self.env.reset()
        return _of_an_actor(self.env.get_observations())

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions [N, J] of the next step.

        Raises:
            XResetError: the actions have another shape, or are not real numbers.
        """
        self._action = checked_action(self.env, actions)

    def step_wait(
        self,
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Step every world: observations [N, ...] by group, reward [N], done [N] and a dictionary for each world."""
        before = self.env.get_observations()
        nothing = torch.zeros(self.num_envs, dtype=torch.bool, device=self.env.device)
        observations, reward, done, extras = self.env.step(self._action, begin=nothing)
        observations = with_sound_rows(observations, before)
        faulty = extras["faulty"]
        reward = reward.masked_fill(faulty, 0.0)
        self.log = extras["log"]
        truncated = extras["time_outs"].bool() & ~faulty
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        ended = done.nonzero().squeeze(-1)
        if len(ended):
            last = _of_an_actor(observations)
            for world in ended.tolist():
                infos[world] = {
                    "terminal_observation": {name: value[world] for name, value in last.items()},
                    "TimeLimit.truncated": bool(truncated[world]),
                    "faulty": bool(faulty[world]),
                }
            self.env.reset(ended)
            observations = self.env.get_observations()
        return _of_an_actor(observations), array(reward), array(done.bool()), infos

    def close(self) -> None:
        """Close the engine."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Return an attribute of the environment, once for each world: the worlds share one environment."""
        # Stable-Baselines3 asks for render_mode, which the environment does not have
        value = None if attr_name == "render_mode" else getattr(self.env, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of the environment that all worlds share."""
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **options: Any
    ) -> list[Any]:
        """Call a method of the environment once and return its result for each world."""
        value = getattr(self.env, method_name)(*args, **options)
        return [value for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """Return False for each world: the worlds have no wrappers."""
        return [False for _ in self._get_indices(indices)]


def _of_an_actor(observations: TensorDict) -> dict[str, np.ndarray]:
    """Return what an actor may observe, by group."""
    return arrays(observations.exclude("privileged"))
