"""Robots from what makers publish: an arm and a hand, URDF or MJCF, to a folder that passes the check."""

import lzma
import os
import re
import tarfile
import tempfile
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest import SkipTest, TestCase, mock

import mujoco
import numpy as np
import trimesh
from numpy.testing import assert_allclose
from torch import tensor

from tests.command import succeeds
from tests.data import DEFAULT, InFolder, refuses
from tests.test_robots import BUILT_IN
from tests.toy_robot import ROBOTS
from xreset import load_object, load_robot, make_backend
from xreset.errors import BackendUnavailableError, RobotError, XResetError
from xreset.geometry.collision import table_clearance
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import surface_of, transform, transformed
from xreset.geometry.urdf import load_urdf
from xreset.geometry.urdf_writer import pose
from xreset.robot_tools import check as checks
from xreset.robot_tools import homes
from xreset.robot_tools.check import check
from xreset.robot_tools.draft import hand_side
from xreset.robot_tools.fingers import Hand, _first_of_five
from xreset.robot_tools.importer import make_robot
from xreset.robot_tools.sources import _at, bare, completed, grounded, read_source, renamed
from xreset.spec import SceneSpec, TableSpec

ARCHIVES = DEFAULT.parent / "robots"
"""Where a development checkout has descriptions as their makers publish them."""

_INERTIA = '<inertia ixx="1e-5" iyy="1e-5" izz="1e-5" ixy="0" ixz="0" iyz="0"/>'
_BONE = f"""<inertial><mass value="{{mass}}"/><origin xyz="0.02 {{y}} 0"/>{_INERTIA}</inertial>
  <collision><origin xyz="0.02 {{y}} 0"/><geometry><box size="0.036 0.014 0.014"/></geometry></collision></link>"""
_LIMIT = '<axis xyz="0 1 0"/><limit lower="0" upper="1.5" effort="1" velocity="5"/>'
_PALM = """<link name="base"><inertial><mass value="0.4"/><origin xyz="0.04 0 0"/>
  <inertia ixx="3e-4" iyy="3e-4" izz="5e-4" ixy="0" ixz="0" iyz="0"/></inertial>
  <collision><origin xyz="0.04 0 0"/><geometry><box size="0.08 0.08 0.02"/></geometry></collision></link>"""
_PLACES = {
    "f1": ((0.085, 0.03, 0), "0 0 0"),
    "f2": ((0.085, 0, 0), "0 0 0"),
    "f3": ((0.085, -0.03, 0), "0 0 0"),
    "thumb": ((0.02, 0.045, 0), "0 0 0.9"),
}
"""The fourth is a right hand's thumb: seen from the back of the hand, fingers up, it is on the left."""


def _finger(name, sideways=0.0):
    """A finger along x that bends towards -z; its second joint follows the first. The origins of its joints are moved
    sideways along their axes."""
    (x, y, z), rpy = _PLACES[name]
    return f"""<link name="{name}_a">{_BONE.format(mass=0.05, y=-sideways)}<link name="{name}_b">{_BONE.format(mass=0.03, y=-sideways)}
<joint name="{name}_1" type="revolute"><parent link="base"/><child link="{name}_a"/>
  <origin xyz="{x} {y + sideways} {z}" rpy="{rpy}"/>{_LIMIT}</joint>
<joint name="{name}_2" type="revolute"><parent link="{name}_a"/><child link="{name}_b"/><origin xyz="0.045 0 0"/>{_LIMIT}
  <mimic joint="{name}_1" multiplier="0.8" offset="0.1"/></joint>"""


def _hand(*fingers):
    return f'<robot name="hand">{_PALM}{"".join(fingers)}</robot>'


HAND = _hand(*map(_finger, _PLACES))

ARM = (ROBOTS / "arm.urdf").read_text()
_MOUNT = """<joint name="mount" type="fixed"><parent link="l5"/><child link="hand_base"/>
  <origin xyz="0 0 0.055" rpy="0 -1.5708 0"/></joint>"""
_FINGERS = HAND.replace('"base"', '"hand_base"').partition(">")[2]
WHOLE = ARM.replace("</robot>", _MOUNT + _FINGERS)
"""Arm and hand in one file."""
MJCF = (ROBOTS / "hand.xml").read_text()
"""The same hand, but for one actuator."""
_AXES = ("1 0 0", "0 1 0", "0 0 1")
_COPIES = '<replicate count="5001"><geom size="0.01"/></replicate></body></worldbody>'
_PEN = '<body name="pen" pos="0.3 0 0.1"><geom type="capsule" size="0.01 0.05" pos="0 0 0.1"/>'
_PEN += "".join(f'<joint name="pen{axis}" type="slide" axis="{axis}"/>' for axis in _AXES)
_PEN += "</body>"
JAW = (ROBOTS / "jaw.xml").read_text()
"""Two fingers on parallelograms: rods that are pinned to the pads keep these parallel."""


class Robots(InFolder):
    def file(self, name, text):
        path = self.folder / name
        path.write_text(text)
        return path


def errors(folder):
    return [
        f"{finding.topic}: {finding.message}"
        for finding in check(folder)
        if finding.level == "error"
    ]


def at_home(spec, *links):
    return Kinematics(spec).link_poses(tensor(spec.home), links).numpy()


class Toy(Robots):
    @classmethod
    def setUpClass(cls):
        cls.sources = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.arm = cls.sources / "arm.urdf"
        cls.arm.write_text(ARM)
        cls.hand = cls.sources / "hand.urdf"
        cls.hand.write_text(HAND)
        out = cls.sources / "mine"
        parts = ("--arm", cls.arm, "--hand", cls.hand)
        cls.said = succeeds("robots import", *parts, "--out", out)
        cls.spec = load_robot(cls.sources / "mine")

    def imported(self, hand, arm=None, **options):
        """The folder of the arm with a hand, given as a text."""
        made = make_robot(
            arm or self.arm, self.file("hand.urdf", hand), self.folder / "mine", **options
        )
        return made.folder

    def read(self, file, text):
        """Tree and notes."""
        notes = []
        path = self.file(file, text)
        return completed(read_source(path, notes), path, notes), " ".join(notes)

    def fingers(self, file, text):
        """Name of each finger -> its last link, and what is guessed."""
        notes = []
        hand = Hand(self.read(file, text)[0], self.folder, None, notes)
        return {tip.name: tip.contact_links[0] for tip in hand.tips}, notes

    def test_a_folder_that_passes_the_check_and_says_what_it_guessed(self):
        spec = self.spec
        self.assertEqual(spec.name, "mine", "the name of its folder")
        links = {tip.name: tip.contact_links[0] for tip in spec.fingertips}
        self.assertEqual(
            links, {"thumb": "thumb_b", "index": "f1_b", "middle": "f2_b", "ring": "f3_b"}
        )
        mimics = {(mimic.joint, mimic.multiplier, mimic.offset) for mimic in spec.mimics}
        self.assertEqual(mimics, {(f"{finger}_2", 0.8, 0.1) for finger in _PLACES})
        keypoints = {point.keypoint: point.link for point in spec.keypoints}
        self.assertEqual(
            [keypoints[f"index{i}"] for i in (1, 2, 4)], ["f1_a", "f1_b", "index_tip_frame"]
        )
        said = " ".join(self.said.split())
        self.assertIn(
            "fingers are named from the thumb's side on: index is f1_b; middle is f2_b", said
        )
        self.assertIn("the hand is turned by --rpy 0 -1.5708 0: its fingers point along", said)
        self.assertRegex(
            said,
            r"its fingers point along \(0.05, 0.00, 1.00\).*The angle about the flange's z axis is yours.*0 errors",
        )
        self.assertTrue((self.sources / "mine" / "robot.png").read_bytes().startswith(b"\x89PNG"))
        self.assertEqual(
            [path.name for path in self.sources.iterdir() if path.name.startswith(".")], []
        )

    def test_fingers_opposite_a_thumb_in_the_middle_are_those_of_a_right_hand(self):
        for y, thumb in ((-0.001, "thumb"), (0.0, "f_middle"), (0.001, "thumb")):
            places = {
                "f2": ((0.085, -0.03, 0), "0 0 0"),
                "thumb": ((0.085, y, -0.06), "3.1416 0 0"),
            }
            with self.subTest(y=y), mock.patch.dict(_PLACES, places):
                hand = _hand(*map(_finger, ("f1", "f2", "thumb"))).replace("thumb", thumb)
                tips, notes = self.fingers("hand.urdf", hand)
                links = {"thumb": f"{thumb}_b", "index": "f1_b", "middle": "f2_b"}
                self.assertEqual(tips, links)
                said = "fingers are named as in a right hand: index is f1_b; middle is f2_b"
                self.assertIn(said, notes)

    def test_the_palm_faces_where_the_fingers_bend(self):
        hand, palm = at_home(self.spec, "hand_base", "palm_frame")
        in_hand = np.linalg.inv(hand) @ palm
        assert_allclose(in_hand[:3, :3], np.diag((1, -1, -1)), atol=0.06)
        assert_allclose(in_hand[:3, 3], (0.045, 0, 0), atol=5e-3, err_msg="4 cm behind knuckles")
        straight = Kinematics(self.spec).link_poses(0 * tensor(self.spec.home)).numpy()
        frames = [Kinematics(self.spec).link_index(x) for x in ("palm_frame", "thumb_tip_frame")]
        assert_allclose(*straight[frames, :3, :3], atol=1e-6)
        # at home it looks down at the table
        assert_allclose(palm[:3, 2], (0, 0, -1), atol=0.05)
        self.assertEqual(hand_side(self.spec), "right")
        thumb, *others = self.spec.fingertips
        mirrored = replace(self.spec, fingertips=(thumb, *others[::-1]))
        self.assertEqual(hand_side(mirrored), "left")

    def test_home_is_within_the_limits_after_rounding_and_strong_drives_are_stable(self):
        narrow = ARM.replace('lower="-2.9" upper="2.9"', 'lower="0.123446" upper="0.2"')
        folder = self.imported(
            HAND, self.file("narrow.urdf", narrow.replace('effort="60"', 'effort="300"'))
        )
        spec = load_robot(folder)
        self.assertEqual(spec.home[spec.arm_indices].tolist(), [0.1235] * 6)
        # 15 times the effort are 4500, the most is 2000, and the step of the engines allows this
        self.assertEqual(spec.joints[0].drive.kp, 1560)
        rail = ARM.replace('type="revolute"', 'type="prismatic"', 1)
        made = make_robot(
            self.file("rail.urdf", rail), self.file("hand.urdf", HAND), self.folder / "rail"
        )
        self.assertEqual(load_robot(made.folder).joints[0].drive.kp, 60 / 0.05)
        self.assertIn(
            "ok", [finding.level for finding in check(folder) if finding.topic == "drives"]
        )

    def test_home_keeps_off_the_table_where_it_can(self):
        robot = load_robot("ur7e-sharpa")
        with mock.patch.object(homes, "_CLEAR", 0.4):
            T = Kinematics(robot).link_poses(tensor(robot.home), [robot.hand_root])[0].numpy()
            held, moved = homes.hold_near(robot, T)
        self.assertRegex(moved, r", moved by \(.*, 15\) cm")
        home = tensor(held.home)[None]
        self.assertGreater(table_clearance(Kinematics(robot), home, TableSpec()), 0.4)

    def test_fingers_are_what_their_names_say(self):
        for codes, ends in (
            (("rh_LF", "rh_MF", "rh_TH", "rh_FF"), ("proximal", "middle")),  # as Shadow's
            (("l_lpinky", "LMiddle", "LThumb", "LEFT_INDEX"), ("_a", "_b")),
        ):
            hand = HAND
            for old, code in zip(_PLACES, codes, strict=True):
                for end, new in zip(("_a", "_b", "_"), (*ends, "J"), strict=True):
                    hand = hand.replace(f"{old}{end}", f"{code}{new}")
            last = [f"{code}{ends[1]}" for code in codes]
            expected = dict(zip(("little", "middle", "thumb", "index"), last, strict=True))
            self.assertEqual(self.fingers("hand.urdf", hand)[0], expected)

    def test_the_first_of_five_numbered_fingers_has_a_point(self):
        for numbers, points in ((range(5), 1.0), (range(1, 6), 1.0), (range(4), 0.0)):
            fingers = [SimpleNamespace(links=("x", f"f{number}_3")) for number in numbers]
            self.assertEqual(
                _first_of_five(fingers).tolist(), [points, *[0.0] * (len(fingers) - 1)]
            )

    def test_a_coupled_joint_has_the_limits_that_its_source_gives_it(self):
        folder = self.imported(
            HAND.replace('upper="1.5" effort="1" velocity="5"/>\n  <mimic', 'upper="1"/><mimic')
        )
        joint = load_urdf(f"{folder}/robot.urdf").joint("f1_2")
        assert_allclose((joint.lower, joint.upper), (0.1, 1.3))
        unset = HAND.replace('upper="1.5" effort="1" velocity="5"/>\n  <mimic', 'upper="0"/><mimic')
        against = HAND.replace('multiplier="0.8"', 'multiplier="-0.8"')
        for text, limits in ((unset, (0.1, 1.3)), (against, (-1.1, 0.1))):
            joint = self.read("hand.urdf", text)[0].joint("f1_2")
            self.assertEqual(joint.type, "revolute")
            assert_allclose((joint.lower, joint.upper), limits)
        self.assertIn("'f1_2' has the limits 0.1..1.3", (folder / "robot.toml").read_text())
        text = (folder / "robot.urdf").read_text()
        (folder / "robot.urdf").write_text(text.replace('upper="1.3"', 'upper="1"'))
        found = errors(folder)
        self.assertEqual(len(found), 4, found)
        self.assertIn("'f1_2' goes from 0.1 to 1.3 with 'f1_1', beyond its own limits", found[0])
        with self.assertRaisesRegex(
            RobotError, r"'f1_2' follows 'f1_1' from 1\.8\.\.3, but its own limits"
        ):
            self.read("hand.urdf", HAND.replace('offset="0.1"', 'offset="1.8"'))

    def test_origins_moved_sideways_do_not_turn_the_palm(self):
        fingers = [_finger(f"f{i}", 0.015) for i in (1, 2, 3)]
        folder = self.imported(_hand(*fingers, _finger("thumb")), offset=(0, 0, 0.01))
        spec = load_robot(folder)
        mount = load_urdf(f"{folder}/robot.urdf").joint("hand_base_fixed").T_parent_joint
        assert_allclose(mount[:3, 3], (0, 0, 0.01), atol=1e-9)
        knuckle = {point.keypoint: point.link for point in spec.keypoints}["index1"]
        hand, *others = at_home(spec, "hand_base", "palm_frame", knuckle)
        palm, knuckle = np.linalg.inv(hand) @ others
        self.assertAlmostEqual(palm[1, 0], 0.0, delta=0.01)
        assert_allclose(knuckle[:3, 3], (0.085, 0.03, 0), atol=1e-6)

    def test_the_axes_of_the_root_do_not_turn_the_palm(self):
        urdf = load_robot("ur7e-robotiq").urdf
        tree = completed(load_urdf(urdf), urdf, [])
        palms = []
        for T in (np.eye(4), pose(rpy=(0.3, 0.4, 0.5))):
            joints = []
            for joint in tree.joints:
                if joint.parent == "wrist_3_link":
                    joints.append(replace(joint, T_parent_joint=T @ joint.T_parent_joint))
            hand = Hand(tree.with_joints(joints), self.folder, None, [])
            palms.append(np.linalg.inv(T) @ hand.palm_in_hand)
        assert_allclose(*palms, atol=1e-9)

    def test_check_warns_of_a_turned_palm_and_of_placeholders_for_inertias(self):
        folder = self.imported(HAND)
        text = (folder / "robot.urdf").read_text()
        for pattern, new in (
            (
                r'(name="palm_frame_fixed"[^>]*>\s*<origin xyz="[^"]*" rpy=")[^"]*',
                r"\g<1>0 1.5708 0",
            ),
            (
                r'(<link name="f1_a">[\s\S]*?<inertia )[^/]*',
                r'\1ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0" ',
            ),
        ):
            text, count = re.subn(pattern, new, text, count=1)
            self.assertEqual(count, 1)
        (folder / "robot.urdf").write_text(text)
        warnings = " ".join(
            finding.message for finding in check(folder) if finding.level == "warning"
        )
        self.assertRegex(
            warnings,
            r"'f1_a' has the principal moments 0.1, 0.1, 0.1 .*placeholder.*do not point along x of the palm 'palm_frame'",
        )

    def test_a_thumb_that_bends_behind_the_palm_is_said(self):
        """Descriptions of left hands that were mirrored from right ones keep axes of the right one."""
        wrong = HAND.replace(
            thumb := _finger("thumb"), thumb.replace('xyz="0 1 0"', 'xyz="0 -1 0"')
        )
        out = self.imported(wrong, thumb="thumb_a")
        said = [found.message for found in check(out) if found.level == "warning"]
        self.assertRegex(" ".join(said), "works on the back of the hand")

    def test_an_arm_that_would_touch_itself_at_home_goes_elsewhere(self):
        held, moved = homes.hold_near(self.spec, at_home(self.spec, self.spec.hand_root)[0])
        self.assertEqual(moved, "")
        # the wanted place is tried alone, then among the others
        with mock.patch.object(homes, "touching_itself", side_effect=[0.5, 0.5, 0.0]):
            held, moved = homes.hold_near(held, at_home(held, held.hand_root)[0])
        self.assertIn("moved by", moved)

    def test_mjcf_is_the_same_hand(self):
        mjcf, notes = self.read("hand.xml", MJCF)
        self.assertNotIn("closed loops", notes)
        urdf = completed(read_source(self.hand, []), self.hand, [])
        self.assertEqual((mjcf.link_names, mjcf.mimics), (urdf.link_names, urdf.mimics))
        for a, b in zip((*mjcf.joints, *mjcf.links), (*urdf.joints, *urdf.links), strict=True):
            for name in ("name", "type", "lower", "upper", "mass"):
                self.assertEqual(getattr(a, name, None), getattr(b, name, None))
        for a, b in zip(*(tree.link("f1_b").collisions for tree in (mjcf, urdf)), strict=True):
            self.assertEqual(a.geometry.size, b.geometry.size)
        drives = [(joint.stiffness, joint.effort) for joint in mjcf.joints[:2]]
        self.assertEqual(drives, [(3.0, 2.0), (0.0, 0.0)])
        unstated, notes = self.read("hand.xml", MJCF.replace('angle="radian" ', ""))
        self.assertIn("angles are read as radians", notes)
        for a, b in zip(mjcf.joints, unstated.joints, strict=True):
            assert_allclose((a.lower, a.upper), (b.lower, b.upper), atol=1e-9)
            assert_allclose(a.T_parent_joint, b.T_parent_joint, atol=1e-9)

    def test_links_of_an_mjcf_move_as_in_mujoco(self):
        """Joints next to their bodies' origins, two of one body, one that is not at 0 in the file, one that is held; and a
        mirrored mesh."""
        trimesh.creation.box((0.04, 0.02, 0.06)).apply_translation((0.01, 0.02, 0.03)).export(
            self.folder / "b.stl"
        )
        text = """<mujoco><compiler angle="radian"/><asset><mesh file="b.stl" scale="1 -1 1"/></asset><worldbody>
          <body name="base" pos="0.1 0.2 0.3" euler="0.4 0 0"><geom size="0.05"/>
          <body name="a" pos="0 0.1 0.05" euler="0.3 0.5 0"><geom size="0.02"/>
            <inertial pos="0.02 0 0.01" mass="0.1" diaginertia="1e-5 2e-5 2.5e-5" euler="0.2 0.1 0.7"/>
            <joint name="turn" axis="0 1 1" pos="0.01 0.02 0" ref="0.3" range="-1 1"/>
            <joint name="slide" type="slide" axis="1 0 2" range="-0.1 0.1"/>
          <body name="b" pos="0.05 0 0" euler="0 0.2 0"><geom name="b" type="mesh" mesh="b" pos="0.01 0 0"/>
            <joint name="held" axis="1 0 0" range="-1 1"/>
          <body name="c" pos="0.04 0 0"><geom type="capsule" size="0.01 0.02" euler="0.3 0 0" pos="0 0 0.02"/>
            <joint name="end" axis="0 0 1" range="-1 1"/></body></body></body></body></worldbody>
          <equality><joint joint1="held" polycoef="0.4 0 0 0 0"/></equality></mujoco>"""
        path = self.file("chain.xml", text)
        tree = read_source(path, [])
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        positions = {"turn": 0.7, "slide": 0.05, "held": 0.4, "end": -0.6}
        for name, position in positions.items():
            data.joint(name).qpos = position
        mujoco.mj_kinematics(model, data)
        poses = {"base": transform(data.body("base").xmat.reshape(3, 3), data.body("base").xpos)}
        for joint in tree.joints:
            position = 0.0 if joint.type == "fixed" else positions[joint.name]
            poses[joint.child] = poses[joint.parent] @ _at(joint, position).T_parent_joint
        for link in tree.links:
            if link.collisions:
                body = data.body(link.name)
                R = poses[link.name][:3, :3]
                assert_allclose(poses[link.name][:3, 3] + R @ link.com, body.xipos, atol=1e-9)
                moments = np.diag(model.body(link.name).inertia)
                inertial = body.ximat.reshape(3, 3)
                inertia = inertial @ moments @ inertial.T
                assert_allclose(R @ link.inertia @ R.T, inertia, atol=1e-12)
        corners = transformed(surface_of(tree.link("b").collisions)[0], poses["b"])
        mesh = data.geom("b")
        theirs = mesh.xpos + model.mesh_vert @ mesh.xmat.reshape(3, 3).T
        assert_allclose(np.sort(corners, axis=0), np.sort(theirs, axis=0), atol=1e-7)

    def test_what_mjcf_has_and_robots_do_not_is_named_one_by_one(self):
        ball = MJCF
        for old, new in (
            ('<joint name="f1_2" axis="0 1 0" range="0 1.5"/>', '<joint name="f1_2" type="ball"/>'),
            ('<joint joint1="f1_2" joint2="f1_1" polycoef="0.1 0.8 0 0 0"/>', ""),
            ('type="box" pos="0.04 0 0"', 'name="egg" type="ellipsoid" pos="0.04 0 0"'),
        ):
            ball = ball.replace(old, new)
        curve = MJCF.replace("0.1 0.8 0 0 0", "0.1 0.8 1 0 0", 1)
        egg = "(?s)ball joint 'f1_2'. Replace it by.*ellipsoid 'egg' of body 'base'. Replace it by"
        off = "'f1_1', 'f1_2', which do not move in proportion.* 0.36 rad .m. off"
        for text, words in ((ball, egg), (curve, off)):
            self.assertRaisesRegex(RobotError, words, self.read, "hand.xml", text)

    def test_actuators_of_an_mjcf(self):
        head, _ = MJCF.split("<equality>")
        tree, notes = self.read(
            "tendon.xml",
            f"""{head}<tendon><fixed name="t"><joint joint="f1_1" coef="1"/><joint joint="f1_2" coef="0.5"/></fixed></tendon>
            <actuator><position tendon="t" kp="2" forcerange="-3 3"/>
            <motor joint="f2_1" ctrlrange="-3 3" gear="2"/></actuator></mujoco>""",
        )
        (mimic,) = tree.mimics
        self.assertEqual((mimic.joint, mimic.source, mimic.multiplier), ("f1_2", "f1_1", 0.5))
        self.assertIn("coupled joints: 'f1_2' with 'f1_1'", notes)
        # The tendon shortens by 1 + 0.5 * 0.5 for each rad.
        for name, *drive in (("f1_1", 3 * 1.25, 2 * 1.25**2), ("f2_1", 6.0, 0.0)):
            joint = tree.joint(name)
            self.assertEqual([joint.effort, joint.stiffness], drive)

    def test_the_armature_of_joints_without_a_position_actuator(self):
        text = MJCF.replace('name="f1_2"', 'name="f1_2" armature="2e-4"', 1)
        text = text.replace('name="f2_1"', 'name="f2_1" armature="3e-4"', 1)
        tree, _ = self.read("hand.xml", text)
        self.assertEqual(tree.joint("f1_2").rotor, 2e-4, "it follows f1_1")
        self.assertEqual(tree.joint("f2_1").rotor, 3e-4, "it has no actuator")

    def test_the_effort_of_a_joint_with_several_actuators_or_a_limit_of_its_own(self):
        text = MJCF.replace("</actuator>", '<velocity joint="f1_1" kv="1"/></actuator>')
        self.assertEqual(self.read("damped.xml", text)[0].joint("f1_1").effort, 2.0)
        limited = '<joint name="f1_1" actuatorfrcrange="-0.5 0.5"'
        text = MJCF.replace('<joint name="f1_1"', limited, 1)
        self.assertEqual(self.read("limited.xml", text)[0].joint("f1_1").effort, 0.5)
        pulling = '<motor joint="f1_1" ctrlrange="-9 0"/></actuator>'
        text = MJCF.replace("</actuator>", pulling)
        self.assertEqual(self.read("pulling.xml", text)[0].joint("f1_1").effort, 9.0)

    def test_bodies_and_joints_without_a_name_get_one_that_makers_do_not_use(self):
        text = MJCF.replace('body name="f1_a"', "body").replace('"f2_a"', '"body2"')
        text = re.sub("<equality>.*</actuator>", "", text, flags=re.DOTALL)
        text = text.replace('joint name="f1_1"', "joint").replace('"f2_1"', '"joint0"')
        tree, _ = self.read("hand.xml", text)
        moved = {link: tree.moved_by[link].name for link in ("unnamed_body2", "body2")}
        self.assertEqual(moved, {"unnamed_body2": "unnamed_joint0", "body2": "joint0"})

    def test_an_actuator_of_a_floating_base_is_left_out(self):
        text = MJCF.replace('<body name="base">', '<body name="base"><freejoint name="float"/>', 1)
        text = text.replace("<actuator>", '<actuator><motor name="thrust" joint="float"/>', 1)
        tree, notes = self.read("floating.xml", text)
        self.assertIn("left out: the actuator 'thrust'", notes)
        self.assertEqual(tree.joint("f1_1").stiffness, 3.0)

    def test_a_joint_that_follows_a_follower_follows_its_source(self):
        chain = HAND.replace('joint="f2_1" multiplier="0.8"', 'joint="f1_2" multiplier="0.5"')
        mimic = self.read("chain.urdf", chain)[0].joint("f2_2").mimic
        self.assertEqual((mimic.source, mimic.multiplier), ("f1_1", 0.4))
        self.assertAlmostEqual(mimic.offset, 0.15)
        still = self.read("still.urdf", chain.replace('multiplier="0.5"', 'multiplier="0"'))[0]
        self.assertEqual(still.joint("f2_2").type, "fixed")
        self.assertAlmostEqual(still.joint("f2_2").T_parent_joint[0, 2], np.sin(0.1))
        with self.assertRaisesRegex(RobotError, "follow one another in a circle: f1_2. Let"):
            self.read("circle.urdf", HAND.replace('<mimic joint="f1_1"', '<mimic joint="f1_2"'))

    def test_a_gripper_with_closed_loops_becomes_a_jaw(self):
        made = make_robot(self.arm, self.file("jaw.xml", JAW), self.folder / "mine")
        spec = load_robot(made.folder)
        self.assertEqual(errors(made.folder), [])
        self.assertEqual(len(spec.hand_indices), 1)
        coupled = {mimic.joint: round(mimic.multiplier, 3) for mimic in spec.mimics}
        self.assertEqual(
            coupled, {"l_rocker": 1, "l_finger": -1, "r_crank": 1, "r_rocker": 1, "r_finger": -1}
        )
        self.assertEqual([tip.contact_links for tip in spec.fingertips], [("l_pad",), ("r_pad",)])
        notes = " ".join(made.guessed)
        self.assertRegex(
            notes, r"coupled joints: 'l_finger', 'l_rocker', .* with 'l_crank'; .* 0.00 mm"
        )
        self.assertRegex(notes, "bars of a linkage: l_rod, r_rod")

    def test_the_fingers_of_a_jaw_are_thumb_and_index_whatever_their_names(self):
        text = JAW.replace('"l_pad"', '"lf_tip"').replace('"r_pad"', '"rf_tip"')
        tips = {"thumb": "lf_tip", "index": "rf_tip"}
        self.assertEqual(self.fingers("jaw.xml", text)[0], tips)

    def test_damaged_or_huge_mjcf_is_refused(self):
        world = "<worldbody>"
        curve = "0.1 0.8 0 0 0"
        tendon = '<tendon><fixed name="t"><joint joint="f1_1" coef="nan"/></fixed></tendon>'
        not_finite = "not finite, or far too large .MuJoCo's "
        for words, old, new in (
            (f"{not_finite}body_quat", 'euler="0 0 0.9"', 'euler="-inf 0 0"'),
            (f"{not_finite}body_pos", 'pos="0.085 0 0"', 'pos="inf 0 0"'),
            (f"{not_finite}eq_data", curve, "nan 1 0 0 0"),
            (f"{not_finite}tendon", "<actuator>", f'{tendon}<actuator><position tendon="t"/>'),
            (f"{not_finite}jnt_axis", 'axis="0 1 0"', 'axis="0 1e300 0"'),
            ("size 1e-300 m, expected 1e-06 m or more", '"0.018 0.007 0.007"', '"1e-300 1 1"'),
            ("5010 shapes. Use 5000 at most", "</body></worldbody>", _COPIES),
            ("Give the file that includes it", MJCF, "<mujocoinclude/>"),
            ("part of another file.* give that file", "<geom", '<geom class="of the scene"'),
            ("not valid MJCF", "<geom", f'<geom class="{300 * "1"}"'),
            ("has no robot", MJCF, "<mujoco><worldbody><body name='a'/></worldbody></mujoco>"),
        ):
            with refuses(self, words, RobotError):
                self.read("hand.xml", MJCF.replace(old, new, 1))
        texture = '<texture name="h" type="2d" builtin="flat" width="9000" height="9000"/>'
        self.file("big.xml", f"<mujocoinclude><asset>{texture}</asset></mujocoinclude>")
        for new in ('<include file="big.xml"/>', '<sensor><user dim="30000000"/></sensor>'):
            with self.subTest(new), mock.patch.dict(os.environ, XRESET_MAX_FILE_MB="100"):
                text = MJCF.replace(world, f"{new}{world}")
                words = "takes more than 100 MB of memory.* Leave out .*XRESET_MAX_FILE_MB"
                self.assertRaisesRegex(RobotError, words, self.read, "hand.xml", text)

    def test_what_an_mjcf_has_and_a_robot_has_not_is_used_or_named(self):
        spring = 'name="f1_1" stiffness="2" frictionloss="0.1"'
        slack = '<tendon><fixed name="slack"><joint joint="f3_1" coef="1"/></fixed></tendon>'
        floor = '<geom type="plane" size="0 0 1"/>'
        scene = f'{floor}<body name="cube"><freejoint/><geom size="0.1"/></body></worldbody>'
        off = '<default><geom contype="0" conaffinity="0" group="{}"/></default><worldbody>'
        pair = '<contact><pair geom1="p" geom2="q"/></contact></mujoco>'
        pairs = MJCF.replace("<geom", '<geom name="p"', 1).replace("</mujoco>", pair)
        pairs = pairs.replace(
            '<geom type="box" pos="0.02', '<geom name="q" type="box" pos="0.02', 1
        )
        for text, words in (
            (
                MJCF.replace('name="f1_1"', spring, 1),
                "springs of joints: f1_1.*friction of joints: f1",
            ),
            (
                MJCF.replace("<actuator>", f"{slack}<actuator>"),
                "tendons without an actuator: slack",
            ),
            (
                MJCF.replace("</worldbody>", scene),
                "left out: bodies of the world .* no joint: cube",
            ),
            (
                pairs.replace("<worldbody>", off.format(3)),
                "shapes of collision groups .* base, f1_a",
            ),
            (pairs.replace("<worldbody>", off.format(0)), "visual shapes .* f1_b, f2_a"),
        ):
            with self.subTest(words):
                tree, notes = self.read("hand.xml", text)
                self.assertRegex(notes, words)
                self.assertEqual([link.name for link in tree.links if not link.collisions], [])
        slides = [
            f'<joint name="b{i}" type="slide" axis="{axis}"/>' for i, axis in enumerate(_AXES)
        ]
        text = MJCF.replace('name="base">', f'name="base">{"".join(slides)}')
        mocap = '<body name="user" mocap="true"/></worldbody>'
        text = text.replace("</worldbody>", f"{_PEN}{mocap}")
        text = text.replace(
            "</equality>", '<weld name="hold" body1="user" body2="base"/></equality>'
        )
        exclude = '<contact><exclude body1="f1_a" body2="f2_a"/></contact></mujoco>'
        made = make_robot(
            self.arm,
            self.file("hand.xml", text.replace("</mujoco>", exclude)),
            self.folder / "mine",
        )
        said = " ".join(made.guessed)
        self.assertIn("left out: joints that only let the hand float: b0, b1, b2", said)
        self.assertEqual(said.count("b0"), 1, "it gets neither limits nor a speed")
        self.assertIn("left out: equalities with a mocap body: hold", said)
        self.assertIn("never collide, because the MJCF says so: f1_a with f2_a", said)
        self.assertIn("left out: what moves next to the hand: pen", said)
        spec = load_robot(made.folder)
        self.assertEqual(len(spec.joint_names), 10)
        self.assertFalse([name for name in load_urdf(spec.urdf).link_names if "pen" in name])
        self.assertIn(("f1_a", "f2_a"), spec.collision_exclude)

    def test_three_joints_before_any_shape_let_a_hand_float_and_two_are_a_wrist(self):
        for count in (2, 3):
            parts = ""
            for i in range(count):
                ends = f'<parent link="w{i}"/><child link="{"base" if i == count - 1 else f"w{i + 1}"}"/>'
                parts += (
                    f'<link name="w{i}"/><joint name="w{i}" type="revolute">{ends}{_LIMIT}</joint>'
                )
            tree, _ = self.read("hand.urdf", HAND.replace("</robot>", f"{parts}</robot>"))
            moving = [joint.name for joint in grounded(tree, []).moved_by.values()]
            self.assertEqual("w0" in moving, count == 2)

    def test_numbers_that_no_robot_has(self):
        fixed = re.sub(
            r'<mimic joint="f1_1"[^>]*>', "", HAND
        )  # what follows it would be fixed, too
        slides = HAND.replace("revolute", "prismatic")
        for text, words, field, value in (
            (HAND.replace('value="0.05"', 'value="30"'), "size does not allow.*f1_a", "lower", 0),
            (HAND.replace('value="0.05"', 'value="1e-6"'), "size does not allow.*f1_a", "lower", 0),
            (
                fixed.replace('lower="0" upper="1.5"', 'lower="1" upper="1"', 1),
                "fixed, .*: f1_1",
                "type",
                "fixed",
            ),
            (
                slides.replace('upper="1.5"', 'upper="40"'),
                "40, are read as millimetres",
                "upper",
                0.04,
            ),
            (HAND.replace('upper="1.5"', 'upper="86"'), "86, are read as degrees", "upper", 1.501),
            (HAND.replace('upper="1.5"', 'upper="1e4"', 1), "limits .* have: f1_1", "upper", 6.283),
            (HAND.replace('velocity="5"', 'velocity="1e5"'), "a speed that a", "velocity", 3.142),
        ):
            with self.subTest(words):
                tree, notes = self.read("hand.urdf", text)
                self.assertRegex(notes, words)
                found = getattr(tree.above["f1_a"], field)
                self.assertEqual(found if isinstance(found, str) else round(found, 3), value)
                self.assertLess(tree.link("f1_a").mass, 0.1)
        still = self.read("hand.urdf", fixed.replace('"0" upper="1.5"', '"1" upper="1"', 1))[0]
        self.assertAlmostEqual(still.above["f1_a"].T_parent_joint[0, 2], np.sin(1.0))
        weak = self.file("weak.urdf", ARM.replace('effort="60"', 'effort="1"'))
        text = MJCF.replace('name="f1_1"', 'name="f1_1" armature="1"', 1).replace(
            'kp="3"', 'kp="900"'
        )
        text = text.replace('forcerange="-2 2"', 'forcerange="-999 999"')
        made = make_robot(weak, self.file("hand.xml", text), self.folder / "weak")
        said = " ".join(made.guessed)
        for words in (
            r"efforts that such joints do not have: j0 \(1\), .*f1_1 \(999\)",
            r"armature that no finger has: f1_1 \(1\)",
            r"less stiffness than stated, .*: f1_1 \(900\)",
        ):
            self.assertRegex(said, words)
        self.assertEqual({finding.level for finding in made.findings}, {"ok", "warning"})
        self.assertNotIn("drives", [x.topic for x in made.findings if x.level == "warning"])
        for text, words in (
            (
                HAND.replace("0.085", "85"),
                "'f1_1' is 85 m from its parent link.*millimetres",
            ),
            (HAND.replace('size="0.036', 'size="36'), "'f1_a' has shapes of 36 m, expected"),
            (
                HAND.replace('size="0.036', 'size="2'),
                "'f1_a' of the hand measures 2 m, expected 0.7",
            ),
            (HAND.replace('upper="1.5"', 'upper="0.02"'), "no joint turns by more than 0.02 rad"),
            (HAND.replace('"f1_a"', f'"{"x" * 50_000}"'), "^.{,200} has 50000 characters"),
            (
                HAND.replace('"revolute"', '"continuous"'),
                "no joint of a finger has limits that say",
            ),
            (
                HAND.replace("collision>", "other>"),
                "the last link of a finger, 'f1_b', has no collision",
            ),
        ):
            with self.subTest(words):
                self.assertRaisesRegex(RobotError, words, self.imported, text)
        self.assertFalse((self.folder / "mine").exists())

    def test_urdfs_that_a_strict_reader_refuses(self):
        prefixed = HAND.replace('velocity="5"', 'velocity="5" drake:acceleration="2"')
        prefixed = prefixed.replace("<robot name", "<robot xmlns:x").replace(
            "</robot>", "<drake:a/></robot>"
        )
        self.assertEqual(self.read("named.urdf", prefixed)[0].name, "named")
        shown = HAND.replace("collision>", "visual>")
        capsule = '<capsule radius=" 0.007 " length="0.02"/>'
        tree, _ = self.read("spaces.urdf", HAND.replace('<box size="0.036 0.014 0.014"/>', capsule))
        self.assertEqual(tree.link("f1_a").collisions[0].geometry.size, (0.007, 0.01))
        tree, notes = self.read("shown.urdf", shown)
        self.assertTrue(tree.link("f1_b").collisions)
        self.assertIn("visual shapes collide where there is no other: base, f1_a, f1_b", notes)
        gone = shown.replace('<box size="0.036 0.014 0.014"/>', '<mesh filename="gone.stl"/>')
        self.assertRaisesRegex(
            RobotError, "the mesh 'gone.stl'.* is not", self.read, "x.urdf", gone
        )
        self.file("tip.stl", "version https://git-lfs.github.com/spec/v1\noid sha256:1\nsize 9")
        stale = "file:///home/somebody/catkin_ws/src/tip.stl"
        pointer = HAND.replace('<box size="0.036 0.014 0.014"/>', f'<mesh filename="{stale}"/>')
        for text, words in (
            (pointer, "tip.stl is a Git LFS pointer, not the file itself. Run `git lfs pull`"),
            (HAND.replace('"1.5"', '"${pi/2}"'), "is xacro.*Run xacro first"),
            (HAND.replace("</robot>", "<xacro:finger/></robot>"), "is xacro.*<xacro:finger>"),
        ):
            with self.subTest(words):
                self.assertRaisesRegex(RobotError, words, self.read, "hand.urdf", text)
        asset = '<asset><mesh file="tip.stl"/></asset><worldbody>'
        text = MJCF.replace("<worldbody>", asset)
        self.assertRaisesRegex(RobotError, "tip.stl is a Git LFS p", self.read, "hand.xml", text)

    def test_a_narrow_vote_names_the_other_finger_and_the_user_decides(self):
        """Names of five fingers count from the thumb on; of four they say nothing."""
        places = {"thumb": ((0.085, 0.06, -0.03), "0.9 0 0")}
        with mock.patch.dict(_PLACES, places):
            hand = _hand(*map(_finger, _PLACES)).replace("thumb", "f4")
        with self.assertRaises(RobotError) as refused:
            self.imported(hand)
        self.assertIn("--thumb", str(refused.exception))
        for finger in ("f4", "f1"):
            out = self.folder / finger
            make_robot(self.arm, self.file("hand.urdf", hand), out, thumb=f"{finger}_b")
            self.assertEqual(errors(out), [])
            self.assertEqual(load_robot(out).fingertips[0].contact_links, (f"{finger}_b",))

    def two_hands(self, y, joints=0, thumb="thumb"):
        """A URDF of two hands that are 2 ``y`` apart, on arms of some joints."""
        parts = []
        for side, at in (("left", y), ("right", -y)):
            hand = HAND.partition(">")[2].replace("</robot>", "")
            hand = re.sub(r'"(base|(?:f\d|thumb)_\w)"', rf'"{side}_\1"', hand)
            parts.append(hand.replace("thumb_", f"{thumb}_"))
            link = "torso"
            for i in range(joints):
                ends = f'<parent link="{link}"/><child link="{side}_arm{i}"/>'
                moves = '<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="1"/>'
                parts.append(
                    f'<link name="{side}_arm{i}"/><joint name="{side}_{i}" type="revolute">{ends}{moves}</joint>'
                )
                link = f"{side}_arm{i}"
            ends = f'<parent link="{link}"/><child link="{side}_base"/><origin xyz="0 {at} 0"/>'
            parts.append(f'<joint name="{side}" type="fixed">{ends}</joint>')
        return f'<robot name="both"><link name="torso"/>{"".join(parts)}</robot>'

    def test_of_two_hands_the_thumb_chooses_one(self):
        words = "has 2 hands, with the fingers left_f1_b, .*Choose one with --thumb"
        nameless = self.two_hands(0.08, joints=3, thumb="f4")
        self.assertRaisesRegex(RobotError, words, self.imported, nameless)
        self.assertRaisesRegex(RobotError, words, self.imported, self.two_hands(0.4, thumb="f4"))
        both = self.two_hands(0.4)
        words = "has 2 hands, with the fingers left_f1_b, .*; right_f1_b, .*Choose one with --thumb"
        self.assertRaisesRegex(RobotError, words, self.imported, both)
        trimesh.creation.box((0.08, 0.08, 0.02)).export(self.folder / "palm.stl")
        both = both.replace('<box size="0.08 0.08 0.02"/>', '<mesh filename="palm.stl"/>')
        spec = load_robot(self.imported(both, thumb="right_thumb_a"))
        meshes = [file.name for file in (self.folder / "mine" / "meshes").iterdir()]
        self.assertEqual(meshes, ["right_base_0.obj"], "none of the other hand")
        self.assertEqual(spec.hand_root, "right_base")
        self.assertEqual(len(spec.hand_indices), 4)
        self.assertFalse([name for name in load_urdf(spec.urdf).link_names if "left" in name])

    def test_what_is_mounted_on_the_flange_is_removed(self):
        gripper = '<link name="{0}"/><joint name="{0}" type="fixed"><parent link="l5"/><child link="{0}"/></joint>'
        claw, thumb = (gripper.format(name) for name in ("claw", "thumb"))
        arm, _ = self.read("armed.urdf", ARM.replace("</robot>", f"{claw}</robot>"))
        notes = []
        self.assertNotIn("claw", bare(arm, "l5", notes).link_names)
        self.assertIn("claw", notes[0])
        two = self.file("two.urdf", ARM.replace("</robot>", f"{claw}{thumb}</robot>"))
        words = "ends in claw, thumb. Name the link that carries the hand with --flange"
        self.assertRaisesRegex(RobotError, words, self.imported, HAND, two)
        self.assertRaisesRegex(RobotError, "no link 'wrist'", self.imported, HAND, flange="wrist")
        words = "no joint moves the link 'base', which would carry the hand. Name another"
        self.assertRaisesRegex(RobotError, words, self.imported, HAND, flange="base")

    def test_no_name_of_the_hand_is_one_of_the_arm(self):
        arm, _ = self.read("arm.urdf", ARM)
        hand, _ = self.read("hand.urdf", HAND.replace('"f1_a"', '"hand_base"'))
        names = renamed(hand, arm).link_names
        self.assertEqual(names[0], "hand_hand_base", "both roots are called base")
        self.assertEqual(len({*names, *arm.link_names}), len(names) + len(arm.link_names))

    def test_the_arm_of_a_robot_carries_another_hand(self):
        again = load_robot(self.imported(HAND, arm=self.sources / "mine"))
        self.assertEqual(again.joint_names, self.spec.joint_names)
        joints = tensor(self.spec.home)[None]
        poses = [Kinematics(spec).link_poses(joints, [spec.palm]) for spec in (self.spec, again)]
        assert_allclose(poses[1], poses[0], atol=1e-5)
        with self.assertRaisesRegex(RobotError, "absent.urdf. is not a file.* ur7e-sharpa"):
            self.imported(HAND, arm=self.sources / "absent.urdf")

    def test_the_arms_of_robots_end_where_their_own_hands_begin(self):
        for robot, flange, end in (
            ("panda-allegro", "panda_link7", 0.12),  # the link before it is on neither side
            ("openarm", "link7", 0.108),  # a joint of the arm moves it, across the fingers
            ("iiwa14-sharpa", "link_7", 0.035),
        ):
            made = make_robot(Path(robot), self.hand, self.folder / robot)
            spec = load_robot(made.folder)
            joint = load_urdf(spec.urdf).joint("base_fixed")
            fingers = joint.T_parent_joint[:3, 0]
            with self.subTest(robot):
                self.assertEqual(joint.parent, flange)
                self.assertEqual(len(spec.arm_indices), 7)
                assert_allclose(joint.T_parent_joint[:3, 3], (0, 0, end), atol=1e-9)
                assert_allclose(fingers, (0, 0, 1), atol=1e-3)
                self.assertIn(f"carried by the arm's link '{flange}'", " ".join(made.guessed))

    def test_a_hand_whose_root_is_inside_it_is_moved_in_front_of_the_flange(self):
        """Its palm is along x, from 0 to 80 mm. The shape of the arm's last link ends 55 mm in front of its frame."""
        made = make_robot(self.arm, self.hand, self.folder / "mine", rpy=(0, np.pi / 2, 0))
        T = load_urdf(made.folder / "robot.urdf").joint("hand_base_fixed").T_parent_joint
        assert_allclose(T[:3, 3], (0, 0, 0.135), atol=1e-9)
        self.assertIn("135 mm along the flange's z axis", " ".join(made.guessed))

    def test_fingers_point_out_of_the_arm_whichever_axis_of_the_flange_does(self):
        before, last, after = ARM.rpartition('<axis xyz="0 0 1"/>')
        against = before + last.replace("0 0 1", "0 0 -1") + after
        for text, rpy, axis in (
            (ARM, "-1.5708 0 0", "-y"),
            (ARM, "0.7 0.7 0", "z"),
            (against, "1.5708 0 0", "y"),
        ):
            mount = (
                f'<link name="tool0"/><joint name="mount" type="fixed"><origin xyz="0 0 0.02" rpy="{rpy}"/>'
                '<parent link="l5"/><child link="tool0"/></joint></robot>'
            )
            arm = self.file("turned.urdf", text.replace("</robot>", mount))
            made = make_robot(arm, self.hand, self.folder / f"mine{axis}")
            spec = load_robot(made.folder)
            palm, last = Kinematics(spec).link_poses(tensor(spec.home), ["palm_frame", "l5"])
            fingers = (
                last[:3, :3].T @ palm[:3, 0]
            ).numpy()  # of the last link, whose joint turns about z
            with self.subTest(axis):
                self.assertIn(
                    f"The angle about the flange's {axis} axis is yours to know", made.to_say[0]
                )
                if axis != "z":  # no axis of the flange points out of the arm
                    assert_allclose(fingers, (0, 0, 1), atol=0.06)

    def test_arm_and_hand_in_one_file_are_the_same_robot(self):
        mount = load_urdf(self.sources / "mine" / "robot.urdf").joint("hand_base_fixed")
        assert_allclose(
            mount.T_parent_joint[:3, 3], (0, 0, 0.055), atol=1e-9, err_msg="the end of l5"
        )
        self.assertEqual(mount.parent, "l5")
        whole = self.file("whole.urdf", WHOLE)
        said = succeeds("robots import --hand", whole, "--out", self.folder / "mine")
        spec = load_robot(self.folder / "mine")
        for field in ("joint_names", "mimics", "fingertips", "keypoints"):
            self.assertEqual(getattr(spec, field), getattr(self.spec, field), field)
        assert_allclose(spec.home, self.spec.home, atol=2e-3)
        tips = [tip.link for tip in spec.fingertips]
        assert_allclose(at_home(spec, *tips), at_home(self.spec, *tips), atol=2e-3)
        self.assertNotIn("how the hand is mounted", said)
        self.assertIn(
            "they move the whole hand: j0, j1, j2, j3, j4, j5; the hand begins with 'l5'",
            " ".join(said.split()),
        )
        refused = (
            (HAND, {}, "has no arm: no joint moves all of its fingers"),
            (HAND, {"flange": "l5"}, "but there is no --arm"),
        )
        for hand, options, words in refused:
            with refuses(self, words, RobotError):
                make_robot(None, self.file("h.urdf", hand), self.folder / "no", **options)
        self.assertFalse((self.folder / "no").exists())

    def test_what_is_no_robot_of_an_arm_and_a_hand_is_named(self):
        bone = _BONE.format(mass=0.03, y=0)
        centered = bone.replace('<collision><origin xyz="0.02 0 0"/>', "<collision>")
        part = f"""<link name="lid">{centered}<joint name="pan" type="revolute"><parent link="base"/>
          <child link="lid"/>{_LIMIT}</joint></robot>"""
        hand = HAND.replace("</robot>", part)
        twice = HAND.replace('name="f2_2"', 'name="f1_2"')
        still = HAND.replace('name="f1_1" type="revolute"', 'name="f1_1" type="fixed"')
        for text, words in (
            (
                hand,
                "tip of 'lid' is at the finger's first joint 'pan'.*If it is no finger, make 'pan'",
            ),
            (twice, "the joint name 'f1_2' occurs twice"),
            (still, "'f1_2' mimics 'f1_1', which is not a moving joint.*Make 'f1_2' fixed"),
        ):
            with refuses(self, words, RobotError):
                self.imported(text)

    def test_frames_whose_fixed_joints_have_one_name_stay(self):
        frames = [
            f'<link name="{x}"/><joint name="mark" type="fixed"><parent link="base"/><child link="{x}"/></joint>'
            for x in ("a", "b")
        ]
        tip = frames[0].replace('"a"', '"f1_tip"').replace('"base"/>', '"f1_b"/>')
        tip = tip.replace("</joint>", '<origin xyz="0.05 0.01 0"/></joint>')
        folder = self.imported(HAND.replace("</robot>", f"{''.join(frames)}{tip}</robot>"))
        self.assertLess({"a", "b"}, {*load_urdf(folder / "robot.urdf").link_names})
        named, tip = at_home(load_robot(folder), "f1_tip", "index_tip_frame")
        assert_allclose(tip[:3, 3], named[:3, 3], atol=1e-9, err_msg="where its name is")

    def test_a_jaw_that_is_closed_at_0_in_one_file_with_its_arm(self):
        described = load_robot("openarm")
        text = described.urdf.read_text()
        for name, urdf in (("one-drive", text), ("two-drives", re.sub("<mimic[^>]*>", "", text))):
            made = make_robot(None, self.file(f"{name}.urdf", urdf), self.folder / name)
            spec = load_robot(made.folder)
            self.assertEqual(len(spec.arm_indices), 7)
            # a target 2 cm inside of an object must press, although no stiffness is stated
            self.assertGreater(spec.joints[-1].drive.kp * 0.02, 10.0)
            self.assertEqual(spec.home_std[1], 0.005)
            tree = load_urdf(spec.urdf)
            for link in ("left_finger", "right_finger"):  # with rotors of 0.1 kg
                before = load_urdf(described.urdf).link(link).mass
                self.assertAlmostEqual(tree.link(link).mass, before + 0.1)
            at_start = spec.home[spec.hand_indices]
            ends = Kinematics(spec).upper.numpy()[spec.hand_indices]
            assert_allclose(at_start, 0.85 * ends, atol=1e-3, err_msg="the jaw is open at home")
            palms = []
            for robot in (spec, described):
                hand, palm = at_home(robot, described.hand_root, robot.palm)
                palms.append(hand[:3, :3].T @ palm[:3, :3])
            with self.subTest(name):
                assert_allclose(*palms, atol=1e-3)
            if name == "one-drive":
                self.assertEqual(spec.joint_names, described.joint_names)

    def test_a_camera_that_pans_on_the_arm_is_no_finger(self):
        for parent, bone in (
            ("l2", _BONE.format(mass=0.03, y=0)),
            ("l5", "</link>"),  # without a shape
        ):
            camera = f"""<link name="camera">{bone}<joint name="pan" type="revolute"><parent link="{parent}"/>
              <child link="camera"/><origin xyz="0.05 0 0.02"/>{_LIMIT}</joint></robot>"""
            file = self.file("whole.urdf", WHOLE.replace("</robot>", camera))
            with self.subTest(parent):
                made = make_robot(None, file, self.folder / parent)
                spec = load_robot(made.folder)
                self.assertEqual(spec.joint_names, self.spec.joint_names)
                self.assertEqual(spec.fingertips, self.spec.fingertips)
                self.assertIn("joints that move no finger are fixed at 0: pan", made.guessed)

    def test_a_camera_that_pans_on_the_hand_is_no_finger(self):
        tilt = _LIMIT.replace("0 1 0", "1 0 0")
        for name, bone, is_camera in (
            ("camera", _BONE.format(mass=0.03, y=0), True),
            ("head", "</link>", True),  # without a shape it touches nothing
            ("head", _BONE.format(mass=0.03, y=0), False),
        ):
            camera = f"""<link name="{name}_a">{bone}<joint name="pan" type="revolute"><parent link="base"/>
              <child link="{name}_a"/><origin xyz="0.03 0 0.03"/>{_LIMIT}</joint><link name="{name}">{bone}
              <joint name="tilt" type="revolute"><parent link="{name}_a"/><child link="{name}"/>{tilt}</joint></robot>"""
            with self.subTest(name, is_camera=is_camera):
                hand = self.file("hand.urdf", HAND.replace("</robot>", camera))
                made = make_robot(self.arm, hand, self.folder / f"{name}{is_camera}")
                joints = load_robot(made.folder).joint_names
                self.assertEqual("pan" not in joints and "tilt" not in joints, is_camera)
                said = "joints that move no finger are fixed at 0: pan, tilt" in made.guessed
                self.assertEqual(said, is_camera)

    def test_a_camera_that_pans_is_not_the_end_of_an_arm(self):
        for name, parent, joints in (
            ("camera", "l5", 2),  # more joints move it than the flange
            ("camera", "base", 1),
            ("mast", "base", 2),
            ("mast", "base", 4),  # perhaps the arm
        ):
            above = parent
            parts = ""
            for i in range(joints):
                parts += f"""<link name="{name}{i}">{_BONE.format(mass=0.03, y=0)}<joint name="turn{i}" type="revolute">
                  <parent link="{above}"/><child link="{name}{i}"/><origin xyz="0.1 0.1 0.1"/>{_LIMIT}</joint>"""
                above = f"{name}{i}"
            arm = self.file("arm.urdf", ARM.replace("</robot>", f"{parts}</robot>"))
            with self.subTest(name, parent=parent, joints=joints):
                if joints == 4:
                    words = "ends in l5, mast3. Name the link that carries the hand"
                    self.assertRaisesRegex(RobotError, words, self.imported, HAND, arm)
                    continue
                made = make_robot(arm, self.hand, self.folder / f"{name}{parent}{joints}")
                self.assertIn("carried by the arm's link 'l5'", " ".join(made.guessed))
                self.assertEqual(load_robot(made.folder).joint_names, self.spec.joint_names)

    def test_impossible_figures_are_replaced_with_a_note(self):
        heavy = HAND.replace(
            'ixx="1e-5" iyy="1e-5" izz="1e-5"', 'ixx="0.1" iyy="0.1" izz="0.1"', 1
        ).replace('<mass value="0.4"/>', '<mass value="0"/>')
        heavy = heavy.replace('iyy="1e-5"', 'iyy="3e-5"', 1)  # more than the two others
        tree, notes = self.read("heavy.urdf", heavy)
        words = r"have no mass.*base \(0.128 kg\).*their mass and size do not allow.*f1_a.*f1_b"
        self.assertRegex(notes, words)  # its box of water
        self.assertLess(np.linalg.eigvalsh(tree.link("f1_a").inertia).max(), 1e-4)

    def test_where_shapes_of_a_link_without_mass_overlap_the_volume_counts_once(self):
        first = '<collision><geometry><box size="0.1 0.04 0.04"/></geometry></collision>'
        second = first.replace("<geometry>", '<origin xyz="0.05 0 0"/><geometry>')
        text = f'<robot name="bar"><link name="bar">{first}{second}</link></robot>'
        link = self.read("bar.urdf", text)[0].link("bar")
        self.assertAlmostEqual(link.mass, 1000 * 0.15 * 0.04 * 0.04)
        assert_allclose(link.com, (0.025, 0, 0), atol=1e-9)
        across = link.mass * (0.15**2 + 0.04**2) / 12
        along = link.mass * (0.04**2 + 0.04**2) / 12
        assert_allclose(link.inertia, np.diag((along, across, across)), atol=1e-12)

    def test_errors_leave_nothing(self):
        entities = f'<!ENTITY e0 "{80 * "a"}">'
        for number in range(1, 8):
            entities += f'<!ENTITY e{number} "{10 * f"&e{number - 1};"}">'
        for hand, options, words in (
            (_hand(_finger("f1")), {}, "expected a thumb and at least one finger"),
            (_hand(), {}, "has no joint that moves"),
            ("nothing", {}, "cannot be read as XML"),
            (
                f"<!DOCTYPE robot [{entities}]><robot>&e7;</robot>",
                {},
                "limit on input amplification",
            ),
            ((self.sources / "mine" / "robot.urdf").read_text(), {}, "holds the arm as well"),
            (HAND, {"thumb": "f9"}, "--thumb 'f9' is in 0 fingers"),
            (HAND, {"offset": (0, 0, 60)}, "--offset is 0.00, 0.00, 60.00, expected metres"),
            (HAND, {"rpy": (0, 0, 90)}, "--rpy is 0.00, 0.00, 90.00, expected radians"),
            (HAND, {"rpy": (0, 0, np.nan)}, "expected radians"),
        ):
            self.assertRaisesRegex(RobotError, words, self.imported, hand, **options)
        with (
            mock.patch.dict(os.environ, XRESET_MAX_FILE_MB="16"),
            self.assertRaisesRegex(RobotError, "too large to describe a robot"),
        ):
            self.imported(HAND + (2 << 20) * " ")
        self.file("taken", "")
        with self.assertRaisesRegex(XResetError, "is there already"):
            make_robot(self.arm, self.hand, self.folder / "taken")
        self.assertEqual({path.name for path in self.folder.iterdir()}, {"hand.urdf", "taken"})


class BuiltIn(TestCase):
    def test_check_finds_nothing(self):
        for name in BUILT_IN:
            self.assertEqual({finding.level for finding in check(name)}, {"ok"}, name)


class Published(Robots):
    """Hands and an arm as their makers publish them."""

    def unpacked(self, name):
        archive = Path(os.environ.get("XRESET_ROBOTS", ARCHIVES)) / f"{name}.tar.xz"
        if not archive.is_file():
            raise SkipTest(
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
        made = make_robot(arm, hand, self.folder / "mine")
        spec = load_robot(made.folder)
        tree = load_urdf(spec.urdf)
        self.assertEqual(
            (len(spec.arm_indices), len(spec.hand_indices), spec.hand_root), (9, 22, "palm")
        )
        self.assertEqual(
            [tip.contact_links[0][:5] for tip in spec.fingertips], [f"part{i}" for i in range(5)]
        )
        self.assertRegex(
            "\n".join(made.guessed),
            "last joints of the arm, because they move the whole hand: WRJ2, WRJ1; the hand begins",
        )
        # Its fingers are side by side: with the usual spread around home they touch in every second episode.
        usual = replace(spec, home_std=(0.075, 0.1))
        self.assertGreater(checks.touching_itself(usual), 2 * checks.MOST_TOUCHING)
        self.assertLess(checks.touching_itself(spec), checks.MOST_TOUCHING)
        self.assertIn("spread by 0.025 rad or m around home, not 0.1", " ".join(made.guessed))
        for changes, problems, expected in (
            (
                {"hand_root": "forearm"},
                checks._fingers,
                "WRJ2, WRJ1 move every fingertip: joints of a wrist",
            ),
            (
                {"palm": "forearm"},
                checks._frames,
                "the palm 'forearm' is 2.. mm from the nearest finger",
            ),
        ):
            with self.subTest(expected):
                self.assertRegex(dict(problems(replace(spec, **changes), tree))["error"], expected)

    def test_hands_whose_makers_have_other_habits(self):
        arm = self.unpacked("xarm7") / "xarm7.urdf"
        for file, joints, mimics, thumb in (
            ("right_sharpa_wave/right_sharpa_wave.xml", 22, 0, "right_thumb_DP"),
            ("robotiq_2f_85/robotiq_2f_85.urdf", 1, 5, "robotiq_85_left_finger_tip_link"),
            ("inspire_hand/inspire_hand_right.urdf", 6, 6, "thumb_distal"),
        ):
            with self.subTest(file):
                name, model = file.split("/")
                folder = make_robot(
                    arm, self.unpacked(name) / model, self.folder / f"xarm7-{name}"
                ).folder
                spec = load_robot(folder)
                self.assertEqual((len(spec.hand_indices), len(spec.mimics)), (joints, mimics))
                self.assertEqual(spec.fingertips[0].contact_links[0], thumb)
        self.assertEqual(errors(folder), [])
        for name in (
            "mujoco",
            "pybullet",
            "sapien",
        ):  # a joint of Inspire's thumb follows one that is no neighbour
            with self.subTest(name):
                scene = SceneSpec(robot=spec, objects=(load_object("soup"),))
                try:
                    engine = make_backend(name, scene, 1)
                except BackendUnavailableError as error:
                    self.skipTest(str(error))
                with engine:
                    for _ in range(10):
                        engine.step()
                    joints = engine.state().joint_pos[0].double().cpu()
                    poses = Kinematics(spec).link_poses(joints, spec.tracked_links)
                    assert_allclose(joints, spec.home, atol=0.02)
                    assert_allclose(engine.links().pos[0].cpu(), poses[:, :3, 3], atol=2e-3)
