"""Find the exported policy that a name means. Nothing is written: the policy of a run may have to be made in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from xreset.errors import PolicyError
from xreset.files.storage import file_hash, read_json
from xreset.learning.run import checkpoints, latest_checkpoint
from xreset.policy.onnx_policy import OnnxPolicy
from xreset.policy.shipped import shipped


def read_policy(policy: str | Path, *, also: Sequence[str] = ()) -> OnnxPolicy:
    """Read a run folder's policy, that of a checkpoint, an exported one, or one that ships with xreset, in this order.

    Args:
        policy: folder, file (``.onnx``, or ``RUN/checkpoints/NUMBER.pt``) or name.
        also: further names that the error lists.

    Raises:
        PolicyError: there is none of that name, or it is damaged.
        RunError: the run has neither a policy nor a checkpoint.
    """
    if os.path.isdir(policy):  # unlike Path.is_dir, it takes names of any length
        return _policy_of_run(Path(policy))
    path = Path(policy)
    if path.suffix == ".pt" and path.is_file():
        return _policy_of_checkpoint(path, path)
    if path.suffix == ".onnx" or os.path.exists(path):
        return OnnxPolicy(path)
    files = shipped()
    if str(policy) not in files:
        known = ", ".join((*also, *files))
        raise PolicyError(
            f"Unknown policy {str(policy)!r}. Give a run folder, a .onnx file, or one of: {known}."
        )
    return OnnxPolicy(files[str(policy)])


def _policy_of_run(folder: Path) -> OnnxPolicy:
    """Return the policy of the newest checkpoint. A run that was copied without its checkpoints keeps its
    ``policy.onnx``."""
    path = folder / "policy.onnx"
    if path.exists() and not checkpoints(folder):
        return OnnxPolicy(path)
    checkpoint = _chosen_before(folder, latest_checkpoint(folder))
    try:
        policy = OnnxPolicy(path)
        if policy.checkpoint == file_hash(checkpoint):
            return policy
    except PolicyError:  # missing, or damaged
        pass
    return _policy_of_checkpoint(path, checkpoint)


def _policy_of_checkpoint(path: Path, checkpoint: Path) -> OnnxPolicy:
    # rsl-rl, which playing a file does not need
    from xreset.learning.export import exported_checkpoint

    return OnnxPolicy(path, exported_checkpoint(checkpoint))


def _chosen_before(folder: Path, newest: Path) -> Path:
    """Return the checkpoint that ``xreset select`` of 0.1 to 0.3 chose among those that the run still has, or else the
    newest one."""
    path = folder / "choice.json"
    if not path.is_file() or newest.name not in path.read_text():
        return newest
    chosen = read_json(path).get("chosen")
    return next((each for each in checkpoints(folder) if each.name == chosen), newest)
