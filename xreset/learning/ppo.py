"""PPO over short sequences: Table VIII's sequence length 4 inside a horizon of 16, on top of rsl-rl's PPO.

rsl-rl back-propagates through whole horizons. Here a rollout [T, N] is cut into pieces [T / L, L, N]; each piece starts from the LSTM state
that the rollout had there, and an episode's end inside a piece zeroes the state. A minibatch holds all pieces of some worlds, drawn anew in
every epoch, so that the cloud frames that pieces share are embedded once. Returns use the whole horizon.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Generator, Iterable
from typing import Any, cast

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import resolve_class, resolve_obs_groups
from tensordict import TensorDict
from torch import Tensor

from xreset.learning.model import ReturnCritic


class SequenceStorage(RolloutStorage):
    """A rollout that is handed out world by world, cut into sequences of fixed length."""

    def __init__(self, sequence_length: int, *args: Any, **options: Any) -> None:
        """Allocate; ``sequence_length`` divides the number of steps."""
        super().__init__(*args, **options)
        self.sequence_length = sequence_length

    def recurrent_mini_batch_generator(self, num_mini_batches: int, num_epochs: int = 8) -> Generator[RolloutStorage.Batch, None, None]:
        """Yield minibatches [T, M, ...] of M worlds.

        ``masks`` [T, M] is True where a step is the first of an episode; ``hidden_states`` [1, pieces * M, lstm] are the states that the
        pieces began with, all worlds of the first piece first.
        """
        first = torch.zeros_like(self.dones, dtype=torch.bool)
        first[1:] = self.dones[:-1].bool()  # step 0 begins with the state that was saved there, zeroed where an episode had ended
        first = first.squeeze(-1)
        # [T, 1, N, lstm] -> [pieces, N, lstm]
        states = [
            tuple(s[:: self.sequence_length].squeeze(1) for s in saved) if saved is not None else None
            for saved in (self.saved_hidden_state_a, self.saved_hidden_state_c)
        ]
        for _ in range(num_epochs):
            for pick in torch.randperm(self.num_envs, device=self.device).tensor_split(num_mini_batches):
                yield RolloutStorage.Batch(
                    observations=self.observations[:, pick],
                    actions=self.actions[:, pick],
                    values=self.values[:, pick],
                    advantages=self.advantages[:, pick],
                    returns=self.returns[:, pick],
                    old_actions_log_prob=self.actions_log_prob[:, pick],
                    old_distribution_params=tuple(p[:, pick] for p in self.distribution_params or ()),
                    hidden_states=tuple(
                        tuple(s[:, pick].flatten(0, 1)[None] for s in state) if state is not None else None for state in states
                    ),  # pyright: ignore[reportArgumentType]
                    masks=first[:, pick],
                )


Batch = Any
"""A :class:`RolloutStorage.Batch` whose every field is there; rsl-rl declares them optional."""

BOUND = 1.1
"""Mean of an action beyond which ``bounds_loss`` pulls it back."""
SLOWEST, FASTEST = 1e-5, 1e-2
"""Limits of an adaptive learning rate (rsl-rl's)."""


class SequencePpo(PPO):
    """rsl-rl's PPO with :class:`SequenceStorage`, an update that never waits for a GPU, and a critic that may learn at its own rate."""

    def __init__(self, *args: Any, critic_learning_rate: float | None = None, bounds_loss: float = 0.0, **options: Any) -> None:
        """Set up as rsl-rl does.

        Args:
            args: rsl-rl's.
            critic_learning_rate: a rate of the critic's own; None: the actor's.
            bounds_loss: weight of the squared excess of the actions' means over :data:`BOUND`.
            options: rsl-rl's.
        """
        super().__init__(*args, **options)
        self.critic_learning_rate, self.bounds_loss = critic_learning_rate, bounds_loss
        if critic_learning_rate is not None:
            groups = [{"params": list(self.actor.parameters())}, {"params": list(self.critic.parameters()), "lr": critic_learning_rate}]
            self.optimizer = type(self.optimizer)(groups, lr=self.learning_rate)

    def update(self) -> dict[str, float]:
        """Learn from the rollout; the mean losses of its minibatches.

        Unlike rsl-rl's, it reads no number back from the device until the end: the adaptive learning rate lives there, too.
        """
        storage, on_gpu = self.storage, torch.device(self.device).type == "cuda"
        value_unit = 1.0
        if isinstance(self.critic, ReturnCritic):
            self.critic.take_returns(storage.returns)
            value_unit = self.critic.return_std
        rate = torch.tensor(self.learning_rate, device=self.device, dtype=torch.float32 if on_gpu else torch.float64)
        self._use_rate(rate, on_gpu)
        sums = torch.zeros(4, device=self.device)
        batches = storage.recurrent_mini_batch_generator(self.num_mini_batches, self.num_learning_epochs)
        for batch in cast(Iterable[Batch], batches):
            self.actor(batch.observations, masks=batch.masks, hidden_state=batch.hidden_states[0], stochastic_output=True)
            log_prob = self.actor.get_output_log_prob(batch.actions)
            values = self.critic(batch.observations, masks=batch.masks, hidden_state=batch.hidden_states[1])
            entropy = self.actor.output_entropy.mean()
            if self.schedule == "adaptive":
                self._adapt(rate, batch)
                if not on_gpu:
                    self._use_rate(rate, on_gpu)
            advantages = batch.advantages.squeeze(-1)
            ratio = torch.exp(log_prob - batch.old_actions_log_prob.squeeze(-1))
            surrogate = torch.max(-advantages * ratio, -advantages * ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)).mean()
            value = self._value_loss(values, batch, value_unit)
            excess = (self.actor.output_mean.abs() - BOUND).clamp_min(0.0).square().sum(dim=-1).mean()
            loss = surrogate + self.value_loss_coef * value - self.entropy_coef * entropy + self.bounds_loss * excess
            self.optimizer.zero_grad()
            loss.backward()
            if self.is_multi_gpu:
                self.reduce_parameters()
            for model in (self.actor, self.critic):
                torch.nn.utils.clip_grad_norm_(model.parameters(), self.max_grad_norm)
            self.optimizer.step()
            sums += torch.stack((value, surrogate, entropy, excess)).detach()
        observations = storage.observations.flatten(0, 1)
        self.actor.update_normalization(observations)
        self.critic.update_normalization(observations)
        storage.clear()
        means = (sums / (self.num_learning_epochs * self.num_mini_batches)).tolist()
        self.learning_rate = float(rate)
        return dict(zip(("value", "surrogate", "entropy", "bounds"), means, strict=True))

    def _value_loss(self, values: Tensor, batch: Batch, unit: Tensor | float) -> Tensor:
        error = (values - batch.returns) / unit
        if not self.use_clipped_value_loss:
            return error.square().mean()
        near = batch.values + unit * ((values - batch.values) / unit).clamp(-self.clip_param, self.clip_param)
        return torch.max(error.square(), ((near - batch.returns) / unit).square()).mean()

    @torch.no_grad()
    def _adapt(self, rate: Tensor, batch: Batch) -> None:
        """Divide (multiply) the rate by 1.5 where the policy moved more than twice (less than half) the desired divergence; in place."""
        kl = self.actor.get_kl_divergence(batch.old_distribution_params, self.actor.output_distribution_params).mean()
        if self.is_multi_gpu:
            torch.distributed.all_reduce(kl)
            kl = kl / self.gpu_world_size
        slower, faster = (rate / 1.5).clamp_min(SLOWEST), (rate * 1.5).clamp_max(FASTEST)
        too_little = (kl < self.desired_kl / 2.0) & (kl > 0.0)
        rate.copy_(torch.where(kl > self.desired_kl * 2.0, slower, torch.where(too_little, faster, rate)))

    def _use_rate(self, rate: Tensor, on_gpu: bool) -> None:
        """Give the rate to the optimiser: on a GPU as a tensor that it reads there, for which it has to be the fused one."""
        groups = self.optimizer.param_groups
        for group in groups[:1] if self.critic_learning_rate is not None else groups:
            group["lr"] = rate if on_gpu else float(rate)
        if on_gpu and not groups[0].get("fused"):
            for group in groups:
                group["fused"], group["foreach"] = True, False
            for state in self.optimizer.state.values():
                state["step"] = state["step"].to(self.device)

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions; the very first step of a run starts from a zero LSTM state, which is stored like any other."""
        for model in (self.actor, self.critic):
            if model.is_recurrent and model.get_hidden_state() is None:
                with torch.no_grad():
                    model(obs)
                h, c = model.get_hidden_state()  # pyright: ignore[reportGeneralTypeIssues]
                model.reset(hidden_state=(torch.zeros_like(h), torch.zeros_like(c)))
        return super().act(obs)

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Any]) -> None:
        """Record one environment step, and which worlds' part of it is not to be learned from (``extras["faulty"]`` [N] bool)."""
        step = self.storage.step
        if not step:
            self._faulty = torch.zeros(self.storage.num_transitions_per_env, *dones.shape, dtype=torch.bool, device=self.device)
        if "faulty" in extras:
            self._faulty[step] = extras["faulty"]
        super().process_env_step(obs, rewards, dones, extras)

    def compute_returns(self, obs: TensorDict) -> None:
        """Returns and advantages; those of faulty steps are the value itself and zero, so that neither loss has a gradient there.

        A faulty step is the last of its episode: with the value as its reward, its error is zero, whatever the simulation said.
        """
        storage, faulty = self.storage, self._faulty[..., None]
        storage.rewards = torch.where(faulty, storage.values, storage.rewards)
        super().compute_returns(obs)
        storage.advantages = torch.where(faulty, 0.0, storage.advantages)

    @staticmethod
    def construct_algorithm(obs: TensorDict, env: VecEnv, cfg: dict, device: str) -> PPO:
        """Build models, storage and algorithm from the runner's configuration."""
        alg_class, alg_cfg = resolve_class(cfg["algorithm"])
        actor_class, actor_cfg = resolve_class(cfg["actor"])
        critic_class, critic_cfg = resolve_class(cfg["critic"])
        with contextlib.redirect_stdout(io.StringIO()):
            groups = resolve_obs_groups(obs, cfg["obs_groups"], ["actor", "critic"])
        actor = actor_class(obs, groups, "actor", env.num_actions, **actor_cfg).to(device)
        critic = critic_class(obs, groups, "critic", 1, **critic_cfg).to(device)
        actor.reuse_embeddings = critic.reuse_embeddings = True
        length = alg_cfg.pop("sequence_length")
        storage = SequenceStorage(length, "rl", env.num_envs, cfg["num_steps_per_env"], obs, [env.num_actions], device)
        return alg_class(actor, critic, storage, device=device, **alg_cfg, multi_gpu_cfg=cfg["multi_gpu"])
