"""Robots: those that ship, descriptions with mistakes, and what `xreset robots check` finds."""

import pickle
import shutil
from dataclasses import replace
from importlib.metadata import EntryPoint
from unittest import TestCase, mock

import numpy as np
import trimesh
from numpy.testing import assert_allclose

from ci import build_robot
from tests.command import refused, succeeds
from tests.data import InFolder
from xreset import TaskConfig, spec
from xreset.errors import PolicyError, RobotError
from xreset.geometry.description import load_robot as load
from xreset.geometry.dynamics import mass_matrix
from xreset.geometry.urdf import find_mesh, robot_tree
from xreset.physics import plugins
from xreset.physics.plugins import robot_folder, robot_names
from xreset.policy.onnx_policy import check_contract, policy_contract
from xreset.robot_tools.check import check
from xreset.spec import DriveSpec

BUILT_IN = {
    "ur7e-sharpa": "503f290c651dbc9d645a3113d96b9f9c51eecfe382a87fadbeaec8c8896e08d2",
    "openarm": "116fba4a3550b6d513fc9a9969e9721697cf89b4b22531e97b45bb9812ddc8dc",
    "panda-allegro": "4c90fbf5c62c42bd8197697c9331762e171cc0bc31a68497313c1a51fdee8293",
    "xarm7-leap": "04b05e0bf4c1a894947de4d2158377814dc3564cc7c3b140c7c77546e5311f08",
    "iiwa14-sharpa": "9fb78ff68276bc76de9068ad23ba2702c7a12a9d2676abc1aac9853eb803a04b",
    "ur7e-robotiq": "740b49e8bc789c5b0a5bbf56850436307734536baac4e177c4a3384f833d9c17",
}
"""Their fingerprints, which are in reset banks and policies, those of 0.1.0 too."""


class Copied(InFolder):
    """A copy of the OpenArm that may be changed."""

    def setUp(self):
        super().setUp()
        shutil.copytree(robot_folder("openarm"), self.folder, dirs_exist_ok=True)

    def edit(self, file, changes):
        """Replace texts in a file: old -> new."""
        path = self.folder / file
        text = path.read_text()
        for old, new in changes.items():
            self.assertIn(old, text)
            text = text.replace(old, new)
        path.write_text(text)


class BuiltIn(TestCase):
    def test_committed_urdf_is_what_build_writes(self):
        for name in BUILT_IN:
            with self.subTest(name):
                self.assertEqual(
                    load(name).urdf.read_text(), build_robot.robot_urdf(name.replace("-", "_"))
                )

    def test_fingerprints_are_those_of_earlier_files(self):
        for name, fingerprint in BUILT_IN.items():
            self.assertEqual(load(name).fingerprint, fingerprint, name)

    def test_a_fingerprint_is_of_values_and_not_of_how_python_holds_them(self):
        robot = load("openarm")
        first = robot.joints[0]
        same = replace(
            first,
            home=np.float64(first.home),
            drive=replace(first.drive, kp=np.float32(first.drive.kp)),
        )
        self.assertEqual(
            replace(robot, joints=(same, *robot.joints[1:])).fingerprint, robot.fingerprint
        )
        other = replace(first, drive=replace(first.drive, kp=first.drive.kp + 1))
        self.assertNotEqual(
            replace(robot, joints=(other, *robot.joints[1:])).fingerprint, robot.fingerprint
        )
        # as if armature and friction_loss had been added today
        with mock.patch.dict(spec._DESCRIBED, {DriveSpec: ("kp", "kd", "effort")}):
            self.assertEqual(
                spec._description(DriveSpec(kp=1, kd=2, effort=3)),
                "DriveSpec(kp=1, kd=2, effort=3)",
            )
            self.assertEqual(
                spec._description(DriveSpec(kp=1, kd=2, effort=3, armature=0.5)),
                "DriveSpec(kp=1, kd=2, effort=3, armature=0.5)",
            )

    def test_one_line_says_what_a_robot_is(self):
        robot = load("ur7e-robotiq")
        words = (
            "RobotSpec('ur7e-robotiq', 6 joints of the arm, 1 of the hand, fingertips thumb, index)"
        )
        self.assertEqual(repr(robot), words)
        again = pickle.loads(pickle.dumps(robot))
        self.assertEqual((again, hash(again)), (robot, hash(robot)))


class Folder(Copied):
    def test_a_file_in_the_folder_is_refused_with_the_folder(self):
        with self.assertRaisesRegex(RobotError, f"is a file. Give .*: {self.folder}$"):
            load(self.folder / "robot.toml")


class Fingerprint(Copied):
    def test_a_changed_mesh_makes_another_robot(self):
        folder = self.folder
        self.edit("robot.urdf", {'<box size="0.05 0.14 0.04" />': '<mesh filename="body.stl" />'})
        trimesh.creation.box((0.05, 0.14, 0.04)).export(folder / "body.stl")
        before = load(folder)
        self.assertEqual([mesh.name for mesh in before.meshes], ["body.stl"])
        stated = before.fingerprint
        of_0_1_0 = replace(before, meshes=()).fingerprint
        trimesh.creation.box((0.06, 0.14, 0.04)).export(folder / "body.stl")
        after = load(folder)
        self.assertFalse(after.has_fingerprint(stated))
        self.assertTrue(after.has_fingerprint(after.fingerprint))
        self.assertTrue(after.has_fingerprint(of_0_1_0))

    def test_a_robot_like_another_plays_its_policies(self):
        robot = load("openarm")
        self.edit(
            "robot.toml", {'name = "openarm"': f'name = "other"\nlike = "{robot.fingerprint}"'}
        )
        other = load(self.folder)
        task = TaskConfig()
        check_contract("p.onnx", policy_contract(robot, task, ()), other, task)
        with self.assertRaisesRegex(PolicyError, "of the robot 'other', not of 'openarm'"):
            check_contract("p.onnx", policy_contract(other, task, ()), robot, task)


class Dynamics(TestCase):
    def test_mass_matrix_is_mujocos(self):
        import mujoco

        robot = load("openarm")
        model = mujoco.MjModel.from_xml_path(str(robot.urdf))
        data = mujoco.MjData(model)
        (mimic,) = robot.mimics
        rates = np.zeros((model.nv, len(robot.joints)))
        for row in range(model.njnt):
            name = model.joint(row).name
            factor = 1.0
            if name == mimic.joint:
                name = mimic.source
                factor = mimic.multiplier
            rates[row, robot.joint_names.index(name)] = factor
        data.qpos = rates @ robot.home
        mujoco.mj_forward(model, data)
        M = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, M)
        assert_allclose(mass_matrix(robot, robot.home), rates.T @ M @ rates, atol=1e-6)


class Registry(Copied):
    def errors(self, level="error"):
        return "\n".join(f"{f.topic}: {f.message}" for f in check(self.folder) if f.level == level)

    def test_names_and_folders(self):
        self.assertLessEqual(set(BUILT_IN), set(robot_names()))
        robot = load(self.folder)
        self.assertEqual(robot.home.tolist(), load("openarm").home.tolist())
        self.assertIs(load(robot), robot)
        self.assertRaisesRegex(RobotError, "ur7e-sharpa", load, "no-such-robot")

    def test_a_plugin_has_the_name_that_files_give_its_robot(self):
        entry = EntryPoint("mine", "xreset.robots.openarm", plugins.ROBOTS)
        with (
            mock.patch.object(plugins, "entry_points", lambda group: [entry]),
            self.assertRaisesRegex(RobotError, "'mine' calls it 'openarm' in robot.toml"),
        ):
            load("mine")

    def test_a_broken_plugin_harms_nobody(self):
        entries = [
            EntryPoint("broken", "xreset_no_such_package.robot", plugins.ROBOTS),
            EntryPoint("openarm", "xreset.robots.openarm", plugins.ROBOTS),
        ]
        with mock.patch.object(plugins, "entry_points", lambda group: entries):
            self.assertEqual(robot_names(), ["broken", "openarm"])
            self.assertEqual(load("openarm").name, "openarm")
            self.assertRaisesRegex(RobotError, "'broken'.*xreset_no_such_package", load, "broken")
            output = succeeds("robots list")
        self.assertRegex(output, r"broken[\s\S]*openarm")

    def refused(self, *parts):
        """Refuse the description; the message has all parts."""
        with self.assertRaises(RobotError) as caught:
            load(self.folder)
        for part in parts:
            self.assertIn(part, str(caught.exception))

    def test_every_mistake_in_a_description_is_listed(self):
        self.edit(
            "robot.toml",
            {
                'palm = "palm"': 'plam = "palm"',
                "home = 0.38, kp = 400.0": 'home = "0.38", kp = true',
                'keypoint = "index4"': 'keypoint = "index5"',
                "pos = [0.45, 0.60, 0.55]": "pos = [0.45, 0.60]",
                'source = "finger_joint1" }': 'source = "finger_joint1", multiplier = 0.0 }',
            },
        )
        self.refused(
            "unknown: hand.plam; missing: hand.palm; known: name, urdf, joints, mimics, base.pos, ",
            "joints[0].home",
            "joints[0].kp",
            "index5",
            "base.pos has 2",
            "mimics[0].multiplier is 0.0, expected a number other than 0",
            "6 places",
        )

    def test_contradictions(self):
        self.edit(
            "robot.toml",
            {
                'name = "thumb", link': 'name = "index", link',
                'source = "finger_joint1"': 'source = "finger_joint9"',
                "quat = [0.38268343,": "quat = [0.5,",
            },
        )
        self.refused("index occur more than once", "finger_joint9", "must be 'thumb'", "expected 1")

    def test_not_toml_wrong_schema_no_file(self):
        for text, message in (("schema = ", "not valid TOML"), ('schema = "other/1"', "other/1")):
            (self.folder / "robot.toml").write_text(text)
            self.refused(message)
        (self.folder / "robot.toml").unlink()
        self.refused("robot.toml cannot be read")

    def test_check_tells_all_that_only_the_urdf_knows(self):
        self.edit(
            "robot.toml",
            {
                'name = "joint7"': 'name = "joint9"',
                "home = 1.50": "home = 2.60",
                'wrist = "link7"': 'wrist = "link77"',
                '["link5", "link7"],': '["link5", "link8"], ["link9", "link7"],',
                "mimics = [{": "mimics = [{ multiplier = 2.0,",
            },
        )
        self.edit(
            "robot.urdf",
            {
                'ixx="0.000143"': 'ixx="-0.00143"',
                '<mass value="0.550659" />': '<mass value="0" />',
            },
        )
        found = self.errors()
        for part in (
            "'joint9' is not in the URDF",
            "'joint7' moves",
            "'joint4' is at home at 2.6",
            "links: keypoints: the URDF has no link 'link77'. Choose from: link0",
            "links: collision.exclude: the URDF has no link 'link8', 'link9'. Choose",
            "finger_joint2",
            "'link6' has the principal moments -",
            "'link5' moves but has the mass 0",
        ):
            self.assertIn(part, found)

    def test_check_names_a_driven_joint_and_a_mimic_that_are_fixed(self):
        self.edit(
            "robot.urdf",
            {
                '"joint7" type="revolute"': '"joint7" type="fixed"',
                '"finger_joint2" type="prismatic"': '"finger_joint2" type="fixed"',
            },
        )
        found = self.errors()
        for name in ("joint7", "finger_joint2"):
            self.assertIn(f"'{name}' is fixed in the URDF, whose moving joints are joint1", found)
        self.assertEqual(
            self.errors("skipped").splitlines()[0],
            "mimic joints: 'finger_joint2': fix the errors of joints first",
        )

    def test_check_finds_a_missing_mesh(self):
        self.edit(
            "robot.urdf",
            {'<box size="0.05 0.14 0.04" />': '<mesh filename="package://a/body.stl" />'},
        )
        self.assertRegex(
            self.errors(), r"URDF: .*'package://a/body\.stl', which is not in its folders"
        )

    def test_a_mesh_name_does_not_lead_out_of_the_robots_folders(self):
        deep = self.folder / "a" / "b" / "c" / "d"
        (deep / "meshes").mkdir(parents=True)
        inside = deep / "x.stl"
        above = self.folder / "a" / "y.stl"
        too_far = self.folder / "z.stl"
        for file, names, found in (
            (inside, ("x.stl", "meshes/../x.stl", f"{inside}", "package://d/x.stl"), inside),
            (above, ("../../../y.stl", "package://any/y.stl", f"file://{above}"), above),
            (too_far, ("../../../../z.stl", f"{too_far}", "package://../../../../z.stl"), None),
        ):
            file.touch()
            for name in names:
                with self.subTest(name):
                    self.assertEqual(find_mesh(name, deep / "robot.urdf"), found)

    def test_check_finds_home_in_the_table_and_in_itself_and_drives_that_swing(self):
        self.edit(
            "robot.toml",
            {
                "pos = [0.45, 0.60, 0.55]": "pos = [0.45, 0.60, 0.10]",
                '["link5", "link7"],': "",
                "kd = 28.3": "kd = 9.0",
                "kd = 55.3": "kd = 500.0",
            },
        )
        self.assertRegex(self.errors(), r"lowest at -[\s\S]*link5 and link7 overlap at home")
        warnings = self.errors("warning")
        self.assertRegex(
            warnings,
            r"'joint1' has the damping ratio 0\.\d+ at home. It swings[\s\S]*finger_joint1': kd = 500",
        )

    def test_a_robot_whose_links_may_all_touch_the_table(self):
        solid = [link.name for link in robot_tree(load(self.folder)).links if link.collisions]
        self.edit("robot.toml", {'table_exclude = ["link0"]': f"table_exclude = {solid}"})
        self.assertIn(
            "home and table: no shape that may not touch the table is above it; 0 %",
            self.errors("ok"),
        )

    def test_command_fails_on_errors_only(self):
        succeeds("robots check", self.folder)
        self.edit("robot.toml", {'palm = "palm"': 'palm = "plam"'})
        picture = self.folder / "robot.png"
        said = refused("robots check", self.folder, "--picture", picture)
        self.assertRegex(
            said, r"error +links: hand.palm: the URDF has no link 'plam'[\s\S]*1 error"
        )
        self.assertFalse(picture.exists())
