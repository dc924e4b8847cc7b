"""Whether an event file of TensorBoard is whole. TensorBoard's own reader stops at the first damaged record and says nothing."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from xreset.errors import FileFormatError

_HEADER, _FOOTER = 12, 4
"""Bytes around the content of a record: its length (uint64) and that number's checksum; the content's checksum."""


def check_events(file: Path, read: Mapping[str, int]) -> None:
    """Refuse a file that has lost its beginning, or of which not everything was read.

    A last record that is not complete is none yet, and no damage.

    Args:
        file: event file.
        read: tag of every scalar that TensorBoard read from it -> its last step.

    Raises:
        FileFormatError: there are records that were not read.
    """
    from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportMissingImports]
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c  # pyright: ignore[reportMissingImports]

    def event(record: bytes) -> Any:
        try:
            return Event.FromString(record)
        except Exception as error:  # protobuf's own exceptions depend on its implementation
            raise _damaged(file, read) from error

    size, last = file.stat().st_size, None
    with open(file, "rb") as stream:
        while size - stream.tell() >= _HEADER + _FOOTER:
            header = stream.read(_HEADER)
            length, checksum = struct.unpack("<QI", header)
            if checksum != masked_crc32c(header[:8]):
                raise _damaged(file, read)
            begin = stream.tell()
            if size - begin < length + _FOOTER:
                break
            if last is None and not event(stream.read(length)).file_version:
                raise FileFormatError(f"{file} is damaged: its beginning is missing. Put back a whole copy, or move it out of the folder.")
            last = begin, length
            stream.seek(begin + length + _FOOTER)
        if last is None:  # a training that has just begun
            return
        stream.seek(last[0])
        newest = event(stream.read(last[1]))
    if any(read.get(value.tag, -1) < newest.step for value in newest.summary.value if value.HasField("simple_value")):
        raise _damaged(file, read)


def _damaged(file: Path, read: Mapping[str, int]) -> FileFormatError:
    return FileFormatError(
        f"{file} is damaged: TensorBoard reads it up to step {max(read.values(), default=0)} and no farther. "
        "Put back a whole copy, or move it out of the folder."
    )
