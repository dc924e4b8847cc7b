"""Loading of demonstrations, motion and banks, with the robot and the objects that they need."""

import pickle
import shutil
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import trimesh
from numpy.testing import assert_array_equal

from tests.data import InOneFolder, refuses
from tests.toy_bank import ONLY_FRAMES, SOUP, SPAM, toy_bank, toy_retargeted
from tests.toy_retarget import retargets_quickly
from xreset import (
    Retargeted,
    evaluate,
    load_object,
    load_policy,
    load_robot,
    make_bank,
    make_env,
    make_goals,
    robots,
    stress,
    synthesize,
    train,
    write_bank,
    write_demos,
    write_retargeted,
)
from xreset.errors import DemoError, FileFormatError, RobotError, XResetError
from xreset.eval.rollout import load_trial
from xreset.files.storage import file_hash
from xreset.objects.catalogue import object_source
from xreset.resets.bank import check_objects, starts_and_goals
from xreset.resets.inputs import load_inputs
from xreset.retarget.file import object_sources


class InputsTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.robot = robots.load("ur7e-sharpa")
        cls.demos = synthesize([SPAM, SOUP], 1, seed=0, fps=8.0)
        cls.demos_file = cls.folder / "demos.npz"
        write_demos(cls.demos_file, cls.demos)
        cls.bank_file = cls.folder / "resets.npz"
        write_bank(cls.bank_file, toy_bank(cls.robot))

    def test_demonstrations(self):
        inputs = load_inputs(self.demos_file)
        self.assertEqual([o.name for o in inputs.objects], [SOUP, SPAM])
        self.assertEqual((inputs.path, inputs.hash), (self.demos_file, file_hash(self.demos_file)))
        trimesh.creation.box((0.06, 0.06, 0.1)).export(self.folder / f"{SOUP}.obj")
        soup = load_inputs(self.demos_file, only=["soup"], else_meshes=self.folder)
        self.assertEqual((soup.meshes, len(soup.objects[0].pieces)), (self.folder, 1))
        given = load_inputs(self.demos, objects=[load_object(SPAM), soup.objects[0]])
        self.assertIs(given.objects[0], soup.objects[0])
        self.assertIsNone(inputs.robot_name)
        with self.assertRaisesRegex(
            DemoError, r"demos.npz holds human demonstrations.* \(robot=... or --robot\)"
        ):
            inputs.bank  # noqa: B018

    def test_starts_and_goals_of_demonstrations_and_of_their_motion_are_the_same(self):
        demos = load_inputs(self.demos, robot=self.robot, only=["soup"])
        self.assertEqual(
            ([o.name for o in demos.objects], len(demos.bank.sequence_name)), ([SOUP], 1)
        )
        with retargets_quickly():
            motion = load_inputs(demos.motion())
        self.assertIsInstance(motion.data, Retargeted)
        self.assertEqual((motion.robot_name, motion.hash), ("ur7e-sharpa", None))
        self.assertEqual(motion.bank.num_states, 0)
        for name in ("start_pos", "start_quat_wxyz", "goal_pos", "goal_quat_wxyz"):
            assert_array_equal(getattr(motion.bank, name), getattr(demos.bank, name), name)

    def test_a_bank_names_its_robot(self):
        inputs = load_inputs(self.bank_file)
        self.assertEqual((inputs.robot.name, inputs.robot_name), ("ur7e-sharpa", "ur7e-sharpa"))
        self.assertEqual(inputs.bank.num_states, 6)
        self.assertEqual(
            [o.name for o in load_inputs(self.bank_file, only=["spam"]).objects], [SPAM]
        )
        with self.assertRaisesRegex(DemoError, "resets.npz is a reset bank, which holds no motion"):
            inputs.motion()

    def test_the_meshes_that_a_file_was_made_with_are_taken_or_asked_for(self):
        folder = self.folder / "project"
        (folder / "meshes").mkdir(parents=True)
        trimesh.creation.box((0.06, 0.06, 0.1)).export(folder / "meshes" / f"{SOUP}.obj")
        block = load_object(SOUP, folder / "meshes")
        motion = toy_retargeted(self.robot, [SOUP], [0, 2])
        inputs = {f"object {SOUP}": block.source, "object robot": "a toy", "robot": "openarm"}
        file = folder / "motion.npz"
        config = {"meshes": "meshes", "doubts": ["odd"]}
        write_retargeted(file, motion, config=config, inputs=inputs)
        self.assertEqual(object_sources(inputs)["robot"], "a toy")
        found = load_inputs(file)
        self.assertEqual(found.made_from, inputs)
        self.assertEqual((found.meshes, found.objects[0].source), (folder / "meshes", block.source))
        noted = []
        make_bank(file, out=folder / "bank.npz", note=noted.append, **ONLY_FRAMES)
        self.assertEqual((load_inputs(folder / "bank.npz").meshes, noted), (found.meshes, ["odd"]))
        other = folder / "other"
        other.mkdir()
        trained = replace(load_policy("zero", robot=self.robot.name), meshes=other)
        self.assertEqual(load_trial(trained, file).meshes, folder / "meshes")
        trimesh.creation.box((0.06, 0.06, 0.12)).export(other / f"{SOUP}.obj")
        words = f"made with an imported mesh of {SOUP}, but the given one is another mesh.*--meshes"
        with self.assertRaisesRegex(FileFormatError, words):
            load_inputs(file, meshes=other)
        with self.assertRaisesRegex(FileFormatError, "but the given one is the built-in stand-in"):
            load_inputs(file, objects=[load_object(SOUP)])
        for wrong in (None, "gone", "a\0b", 3):
            write_retargeted(file, motion, config={"meshes": wrong}, inputs=inputs)
            with refuses(self, "--meshes", XResetError, wrong):
                load_inputs(file)
        write_retargeted(file, motion, inputs={f"object {SOUP}": 3})
        self.assertEqual(load_inputs(file, objects=[block]).made_from, {})

    def test_the_folder_of_a_robot_is_found_from_any_working_directory(self):
        folder = self.folder / "work"
        mine = folder / "robots" / "mine"
        shutil.copytree(self.robot.urdf.parent, mine)
        text = (mine / "robot.toml").read_text()
        (mine / "robot.toml").write_text(text.replace('name = "ur7e-sharpa"', 'name = "mine"'))
        robot = load_robot(mine)
        (folder / "runs" / "mine").mkdir(parents=True)  # is no robot
        motion = folder / "runs" / "motion.npz"
        write_retargeted(
            motion, toy_retargeted(robot, [SOUP], [0, 2]), config={"robot": "robots/mine"}
        )
        bank = folder / "runs" / "resets.npz"
        make_bank(motion, out=bank)
        goals = folder / "runs" / "goals.npz"
        make_goals([SOUP], robot=mine, families="lift", per_family=1, out=goals)
        for file in (motion, bank, goals):
            self.assertEqual(load_inputs(file).robot.urdf, robot.urdf, file.name)
        write_bank(bank, toy_bank(robot))
        shutil.move(mine, folder)
        for file in (motion, bank):  # from where the folder has the robot's name
            self.assertEqual(load_inputs(file).robot_name, str(folder / "mine"), file.name)
        shutil.move(folder / "mine", folder / "gone")
        words = "Unknown robot 'mine', and no folder has that name.*--robot"
        with self.assertRaisesRegex(RobotError, words):
            load_inputs(bank)

    def test_what_does_not_fit_is_refused(self):
        with self.assertRaisesRegex(FileFormatError, "for the robot 'ur7e-sharpa'"):
            load_inputs(self.bank_file, robot="openarm")
        with self.assertRaisesRegex(
            FileFormatError, "expected 'xreset-demos/1' .xreset demos. or 'xreset-retargeted"
        ):
            load_inputs(self.bank_file, accept=("demos", "motion"))
        other = toy_bank(self.robot, object_sources=("abc", "stand-in"))
        with self.assertRaisesRegex(
            FileFormatError,
            "was made with an imported mesh of 005_tomato_soup_can, but the given one is the built-in stand-in. Give",
        ):
            load_inputs(other)
        changed = (replace(load_object(SOUP), source="def"), load_object(SPAM))
        with self.assertRaisesRegex(
            FileFormatError, "an imported mesh of .*, but the given one is another mesh, or has"
        ):
            check_objects("bank.npz", other, changed)

    def test_objects_whose_tolerance_has_changed_are_refused(self):
        mesh = self.folder / f"{SOUP}.obj"
        trimesh.creation.box((0.05, 0.06, 0.07)).export(mesh)
        tolerance = mesh.with_suffix(".toml")
        tolerance.write_text("tolerance = 0.001")
        spam = load_object(SPAM)
        fine = load_object(SOUP, self.folder)
        self.assertEqual(fine.source, object_source(SOUP, self.folder))
        bank = toy_bank(self.robot, object_sources=(fine.source, "stand-in"))
        check_objects("bank.npz", bank, (fine, spam))
        tolerance.unlink()
        coarse = load_object(SOUP, self.folder)
        with self.assertRaisesRegex(FileFormatError, "has another tolerance in NAME.toml"):
            check_objects("bank.npz", bank, (coarse, spam))
        before = toy_bank(self.robot, object_sources=(file_hash(mesh), "stand-in"))
        for obj in (fine, coarse):  # 0.3 did not state it
            check_objects("bank.npz", before, (obj, spam))

    def test_another_mesh_is_refused_before_it_is_cut(self):
        meshes = self.folder / "meshes"
        meshes.mkdir()
        for name in (SOUP, SPAM):
            trimesh.creation.box((0.05, 0.06, 0.07)).export(meshes / f"{name}.obj")
        with (
            patch("xreset.objects.catalogue.import_mesh") as cut,
            self.assertRaisesRegex(
                FileFormatError, "resets.npz was made with the built-in stand-in of"
            ),
        ):
            load_inputs(self.bank_file, meshes=meshes)
        cut.assert_not_called()

    def test_a_bank_is_for_objects_of_about_its_mass_and_friction(self):
        heavy = {"object_mass": np.array([40.0, 0.0]), "object_friction": np.array([0.0, 0.0])}
        with self.assertRaisesRegex(
            FileFormatError,
            "made with a mass of 40 kg of 005_tomato_soup_can, but it is 0.349 kg now. Make",
        ):
            load_inputs(toy_bank(self.robot, **heavy))
        soup = load_object(SOUP)
        spam = load_object(SPAM)
        bank = starts_and_goals(
            toy_retargeted(self.robot, [SOUP], [0, 2]), self.robot, [replace(soup, friction=0.4)]
        )
        assert_array_equal((bank.object_mass, bank.object_friction), ([soup.mass], [0.4]))
        for near in ({"friction": 0.43}, {"friction": None}, {"mass": 1.05 * soup.mass}):
            check_objects("bank.npz", bank, (replace(soup, **near), spam))
        for far, words in (
            ({"friction": 0.8}, "a friction of 0.4 of .*, but it is 0.8 now"),
            ({"mass": 1.2 * soup.mass}, "a mass of 0.349 kg of .*, but it is 0.419 kg now"),
        ):
            with refuses(self, words, FileFormatError):
                check_objects("bank.npz", bank, (replace(soup, **far), spam))

    def test_numbers_without_sense_are_refused(self):
        bank = toy_bank(self.robot)
        motion = toy_retargeted(self.robot, [SOUP], [0, 2])
        objects = [load_object(name) for name in (SOUP, SPAM)]
        run = {"bank": self.bank_file, "out": self.folder / "run", "engine": "mujoco"}
        scene = {"robot": self.robot, "objects": objects}
        playing = {"policy": "zero", "robot": "ur7e-sharpa", "demos": bank}
        seeds = "a whole number from 0 to 4294967295"
        counts = "a whole number above 0"
        for call, given, wrong, expected in (
            (train, run, {"seed": "3"}, seeds),
            (train, run, {"seed": -1}, seeds),
            (evaluate, playing, {"episodes": "5"}, counts),
            (evaluate, playing, {"num_envs": 0}, counts),
            (make_bank, {"retargeted": motion} | scene, {"num_envs": 0}, counts),
            (evaluate, playing, {"seed": 2**32}, seeds),
            (make_env, {"bank": bank} | scene, {"seed": np.random.default_rng()}, seeds),
            (stress, {"policy": "many-objects", "demos": bank}, {"episodes": 0}, counts),
        ):
            with (
                self.subTest(call.__name__, **wrong),
                self.assertRaisesRegex(
                    XResetError, f"^{next(iter(wrong))} is .*, expected {expected}"
                ),
            ):
                call(**given | wrong)
        self.assertFalse((self.folder / "run").exists())

    def test_an_empty_selection_is_not_everything(self):
        for call in (
            lambda: synthesize([]),
            lambda: make_goals([], robot="openarm"),
            lambda: evaluate("zero", self.demos, [], robot="ur7e-sharpa"),
        ):
            with self.assertRaisesRegex(XResetError, "^No (object|engine) is named. Name one"):
                call()

    def test_functions_of_the_package_can_be_sent_to_other_processes(self):
        for function in (evaluate, make_env, train):
            self.assertIs(pickle.loads(pickle.dumps(function)), function)

    def test_errors_of_right_arguments_are_not_changed(self):
        with patch("xreset.eval.policy_spec.load_policy", side_effect=TypeError("defect")):
            self.assertRaisesRegex(TypeError, "defect", evaluate, "zero", self.demos)
