"""The worlds of a scene as a Newton model.

Newton leaves gravity to its worlds: it is off, and weights are forces on bodies. Friction of a pair is the *mean* of its two
coefficients. The object's own is zero, so that the other's is twice the pair's; where the robot touches the table or itself, copies of its
links and of the table collide, with their friction against the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, get_args

import newton
import numpy as np
import warp as wp

from xreset.backends.rigid import (
    OTHER_LINK,
    TABLE,
    Inertia,
    Mechanism,
    matrix_to_quat,
    object_inertia,
)
from xreset.errors import CapabilityError
from xreset.spec import Geometry, ObjectSpec, SceneSpec, Shape

Role = Literal["tip", "link", "table", "object"]
"""What a shape is; the first three are the columns of a scene's frictions."""


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
    """What a shape is to the object, and what it may touch."""

    role: Role
    owner: int = OTHER_LINK
    """Index of its fingertip, or TABLE."""
    link: str = ""
    """The robot's link that it belongs to."""
    copy: bool = False
    """Whether it touches the robot and the table instead of the object."""

    @property
    def friction_scale(self) -> float:
        """Its coefficient as a multiple of the pair's friction with the object."""
        return {"object": 0.0}.get(self.role, 1.0 if self.copy else 2.0)

    @property
    def friction_column(self) -> int:
        """Which of a world's three frictions it takes."""
        return get_args(Role).index(self.role) % 3


@dataclass(frozen=True, kw_only=True)
class NewtonModel:
    """A finished model of N worlds, and where their parts are in it.

    In each world, the bodies are those of the mechanism without the base, then the object; so are the joints.
    """

    model: newton.Model
    pairs: np.ndarray
    """[P, 2] shapes that collide with one another."""
    surfaces: Sequence[Surface]
    """Of each shape."""
    worlds: np.ndarray
    """World of each shape."""


def build_model(
    scene: SceneSpec,
    robot: Mechanism,
    object_index: Sequence[int],
    settings: NewtonSettings,
    device: str,
) -> NewtonModel:
    """Build the worlds, of which each holds one of the scene's objects.

    Raises:
        CapabilityError: a joint of the robot has dry friction.
    """
    if any(joint.drive.friction_loss for joint in scene.robot.joints):
        raise CapabilityError(
            "Newton has no dry friction of joints on the CPU: give the robot's drives a friction_loss of 0."
        )
    kinds = {i: _World(scene, robot, scene.objects[i], settings) for i in set(object_index)}
    builder = _builder()
    pairs = []
    surfaces: list[Surface] = []
    worlds: list[int] = []
    for i, kind in enumerate(object_index):
        world = kinds[kind]
        pairs.append(world.pairs + len(surfaces))
        builder.add_world(world.builder)
        surfaces += world.surfaces
        worlds += [i] * len(world.surfaces)
    model = builder.finalize(device=device)
    model.steel.rigid_body_angular_damping.zero_()  # by default Newton brakes what spins, by 5 % a second
    return NewtonModel(
        model=model, pairs=np.concatenate(pairs), surfaces=surfaces, worlds=np.array(worlds)
    )


def _builder() -> newton.ModelBuilder:
    """Return a builder without gravity that takes inertias as they are."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    newton.solvers.SolverSteel.register_custom_attributes(builder)
    builder.balance_inertia = False
    return builder


class _World:
    """One world with one object, as a builder."""

    def __init__(
        self, scene: SceneSpec, robot: Mechanism, obj: ObjectSpec, settings: NewtonSettings
    ) -> None:
        self.builder = _builder()
        self.surfaces: list[Surface] = []
        self._config = newton.ModelBuilder.ShapeConfig(
            density=0.0, mu=0.0, gap=settings.contact_gap
        )
        corner = np.eye(4)
        corner[:3, 3] = *scene.table.center, -scene.table.half_size[2]
        slab = Geometry(kind="box", size=scene.table.half_size)
        self._add(-1, Shape(geometry=slab, T_body_shape=corner), "table", TABLE)
        self._add_robot(robot)
        body = self.builder.add_body(**_mass(object_inertia(obj)), label="object")
        for piece in obj.pieces:
            self._add(body, piece, "object")
        shapes = combinations(range(len(self.surfaces)), 2)
        colliding = [pair for pair in shapes if self._collide(robot, *pair)]
        self.pairs = np.array(colliding, dtype=np.int32)
        """[P, 2] pairs of shapes that the scene lets collide."""

    def _add(
        self, body: int, shape: Shape, role: Role, owner: int = OTHER_LINK, link: str = ""
    ) -> None:
        """Add a collision shape to a body, and its copy; -1 is the world."""
        for copy in (False,) if role == "object" else (False, True):
            self._add_shape(body, shape)
            self.surfaces.append(Surface(role, owner, link, copy))

    def _add_shape(self, body: int, shape: Shape) -> None:
        where = {"body": body, "xform": transform(shape.T_body_shape), "cfg": self._config}
        kind = shape.geometry.kind
        size = shape.geometry.size
        if kind == "box":
            self.builder.add_shape_box(hx=size[0], hy=size[1], hz=size[2], **where)
        elif kind == "sphere":
            self.builder.add_shape_sphere(radius=size[0], **where)
        elif kind == "hull":
            corners, faces = shape.geometry.vertices, shape.geometry.faces
            mesh = newton.Mesh(corners, faces.flatten(), compute_inertia=False)
            self.builder.add_shape_convex_hull(mesh=mesh, **where)
        elif kind == "capsule":
            self.builder.add_shape_capsule(radius=size[0], half_height=size[1], **where)
        else:
            self.builder.add_shape_cylinder(radius=size[0], half_height=size[1], **where)

    def _collide(self, robot: Mechanism, i: int, j: int) -> bool:
        a, b = self.surfaces[i], self.surfaces[j]
        roles = {a.role, b.role}
        if "object" in roles:
            return roles != {"object"} and not (a.copy or b.copy)
        if not (a.copy and b.copy):
            return False
        if "table" in roles:
            return roles != {"table"} and (a.link or b.link) not in robot.robot.table_exclude
        return robot.may_collide(a.link, b.link)

    def _add_robot(self, robot: Mechanism) -> None:
        spec = robot.robot
        base = wp.transform(spec.base_pos, xyzw(np.asarray(spec.base_quat)))
        drives = {joint.name: joint.drive for joint in spec.joints}
        joints: dict[str, int] = {}
        for index, item in enumerate(robot.bodies):
            body = index - 1  # the base is the world
            if item.joint is not None and item.inertia is not None:
                body = self.builder.add_link(**_mass(item.inertia), label=item.name)
                drive = drives.get(item.joint.name)
                place = transform(item.T_parent_body)
                slides = item.joint.type == "prismatic"
                add = (
                    self.builder.add_joint_prismatic if slides else self.builder.add_joint_revolute
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
                tip = robot.tip_of.get(part.link, OTHER_LINK)
                placed = part.shape
                if body < 0:
                    pose = matrix(base) @ placed.T_body_shape
                    placed = Shape(geometry=placed.geometry, T_body_shape=pose)
                self._add(body, placed, "link" if tip < 0 else "tip", tip, part.link)
        for mimic in spec.mimics:
            self.builder.set_joint_mimic(
                joints[mimic.joint], joints[mimic.source], coeffs=(mimic.offset, mimic.multiplier)
            )
        self.builder.add_articulation(list(joints.values()))


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
