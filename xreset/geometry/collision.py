"""How far a robot is from the table and from itself.

The table needs no collision library: a convex shape's lowest point is one of a few support points, less a radius. Self-collision asks coal
(signed distance, nearest points), but only for the pairs of shapes whose bounding spheres are near.

Shape letters: B configurations, L links, G shapes, H support points.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from torch import Tensor

from xreset.errors import XResetError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.urdf import RobotTree
from xreset.spec import Geometry, RobotSpec, TableSpec

_RIM = 16
"""Support points on each rim of a cylinder."""
_POSES_PER_CHUNK = 4096


def support_points(geometry: Geometry) -> tuple[np.ndarray, float]:
    """Points [H, 3] and a radius such that the shape is the convex hull of balls of that radius around the points.

    Exact for boxes, spheres, capsules and hulls; a cylinder's rims are regular polygons whose corners lie on the rim.
    """
    if geometry.kind == "box":
        return np.array(np.meshgrid(*([-s, s] for s in geometry.size))).reshape(3, -1).T, 0.0
    if geometry.kind == "sphere":
        return np.zeros((1, 3)), geometry.size[0]
    if geometry.kind == "capsule":
        radius, half = geometry.size
        return np.array([[0, 0, -half], [0, 0, half]]), radius
    if geometry.kind == "cylinder":
        radius, half = geometry.size
        angle = np.arange(_RIM) * (2 * np.pi / _RIM)
        rim = np.stack((radius * np.cos(angle), radius * np.sin(angle)), axis=1)
        return np.concatenate([np.column_stack((rim, np.full(_RIM, z))) for z in (-half, half)]), 0.0
    assert geometry.vertices is not None
    return np.asarray(geometry.vertices, dtype=float), 0.0


@dataclass(frozen=True, kw_only=True)
class SupportPoints:
    """The support points of a robot's shapes."""

    links: tuple[str, ...]
    """Link of each point (length H)."""
    points: np.ndarray
    """[H, 3] in the link's frame."""
    radii: np.ndarray
    """[H] radius of the ball around each."""


def table_points(robot: RobotSpec, kinematics: Kinematics) -> SupportPoints:
    """The support points of every link that may not touch the table."""
    links: list[str] = []
    points: list[np.ndarray] = []
    radii: list[float] = []
    for name in kinematics.link_names:
        if name in robot.table_exclude:
            continue
        for shape in kinematics.tree.link(name).collisions:
            local, radius = support_points(shape.geometry)
            points.append(local @ shape.T_body_shape[:3, :3].T + shape.T_body_shape[:3, 3])
            links += [name] * len(local)
            radii += [radius] * len(local)
    return SupportPoints(
        links=tuple(links), points=np.concatenate(points) if points else np.zeros((0, 3)), radii=np.array(radii)
    )


def height_above_table(points: Tensor, radii: Tensor, table: TableSpec) -> Tensor:
    """[..., H] height of balls above the table's top; infinite for balls centred beside it. Points are [..., H, 3]."""
    beside = ((points[..., 0] - table.center[0]).abs() > table.half_size[0]) | (
        (points[..., 1] - table.center[1]).abs() > table.half_size[1]
    )
    return (points[..., 2] - radii).masked_fill(beside, float("inf"))


@dataclass(frozen=True, kw_only=True)
class Approaches:
    """Pairs of shapes that are near each other (length A)."""

    configuration: np.ndarray
    """[A] which configuration."""
    links: np.ndarray
    """[A, 2] indices of the two links in the kinematics' order."""
    distance: np.ndarray
    """[A] signed distance [m], negative where they overlap."""
    points: np.ndarray
    """[A, 2, 3] nearest points on either shape, world frame."""
    normal: np.ndarray
    """[A, 3] unit vector from the first shape to the second: moving the second along it parts them."""


class SelfCollision:
    """Distances between the shapes of a robot's links."""

    def __init__(
        self,
        robot: RobotSpec,
        kinematics: Kinematics,
        *,
        moved_by_arm: bool = False,
        only: Collection[str] | None = None,
    ) -> None:
        """Choose the pairs of links that count: never neighbours, excluded pairs, or pairs that overlap at home (a matter of modelling).

        Args:
            robot: the robot.
            kinematics: of the whole robot, or of its hand.
            moved_by_arm: only pairs whose relative pose depends on an arm joint.
            only: only pairs among these links.

        Raises:
            XResetError: coal is not installed.
        """
        try:
            import coal
        except ImportError as error:
            raise XResetError(
                f"self-collision needs coal, which cannot be imported ({error}). Run: pip install 'xreset[retarget]'"
            ) from error
        self._coal = coal
        tree = kinematics.tree
        self._link: list[int] = []
        self._geometry: list = []
        local, centers, radii = [], [], []
        for index, name in enumerate(kinematics.link_names):
            if only is not None and name not in only:
                continue
            for shape in tree.link(name).collisions:
                self._link.append(index)
                self._geometry.append(coal_geometry(coal, shape.geometry))
                points, radius = support_points(shape.geometry)
                centre = (points.max(axis=0) + points.min(axis=0)) / 2
                local.append(shape.T_body_shape)
                centers.append(shape.T_body_shape[:3, :3] @ centre + shape.T_body_shape[:3, 3])
                radii.append(radius + float(np.linalg.norm(points - centre, axis=1).max()))
        self._T_link_shape = np.array(local).reshape(-1, 4, 4)
        self._center, self._radius = np.array(centers).reshape(-1, 3), np.array(radii)

        names = kinematics.link_names
        linked = combinations(dict.fromkeys(self._link), 2)
        count = {(a, b) for a, b in linked if _may_collide(robot, tree, names[a], names[b], moved_by_arm)}
        pairs = [(i, j) for i, j in combinations(range(len(self._link)), 2) if (self._link[i], self._link[j]) in count]
        self._pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)
        home = kinematics.link_poses(
            kinematics.clamp(kinematics.lower.new_tensor(robot.home[kinematics.joint_indices]))
        )[None].numpy()
        overlapping = self.near(home, 0.0)
        never = {tuple(sorted(pair)) for pair in overlapping.links.tolist()}
        self.overlapping_at_home: tuple[tuple[str, str], ...] = tuple(
            (kinematics.link_names[int(i)], kinematics.link_names[int(j)]) for i, j in sorted(never)
        )
        """Pairs of links that were left out because they overlap at home."""
        keep = [tuple(sorted((self._link[i], self._link[j]))) not in never for i, j in self._pairs]
        self._pairs = self._pairs[np.array(keep, dtype=bool)]

    @property
    def link_pairs(self) -> list[tuple[int, int]]:
        """Pairs of links that count, as indices in the kinematics' order."""
        return list(dict.fromkeys((self._link[i], self._link[j]) for i, j in self._pairs))

    def near(self, link_poses: np.ndarray, margin: float) -> Approaches:
        """Every pair of shapes nearer than ``margin`` [m].

        Args:
            link_poses: [B, L, 4, 4] of all links of the kinematics, in its order.
            margin: [m]
        """
        coal = self._coal
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        request.enable_signed_distance = True
        rows: list[tuple[int, int, int, float]] = []
        points: list[tuple[np.ndarray, np.ndarray]] = []
        normals: list[np.ndarray] = []
        for begin in range(0, len(link_poses) if len(self._pairs) else 0, _POSES_PER_CHUNK):
            part = link_poses[begin : begin + _POSES_PER_CHUNK]
            T = part[:, self._link]  # [B, G, 4, 4]
            centers = np.einsum("bgij,gj->bgi", T[..., :3, :3], self._center) + T[..., :3, 3]
            first, second = self._pairs.T
            reach = self._radius[first] + self._radius[second] + margin
            gap = np.zeros((len(part), len(self._pairs)))
            for axis in range(3):  # one axis at a time, to keep the temporary arrays small
                gap += (centers[:, first, axis] - centers[:, second, axis]) ** 2
            for b, pair in np.argwhere(gap < reach**2):
                transforms = []
                for g in self._pairs[pair]:
                    pose = T[b, g] @ self._T_link_shape[g]
                    transforms.append(coal.Transform3s(pose[:3, :3], pose[:3, 3]))
                i, j = self._pairs[pair]
                result.clear()
                distance = coal.distance(
                    self._geometry[i], transforms[0], self._geometry[j], transforms[1], request, result
                )
                if distance < margin:
                    rows.append((begin + b, self._link[i], self._link[j], distance))
                    points.append((np.array(result.getNearestPoint1()), np.array(result.getNearestPoint2())))
                    normals.append(np.array(result.normal))
        table = np.array(rows).reshape(-1, 4)
        return Approaches(
            configuration=table[:, 0].astype(np.int64),
            links=table[:, 1:3].astype(np.int64),
            distance=table[:, 3],
            points=np.array(points).reshape(-1, 2, 3),
            normal=np.array(normals).reshape(-1, 3),
        )

    def clearance(self, link_poses: np.ndarray, margin: float) -> np.ndarray:
        """[B] smallest signed distance between two shapes, at most ``margin``."""
        near = self.near(link_poses, margin)
        clearance = np.full(len(link_poses), margin)
        np.minimum.at(clearance, near.configuration, near.distance)
        return clearance


def _may_collide(robot: RobotSpec, tree: RobotTree, a: str, b: str, moved_by_arm: bool) -> bool:
    """Whether a pair of links counts: see :class:`SelfCollision`."""
    parents = {joint.child: joint for joint in tree.joints}
    body_a, body_b = tree.moving_ancestor(a), tree.moving_ancestor(b)

    def parent_body(body: str) -> str | None:
        return tree.moving_ancestor(parents[body].parent) if body in parents else None

    if body_a == body_b or parent_body(body_a) == body_b or parent_body(body_b) == body_a:
        return False
    if any({tree.moving_ancestor(name) for name in pair} == {body_a, body_b} for pair in robot.collision_exclude):
        return False
    if not moved_by_arm:
        return True
    arm = {joint.name for joint in robot.joints if joint.group == "arm"}

    def arm_joints(link: str) -> set[str]:
        found = set()
        while link in parents:
            found |= {parents[link].name} & arm
            link = parents[link].parent
        return found

    return arm_joints(a) != arm_joints(b)


def coal_geometry(coal, geometry: Geometry):
    """A shape as coal knows it."""
    if geometry.kind == "box":
        return coal.Box(*(2 * s for s in geometry.size))
    if geometry.kind == "sphere":
        return coal.Sphere(geometry.size[0])
    if geometry.kind == "capsule":
        return coal.Capsule(geometry.size[0], 2 * geometry.size[1])
    if geometry.kind == "cylinder":
        return coal.Cylinder(geometry.size[0], 2 * geometry.size[1])
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    assert geometry.vertices is not None and geometry.faces is not None
    for vertex in geometry.vertices:
        points.append(np.asarray(vertex, dtype=float))
    for face in geometry.faces:
        triangles.append(coal.Triangle(*(int(i) for i in face)))
    return coal.Convex(points, triangles)
