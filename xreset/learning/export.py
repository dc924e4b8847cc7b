"""Export of policies to ONNX, with all that another engine needs to run them unchanged."""

from __future__ import annotations

from pathlib import Path

import torch
from tensordict import TensorDict

from xreset.files.checks import Onnx, obeys_rules
from xreset.files.storage import file_hash, must_exist, write_whole
from xreset.learning.checkpoint import must_fit, read_checkpoint
from xreset.learning.model import ExportedPolicy, PointNetLstmModel, make_actor
from xreset.learning.run import RunInfo, read_run
from xreset.policy.onnx_policy import (
    CHECKPOINT_KEY,
    INPUTS,
    OUTPUTS,
    Contract,
    contract_metadata,
    observation_shapes,
    picture_shape,
)
from xreset.policy.to_onnx import exported_module


def exported(
    actor: PointNetLstmModel, contract: Contract, *, checkpoint: Path | None = None
) -> bytes:
    """Return the deterministic policy as the content of one ONNX file.

    Args:
        actor: trained actor.
        contract: what the policy needs to run: see :func:`xreset.policy.onnx_policy.policy_contract`.
        checkpoint: file with the actor's weights, of which the policy states the hash; None: there is none.
    """
    import onnx

    policy = ExportedPolicy(actor)
    n = 2  # an example batch that is not 1, so that the exporter keeps the world dimension free
    state = torch.zeros(1, n, policy.lstm_dim)
    values = (
        torch.zeros(n, policy.flat_dim),
        torch.zeros(n, *picture_shape(contract.task)),
        state,
        state.clone(),
    )
    example: dict[str, torch.Tensor] = dict(zip(INPUTS, values, strict=True))
    model = exported_module(policy, example, OUTPUTS, state=INPUTS[2:])
    entries = contract_metadata(contract)
    if checkpoint is not None:
        entries[CHECKPOINT_KEY] = file_hash(checkpoint)
    onnx.helper.set_model_props(model, entries)
    return model.SerializeToString()


@obeys_rules
def export_checkpoint(checkpoint: str | Path, policy: Onnx) -> None:
    """Write the policy of one checkpoint of a training as an ONNX file.

    :func:`~xreset.eval.policy_spec.load_policy` takes a checkpoint as well, and the newest one of a run folder.

    Args:
        checkpoint: file ``RUN/checkpoints/NUMBER.pt`` in the training's run folder.
        policy: file to write, which ends in ``.onnx``.

    Raises:
        RunError: the checkpoint is not in a run folder, or does not fit the run.
        FileFormatError: there is no such checkpoint, or it or the run's description is damaged.
        XResetError: the name of the policy does not end in ``.onnx``, or the file cannot be written.
    """
    path = Path(checkpoint)
    must_exist(path, "checkpoint")
    write_whole(policy, exported_checkpoint(path, read_run(path.parent.parent)))


def exported_checkpoint(checkpoint: Path, run: RunInfo) -> bytes:
    """Return the content of the file that :func:`export_checkpoint` writes; ``run``: the checkpoint's training."""
    weights = read_checkpoint(checkpoint).policy_state_dict
    shapes = observation_shapes(run.contract, str(checkpoint))
    example = TensorDict(
        {name: torch.zeros(1, *shape) for name, shape in shapes.items()}, batch_size=[1]
    )
    actor = make_actor(example, run.contract.num_actions, run.config)
    with must_fit(checkpoint):
        actor.load_state_dict(weights)
    return exported(actor, run.contract, checkpoint=checkpoint)
