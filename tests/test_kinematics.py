"""Kinematics, URDF files and mass matrices: read, written, and compared with MuJoCo."""

import os
import unittest
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import torch
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from tests.data import InFolder, InOneFolder, refuses
from tests.toy_retarget import FLOAT, slope
from tests.toy_robot import toy_hand_arm
from xreset import robots
from xreset.backends.conformance.scene import gripper
from xreset.backends.conformance.scene import shape as placed
from xreset.backends.rigid import MovingJoints, TrackedLinks, mechanism, vertices
from xreset.errors import RobotError
from xreset.geometry.dynamics import drive_shares, mass_matrix
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import hull
from xreset.geometry.urdf import RobotTree, load_urdf
from xreset.geometry.urdf_writer import fixed, frame, pose, urdf_text, write_meshes

FIXED = (
    '<joint name="{name}" type="fixed"><parent link="base"/><child link="{child}"/><!----></joint>'
)


class DriveSharesTest(unittest.TestCase):
    def test_a_shared_drive_accelerates_coupled_joints_as_they_are_coupled(self):
        robot = gripper()
        (mimic,) = robot.mimics
        source = robot.joint_names.index(mimic.source)
        shares = drive_shares(robot)
        each = np.eye(len(robot.joints))
        rates = np.vstack((each, mimic.multiplier * each[source]))
        assert_allclose(shares @ rates, each, atol=1e-9)
        follower = replace(robot.joints[source], name=mimic.joint)
        free = replace(robot, joints=(*robot.joints, follower), mimics=())
        home = np.append(robot.home, mimic.multiplier * robot.home[source] + mimic.offset)
        armature = [joint.drive.armature for joint in robot.joints]
        M = mass_matrix(free, home) + np.diag([*armature, 0.0])
        acceleration = np.linalg.solve(M, shares.T @ np.arange(1.0, 1 + len(robot.joints)))
        self.assertAlmostEqual(acceleration[-1], mimic.multiplier * acceleration[source], places=9)


class MechanismTest(unittest.TestCase):
    def test_every_shape_has_vertices(self):
        for kind, size, extent in (
            ("box", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
            ("hull", (0.1, 0.2, 0.3), (0.1, 0.2, 0.3)),
            ("sphere", (0.1,), (0.1, 0.1, 0.1)),
            ("cylinder", (0.1, 0.3), (0.1, 0.1, 0.3)),
            ("capsule", (0.1, 0.3), (0.1, 0.1, 0.4)),
        ):
            corners = vertices(placed(kind, size, (1.0, 2.0, 3.0)))
            assert_allclose(np.ptp(corners, axis=0) / 2, extent, rtol=0.01, err_msg=kind)
            assert_allclose(corners.max(axis=0) - extent, (1.0, 2.0, 3.0), atol=2e-3)

    def test_tracked_links_are_those_of_the_kinematics(self):
        made = mechanism(gripper())
        kinematics = Kinematics(made.robot)
        rng = np.random.default_rng(0)
        for _ in range(20):
            q = rng.uniform(-1.0, 1.0, len(made.robot.joints)) * np.pi
            moving = MovingJoints(made.robot, made.joint_names)
            pos, quat, linvel, angvel = TrackedLinks(made).locate(*moving.spread(q, q))
            links = kinematics.jacobian(torch.tensor(q), made.robot.tracked_links)
            assert_allclose(pos, links.pos, atol=1e-12)
            assert_allclose(
                Rotation.from_quat(quat, scalar_first=True).as_matrix(), links.rot, atol=1e-12
            )
            assert_allclose(linvel, links.linear.numpy() @ q, atol=1e-12)
            assert_allclose(angvel, links.angular.numpy() @ q, atol=1e-12)


class UrdfTest(InFolder):
    def urdf(self, *parts):
        path = self.folder / "robot.urdf"
        path.write_text(f'<robot name="toy"><link name="base"/>{"".join(parts)}</robot>')
        return path

    def with_mesh(self, name):
        """A URDF with a link ``end`` of the shape in a file."""
        shape = f'<collision><geometry><mesh filename="{name}"/></geometry></collision>'
        return self.urdf(f'<link name="end">{shape}</link>', FIXED.format(name="j", child="end"))

    def test_what_is_not_a_file_is_refused_at_once(self):
        pipe = self.folder / "pipe.urdf"
        os.mkfifo(pipe)
        for path in (pipe, self.folder, self.folder / "none.urdf", "x" * 5000):
            with self.assertRaisesRegex(RobotError, "is not a file. Expected a robot's URDF"):
                load_urdf(path)

    def test_a_changed_mesh_is_read_again(self):
        mesh = self.folder / "box.stl"
        trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
        path = self.with_mesh("box.stl")
        tree = load_urdf(path)
        with patch("xreset.geometry.urdf.parse_xml", side_effect=AssertionError):
            self.assertIs(load_urdf(path), tree)
        trimesh.creation.box((0.3, 0.1, 0.1)).export(mesh)
        os.utime(mesh, ns=(1, 1))
        vertices = np.asarray(load_urdf(path).link("end").collisions[0].geometry.vertices)
        self.assertAlmostEqual(np.ptp(vertices[:, 0]), 0.3)

    def test_collada_states_its_unit(self):
        mesh = self.folder / "box.dae"
        trimesh.creation.box((10, 20, 30)).export(mesh)
        unit = '<unit name="centimeter" meter="0.01"/></asset>'
        mesh.write_text(mesh.read_text().replace("</asset>", unit))
        tree = load_urdf(self.with_mesh("box.dae"))
        vertices = np.asarray(tree.link("end").collisions[0].geometry.vertices)
        assert_allclose(np.ptp(vertices, axis=0), (0.1, 0.2, 0.3))

    def test_shapes_and_defaults(self):
        origin = f'<origin xyz="1 2 3" rpy="0 0 {np.pi / 2}"/>'
        shapes = (
            ('box size="2 4 6"', ("box", (1, 2, 3))),
            ('sphere radius="1"', ("sphere", (1,))),
            ('cylinder radius="1" length="4"', ("cylinder", (1, 2))),
            ('capsule radius="1" length="4"', ("capsule", (1, 2))),
        )
        collisions = "".join(
            f"<collision>{origin}<geometry><{shape}/></geometry></collision>" for shape, _ in shapes
        )
        joint = FIXED.format(name="j", child="end").replace("fixed", "continuous")
        visuals = collisions.replace("collision>", "visual>")
        tree = load_urdf(self.urdf(f'<link name="end">{collisions}{visuals}</link>', joint))
        found = tree.link("end").collisions
        for shape, (_, expected) in zip(found, shapes, strict=True):
            self.assertEqual((shape.geometry.kind, shape.geometry.size), expected)
        turned = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
        assert_allclose(found[0].T_body_shape, turned, atol=1e-12)
        found = tree.joint("j")
        self.assertEqual((found.type, found.lower, found.upper), ("revolute", -np.inf, np.inf))
        assert_array_equal(found.axis, (1, 0, 0))
        self.assertEqual(tree.link("end").mass, 0)
        moments = '<inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="3"/>'
        inertial = f'<inertial>{origin}<mass value="1"/>{moments}</inertial>'
        end = load_urdf(self.urdf(f'<link name="end">{inertial}</link>', joint)).link("end")
        assert_allclose(end.inertia, np.diag((2, 1, 3)), atol=1e-12)
        assert_array_equal(end.com, (1, 2, 3))

    def test_a_limit_of_zero_is_none(self):
        """SolidWorks and other programs write it where nothing was stated."""
        limit = '<limit lower="0" upper="1" effort="0" velocity="0"/></joint>'
        joint = FIXED.format(name="j", child="end").replace("fixed", "revolute")
        tree = load_urdf(self.urdf('<link name="end"/>', joint.replace("</joint>", limit)))
        found = tree.joint("j")
        self.assertEqual((found.effort, found.velocity, found.lower), (0.0, np.inf, 0.0))

    def test_what_is_written_reads_back(self):
        """Also links whose names differ in a slash only, and a comment with two hyphens."""
        links = [frame("base")]
        for name, size in (("f/1", 0.1), ("f_1", 0.2)):
            shape = hull(size * np.vstack((np.zeros(3), np.eye(3))))
            links.append(replace(frame(name), collisions=(shape,), inertia=np.eye(3) * 2e-13))
        joints = []
        for link, pitch in zip(links[1:], (0.2, np.pi / 2), strict=True):
            joints.append(fixed("base", link.name, pose((1, 2, 3), rpy=(0.1, pitch, 0.3))))
        tree = RobotTree(name="toy", root="base", links=tuple(links), joints=tuple(joints))
        path = self.folder / "robot.urdf"
        path.write_text(urdf_text(tree, "made by --hand"))
        write_meshes(tree, self.folder)
        read = load_urdf(path)
        self.assertEqual(read.link_names, tree.link_names)
        for found, joint in zip(read.joints, joints, strict=True):
            assert_allclose(found.T_parent_joint, joint.T_parent_joint, atol=1e-8)
        sizes = [float(np.max(link.collisions[0].geometry.vertices)) for link in read.links[1:]]
        assert_allclose(sizes, (0.1, 0.2))
        assert_allclose(read.link("f_1").inertia, np.eye(3) * 2e-13)

    def test_meshes_that_are_archives_and_other_files_are_refused(self):
        (self.folder / "box.zip").write_bytes(b"PK")
        path = self.with_mesh("box.zip")
        self.assertRaisesRegex(RobotError, "is an archive. Unpack it", load_urdf, path)
        path.write_text("<mujocoinclude/>")
        with self.assertRaisesRegex(RobotError, "starts with <mujocoinclude>.*Expected <robot>"):
            load_urdf(path)

    def test_what_is_not_a_tree_of_links_is_refused(self):
        link = '<link name="end"/>'
        joint = FIXED.format(name="j", child="end")
        revolute = joint.replace("fixed", "revolute").replace("<!---->", '<axis xyz="{}"/>')
        for parts, message in (
            ((link, link, joint), "occurs twice"),
            ((link,), "expected one root link, found 2"),
            ((joint,), "names link 'end'"),
            ((link, joint, joint), "child of two joints"),
            ((link, joint.replace("fixed", "floating")), "type 'floating'"),
            ((link, '<joint name="j" type="fixed"/>'), "no parent link"),
            ((link, joint.replace('name="j"', "")), "a joint has no name"),
            ((link.replace("end", "e&#155;d"),), "control characters"),
            ((link, revolute.format("1 0")), "expected 3 numbers"),
            ((link, revolute.format("0 0 0")), "expected a direction"),
        ):
            with refuses(self, message, RobotError):
                load_urdf(self.urdf(*parts))


class KinematicsTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.robot = toy_hand_arm(cls.folder)
        cls.kinematics = Kinematics(cls.robot)
        cls.q = cls.drawn(cls.kinematics, 3, 5)

    @staticmethod
    def drawn(kinematics, *shape):
        """[*shape, J] joint positions within the limits."""
        low = kinematics.lower
        generator = torch.Generator().manual_seed(0)
        return low + (kinematics.upper - low) * torch.rand(
            *shape, len(low), dtype=FLOAT, generator=generator
        )

    def test_link_poses_agree_with_mujoco(self):
        import mujoco

        others = [(robots.load(name), 1e-6) for name in ("ur7e-sharpa", "openarm")]
        for robot, atol in ((self.robot, 1e-9), *others):
            kinematics = Kinematics(robot)
            description = mujoco.MjSpec.from_file(str(robot.urdf))
            description.compiler.fusestatic = False
            model = description.compile()
            data = mujoco.MjData(model)
            for q in self.drawn(kinematics, 10):
                for name, position in zip(robot.joint_names, q.tolist(), strict=True):
                    data.joint(name).qpos = position
                for mimic in robot.mimics:
                    data.joint(mimic.joint).qpos = (
                        mimic.multiplier * data.joint(mimic.source).qpos + mimic.offset
                    )
                mujoco.mj_kinematics(model, data)
                poses = kinematics.link_poses(q, base=torch.eye(4, dtype=FLOAT)).numpy()
                for name, T in zip(kinematics.link_names[1:], poses[1:], strict=True):
                    assert_allclose(T[:3, 3], data.body(name).xpos, atol=atol, err_msg=name)
                    assert_allclose(
                        T[:3, :3].ravel(), data.body(name).xmat, atol=atol, err_msg=name
                    )

    def test_jacobian_is_the_derivative(self):
        links = ["tip_a", "finger_a2", "palm", "tip_b"]
        offsets = torch.tensor(
            [[0.01, 0.02, -0.03], [0, 0, 0], [0.1, 0, 0], [0, 0.01, 0]], dtype=FLOAT
        )
        jacobian = self.kinematics.jacobian(self.q, links, offsets)
        assert_close(jacobian.pos, self.kinematics.points(self.q, links, offsets))
        for j in range(self.q.shape[-1]):
            T = slope(lambda q: self.kinematics.link_poses(q, links), self.q, (..., j))
            points = T[..., :3, 3] + (T[..., :3, :3] @ offsets[..., None])[..., 0]
            assert_close(jacobian.linear[..., j], points, atol=1e-8, rtol=0)
            # the cross-product matrix of the angular velocity
            spin = T[..., :3, :3] @ jacobian.rot.mT
            omega = torch.stack((spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]), dim=-1)
            assert_close(jacobian.angular[..., j], omega, atol=1e-8, rtol=0)

    def test_motion_agrees_with_poses_and_jacobian(self):
        for robot in (self.robot, gripper(), robots.load("openarm")):
            kinematics = Kinematics(robot)
            q = self.drawn(kinematics, 4)
            qd = self.drawn(kinematics, 4).flip(0)
            for links in (robot.tracked_links, kinematics.link_names):
                pos, rot, linear, angular = kinematics.motion(q, qd, links)
                jacobian = kinematics.jacobian(q, links)
                assert_close(pos, jacobian.pos, atol=1e-12, rtol=0)
                assert_close(rot, jacobian.rot, atol=1e-12, rtol=0)
                for found, columns in ((linear, jacobian.linear), (angular, jacobian.angular)):
                    expected = (columns @ qd[:, None, :, None])[..., 0]
                    assert_close(found, expected, atol=1e-12, rtol=0)

    def test_base_places_the_robot_in_the_world(self):
        poses = self.kinematics.link_poses(self.q)
        root = poses[0, 0, self.kinematics.link_index(self.kinematics.root)]
        assert_allclose(root[:3, 3], self.robot.base_pos)
        shift = torch.eye(4, dtype=FLOAT)
        shift[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
        moved = self.kinematics.link_poses(self.q, base=shift @ self.kinematics.base)
        assert_close(moved, shift @ poses, atol=1e-12, rtol=0)

    def test_a_subtree_moves_as_in_the_whole(self):
        hand = Kinematics(self.robot, root="palm")
        self.assertEqual(
            hand.joint_names, tuple(self.robot.joint_names[i] for i in self.robot.hand_indices)
        )
        whole = self.kinematics.link_poses(self.q, hand.link_names)
        palm = self.kinematics.link_poses(self.q, ["palm"])[..., 0, :, :]
        assert_close(
            hand.link_poses(self.q[..., hand.joint_indices], base=palm), whole, atol=1e-12, rtol=0
        )

    def test_limits_take_the_mimic_joint_into_account(self):
        # Joints are in the order of the description. The mimic, at half its travel, is the first to end.
        jaw = self.robot.joint_names.index("jaw_a")
        self.assertAlmostEqual(self.kinematics.upper[jaw].item(), 0.025)
        (mimic,) = self.robot.mimics
        backwards = replace(self.robot, mimics=(replace(mimic, multiplier=-1.0),))
        self.assertAlmostEqual(Kinematics(backwards).upper[jaw].item(), 0.005)

    def test_errors_name_the_cause(self):
        with self.assertRaisesRegex(RobotError, "no link 'nose' below"):
            self.kinematics.points(self.q, ["nose"])
        with self.assertRaisesRegex(ValueError, "q has 2 joint positions, expected "):
            self.kinematics.link_poses(torch.zeros(2))
        renamed = self.folder / "other.urdf"
        renamed.write_text(self.robot.urdf.read_text().replace('"arm_2"', '"arm_two"'))
        passive = replace(self.robot.mimics[0], source="jaw_b")
        for changes, cause in (
            ({"mimics": ()}, "'jaw_b' moves, but the description neither"),
            ({"mimics": (passive,)}, "follow jaw_b, which the description does not actuate"),
            ({"urdf": renamed}, "arm_two"),
        ):
            with self.assertRaisesRegex(RobotError, cause):
                Kinematics(replace(self.robot, **changes))
