"""Graphs of policies, kept in a cache because torch's export takes seconds."""

from __future__ import annotations

import hashlib
import json
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from xreset.errors import PolicyError, XResetError, needs
from xreset.files.storage import write_whole
from xreset.live.graph import policy_graph
from xreset.objects.cache import cache_folder
from xreset.spec import RobotSpec
from xreset.task.config import TaskConfig
from xreset.task.observations import TERMS

if TYPE_CHECKING:
    from onnx import ModelProto

_CODE = ("geometry", "live", "physics", "policy", "task")
"""Packages whose code is in graphs."""
_MOST = 16
"""Graphs that the cache keeps, each 0.3 to 4 MB."""


def cached_graph(network: bytes, robot: RobotSpec, task: TaskConfig) -> ModelProto:
    """Return :func:`~xreset.live.graph.policy_graph` of an exported policy, from the cache if it is there."""
    folder = cache_folder()
    if folder is None or any(not f.__module__.startswith("xreset.") for f in TERMS.values()):
        return policy_graph(network, robot, task)  # the code of a user's terms may be anywhere
    with needs("onnx", "deploy", PolicyError):
        import onnx
    identity = [_code(), hashlib.sha256(network).hexdigest(), robot.fingerprint, asdict(task)]
    key = hashlib.sha256(json.dumps(identity, default=str).encode()).hexdigest()
    path = folder / "graphs" / f"{key}.onnx"
    with suppress(Exception):  # absent, damaged or not readable: make it again
        return onnx.load_from_string(path.read_bytes())
    model = policy_graph(network, robot, task)
    with suppress(XResetError, OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, model.SerializeToString())
        files = sorted(path.parent.glob("*.onnx"), key=lambda file: file.stat().st_mtime)
        for file in files[:-_MOST]:
            file.unlink(missing_ok=True)
    return model


@cache
def _code() -> str:
    """Return a digest of the code that graphs are made of."""
    root = Path(__file__).parents[1]
    digest = hashlib.sha256(torch.__version__.encode())
    for package in _CODE:
        for file in sorted((root / package).rglob("*.py")):
            digest.update(file.read_bytes())
    return digest.hexdigest()
