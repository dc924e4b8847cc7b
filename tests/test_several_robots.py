"""One policy for several robots: slots of joints and fingertips, environments in a row, training and evaluation."""

from contextlib import redirect_stdout
from dataclasses import replace
from functools import partial
from io import StringIO
from unittest import SkipTest, TestCase
from unittest.mock import patch

import numpy as np
import torch
from torch.testing import assert_close

from tests.data import InOneFolder
from tests.toy_bank import SOUP, toy_bank
from tests.toy_training import CONFIG, OPTIONS, quickly
from xreset import (
    evaluate,
    load_policy,
    make_backend,
    robots,
    train,
    write_bank,
)
from xreset.env.manipulation import make_env
from xreset.env.several import SeveralEnvs
from xreset.errors import PolicyError, RobotError, RunError, XResetError
from xreset.learning.checkpoint import read_checkpoint
from xreset.learning.model import CLIP_OBSERVATIONS, Gaussian, PointNet, PointNetLstmModel, Trunk
from xreset.learning.recipes import for_robots
from xreset.learning.run import checkpoints, latest_checkpoint, read_run
from xreset.learning.train import config_of_student
from xreset.live.engine import GraphPolicy
from xreset.objects.catalogue import load_objects
from xreset.policy.onnx_policy import check_contract, policy_contract
from xreset.runtime import Controller
from xreset.task.config import TaskConfig
from xreset.task.slots import Slots, check_fits, needed_slots

try:
    import xreset.backends.mujoco  # noqa: F401
except ImportError as error:
    raise SkipTest(str(error)) from error

ARMS = ("openarm", "ur7e-robotiq")
"""A jaw on an arm of seven joints, and one on an arm of six."""


def bank_at_home(robot):
    home = np.tile(robot.home, (6, 1)).astype(np.float32)
    return toy_bank(robot, joint_pos=home)


class SlotsTest(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.sharpa = robots.load("ur7e-sharpa")
        cls.allegro = robots.load("panda-allegro")

    def test_what_robots_need(self):
        for name, needed in (
            ("ur7e-sharpa", (6, 5)),
            ("iiwa14-sharpa", (7, 5)),
            ("panda-allegro", (7, 4)),
            ("xarm7-leap", (7, 4)),
            ("ur7e-robotiq", (6, 1)),
            ("openarm", (7, 1)),
        ):
            self.assertEqual(needed_slots([robots.load(name)]), needed, name)
        self.assertEqual(needed_slots([self.sharpa, self.allegro]), (7, 5))

    def test_a_finger_has_the_same_slots_in_every_hand(self):
        for robot, first, tips in (
            (self.sharpa, "right_middle_MCP_FE", [0, 1, 2, 3, 4]),
            (self.allegro, "middle_base_joint", [0, 1, 2, 3, 4]),
            (robots.load("openarm"), None, [0, 1, 2, 2, 2]),
        ):
            slots = Slots.of(robot, (7, 5))
            self.assertEqual(slots.tip.tolist(), tips)
            self.assertEqual(slots.mask.sum(), len(robot.joints))
            self.assertEqual(len(set(slots.of_joint.tolist())), len(robot.joints))
            self.assertEqual(
                slots.of_joint[: len(robot.arm_indices)].tolist(), [*robot.arm_indices]
            )
            if first is not None:
                index = robot.joint_names.index(first)
                self.assertEqual(slots.of_joint[index : index + 4].tolist(), [17, 18, 19, 20])

    def test_values_in_slots(self):
        slots = Slots.of(self.allegro, (7, 5))
        values = torch.randn(3, 2 * len(self.allegro.joints))
        found = slots.joints(values).unflatten(1, (-1, 2))
        self.assertEqual(found.shape, (3, 32, 2))
        assert_close(found[:, slots.of_joint].flatten(1), values, rtol=0, atol=0)
        self.assertFalse(found[:, slots.mask == 0].any())
        tips = slots.tips(torch.ones(1, 4 * 3))
        self.assertEqual(tips.tolist(), [[1.0] * 12 + [0.0] * 3])

    def test_a_policy_of_other_slots_is_refused(self):
        """Although both have 32 actions."""
        tasks = [TaskConfig(joint_slots=slots) for slots in ((7, 5), (12, 4))]
        contract = policy_contract(self.allegro, tasks[0], ())
        with self.assertRaisesRegex(PolicyError, r"mapping .joint_slots: \(7, 5\), here \(12, 4\)"):
            check_contract("it", contract, self.allegro, tasks[1])

    def test_robots_that_do_not_fit(self):
        with self.assertRaisesRegex(RobotError, "6 joints in its arm and up to 5 .* 7 and 1"):
            check_fits(self.sharpa, (7, 1))
        thumb, index, *others = self.sharpa.fingertips
        twice = replace(self.sharpa, fingertips=(thumb, replace(index, keypoint="thumb3"), *others))
        with self.assertRaisesRegex(RobotError, "follow thumb, thumb, middle"):
            check_fits(twice, (7, 5))
        with self.assertRaisesRegex(RobotError, "right_pinky_CMC, .* move no fingertip"):
            check_fits(replace(self.sharpa, fingertips=self.sharpa.fingertips[:-1]), (7, 5))


class MaskTest(TestCase):
    def test_actions_that_a_robot_lacks_have_no_part_in_anything(self):
        gaussian = Gaussian(3, init_std=0.5, std_type="log")
        gaussian.mask = torch.tensor([[1.0, 0.0, 1.0], [1.0, 1.0, 1.0]])
        means = torch.tensor([[0.1, 0.2, 0.3]] * 2, requires_grad=True)
        actions = torch.tensor([[0.5, 5.0, -0.5]] * 2)
        gaussian.update(means)
        before = gaussian.params
        one, two = gaussian.log_prob(actions)
        (gaussian.log_prob(actions)[0] + gaussian.entropy[0]).backward()
        self.assertEqual((means.grad[0] != 0).tolist(), [True, False, True])
        self.assertEqual((gaussian.log_std_param.grad != 0).tolist(), [True, False, True])
        gaussian.update(means + torch.tensor([0.0, 1.0, 0.0]))
        changed = gaussian.log_prob(actions)
        self.assertEqual(changed[0], one)
        self.assertNotEqual(changed[1], two)
        kl = gaussian.kl_divergence(before, gaussian.params)
        self.assertEqual((kl != 0).tolist(), [False, True])

    def test_observations_that_were_constant_are_limited(self):
        trunk = Trunk(2, PointNet((4,), 3), 1, 4, clip=True)
        trunk.normalizer.update(torch.tensor([[1.0, 0.0], [1.0, 2.0]]))
        trunk.eval()
        joined = trunk.join(torch.tensor([[3.0, 1.0], [1.0, 0.0]]), torch.zeros(2, 1, 1))
        self.assertEqual(joined[:, 0].tolist(), [CLIP_OBSERVATIONS, 0.0])
        self.assertLess(joined[1, 1], -0.5)


class EnvTest(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.objects = load_objects((SOUP, "010_potted_meat_can"), None)
        cls.robots = [robots.load(name) for name in ARMS]
        cls.task = for_robots(CONFIG, cls.robots).task

    def env(self, robot, task):
        with quickly():
            made = make_env(robot, self.objects, bank_at_home(robot), task, num_envs=2, seed=1)
        self.addCleanup(made.close)
        return made

    def test_slots_change_no_episode(self):
        """The same actions have the same effect, whatever is in empty slots, and terms hold the same numbers."""
        robot = self.robots[1]
        plain = self.env(robot, CONFIG.task)
        env = self.env(robot, self.task)
        self.assertEqual((plain.num_actions, env.num_actions), (7, 7 + 5))
        empty = env.slots.mask == 0
        for _ in range(3):
            action = 2 * torch.rand(2, 7) - 1
            expected, *ends = plain.step(action)
            observed, *others = env.step(env.slots.joints(action) + 0.7 * empty)
            for one, two in zip(ends[:2], others[:2], strict=True):
                assert_close(one, two, rtol=0, atol=0)
            assert_close(plain.backend.state().joint_pos, env.backend.state().joint_pos)
            proprio = observed["proprio"]
            joint_pos = proprio[:, :12]
            assert_close(joint_pos[:, env.slots.of_joint], expected["proprio"][:, :7])
            self.assertFalse(joint_pos[:, empty].any())
            mask = proprio[:, -41:-29]
            limits = proprio[:, -29:-5]
            tips = proprio[:, -5:]
            assert_close(mask, observed["action_mask"])
            assert_close(mask[0], env.slots.mask)
            self.assertEqual(tips.tolist(), [[1, 1, 0, 0, 0]] * 2)
            lower = limits.unflatten(1, (-1, 2))[0, env.slots.of_joint, 0]
            assert_close(lower, env.actions.lower)

    def test_a_row_of_environments_is_each_of_them(self):
        alone = [self.env(robot, self.task) for robot in self.robots]
        row = SeveralEnvs([self.env(robot, self.task) for robot in self.robots])
        row.episode_length_buf = torch.tensor([0, 1, 2, 3])
        for env, lengths in zip(alone, ((0, 1), (2, 3)), strict=True):
            env.episode_length_buf = torch.tensor(lengths)
        action = 2 * torch.rand(4, row.num_actions) - 1
        observed, reward, done, extras = row.step(action)
        parts = [env.step(part) for env, part in zip(alone, action.split(2), strict=True)]
        for group, value in observed.items():
            assert_close(value, torch.cat([part[0][group] for part in parts]), rtol=0, atol=0)
        assert_close(reward, torch.cat([part[1] for part in parts]), rtol=0, atol=0)
        assert_close(done, torch.cat([part[2] for part in parts]))
        self.assertEqual(row.episode_length_buf.tolist(), [1, 2, 3, 4])
        self.assertIn("task/success_from_home/ur7e-robotiq", extras["log"])
        row.resets.success_rate.copy_(torch.arange(6))
        self.assertEqual(row.envs[1].resets.success_rate.tolist(), [3, 4, 5])

    def test_observations_of_different_widths_are_refused(self):
        with self.assertRaisesRegex(XResetError, "'policy' have the shape"):
            SeveralEnvs([self.env(robot, CONFIG.task) for robot in self.robots])


class TrainingTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.banks = []
        for name in ARMS:
            path = cls.folder / f"{name}.npz"
            write_bank(path, bank_at_home(robots.load(name)))
            cls.banks.append(path)
        cls.out = cls.folder / "run"
        with (
            patch("xreset.env.manipulation.make_backend", partial(make_backend, workers=0)),
            redirect_stdout(StringIO()),
        ):
            train(cls.banks, out=cls.out, config=CONFIG, **OPTIONS | {"num_envs": 5})

    def test_what_a_run_holds(self):
        info = read_run(self.out)
        self.assertEqual(info.config.task.joint_slots, (7, 1))
        self.assertEqual(
            (info.robot, [o.robot for o in info.others]), ("openarm", ["ur7e-robotiq"])
        )
        self.assertEqual([*info.contract.others], ["ur7e-robotiq"])
        self.assertEqual(info.contract.num_actions, 12)
        self.assertEqual(info.contract.observation_layout["proprio"]["joint_pos_limits"], 24)
        self.assertEqual(len(checkpoints(self.out)), 2)
        with quickly():
            train(out=self.out, iterations=3)
            train(out=self.out)
        self.assertEqual(len(checkpoints(self.out)), 3)

    def test_the_policy_plays_each_of_its_robots_and_others_that_fit(self):
        for name, folder in (
            ("openarm", "eval"),
            ("ur7e-robotiq", "ur7e-robotiq/eval"),
        ):
            self.assertEqual(load_policy(self.out, robot=name).folder, self.out / folder)
            (result,) = self.evaluation(name)
            self.assertEqual(result.robot, name)
            self.assertEqual(len(result.episodes), 3)
        self.assertEqual(load_policy(self.out).robot.name, "openarm")
        with self.assertRaisesRegex(PolicyError, "'ur7e-sharpa' has 6 .* up to 5 .* 7 and 1"):
            load_policy(self.out, robot="ur7e-sharpa")
        unknown = replace(robots.load("ur7e-robotiq"), name="another")
        with patch("xreset.eval.policy_spec.load_robot", return_value=unknown):
            self.assertEqual(load_policy(self.out, robot="another").robot.name, "another")
        changed = replace(unknown, name="ur7e-robotiq", home_std=(0.0, 0.0))
        with (
            patch("xreset.eval.policy_spec.load_robot", return_value=changed),
            self.assertRaisesRegex(PolicyError, "another version of the robot"),
        ):
            load_policy(self.out, robot="changed")

    def evaluation(self, name):
        bank = bank_at_home(robots.load(name))
        with quickly():
            return evaluate(self.out, bank, robot=name, episodes=1, episode_seconds=0.1)

    def test_the_graph_of_a_robot_gives_the_targets_of_the_policy(self):
        """Of the second one: an export takes seconds, and the first is what a policy of one robot is."""
        robot = robots.load(ARMS[1])
        spec = load_policy(self.out, robot=robot.name)
        objects = load_objects((SOUP, "010_potted_meat_can"), None)
        with quickly():
            env = spec.make_env(objects, bank_at_home(robot), num_envs=2)
        self.addCleanup(env.close)
        policy = spec.begin(env)
        graph = GraphPolicy(Controller(spec.graph))
        graph.begin(env)
        for _ in range(3):
            observations = env.get_observations()
            actions = (policy.act(observations), graph.act(observations))
            targets = []
            for action in actions:
                self.assertEqual(action.shape, (2, 12))
                own = action[:, env.slots.of_joint]
                joint_pos = env.backend.state().joint_pos
                targets.append(env.actions.targets(own, env.joint_target, joint_pos))
            assert_close(*targets, rtol=0, atol=1e-4)
            self.assertGreater((targets[0] - env.joint_target).abs().max(), 1e-3)
            env.advance(actions[0])

    def test_a_training_of_one_robot_goes_on_from_several(self):
        with quickly():
            run = train(
                self.banks[1],
                out=self.folder / "tuned",
                weights=self.out,
                iterations=1,
                **OPTIONS,
            )
        info = read_run(run)
        self.assertEqual((info.robot, info.config.task.joint_slots), ("ur7e-robotiq", (7, 1)))
        with self.assertRaisesRegex(PolicyError, "Start from its configuration"):
            out = self.folder / "wrong"
            train(self.banks[1], out=out, weights=self.out, recipe="default", **OPTIONS)

    def test_a_student_of_one_robot_learns_from_a_teacher_of_several(self):
        """What the teacher says about actions that the robot lacks has no part in it."""
        config = config_of_student(self.out)
        vision = replace(config.task.vision, width=16, height=12, points=8)
        task = replace(config.task, vision=vision)
        config = replace(config, task=task, model=CONFIG.model, iterations=1)
        forward = PointNetLstmModel.forward
        weights = []
        for i, said in enumerate((0.0, 0.5)):

            def answer(model, obs, *args, said=said, **options):
                actions = forward(model, obs, *args, **options)
                mask = obs.get("action_mask", None)
                if model.distribution is not None or mask is None:
                    return actions
                return torch.where(mask > 0, actions, said)

            with quickly(), patch.object(PointNetLstmModel, "forward", answer):
                out = self.folder / f"student-{i}"
                train(self.banks[1], teacher=self.out, out=out, config=config, **OPTIONS)
            weights.append(read_checkpoint(latest_checkpoint(out)).actor_state_dict)
        assert_close(*weights, rtol=0, atol=0)

    def test_banks_that_do_not_go_together(self):
        out = self.folder / "refused"
        for banks, changes, problem in (
            (self.banks, {"robot": "openarm"}, "2 reset banks and robot are given"),
            (self.banks[:1] * 2, {}, "are for openarm, openarm, expected another robot"),
            ([self.banks[0], bank_at_home(robots.load("openarm"))], {}, "must be files"),
        ):
            with self.assertRaisesRegex(RunError, problem):
                train(banks, out=out, config=CONFIG, **OPTIONS | changes)
        self.assertFalse(out.exists())
