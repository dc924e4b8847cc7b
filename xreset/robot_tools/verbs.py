"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.errors import RobotError
from xreset.files.checks import Option, Output, Png, PositiveInt, obeys_rules
from xreset.files.progress import NamedProgress, Progress, unseen
from xreset.files.storage import this_command
from xreset.files.text import texts
from xreset.physics.plugins import Device, EngineName, RobotName
from xreset.resets.config import SqueezeConfig
from xreset.robot_tools.placement import Finalist, PlaceConfig, write_placement

if TYPE_CHECKING:
    from xreset.resets.bank import ResetBank
    from xreset.robot_tools.check import Finding
    from xreset.robot_tools.importer import Imported
    from xreset.robot_tools.judge import Judgement
    from xreset.spec import ObjectSpec, RobotSpec
else:  # a command has files and names in place of these
    ResetBank = Finding = Imported = Judgement = ObjectSpec = RobotSpec = Any

Vector = tuple[float, float, float]
_PER_OBJECT = 2
"""Sequences of each object that a search for a placement tries, spread over the archive."""


@obeys_rules
def check_robot(robot: str | Path, *, picture: Png | None = None) -> list[Finding]:
    """Check a robot, and list all errors and warnings. The command exits with 1 after an error.

    xreset engines check --robot ROBOT tries it in the physics engines.

    Args:
        robot: name of a robot, or a folder with a robot.toml.
        picture: PNG to write: the robot at home, with the frames of its palm, fingertips and joints.

    Returns:
        At least one finding for each topic. After errors of description, URDF or inertias, home is skipped, and there
        is no picture.
    """
    from xreset.geometry.description import load_robot
    from xreset.pictures.render import write_png
    from xreset.robot_tools.check import can_be_drawn, check
    from xreset.robot_tools.picture import robot_picture

    found = check(robot)
    if picture is not None and can_be_drawn(found):
        write_png(Path(picture), robot_picture(load_robot(robot)))
    return found


@obeys_rules
def import_robot(
    arm: Annotated[str | Path | None, Option("arm")],
    hand: str | Path,
    out: Output,
    *,
    flange: str | None = None,
    offset: Vector | None = None,
    rpy: Vector | None = None,
    thumb: str | None = None,
) -> Imported:
    """Make a robot's folder from the published files of an arm and a hand, or from one file of both.

    Writes robot.urdf, the hulls of the meshes, a commented robot.toml and a picture, and lists what it guessed and what
    only you can decide.

    Args:
        arm: URDF or MJCF of the arm, or name or folder of a robot whose arm is taken; leave it out if the hand's file
            holds the arm as well.
        hand: URDF or MJCF of the hand. Joints that move all fingers become joints of the arm.
        out: folder to make; its name is the robot's.
        flange: link of the arm that carries the hand; default: one that makers call so, or the arm's last link.
        offset: position of the hand's root link in the flange's frame [m]; default: the origin, moved out of the arm
            until the hand's body is in front of the flange.
        rpy: roll, pitch and yaw of the hand about the flange's fixed axes [rad]; default: as in the hand's file, or
            turned so that the fingers point out of the arm, along its last joint's axis.
        thumb: a link or joint of the thumb, if the import chooses another finger.

    Raises:
        RobotError: a file cannot be read, no fingers are found, or the robot would fail its check; the message says
            what to do.
        XResetError: the folder exists, or cannot be written.
    """
    from xreset.geometry.description import load_robot
    from xreset.pictures.render import write_png
    from xreset.robot_tools.importer import make_robot
    from xreset.robot_tools.picture import robot_picture

    made = make_robot(
        Path(arm) if arm else None,
        Path(hand),
        Path(out),
        flange=flange,
        offset=offset,
        rpy=rpy,
        thumb=thumb,
    )
    write_png(made.folder / "robot.png", robot_picture(load_robot(made.folder)))
    return made


@obeys_rules
def place_robot(
    robot: str | Path,
    demos: str | Path,
    *,
    meshes: str | Path | None = None,
    write: bool = False,
    search: PlaceConfig = PlaceConfig(),
    progress: NamedProgress = unseen,
) -> list[Finalist]:
    """Find the base placement from which a robot's arm follows most of the demonstrations.

    Args:
        robot: name of a robot, or a folder with a robot.toml.
        demos: archive of demonstrations (xreset demos).
        meshes: folder of real meshes; default: the built-in stand-ins.
        write: write the placement and its home into the robot.toml of a folder.
        search: ranges and effort of the search.
        progress: called with (stage, done, in all).

    Returns:
        The finalists, those with a home first, and of these the one that follows most.

    Raises:
        RobotError: there is no wrist pose to reach, no room for the base, or the description cannot be changed: that of
            an installed robot, for example.
    """
    import numpy as np

    from xreset.demos.archive import demo_objects, read_demos, rest_on_table
    from xreset.geometry.description import load_robot
    from xreset.physics.plugins import DESCRIPTION, robot_folder, robot_names
    from xreset.retarget.pipeline import wrist_paths
    from xreset.robot_tools.place import place

    folder = robot_folder(robot)
    if write and str(robot) in robot_names():
        raise RobotError(
            f"{robot} is an installed robot, whose policies need it as it is. Copy its folder (cp -r {folder} mine), "
            "change the name in mine/robot.toml, and place the copy."
        )
    spec = load_robot(robot)
    every = read_demos(demos)
    chosen = every.select(per_object=_PER_OBJECT, pick="spread")
    objects = list(demo_objects(chosen, meshes).values())
    paths = wrist_paths(chosen, spec, objects, progress=partial(progress, "hand retargeting"))
    grounded = rest_on_table(every, objects)
    wrists = grounded.hand_keypoints[grounded.hand_valid, 0]
    avoid = np.concatenate((wrists, grounded.object_pos))
    found = place(spec, paths, avoid, search, partial(progress, "placements"))
    if write:
        write_placement(folder / DESCRIPTION, spec, found[0], this_command())
    return found


@obeys_rules
def judge(
    bank: str | Path | ResetBank,
    robot: RobotName | RobotSpec | None = None,
    objects: Sequence[ObjectSpec] | None = None,
    engine: EngineName | Sequence[EngineName] = "mujoco",
    *,
    meshes: str | Path | None = None,
    states: PositiveInt = 8,
    squeeze: SqueezeConfig = SqueezeConfig(),
    device: Device = "cpu",
    picture: Png | None = None,
    progress: Progress = unseen,
) -> Judgement:
    """Judge a robot without training: which objects it holds for a second at full gravity, lifts and turns.

    Accepted states in which the object is in the air start a fixed program: the fingers press, the object gets its
    weight for a second, the arm raises the hand by 10 cm, and turns it by 45 degrees about the fingers' direction. The
    object must stay within 3 cm and 45 degrees of where it was in the hand.

    Also counts the demonstrations that the robot can follow with a grasp that stays rigid: the hand gets to the object
    clear of the table, and the arm brings it to the goal. For a jaw, grasps are planned on the object's shape; other
    hands use the grasps of the bank.

    Args:
        bank: states that physics accepted, made by xreset resets.
        robot: name or folder of the robot; default: that of the bank.
        objects: the objects of the bank; default: those of ``meshes``.
        engine: physics engine to try the states in, or several; the command's default: all that can be used here, on
            a CPU without MuJoCo-Warp, which is slow there.
        meshes: folder of real meshes; default: that of the bank, else the stand-ins.
        states: number of states of each object: those in the air in which the thumb and another finger are nearest to
            the object, as many from each demonstration as possible. States in grasps of other demonstrations are left
            out: they were chosen because they hold.
        squeeze: how hard fingers press that are within 10 mm of the object, the same on every object.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        picture: PNG to write: the best state of each object at the start and after each phase.
        progress: called with (states done, states in all); then again with demonstrations.

    Raises:
        RobotError: the bank has no lifted grasp of any object.
        DemoError: an object of the bank is unknown.
        FileFormatError: the bank's states are for a robot with other joints, or for other meshes.
    """
    from xreset.pictures.render import write_png
    from xreset.resets.inputs import load_inputs
    from xreset.robot_tools.judge import judge_picture, try_grasps

    inputs = load_inputs(bank, robot=robot, objects=objects, meshes=meshes, accept=("bank",))
    found = try_grasps(
        inputs.bank,
        inputs.robot,
        inputs.objects,
        texts(engine),
        states=states,
        squeeze=squeeze,
        device=device,
        progress=progress,
    )
    if picture is not None:
        write_png(Path(picture), judge_picture(found, inputs.robot, inputs.objects))
    return found
