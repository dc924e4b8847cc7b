"""Pictures: everything is where it should be, in its own color."""

from unittest import TestCase, mock

import numpy as np
import torch
import trimesh
from numpy.testing import assert_allclose, assert_array_equal

from tests.toy_retarget import box_object
from xreset.errors import RobotError, XResetError
from xreset.geometry.description import load_robot as load
from xreset.geometry.kinematics import Kinematics
from xreset.pictures import meshes, render
from xreset.pictures.meshes import link_colors
from xreset.pictures.render import Camera, Points, Renderer
from xreset.spec import SceneSpec


def at(x, y, z):
    return np.array([x, y, z]), np.array([1.0, 0, 0, 0])


def pixel(camera, size, point):
    """Where a world point appears, by the textbook: written apart from the module that is tested."""
    forward = np.subtract(camera.target, camera.eye)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0, 0, 1])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    away = np.subtract(point, camera.eye)
    scale = size[1] / 2 / np.tan(camera.fov / 2) / (away @ forward)
    return np.array([size[0] / 2 + scale * (away @ right), size[1] / 2 - scale * (away @ up)])


class Pictures(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.robot = load("openarm")
        cls.size = (240, 180)
        cubes = [box_object(((0, 0, 0), (edge, edge, edge))) for edge in (0.08, 0.16)]
        cls.renderer = Renderer(SceneSpec(robot=cls.robot, objects=tuple(cubes)), size=cls.size)
        cls.camera = Camera()
        cls.home = cls.robot.home

    def changed(self, a, b):
        return np.abs(a.astype(int) - b).max(axis=-1) > 12

    def test_object_appears_where_it_is(self):
        empty = self.renderer.draw(self.home)
        for position in ((0.4, 0.1, 0.3), (0.6, 0.2, 0.5)):  # its shadow falls elsewhere
            picture = self.renderer.draw(self.home, at(*position))
            orange = (picture[..., 0] > picture[..., 2] + 60) & self.changed(picture, empty)
            y, x = np.nonzero(orange)
            expected = pixel(self.camera, self.size, position)
            assert_allclose(
                (x.min() / 2 + x.max() / 2 + 0.5, y.min() / 2 + y.max() / 2 + 0.5),
                expected,
                atol=2.0,
            )

    def test_the_object_is_the_one_of_the_index_and_the_robot_moves(self):
        empty = self.renderer.draw(self.home)
        areas = []
        for i in (0, 1):
            picture = self.renderer.draw(self.home, at(0.4, 0.1, 0.4), object_index=i)
            areas.append(self.changed(picture, empty).sum())
        self.assertGreater(areas[1], 2.5 * areas[0])
        moved = self.home.copy()
        moved[0] += 0.5
        self.assertGreater(self.changed(empty, self.renderer.draw(moved)).sum(), 100)

    def test_shadow_falls_on_the_table_away_from_the_light(self):
        above = np.array([0.35, 0.1, 0.25])
        ground = above - render._LIGHT * above[2] / render._LIGHT[2]
        x, y = pixel(self.camera, self.size, ground).astype(int)
        lit = self.renderer.draw(self.home)[y, x]
        dark = self.renderer.draw(self.home, at(*above))[y, x]
        self.assertLess(dark.max(), 0.75 * int(lit.max()))

    def test_goal_is_translucent(self):
        T = at(0.4, 0.1, 0.3)
        x, y = pixel(self.camera, self.size, T[0]).astype(int)
        empty = self.renderer.draw(self.home)[y, x].astype(int)
        goal = self.renderer.draw(self.home, goal_pose=T)[y, x]
        solid = self.renderer.draw(self.home, T)[y, x]
        self.assertGreater(goal[1], goal[0])  # green
        self.assertLess(np.abs(goal - empty).sum(), np.abs(solid - empty).sum())

    def test_points_are_drawn_over_everything_and_missing_ones_or_far_ones_left_out(self):
        color = (1.0, 0.0, 1.0)
        inside = np.array([0.4, 0.1, 0.3])
        # the second is behind the camera, in line with a place in the picture
        behind = 2 * np.array(self.camera.eye) - inside - (0.1, 0.0, 0.0)
        outside = [[50.0, 0, 0], behind, [1.28, -0.5, 0.9], [np.nan] * 3]
        points = Points(pos=np.array([inside, *outside]), color=color, radius=0.012)
        picture = self.renderer.draw(self.home, at(*inside), points=[points])
        y, x = np.nonzero((picture == (255, 0, 255)).all(axis=-1))
        assert_allclose(
            (x.mean() + 0.5, y.mean() + 0.5), pixel(self.camera, self.size, inside), atol=1.0
        )

    def test_frames_show_the_links_axes(self):
        lines = self.renderer.link_frames(self.home, ["palm"], length=0.1)
        T = Kinematics(self.robot).link_poses(torch.tensor(self.home), ["palm"])[0].numpy()
        picture = self.renderer.draw(self.home, points=lines).astype(int)
        for axis in range(3):
            x, y = pixel(self.camera, self.size, T[:3, 3] + 0.08 * T[:3, axis]).astype(int)
            self.assertEqual(picture[y, x].argmax(), axis)
            self.assertGreater(picture[y, x].max() - picture[y, x].min(), 100)
        with self.assertRaisesRegex(RobotError, "no link 'no_such_link'"):
            self.renderer.link_frames(self.home, ["no_such_link"])

    def test_a_picture_may_have_its_own_camera(self):
        near = Camera(eye=(0.8, -0.1, 0.5), target=(0.4, 0.1, 0.1))
        T = at(0.4, 0.1, 0.04)
        # the same, each time
        own = Renderer(self.renderer.scene, size=self.size, camera=near).draw(self.home, T)
        assert_array_equal(self.renderer.draw(self.home, T, camera=near), own)
        self.assertGreater(self.changed(self.renderer.draw(self.home, T), own).mean(), 0.1)
        smooth = Renderer(self.renderer.scene, size=self.size, camera=near, smooth=True).draw(
            self.home, T
        )
        self.assertEqual(smooth.shape, own.shape)
        self.assertIs(render._rays(near, self.size), render._rays(near, self.size))
        self.assertLess(np.abs(smooth.astype(float) - own).mean(), 3.0)

    def test_parts_are_told_apart_by_color(self):
        for name in ("openarm", "ur7e-sharpa"):
            robot = load(name)
            colors = link_colors(robot)
            self.assertEqual(colors[robot.hand_root], meshes.PALM_COLOR)
            for tip in robot.fingertips:
                for link in tip.contact_links:
                    self.assertEqual(colors[link], meshes.TIP_COLOR)
            self.assertEqual(colors[Kinematics(robot).link_names[0]], meshes.ARM_COLOR)
        self.assertEqual(colors["right_index_MP"], meshes.HAND_COLOR)


class WithoutEmbree(TestCase):
    def test_the_error_names_the_package(self):
        with (
            mock.patch.dict("sys.modules", {"embreex.mesh_construction": None}),
            self.assertRaisesRegex(XResetError, "pip install embreex"),
        ):
            render.draw_bodies([trimesh.creation.box()], [(1, 0, 0)], Camera(), (4, 4))
