"""Pickled arrays of numpy, scipy, torch and chumpy, read without any other function that a pickle names.

A pickle names functions and calls them. Here it may only name those that make arrays. This is no full protection: take
files from the data sets' own sites.
"""

import io
import pickle
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

_ALLOWED = {
    "numpy": {"dtype", "ndarray"},
    "numpy.core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "scipy.sparse.csc": {"csc_matrix"},
    "scipy.sparse._csc": {"csc_matrix"},
    "torch._utils": {"_rebuild_tensor_v2"},
    "collections": {"OrderedDict"},
    "_codecs": {"encode"},
}


class _Chumpy:
    """An array of chumpy, or some elements of one; chumpy itself does not run on today's Python."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.state = state

    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        if "x" in self.state:
            return np.asarray(self.state["x"], dtype=dtype)
        chosen = np.asarray(self.state["a"]).ravel()[np.asarray(self.state["idxs"])]
        return chosen.reshape(self.state["preferred_shape"]).astype(dtype or float)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in (("chumpy.ch", "Ch"), ("chumpy.reordering", "Select")):
            return _Chumpy
        if (module, name) == ("torch.storage", "_load_from_bytes"):
            return _torch_storage
        if name not in _ALLOWED.get(module, ()):
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, expected arrays only")
        return super().find_class(module.replace("scipy.sparse.csc", "scipy.sparse"), name)


def _torch_storage(content: bytes) -> Any:
    import torch

    return torch.load(io.BytesIO(content), weights_only=True, map_location="cpu")


def load_pickle(path: Path) -> Any:
    """Read a pickle of arrays, also one of Python 2."""
    with open(path, "rb") as file:
        return _Unpickler(file, encoding="latin1").load()


def load_npy(file: BinaryIO) -> Any:
    """Read an npy file that may hold a dictionary, as ``numpy.save`` pickles it."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0
    if version == (2, 0):
        read_header = np.lib.format.read_array_header_2_0
    _, _, dtype = read_header(file)
    if not dtype.hasobject:
        file.seek(0)
        return np.load(file)
    array = _Unpickler(file, encoding="latin1").load()
    return array.item() if array.shape == () else array
