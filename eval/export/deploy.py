"""Write policies for robots."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.live.deploy import deploy_contract, write_deployed
from xreset.objects.catalogue import load_objects


def export_deploy(
    policy: str | Path | PolicySpec,
    out: str | Path,
    *,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    only: Sequence[str] = (),
) -> PolicySpec:
    """Write a policy for a robot: ``policy.onnx``, ``contract.json`` and the package ``runtime``, which needs numpy
    and onnxruntime (``docs/live.md``).

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
    spec, contract = served(policy, robot=robot, meshes=meshes, only=only)
    write_deployed(spec.exported(), contract, Path(out))
    return spec


def served(
    policy: str | Path | PolicySpec,
    *,
    robot: str | Path | None,
    meshes: str | Path | None,
    only: Sequence[str],
) -> tuple[PolicySpec, dict[str, Any]]:
    """Return a policy and its contract, for :class:`xreset.live.serve.PolicyServer`; see :func:`export_deploy`."""
    spec = load_policy(policy, robot=robot)
    folder = spec.meshes_folder(meshes)
    listed = load_objects(only or spec.objects_of(folder), folder)
    return spec, deploy_contract(spec.robot, spec.task, listed, spec.exported())


def serve(
    policy: str | Path | PolicySpec,
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    only: Sequence[str] = (),
) -> None:
    """Serve a policy to a robot's computer over a WebSocket until Ctrl-C (``docs/live.md`` has the messages). It may
    run in a thread, such as that of a notebook.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`; no baseline.
        host: address to listen at. Any other than 127.0.0.1 lets other computers use the policy; there is no password.
        port: port to listen at.
        robot: name or folder of the robot; default: the policy's own.
        meshes: folder of object meshes; default: the folder of the policy's training, else the stand-ins.
        only: names of the objects that clients may name; default: the objects of the training.

    Raises:
        PolicyError: the policy is a baseline or looks through cameras.
        XResetError: the port is taken or impossible, the address is not this machine's, or websockets is missing.
    """
    from xreset.live import serve as server  # which needs websockets
    from xreset.pictures.view import server as pages

    spec, contract = served(policy, robot=robot, meshes=meshes, only=only)
    listening = server.PolicyServer(contract, spec.exported(), host=host, port=port)
    print(
        f"{spec.name} for {spec.robot.name} at {listening.url}, {contract['rate']:g} steps per second. Ctrl-C ends."
    )
    if host not in ("127.0.0.1", "localhost", "::1"):
        print("Every computer that reaches this address can use the policy. There is no password.")
    pages.serve_until_interrupted(listening)
