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


def check_contract(contract: dict[str, Any], source: str) -> None:
    """Raise ``LiveError`` for a contract of another schema or with options that this package does not support."""
    if not isinstance(contract, dict):
        contract = {}
    problem = ""
    for part, known in _KNOWN.items():
        if unknown := sorted(set(contract.get(part, {})) - known):
            problem = f"needs {part} options that this runtime does not know: {', '.join(unknown)}"
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
    try:
        folder = Path(folder)
        contract = json.loads((folder / CONTRACT).read_text())
        content = (folder / POLICY).read_bytes()
    except (OSError, TypeError, ValueError) as error:
        raise LiveError(
            f"{folder} is not an exported policy ({error}). Make one: xreset export deploy"
        ) from error
    check_contract(contract, str(folder / CONTRACT))
    found = hashlib.sha256(content).hexdigest()
    if found != contract["policy_sha256"]:
        raise LiveError(
            f"{folder / POLICY} has SHA-256 {found[:12]}, the contract names {contract['policy_sha256'][:12]}. "
            "Export the policy again."
        )
    return contract
