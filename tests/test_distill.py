"""Distillation: the teacher's network from its file, a student's training, resumed and exported, and refusals."""

import io
from contextlib import redirect_stdout
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import torch

from tests.data import refuses
from tests.toy_bank import in_this_process
from tests.toy_training import CONFIG, OPTIONS, WithBank, quickly
from xreset import make_env, train
from xreset.cameras.config import FRONT, WRIST, VisionConfig
from xreset.errors import PolicyError, XResetError
from xreset.learning.checkpoint import read_checkpoint
from xreset.learning.config import PpoConfig, TrainConfig
from xreset.learning.from_onnx import network_of
from xreset.learning.recipes import student_config
from xreset.learning.run import TEACHER, latest_checkpoint, read_run
from xreset.learning.train import config_of_student
from xreset.objects.catalogue import load_objects
from xreset.policy.onnx_policy import OnnxPolicy, check_contract
from xreset.policy.shipped import shipped
from xreset.task.config import ObservationConfig, TaskConfig, evaluation_task

TASK = TaskConfig(
    observation=ObservationConfig(
        cloud_points=16, perception={"paired_cloud": {"noise": 0.002, "scale": 1.0}}
    ),
    distance_points=64,
)
SMALL = replace(CONFIG.model, initial_std=0.1)
SEEING = VisionConfig(cameras=(FRONT, WRIST), width=16, height=12, points=8)


class DistillTest(WithBank):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.enterClassContext(in_this_process())
        cls.teacher = cls.folder / "teacher"
        config = TrainConfig(
            task=TASK, model=SMALL, ppo=PpoConfig(horizon=8, mini_epochs=1), iterations=1
        )
        with redirect_stdout(io.StringIO()):
            train(cls.bank, out=cls.teacher, config=config, **OPTIONS)
            cls.run_folder = cls.distill("student")

    @classmethod
    def distill(cls, name, vision=SEEING, **changes):
        config = student_config(TASK, vision)
        ppo = replace(
            config.ppo, horizon=8, sequence_length=4, minibatch_size=16, learning_rate=3e-3
        )
        config = replace(config, **({"model": SMALL, "ppo": ppo, "iterations": 2} | changes))
        out = cls.folder / name
        return train(cls.bank, teacher=cls.teacher, out=out, config=config, **OPTIONS)

    def env(self, vision):
        objects = load_objects(list(self.states.object_names), None)
        task = replace(evaluation_task(TASK), vision=vision)
        env = make_env(self.robot, objects, self.states, task, engine="mujoco", num_envs=2)
        self.addCleanup(env.close)
        return env

    def test_every_policy_that_ships_can_teach(self):
        for file in shipped().values():  # in float16, and of a history of clouds
            network_of(OnnxPolicy(file))  # which compares its actions with the file's

    def test_the_run_is_a_policy_that_sees(self):
        info = read_run(self.run_folder)
        self.assertEqual(info.teacher, str(self.teacher))
        self.assertEqual(
            (self.run_folder / TEACHER).read_bytes(), (self.teacher / "policy.onnx").read_bytes()
        )
        policy = OnnxPolicy(self.run_folder / "policy.onnx")
        self.assertEqual(list(policy.contract.observation_layout), ["goal", "proprio", "view"])
        env = self.env(SEEING)
        check_contract("it", policy.contract, self.robot, env.task)
        seen = env.get_observations()
        blind = seen.clone()
        blind["view"] = torch.zeros_like(blind["view"])
        told = seen.clone()
        for name in ("policy", "perception", "privileged"):
            told[name] = torch.zeros_like(told[name])
        actions = []
        for observations in (seen, blind, told):
            policy.begin(env)
            actions.append(policy.act(observations))
        self.assertEqual(actions[0].shape, (2, env.num_actions))
        self.assertFalse(torch.allclose(actions[0], actions[1]))
        self.assertTrue(torch.equal(actions[0], actions[2]))
        with self.assertRaisesRegex(PolicyError, "another set of cameras"):
            check_contract(
                "it",
                policy.contract,
                self.robot,
                replace(env.task, vision=replace(SEEING, interval=1)),
            )
        layout = policy.contract.observation_layout | {"view": {"depth": 768}}
        of_images = replace(policy.contract, observation_layout=layout)  # of version 0.3
        with self.assertRaisesRegex(PolicyError, "another observation layout .view.depth: 768"):
            check_contract("it", of_images, self.robot, env.task)

    def test_the_student_learns_the_teachers_actions_and_resumes(self):
        errors = []

        def note(_log, _iteration, _steps, _elapsed, scalars):
            errors.append(scalars["loss/behavior"])

        with quickly(), patch("xreset.learning.runner.TrainingLog.write", note):
            out = self.distill("longer", iterations=15, save_interval=100)
            before = read_checkpoint(latest_checkpoint(out))
            train(out=out, iterations=20)
            after = read_checkpoint(latest_checkpoint(out))
        self.assertLess(np.mean(errors[-3:]), 0.5 * np.mean(errors[:3]))
        self.assertEqual((before.iteration, after.iteration), (15, 20))
        steps = []
        for checkpoint in (before, after):
            states = checkpoint.optimizer_state_dict["state"].values()
            steps.append(max(int(state["step"]) for state in states))
        self.assertEqual(20 * steps[0], 15 * steps[1], "the optimizer went on")

    def test_cameras_of_a_student(self):
        vision = config_of_student("many-objects").task.vision
        self.assertEqual(vision.cameras, (FRONT,))
        for cameras in ("wrist", WRIST, ("wrist",)):
            vision = config_of_student("many-objects", cameras).task.vision
            self.assertEqual(vision.cameras, (WRIST,))

    def test_refusals(self):
        away = replace(SEEING, cameras=(replace(FRONT, target=(3.0, 0.2, 0.5)),))
        two = {"teacher": self.teacher, "bank": self.bank, "out": self.folder / "refused"}
        for error, words, options in (
            (
                XResetError,
                "Unknown camera 'rear'. Choose from: front, side, wrist",
                {"cameras": "rear"},
            ),
            (XResetError, "'front' is given twice. Give each", {"cameras": ("front", FRONT)}),
            (XResetError, "Unknown camera 3", {"cameras": (FRONT, 3)}),
            (PolicyError, "Unknown policy 'nobody'", {"teacher": "nobody"}),
            (
                PolicyError,
                "sees through cameras itself",
                {"teacher": self.run_folder, "config": student_config(TASK, SEEING)},
            ),
        ):
            with quickly(), refuses(self, words, error):
                train(**(two | options))
            self.assertFalse((self.folder / "refused").exists(), words)
        with self.assertRaisesRegex(
            XResetError, r"no critic.* another run .--weights.*xreset train --out"
        ):
            train(
                self.bank,
                out=self.folder / "refused",
                weights=self.run_folder,
                config=CONFIG,
                **OPTIONS,
            )
        words = "No camera shows 005_tomato_soup_can, 010_potted_meat_can"
        with quickly(), self.assertRaisesRegex(XResetError, words):
            self.distill("away", away)
        self.assertFalse((self.folder / "away").exists())
        notes = self.folder / "kept" / "notes.txt"
        notes.parent.mkdir()
        notes.touch()
        with quickly(), self.assertRaisesRegex(XResetError, words):
            self.distill("kept", away)
        self.assertEqual(list(notes.parent.iterdir()), [notes])

    def test_a_student_is_resumed_as_it_was_started(self):
        for options, problem in (
            ("", ""),
            ("--camera front", "continues as it was started. Omit cameras"),
            ("--config.task.vision.points 64", "Omit config"),
            # the default, which is not what the run was started with
            ("--num-envs 1024", "Omit num_envs"),
            ("--teacher many-objects", "Omit teacher"),
        ):
            with self.subTest(options):
                self.assert_resumed(f"train --out {self.run_folder} {options}", problem)
