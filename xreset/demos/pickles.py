"""Read pickled arrays of unknown origin without calling anything that a pickle names.

A pickle is a program that names functions and calls them. Here every call is recorded and none is made; afterwards
:func:`array_of` makes an array from the calls that numpy writes for one. numpy's own functions would not be safe: a
forged state of a dtype makes numpy take numbers for addresses.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from xreset.errors import DemoError
from xreset.files.text import shown

_MAX_BYTES = 1 << 20
"""Largest file; a frame of HO-3D has a few kilobytes."""
_NUMBERS = ("f4", "f8", "i4", "i8")


class _Call:
    """A function of the pickle, or a call of it, with the state that the pickle gives to the result."""

    def __init__(self, function: str, *arguments: Any) -> None:
        self.function = function
        self.arguments = arguments
        self.state: Any = None

    def __call__(self, *arguments: Any) -> _Call:
        return _Call(self.function, *arguments)

    def __setstate__(self, state: Any) -> None:
        self.state = state


# The unpickler in C reserves memory for any index that a file states.
class _Unpickler(pickle._Unpickler):
    dispatch: dict[int, Any] = pickle._Unpickler.dispatch.copy()
    # This operation makes an array of any length that a file states.
    dispatch.pop(pickle.BYTEARRAY8[0])

    def find_class(self, module: str, name: str) -> Any:
        if module.partition(".")[0] not in ("numpy", "_codecs"):
            raise ValueError(f"it asks for {shown(f'{module}.{name}')}, expected arrays only")
        return _Call(name)


def read_pickle(path: Path) -> dict[Any, Any]:
    """Read the dictionary of a pickle; arrays in it are for :func:`array_of`.

    Raises:
        DemoError: it is damaged, too large, no dictionary, or asks for anything but arrays.
    """
    try:
        with open(path, "rb") as file:
            content = file.read(_MAX_BYTES + 1)
        if len(content) > _MAX_BYTES:
            raise ValueError("it has more than a megabyte")
        if content[:2] == pickle.PROTO + b"\x05":
            raise ValueError("it is of protocol 5; save it with pickle.dump(..., protocol=4)")
        data = _Unpickler(io.BytesIO(content), encoding="latin-1").load()
        if not isinstance(data, dict):
            raise ValueError(f"it holds {shown(type(data).__name__)}, expected a dictionary")
        return data
    except Exception as error:  # a damaged pickle raises any kind of error
        raise DemoError(f"{path} cannot be read as pickled arrays: {shown(str(error))}.") from error


def array_of(call: Any) -> np.ndarray:
    """Return an array of numbers from numpy's calls; any kind of error if it is not one."""
    _, shape, dtype, is_fortran, data = call.state
    if isinstance(data, _Call):  # encode: bytes in a pickle for Python 2
        data = data.arguments[0]
    if isinstance(data, str):  # written by Python 2, or for it
        data = data.encode("latin-1")
    kind = dtype.arguments[0]
    if kind not in _NUMBERS:
        raise ValueError(f"an array of {shown(kind)}, expected numbers")
    numbers = np.dtype(kind).newbyteorder(">" if dtype.state[1] == ">" else "<")
    return np.frombuffer(data, dtype=numbers).reshape(shape, order="F" if is_fortran else "C")
