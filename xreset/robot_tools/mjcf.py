"""Reads a robot, or a part of one, from an MJCF that MuJoCo has compiled."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from xreset.errors import ObjectError, RobotError
from xreset.geometry.shapes import hull, transform
from xreset.geometry.urdf import HULL_TOLERANCE, Joint, Link, RobotTree, check_tree
from xreset.geometry.urdf_writer import fixed, frame
from xreset.robot_tools.couplings import SLIDE, Couplings, Pull, joint_name
from xreset.spec import Geometry, MimicSpec, Shape

_MOST = 2**22
"""Largest product of the numbers of an element that decide how much memory MuJoCo takes."""
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "mesh": 0, "plane": 0}
"""Numbers of a shape's size that count."""


def read_mjcf(path: Path, root: ElementTree.Element, notes: list[str]) -> RobotTree:
    """Read an MJCF whose root element is ``root``; what had to be assumed is appended to ``notes``.

    Raises:
        RobotError: it cannot be read, or uses what xreset does not have; the message names all of it.
    """
    _check_sizes(path, root)
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise RobotError(f"{path} is not valid MJCF: {error}") from error
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    if not np.isfinite(data.geom_xmat).all() or not np.isfinite(data.ximat).all():
        raise RobotError(f"{path} has an orientation that is not finite.")
    problems = _unsupported(model)
    pulls = _pulls(model, problems, notes)
    _refuse(path, problems)
    couplings = Couplings(model, [*pulls.values()])
    _refuse(path, couplings.problems)
    notes += couplings.notes
    tree = _tree(path, model, couplings)
    joints = {joint.name: joint for joint in tree.joints}
    for actuator, pull in pulls.items():
        joint, lever = couplings.lever(pull)
        lever = abs(lever * float(model.actuator_gear[actuator, 0]))
        gain = float(model.actuator_gainprm[actuator, 0])
        kp = -float(model.actuator_biasprm[actuator, 1])
        limit = 0.0
        if model.actuator_forcelimited[actuator]:
            limit = lever * float(model.actuator_forcerange[actuator, 1])
        elif kp == 0 and model.actuator_ctrllimited[actuator]:  # a motor: its control is a force
            limit = abs(gain) * lever * float(model.actuator_ctrlrange[actuator, 1])
        if limit <= 0 and model.jnt_actfrclimited[joint]:
            limit = float(model.jnt_actfrcrange[joint, 1])
        stated = {"effort": max(limit, 0.0)}
        if gain > 0 and kp > 0 and lever > 0:
            stated["stiffness"] = kp * lever**2
            stated["rotor"] = float(model.dof_armature[model.jnt_dofadr[joint]])
        name = joint_name(model, joint)
        joints[name] = replace(joints[name], **stated)
    tree = replace(tree, joints=tuple(joints.values()))
    check_tree(tree)
    return tree


def _refuse(path: Path, problems: list[str]) -> None:
    if problems:
        raise RobotError(
            f"{path} uses what xreset does not have:"
            + "".join(f"\n  - {problem}" for problem in problems)
        )


def _check_sizes(path: Path, root: ElementTree.Element) -> None:
    """Raise ``RobotError`` for a small file that takes much memory when MuJoCo reads it."""
    for tag in ("flexcomp", "hfield", "replicate"):
        if root.find(f".//{tag}") is not None:
            raise RobotError(
                f"{path} has a {tag}, which no robot needs. Leave it out, or write out what it stands for."
            )
    for element in [*root.iter("size"), *root.iter("texture")]:
        entries = 1.0
        for name, text in element.items():
            if name.startswith(("nkey", "nuser", "width", "height")):
                with suppress(ValueError):  # MuJoCo says what is wrong
                    entries *= float(text)
        if entries > _MOST:
            raise RobotError(
                f"{path}: a {element.tag} has {entries:.3g} entries, expected at most {_MOST}. "
                "Leave it out: robots need none."
            )


def _unsupported(model: mujoco.MjModel) -> list[str]:
    """Return every feature of a model that a robot of xreset cannot have."""
    problems = []
    for joint in map(model.joint, range(model.njnt)):
        if joint.type[0] == int(mujoco.mjtJoint.mjJNT_BALL):
            problems.append(
                f"the ball joint {joint.name!r}. Replace it by three hinges of the same body"
            )
    for geom in map(model.geom, range(model.ngeom)):
        kind = _kind(geom)
        if _is_solid(geom) and kind not in _SIZES:
            body = model.body(geom.bodyid[0]).name
            problems.append(
                f"the {kind} {geom.name or geom.id!r} of body {body!r}. Replace it by a capsule, box or mesh"
            )
    if model.nflex:
        problems.append("flexible bodies. Leave them out, or make them rigid")
    return problems


def _pulls(model: mujoco.MjModel, problems: list[str], notes: list[str]) -> dict[int, Pull]:
    """Return which joints each actuator moves."""
    pulls = {}
    for actuator in range(model.nu):
        kind = mujoco.mjtTrn(int(model.actuator_trntype[actuator]))
        target = int(model.actuator_trnid[actuator, 0])
        is_joint = kind in (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
        if is_joint and model.jnt_type[target] >= SLIDE:
            pulls[actuator] = {target: 1.0}
        elif kind == mujoco.mjtTrn.mjTRN_TENDON:
            begin = model.tendon_adr[target]
            wraps = slice(begin, begin + model.tendon_num[target])
            pulls[actuator] = dict(
                zip(model.wrap_objid[wraps].tolist(), model.wrap_prm[wraps].tolist(), strict=True)
            )
            if (model.wrap_type[wraps] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
                problems.append(
                    f"the tendon {model.tendon(target).name!r}, which runs through space. Drive its joint by a "
                    "position actuator of its own, or couple its joints by an equality"
                )
        else:
            notes.append(
                f"left out: the actuator {model.actuator(actuator).name!r}, which drives no hinge and no slide"
            )
    return pulls


def _tree(path: Path, model: mujoco.MjModel, couplings: Couplings) -> RobotTree:
    """Return links and joints of a model, from its poses where the joints are at 0 or held.

    The origin of a link is at its joint, which may be away from the body's origin.
    """
    names = [model.body(i).name or f"body{i}" for i in range(model.nbody)]
    tops = [names[i] for i in range(1, model.nbody) if model.body_parentid[i] == 0]
    if len(tops) != 1:
        raise RobotError(
            f"{path}: expected one body in the world, found {', '.join(tops) or 'none'}."
        )
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[model.jnt_type >= SLIDE]] = 0.0
    for joint, line in couplings.lines.items():
        if not line.multiplier:
            data.qpos[model.jnt_qposadr[joint]] = line.offset
    mujoco.mj_kinematics(model, data)
    links = {}
    joints = []
    poses = {}
    for number in range(1, model.nbody):
        body = model.body(number)
        name = names[number]
        moving = np.flatnonzero((model.jnt_bodyid == number) & (model.jnt_type >= SLIDE)).tolist()
        above = names[int(body.parentid[0])]
        if number == 1 and moving:
            raise RobotError(
                f"{path}: the first body {body.name!r} has joints; put it into a body that does not move."
            )
        turn = data.xmat[number].reshape(3, 3).T
        T = transform(turn.T, data.xpos[number])
        children = [*(f"{name}_axis{i}" for i in range(len(moving) - 1)), name]
        for child, joint in zip(children, moving, strict=False):
            T = transform(turn.T, data.xanchor[joint])
            poses[child] = T
            links[child] = frame(child)
            placed = Joint(
                parent=above,
                child=child,
                T_parent_joint=np.linalg.inv(poses[above]) @ T,
                axis=turn @ data.xaxis[joint],
                **_motion(model, couplings, joint),
            )
            joints.append(placed)
            above = child
        poses[name] = T
        if not moving and number > 1:
            joints.append(fixed(above, name, np.linalg.inv(poses[above]) @ T))
        R = turn @ data.ximat[number].reshape(3, 3)
        links[name] = Link(
            name=name,
            mass=float(body.mass[0]),
            com=turn @ (data.xipos[number] - T[:3, 3]),
            inertia=R @ np.diag(body.inertia) @ R.T,
            collisions=tuple(_shapes(model, data, number, T)),
        )
    order = [tops[0], *(joint.child for joint in joints)]
    return RobotTree(
        name=path.stem,
        root=tops[0],
        links=tuple(links[name] for name in order),
        joints=tuple(joints),
    )


def _motion(model: mujoco.MjModel, couplings: Couplings, number: int) -> dict[str, Any]:
    """Return a joint's name, type, limits and what it follows."""
    name = joint_name(model, number)
    is_slide = model.jnt_type[number] == SLIDE
    motion: dict[str, Any] = {"name": name, "type": "prismatic" if is_slide else "revolute"}
    if model.jnt_limited[number]:
        motion["lower"], motion["upper"] = model.jnt_range[number].tolist()
    line = couplings.lines.get(number)
    if line and line.multiplier:
        source = joint_name(model, line.source)
        motion["mimic"] = MimicSpec(
            joint=name, source=source, multiplier=line.multiplier, offset=line.offset
        )
    elif line:
        motion["type"] = "fixed"
    return motion


def _shapes(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, T_world_link: np.ndarray
) -> Iterator[Shape]:
    """Yield the collision shapes of a body."""
    for number in np.flatnonzero(model.geom_bodyid == body):
        geom = model.geom(number)
        kind = _kind(geom)
        if not _is_solid(geom) or kind == "plane":
            continue
        T = np.linalg.inv(T_world_link) @ transform(data.geom_xmat[number], data.geom_xpos[number])
        geometry = Geometry(kind=kind, size=tuple(map(float, geom.size[: _SIZES[kind]])))
        if kind == "mesh":
            mesh = model.mesh(geom.dataid[0])
            begin = int(mesh.vertadr[0])
            vertices = model.mesh_vert[begin : begin + int(mesh.vertnum[0])].astype(float)
            try:
                geometry = hull(vertices, HULL_TOLERANCE).geometry
            except ObjectError as error:
                raise RobotError(
                    f"the mesh {mesh.name!r} of a body cannot be used: {error}"
                ) from error
        yield Shape(geometry=geometry, T_body_shape=T)


def _kind(geom: mujoco._structs._MjModelGeomViews) -> Any:
    """Return the name of a kind of shape, which may be one that the project does not have."""
    return mujoco.mjtGeom(int(geom.type[0])).name.removeprefix("mjGEOM_").lower()


def _is_solid(geom: mujoco._structs._MjModelGeomViews) -> bool:
    return bool(geom.contype[0] or geom.conaffinity[0])
