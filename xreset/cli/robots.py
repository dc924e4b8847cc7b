"""``xreset robots``: list, check, import, place and judge robots."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.text import Text

from xreset.cli._common import (
    Meshes,
    RobotName,
    this_command,
    usable_engines,
)
from xreset.cli._options import Output, Png
from xreset.cli._terminal import Progress, console, show_table
from xreset.cli._verbs import verb
from xreset.errors import RobotError
from xreset.physics.plugins import robot_names
from xreset.retarget.accounts import described
from xreset.robot_tools import placement, verbs
from xreset.robot_tools.placement import PlaceConfig

if TYPE_CHECKING:
    from xreset.robot_tools.check import Finding
    from xreset.robot_tools.judge import Judgement


_PER_OBJECT = 2
"""Sequences of each object that a search for a placement tries, spread over the archive."""


def list_robots() -> None:
    """List robots: built-in ones and those of installed packages."""
    from xreset.geometry import description

    table = [("robot", "joints (arm + hand)", "fingertips", "folder")]
    for name in robot_names():
        try:
            spec = description.load_robot(name)
        except RobotError as error:  # one broken plugin must not hide the others
            table.append((name, "-", "-", f"broken: {error}"))
            continue
        joints = f"{len(spec.arm_indices)} + {len(spec.hand_indices)}"
        table.append(
            (name, joints, ", ".join(spec.fingertip_names), str(description.robot_folder(name)))
        )
    show_table(table)


def check(robot: RobotName, /, *, picture: Png | None = None) -> None:
    """Check a robot, and print all errors and warnings. Exits with 1 after an error.

    `xreset engines check --robot ROBOT` tries it in the physics engines.

    Args:
        picture: PNG to write: the robot at home, with the frames of its palm, fingertips and joints.
    """
    from xreset.geometry import description
    from xreset.pictures import render
    from xreset.robot_tools import check as checks
    from xreset.robot_tools import picture as pictures

    findings = checks.check(robot)
    _print_findings(findings)
    if picture is not None and findings[-1].topic not in ("description", "URDF"):
        render.write_png(picture, pictures.robot_picture(description.load_robot(robot)))
        console.print(f"wrote {picture}")
    if any(finding.level == "error" for finding in findings):
        raise SystemExit(1)


def _print_findings(findings: Sequence[Finding]) -> None:
    styles = {"ok": "green", "skipped": "dim", "warning": "yellow", "error": "bold red"}
    for finding in findings:
        level = (f"{finding.level:8}", styles[finding.level])
        console.print(Text.assemble(level, f" {finding.topic}: {finding.message}"))
    levels = [finding.level for finding in findings]
    console.print(f"{levels.count('error')} errors, {levels.count('warning')} warnings")


def import_(
    *,
    arm: Path | None = None,
    hand: Path,
    out: Output,
    name: str | None = None,
    flange: str | None = None,
    offset: tuple[float, float, float] | None = None,
    rpy: tuple[float, float, float] | None = None,
    thumb: str | None = None,
) -> None:
    """Make a robot's folder from the published files of an arm and a hand, or from one file of both.

    Writes robot.urdf, the hulls of the meshes, a commented robot.toml and a picture, and lists what it guessed and what
    only you can decide.

    Args:
        arm: URDF or MJCF of the arm; leave it out if the hand's file holds the arm as well.
        hand: URDF or MJCF of the hand. Joints that move all fingers become joints of the arm.
        out: Folder to make.
        name: Name of the robot; default: the folder's.
        flange: Link of the arm that carries the hand; default: one that makers call so, or the arm's last link.
        offset: Position of the hand's root link in the flange's frame [m]; default: the origin, moved out of the arm
            until the hand's body is in front of the flange.
        rpy: Roll, pitch and yaw of the hand about the flange's fixed axes [rad]; default: as in the hand's file, or
            turned so that the fingers point out of the arm, along its last joint's axis.
        thumb: A link or joint of the thumb, if the import chooses another finger.
    """
    from xreset.geometry import description
    from xreset.pictures import render
    from xreset.robot_tools import importer
    from xreset.robot_tools import picture as pictures

    made = importer.import_robot(
        arm, hand, out, name=name, flange=flange, offset=offset, rpy=rpy, thumb=thumb
    )
    render.write_png(out / "robot.png", pictures.robot_picture(description.load_robot(out)))
    for title, lines in (("guessed", made.guessed), ("for you to decide", made.to_say)):
        console.print(f"{title}:")
        for line in lines:
            console.print(f"  - {line}")
    console.print(f"wrote {out / 'robot.toml'}, robot.urdf and robot.png; its check:")
    _print_findings(made.findings)


def place(
    robot: RobotName,
    /,
    *,
    demos: Path,
    meshes: Meshes = None,
    write: bool = False,
    search: PlaceConfig = PlaceConfig(),
) -> None:
    """Find the base placement from which a robot's arm follows most of the demonstrations.

    Args:
        demos: Archive of demonstrations (`xreset demos`).
        write: Write the placement and its home into the robot's robot.toml.
        search: Ranges and effort of the search.
    """
    from xreset.demos import archive
    from xreset.geometry import description
    from xreset.retarget import pipeline
    from xreset.robot_tools import place as places

    spec = description.load_robot(robot)
    every = archive.read_demos(demos)
    chosen = every.select(max_per_object=_PER_OBJECT, spread=True)
    specs = list(archive.demo_objects(chosen, meshes).values())
    with Progress() as bar:
        paths = pipeline.wrist_paths(chosen, spec, specs, progress=bar.count("hand retargeting"))
        grounded = archive.rest_on_table(every, specs)
        wrists = grounded.hand_keypoints[grounded.hand_valid, 0]
        avoid = np.concatenate((wrists, grounded.object_pos))
        found = places.place(spec, paths, avoid, search, bar.count("placements"))
    table = [("follows", "reaches", "dexterity", "base.pos", "base.quat", "home")]
    for finalist in found:
        table.append(
            (
                f"{finalist.followed:.1%}",
                f"{finalist.reached:.1%}",
                f"{finalist.dexterity:.3f}",
                f"[{_digits(finalist.robot.base_pos)}]",
                f"[{_digits(finalist.robot.base_quat)}]",
                finalist.home_rule or "not found",
            )
        )
    show_table(table, title="placements, the best one first")
    console.print(f"arm at home in the best: {_digits(found[0].robot.home[spec.arm_indices])}")
    console.print(f"of {found[0].frames} annotated frames of {chosen.num_sequences} sequences")
    if write:
        file = description.robot_folder(robot) / description.DESCRIPTION
        placement.write_placement(file, spec, found[0], this_command())
        console.print(f"wrote {file}")


def _show_judged(found: Judgement, options: Mapping[str, Any]) -> None:
    names = list(dict.fromkeys(row.engine for row in found.rows))
    table = [("object", "states", *names)]
    for label in dict.fromkeys(row.object_name for row in found.rows):
        mine = [row for row in found.rows if row.object_name == label]
        table.append(
            (label, str(mine[0].tried), *(f"{row.hold}, {row.lift}, {row.turn}" for row in mine))
        )
    show_table(table, title=f"{found.robot}: states that hold, also lift, also turn the object")
    if fails := found.rows[-1].arm_fails:
        console.print(
            f"the arm cannot raise or turn the hand that far in {fails} of {found.rows[-1].tried} states"
        )
    table = [("object", "demonstrations", "in reach", "why the others are not")]
    for row in found.reach:
        table.append(
            (row.object_name, str(row.demonstrations), str(row.reached), described(row.lost))
        )
    show_table(
        table, title="demonstrations that a rigid grasp can follow, from the start to the goal"
    )
    if found.without:
        absent = ", ".join(found.without)
        console.print(
            f"no accepted state has these objects in the air between thumb and finger: {absent}"
        )
    console.print(
        f"at least half of the states hold, lift and turn these objects in every engine: {', '.join(found.kept) or '-'}"
    )
    if options["picture"]:
        console.print(f"wrote {options['picture']}")


def _in_all_engines(arguments: dict[str, Any]) -> None:
    """Let a command without engines use all that can be used here."""
    arguments["engines"] = arguments.get("engines") or usable_engines()


def _digits(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


COMMAND = {
    "": list_robots,
    "check": check,
    "import": import_,
    "place": place,
    "judge": verb(verbs.judge, _show_judged, prepare=_in_all_engines, engines=()),
}
