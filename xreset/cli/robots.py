"""``xreset robots``: which robots there are, and what is wrong with one."""

from __future__ import annotations

import shlex
from dataclasses import fields
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from rich.table import Table
from rich.text import Text

from xreset.backends import workers
from xreset.cli._terminal import Console, Progress
from xreset.demos import archive
from xreset.description import DESCRIPTION, load_robot, robot_folder
from xreset.errors import RobotError
from xreset.pictures import render
from xreset.plugins import robot_names
from xreset.retarget import pipeline
from xreset.robot_tools import check as checks
from xreset.robot_tools import importer, placement
from xreset.robot_tools import picture as pictures
from xreset.robot_tools import place as places
from xreset.robot_tools import reshape as reshaping
from xreset.robot_tools.placement import PlaceConfig


def list_robots() -> None:
    """List the robots: built in, and from installed packages."""
    table = Table("robot", "joints (arm + hand)", "fingertips", "folder")
    for name in robot_names():
        try:
            spec = load_robot(name)
        except RobotError as error:  # one broken plugin must not hide the others
            table.add_row(name, "-", "-", f"broken: {error}")
            continue
        joints = f"{len(spec.arm_indices)} + {len(spec.hand_indices)}"
        table.add_row(name, joints, ", ".join(spec.fingertip_names), str(robot_folder(name)))
    Console().print(table)


def check(
    robot: Annotated[str, tyro.conf.Positional],
    /,
    *,
    picture: Path | None = None,
    engines: bool = True,
) -> None:
    """Say everything that is wrong with a robot, in one go. Exits with 1 if anything is.

    Args:
        robot: name of a registered robot, or a folder with a robot.toml.
        picture: write a picture (PNG) of the robot at home, with the frames of its palm, fingertips and joints.
        engines: build the robot in every installed engine (the first time, mujoco-warp compiles for a minute or two).
    """
    console = Console()
    styles = {"ok": "green", "skipped": "dim", "warning": "yellow", "error": "bold red"}

    def report(finding: checks.Finding) -> None:
        level = (f"{finding.level:8}", styles[finding.level])
        console.print(Text.assemble(level, f" {finding.topic}: {finding.message}"), soft_wrap=True)

    findings = checks.check(robot, report=report, engines=engines)
    counts = {level: sum(finding.level == level for finding in findings) for level in ("error", "warning")}
    if picture is not None and findings[0].level == "ok":
        render.write_png(picture, pictures.robot_picture(load_robot(robot)))
        console.print(f"wrote {picture}", highlight=False)
    console.print(f"{counts['error']} errors, {counts['warning']} warnings", highlight=False)
    if counts["error"]:
        raise SystemExit(1)


def import_(
    *,
    arm: Path,
    hand: Path,
    out: Path,
    name: str | None = None,
    flange: str | None = None,
    offset: tuple[float, float, float] | None = None,
    rpy: tuple[float, float, float] = (0, 0, 0),
    thumb: str | None = None,
) -> None:
    """Make a robot's folder from an arm and a hand as their makers publish them.

    Writes robot.urdf, the meshes' hulls, a commented robot.toml and a picture; says what it guessed and what only a person can say.

    Args:
        arm: URDF or MJCF of the arm.
        hand: URDF or MJCF of the hand.
        out: Folder to make.
        name: Name of the robot; default: the folder's.
        flange: Link of the arm that carries the hand; default: the arm's last link.
        offset: Position of the hand's root link in the flange's frame [m]; default: its origin, or as far along its z axis as keeps the
            hand's body out of the arm.
        rpy: Its roll, pitch and yaw about the flange's fixed axes [rad].
        thumb: A link or joint of the thumb, where names and geometry do not tell.
    """
    made = importer.import_robot(arm, hand, out, name=name, flange=flange, offset=offset, rpy=rpy, thumb=thumb)
    render.write_png(out / "robot.png", pictures.robot_picture(load_robot(out)))
    console = Console()
    for title, lines in (("guessed", made.guessed), ("for you to say", made.to_say)):
        console.print(f"{title}:", highlight=False)
        for line in lines:
            console.print(f"  - {line}", highlight=False, soft_wrap=True)
    console.print(f"wrote {out / 'robot.toml'}, robot.urdf and robot.png; checking it", highlight=False, soft_wrap=True)
    check(str(out), engines=False)


def reshape(robot: Annotated[str, tyro.conf.Positional], /, *, shapes: Path, out: Path) -> None:
    """Make a robot's folder from a robot and another URDF or MJCF of some of its links, of which it takes the collision shapes.

    Joints, masses, drives and frames stay as they are, and policies of the robot play with the new one. Links are matched by name.

    Args:
        robot: name of a registered robot, or a folder with a robot.toml.
        shapes: URDF or MJCF, of the hand for instance.
        out: Folder to make; its name is the new robot's.
    """
    for note in reshaping.reshape(robot, shapes, out):
        print(note)
    check(str(out), engines=False)


def place(
    robot: Annotated[str, tyro.conf.Positional],
    /,
    *,
    demos: Path,
    objects: Path | None = None,
    max_per_object: int = 2,
    processes: int | None = None,
    write: bool = False,
    search: PlaceConfig = PlaceConfig(),  # noqa: B008  tyro reads flags from the default
) -> None:
    """Find the place of a robot's base from which its arm reaches most wrist poses of demonstrations.

    Args:
        robot: name of a registered robot, or a folder with a robot.toml.
        demos: archive of demonstrations (see `xreset demos`).
        objects: folder of real meshes; default: the built-in stand-ins.
        max_per_object: only so many sequences of each object, taken from all over the archive.
        processes: that try placements at a time, with about 0.5 GB each; default: one for each core, at most 8.
        write: put the placement, its home and its figure into the robot's robot.toml.
        search: ranges and effort.
    """
    console = Console()
    spec = load_robot(robot)
    chosen = archive.read_demos(demos).select(max_per_object=max_per_object, spread=True)
    specs = list(archive.demo_objects(chosen, objects).values())
    with Progress(console) as bar:
        paths = pipeline.wrist_paths(chosen, spec, specs, progress=bar.count("hand retargeting"))
        wrists = np.concatenate([path.root_pos[path.annotated].numpy() for path in paths])
        avoid = np.concatenate((wrists, pipeline.rest_on_table(chosen, specs).object_pos))
        task = bar.add_task("placements", total=1.0)

        def report(done: float, best: placement.Reach) -> None:
            bar.update(task, completed=done, description=f"placements (best yet reaches {best.reached:.0%})")

        found = places.place(spec, paths, avoid, search, report, processes or min(workers.usable_cores(), 8))
    for title, finalist in (("as described", found.own), ("best found", found.best)):
        pos, quat = (
            ", ".join(f"{v:.4f}" for v in values) for values in (finalist.placement.pos, finalist.placement.quat)
        )
        console.print(
            f"{title:12}  follows {finalist.followed:.1%}, reaches {finalist.reach.reached:.1%}, dexterity {finalist.reach.dexterity:.3f}: "
            f"pos [{pos}], quat [{quat}]",
            highlight=False,
            soft_wrap=True,
        )
    if found.home is not None:
        console.print(f"{'its home':12}  {', '.join(f'{v:.3f}' for v in found.home)}", highlight=False, soft_wrap=True)
    console.print(f"of {found.frames} annotated frames of {chosen.num_sequences} sequences", highlight=False)
    if write:
        given = [] if objects is None else ["--objects", objects.name]
        command = [
            "xreset",
            "robots",
            "place",
            spec.name,
            "--demos",
            demos.name,
            *given,
            "--max-per-object",
            str(max_per_object),
        ]
        for field in fields(search):
            if (value := getattr(search, field.name)) != field.default:
                command += [f"--search.{field.name}", *map(str, value if isinstance(value, tuple) else (value,))]
        placement.write_placement(robot_folder(robot) / DESCRIPTION, spec, found, shlex.join(command))
        console.print(f"wrote {robot_folder(robot) / DESCRIPTION}", highlight=False)


COMMAND = {"list": list_robots, "check": check, "import": import_, "reshape": reshape, "place": place}
