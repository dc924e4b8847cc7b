"""Play with a policy in a browser, from Python."""

from __future__ import annotations

from pathlib import Path

from xreset.eval.play.page import Page
from xreset.eval.play.session import Session
from xreset.eval.policy_spec import PolicySpec
from xreset.pictures.view.server import serve_until_interrupted
from xreset.tensors import one_thread


def play(
    policy: str | Path | PolicySpec = "many-objects",
    *,
    thing: str | None = None,
    engine: str = "mujoco",
    robot: str | Path | None = None,
    demos: str | Path | None = None,
    objects: str | Path | None = None,
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int = 8080,
) -> None:
    """Serve a live episode as a web page until Ctrl-C. Its visitors drag the goal and disturb the robot.

    Args:
        policy: as for :func:`~xreset.eval.policy_spec.load_policy`.
        thing: name of the object to begin with; None: the soup can, or else the first object.
        engine: name of the engine to begin with.
        robot: default: the policy's.
        demos: starts and goals, from a file of demonstrations, motion or reset states; None: synthetic ones.
        objects: folder of object meshes; None: the folder of the policy's training, or the stand-ins.
        seed: chooses starts and goals.
        host: address to serve at; 0.0.0.0 allows other machines.
        port: port to serve at; if it is taken, the next free one.

    Raises:
        XResetError: something cannot be loaded, or the server does not start.
    """
    print("Loading the policy, the object and the engine ...", flush=True)
    with one_thread():
        session = Session(
            policy,
            thing=thing,
            engine=engine,
            robot=robot,
            demos=Path(demos) if demos else None,
            objects=Path(objects) if objects else None,
            seed=seed,
        )
        try:
            page = Page(session, host=host, port=port)
            print(f"{session.policy.name} plays at {page.url}. Ctrl-C ends.", flush=True)
            serve_until_interrupted(page)
        finally:
            session.close()
