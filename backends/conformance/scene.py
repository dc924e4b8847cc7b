"""The scene of the conformance suite: small, quick to build, with nothing symmetric, centred or in a likely order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from xreset.geometry.description import read_description
from xreset.geometry.shapes import mass_properties, mesh_arrays, surface_of, transform
from xreset.spec import Geometry, ObjectSpec, PairFriction, RobotSpec, SceneSpec, Shape


@cache
def gripper() -> RobotSpec:
    """Return the suite's own robot, hung above the table: five joints, one with a mimic joint, and two fingertips.

    Its joint order is neither the URDF's nor alphabetical.
    """
    return read_description(Path(__file__).with_name("gripper.toml"))


def presser(**contact_links: tuple[str, ...]) -> RobotSpec:
    """Return a foot that slides along x and presses down, next to a shelf on its base.

    Args:
        contact_links: finger, ``thumb`` or ``index`` -> which links are its own, of ``foot``, ``shelf`` and ``palm``.
    """
    robot = read_description(Path(__file__).with_name("presser.toml"))
    tips = []
    for tip in robot.fingertips:
        tips.append(replace(tip, contact_links=contact_links.get(tip.name, tip.contact_links)))
    return replace(robot, fingertips=tuple(tips))


@cache
def objects() -> tuple[ObjectSpec, ...]:
    """Return a brick (a box), a can (a cylinder) and a bracket (two hulls); no centre of mass is at the mesh origin."""
    brick = shape("box", (0.02, 0.03, 0.025), (0.01, 0.005, -0.004), yaw=0.3)
    can = shape("cylinder", (0.033, 0.05), (0.0, 0.0, 0.01))
    foot = shape("hull", (0.05, 0.02, 0.01), (0.0, 0.0, -0.02))
    arm = shape("hull", (0.012, 0.02, 0.03), (-0.038, 0.0, 0.02))
    return (
        solid("brick", 0.25, (brick,), shift=(0.004, -0.003, 0.002), twist=0.2),
        solid("can", 0.35, (can,), shift=(0.002, 0.0, -0.003)),
        solid("bracket", 0.30, (foot, arm), shift=(0.0, 0.001, 0.0)),
    )


@cache
def flat_objects() -> tuple[ObjectSpec, ...]:
    """Return a box, the same as a hull, the same as two hulls, and a cylinder: all 40 mm high, with centred frames."""
    size = (0.05, 0.06, 0.02)
    half = (0.025, 0.06, 0.02)
    halves = (shape("hull", half, (0.025, 0, 0)), shape("hull", half, (-0.025, 0, 0)))
    return (
        solid("box", 0.4, (shape("box", size),)),
        solid("hull", 0.4, (shape("hull", size),)),
        solid("two hulls", 0.4, halves),
        solid("cylinder", 0.4, (shape("cylinder", (0.06, 0.02)),)),
    )


@cache
def tin() -> ObjectSpec:
    """Return a tin of 40 mm diameter and 30 mm height, a hull with 16 sides."""
    vertices, faces = mesh_arrays(trimesh.creation.cylinder(0.02, 0.03, sections=16))
    hull = Geometry(kind="hull", vertices=vertices, faces=faces)
    return solid("tin", 0.3, (Shape(geometry=hull),))


@cache
def ball() -> ObjectSpec:
    """Return a ball of 30 mm radius."""
    return replace(solid("ball", 0.4, (shape("sphere", (0.03,)),)), inertia=8e-4 * np.eye(3))


def scene(robot: RobotSpec | None = None) -> SceneSpec:
    """Return the suite's scene: its own robot or another one, and its three objects."""
    friction = PairFriction(tip=0.9, link=0.5, table=0.6, torsional=0.002)
    return SceneSpec(robot=robot or gripper(), objects=objects(), friction=friction)


def reorder_joints(scene: SceneSpec) -> SceneSpec:
    """Return the scene with its joints named in reverse order."""
    return replace(scene, robot=replace(scene.robot, joints=scene.robot.joints[::-1]))


def shape(
    kind: str, size: Sequence[float], pos: Sequence[float] = (0, 0, 0), yaw: float = 0.0
) -> Shape:
    """Return a shape at a place in the mesh frame [m].

    Sizes [m]: half edges of a box, or of a box that is given as a hull; radius and half height of a cylinder; radius
    of a sphere.
    """
    geometry = Geometry(kind=kind, size=tuple(size))  # pyright: ignore[reportArgumentType]
    if kind == "hull":
        mesh = trimesh.creation.box(extents=2.0 * np.array(size))
        vertices, faces = mesh_arrays(mesh)
        geometry = Geometry(kind="hull", vertices=vertices, faces=faces)
    turn = Rotation.from_euler("z", yaw).as_matrix()
    return Shape(geometry=geometry, T_body_shape=transform(turn, pos))


def solid(
    name: str,
    mass: float,
    pieces: tuple[Shape, ...],
    *,
    shift: Sequence[float] = (0, 0, 0),
    twist: float = 0.0,
) -> ObjectSpec:
    """Return an object of even density whose centre of mass is then shifted and whose principal axes are turned.

    The mass is a number of float32, as the interface to a backend has it: a mass that is set and one that is built do
    not differ by rounding.
    """
    mass = float(np.float32(mass))
    vertices, faces = surface_of(pieces)
    com, inertia = mass_properties(vertices, faces, mass)
    R = Rotation.from_euler("xyz", (twist, -twist, twist)).as_matrix()
    return ObjectSpec(
        name=name,
        pieces=pieces,
        mass=mass,
        com=com + np.array(shift),
        inertia=R @ inertia @ R.T,
        vertices=vertices,
        faces=faces,
    )
