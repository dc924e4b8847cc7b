"""``xreset serve``."""

from __future__ import annotations

import logging
from pathlib import Path

from xreset.cli._common import Name, Several
from xreset.eval.export import deploy
from xreset.live import serve as server


def serve(
    policy: Name,
    *,
    host: str = "127.0.0.1",
    port: int = 8765,
    robot: str | None = None,
    objects: Path | None = None,
    object: Several = (),
) -> None:
    """Serve a policy to a robot's computer over a WebSocket (docs/live.md has the messages).

    Args:
        policy: Run folder, exported policy (.onnx), or name of a policy that ships with xreset (xreset policies list).
        host: Address to listen at. Any other than 127.0.0.1 lets other computers use the policy; there is no password.
        port: Port to listen at.
        robot: Name or folder of the robot; default: the policy's.
        objects: Folder of meshes; default: that of the training, else the stand-ins.
        object: Object that clients may name; give it again for more. Default: the objects of the training.
    """
    logging.basicConfig(format="%(message)s", level=logging.WARNING)
    spec, contract = deploy.served(policy, robot=robot, objects=objects, only=object)
    listening = server.PolicyServer(contract, spec.exported().read_bytes(), host=host, port=port)
    print(f"{spec.name} for {spec.robot.name} at {listening.url}, {contract['rate']:g} steps per second. Ctrl-C ends.")
    if host not in ("127.0.0.1", "localhost", "::1"):
        print("Every computer that reaches this address can use the policy. There is no password.")
    try:
        listening.run()
    except KeyboardInterrupt:  # the way to end it, not a failure
        print("\nclosed.")
    finally:
        listening.close()


COMMAND = serve
