"""Write policies for robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.live.deploy import write_deployed
from xreset.objects.catalogue import load_objects


def export_deploy(
    policy: str | Path | PolicySpec,
    out: str | Path,
    *,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    only: Sequence[str] = (),
) -> PolicySpec:
    """Write a policy for a robot: ``policy.onnx``, from readings to joint targets, and the package ``runtime``, which
    needs numpy and onnxruntime (``docs/live.md``).

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`; no baseline.
        out: folder to write; must not exist, or be empty.
        robot: name or folder of the robot; default: the policy's own.
        meshes: folder of object meshes; default: the folder of the policy's training, else the stand-ins.
        only: names of the objects whose points the contract lists; default: the objects of the training.

    Returns:
        The policy.

    Raises:
        PolicyError: the policy is a baseline or looks through cameras, or the folder is not empty.
        ObjectError: there is neither a stand-in nor a mesh of an object.
    """
    spec = load_policy(policy, robot=robot)
    folder = spec.meshes_folder(meshes)
    write_deployed(spec.deployed(load_objects(only or spec.objects_of(folder), folder)), Path(out))
    return spec
