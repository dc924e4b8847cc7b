"""Writes the files of the policies that ship with xreset: ci/ship_policies.py [NAME=RUN ...]

Without arguments it writes the deployed graphs anew, which is needed after the code of observations or actions has
changed. NAME=RUN adds the policy of a run with its graph and its newest checkpoint, or replaces them; large weights are
stored in half precision. Measure the file that ships, and write its card. Graphs have the contract of the training that the policy's own file states.
"""

from __future__ import annotations

import io
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

from xreset.eval.policy_spec import load_policy
from xreset.learning.checkpoint import read_checkpoint
from xreset.learning.run import latest_checkpoint
from xreset.live.deploy import deployed_graph, with_metadata
from xreset.policy.onnx_policy import METADATA_KEY, VERSION_KEY
from xreset.policy.shipped import FOLDER, shipped

SMALL = 1024
"""Weights of fewer bytes stay in a graph and in a checkpoint."""
LARGE = 100_000
"""Weights of more bytes are stored in half precision."""


def halved(content: bytes) -> bytes:
    """Return an exported policy with its large weights in half precision; it computes in single precision."""
    model = onnx.load_from_string(content)
    graph = model.graph
    for constant in list(graph.initializer):
        value = numpy_helper.to_array(constant)
        if value.dtype != np.float32 or value.nbytes < LARGE:
            continue
        name = f"{constant.name}_float16"
        half = numpy_helper.from_array(value.astype(np.float16), name)
        cast = helper.make_node("Cast", [name], [constant.name], to=onnx.TensorProto.FLOAT)
        graph.initializer.remove(constant)
        graph.initializer.append(half)
        graph.node.insert(0, cast)
    onnx.checker.check_model(model)
    return model.SerializeToString()


def halved_checkpoint(run: Path, network: bytes) -> bytes:
    """Return a checkpoint from which another training starts: the policy and the critic of a run's newest one.

    Large weights are in half precision, those of the critic with the digits of bfloat16, which take a sixth less space in
    a wheel. Weights that the policy's file has are left out.

    Args:
        run: run folder.
        network: content of the policy's file.
    """
    content = read_checkpoint(latest_checkpoint(run))
    actor = halved_state(content.policy_state_dict)
    critic = halved_state(content.critic_state_dict)
    for name, value in critic.items():
        if value.dtype == torch.half:
            critic[name] = value.bfloat16().half()
    content = replace(
        content,
        actor_state_dict=actor,
        critic_state_dict=critic,
        optimizer_state_dict={"state": {}},
        average_state_dict={},
        resets_state_dict={},
    )
    buffer = io.BytesIO()
    torch.save(vars(content), buffer)
    return without_weights(
        buffer.getvalue(), [v.numpy().tobytes() for v in actor.values()], network
    )


def halved_state(state: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Return the state of a network with its large weights in half precision."""
    halved = {}
    for name, value in state.items():
        # a clone, because an LSTM's weights lie in one storage, which would be written whole
        halved[name] = value.half() if value.nbytes >= LARGE else value.clone()
    return halved


def cut_graph(graph: bytes, network: bytes) -> bytes:
    """Return a graph without the weights that its policy's file has."""
    weights = [constant.raw_data for constant in onnx.load_from_string(graph).graph.initializer]
    return without_weights(graph, weights, network)


def without_weights(content: bytes, weights: list[bytes], network: bytes) -> bytes:
    """Return a file's content without the weights that its policy's file has, for :func:`xreset.policy.shipped.whole`.

    Args:
        content: the whole content.
        weights: its arrays, in the order in which they lie in it.
        network: content of the policy's file.
    """
    cuts = []
    rest = []
    end = 0
    for array in weights:
        at = content.find(array, end)
        offset = network.find(array)
        if len(array) < SMALL or at < 0 or offset < 0:
            continue
        rest.append(content[end:at])
        cuts.append((sum(map(len, rest)), offset, len(array)))
        end = at + len(array)
    rest.append(content[end:])
    return json.dumps(cuts).encode() + b"\n" + b"".join(rest)


def main() -> None:
    made = set()
    for argument in sys.argv[1:]:
        name, _, run = argument.partition("=")
        network = halved(load_policy(run).exported())
        checkpoint = halved_checkpoint(Path(run), network)
        (FOLDER / f"{name}.onnx").write_bytes(network)
        (FOLDER / f"{name}.pt").write_bytes(checkpoint)
        made.add(name)
    for name, file in shipped().items():
        policy = load_policy(file)
        if policy.task.vision.cameras or (made and name not in made):
            continue
        stated = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
        own = {key: stated[key] for key in (METADATA_KEY, VERSION_KEY) if key in stated}
        # anew: policy.graph would be the one that ships
        graph = deployed_graph(policy.exported(), policy.robot, policy.task)
        content = cut_graph(with_metadata(graph, own), file.read_bytes())
        file.with_suffix(".graph").write_bytes(content)
        print(name)


if __name__ == "__main__":
    main()
