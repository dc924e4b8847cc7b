"""The contract of an exported policy: what goes in and out."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

try:
    from xreset.errors import XResetError
except ImportError:  # a deployed policy runs without xreset
    XResetError = Exception  # pyright: ignore

SCHEMA = "xreset-deploy/1"
CONTRACT = "contract.json"
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


def check_contract(contract: dict[str, Any], source: str) -> None:
    """Raise ``LiveError`` for a contract of another schema, without an entry that this package reads, or with options
    that it does not support."""
    if not isinstance(contract, dict):
        contract = {}
    problem = ""
    for part, known in _KNOWN.items():
        options = contract.get(part)
        if isinstance(options, dict) and (unknown := sorted(set(options) - known)):
            problem = f"needs {part} options that this runtime does not know: {', '.join(unknown)}"
    if missing := [
        name for name, kind in _ENTRIES.items() if not isinstance(contract.get(name), kind)
    ]:
        problem = f"lacks {', '.join(missing)}, or has another type there"
    if contract.get("schema") != SCHEMA:
        problem = f"has schema {str(contract.get('schema'))[:60]!r}, this runtime reads {SCHEMA!r}"
    if problem:
        raise LiveError(
            f"{source} {problem}. Export the policy again and use the runtime of the same folder."
        )


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
    except (OSError, TypeError, ValueError) as error:
        raise LiveError(
            f"{folder} is not an exported policy ({error}). Make one: xreset export deploy"
        ) from error


def check_hash(folder: str | Path, contract: dict[str, Any], content: bytes) -> None:
    """Raise ``LiveError`` if the content of the policy's file is not what the contract was written for."""
    found = hashlib.sha256(content).hexdigest()
    if found != contract["policy_sha256"]:
        raise LiveError(
            f"{Path(folder) / POLICY} has SHA-256 {found[:12]}, the contract names {contract['policy_sha256'][:12]}. "
            "Export the policy again."
        )
