"""The paper's network (appendix C, Table VIII): PointNet per cloud frame, LSTM with layer norm, MLP.

Observation groups with two dimensions are flat; groups with four, [N, H, P, 3], are cloud histories. Shape letters: N worlds (or
sequences), L steps of a sequence, H history, P points, D flat width.
"""

from __future__ import annotations

import copy
import importlib.util

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization, HiddenState
from tensordict import TensorDict
from torch import Tensor, nn

LstmState = tuple[Tensor, Tensor]


class PointNet(nn.Module):
    """Embeds clouds [..., P, 3] as [..., dims[-1]]: the same MLP for every point, then the maximum over points."""

    def __init__(self, dims: list[int], activation: str = "elu") -> None:
        """Build the per-point MLP 3 -> dims[0] -> ...; no activation after the last layer."""
        super().__init__()
        act = {"elu": nn.ELU, "relu": nn.ReLU}[activation]
        layers: list[nn.Module] = []
        for i, (width_in, width_out) in enumerate(zip([3, *dims[:-1]], dims, strict=True)):
            layers += [act()] * (i > 0) + [nn.Linear(width_in, width_out)]
        self.mlp = nn.Sequential(*layers)
        self.use_bfloat16 = False
        """Whether to compute in bfloat16 where the clouds are on a GPU; the result is float32 all the same."""
        self._fusible = activation == "elu" and len(dims) == 3

    def forward(self, cloud: Tensor) -> Tensor:
        """[..., P, 3] -> [..., dims[-1]]."""
        if not (self.use_bfloat16 and cloud.is_cuda):
            return self.mlp(cloud).amax(dim=-2)
        linear = [layer for layer in self.mlp if isinstance(layer, nn.Linear)]
        if self._fusible and importlib.util.find_spec("triton") is not None:
            from xreset.learning import fused

            if fused.supports(cloud.shape[-2], tuple(layer.out_features for layer in linear)):
                return fused.fused_pointnet(cloud, *(parameter for layer in linear for parameter in (layer.weight, layer.bias)))
        with torch.autocast("cuda", dtype=torch.bfloat16):
            return self.mlp(cloud).amax(dim=-2).float()


def embed_sequences(pointnet: PointNet, cloud: Tensor, first: Tensor) -> Tensor:
    """[L, N, H, embedding] embeddings of cloud histories [L, N, H, P, 3], every distinct frame embedded once.

    Step t's history is step t-1's, shifted by one, with the newest frame at the end; where an episode begins (``first`` [L, N]) it is H
    copies of the newest. So L steps hold H - 1 + L distinct frames and not L * H: with the paper's 4 and 5, 8 and not 20.
    """
    steps, _, history = cloud.shape[:3]
    frames = torch.cat((cloud[0, :, :-1].transpose(0, 1), cloud[:, :, -1]))  # [H - 1 + L, N, P, 3]
    embedded = pointnet(frames)
    step = torch.arange(steps, device=cloud.device)
    begin = torch.where(first, step[:, None], -history).cummax(dim=0).values  # [L, N] step of this episode's beginning, if it is in here
    shifted = step[:, None, None] + torch.arange(1 - history, 1, device=cloud.device)  # [L, 1, H] step whose newest frame it was
    source = torch.maximum(shifted, begin[..., None]) + history - 1
    return embedded.transpose(0, 1)[torch.arange(cloud.shape[1], device=cloud.device)[:, None], source]


class Trunk(nn.Module):
    """From observations to the MLP's input: what training and the exported policy share."""

    def __init__(
        self, flat_dim: int, history: int, pointnet_dims: list[int], lstm_dim: int, activation: str, normalizer: nn.Module
    ) -> None:
        """Build normaliser, PointNet, LSTM and layer norm."""
        super().__init__()
        self.normalizer = normalizer
        self.pointnet = PointNet(pointnet_dims, activation)
        self.lstm = nn.LSTM(flat_dim + history * pointnet_dims[-1], lstm_dim)
        self.norm = nn.LayerNorm(lstm_dim)

    def join(self, flat: Tensor, embeddings: Tensor) -> Tensor:
        """Flat [..., D] and embeddings [..., H, embedding] -> [..., D + H * embedding], the LSTM's input."""
        return torch.cat((self.normalizer(flat), embeddings.flatten(-2)), dim=-1)

    def forward(self, flat: Tensor, cloud: Tensor, state: LstmState) -> tuple[Tensor, LstmState]:
        """One step for N worlds: [N, D], [N, H, P, 3], LSTM state of [1, N, lstm] each -> [N, lstm], new state."""
        out, state = self.lstm(self.join(flat, self.pointnet(cloud))[None], state)
        return self.norm(out[0]), state


class PointNetLstmModel(MLPModel):
    """Actor or critic for rsl-rl's runner.

    In a rollout the model keeps its own LSTM state. In an update it gets sequences [L, N, ...], the state each began with, and ``masks``
    [L, N], True where a step is the first of an episode: there the state is zeroed, so gradients never cross an episode's end.
    """

    is_recurrent: bool = True

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        hidden_dims: list[int] | tuple[int, ...] = (512, 256, 128),
        activation: str = "elu",
        obs_normalization: bool = True,
        distribution_cfg: dict | None = None,
        pointnet_dims: list[int] | tuple[int, ...] = (64, 128, 64),
        lstm_dim: int = 512,
        bfloat16_clouds: bool = False,
    ) -> None:
        """Build the model for the observation groups of one set (``actor`` or ``critic``)."""
        self._latent_dim = lstm_dim
        self.cloud_group = next(group for group in obs_groups[obs_set] if obs[group].ndim == 4)
        super().__init__(obs, obs_groups, obs_set, output_dim, hidden_dims, activation, False, distribution_cfg)
        normalizer = EmpiricalNormalization(self.obs_dim) if obs_normalization else nn.Identity()
        self.trunk = Trunk(self.obs_dim, obs[self.cloud_group].shape[1], list(pointnet_dims), lstm_dim, activation, normalizer)
        self.trunk.pointnet.use_bfloat16 = bfloat16_clouds
        self.state: LstmState | None = None

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: HiddenState = None) -> Tensor:
        """The MLP's input: [N, lstm] in a rollout, [L, N, lstm] in an update."""
        flat = torch.cat([obs[group] for group in self.obs_groups], dim=-1)
        cloud = obs[self.cloud_group]
        if masks is None:
            if self.state is None:
                zero = flat.new_zeros(1, flat.shape[0], self._latent_dim)
                self.state = (zero, zero.clone())
            latent, self.state = self.trunk(flat, cloud, self.state)
            return latent
        assert isinstance(hidden_state, tuple), "an update needs the LSTM state that each sequence began with"
        embedded = self.trunk.join(flat, embed_sequences(self.trunk.pointnet, cloud, masks))
        h, c = hidden_state
        out = []
        for step, first in zip(embedded, masks, strict=True):
            keep = (~first).to(h.dtype)[None, :, None]
            y, (h, c) = self.trunk.lstm(step[None], (h * keep, c * keep))
            out.append(y)
        return self.trunk.norm(torch.cat(out))

    def reset(self, dones: Tensor | None = None, hidden_state: HiddenState = None) -> None:
        """Forget everything, take over a state, or zero the state of worlds whose episode has ended ([N] bool or 0/1)."""
        if dones is None:
            self.state = hidden_state  # pyright: ignore[reportAttributeAccessIssue]
        elif self.state is not None:
            keep = (dones == 0).to(self.state[0].dtype)[None, :, None]
            self.state = (self.state[0] * keep, self.state[1] * keep)

    def get_hidden_state(self) -> HiddenState:
        """The LSTM state, each [1, N, lstm]; None before the first step."""
        return self.state

    def detach_hidden_state(self, dones: Tensor | None = None) -> None:
        """Cut the graph behind the LSTM state."""
        if self.state is not None:
            self.state = (self.state[0].detach(), self.state[1].detach())

    def update_normalization(self, obs: TensorDict) -> None:
        """Take observations [M, ...] into the running mean and variance."""
        if isinstance(self.trunk.normalizer, EmpiricalNormalization):
            self.trunk.normalizer.update(torch.cat([obs[group] for group in self.obs_groups], dim=-1))

    def as_onnx(self, verbose: bool = False) -> nn.Module:
        """The deterministic policy as a plain module; see :class:`ExportedPolicy`."""
        return ExportedPolicy(self)

    def as_jit(self) -> nn.Module:
        """The same module as for ONNX: state in, state out."""
        return ExportedPolicy(self)

    def _get_obs_dim(self, obs: TensorDict, obs_groups: dict[str, list[str]], obs_set: str) -> tuple[list[str], int]:
        flat = [group for group in obs_groups[obs_set] if obs[group].ndim == 2]
        return flat, sum(obs[group].shape[-1] for group in flat)

    def _get_latent_dim(self) -> int:
        return self._latent_dim


class ExportedPolicy(nn.Module):
    """The deterministic policy: ``(flat [N, D], cloud [N, H, P, 3], h_in, c_in [1, N, lstm]) -> (actions [N, J], h_out, c_out)``."""

    def __init__(self, model: PointNetLstmModel) -> None:
        """Copy the parts of a trained model; the copy is on the CPU and in evaluation mode."""
        super().__init__()
        self.trunk = copy.deepcopy(model.trunk)
        self.trunk.pointnet.use_bfloat16 = False
        self.mlp = copy.deepcopy(model.mlp)
        self.output = model.distribution.as_deterministic_output_module() if model.distribution is not None else nn.Identity()
        self.flat_dim, self.lstm_dim = model.obs_dim, model._latent_dim
        self.cpu().eval()

    def forward(self, flat: Tensor, cloud: Tensor, h_in: Tensor, c_in: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """One control step."""
        latent, (h, c) = self.trunk(flat, cloud, (h_in, c_in))
        return self.output(self.mlp(latent)), h, c
