"""A scene as a MuJoCo model: what both MuJoCo backends run.

The model is built from :class:`~xreset.backends.rigid.Mechanism`, not by MuJoCo's URDF reader, which turns effort
limits into joint force ranges. Links that are fixed to another are fused into its body, because fewer bodies are faster
on a GPU; :class:`SceneModel` states where every link, joint and shape of the scene is.

The settings follow from measurements against other engines: an elliptic friction cone with impratio 10 or more holds
grasps that a pyramidal cone loses, and condim 4 gives torsional friction.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, combinations, product

import mujoco
import numpy as np

from xreset.backends.mjcf_model import (
    MIN_FRICTION,
    OBJECT,
    SceneModel,
    add_sensors,
    body_name,
    pos_quat,
)
from xreset.backends.rigid import (
    OTHER_LINK,
    TABLE,
    Inertia,
    Mechanism,
    MovingJoints,
    TrackedFrames,
    mechanism,
    object_inertia,
)
from xreset.errors import ObjectError, XResetError
from xreset.geometry.urdf import Joint
from xreset.physics import KnownDifference
from xreset.spec import GRAVITY, Geometry, ObjectSpec, SceneSpec, Shape

# Collision bits: a pair collides if the contype of one meets the conaffinity of the other.
_HIT_OBJECT = 1
_HIT_TABLE = 2
_HIT_SELF = 4

_FINE = 1.0 / 200.0
"""Timestep [s] below which friction is harder; see :func:`_impratio`."""
_SOLIMP = (0.95, 0.99, 0.001, 0.5, 2.0)
_SOLIMP_MIMIC = (0.99, 0.999, 0.001, 0.5, 2.0)
_STIFF_MIMIC = 0.8
"""Share of a mimic joint's lag behind its source that one step removes. The lag's rate is removed as a whole."""
_CONDIM = 4
_ROLLING = 1e-4  # MuJoCo wants a positive number although condim 4 does not use it
_ARENA = 16 << 20  # bytes for contacts and constraints of one MjData

_GEOM_TYPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "hull": mujoco.mjtGeom.mjGEOM_MESH,
}
_JOINT_TYPES = {
    "revolute": mujoco.mjtJoint.mjJNT_HINGE,
    "prismatic": mujoco.mjtJoint.mjJNT_SLIDE,
}
_PARKED_SIZE = 1e-6
# in the object's frame: out of everything's reach wherever the object is
_PARKED_POS = (0.0, 0.0, 1e3)


KNOWN_DIFFERENCES = (
    KnownDifference(
        check="long_spin",
        measure="centre of mass",
        bound=3e-3,
        reason="MuJoCo moves the origin of the object's mesh by this point's velocity, so the centre of mass of a "
        "spinning object drifts, in proportion to the timestep and to the distance between the two",
    ),
    KnownDifference(
        check="joint_friction",
        measure="way within friction",
        bound=0.4,
        reason="dry friction is a soft constraint, so a joint that it holds creeps, by 2 mm/s at three quarters of it",
    ),
)
"""Checks that both MuJoCo backends miss."""

_CONTACT_STEPS = 3.0
"""Time constant of contacts (``solref``) in timesteps.

With 2.016, the stiffest that is stable, a tapped object leaves the finger: an impact changes its speed by more than the
finger's. With 3 it stays, and fewer grasps of a reset bank turn (docs/sim-to-sim.md).
"""
_LIMIT_STEPS = 2.016
"""Time constant of joint limits in timesteps: as stiff as the timestep allows, with room for rounding."""


def compile_scene(
    scene: SceneSpec,
    object_index: int,
    *,
    slots_for: Sequence[int] = (),
    sensors: bool = False,
) -> SceneModel:
    """Return the model of a scene that holds ``scene.objects[object_index]``.

    Args:
        scene: the scene.
        object_index: index of the object.
        slots_for: also make room for the shapes of these objects. Models of one scene with the same ``slots_for`` agree
            in the type and number of all geoms and in all meshes, so one engine model can hold any of the objects.
            Unused slots are parked.
        sensors: let the engine itself compute what a backend reports. ``sensordata`` then holds, in this order, the
            tracked links' positions [K, 3], orientations [K, 4], velocities [K, 3] and angular velocities [K, 3]; the
            force of the object on the table [3] and on each fingertip geom [S, 3].

    Raises:
        RobotError: the robot cannot be simulated.
        ObjectError: the object cannot be simulated.
    """
    robot = mechanism(scene.robot)
    names = [*scene.robot.joint_names, *(mimic.joint for mimic in scene.robot.mimics)]
    spec = _empty_spec(scene)
    roles = _add_robot(spec, scene, robot)
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=scene.table.half_size,
        pos=(*scene.table.center, -scene.table.half_size[2]),
        contype=0,
        conaffinity=_HIT_OBJECT | _HIT_TABLE,
        **_contact(scene.friction.table, scene),
    )
    roles["table"] = TABLE
    parked = _add_object(spec, scene, object_index, slots_for)
    joints = MovingJoints(scene.robot, names)
    _add_drives(spec, scene, joints, names)
    frames = TrackedFrames(robot)
    sensed = add_sensors(spec, robot, frames, roles) if sensors else []
    model = _compiled(spec, scene, scene.objects[object_index])
    geoms = [model.geom(i).name for i in range(model.ngeom)]
    bodies = [model.body(body_name(body)).id for body in robot.bodies]
    joint_ids = [model.joint(name).id for name in names]
    free = model.joint("object").id
    return SceneModel(
        scene=scene,
        spec=spec,
        model=model,
        joints=joints,
        qpos=model.jnt_qposadr[joint_ids].astype(np.int64),
        dof=model.jnt_dofadr[joint_ids].astype(np.int64),
        link_body=np.array([bodies[i] for i in frames.bodies]),
        link_pos=frames.pos,
        link_quat=frames.quat,
        moving_bodies=np.array(bodies[1:]),
        object_body=model.body("object").id,
        object_qpos=int(model.jnt_qposadr[free]),
        object_dof=int(model.jnt_dofadr[free]),
        geom_role=np.array([roles.get(name, OBJECT) for name in geoms]),
        parked=np.array([name in parked for name in geoms]),
        sensed_tip=np.array(sensed, dtype=np.int64),
    )


def _compiled(spec: mujoco.MjSpec, scene: SceneSpec, obj: ObjectSpec) -> mujoco.MjModel:
    """Return the model, whose object has its weight and its own centre of mass."""
    try:
        model = spec.compile()
    except ValueError as error:
        raise XResetError(
            f"MuJoCo refuses the robot {scene.robot.name!r} with the object {obj.name!r}: {error}"
        ) from error
    body = model.body("object").id
    _let_com_move(model, body)
    model.body_gravcomp[body] = 0.0
    return model


# Options --------------------------------------------------------------------------------------------------------------


def _empty_spec(scene: SceneSpec) -> mujoco.MjSpec:
    """Return a model without bodies, with the solver's settings."""
    spec = mujoco.MjSpec()
    spec.modelname = scene.robot.name
    spec.memory = _ARENA
    spec.compiler.degree = False
    spec.compiler.autolimits = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    option = spec.option
    option.timestep = scene.timestep
    option.gravity = (0.0, 0.0, -GRAVITY)
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = _impratio(scene.timestep)
    return spec


def _impratio(timestep: float) -> float:
    """Return how many times harder a contact resists sliding than penetration, for a timestep [s].

    A held object creeps in proportion to the contacts' time constant and to 1 / impratio. At 240 Hz, with 150, objects
    stay where a hand holds them for a minute, as in PyBullet and SAPIEN; with 10 they do not. At 120 Hz, with 100, a
    third of the steps need more Newton iterations than MuJoCo-Warp takes, and policies learn more slowly
    (docs/lab-book.md).
    """
    return 150.0 if timestep < _FINE else 10.0


def _solref(scene: SceneSpec, steps: float) -> tuple[float, float]:
    """Return a time constant of a number of timesteps, in seconds, and the damping ratio."""
    return (steps * scene.timestep, 1.0)


def _contact(friction: float, scene: SceneSpec) -> dict:
    """Contact attributes of a geom."""
    return {
        "friction": (max(friction, MIN_FRICTION), scene.friction.torsional, _ROLLING),
        "solref": _solref(scene, _CONTACT_STEPS),
        "solimp": _SOLIMP,
        "condim": _CONDIM,
    }


# Robot ----------------------------------------------------------------------------------------------------------------


def _add_robot(spec: mujoco.MjSpec, scene: SceneSpec, robot: Mechanism) -> dict[str, int]:
    """Add bodies, joints and geoms; return geom -> role."""
    description = robot.robot
    added: list[mujoco.MjsBody] = []
    roles: dict[str, int] = {}
    self_geoms: list[dict[str, str]] = []
    """For each body: geom -> link, of the links that may collide with other links."""
    for body in robot.bodies:
        if body.joint is None:
            parent = spec.worldbody
            pos = np.array(description.base_pos)
            quat = np.array(description.base_quat)
        else:
            parent = added[body.parent]
            pos, quat = pos_quat(body.T_parent_body)
        element = parent.add_body(
            name=body_name(body),
            pos=pos,
            quat=quat,
            gravcomp=float(description.gravity_compensated),
            explicitinertial=True,
        )
        if body.inertia is not None:
            _set_inertia(element, body.inertia)
        if body.joint is not None:
            _add_joint(element, body.joint, scene)
        added.append(element)
        self_geoms.append({})
        for i, item in enumerate(body.shapes):
            name = f"{body_name(body)}/{i}"
            roles[name] = role = robot.tip_of.get(item.link, OTHER_LINK)
            friction = scene.friction.link if role == OTHER_LINK else scene.friction.tip
            self_bit = _HIT_SELF if item.link in description.self_collision_links else 0
            table_bit = 0 if item.link in description.table_exclude else _HIT_TABLE
            element.add_geom(
                name=name,
                contype=self_bit | table_bit,
                conaffinity=_HIT_OBJECT | self_bit,
                **_placed(spec, item.shape, name),
                **_contact(friction, scene),
            )
            if self_bit:
                self_geoms[-1][name] = item.link
    _limit_self_collision(spec, scene, robot, self_geoms)
    return roles


def _set_inertia(element: mujoco.MjsBody, inertia: Inertia) -> None:
    element.mass = inertia.mass
    element.ipos = inertia.com
    element.inertia = inertia.moments
    element.iquat = inertia.quat


def _add_joint(element: mujoco.MjsBody, joint: Joint, scene: SceneSpec) -> None:
    drive = {j.name: j.drive for j in scene.robot.joints}.get(joint.name)  # a mimic joint has none
    limited = bool(np.isfinite(joint.lower) and np.isfinite(joint.upper))
    element.add_joint(
        name=joint.name,
        type=_JOINT_TYPES[joint.type],
        axis=joint.axis,
        limited=limited,
        range=(joint.lower, joint.upper) if limited else (0.0, 0.0),
        solref_limit=_solref(scene, _LIMIT_STEPS),
        solimp_limit=_SOLIMP,
        armature=drive.armature if drive else 0.0,
        frictionloss=drive.friction_loss if drive else 0.0,
    )


def _limit_self_collision(
    spec: mujoco.MjSpec, scene: SceneSpec, robot: Mechanism, geoms: Sequence[dict[str, str]]
) -> None:
    """Keep the collisions between bodies that :meth:`Mechanism.may_collide` allows.

    MuJoCo excludes whole bodies. Where only some links of two bodies may collide, the bodies are excluded and the geoms
    of those links are paired. In MuJoCo-Warp such a pair keeps the scene's friction.
    """

    def contact(*links: str) -> dict:
        friction = scene.friction
        rougher = max(friction.tip if link in robot.tip_of else friction.link for link in links)
        attributes = _contact(rougher, scene)
        slide, spin, roll = attributes["friction"]
        return attributes | {"friction": (slide, slide, spin, roll, roll)}

    for i, j in combinations(range(len(geoms)), 2):
        pairs = list(product(geoms[i], geoms[j]))
        allowed = [(a, b) for a, b in pairs if robot.may_collide(geoms[i][a], geoms[j][b])]
        if len(allowed) == len(pairs):
            continue
        spec.add_exclude(bodyname1=body_name(robot.bodies[i]), bodyname2=body_name(robot.bodies[j]))
        for a, b in allowed:
            spec.add_pair(geomname1=a, geomname2=b, **contact(geoms[i][a], geoms[j][b]))


def _add_drives(
    spec: mujoco.MjSpec, scene: SceneSpec, joints: MovingJoints, names: Sequence[str]
) -> None:
    """Add the drives and the mimic joints; a drive whose joint others follow acts on all of them through a tendon, with
    the shares of :func:`~xreset.geometry.dynamics.drive_shares`."""
    _, offset = joints.couplings
    for joint, shares in zip(scene.robot.joints, joints.shares, strict=True):
        drive = joint.drive
        along = np.flatnonzero(shares)
        shared = len(along) > 1
        if shared:
            tendon = spec.add_tendon(name=joint.name)
            for i in along.tolist():
                tendon.wrap_joint(names[i], shares[i])
        spec.add_actuator(
            name=joint.name,
            trntype=mujoco.mjtTrn.mjTRN_TENDON if shared else mujoco.mjtTrn.mjTRN_JOINT,
            target=joint.name,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=_padded((drive.kp,)),
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=_padded((drive.kp * float(shares @ offset), -drive.kp, -drive.kd)),
            ctrllimited=False,
            forcelimited=True,
            forcerange=(-drive.effort, drive.effort),
        )
    for mimic in scene.robot.mimics:
        spec.add_equality(
            name=mimic.joint,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=mimic.joint,
            name2=mimic.source,
            data=_padded((mimic.offset, mimic.multiplier), mujoco.mjNEQDATA),
            solref=(-_STIFF_MIMIC / scene.timestep**2, -1.0 / scene.timestep),
            solimp=_SOLIMP_MIMIC,
        )


def _padded(values: Sequence[float], length: int = mujoco.mjNGAIN) -> np.ndarray:
    """Return values, followed by zeros, as MuJoCo stores the parameters of an element."""
    padded = np.zeros(length)
    padded[: len(values)] = values
    return padded


# Object ---------------------------------------------------------------------------------------------------------------


def _add_object(
    spec: mujoco.MjSpec, scene: SceneSpec, index: int, slots_for: Sequence[int]
) -> set[str]:
    """Add the object and empty slots; return the names of the geoms that are parked."""
    obj = scene.objects[index]
    hulls: dict[int, list[str]] = {}
    slots: Counter[str] = Counter()
    for i in sorted({*slots_for, index}):
        hulls[i] = _add_hulls(spec, scene.objects[i], i)
        # the larger of the two counts
        slots |= Counter(piece.geometry.kind for piece in scene.objects[i].pieces)
    spare = next(chain.from_iterable(hulls.values()), "")

    # MuJoCo ignores gravcomp unless it is set while compiling.
    body = spec.worldbody.add_body(name="object", gravcomp=1.0, explicitinertial=True)
    inertia = object_inertia(obj)
    _set_inertia(body, replace(inertia, com=inertia.com + _ASIDE))
    body.add_joint(
        name="object", type=mujoco.mjtJoint.mjJNT_FREE, align=mujoco.mjtAlignFree.mjALIGNFREE_FALSE
    )
    parked = set()
    common = {"contype": _HIT_OBJECT, "conaffinity": 0, **_contact(0.0, scene)}
    for kind, geom_type in _GEOM_TYPES.items():
        pieces = [piece for piece in obj.pieces if piece.geometry.kind == kind]
        for slot in range(slots[kind]):
            name = f"object/{kind}/{slot}"
            if slot < len(pieces):
                mesh = hulls[index][slot] if kind == "hull" else ""
                body.add_geom(name=name, **_geometry(pieces[slot], mesh), **common)
            else:
                parked.add(name)
                mesh = spare if kind == "hull" else ""
                body.add_geom(
                    name=name,
                    type=geom_type,
                    pos=_PARKED_POS,
                    size=(_PARKED_SIZE,) * 3,
                    meshname=mesh,
                    **common,
                )
    return parked


def _add_hulls(spec: mujoco.MjSpec, obj: ObjectSpec, index: int) -> list[str]:
    if not obj.pieces:
        raise ObjectError(f"object {obj.name!r} has no collision piece; it needs at least one.")
    hulls = [piece.geometry for piece in obj.pieces if piece.geometry.kind == "hull"]
    return [_add_mesh(spec, f"object/{index}/{i}", hull) for i, hull in enumerate(hulls)]


_ASIDE = np.full(3, 1e-3)
"""[m] by which the object's centre of mass is away from its place while MuJoCo compiles."""


def _let_com_move(model: mujoco.MjModel, body: int) -> None:
    """Put the object's centre of mass into its place.

    Where MuJoCo finds it in the body's origin, it makes the mass matrix diagonal for good and ignores the position.
    """
    model.body_ipos[body] -= _ASIDE
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


# Shapes ---------------------------------------------------------------------------------------------------------------


def _placed(spec: mujoco.MjSpec, shape: Shape, name: str) -> dict:
    """Return the attributes of a geom, whose mesh is added if it has one."""
    mesh = _add_mesh(spec, name, shape.geometry) if shape.geometry.kind == "hull" else ""
    return _geometry(shape, mesh)


def _geometry(shape: Shape, mesh: str) -> dict:
    pos, quat = pos_quat(shape.T_body_shape)
    size = np.zeros(3)
    size[: len(shape.geometry.size)] = shape.geometry.size
    return {
        "type": _GEOM_TYPES[shape.geometry.kind],
        "pos": pos,
        "quat": quat,
        "size": size,
        "meshname": mesh,
    }


def _add_mesh(spec: mujoco.MjSpec, name: str, hull: Geometry) -> str:
    spec.add_mesh(
        name=name,
        uservert=np.asarray(hull.vertices, dtype=np.float64).ravel(),
        userface=np.asarray(hull.faces, dtype=np.int32).ravel(),
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX,
    )
    return name
