"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.errors import XResetError
from xreset.files.checks import Option, OutputFile, PositiveInt, Seed, obeys_rules
from xreset.files.progress import NamedProgress, Progress, unseen
from xreset.files.records import replaces
from xreset.files.text import shown, texts
from xreset.physics.plugins import Device, EngineName, RobotName, backend_class
from xreset.resets.config import ClosingConfig, FilterConfig, SqueezeConfig, TransferConfig

if TYPE_CHECKING:
    from xreset.resets.bank import ResetBank
    from xreset.resets.goals import GoalSet
    from xreset.retarget.file import Retargeted
    from xreset.spec import ObjectSpec, RobotSpec
else:  # a command has files and names in place of these
    ResetBank = GoalSet = Retargeted = ObjectSpec = RobotSpec = Any

_warn = logging.getLogger(__name__).warning
Pose = tuple[float, float, float, float, float, float, float]


@obeys_rules
def make_bank(
    retargeted: str | Path | Retargeted,
    robot: RobotName | RobotSpec | None = None,
    objects: Sequence[ObjectSpec] | None = None,
    engine: EngineName | Sequence[EngineName] = "mujoco",
    *,
    out: Annotated[OutputFile, replaces("xreset-resets/")] | None = None,
    meshes: str | Path | None = None,
    num_envs: PositiveInt = 64,
    device: Device = "cpu",
    limits: Annotated[FilterConfig | None, Option("filter")] = FilterConfig(),
    closing: ClosingConfig | None = ClosingConfig(),
    squeeze: SqueezeConfig | None = SqueezeConfig(),
    transfer: TransferConfig | None = TransferConfig(),
    progress: NamedProgress = unseen,
    note: Callable[[str], None] = _warn,
) -> ResetBank:
    """Test retargeted states in physics and keep the stable ones; then add states in grasps of other demonstrations.

    A state in which the robot is more than 2 mm deep in the object is rejected without a test.

    Args:
        retargeted: motion made by xreset retarget; demonstrations are refused.
        robot: name or folder of the robot; default: that of the motion.
        objects: the objects of the motion; default: those of ``meshes``.
        engine: physics engine to test the states in, or several: states are kept that are stable in all of them. A
            rejection states the first engine's reason.
        out: reset bank to write.
        meshes: folder of real meshes; default: that of the motion, else the stand-ins.
        num_envs: worlds at a time.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        limits: duration of the test, and the largest speeds of a stable state.
        closing: extra states between frames in which the hand closes in on the object.
        squeeze: how hard fingers within 5 mm of the object press in states after contact, in addition to the object's
            weight. The thumb presses as hard as all fingers that oppose it together. Accepted states are tried once
            more with the targets that press; one that an engine rejects then does not press.
        transfer: extra states at poses of each demonstration, in grasps of other demonstrations of the same object
            that hold its full weight in every engine. There are none if no finger presses.
        progress: called with (what is tried, candidates tried, candidates in all).
        note: called with the doubts that the motion states about its demonstrations, and with that of few kept frames.

    Raises:
        DemoError: no frame is valid, or an object of the motion is not given.
        FileFormatError: the motion is for a robot with other joints.
        XResetError: no motion is given, no engine is named, one cannot be used here, or coal is not installed.
    """
    from xreset.files.records import stated_doubts
    from xreset.resets.bank import write_bank
    from xreset.resets.filter import doubt_about_losses, stable_states
    from xreset.resets.inputs import load_inputs
    from xreset.resets.transfer import add_transfers
    from xreset.retarget.file import Retargeted

    if not isinstance(retargeted, str | Path | Retargeted):
        raise XResetError(
            f"retargeted is {shown(retargeted)}, expected the motion of xreset.retarget_demos, or its file."
        )
    inputs = load_inputs(
        retargeted, robot=robot, objects=objects, meshes=meshes, accept=("motion",)
    )
    doubts = stated_doubts(inputs.path) if inputs.path else []
    for doubt in doubts:
        note(doubt)
    motion = inputs.motion()
    scene = (inputs.robot, inputs.objects)
    engines = texts(engine)
    if not engines:
        raise XResetError("No engine is named. Name one or several of them.")
    # fails where an engine is missing, before others have worked
    for name in engines:
        backend_class(name).engine_version()
    limits = limits or FilterConfig()
    closing = closing or ClosingConfig(spacing=None)
    squeeze = squeeze or SqueezeConfig(force=0.0)
    force = squeeze.newtons(len(inputs.robot.fingertips))
    transfer = transfer or TransferConfig(per_pose=0)
    bank = stable_states(
        motion,
        *scene,
        engines,
        limits=limits,
        closing=closing,
        force=force,
        num_envs=num_envs,
        device=device,
        progress=partial(progress, f"states stable in {', '.join(engines)}"),
    )
    if doubt := doubt_about_losses(bank, motion, str(inputs.path or "FILE")):
        doubts.append(doubt)
        note(doubt)
    if transfer.per_pose and force:
        bank = add_transfers(
            bank,
            motion,
            *scene,
            transfer,
            num_envs=num_envs,
            device=device,
            progress=partial(progress, "grasps of other demonstrations"),
        )
    if out is not None:
        made_with = {
            "engines": list(engines),
            "num_envs": num_envs,
            "filter": asdict(limits),
            "closing": asdict(closing),
            "squeeze": {"force": force},
            "transfer": asdict(transfer),
            "robot": inputs.robot_name,
            "meshes": str(inputs.meshes) if inputs.meshes else None,
            "doubts": doubts,
        }
        hashes = {"retargeted": inputs.hash} if inputs.hash else {}
        write_bank(out, bank, config=made_with, inputs=hashes)
    return bank


@obeys_rules
def make_goals(
    names: Sequence[str] | None = None,
    *,
    robot: RobotName | RobotSpec,
    out: Annotated[OutputFile, replaces("xreset-goals/")] | None = None,
    meshes: str | Path | None = None,
    families: Annotated[str | Sequence[str] | None, Option("family")] = None,
    poses: Annotated[Sequence[Pose], Option("pose")] = (),
    per_family: PositiveInt = 20,
    upright: bool = False,
    seed: Seed = 0,
    progress: Progress = unseen,
) -> GoalSet:
    """Give objects starts and goals without demonstrations, for xreset eval --demos and xreset train --goals.

    Objects come to rest on the table in MuJoCo first, so that every start is at rest. The robot can reach every goal
    with the grasp that it has at the start. The goals of an object do not depend on the other objects.

    Args:
        names: objects; default: all.
        robot: name or folder of the robot.
        out: goal set to write.
        meshes: folder of real meshes; default: the built-in stand-ins.
        families: kind of goal, or several: lift, yaw, tilt-x, tilt-y (lifted, and turned by 60 degrees about an axis of
            the world) or random; default: all of them, or none if there are poses.
        poses: goal of your own for every object, a pose of the mesh frame: x y z [m] and quaternion w x y z; or
            several.
        per_family: goals of each object and family.
        upright: whether objects start in the resting pose in which their mesh's z axis points up. Otherwise they start
            in any of their resting poses, on a broad face more often than on a narrow one.
        seed: the same seed gives the same goals.
        progress: called with (goals found, goals in all).

    Raises:
        ObjectError: an object is unknown, or has no usable mesh.
        GoalError: an object does not come to rest, or a goal is inside the table or out of the robot's reach.
    """
    from xreset.geometry.description import load_robot
    from xreset.objects.catalogue import load_objects
    from xreset.resets.goals import drawn_goals, write_goals

    config = {"per_family": per_family, "upright": upright, "seed": seed}
    found = drawn_goals(
        load_objects(names, meshes),
        load_robot(robot),
        families,
        poses,
        **config,
        progress=progress,
    )
    if out is not None:
        stated = robot if isinstance(robot, str | Path) else None
        write_goals(out, found, config=config, robot=stated, meshes=meshes)
    return found
