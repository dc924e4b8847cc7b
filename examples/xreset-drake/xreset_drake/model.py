"""A scene as a Drake model.

Contact is hydroelastic: objects and table are compliant, the robot is rigid, and a contact is the patch in which two shapes overlap.
Drake's other contact model has one point per pair of shapes, on which no box rests; it is left for the robot's contacts with itself,
where both are rigid.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Capsule,
    CollisionFilterDeclaration,
    Convex,
    Cylinder,
    GeometryId,
    GeometrySet,
    ProximityProperties,
    SceneGraph,
    Sphere,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    Frame,
    ModelInstanceIndex,
    PdControllerGains,
    PrismaticJoint,
    RevoluteJoint,
    RigidBody,
    RotationalInertia,
    SpatialInertia,
)
from pydrake.systems.framework import Diagram, DiagramBuilder

from xreset.backends.rigid import Inertia, Mechanism
from xreset.spec import Geometry, ObjectSpec, SceneSpec, Shape


@dataclass(frozen=True, kw_only=True)
class DrakeSettings:
    """Drake's dials, with the results of the conformance suite that chose them."""

    internal_steps: int = 2
    """Drake steps per physics step. With 1, joints lag MuJoCo's by 3.5 mrad rms instead of 2.6; with 4, by 2.1, at twice the cost."""
    modulus: float = 1e8
    """Hydroelastic modulus of objects [Pa]: the pressure where a piece is pressed in down to its middle."""
    table_modulus: float = 3e5
    """The table's: objects sink in by 0.02 mm. From 1e7 on they chatter, and the table's force reads 0 to 3 m g."""
    dissipation: float = 3.0
    """Hunt and Crossley's dissipation of contacts [s/m]. With 30, sliding objects pitter and stop up to 70 % too early."""
    stiction_tolerance: float = 1e-4
    """Speed [m/s] at which a contact counts as sliding: objects creep at up to that speed where friction holds them."""
    resolution: float = 0.01
    """Longest edge [m] of the meshes that Drake makes of cylinders, capsules and spheres."""


@dataclass(frozen=True)
class Surface:
    """What a geometry is to the object."""

    role: Literal["tip", "link", "table", "object"]
    tip: int | None = None
    """Index of its fingertip."""


@dataclass(frozen=True, kw_only=True)
class DrakeModel:
    """A finished diagram, and where the scene's parts are in it. Letters: D moving joints, J actuated joints, K tracked links."""

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    robot: ModelInstanceIndex
    position: np.ndarray
    """[D] where the moving joints, in the mechanism's order, are in the plant's position vector."""
    velocity: np.ndarray
    """[D] and in its velocity vector."""
    actuator: np.ndarray
    """[J] where the actuated joints are among the robot's actuators."""
    links: Sequence[Frame]
    """[K] frames of the tracked links."""
    moving: Sequence[RigidBody]
    """The robot's moving bodies, in the order of the mechanism."""
    object: RigidBody
    """Its frame is the object's mesh frame."""
    surfaces: dict[GeometryId, Surface]
    """What each geometry is to the object."""
    properties: dict[GeometryId, ProximityProperties]
    """Of each geometry, without friction."""


OBJECT_FRICTION = 10.0
"""Coefficient of the object itself: large, so that any pair friction below 20 can be reached (see :func:`friction_of_other`)."""


def friction_of_other(pair: float) -> float:
    """Coefficient that gives a pair with the object its friction: Drake combines a and b to 2 a b / (a + b)."""
    return OBJECT_FRICTION * pair / (2.0 * OBJECT_FRICTION - pair)


def build_model(
    scene: SceneSpec, robot: Mechanism, obj: ObjectSpec, inertia: Inertia, settings: DrakeSettings
) -> DrakeModel:
    """Build the diagram of one world."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlant(
        MultibodyPlantConfig(
            time_step=scene.timestep / settings.internal_steps,
            contact_model="hydroelastic_with_fallback",
            discrete_contact_approximation="lagged",  # with "sap", an object that slides at 1.4 m/s flies up by 16 mm
            stiction_tolerance=settings.stiction_tolerance,
            adjacent_bodies_collision_filters=False,
        ),
        builder,
    )
    parts = _Parts(plant, settings)
    table = Shape(geometry=Geometry(kind="box", size=scene.table.half_size))
    at_table = RigidTransform([*scene.table.center, -scene.table.half_size[2]])
    parts.attach(plant.world_body(), table, Surface("table"), placed=at_table)
    instance = plant.AddModelInstance("robot")
    plant.set_gravity_enabled(instance, not scene.robot.gravity_compensated)
    bodies = _add_robot(parts, robot, instance)
    body = _add_object(parts, obj, inertia)
    plant.Finalize()
    _filter_collisions(scene_graph, parts, robot)
    diagram = builder.Build()

    joints = [plant.GetJointByName(name, instance) for name in robot.joint_names]
    actuators = list(plant.GetJointActuatorIndices(instance))
    driven = [plant.GetJointActuatorByName(name, instance) for name in scene.robot.joint_names]
    return DrakeModel(
        diagram=diagram,
        plant=plant,
        scene_graph=scene_graph,
        robot=instance,
        position=np.array([joint.position_start() for joint in joints]),
        velocity=np.array([joint.velocity_start() for joint in joints]),
        actuator=np.array([actuators.index(actuator.index()) for actuator in driven]),
        links=[
            plant.GetFrameByName(_frame_name(link), instance) for link in scene.robot.tracked_links
        ],
        moving=bodies[1:],
        object=body,
        surfaces=parts.surfaces,
        properties=parts.properties,
    )


class _Parts:
    """What has been added to a plant."""

    def __init__(self, plant: MultibodyPlant, settings: DrakeSettings) -> None:
        self.plant = plant
        self.settings = settings
        self.surfaces: dict[GeometryId, Surface] = {}
        self.properties: dict[GeometryId, ProximityProperties] = {}
        self.links: dict[str, list[GeometryId]] = {}

    def attach(
        self,
        body: RigidBody,
        shape: Shape,
        surface: Surface,
        *,
        placed: RigidTransform | None = None,
        link: str = "",
    ) -> None:
        """Add a collision shape to a body."""
        properties = ProximityProperties()
        settings = self.settings
        resolution = (
            min(settings.resolution, *shape.geometry.size)
            if shape.geometry.size
            else settings.resolution
        )
        modulus = {"object": settings.modulus, "table": settings.table_modulus}.get(surface.role)
        if modulus is not None:
            AddCompliantHydroelasticProperties(resolution, modulus, properties)
        else:
            AddRigidHydroelasticProperties(resolution, properties)
        AddContactMaterial(properties, dissipation=settings.dissipation)
        with_friction = ProximityProperties(properties)
        AddContactMaterial(with_friction, friction=CoulombFriction(1.0, 1.0))
        pose = _transform(shape.T_body_shape)
        geometry = self.plant.RegisterCollisionGeometry(
            body,
            pose if placed is None else placed @ pose,
            _shape(shape.geometry),
            f"shape{len(self.surfaces)}",
            with_friction,
        )
        self.surfaces[geometry] = surface
        self.properties[geometry] = properties
        if link:
            self.links.setdefault(link, []).append(geometry)


def _add_robot(parts: _Parts, robot: Mechanism, instance: ModelInstanceIndex) -> list[RigidBody]:
    plant = parts.plant
    spec = robot.robot
    bodies: list[RigidBody] = []
    for item in robot.bodies:
        body = plant.AddRigidBody(
            item.name,
            instance,
            spatial_inertia(item.inertia) if item.inertia else SpatialInertia.Zero(),
        )
        bodies.append(body)
        for part in item.shapes:
            tip = robot.tip_of.get(part.link)
            parts.attach(
                body, part.shape, Surface("link" if tip is None else "tip", tip), link=part.link
            )
        if item.joint is None:
            base = RigidTransform(Quaternion(_unit(spec.base_quat)), spec.base_pos)
            plant.WeldFrames(plant.world_frame(), body.body_frame(), base)
            continue
        place = FixedOffsetFrame(
            f"joint:{item.joint.name}",
            bodies[item.parent].body_frame(),
            _transform(item.T_parent_body),
            instance,
        )
        kind = PrismaticJoint if item.joint.type == "prismatic" else RevoluteJoint
        plant.AddJoint(
            kind(
                item.joint.name,
                plant.AddFrame(place),
                body.body_frame(),
                item.joint.axis,
                pos_lower_limit=item.joint.lower,
                pos_upper_limit=item.joint.upper,
                damping=0.0,
            )
        )
    for joint in spec.joints:
        drive = joint.drive
        actuator = plant.AddJointActuator(
            joint.name, plant.GetJointByName(joint.name, instance), drive.effort
        )
        actuator.set_controller_gains(PdControllerGains(p=drive.kp, d=drive.kd))
        actuator.set_default_rotor_inertia(drive.armature)
        actuator.set_default_gear_ratio(1.0)
    for mimic in spec.mimics:
        follower, source = (
            plant.GetJointByName(name, instance) for name in (mimic.joint, mimic.source)
        )
        plant.AddCouplerConstraint(follower, source, mimic.multiplier, mimic.offset)
    for link in dict.fromkeys(spec.tracked_links):
        index, T = robot.frames[link]
        plant.AddFrame(
            FixedOffsetFrame(_frame_name(link), bodies[index].body_frame(), _transform(T), instance)
        )
    return bodies


def _add_object(parts: _Parts, obj: ObjectSpec, inertia: Inertia) -> RigidBody:
    plant = parts.plant
    instance = plant.AddModelInstance("object")
    plant.set_gravity_enabled(instance, False)
    body = plant.AddRigidBody("object", instance, spatial_inertia(inertia))
    for piece in obj.pieces:
        parts.attach(body, piece, Surface("object"))
    return body


def _filter_collisions(scene_graph: SceneGraph, parts: _Parts, robot: Mechanism) -> None:
    """Let only those pairs collide that the scene says: everything is excluded first, then the wanted pairs are allowed."""
    spec = robot.robot
    on_object = [g for g, surface in parts.surfaces.items() if surface.role == "object"]
    on_table = [g for g, surface in parts.surfaces.items() if surface.role == "table"]
    on_links = []
    above_table = []
    for link, geometries in parts.links.items():
        on_links += geometries
        if link not in spec.table_exclude:
            above_table += geometries
    rule = CollisionFilterDeclaration().ExcludeWithin(GeometrySet(list(parts.surfaces)))
    rule.AllowBetween(GeometrySet(on_object), GeometrySet(on_table + on_links))
    rule.AllowBetween(GeometrySet(on_table), GeometrySet(above_table))
    for a, b in robot.colliding_links:
        if a in parts.links and b in parts.links:
            rule.AllowBetween(GeometrySet(parts.links[a]), GeometrySet(parts.links[b]))
    scene_graph.collision_filter_manager().Apply(rule)


def spatial_inertia(inertia: Inertia) -> SpatialInertia:
    """Mass properties about the origin of the body's frame, which is where Drake wants them."""
    about_com = inertia.matrix
    rotational = RotationalInertia(
        *np.diag(about_com), about_com[0, 1], about_com[0, 2], about_com[1, 2]
    )
    return SpatialInertia.MakeFromCentralInertia(inertia.mass, inertia.com, rotational)


def _shape(geometry: Geometry) -> Any:
    if geometry.kind == "box":
        return Box(2.0 * np.array(geometry.size))
    if geometry.kind == "sphere":
        return Sphere(*geometry.size)
    if geometry.kind == "hull":
        return Convex(points=geometry.vertices.T, label="hull")
    radius, half_length = geometry.size
    return (Capsule if geometry.kind == "capsule" else Cylinder)(radius, 2.0 * half_length)


def _frame_name(link: str) -> str:
    return f"link:{link}"


def _transform(T: np.ndarray) -> RigidTransform:
    return RigidTransform(RotationMatrix.ProjectToRotationMatrix(T[:3, :3]), T[:3, 3])


def _unit(quat: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(quat, dtype=float) / np.linalg.norm(quat)
