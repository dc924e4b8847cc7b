"""Whether an event file of TensorBoard is whole. TensorBoard's own reader stops at the first damaged record and says nothing."""

from __future__ import annotations

import os
import struct
from collections.abc import Mapping
from pathlib import Path

from xreset.errors import FileFormatError

_HEADER, _FOOTER = 12, 4
"""Bytes around the content of a record: its length (uint64) and that number's checksum; the content's checksum."""
_PLAUSIBLE = 1 << 24
"""[bytes] A longer record is no record: a scalar takes less than 100."""


def check_events(file: Path, read: Mapping[str, int]) -> None:
    """Refuse a file of which not everything was read. A last record that is not complete is none yet, and no damage.

    Args:
        file: event file.
        read: tag of every scalar that TensorBoard read from it -> its last step.

    Raises:
        FileFormatError: there are records that were not read.
    """
    from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportMissingImports]

    size, last = file.stat().st_size, None
    with open(file, "rb") as stream:
        while size - stream.tell() >= _HEADER + _FOOTER:
            (length,) = struct.unpack("<Q", stream.read(_HEADER)[:8])
            if not 0 < length < _PLAUSIBLE:
                raise _damaged(file, read)
            if size - stream.tell() < length + _FOOTER:
                break
            last = stream.tell(), length
            stream.seek(length + _FOOTER, os.SEEK_CUR)
        if last is None:  # a training that has just begun
            return
        stream.seek(last[0])
        content = stream.read(last[1])
    try:
        event = Event.FromString(content)
    except Exception as error:  # protobuf's own exceptions depend on its implementation
        raise _damaged(file, read) from error
    if any(read.get(value.tag, -1) < event.step for value in event.summary.value if value.HasField("simple_value")):
        raise _damaged(file, read)


def _damaged(file: Path, read: Mapping[str, int]) -> FileFormatError:
    return FileFormatError(
        f"{file} is damaged: TensorBoard reads it up to step {max(read.values(), default=0)} and no farther. "
        "Put back a whole copy, or move it out of the folder."
    )
