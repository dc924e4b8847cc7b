"""Reads a robot, or a part of one, from an MJCF that MuJoCo has compiled."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from xreset.errors import ObjectError, RobotError
from xreset.files.storage import RAISE_LIMIT, max_bytes
from xreset.files.text import listed
from xreset.geometry.shapes import hull, refuse_pointer, transform
from xreset.geometry.urdf import HULL_TOLERANCE, Joint, Link, RobotTree, check_tree
from xreset.geometry.urdf_writer import fixed, frame
from xreset.robot_tools.couplings import SLIDE, Couplings, Pull, joint_name
from xreset.spec import Geometry, MimicSpec, Shape

_COMPILE = """
import os, resource, sys
os.environ["MUJOCO_GL"] = "disable"  # else another process looks for libraries of windows
import mujoco
source, target, most, unit = sys.argv[1:]
with open("/proc/self/statm") as pages:
    limit = int(pages.read().split()[0]) * resource.getpagesize() + int(most)
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
resource.setrlimit(resource.RLIMIT_CPU, (30, 30))
try:
    if unit == "radians":
        spec = mujoco.MjSpec.from_file(source)
        spec.compiler.degree = False
        model = spec.compile()
    else:
        model = mujoco.MjModel.from_xml_path(source)
except ValueError as error:
    print(error)
    sys.exit(1)
except Exception:
    sys.exit(2)
mujoco.MjData(model)
mujoco.mj_saveModel(model, target)
"""
"""Program that compiles a model in a process whose memory and time are limited: small files can ask for any amount."""
_RADIANS_AS_DEGREES = np.radians(2 * np.pi)
"""Largest limit that a hinge can have if its radians were read as degrees [rad]: a full turn."""
_LARGEST = 1e10
"""Larger numbers are errors."""
_PARTS = ("actuator_", "body_", "dof_", "eq_", "geom_", "jnt_", "qpos", "tendon_", "wrap_")
"""Beginnings of the names of the arrays that are read."""
_DERIVED = ("geom_aabb", "geom_rbound")
"""Arrays that follow from others; a plane without a size has a box of 1e10 m."""
_COLLISION_GROUP = 3
"""Makers put collision shapes into this group or a later one, and visual ones into earlier groups."""
_MOST_SHAPES = 5000
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2, "box": 3, "mesh": 0, "plane": 0}
"""Numbers of a shape's size that count."""


def read_mjcf(path: Path, notes: list[str]) -> RobotTree:
    """Read an MJCF; what had to be assumed, and what is left out, is appended to ``notes``.

    Raises:
        RobotError: it cannot be read, or uses what xreset does not have; the message names all of it.
    """
    model = _compiled(path)
    if 0 < (degrees := _farthest_turn(model)) < _RADIANS_AS_DEGREES:
        model = _compiled(path, "radians")
        if _farthest_turn(model) > degrees:
            notes.append(
                f"angles are read as radians: as degrees, no joint would turn farther than to {np.degrees(degrees):.3g}"
            )
    _check_numbers(path, model)
    solid = _solid(model, notes)
    problems = _unsupported(model, solid)
    pulls = _pulls(model, problems, notes)
    _refuse(path, problems)
    _let_go(model, notes)
    couplings = Couplings(model, [*pulls.values()])
    _refuse(path, couplings.problems)
    notes += couplings.notes
    _left_out(model, notes)
    tree = _tree(path, model, couplings, solid, notes)
    joints = {joint.name: joint for joint in tree.joints}
    for actuator, pull in pulls.items():
        joint, lever = couplings.lever(pull)
        lever = abs(lever * float(model.actuator_gear[actuator, 0]))
        gain = float(model.actuator_gainprm[actuator, 0])
        kp = -float(model.actuator_biasprm[actuator, 1])
        limit = 0.0
        if model.actuator_forcelimited[actuator]:
            limit = lever * _farthest(model.actuator_forcerange[actuator])
        elif kp == 0 and model.actuator_ctrllimited[actuator]:  # a motor: its control is a force
            limit = abs(gain) * lever * _farthest(model.actuator_ctrlrange[actuator])
        if model.jnt_actfrclimited[joint]:
            most = _farthest(model.jnt_actfrcrange[joint])
            limit = min(limit, most) if limit > 0 else most
        name = joint_name(model, joint)
        stated = {"effort": max(limit, joints[name].effort)}
        if gain > 0 and kp > 0 and lever > 0:
            stated["stiffness"] = kp * lever**2
        joints[name] = replace(joints[name], **stated)
    tree = tree.with_joints(joints.values())
    check_tree(tree)
    return tree


def _refuse(path: Path, problems: list[str]) -> None:
    if problems:
        raise RobotError(
            f"{path} uses what xreset does not have:"
            + "".join(f"\n  - {problem}" for problem in problems)
        )


def _farthest_turn(model: mujoco.MjModel) -> float:
    """Return the largest limit of two or more hinges [rad]; 0 if there are fewer."""
    turns = model.jnt_limited.astype(bool) & (model.jnt_type > SLIDE)
    return _farthest(model.jnt_range[turns]) if turns.sum() > 1 else 0.0


def _farthest(ranges: np.ndarray) -> float:
    """Return the limit farthest from 0: what only pulls has a range such as -5 to 0."""
    return float(np.abs(ranges).max())


def _compiled(path: Path, unit: str = "") -> mujoco.MjModel:
    """Return the compiled model of a file; unit: ``radians`` if the file's angles are radians, whatever it says."""
    most = max_bytes()
    with tempfile.TemporaryDirectory() as folder:
        binary = f"{folder}/model.mjb"
        command = [
            sys.executable,
            "-P",
            "-c",
            _COMPILE,
            str(path.resolve()),
            binary,
            str(most),
            unit,
        ]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace")
        if done.returncode == 1 and "alloc" not in done.stdout:
            for name in re.findall("'([^']+)'", done.stdout):
                if os.path.isfile(path.parent / name):  # a name may be too long for Path.is_file()
                    refuse_pointer(path.parent / name, RobotError)
            raise RobotError(
                f"{path} is not valid MJCF: {done.stdout.strip()}. If it is a part of another file, such as a scene "
                "that includes it, give that file."
            )
        if done.returncode:
            raise RobotError(
                f"{path} takes more than {most >> 20} MB of memory, or half a minute, when MuJoCo reads it. Leave out "
                f"what a robot does not need, such as textures, height fields and sensors. {RAISE_LIMIT}"
            )
        return mujoco.MjModel.from_binary_path(binary)


def _check_numbers(path: Path, model: mujoco.MjModel) -> None:
    """Raise ``RobotError`` for numbers that are not finite or far too large, and for directions without a length."""
    for name in dir(model):
        is_stated = name.startswith(_PARTS) and name not in _DERIVED
        is_stated = is_stated and not name.endswith("0")  # those follow from others, too
        values = getattr(model, name) if is_stated else None
        if isinstance(values, np.ndarray) and values.dtype.kind == "f":
            wrong = ~(np.abs(values) < _LARGEST)
            if name.endswith(("_axis", "quat")):
                wrong = ~(np.abs(np.linalg.norm(values, axis=-1) - 1) < 1e-6)
            if wrong.any():
                raise RobotError(
                    f"{path} has a number that is not finite, or far too large (MuJoCo's {name})."
                )


def _unsupported(model: mujoco.MjModel, solid: np.ndarray) -> list[str]:
    """Return every feature of a model that a robot of xreset cannot have; ``solid`` are its collision shapes."""
    problems = []
    for joint in map(model.joint, range(model.njnt)):
        if joint.type[0] == int(mujoco.mjtJoint.mjJNT_BALL):
            problems.append(
                f"the ball joint {joint.name!r}. Replace it by three hinges of the same body"
            )
    for geom in map(model.geom, range(model.ngeom)):
        kind = _kind(geom)
        if solid[geom.id] and kind not in _SIZES:
            body = model.body(geom.bodyid[0]).name
            problems.append(
                f"the {kind} {geom.name or geom.id!r} of body {body!r}. Replace it by a capsule, box or mesh"
            )
    if model.ngeom > _MOST_SHAPES:
        problems.append(f"{model.ngeom} shapes. Use {_MOST_SHAPES} at most")
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


def _let_go(model: mujoco.MjModel, notes: list[str]) -> None:
    """Switch off the equalities by which a user's mocap body holds a robot, and note them."""
    is_body = model.eq_objtype == int(mujoco.mjtObj.mjOBJ_BODY)
    ends = np.where(is_body, (model.eq_obj1id, model.eq_obj2id), 0)
    held = (model.body_mocapid[ends] >= 0).any(axis=0)
    model.eq_active0[held] = 0
    if held.any():
        names = [model.equality(i).name or f"{i}" for i in np.flatnonzero(held).tolist()]
        notes.append(f"left out: equalities with a mocap body: {listed(names)}")


def _left_out(model: mujoco.MjModel, notes: list[str]) -> None:
    """Note what moves or pulls in a model and is not in a robot of xreset."""
    names = [joint_name(model, joint) for joint in range(model.njnt)]
    is_free = model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE)
    damped = np.flatnonzero((model.dof_damping > 0) | (model.dof_frictionloss > 0))
    by_tendon = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)
    slack = np.setdiff1d(np.arange(model.ntendon), model.actuator_trnid[by_tendon, 0])
    for what, left in (
        ("free joints", [names[i] for i in np.flatnonzero(is_free)]),
        ("springs of joints", [names[i] for i in np.flatnonzero(model.jnt_stiffness)]),
        ("damping and friction of joints", [names[i] for i in np.unique(model.dof_jntid[damped])]),
        ("tendons without an actuator", [model.tendon(i).name or f"{i}" for i in slack]),
    ):
        if left:
            notes.append(f"left out: {what}: {listed(left)}")


def _solid(model: mujoco.MjModel, notes: list[str]) -> np.ndarray:
    """[G] bool: the shapes of a model that collide.

    If the last body of a chain has none, the file lets shapes collide by other means, and bodies without one get those
    of the collision groups, or all of theirs.
    """
    on_robot = model.geom_bodyid > 0
    switched_on = on_robot & ((model.geom_contype | model.geom_conaffinity) > 0)
    solid = switched_on.copy()
    solid[np.concatenate((model.pair_geom1, model.pair_geom2))] = True
    solid &= on_robot
    body = model.body_weldid[model.geom_bodyid]
    moving = np.unique(model.jnt_bodyid[model.jnt_type >= SLIDE])
    ends = np.setdiff1d(moving, model.body_weldid[model.body_parentid[moving]])
    if not np.setdiff1d(np.intersect1d(ends, body), body[solid]).size:
        return solid
    groups = on_robot & (model.geom_group >= _COLLISION_GROUP)
    groups &= ~np.isin(body, body[switched_on])
    solid |= groups
    visual = on_robot & ~np.isin(body, body[solid])
    solid |= visual
    for what, used in (("shapes of collision groups", groups), ("visual shapes", visual)):
        bodies = [_body_name(model, i) for i in np.unique(model.geom_bodyid[used]).tolist()]
        if bodies:
            notes.append(f"{what} collide where no contact is switched on: {listed(bodies)}")
    return solid


def _tree(
    path: Path,
    model: mujoco.MjModel,
    couplings: Couplings,
    solid: np.ndarray,
    notes: list[str],
) -> RobotTree:
    """Return links and joints of a model, from its poses where the joints are at 0 or held; ``solid`` are the shapes
    that collide.

    The origin of a link is at its joint, which may be away from the body's origin.
    """
    names = [_body_name(model, i) for i in range(model.nbody)]
    kept = _kept_trees(path, model, names, notes)
    if len(kept) > 1 or _moving(model, kept[0]):
        names[0] = "world_frame"
        root = names[0]
    else:
        root = names[kept[0]]
    links = {root: frame(root)}
    joints = []
    poses = {root: np.eye(4)}
    data = _posed(model, couplings)
    for number in range(1, model.nbody):
        if model.body_rootid[number] not in kept:
            continue
        name = names[number]
        above = names[model.body_parentid[number]]
        R = data.xmat[number].reshape(3, 3)
        T = transform(R, data.xpos[number])
        # a link for each joint of the body, of which the last one is the body itself
        moving = _moving(model, number)
        children = [*(f"{name}_axis{i}" for i in range(len(moving) - 1)), name]
        for child, joint in zip(children, moving, strict=False):
            T = transform(R, data.xanchor[joint])
            poses[child] = T
            links[child] = frame(child)
            placed = Joint(
                parent=above,
                child=child,
                T_parent_joint=np.linalg.inv(poses[above]) @ T,
                axis=R.T @ data.xaxis[joint],
                **_motion(model, couplings, joint),
            )
            joints.append(placed)
            above = child
        poses[name] = T
        if not moving and name != root:
            joints.append(fixed(above, name, np.linalg.inv(poses[above]) @ T))
        links[name] = _link(model, data, number, name, T, solid)
    order = [root, *(joint.child for joint in joints)]
    pairs = [(names[pair >> 16], names[pair & 0xFFFF]) for pair in model.exclude_signature.tolist()]
    return RobotTree(
        name=path.stem,
        root=root,
        links=tuple(links[name] for name in order),
        joints=tuple(joints),
        exclude=tuple(pair for pair in pairs if {*pair} <= {*order}),
    )


def _body_name(model: mujoco.MjModel, body: int) -> str:
    return model.body(body).name or f"unnamed_body{body}"


def _kept_trees(
    path: Path, model: mujoco.MjModel, names: list[str], notes: list[str]
) -> np.ndarray:
    """Return the bodies of the world that have a joint, or that carry bodies with one; note the others."""
    jointed = np.unique(model.jnt_bodyid[model.jnt_type >= SLIDE])
    tops = np.flatnonzero(model.body_parentid[1:] == 0) + 1
    kept = np.intersect1d(tops, model.body_rootid[jointed])
    if not len(kept):
        raise RobotError(f"{path} has no body with a hinge or a slide, so it has no robot.")
    absent = [names[i] for i in tops if i not in kept]
    if absent:
        notes.append(f"left out: bodies of the world that have no joint: {listed(absent)}")
    return kept


def _moving(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the hinges and slides of a body."""
    return np.flatnonzero((model.jnt_bodyid == body) & (model.jnt_type >= SLIDE)).tolist()


def _posed(model: mujoco.MjModel, couplings: Couplings) -> mujoco.MjData:
    """Return the poses of all bodies where the joints are at 0, or where a coupling holds them."""
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[model.jnt_type >= SLIDE]] = 0.0
    for joint, line in couplings.lines.items():
        if not line.multiplier:
            data.qpos[model.jnt_qposadr[joint]] = line.offset
    mujoco.mj_kinematics(model, data)
    return data


def _link(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    number: int,
    name: str,
    T: np.ndarray,
    solid: np.ndarray,
) -> Link:
    """Return a body as a link whose frame has the pose ``T``."""
    R = T[:3, :3].T @ data.ximat[number].reshape(3, 3)
    return Link(
        name=name,
        mass=float(model.body_mass[number]),
        com=T[:3, :3].T @ (data.xipos[number] - T[:3, 3]),
        inertia=R @ np.diag(model.body_inertia[number]) @ R.T,
        collisions=tuple(_shapes(model, data, number, solid, T)),
    )


def _motion(model: mujoco.MjModel, couplings: Couplings, number: int) -> dict[str, Any]:
    """Return a joint's name, type, rotor, limits and what it follows."""
    name = joint_name(model, number)
    is_slide = model.jnt_type[number] == SLIDE
    motion: dict[str, Any] = {"name": name, "type": "prismatic" if is_slide else "revolute"}
    motion["rotor"] = float(model.dof_armature[model.jnt_dofadr[number]])
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
    model: mujoco.MjModel,
    data: mujoco.MjData,
    body: int,
    solid: np.ndarray,
    T_world_link: np.ndarray,
) -> Iterator[Shape]:
    """Yield the collision shapes of a body."""
    for number in np.flatnonzero(model.geom_bodyid == body):
        geom = model.geom(number)
        kind = _kind(geom)
        if not solid[number] or kind == "plane":
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
