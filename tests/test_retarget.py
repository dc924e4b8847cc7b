import contextlib
import dataclasses
import io
import json
import tempfile
import unittest
from pathlib import Path
from types import SimpleNamespace
from typing import ClassVar
from unittest import mock

import numpy as np
import torch

from tests.data import data_dir
from tests.test_cli import run
from tests.toy_robot import toy_hand_arm, toy_motion
from xreset import robots
from xreset.demos.archive import demo_objects, read_demos, write_demos
from xreset.demos.synth import synthesize
from xreset.errors import DemoError, FileFormatError, RobotError
from xreset.geometry.balls import BARE, SPACING, inscribed_balls, shape_balls, sharp_points
from xreset.geometry.collision import SelfCollision, height_above_table, support_points, table_points
from xreset.geometry.fields import DistanceFields
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_angle, quat_from_axis_angle, quat_multiply, quat_rotate, quat_to_matrix
from xreset.geometry.shapes import box, half_spaces, hull, shape_mesh, surface_of
from xreset.geometry.solids import link_field, signed_distance
from xreset.geometry.surface import Surface, keypoint_contacts
from xreset.retarget.arm import cost as arm_cost
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import track
from xreset.retarget.collisions import colliding_links
from xreset.retarget.file import Retargeted, read_retargeted, write_retargeted
from xreset.retarget.hand.clearance import Distances, Objects, too_near
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.model import HandModel, HandState, HandTargets, keypoint_pairs
from xreset.retarget.hand.solve import retarget_hand
from xreset.retarget.least_squares import solve_chain
from xreset.retarget.pipeline import RetargetConfig, rest_on_table, retarget_demos
from xreset.retarget.validity import REASONS, Measures, Thresholds, classify
from xreset.spec import KEYPOINTS, Geometry, ObjectSpec, Shape, TableSpec

FLOAT = torch.float64


def box_object(*boxes: tuple[tuple[float, float, float], tuple[float, float, float]]) -> ObjectSpec:
    """An object made of boxes (centre, size)."""
    pieces = tuple(box(center, size) for center, size in boxes)
    vertices, faces = surface_of(pieces)
    return ObjectSpec(
        name="block", pieces=pieces, mass=1.0, com=np.zeros(3), inertia=np.eye(3), vertices=vertices, faces=faces
    )


FAR_OBJECT = Surface(box_object(((0, 0, 0), (0.1, 0.1, 0.1))))


class ChainTest(unittest.TestCase):
    def test_agrees_with_the_dense_solution(self):
        generator = torch.Generator().manual_seed(0)
        S, T, n = 2, 5, 3
        A = torch.randn(S, T, n, n, dtype=FLOAT, generator=generator)
        diagonal = A @ A.mT + 6.0 * torch.eye(n, dtype=FLOAT)
        coupling = torch.randn(S, T - 1, n, dtype=FLOAT, generator=generator)
        rhs = torch.randn(S, T, n, dtype=FLOAT, generator=generator)
        dense = torch.zeros(S, T * n, T * n, dtype=FLOAT)
        for t in range(T):
            dense[:, t * n : (t + 1) * n, t * n : (t + 1) * n] = diagonal[:, t]
            if t:
                link = torch.diag_embed(coupling[:, t - 1])
                dense[:, t * n : (t + 1) * n, (t - 1) * n : t * n] = link
                dense[:, (t - 1) * n : t * n, t * n : (t + 1) * n] = link
        expected = torch.linalg.solve(dense, rhs.reshape(S, -1)).view(S, T, n)
        torch.testing.assert_close(solve_chain(diagonal, coupling, rhs), expected, atol=1e-10, rtol=0)


class SurfaceTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.size = np.array([0.06, 0.08, 0.10])
        cls.surface = Surface(box_object(((0, 0, 0), tuple(cls.size))))
        cls.points = np.random.default_rng(0).uniform(-0.065, 0.065, (500, 3))
        outside = np.abs(cls.points) - cls.size / 2
        cls.exact = np.linalg.norm(np.maximum(outside, 0), axis=1) + np.minimum(outside.max(axis=1), 0)

    def test_signed_distance_of_a_box(self):
        distance, _ = self.surface.signed_distance(torch.as_tensor(self.points))
        near = self.exact < 0.01
        np.testing.assert_allclose(
            distance[near], self.exact[near], atol=2.1e-3
        )  # half a cell where the field has an edge
        np.testing.assert_allclose(distance, self.exact, atol=4e-3)
        self.assertLess(np.abs(distance.numpy() - self.exact).mean(), 4e-4)

    def test_gradient_is_the_derivative_of_the_interpolation(self):
        points = torch.as_tensor(self.points)
        _, gradient = self.surface.signed_distance(points)
        step = 1e-8
        for axis in range(3):
            shift = step * torch.eye(3, dtype=FLOAT)[axis]
            slope = (
                self.surface.signed_distance(points + shift)[0] - self.surface.signed_distance(points - shift)[0]
            ) / (2 * step)
            self.assertGreater((torch.isclose(slope, gradient[:, axis], atol=1e-5)).double().mean().item(), 0.99)

    def test_nearest_point_is_exact(self):
        nearest, distance = self.surface.nearest(self.points)
        np.testing.assert_allclose(distance, np.abs(self.exact), atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(nearest - self.points, axis=1), distance, atol=1e-12)

    def test_faces_inside_the_solid_do_not_count(self):
        two = Surface(box_object(((-0.02, 0, 0), (0.08, 0.06, 0.06)), ((0.02, 0, 0), (0.08, 0.06, 0.06))))
        distance, _ = two.signed_distance(torch.zeros(1, 3, dtype=FLOAT))
        self.assertAlmostEqual(
            distance.item(), -0.03, delta=2.1e-3
        )  # to the outer faces, not to the ends of the boxes at x = +-0.02

    def test_contacts_need_annotation_and_nearness(self):
        quat = np.array([[np.sqrt(0.5), 0, 0, np.sqrt(0.5)]])  # x of the object is y of the world
        keypoints = np.array([[[1.0, 2.045, 3.0], [1.0, 2.060, 3.0], [np.nan] * 3]])
        points, contact = keypoint_contacts(self.surface, keypoints, np.array([[1.0, 2.0, 3.0]]), quat, 0.02)
        self.assertEqual(contact.tolist(), [[True, False, False]])
        np.testing.assert_allclose(points[0, 0], [1.0, 2.03, 3.0], atol=1e-9)
        np.testing.assert_array_equal(points[0, 1:], 0.0)


class CollisionTest(unittest.TestCase):
    SHAPES = (
        Geometry(kind="box", size=(0.02, 0.03, 0.01)),
        Geometry(kind="sphere", size=(0.02,)),
        Geometry(kind="capsule", size=(0.01, 0.03)),
        Geometry(kind="cylinder", size=(0.01, 0.03)),
        Geometry(kind="cylinder", size=(0.03, 0.01)),
        Geometry(kind="hull", vertices=np.array([[0, 0, 0], [0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05]])),
    )

    def test_support_points_span_the_shape(self):
        extents = (
            (0.02, 0.03, 0.01),
            (0.02, 0.02, 0.02),
            (0.01, 0.01, 0.04),
            (0.01, 0.01, 0.03),
            (0.03, 0.03, 0.01),
            (0.05, 0.05, 0.05),
        )
        for geometry, extent in zip(self.SHAPES, extents, strict=True):
            points, radius = support_points(geometry)
            np.testing.assert_allclose(points.max(axis=0) + radius, extent, atol=1e-9)

    def test_inscribed_balls_are_inside(self):
        from scipy.spatial import ConvexHull

        for geometry in self.SHAPES[:5]:
            with self.subTest(kind=geometry.kind):
                centers, radius = inscribed_balls(geometry)
                points, ball = support_points(geometry)
                if len(points) > 3:
                    planes = ConvexHull(points).equations
                    depth = -(centers @ planes[:, :3].T + planes[:, 3]).max(axis=1)
                    self.assertGreaterEqual(depth.min(), radius - ball - 3e-4)  # a rim is a polygon
                else:
                    np.testing.assert_allclose(np.abs(centers).max(axis=0), np.abs(points).max(axis=0))
                    self.assertEqual(radius, ball)

    def test_thin_shapes_take_no_more_balls_than_spacing_asks_for(self):
        thin = Geometry(kind="box", size=(0.04, 0.03, 0.0005))
        centers, radius = inscribed_balls(thin)
        self.assertEqual(radius, 0.0005)
        self.assertLessEqual(len(centers), 21 * 16)
        steps = np.diff(np.unique(centers[:, 0].round(9)))
        self.assertLessEqual(steps.max(), SPACING + 1e-9)

    def test_near_points_of_several_solids_are_those_that_looking_at_all_of_them_finds(self):
        fields = DistanceFields.join(
            [link_field([box((0, 0, 0), size)]) for size in ((0.06, 0.04, 0.02), (0.02, 0.02, 0.1))]
        )
        rng = np.random.default_rng(0)
        points, than = (
            torch.as_tensor(rng.uniform(-0.06, 0.06, (5000, 3))),
            torch.as_tensor(rng.uniform(-0.01, 0.03, 5000)),
        )
        which = torch.as_tensor(rng.integers(2, size=5000))
        value, slope = fields.signed_distance(points, which)
        near, distance, gradient = fields.nearer(points, which, than)
        expected = (value < than).nonzero()[:, 0]
        self.assertGreater(len(expected), 500)
        self.assertTrue(torch.equal(near, expected))
        self.assertTrue(torch.equal(distance, value[expected]))
        self.assertTrue(torch.equal(gradient, slope[expected]))

    def test_a_link_of_thin_walls_is_solid_for_other_links_and_no_thicker(self):
        walls = [box((0, 0, z), (0.06, 0.04, 0.001)) for z in (-0.0095, 0.0095)] + [
            box((0, y, 0), (0.06, 0.001, 0.02)) for y in (-0.0195, 0.0195)
        ]  # a tube, open at both ends
        field, half = link_field(walls), np.array((0.03, 0.02, 0.01))
        points = np.random.default_rng(0).uniform(-1.2 * half, 1.2 * half, (2000, 3))
        found, which = (
            field.signed_distance(torch.as_tensor(points), torch.zeros(len(points), dtype=torch.long))[0].numpy(),
            np.abs(points) - half,
        )
        solid = np.linalg.norm(np.maximum(which, 0), axis=1) + np.minimum(which.max(axis=1), 0)
        middle = np.abs(points[:, 0]) < 0.015  # at its open ends a ball of a gap's size looks in
        np.testing.assert_allclose(found[middle], solid[middle], atol=1e-3)
        self.assertGreater((found - solid).min(), -1e-3)

    def test_distances_to_every_kind_of_shape(self):
        import trimesh

        points = np.random.default_rng(0).uniform(-0.07, 0.07, (300, 3))
        turn = trimesh.transformations.euler_matrix(0.3, -0.4, 0.5)
        for geometry in (*self.SHAPES[:5], hull(trimesh.creation.icosphere(1, 0.03).vertices).geometry):
            with self.subTest(kind=geometry.kind):
                shape = Shape(geometry=geometry, T_body_shape=turn)
                expected = -trimesh.proximity.signed_distance(shape_mesh(shape), points)
                np.testing.assert_allclose(signed_distance(shape, points), expected, atol=5e-4)

    def test_one_link_is_kept_out_of_another_however_many_balls_are_looked_at_in_one_go(self):
        robot = robots.load("ur7e-sharpa")
        model = HandModel(robot)
        joints = torch.as_tensor(robot.home[robot.hand_indices])[None].repeat(3, 1)
        for name, value in {"right_middle_MCP_AA": 0.3, "right_ring_MCP_AA": -0.3}.items():
            joints[1:, model.kinematics.joint_names.index(name)] = value
        joints.requires_grad_()
        clear = torch.zeros(3, 3, dtype=FLOAT)
        clear[:, 2] = 1.0  # above the table
        nothing = Objects.at(
            clear + 10.0,
            torch.tensor([1.0, 0, 0, 0], dtype=FLOAT).expand(3, 4),
            torch.zeros(3, dtype=torch.long),
            link_field([box((0, 0, 0), (0.1, 0.1, 0.1))]),
        )

        def found(q):
            bodies = model.bodies(q, clear, torch.tensor([1.0, 0, 0, 0], dtype=FLOAT).expand(3, 4))
            return too_near(model, bodies, nothing, torch.ones(3, dtype=torch.bool), 0.0, 0.0)

        here = found(joints.detach())
        self.assertEqual(sorted(set(here.frame.tolist())), [1, 2])
        self.assertLess(float(here.value.min()), -0.003)
        with mock.patch.dict("xreset.geometry.balls._ROWS", {"cpu": 7}):
            pieces = found(joints.detach())
        self.assertTrue(torch.equal(here.value.sort().values, pieces.value.sort().values))
        step, column = 1e-5, model.kinematics.joint_names.index("right_middle_MCP_AA")
        moved = joints.detach().clone()
        moved[:, column] += step
        change = (found(moved).value - here.value) / step
        torch.testing.assert_close(change, here.slope[:, column], atol=2e-3, rtol=0.0)

    def test_self_collision_names_the_links(self):
        robot = robots.load("ur7e-sharpa")
        hand = SelfCollision(robot, Kinematics(robot, root=robot.hand_root), only=robot.self_collision_links)
        names = Kinematics(robot, root=robot.hand_root).link_names
        joints = np.tile(robot.home, (2, 1))
        crossed = {"right_middle_MCP_AA": 0.3, "right_ring_MCP_AA": -0.3}
        for name, value in crossed.items():
            joints[1, robot.joint_names.index(name)] = value
        result = SimpleNamespace(joint_pos=joints, reason=np.array([0, REASONS.index("self collision")]))
        found = colliding_links(result, robot)  # pyright: ignore[reportArgumentType]
        fingers = [pair for pair in found if all("middle" in a or "ring" in a for a in pair)]
        self.assertTrue(fingers, found)
        self.assertEqual(set(found.values()), {1})
        self.assertTrue(all((names.index(a), names.index(b)) in hand.link_pairs for a, b in fingers))
        self.assertEqual(colliding_links(SimpleNamespace(joint_pos=joints, reason=np.zeros(2)), robot), {})  # pyright: ignore[reportArgumentType]

    def test_sharp_points_lie_on_edges_and_round_shapes_have_none(self):
        size = np.array(self.SHAPES[0].size)
        points = sharp_points(self.SHAPES[0], 0.01)
        at_side = np.isclose(np.abs(points), size)
        self.assertTrue((at_side.sum(axis=1) >= 2).all())
        self.assertEqual((at_side.sum(axis=1) == 3).sum(), 8)
        lonely = np.linalg.norm(points[:, None] - points, axis=-1) + np.eye(len(points))
        self.assertLessEqual(lonely.min(axis=1).max(), 0.01 + 1e-12)
        self.assertEqual(len(sharp_points(self.SHAPES[1], 0.01)) + len(sharp_points(self.SHAPES[2], 0.01)), 0)

    def test_no_surface_of_a_thick_shape_lies_bare(self):
        """The OpenArm's gripper: 7 mm deep between its balls, before balls lay under its surface, and bananas sank in."""
        import trimesh

        for shape in (box((0, 0, 0), (0.05, 0.14, 0.04)), hull(trimesh.creation.cone(0.04, 0.08).vertices)):
            centers, radii = shape_balls(shape)
            surface = trimesh.sample.sample_surface(shape_mesh(shape), 4000, seed=0)[0]
            bare = (np.linalg.norm(surface[:, None] - centers, axis=-1) - radii).min(axis=1)
            self.assertLess(np.quantile(bare, 0.98), BARE + SPACING / 2)
            planes = half_spaces(shape)
            outside = (centers @ planes[:, :3].T + planes[:, 3]).max(axis=1) + radii
            self.assertLess(outside[radii < radii.max()].max(), 1e-3)
        self.assertTrue((shape_balls(Shape(geometry=self.SHAPES[2]))[1] == 0.01).all())

    def test_height_counts_only_above_the_table(self):
        table = TableSpec(center=(0.0, 0.0), half_size=(0.5, 0.5, 0.02))
        points = torch.tensor([[0.0, 0.0, 0.03], [0.0, 0.6, -1.0]], dtype=FLOAT)
        heights = height_above_table(points, torch.tensor([0.01, 0.01], dtype=FLOAT), table)
        self.assertAlmostEqual(heights[0].item(), 0.02)
        self.assertEqual(heights[1].item(), float("inf"))

    def test_fingers_that_cross_are_found_and_neighbours_are_not(self):
        robot = robots.load("ur7e-sharpa")
        kinematics = Kinematics(robot)
        collision = SelfCollision(robot, kinematics)
        self.assertFalse(
            any(
                "right_index_MP" in pair and "right_index_DP" in pair
                for pair in self._names(kinematics, collision.link_pairs)
            )
        )
        q = torch.as_tensor(robot.home)[None].repeat(2, 1)
        q[1, robot.joint_names.index("right_index_MCP_AA")] = 0.35
        clearance = collision.clearance(kinematics.link_poses(q).numpy(), 0.01)
        self.assertGreaterEqual(clearance[0], 0.0)
        self.assertLess(clearance[1], -0.002)
        near = collision.near(kinematics.link_poses(q).numpy(), 0.0)
        self.assertEqual(set(near.configuration.tolist()), {1})
        pairs = self._names(kinematics, near.links.tolist())
        self.assertTrue(all("right_index" in a or "right_index" in b for a, b in pairs), pairs)

    @staticmethod
    def _names(kinematics, pairs):
        return [tuple(kinematics.link_names[i] for i in pair) for pair in pairs]


class HandTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = toy_hand_arm(Path(cls.enterClassContext(tempfile.TemporaryDirectory())))
        cls.model = HandModel(cls.robot)
        motion = toy_motion(cls.model, torch.Generator().manual_seed(1), margin=0.1, turn=0.3)
        cls.joints, cls.root_pos, cls.root_quat = motion.joints, motion.root_pos, motion.root_quat
        cls.keypoints = cls.model.keypoints(cls.joints, cls.root_pos, cls.root_quat)
        cls.seen = [
            name for name in cls.model.kinematics.joint_names if name != "jaw_a"
        ]  # no keypoint follows the jaws
        cls.columns = [cls.model.kinematics.joint_names.index(name) for name in cls.seen]

    def targets(self, **changes) -> HandTargets:
        shape = self.keypoints.shape[:2]
        values = {
            "keypoints": self.keypoints,
            "annotated": torch.ones(shape, dtype=torch.bool),
            "contact_points": torch.zeros_like(self.keypoints),
            "in_contact": torch.zeros(self.keypoints.shape[:3], dtype=torch.bool),
            "held": torch.ones(shape, dtype=torch.bool),
            "object_pos": torch.full((*shape, 3), 9.0, dtype=FLOAT),
            "object_quat": torch.tensor([1.0, 0, 0, 0], dtype=FLOAT).expand(*shape, 4),
            "object_index": torch.zeros(len(self.keypoints), dtype=torch.long),
            "fields": FAR_OBJECT.field,
        }
        return HandTargets(**(values | changes))

    def too_near(self, targets: HandTargets, state: HandState, config: HandConfig) -> Distances:
        """What the clearance term acts on."""
        values = (state.joints, state.root_pos, state.root_quat)
        bodies = self.model.bodies(*(value.flatten(0, 1) for value in values))
        objects = Objects.at(
            targets.object_pos.flatten(0, 1),
            targets.object_quat.flatten(0, 1),
            targets.object_index.repeat_interleave(12),
            targets.fields,
        )
        return too_near(
            self.model, bodies, objects, targets.annotated.flatten(), config.object_clearance, config.self_depth
        )

    def test_gradient_is_the_derivative_of_the_cost(self):
        """All terms at once: bones, alignment, contact (beyond and below the knee), object, smoothness, jumps."""
        turn = quat_from_axis_angle(torch.tensor([0.3, -0.2, 0.5], dtype=FLOAT))
        targets = self.targets(
            contact_points=self.keypoints + torch.tensor([0.011, 0.0, 0.0], dtype=FLOAT) * torch.arange(6)[:, None],
            in_contact=torch.ones(self.keypoints.shape[:3], dtype=torch.bool),
            object_pos=self.keypoints[:, :, 3] + 0.01,
            object_quat=turn.expand(*self.keypoints.shape[:2], 4),
        )
        config = HandConfig(jump_limit=0.02)
        joints = self.model.kinematics.clamp(self.joints + 0.05)
        state = HandState(joints=joints, root_pos=self.root_pos + 0.004, root_quat=self.root_quat)
        found = system(self.model, targets, config, state)
        self.assertGreater(len(self.too_near(targets, state, config).value), 10)
        self.assertGreater(joints.diff(dim=1).abs().max().item(), config.jump_limit)
        for weight in ("jump_weight", "clearance_weight", "contact_weight", "global_weight", "local_weight"):
            without = system(self.model, targets, dataclasses.replace(config, **{weight: 0.0}), state)
            self.assertGreater((found.cost - without.cost).max().item(), 1e-6, weight)
        count, step = joints.shape[-1], 1e-6
        for frame in (0, 5, 11):
            for k in range(count + 6):
                costs = []
                for sign in (1.0, -1.0):
                    shift = torch.zeros_like(found.gradient)
                    shift[:, frame, k] = sign * step
                    moved = HandState(
                        joints=joints + shift[..., :count],
                        root_pos=state.root_pos + shift[..., count : count + 3],
                        root_quat=quat_multiply(quat_from_axis_angle(shift[..., count + 3 :]), state.root_quat),
                    )
                    costs.append(system(self.model, targets, config, moved).cost)
                slope = (costs[0] - costs[1]) / (4 * step)  # gradient is half the derivative
                torch.testing.assert_close(
                    found.gradient[:, frame, k], slope, rtol=2e-3, atol=2e-4 * float(found.gradient.abs().max())
                )

    def test_recovers_a_motion_from_its_own_keypoints(self):
        config = HandConfig(smoothness_weight=1e-6, clearance_weight=0.0, iterations=60, tolerance=1e-9)
        found = retarget_hand(self.model, self.targets(), config)
        self.assertLess((found.keypoints - self.keypoints).norm(dim=-1).max().item(), 1e-4)
        self.assertLess((found.joints - self.joints)[..., self.columns].abs().max().item(), 5e-3)
        self.assertLess(quat_angle(found.root_quat, self.root_quat).max().item(), 5e-3)

    def test_moves_with_the_scene(self):
        """A rigid motion of everything moves the hand with it: object and contacts too, far above the table, which does not move."""
        turn = quat_from_axis_angle(torch.tensor([0.4, 0.2, -1.0], dtype=FLOAT))
        shift = torch.tensor([0.3, -0.1, 0.2], dtype=FLOAT)
        up = torch.tensor([0.0, 0.0, 2.0], dtype=FLOAT)
        here = self.targets(
            keypoints=self.keypoints + up,
            contact_points=self.keypoints + up + 0.02,
            in_contact=torch.ones(self.keypoints.shape[:3], dtype=torch.bool),
            object_pos=self.keypoints[:, :, self.model.names.index("index4")] + up + 0.03,
        )
        there = dataclasses.replace(
            here,
            keypoints=quat_rotate(turn, here.keypoints) + shift,
            contact_points=quat_rotate(turn, here.contact_points) + shift,
            object_pos=quat_rotate(turn, here.object_pos) + shift,
            object_quat=quat_multiply(turn.expand_as(here.object_quat), here.object_quat),
        )
        still, moved = retarget_hand(self.model, here), retarget_hand(self.model, there)
        torch.testing.assert_close(still.cost, moved.cost, atol=0, rtol=1e-6)
        torch.testing.assert_close(still.joints, moved.joints, atol=1e-6, rtol=0)
        torch.testing.assert_close(quat_rotate(turn, still.root_pos) + shift, moved.root_pos, atol=1e-6, rtol=0)

    def test_order_and_company_of_sequences_do_not_matter(self):
        object_pos = self.keypoints[:, :, self.model.names.index("index4")] + 0.01
        targets = self.targets(object_pos=object_pos)
        together = retarget_hand(self.model, targets)
        order = torch.tensor([2, 0, 1])
        permuted = retarget_hand(self.model, targets[order])
        torch.testing.assert_close(permuted.joints, together.joints[order], atol=1e-9, rtol=0)
        for i in range(3):
            alone = retarget_hand(self.model, targets[torch.tensor([i])])
            torch.testing.assert_close(alone.joints[0], together.joints[i], atol=1e-9, rtol=0)

    def test_joints_do_not_jump(self):
        """Keypoints that jump to another posture in one frame: the wall spreads the change over several."""
        swapped = torch.cat((self.keypoints[:, :6], self.keypoints[:, -1:].expand(-1, 6, -1, -1)), dim=1)
        jumps = []
        for weight in (0.0, 1000.0):
            joints = retarget_hand(self.model, self.targets(keypoints=swapped), HandConfig(jump_weight=weight)).joints
            jumps.append(joints.diff(dim=1).abs().max().item())
        self.assertGreater(jumps[0], 0.25)
        self.assertLess(jumps[1], 0.2)

    @unittest.skipUnless(torch.cuda.is_available(), "needs a CUDA device")
    def test_a_gpu_finds_the_same_motion(self):
        targets = self.targets(object_pos=self.keypoints[:, :, self.model.names.index("index4")] + 0.01)
        cpu, gpu = (retarget_hand(HandModel(self.robot, device=device), targets) for device in ("cpu", "cuda"))
        torch.testing.assert_close(gpu.cost, cpu.cost, atol=0, rtol=1e-6)
        torch.testing.assert_close(gpu.joints, cpu.joints, atol=1e-4, rtol=0)

    def test_frames_without_annotation_do_not_matter_and_are_bridged(self):
        annotated = torch.ones(3, 12, dtype=torch.bool)
        annotated[:, 4:7] = False
        annotated[:, 10:] = False
        garbage = self.keypoints.clone()
        garbage[~annotated] = 1e3
        a = retarget_hand(self.model, self.targets(annotated=annotated))
        b = retarget_hand(self.model, self.targets(annotated=annotated, keypoints=garbage))
        torch.testing.assert_close(a.joints, b.joints, atol=0, rtol=0)
        middle = (a.joints[:, 3] + a.joints[:, 7]) / 2
        torch.testing.assert_close(a.joints[:, 5], middle, atol=1e-3, rtol=0)
        torch.testing.assert_close(a.joints[:, 11], a.joints[:, 9], atol=1e-3, rtol=0)

    def test_contact_pulls_the_links_that_touch(self):
        aim = self.keypoints.clone()
        tip = self.model.names.index("index4")
        aim[:, :, tip, 2] += 0.04
        mask = torch.zeros(self.keypoints.shape[:3], dtype=torch.bool)
        mask[:, :, tip] = True
        free = retarget_hand(self.model, self.targets())
        pulled = retarget_hand(
            self.model, self.targets(contact_points=aim, in_contact=mask), HandConfig(contact_weight=50.0)
        )
        gap = [(motion.keypoints - aim)[:, :, tip].norm(dim=-1).mean().item() for motion in (free, pulled)]
        self.assertGreater(gap[0], 0.035)
        self.assertLess(gap[1], 0.025)

    def test_the_hand_stays_out_of_the_object(self):
        inside = self.targets(object_pos=self.keypoints[:, :, self.model.names.index("index4")])
        depth = []
        for weight in (0.0, 2000.0):
            motion = retarget_hand(self.model, inside, HandConfig(clearance_weight=weight))
            distance = self.too_near(inside, motion, HandConfig()).value
            depth.append(-distance.min().item() if len(distance) else 0.0)
        self.assertGreater(depth[0], 0.02)
        self.assertLess(depth[1], 0.005)

    def test_joints_stay_within_limits(self):
        spread = self.targets(keypoints=self.keypoints * torch.tensor([1.0, 3.0, 1.0], dtype=FLOAT))
        joints = retarget_hand(self.model, spread).joints
        self.assertTrue(((joints >= self.model.kinematics.lower) & (joints <= self.model.kinematics.upper)).all())
        self.assertTrue(((joints == self.model.kinematics.lower) | (joints == self.model.kinematics.upper)).any())

    def test_pairs_for_any_subset_of_keypoints(self):
        links = [f"link_{name}" for name in KEYPOINTS]
        whole = keypoint_pairs(KEYPOINTS, links)
        self.assertIn((KEYPOINTS.index("wrist"), KEYPOINTS.index("index1")), whole)
        self.assertIn((KEYPOINTS.index("thumb4"), KEYPOINTS.index("little4")), whole)
        self.assertEqual(len(whole), len(set(whole)))
        jaws = keypoint_pairs(("wrist", "thumb4", "index4", "middle4"), ("hand", "left", "right", "right"))
        self.assertEqual(set(jaws), {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)})

    def test_a_hand_root_that_the_arm_does_not_end_in_is_refused(self):
        with self.assertRaisesRegex(RobotError, "hand_root"):
            HandModel(dataclasses.replace(self.robot, hand_root="upper"))
        with self.assertRaisesRegex(RobotError, "3 or more"):
            HandModel(dataclasses.replace(self.robot, keypoints=self.robot.keypoints[:2]))


class ConfigTest(unittest.TestCase):
    def test_numbers_out_of_range_are_refused_by_name(self):
        for config, name, values in (
            (HandConfig, "jump_weight", (-1.0, np.nan, np.inf)),
            (HandConfig, "contact_knee", (0.0, np.nan)),
            (HandConfig, "object_clearance", (np.nan, -np.inf)),
            (HandConfig, "clearance_growth", ((0.1, np.nan),)),
            (ArmConfig, "reseeds", (-1,)),
            (ArmConfig, "restarts", (0,)),
            (ArmConfig, "position_weight", (-50.0, np.nan)),
        ):
            for value in values:
                with (
                    self.subTest(name=name, value=value),
                    self.assertRaisesRegex(ValueError, f"^{name} is .*, expected"),
                ):
                    config(**{name: value})
        HandConfig(object_clearance=-0.001, jump_limit=np.inf)  # deeper than the surface; no limit

    def test_the_command_line_says_so_too(self):
        for option, value, said in (
            ("--hand.jump-weight", "nan", "jump_weight is nan"),
            ("--arm.reseeds", "-1", "reseeds is -1"),
        ):
            code, out, err = run("retarget", "demos.npz", "--robot", "openarm", "--out", "out.npz", option, value)
            self.assertEqual(code, 2)
            self.assertIn(said, out + err)


class ArmTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = robots.load("ur7e-sharpa")
        cls.model = ArmModel(cls.robot)
        cls.config = ArmConfig(restarts=12, branches=2)

    def along(self, joints: torch.Tensor, lower: float = 0.0) -> ArmTargets:
        """Targets from the hand's pose along arm joints [T, n], lowered by ``lower`` [m]."""
        hand = torch.as_tensor(self.robot.home[self.robot.hand_indices]).expand(1, len(joints), -1)
        T = self.model.kinematics.link_poses(self.model.full(joints[None], hand), [self.robot.hand_root])[:, :, 0]
        from xreset.geometry.rotations import matrix_to_quat

        pos = T[..., :3, 3].clone()
        pos[..., 2] -= lower
        shape = pos.shape[:2]
        return ArmTargets(
            root_pos=pos,
            root_quat=matrix_to_quat(T[..., :3, :3]),
            hand_joints=hand,
            annotated=torch.ones(shape, dtype=torch.bool),
            hand_error=torch.zeros(shape, dtype=FLOAT),
            hand_clearance=self.model.hand_clearance(hand),
        )

    def home_path(self, frames: int = 8) -> torch.Tensor:
        home = torch.as_tensor(self.robot.home[self.robot.arm_indices])
        return home + torch.linspace(0, 0.4, frames, dtype=FLOAT)[:, None] * torch.tensor(
            [1.0, 0.3, -0.5, 0.4, 0.3, 1.0], dtype=FLOAT
        )

    def test_follows_a_path_that_the_arm_can_follow(self):
        joints, measures = track(self.model, self.along(self.home_path()), Thresholds(), self.config)
        self.assertLess(measures.wrist_position.max().item(), 1e-3)
        self.assertLess(measures.wrist_orientation.max().item(), 5e-3)
        self.assertEqual(classify(measures, Thresholds()).tolist(), [[0] * 8])
        self.assertTrue(((joints >= self.model.lower) & (joints <= self.model.upper)).all())

    def test_same_inputs_same_result(self):
        runs = [track(self.model, self.along(self.home_path(3)), Thresholds(), self.config)[0] for _ in range(2)]
        torch.testing.assert_close(runs[0], runs[1], atol=0, rtol=0)

    def test_stays_above_the_table(self):
        path = self.along(self.home_path(4))
        kinematics, support = self.model.kinematics, table_points(self.robot, self.model.kinematics)
        joints = self.model.full(self.home_path(4)[None], path.hand_joints)
        points = kinematics.points(joints, support.links, torch.as_tensor(support.points))
        height = height_above_table(points, torch.as_tensor(support.radii), self.model.table).min().item()
        sunk = self.along(self.home_path(4), lower=height + 0.05)
        _, free = track(self.model, sunk, Thresholds(), dataclasses.replace(self.config, collision_weight=0.0))
        _, kept = track(self.model, sunk, Thresholds(), self.config)
        self.assertLess(free.table_clearance.min().item(), -0.045)
        self.assertGreater(kept.table_clearance.min().item(), -0.006)
        self.assertEqual(REASONS[classify(free, Thresholds()).max()], "table collision")
        self.assertEqual(REASONS[classify(kept, Thresholds()).max()], "wrist position")

    def test_lowest_points_are_those_of_all_points(self):
        for name in ("ur7e-sharpa", "openarm"):
            model = ArmModel(robots.load(name))
            kinematics, support = model.kinematics, table_points(model.robot, model.kinematics)
            span = (kinematics.upper - kinematics.lower).clamp_max(6.0)
            generator = torch.Generator().manual_seed(0)
            joints = kinematics.clamp(span * (torch.rand(300, len(span), generator=generator, dtype=FLOAT) - 0.5))
            carriers = kinematics.link_poses(joints, model.carriers)
            hand_poses = model.hand_poses(joints[:, torch.as_tensor(model.hand.joint_indices)])
            low = model.low_points(carriers[..., :3, 3], carriers[..., :3, :3], hand_poses, 0.02)
            points = kinematics.points(joints, support.links, torch.as_tensor(support.points))
            heights = height_above_table(points, torch.as_tensor(support.radii), model.table)
            of_carrier = model.carrier_of[[kinematics.link_index(link) for link in support.links]]
            for carrier in range(len(model.carriers)):
                own = low[low.carrier == carrier]
                expected = (
                    heights[:, of_carrier == carrier].amin(1)
                    if (of_carrier == carrier).any()
                    else torch.full((300,), np.inf)
                )
                self.assertEqual(own.frame.tolist(), (expected < 0.02).nonzero()[:, 0].tolist())
                torch.testing.assert_close(own.height, expected[own.frame].to(FLOAT), atol=1e-12, rtol=0)
            self.assertGreater(len(low.frame), 40)

    def test_out_of_reach_is_invalid(self):
        far = self.along(self.home_path(2))
        far = dataclasses.replace(far, root_pos=far.root_pos + torch.tensor([0.0, -3.0, 0.0], dtype=FLOAT))
        _, measures = track(self.model, far, Thresholds(), self.config)
        self.assertTrue((classify(measures, Thresholds()) != 0).all())
        self.assertGreater(measures.wrist_position.min().item(), 0.5)

    def test_self_collision_costs_and_its_gradient_parts_the_links(self):
        """The arm folded onto itself: a small step against the gradient must raise the clearance."""
        folded = torch.as_tensor(self.robot.home[self.robot.arm_indices]).clone()[None]
        folded[0, self.robot.joint_names.index("elbow_joint")] = 2.95
        targets = self.along(folded)
        frame = arm_cost.Frame(
            pos=targets.root_pos[:, 0],
            quat=targets.root_quat[:, 0],
            hand_poses=self.model.hand_poses(targets.hand_joints)[:, 0],
            hand_joints=targets.hand_joints[:, 0],
            previous=None,
        )
        plain = arm_cost.system(self.model, frame, folded, self.config, self_collision=False)
        full = arm_cost.system(self.model, frame, folded, self.config, self_collision=True)
        self.assertGreater((full.cost - plain.cost).item(), 0.1)
        push = full.gradient - plain.gradient
        step = 1e-6
        slopes = []
        for k in range(folded.shape[1]):
            shift = torch.zeros_like(folded)
            shift[0, k] = step
            costs = [
                arm_cost.system(self.model, frame, folded + sign * shift, self.config, self_collision=True).cost
                - arm_cost.system(self.model, frame, folded + sign * shift, self.config, self_collision=False).cost
                for sign in (1.0, -1.0)
            ]
            slopes.append(((costs[0] - costs[1]) / (4 * step)).item())
        np.testing.assert_allclose(push[0], slopes, atol=0.02 * max(map(abs, slopes)))


class ValidityTest(unittest.TestCase):
    GOOD: ClassVar = {
        "annotated": True,
        "hand_error": 0.005,
        "wrist_position": 0.001,
        "wrist_orientation": 0.01,
        "at_limit": False,
        "arm_jump": 0.1,
        "table_clearance": 0.01,
        "self_clearance": 0.01,
    }
    BAD: ClassVar = {
        "not annotated": {"annotated": False},
        "hand error": {"hand_error": 0.05},
        "joint limit": {"wrist_position": 0.02, "at_limit": True},
        "wrist position": {"wrist_position": 0.02},
        "wrist orientation": {"wrist_orientation": 0.2},
        "arm jump": {"arm_jump": 0.5},
        "table collision": {"table_clearance": -0.01},
        "self collision": {"self_clearance": -0.01},
    }

    def reason(self, **changes) -> str:
        measures = Measures(**{name: torch.tensor([value]) for name, value in (self.GOOD | changes).items()})
        return REASONS[int(classify(measures, Thresholds()))]

    def test_every_reason_can_be_reached(self):
        self.assertEqual(self.reason(), "valid")
        self.assertEqual(self.reason(at_limit=True), "valid")  # a limit alone does no harm
        self.assertEqual(list(self.BAD), list(REASONS[1:]))
        for name, changes in self.BAD.items():
            self.assertEqual(self.reason(**changes), name)

    def test_the_first_reason_counts(self):
        self.assertEqual(self.reason(arm_jump=1.0, hand_error=1.0), "hand error")
        self.assertEqual(
            self.reason(**{k: v for changes in self.BAD.values() for k, v in changes.items()}), "not annotated"
        )

    def test_not_a_number_is_invalid(self):
        for name in (
            "hand_error",
            "wrist_position",
            "wrist_orientation",
            "arm_jump",
            "table_clearance",
            "self_clearance",
        ):
            self.assertNotEqual(self.reason(**{name: float("nan")}), "valid", name)


class PipelineTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = robots.load("ur7e-sharpa")
        demos = synthesize(["soup"], per_object=2, seed=0)
        valid = demos.hand_valid.copy()
        valid[demos.frames(1)] = False  # a sequence in which the hand was never seen
        keypoints = np.where(valid[:, None, None], demos.hand_keypoints, np.nan)
        cls.demos = dataclasses.replace(demos, hand_valid=valid, hand_keypoints=keypoints)
        cls.objects = list(demo_objects(demos).values())
        cls.config = RetargetConfig(arm=ArmConfig(restarts=12, branches=2))
        cls.ticks = []
        cls.result = retarget_demos(
            cls.demos, cls.robot, cls.objects, cls.config, progress=lambda done, total: cls.ticks.append((done, total))
        )

    def test_most_frames_of_a_synthetic_demonstration_are_valid(self):
        first = self.demos.frames(0)
        seen = self.result.annotated[first]
        self.assertGreater(self.result.valid[first].sum() / seen.sum(), 0.8)
        self.assertLess(self.result.hand_error[first][seen].mean(), 0.015)

    def test_the_file_says_what_the_robot_does(self):
        kinematics = Kinematics(self.robot)
        links = kinematics.link_poses(torch.as_tensor(self.result.joint_pos), self.robot.tracked_links).numpy()
        np.testing.assert_allclose(self.result.palm_pos, links[:, 0, :3, 3], atol=1e-12)
        np.testing.assert_allclose(self.result.fingertip_pos, links[:, 1:, :3, 3], atol=1e-12)
        np.testing.assert_allclose(
            quat_to_matrix(torch.as_tensor(self.result.palm_quat_wxyz)), links[:, 0, :3, :3], atol=1e-9
        )
        q = torch.as_tensor(self.result.joint_pos)
        self.assertTrue(((q >= kinematics.lower - 1e-12) & (q <= kinematics.upper + 1e-12)).all())
        seen = self.result.annotated & self.result.valid
        tips = [KEYPOINTS.index(tip.keypoint) for tip in self.robot.fingertips]
        rested = rest_on_table(self.demos, self.objects)
        gap = np.linalg.norm(self.result.fingertip_pos - rested.hand_keypoints[:, tips], axis=-1).mean(axis=1)
        np.testing.assert_allclose(
            gap[seen], self.result.hand_error[seen], atol=0.011
        )  # apart by the wrist's error at most

    def test_the_object_rests_on_the_table_and_keeps_its_goal(self):
        spec = self.objects[0]
        for i in range(2):
            rows = self.demos.frames(i)
            quat = torch.as_tensor(self.result.object_quat_wxyz[rows.start])
            lowest = (
                quat_rotate(quat, torch.as_tensor(spec.vertices))[:, 2].min().item()
                + self.result.object_pos[rows.start, 2]
            )
            self.assertAlmostEqual(lowest, 0.0, delta=1e-6)
            np.testing.assert_array_equal(self.result.goal_pos[i], self.result.object_pos[rows.stop - 1])

    def test_first_contact_splits_the_sequence(self):
        first = self.result.first_contact[0]
        contact = self.result.contact[self.demos.frames(0)]
        self.assertTrue(0 < first < len(contact))
        self.assertFalse(contact[:first].any())
        self.assertTrue(contact[first])

    def test_a_sequence_without_a_hand_stays_at_home(self):
        rows = self.demos.frames(1)
        np.testing.assert_array_equal(
            self.result.joint_pos[rows], np.tile(self.robot.home, (rows.stop - rows.start, 1))
        )
        self.assertEqual({REASONS[r] for r in self.result.reason[rows]}, {"not annotated"})
        self.assertEqual(self.result.first_contact[1], -1)

    def test_progress_ends_complete(self):
        self.assertEqual(self.ticks[-1], (1, 1))
        self.assertEqual([done for done, _ in self.ticks], sorted(done for done, _ in self.ticks))

    def test_the_same_inputs_give_the_same_file(self):
        again = retarget_demos(self.demos, self.robot, self.objects, self.config)
        for name, result in (("a.npz", self.result), ("b.npz", again)):
            write_retargeted(self.folder / name, result, config={}, inputs={})
        self.assertEqual((self.folder / "a.npz").read_bytes(), (self.folder / "b.npz").read_bytes())

    def test_the_file_comes_back(self):
        write_retargeted(self.folder / "c.npz", self.result, config={"x": 1}, inputs={})
        back = read_retargeted(self.folder / "c.npz")
        for field in dataclasses.fields(Retargeted):
            np.testing.assert_array_equal(getattr(back, field.name), getattr(self.result, field.name), field.name)
        self.assertEqual(back.robot_fingerprint, self.robot.fingerprint)

    def test_a_file_that_contradicts_itself_is_refused(self):
        for changes, message in (
            ({"valid": ~self.result.valid}, "contradict"),
            ({"joint_pos": np.full_like(self.result.joint_pos, np.nan)}, "non-finite"),
            ({"reason": self.result.reason + 100}, "points beyond"),
            ({"frame_offsets": self.result.frame_offsets[::-1].copy()}, "frame_offsets"),
            ({"first_contact": np.array([10_000, -1])}, "first_contact"),
        ):
            with self.subTest(message):
                write_retargeted(
                    self.folder / "d.npz", dataclasses.replace(self.result, **changes), config={}, inputs={}
                )
                with self.assertRaisesRegex(FileFormatError, message):
                    read_retargeted(self.folder / "d.npz")

    def test_an_object_that_was_not_given_is_named(self):
        with self.assertRaisesRegex(DemoError, "005_tomato_soup_can"):
            retarget_demos(self.demos, self.robot, [])

    def test_the_command_writes_file_and_picture_for_a_gripper(self):
        from xreset.cli.retarget import retarget as command

        write_demos(self.folder / "demos.npz", self.demos.select(indices=[0]))
        text = io.StringIO()
        with contextlib.redirect_stdout(text):
            command(
                self.folder / "demos.npz",
                robot="openarm",
                out=self.folder / "jaws.npz",
                picture=self.folder / "jaws.png",
                hand=HandConfig(tolerance=0.002),
                arm=ArmConfig(restarts=8),
            )
        with np.load(self.folder / "jaws.npz") as file:
            used = json.loads(str(file["meta"]))["config"]["retarget"]
        self.assertEqual((used["hand"]["tolerance"], used["arm"]["restarts"]), (0.002, 8))
        result = read_retargeted(self.folder / "jaws.npz")
        self.assertEqual(result.robot, "openarm")
        self.assertIn("005_toma", text.getvalue())
        self.assertEqual((self.folder / "jaws.png").read_bytes()[:4], b"\x89PNG")

    def test_a_stopped_command_leaves_no_file(self):
        from xreset.cli.retarget import retarget as command

        demos = self.folder / "stopped" / "demos.npz"
        demos.parent.mkdir()
        write_demos(demos, self.demos.select(indices=[0]))
        with (
            mock.patch("xreset.retarget.pipeline.track", side_effect=KeyboardInterrupt),
            contextlib.redirect_stdout(io.StringIO()),
            self.assertRaises(KeyboardInterrupt),
        ):
            command(demos, robot="openarm", out=demos.with_name("out.npz"), hand=HandConfig(iterations=1))
        self.assertEqual(list(demos.parent.iterdir()), [demos])


class RealDataTest(unittest.TestCase):
    def test_fingertips_follow_a_real_hand(self):
        demos = read_demos(data_dir() / "dexycb_right_9x20.npz").select(objects=["soup"], max_per_object=1)
        result = retarget_demos(demos, robots.load("ur7e-sharpa"), list(demo_objects(demos).values()))
        self.assertLess(result.hand_error[result.annotated].mean(), 0.010)
        self.assertGreater(result.valid.sum() / result.annotated.sum(), 0.9)


if __name__ == "__main__":
    unittest.main()
