"""The contract of an exported policy: what goes in and out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

try:
    from xreset.errors import XResetError
except ImportError:  # a deployed policy runs without xreset
    XResetError = Exception  # pyright: ignore

SCHEMA = "xreset-deploy/1"
CONTRACT = "contract.json"
DIGEST = "contract_sha256"
"""Entry with the hash of the others; contracts of xreset 0.2 have none."""
POLICY = "policy.onnx"


class LiveError(XResetError):  # pyright: ignore
    """A deployed policy cannot be read, or cannot act."""


_KNOWN = {
    "observation": {
        "cloud_points", "cloud", "cloud_history", "rotation", "cloud_scale", "contact_force_scale", "joint_target",
        "joint_vel_scale", "content",
    },
    "action": {"arm_step", "arm_lead", "hand", "hand_step", "hand_lead", "hand_zero"},
}  # fmt: skip
"""Options of observations and actions that this package supports."""


_ENTRIES = {
    "policy_sha256": str,
    "control_dt": (int, float),
    "joints": list,
    "fingertips": list,
    "observation": dict,
    "action": dict,
    "kinematics": dict,
    "object_frame": str,
    "objects": dict,
}
"""Entries that this package reads, and their types."""
_OPTIONS = {
    "cloud": ("history", "paired"),
    "rotation": ("quaternion", "matrix", "to_goal"),
    "content": ("draft", "published"),
    "joint_target": (False, True),
    "cloud_points": (1, 100_000),
    "cloud_history": (1, 1000),
    "cloud_scale": (0.0, 1e3),
    "contact_force_scale": (0.0, 1e3),
    "joint_vel_scale": (0.0, 1e3),
}
"""Values of the observation's options: texts and truths to choose from, or the least and the largest number."""
_JOINT = {"home": 100.0, "step": 0.5, "lead": 2.0, "zero": 100.0, "below": 100.0, "above": 100.0}
"""Numbers of a joint, and the largest size of each [rad, m]."""
_SIGNED = {"home", "zero"}
"""Numbers of a joint that may be negative."""
_FARTHEST = 100.0
"""Largest coordinate [m], and largest factor and offset of a coupled joint."""
_RIGID = 1e-3
"""How far a rotation matrix may be from one."""


def check_contract(contract: dict[str, Any], source: str) -> None:
    """Raise ``LiveError`` for a contract of another schema, without an entry that this package reads, or with options
    that it does not support."""
    if not isinstance(contract, dict):
        contract = {}
    problem = ""
    for part, known in _KNOWN.items():
        options = contract.get(part)
        if isinstance(options, dict) and (unknown := sorted(set(options) - known)):
            problem = (
                f"needs {part} options that this runtime does not know: {', '.join(unknown)[:200]}"
            )
    if missing := [
        name for name, kind in _ENTRIES.items() if not isinstance(contract.get(name), kind)
    ]:
        problem = f"lacks {', '.join(missing)}, or has another type there"
    if contract.get("schema") != SCHEMA:
        problem = f"has schema {str(contract.get('schema'))[:60]!r}, this runtime reads {SCHEMA!r}"
    if not problem:
        wrong = next(_wrong_values(contract), None)
        if wrong is not None:
            name, value, expected = wrong
            problem = f"has {name} {str(value)[:60]}, expected {expected}"
    if problem:
        raise LiveError(
            f"{source} {problem}. Export the policy again and use the runtime of the same folder."
        )


def _wrong_values(contract: dict[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """Yield name, value and expectation of the entries with which a robot must not move."""
    yield from _outside("control_dt", contract["control_dt"], 1e-3, 1.0)
    for name, choices in _OPTIONS.items():
        value = contract["observation"].get(name)
        label = f"observation.{name}"
        if type(choices[0]) in (int, float):
            yield from _outside(label, value, *choices)
        elif value not in choices or type(value) is not type(choices[0]):
            yield label, value, f"one of {', '.join(map(str, choices))}"
    for name, choices in (("hand", ("absolute", "relative")), ("object_frame", ("mesh", "center"))):
        value = contract["action"].get(name) if name == "hand" else contract[name]
        if value not in choices:
            yield name, value, f"one of {', '.join(choices)}"
    if not contract["joints"]:
        yield "joints", [], "joints"
    for i, joint in enumerate(contract["joints"]):
        yield from _wrong_in_joint(f"joints[{i}]", joint)
    yield from _wrong_in_chain(contract)
    shapes = {"points": (contract["observation"]["cloud_points"], 3), "center": (3,)}
    for name, entry in contract["objects"].items():
        for part, shape in shapes.items():
            value = entry.get(part) if isinstance(entry, dict) else None
            if _array(value, shape) is None:
                yield f"objects.{name[:60]}.{part}", value, f"coordinates of shape {shape}"


def _wrong_in_joint(name: str, joint: Any) -> Iterator[tuple[str, Any, str]]:
    if not isinstance(joint, dict):
        yield name, joint, "an object"
        return
    if not isinstance(joint.get("name"), str):
        yield f"{name}.name", joint.get("name"), "a text"
    if joint.get("group") not in ("arm", "hand"):
        yield f"{name}.group", joint.get("group"), "arm or hand"
    for entry, most in _JOINT.items():
        least = -most if entry in _SIGNED else 0.0
        yield from _outside(f"{name}.{entry}", joint.get(entry), least, most)
    lower: Any = joint.get("lower")
    upper: Any = joint.get("upper")
    if joint.get("type") == "continuous" and lower is None and upper is None:
        return
    for entry, limit in (("lower", lower), ("upper", upper)):
        yield from _outside(f"{name}.{entry}", limit, -_FARTHEST, _FARTHEST)
    if lower >= upper:
        yield f"{name}.upper", upper, f"a number above {lower}"


def _wrong_in_chain(contract: dict[str, Any]) -> Iterator[tuple[str, Any, str]]:
    chain = contract["kinematics"]
    steps = chain.get("steps")
    if not _is_rigid(chain.get("base")):
        yield "kinematics.base", chain.get("base"), "a rigid transform"
    if not isinstance(steps, list):
        yield "kinematics.steps", steps, "a list"
        return
    for i, step in enumerate(steps):
        name = f"kinematics.steps[{i}]"
        if not isinstance(step, dict):
            yield name, step, "an object"
            return
        if not _is_index(step.get("parent"), i + 1):
            yield f"{name}.parent", step.get("parent"), "an earlier link"
        if not _is_rigid(step.get("origin")):
            yield f"{name}.origin", step.get("origin"), "a rigid transform"
        for entry in ("multiplier", "offset"):
            yield from _outside(f"{name}.{entry}", step.get(entry), -_FARTHEST, _FARTHEST)
        axis = _array(step.get("axis"), (3,))
        kind = step.get("type")
        is_fixed = kind == "fixed"
        if kind not in ("fixed", "revolute", "continuous", "prismatic"):
            yield f"{name}.type", kind, "a type of joint"
        if axis is None or not (is_fixed or abs(np.linalg.norm(axis) - 1.0) <= _RIGID):
            yield f"{name}.axis", step.get("axis"), "a direction of length 1"
        joint = step.get("joint")
        is_known = joint is None if is_fixed else _is_index(joint, len(contract["joints"]))
        if not is_known:
            yield f"{name}.joint", joint, "null for a fixed link, or else the index of a joint"
    tips = chain.get("tips")
    if not _is_index(chain.get("palm"), len(steps) + 1):
        yield "kinematics.palm", chain.get("palm"), "the index of a link"
    if not isinstance(tips, list) or len(tips) != len(contract["fingertips"]):
        yield "kinematics.tips", tips, "a link for each fingertip"
    elif not all(_is_index(tip, len(steps) + 1) for tip in tips):
        yield "kinematics.tips", tips, "indices of links"


def _outside(name: str, value: Any, least: float, most: float) -> Iterator[tuple[str, Any, str]]:
    """Yield a value that is no number of its kind, or outside its range."""
    kinds = (int,) if isinstance(most, int) else (int, float)
    if type(value) not in kinds or not least <= value <= most:
        yield name, value, f"a number from {least:g} to {most:g}"


def _is_index(value: Any, count: int) -> bool:
    return type(value) is int and 0 <= value < count


def _array(value: Any, shape: tuple[int, ...]) -> np.ndarray | None:
    """Return coordinates as an array; None if there is a wrong number, or a wrong number of them."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if array.shape != shape or not (np.abs(array) <= _FARTHEST).all():
        return None
    return array


def _is_rigid(value: Any) -> bool:
    """Return whether a value is a matrix [4, 4] that turns and moves, and does nothing else."""
    matrix = _array(value, (4, 4))
    if matrix is None or not np.array_equal(matrix[3], [0, 0, 0, 1]):
        return False
    rotation = matrix[:3, :3]
    is_orthogonal = np.abs(rotation @ rotation.T - np.eye(3)).max() <= _RIGID
    return bool(is_orthogonal and np.linalg.det(rotation) > 0)


def digest(contract: dict[str, Any]) -> str:
    """Return the SHA-256 of a contract without its own entry :data:`DIGEST`."""
    rest = {name: value for name, value in contract.items() if name != DIGEST}
    try:
        text = json.dumps(rest, sort_keys=True)
    except RecursionError:  # newer versions of Python read deeper nesting than they write
        return "nested too deeply"
    return hashlib.sha256(text.encode()).hexdigest()


def read_contract(folder: str | Path) -> dict[str, Any]:
    """Read the contract of a folder that ``xreset export deploy`` wrote.

    Raises:
        LiveError: the folder is incomplete or of another version, or its policy's hash is not the contract's.
    """
    contract, content = read_exported(folder)
    check_contract(contract, str(Path(folder) / CONTRACT))
    check_hash(folder, contract, content)
    return contract


def read_exported(folder: str | Path) -> tuple[Any, bytes]:
    """Return what is in the contract's file, not checked yet, and the content of the policy's file."""
    try:
        folder = Path(folder)
        return json.loads((folder / CONTRACT).read_text()), (folder / POLICY).read_bytes()
    except (OSError, TypeError, ValueError, RecursionError) as error:
        raise LiveError(
            f"{folder} is not an exported policy ({error}). Make one: xreset export deploy"
        ) from error


def check_hash(folder: str | Path, contract: dict[str, Any], content: bytes) -> None:
    """Raise ``LiveError`` if the contract was changed, or the content of the policy's file is not the one that it was
    written for."""
    found = hashlib.sha256(content).hexdigest()
    if found != contract["policy_sha256"]:
        raise LiveError(
            f"{Path(folder) / POLICY} has SHA-256 {found[:12]}, the contract names {contract['policy_sha256'][:12]}. "
            "Export the policy again."
        )
    if contract.get(DIGEST, digest(contract)) != digest(contract):
        raise LiveError(
            f"{Path(folder) / CONTRACT} was changed after its export. Export the policy again."
        )
