"""Write a policy with its contract and the runtime, for computers without xreset."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from xreset.errors import PolicyError
from xreset.files.storage import atomic_folder, code_version, is_occupied, write_json
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.urdf import robot_tree
from xreset.objects.sampling import center, surface_points
from xreset.policy.onnx_policy import policy_contract
from xreset.runtime import check_contract
from xreset.runtime import contract as files
from xreset.spec import MimicSpec, ObjectSpec, RobotSpec
from xreset.task.actions import ActionSpace
from xreset.task.config import ObservationConfig, TaskConfig
from xreset.task.legacy import ObservationOptions

FRAMES = {
    "world": "z up; the top of the table is at z = 0; the root link of the robot is at kinematics.base",
    "object": "the frame of its mesh; its points are in this frame",
    "quaternion": "w, x, y, z",
    "tip_force": "force of a fingertip on the object, along the axes of the world",
}
UNITS = {
    "position": "m",
    "revolute joint": "rad",
    "prismatic joint": "m",
    "time": "s",
    "force": "N",
    "angular velocity": "rad/s",
}


def deploy_contract(
    robot: RobotSpec, task: TaskConfig, objects: Sequence[ObjectSpec], policy: bytes | None = None
) -> dict[str, Any]:
    """Return everything that :mod:`xreset.runtime` needs to know about a policy, as JSON.

    Args:
        robot: robot of the policy.
        task: task of the policy's training.
        objects: objects whose points the contract lists.
        policy: content of the exported policy, whose hash the contract states; None: the contract stays in this
            process.

    Raises:
        PolicyError: the policy has cameras, or observes something that the runtime cannot compute.
        LiveError: the task has options that the runtime does not support.
    """
    if task.vision.cameras:
        raise PolicyError(
            "The policy has cameras, which the runtime does not support. Use a policy without cameras."
        )
    trained = policy_contract(robot, task, tuple(o.name for o in objects))
    listed = {}
    for each in objects:
        points = surface_points(each, task.observation.cloud_points)
        listed[each.name] = {
            "source": each.source,
            "points": points.astype(np.float32).tolist(),
            "center": center(each).astype(np.float32).tolist(),
        }
    contract = {
        "schema": files.SCHEMA,
        "xreset": code_version(),
        "policy_sha256": hashlib.sha256(policy).hexdigest() if policy else "",
        "robot": robot.name,
        "robot_fingerprint": robot.fingerprint,
        "control_dt": trained.control_dt,
        "rate": 1.0 / trained.control_dt,
        "frames": FRAMES,
        "units": UNITS,
        "joints": _joints(robot, task),
        "fingertips": list(robot.fingertip_names),
        "observation": _observation_options(task.observation),
        "observation_layout": trained.observation_layout,
        "action": asdict(task.action),
        "kinematics": _chain(robot),
        "object_frame": task.object_frame,
        "objects": listed,
    }
    check_contract(contract, f"The task of {robot.name}")
    return contract | {files.DIGEST: files.digest(contract)}


def _observation_options(c: ObservationConfig) -> dict[str, Any]:
    """Return the options of :mod:`xreset.runtime` that mean these observations."""
    (cloud,) = c.perception.values()
    given = {
        "cloud_points": c.cloud_points,
        "cloud_history": cloud.get("frames", 5),
        "cloud_scale": cloud["scale"],
        "contact_force_scale": c.proprio.get("tip_force", {}).get("scale", 0.1),
        "joint_vel_scale": c.proprio.get("joint_vel", {}).get("scale", 0.1),
    }
    wanted = _flat_terms(c)
    for content, rotation, form, joint_target in product(
        ("draft", "published"),
        ("quaternion", "matrix", "to_goal"),
        ("history", "paired"),
        (False, True),
    ):
        options = ObservationOptions(
            content=content, rotation=rotation, cloud=form, joint_target=joint_target, **given
        )
        if _flat_terms(ObservationConfig(**options.entries())) == wanted:
            found = asdict(options)
            del found["noise"]
            return found
    raise PolicyError(
        "The policy observes terms that the runtime cannot compute. Use the observations of a recipe."
    )


def _flat_terms(c: ObservationConfig) -> list[tuple[str, dict[str, Any]]]:
    """Return what a policy without cameras observes, in order."""
    quiet = c.without_noise()
    return [*quiet.policy.items(), *quiet.proprio.items(), *quiet.perception.items()]


def _joints(robot: RobotSpec, task: TaskConfig) -> list[dict[str, Any]]:
    """Return name, limits and action mapping of every joint, in joint order."""
    space = ActionSpace(robot, task.action)
    tree = robot_tree(robot)
    rows = []
    for i, joint in enumerate(robot.joints):
        in_tree = tree.joint(joint.name)
        row: dict[str, Any] = {
            "name": joint.name,
            "group": joint.group,
            "type": in_tree.type,
            "velocity": in_tree.velocity,
            "home": joint.home,
        }
        for name in ("lower", "upper", "step", "lead", "zero", "below", "above"):
            row[name] = float(getattr(space, name)[i])
        for name, value in row.items():
            if value in (-math.inf, math.inf):
                row[name] = None  # JSON has no infinite numbers
        rows.append(row)
    return rows


def _chain(robot: RobotSpec) -> dict[str, Any]:
    """Return the joints from the root to the palm and the fingertips, each after its parent."""
    tree = robot_tree(robot)
    mimics = {mimic.joint: mimic for mimic in robot.mimics}
    index = {tree.root: 0}
    steps = []
    for joint in tree.joints:
        if set(robot.tracked_links).isdisjoint(tree.below(joint.child)):
            continue
        index[joint.child] = len(index)
        # A joint without a source follows itself, with multiplier 1 and offset 0.
        mimic = mimics.get(joint.name, MimicSpec(joint=joint.name, source=joint.name))
        step = {
            "link": joint.child,
            "parent": index[joint.parent],
            "type": joint.type,
            "joint": None if joint.type == "fixed" else robot.joint_names.index(mimic.source),
            "multiplier": mimic.multiplier,
            "offset": mimic.offset,
            "origin": joint.T_parent_joint.tolist(),
            "axis": np.asarray(joint.axis, dtype=float).tolist(),
        }
        steps.append(step)
    tracked = [index[name] for name in robot.tracked_links]
    base = Kinematics(robot).base.to(torch.float64).tolist()
    return {"base": base, "palm": tracked[0], "tips": tracked[1:], "steps": steps}


def write_deployed(policy: bytes, contract: dict[str, Any], out: Path) -> None:
    """Write ``policy.onnx``, ``contract.json`` and the package ``runtime`` into a new folder.

    Args:
        policy: content of the exported policy (.onnx).
        contract: what :func:`deploy_contract` returns for it.
        out: folder to write; must not exist, or be empty.

    Raises:
        PolicyError: the folder is not empty.
    """
    if is_occupied(out):
        raise PolicyError(f"{out} exists already. Choose another folder, or remove it.")
    with atomic_folder(out) as folder:
        (folder / files.POLICY).write_bytes(policy)
        runtime = folder / "runtime"
        runtime.mkdir()
        for module in Path(files.__file__).parent.glob("*.py"):
            (runtime / module.name).write_bytes(module.read_bytes())
        write_json(folder / files.CONTRACT, contract)
