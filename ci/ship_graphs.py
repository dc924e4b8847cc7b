"""Writes the deployed graphs of the policies that ship with xreset: ci/ship_graphs.py

Run it after a policy was added, or after the code of observations or actions has changed. Graphs have the contract of
the training that the policy's own file states.
"""

from __future__ import annotations

import json

import onnx

from xreset.eval.policy_spec import load_policy
from xreset.live.deploy import with_metadata
from xreset.policy.onnx_policy import METADATA_KEY, VERSION_KEY
from xreset.policy.shipped import shipped

SMALL = 1024
"""Pieces of fewer bytes stay in the graph."""


def without_weights(graph: bytes, network: bytes) -> bytes:
    """Return a graph without the weights that are in its network's file too, as
    :func:`xreset.policy.shipped.shipped_graphs` describes it."""
    cuts = []
    rest = []
    end = 0
    for constant in onnx.load_from_string(graph).graph.initializer:
        weights = constant.raw_data
        at = graph.find(weights, end)
        offset = network.find(weights)
        if len(weights) < SMALL or at < 0 or offset < 0:
            continue
        rest.append(graph[end:at])
        cuts.append((sum(map(len, rest)), offset, len(weights)))
        end = at + len(weights)
    rest.append(graph[end:])
    return json.dumps(cuts).encode() + b"\n" + b"".join(rest)


def main() -> None:
    for name, file in shipped().items():
        policy = load_policy(file)
        if policy.task.vision.cameras:
            continue
        stated = {entry.key: entry.value for entry in onnx.load(file).metadata_props}
        own = {key: stated[key] for key in (METADATA_KEY, VERSION_KEY) if key in stated}
        graph = with_metadata(policy.graph, own)
        file.with_suffix(".graph").write_bytes(without_weights(graph, file.read_bytes()))
        print(name)


if __name__ == "__main__":
    main()
