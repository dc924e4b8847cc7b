"""Reading of a robot's description, ``robot.toml``.

A robot is a folder with a ``robot.toml`` and the URDF that it names. A package makes such a folder known with an entry point of the group
``xreset.robots`` whose value is the module that lies in the folder: ``my-robot = "my_package.my_robot"``. The built-in robots are listed in
``pyproject.toml`` in the same way, and their ``robot.toml`` are commented examples of the format.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from xreset.errors import RobotError
from xreset.plugins import robot_folder
from xreset.spec import KEYPOINTS, DriveSpec, FingertipSpec, JointSpec, KeypointSpec, MimicSpec, PlacementSpec, RobotSpec

DESCRIPTION = "robot.toml"
"""Name of the description in a robot's folder."""
SCHEMA = "xreset-robot/1"
"""What ``schema`` in the description must be."""


def load_robot(name_or_folder: str | Path) -> RobotSpec:
    """Read a robot's description.

    Args:
        name_or_folder: a registered name, or a folder with a ``robot.toml``.

    Raises:
        RobotError: unknown robot, or a description that is wrong; the message lists everything that is wrong in it. What only the URDF can
            tell (whether the named links and joints exist) is found by :func:`xreset.robot_tools.check.check`.
    """
    return read_description(robot_folder(name_or_folder) / DESCRIPTION)


def read_description(path: Path) -> RobotSpec:
    """Read a ``robot.toml``; see :func:`load_robot`."""
    try:
        data = tomllib.loads(path.read_text())
    except OSError as error:
        raise RobotError(
            f"{path.parent} has no readable {path.name} ({error.strerror}). A robot's folder holds one beside its URDF."
        ) from error
    except (ValueError, RecursionError) as error:  # also texts that are not UTF-8, numbers of thousands of digits
        raise RobotError(f"{path} is not valid TOML: {error}.") from error
    if data.get("schema") != SCHEMA:
        raise RobotError(f"{path} states schema {data.get('schema')!r}, expected {SCHEMA!r}.")
    problems: list[str] = []
    spec = _robot(_Table(data, "", problems), path)
    problems = problems or _contradictions(spec)
    if problems:
        listed = "".join(f"\n  - {problem}" for problem in problems)
        raise RobotError(f"{path} is wrong in {len(problems)} place{'s' * (len(problems) > 1)}:{listed}")
    return spec


# The format ------------------------------------------------------------------------------------------------------------------------------


def _robot(top: _Table, path: Path) -> RobotSpec:
    top.text("schema")
    base, hand, collision = top.table("base"), top.table("hand"), top.table("collision", optional=True)
    spread = top.table("home_std", optional=True)
    keypoints = top.table("keypoints")
    spec = RobotSpec(
        name=top.text("name"),
        urdf=(path.parent / top.text("urdf")).resolve(),
        joints=tuple(_joint(row) for row in top.rows("joints")),
        mimics=tuple(_mimic(row) for row in top.rows("mimics", optional=True)),
        base_pos=base.numbers("pos", 3),
        base_quat=base.numbers("quat", 4),
        placement=_placement(base.table("placement")) if "placement" in base.data else None,
        palm=hand.text("palm"),
        hand_root=hand.text("root"),
        fingertips=tuple(_fingertip(row) for row in top.rows("fingertips")),
        keypoints=tuple(KeypointSpec(keypoint=key, link=keypoints.text(key)) for key in keypoints.data),
        self_collision_links=collision.texts("self", ()),
        collision_exclude=collision.pairs("exclude", ()),
        table_exclude=collision.texts("table_exclude", ()),
        gravity_compensated=top.flag("gravity_compensated", True),
        home_std=(spread.number("arm", RobotSpec.home_std[0]), spread.number("hand", RobotSpec.home_std[1])),
    )
    top.finish()
    return spec


def _joint(row: _Table) -> JointSpec:
    group: Literal["arm", "hand"] = "arm" if row.choice("group", ("arm", "hand")) == "arm" else "hand"
    return JointSpec(
        name=row.text("name"),
        group=group,
        home=row.number("home"),
        drive=DriveSpec(
            kp=row.number("kp"),
            kd=row.number("kd"),
            effort=row.number("effort"),
            armature=row.number("armature", 0.0),
            friction_loss=row.number("friction_loss", 0.0),
        ),
    )


def _mimic(row: _Table) -> MimicSpec:
    return MimicSpec(
        joint=row.text("joint"), source=row.text("source"), multiplier=row.number("multiplier", 1.0), offset=row.number("offset", 0.0)
    )


def _placement(row: _Table) -> PlacementSpec:
    return PlacementSpec(
        reached=row.number("reached"), followed=row.number("followed"), frames=int(row.number("frames")), command=row.text("command")
    )


def _fingertip(row: _Table) -> FingertipSpec:
    return FingertipSpec(
        name=row.text("name"), link=row.text("link"), contact_links=row.texts("contact_links"), keypoint=row.choice("keypoint", KEYPOINTS)
    )


def _contradictions(spec: RobotSpec) -> list[str]:
    """What is wrong although every entry by itself has the right form."""
    problems = []
    for what, names in (
        ("joints", [*spec.joint_names, *(mimic.joint for mimic in spec.mimics)]),
        ("fingertips", list(spec.fingertip_names)),
        ("fingertips' links", [tip.link for tip in spec.fingertips]),
    ):
        if twice := sorted({name for name in names if names.count(name) > 1}):
            problems.append(f"{what}: {', '.join(twice)} occur more than once.")
    for mimic in spec.mimics:
        if mimic.source not in spec.joint_names:
            problems.append(f"mimics: {mimic.joint!r} follows {mimic.source!r}, which is not among the joints.")
    for keypoint in spec.keypoints:
        if keypoint.keypoint not in KEYPOINTS:
            problems.append(f"keypoints: there is no keypoint {keypoint.keypoint!r}; there are {', '.join(KEYPOINTS)}.")
    if not spec.joints:
        problems.append("joints: there is none.")
    if not spec.fingertips or spec.fingertips[0].name != "thumb":
        problems.append(f"fingertips: the first must be 'thumb', found {list(spec.fingertip_names)}.")
    if not len(spec.arm_indices) or not len(spec.hand_indices):
        problems.append("joints: at least one joint must be of group 'arm' and one of group 'hand'.")
    if abs(math.hypot(*spec.base_quat) - 1) > 1e-3:
        problems.append(f"base: quat {list(spec.base_quat)} has length {math.hypot(*spec.base_quat):.4g}, expected 1.")
    return problems


# Reading a table of TOML: every problem is noted, a harmless value takes the place of a wrong one -----------------------------------------


class _Table:
    """A TOML table that is read key by key, so that what is wrong, missing or left over can be told all at once."""

    def __init__(self, data: Any, where: str, problems: list[str]) -> None:
        self.where = where
        self.problems = problems
        self.data: Mapping[str, Any] = data if isinstance(data, dict) else {}
        self.known: list[str] = []
        self.inner: list[_Table] = []
        if not isinstance(data, dict):
            self._note(f"is {_shown(data)}, expected a table")

    def finish(self) -> None:
        """Note the keys that nobody asked for, here and in the tables inside."""
        for key in self.data:
            if key not in self.known:
                self._note(f"has the unknown key {key!r}; known are {', '.join(self.known)}")
        for table in self.inner:
            table.finish()

    def text(self, key: str) -> str:
        return self._get(key, _is_text, "a text", None, "")

    def flag(self, key: str, default: bool) -> bool:
        return self._get(key, lambda value: isinstance(value, bool), "true or false", default, default)

    def number(self, key: str, default: float | None = None) -> float:
        return float(self._get(key, _is_number, "a finite number", default, 0.0))

    def choice(self, key: str, options: tuple[str, ...]) -> str:
        return self._get(key, lambda value: value in options, f"one of {', '.join(options)}", None, options[0])

    def numbers(self, key: str, length: int) -> Any:
        def fits(value: Any) -> bool:
            return isinstance(value, list) and len(value) == length and all(map(_is_number, value))

        return tuple(float(value) for value in self._get(key, fits, f"{length} finite numbers", None, [1.0] + [0.0] * (length - 1)))

    def texts(self, key: str, default: tuple[str, ...] | None = None) -> tuple[str, ...]:
        def fits(value: Any) -> bool:
            return isinstance(value, list) and all(map(_is_text, value))

        return tuple(self._get(key, fits, "a list of texts", default, ()))

    def pairs(self, key: str, default: tuple[tuple[str, str], ...]) -> tuple[tuple[str, str], ...]:
        def fits(value: Any) -> bool:
            return isinstance(value, list) and all(isinstance(p, list) and len(p) == 2 and all(map(_is_text, p)) for p in value)

        return tuple((a, b) for a, b in self._get(key, fits, "a list of pairs of texts", default, ()))

    def table(self, key: str, *, optional: bool = False) -> _Table:
        value = self._get(key, lambda value: isinstance(value, dict), "a table", {} if optional else None, {})
        self.inner.append(_Table(value, key, self.problems))
        return self.inner[-1]

    def rows(self, key: str, *, optional: bool = False) -> list[_Table]:
        value = self._get(key, lambda value: isinstance(value, list), "a list of tables", [] if optional else None, [])
        tables = [_Table(row, f"{key}[{i}]", self.problems) for i, row in enumerate(value)]
        self.inner += tables
        return tables

    def _get(self, key: str, fits: Callable[[Any], bool], expected: str, default: Any, harmless: Any) -> Any:
        self.known.append(key)
        if key not in self.data:
            if default is None:
                self._note(f"has no {key!r}, expected {expected}")
            return harmless if default is None else default
        value = self.data[key]
        if fits(value):
            return value
        self._note(f"has {key} = {_shown(value)}, expected {expected}")
        return harmless

    def _note(self, problem: str) -> None:
        self.problems.append(f"{self.where or 'the file'} {problem}.")


def _is_text(value: Any) -> bool:
    return isinstance(value, str) and bool(value.strip()) and value.isprintable()


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


_LARGEST = 1e9
"""Of any number of a description: stiffnesses reach 1e5, everything else far less."""


def _shown(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
