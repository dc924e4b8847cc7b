"""What goes wrong: the recorded episodes that got least far, as strips of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from xreset.eval.report.clips import camera_for, recorded_episode
from xreset.eval.rollout import Episode, Trace
from xreset.spec import ObjectSpec, RobotSpec

SIZE = (240, 180)
"""Width and height of one picture [pixels]."""
MOMENTS = 6
"""Pictures in a strip, evenly over the episode, first and last state included."""


@dataclass(frozen=True, kw_only=True)
class Strip:
    """One episode as a row of pictures."""

    episode: Episode
    picture: np.ndarray
    """[H, MOMENTS * W, 3] uint8"""
    times: tuple[float, ...]
    """[MOMENTS] when each was taken [s]."""


def choose_failures(episodes: Sequence[Episode], traces: Sequence[Trace], count: int) -> list[tuple[Episode, Trace]]:
    """The recorded episodes of one engine that missed the goal, worst first, at most ``count``.

    Worst is the lowest stage, then the least of the way to the goal, then the lower index of the demonstration. Objects take turns, so that
    a hard one does not hide the others.
    """
    found = [(recorded_episode(tuple(episodes), trace.sequence), trace) for trace in traces]
    missed = sorted(
        ((e, t) for e, t in found if not e.reorient), key=lambda x: (x[0].task_progress, x[0].reorientation_progress, x[0].sequence)
    )
    seen: dict[str, int] = {}
    turns = []
    for place, (_, trace) in enumerate(missed):
        turns.append((seen.setdefault(trace.object, 0), place))
        seen[trace.object] += 1
    return [missed[place] for place in sorted(place for _, place in sorted(turns)[:count])]


def count_failures(episodes: Sequence[Episode]) -> dict[str, int]:
    """How many episodes ended below each stage, by what was missing."""
    return {
        "never near the object": sum(not e.approach for e in episodes),
        "near it, but no grasp": sum(e.approach and not e.grasp for e in episodes),
        "grasped, never at the goal": sum(e.grasp and not e.reorient_once for e in episodes),
        "at the goal, but not in the end": sum(e.reorient_once and not e.reorient for e in episodes),
    }


def draw_strip(episode: Episode, trace: Trace, robot: RobotSpec, obj: ObjectSpec) -> Strip:
    """Draw an episode's strip, the goal as a translucent object; states that are not finite are left grey."""
    from xreset.pictures.raster import Renderer, pose_matrix
    from xreset.spec import SceneSpec

    renderer = Renderer(SceneSpec(robot=robot, objects=(obj,)), size=SIZE, camera=camera_for([trace], distance=0.7))
    goal = pose_matrix(trace.goal_pos, trace.goal_quat)
    rows = np.linspace(0, len(trace.time) - 1, MOMENTS).round().astype(int)
    pictures = []
    for row in rows.tolist():
        state = (trace.joint_pos[row], trace.object_pos[row], trace.object_quat[row])
        if all(np.isfinite(part).all() for part in state):
            pictures.append(renderer.draw(state[0], pose_matrix(*state[1:]), goal_pose=goal))
        else:
            pictures.append(np.full((SIZE[1], SIZE[0], 3), 128, dtype=np.uint8))
    return Strip(episode=episode, picture=np.concatenate(pictures, axis=1), times=tuple(float(trace.time[row]) for row in rows))
