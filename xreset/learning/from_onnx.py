"""The network of an exported policy, which teaches a student: the file holds all weights."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from xreset.errors import PolicyError
from xreset.learning.config import MODEL, ModelConfig
from xreset.learning.model import PointNetLstmModel
from xreset.policy.onnx_policy import OnnxPolicy, observation_shapes

if TYPE_CHECKING:
    from onnx import GraphProto

_CLOSE = 1e-3
"""Largest difference between an action of the file and one of the network."""


def network_of(policy: OnnxPolicy) -> PointNetLstmModel:
    """Return the network of an exported policy, in evaluation mode on the CPU.

    Raises:
        PolicyError: the network is built in another way than this version exports policies.
    """
    shapes = observation_shapes(policy.contract, str(policy.path))
    observations = TensorDict(
        {name: torch.randn(2, *shape) for name, shape in shapes.items()}, batch_size=[2]
    )
    with _rebuilding(policy):
        weights = _weights(policy)
        model = PointNetLstmModel(
            observations,
            list(shapes),
            policy.contract.num_actions,
            _layers(weights),
            clip=policy.contract.task.joint_slots is not None,
        )
        model.load_state_dict(model.state_dict() | weights)
        model.eval()
        with torch.no_grad():
            difference = (model(observations).clamp(-1, 1) - policy.act(observations)).abs().max()
    if not difference < _CLOSE:
        raise PolicyError(
            f"The network of {policy.path} cannot be rebuilt: its actions differ from the file's by {difference:.2g}."
        )
    model.reset()
    return model.requires_grad_(False)


def layers_of(policy: OnnxPolicy) -> ModelConfig:
    """Return the layers of an exported policy's network; ``PolicyError`` as for :func:`network_of`."""
    with _rebuilding(policy):
        return _layers(_weights(policy))


@contextmanager
def _rebuilding(policy: OnnxPolicy) -> Iterator[None]:
    try:
        yield
    except (KeyError, IndexError, StopIteration, RuntimeError, ValueError) as error:
        raise PolicyError(
            f"The network of {policy.path} cannot be rebuilt: it is not built as xreset exports it ({error})."
        ) from error


def _layers(weights: dict[str, Tensor]) -> ModelConfig:
    return ModelConfig(
        pointnet=_widths(weights, "trunk.pointnet.mlp."),
        lstm=weights["trunk.lstm.weight_hh_l0"].shape[1],
        mlp=_widths(weights, "mlp.")[:-1],
        initial_std=MODEL.initial_std,
    )


def _widths(weights: dict[str, Tensor], prefix: str) -> tuple[int, ...]:
    """Return the widths of the linear layers whose names begin with a prefix, in order."""
    layers = [name for name in weights if name.startswith(prefix) and name.endswith(".bias")]
    layers.sort(key=lambda name: int(name.split(".")[-2]))
    return tuple(len(weights[name]) for name in layers)


def _weights(policy: OnnxPolicy) -> dict[str, Tensor]:
    """Return the weights of an exported network by the names of :class:`PointNetLstmModel`."""
    import onnx

    graph = onnx.load_model_from_string(policy.content).graph
    found = dict(_arrays(graph))
    weights = {name: value for name, value in found.items() if name.startswith(("trunk.", "mlp."))}
    for node in graph.node:
        last = node.input[1] if len(node.input) > 1 else ""
        # the exporter has transposed and renamed the weights of a linear layer, whose bias has kept its name
        if node.op_type == "MatMul" and last in found:
            bias = next(
                other.input[1]
                for other in graph.node
                if other.op_type == "Add" and node.output[0] in other.input
            )
            weights[bias.removesuffix("bias") + "weight"] = found[last].T
        if node.op_type == "Div" and last in found:
            std = found[last] - 1e-2  # rsl-rl's eps
            weights["trunk.normalizer._std"] = std
            weights["trunk.normalizer._var"] = std.square()
        if node.op_type == "LSTM":
            input_bias, recurrent_bias = found[node.input[3]].reshape(2, -1)
            weights["trunk.lstm.bias_ih_l0"] = _reordered(input_bias)
            weights["trunk.lstm.bias_hh_l0"] = _reordered(recurrent_bias)
            for name, given in zip(("weight_ih_l0", "weight_hh_l0"), node.input[1:3], strict=True):
                if given in found:  # in a small network, the exporter has reordered the gates
                    weights[f"trunk.lstm.{name}"] = _reordered(found[given][0])
    return weights


def _arrays(graph: GraphProto) -> Iterator[tuple[str, Tensor]]:
    """Yield the names and values of a graph's constants; names of float16 constants without their suffix."""
    from onnx import numpy_helper

    for constant in graph.initializer:
        value = numpy_helper.to_array(constant)
        if value.dtype in (np.float16, np.float32):
            yield constant.name.removesuffix("_float16"), torch.tensor(value, dtype=torch.float32)


def _reordered(gates: Tensor) -> Tensor:
    """Return an LSTM's bias or weights in torch's order of gates (input, forget, cell, output) instead of ONNX's."""
    i, o, f, c = gates.chunk(4)
    return torch.cat((i, f, c, o))
