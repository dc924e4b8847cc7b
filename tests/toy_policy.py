"""A policy of one matrix, written as ONNX by hand: in every way that an exported one could be wrong."""

import json
import tempfile
from dataclasses import asdict
from functools import cache
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper

from tests import toy_grasp
from xreset.live.deploy import deployed_graph
from xreset.policy.onnx_policy import observation_shapes, parsed_contract, policy_contract
from xreset.task.config import TaskConfig, evaluation_task

TASK = evaluation_task(TaskConfig(object_frame="center"))


@cache
def toy_graph():
    """Return the network of a policy of the toy gripper, and the policy as one graph."""
    return graph_of(toy_grasp.robot(), toy_grasp.brick(), value=0.01)


def graph_of(robot, *objects, value):
    """Return the network of a policy of a robot, with one value for all weights, and the policy as one graph."""
    trained = asdict(policy_contract(robot, TASK, tuple(obj.name for obj in objects)))
    with tempfile.TemporaryDirectory() as folder:
        network = write_policy(Path(folder) / "toy.onnx", trained, value=value).read_bytes()
    return network, deployed_graph(network, robot, TASK, objects)


def write_policy(
    path,
    contract,
    *,
    lstm=8,
    actions=None,
    outputs=3,
    value=0.5,
    state="Identity",
    metadata=None,
    version="",
):
    """Write it; without options it is sound.

    Args:
        path: file.
        contract: says how wide its inputs and actions are.
        lstm: units.
        actions: how many it gives, if not those of the contract.
        outputs: how many of the three it has.
        value: of every weight.
        state: ONNX operator that makes the LSTM's new state from the old one.
        metadata: in place of the contract: text, or a dictionary.
        version: of xreset, which exported it.
    """
    policy, proprio, cloud = observation_shapes(parsed_contract("it", contract), "it").values()
    flat = policy[0] + proprio[0]
    shapes = {
        "flat": ["n", flat],
        "cloud": ["n", *cloud],
        "h_in": [1, "n", lstm],
        "c_in": [1, "n", lstm],
    }
    inputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)
        for name, shape in shapes.items()
    ]
    given = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, None)
        for name in ("actions", "h_out", "c_out")[:outputs]
    ]
    width = len(contract["joint_names"]) if actions is None else actions
    weights = numpy_helper.from_array(np.full((flat, width), value, dtype=np.float32), "w")
    nodes = [
        helper.make_node("MatMul", ["flat", "w"], ["actions"]),
        helper.make_node(state, ["h_in"], ["h_out"]),
        helper.make_node(state, ["c_in"], ["c_out"]),
    ]
    graph = helper.make_graph(nodes, "policy", inputs, given, [weights])
    model = helper.make_model(graph, ir_version=9, opset_imports=[helper.make_opsetid("", 18)])
    text = metadata if isinstance(metadata, str) else json.dumps(metadata or contract)
    helper.set_model_props(model, {"xreset": text, "xreset-version": version})
    path.write_bytes(model.SerializeToString())
    return path
