"""What a run of retargeting that was stopped has finished: a folder with one file per batch of sequences.

Every file carries the key of the run that wrote it. Only a run with the same key reads it, so a changed input can never mix with an old
result; a file that is damaged or of another run counts as not there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from xreset import __version__
from xreset.demos.archive import Demos
from xreset.errors import FileFormatError
from xreset.files import remove_leftovers
from xreset.records import JOINT, Field, read_npz, schema_of, write_npz
from xreset.retarget.validity import REASONS
from xreset.spec import ObjectSpec, RobotSpec

_SCHEMA_NAME = "xreset-retargeted-batch/1"


@dataclass(frozen=True, kw_only=True)
class Batch:
    """What solving a batch gives, the frames of its sequences behind one another; see :class:`xreset.retarget.file.Retargeted`."""

    joint_pos: Annotated[np.ndarray, Field(("F", "J"), "f", within=JOINT)]
    """[F, J]"""
    reason: Annotated[np.ndarray, Field(("F",), "i", within=(0, len(REASONS) - 1))]
    """[F]"""
    hand_error: Annotated[np.ndarray, Field(("F",), "f", within=None)]
    """[F] [m]"""
    wrist_error: Annotated[np.ndarray, Field(("F",), "f", within=None)]
    """[F] [m]"""


@dataclass(frozen=True)
class Partial:
    """The finished batches of one run."""

    folder: Path
    key: str
    """Of the run: see :func:`run_key`."""

    def read(self, number: int) -> Batch | None:
        """A batch, or None if this run has not finished it."""
        path = self._path(number)
        if not path.exists():
            return None
        try:
            arrays = read_npz(path, _SCHEMA_NAME, {"key": Field((), "U"), **schema_of(Batch)}, what="a finished batch")
        except FileFormatError:
            return None  # it costs a minute to make it again, and asking the user to delete it costs more
        if str(arrays["key"]) != self.key:
            return None
        return Batch(**{f.name: arrays[f.name] for f in fields(Batch)})

    def write(self, number: int, batch: Batch) -> None:
        """Keep a finished batch; the file appears whole or not at all."""
        write_npz(self._path(number), _SCHEMA_NAME, {"key": self.key} | vars(batch))

    def _path(self, number: int) -> Path:
        return self.folder / f"batch_{number:04d}.npz"


def discard(folder: Path) -> None:
    """Remove the batches in a folder, and the folder unless it holds files that are not xreset's."""
    if not folder.is_dir():
        return
    remove_leftovers(folder)
    for path in folder.glob("batch_*.npz"):
        path.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


def run_key(
    demos: Demos, robot: RobotSpec, objects: Sequence[ObjectSpec], config: Any, sequences_per_batch: int, device: str
) -> str:
    """SHA-256 over everything that a run's result depends on.

    Args:
        demos: the demonstrations, as they are retargeted.
        objects: the objects that the demonstrations name; of these, only the collision pieces are looked at.
        sequences_per_batch: decides which sequences a batch holds.
        device: rounds in its own way.
    """
    digest = hashlib.sha256()
    stated = [__version__, robot.fingerprint, asdict(config), sequences_per_batch, device, float(demos.fps)]
    digest.update(json.dumps(stated, sort_keys=True).encode())
    arrays = {f.name: getattr(demos, f.name) for f in fields(demos)}
    for spec in sorted(objects, key=lambda o: o.name):
        for number, piece in enumerate(spec.pieces):
            shape = {"pose": piece.T_body_shape} | {
                name: np.asarray(v) for name, v in vars(piece.geometry).items() if v is not None
            }
            arrays |= {f"{spec.name} piece {number} {name}": value for name, value in shape.items()}
    for name, value in arrays.items():
        if value is not None:
            array = np.ascontiguousarray(value)
            digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
