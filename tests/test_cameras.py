"""Depth cameras: what the rays hit, errors of the images, the same picture in every engine, timing, and refusals."""

from dataclasses import replace
from unittest import TestCase, mock

import numpy as np
import torch
import trimesh
from numpy.testing import assert_array_equal
from torch import tensor
from torch.testing import assert_close

from tests.data import refuses
from tests.toy_bank import SOUP, in_this_process, toy_bank
from tests.toy_robot import toy_robot
from xreset.cameras.config import CameraConfig, DepthNoise, VisionConfig
from xreset.cameras.rays import RayCaster
from xreset.cameras.sensor import Cameras
from xreset.env.manipulation import make_env, make_scene
from xreset.errors import RobotError, XResetError
from xreset.objects.catalogue import load_objects
from xreset.physics import State
from xreset.task.config import ObservationConfig, RandomizationConfig, TaskConfig, evaluation_task

IDEAL = DepthNoise(spread=0.0, step=0.0, holes=0.0, edges=0.0)
ABOVE = CameraConfig(pos=(0.57, 0.3, 0.5), target=(0.57, 0.3, 0.0), noise=IDEAL)
TASK = TaskConfig(
    distance_points=8,
    observation=ObservationConfig(
        cloud_points=4, perception={"paired_cloud": {"noise": 0.002, "scale": 1.0}}
    ),
)
SIZE = {"width": 32, "height": 24}
VISION = VisionConfig(cameras=(ABOVE, replace(ABOVE, pos=(1.0, 0.2, 0.4))), interval=1, **SIZE)


class TestCameras(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = toy_robot()
        cls.objects = tuple(load_objects([SOUP], None))
        cls.scene = make_scene(cls.robot, cls.objects, TaskConfig())
        cls.index = torch.zeros(2, dtype=torch.long)
        cls.state = State.initial(cls.scene, cls.index)

    def cameras(self, vision=VISION, **options):
        return Cameras(self.scene, self.index, vision, **options)

    def look(self, cameras, state=None):
        state = state or self.state
        goal = state.object_pos + tensor([0.0, 0.0, 0.2])
        cameras.aim(state, goal, state.object_quat, torch.ones(2, dtype=torch.bool))
        cameras.cast()
        return cameras.observe(torch.Generator().manual_seed(0))

    def test_depths_along_the_view_axis(self):
        cameras = self.cameras()
        self.look(cameras)
        depth = cameras.rays.depth[0, 0]
        body = cameras.rays.body[0, 0]
        can = body.max()
        on_table = depth[body == can - 1]
        assert_close(on_table, torch.full_like(on_table, 0.5))
        top = 0.5 - (self.objects[0].vertices[:, 2].max() + float(self.state.object_pos[0, 2]))
        self.assertAlmostEqual(depth[12, 16], top, delta=5e-5)
        self.assertEqual(body[12, 16], can)
        # as many pixels as a disk of the can's size has at that depth
        radius = np.ptp(self.objects[0].vertices[:, 0]) / 2
        pixels_per_metre = 24 / 2 / np.tan(ABOVE.fov / 2) / top
        self.assertAlmostEqual(
            (body == can).sum(), np.pi * (radius * pixels_per_metre) ** 2, delta=12
        )
        assert_close(cameras.image[0, 0], depth.where(depth <= 2.0, 0.0))

    def test_robots_of_more_than_127_bodies(self):
        meshes = [trimesh.creation.box((0.01, 0.01, 0.01))]
        camera = tensor(np.eye(4), dtype=torch.float32).expand(1, 1, 4, 4).contiguous()
        due = torch.ones(1, dtype=torch.bool)
        rays = RayCaster(
            meshes, torch.zeros(1, 300, dtype=torch.long), camera, torch.ones(1, 1), due, (3, 3)
        )
        rays.pose[:, :-1, 2, 3] = -1.0  # behind the camera
        rays.pose[:, -1, 2, 3] = 1.0
        rays.cast()
        self.assertEqual(int(rays.body[0, 0, 1, 1]), 299)

    def test_errors_of_depth(self):
        def image(scale=1.0, **noise):
            camera = replace(ABOVE, noise=replace(IDEAL, **noise))
            cameras = self.cameras(
                replace(VISION, cameras=(camera, replace(camera, pos=(1.0, 0.2, 0.4))))
            )
            cameras.noise_scale.fill_(scale)
            self.look(cameras)
            return cameras.image

        exact = image()
        seen = exact > 0
        for scale in (
            1.0,
            2.0,
        ):  # the spread grows with the square of the depth, and with the scale
            error = (image(spread=0.002, scale=scale) - exact) / exact.square().clamp_min(1e-3)
            self.assertAlmostEqual(error[seen].std(), 0.002 * scale, delta=2e-4 * scale)
        steps = 1 / image(step=0.01)[seen] / 0.01
        self.assertLess((steps - steps.round()).abs().max(), 1e-3)
        lost = (image(holes=0.2) == 0) & seen
        self.assertAlmostEqual(lost.sum() / seen.sum(), 0.2, delta=0.04)
        lost = (image(edges=1.0) == 0) & seen  # around the can, and not on the table
        self.assertGreater(lost[0, 0].sum(), 10)
        self.assertFalse(lost[0, 0, :, :6].any())

    def test_points_are_on_the_object(self):
        cameras = self.cameras(replace(VISION, points=20), scale=2.0)
        cloud = self.look(cameras)
        self.assertEqual(cloud.shape, (2, 2, 20, 4))
        self.assertTrue((cloud[..., 3] == 1).all())
        points = cloud[..., :3] / 2 - self.state.object_pos[:, None, None]
        points[:, 1, :, 2] -= 0.2  # the goal is higher
        low, high = (
            tensor(getattr(self.objects[0].vertices, end)(axis=0)) for end in ("min", "max")
        )
        self.assertTrue(((points > low - 1e-3) & (points < high + 1e-3)).all())

    def test_points_are_where_a_camera_that_has_not_moved_would_see_them(self):
        cameras = self.cameras(replace(VISION, cameras=(ABOVE,), points=20))
        expected = self.look(cameras)[:, 0, :, 2].max()
        cameras.shift[..., 2] = 0.1  # down
        self.assertAlmostEqual(self.look(cameras)[:, 0, :, 2].max(), expected + 0.1, delta=1e-4)

    def test_a_picture_may_show_the_goal_in_green(self):
        cameras = self.cameras()
        self.look(cameras)
        gray, colored = (cameras.picture(0, 128, goal=goal).astype(int) for goal in (False, True))
        self.assertTrue((gray == gray[..., :1]).all())
        green = colored[..., 1] > colored[..., 0]
        self.assertTrue(green[:, :64].any() and green[:, 64:].any())
        assert_array_equal(colored[~green], gray[~green])

    def test_a_camera_on_a_link_moves_with_it(self):
        cameras = self.cameras(
            replace(
                VISION, cameras=(CameraConfig(link="palm", pos=(0, 0, 0.2), target=(1, 0, 0.2)),)
            )
        )
        self.look(cameras)
        before = cameras.pose.clone()
        joints = self.state.joint_pos.clone()
        joints[:, self.robot.joint_names.index("arm_3")] += 0.1
        self.look(cameras, replace(self.state, joint_pos=joints))
        moved = (cameras.pose - before)[0, 0, :3, 3].norm()
        self.assertAlmostEqual(moved, 0.1, delta=5e-6)

    def test_refusals(self):
        inside = CameraConfig(link="palm", pos=(0, 0, 0.001), target=(1, 0, 0))
        below = replace(ABOVE, pos=(0.57, 0.3, -0.01))
        for camera, error, words in (
            (CameraConfig(link="nose"), RobotError, "nose"),
            (inside, XResetError, "inside the robot's link 'palm'"),
            (below, XResetError, "inside the table"),
        ):
            with refuses(self, words, error):
                self.cameras(replace(VISION, cameras=(camera,)))
        with (
            mock.patch("xreset.cameras.rays.wp.launch", side_effect=RuntimeError("no driver")),
            self.assertRaisesRegex(
                XResetError,
                r"renderer of depth images cannot start on cpu: no driver. Use a policy without",
            ),
        ):
            self.cameras()
        for words, changes in (
            ("near is 3.0, expected less than far, which is 2.0", {"near": 3.0}),
            ("fov is 4.0, expected an angle between", {"fov": 4.0}),
            ("target is .*, expected another point than pos", {"target": ABOVE.pos}),
            ("pos is .*, expected three finite numbers", {"pos": (0.5, 0.2)}),
            ("pos is .*, expected three finite numbers", {"pos": (0.5, 0.2, float("nan"))}),
        ):
            with refuses(self, words, ValueError, changes):
                replace(ABOVE, **changes)
        few = VisionConfig(cameras=(ABOVE,), width=8, height=8, points=64)
        self.assertEqual(self.look(self.cameras(few)).shape, (2, 2, 64, 4))
        with self.assertRaisesRegex(ValueError, "points is 65, expected at most 64"):
            replace(few, points=65)


class TestVisionInTheEnvironment(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = toy_robot()
        cls.bank = toy_bank(cls.robot)
        cls.objects = tuple(load_objects(list(cls.bank.object_names), None))

    def make(self, vision, **changes):
        task = replace(evaluation_task(TASK), vision=vision, **changes)
        with in_this_process():
            return self.enterContext(
                make_env(self.robot, self.objects, self.bank, task, num_envs=2)
            )

    def play(self, env, steps):
        """Return what cameras see in each step, whichever order the points are drawn in."""
        views = [env.get_observations()["view"].sort(dim=2).values]
        generator = torch.Generator().manual_seed(0)
        for _ in range(steps):
            env.advance(2 * torch.rand(2, env.num_actions, generator=generator) - 1)
            views.append(env.get_observations()["view"].sort(dim=2).values)
        return views

    def test_interval_and_latency(self):
        vision = replace(VISION, points=2 * 32 * 24)  # every pixel
        every = self.play(self.make(vision), 6)
        self.assertFalse(torch.equal(every[1], every[2]))
        third = self.play(self.make(replace(vision, interval=3)), 6)
        late = self.play(self.make(replace(vision, latency=2.0)), 6)
        drawn = RandomizationConfig(
            camera_latency=(2.0, 2.0), friction=(0.75, 0.75), mass_scale=(1.0, 1.0)
        )
        drawn_late = self.play(self.make(vision, randomization=drawn), 6)
        for step in range(7):
            assert_close(third[step], every[step - step % 3])
            assert_close(late[step], every[max(step - 2, 0)])
            assert_close(drawn_late[step], late[step])

    def test_a_reset_renews_its_world_alone(self):
        env = self.make(replace(VISION, interval=50, latency=3.0))
        self.play(env, 4)
        before = env.get_observations()["view"]
        env.reset(tensor([1]))
        after = env.get_observations()["view"]
        self.assertTrue(torch.equal(after[0], before[0]))
        self.assertFalse(torch.equal(after[1], before[1]))

    def test_cameras_are_moved_as_drawn(self):
        moved = RandomizationConfig(
            camera_shift=(0.03, 0.03), camera_turn=(0.05, 0.05), camera_fov=(0.9, 1.1)
        )
        cameras = self.make(VISION, randomization=moved).vision.cameras
        assert_close(cameras.shift.norm(dim=-1), torch.full((2, 2), 0.03))
        assert_close(cameras.turn.norm(dim=-1), torch.full((2, 2), 0.05))
        self.assertEqual(len(cameras.fov_scale.unique()), 4)
