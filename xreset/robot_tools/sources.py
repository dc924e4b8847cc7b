"""What others publish of a robot, URDF or MJCF, as one kind of plain data; and an arm and a hand put together."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.errors import ObjectError, RobotError
from xreset.geometry.shapes import hull, mass_properties, surface_of
from xreset.geometry.urdf import HULL_TOLERANCE, Joint, Link, RobotTree, check_tree, load_urdf, parse_xml
from xreset.geometry.urdf_writer import FRAME_INERTIA, FRAME_MASS, fixed
from xreset.robot_tools.draft import below
from xreset.spec import DriveSpec, Geometry, MimicSpec, Shape
from xreset.text import shown

_DENSITY = 1000.0
"""[kg/m^3] Of links whose mass nobody states."""
_ROTOR_AT_MOST = 0.01
"""[kg m^2] Reflected inertia of a rotor that descriptions add to light links."""
_TURNS = 2 * math.pi
"""[rad] Range in either direction of a joint without limits."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A robot, or a part of one, as its maker describes it."""

    tree: RobotTree
    mimics: tuple[MimicSpec, ...] = ()
    effort: dict[str, float] = field(default_factory=dict)
    """Largest torque [N m] or force [N] of joints, where it is stated."""
    drives: dict[str, DriveSpec] = field(default_factory=dict)
    """Drives of joints, where they are stated."""
    notes: tuple[str, ...] = ()
    """What had to be changed or assumed."""


def read_source(path: str | Path) -> Source:
    """Read a URDF, or an MJCF (needs the engine MuJoCo).

    Raises:
        RobotError: it cannot be read, or uses what xreset does not have; the message names all of it.
    """
    path = Path(path)
    root = parse_xml(path)
    source = _read_mjcf(path) if root.tag == "mujoco" else _read_urdf(path, root)
    check_tree(source.tree, path)
    drives = [
        number for drive in source.drives.values() for number in (drive.kp, drive.kd, drive.effort, drive.armature)
    ]
    if not np.isfinite(
        [*drives, *(number for mimic in source.mimics for number in (mimic.multiplier, mimic.offset))]
    ).all():
        raise RobotError(f"{path} has a drive or a mimicking joint with a number that is not finite.")
    return _with_masses(_with_limits(source))


def _read_urdf(path: Path, root: ElementTree.Element) -> Source:
    tree, mimics, effort = load_urdf(path), [], {}

    def number(tag: ElementTree.Element, name: str, default: float) -> float:
        try:
            return float(tag.get(name, default))
        except ValueError as error:
            raise RobotError(f"{path}: {tag.tag} has the {name} {shown(tag.get(name))}, expected a number.") from error

    for joint in root.findall("joint"):
        name, tag, limit = joint.get("name", ""), joint.find("mimic"), joint.find("limit")
        if tag is not None:
            of = {"multiplier": number(tag, "multiplier", 1), "offset": number(tag, "offset", 0)}
            mimics.append(MimicSpec(joint=name, source=tag.get("joint", ""), **of))
        if limit is not None and 0 < number(limit, "effort", 0) < math.inf:
            effort[name] = number(limit, "effort", 0)
    return Source(tree=tree, mimics=tuple(mimics), effort=effort)


def combined(arm: Source, hand: Source, *, flange: str | None, T_flange_hand: np.ndarray, name: str) -> Source:
    """An arm with a hand at its flange; whatever the arm carries there already is left out.

    Args:
        arm: the arm.
        hand: the hand.
        flange: link of the arm that carries the hand; None: the arm's last link, if there is only one.
        T_flange_hand: [4, 4] pose of the hand's root link in the flange's frame.
        name: of the whole.

    Raises:
        RobotError: there is no such link, or the last one is not unique.
    """
    notes = [*arm.notes, *hand.notes]
    parents = {joint.parent for joint in arm.tree.joints}
    ends = [link for link in arm.tree.link_names if link not in parents]
    if flange is None:
        if len(ends) != 1:
            before = ", ".join(link for link in arm.tree.link_names if {*ends} < {*below(arm.tree, link)})
            raise RobotError(
                f"the arm ends in {', '.join(ends)}, after {before}; say with --flange which of its links carries the hand;"
                " what hangs there is left out."
            )
        flange = ends[0]
        notes.append(f"the hand is carried by the arm's last link, {flange!r} (--flange says another)")
    arm.tree.link(flange)
    path = {link for link in arm.tree.link_names if flange in below(arm.tree, link)}
    gone = {*below(arm.tree, flange)} - {flange}
    if gone:
        notes.append(f"left out, because it hangs on the flange where the hand goes: {', '.join(sorted(gone))}")
    kept = [joint for joint in arm.tree.joints if joint.child not in gone]
    stiff = [joint.name for joint in kept if joint.type != "fixed" and joint.child not in path]
    if stiff:
        notes.append(f"joints of the arm that do not move the hand are fixed at 0: {', '.join(stiff)}")
    joints = [replace(joint, type="fixed") if joint.name in stiff else joint for joint in kept]
    hand = _renamed(hand, {*arm.tree.link_names} - gone, {joint.name for joint in kept})
    tree = RobotTree(
        name=name,
        root=arm.tree.root,
        links=(*(link for link in arm.tree.links if link.name not in gone), *hand.tree.links),
        joints=(*joints, fixed(flange, hand.tree.root, T_flange_hand), *hand.tree.joints),
    )
    moving = {joint.name for joint in tree.joints if joint.type != "fixed"}
    return Source(
        tree=tree,
        mimics=tuple(mimic for mimic in (*arm.mimics, *hand.mimics) if mimic.joint in moving),
        effort=arm.effort | hand.effort,
        drives=arm.drives | hand.drives,
        notes=tuple(notes),
    )


def _renamed(source: Source, links: Iterable[str], joints: Iterable[str]) -> Source:
    """The source with ``hand_`` before the names of links and joints that are taken."""
    link = {name: f"hand_{name}" if name in set(links) else name for name in source.tree.link_names}
    joint = {j.name: f"hand_{j.name}" if j.name in set(joints) else j.name for j in source.tree.joints}
    tree = RobotTree(
        name=source.tree.name,
        root=link[source.tree.root],
        links=tuple(replace(item, name=link[item.name]) for item in source.tree.links),
        joints=tuple(
            replace(j, name=joint[j.name], parent=link[j.parent], child=link[j.child]) for j in source.tree.joints
        ),
    )
    mimics = tuple(
        replace(mimic, joint=joint[mimic.joint], source=joint.get(mimic.source, mimic.source))
        for mimic in source.mimics
    )
    effort, drives = ({joint[name]: value for name, value in part.items()} for part in (source.effort, source.drives))
    return replace(source, tree=tree, mimics=mimics, effort=effort, drives=drives)


def _with_limits(source: Source) -> Source:
    notes, joints = list(source.notes), []
    for joint in source.tree.joints:
        if joint.type != "fixed" and not np.isfinite((joint.lower, joint.upper)).all():
            notes.append(f"the joint {joint.name!r} has no limits; it gets one turn in either direction")
            joint = replace(joint, lower=-_TURNS, upper=_TURNS)
        if joint.type != "fixed" and not 0 < joint.velocity < math.inf:
            joint = replace(joint, velocity=math.pi)
        joints.append(joint)
    limits = {joint.name: np.array((joint.lower, joint.upper)) for joint in joints}
    for mimic in source.mimics:
        if mimic.source not in limits:
            raise RobotError(f"{mimic.joint!r} mimics {mimic.source!r}, which is no joint of the same file.")
        low, high = sorted((mimic.multiplier * limits[mimic.source] + mimic.offset).tolist())
        row = next(i for i, joint in enumerate(joints) if joint.name == mimic.joint)
        if low < joints[row].lower or high > joints[row].upper:
            stated = f"{joints[row].lower:.4g}..{joints[row].upper:.4g}"
            notes.append(
                f"{mimic.joint!r} has the limits {low:.4g}..{high:.4g} that {mimic.source!r} gives it, in place of {stated}"
            )
            joints[row] = replace(joints[row], lower=low, upper=high)
    return replace(source, tree=replace(source.tree, joints=tuple(joints)), notes=tuple(notes))


def _with_masses(source: Source) -> Source:
    """Masses and inertias that a solid body can have: from the shapes where none or an impossible one is stated."""
    links: list[Link] = []
    replaced: dict[str, list[str]] = {}
    for link in source.tree.links:
        if not link.collisions:
            if link.mass <= FRAME_MASS or not plausible(link):
                link = replace(link, mass=max(link.mass, FRAME_MASS), inertia=np.eye(3) * FRAME_INERTIA)
            links.append(link)
            continue
        if link.mass <= 0 or not plausible(link):
            vertices, faces = surface_of(link.collisions)
            volume = float(
                np.einsum("ij,ij->", vertices[faces[:, 0]], np.cross(vertices[faces[:, 1]], vertices[faces[:, 2]])) / 6
            )
            mass = link.mass if link.mass > 0 else _DENSITY * volume
            com, inertia = mass_properties(vertices, faces, mass)
            why = "have no mass" if link.mass <= 0 else "have an inertia that their mass and size do not allow"
            replaced.setdefault(why, []).append(f"{link.name} ({mass:.3g} kg)")
            link = replace(link, mass=mass, com=com, inertia=inertia)
        links.append(link)
    notes = (f"these links {why}, and get that of their shapes: {', '.join(names)}" for why, names in replaced.items())
    return replace(source, tree=replace(source.tree, links=tuple(links)), notes=(*source.notes, *notes))


def plausible(link: Link) -> bool:
    """Whether a link's moments are positive, those of a solid body, and no larger than its mass at twice its shapes' reach would have."""
    moments = np.linalg.eigvalsh(link.inertia)
    if moments[0] <= 0 or moments[2] > (moments[0] + moments[1]) * 1.001:
        return False
    return not link.collisions or float(moments[2]) <= largest_moment(link)


def largest_moment(link: Link) -> float:
    """[kg m^2] What a link's mass at twice its shapes' reach would have, and the rotor of a joint besides."""
    vertices, _ = surface_of(link.collisions)
    return link.mass * (2 * float(np.linalg.norm(vertices - link.com, axis=1).max())) ** 2 + _ROTOR_AT_MOST


# MJCF ------------------------------------------------------------------------------------------------------------------------------------


def _mjcf_model(path: Path) -> tuple[Any, Any]:
    """The model, and the module that has read it."""
    try:
        import mujoco
    except ImportError as error:
        raise RobotError(
            f"{path} is MJCF, which only MuJoCo reads, and that cannot be imported ({error}). Run: pip install mujoco"
        ) from error
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise RobotError(f"{path} is not valid MJCF: {error}") from error
    if problems := _unsupported(model, mujoco):
        raise RobotError(
            f"{path} uses what xreset does not have:" + "".join(f"\n  - {problem}" for problem in problems)
        )
    return model, mujoco


def _read_mjcf(path: Path) -> Source:
    model, mujoco = _mjcf_model(path)
    notes: list[str] = []
    names = [model.body(i).name or f"body{i}" for i in range(model.nbody)]
    tops = [i for i in range(1, model.nbody) if model.body_parentid[i] == 0]
    if len(tops) != 1:
        raise RobotError(
            f"{path}: expected one body in the world, found {', '.join(names[i] for i in tops) or 'none'}."
        )
    shift = np.zeros((model.nbody, 3))  # a joint may lie beside its body's origin: the link's frame is put onto it
    links, joints, joint_name = [], [], {}
    for body in range(1, model.nbody):
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        own = [j for j in range(first, first + count) if int(model.jnt_type[j]) != int(mujoco.mjtJoint.mjJNT_FREE)]
        if count > len(own):
            notes.append(f"the free joint of {names[body]!r} is left out")
        shift[body] = model.jnt_pos[own[0]] if own else 0.0
        if any(np.abs(model.jnt_pos[j] - shift[body]).max() > 1e-9 for j in own):
            raise RobotError(f"{path}: the joints of body {names[body]!r} do not meet in one point.")
        inner = np.eye(4)
        inner[:3, :3], inner[:3, 3] = _matrix(model.body_iquat[body]), model.body_ipos[body] - shift[body]
        link = Link(
            name=names[body],
            mass=float(model.body_mass[body]),
            com=inner[:3, 3].copy(),
            inertia=inner[:3, :3] @ np.diag(model.body_inertia[body]) @ inner[:3, :3].T,
            collisions=tuple(_geoms(model, mujoco, body, shift[body])),
        )
        if body != tops[0]:
            parent = int(model.body_parentid[body])
            T = np.eye(4)
            T[:3, :3] = _matrix(model.body_quat[body])
            T[:3, 3] = model.body_pos[body] + T[:3, :3] @ shift[body] - shift[parent]
            above = names[parent]
            for number, j in enumerate(own):
                last = number == len(own) - 1
                below = names[body] if last else f"{names[body]}_axis{number}"
                joint_name[j] = model.joint(j).name or f"joint{j}"
                joints.append(_mjcf_joint(model, mujoco, j, joint_name[j], above, below, T))
                if not last:
                    links.append(Link(name=below, mass=0.0, com=np.zeros(3), inertia=np.zeros((3, 3)), collisions=()))
                above, T = below, np.eye(4)
            if not own:
                joints.append(fixed(above, names[body], T))
        elif own:
            raise RobotError(
                f"{path}: the first body {names[body]!r} has joints; put it into a body that does not move."
            )
        links.append(link)
    mimics = []
    for i in range(model.neq):
        if model.eq_obj2id[i] >= 0:
            ends = [joint_name[int(model.eq_obj1id[i])], joint_name[int(model.eq_obj2id[i])]]
            offset, factor = (float(value) for value in model.eq_data[i, :2])
            mimics.append(MimicSpec(joint=ends[0], source=ends[1], multiplier=factor, offset=offset))
    order = {link.name: link for link in links}
    tree = RobotTree(
        name=Path(path).stem,
        root=names[tops[0]],
        links=(order[names[tops[0]]], *(order[j.child] for j in joints)),
        joints=tuple(joints),
    )
    drives, effort = _mjcf_drives(model, joint_name)
    return Source(tree=tree, mimics=tuple(mimics), effort=effort, drives=drives, notes=tuple(notes))


def _mjcf_drives(model, joint_name: dict[int, str]) -> tuple[dict[str, DriveSpec], dict[str, float]]:
    """Position drives and efforts of the joints that have actuators."""
    drives, effort = {}, {}
    for i in range(model.nu):
        j = int(model.actuator_trnid[i, 0])
        kp, kd = float(model.actuator_gainprm[i, 0]), float(-model.actuator_biasprm[i, 2])
        limit = float(model.actuator_forcerange[i, 1]) if model.actuator_forcelimited[i] else 0.0
        if limit <= 0 and model.jnt_actfrclimited[j]:
            limit = float(model.jnt_actfrcrange[j, 1])
        if limit > 0:
            effort[joint_name[j]] = limit
        if kp > 0 and model.actuator_biasprm[i, 1] < 0:
            dof = int(model.jnt_dofadr[j])
            kd += float(model.dof_damping[dof])
            armature = float(model.dof_armature[dof])
            drives[joint_name[j]] = DriveSpec(kp=kp, kd=kd, effort=max(limit, 0.0), armature=armature)
    return drives, effort


def _unsupported(model, mujoco) -> list[str]:
    """Every feature of a model that a robot of xreset cannot have."""
    kinds, geoms = mujoco.mjtJoint, mujoco.mjtGeom
    problems = [
        f"the ball joint {model.joint(j).name!r}"
        for j in range(model.njnt)
        if int(model.jnt_type[j]) == int(kinds.mjJNT_BALL)
    ]
    for i in range(model.ngeom):
        solid = model.geom_contype[i] or model.geom_conaffinity[i]
        known = {
            int(getattr(geoms, f"mjGEOM_{kind}")) for kind in ("BOX", "SPHERE", "CAPSULE", "CYLINDER", "MESH", "PLANE")
        }
        if solid and int(model.geom_type[i]) not in known:
            kind = geoms(int(model.geom_type[i])).name.removeprefix("mjGEOM_").lower()
            problems.append(
                f"the {kind} {model.geom(i).name or i!r} of body {model.body(int(model.geom_bodyid[i])).name!r}"
            )
    for i in range(model.nu):
        if int(model.actuator_trntype[i]) != int(mujoco.mjtTrn.mjTRN_JOINT):
            problems.append(f"the actuator {model.actuator(i).name!r}, which does not drive a single joint")
    for i in range(model.neq):
        if int(model.eq_type[i]) != int(mujoco.mjtEq.mjEQ_JOINT):
            problems.append(
                f"the equality {model.equality(i).name or i!r} of type {mujoco.mjtEq(int(model.eq_type[i])).name[5:].lower()}"
            )
        elif np.abs(model.eq_data[i, 2:5]).max() > 0:
            problems.append(
                f"the equality {model.equality(i).name or i!r}, which couples joints by a curve that is not straight"
            )
    problems += [f"the tendon {model.tendon(i).name or i!r}" for i in range(model.ntendon)]
    problems += ["flexible bodies"] * bool(model.nflex)
    return problems


def _mjcf_joint(model, mujoco, j: int, name: str, parent: str, child: str, T: np.ndarray) -> Joint:
    limited = bool(model.jnt_limited[j])
    return Joint(
        name=name,
        type="prismatic" if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) else "revolute",
        parent=parent,
        child=child,
        T_parent_joint=T,
        axis=np.array(model.jnt_axis[j]) / np.linalg.norm(model.jnt_axis[j]),
        lower=float(model.jnt_range[j, 0]) if limited else -math.inf,
        upper=float(model.jnt_range[j, 1]) if limited else math.inf,
        velocity=math.inf,
    )


def _geoms(model, mujoco, body: int, shift: np.ndarray) -> Iterable[Shape]:
    """The collision shapes of a body."""
    kinds = mujoco.mjtGeom
    for i in range(int(model.body_geomadr[body]), int(model.body_geomadr[body]) + int(model.body_geomnum[body])):
        if not (model.geom_contype[i] or model.geom_conaffinity[i]) or int(model.geom_type[i]) == int(
            kinds.mjGEOM_PLANE
        ):
            continue
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = _matrix(model.geom_quat[i]), model.geom_pos[i] - shift
        size = [float(value) for value in model.geom_size[i]]
        kind = int(model.geom_type[i])
        if kind == int(kinds.mjGEOM_MESH):
            mesh = int(model.geom_dataid[i])
            begin = int(model.mesh_vertadr[mesh])
            vertices = np.array(model.mesh_vert[begin : begin + int(model.mesh_vertnum[mesh])], dtype=float)
            try:
                geometry = hull(vertices, HULL_TOLERANCE).geometry
            except ObjectError as error:
                raise RobotError(
                    f"the mesh {model.mesh(mesh).name!r} of body {model.body(body).name!r}: {error}"
                ) from error
        elif kind == int(kinds.mjGEOM_BOX):
            geometry = Geometry(kind="box", size=tuple(size))
        elif kind == int(kinds.mjGEOM_SPHERE):
            geometry = Geometry(kind="sphere", size=(size[0],))
        else:
            geometry = Geometry(
                kind="capsule" if kind == int(kinds.mjGEOM_CAPSULE) else "cylinder", size=(size[0], size[1])
            )
        yield Shape(geometry=geometry, T_body_shape=T)


def _matrix(quat: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()
