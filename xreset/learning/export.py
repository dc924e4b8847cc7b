"""Export of a policy to ONNX, with all that another engine needs to run it unchanged."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import tempfile
import warnings
from pathlib import Path
from typing import Any

import torch

from xreset.checks import from_dict
from xreset.files import atomic_write
from xreset.learning.model import PointNetLstmModel
from xreset.learning.shrink import drop_exporter_notes
from xreset.policy import INPUTS, METADATA_KEY, OUTPUTS
from xreset.task.config import ObservationConfig


def export_onnx(actor: PointNetLstmModel, path: str | Path, contract: dict[str, Any]) -> None:
    """Write the deterministic policy as one ONNX file.

    Args:
        actor: trained actor.
        path: file to write.
        contract: what the policy needs to run: see :func:`xreset.policy.policy_contract`.
    """
    import onnx

    policy = actor.as_onnx()
    observation = from_dict(
        ObservationConfig, contract["task"]["observation"], "the policy's contract: task.observation"
    )
    n = 2  # an example batch that is not 1, so that the exporter keeps the world dimension free
    state = torch.zeros(1, n, policy.lstm_dim)  # pyright: ignore[reportArgumentType, reportCallIssue]
    example = (torch.zeros(n, policy.flat_dim), torch.zeros(n, *observation.cloud_shape), state, state.clone())  # pyright: ignore[reportArgumentType, reportCallIssue]
    worlds = torch.export.Dim("worlds", min=1, max=65536)
    shapes = ({0: worlds}, {0: worlds}, {1: worlds}, {1: worlds})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "policy.onnx"
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()), torch.no_grad():
            warnings.simplefilter("ignore")
            torch.onnx.export(
                policy,
                example,
                str(file),
                input_names=list(INPUTS),
                output_names=list(OUTPUTS),
                dynamic_shapes=shapes,
                external_data=False,
                dynamo=True,
                verbose=False,
            )
        model = onnx.load(str(file))
    drop_exporter_notes(model)
    entry = model.metadata_props.add()
    entry.key, entry.value = METADATA_KEY, json.dumps(contract, sort_keys=True)
    with atomic_write(path) as out:
        out.write(model.SerializeToString())
