"""Find the exported policy that a name means. Nothing is written: the policy of a run may have to be made in memory."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from xreset.errors import PolicyError
from xreset.files.checks import frozen
from xreset.files.storage import file_hash
from xreset.learning.run import RunInfo, checkpoints, played_checkpoint, read_run
from xreset.physics.plugins import robot_names
from xreset.policy.onnx_policy import OnnxPolicy, policy_content
from xreset.policy.shipped import no_policy_for, results_folder, shipped, shipped_name
from xreset.runtime.contract import POLICY


@frozen
class PolicyFile:
    """Content of an exported policy, and where it is from."""

    name: str
    """What results call the policy."""
    path: Path
    """The file; or what messages call a policy that ships or that is in no file."""
    content: bytes
    results: Path
    """Default folder of the policy's results."""
    run: RunInfo | None = None
    """The training, where the policy was found in its run folder."""

    @property
    def folder_name(self) -> str:
        """Name of the file, or of its folder if the file has the name that every deployed policy has."""
        return self.path.resolve().parent.name if self.path.name == POLICY else self.name


def find_policy(policy: str | Path, *, also: Sequence[str] = ()) -> PolicyFile:
    """Find a run folder's policy, that of a checkpoint, an exported or deployed one, or one that ships with xreset, in
    this order. The name of a robot means the policy that ships for it.

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
        return _policy_of_run(path)
    if path.suffix == ".pt" and path.parent.name == "checkpoints" and path.is_file():
        return _policy_of_checkpoint(path)
    if path.suffix == ".onnx" or os.path.exists(path):
        content = policy_content(path)
        return PolicyFile(name=path.stem, path=path, content=content, results=path.parent)
    name = shipped_name(str(policy))
    files = shipped()
    if name is None and str(policy) in robot_names():
        raise PolicyError(no_policy_for(str(policy)))
    if name is None:
        known = ", ".join((*also, *files))
        raise PolicyError(
            f"Unknown policy {str(policy)!r}. Give a run folder, a .onnx file, or one of: {known}."
        )
    content = policy_content(files[name])
    return PolicyFile(name=name, path=Path(name), content=content, results=results_folder(name))


def read_policy(policy: str | Path) -> OnnxPolicy:
    """Read the policy that :func:`find_policy` finds; ``PolicyError`` also if it is damaged."""
    found = find_policy(policy)
    return OnnxPolicy(found.path, found.content)


def _policy_of_run(folder: Path) -> PolicyFile:
    """Return the policy of the newest checkpoint. A run that was copied without its checkpoints keeps its
    ``policy.onnx``."""
    run = read_run(folder)
    path = folder / "policy.onnx"
    is_copied = path.exists() and not checkpoints(folder)
    checkpoint = None if is_copied else played_checkpoint(folder)
    content = policy_content(path) if path.exists() else b""
    # the hash is an entry of the metadata, at the end
    if checkpoint is not None and file_hash(checkpoint).encode() not in content:
        content = _exported(checkpoint, run)
    return PolicyFile(name=folder.name, path=path, content=content, results=folder, run=run)


def _policy_of_checkpoint(checkpoint: Path) -> PolicyFile:
    folder = checkpoint.parent.parent
    run = read_run(folder)
    return PolicyFile(
        name=f"{folder.name}-{checkpoint.stem}",
        path=checkpoint,
        content=_exported(checkpoint, run),
        results=checkpoint.with_suffix(""),
        run=run,
    )


def _exported(checkpoint: Path, run: RunInfo) -> bytes:
    # rsl-rl, which playing a file does not need
    from xreset.learning.export import exported_checkpoint

    return exported_checkpoint(checkpoint, run)
