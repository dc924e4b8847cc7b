"""``xreset robots``: list, check, import, place and judge robots."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from rich.text import Text

from xreset.cli._common import in_quick_engines
from xreset.cli._terminal import console, show_table
from xreset.cli._verbs import verb
from xreset.errors import RobotError
from xreset.files.text import quantity
from xreset.physics.plugins import robot_folder, robot_names
from xreset.retarget.accounts import described
from xreset.robot_tools import verbs

if TYPE_CHECKING:
    from xreset.robot_tools.check import Finding
    from xreset.robot_tools.importer import Imported
    from xreset.robot_tools.judge import Judgement
    from xreset.robot_tools.placement import Finalist


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


def _show_check(findings: Sequence[Finding], options: Mapping[str, Any]) -> None:
    from xreset.robot_tools.check import can_be_drawn

    _print_findings(findings)
    if options["picture"] and can_be_drawn(findings):
        console.print(f"wrote {options['picture']}")
    if any(finding.level == "error" for finding in findings):
        raise SystemExit(1)


def _print_findings(findings: Sequence[Finding]) -> None:
    styles = {"ok": "green", "skipped": "dim", "warning": "yellow", "error": "bold red"}
    for finding in findings:
        level = (f"{finding.level:8}", styles[finding.level])
        console.print(Text.assemble(level, f" {finding.topic}: {finding.message}"))
    levels = [finding.level for finding in findings]
    counts = [quantity(levels.count(level), level) for level in ("error", "warning")]
    console.print(", ".join(counts))


def _show_import(made: Imported, _options: Mapping[str, Any]) -> None:
    for title, lines in (("guessed", made.guessed), ("for you to decide", made.to_say)):
        console.print(f"{title}:")
        for line in lines:
            console.print(f"  - {line}")
    console.print(f"wrote {made.folder / 'robot.toml'}, robot.urdf and robot.png; its check:")
    _print_findings(made.findings)


def _show_places(found: Sequence[Finalist], options: Mapping[str, Any]) -> None:
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
    best = found[0].robot
    console.print(f"arm at home in the best: {_digits(best.home[best.arm_indices])}")
    console.print(
        f"follows: share of {quantity(found[0].frames, 'annotated frame')} of "
        f"{quantity(found[0].sequences, 'sequence')}, one after another; "
        "reaches: of a sample of their wrist poses, each on its own, to 5 mm and 5 degrees"
    )
    console.print(
        "These are poses of the human's wrist. xreset robots judge counts demonstrations that a rigid grasp can "
        "follow, with other poses of the hand."
    )
    if options["write"]:
        console.print(f"wrote {robot_folder(options['robot']) / 'robot.toml'}")


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
    console.print(
        "The hand's poses follow from the grasp and the object. xreset robots place counts frames in which the arm "
        "follows the human's wrist, with other poses of the hand."
    )
    if found.without:
        absent = ", ".join(found.without)
        console.print(
            f"no accepted state has these objects in the air between thumb and finger: {absent}"
        )
    order = ", ".join(f"{name} {share:.0%}" for name, share in found.prospects.items())
    console.print(
        f"what training is likely to learn, best first (states that turn in {names[0]} x demonstrations in reach): "
        f"{order}"
    )
    if options["picture"]:
        console.print(f"wrote {options['picture']}")


def _digits(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.4f}" for value in values)


COMMAND = {
    "": list_robots,
    "check": verb(verbs.check_robot, _show_check),
    "import": verb(verbs.import_robot, _show_import, arm=None),
    "place": verb(verbs.place_robot, _show_places),
    "judge": verb(verbs.judge, _show_judged, prepare=in_quick_engines, engine=()),
}
