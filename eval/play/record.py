"""Save what happened in a session: a film, or a file with all numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

import numpy as np

from xreset.errors import XResetError
from xreset.eval.play.session import Moment, Session
from xreset.files.storage import write_whole
from xreset.pictures.render import Renderer, encode_mp4
from xreset.spec import SceneSpec

FRAMES_PER_SECOND = 20.0
SIZE = (640, 480)
"""Width and height of a film [pixels]."""


def write_trace(path: str | Path, session: Session) -> None:
    """Write all moments that a session remembers, T of them, as one recorded episode (``xreset-trace/1``).

    Its goal is the last one. Next to the arrays of every recorded episode, ``goal_path_pos`` [T, 3] and
    ``goal_path_quat`` [T, 4] say where the goal was, and the other fields of
    :class:`~xreset.eval.play.session.Moment` are arrays [T, ...].
    The columns of ``inputs`` [T, D] have the names ``input_names`` [D].

    Raises:
        XResetError: nothing has happened yet.
    """
    from xreset.eval.results import Trace, write_traces  # pandas, which playing does not need

    moments = last_moments(session, None)
    arrays = {}
    for each in fields(Moment):
        arrays[each.name] = np.array([getattr(moment, each.name) for moment in moments])
    goal_pos = arrays.pop("goal_pos")
    goal_quat = arrays.pop("goal_quat")
    states = {name: arrays.pop(name) for name in ("time", "joint_pos", "object_pos", "object_quat")}
    trace = Trace(
        sequence=0,
        object=session.object_name,
        goal_pos=goal_pos[-1],
        goal_quat=goal_quat[-1],
        # those before the first state are of no recorded step
        joint_target=arrays.pop("joint_target")[1:],
        **states,
    )
    input_names = []
    for name, place in session.inputs.items():
        input_names += [name] * (place.stop - place.start)
    robot = session.policy.robot
    write_traces(
        Path(path),
        [trace],
        robot.joint_names,
        policy=session.policy.name,
        robot=robot.name,
        fingertip_names=np.array(robot.fingertip_names),
        input_names=np.array(input_names),
        goal_path_pos=goal_pos,
        goal_path_quat=goal_quat,
        **arrays,
    )


def write_film(path: str | Path, session: Session, *, seconds: float = 10.0) -> None:
    """Write the last seconds of a session as an mp4 at its own speed; ``XResetError`` if nothing has happened yet."""
    write_whole(Path(path), draw_film(session.scene, last_moments(session, seconds)))


def draw_film(scene: SceneSpec, moments: Sequence[Moment]) -> bytes:
    """Draw moments as an mp4, :data:`FRAMES_PER_SECOND` of them for each second."""
    renderer = Renderer(scene, size=SIZE)
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * scene.control_dt)))
    frames = []
    for moment in moments[::every]:
        pose = (moment.object_pos, moment.object_quat)
        goal = (moment.goal_pos, moment.goal_quat)
        frames.append(renderer.draw(moment.joint_pos, pose, goal_pose=goal))
    return encode_mp4(frames, 1.0 / (every * scene.control_dt))


def last_moments(session: Session, seconds: float | None) -> list[Moment]:
    """Return the moments of the last seconds; None: all that a session remembers."""
    if not session.history:
        raise XResetError("Nothing has happened yet. Let the policy act first.")
    now = session.history[-1].time
    return [moment for moment in session.history if seconds is None or moment.time > now - seconds]
