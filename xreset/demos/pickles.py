"""Pickled arrays of strangers, read by something that can build nothing else.

A pickle is a program: it names functions and calls them. Here it finds only those that numpy's arrays need, and these are our own: they
check shape, kind and length of the data before they make an array of it. Texts, numbers, lists and dictionaries need no function.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from xreset.errors import DemoError
from xreset.files import max_bytes
from xreset.text import shown

_KINDS = "fiub"


class _Kind:
    """Stands for ``numpy.dtype``: numbers and truth values only."""

    def __init__(self, text: str, *_: Any) -> None:
        self.dtype = np.dtype(text) if isinstance(text, str) and text[:1] in _KINDS and text[1:].isdecimal() else None
        if self.dtype is None:
            raise ValueError(f"an array of {shown(text)}, expected numbers")

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        assert self.dtype is not None
        self.dtype = self.dtype.newbyteorder(">" if state[1] == ">" else "<")


class _Array:
    """Stands for ``numpy.ndarray`` while it is built."""

    value: np.ndarray | None = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, kind, fortran, data = state
        self.value = _numbers(data, kind, shape, "F" if fortran else "C")


def _numbers(data: Any, kind: Any, shape: Any, order: str) -> np.ndarray:
    if isinstance(data, str):  # written by Python 2
        data = data.encode("latin-1")
    if not isinstance(kind, _Kind) or not isinstance(data, bytes | bytearray) or not isinstance(shape, tuple):
        raise ValueError("an array that is not made of plain numbers")
    return np.frombuffer(bytes(data), dtype=kind.dtype).reshape(shape, order="F" if order == "F" else "C")


def _reconstruct(*_: Any) -> _Array:
    return _Array()


def _scalar(kind: Any, data: Any) -> _Array:
    found = _Array()
    found.value = _numbers(data, kind, (), "C")
    return found


def _frombuffer(data: Any, kind: Any, shape: Any, order: str) -> _Array:
    found = _Array()
    found.value = _numbers(data, kind, shape, order)
    return found


def _encode(text: Any, encoding: Any) -> bytes:
    """``_codecs.encode``, by which Python 3 writes bytes for Python 2."""
    if encoding != "latin1" or not isinstance(text, str):
        raise ValueError(f"a text to be encoded as {shown(encoding)}")
    return text.encode("latin-1")


def _empty() -> bytes:
    """``bytes``, by which Python 3 writes no bytes for Python 2."""
    return b""


_FUNCTIONS = {
    ("__builtin__", "bytes"): _empty,
    ("numpy", "ndarray"): _Array,
    ("numpy", "dtype"): _Kind,
    ("_codecs", "encode"): _encode,
} | {
    (f"numpy.{core}.{module}", name): function
    for core in ("core", "_core")
    for module, name, function in (
        ("multiarray", "_reconstruct", _reconstruct),
        ("multiarray", "scalar", _scalar),
        ("numeric", "_frombuffer", _frombuffer),
    )
}


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _FUNCTIONS:
            raise ValueError(f"it asks for {shown(f'{module}.{name}')}, expected arrays only")
        return _FUNCTIONS[module, name]

    def persistent_load(self, pid: Any) -> Any:
        raise ValueError("it refers to something outside")


def read_pickle(path: Path) -> dict[str, Any]:
    """The dictionary of a pickle: texts, numbers, None and arrays by name.

    Raises:
        DemoError: it is damaged, too large, no dictionary, or asks for anything but arrays.
    """
    try:
        if path.stat().st_size > max_bytes():
            raise DemoError(f"{path} has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows.")
        data = _Reader(io.BytesIO(path.read_bytes()), encoding="latin-1").load()
    except (DemoError, MemoryError):
        raise
    except Exception as error:  # a damaged pickle raises almost anything
        raise DemoError(f"{path} cannot be read as pickled arrays: {shown(str(error))}.") from error
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        raise DemoError(f"{path} holds {shown(type(data).__name__)}, expected a dictionary with names.")
    return {name: value.value if isinstance(value, _Array) else value for name, value in data.items()}
