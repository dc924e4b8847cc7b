"""Find the exported policy that a name means. Nothing is written: the policy of a run may have to be made in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from xreset.errors import PolicyError
from xreset.files.storage import file_hash
from xreset.learning.run import checkpoints, latest_checkpoint, read_choice
from xreset.policy.onnx_policy import OnnxPolicy
from xreset.policy.shipped import shipped


def read_policy(policy: str | Path, *, also: Sequence[str] = ()) -> OnnxPolicy:
    """Read a run folder's policy, an exported one, or one that ships with xreset, in this order.

    Args:
        policy: folder, file or name.
        also: further names that the error lists.

    Raises:
        PolicyError: there is none of that name, or it is damaged.
        RunError: the run has neither a policy nor a checkpoint.
    """
    if os.path.isdir(policy):  # unlike Path.is_dir, it takes names of any length
        return _policy_of_run(Path(policy))
    path = Path(policy)
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
    """Return the policy of the newest checkpoint, unless ``xreset select`` chose one and the run has had no newer one
    since. A run that was copied without its checkpoints keeps its ``policy.onnx``."""
    path = folder / "policy.onnx"
    if path.exists() and not checkpoints(folder):
        return OnnxPolicy(path)
    checkpoint = latest_checkpoint(folder)
    choice = read_choice(folder)
    if choice is not None and choice.candidates[0].name == checkpoint.name:
        chosen = checkpoint.with_name(choice.chosen)
        checkpoint = chosen if chosen.exists() else checkpoint
    try:
        policy = OnnxPolicy(path)
        if policy.checkpoint == file_hash(checkpoint):
            return policy
    except PolicyError:  # missing, or damaged
        pass
    # rsl-rl, which playing a file does not need
    from xreset.learning.export import exported_checkpoint

    return OnnxPolicy(path, exported_checkpoint(checkpoint))
