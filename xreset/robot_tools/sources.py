"""Reads what makers publish of a robot, URDF or MJCF, as one kind of plain data, and puts an arm and a hand
together."""

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
from xreset.geometry.urdf_writer import FRAME_INERTIA, FRAME_MASS, fixed, pose
from xreset.robot_tools.couplings import Couplings, Line, read_couplings, resolved, tendon_joints
from xreset.robot_tools.draft import below
from xreset.spec import DriveSpec, Geometry, MimicSpec, Shape
from xreset.text import shown

_DENSITY = 1000.0
"""[kg/m^3] Density of links whose mass is not stated."""
_ROTOR_AT_MOST = 0.01
"""[kg m^2] Reflected inertia of a rotor that descriptions add to light links."""
_TURNS = 2 * math.pi
"""[rad] Range in either direction of a joint without limits."""
_FLANGES = (
    *("tool0", "flange", "tool_link", "ee_link", "link_eef", "link_ee", "end_effector_link", "attachment"),
    *("panda_link8", "fr3_link8", "fer_link8", "iiwa_link_ee", "lbr_link_ee", "lbr_iiwa_link_7", "bracelet_link"),
)
"""Links that carry the tool in the makers' files: UR, ABB and Fanuc (ROS-Industrial), xArm, Panda and FR3, iiwa,
Kinova."""
_SMALLEST = 1e-6
"""[m] Smallest size of a shape."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """A robot, or a part of one, as its maker describes it."""

    tree: RobotTree
    mimics: tuple[MimicSpec, ...] = ()
    effort: dict[str, float] = field(default_factory=dict)
    """Joint -> largest torque [N m] or force [N], where it is stated."""
    drives: dict[str, DriveSpec] = field(default_factory=dict)
    """Joint -> drive, where it is stated."""
    notes: tuple[str, ...] = ()
    """What had to be changed or assumed."""


def read_source(path: str | Path) -> Source:
    """Read a URDF, or an MJCF (needs the engine MuJoCo).

    Raises:
        RobotError: the file cannot be read, or uses what xreset does not have; the message names all of it.
    """
    path = Path(path)
    root = parse_xml(path)
    if root.tag == "mujocoinclude":
        raise RobotError(f"{path} is a part of an MJCF. Give the file that includes it.")
    source = _read_mjcf(path, root) if root.tag == "mujoco" else _read_urdf(path, root)
    check_tree(source.tree, path)
    for link in source.tree.links:
        for shape in link.collisions:
            sizes = shape.geometry.size
            if shape.geometry.kind != "box":
                sizes = sizes[:1]  # the half length of a capsule may be 0
            if sizes and min(sizes) < _SMALLEST:
                raise RobotError(
                    f"{path}: a {shape.geometry.kind} of link {link.name!r} is {min(sizes):g} m small. "
                    f"Expected at least {_SMALLEST:g}."
                )
    numbers = []
    for mimic in source.mimics:
        numbers += [mimic.multiplier, mimic.offset]
    for drive in source.drives.values():
        numbers += [drive.kp, drive.kd, drive.effort, drive.armature]
    if not np.isfinite(numbers).all():
        raise RobotError(f"{path} has a drive or a mimic joint with a number that is not finite.")
    return _with_masses(_with_limits(source))


def _read_urdf(path: Path, root: ElementTree.Element) -> Source:
    def number(tag: ElementTree.Element, name: str, default: float) -> float:
        try:
            return float(tag.get(name, default))
        except ValueError as error:
            raise RobotError(f"{path}: {tag.tag} has the {name} {shown(tag.get(name))}, expected a number.") from error

    tree = load_urdf(path)
    mimics = []
    efforts = {}
    for joint in root.findall("joint"):
        name = joint.get("name", "")
        mimic = joint.find("mimic")
        if mimic is not None:
            multiplier = number(mimic, "multiplier", 1)
            offset = number(mimic, "offset", 0)
            mimics.append(MimicSpec(joint=name, source=mimic.get("joint", ""), multiplier=multiplier, offset=offset))
        limit = joint.find("limit")
        if limit is not None and 0 < number(limit, "effort", 0) < math.inf:
            efforts[name] = number(limit, "effort", 0)
    followers = {mimic.joint for mimic in mimics}
    if any(mimic.source in followers for mimic in mimics):
        lines = [Line(mimic.joint, mimic.source, mimic.multiplier, mimic.offset) for mimic in mimics]
        try:
            mimics = [MimicSpec(**line._asdict()) for line in resolved(lines)]
        except ValueError as error:
            raise RobotError(f"{path}: {error}. Let one of them follow nothing.") from error
    return Source(tree=tree, mimics=tuple(mimics), effort=efforts)


def combined(arm: Source, hand: Source, *, flange: str | None, T_flange_hand: np.ndarray, name: str) -> Source:
    """Return an arm with a hand at its flange. What the flange carries already is left out.

    Args:
        flange: link of the arm that carries the hand; None: a link that makers of arms call so, or the arm's last link,
            if there is only one.
        T_flange_hand: [4, 4] pose of the hand's root link in the flange's frame.

    Raises:
        RobotError: there is no such link, or the last one is not unique.
    """
    notes = [*arm.notes, *hand.notes]
    if flange is None:
        flange = _last_link(arm.tree)
        notes.append(f"the hand is carried by the arm's link {flange!r} (--flange says another)")
    arm.tree.link(flange)
    carriers = {link for link in arm.tree.link_names if flange in below(arm.tree, link)}
    removed = set(below(arm.tree, flange)) - {flange}
    if removed:
        notes.append(f"left out, because it hangs on the flange where the hand goes: {', '.join(sorted(removed))}")
    joints = []
    stiff = []
    for joint in arm.tree.joints:
        if joint.child in removed:
            continue
        if joint.type != "fixed" and joint.child not in carriers:
            stiff.append(joint.name)
            joint = replace(joint, type="fixed")
        joints.append(joint)
    if stiff:
        notes.append(f"joints of the arm that do not move the hand are fixed at 0: {', '.join(stiff)}")
    links = [link for link in arm.tree.links if link.name not in removed]
    hand = _renamed(hand, {link.name for link in links}, {joint.name for joint in joints})
    tree = RobotTree(
        name=name,
        root=arm.tree.root,
        links=(*links, *hand.tree.links),
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


def _last_link(arm: RobotTree) -> str:
    parents = {joint.parent for joint in arm.joints}
    ends = [link for link in arm.link_names if link not in parents]
    known = [link for link in arm.link_names if link in _FLANGES]
    if known:
        return known[-1]
    if len(ends) == 1:
        return ends[0]
    before = [link for link in arm.link_names if set(ends) < set(below(arm, link))]
    raise RobotError(
        f"the arm ends in {', '.join(ends)}, after {', '.join(before)}; say with --flange which of its links carries "
        "the hand;"
        " what hangs there is left out."
    )


def _renamed(source: Source, links: set[str], joints: set[str]) -> Source:
    """Return the source with ``hand_`` before the names of links and joints that are taken."""

    def link(name: str) -> str:
        return f"hand_{name}" if name in links else name

    def joint(name: str) -> str:
        return f"hand_{name}" if name in joints else name

    def moved(each: Joint) -> Joint:
        return replace(each, name=joint(each.name), parent=link(each.parent), child=link(each.child))

    tree = RobotTree(
        name=source.tree.name,
        root=link(source.tree.root),
        links=tuple(replace(each, name=link(each.name)) for each in source.tree.links),
        joints=tuple(moved(each) for each in source.tree.joints),
    )
    return Source(
        tree=tree,
        mimics=tuple(replace(each, joint=joint(each.joint), source=joint(each.source)) for each in source.mimics),
        effort={joint(name): effort for name, effort in source.effort.items()},
        drives={joint(name): drive for name, drive in source.drives.items()},
        notes=source.notes,
    )


def _with_limits(source: Source) -> Source:
    """Return the source with finite limits; a mimic joint has those that its source gives it."""
    notes = list(source.notes)
    joints = {}
    for joint in source.tree.joints:
        if joint.type != "fixed" and not np.isfinite((joint.lower, joint.upper)).all():
            notes.append(f"the joint {joint.name!r} has no limits; it gets one turn in either direction")
            joint = replace(joint, lower=-_TURNS, upper=_TURNS)
        if joint.type != "fixed" and not 0 < joint.velocity < math.inf:
            joint = replace(joint, velocity=math.pi)
        joints[joint.name] = joint
    stated = dict(joints)
    for mimic in source.mimics:
        if mimic.source not in joints:
            raise RobotError(f"{mimic.joint!r} mimics {mimic.source!r}, which is not a joint of the same file.")
        driver = stated[mimic.source]
        joint = joints[mimic.joint]
        ends = mimic.multiplier * np.array((driver.lower, driver.upper)) + mimic.offset
        low, high = sorted(ends.tolist())
        if low < joint.lower or high > joint.upper:
            notes.append(
                f"{mimic.joint!r} has the limits {low:.4g}..{high:.4g} that {mimic.source!r} gives it, "
                f"in place of {joint.lower:.4g}..{joint.upper:.4g}"
            )
            joints[mimic.joint] = replace(joint, lower=low, upper=high)
    return replace(source, tree=replace(source.tree, joints=tuple(joints.values())), notes=tuple(notes))


def _with_masses(source: Source) -> Source:
    """Return the source with masses and inertias that a solid body can have: those of the shapes where the stated ones
    are impossible."""
    links = []
    replaced: dict[str, list[str]] = {}
    for link in source.tree.links:
        if not link.collisions:
            if link.mass <= FRAME_MASS or not plausible(link):
                link = replace(link, mass=max(link.mass, FRAME_MASS), inertia=np.eye(3) * FRAME_INERTIA)
        elif link.mass <= 0 or not plausible(link):
            why = "have no mass" if link.mass <= 0 else "have an inertia that their mass and size do not allow"
            link = _with_mass_of_shapes(link)
            replaced.setdefault(why, []).append(f"{link.name} ({link.mass:.3g} kg)")
        links.append(link)
    notes = [f"these links {why}, and get that of their shapes: {', '.join(names)}" for why, names in replaced.items()]
    return replace(source, tree=replace(source.tree, links=tuple(links)), notes=(*source.notes, *notes))


def _with_mass_of_shapes(link: Link) -> Link:
    vertices, faces = surface_of(link.collisions)
    mass = link.mass
    if mass <= 0:
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        mass = _DENSITY * float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
    com, inertia = mass_properties(vertices, faces, mass)
    if not (np.isfinite(com).all() and np.isfinite(inertia).all()):
        raise RobotError(f"the shapes of link {link.name!r} have no volume. State the mass and inertia of the link.")
    return replace(link, mass=mass, com=com, inertia=inertia)


def plausible(link: Link) -> bool:
    """Return whether a link's moments are positive, those of a solid body, and at most :func:`largest_moment`."""
    moments = np.linalg.eigvalsh(link.inertia)
    if moments[0] <= 0 or moments[2] > (moments[0] + moments[1]) * 1.001:
        return False
    return not link.collisions or float(moments[2]) <= largest_moment(link)


def largest_moment(link: Link) -> float:
    """[kg m^2] Moment of the link's mass at twice the reach of its shapes, and of the rotor of a joint."""
    vertices, _ = surface_of(link.collisions)
    return link.mass * (2 * float(np.linalg.norm(vertices - link.com, axis=1).max())) ** 2 + _ROTOR_AT_MOST


# MJCF -----------------------------------------------------------------------------------------------------------------

_LARGEST = {"hfield": ("nrow", "ncol"), "texture": ("width", "height"), "size": ("nkey",)}
"""Elements whose numbers decide how much memory MuJoCo takes."""
_ENTRIES = 2**24
_COPIES = 1000
_SOLIDS = ("sphere", "capsule", "cylinder", "box", "mesh", "plane")


def _read_mjcf(path: Path, root: ElementTree.Element) -> Source:
    _check_sizes(path, root)
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
    couplings = read_couplings(model, mujoco)
    if problems := [*_unsupported(model, mujoco), *couplings.problems]:
        raise RobotError(
            f"{path} uses what xreset does not have:" + "".join(f"\n  - {problem}" for problem in problems)
        )
    for quats in (model.body_quat, model.body_iquat, model.geom_quat):
        if not np.allclose(np.linalg.norm(quats, axis=1), 1, atol=1e-3):
            raise RobotError(f"{path} has an orientation that is not finite.")
    return _MjcfReader(path, model, mujoco, couplings).source()


def _check_sizes(path: Path, root: ElementTree.Element) -> None:
    """Raise ``RobotError`` for a small file that takes much memory when MuJoCo reads it."""

    def product(element: ElementTree.Element, names: Iterable[str]) -> float:
        try:
            return math.prod(float(element.get(name, 1)) for name in names)
        except ValueError:
            return 1.0  # MuJoCo says what is wrong

    for tag, names in _LARGEST.items():
        for element in root.iter(tag):
            if product(element, names) > _ENTRIES:
                raise RobotError(f"{path}: a {tag} has {product(element, names):.3g} entries, which is too many.")
    copies = math.prod(product(element, ["count"]) for element in root.iter("replicate"))
    if copies > _COPIES:
        raise RobotError(f"{path} replicates up to {copies:.3g} times, which is too often.")


class _MjcfReader:
    """Turns a model of MuJoCo into links and joints.

    A joint may be away from its body's origin. The link's frame is put onto the joint, ``shift`` from the origin.
    """

    def __init__(self, path: Path, model: Any, mujoco: Any, couplings: Couplings) -> None:
        self.path = path
        self.model = model
        self.mujoco = mujoco
        self.couplings = couplings
        self.names = [model.body(i).name or f"body{i}" for i in range(model.nbody)]
        self.shift = np.zeros((model.nbody, 3))
        self.notes = [*couplings.notes]
        self.links: dict[str, Link] = {}
        self.joints: list[Joint] = []
        self.joint_names: dict[int, str] = {}

    def source(self) -> Source:
        tops = [i for i in range(1, self.model.nbody) if self.model.body_parentid[i] == 0]
        if len(tops) != 1:
            found = ", ".join(self.names[i] for i in tops) or "none"
            raise RobotError(f"{self.path}: expected one body in the world, found {found}.")
        for body in range(1, self.model.nbody):
            self._add_body(body, is_root=body == tops[0])
        root = self.names[tops[0]]
        order = [root, *(joint.child for joint in self.joints)]
        tree = RobotTree(
            name=self.path.stem,
            root=root,
            links=tuple(self.links[name] for name in order),
            joints=tuple(self.joints),
        )
        mimics = []
        for line in self.couplings.lines:
            joint = self.joint_names[line.joint]
            driver = self.joint_names[line.source]
            mimics.append(MimicSpec(joint=joint, source=driver, multiplier=line.multiplier, offset=line.offset))
        drives, efforts = self._drives()
        return Source(tree=tree, mimics=tuple(mimics), effort=efforts, drives=drives, notes=tuple(self.notes))

    def _add_body(self, number: int, is_root: bool) -> None:
        body = self.model.body(number)
        name = self.names[number]
        first = int(body.jntadr[0])
        joints = [self.model.joint(first + i) for i in range(int(body.jntnum[0]))]
        moving = [joint for joint in joints if int(joint.type[0]) != int(self.mujoco.mjtJoint.mjJNT_FREE)]
        if len(joints) > len(moving):
            self.notes.append(f"the free joint of {name!r} is left out")
        if is_root and moving:
            raise RobotError(f"{self.path}: the first body {name!r} has joints; put it into a body that does not move.")
        if moving:
            self.shift[number] = moving[0].pos
        if any(np.abs(joint.pos - self.shift[number]).max() > 1e-9 for joint in moving):
            raise RobotError(f"{self.path}: the joints of body {name!r} do not meet in one point.")
        R = _matrix(body.iquat)
        self.links[name] = Link(
            name=name,
            mass=float(body.mass[0]),
            com=body.ipos - self.shift[number],
            inertia=R @ np.diag(body.inertia) @ R.T,
            collisions=tuple(self._shapes(number)),
        )
        if is_root:
            return
        parent = int(body.parentid[0])
        T = np.eye(4)
        T[:3, :3] = _matrix(body.quat)
        T[:3, 3] = body.pos + T[:3, :3] @ self.shift[number] - self.shift[parent]
        above = self.names[parent]
        if not moving:
            self.joints.append(fixed(above, name, T))
        for i, joint in enumerate(moving):
            child = name
            if i < len(moving) - 1:  # a link without mass between two joints of one body
                child = f"{name}_axis{i}"
                nothing = np.zeros((3, 3))
                self.links[child] = Link(name=child, mass=0.0, com=np.zeros(3), inertia=nothing, collisions=())
            self.joints.append(self._joint(joint, above, child, T))
            above = child
            T = np.eye(4)

    def _joint(self, joint: Any, parent: str, child: str, T: np.ndarray) -> Joint:
        name = joint.name or f"joint{joint.id}"
        self.joint_names[joint.id] = name
        is_slide = int(joint.type[0]) == int(self.mujoco.mjtJoint.mjJNT_SLIDE)
        axis = joint.axis / np.linalg.norm(joint.axis)
        moved = self.couplings.held.get(joint.id, 0.0) - float(self.model.qpos0[joint.qposadr[0]])
        if moved:  # the file's poses are those at qpos0
            if is_slide:
                step = pose(moved * axis)
            else:
                step = pose(quat=Rotation.from_rotvec(moved * axis).as_quat(scalar_first=True))
            T = T @ step
        if joint.id in self.couplings.held:
            return replace(fixed(parent, child, T), name=name)
        lower = -math.inf
        upper = math.inf
        if self.model.jnt_limited[joint.id]:
            lower, upper = map(float, joint.range)
        return Joint(
            name=name,
            type="prismatic" if is_slide else "revolute",
            parent=parent,
            child=child,
            T_parent_joint=T,
            axis=axis,
            lower=lower,
            upper=upper,
            velocity=math.inf,
        )

    def _drives(self) -> tuple[dict[str, DriveSpec], dict[str, float]]:
        """Return position drives and efforts of the joints that have actuators. What drives coupled joints is the
        drive of the joint that they follow."""
        model = self.model
        drives = {}
        efforts = {}
        for i in range(model.nu):
            target = int(model.actuator_trnid[i, 0])
            gear = float(model.actuator_gear[i, 0])
            kind = int(model.actuator_trntype[i])
            if kind == int(self.mujoco.mjtTrn.mjTRN_TENDON):
                parts = tendon_joints(model, self.mujoco, target)
            elif kind in (int(self.mujoco.mjtTrn.mjTRN_JOINT), int(self.mujoco.mjtTrn.mjTRN_JOINTINPARENT)):
                parts = ([target], [1.0])
            else:
                continue
            assert parts is not None, "a tendon through space was refused"
            joint, lever = self.couplings.lever(*parts)
            lever = abs(lever * gear)
            name = self.joint_names[joint]
            gain = float(model.actuator_gainprm[i, 0])
            _, kp, kd = map(float, -model.actuator_biasprm[i, :3])
            limit = 0.0
            if model.actuator_forcelimited[i]:
                limit = lever * float(model.actuator_forcerange[i, 1])
            elif kp == 0 and model.actuator_ctrllimited[i]:  # a motor: its control is a force
                limit = abs(gain) * lever * float(model.actuator_ctrlrange[i, 1])
            if limit <= 0 and model.jnt_actfrclimited[joint]:
                limit = float(model.jnt_actfrcrange[joint, 1])
            if limit > 0:
                efforts[name] = limit
            if gain > 0 and kp > 0 and lever > 0:
                dof = int(model.jnt_dofadr[joint])
                kd = kd * lever**2 + float(model.dof_damping[dof])
                armature = float(model.dof_armature[dof])
                drives[name] = DriveSpec(kp=kp * lever**2, kd=kd, effort=max(limit, 0.0), armature=armature)
        return drives, efforts

    def _shapes(self, number: int) -> Iterable[Shape]:
        """Return the collision shapes of a body."""
        body = self.model.body(number)
        first = int(body.geomadr[0])
        for geom in (self.model.geom(first + i) for i in range(int(body.geomnum[0]))):
            kind = _kind(self.mujoco, geom)
            if not _is_solid(geom) or kind == "plane":
                continue
            T = np.eye(4)
            T[:3, :3] = _matrix(geom.quat)
            T[:3, 3] = geom.pos - self.shift[number]
            count = {"box": 3, "sphere": 1}.get(kind, 2)
            geometry = Geometry(kind=kind, size=tuple(map(float, geom.size[:count])))  # pyright: ignore[reportArgumentType]
            if kind == "mesh":
                mesh = self.model.mesh(int(geom.dataid[0]))
                begin = int(mesh.vertadr[0])
                vertices = self.model.mesh_vert[begin : begin + int(mesh.vertnum[0])].astype(float)
                try:
                    geometry = hull(vertices, HULL_TOLERANCE).geometry
                except ObjectError as error:
                    raise RobotError(f"the mesh {mesh.name!r} of body {body.name!r}: {error}") from error
            yield Shape(geometry=geometry, T_body_shape=T)


def _kind(mujoco: Any, geom: Any) -> str:
    return mujoco.mjtGeom(int(geom.type[0])).name.removeprefix("mjGEOM_").lower()


def _is_solid(geom: Any) -> bool:
    return bool(geom.contype[0] or geom.conaffinity[0])


def _unsupported(model: Any, mujoco: Any) -> list[str]:
    """Return every feature of a model that a robot of xreset cannot have."""
    problems = []
    for joint in map(model.joint, range(model.njnt)):
        if int(joint.type[0]) == int(mujoco.mjtJoint.mjJNT_BALL):
            problems.append(f"the ball joint {joint.name!r}. Replace it by three hinges of the same body")
    for geom in map(model.geom, range(model.ngeom)):
        kind = _kind(mujoco, geom)
        if _is_solid(geom) and kind not in _SOLIDS:
            body = model.body(int(geom.bodyid[0])).name
            problems.append(
                f"the {kind} {geom.name or geom.id!r} of body {body!r}. Replace it by a capsule, box or mesh"
            )
    if model.nflex:
        problems.append("flexible bodies. Leave them out, or make them rigid")
    return problems


def _matrix(quat: np.ndarray) -> np.ndarray:
    return Rotation.from_quat(quat, scalar_first=True).as_matrix()
