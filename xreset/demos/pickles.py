"""Read pickled arrays of unknown origin with an unpickler that can build nothing else.

A pickle is a program that names functions and calls them. Here it finds only those that numpy's arrays need, and they
are replaced by functions that check kind, shape and length of the data before they make an array. Texts, numbers, lists
and dictionaries need no function.
"""

from __future__ import annotations

import io
import pickle
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from xreset.errors import DemoError
from xreset.files import max_bytes
from xreset.text import shown

_KINDS = "fiub"
_PER_BYTE = 64
"""Bytes of memory that a byte of a pickle may take: one byte makes an empty list."""


class _Dtype:
    """Replaces ``numpy.dtype``: numbers and truth values only."""

    def __init__(self, text: str, *_: Any) -> None:
        if not isinstance(text, str) or text[:1] not in _KINDS or not text[1:].isdecimal():
            raise ValueError(f"an array of {shown(text)}, expected numbers")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.dtype = self.dtype.newbyteorder(">" if state[1] == ">" else "<")


class _Array:
    """Replaces ``numpy.ndarray``. The array is made when it is asked for: many may share one text of the file."""

    data: Any = None
    dtype: Any = None
    shape: Any = ()
    order: Any = "C"

    def __init__(self, *_: Any) -> None:
        pass  # numpy's _reconstruct, which passes a type and a shape that do not matter

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, self.shape, self.dtype, fortran, self.data = state
        self.order = "F" if fortran else "C"

    @cached_property
    def value(self) -> np.ndarray:
        data = self.data
        if isinstance(data, str):  # written by Python 2, or for it
            data = data.encode("latin-1")
        is_plain = isinstance(self.dtype, _Dtype) and isinstance(self.shape, tuple)
        if not is_plain or not isinstance(data, bytes | bytearray):
            raise ValueError("an array that is not made of plain numbers")
        order = "F" if self.order == "F" else "C"
        return np.frombuffer(data, dtype=self.dtype.dtype).reshape(self.shape, order=order)


def _array(data: Any, dtype: Any, shape: Any = (), order: Any = "C") -> _Array:
    """Replaces numpy's ``scalar`` and ``_frombuffer``."""
    found = _Array()
    found.data = data
    found.dtype = dtype
    found.shape = shape
    found.order = order
    return found


def _encode(text: Any, encoding: Any) -> str:
    """Replaces ``_codecs.encode``, with which Python 3 writes bytes for Python 2: the text stands for its bytes."""
    if encoding != "latin1" or not isinstance(text, str):
        raise ValueError(f"a text to be encoded as {shown(encoding)}")
    return text


_FUNCTIONS: dict[str, Any] = {
    "__builtin__.bytes": lambda: b"",  # with which Python 3 writes no bytes for Python 2
    "_codecs.encode": _encode,
    "numpy.ndarray": _Array,
    "numpy.dtype": _Dtype,
}
for _core in ("numpy.core", "numpy._core"):
    _FUNCTIONS[f"{_core}.multiarray._reconstruct"] = _Array
    _FUNCTIONS[f"{_core}.multiarray.scalar"] = lambda dtype, data: _array(data, dtype)
    _FUNCTIONS[f"{_core}.numeric._frombuffer"] = _array


class _Unpickler(pickle._Unpickler):  # the one in Python: the one in C reserves memory for values that never come
    dispatch: dict[int, Any] = pickle._Unpickler.dispatch.copy()

    def find_class(self, module: str, name: str) -> Any:
        function = f"{module}.{name}"
        if function not in _FUNCTIONS:
            raise ValueError(f"it asks for {shown(function)}, expected arrays only")
        return _FUNCTIONS[function]

    def persistent_load(self, pid: Any) -> Any:
        raise ValueError("it refers to something outside")

    def load_bytearray(self) -> None:
        """Read first, then make the array: the inherited method makes an array of any size that a file states."""
        size = int.from_bytes(self.read(8), "little")  # pyright: ignore[reportAttributeAccessIssue]
        self.append(bytearray(self.read(size)))  # pyright: ignore[reportAttributeAccessIssue]

    dispatch[pickle.BYTEARRAY8[0]] = load_bytearray


def read_pickle(path: Path) -> dict[str, Any]:
    """Read the dictionary of a pickle: texts, numbers, None and arrays by name.

    Raises:
        DemoError: it is damaged, too large, no dictionary, or asks for anything but arrays.
    """
    try:
        if path.stat().st_size > max_bytes() // _PER_BYTE:
            raise ValueError(f"it has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows")
        # a file in memory reserves no memory for what it does not hold
        data = _Unpickler(io.BytesIO(path.read_bytes()), encoding="latin-1").load()
        if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
            raise ValueError(f"it holds {shown(type(data).__name__)}, expected a dictionary with names")
        return _with_arrays(data)
    except MemoryError:
        raise
    except Exception as error:  # a damaged pickle raises any kind of error
        raise DemoError(f"{path} cannot be read as pickled arrays: {shown(str(error))}.") from error


def _with_arrays(data: dict[str, Any]) -> dict[str, Any]:
    left = max_bytes() // _PER_BYTE
    found = {}
    for name, value in data.items():
        if isinstance(value, _Array):
            value = value.value
            left -= value.nbytes
            if left < 0:
                raise ValueError("its arrays take more memory than XRESET_MAX_FILE_MB allows")
        found[name] = value
    return found
