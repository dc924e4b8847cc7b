"""Reads the description of a robot, ``robot.toml``.

A robot is a folder with a ``robot.toml`` and the URDF that it names. A package registers such a folder with an entry
point of the group ``xreset.robots`` whose value is the module in the folder: ``my-robot = "my_package.my_robot"``. The
built-in robots are listed in ``pyproject.toml`` in the same way, and their ``robot.toml`` are commented examples of the
format.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from xreset.errors import RobotError
from xreset.files.checks import parsed
from xreset.files.storage import read_toml
from xreset.geometry.urdf import mesh_files
from xreset.physics.plugins import DESCRIPTION, robot_folder, robot_names
from xreset.spec import RobotSpec

SCHEMA = "xreset-robot/1"
"""What ``schema`` in the description must be."""


def load_robot(name_or_folder: str | Path | RobotSpec) -> RobotSpec:
    """Read a robot's description.

    Args:
        name_or_folder: a registered name, or a folder with a ``robot.toml``. A loaded robot is returned as it is.

    Raises:
        RobotError: the robot is unknown, or its description is wrong; the message lists everything that is wrong.
            Whether the URDF has the named links and joints is found by :func:`xreset.robot_tools.check.check`.
    """
    if isinstance(name_or_folder, RobotSpec):
        return name_or_folder
    spec = read_description(robot_folder(name_or_folder) / DESCRIPTION)
    name = str(name_or_folder)
    if name in robot_names() and spec.name != name:  # files name the robot as robot.toml does
        raise RobotError(
            f"The package of the robot {name!r} calls it {spec.name!r} in robot.toml. Use one name in both."
        )
    return spec


def read_description(path: Path) -> RobotSpec:
    """Read a ``robot.toml``; see :func:`load_robot`."""
    data = read_toml(
        path,
        SCHEMA,
        error=RobotError,
        hint=" A robot's folder has one next to its URDF; a package ships it as data.",
    )
    spec, problems = parsed(RobotSpec, _fields(data, path.parent), "the file")
    if spec is not None:
        problems = _contradictions(spec)
        if not problems:
            with suppress(RobotError):  # a wrong URDF is reported by whoever reads it
                spec = replace(spec, meshes=tuple(mesh_files(spec.urdf)))
            return spec
    listed = "".join(f"\n  - {_as_written(problem)}" for problem in problems)
    noun = "place" if len(problems) == 1 else "places"
    raise RobotError(f"{path} is wrong in {len(problems)} {noun}:{listed}")


_FIELDS = {
    "base.pos": "base_pos",
    "base.quat": "base_quat",
    "hand.root": "hand_root",
    "hand.palm": "palm",
    "collision.self": "self_collision_links",
    "collision.exclude": "collision_exclude",
    "collision.table_exclude": "table_exclude",
}
"""Entry of a table of the file -> field of a :class:`~xreset.spec.RobotSpec`; other entries have the field's name."""
_TABLES = ("base", "hand", "collision", "home_std")


def _fields(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return what a file holds as fields of a :class:`~xreset.spec.RobotSpec`; what does not fit stays as it is."""
    values = {name: value for name, value in data.items() if name != "schema"}
    for table in _TABLES:
        if isinstance(data.get(table), dict):
            for entry, value in values.pop(table).items():
                name = f"{table}.{entry}"
                values[_FIELDS.get(name, name)] = value
    arm, hand = RobotSpec.home_std
    values.setdefault(
        "home_std", [values.pop("home_std.arm", arm), values.pop("home_std.hand", hand)]
    )
    values.pop("base.placement", None)  # how it was found, in files of 0.2.0
    if isinstance(data.get("urdf"), str):
        values["urdf"] = (folder / data["urdf"]).resolve()
    if isinstance(data.get("keypoints"), dict):
        values["keypoints"] = [
            {"keypoint": keypoint, "link": link} for keypoint, link in data["keypoints"].items()
        ]
    if isinstance(data.get("joints"), list):
        values["joints"] = [_joint(joint) for joint in data["joints"]]
    return values


def _joint(entries: Any) -> Any:
    """Return a joint of the file, which holds its drive's entries, as fields of a :class:`~xreset.spec.JointSpec`."""
    if not isinstance(entries, dict):
        return entries
    own = {name: value for name, value in entries.items() if name in ("name", "group", "home")}
    return {**own, "drive": {name: value for name, value in entries.items() if name not in own}}


def _as_written(problem: str) -> str:
    """Return a problem with the names that the file has."""
    written = {field: entry for entry, field in _FIELDS.items()}
    problem = problem.removeprefix("the file.").replace("].drive", "]")
    return re.sub(
        r"(^|[:,] |\()(\w+)", lambda match: match[1] + written.get(match[2], match[2]), problem
    )


def _contradictions(spec: RobotSpec) -> list[str]:
    """Return what is wrong although each entry has the right form."""
    problems = []
    unique = {
        "joints": [*spec.joint_names, *(mimic.joint for mimic in spec.mimics)],
        "fingertips": spec.fingertip_names,
        "fingertips' links": [tip.link for tip in spec.fingertips],
    }
    for what, names in unique.items():
        repeated = sorted(name for name, count in Counter(names).items() if count > 1)
        if repeated:
            problems.append(f"{what}: {', '.join(repeated)} occur more than once.")
    for mimic in spec.mimics:
        if mimic.source not in spec.joint_names:
            problems.append(
                f"mimics: {mimic.joint!r} follows {mimic.source!r}, which is not among the joints."
            )
    if not spec.fingertips or spec.fingertips[0].name != "thumb":
        problems.append(
            f"fingertips: the first must be 'thumb', found {list(spec.fingertip_names)}."
        )
    if not len(spec.arm_indices) or not len(spec.hand_indices):
        problems.append(
            "joints: at least one joint must be of group 'arm' and one of group 'hand'."
        )
    length = math.hypot(*spec.base_quat)
    if abs(length - 1) > 1e-3:
        problems.append(f"base: quat {list(spec.base_quat)} has length {length:.4g}, expected 1.")
    return problems
