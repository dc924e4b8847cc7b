"""Read pickled arrays of unknown origin with an unpickler that can build nothing else.

A pickle is a program that names functions and calls them. Here it finds only those that numpy's arrays need, and they
are replaced by functions that check kind, shape and length of the data before they make an array. Texts, numbers, lists
and dictionaries need no function.
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


class _Dtype:
    """Replaces ``numpy.dtype``: numbers and truth values only."""

    def __init__(self, text: str, *_: Any) -> None:
        if not isinstance(text, str) or text[:1] not in _KINDS or not text[1:].isdecimal():
            raise ValueError(f"an array of {shown(text)}, expected numbers")
        self.dtype = np.dtype(text)

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.dtype = self.dtype.newbyteorder(">" if state[1] == ">" else "<")


class _Array:
    """Replaces ``numpy.ndarray`` while it is built."""

    value: np.ndarray | None = None

    def __init__(self, *_: Any) -> None:
        pass  # numpy's _reconstruct, which passes a type and a shape that do not matter

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran else "C").value


def _array(data: Any, dtype: Any, shape: Any = (), order: Any = "C") -> _Array:
    """Replaces numpy's ``scalar`` and ``_frombuffer``."""
    if isinstance(data, str):  # written by Python 2
        data = data.encode("latin-1")
    if not isinstance(dtype, _Dtype) or not isinstance(data, bytes | bytearray) or not isinstance(shape, tuple):
        raise ValueError("an array that is not made of plain numbers")
    found = _Array()
    found.value = np.frombuffer(bytes(data), dtype=dtype.dtype).reshape(shape, order="F" if order == "F" else "C")
    return found


def _encode(text: Any, encoding: Any) -> bytes:
    """Replaces ``_codecs.encode``, with which Python 3 writes bytes for Python 2."""
    if encoding != "latin1" or not isinstance(text, str):
        raise ValueError(f"a text to be encoded as {shown(encoding)}")
    return text.encode("latin-1")


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
        if path.stat().st_size > max_bytes():
            raise ValueError(f"it has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows")
        # a file in memory reserves no memory for what it does not hold
        data = _Unpickler(io.BytesIO(path.read_bytes()), encoding="latin-1").load()
    except MemoryError:
        raise
    except Exception as error:  # a damaged pickle raises any kind of error
        raise DemoError(f"{path} cannot be read as pickled arrays: {shown(str(error))}.") from error
    if not isinstance(data, dict) or not all(isinstance(name, str) for name in data):
        raise DemoError(f"{path} holds {shown(type(data).__name__)}, expected a dictionary with names.")
    return {name: value.value if isinstance(value, _Array) else value for name, value in data.items()}
