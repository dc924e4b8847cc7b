"""The paper's network (appendix C, Table VIII): PointNet per cloud frame, LSTM with layer norm, MLP.

Observation groups with two dimensions are flat; groups with four, [N, H, P, K], are cloud histories. Shape
letters: N worlds (or sequences), T steps of a rollout, L steps of a sequence, H history, P points, K numbers per point,
D flat width; ``embedding`` and ``lstm`` are the widths of a frame's embedding and of the LSTM.
"""

from __future__ import annotations

import copy
import importlib.util
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torch.distributions import Normal

from xreset.errors import needs
from xreset.learning.config import ModelConfig, TrainConfig
from xreset.learning.distributed import Processes

with needs("rsl-rl-lib", "train"):
    from rsl_rl.models import MLPModel
    from rsl_rl.modules import EmpiricalNormalization, HiddenState
    from rsl_rl.modules.distribution import GaussianDistribution

CLIP_OBSERVATIONS = 5.0
"""Limit of normalized observations in policies for several robots. An observation that is constant in the training,
such as an empty slot, has almost no deviation: in another robot, its value may be a hundred deviations away."""
LstmState = tuple[Tensor, Tensor]
"""Hidden and cell state of the LSTM, each [1, N, lstm]."""


class PointNet(nn.Module):
    """Embeds clouds [..., P, K] as [..., dims[-1]]: the same MLP for every point, then the maximum over points."""

    def __init__(self, dims: Sequence[int], point_width: int) -> None:
        """Build the per-point MLP K -> dims[0] -> ..., K being ``point_width``; no activation after the last layer."""
        super().__init__()
        layers = []
        for width_in, width_out in zip((point_width, *dims[:-1]), dims, strict=True):
            layers += [nn.Linear(width_in, width_out), nn.ELU()]
        self.mlp = nn.Sequential(*layers[:-1])
        self.use_bfloat16 = False
        """Whether to compute in bfloat16 where the clouds are on a GPU; the result is float32 all the same."""

    def forward(self, cloud: Tensor) -> Tensor:
        """[..., P, K] -> [..., dims[-1]]."""
        if not (self.use_bfloat16 and cloud.is_cuda):
            return self.mlp(cloud).amax(dim=-2)
        linear = [layer for layer in self.mlp if isinstance(layer, nn.Linear)]
        if importlib.util.find_spec("triton") is not None:
            from xreset.learning import fused

            if fused.supports(cloud.shape[-2], tuple(layer.out_features for layer in linear)):
                return fused.fused_pointnet(cloud, *self.mlp.parameters())
        with torch.autocast("cuda", dtype=torch.bfloat16):
            return self.mlp(cloud).amax(dim=-2).float()


def embed_sequences(pointnet: PointNet, cloud: Tensor, first: Tensor) -> Tensor:
    """Return embeddings [L, N, H, embedding] of cloud histories [L, N, H, P, K]; every distinct frame is embedded once.

    A step's history is that of the step before, shifted by one, with the newest frame at the end. Where an episode
    starts (``first`` [L, N]) it is H copies of the newest frame. So L steps hold H - 1 + L distinct frames, not L * H:
    with a horizon of 16 and a history of 5, 20 and not 80.
    """
    steps, _, history = cloud.shape[:3]
    frames = torch.cat((cloud[0, :, :-1].transpose(0, 1), cloud[:, :, -1]))  # [H - 1 + L, N, P, 3]
    embedded = pointnet(frames)
    step = torch.arange(steps, device=cloud.device)
    # [L, N] step in which this episode started, if it is one of these
    begin = torch.where(first, step[:, None], -history).cummax(dim=0).values
    # [L, 1, H] step of which each frame was the newest
    shifted = step[:, None, None] + torch.arange(1 - history, 1, device=cloud.device)
    source = torch.maximum(shifted, begin[..., None]) + history - 1
    return embedded.transpose(0, 1)[
        torch.arange(cloud.shape[1], device=cloud.device)[:, None], source
    ]


def run_lstm(lstm: nn.LSTM, x: Tensor, keep: Tensor, state: LstmState) -> tuple[Tensor, LstmState]:
    """Run one LSTM layer over L steps, with a state that may be zeroed before any of them.

    The library's layer has to be called once for every step. On a GPU the inputs of all steps are multiplied at once
    instead, with widths that suit the matrix units, and each step is one product and one fused kernel.

    Args:
        lstm: the layer.
        x: [L, N, D]; in bfloat16 (on a GPU) all products have such factors, while sums and the state are float32.
        keep: [L, N] False where an episode begins.
        state: [1, N, lstm] each.

    Returns:
        outputs [L, N, lstm], new state.
    """
    h, c = state
    out = []
    if not x.is_cuda:
        for step, kept in zip(x, keep.to(h.dtype)[:, None, :, None], strict=True):
            y, (h, c) = lstm(step[None], (h * kept, c * kept))
            out.append(y)
        return torch.cat(out), (h, c)
    low = x.dtype
    padding = (0, -x.shape[-1] % 8)
    weight, recurrent, bias, recurrent_bias = lstm.all_weights[0]
    inputs = nn.functional.linear(
        nn.functional.pad(x, padding), nn.functional.pad(weight, padding).to(low)
    )
    recurrent = recurrent.to(low)
    h = h[0]
    c = c[0]
    for step, kept in zip(inputs, keep.to(h.dtype)[..., None], strict=True):
        gates = nn.functional.linear((h * kept).to(low), recurrent).to(h.dtype)
        # torch has no public name for the cell's kernel
        h, c, _ = torch.ops.aten._thnn_fused_lstm_cell(
            step.to(h.dtype), gates, c * kept, bias, recurrent_bias
        )
        out.append(h)
    return torch.stack(out), (h[None], c[None])


class Trunk(nn.Module):
    """From observations to the MLP's input: what training and the exported policy share."""

    def __init__(
        self,
        flat_dim: int,
        pointnet: PointNet,
        embedding_dim: int,
        lstm_dim: int,
        *,
        clip: bool = False,
    ) -> None:
        """Build normalization, LSTM and layer norm.

        Args:
            flat_dim: D.
            pointnet: encoder of clouds.
            embedding_dim: width of all embeddings of a step.
            lstm_dim: units of the LSTM.
            clip: whether normalized observations are limited to +-:data:`CLIP_OBSERVATIONS`.
        """
        super().__init__()
        self.clip = clip
        self.normalizer = EmpiricalNormalization(flat_dim)
        self.pointnet = pointnet
        self.lstm = nn.LSTM(flat_dim + embedding_dim, lstm_dim)
        self.norm = nn.LayerNorm(lstm_dim)

    def join(self, flat: Tensor, embeddings: Tensor) -> Tensor:
        """Flat [..., D] and embeddings [..., H, embedding] -> [..., D + H * embedding], the LSTM's input.

        It already has the precision of the LSTM's factors, so that later copies move half as much.
        """
        dtype = torch.bfloat16 if self.pointnet.use_bfloat16 and flat.is_cuda else flat.dtype
        flat = self.normalizer(flat)
        if self.clip:
            flat = flat.clamp(-CLIP_OBSERVATIONS, CLIP_OBSERVATIONS)
        return torch.cat((flat.to(dtype), embeddings.flatten(-2).to(dtype)), dim=-1)

    def forward(self, flat: Tensor, cloud: Tensor, state: LstmState) -> tuple[Tensor, LstmState]:
        """One step for N worlds: [N, D], [N, H, P, K], LSTM state of [1, N, lstm] each -> [N, lstm], new state."""
        out, state = self.lstm(self.join(flat, self.pointnet(cloud))[None], state)
        return self.norm(out[0]), state


class Gaussian(GaussianDistribution):
    """rsl-rl's, but sampling does not wait for the GPU: torch's ``normal`` checks that every deviation is positive.

    Attributes:
        mask: [..., A] 1 for the actions that a robot has, else 0; None: it has all. The others have mean 0 and
            deviation 1, whatever the network says, so that neither probabilities nor gradients depend on them.
    """

    mask: Tensor | None = None

    def update(self, mlp_output: Tensor) -> None:
        """Take means."""
        super().update(mlp_output)
        if self.mask is not None:
            std = torch.where(self.mask > 0, self.std, 1.0)
            self._distribution = Normal(self.mask * self.mean, std)

    def sample(self) -> Tensor:
        """[..., J]"""
        return self.mean + self.std * torch.randn_like(self.mean)


class PointNetLstmModel(MLPModel):
    """Actor or critic for rsl-rl's algorithms.

    In a rollout the model keeps its own LSTM state. In an update it gets whole rollouts [T, N, ...] of some worlds, the
    state with which each piece starts, and ``masks`` [T, N], True where a step is the first of an episode. There the
    state is zeroed, so gradients cross neither the end of an episode nor that of a piece.
    """

    is_recurrent: bool = True

    def __init__(
        self,
        obs: TensorDict,
        groups: Sequence[str],
        output_dim: int,
        config: ModelConfig,
        *,
        stochastic: bool = False,
        clip: bool = False,
    ) -> None:
        """Build the model.

        Args:
            obs: an example of the observations.
            groups: flat groups of the observations, then the group of clouds.
            output_dim: number of outputs.
            config: widths of the layers.
            stochastic: whether the outputs are the means of a Gaussian.
            clip: as for :class:`Trunk`.
        """
        gaussian = {"class_name": Gaussian, "init_std": config.initial_std, "std_type": "log"}
        *flat, self.cloud_group = groups
        self._latent_dim = config.lstm
        super().__init__(
            obs,
            {"flat": flat},
            "flat",
            output_dim,
            config.mlp,
            distribution_cfg=gaussian if stochastic else None,
        )
        clouds, _, point_width = obs[self.cloud_group].shape[1:]
        encoder = PointNet(config.pointnet, point_width)
        width = clouds * config.pointnet[-1]
        self.trunk = Trunk(self.obs_dim, encoder, width, config.lstm, clip=clip)
        self.state: LstmState | None = None

    def forward(self, obs: TensorDict, *args: Any, **options: Any) -> Tensor:
        """[..., outputs]; those that an actor draws are masked by the observation ``action_mask``, if there is one."""
        if options.get("stochastic_output") and isinstance(self.distribution, Gaussian):
            self.distribution.mask = obs.get("action_mask", None)
        return super().forward(obs, *args, **options)

    def mean_std(self) -> Tensor:
        """[] mean standard deviation of the actions that robots have, in the last batch."""
        assert isinstance(self.distribution, Gaussian)
        std = self.output_std.detach()
        mask = self.distribution.mask
        return std.mean() if mask is None else std[mask > 0].mean()

    def get_latent(
        self, obs: TensorDict, masks: Tensor | None = None, hidden_state: HiddenState = None
    ) -> Tensor:
        """Return the MLP's input: [N, lstm] in a rollout, [T, N, lstm] in an update.

        In an update the T steps are cut into pieces; ``hidden_state`` [1, pieces * N, lstm] has the state with which
        each piece starts, piece by piece.
        """
        flat = torch.cat([obs[group] for group in self.obs_groups], dim=-1)
        cloud = obs[self.cloud_group]
        trunk = self.trunk
        if masks is None:
            if self.state is None:
                zero = flat.new_zeros(1, flat.shape[0], self._latent_dim)
                self.state = (zero, zero.clone())
            joined = trunk.join(flat, trunk.pointnet(cloud))[None]
            keep = torch.ones_like(joined[..., 0], dtype=torch.bool)
            out, self.state = run_lstm(trunk.lstm, joined, keep, self.state)
            return trunk.norm(out[0])
        assert isinstance(hidden_state, tuple), (
            "an update needs the LSTM state of each sequence's start"
        )
        joined = trunk.join(flat, self._embed_rollout(cloud, masks))
        pieces = hidden_state[0].shape[1] // joined.shape[1]

        def cut(value: Tensor) -> Tensor:
            """[T, N, ...] -> [T / pieces, pieces * N, ...]"""
            return value.unflatten(0, (pieces, -1)).transpose(0, 1).flatten(1, 2)

        out, _ = run_lstm(trunk.lstm, cut(joined), ~cut(masks), hidden_state)
        return trunk.norm(out).unflatten(1, (pieces, -1)).transpose(0, 1).flatten(0, 1)

    def _embed_rollout(self, cloud: Tensor, first: Tensor) -> Tensor:
        """Return embeddings [T, N, H, embedding] of clouds [T, N, H, P, K] in an update."""
        if self.cloud_group == "view":  # what cameras show is not shifted from step to step
            return self.trunk.pointnet(cloud)
        return embed_sequences(self.trunk.pointnet, cloud, first)

    def reset(self, dones: Tensor | None = None, hidden_state: HiddenState = None) -> None:
        """Forget all, take over a state, or zero the state of worlds whose episode has ended ([N] bool or 0/1)."""
        if dones is None:
            self.state = hidden_state  # pyright: ignore[reportAttributeAccessIssue]
        elif self.state is not None:
            keep = (dones == 0).to(self.state[0].dtype)[None, :, None]
            self.state = (self.state[0] * keep, self.state[1] * keep)

    def get_hidden_state(self) -> HiddenState:
        """The LSTM state, each [1, N, lstm]; None before the first step."""
        return self.state

    def update_normalization(self, obs: TensorDict) -> None:
        """Take observations [M, ...] into the running mean and variance."""
        normalizer = self.trunk.normalizer
        std = normalizer._std  # rsl-rl replaces this tensor; captured updates read it where it is
        normalizer.update(torch.cat([obs[group] for group in self.obs_groups], dim=-1))
        normalizer._std = std.copy_(normalizer._std)

    def _get_latent_dim(self) -> int:
        return self._latent_dim


class ReturnCritic(PointNetLstmModel):
    """A critic whose last layer gives returns in units of their running standard deviation, around their running mean.

    When mean and deviation change, the last layer changes so that the values stay the same (van Hasselt et al. 2016,
    Learning values across many orders of magnitude).
    """

    RATE = 0.01
    """Weight of a rollout in the running moments, once there have been a hundred."""

    def __init__(self, *args: Any, **options: Any) -> None:
        """Build, with a mean of 0 and a deviation of 1."""
        super().__init__(*args, **options)
        self.return_mean: Tensor
        self.return_std: Tensor
        self.rollouts: Tensor
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_std", torch.ones(()))
        self.register_buffer("rollouts", torch.zeros((), dtype=torch.long))

    def forward(self, *args: Any, **options: Any) -> Tensor:
        """[..., 1] values, in the unit of the rewards."""
        return self.return_mean + self.return_std * super().forward(*args, **options)

    @torch.no_grad()
    def take_returns(self, returns: Tensor, processes: Processes) -> None:
        """Take all processes' returns into mean and deviation; the values of observations do not change."""
        self.rollouts += 1
        rate = (1.0 / self.rollouts).clamp_min(self.RATE)
        own = returns.mean()
        center = processes.mean(own)
        spread = processes.mean(returns.var(unbiased=False) + (own - center).square())
        shift = center - self.return_mean
        mean = self.return_mean + rate * shift
        variance = (
            (1 - rate) * self.return_std.square()
            + rate * spread
            + rate * (1 - rate) * shift.square()
        )
        std = variance.sqrt().clamp_min(1e-3)
        last = [layer for layer in self.mlp.modules() if isinstance(layer, nn.Linear)][-1]
        last.weight.mul_(self.return_std / std)
        last.bias.mul_(self.return_std).add_(self.return_mean - mean).div_(std)
        self.return_mean.copy_(mean)
        self.return_std.copy_(std)


class ExportedPolicy(nn.Module):
    """The deterministic policy.

    ``(flat [N, D], cloud [N, H, P, K], h_in, c_in [1, N, lstm]) -> (actions [N, J], h_out, c_out)``.
    """

    def __init__(self, model: PointNetLstmModel) -> None:
        """Copy the parts of a trained model; the copy is on the CPU and in evaluation mode."""
        super().__init__()
        self.trunk = copy.deepcopy(model.trunk)
        self.trunk.pointnet.use_bfloat16 = False
        self.mlp = copy.deepcopy(model.mlp)
        assert model.distribution is not None, "a policy is stochastic while it learns"
        self.output = model.distribution.as_deterministic_output_module()
        self.flat_dim = model.obs_dim
        self.lstm_dim = model._latent_dim
        self.cpu().eval()

    def forward(
        self, flat: Tensor, cloud: Tensor, h_in: Tensor, c_in: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One control step."""
        latent, (h, c) = self.trunk(flat, cloud, (h_in, c_in))
        return self.output(self.mlp(latent)), h, c


def make_actor(obs: TensorDict, num_actions: int, config: TrainConfig) -> PointNetLstmModel:
    """Return a new actor; ``obs`` is an example of the observations."""
    actor = PointNetLstmModel(
        obs,
        config.task.policy_groups,
        num_actions,
        config.model,
        stochastic=True,
        clip=config.task.joint_slots is not None,
    )
    actor.trunk.pointnet.use_bfloat16 = config.ppo.precision == "bfloat16"
    return actor


def make_critic(obs: TensorDict, config: TrainConfig) -> PointNetLstmModel:
    """Return a new critic; ``obs`` is an example of the observations."""
    m = config.model
    kind = ReturnCritic if m.normalize_returns else PointNetLstmModel
    critic = kind(
        obs,
        ("policy", "proprio", "privileged", "perception"),
        1,
        replace(m, mlp=m.critic_mlp or m.mlp),
        clip=config.task.joint_slots is not None,
    )
    critic.trunk.pointnet.use_bfloat16 = config.ppo.precision == "bfloat16"
    return critic
