"""Robots from what makers publish: an arm and a hand, URDF or MJCF, to a folder that passes the check."""

import contextlib
import io
import lzma
import os
import re
import tarfile
import tempfile
import unittest
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from tests.data import DEFAULT
from xreset.cli import main
from xreset.description import load_robot
from xreset.errors import BackendUnavailableError, RobotError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.urdf import load_urdf
from xreset.objects.catalogue import load_object
from xreset.plugins import make_backend
from xreset.robot_tools import check as checks
from xreset.robot_tools import homes
from xreset.robot_tools.check import check
from xreset.robot_tools.importer import import_robot
from xreset.robot_tools.sources import bare, combined, read_source, renamed
from xreset.spec import SceneSpec

ARCHIVES = DEFAULT.parent / "robots"
"""Where a development checkout has descriptions as their makers publish them."""

_FINGER = """
<link name="{0}_a"><inertial><mass value="0.05"/><origin xyz="0.02 0 0"/>
  <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.02 0 0"/><geometry><box size="0.036 0.014 0.014"/></geometry></collision></link>
<link name="{0}_b"><inertial><mass value="0.03"/><origin xyz="0.02 0 0"/>
  <inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.02 0 0"/><geometry><box size="0.036 0.014 0.014"/></geometry></collision></link>
<joint name="{0}_1" type="revolute"><parent link="base"/><child link="{0}_a"/><origin xyz="{1}" rpy="{2}"/><axis xyz="0 1 0"/>
  <limit lower="0" upper="1.5" effort="1" velocity="5"/></joint>
<joint name="{0}_2" type="revolute"><parent link="{0}_a"/><child link="{0}_b"/><origin xyz="0.045 0 0"/><axis xyz="0 1 0"/>
  <limit lower="0" upper="1.5" effort="1" velocity="5"/><mimic joint="{0}_1" multiplier="0.8" offset="0.1"/></joint>"""
"""A finger along x that bends towards -z; its second joint follows the first."""
_PALM = """<link name="base"><inertial><mass value="0.4"/><origin xyz="0.04 0 0"/>
  <inertia ixx="3e-4" iyy="3e-4" izz="5e-4" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.04 0 0"/><geometry><box size="0.08 0.08 0.02"/></geometry></collision></link>"""
_PLACES = {
    "f1": ("0.085 0.03 0", "0 0 0"),
    "f2": ("0.085 0 0", "0 0 0"),
    "f3": ("0.085 -0.03 0", "0 0 0"),
    "thumb": ("0.02 0.045 0", "0 0 0.9"),
}
"""The fourth is a right hand's thumb: seen from the back of the hand, fingers up, it is on the left."""
HAND = (
    '<robot name="hand">'
    + _PALM
    + "".join(_FINGER.format(name, *place) for name, place in _PLACES.items())
    + "</robot>"
)

ARM = '<robot name="arm"><link name="base"><collision><geometry><cylinder radius="0.06" length="0.1"/></geometry></collision></link>'
for _number, (_xyz, _axis) in enumerate(
    [
        ("0 0 0.15", "0 0 1"),
        ("0 0 0.1", "0 1 0"),
        ("0 0 0.4", "0 1 0"),
        ("0 0 0.2", "0 0 1"),
        ("0 0 0.2", "0 1 0"),
        ("0 0 0.1", "0 0 1"),
    ]
):
    ARM += f"""<link name="l{_number}"><inertial><mass value="2"/><origin xyz="0 0 0.03"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
      <collision><origin xyz="0 0 0.03"/><geometry><cylinder radius="0.03" length="0.05"/></geometry></collision></link>
      <joint name="j{_number}" type="revolute"><parent link="{f"l{_number - 1}" if _number else "base"}"/><child link="l{_number}"/>
      <origin xyz="{_xyz}"/><axis xyz="{_axis}"/><limit lower="-2.9" upper="2.9" effort="60" velocity="3"/></joint>"""
ARM += "</robot>"

_MJCF_FINGER = """<body name="{0}_a" pos="{1}" euler="{2}"><inertial pos="0.02 0 0" mass="0.05" diaginertia="1e-5 1e-5 1e-5"/>
  <joint name="{0}_1" axis="0 1 0" range="0 1.5"/><geom type="box" pos="0.02 0 0" size="0.018 0.007 0.007"/>
  <body name="{0}_b" pos="0.045 0 0"><inertial pos="0.02 0 0" mass="0.03" diaginertia="1e-5 1e-5 1e-5"/>
  <joint name="{0}_2" axis="0 1 0" range="0 1.5"/><geom type="box" pos="0.02 0 0" size="0.018 0.007 0.007"/></body></body>"""
MJCF = (
    '<mujoco model="hand"><compiler angle="radian" eulerseq="XYZ"/><worldbody><body name="base">'
    '<inertial pos="0.04 0 0" mass="0.4" diaginertia="3e-4 3e-4 5e-4"/><geom type="box" pos="0.04 0 0" size="0.04 0.04 0.01"/>'
    + "".join(_MJCF_FINGER.format(name, *place) for name, place in _PLACES.items())
    + "</body></worldbody><equality>"
    + "".join(f'<joint joint1="{name}_2" joint2="{name}_1" polycoef="0.1 0.8 0 0 0"/>' for name in _PLACES)
    + '</equality><actuator><position joint="f1_1" kp="3" kv="0.2" forcerange="-2 2"/></actuator></mujoco>'
)


_SIDE = """<body name="{0}_arm" pos="0 0.02 0.05" {1}><inertial pos="0 0.01 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/>
  <joint name="{0}_crank" axis="1 0 0" range="0 0.8"/><geom type="box" pos="0 0.02 0.015" size="0.005 0.02 0.004"/>
  <body name="{0}_pad" pos="0 0.04 0.03"><inertial pos="0 0 0.02" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/>
  <joint name="{0}_finger" axis="1 0 0" range="-1 1"/><geom type="box" pos="0 0 0.025" size="0.01 0.004 0.02"/></body></body>
  <body name="{0}_rod" pos="0 {2} 0.07" {1}><inertial pos="0 0.01 0" mass="0.02" diaginertia="1e-5 1e-5 1e-5"/>
  <joint name="{0}_rocker" axis="1 0 0" range="-1 1"/><geom type="capsule" fromto="0 0 0 0 0.03 0.02" size="0.004"/></body>"""
JAW = (
    '<mujoco model="jaw"><compiler angle="radian"/><worldbody><body name="mount"><geom type="box" pos="0 0 0.02" '
    'size="0.03 0.03 0.02"/>'
    + _SIDE.format("l", "", 0.02)
    + _SIDE.format("r", 'quat="0 0 0 1"', -0.02).replace('pos="0 0.02 0.05"', 'pos="0 -0.02 0.05"')
    + '</body></worldbody><equality><connect name="left" body1="l_rod" body2="l_pad" anchor="0 0.04 0.03"/>'
    '<connect name="right" body1="r_rod" body2="r_pad" anchor="0 0.04 0.03"/>'
    '<joint joint1="r_crank" joint2="l_crank"/></equality>'
    '<actuator><position joint="l_crank" kp="20" forcerange="-5 5"/></actuator></mujoco>'
)
"""Two fingers on parallelograms: rods that are pinned to the pads keep these parallel."""


class WithFolder(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def file(self, name, text):
        path = self.folder / name
        path.write_text(text)
        return path


class Toy(WithFolder):
    def setUp(self):
        super().setUp()
        self.arm = self.file("arm.urdf", ARM)
        self.hand = self.file("hand.urdf", HAND)

    def test_a_folder_that_passes_the_check_and_says_what_it_guessed(self):
        made = import_robot(self.arm, self.hand, self.folder / "mine")
        folder = made.folder
        spec = load_robot(folder)
        found = check(folder)
        self.assertEqual([f"{f.topic}: {f.message}" for f in found if f.level == "error"], [])
        self.assertEqual(spec.fingertip_names, ("thumb", "index", "middle", "ring"))
        self.assertEqual(
            [tip.contact_links for tip in spec.fingertips], [("thumb_b",), ("f1_b",), ("f2_b",), ("f3_b",)]
        )
        self.assertEqual(len(spec.hand_indices), 4)
        self.assertEqual(
            {(m.joint, m.multiplier, m.offset) for m in spec.mimics}, {(f"{finger}_2", 0.8, 0.1) for finger in _PLACES}
        )
        notes = "\n".join(made.guessed)
        self.assertIn("fingers are named from the thumb's side on: index is f1_b; middle is f2_b", notes)
        self.assertIn("the hand is turned by --rpy 0 -1.5708 0: its fingers point along", notes)
        self.assertRegex(made.to_say[0], r"its fingers point along \(0.05, 0.00, 1.00\).*The angle about z is yours")
        self.assertEqual([path.name for path in self.folder.iterdir() if path.name.startswith(".")], [])
        keypoints = {point.keypoint: point.link for point in spec.keypoints}
        self.assertEqual([keypoints[f"index{i}"] for i in (1, 2, 4)], ["f1_a", "f1_b", "index_tip_frame"])

    def test_home_is_within_the_limits_after_rounding(self):
        narrow = self.file("narrow.urdf", ARM.replace('lower="-2.9" upper="2.9"', 'lower="0.123446" upper="0.2"'))
        spec = load_robot(import_robot(narrow, self.hand, self.folder / "mine").folder)
        self.assertEqual(spec.home[spec.arm_indices].tolist(), [0.1235] * 6)

    def test_strong_drives_of_light_joints_are_stable(self):
        strong = self.file("strong.urdf", ARM.replace('effort="60"', 'effort="300"'))
        folder = import_robot(strong, self.hand, self.folder / "mine").folder
        spec = load_robot(folder)
        found = check(folder)
        self.assertEqual([f.level for f in found if f.topic == "drives"], ["ok"])
        self.assertEqual(spec.joints[0].drive.kp, 2000)

    def test_home_keeps_off_the_table_where_it_can(self):
        robot = load_robot("ur7e-sharpa")
        with mock.patch.object(homes, "_CLEAR", 0.4):
            T = Kinematics(robot).link_poses(torch.tensor(robot.home), [robot.hand_root])[0].numpy()
            home = homes.reach_near(robot, T)
        self.assertRegex(home.moved, r", moved by \(.*, 15\) cm")
        q = torch.tensor(robot.home)
        q[torch.as_tensor(robot.arm_indices)] = torch.tensor(home.joints, dtype=q.dtype)
        self.assertGreater(float(homes.table_clearance(robot, q[None])), 0.4)

    def test_names_of_the_shadow_hand(self):
        shadow = HAND
        for old, new in (("f1", "rh_LF"), ("f2", "rh_MF"), ("f3", "rh_TH"), ("thumb", "rh_FF")):
            shadow = shadow.replace(f"{old}_a", f"{new}proximal").replace(f"{old}_b", f"{new}middle")
        spec = load_robot(import_robot(self.arm, self.file("sh.urdf", shadow), self.folder / "mine").folder)
        links = {tip.name: tip.contact_links for tip in spec.fingertips}
        self.assertEqual(
            links,
            {
                "thumb": ("rh_THmiddle",),
                "index": ("rh_FFmiddle",),
                "middle": ("rh_MFmiddle",),
                "little": ("rh_LFmiddle",),
            },
        )

    def test_a_coupled_joint_has_the_limits_that_its_source_gives_it(self):
        narrow = HAND.replace(
            '<limit lower="0" upper="1.5" effort="1" velocity="5"/><mimic',
            '<limit lower="0" upper="1" effort="1"/><mimic',
        )
        folder = import_robot(self.arm, self.file("narrow.urdf", narrow), self.folder / "mine").folder
        tree = load_urdf(folder / "robot.urdf")
        np.testing.assert_allclose((tree.joint("f1_2").lower, tree.joint("f1_2").upper), (0.1, 1.3))
        text = (folder / "robot.urdf").read_text()
        (folder / "robot.urdf").write_text(text.replace('upper="1.3"', 'upper="1"'))
        found = [f.message for f in check(folder) if f.level == "error"]
        self.assertEqual(len(found), 4, found)
        self.assertIn("'f1_2' goes from 0.1 to 1.3 with 'f1_1', beyond its own limits", found[0])

    def test_origins_beside_a_finger_do_not_turn_its_palm(self):
        beside = HAND
        for name, (
            xyz,
            rpy,
        ) in _PLACES.items():  # every knuckle's origin 15 mm along its axis; the links stay where they are
            x, y, z = (float(v) for v in xyz.split())
            if rpy == "0 0 0":
                beside = beside.replace(
                    f'<child link="{name}_a"/><origin xyz="{xyz}"',
                    f'<child link="{name}_a"/><origin xyz="{x} {y + 0.015} {z}"',
                )
                head, tail = beside.split(f'<link name="{name}_a">')
                link, rest = tail.split("</link>", 1)
                beside = f'{head}<link name="{name}_a">{link.replace("0.02 0 0", "0.02 -0.015 0")}</link>{rest}'
                beside = beside.replace(
                    f'<parent link="{name}_a"/><child link="{name}_b"/><origin xyz="0.045 0 0"',
                    f'<parent link="{name}_a"/><child link="{name}_b"/><origin xyz="0.045 -0.015 0"',
                )
        spec = load_robot(import_robot(self.arm, self.file("beside.urdf", beside), self.folder / "mine").folder)
        kinematics = Kinematics(spec)
        poses = dict(zip(kinematics.link_names, kinematics.link_poses(torch.tensor(spec.home)).numpy(), strict=True))
        in_hand = np.linalg.inv(poses["hand_base"]) @ poses["palm_frame"]
        self.assertAlmostEqual(in_hand[1, 0], 0.0, delta=0.01)
        knuckle = np.linalg.inv(poses["hand_base"]) @ poses[{p.keypoint: p.link for p in spec.keypoints}["index1"]]
        np.testing.assert_allclose(knuckle[:3, 3], (0.085, 0.03, 0), atol=1e-6)

    def test_the_palm_looks_where_the_fingers_bend(self):
        spec = load_robot(import_robot(self.arm, self.hand, self.folder / "mine").folder)
        kinematics = Kinematics(spec)
        poses = dict(zip(kinematics.link_names, kinematics.link_poses(torch.tensor(spec.home)).numpy(), strict=True))
        in_hand = np.linalg.inv(poses["hand_base"]) @ poses["palm_frame"]
        np.testing.assert_allclose(in_hand[:3, :3], np.stack([(1, 0, 0), (0, -1, 0), (0, 0, -1)], axis=1), atol=0.06)
        np.testing.assert_allclose(
            poses["palm_frame"][:3, 2], (0, 0, -1), atol=0.05
        )  # at home it looks down at the table

    def test_check_warns_of_a_turned_palm_and_of_placeholders_for_inertias(self):
        folder = import_robot(self.arm, self.hand, self.folder / "mine").folder
        text = (folder / "robot.urdf").read_text()
        turned, count = re.subn(
            r'(name="palm_frame_fixed"[^>]*>\s*<origin xyz="[^"]*" rpy=")[^"]*', r"\g<1>0 1.5708 0", text
        )
        self.assertEqual(count, 1)
        turned, count = re.subn(
            r'(<link name="f1_a">[\s\S]*?<inertia )[^/]*',
            r'\1ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0" ',
            turned,
            count=1,
        )
        (folder / "robot.urdf").write_text(turned)
        warnings = "\n".join(f.message for f in check(folder) if f.level == "warning")
        self.assertRegex(warnings, r"lie along z of the palm 'palm_frame'")
        self.assertRegex(warnings, r"'f1_a' has a moment of 0.1 kg m\^2; 0.05 kg of its size")

    def test_mjcf_is_the_same_hand(self):
        mjcf = read_source(self.file("hand.xml", MJCF))
        urdf = read_source(self.hand)
        self.assertEqual(mjcf.tree.link_names, urdf.tree.link_names)
        for a, b in zip(mjcf.tree.joints, urdf.tree.joints, strict=True):
            self.assertEqual((a.name, a.type, a.lower, a.upper), (b.name, b.type, b.lower, b.upper))
            np.testing.assert_allclose(a.T_parent_joint, b.T_parent_joint, atol=1e-6)
        for a, b in zip(mjcf.tree.links, urdf.tree.links, strict=True):
            np.testing.assert_allclose(
                np.r_[a.mass, a.com, a.inertia.ravel()], np.r_[b.mass, b.com, b.inertia.ravel()], atol=1e-9
            )
            self.assertEqual([s.geometry.size for s in a.collisions], [s.geometry.size for s in b.collisions])
        self.assertEqual(mjcf.tree.mimics, urdf.tree.mimics)
        self.assertEqual((mjcf.stiffness, mjcf.tree.joint("f1_1").effort), ({"f1_1": 3.0}, 2.0))

    def test_what_mjcf_has_and_robots_do_not_is_named_one_by_one(self):
        ball = MJCF.replace('<joint name="f1_2" axis="0 1 0" range="0 1.5"/>', '<joint name="f1_2" type="ball"/>')
        ball = ball.replace('<joint joint1="f1_2" joint2="f1_1" polycoef="0.1 0.8 0 0 0"/>', "")
        ball = ball.replace('type="box" pos="0.04 0 0"', 'name="egg" type="ellipsoid" pos="0.04 0 0"')
        with self.assertRaisesRegex(
            RobotError, "(?s)ball joint 'f1_2'. Replace it by.*ellipsoid 'egg' of body 'base'. Replace it by"
        ):
            read_source(self.file("ball.xml", ball))
        curve = MJCF.replace("0.1 0.8 0 0 0", "0.1 0.8 1 0 0", 1)
        with self.assertRaisesRegex(RobotError, "'f1_1', 'f1_2', which do not move in proportion.* 0.36 rad .m. off"):
            read_source(self.file("curve.xml", curve))

    def test_a_tendon_couples_the_joints_that_it_pulls(self):
        head, _ = MJCF.split("<equality>")
        tendon = """<tendon><fixed name="t"><joint joint="f1_1" coef="1"/><joint joint="f1_2" coef="0.5"/></fixed>
          </tendon>
          <actuator><position tendon="t" kp="2" forcerange="-3 3"/></actuator></mujoco>"""
        source = read_source(self.file("tendon.xml", head + tendon))
        mimics = source.tree.mimics
        self.assertEqual([(m.joint, m.source, m.multiplier) for m in mimics], [("f1_2", "f1_1", 0.5)])
        # The tendon shortens by 1 + 0.5 * 0.5 for each rad.
        self.assertEqual(source.tree.joint("f1_1").effort, 3 * 1.25)
        self.assertEqual(source.stiffness["f1_1"], 2 * 1.25**2)
        self.assertIn("coupled joints: 'f1_2' with 'f1_1'", " ".join(source.notes))

    def test_a_joint_that_follows_a_follower_follows_its_source(self):
        chained = HAND.replace('joint="f2_1" multiplier="0.8"', 'joint="f1_2" multiplier="0.5"')
        mimics = {mimic.joint: mimic for mimic in read_source(self.file("chain.urdf", chained)).tree.mimics}
        self.assertEqual(
            (mimics["f2_2"].source, mimics["f2_2"].multiplier, mimics["f2_2"].offset),
            ("f1_1", 0.4, 0.15000000000000002),
        )
        circle = HAND.replace('<mimic joint="f1_1"', '<mimic joint="f1_2"')
        with self.assertRaisesRegex(RobotError, "follow one another in a circle: f1_2. Let"):
            read_source(self.file("circle.urdf", circle))

    def test_a_gripper_with_closed_loops_becomes_a_jaw(self):
        made = import_robot(self.arm, self.file("jaw.xml", JAW), self.folder / "mine")
        folder = made.folder
        spec = load_robot(folder)
        found = check(folder)
        self.assertEqual([f"{f.topic}: {f.message}" for f in found if f.level == "error"], [])
        self.assertEqual(len(spec.hand_indices), 1)
        coupled = {mimic.joint: round(mimic.multiplier, 3) for mimic in spec.mimics}
        self.assertEqual(coupled, {"l_rocker": 1, "l_finger": -1, "r_crank": 1, "r_rocker": 1, "r_finger": -1})
        self.assertEqual([tip.contact_links for tip in spec.fingertips], [("l_pad",), ("r_pad",)])
        notes = "\n".join(made.guessed)
        self.assertRegex(notes, r"coupled joints: 'l_finger', 'l_rocker', .* with 'l_crank'; .* 0.00 mm")
        self.assertRegex(notes, r"bars of a linkage: l_rod \(at l_pad\), r_rod")

    def test_damaged_or_huge_mjcf_is_refused(self):
        def asset(text):
            return MJCF.replace("<worldbody>", f"<asset>{text}</asset><worldbody>")

        copies = '<replicate count="30000"><replicate count="30000"><geom size="0.01"/></replicate></replicate></body>'
        for words, text in (
            ("orientation that is not finite", MJCF.replace('euler="0 0 0.9"', 'euler="-inf 0 0"')),
            ("1e-300 m small", MJCF.replace('size="0.018 0.007 0.007"', 'size="1e-300 1e-300 1e-300"')),
            ("hfield has 1.6e.09 entries", asset('<hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/>')),
            ("texture has 9e.08", asset('<texture name="h" type="2d" builtin="flat" width="30000" height="30000"/>')),
            ("size has 2e.09", MJCF.replace("<worldbody>", '<size nkey="2000000000"/><worldbody>')),
            ("replicates up to 9e.08", MJCF.replace("</body></worldbody>", f"{copies}</worldbody>")),
            ("Give the file that includes it", "<mujocoinclude/>"),
        ):
            with self.subTest(words), self.assertRaisesRegex(RobotError, words):
                read_source(self.file("hand.xml", text))

    def test_the_control_of_a_motor_is_its_effort(self):
        motor = MJCF.replace(
            '<position joint="f1_1" kp="3" kv="0.2" forcerange="-2 2"/>',
            '<motor joint="f1_1" ctrlrange="-3 3" gear="2"/>',
        )
        source = read_source(self.file("hand.xml", motor))
        self.assertEqual((source.tree.joint("f1_1").effort, source.stiffness), (6.0, {}))

    def test_mjcf_in_place_of_a_urdf_is_told(self):
        with self.assertRaisesRegex(RobotError, "is MJCF, not URDF; `xreset robots import`"):
            load_urdf(self.file("hand.xml", MJCF))

    def test_offset_flange_and_what_hangs_there(self):
        gripper = '<link name="claw"/><joint name="mount" type="fixed"><parent link="l5"/><child link="claw"/></joint></robot>'
        arm = read_source(self.file("armed.urdf", ARM.replace("</robot>", gripper)))
        T = np.eye(4)
        T[2, 3] = 0.05
        hand = renamed(read_source(self.hand), arm.tree)
        armless = bare(arm, "l5")
        whole = combined(armless, hand, "l5", T, "x")
        self.assertNotIn("claw", whole.tree.link_names)
        self.assertTrue(any("claw" in note for note in whole.notes))
        np.testing.assert_array_equal(whole.tree.joint("hand_base_fixed").T_parent_joint, T)
        second = gripper.replace("claw", "thumb").replace("mount", "second")
        two = self.file("two.urdf", ARM.replace("</robot>", gripper.removesuffix("</robot>") + second))
        with self.assertRaisesRegex(
            RobotError, "ends in claw, thumb. Name the link that carries the hand with --flange"
        ):
            import_robot(two, self.hand, self.folder / "x")
        with self.assertRaisesRegex(RobotError, "no link 'wrist'"):
            import_robot(self.arm, self.hand, self.folder / "x", flange="wrist")

    def test_a_hand_whose_root_is_inside_it_stands_before_the_flange(self):
        made = import_robot(
            self.arm, self.hand, self.folder / "mine", rpy=(0, -np.pi / 2, 0)
        )  # its palm lies along x, from 0 to 80 mm
        T = load_urdf(made.folder / "robot.urdf").joint("hand_base_fixed").T_parent_joint
        np.testing.assert_allclose(T[:3, 3], 0, atol=1e-9)
        self.assertRegex(made.to_say[0], r"its fingers point along \(0.05, 0.00, 1.00\) of 'l5'")
        self.assertNotIn("for fingers along", made.to_say[0])
        back = import_robot(self.arm, self.hand, self.folder / "back", rpy=(0, np.pi / 2, 0))
        self.assertRegex(back.to_say[0], "for fingers along its z axis: --rpy 0 -1.5708 0$")
        T = load_urdf(back.folder / "robot.urdf").joint("hand_base_fixed").T_parent_joint
        np.testing.assert_allclose(T[:3, 3], (0, 0, 0.08), atol=1e-9)
        self.assertTrue(any("80 mm along the flange's z axis" in note for note in back.guessed), back.guessed)
        stated = import_robot(self.arm, self.hand, self.folder / "stated", offset=(0, 0, 0.01), rpy=(0, np.pi / 2, 0))
        T = load_urdf(stated.folder / "robot.urdf").joint("hand_base_fixed").T_parent_joint
        np.testing.assert_allclose(T[:3, 3], (0, 0, 0.01), atol=1e-9)

    def test_fingers_point_out_of_the_arm_whichever_axis_of_the_flange_does(self):
        for rpy, axis in (("0 -1.5708 0", "x"), ("-1.5708 0 0", "-y"), ("0.7 0.7 0", "z")):
            mount = (
                f'<link name="tool0"/><joint name="mount" type="fixed"><origin xyz="0 0 0.02" rpy="{rpy}"/>'
                '<parent link="l5"/><child link="tool0"/></joint></robot>'
            )
            arm = self.file("turned.urdf", ARM.replace("</robot>", mount))
            made = import_robot(arm, self.hand, self.folder / f"mine{axis}")
            spec = load_robot(made.folder)
            palm, last = Kinematics(spec).link_poses(torch.tensor(spec.home), ["palm_frame", "l5"])
            fingers = (last[:3, :3].T @ palm[:3, 0]).numpy()  # of the last link, whose joint turns about z
            with self.subTest(axis):
                self.assertIn(f"The angle about {axis} is yours to know", made.to_say[0])
                if axis != "z":  # no axis of the flange points out of the arm
                    np.testing.assert_allclose(fingers, (0, 0, 1), atol=0.06)

    def test_impossible_figures_are_replaced_and_told(self):
        heavy = HAND.replace('ixx="1e-5" iyy="1e-5" izz="1e-5"', 'ixx="0.1" iyy="0.1" izz="0.1"', 1).replace(
            '<mass value="0.4"/>', '<mass value="0"/>'
        )
        source = read_source(self.file("heavy.urdf", heavy))
        self.assertEqual(len(source.notes), 2, source.notes)
        self.assertAlmostEqual(source.tree.link("base").mass, 0.128, places=6)  # its box of water
        self.assertLess(np.linalg.eigvalsh(source.tree.link("f1_a").inertia).max(), 1e-4)

    def test_errors_leave_nothing(self):
        with self.assertRaisesRegex(RobotError, "expected a thumb and at least one finger"):
            import_robot(
                self.arm,
                self.file("one.urdf", f'<robot name="hand">{_PALM}{_FINGER.format("f1", *_PLACES["f1"])}</robot>'),
                self.folder / "x",
            )
        with self.assertRaisesRegex(RobotError, "cannot be read as XML"):
            import_robot(self.arm, self.folder / "nothing.urdf", self.folder / "x")
        entities = self.file("entities.urdf", f'<!DOCTYPE robot [<!ENTITY a "b">]>{HAND}')
        with self.assertRaisesRegex(RobotError, "has a DOCTYPE. Remove it"):
            import_robot(self.arm, entities, self.folder / "x")
        with self.assertRaisesRegex(RobotError, "--thumb 'f9' is in 0 fingers"):
            import_robot(self.arm, self.hand, self.folder / "x", thumb="f9")
        self.file("taken", "")
        with self.assertRaisesRegex(RobotError, "is there already"):
            import_robot(self.arm, self.hand, self.folder / "taken")
        self.assertEqual({p.suffix or p.name for p in self.folder.iterdir()}, {".urdf", "taken"})

    def test_command(self):
        out = io.StringIO()
        err = io.StringIO()
        words = ["robots", "import", "--arm", self.arm, "--hand", self.hand, "--out", self.folder / "mine"]
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            main([*map(str, words), *["--offset", "0", "0", "0.02"]])
        self.assertIn("for you to decide", out.getvalue())
        self.assertIn("0 errors", out.getvalue())
        self.assertTrue((self.folder / "mine" / "robot.png").read_bytes().startswith(b"\x89PNG"))


class Published(WithFolder):
    """Hands and an arm as their makers publish them."""

    def unpacked(self, name):
        archive = Path(os.environ.get("XRESET_ROBOTS", ARCHIVES)) / f"{name}.tar.xz"
        if not archive.is_file():
            raise unittest.SkipTest(
                f"no published robot at {archive}; set XRESET_ROBOTS to the folder with the archives"
            )
        with lzma.open(archive) as file, tarfile.open(fileobj=file) as tar:
            tar.extractall(self.folder, filter="data")
        return self.folder / name

    def test_the_shadow_hands_wrist_and_thumb_whatever_its_names(self):
        arm = self.unpacked("iiwa14") / "iiwa14.urdf"
        hand = self.unpacked("shadow_hand") / "shadow_hand_right.urdf"
        text = hand.read_text()
        for number, code in enumerate(("th", "ff", "mf", "rf", "lf")):
            text = re.sub(rf'"({code}|{code.upper()})(?!\w*[./])', f'"part{number}', text)
        hand.write_text(text)
        made = import_robot(arm, hand, self.folder / "mine")
        folder = made.folder
        spec = load_robot(folder)
        found = check(folder)
        self.assertEqual([f"{f.topic}: {f.message}" for f in found if f.level == "error"], [])
        self.assertEqual((len(spec.arm_indices), len(spec.hand_indices), spec.hand_root), (9, 22, "palm"))
        self.assertEqual(spec.fingertips[0].link, "thumb_tip_frame")
        self.assertEqual([tip.contact_links[0][:5] for tip in spec.fingertips], [f"part{i}" for i in range(5)])
        self.assertRegex("\n".join(made.guessed), "WRJ2, WRJ1 move the whole hand: they are the last joints of the arm")

        toml = (made.folder / "robot.toml").read_text()
        tips = re.findall(r"^    { name = .*contact_links.*$", toml, re.MULTILINE)
        rows = [tips[4].replace('name = "little"', 'name = "thumb"').replace("little4", "thumb4"), *tips[1:4]]
        rows.append(tips[0].replace('name = "thumb"', 'name = "little"').replace("thumb4", "little4"))
        swapped = toml.replace("\n".join(tips), "\n".join(rows))
        wrist = re.sub(r'(name = "WRJ\d", group = )"arm"', r'\1"hand"', toml)
        for wrong, expected in (
            (swapped, "the thumb 'little_tip_frame' can meet little pad to pad, little 'thumb_tip_frame' can meet"),
            (wrist.replace('root = "palm"', 'root = "forearm"'), "WRJ2, WRJ1 move every fingertip: joints of a wrist"),
        ):
            (made.folder / "robot.toml").write_text(wrong)
            spec = load_robot(made.folder)
            self.assertIn(expected, dict(checks._fingers(spec, load_urdf(spec.urdf)))["error"])
        (made.folder / "robot.toml").write_text(toml)
        urdf = made.folder / "robot.urdf"
        pattern = r'(name="palm_frame_fixed"[^>]*>\s*<origin xyz=")[^"]*'
        urdf.write_text(re.sub(pattern, r"\g<1>0 0 -0.2", urdf.read_text()))
        spec = load_robot(made.folder)
        errors = dict(checks._frames(spec, load_urdf(spec.urdf)))
        self.assertRegex(errors["error"], "the palm 'palm_frame' is 2.. mm from the nearest finger")

    def test_the_robotiq_gripper_is_a_jaw(self):
        arm = self.unpacked("iiwa14") / "iiwa14.urdf"
        hand = self.unpacked("robotiq_2f_85") / "robotiq_2f_85.urdf"
        folder = import_robot(arm, hand, self.folder / "mine").folder
        spec = load_robot(folder)
        found = check(folder)
        self.assertEqual([f"{f.topic}: {f.message}" for f in found if f.level == "error"], [])
        self.assertEqual((len(spec.hand_indices), len(spec.mimics), len(spec.fingertips)), (1, 5, 2))

    def test_inspires_coupled_joints_in_the_engines(self):
        arm = self.unpacked("xarm7") / "xarm7.urdf"
        hand = self.unpacked("inspire_hand") / "inspire_hand_right.urdf"
        spec = load_robot(
            import_robot(arm, hand, self.folder / "mine").folder
        )  # a joint of the thumb follows one that is no neighbour
        for name in ("mujoco", "pybullet", "sapien"):
            with self.subTest(name):
                try:
                    engine = make_backend(name, SceneSpec(robot=spec, objects=(load_object("soup"),)), 1)
                except BackendUnavailableError as error:
                    self.skipTest(str(error))
                with engine:
                    for _ in range(30):
                        engine.step()
                    joints = engine.state().joint_pos[0].double().cpu()
                    poses = Kinematics(spec).link_poses(joints, spec.tracked_links)
                    np.testing.assert_allclose(joints, spec.home, atol=0.02)
                    np.testing.assert_allclose(engine.links().pos[0].cpu(), poses[:, :3, 3], atol=2e-3)

    def test_hands_on_xarm7(self):
        arm = self.unpacked("xarm7") / "xarm7.urdf"
        cases = {
            "leap_hand": (
                "leap_hand_right.urdf",
                ("thumb_fingertip", "fingertip", "fingertip_2", "fingertip_3"),
                16,
                0,
            ),
            "allegro_hand": ("allegro_hand_right.urdf", ("link_15.0", "link_3.0", "link_7.0", "link_11.0"), 16, 0),
            "inspire_hand": (
                "inspire_hand_right.urdf",
                ("thumb_distal", *(f"{f}_intermediate" for f in ("index", "middle", "ring", "pinky"))),
                6,
                6,
            ),
            "right_sharpa_wave": (
                "right_sharpa_wave.xml",
                tuple(f"right_{f}_DP" for f in ("thumb", "index", "middle", "ring", "pinky")),
                22,
                0,
            ),
        }
        for name, (file, ends, joints, mimics) in cases.items():
            with self.subTest(name):
                made = import_robot(arm, self.unpacked(name) / file, self.folder / f"xarm7-{name}")
                folder = made.folder
                spec = load_robot(folder)
                found = check(folder)
                self.assertEqual([f"{f.topic}: {f.message}" for f in found if f.level == "error"], [])
                self.assertEqual((len(spec.hand_indices), len(spec.mimics)), (joints, mimics))
                self.assertEqual(tuple(tip.contact_links[0] for tip in spec.fingertips), ends)
                size = next(f.message for f in found if f.topic == "retargeting")
                self.assertLess(float(size.split("about ")[1].split()[0]), 3.0, size)


if __name__ == "__main__":
    unittest.main()
