"""``xreset play``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Host, Policy, Port, Robot, TrainedObjects


def play(
    policy: Policy = "many-objects",
    *,
    object: str | None = None,
    backend: str = "mujoco",
    robot: Robot = None,
    demos: Path | None = None,
    objects: TrainedObjects = None,
    seed: int = 0,
    host: Host = "127.0.0.1",
    port: Port = 8080,
) -> None:
    """Play with a policy in a browser: drag the goal, push the object or the robot, change the engine.

    Args:
        object: Object to begin with; default: the soup can, or else the first one.
        backend: Physics engine to begin with.
        demos: Starts and goals: demonstrations, robot motion, reset states or a goal set. Default: synthetic
            demonstrations.
        seed: Seed of starts and goals.
    """
    from xreset.eval.play import page

    page.play(
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
