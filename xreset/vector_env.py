"""The environment as Gymnasium knows it: for learning code that is not this project's."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from xreset.env import ManipulationEnv
from xreset.errors import XResetError, needs

with needs("gymnasium", "gymnasium"):
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space


class VectorEnv(gymnasium.vector.VectorEnv):
    """N worlds of the task in any engine.

    Observations are a dictionary of the environment's groups, [N, ...] float32; actions are [N, J] in [-1, 1]. An episode that leaves the
    scene is terminated; one whose time is over, or whose simulation fails, is truncated. The step after, its world ignores the action,
    gives no reward, and shows the next episode's beginning (Gymnasium's ``AutoresetMode.NEXT_STEP``).
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(self, env: ManipulationEnv) -> None:
        """Wrap an environment, which is this object's from then on."""
        self.env = env
        self.num_envs = env.num_envs
        env.reset()
        shapes = {name: tuple(value.shape[1:]) for name, value in env.get_observations().items()}
        spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32) for name, shape in shapes.items()
        }
        self.single_observation_space = gymnasium.spaces.Dict(spaces)
        self.single_action_space = gymnasium.spaces.Box(-1.0, 1.0, (env.num_actions,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._ended = torch.zeros(self.num_envs, dtype=torch.bool, device=env.device)

    def reset(
        self, *, seed: int | list[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode in every world; a seed decides everything that is drawn from then on.

        Raises:
            XResetError: there are several seeds: worlds share one generator.
        """
        if isinstance(seed, list):
            raise XResetError(f"there are {len(seed)} seeds, expected one for all worlds.")
        super().reset(seed=seed)
        if seed is not None:
            self.env.generator.manual_seed(seed)
        self._ended.zero_()
        self.env.reset()
        return self._observations(), {}

    def step(self, actions: Any) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Observations, reward [N], terminated [N] and truncated [N], and ``faulty`` [N]: whether the simulation has failed."""
        action = torch.as_tensor(np.asarray(actions), dtype=torch.float32, device=self.env.device)
        action = torch.where(self._ended[:, None], 0.0, action)  # ignored: the world begins anew
        _, reward, done, extras = self.env.step(action, begin=self._ended)
        reward = torch.where(self._ended, 0.0, reward)
        self._ended = done.bool()
        truncated = self._ended & extras["time_outs"].bool()
        infos = {"faulty": _numpy(extras["faulty"])}
        return self._observations(), _numpy(reward), _numpy(self._ended & ~truncated), _numpy(truncated), infos

    def close_extras(self, **_: Any) -> None:
        """Close the engine."""
        self.env.close()

    def _observations(self) -> dict[str, np.ndarray]:
        return {name: _numpy(value) for name, value in self.env.get_observations().items()}


def _numpy(x: Any) -> np.ndarray:
    return x.detach().cpu().numpy()
