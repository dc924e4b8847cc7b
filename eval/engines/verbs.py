"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.files.checks import Json, JsonOrPage, Option, PositiveInt, obeys_rules
from xreset.files.progress import NamedProgress, unseen
from xreset.files.records import replaces
from xreset.files.storage import file_hash, measured, write_json, write_whole
from xreset.files.text import texts
from xreset.physics.plugins import Device, EngineName, RobotName, backend_class

if TYPE_CHECKING:
    from xreset.eval.engines.agreement import Parity
    from xreset.eval.rollout import Engine
else:  # a command has texts in place of these
    Parity = Engine = Any


@obeys_rules
def check_engines(
    engine: Annotated[EngineName, Option("engine")] | Sequence[EngineName],
    *,
    robot: RobotName | None = None,
    device: Device = "cpu",
    only: Annotated[Sequence[str], Option("check")] = (),
    out: Annotated[JsonOrPage, replaces("xreset-")] | None = None,
    say: Callable[[Any], None] = print,
) -> list[dict[str, Any]]:
    """Test whether physics engines keep their contract. The command exits with 1 if one does not.

    Args:
        engine: physics engine, or several; the command's default: all that can be used here.
        robot: name or folder of the robot to test with; default: a gripper, with which every check can run.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        only: check to run, or several, with every measured number; default: all, with the number of each that is
            nearest to its tolerance.
        out: file to write: every number (.json), or a page with tables (.md).
        say: called with lines about each check.

    Returns:
        The runs of the file of results (:mod:`xreset.backends.conformance.results`), one for each engine.

    Raises:
        XResetError: an engine or a check is unknown, or an engine cannot be used here.
    """
    from xreset.backends import conformance
    from xreset.eval.engines import contract
    from xreset.eval.engines import page as pages
    from xreset.geometry.description import load_robot

    spec = load_robot(robot) if robot else conformance.scene().robot
    names = texts(engine)
    for name in names:  # before minutes of checks
        backend_class(name).engine_version()
    runs = [contract.check(name, spec, device, only, say) for name in names]
    found = measured({"schema": conformance.SCHEMA, "runs": runs})
    if out is not None and Path(out).suffix.lower() == ".json":
        write_json(out, found)
    elif out is not None:
        write_whole(out, pages.page(found))
    return runs


@obeys_rules
def compare_engines(
    motion: str | Path,
    engine: EngineName | Engine | Sequence[EngineName | Engine],
    *,
    robot: RobotName | None = None,
    meshes: str | Path | None = None,
    names: Annotated[Sequence[str], Option("object")] = (),
    grasps: PositiveInt = 48,
    device: Device = "cpu",
    out: Annotated[Json, replaces("xreset-")] | None = None,
    progress: NamedProgress = unseen,
) -> Parity:
    """Measure how far physics engines agree with MuJoCo on grasps. The command exits with 1 if one misses a target.

    Press: a hand closes on an object that cannot move. Closing: a hand closes on an object on the table, lifts and
    shakes it. Hold: lift and shake from a common state. The column of MuJoCo at half the timestep shows how far two
    solutions of the same equations differ. The command leaves out MuJoCo-Warp on a CPU, where it is slow, unless it is
    named.

    Args:
        motion: file with the grasps: of xreset retarget, or of xreset demos, which is retargeted first.
        engine: physics engine to measure, or several; the command's default: all that can be used here, on a CPU
            without MuJoCo-Warp, which is slow there.
        robot: name or folder of the robot; default: the file's.
        meshes: folder of real meshes; default: as the file names it, else the stand-ins.
        names: object to use, or several; default: all objects of the file.
        grasps: number of closings, and of holds.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        out: file to write, with every number (.json).
        progress: called with (current try, tries done, tries in all).

    Raises:
        DemoError: the file shows no grasp.
        XResetError: an engine is unknown or cannot be used here.
    """
    from xreset.eval.engines import agreement
    from xreset.eval.rollout import chosen_engines
    from xreset.resets.inputs import load_inputs

    tested = [each for each in chosen_engines(engine, device) if each.name != agreement.REFERENCE]
    inputs = load_inputs(motion, robot=robot, meshes=meshes, only=names, accept=("demos", "motion"))
    grasped = inputs.motion(partial(progress, "retargeting"))
    # hashed now, because after minutes of work the file may have changed
    hashes = {"motion": file_hash(motion)}
    found = agreement.compare(
        inputs.robot, inputs.objects, grasped, tested, grasps=grasps, progress=progress
    )
    if out is not None:
        write_json(out, measured(asdict(found) | {"ok": not found.missed, "inputs": hashes}))
    return found
