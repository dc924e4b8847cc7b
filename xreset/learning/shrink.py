"""Exported policies at half the size: weight matrices are stored in float16 and used in float32.

Each weight becomes the nearest float16 number, and a Cast to float32 comes before its first use; the runtime does these
casts once, when it loads the file. The error of a rounded weight is at most 2^-11 of its size (2^-25 below 6e-5).
Biases and the normalization of observations stay float32: they are few, and training does not bound their range.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.errors import PolicyError, needs
from xreset.files import atomic_write
from xreset.policy import OnnxPolicy

if TYPE_CHECKING:
    from onnx import ModelProto

_SUFFIX = "_float16"


def shrink(source: str | Path, path: str | Path) -> None:
    """Write an exported policy with its weight matrices in float16; contract, inputs and outputs do not change.

    Args:
        source: policy as exported (``.onnx``).
        path: file to write; may be the source.

    Raises:
        PolicyError: the source is missing, damaged or not a policy, has no float32 matrix, or one that float16 cannot
            hold.
        XResetError: the file cannot be written.
    """
    OnnxPolicy(source)  # refuses other files
    with needs("onnx", "train", PolicyError):
        import onnx
    model = onnx.load(str(source))
    if not halve_matrices(model, str(source)):
        raise PolicyError(f"{source} holds no weight matrix in float32: it was shrunk before. Use the file as it is.")
    drop_exporter_notes(model)
    with atomic_write(path) as out:
        out.write(model.SerializeToString())


def halve_matrices(model: ModelProto, source: str) -> int:
    """Store every float32 matrix of the model in float16, in place; return their number.

    Args:
        model: the model.
        source: where it comes from, for messages.

    Raises:
        PolicyError: a weight is too large for float16.
    """
    from onnx import TensorProto, helper, numpy_helper

    graph = model.graph
    casts = []
    for weights in graph.initializer:
        if weights.data_type != TensorProto.FLOAT or len(weights.dims) != 2 or min(weights.dims) == 1:
            continue
        name = weights.name
        exact = numpy_helper.to_array(weights)
        with np.errstate(over="ignore"):
            rounded = exact.astype(np.float16)
        if not np.isfinite(rounded).all():
            raise PolicyError(
                f"{source} has weights up to {np.abs(exact).max():.3g} in {name}, float16 ends at 65504. "
                "Use the file as it was exported, or an earlier checkpoint."
            )
        weights.CopyFrom(numpy_helper.from_array(rounded, name + _SUFFIX))
        casts.append(
            helper.make_node("Cast", [name + _SUFFIX], [name], name=f"{name}_to_float32", to=TensorProto.FLOAT)
        )
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return len(casts)


def drop_exporter_notes(model: ModelProto) -> None:
    """Remove, in place, the exporter's notes on nodes and values: lines of source code with paths of its machine."""
    graph = model.graph
    for noted in (graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        del noted.metadata_props[:]
        noted.doc_string = ""
