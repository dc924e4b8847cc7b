"""``xreset serve``."""

from __future__ import annotations

import logging

from xreset.cli._common import Policy, Robot, Several, TrainedMeshes
from xreset.files.checks import Port


def serve(
    policy: Policy,
    *,
    host: str = "127.0.0.1",
    port: Port = 8765,
    robot: Robot = None,
    meshes: TrainedMeshes = None,
    object: Several = (),
) -> None:
    """Serve a policy to a robot's computer over a WebSocket (docs/live.md has the messages).

    Args:
        host: Address to listen at. Any other than 127.0.0.1 lets other computers use the policy; there is no password.
        port: Port to listen at.
        object: Object that clients may name; give it again for more. Default: the objects of the training.
    """
    from xreset.eval.export import deploy

    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    deploy.serve(policy, host=host, port=port, robot=robot, meshes=meshes, only=object)


COMMAND = serve
