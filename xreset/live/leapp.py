"""A deployed policy in LEAPP, the format in which Isaac Lab deploys policies: a YAML file next to the graph.

LEAPP (0.7, configuration 1.3) lists models with their inputs and outputs, and how values flow between them and from one
step to the next. Feedback starts with zeros unless a file states other values, as the graph's memory does.
"""

from __future__ import annotations

import hashlib
from typing import Any

import yaml

from xreset.files.storage import code_version
from xreset.runtime import Controller
from xreset.runtime.contract import POLICY

FILE = "leapp.yaml"
_CONFIG = "1.3"
_NODE = "policy"
_KINDS = {
    "joint_pos": "state/joint/position",
    "joint_vel": "state/joint/velocity",
    "joint_target": "command/joint/position",
    "object_pos": "state/body/position",
    "object_quat": "state/body/rotation",
    "tip_force": "state/vector3d",
    "goal_quat": "command/body/rotation",
    "target": "target/joint/position",
}
"""LEAPP's kinds of inputs and outputs. It has none for points, for a goal's position, and for a memory."""


def leapp_description(graph: bytes) -> str:
    """Return the YAML file of a deployed policy, given its content."""
    controller = Controller(graph)
    contract = controller.contract
    joints = [joint["name"] for joint in contract["joints"]]
    observed = controller.observations
    shapes = {
        "target": (len(joints),),
        "memory_out": controller.shapes.get("memory_in", ()),
        "links": (len(contract.get("links", ())), 3),
        "observations": () if observed is None else observed.shape[1:],
    }
    outputs = {name: shapes[name] for name in controller.outputs if name in shapes}
    feedback = {f"{_NODE}/memory_out": [f"{_NODE}/memory_in"]} if "memory_out" in outputs else {}

    def described(name: str, shape: tuple[int, ...]) -> dict[str, Any]:
        entry: dict[str, Any] = {
            "name": name,
            "dtype": "float32",
            "shape": [1, *shape],
            "type": "tensor",
        }
        if name in _KINDS:
            entry["kind"] = _KINDS[name]
        if shape == (len(joints),):
            entry["element_names"] = [["robot"], joints]
        return entry

    given = [name for name in controller.shapes if name != "memory_in"]
    kept = [name for name in outputs if name != "memory_out"]
    description = {
        "models": {
            _NODE: {
                "inputs": [described(*each) for each in controller.shapes.items()],
                "outputs": [described(*each) for each in outputs.items()],
                "parameters": {
                    "model_path": POLICY,
                    "md5sum": hashlib.md5(graph, usedforsecurity=False).hexdigest(),
                    "sha256sum": hashlib.sha256(graph).hexdigest(),
                    "backend": "onnx",
                },
            }
        },
        "pipeline": {
            "data_flow": {},
            "feedback_flow": feedback,
            "inputs": {_NODE: given},
            "outputs": {_NODE: kept},
        },
        "system information": {"leapp config version": _CONFIG, "xreset": code_version()},
    }
    return yaml.safe_dump(description, sort_keys=False)
