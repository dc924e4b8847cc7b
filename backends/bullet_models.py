"""Models for Bullet, which reads URDF files.

They are written here from the fused bodies, so every mass and inertia is the same as in the other engines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from xreset.backends.rigid import OTHER_LINK, Inertia, Mechanism, vertices
from xreset.files.checks import frozen
from xreset.geometry.shapes import roll_pitch_yaw, transform
from xreset.geometry.urdf import Joint
from xreset.spec import Shape


@frozen
class Part:
    """A link of a robot's Bullet model: a moving body, or a fixed piece of one."""

    body: int
    """Index of the body that the part is, or belongs to."""
    link: str
    """URDF link whose shapes the part has."""
    shapes: tuple[Shape, ...]
    owner: int
    """Index of the fingertip that the part belongs to, or ``OTHER_LINK``."""
    bare: bool = False
    """Whether it is a copy of friction 1, which touches links of the robot only."""


def is_hull(shapes: Sequence[Shape]) -> bool:
    """Return whether the shapes of a Bullet link are a single convex hull."""
    return bool(shapes) and shapes[0].geometry.kind == "hull"


def link_groups(shapes: Sequence[Shape]) -> list[tuple[Shape, ...]]:
    """Return the shapes that may share a Bullet link: the primitives together, every hull alone.

    Only the margin of a link with a single hull can be removed. A robot's hulls keep Bullet's margin of 1 mm against
    anything round.
    """
    hulls = [(shape,) for shape in shapes if shape.geometry.kind == "hull"]
    primitives = tuple(shape for shape in shapes if shape.geometry.kind != "hull")
    return [primitives, *hulls] if primitives or not hulls else hulls


def robot_parts(robot: Mechanism) -> list[Part]:
    """Return the base and the moving bodies, then the fixed pieces, so that Bullet's link i is body i.

    Links that touch one another have bare copies: a pair's friction is that of the rougher part.
    """
    moving = []
    fixed = []
    bare = []
    for i, body in enumerate(robot.bodies):
        for link in dict.fromkeys((body.name, *(item.link for item in body.shapes))):
            groups = link_groups([item.shape for item in body.shapes if item.link == link])
            parts = [
                Part(body=i, link=link, shapes=group, owner=robot.tip_of.get(link, OTHER_LINK))
                for group in groups
            ]
            if link in robot.robot.self_collision_links:
                bare += [replace(part, bare=True) for part in parts if part.shapes]
            if link == body.name:
                moving.append(parts.pop(0))
            fixed += parts
    return moving + fixed + bare


WEIGHTLESS = Inertia(
    mass=1e-9, com=np.zeros(3), quat=np.array([1.0, 0, 0, 0]), moments=np.full(3, 1e-14)
)
"""Inertia of fixed pieces, whose mass is counted in their body: Bullet would invent one."""


def robot_urdf(robot: Mechanism, parts: Sequence[Part], folder: Path) -> Path:
    """Write the URDF of a robot, and its meshes, into a folder."""
    lines = ['<robot name="xreset">']
    lines.append(_link("root", WEIGHTLESS, (), folder))  # Bullet does not count the root as a link
    for i, part in enumerate(parts):
        body = robot.bodies[part.body]
        is_body = i == part.body
        inertia = body.inertia if is_body and body.inertia else WEIGHTLESS
        lines.append(_link(f"link{i}", inertia, part.shapes, folder))
        if is_body and body.joint is not None:
            lines.append(_joint(i, f"link{body.parent}", body.joint, body.T_parent_body))
        else:
            parent = f"link{part.body}" if i else "root"
            lines.append(f'<joint name="joint{i}" type="fixed">{_ends(parent, i)}</joint>')
    lines.append("</robot>")
    path = folder / "robot.urdf"
    path.write_text("\n".join(lines))
    return path


def _ends(parent: str, child: int) -> str:
    return f'<parent link="{parent}"/><child link="link{child}"/>'


def _joint(i: int, parent: str, joint: Joint, T_parent_body: np.ndarray) -> str:
    kind = joint.type
    lower = joint.lower
    upper = joint.upper
    if not (np.isfinite(lower) and np.isfinite(upper)):
        kind = "prismatic" if joint.type == "prismatic" else "continuous"
        lower = 0.0
        upper = -1.0  # Bullet's sign of a joint without limits
    return (
        f'<joint name="joint{i}" type="{kind}">{_ends(parent, i)}'
        f'{_origin(T_parent_body)}<axis xyz="{_numbers(joint.axis)}"/>'
        f'<limit lower="{lower!r}" upper="{upper!r}" effort="0" velocity="0"/></joint>'
    )


def _link(name: str, inertia: Inertia, shapes: Sequence[Shape], folder: Path) -> str:
    x, y, z = inertia.moments.tolist()
    text = [
        f'<link name="{name}"><inertial>{_origin(inertial_frame(inertia))}<mass value="{inertia.mass!r}"/>'
        f'<inertia ixx="{x!r}" iyy="{y!r}" izz="{z!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
    ]
    for i, shape in enumerate(shapes):
        geometry = _geometry(shape, folder / f"{name}_{i}.obj")
        # vertices of a hull are moved
        pose = np.eye(4) if shape.geometry.kind == "hull" else shape.T_body_shape
        text.append(f"<collision>{_origin(pose)}<geometry>{geometry}</geometry></collision>")
    return "".join([*text, "</link>"])


def _geometry(shape: Shape, mesh: Path) -> str:
    kind = shape.geometry.kind
    size = shape.geometry.size
    if shape.geometry.faces is not None:
        lines = [f"v {_numbers(vertex)}" for vertex in vertices(shape)]
        lines += [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in shape.geometry.faces]
        mesh.write_text("\n".join(lines) + "\n")
        return f'<mesh filename="{mesh.name}"/>'
    if kind == "box":
        return f'<box size="{_numbers(2.0 * np.array(size))}"/>'
    if kind == "sphere":
        return f'<sphere radius="{size[0]!r}"/>'
    return f'<{kind} radius="{size[0]!r}" length="{2.0 * size[1]!r}"/>'


def _origin(T: np.ndarray) -> str:
    rpy = roll_pitch_yaw(T[:3, :3], level=1e-9)
    return f'<origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers(rpy)}"/>'


def _numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def inertial_frame(inertia: Inertia) -> np.ndarray:
    """[4, 4] pose of the centre of mass and the principal axes in the body's frame."""
    return transform(inertia.axes.T, inertia.com)
