"""Find the exported policy that a name means. Nothing is written: the policy of a run may have to be made in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from xreset.errors import PolicyError
from xreset.files.checks import frozen
from xreset.files.storage import file_hash, read_json
from xreset.learning.run import RunInfo, checkpoints, latest_checkpoint, read_run
from xreset.policy.onnx_policy import OnnxPolicy, policy_content
from xreset.policy.shipped import results_folder, shipped
from xreset.runtime.contract import POLICY


@frozen
class PolicyFile:
    """Content of an exported policy, and where it is from."""

    name: str
    """What results call the policy."""
    path: Path
    """The file; or what messages call a policy that is in no file."""
    content: bytes
    results: Path
    """Default folder of the policy's results."""
    run: RunInfo | None = None
    """The training, where the policy was found in its run folder."""


def find_policy(policy: str | Path, *, also: Sequence[str] = ()) -> PolicyFile:
    """Find a run folder's policy, that of a checkpoint, an exported or deployed one, or one that ships with xreset, in
    this order.

    Args:
        policy: folder, file (``.onnx``, or ``RUN/checkpoints/NUMBER.pt``) or name.
        also: further names that the error lists.

    Raises:
        PolicyError: there is none of that name.
        RunError: the folder is no run, or has neither a policy nor a checkpoint.
        FileFormatError: ``run.json`` or a checkpoint is damaged.
    """
    path = Path(policy)
    if os.path.isdir(path / "runtime"):  # of xreset export deploy
        path = path / POLICY
    if os.path.isdir(path):  # unlike Path.is_dir, it takes names of any length
        run = read_run(path)
        file = path / "policy.onnx"
        content = _content_of_run(path, run)
        return PolicyFile(name=path.name, path=file, content=content, results=path, run=run)
    if path.suffix == ".pt" and path.is_file():
        folder = path.parent.parent
        run = read_run(folder)
        name = f"{folder.name}-{path.stem}"
        content = _exported(path, run)
        results = path.with_suffix("")
        return PolicyFile(name=name, path=path, content=content, results=results, run=run)
    if path.suffix == ".onnx" or os.path.exists(path):
        content = policy_content(path)
        return PolicyFile(name=path.stem, path=path, content=content, results=path.parent)
    name = str(policy)
    files = shipped()
    if name not in files:
        known = ", ".join((*also, *files))
        raise PolicyError(
            f"Unknown policy {name!r}. Give a run folder, a .onnx file, or one of: {known}."
        )
    content = policy_content(files[name])
    return PolicyFile(name=name, path=files[name], content=content, results=results_folder(name))


def read_policy(policy: str | Path) -> OnnxPolicy:
    """Read the policy that :func:`find_policy` finds; ``PolicyError`` also if it is damaged."""
    found = find_policy(policy)
    return OnnxPolicy(found.path, found.content)


def _content_of_run(folder: Path, run: RunInfo) -> bytes:
    """Return the policy of the newest checkpoint. A run that was copied without its checkpoints keeps its
    ``policy.onnx``."""
    path = folder / "policy.onnx"
    if path.exists() and not checkpoints(folder):
        return policy_content(path)
    checkpoint = _chosen_before(folder, latest_checkpoint(folder))
    if path.exists():
        content = policy_content(path)
        if file_hash(checkpoint).encode() in content:  # an entry of the metadata, at the end
            return content
    return _exported(checkpoint, run)


def _exported(checkpoint: Path, run: RunInfo) -> bytes:
    # rsl-rl, which playing a file does not need
    from xreset.learning.export import exported_checkpoint

    return exported_checkpoint(checkpoint, run)


def _chosen_before(folder: Path, newest: Path) -> Path:
    """Return the checkpoint that ``xreset select`` of 0.1 to 0.3 chose among those that the run still has, or else the
    newest one."""
    path = folder / "choice.json"
    if not path.is_file() or newest.name not in path.read_text():
        return newest
    chosen = read_json(path).get("chosen")
    return next((each for each in checkpoints(folder) if each.name == chosen), newest)
