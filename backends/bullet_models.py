"""Models for Bullet, which reads URDF files.

They are written here from the fused bodies, so every mass and inertia is the one of the other engines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from xreset.backends.rigid import Inertia, Mechanism, rotate
from xreset.spec import Shape


@dataclass(frozen=True, kw_only=True)
class Part:
    """A link of a Bullet model: a moving body, or a fixed piece of one."""

    body: int
    """Index of the body that it is (part of)."""
    link: str
    """URDF link whose shapes it has; empty for objects and the table."""
    shapes: tuple[Shape, ...]
    tip: int | None = None
    """Index of the fingertip that it is part of."""

    @property
    def is_hull(self) -> bool:
        """Whether its only shape is a convex hull."""
        return any(shape.geometry.kind == "hull" for shape in self.shapes)


@dataclass(frozen=True)
class Model:
    """A loaded URDF."""

    body: int
    """Bullet's number of it."""
    first: int
    """Bullet's number of its first part: -1 where that is the root of the URDF."""
    parts: list[Part]

    @property
    def links(self) -> list[tuple[int, Part]]:
        """Bullet's link number and description of every part."""
        return list(enumerate(self.parts, start=self.first))


# What remains inflated by Bullet's margin of 1 mm against anything round: a robot's hulls.


def link_groups(shapes: Sequence[Shape]) -> list[tuple[Shape, ...]]:
    """Shapes that may share a Bullet link: the primitives together, every hull alone, for only then can its margin be removed."""
    hulls = [(shape,) for shape in shapes if shape.geometry.kind == "hull"]
    primitives = tuple(shape for shape in shapes if shape.geometry.kind != "hull")
    return [primitives, *hulls] if primitives or not hulls else hulls


def robot_parts(robot: Mechanism) -> list[Part]:
    """The base and the moving bodies, then the fixed pieces: so Bullet's link i is body i."""
    moving, fixed = [], []
    for i, body in enumerate(robot.bodies):
        for link in dict.fromkeys((body.name, *(s.link for s in body.shapes))):
            parts = [
                Part(body=i, link=link, shapes=group, tip=robot.tip_of.get(link))
                for group in link_groups([s.shape for s in body.shapes if s.link == link])
            ]
            if link == body.name:
                moving.append(parts.pop(0))
            fixed += parts
    return moving + fixed


WEIGHTLESS = Inertia(mass=1e-9, com=np.zeros(3), quat=np.array([1.0, 0, 0, 0]), moments=np.full(3, 1e-14))
"""Of fixed pieces, whose mass is counted in their body: Bullet would invent one for a link without."""


def robot_urdf(robot: Mechanism, parts: Sequence[Part], folder: Path) -> Path:
    """Write the URDF of a robot."""
    text = [
        _link_text("root", WEIGHTLESS, (), folder)
    ]  # Bullet does not count the root as a link, and tells less about it
    for i, part in enumerate(parts):
        body = robot.bodies[part.body]
        text.append(
            _link_text(f"link{i}", (body.inertia if i == part.body else None) or WEIGHTLESS, part.shapes, folder)
        )
        if i == 0 or i != part.body:
            text.append(_fixed_joint_text(i, f"link{part.body}" if i else "root"))
            continue
        joint = body.joint
        limited = np.isfinite(joint.lower) and np.isfinite(joint.upper)
        kind = "prismatic" if joint.type == "prismatic" else "revolute" if limited else "continuous"
        lower, upper = (joint.lower, joint.upper) if limited else (0.0, -1.0)
        text.append(
            f'<joint name="joint{i}" type="{kind}"><parent link="link{body.parent}"/><child link="link{i}"/>'
            f'{_origin(body.T_parent_body)}<axis xyz="{_numbers(joint.axis)}"/>'
            f'<limit lower="{lower!r}" upper="{upper!r}" effort="0" velocity="0"/></joint>'
        )
    return _write(folder / "robot.urdf", text)


def _fixed_joint_text(link: int, parent: str) -> str:
    return f'<joint name="joint{link}" type="fixed"><parent link="{parent}"/><child link="link{link}"/></joint>'


def _write(path: Path, text: Sequence[str]) -> Path:
    path.write_text("\n".join(['<robot name="xreset">', *text, "</robot>"]))
    return path


def _link_text(name: str, inertia: Inertia, shapes: Sequence[Shape], folder: Path) -> str:
    x, y, z = (float(m) for m in inertia.moments)
    text = [
        f'<link name="{name}"><inertial>{_origin(inertial_frame(inertia))}<mass value="{inertia.mass!r}"/>'
        f'<inertia ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    ]
    for i, shape in enumerate(shapes):
        geometry = _geometry_text(shape, folder / f"{name}_{i}.obj")
        origin = _origin(
            np.eye(4) if shape.geometry.kind == "hull" else shape.T_body_shape
        )  # a hull's vertices are moved instead
        text.append(f"<collision>{origin}<geometry>{geometry}</geometry></collision>")
    return "".join([*text, "</link>"])


def _geometry_text(shape: Shape, mesh: Path) -> str:
    geometry = shape.geometry
    if geometry.vertices is not None and geometry.faces is not None:
        vertices = geometry.vertices @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3]
        lines = [f"v {_numbers(v)}" for v in vertices] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in geometry.faces]
        mesh.write_text("\n".join(lines) + "\n")
        return f'<mesh filename="{mesh.name}"/>'
    if geometry.kind == "box":
        return f'<box size="{_numbers(2.0 * np.array(geometry.size))}"/>'
    if geometry.kind == "sphere":
        return f'<sphere radius="{geometry.size[0]!r}"/>'
    radius, half = geometry.size
    return f'<{geometry.kind} radius="{radius!r}" length="{2.0 * half!r}"/>'


def _origin(T: np.ndarray) -> str:
    R = T[:3, :3]
    run = float(np.hypot(R[0, 0], R[1, 0]))  # cosine of the pitch: 0 where roll and yaw are one
    roll, yaw = (
        (np.arctan2(R[2, 1], R[2, 2]), np.arctan2(R[1, 0], R[0, 0]))
        if run > 1e-9
        else (np.arctan2(-R[1, 2], R[1, 1]), 0.0)
    )
    return f'<origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers((roll, np.arctan2(-R[2, 0], run), yaw))}"/>'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def inertial_frame(inertia: Inertia) -> np.ndarray:
    """[4, 4] pose of the centre of mass and the principal axes in the body's frame."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = _matrix(inertia.quat), inertia.com
    return T


def _matrix(quat: np.ndarray) -> np.ndarray:
    return np.stack([rotate(quat, axis) for axis in np.eye(3)], axis=1)
