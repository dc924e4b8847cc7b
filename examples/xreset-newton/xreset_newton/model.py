"""A scene as a Newton model.

Newton leaves gravity to the world: it is off, and weights are forces on bodies. Friction of a pair is the *mean* of its two coefficients;
the object's own is zero, so that the other's is twice the pair's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

import newton
import numpy as np
import warp as wp

from xreset.backends.rigid import Inertia, Mechanism, matrix_to_quat
from xreset.errors import CapabilityError
from xreset.spec import Geometry, ObjectSpec, SceneSpec, Shape


@dataclass(frozen=True, kw_only=True)
class NewtonSettings:
    """Newton's dials, with the results of the conformance suite that chose them."""

    internal_steps: int = 2
    """Newton steps per physics step, an even number: a step ends in the state that it began with."""
    iterations: int = 30
    """Sweeps of the projected Gauss-Seidel solver per Newton step."""
    baumgarte: float = 0.2
    """Share of a penetration that one Newton step takes away."""
    contact_gap: float = 0.001
    """Distance [m] below which two shapes are handed to the solver."""
    rows: int = 512
    """Room for constraints that touch the robot, and as much for those that do not; beyond it the world counts as overflowed."""


@dataclass(frozen=True)
class Surface:
    """What a shape is to the object."""

    role: Literal["tip", "link", "table", "object"]
    tip: int = -1
    """Index of its fingertip; -1: none."""


@dataclass(frozen=True, kw_only=True)
class NewtonModel:
    """A finished model, and where the scene's parts are in it. Its bodies are those of the mechanism without the base, then the object."""

    model: newton.Model
    pairs: np.ndarray
    """[P, 2] shapes that collide with one another."""
    surfaces: Sequence[Surface]
    """Of each shape."""


def build_model(
    scene: SceneSpec,
    robot: Mechanism,
    obj: ObjectSpec,
    inertia: Inertia,
    settings: NewtonSettings,
) -> NewtonModel:
    """Build the model of one world.

    Raises:
        CapabilityError: a joint of the robot has dry friction.
    """
    if any(joint.drive.friction_loss for joint in scene.robot.joints):
        raise CapabilityError(
            "Newton has no dry friction of joints on the CPU: give the robot's drives a friction_loss of 0."
        )
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    newton.solvers.SolverSteel.register_custom_attributes(builder)
    builder.balance_inertia = False
    shapes = _Shapes(builder, settings)
    corner = np.eye(4)
    corner[:3, 3] = *scene.table.center, -scene.table.half_size[2]
    shapes.add(
        -1,
        Shape(geometry=Geometry(kind="box", size=scene.table.half_size), T_body_shape=corner),
        Surface("table"),
    )
    _add_robot(builder, shapes, robot)
    body = builder.add_body(**_mass(inertia), label="object")
    for piece in obj.pieces:
        shapes.add(body, piece, Surface("object"))
    model = builder.finalize(device="cpu")
    model.steel.rigid_body_angular_damping.zero_()  # by default Newton brakes what spins, by 5 % a second
    return NewtonModel(model=model, pairs=shapes.colliding(robot), surfaces=shapes.surfaces)


class _Shapes:
    """The shapes that have been added to a builder."""

    def __init__(self, builder: newton.ModelBuilder, settings: NewtonSettings) -> None:
        self._builder = builder
        self._config = newton.ModelBuilder.ShapeConfig(
            density=0.0, mu=0.0, gap=settings.contact_gap
        )
        self.surfaces: list[Surface] = []
        self._links: list[str] = []

    def add(self, body: int, shape: Shape, surface: Surface, link: str = "") -> None:
        """Add a collision shape to a body; -1 is the world."""
        where = {"body": body, "xform": transform(shape.T_body_shape), "cfg": self._config}
        kind = shape.geometry.kind
        size = shape.geometry.size
        if kind == "box":
            self._builder.add_shape_box(hx=size[0], hy=size[1], hz=size[2], **where)
        elif kind == "sphere":
            self._builder.add_shape_sphere(radius=size[0], **where)
        elif kind == "hull":
            mesh = newton.Mesh(
                shape.geometry.vertices, shape.geometry.faces.flatten(), compute_inertia=False
            )
            self._builder.add_shape_convex_hull(mesh=mesh, **where)
        else:
            add = (
                self._builder.add_shape_capsule
                if kind == "capsule"
                else self._builder.add_shape_cylinder
            )
            add(radius=size[0], half_height=size[1], **where)
        self.surfaces.append(surface)
        self._links.append(link)

    def colliding(self, robot: Mechanism) -> np.ndarray:
        """[P, 2] pairs of shapes that the scene lets collide."""
        return np.array(
            [
                pair
                for pair in combinations(range(len(self.surfaces)), 2)
                if self._collide(robot, *pair)
            ],
            dtype=np.int32,
        )

    def _collide(self, robot: Mechanism, a: int, b: int) -> bool:
        roles = {self.surfaces[a].role, self.surfaces[b].role}
        if "object" in roles:
            return roles != {"object"}
        if "table" in roles:
            return (self._links[a] or self._links[b]) not in robot.robot.table_exclude
        return robot.may_collide(self._links[a], self._links[b])


def _add_robot(builder: newton.ModelBuilder, shapes: _Shapes, robot: Mechanism) -> None:
    spec = robot.robot
    base = wp.transform(spec.base_pos, xyzw(np.asarray(spec.base_quat)))
    drives = {joint.name: joint.drive for joint in spec.joints}
    joints: dict[str, int] = {}
    for index, item in enumerate(robot.bodies):
        body = index - 1  # the base is the world
        if item.joint is not None and item.inertia is not None:
            body = builder.add_link(**_mass(item.inertia), label=item.name)
            drive = drives.get(item.joint.name)
            place = transform(item.T_parent_body)
            add = (
                builder.add_joint_prismatic
                if item.joint.type == "prismatic"
                else builder.add_joint_revolute
            )
            joints[item.joint.name] = add(
                item.parent - 1,
                body,
                parent_xform=base * place if item.parent == 0 else place,
                axis=wp.vec3(*item.joint.axis),
                target_ke=drive.kp if drive else 0.0,
                target_kd=drive.kd if drive else 0.0,
                effort_limit=drive.effort if drive else 0.0,
                armature=drive.armature if drive else 0.0,
                limit_lower=item.joint.lower,
                limit_upper=item.joint.upper,
                friction=0.0,
                label=item.joint.name,
            )
        for part in item.shapes:
            tip = robot.tip_of.get(part.link, -1)
            placed = (
                Shape(
                    geometry=part.shape.geometry,
                    T_body_shape=matrix(base) @ part.shape.T_body_shape,
                )
                if body < 0
                else part.shape
            )
            shapes.add(body, placed, Surface("link" if tip < 0 else "tip", tip), part.link)
    for mimic in spec.mimics:
        builder.set_joint_mimic(
            joints[mimic.joint], joints[mimic.source], coeffs=(mimic.offset, mimic.multiplier)
        )
    builder.add_articulation(list(joints.values()))


def _mass(inertia: Inertia) -> dict[str, object]:
    """What a Newton body is told of its mass."""
    return {
        "mass": inertia.mass,
        "com": wp.vec3(*inertia.com),
        "inertia": wp.mat33(*inertia.matrix.flatten()),
        "lock_inertia": True,
    }


def xyzw(quat: np.ndarray) -> wp.quat:
    """Newton's quaternion of (w, x, y, z)."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return wp.quat(x, y, z, w)


def transform(T: np.ndarray) -> wp.transform:
    """Newton's transform of a pose [4, 4]."""
    return wp.transform(wp.vec3(*T[:3, 3]), xyzw(matrix_to_quat(T[:3, :3])))


def matrix(pose: wp.transform) -> np.ndarray:
    """[4, 4] pose of Newton's transform."""
    return np.array(wp.transform_to_matrix(pose)).reshape(4, 4)
