"""Environments of several robots as one, for a policy that learns them together."""

from __future__ import annotations

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv
from xreset.errors import XResetError


class SeveralEnvs:
    """The worlds of several environments in a row, those of the first one first. They have what a training needs of a
    :class:`ManipulationEnv`. The environments step one after another, because an engine simulates worlds of one robot.

    Attributes:
        envs: the environments, on one device and with equal observations and actions (``task.joint_slots``).
        resets: ``success_rate`` of the demonstrations of all environments.
    """

    vision = None

    def __init__(self, envs: Sequence[ManipulationEnv]) -> None:
        """Join environments.

        Raises:
            XResetError: their observations differ: a term of the user's own has another width for each robot.
        """
        self.envs = tuple(envs)
        first = self.envs[0]
        self.task = first.task
        self.device = first.device
        self.num_actions = first.num_actions
        self.max_episode_length = first.max_episode_length
        self._worlds = [env.num_envs for env in self.envs]
        self.num_envs = sum(self._worlds)
        expected = first.get_observations()
        for env in self.envs[1:]:
            for group, value in env.get_observations().items():
                shape = tuple(value.shape[1:])
                wanted = tuple(expected[group].shape[1:])
                if shape != wanted:
                    raise XResetError(
                        f"The observations {group!r} have the shape {wanted} in {first!r}, but {shape} in {env!r}. "
                        "Omit the terms that differ, or train each robot alone."
                    )
        # One tensor, parts of which the environments write: a training averages it between processes, and saves it.
        rates = [env.resets.success_rate for env in self.envs]
        joined = torch.cat(rates)
        self.resets = SimpleNamespace(success_rate=joined)
        for env, part in zip(self.envs, joined.split([len(rate) for rate in rates]), strict=True):
            env.resets.success_rate = part

    @property
    def episode_length_buf(self) -> Tensor:
        """[N] control steps since each world's reset. Assigned values are copied."""
        return torch.cat([env.episode_length_buf for env in self.envs])

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        for env, part in zip(self.envs, value.split(self._worlds), strict=True):
            env.episode_length_buf = part

    @property
    def nonfinite_count(self) -> Tensor:
        """[] number of episodes that ended because a number was not finite."""
        return torch.stack([env.nonfinite_count for env in self.envs]).sum()

    @property
    def overflow_count(self) -> Tensor:
        """[] number of episodes that ended because the engine dropped contacts."""
        return torch.stack([env.overflow_count for env in self.envs]).sum()

    def get_observations(self) -> TensorDict:
        """Observations of the present state, by group."""
        return _in_a_row([env.get_observations() for env in self.envs])

    def step(self, action: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """Take one control step in every world, as :meth:`ManipulationEnv.step` does.

        The log has the means over robots, the totals of all, and each robot's own success from home.
        """
        parts = action.split(self._worlds)
        steps = [env.step(part) for env, part in zip(self.envs, parts, strict=True)]
        observations, rewards, dones, extras = zip(*steps, strict=True)
        joined: dict[str, Any] = {}
        for name in ("time_outs", "faulty"):
            joined[name] = torch.cat([each[name] for each in extras])
        logs = [each["log"] for each in extras]
        log = {}
        for name in logs[0]:
            values = torch.stack([each[name].float() for each in logs])
            log[name] = values.sum() if name.startswith("health/") else values.mean()
        for env, each in zip(self.envs, logs, strict=True):
            robot = env.backend.scene.robot.name
            log[f"task/success_from_home/{robot}"] = each["task/success_from_home"]
        joined["log"] = log
        return _in_a_row(observations), torch.cat(rewards), torch.cat(dones), joined


def _in_a_row(observations: Any) -> Any:
    """Return the observations of all worlds; torch's type of ``cat`` knows tensors only."""
    return torch.cat(observations)
