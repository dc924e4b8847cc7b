"""Film what happened in a session."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from xreset.errors import XResetError
from xreset.eval.play.session import Moment, Session
from xreset.files.storage import write_whole
from xreset.pictures.render import Renderer, encode_mp4
from xreset.spec import SceneSpec

FRAMES_PER_SECOND = 20.0
SIZE = (640, 480)
"""Width and height of a film [pixels]."""


def write_film(path: str | Path, session: Session, *, seconds: float = 10.0) -> None:
    """Write the last seconds of a session as an mp4 at its own speed; ``XResetError`` if nothing has happened yet."""
    write_whole(Path(path), draw_film(session.scene, last_moments(session, seconds)))


def draw_film(scene: SceneSpec, moments: Sequence[Moment]) -> bytes:
    """Draw moments as an mp4, about :data:`FRAMES_PER_SECOND` of them for each second."""
    renderer = Renderer(scene, size=SIZE)
    every = max(1, round(1.0 / (FRAMES_PER_SECOND * scene.control_dt)))
    frames = []
    for moment in moments[::every]:
        pose = (moment.object_pos, moment.object_quat)
        goal = (moment.goal_pos, moment.goal_quat)
        frames.append(renderer.draw(moment.joint_pos, pose, goal_pose=goal))
    return encode_mp4(frames, 1.0 / (every * scene.control_dt))


def last_moments(session: Session, seconds: float) -> list[Moment]:
    """Return the moments of the last seconds."""
    if not session.history:
        raise XResetError("Nothing has happened yet. Let the policy act first.")
    now = session.history[-1].time
    return [moment for moment in session.history if moment.time > now - seconds]
