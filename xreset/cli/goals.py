"""``xreset goals``."""

from __future__ import annotations

from collections import Counter
from typing import Annotated

from tyro.conf import UseAppendAction

from xreset.cli._common import Meshes, Names, Several
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console
from xreset.resets.config import GoalConfig

Pose = tuple[float, float, float, float, float, float, float]


def goals(
    names: Names = (),
    *,
    robot: str,
    out: Output,
    meshes: Meshes = None,
    family: Several = (),
    pose: Annotated[tuple[Pose, ...], UseAppendAction] = (),
    draw: GoalConfig = GoalConfig(),
) -> None:
    """Give objects starts and goals without demonstrations, for `xreset eval --demos` and `xreset train --goals`.

    Objects start at rest on the table. The robot can reach every goal with the grasp that it has at the start.

    Args:
        names: Objects; default: all.
        robot: Name or folder of the robot.
        out: Goal set to write.
        family: Kind of goal: lift, yaw, tilt-x, tilt-y (lifted, and turned by 60 degrees about an axis of the world) or
            random; give it again for more. Default: all of them, or none with --pose.
        pose: Goal of your own, a pose of the mesh frame: x y z [m] and quaternion w x y z; give it again for more.
        draw: Number, sizes, offsets and seed.
    """
    from xreset.resets import goals as goal_sets

    with Progress() as bar:
        made = goal_sets.make_goals(
            names or None, robot=robot, meshes=meshes, families=family or None, poses=pose, config=draw,
            progress=bar.count("goals within reach"),
        )  # fmt: skip
    goal_sets.write_goals(out, made, draw, meshes=meshes)
    counts = Counter(made.family.tolist())
    listing = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    console.print(
        f"{len(made.family)} goals of {len(made.object_names)} objects ({listing}) in {out}"
    )


COMMAND = goals
