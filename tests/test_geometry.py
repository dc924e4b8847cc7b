"""Surfaces, convex shapes, and the distances of a robot from itself and the table."""

from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from torch.testing import assert_close

from tests import toy_grasp
from tests.toy_retarget import UPRIGHT, box_object, double
from xreset import robots
from xreset.geometry.balls import BARE, SPACING, inscribed_balls, link_balls, sharp_points
from xreset.geometry.collision import (
    SelfCollision,
    bounding_ball,
    height_above_table,
    object_depth,
)
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_to_matrix
from xreset.geometry.shapes import box, half_spaces, hull, shape_mesh
from xreset.geometry.solids import link_field, signed_distance
from xreset.geometry.surface import Surface
from xreset.retarget.hand.clearance import Objects, too_near
from xreset.retarget.hand.model import HandModel, HandState
from xreset.spec import Geometry, Shape, TableSpec


def distances(field, points):
    """[n] signed distances of points [n, 3] from the only object of a field."""
    which = torch.zeros(len(points), dtype=torch.long)
    return field.signed_distance(torch.as_tensor(points), which)[0].numpy()


class SurfaceTest(TestCase):
    @classmethod
    def setUpClass(cls):
        size = (0.06, 0.08, 0.10)
        cls.surface = Surface(box_object(((0, 0, 0), size)))
        cls.points = default_rng(0).uniform(-0.065, 0.065, (500, 3))
        cls.exact = signed_distance(box((0, 0, 0), size), cls.points)

    def test_signed_distance_of_a_box(self):
        distance = distances(self.surface.field, self.points)
        near = self.exact < 0.01
        # The field is off by half a cell where it has an edge.
        assert_allclose(distance[near], self.exact[near], atol=2.1e-3)
        assert_allclose(distance, self.exact, atol=4e-3)
        self.assertLess(np.abs(distance - self.exact).mean(), 4e-4)

    def test_signed_distance_beyond_the_grid(self):
        far = 5 * self.points
        distance = distances(self.surface.field, far)
        assert_allclose(self.surface.signed_distance(far), distance, atol=1e-5)
        which = torch.zeros(len(far), dtype=torch.long)
        _, found = self.surface.field.signed_distance(torch.as_tensor(far), which)
        for axis, step in enumerate(1e-7 * np.eye(3)):
            slope = (distances(self.surface.field, far + step) - distance) / 1e-7
            assert_allclose(found[:, axis], slope, atol=1e-4)

    def test_the_grid_of_a_large_object_is_coarse(self):
        size = (0.6, 0.8, 1.0)
        with patch("xreset.geometry.surface._MOST_CELLS", 3e4):
            large = Surface(box_object(((0, 0, 0), size))).field
        self.assertLess(len(large.values), 4e4)
        both = DistanceFields.join([self.surface.field, large])
        points = np.concatenate((self.points, 10 * self.points))
        which = torch.arange(2).repeat_interleave(500)
        found, slope = both.signed_distance(torch.as_tensor(points), which)
        assert_array_equal(found[:500], distances(self.surface.field, self.points))
        exact = signed_distance(box((0, 0, 0), size), points[500:])
        near = exact < 0.03
        assert_allclose(found[500:][near], exact[near], atol=large.spacing.item() / 2)
        self.assertAlmostEqual(slope[500:].norm(dim=-1).median().item(), 1.0, places=3)

    def test_nearest_point_is_exact(self):
        nearest, distance = self.surface.nearest(self.points)
        assert_allclose(distance, np.abs(self.exact), atol=1e-9)
        assert_allclose(np.linalg.norm(nearest - self.points, axis=1), distance, atol=1e-12)

    def test_faces_inside_the_solid_do_not_count(self):
        two = Surface(
            box_object(((-0.02, 0, 0), (0.08, 0.06, 0.06)), ((0.02, 0, 0), (0.08, 0.06, 0.06)))
        )
        (distance,) = distances(two.field, np.zeros((1, 3)))
        # To the outer faces, not to the ends of the boxes at x = +-0.02.
        self.assertAlmostEqual(distance, -0.03, delta=2.1e-3)

    def test_contacts_need_annotation_and_nearness(self):
        quat = np.array([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])  # x of the object is y of the world
        at = [(1.0, y, 3.0) for y in (2.045, 1.955, 2.060)]
        keypoints = np.array([[*at, [np.nan] * 3]])
        points, contact = self.surface.contacts(keypoints, np.array([[1.0, 2.0, 3.0]]), quat, 0.02)
        self.assertEqual(contact.tolist(), [[True, True, False, False]])
        assert_allclose(points[0, :2], [[1.0, 2.03, 3.0], [1.0, 1.97, 3.0]], atol=1e-9)
        assert_array_equal(points[0, 2:], 0.0)


class ShapesTest(TestCase):
    BOX = Geometry(kind="box", size=(0.02, 0.03, 0.01))
    SPHERE = Geometry(kind="sphere", size=(0.02,))
    CAPSULE = Geometry(kind="capsule", size=(0.01, 0.03))
    LONG = Geometry(kind="cylinder", size=(0.01, 0.03))
    FLAT = Geometry(kind="cylinder", size=(0.03, 0.01))
    PRIMITIVES = (BOX, SPHERE, CAPSULE, LONG, FLAT)

    def test_inscribed_balls_are_inside(self):
        for geometry in self.PRIMITIVES:
            with self.subTest(kind=geometry.kind):
                centers, radius = inscribed_balls(geometry)
                depth = -signed_distance(Shape(geometry=geometry), centers)
                self.assertGreaterEqual(depth.min(), radius - 1e-9)

    def test_sharp_points_are_on_edges(self):
        points = sharp_points(self.BOX, 0.01)
        at_side = np.isclose(np.abs(points), self.BOX.size).sum(axis=1)
        self.assertEqual(np.unique(at_side, return_counts=True)[1][-1], 8)
        self.assertEqual(at_side.min(), 2)

    def test_balls_cover_the_surface_of_a_thick_shape(self):
        """Without balls under its surface the OpenArm's gripper was 7 mm deep between its balls, and bananas sank
        in."""
        for shape in (
            box((0, 0, 0), (0.05, 0.14, 0.04)),
            hull(trimesh.creation.cone(0.04, 0.08).vertices),
        ):
            centers, radii = link_balls([shape])
            surface = trimesh.sample.sample_surface(shape_mesh(shape), 4000, seed=0)[0]
            bare = (np.linalg.norm(surface[:, None] - centers, axis=-1) - radii).min(axis=1)
            self.assertLess(np.quantile(bare, 0.98), BARE + SPACING / 2)
            planes = half_spaces(shape)
            outside = (centers @ planes[:, :3].T + planes[:, 3]).max(axis=1) + radii
            self.assertLess(outside[radii < radii.max()].max(), 1e-3)
        self.assertTrue((link_balls([Shape(geometry=self.CAPSULE)])[1] == 0.01).all())

    def test_near_points_of_several_solids_are_found(self):
        sizes = ((0.06, 0.04, 0.02), (0.02, 0.02, 0.1))
        fields = DistanceFields.join([link_field([box((0, 0, 0), size)]) for size in sizes])
        rng = default_rng(0)
        points = torch.as_tensor(rng.uniform(-0.06, 0.06, (5000, 3)))
        limit = torch.as_tensor(rng.uniform(-0.01, 0.03, 5000))
        which = torch.as_tensor(rng.integers(2, size=5000))
        value, direction = fields.signed_distance(points, which)
        expected = (value < limit).nonzero()[:, 0]
        self.assertGreater(len(expected), 500)
        rows, near, slope = fields.nearer(points, which, limit)
        self.assertTrue(torch.equal(rows, expected))
        self.assertTrue(
            torch.equal(near, value[expected]) and torch.equal(slope, direction[expected])
        )

    def test_a_link_of_thin_walls_is_solid_for_other_links_and_no_thicker(self):
        # A tube, open at both ends.
        walls = [box((0, 0, z), (0.06, 0.04, 0.001)) for z in (-0.0095, 0.0095)]
        walls += [box((0, y, 0), (0.06, 0.001, 0.02)) for y in (-0.0195, 0.0195)]
        size = np.array((0.06, 0.04, 0.02))
        points = default_rng(0).uniform(-0.6 * size, 0.6 * size, (2000, 3))
        found = distances(link_field(walls), points)
        solid = signed_distance(box((0, 0, 0), size), points)
        middle = np.abs(points[:, 0]) < 0.015  # at its open ends a ball of a gap's size looks in
        assert_allclose(found[middle], solid[middle], atol=1e-3)
        self.assertGreater((found - solid).min(), -1e-3)
        apart = [box((0, 0, z), (0.06, 0.04, 0.001)) for z in (-0.0155, 0.0155)]
        self.assertGreater(distances(link_field(apart), np.zeros((1, 3)))[0], 0.01)

    def test_distances_to_every_kind_of_shape(self):
        points = default_rng(0).uniform(-0.07, 0.07, (300, 3))
        turn = trimesh.transformations.euler_matrix(0.3, -0.4, 0.5)
        for geometry in (
            *self.PRIMITIVES,
            hull(trimesh.creation.icosphere(1, 0.03).vertices).geometry,
        ):
            with self.subTest(kind=geometry.kind):
                shape = Shape(geometry=geometry, T_body_shape=turn)
                expected = -trimesh.proximity.signed_distance(shape_mesh(shape), points)
                assert_allclose(signed_distance(shape, points), expected, atol=5e-4)

    def test_a_ball_around_balls(self):
        center, radius = bounding_ball(np.diag((2.0, 0.0, 0.0)), np.array((1.0, 0.5, 0.5)))
        self.assertEqual((center.tolist(), radius), ([1, 0, 0], 2))

    def test_height_counts_only_above_the_table(self):
        table = TableSpec(center=(0.0, 0.0), half_size=(0.5, 0.5, 0.02))
        points = double([[0.0, 0.0, 0.03], [0.0, 0.6, -1.0]])
        heights = height_above_table(points, double([0.01, 0.01]), table)
        self.assertAlmostEqual(heights[0].item(), 0.02)
        self.assertEqual(heights[1], float("inf"))


class ObjectDepthTest(TestCase):
    """The gripper around its brick, whose jaws close into it, and another object."""

    robot = toy_grasp.robot()
    objects = (box_object(((0, 0, 0), (0.1, 0.1, 0.1))), toy_grasp.brick())

    def depth(self, names, joints, pos, quat):
        return object_depth(self.robot, self.objects, np.array(names), joints, pos, quat)

    def test_jaws_are_as_deep_as_they_close_wherever_the_object_is(self):
        joints = np.tile(self.robot.home, (4, 1))
        joints[2:, self.robot.joint_names.index("turn")] += 0.5
        poses = [toy_grasp.brick_pose(each) for each in joints]
        pos, quat = map(np.array, zip(*poses, strict=True))
        jaw = self.robot.joint_names.index("jaw_a_slide")
        joints[:, jaw] = toy_grasp.OPEN - np.array([0.0, 0.003, 0.001, 0.003])
        found = self.depth(["brick"] * 4, joints, pos, quat)
        # jaw_b, which goes 1.1 times as far, begins 0.11 mm from the brick
        assert_allclose(found, [0.0, 0.00319, 0.00099, 0.00319], atol=1e-6)

    def test_each_state_has_its_own_object_and_the_arm_counts(self):
        joints = np.tile(self.robot.home, (3, 1))
        kinematics = Kinematics(self.robot)
        arm = next(
            link
            for link in kinematics.link_names
            if kinematics.tree.link(link).collisions
            and link not in Kinematics(self.robot, root=self.robot.hand_root).link_names
        )
        shape = kinematics.tree.link(arm).collisions[0]
        at = (
            kinematics.link_poses(torch.as_tensor(joints), [arm])[0, 0].numpy() @ shape.T_body_shape
        )
        pos = np.array([at[:3, 3], at[:3, 3] + 3.0, at[:3, 3]])
        quat = np.tile([1.0, 0, 0, 0], (3, 1))
        name = self.objects[0].name
        found = self.depth([name, name, "brick"], joints, pos, quat)
        self.assertGreater(found[0], 0.05)
        self.assertEqual(found[1], 0.0)
        self.assertNotEqual(found[2], found[0])


class SelfCollisionTest(TestCase):
    """The UR7e with the Sharpa hand: at home, and with fingers that cross."""

    CROSSED = (("right_middle_MCP_AA", 0.3), ("right_ring_MCP_AA", -0.3))

    robot = robots.load("ur7e-sharpa")

    def home_and(self, *changes):
        """[2, J] joints at home, and with some changed."""
        joints = np.tile(self.robot.home, (2, 1))
        for name, value in changes:
            joints[1, self.robot.joint_names.index(name)] = value
        return joints

    def test_fingers_that_cross_are_found_and_neighbours_are_not(self):
        kinematics = Kinematics(self.robot)
        collision = SelfCollision(kinematics)
        self.assertNotIn(("right_index_MP", "right_index_DP"), collision.link_pairs)
        poses = kinematics.link_poses(
            torch.as_tensor(self.home_and(("right_index_MCP_AA", 0.35)))
        ).numpy()
        clearance = collision.clearance(poses)
        self.assertEqual(clearance[0], 0.0)
        self.assertLess(clearance[1], -0.002)
        near = collision.near(poses, 0.0)
        for configuration, a, b in near:
            self.assertEqual(configuration, 1)
            self.assertIn("right_index", a + b)

    def test_any_number_of_configurations_is_looked_at(self):
        kinematics = Kinematics(self.robot)
        collision = SelfCollision(kinematics)
        few = kinematics.link_poses(torch.as_tensor(self.home_and(("right_index_MCP_AA", 0.35))))
        many = few[[0] * 600 + [1]].numpy()
        expected = collision.clearance(few.numpy())
        assert_array_equal(collision.clearance(many), expected[[0] * 600 + [1]])

    def test_pairs_that_the_arm_moves_join_hand_and_arm(self):
        collision = SelfCollision(Kinematics(self.robot), moved_by_arm=True)
        self.assertIn(("forearm_link", "right_index_DP"), collision.link_pairs)
        # the wrist is fixed to the palm, which is excluded with the thumb
        pairs = SelfCollision(Kinematics(self.robot)).link_pairs
        self.assertNotIn(("right_hand_C_MC", "right_thumb_MC"), pairs)
        self.assertIn(("wrist_3_link", "right_thumb_MC"), pairs)
        self.assertNotIn(("right_index_DP", "right_middle_DP"), collision.link_pairs)

    def test_one_link_is_kept_out_of_another(self):
        model = HandModel(self.robot)
        joints = torch.as_tensor(self.home_and(*self.CROSSED)[:, self.robot.hand_indices])[
            [0, 1, 1]
        ]
        above = double([0.0, 0.0, 1.0]).expand(3, 3)
        quat = UPRIGHT.expand(3, 4)
        field = link_field([box((0, 0, 0), (0.1, 0.1, 0.1))])
        nothing = Objects(
            above + 10.0, quat_to_matrix(quat), torch.zeros(3, dtype=torch.long), field
        )

        def found(q):
            return too_near(
                model,
                model.bodies(HandState(q, above, quat)),
                nothing,
                torch.ones(3, dtype=torch.bool),
                0.0,
                0.0,
            )

        here = found(joints)
        self.assertEqual(sorted(set(here.frame.tolist())), [1, 2])
        self.assertLess(here.value.min(), -0.003)
        column = model.kinematics.joint_names.index("right_middle_MCP_AA")
        moved = joints.clone()
        moved[:, column] += 1e-5
        change = (found(moved).value - here.value) / 1e-5
        assert_close(change, here.slope[:, column], atol=2e-3, rtol=0.0)
