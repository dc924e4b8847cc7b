"""Reading and writing of xreset's files: npz with a schema, JSON, always whole or not at all.

Every file carries ``schema`` (a name and version such as ``xreset-demos/1``) and, if xreset wrote it, ``meta``: a JSON text with the
configuration it was made with and the SHA-256 of its inputs. Arrays are never pickled. The same content gives the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from xreset import __version__
from xreset.errors import FileFormatError, XResetError


@dataclass(frozen=True)
class Field:
    """One array of a schema."""

    shape: tuple[str | int, ...]
    """Shape letters (the same letter must have the same length in every field; ``"F+1"`` is one more than F) or fixed lengths."""
    kind: str
    """numpy kinds that are allowed: ``f`` float, ``i`` integer, ``b`` bool, ``U`` text."""
    required: bool = True
    """Whether the file must have it."""


Schema = Mapping[str, Field]


@contextmanager
def atomic_write(path: str | Path, mode: str = "wb") -> Iterator[IO[Any]]:
    """Open a temporary file that becomes ``path`` when the block ends, and vanishes if the block raises.

    Raises:
        XResetError: if the file cannot be written (no such folder, no permission, disk full); ``path`` is then as it was before.
    """
    path = Path(path)
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        temporary = Path(name)
        with os.fdopen(descriptor, mode) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)
        temporary.replace(path)
    except OSError as error:
        reason = error.strerror or str(error)
        raise XResetError(f"cannot write {path}: {reason}. Nothing was changed; free some space or choose another place.") from error
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def write_json(path: str | Path, data: Any) -> None:
    """Write ``data`` as indented JSON; non-finite numbers are refused (``ValueError``)."""
    with atomic_write(path, "w") as file:
        file.write(json.dumps(data, indent=2, allow_nan=False) + "\n")


def read_json(path: str | Path, schema: str | None = None) -> dict[str, Any]:
    """Read a JSON object; with ``schema``, its ``schema`` entry must be that."""
    path = Path(path)
    _must_exist(path, "JSON file")
    try:
        data = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"{path} is not valid JSON ({error}). It may be truncated; make it again.") from error
    if not isinstance(data, dict):
        raise FileFormatError(f"{path} holds a JSON {type(data).__name__}, expected an object.")
    if schema is not None:
        _check_schema(path, data.get("schema"), schema)
    return data


def file_hash(path: str | Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


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
    path: str | Path, schema_name: str, schema: Schema, *, what: str, check: Callable[[dict[str, np.ndarray]], str | None] | None = None
) -> dict[str, np.ndarray]:
    """Read an npz file and check all of it before anything is used.

    Args:
        path: file.
        schema_name: schema that the file must state.
        schema: fields that it must have.
        what: what the file is, for messages ("a reset bank").
        check: further check; returns a message if something is wrong.

    Returns:
        Every array of the file, by name (``meta`` too, as text array, if present).

    Raises:
        FileFormatError: the file is damaged or does not match.
    """
    path = Path(path)
    _must_exist(path, what)
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:  # numpy leaves a file open that it cannot read
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise FileFormatError(f"{path} cannot be read as {what}: {error}. It is damaged or truncated, or not an npz file.") from error
    except Exception as error:  # zlib.error and others from damaged members
        raise FileFormatError(f"{path} cannot be read as {what}: {error}. It is damaged or truncated.") from error
    found = str(arrays["schema"]) if "schema" in arrays else None
    _check_schema(path, found, schema_name)
    problem = _match(arrays, schema) or (check(arrays) if check else None)
    if problem:
        raise FileFormatError(f"{path} is not valid as {what}: {problem}")
    return arrays


def npz_schema(path: str | Path) -> str:
    """The schema that an npz file states; its reader checks all the rest.

    Raises:
        FileFormatError: it is no npz file, or states none.
    """
    path = Path(path)
    if not path.is_file():
        raise FileFormatError(f"there is no file {path}. Check the path, or make the file first.")
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            return str(file["schema"])
    except Exception as error:  # zlib.error and others from damaged members
        raise FileFormatError(f"{path} is not one of xreset's npz files, or it is damaged ({error}). Is it the right file?") from error


def meta_of(arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Provenance of a file read with :func:`read_npz`: ``{"xreset", "config", "inputs"}``; empty if it has none."""
    return json.loads(str(arrays["meta"])) if "meta" in arrays else {}


def _must_exist(path: Path, what: str) -> None:
    if not path.exists():
        raise FileFormatError(f"there is no {path} ({what}). Check the path, or make the file first.")
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder, expected a file ({what}).")


def _check_schema(path: Path, found: Any, expected: str) -> None:
    if found == expected:
        return
    name, _, version = expected.rpartition("/")
    if isinstance(found, str) and found.rpartition("/")[0] == name:
        raise FileFormatError(f"{path} has schema version {found!r}; this xreset ({__version__}) reads {expected!r}. Make the file again.")
    stated = f"states schema {found!r}" if found else "states no schema"
    raise FileFormatError(f"{path} {stated}, expected {expected!r} (version {version} of {name}). Is it the right file?")


_KINDS = {"f": "floating-point", "i": "integer", "u": "unsigned", "b": "bool", "U": "text"}


def _match(arrays: Mapping[str, np.ndarray], schema: Schema) -> str | None:
    lengths: dict[str, tuple[int, str]] = {}
    for name, field in schema.items():
        if name not in arrays:
            if field.required:
                return f"it has no array {name!r}; found {', '.join(sorted(arrays))}."
            continue
        array = arrays[name]
        kinds = field.kind + ("u" if "i" in field.kind else "")
        if array.dtype.kind not in kinds:
            wanted = " or ".join(_KINDS[k] for k in field.kind)
            return f"array {name!r} has type {array.dtype}, expected {wanted}."
        if array.ndim != len(field.shape):
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
