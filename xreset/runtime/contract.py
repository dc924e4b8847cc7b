"""The contract of a deployed policy: what its ONNX graph takes and gives, in the graph's metadata."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

try:
    from xreset.errors import XResetError
except ImportError:  # a deployed policy runs without xreset
    XResetError = Exception  # pyright: ignore

SCHEMA = "xreset-deploy/2"
KEY = "xreset-deploy"
"""Key of the metadata entry that holds the contract as JSON."""
POLICY = "policy.onnx"
OLD_CONTRACT = "contract.json"
"""File of a folder of xreset 0.3 or earlier."""


class LiveError(XResetError):  # pyright: ignore
    """A deployed policy cannot be read, or cannot act."""


_FARTHEST = 100.0
"""Largest limit of a joint and coordinate of an object [rad, m]."""
_SLOWEST = 1e-3
_FASTEST = 1e3
"""Smallest and largest speed limit of a joint [rad/s, m/s]."""
_LARGEST_STEP = 0.5
"""Largest move of a relative target in a control step [rad, m]."""


def read_graph(policy: str | Path) -> bytes:
    """Return the content of a deployed policy.

    Args:
        policy: the file, or the folder that ``xreset export deploy`` wrote.

    Raises:
        LiveError: there is none, or the folder is of xreset 0.3 or earlier.
    """
    try:
        path = Path(policy)
        if path.is_dir():
            if (path / OLD_CONTRACT).exists():
                raise LiveError(
                    f"{path} is of xreset 0.3 or earlier. Use the runtime in this folder, or write a new one: "
                    f"xreset export deploy {path / POLICY} --out FOLDER"
                )
            path = path / POLICY
        return path.read_bytes()
    except (OSError, TypeError, ValueError) as error:
        raise LiveError(
            f"{policy} is not an exported policy ({error}). Make one: xreset export deploy"
        ) from error


def parse_contract(metadata: dict[str, str], source: str) -> dict[str, Any]:
    """Return the contract in a graph's metadata.

    Raises:
        LiveError: there is none, it has another schema, or a robot must not follow it.
    """
    if KEY not in metadata:
        raise LiveError(
            f"{source} has no metadata entry {KEY!r}: it is not a deployed policy. Make one: xreset export deploy"
        )
    try:
        contract = json.loads(metadata[KEY])
    except (ValueError, RecursionError) as error:
        raise LiveError(
            f"{source} has a contract that is not JSON ({error}). Export it again."
        ) from error
    check_contract(contract, source)
    return contract


def check_contract(contract: Any, source: str) -> None:
    """Raise ``LiveError`` for a contract of another schema, or one that a robot must not follow."""
    if not isinstance(contract, dict) or contract.get("schema") != SCHEMA:
        found = contract.get("schema") if isinstance(contract, dict) else None
        raise LiveError(
            f"{source} has schema {str(found)[:60]!r}, this runtime reads {SCHEMA!r}. Export the policy again, and "
            "use the runtime of the same folder."
        )
    wrong = next(_wrong_values(contract), None)
    if wrong is not None:
        name, value, expected = wrong
        raise LiveError(
            f"{source} has {name} {str(value)[:60]}, expected {expected}. Export the policy again."
        )


def _wrong_values(contract: dict[str, Any]) -> Iterator[tuple[str, Any, str]]:
    """Yield name, value and expectation of the entries with which a robot must not move."""
    yield from _outside("control_dt", contract.get("control_dt"), 1e-3, 1.0)
    if not isinstance(contract.get("robot"), str):
        yield "robot", contract.get("robot"), "a name"
    joints = contract.get("joints")
    if not isinstance(joints, list) or not joints:
        yield "joints", joints, "a list of joints"
        return
    for i, joint in enumerate(joints):
        yield from _wrong_in_joint(f"joints[{i}]", joint)
    for name in ("fingertips", "links"):
        listed = contract.get(name, [])
        if not isinstance(listed, list) or not all(isinstance(each, str) for each in listed):
            yield name, listed, "a list of names"
    objects = contract.get("objects", {})
    if not isinstance(objects, dict):
        yield "objects", objects, "an object"
        return
    for name, entry in objects.items():
        for part, dimensions in (("points", 2), ("normals", 2), ("center", 1)):
            value = entry.get(part) if isinstance(entry, dict) else None
            if part == "normals" and value is None:
                continue  # policies of xreset 0.3 have none
            if not _is_coordinates(value, dimensions):
                yield f"objects.{name[:60]}.{part}", value, "coordinates in metres"


def _wrong_in_joint(name: str, joint: Any) -> Iterator[tuple[str, Any, str]]:
    if not isinstance(joint, dict):
        yield name, joint, "an object"
        return
    if not isinstance(joint.get("name"), str):
        yield f"{name}.name", joint.get("name"), "a text"
    yield from _outside(f"{name}.home", joint.get("home"), -_FARTHEST, _FARTHEST)
    yield from _outside(f"{name}.step", joint.get("step", 0.0), 0.0, _LARGEST_STEP)
    if joint.get("velocity") is not None:
        yield from _outside(f"{name}.velocity", joint["velocity"], _SLOWEST, _FASTEST)
    lower: Any = joint.get("lower")
    upper: Any = joint.get("upper")
    if joint.get("type") == "continuous" and lower is None and upper is None:
        return
    for entry, limit in (("lower", lower), ("upper", upper)):
        yield from _outside(f"{name}.{entry}", limit, -_FARTHEST, _FARTHEST)
    if lower >= upper:
        yield f"{name}.upper", upper, f"a number above {lower}"


def _outside(name: str, value: Any, least: float, most: float) -> Iterator[tuple[str, Any, str]]:
    """Yield a value that is no number, or outside its range."""
    if type(value) not in (int, float) or not least <= value <= most:
        yield name, value, f"a number from {least:g} to {most:g}"


def _is_coordinates(value: Any, dimensions: int) -> bool:
    """Return whether a value is a position, or a list of positions, that no unit but metres explains."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return False
    has_shape = array.ndim == dimensions and array.shape[-1] == 3
    return has_shape and bool((np.abs(array) <= _FARTHEST).all())


def joint_values(contract: dict[str, Any], name: str, otherwise: float) -> np.ndarray:
    """[J] a number of every joint; ``otherwise`` where the contract has none."""
    values = [joint.get(name) for joint in contract["joints"]]
    filled = [otherwise if value is None else value for value in values]
    return np.array(filled, dtype=np.float32)
