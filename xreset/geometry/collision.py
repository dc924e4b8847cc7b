"""How far a robot is from the table and from itself, and how deep it is in an object.

The table needs no collision library: the lowest point of a convex shape is one of a few support points, less a radius.
The others ask coal for signed distances, but only for pairs of shapes whose bounding spheres are near.

Shape letters: B configurations, L links, G shapes, H support points, M states, J joints, K pieces of an object.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import cache
from itertools import combinations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from xreset.errors import needs
from xreset.files.checks import frozen
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matvec, quat_to_matrix
from xreset.geometry.shapes import transformed
from xreset.physics.tensors import Tensors, one_thread
from xreset.spec import Geometry, ObjectSpec, RobotSpec, Shape, TableSpec

_RIM_POINTS = 16
"""Support points on each rim of a cylinder."""
_AT_ONCE = 512
"""Configurations that are looked at together; limits the memory that this takes."""


def support_points(shape: Shape) -> tuple[np.ndarray, float]:
    """Return points [H, 3] in the body's frame and a radius such that the shape is the convex hull of balls of that
    radius around the points.

    Exact for boxes, spheres, capsules and hulls; a cylinder's rims are regular polygons whose corners lie on the rim.
    """
    geometry = shape.geometry
    size = geometry.size
    radius = 0.0
    if geometry.kind == "box":
        points = np.array(np.meshgrid(*([-half, half] for half in size))).reshape(3, -1).T
    elif geometry.kind == "sphere":
        points = np.zeros((1, 3))
        radius = size[0]
    elif geometry.kind == "capsule":
        points = np.array([[0, 0, -size[1]], [0, 0, size[1]]])
        radius = size[0]
    elif geometry.kind == "cylinder":
        angle = np.arange(_RIM_POINTS) * (2 * np.pi / _RIM_POINTS)
        rim = np.stack((size[0] * np.cos(angle), size[0] * np.sin(angle)), axis=1)
        points = np.concatenate(
            [np.column_stack((rim, np.full(_RIM_POINTS, z))) for z in (-size[1], size[1])]
        )
    else:
        points = np.asarray(geometry.vertices, dtype=float)
    return transformed(points, shape.T_body_shape), radius


def bounding_ball(points: np.ndarray, radii: ArrayLike = 0.0) -> tuple[np.ndarray, float]:
    """Return center [3] and radius of a ball around balls at points [H, 3]; the center is that of the points' bounding
    box."""
    center = (points.max(axis=0) + points.min(axis=0)) / 2
    return center, float((np.linalg.norm(points - center, axis=1) + radii).max())


def table_points(kinematics: Kinematics) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the support points [H, 3] of every link of a robot that may not touch the table, in the link's frame, and
    the radii [H] of the balls around them."""
    found = {}
    for name in kinematics.link_names:
        shapes = kinematics.tree.link(name).collisions
        if shapes and name not in kinematics.robot.table_exclude:
            points, radii = zip(*map(support_points, shapes), strict=True)
            radii = np.repeat(radii, [len(own) for own in points])
            found[name] = np.concatenate(points), radii
    return found


def height_above_table(points: Tensor, radii: Tensor, table: TableSpec) -> Tensor:
    """[..., H] height of balls at points [..., H, 3] above the table's top; infinite for balls centered next to the
    table."""
    x, y, z = points.unbind(-1)
    off_x = (x - table.center[0]).abs() > table.half_size[0]
    off_y = (y - table.center[1]).abs() > table.half_size[1]
    return (z - radii).masked_fill(off_x | off_y, float("inf"))


def table_clearance(kinematics: Kinematics, q: Tensor, table: TableSpec) -> Tensor:
    """[B] lowest height of the robot's moving shapes above the table [m], at joint positions [B, J]; infinite if none
    is above it."""
    support = table_points(kinematics)
    if not support:
        return q.new_full((len(q),), float("inf"))
    points, radii = map(np.concatenate, zip(*support.values(), strict=True))
    links = np.repeat([*support], [len(own) for own, _ in support.values()])
    centers = kinematics.points(q, links.tolist(), q.new_tensor(points))
    return height_above_table(centers, q.new_tensor(radii), table).amin(dim=-1)


class _LinkShapes:
    """Collision shapes of a robot's links (length G), with balls around them."""

    def __init__(self, kinematics: Kinematics, links: Collection[str]) -> None:
        """Prepare the shapes of these links; ``XResetError`` if coal is not installed."""
        with needs("coal, which measures collisions,", "retarget"):
            import coal
        self.coal = coal
        self.link: list[str] = []
        """Link of each shape."""
        self.geometry = []
        local = []
        centers = []
        radii = []
        for name in kinematics.link_names:
            if name not in links:
                continue
            for shape in kinematics.tree.link(name).collisions:
                center, radius = bounding_ball(*support_points(shape))
                self.link.append(name)
                self.geometry.append(coal_geometry(coal, shape.geometry))
                local.append(shape.T_body_shape)
                centers.append(center)
                radii.append(radius)
        self.index = [kinematics.link_index(name) for name in self.link]
        """Links, as indices into the kinematics' links."""
        self.T_link_shape = np.array(local).reshape(-1, 4, 4)
        self.radius = np.array(radii)
        """[G] radius of the ball around each shape [m]."""
        self._center = np.array(centers).reshape(-1, 3)

    def centers(self, T: np.ndarray) -> np.ndarray:
        """[B, G, 3] centers of the balls, at poses [B, G, 4, 4] of the shapes' links."""
        return np.einsum("bgij,gj->bgi", T[..., :3, :3], self._center) + T[..., :3, 3]

    def placed(self, T: np.ndarray) -> Callable[[int, int], tuple]:
        """Return a function of configuration and shape that gives the shape as coal wants it; each is made once.

        Args:
            T: [B, G, 4, 4] poses of the shapes' links.
        """

        @cache
        def shape_of(configuration: int, shape: int) -> tuple:
            pose = T[configuration, shape] @ self.T_link_shape[shape]
            return self.geometry[shape], self.coal.Transform3s(pose[:3, :3], pose[:3, 3])

        return shape_of


class SelfCollision:
    """Distances between the shapes of a robot's links."""

    def __init__(
        self,
        kinematics: Kinematics,
        *,
        moved_by_arm: bool = False,
        only: Collection[str] | None = None,
    ) -> None:
        """Choose the pairs of links that count.

        Neighbors, excluded pairs and pairs that overlap at home (a matter of modeling) never count.

        Args:
            kinematics: kinematics of the whole robot, or of its hand.
            moved_by_arm: only pairs whose relative pose depends on an arm joint.
            only: only pairs among these links.

        Raises:
            XResetError: coal is not installed.
        """
        self._shapes = _LinkShapes(kinematics, kinematics.link_names if only is None else only)
        robot = kinematics.robot
        tree = kinematics.tree
        excluded = set(map(frozenset, robot.collision_exclude))
        counted = []
        for pair in combinations(dict.fromkeys(self._shapes.link), 2):
            if tree.may_meet(*pair) and frozenset(pair) not in excluded:
                counted.append(pair)
        if moved_by_arm:
            arm = [robot.joint_names[i] for i in robot.arm_indices]
            moved = [tree.below(tree.joint(name).child) for name in arm]

            def movers(link: str) -> list[bool]:
                return [link in links for links in moved]

            counted = [(a, b) for a, b in counted if movers(a) != movers(b)]
        self._measure_only(counted)
        home = kinematics.link_poses(kinematics.clamp(kinematics.home))
        overlapping = self.near(home[None].numpy(), 0.0)
        self.overlapping_at_home = [pair for pair in counted if (0, *pair) in overlapping]
        """Pairs of links that do not count because they overlap at home."""
        self._measure_only([pair for pair in counted if pair not in self.overlapping_at_home])

    def _measure_only(self, link_pairs: list[tuple[str, str]]) -> None:
        """Measure only these pairs of links from now on."""
        self.link_pairs = link_pairs
        """Pairs of links that count."""
        link = self._shapes.link
        counted = set(link_pairs)
        pairs = [
            (i, j) for i, j in combinations(range(len(link)), 2) if (link[i], link[j]) in counted
        ]
        self._pairs = np.array(pairs, dtype=np.int64).reshape(-1, 2)

    def near(self, link_poses: np.ndarray, margin: float) -> dict[tuple[int, str, str], float]:
        """Return the signed distance [m] of every pair of links nearer than ``margin``, by (configuration, link, link).

        Args:
            link_poses: [B, L, 4, 4] poses of all links of the kinematics.
            margin: distance [m]; negative where links overlap.
        """
        shapes = self._shapes
        distance_of, _ = _signed_distance(shapes.coal)
        first, second = self._pairs.T
        reach = shapes.radius[first] + shapes.radius[second] + margin
        found: dict[tuple[int, str, str], float] = {}
        for start in range(0, len(link_poses), _AT_ONCE):
            T = link_poses[start : start + _AT_ONCE, shapes.index]  # [B, G, 4, 4]
            centers = shapes.centers(T)
            gap = np.linalg.norm(centers[:, first] - centers[:, second], axis=-1)
            row, pair = np.nonzero(gap < reach)
            placed = shapes.placed(T)
            near = zip(row.tolist(), first[pair].tolist(), second[pair].tolist(), strict=True)
            for b, i, j in near:
                distance = distance_of(*placed(b, i), *placed(b, j))
                if distance < margin:
                    key = (start + b, shapes.link[i], shapes.link[j])
                    found[key] = min(distance, found.get(key, margin))
        return found

    def clearance(self, link_poses: np.ndarray) -> np.ndarray:
        """[B] smallest signed distance between two shapes, at most 0; poses as in :meth:`near`."""
        clearance = np.zeros(len(link_poses))
        for (configuration, _, _), distance in self.near(link_poses, 0.0).items():
            clearance[configuration] = min(clearance[configuration], distance)
        return clearance


@frozen
class Overlaps(Tensors):
    """Pairs of a robot's shape and a piece of an object that overlap (length A)."""

    state: Tensor
    """[A]"""
    shape: Tensor
    """[A] the robot's shape."""
    depth: Tensor
    """[A] shortest way by which one of them must move until they are apart [m]."""
    point: Tensor
    """[A, 3] the robot's deepest point, in the world."""
    outward: Tensor
    """[A, 3] direction of the shape's way out, in the world."""

    def deepest(self, states: int) -> Tensor:
        """[M] largest depth of each of M states [m], 0 where nothing overlaps."""
        return self.depth.new_zeros(states).scatter_reduce(0, self.state, self.depth, "amax")


class ObjectCollision:
    """Overlaps of a robot's shapes with the pieces of objects."""

    def __init__(self, kinematics: Kinematics, objects: Sequence[ObjectSpec]) -> None:
        """Prepare the shapes.

        Raises:
            XResetError: coal is not installed.
        """
        self._shapes = _LinkShapes(kinematics, kinematics.link_names)
        self.links = tuple(self._shapes.link)
        """Link of each of the robot's shapes (length G)."""
        self._pieces = [_Pieces(self._shapes.coal, obj.pieces) for obj in objects]

    def overlaps(
        self, link_poses: Tensor, object_index: Tensor, object_pos: Tensor, object_rot: Tensor
    ) -> Overlaps:
        """Find all overlaps in states; the memory that this takes grows with their number.

        Args:
            link_poses: [M, G, 4, 4] poses of the shapes' links.
            object_index: [M] index of the object of each state.
            object_pos: [M, 3]
            object_rot: [M, 3, 3]
        """
        T = link_poses.clone()
        T[..., :3, 3] -= object_pos[:, None]
        T[..., :3, :] = object_rot.mT[:, None] @ T[..., :3, :]
        in_object = T.numpy()
        found = []
        for index in object_index.unique().tolist():
            states = (object_index == index).nonzero()[:, 0].numpy()
            found += _overlaps(self._shapes, self._pieces[index], in_object[states], states)
        state, shape, *rest = np.array(found).reshape(-1, 9).T
        depth, *vectors = torch.as_tensor(np.array(rest))
        point, outward = torch.stack(vectors, dim=-1).split(3, dim=-1)
        row = torch.as_tensor(state).long()
        return Overlaps(
            state=row,
            shape=torch.as_tensor(shape).long(),
            depth=depth,
            point=matvec(object_rot[row], point) + object_pos[row],
            outward=matvec(object_rot[row], outward),
        )


@one_thread()
def object_depth(
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    object_name: np.ndarray,
    joint_pos: np.ndarray,
    object_pos: np.ndarray,
    object_quat: np.ndarray,
) -> np.ndarray:
    """Measure how deep a robot is in the objects of states.

    The depth of two convex shapes is the shortest way by which one of them must move until they are apart, as physics
    engines measure it. Of all pairs of a link's shape and a piece of the object, the largest depth counts.

    Args:
        robot: the robot; its arm counts as well.
        objects: geometry of the states' objects.
        object_name: [M] object of each state.
        joint_pos: [M, J]
        object_pos: [M, 3]
        object_quat: [M, 4]

    Returns:
        [M] depth [m], 0 where they are apart.

    Raises:
        XResetError: coal is not installed.
    """
    kinematics = Kinematics(robot)
    collision = ObjectCollision(kinematics, objects)
    names = [obj.name for obj in objects]
    index = torch.tensor([names.index(name) for name in object_name.tolist()], dtype=torch.long)
    pos = torch.as_tensor(object_pos, dtype=torch.float64)
    rot = quat_to_matrix(torch.as_tensor(object_quat, dtype=torch.float64))
    joints = torch.as_tensor(joint_pos, dtype=torch.float64)
    parts = []
    for rows in torch.arange(len(joints)).split(_AT_ONCE):
        poses = kinematics.link_poses(joints[rows], collision.links)
        found = collision.overlaps(poses, index[rows], pos[rows], rot[rows])
        parts.append(found.deepest(len(rows)).numpy())
    return np.concatenate([np.zeros(0), *parts])


class _Pieces:
    """Pieces of an object (length K), with boxes around them."""

    def __init__(self, coal, pieces: Sequence[Shape]) -> None:
        self.placed = []
        """coal's geometry and pose of each piece."""
        boxes = []
        for piece in pieces:
            geometry = coal_geometry(coal, piece.geometry)
            geometry.computeLocalAABB()
            T = piece.T_body_shape
            self.placed.append((geometry, coal.Transform3s(T[:3, :3], T[:3, 3])))
            boxes.append((geometry.aabb_local.min_, geometry.aabb_local.max_))
        T = np.array([piece.T_body_shape for piece in pieces])
        self._T_piece_object = np.linalg.inv(T)
        self._low, self._high = np.array(boxes).swapaxes(0, 1)
        half = np.abs(T[:, :3, :3]) @ ((self._high - self._low) / 2)[..., None]
        middle = T[:, :3, :3] @ ((self._high + self._low) / 2)[..., None] + T[:, :3, 3:]
        self._bounds = (middle - half)[..., 0].min(axis=0), (middle + half)[..., 0].max(axis=0)

    def near(self, points: np.ndarray, distance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Find the boxes that are nearer to points [A, 3] in the object's frame than distances [A]: the indices of
        points, ascending, and of pieces."""
        gap = np.linalg.norm(points - points.clip(*self._bounds), axis=-1)
        rows = np.flatnonzero(gap < distance)
        T = self._T_piece_object
        local = points[rows] @ T[:, :3, :3].swapaxes(1, 2) + T[:, None, :3, 3]  # [K, rows, 3]
        beyond = local - local.clip(self._low[:, None], self._high[:, None])
        gap = np.linalg.norm(beyond, axis=-1).T
        row, piece = np.nonzero(gap < distance[rows, None])
        return rows[row], piece


def _overlaps(
    shapes: _LinkShapes, pieces: _Pieces, T: np.ndarray, states: np.ndarray
) -> Iterator[tuple[float, ...]]:
    """Yield state, shape, depth, the shape's deepest point and the direction of its way out, of each pair of a link's
    shape and a piece that overlap.

    Args:
        shapes: the robot's shapes.
        pieces: the object's pieces.
        T: [B, G, 4, 4] poses of the shapes' links in the object's frame.
        states: [B] number of each state.
    """
    distance_of, result = _signed_distance(shapes.coal)
    near, piece = pieces.near(shapes.centers(T).reshape(-1, 3), np.tile(shapes.radius, len(T)))
    placed = shapes.placed(T)
    rows, own = np.divmod(near, T.shape[1])
    for row, shape, other in zip(rows.tolist(), own.tolist(), piece.tolist(), strict=True):
        distance = distance_of(*placed(row, shape), *pieces.placed[other])
        if distance < 0:
            # coal's normal points from the first shape to the second
            outward = -result.normal
            yield int(states[row]), shape, -distance, *result.getNearestPoint1(), *outward


def _signed_distance(coal) -> tuple:
    """Return a function of two placed shapes that computes their signed distance [m], and where it leaves the nearest
    points."""
    request = coal.DistanceRequest()
    request.enable_signed_distance = True
    result = coal.DistanceResult()

    def distance_of(*placed) -> float:
        result.clear()
        return coal.distance(*placed, request, result)

    return distance_of, result


def coal_geometry(coal, geometry: Geometry):
    """Convert a shape to coal's type; ``coal`` is the module."""
    size = geometry.size
    if geometry.kind == "box":
        return coal.Box(*(2 * half for half in size))
    if geometry.kind == "sphere":
        return coal.Sphere(size[0])
    if geometry.kind == "capsule":
        return coal.Capsule(size[0], 2 * size[1])
    if geometry.kind == "cylinder":
        return coal.Cylinder(size[0], 2 * size[1])
    assert geometry.vertices is not None and geometry.faces is not None
    points = coal.StdVec_Vec3s()
    points.extend([*np.asarray(geometry.vertices, dtype=float)])
    triangles = coal.StdVec_Triangle()
    triangles.extend([coal.Triangle(*face) for face in geometry.faces.tolist()])
    return coal.Convex(points, triangles)
