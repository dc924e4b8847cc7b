"""Arrays as files: npz with a schema and provenance, checked completely before use.

Every file has ``schema`` (a name and version such as ``xreset-demos/1``) and, if xreset wrote it, ``meta``: a JSON text
with the configuration that made it and the SHA-256 of its inputs. Arrays are never pickled. The same content gives the
same bytes.
"""

from __future__ import annotations

import errno
import json
import math
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields, replace
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import numpy as np

from xreset.errors import FileFormatError, XResetError
from xreset.files.checks import Check, marks_of
from xreset.files.storage import (
    RAISE_LIMIT,
    atomic_write,
    check_schema,
    code_version,
    max_bytes,
    must_exist,
    read_json,
    stated_path,
)
from xreset.files.text import is_plain, plain, shown

T = TypeVar("T")
_NOT_OPENED = (errno.EACCES, errno.EPERM, errno.EMFILE, errno.ENFILE)
"""Errors of the system that say nothing about a file's content: no right to read, too many open files."""


@dataclass(frozen=True)
class Field:
    """One array of a schema."""

    shape: tuple[str | int, ...]
    """Shape letters (the same letter must have the same length in every field; ``"F+1"`` is one more than F) or fixed
    lengths."""
    kind: str
    """numpy kinds that are allowed: ``f`` float, ``i`` integer, ``b`` bool, ``U`` text."""
    required: bool = True
    """Whether the file must have it."""
    within: tuple[float, float] | None = (-math.inf, math.inf)
    """Range of its numbers, which must be finite; None: any, because the reader checks them itself."""
    unit: bool = False
    """Whether its last axis holds unit quaternions."""
    dtype: type | None = None
    """Type in which it is written; None: as it is."""
    earlier: str | None = None
    """Its name in files of earlier versions, which are still read."""


Schema = Mapping[str, Field]
Arrays = dict[str, np.ndarray]
"""Arrays by name."""
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
        config: JSON-able configuration that made the content; numbers that are not finite are written as text.
        inputs: name -> SHA-256 of each input.

    Raises:
        XResetError: the configuration holds what JSON has not, such as a path, or the file cannot be written.
    """
    meta = {"xreset": code_version(), "config": dict(config or {}), "inputs": dict(inputs or {})}
    try:
        as_json = json.loads(json.dumps(meta, sort_keys=True), parse_constant=str)
    except (TypeError, ValueError) as error:
        raise XResetError(
            f"config or inputs cannot be written to {path}: {error}. Use numbers, texts, lists and dictionaries."
        ) from error
    out = {
        "schema": np.array(schema_name),
        "meta": np.array(json.dumps(as_json)),
    }
    for name, value in arrays.items():
        array = np.asarray(value)
        if array.dtype.kind not in "fiubU":
            raise TypeError(
                f"array {name!r} has dtype {array.dtype}; only numbers, bool and text can be stored"
            )
        out[name] = array
    with atomic_write(path) as file:
        np.savez_compressed(file, **out)  # pyright: ignore[reportArgumentType]


def read_npz(
    path: str | Path,
    schema_name: str | None,
    schema: Schema,
    *,
    what: str,
    check: Callable[[Arrays], str | None] | None = None,
) -> Arrays:
    """Read an npz file and check its size before anything is unpacked, and its content before anything is used.

    Args:
        schema_name: schema that the file must state; None: a file that others made, which states none.
        schema: fields that it must have. Others are ignored.
        what: what the file is, for messages ("a reset bank").
        check: further check; returns a message if something is wrong.

    Returns:
        The arrays of the schema by name (``meta`` too, as text array, if present): integers as int64, floats as native
        float32 or float64.

    Raises:
        FileFormatError: the file is damaged or does not match.
    """
    path = Path(path)
    own = dict(schema)
    arrays: dict[str, np.ndarray] = {}
    sizes: dict[str, int] = {}
    with _opened(path, what, f"cannot be read as {what}") as (archive, packed):
        if schema_name is not None:
            check_schema(path, _stated_schema(archive, packed), schema_name, what)
            own |= {"schema": Field((), "U"), "meta": Field((), "U", required=False)}
        stored = {}
        for name, field in own.items():
            if name in packed:
                stored[name] = name
            elif field.earlier in packed:
                stored[name] = field.earlier
            elif field.required:
                raise FileFormatError(
                    f"{path} is not valid as {what}: it has no array {name!r}; "
                    f"found {', '.join(sorted(set(packed) - {'schema'}))}."
                )
        _check_size(path, {name: packed[found] for name, found in stored.items()})
        for name, found in stored.items():
            array = np.asanyarray(archive[found])
            # the size of an item as _native gives it
            sizes[name] = array.size * max(
                array.dtype.itemsize, {"i": 8, "u": 8, "f": 4}.get(array.dtype.kind, 1)
            )
            _check_size(path, sizes)
            arrays[name] = _native(path, name, array)
    problem = _wrong_shape(arrays, own) or wrong_value(arrays, schema)
    if problem is None and check is not None:
        problem = check(arrays)
    if problem is not None:
        raise FileFormatError(f"{path} is not valid as {what}: {problem}")
    return arrays


def npz_schema(path: str | Path, *, what: str = "one of xreset's npz files") -> str:
    """Return the schema that an npz file states; its reader checks all the rest.

    Args:
        what: what the file ought to be, for messages.

    Raises:
        FileFormatError: it is no npz file, or states none.
    """
    path = Path(path)
    with _opened(path, what, f"is not {what}") as (archive, packed):
        stated = _stated_schema(archive, packed)
    if stated is None:
        raise FileFormatError(f"{path} is not {what}: it states no schema. Is it the right file?")
    return stated


_PAGES = {
    b"# Engines: what each can do, and how far they agree": "xreset-engines",
    b" - xreset report</title>": "xreset-report",
}
"""Text that every page of a kind has near its beginning -> the kind."""


def replaces(kind: str, name: str = "") -> Check:
    """Return the check of an output file that refuses to replace a file of another kind.

    Args:
        kind: beginning of the schema that the output states, or of a page's kind. A file without content may be
            replaced.
        name: of the file, where the output is a folder.
    """

    def refuse_other(path: str | Path) -> None:
        path = Path(path, name)
        if not path.is_file() or not path.stat().st_size:
            return
        stated = _kind_of(path)
        if not isinstance(stated, str) or not stated.startswith(kind):
            found = f"of another kind ({shown(stated)})" if stated else "not one of xreset's"
            raise XResetError(
                f"cannot write {path}: a file of this name exists, and is {found}. Nothing was overwritten; choose"
                " another name, or remove the file."
            )

    return Check(refuse_other)


def _kind_of(path: Path) -> Any:
    """Return the schema that an npz or JSON file states, or the kind of a page; None if it is neither."""
    with suppress(FileFormatError):
        return npz_schema(path)
    with suppress(FileFormatError):
        return read_json(path).get("schema")
    with path.open("rb") as file:
        beginning = file.read(10_000)
    return next((kind for text, kind in _PAGES.items() if text in beginning), None)


@contextmanager
def _opened(
    path: Path, what: str, failure: str
) -> Iterator[tuple[Mapping[str, Any], dict[str, int]]]:
    """Yield the arrays of an npz file, and the size of each, unpacked [bytes]; whatever zipfile, zlib and numpy raise
    at damage becomes one error."""
    must_exist(path, what)
    try:
        sizes: dict[str, int] = {}
        with zipfile.ZipFile(path) as file:
            for member in file.infolist():  # NAME and NAME.npy are the same array
                name = member.filename.removesuffix(".npy")
                sizes[name] = max(member.file_size, sizes.get(name, 0))
        with np.load(path, allow_pickle=False) as arrays:
            yield arrays, sizes
    except XResetError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.errno in _NOT_OPENED:
            raise FileFormatError(f"{path} {failure}: {error.strerror}.") from error
        if str(error).startswith("Object arrays"):  # numpy's refusal
            raise FileFormatError(
                f"{path} {failure}: it holds Python objects, and objects are never read."
            ) from error
        reason = (
            str(error)
            if isinstance(error, zipfile.BadZipFile | OSError)
            else "its content is broken"
        )
        raise FileFormatError(
            f"{path} {failure}: {reason}. It is damaged or truncated, or not an npz file."
        ) from error


def _stated_schema(arrays: Mapping[str, Any], sizes: Mapping[str, int]) -> str | None:
    if sizes.get("schema", 1 << 20) > 4096:
        return None
    array = arrays["schema"]
    is_text = isinstance(array, np.ndarray) and array.dtype.kind == "U" and not array.shape
    return str(array) if is_text else None


def _check_size(path: Path, sizes: Mapping[str, int]) -> None:
    total = sum(sizes.values())
    if total > max_bytes():
        largest = max(sizes, key=lambda name: sizes[name])
        raise FileFormatError(
            f"{path}: its arrays take {total >> 20} MB unpacked, the largest is {largest!r}. {RAISE_LIMIT}"
        )


def _native(path: Path, name: str, array: np.ndarray) -> np.ndarray:
    kind = array.dtype.kind
    is_large = array.dtype == np.uint64 and (array > np.iinfo(np.int64).max).any()
    if kind not in "fiubU" or is_large:
        what = "integers of more than 63 bits" if is_large else array.dtype
        raise FileFormatError(
            f"{path}: the array {name!r} holds {what}, expected numbers, bool or text."
        )
    if kind in "iu":
        return array.astype(np.int64)
    if kind == "f":
        with np.errstate(over="ignore"):  # becomes infinite, which is found later
            return array.astype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    return array.astype(array.dtype.newbyteorder("="))


def _wrong_shape(arrays: Arrays, schema: Schema) -> str | None:
    lengths: dict[str, tuple[int, str]] = {}
    for name, array in arrays.items():
        field = schema[name]
        if array.dtype.kind.replace("u", "i") not in field.kind:
            wanted = " or ".join(_KINDS[kind] for kind in field.kind)
            return f"array {name!r} has type {array.dtype}, expected {wanted}."
        expected = f"array {name!r} has shape {array.shape}, expected ({', '.join(map(str, field.shape))})."
        if array.ndim != len(field.shape):
            return expected
        for length, wanted in zip(array.shape, field.shape, strict=True):
            if isinstance(wanted, int):
                if length != wanted:
                    return expected
                continue
            letter = wanted.removesuffix("+1")
            value = length - (letter != wanted)
            known, owner = lengths.setdefault(letter, (value, name))
            if value != known:
                return f"array {name!r} has shape {array.shape}, but {letter} = {known} by array {owner!r}."
    return None


_KINDS = {"f": "floating-point", "i": "integer", "b": "bool", "U": "text"}


def wrong_value(arrays: Arrays, schema: Schema) -> str | None:
    """Return what is wrong with the values of arrays whose types and shapes are right, or None."""
    for name, field in schema.items():
        array = arrays.get(name)
        if array is None or array.dtype.kind == "b":
            continue
        if array.dtype.kind == "U":
            for text in array.ravel().tolist():
                if not is_plain(text):
                    return f"array {name!r} holds the text {shown(text)}, which is not printable."
            continue
        if field.within is None:
            continue
        if not np.isfinite(array).all():
            return f"array {name!r} holds non-finite numbers."
        low, high = field.within
        outside = array[(array < low) | (array > high)]
        if outside.size:
            units = " Units are metres and radians." if field.within == POSITION else ""
            return (
                f"array {name!r} holds {outside[0]:.6g}, expected numbers from {low:g} to {high:g}."
                f"{units}"
            )
        if field.unit:
            lengths = np.linalg.norm(array.astype(np.float64), axis=-1)
            if (np.abs(lengths - 1) > UNIT_TOLERANCE).any():
                return f"array {name!r} holds quaternions that are not unit."
    return None


def offsets_problem(arrays: Arrays, frames: int) -> str | None:
    """Return what is wrong with ``frame_offsets``, which say where each of the sequences ``sequence_name`` begins and
    ends; or with the names."""
    offsets = arrays["frame_offsets"]
    names = arrays["sequence_name"]
    if not len(names):
        return "it holds no sequence."
    if offsets[0] != 0 or offsets[-1] != frames:
        return f"frame_offsets go from {offsets[0]} to {offsets[-1]}, expected 0 to {frames} (the number of frames)."
    lengths = np.diff(offsets)
    if (lengths <= 0).any():
        i = np.argmax(lengths <= 0)
        return (
            f"frame_offsets must increase, but sequence {i} ({names[i]!s}) has {lengths[i]} frames."
        )
    return unique_problem(names)


def unique_problem(names: np.ndarray) -> str | None:
    """Return what is wrong with the names of sequences [S], of which no two may be the same."""
    unique, counts = np.unique(names, return_counts=True)
    if (counts > 1).any():
        return f"sequence names must be unique, but {unique[np.argmax(counts)]!s} occurs {counts.max()} times."
    return None


# Dataclasses as files -------------------------------------------------------------------------------------------------


@cache
def schema_of(cls: type) -> Schema:
    """Return the schema of a dataclass whose fields are annotated with what they are in the file:
    ``Annotated[np.ndarray, Field(...)]``.

    A field whose default is None may be missing.
    """
    marks = marks_of(cls)
    schema = {}
    for f in fields(cls):
        field = next(mark for mark in marks[f.name] if isinstance(mark, Field))
        schema[f.name] = replace(field, required=f.default is not None)
    return schema


def write_record(
    cls: type,
    path: str | Path,
    schema_name: str,
    record: Any,
    *,
    check: Callable[[Arrays], str | None],
    error: type[XResetError] = XResetError,
    **provenance: Any,
) -> None:
    """Write a dataclass of :func:`schema_of`'s kind; fields that are None are left out. See :func:`write_npz` for
    ``provenance``.

    Raises:
        XResetError: it is of another class, or, as an ``error``, :func:`read_record` with the same ``check`` would
            refuse the file.
    """
    arrays = arrays_of(cls, record)
    if problem := record_problem(cls, arrays, check):
        raise error(f"{path} was not written, because it could not be read: {problem}")
    write_npz(path, schema_name, arrays, **provenance)


def read_meta(path: str | Path) -> dict[str, Any]:
    """Return what an npz file states about its making: ``config``, ``inputs``; empty if it states nothing.

    Raises:
        FileFormatError: the file is missing or damaged.
    """
    field = {"meta": Field((), "U", required=False)}
    text = read_npz(path, None, field, what="a file of xreset").get("meta")
    try:
        meta = json.loads(str(text))
    except (ValueError, RecursionError):
        return {}
    return meta if isinstance(meta, dict) else {}


def stated_inputs(path: str | Path) -> dict[str, str]:
    """Return the inputs that a file was made from, name -> SHA-256; without those that it does not state as text."""
    inputs = read_meta(path).get("inputs")
    if not isinstance(inputs, dict):
        return {}
    return {name: text for name, text in inputs.items() if isinstance(text, str)}


def stated_doubts(path: str | Path) -> list[str]:
    """Return the doubts about demonstrations that a file made from them states in its configuration."""
    doubts = _stated(path, "doubts")
    if not isinstance(doubts, list):
        return []
    return [plain(text) for text in doubts if isinstance(text, str)]


def stated_meshes(path: str | Path) -> Path | None:
    """Return the folder of meshes that a file was made with, if the file states one that is still there; see
    :func:`stated_path`."""
    folder = _stated(path, "meshes")
    if not folder or not isinstance(folder, str):
        return None
    found = stated_path(folder, path)
    return None if found is None else Path(found)


def stated_robot(path: str | Path) -> str | None:
    """Return the name or folder of the robot that a file was made with, as it was given; None if the file does not
    state it."""
    robot = _stated(path, "robot")
    return robot if isinstance(robot, str) else None


def _stated(path: str | Path, name: str) -> Any:
    """Return an entry of the configuration that a file states; None if there is none."""
    config = read_meta(path).get("config")
    return config.get(name) if isinstance(config, dict) else None


def record_problem(cls: type, arrays: Arrays, check: Callable[[Arrays], str | None]) -> str | None:
    """Return what is wrong with the arrays of a dataclass of :func:`schema_of`'s kind, or None."""
    schema = schema_of(cls)
    for name, field in schema.items():
        if field.required and name not in arrays:
            return f"{name} is None, expected an array."
    return _wrong_shape(arrays, schema) or wrong_value(arrays, schema) or check(arrays)


def arrays_of(cls: type, record: Any) -> Arrays:
    """Return the arrays of a dataclass of :func:`schema_of`'s kind, as they are written.

    Raises:
        XResetError: the record is of another class, or a field is no array, so that its file could not be read.
    """
    if not isinstance(record, cls):
        raise XResetError(f"Found {shown(record)}, expected {cls.__name__}. Nothing was written.")
    arrays = {}
    for name, field in schema_of(cls).items():
        value = getattr(record, name)
        if value is not None:
            default = np.str_ if field.kind == "U" else None
            try:
                arrays[name] = np.asarray(value, dtype=field.dtype or default)
            except (TypeError, ValueError, RuntimeError) as error:  # such as a tensor of a GPU
                raise XResetError(
                    f"{name} is {shown(value)}, expected an array. Nothing was written."
                ) from error
    return arrays


def read_record(
    cls: type[T],
    path: str | Path,
    schema_name: str,
    *,
    what: str,
    check: Callable[[Arrays], str | None],
) -> T:
    """Read a dataclass of :func:`schema_of`'s kind; arguments and errors as of :func:`read_npz`."""
    arrays: dict[str, Any] = read_npz(path, schema_name, schema_of(cls), what=what, check=check)
    values = {}
    for name, hint in get_type_hints(cls).items():
        if name not in arrays:
            continue
        values[name] = arrays[name]
        if hint in (str, float):
            values[name] = hint(arrays[name])
        elif hint == tuple[str, ...]:
            values[name] = tuple(arrays[name].tolist())
    return cls(**values)
