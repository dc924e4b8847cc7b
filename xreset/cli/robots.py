"""``xreset robots``: which robots there are, and what is wrong with one."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from xreset.errors import RobotError


def list_robots() -> None:
    """List the robots: built in, and from installed packages."""
    from rich.console import Console
    from rich.table import Table

    from xreset.robots import load, robot_names
    from xreset.robots.registry import robot_folder

    table = Table("robot", "joints (arm + hand)", "fingertips", "folder")
    for name in robot_names():
        try:
            spec = load(name)
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
    from rich.console import Console
    from rich.markup import escape

    from xreset.robots.check import Finding
    from xreset.robots.check import check as run_checks

    console = Console()
    styles = {"ok": "green", "skipped": "dim", "warning": "yellow", "error": "bold red"}

    def report(finding: Finding) -> None:
        level = f"[{styles[finding.level]}]{finding.level:8}[/]"
        console.print(f"{level} {escape(finding.topic)}: {escape(finding.message)}", soft_wrap=True, highlight=False)

    findings = run_checks(robot, report=report, engines=engines)
    counts = {level: sum(finding.level == level for finding in findings) for level in ("error", "warning")}
    if picture is not None and findings[0].level == "ok":
        from xreset.render import write_png
        from xreset.robots import load
        from xreset.robots.picture import robot_picture

        write_png(picture, robot_picture(load(robot)))
        console.print(f"wrote {picture}", highlight=False)
    console.print(f"{counts['error']} errors, {counts['warning']} warnings", highlight=False)
    if counts["error"]:
        raise SystemExit(1)


COMMAND = {"list": list_robots, "check": check}
