"""Export torch modules to ONNX."""

from __future__ import annotations

import contextlib
import io
import logging
import warnings
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from xreset.errors import PolicyError, needs

if TYPE_CHECKING:
    from onnx import ModelProto


def exported_module(
    module: nn.Module,
    example: dict[str, Tensor],
    outputs: Sequence[str],
    *,
    state: Sequence[str] = (),
    opset: int | None = None,
) -> ModelProto:
    """Return a module as an ONNX model with any number of worlds N, without the exporter's notes.

    Args:
        module: the module, in evaluation mode.
        example: name and example of each input [N, ...]; N is not 1, or the exporter fixes it.
        outputs: names of the outputs.
        state: names of the inputs [1, N, ...], whose second dimension is N.
        opset: version of the operators; None: the exporter's default.

    Raises:
        PolicyError: onnx or onnxscript is missing.
    """
    with needs("onnxscript", "deploy", PolicyError):
        import onnxscript  # noqa: F401  torch's exporter needs it

    worlds = torch.export.Dim("worlds", min=1, max=65536)
    with _quiet(), torch.no_grad():
        program = torch.onnx.export(
            module,
            tuple(example.values()),
            input_names=list(example),
            output_names=list(outputs),
            dynamic_shapes=tuple({1 if name in state else 0: worlds} for name in example),
            opset_version=opset,
            dynamo=True,
            verbose=False,
        )
    assert program is not None, "dynamo returns the graph"
    model = program.model_proto
    _drop_notes(model)
    return model


def _drop_notes(model: ModelProto) -> None:
    """Remove, in place, the exporter's notes on nodes and values: lines of source code with paths of its machine."""
    graph = model.graph
    for noted in (
        graph,
        *graph.node,
        *graph.input,
        *graph.output,
        *graph.value_info,
        *graph.initializer,
    ):
        del noted.metadata_props[:]
        noted.doc_string = ""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep the exporter's warnings and progress from the terminal."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
            warnings.simplefilter("ignore")
            yield
    finally:
        logger.setLevel(level)
