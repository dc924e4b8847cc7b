"""Write a policy for a robot: one ONNX graph with its contract, and the runtime, for computers without xreset."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from xreset import runtime
from xreset.errors import PolicyError, needs
from xreset.files.storage import atomic_folder, code_version
from xreset.geometry.urdf import robot_tree
from xreset.live import leapp
from xreset.objects.sampling import center, surface_normals, surface_points
from xreset.policy.onnx_policy import (
    METADATA_KEY,
    VERSION_KEY,
    contract_metadata,
    of_another_robot,
    parsed_contract,
    policy_contract,
)
from xreset.runtime import Controller
from xreset.runtime.contract import KEY, POLICY, SCHEMA, check_contract
from xreset.spec import ObjectSpec, RobotSpec, first_difference
from xreset.task.config import EVALUATION_TIMESTEP, ActionConfig, TaskConfig
from xreset.task.contract import SCHEMA as TRAINED
from xreset.task.contract import Contract

if TYPE_CHECKING:
    from torch import nn

_ANY = 10.0
"""A move of a target in one step that no joint makes [rad]."""
FRAMES = {
    "world": "z up; the top of the table is at z = 0; the root link of the robot is at base_pos, base_quat",
    "object": "the frame of its mesh; its points and its center are in this frame",
    "quaternion": "w, x, y, z",
}
MEANINGS = {
    "joint_pos": "joint positions, in the order of joints [rad, m]",
    "joint_vel": "joint velocities [rad/s, m/s]",
    "joint_target": "joint targets of the last step; in the first step those that the drives have [rad, m]",
    "object_pos": "origin of the object's mesh frame, world [m]",
    "object_quat": "orientation of the object, world",
    "tip_force": "force of each fingertip on the object, along the axes of the world [N]; zeros if unknown",
    "goal_pos": "goal position of the object's mesh frame, world [m]",
    "goal_quat": "goal orientation, world",
    "object_points": "points on the object's surface, in its frame [m]: an entry of objects",
    "object_normals": "outward unit normals of the surface at these points: an entry of objects",
    "object_center": "center of the object, in its frame [m]: an entry of objects",
    "memory_in": "zeros in the first step, then memory_out of the step before",
    "target": "joint targets for position drives, within the joints' limits [rad, m]",
    "memory_out": "memory_in of the next step",
    "links": "positions of the links, world [m]: palm, then fingertips",
    "observations": "what the network was told, without the points: to look at, not needed for control",
}
"""Meaning of every input and output that a graph may have."""


def deploy_contract(
    robot: RobotSpec, task: TaskConfig, objects: Sequence[ObjectSpec] = ()
) -> dict[str, Any]:
    """Return the contract of a deployed policy, as JSON.

    Args:
        robot: robot of the policy.
        task: task of the policy's training.
        objects: objects whose points the contract lists.
    """
    contract = {
        "schema": SCHEMA,
        "xreset": code_version(),
        "robot": robot.name,
        "robot_fingerprint": robot.fingerprint,
        "base_pos": list(robot.base_pos),
        "base_quat": list(robot.base_quat),
        "control_dt": task.control_dt,
        "frames": FRAMES,
        "values": MEANINGS,
        "joints": _joints(robot, task),
        "fingertips": list(robot.fingertip_names),
        "links": list(robot.tracked_links),
        "objects": _listed(objects, task.observation.cloud_points),
    }
    check_contract(contract, f"The task of {robot.name}")
    return contract


def _listed(objects: Sequence[ObjectSpec], cloud_points: int) -> dict[str, Any]:
    """Return what a policy takes of objects, by name, as JSON."""
    listed = {}
    for each in objects:
        rows = {name: value.tolist() for name, value in known_of(each, cloud_points).items()}
        listed[each.name] = {"source": each.source, **rows}
    return listed


def known_of(obj: ObjectSpec, cloud_points: int) -> dict[str, np.ndarray]:
    """Return what a policy takes of an object: points [P, 3], the normals there [P, 3] and the center [3], in its frame
    and in single precision."""
    known = {
        "points": surface_points(obj, cloud_points),
        "normals": surface_normals(obj, cloud_points),
        "center": center(obj),
    }
    return {name: value.astype(np.float32) for name, value in known.items()}


def _joints(robot: RobotSpec, task: TaskConfig) -> list[dict[str, Any]]:
    """Return name, limits and step of every joint, in joint order."""
    from xreset.task.actions import ActionSpace

    space = ActionSpace(robot, task.action)
    tree = robot_tree(robot)
    rows = []
    for i, joint in enumerate(robot.joints):
        in_tree = tree.joint(joint.name)
        is_continuous = in_tree.type == "revolute" and math.isinf(in_tree.upper - in_tree.lower)
        row: dict[str, Any] = {
            "name": joint.name,
            "group": joint.group,
            "type": "continuous" if is_continuous else in_tree.type,
            "velocity": in_tree.velocity,
            "home": joint.home,
        }
        for name in ("lower", "upper", "step"):
            row[name] = float(getattr(space, name)[i])
        for name, value in row.items():
            if value in (-math.inf, math.inf):
                row[name] = None  # JSON has no infinite numbers
        rows.append(row)
    return rows


def deployed_graph(
    network: bytes | nn.Module,
    robot: RobotSpec,
    task: TaskConfig,
    objects: Sequence[ObjectSpec] = (),
) -> bytes:
    """Return the content of a deployed policy: one ONNX graph from readings to joint targets.

    Args:
        network: an exported policy's content (.onnx); or a module of any learner, from the flat observations [N, D] and
            the clouds [N, H, P, K] of the task to actions [N, J] in [-1, 1].
        robot: robot of the policy.
        task: task of the policy's training.
        objects: objects whose points the contract lists.

    Raises:
        PolicyError: the policy has cameras, it observes something that no robot measures, or onnx is missing.
    """
    import onnx

    from xreset.live.cache import cached_graph
    from xreset.live.graph import policy_graph

    if isinstance(network, bytes):
        model = cached_graph(network, robot, task)
    else:
        model = policy_graph(network, robot, task)
    trained = policy_contract(robot, task, tuple(o.name for o in objects))
    entries = {KEY: json.dumps(deploy_contract(robot, task, objects)), **contract_metadata(trained)}
    onnx.helper.set_model_props(model, entries)
    return model.SerializeToString()


def check_made_for(source: str, contract: Contract, robot: RobotSpec) -> None:
    """Refuse to play a deployed policy on another robot, whose kinematics its graph does not have.

    Args:
        source: name of the policy in messages.
        contract: as of :func:`training_of`.
        robot: the robot that shall play it.

    Raises:
        PolicyError: the robot has other joints, or another description than the policy states.
    """
    differs = first_difference(contract.joint_names, robot.joint_names)
    stated = contract.robot_fingerprint
    if not differs and stated not in ("", robot.like) and not robot.has_fingerprint(stated):
        differs = "its URDF, a mesh or robot.toml has changed"
    if differs and contract.robot != robot.name:
        raise of_another_robot(source, contract.robot, robot.name)
    if differs:
        raise PolicyError(
            f"{source} is a policy of another version of {robot.name!r}: {differs}. Export the policy again, or use "
            "the robot's former version."
        )


def with_objects(graph: bytes, objects: Sequence[ObjectSpec]) -> bytes:
    """Return a deployed policy whose contract lists other objects. It needs no torch."""
    controller = Controller(graph)
    points = controller.shapes.get("object_points", (1, 3))[0]
    listed = _listed(objects, points)
    contract = {**controller.contract, "xreset": code_version(), "objects": listed}
    return with_metadata(graph, {KEY: json.dumps(contract)})


def with_metadata(graph: bytes, entries: dict[str, str]) -> bytes:
    """Return a graph with other entries of its metadata; the others stay."""
    with needs("onnx", "deploy", PolicyError):
        import onnx
    model = onnx.load_from_string(graph)
    stated = {entry.key: entry.value for entry in model.metadata_props}
    onnx.helper.set_model_props(model, stated | entries)
    return model.SerializeToString()


def is_deployed(content: bytes) -> bool:
    """Return whether the content of an ONNX file is a deployed policy, and not only its network."""
    return KEY.encode() in content


def training_of(controller: Controller, source: str) -> Contract:
    """Return the contract of a deployed policy's training, with the objects whose points the policy lists, if any.

    A policy that was not trained by xreset states none. Its task has the policy's rate, and actions that reach every
    target; nobody states what its observations are called.

    Args:
        controller: the policy.
        source: its name in messages.

    Raises:
        PolicyError: the stated contract is damaged.
    """
    stated = controller.contract
    listed = tuple(stated.get("objects", ()))
    trained = controller.metadata.get(METADATA_KEY)
    if trained is not None:
        version = controller.metadata.get(VERSION_KEY)
        contract = parsed_contract(source, json.loads(trained), version)
        return replace(contract, objects=listed or contract.objects)
    substeps = max(1, round(controller.dt / EVALUATION_TIMESTEP))
    action = ActionConfig(
        arm_step=_ANY, arm_lead=_ANY, hand="relative", hand_step=_ANY, hand_lead=_ANY
    )
    return Contract(
        schema=TRAINED,
        robot=stated["robot"],
        robot_fingerprint=str(stated.get("robot_fingerprint", "")),
        joint_names=tuple(joint["name"] for joint in stated["joints"]),
        fingertip_names=tuple(stated.get("fingertips", ())),
        objects=listed,
        observation_layout={},
        control_dt=controller.dt,
        task=TaskConfig(action=action, timestep=controller.dt / substeps, substeps=substeps),
    )


def write_deployed(graph: bytes, out: Path) -> None:
    """Write ``policy.onnx``, ``leapp.yaml`` and the package ``runtime`` into a new folder.

    Args:
        graph: what :func:`deployed_graph` returns.
        out: folder to write; must not exist, or be empty.

    Raises:
        XResetError: the folder is not empty.
    """
    with atomic_folder(out) as folder:
        (folder / POLICY).write_bytes(graph)
        (folder / leapp.FILE).write_text(leapp.leapp_description(graph))
        package = folder / "runtime"
        package.mkdir()
        for module in Path(runtime.__file__).parent.glob("*.py"):
            (package / module.name).write_bytes(module.read_bytes())
