"""PPO over short sequences: Table VIII's sequence length 4 inside a horizon of 16, on top of rsl-rl's PPO.

rsl-rl back-propagates through whole horizons. Here a rollout [T, N] is cut into pieces [T / L, L, N]. Each piece starts
with the LSTM state that the rollout had there, and an episode's end inside a piece zeroes the state. A minibatch holds
all pieces of some worlds, so that the cloud frames that pieces share are embedded once; the worlds are drawn again in
every epoch. Returns use the whole horizon.
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor

from xreset.learning.config import TrainConfig
from xreset.learning.distributed import Processes
from xreset.learning.model import LstmState, ReturnCritic, make_actor, make_critic
from xreset.physics.capture import GraphRunner

BOUND = 1.1
"""Mean of an action beyond which ``bounds_loss`` pulls it back."""
CLIP = 0.2
"""Clip range of the policy's ratio and of the values (Table VIII)."""
GAE_LAMBDA = 0.95
"""Decay of the advantages' estimator (Table VIII)."""
GRAD_NORM = 1.0
"""Largest norm of a network's gradient (Table VIII); a longer one is shortened to it."""
SLOWEST = 1e-5
FASTEST = 1e-2
"""Limits of the learning rate (rsl-rl's)."""


def first_steps(storage: RolloutStorage, worlds: Tensor) -> Tensor:
    """[T, M] bool, True where a step of M worlds [M] is the first of an episode."""
    first = torch.zeros_like(storage.dones[:, worlds, 0], dtype=torch.bool)
    # step 0 starts with the state that was saved there, zeroed where an episode had ended
    first[1:] = storage.dones[:-1, worlds, 0].bool()
    return first


def piece_states(saved: Any, worlds: Tensor, length: int) -> LstmState:
    """Return a model's state at the start of each piece of a length: [1, pieces * M, lstm] each, all worlds [M] of the
    first piece first.

    Args:
        saved: [T, 1, N, lstm] each, as rsl-rl's storage keeps them.
    """
    h, c = (state[::length, 0, worlds].flatten(0, 1)[None] for state in saved)
    return h, c


class SequencePpo(PPO):
    """rsl-rl's PPO with an update on sequences that never waits for a GPU.

    Attributes:
        networks: name -> network that a checkpoint holds.
    """

    def __init__(
        self,
        obs: TensorDict,
        num_actions: int,
        config: TrainConfig,
        device: str,
        processes: Processes,
    ) -> None:
        """Make networks and storage; ``obs`` are the observations of all worlds of this process."""
        p = config.ppo
        actor = make_actor(obs, num_actions, config)
        critic = make_critic(obs, config)
        super().__init__(
            actor,
            critic,
            RolloutStorage("rl", len(obs), p.horizon, obs, [num_actions], device),
            num_learning_epochs=p.mini_epochs,
            num_mini_batches=p.minibatches(len(obs)),
            clip_param=CLIP,
            gamma=p.discount,
            lam=GAE_LAMBDA,
            value_loss_coef=p.value_loss,
            entropy_coef=p.entropy,
            learning_rate=p.learning_rate,
            max_grad_norm=GRAD_NORM,
            schedule="adaptive",
            desired_kl=p.desired_kl,
            device=device,
            multi_gpu_cfg=processes.ranks,
        )
        self.networks = {"actor": actor, "critic": critic}
        self.processes = processes
        self.sequence_length = p.sequence_length
        self.bounds_loss = p.bounds_loss
        on_gpu = device.startswith("cuda")
        count = self.storage.num_envs
        self._faulty = torch.zeros(p.horizon, count, dtype=torch.bool, device=device)
        self._rate = torch.tensor(
            self.learning_rate, device=device, dtype=torch.float32 if on_gpu else torch.float64
        )
        self._sums = torch.zeros(4, device=device)
        self._worlds = torch.zeros(count // self.num_mini_batches, dtype=torch.long, device=device)
        self._graphs = GraphRunner(torch.device(device))
        # a graph needs minibatches of one size
        self._graphs.active &= count % self.num_mini_batches == 0

    def process_env_step(
        self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]
    ) -> None:
        """Record one environment step; ``extras["faulty"]`` [N] bool marks worlds whose step teaches nothing."""
        self._faulty[self.storage.step] = extras.get("faulty", False)
        super().process_env_step(obs, rewards, dones, extras)

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and advantages; at faulty steps neither loss gets a gradient from them.

        A faulty step is the last of its episode. With the value as its reward, its error is zero, whatever the
        simulation gave.
        """
        storage = self.storage
        faulty = self._faulty[..., None]
        advantages = storage.advantages
        storage.rewards = torch.where(faulty, storage.values, storage.rewards)
        super().compute_returns(obs)
        # written in place, where the update's graph reads them
        storage.advantages = advantages.copy_(torch.where(faulty, 0.0, storage.advantages))

    def update(self) -> dict[str, float]:
        """Learn from the rollout; return the mean losses of its minibatches.

        Unlike rsl-rl's, it reads no number from the device until the end: the adaptive learning rate is on the device,
        too. On a GPU a minibatch is a CUDA graph, in which gradients are averaged over processes, too: its many small
        kernels take longer to launch than to run.
        """
        storage = self.storage
        if isinstance(self.critic, ReturnCritic):
            self.critic.take_returns(storage.returns, self.processes)
        self._rate.fill_(self.learning_rate)
        self._use_rate()
        self._sums.zero_()
        orders = [
            torch.randperm(storage.num_envs, device=self.device)
            for _ in range(self.num_learning_epochs)
        ]
        for order in orders:
            for worlds in order.tensor_split(self.num_mini_batches):
                if self._graphs.active:
                    self._worlds.copy_(worlds)
                else:
                    self._worlds = worlds
                self._graphs.run(self._learn_from_minibatch)
        observations = storage.observations.flatten(0, 1)
        self.actor.update_normalization(observations)
        self.critic.update_normalization(observations)
        storage.clear()
        means = (self._sums / (self.num_learning_epochs * self.num_mini_batches)).tolist()
        self.learning_rate = float(self._rate)
        return dict(zip(("value", "surrogate", "entropy", "bounds"), means, strict=True))

    def _learn_from_minibatch(self) -> None:
        """Take one step of the optimizer on the minibatch of ``_worlds``, and add its losses to ``_sums``."""
        storage = self.storage
        worlds = self._worlds
        observations = storage.observations[:, worlds]
        first = first_steps(storage, worlds)
        state = piece_states(storage.saved_hidden_state_a, worlds, self.sequence_length)
        self.actor(observations, masks=first, hidden_state=state, stochastic_output=True)
        log_prob = self.actor.get_output_log_prob(storage.actions[:, worlds])
        value = self._value_loss(observations, first)
        entropy = self.actor.output_entropy.mean()
        self._adapt_rate(tuple(p[:, worlds] for p in storage.distribution_params or ()))
        self._use_rate()
        advantages = storage.advantages[:, worlds, 0]
        ratio = torch.exp(log_prob - storage.actions_log_prob[:, worlds, 0])
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
        excess = (self.actor.output_mean.abs() - BOUND).clamp_min(0.0).square().sum(dim=-1).mean()
        loss = (
            surrogate
            + self.value_loss_coef * value
            - self.entropy_coef * entropy
            + self.bounds_loss * excess
        )
        self.optimizer.zero_grad()
        loss.backward()
        if self.is_multi_gpu:
            self.reduce_parameters()
        for model in (self.actor, self.critic):
            torch.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self._sums += torch.stack((value, surrogate, entropy, excess)).detach()

    def _value_loss(self, observations: TensorDict, first: Tensor) -> Tensor:
        """Return the mean squared error of the values of the minibatch of ``_worlds``, in units of the returns'
        deviation if the critic knows it."""
        storage = self.storage
        worlds = self._worlds
        state = piece_states(storage.saved_hidden_state_c, worlds, self.sequence_length)
        values = self.critic(observations, masks=first, hidden_state=state)
        old_values = storage.values[:, worlds]
        returns = storage.returns[:, worlds]
        unit = self.critic.return_std if isinstance(self.critic, ReturnCritic) else 1.0
        error = (values - returns) / unit
        near = old_values + unit * ((values - old_values) / unit).clamp(
            -self.clip_param, self.clip_param
        )
        return torch.max(error.square(), ((near - returns) / unit).square()).mean()

    @torch.no_grad()
    def _adapt_rate(self, old_params: tuple[Tensor, ...]) -> None:
        """Divide (multiply) the rate by 1.5 where the policy moved more than twice (less than half) the desired KL."""
        kl = self.actor.get_kl_divergence(old_params, self.actor.output_distribution_params).mean()
        if self.is_multi_gpu:
            torch.distributed.all_reduce(kl)
            kl = kl / self.gpu_world_size
        slower = (self._rate / 1.5).clamp_min(SLOWEST)
        faster = (self._rate * 1.5).clamp_max(FASTEST)
        too_little = (kl < self.desired_kl / 2.0) & (kl > 0.0)
        too_much = kl > self.desired_kl * 2.0
        self._rate.copy_(torch.where(too_much, slower, torch.where(too_little, faster, self._rate)))

    def _use_rate(self) -> None:
        """Give the rate to the optimizer. On a GPU it reads the tensor itself; only the fused optimizer can."""
        groups = self.optimizer.param_groups
        on_gpu = self._rate.is_cuda
        for group in groups:
            group["lr"] = self._rate if on_gpu else float(self._rate)
        if groups[0]["capturable"] != on_gpu:  # new, or from a checkpoint of another kind of device
            for group in groups:
                group |= {"fused": on_gpu, "foreach": False, "capturable": on_gpu}
            for state in self.optimizer.state.values():
                state["step"] = state["step"].to(self.device)
