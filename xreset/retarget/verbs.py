"""``retarget_demos``, a function and a command: its signature has the options, its docstring the help.

It imports most of what it needs when it is called, because the help of a command is shown at once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.files.checks import Option, OutputFile, obeys_rules
from xreset.files.progress import Progress, unseen
from xreset.files.records import replaces
from xreset.files.storage import file_hash
from xreset.physics.plugins import Device, RobotName

if TYPE_CHECKING:
    from xreset.demos.archive import Demos
    from xreset.retarget.file import Retargeted
    from xreset.retarget.pipeline import RetargetConfig
    from xreset.spec import ObjectSpec, RobotSpec
else:  # a command has files and names in place of these
    Demos = Retargeted = RetargetConfig = ObjectSpec = RobotSpec = Any

_warn = logging.getLogger(__name__).warning


@obeys_rules
def retarget_demos(
    demos: str | Path | Demos,
    robot: RobotName | RobotSpec,
    objects: Sequence[ObjectSpec] | None = None,
    config: RetargetConfig | None = None,
    *,
    out: Annotated[OutputFile, replaces("xreset-retargeted/")] | None = None,
    meshes: str | Path | None = None,
    trust: Annotated[bool, Option("trust_recordings")] = False,
    device: Device = "cpu",
    progress: Progress = unseen,
    note: Callable[[str], None] = _warn,
) -> Retargeted:
    """Turn human demonstrations into robot motion.

    Sequences are independent of one another, and the same arguments give the same result.

    Args:
        demos: archive of demonstrations (xreset demos); they need not rest on the table yet.
        robot: name of a robot, or the folder of its description.
        objects: geometry of every object that the demonstrations name; default: those of ``meshes``.
        config: weights and limits.
        out: file to write.
        meshes: folder of real meshes; default: the built-in stand-ins.
        trust: use demonstrations that are certainly wrong all the same.
        device: where hand retargeting runs: cpu or cuda. The arm runs on the CPU.
        progress: called with the sequences done and the sequences in all.
        note: called with each doubt about the demonstrations (:mod:`xreset.demos.examine`).

    Returns:
        Trajectories of every sequence. In a sequence without an annotated hand the robot stays at home and no frame is
        valid.

    Raises:
        DemoError: an object is unknown, or demonstrations are certainly wrong.
        RobotError: the robot's description does not allow retargeting.
    """
    from xreset.demos.archive import demo_objects, read_demos
    from xreset.demos.examine import examine, refuse_wrong
    from xreset.geometry.description import load_robot
    from xreset.geometry.surface import prepared_surface
    from xreset.retarget.file import write_retargeted
    from xreset.retarget.pipeline import RetargetConfig, follow
    from xreset.spec import checked_objects, objects_named

    spec = load_robot(robot)
    inputs = {}
    if isinstance(demos, str | Path):
        path = demos
        demos = read_demos(path)
        inputs["demos"] = file_hash(path)
    if objects is None:
        objects = tuple(demo_objects(demos, meshes).values())
    objects = checked_objects(spec, objects)
    named = objects_named(objects, demos.object_names)
    surfaces = {name: prepared_surface(each) for name, each in named.items()}
    doubts = refuse_wrong(examine(demos, surfaces), trust=trust)
    for doubt in doubts:
        note(doubt)
    config = config or RetargetConfig()
    motion = follow(demos, spec, objects, config, progress=progress, device=device)
    if out is not None:
        made_with = {
            "retarget": asdict(config),
            "robot": spec.name if robot is spec else str(robot),
            "meshes": str(meshes) if meshes else None,
            "doubts": doubts,
        }
        inputs["robot"] = spec.fingerprint
        for each in objects:
            inputs[f"object {each.name}"] = each.source
        write_retargeted(out, motion, config=made_with, inputs=inputs)
    return motion
