"""Load what commands work on: demonstrations, retargeted motion, a reset bank or a goal set, with the robot and the
objects."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

from xreset.demos.archive import SCHEMA_NAME as DEMOS
from xreset.demos.archive import Demos, demo_objects, read_demos, rest_on_table
from xreset.errors import DemoError, FileFormatError, XResetError
from xreset.files.checks import frozen
from xreset.files.progress import Progress, unseen
from xreset.files.records import npz_schema, stated_inputs, stated_meshes, stated_robot
from xreset.files.storage import file_hash
from xreset.files.text import shown
from xreset.geometry.description import load_robot
from xreset.objects.catalogue import canonical_names, load_objects, object_source
from xreset.physics.plugins import robot_of_file
from xreset.resets.bank import SCHEMA as BANK
from xreset.resets.bank import (
    ResetBank,
    check_objects,
    check_sources,
    read_bank,
    starts_and_goals,
    stated_sources,
)
from xreset.resets.goals import SCHEMA as GOALS
from xreset.resets.goals import GoalSet, checked_goals, read_goals
from xreset.retarget.file import SCHEMA as MOTION
from xreset.retarget.file import Retargeted, check_retargeted, object_sources, read_retargeted
from xreset.retarget.verbs import retarget_demos
from xreset.spec import ObjectSpec, RobotSpec, check_robot, checked_objects, objects_named

Kind = Literal["demos", "motion", "bank", "goals"]
Data = Demos | Retargeted | ResetBank

_KINDS = {
    "demos": (DEMOS, read_demos, "xreset demos"),
    "motion": (MOTION, read_retargeted, "xreset retarget"),
    "bank": (BANK, read_bank, "xreset resets"),
    "goals": (GOALS, read_goals, "xreset goals"),
}
"""Schema, reader, and the command that writes such files."""


@frozen
class Inputs:
    """Demonstrations, motion, a bank or a goal set, with robot and objects; all checked against one another."""

    data: Data
    objects: tuple[ObjectSpec, ...]
    """Sorted by name; for a bank in the bank's order. Where some are named, in the order of their names."""
    path: Path | None = None
    """File of the data; None: the data never were in a file."""
    hash: str | None = None
    """SHA-256 of the file when it was read."""
    made_from: Mapping[str, str] = field(default_factory=dict)
    """What a file of motion was made from: name -> SHA-256."""
    meshes: Path | None = None
    """Folder of object meshes; None: the built-in stand-ins."""
    robot_name: str | None = None
    """Name or folder of the robot, as given or as the file states it; None: demonstrations, and no robot was given."""
    loaded_robot: RobotSpec | None = None
    """The robot, if there is one; see :attr:`robot`."""

    @property
    def robot(self) -> RobotSpec:
        """The robot.

        Raises:
            DemoError: the data are demonstrations, and no robot was given.
        """
        if self.loaded_robot is None:
            raise DemoError(
                f"{self.name} holds human demonstrations, which are for no robot yet. Give one (robot=... or --robot)."
            )
        return self.loaded_robot

    @property
    def name(self) -> str:
        """What messages call the data."""
        return "the data" if self.path is None else str(self.path)

    @cached_property
    def bank(self) -> ResetBank:
        """The reset bank; for demonstrations and motion a bank without states, which holds their starts and goals."""
        data = self.data
        if isinstance(data, ResetBank):
            return data
        if isinstance(data, Demos):
            data = rest_on_table(data, self.objects)
        return starts_and_goals(data, self.robot)

    def motion(self, progress: Progress = unseen) -> Retargeted:
        """Return the robot's motion; demonstrations are retargeted here, which takes about a second for each.

        Args:
            progress: called with (sequences retargeted, sequences in all).

        Raises:
            DemoError: the data are a reset bank, or demonstrations and no robot was given.
        """
        if isinstance(self.data, Retargeted):
            return self.data
        if isinstance(self.data, ResetBank):
            what = "goal set" if isinstance(self.data, GoalSet) else "reset bank"
            raise DemoError(
                f"{self.name} is a {what}, which holds no motion. Give the file of xreset retarget."
            )
        return retarget_demos(self.data, self.robot, self.objects, progress=progress)


def load_inputs(
    source: str | Path | Data,
    *,
    robot: str | Path | RobotSpec | None = None,
    objects: Sequence[ObjectSpec] | None = None,
    meshes: str | Path | None = None,
    else_meshes: str | Path | None = None,
    only: Iterable[str] = (),
    accept: tuple[Kind, ...] = ("demos", "motion", "bank", "goals"),
) -> Inputs:
    """Load a file, or take data that are loaded already, with the robot and the objects.

    Args:
        source: file of ``xreset demos``, ``xreset retarget``, ``xreset resets`` or ``xreset goals``, or its content.
        robot: the robot, its name or its folder; default: the robot that the file names. Demonstrations name none.
        objects: the objects, if they are loaded already.
        meshes: folder of object meshes; default: the folder that the file states.
        else_meshes: folder of meshes where the file states none; default: the built-in stand-ins.
        only: names of the objects to load; demonstrations of other objects are left out. Default: all objects.
        accept: the kinds of data that the caller can use.

    Raises:
        FileFormatError: the file is damaged, of another kind, or for another robot or object geometry.
        DemoError: the demonstrations need an object that is unknown.
        GoalError: a goal of a goal set is inside the table, or out of the robot's reach.
        XResetError: the robot or an object cannot be used.
    """
    path = None
    data = source
    if isinstance(data, str | Path):
        path = Path(data)
        data = read_data(path, accept)
    if not isinstance(data, Data):
        raise XResetError(
            f"Found {shown(data)}, expected Demos, Retargeted, a ResetBank or their file."
        )
    folder = Path(meshes) if meshes else None
    if folder is None and path is not None:
        folder = stated_meshes(path)
    if folder is None and else_meshes:
        folder = Path(else_meshes)
    made_from = {}
    if path is not None and isinstance(data, Retargeted):
        made_from = stated_inputs(path)
    names = data.object_names
    if only:
        names = tuple(dict.fromkeys(canonical_names(only, names)))
        if isinstance(data, Demos):
            data = data.select(objects=names)
    if isinstance(data, Demos):
        by_name = demo_objects(data, folder) if objects is None else objects_named(objects, names)
        loaded = tuple(by_name[name] for name in names)
    else:
        stated = object_sources(made_from)
        if isinstance(data, ResetBank):
            stated = stated_sources(data)
        if robot is None and path is not None:
            robot = robot_of_file(path, stated_robot(path) or data.robot, data.robot)
        robot = robot or data.robot
        if objects is None:
            sources = {name: object_source(name, folder) for name in names if name in stated}
        else:
            objects = checked_objects(load_robot(robot), objects)
            sources = {o.name: o.source for o in objects}
        # before meshes are cut, which takes minutes
        check_sources(str(path or "the data"), stated, sources)
        loaded = load_objects(names, folder) if objects is None else objects
    robot_name = None
    spec = None
    if robot is not None:
        robot_name = robot.name if isinstance(robot, RobotSpec) else str(robot)
        spec = load_robot(robot)
    inputs = Inputs(
        data=data,
        objects=loaded,
        path=path,
        hash=file_hash(path) if path else None,
        made_from=made_from,
        meshes=folder,
        robot_name=robot_name,
        loaded_robot=spec,
    )
    if isinstance(data, GoalSet):
        return replace(inputs, data=checked_goals(inputs.name, data, inputs.robot, loaded))
    if isinstance(data, Retargeted):
        check_retargeted(inputs.name, data, inputs.robot)
    if isinstance(data, ResetBank):
        check_robot(inputs.name, "reset bank", data, inputs.robot)
        check_objects(inputs.name, data, loaded)
    return inputs


def read_data(path: Path, accept: Iterable[Kind]) -> Data:
    """Read a file of one of the kinds, without its robot and objects; ``FileFormatError`` if it is none."""
    commands = " or ".join(_KINDS[kind][2] for kind in accept)
    stated = npz_schema(path, what=f"a file of {commands}")
    expected = []
    for schema, read, command in (_KINDS[kind] for kind in accept):
        if stated == schema:
            return read(path)
        expected.append(f"{schema!r} ({command})")
    raise FileFormatError(
        f"{path} states schema {shown(stated)}, expected {' or '.join(expected)}."
    )
