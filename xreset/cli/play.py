"""``xreset play``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Host, Policy, Port, Robot, TrainedMeshes
from xreset.files.checks import Seed


def play(
    policy: Policy = "many-objects",
    *,
    object: str | None = None,
    engine: str = "mujoco",
    robot: Robot = None,
    demos: Path | None = None,
    meshes: TrainedMeshes = None,
    seed: Seed = 0,
    host: Host = "127.0.0.1",
    port: Port = 8080,
) -> None:
    """Play with a policy in a browser: drag the goal, push the object or the robot, change the engine.

    Args:
        object: Object to begin with; default: the soup can, or else the first one.
        engine: Physics engine to begin with.
        demos: Starts and goals: demonstrations, robot motion, reset states or a goal set. Default: synthetic
            demonstrations.
        seed: Seed of starts and goals.
    """
    from xreset.eval.play import page

    page.play(
        policy,
        object_name=object,
        engine=engine,
        robot=robot,
        demos=demos,
        meshes=meshes,
        seed=seed,
        host=host,
        port=port,
    )


COMMAND = play
