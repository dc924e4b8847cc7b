"""``xreset play``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from xreset.eval.play import run


def play(
    policy: Annotated[str, tyro.conf.Positional] = "nine-objects",
    *,
    object: str | None = None,
    backend: str = "mujoco",
    robot: str | None = None,
    demos: Path | None = None,
    objects: Path | None = None,
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Play with a policy in a browser: drag the goal, push the object or the robot, change the engine.

    Args:
        policy: Run folder, exported policy (.onnx), name of a policy that ships with xreset (xreset policies list), or
            a baseline: zero, random.
        object: Object to begin with; default: the soup can, or else the first one.
        backend: Physics engine to begin with.
        robot: Robot; default: the policy's own.
        demos: Starts and goals: demonstrations, robot motion or reset states. Default: synthetic demonstrations.
        objects: Folder of real meshes; default: the folder of the policy's training, or the built-in stand-ins.
        seed: Chooses starts and goals.
        host: Address to serve at; 0.0.0.0 allows other machines.
        port: Port to serve at; if it is taken, the next free one.
    """
    run.play(
        policy,
        thing=object,
        engine=backend,
        robot=robot,
        demos=demos,
        objects=objects,
        seed=seed,
        host=host,
        port=port,
    )


COMMAND = play
