"""The scene of the conformance suite: small, quick to build, and with nothing symmetric, centred or in the engine's likely order."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from xreset.description import read_description
from xreset.geometry.urdf import robot_tree
from xreset.spec import Geometry, ObjectSpec, PairFriction, RobotSpec, SceneSpec, Shape


@cache
def gripper() -> RobotSpec:
    """The suite's own robot, hung above the table: five joints, one of which another one mimics, and two fingertips.

    Its joint order is neither the URDF's nor alphabetical.
    """
    return read_description(Path(__file__).with_name("gripper.toml"))


@cache
def objects() -> tuple[ObjectSpec, ...]:
    """A brick (a box), a can (a cylinder) and a bracket (two hulls); the centres of mass are off the origin of the mesh frame."""
    brick = shape("box", (0.02, 0.03, 0.025), (0.01, 0.005, -0.004), yaw=0.3)
    can = shape("cylinder", (0.033, 0.05), (0.0, 0.0, 0.01))
    foot, arm = (
        shape("hull", (0.05, 0.02, 0.01), (0.0, 0.0, -0.02)),
        shape("hull", (0.012, 0.02, 0.03), (-0.038, 0.0, 0.02)),
    )
    return (
        solid("brick", 0.25, (brick,), shift=(0.004, -0.003, 0.002), twist=0.2),
        solid("can", 0.35, (can,), shift=(0.002, 0.0, -0.003), twist=0.0),
        solid("bracket", 0.30, (foot, arm), shift=(0.0, 0.001, 0.0), twist=0.0),
    )


@cache
def flat_objects() -> tuple[ObjectSpec, ...]:
    """A box, a hull of the same shape, two hulls side by side, and a cylinder: all rest 20 mm above the table and are 40 mm high."""
    half = (0.05, 0.06, 0.02)
    side = (half[0] / 2, half[1], half[2])
    return (
        solid("box", 0.4, (shape("box", half, (0, 0, 0)),)),
        solid("hull", 0.4, (shape("hull", half, (0, 0, 0)),)),
        solid("two hulls", 0.4, tuple(shape("hull", side, (x, 0, 0)) for x in (side[0], -side[0]))),
        solid("cylinder", 0.4, (shape("cylinder", (0.06, 0.02), (0, 0, 0)),)),
    )


@cache
def ball() -> ObjectSpec:
    """A ball of 30 mm radius."""
    return replace(solid("ball", 0.4, (shape("sphere", (0.03,), (0, 0, 0)),)), inertia=8e-4 * np.eye(3))


def scene(robot: RobotSpec | None = None) -> SceneSpec:
    """The suite's scene: its own robot or another one, and its three objects."""
    return SceneSpec(
        robot=robot or gripper(),
        objects=objects(),
        friction=PairFriction(tip=0.9, link=0.5, table=0.6, torsional=0.002),
    )


def without_collisions(scene: SceneSpec) -> SceneSpec:
    """The same scene with a robot whose links touch neither one another nor the table."""
    robot = scene.robot
    return replace(scene, robot=replace(robot, self_collision_links=(), table_exclude=robot_tree(robot).link_names))


def reorder_joints(scene: SceneSpec) -> SceneSpec:
    """The same scene with its joints named in reverse order."""
    return replace(scene, robot=replace(scene.robot, joints=scene.robot.joints[::-1]))


def shape(kind: str, size: tuple[float, ...], pos: tuple[float, float, float], yaw: float = 0.0) -> Shape:
    """A box, a box as a hull (half edges), a cylinder (radius, half height) or a sphere, at a place in the mesh frame [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("z", yaw).as_matrix(), pos
    if kind == "hull":  # a box, given as vertices
        mesh = trimesh.creation.box(extents=2.0 * np.array(size))
        geometry = Geometry(kind="hull", vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))
    else:
        geometry = Geometry(kind=kind, size=size)  # pyright: ignore[reportArgumentType]
    return Shape(geometry=geometry, T_body_shape=T)


def solid(
    name: str, mass: float, pieces: tuple[Shape, ...], *, shift: Sequence[float] = (0, 0, 0), twist: float = 0.0
) -> ObjectSpec:
    """An object with the inertia of its shape at even density, then its centre of mass shifted and its principal axes turned.

    Its mass is a number of float32, as the interface to a backend has it: no rounding comes between a mass that is set and one built.
    """
    mass = float(np.float32(mass))
    mesh = trimesh.util.concatenate([_mesh(piece) for piece in pieces])
    R = Rotation.from_euler("xyz", (twist, -twist, twist)).as_matrix()
    return ObjectSpec(
        name=name,
        pieces=pieces,
        mass=mass,
        com=np.asarray(mesh.center_mass) + np.array(shift),
        inertia=R @ np.asarray(mesh.moment_inertia) * (mass / mesh.mass) @ R.T,
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
    )


def _mesh(shape: Shape) -> trimesh.Trimesh:
    geometry = shape.geometry
    if geometry.kind == "box":
        mesh = trimesh.creation.box(extents=2.0 * np.array(geometry.size))
    elif geometry.kind == "sphere":
        mesh = trimesh.creation.icosphere(radius=geometry.size[0])
    elif geometry.kind == "cylinder":
        mesh = trimesh.creation.cylinder(radius=geometry.size[0], height=2.0 * geometry.size[1], sections=32)
    else:
        mesh = trimesh.Trimesh(geometry.vertices, geometry.faces)
    return mesh.apply_transform(shape.T_body_shape)
