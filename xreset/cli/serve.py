"""``xreset serve``."""

from __future__ import annotations

import logging

from xreset.cli._common import Policy, Robot, Several, TrainedObjects
from xreset.live import serve as server


def serve(
    policy: Policy,
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    robot: Robot = None,
    objects: TrainedObjects = None,
    object: Several = (),
) -> None:
    """Serve a policy to a robot's computer over a WebSocket (docs/live.md has the messages).

    Args:
        host: Address to listen at. Any other than 127.0.0.1 lets other computers use the policy; there is no password.
        port: Port to listen at.
        object: Object that clients may name; give it again for more. Default: the objects of the training.
    """
    from xreset.eval.export import deploy
    from xreset.pictures.view import server as pages

    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    spec, contract = deploy.served(policy, robot=robot, objects=objects, only=object)
    listening = server.PolicyServer(contract, spec.exported().read_bytes(), host=host, port=port)
    print(
        f"{spec.name} for {spec.robot.name} at {listening.url}, {contract['rate']:g} steps per second. Ctrl-C ends."
    )
    if host not in ("127.0.0.1", "localhost", "::1"):
        print("Every computer that reaches this address can use the policy. There is no password.")
    pages.serve_until_interrupted(listening)


COMMAND = serve
