"""Arrays as files: npz with a schema and provenance, all of it checked before any of it is used.

Every file carries ``schema`` (a name and version such as ``xreset-demos/1``) and, if xreset wrote it, ``meta``: a JSON text with the
configuration it was made with and the SHA-256 of its inputs. Arrays are never pickled. The same content gives the same bytes.
"""

from __future__ import annotations

import json
import logging
import math
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from xreset import __version__
from xreset.errors import FileFormatError, XResetError
from xreset.files import RAISE_LIMIT, atomic_write, check_schema, max_bytes, must_exist
from xreset.text import is_plain, shown

T = TypeVar("T")


@dataclass(frozen=True)
class Field:
    """One array of a schema: what it must be like, and what its numbers may be."""

    shape: tuple[str | int, ...]
    """Shape letters (the same letter must have the same length in every field; ``"F+1"`` is one more than F) or fixed lengths."""
    kind: str
    """numpy kinds that are allowed: ``f`` float, ``i`` integer, ``b`` bool, ``U`` text."""
    required: bool = True
    """Whether the file must have it."""
    within: tuple[float, float] | None = (-math.inf, math.inf)
    """Range of its numbers, which must be finite; None: any, for the reader checks them with its own knowledge."""
    unit: bool = False
    """Whether its last axis holds unit quaternions."""
    dtype: type | None = None
    """What it is written as; None: as it is."""


Schema = Mapping[str, Field]
POSITION = (-100.0, 100.0)
"""[m] Range of positions: a tabletop scene is smaller by far, and float32 knows millimetres there."""
JOINT = (-100.0, 100.0)
"""[rad or m] Range of joint positions; a robot's own limits are checked where the robot is known."""
RATE = (0.1, 1e4)
"""[1/s] Range of frame rates."""
UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1: three digits are what people write by hand."""


def write_npz(
    path: str | Path,
    schema_name: str,
    arrays: Mapping[str, Any],
    *,
    config: Mapping[str, Any] | None = None,
    inputs: Mapping[str, str] | None = None,
) -> None:
    """Write arrays with their schema and provenance.

    Args:
        path: file to write; appears whole or not at all.
        schema_name: such as ``xreset-resets/1``.
        arrays: name -> array (numbers, bool or text; never objects).
        config: JSON-able configuration that made the content.
        inputs: name -> SHA-256 of each input.
    """
    meta = {"xreset": __version__, "config": dict(config or {}), "inputs": dict(inputs or {})}
    out = {"schema": np.array(schema_name), "meta": np.array(json.dumps(meta, sort_keys=True, allow_nan=False))}
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "fiubU":
            raise TypeError(f"array {name!r} has dtype {array.dtype}; only numbers, bool and text can be stored")
        out[name] = array
    with atomic_write(path) as file:
        np.savez_compressed(file, **out)  # pyright: ignore[reportArgumentType]


def read_npz(
    path: str | Path,
    schema_name: str | None,
    schema: Schema,
    *,
    what: str,
    check: Callable[[dict[str, np.ndarray]], str | None] | None = None,
) -> dict[str, np.ndarray]:
    """Read an npz file and check all of it before anything is used; names, kinds, shapes and sizes before anything is unpacked.

    Args:
        schema_name: schema that the file must state; None: a file that others made, which states none.
        schema: fields that it must have. Others are left aside, with a warning.
        what: what the file is, for messages ("a reset bank").
        check: further check; returns a message if something is wrong.

    Returns:
        The arrays of the schema by name (``meta`` too, as text array, if present): integers as int64, floats as native float32 or float64.

    Raises:
        FileFormatError: the file is damaged or does not match.
    """
    path = Path(path)
    must_exist(path, what)
    with _archive(path, f"cannot be read as {what}") as archive:
        found = _headers(archive)
        own = schema
        if schema_name is not None:
            check_schema(path, _text(archive, found, "schema"), schema_name)
            own = {"schema": Field((), "U"), "meta": Field((), "U", required=False), **schema}
        problem = _match(found, own) or _too_large(found, own)
        arrays = {} if problem else {name: _read(archive, found[name]) for name in own if name in found}
    problem = problem or _bad_values(arrays, schema) or (check(arrays) if check else None)
    if problem:
        raise FileFormatError(f"{path} is not valid as {what}: {problem}")
    if unknown := sorted(set(found) - set(own)):
        logging.getLogger(__name__).warning(
            "%s also holds %s, which this xreset (%s) leaves aside.", path, shown(unknown), __version__
        )
    return arrays


def read_arrays(path: str | Path, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Some arrays of a foreign npz file, which states no schema; sizes are checked before anything is unpacked.

    Raises:
        FileFormatError: the file is damaged, too large, or lacks one of them.
    """
    path = Path(path)
    must_exist(path, "npz file")
    with _archive(path, "cannot be read") as archive:
        found = _headers(archive)
        if missing := [name for name in names if name not in found]:
            raise FileFormatError(f"{path} has no array {', '.join(missing)}.")
        if wrong := [name for name in names if found[name].dtype.kind not in "fiu"]:
            raise FileFormatError(f"{path} has no numbers in {', '.join(wrong)}.")
        if problem := _too_large(found, {name: Field((), "f") for name in names}):
            raise FileFormatError(f"{path}: {problem}")
        return {name: _read(archive, found[name]) for name in names}


def npz_schema(path: str | Path) -> str:
    """The schema that an npz file states; its reader checks all the rest.

    Raises:
        FileFormatError: it is no npz file, or states none.
    """
    path = Path(path)
    must_exist(path, "one of xreset's npz files")
    with _archive(path, "is not one of xreset's npz files") as archive:
        stated = _text(archive, _headers(archive), "schema")
    if stated is None:
        raise FileFormatError(f"{path} is not one of xreset's npz files: it states no schema. Is it the right file?")
    return stated


@dataclass(frozen=True)
class _Header:
    """What an array's own header says of it."""

    member: str
    """Name in the zip file."""
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def bytes(self) -> int:
        """What it takes as :func:`_read` gives it: integers of one byte become eight."""
        return math.prod(self.shape) * max(self.dtype.itemsize, {"i": 8, "u": 8, "f": 4}.get(self.dtype.kind, 1))


@contextmanager
def _archive(path: Path, failure: str) -> Iterator[zipfile.ZipFile]:
    """Open an npz file; whatever zipfile, zlib and numpy raise at damage becomes one error."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except XResetError:
        raise
    except Exception as error:
        reason = str(error) if isinstance(error, zipfile.BadZipFile | OSError | _BadArray) else "its content is broken"
        raise FileFormatError(f"{path} {failure}: {reason}. It is damaged or truncated, or not an npz file.") from error


class _BadArray(ValueError):
    """An array of an npz file is not one of numbers or text."""


def _headers(archive: zipfile.ZipFile) -> dict[str, _Header]:
    headers = {}
    for member in archive.namelist():
        with archive.open(member) as stream:
            version = np.lib.format.read_magic(stream)
            read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}[version]
            shape, _, dtype = read(stream)
        if dtype.kind not in "fiubU":
            raise _BadArray(
                f"the array {shown(member)} holds {dtype}, expected numbers, bool or text; objects are never read"
            )
        if min(shape, default=0) < 0:
            raise _BadArray(f"the array {shown(member)} has the shape {shape}")
        headers[member.removesuffix(".npy")] = _Header(member, shape, dtype)
    return headers


def _too_large(headers: Mapping[str, _Header], schema: Schema) -> str | None:
    sizes = {name: headers[name].bytes for name in schema if name in headers}
    if sum(sizes.values()) <= max_bytes():
        return None
    largest = max(sizes, key=lambda name: sizes[name])
    return f"its arrays take {sum(sizes.values()) >> 20} MB unpacked, the largest is {largest!r}. {RAISE_LIMIT}"


def _read(archive: zipfile.ZipFile, header: _Header) -> np.ndarray:
    with archive.open(header.member) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        stream.read(1)  # at the end the checksum is compared
    if array.dtype.kind in "iu":
        if array.dtype == np.uint64 and (array > np.iinfo(np.int64).max).any():
            raise _BadArray(f"the array {shown(header.member)} holds integers of more than 63 bits")
        return array.astype(np.int64)
    if array.dtype.kind == "f":
        with np.errstate(over="ignore"):  # becomes infinite, and is then found to be
            return array.astype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    return array.astype(array.dtype.newbyteorder("="))


def _text(archive: zipfile.ZipFile, headers: Mapping[str, _Header], name: str) -> str | None:
    header = headers.get(name)
    if header is None or header.dtype.kind != "U" or header.shape or header.bytes > 1024:
        return None
    return str(_read(archive, header))


def _bad_values(arrays: Mapping[str, np.ndarray], schema: Schema) -> str | None:
    for name, field in schema.items():
        array = arrays.get(name)
        if array is None:
            continue
        if array.dtype.kind == "U":
            wrong = next((text for text in array.ravel().tolist() if not is_plain(text)), None)
            if wrong is not None:
                return f"array {name!r} holds the text {shown(wrong)} with characters that control a terminal, or are none."
            continue
        if array.dtype.kind == "b" or field.within is None:
            continue
        low, high = field.within
        if not np.isfinite(array).all():
            return f"array {name!r} holds non-finite numbers."
        if ((array < low) | (array > high)).any():
            worst = array[(array < low) | (array > high)].ravel()[0]
            return f"array {name!r} holds {worst:.6g}, expected numbers from {low:g} to {high:g}."
        if field.unit and (np.abs(np.linalg.norm(array.astype(np.float64), axis=-1) - 1) > UNIT_TOLERANCE).any():
            return f"array {name!r} holds quaternions that are not unit."
    return None


def offsets_problem(arrays: Mapping[str, np.ndarray], frames: int) -> str | None:
    """What is wrong with ``frame_offsets``, which say where each of the sequences ``sequence_name`` begins and ends; or with the names."""
    offsets, names = arrays["frame_offsets"], arrays["sequence_name"]
    if not len(names):
        return "it holds no sequence."
    if offsets[0] != 0 or offsets[-1] != frames:
        return f"frame_offsets go from {offsets[0]} to {offsets[-1]}, expected 0 to {frames} (the number of frames)."
    if (offsets[1:] <= offsets[:-1]).any():
        i = int(np.argmax(offsets[1:] <= offsets[:-1]))
        return f"frame_offsets must increase, but sequence {i} ({names[i]!s}) has {offsets[i + 1] - offsets[i]} frames."
    return unique_problem(names)


def unique_problem(names: np.ndarray) -> str | None:
    """What is wrong with the names of sequences [S], of which no two may be the same."""
    unique, counts = np.unique(names, return_counts=True)
    if (counts > 1).any():
        return f"sequence names must be unique, but {unique[np.argmax(counts)]!s} occurs {counts.max()} times."
    return None


_KINDS = {"f": "floating-point", "i": "integer", "u": "unsigned", "b": "bool", "U": "text"}


def _match(arrays: Mapping[str, _Header], schema: Schema) -> str | None:
    lengths: dict[str, tuple[int, str]] = {}
    for name, field in schema.items():
        if name not in arrays:
            if field.required:
                return f"it has no array {name!r}; found {', '.join(sorted(set(arrays) - {'schema'}))}."
            continue
        array = arrays[name]
        kinds = field.kind + ("u" if "i" in field.kind else "")
        if array.dtype.kind not in kinds:
            wanted = " or ".join(_KINDS[k] for k in field.kind)
            return f"array {name!r} has type {array.dtype}, expected {wanted}."
        if len(array.shape) != len(field.shape):
            return f"array {name!r} has shape {array.shape}, expected ({', '.join(map(str, field.shape))})."
        for length, want in zip(array.shape, field.shape, strict=True):
            letter, extra = (want[:-2], 1) if isinstance(want, str) and want.endswith("+1") else (want, 0)
            if isinstance(letter, int):
                if length != letter:
                    return f"array {name!r} has shape {array.shape}, expected ({', '.join(map(str, field.shape))})."
                continue
            value = length - extra
            known, owner = lengths.setdefault(letter, (value, name))
            if value != known:
                return f"array {name!r} has shape {array.shape}, but {letter} = {known} by array {owner!r}."
    return None


# Dataclasses as files ---------------------------------------------------------------------------------------------------------------------


@cache
def schema_of(cls: type) -> Schema:
    """The schema of a dataclass whose fields are annotated with what they are in the file: ``Annotated[np.ndarray, Field(...)]``.

    A field whose default is None may be missing.
    """
    optional = {f.name for f in fields(cls) if f.default is None}
    hints = get_type_hints(cls, include_extras=True)
    return {name: replace(_field_of(hint), required=name not in optional) for name, hint in hints.items()}


def _field_of(hint: Any) -> Field:
    parts = get_args(hint) if get_origin(hint) is Union else (hint,)
    return next(found for part in parts for found in getattr(part, "__metadata__", ()) if isinstance(found, Field))


def write_record(path: str | Path, schema_name: str, record: Any, **provenance: Any) -> None:
    """Write a dataclass of :func:`schema_of`'s kind; what is None is left out. See :func:`write_npz` for ``provenance``."""
    write_npz(path, schema_name, arrays_of(record), **provenance)


def arrays_of(record: Any) -> dict[str, np.ndarray]:
    """The arrays of a dataclass of :func:`schema_of`'s kind, as they are written."""
    arrays = {}
    for name, field in schema_of(type(record)).items():
        if (value := getattr(record, name)) is not None:
            arrays[name] = np.asarray(value, dtype=field.dtype or (np.str_ if field.kind == "U" else None))
    return arrays


def read_record(
    cls: type[T],
    path: str | Path,
    schema_name: str,
    *,
    what: str,
    check: Callable[[dict[str, np.ndarray]], str | None] | None = None,
) -> T:
    """Read a dataclass of :func:`schema_of`'s kind; arguments and errors as of :func:`read_npz`."""
    arrays = read_npz(path, schema_name, schema_of(cls), what=what, check=check)
    make: dict[Any, Callable[[np.ndarray], Any]] = {
        str: str,
        float: float,
        tuple[str, ...]: lambda array: tuple(array.tolist()),
    }
    hints = get_type_hints(cls)
    return cls(
        **{name: make.get(hints[name], lambda array: array)(array) for name, array in arrays.items() if name in hints}
    )
