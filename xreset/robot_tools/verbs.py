"""``judge``, a function and a command: its signature has the options, its docstring the help.

It imports most of what it needs when it is called, because the help of a command is shown at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.files.checks import Option, Png, PositiveInt, obeys_rules
from xreset.files.progress import unseen
from xreset.physics.plugins import Device
from xreset.resets.config import JUDGE_SQUEEZE, SqueezeConfig

if TYPE_CHECKING:
    from xreset.resets.bank import ResetBank
    from xreset.robot_tools.judge import Judgement
    from xreset.spec import ObjectSpec, RobotSpec
else:  # a command has files and names in place of these
    ResetBank = Judgement = ObjectSpec = RobotSpec = Any


@obeys_rules
def judge(
    bank: str | Path | ResetBank,
    robot: str | Path | RobotSpec | None = None,
    objects: Sequence[ObjectSpec] | None = None,
    engines: Annotated[str | Sequence[str], Option("engine")] = "mujoco",
    *,
    meshes: str | Path | None = None,
    states: PositiveInt = 8,
    squeeze: SqueezeConfig = JUDGE_SQUEEZE,
    num_envs: PositiveInt = 32,
    device: Device = "cpu",
    picture: Png | None = None,
    progress: Callable[[float, int], None] = unseen,
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
        engines: physics engine to try the states in, or several; the command's default: all that can be used here.
        meshes: folder of real meshes; default: that of the bank, else the stand-ins.
        states: number of states of each object: those in the air in which the thumb and another finger are nearest to
            the object, as many from each demonstration as possible. States in grasps of other demonstrations are left
            out: they were chosen because they hold.
        squeeze: how hard fingers press, and which fingers.
        num_envs: worlds at a time.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        picture: PNG to write: the best state of each object at the start and after each phase.
        progress: called with (states done, states in all); then again with demonstrations.

    Raises:
        RobotError: the bank has no lifted grasp of any object.
        DemoError: a lifted object of the bank is unknown.
        FileFormatError: the bank's states are for a robot with other joints, or for other meshes.
    """
    from xreset.pictures.render import write_png
    from xreset.resets.inputs import load_inputs
    from xreset.robot_tools.judge import judge_picture, try_grasps

    inputs = load_inputs(bank, robot=robot, objects=objects, meshes=meshes, accept=("bank",))
    chosen = (engines,) if isinstance(engines, str) else tuple(dict.fromkeys(engines))
    found = try_grasps(
        inputs.bank,
        inputs.robot,
        inputs.objects,
        chosen,
        states=states,
        squeeze=squeeze,
        num_envs=num_envs,
        device=device,
        progress=progress,
    )
    if picture is not None:
        write_png(Path(picture), judge_picture(found, inputs.robot, inputs.objects))
    return found
