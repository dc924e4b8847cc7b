"""Grasps from files: retargeted trajectories, reset banks, or demonstrations that are retargeted here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from xreset.demos.archive import SCHEMA_NAME as DEMOS
from xreset.description import load_robot
from xreset.errors import DemoError, FileFormatError
from xreset.eval.engines.grasps import Frames
from xreset.files import npz_schema
from xreset.objects import canonical_name, load_objects
from xreset.resets.bank import SCHEMA as BANK
from xreset.resets.bank import check_objects, check_retargeted, check_robot, read_bank
from xreset.retarget.file import SCHEMA as RETARGETED
from xreset.retarget.file import read_retargeted
from xreset.spec import ObjectSpec, RobotSpec


def load_frames(
    path: Path,
    *,
    robot: str | None = None,
    objects_folder: Path | None = None,
    only: Iterable[str] = (),
    progress: Callable[[str, float, int], None] = lambda doing, done, total: None,
) -> tuple[RobotSpec, tuple[ObjectSpec, ...], Frames]:
    """Robot, objects and frames of a file.

    Args:
        path: retargeted trajectories, a reset bank, or demonstrations.
        robot: name or folder; default: the file's. Demonstrations need it.
        objects_folder: folder of real meshes; None for the stand-ins.
        only: names of the objects to use; default: all of the file.
        progress: called with (what is being done, sequences retargeted, sequences in all).

    Raises:
        XResetError: the file, the robot or an object cannot be used, or they do not belong together.
    """
    schema = npz_schema(path)
    if schema == RETARGETED:
        data = read_retargeted(path)
        spec = load_robot(robot or data.robot)
        check_retargeted(path, data, spec)
        frames = Frames.of_retargeted(data)
        return spec, _objects(data.object_name.tolist(), only, objects_folder, path), frames
    if schema == BANK:
        bank = read_bank(path)
        spec = load_robot(robot or bank.robot)
        check_robot(path, "reset bank", spec, name=bank.robot, joint_names=bank.joint_names, fingerprint=bank.robot_fingerprint)
        objects = _objects(bank.object_names, only, objects_folder, path)
        check_objects(path, bank, objects)
        return spec, objects, Frames.of_bank(bank)
    if schema == DEMOS:
        return _retargeted_here(path, robot, objects_folder, only, progress)
    raise FileFormatError(f"{path} states schema {schema!r}; grasps come from {RETARGETED!r}, {BANK!r} or {DEMOS!r}.")


def _retargeted_here(
    path: Path, robot: str | None, objects_folder: Path | None, only: Iterable[str], progress: Callable[[str, float, int], None]
) -> tuple[RobotSpec, tuple[ObjectSpec, ...], Frames]:
    from xreset.demos.archive import read_demos
    from xreset.retarget.pipeline import retarget

    if robot is None:
        raise DemoError(f"{path} holds demonstrations, which name no robot: give --robot.")
    demos, spec = read_demos(path), load_robot(robot)
    objects = _objects(demos.object_name.tolist(), only, objects_folder, path)
    names = [o.name for o in objects]
    demos = demos.select(objects=names)
    data = retarget(demos, spec, objects, progress=lambda done, total: progress("retargeting", done, total))
    return spec, objects, Frames.of_retargeted(data)


def _objects(found: Iterable[str], only: Iterable[str], folder: Path | None, path: Path) -> tuple[ObjectSpec, ...]:
    names = sorted(set(found))
    wanted = [canonical_name(name, names) for name in only] or names
    return load_objects(dict.fromkeys(wanted), folder)
