import dataclasses
import os
import tempfile
import unittest
from pathlib import Path

import numpy as np
import torch
import trimesh

from tests.toy_robot import toy_hand_arm, write_urdf
from xreset import robots
from xreset.backends.conformance.scene import gripper
from xreset.errors import RobotError
from xreset.geometry.dynamics import drive_shares, mass_matrix
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.urdf import load_urdf
from xreset.spec import DriveSpec, JointSpec

FIXED = '<joint name="{name}" type="fixed"><parent link="base"/><child link="{child}"/><!----></joint>'


class DriveSharesTest(unittest.TestCase):
    def test_a_shared_drive_accelerates_coupled_joints_as_they_are_coupled(self):
        robot = gripper()
        (mimic,) = robot.mimics
        source = robot.joint_names.index(mimic.source)
        shares = drive_shares(robot)
        rates = np.vstack((np.eye(len(robot.joints)), mimic.multiplier * np.eye(len(robot.joints))[source]))
        np.testing.assert_allclose(shares @ rates, np.eye(len(robot.joints)), atol=1e-9)
        follower = JointSpec(name=mimic.joint, group="hand", drive=DriveSpec(kp=0, kd=0, effort=0), home=0.0)
        free = dataclasses.replace(robot, joints=(*robot.joints, follower), mimics=())
        home = np.append(robot.home, mimic.multiplier * robot.home[source] + mimic.offset)
        M = mass_matrix(free, home) + np.diag([joint.drive.armature for joint in free.joints])
        acceleration = np.linalg.solve(M, shares.T @ np.random.default_rng(0).normal(size=len(robot.joints)))
        self.assertAlmostEqual(acceleration[-1], mimic.multiplier * acceleration[source], places=9)

    def test_without_mimic_joints_a_drive_is_its_joints_own(self):
        robot = robots.load("ur7e-sharpa")
        np.testing.assert_array_equal(drive_shares(robot), np.eye(len(robot.joints)))


class UrdfTest(unittest.TestCase):
    def setUp(self):
        self.folder = Path(self.enterContext(tempfile.TemporaryDirectory()))

    def urdf(self, *parts: str) -> Path:
        path = self.folder / "robot.urdf"
        path.write_text(f'<robot name="toy"><link name="base"/>{"".join(parts)}</robot>')
        return path

    def test_a_changed_mesh_is_read_again(self):
        mesh = self.folder / "box.stl"
        trimesh.creation.box((0.1, 0.1, 0.1)).export(mesh)
        shape = '<collision><geometry><mesh filename="box.stl"/></geometry></collision>'
        path = self.urdf(f'<link name="end">{shape}</link>', FIXED.format(name="j", child="end"))
        self.assertIs(load_urdf(path), load_urdf(path))
        trimesh.creation.box((0.3, 0.1, 0.1)).export(mesh)
        os.utime(mesh, ns=(1, 1))
        vertices = np.asarray(load_urdf(path).link("end").collisions[0].geometry.vertices)
        self.assertAlmostEqual(np.ptp(vertices[:, 0]), 0.3)

    def test_shapes_and_defaults(self):
        shapes = '<box size="2 4 6"/>', '<sphere radius="1"/>', '<cylinder radius="1" length="4"/>'
        collisions = "".join(
            f'<collision><origin xyz="1 2 3" rpy="0 0 {np.pi / 2}"/><geometry>{shape}</geometry></collision>'
            for shape in (*shapes, '<capsule radius="1" length="4"/>')
        )
        joint = FIXED.format(name="j", child="end").replace("fixed", "continuous")
        tree = load_urdf(self.urdf(f'<link name="end">{collisions}</link>', joint))
        found = [(shape.geometry.kind, shape.geometry.size) for shape in tree.link("end").collisions]
        kinds = [("box", (1, 2, 3)), ("sphere", (1,)), ("cylinder", (1, 2)), ("capsule", (1, 2))]
        self.assertEqual(found, kinds)
        turned = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
        np.testing.assert_allclose(tree.link("end").collisions[0].T_body_shape, turned, atol=1e-12)
        joint = tree.joint("j")
        self.assertEqual((joint.type, joint.lower, joint.upper), ("revolute", -np.inf, np.inf))
        np.testing.assert_array_equal(joint.axis, (1, 0, 0))
        self.assertEqual(tree.link("end").mass, 0)

    def test_what_is_no_tree_of_links_is_refused(self):
        link = '<link name="end"/>'
        joint = FIXED.format(name="j", child="end")
        for parts, message in (
            ((link, link, joint), "occurs twice"),
            ((link,), "expected one root link, found 2"),
            ((joint,), "names link 'end'"),
            ((link, joint, joint), "child of two joints"),
            ((link, joint.replace("fixed", "floating")), "type 'floating'"),
            ((link, '<joint name="j" type="fixed"/>'), "no parent link"),
            ((link, joint.replace('name="j"', "")), "KeyError"),
            ((link.replace("end", "e&#155;d"),), "control characters"),
            ((link, joint.replace("fixed", "revolute").replace("<!---->", '<axis xyz="1 0"/>')), "expected 3 numbers"),
            (
                (link, joint.replace("fixed", "revolute").replace("<!---->", '<axis xyz="0 0 0"/>')),
                "expected a direction",
            ),
        ):
            with self.subTest(message), self.assertRaisesRegex(RobotError, message):
                load_urdf(self.urdf(*parts))


class KinematicsTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = toy_hand_arm(cls.folder)
        cls.kinematics = Kinematics(cls.robot)
        generator = torch.Generator().manual_seed(0)
        low, high = cls.kinematics.lower, cls.kinematics.upper
        cls.q = low + (high - low) * torch.rand(3, 5, len(low), dtype=torch.float64, generator=generator)

    def test_link_poses_agree_with_mujoco(self):
        import mujoco

        model = mujoco.MjModel.from_xml_path(str(self.robot.urdf))
        data = mujoco.MjData(model)
        kinematics = self.kinematics
        identity = torch.eye(4, dtype=torch.float64)
        poses = kinematics.link_poses(self.q, base=identity)
        mimics = {mimic.joint: mimic for mimic in self.robot.mimics}
        for index in np.ndindex(3, 5):
            for j in range(model.njnt):
                name = model.joint(j).name
                mimic = mimics.get(name)
                value = self.q[index][kinematics.joint_names.index(mimic.source if mimic else name)].item()
                data.qpos[model.jnt_qposadr[j]] = mimic.multiplier * value + mimic.offset if mimic else value
            mujoco.mj_kinematics(model, data)
            for i, name in enumerate(kinematics.link_names):
                if name == kinematics.root:
                    continue
                body = model.body(name).id
                np.testing.assert_allclose(poses[index][i, :3, 3], data.xpos[body], atol=1e-9)
                np.testing.assert_allclose(poses[index][i, :3, :3], data.xmat[body].reshape(3, 3), atol=1e-9)

    def test_jacobian_is_the_derivative(self):
        links = ["tip_a", "finger_a2", "palm", "tip_b"]
        offsets = torch.tensor([[0.01, 0.02, -0.03], [0, 0, 0], [0.1, 0, 0], [0, 0.01, 0]], dtype=torch.float64)
        jacobian = self.kinematics.jacobian(self.q, links, offsets)
        torch.testing.assert_close(jacobian.pos, self.kinematics.points(self.q, links, offsets))
        step = 1e-6
        for j in range(self.q.shape[-1]):
            shift = torch.zeros(self.q.shape[-1], dtype=torch.float64)
            shift[j] = step
            ahead, behind = (
                self.kinematics.link_poses(self.q + shift, links),
                self.kinematics.link_poses(self.q - shift, links),
            )
            points = [T[..., :3, 3] + (T[..., :3, :3] @ offsets[..., None])[..., 0] for T in (ahead, behind)]
            torch.testing.assert_close(jacobian.linear[..., j], (points[0] - points[1]) / (2 * step), atol=1e-8, rtol=0)
            spin = (
                (ahead - behind)[..., :3, :3] / (2 * step) @ jacobian.rot.mT
            )  # the cross-product matrix of the angular velocity
            omega = torch.stack((spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]), dim=-1)
            torch.testing.assert_close(jacobian.angular[..., j], omega, atol=1e-8, rtol=0)

    def test_base_places_the_robot_in_the_world(self):
        kinematics = self.kinematics
        root = kinematics.link_poses(self.q, [kinematics.root])[0, 0, 0]
        np.testing.assert_allclose(root[:3, 3], self.robot.base_pos)
        moved = torch.eye(4, dtype=torch.float64)
        moved[:3, 3] = torch.tensor([1.0, 2.0, 3.0])
        torch.testing.assert_close(
            kinematics.link_poses(self.q, base=moved @ kinematics.base),
            moved @ kinematics.link_poses(self.q),
            atol=1e-12,
            rtol=0,
        )

    def test_a_subtree_moves_as_in_the_whole(self):
        hand = Kinematics(self.robot, root="palm")
        self.assertEqual(hand.joint_names, tuple(self.robot.joint_names[i] for i in self.robot.hand_indices))
        whole = self.kinematics.link_poses(self.q, hand.link_names)
        palm = self.kinematics.link_poses(self.q, ["palm"])[..., 0, :, :]
        torch.testing.assert_close(
            hand.link_poses(self.q[..., hand.joint_indices], base=palm), whole, atol=1e-12, rtol=0
        )

    def test_joint_order_is_the_descriptions(self):
        self.assertEqual(self.kinematics.joint_names, self.robot.joint_names)
        self.assertNotEqual(
            self.robot.joint_names,
            tuple(j.name for j in self.kinematics.tree.joints if j.name in self.robot.joint_names),
        )

    def test_limits_take_the_mimic_joint_into_account(self):
        column = self.robot.joint_names.index("jaw_a")
        self.assertAlmostEqual(
            self.kinematics.upper[column].item(), 0.025
        )  # the mimic, at half its travel, is the first to end

    def test_errors_name_the_cause(self):
        with self.assertRaisesRegex(RobotError, "no link 'nose' below"):
            self.kinematics.points(self.q, ["nose"])
        with self.assertRaisesRegex(ValueError, "expected"):
            self.kinematics.link_poses(self.q[..., :2])

        passive = dataclasses.replace(self.robot, mimics=())
        with self.assertRaisesRegex(RobotError, "jaw_b"):
            Kinematics(passive)
        misnamed = dataclasses.replace(
            self.robot, urdf=write_urdf(self.folder / "other.urdf", rename={"arm_2": "arm_two"})
        )
        with self.assertRaisesRegex(RobotError, "arm_two"):
            Kinematics(misnamed)


if __name__ == "__main__":
    unittest.main()
