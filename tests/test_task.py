"""The task's pure functions, and what a policy is refused for. Expected numbers come from the paper's formulas, not from the code."""

import json
import math
from copy import deepcopy
from dataclasses import asdict, replace
from itertools import product
from types import SimpleNamespace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from torch import tensor
from torch.testing import assert_close

from tests.data import refuses
from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_robot import toy_robot
from xreset import robots
from xreset.cameras.config import FRONT, VisionConfig
from xreset.cli._terms import take_terms
from xreset.errors import DemoError, FileFormatError, PolicyError, RunError
from xreset.eval.baselines import ZeroPolicy
from xreset.files.checks import from_dict, merged
from xreset.geometry.rotations import (
    quat_angle,
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_rotate,
    quat_to_axis_angle,
    quat_to_matrix,
)
from xreset.learning.config import TASK, TrainConfig
from xreset.learning.recipes import RECIPES
from xreset.physics import Contacts, Health, Links, State
from xreset.policy.onnx_policy import (
    check_contract,
    parsed_contract,
    policy_contract,
)
from xreset.resets.distribution import ResetDistribution
from xreset.spec import TableSpec
from xreset.task import observations as obs
from xreset.task.actions import ActionSpace
from xreset.task.config import (
    GROUPS,
    ActionConfig,
    ObservationConfig,
    PushConfig,
    RandomizationConfig,
    ResetConfig,
    RewardConfig,
    TaskConfig,
    TrackerConfig,
    evaluation_task,
)
from xreset.task.latency import DelayLine
from xreset.task.pushes import Pushes
from xreset.task.randomization import (
    pair_friction,
    sample_drives,
    sample_friction,
    sample_offset,
)
from xreset.task.reading import Reading, step_log
from xreset.task.rewards import Reward, RewardFunction, RewardInput, contact_gate
from xreset.task.terminations import out_of_bounds
from xreset.task.tracker import Tracker
from xreset.task.worlds import Worlds

IDENTITY = tensor([1.0, 0, 0, 0])
FAR = {"best_reach": 1e3}
CONFIG = RECIPES["paper"]
OPEN = {"near": {"tips": 9.0, "palm": 9.0}}


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def turned(degrees, axis=(0.0, 0.0, 1.0)):
    return quat_from_axis_angle(tensor(axis) * math.radians(degrees))


def assert_range(values, low, high, atol=1e-6):
    """The least and the largest value are these."""
    assert_close(torch.stack(values.aminmax()), tensor([low, high]), atol=atol, rtol=0)


def height(x):
    return x.object_pos[:, 2] - x.state.object_linvel[:, 2]


def one_number(x):
    return x.object_pos[:, 2].mean()


def misspelt(x):
    return x.object_position


def near(distance, width):
    return 1 - math.tanh(distance / width)


class RewardTest(TestCase):
    PRESS = tensor([[0.6, 0.0, 0.8], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    SQUEEZE = tensor([[3.0, 0, 1], [0, 0, 0], [-3.0, 0, 1]])

    def reward(self, config=None, **changes):
        """One world: three fingers that do not press, object at its goal, no action; ``changes`` replace inputs (without batch)."""
        x = {
            "tip_distance": [0.2] * 3,
            "best_reach": 0.2,
            "tip_force": torch.zeros(3, 3),
            "action": torch.zeros(4),
            "previous_action": torch.zeros(4),
            "out_of_bounds": False,
            "palm_distance": 0.2,
            "points": torch.zeros(4, 3),
            "is_arm": [True, True, False, False],
        }
        success_position = changes.pop("success_position", 0.02)
        for name in ("object", "goal", "start"):
            x |= {f"{name}_pos": [0.5, 0.3, 0.1], f"{name}_quat": IDENTITY}
        x = {name: torch.as_tensor(value) for name, value in (x | changes).items()}
        x = {k: v if k == "is_arm" else v[None] for k, v in x.items()}
        state = State.at_rest(torch.zeros(1, 4), x.pop("object_pos"), x.pop("object_quat"))
        x = RewardInput(state=state, success_position=success_position, **x)
        return RewardFunction(config or RewardConfig())(x)

    def assert_terms(self, reward, **expected):
        """The named terms have these values, every other term is zero, and the total is a hundredth of the sum."""
        found = {name: float(value) for name, value in reward.terms.items()}
        zeros = dict.fromkeys(found, 0.0)
        assert_close(found, zeros | expected, atol=5e-6, rtol=0)
        self.assertAlmostEqual(reward.total, 0.01 * sum(expected.values()), delta=5e-6)

    def test_each_term(self):
        """What a term with weight 2 pays; the gate is open, unless one is named."""
        gone = {"best_reach": 0.01, "tip_distance": [0.1, 0.2, 0.3]}
        away = {"object_pos": [0.5, 0.36, 0.02], "object_quat": turned(60, (0.0, 0.6, 0.8))}
        moving = {"action": [3.0, -0.5, 0, 0], "previous_action": [1.0, 0.5, 0.2, 0]}
        points = [[0.05, 0, 0], [0, 0.05, 0], [-0.05, 0, 0], [0, -0.05, 0]]
        turn = {"points": points, "object_quat": turned(20.0)}
        d = 0.1 * math.sin(math.radians(10))
        just = {"success_position": 1.01 * d}
        parts = {"arm": 0.5, "hand": 0.1}
        apart = {"palm_distance": 0.7, "tip_distance": [1.0, 2.0, 3.0]}
        for name, parameters, changes, expected in (
            ("best_reach", {"width": 0.1}, gone, near(0.01, 0.1)),
            ("reach", {"width": 0.4}, gone, near(0.2, 0.4)),
            ("grasp", {"force": 0.9}, {"tip_force": self.PRESS}, 1.0),
            ("grasp", {"force": 1.0}, {"tip_force": self.PRESS}, 0.0),
            ("position", {"width": 0.2}, away, near(0.1, 0.2)),
            ("rotation", {"width": 1.5}, away, near(math.pi / 3, 1.5)),
            ("points", {"zero": 0.3}, turn, 1 - d / 0.3),
            ("near_success", {"most": 15.0}, turn | just, 15 / (1 + 10 * d)),
            ("near_success", {"most": 15.0}, turn | {"success_position": 0.99 * d}, 0.0),
            ("proximity", {"cap": 3.0}, {}, 0.6),
            ("proximity", {"cap": 3.0}, apart, 3.0),
            ("palm_proximity", {"cap": 0.5}, {}, 0.2),
            ("palm_proximity", {"cap": 0.5}, apart, 0.5),
            ("action", {"limited": True}, moving, 1.25),
            ("action", {"limited": False}, moving, 9.25),
            ("action_rate", {"limited": True}, moving, 1.04),
            ("action_rate", {"limited": False}, moving, 5.04),
            ("action_rate_of_parts", parts | {"limited": True}, moving, 0.5 + 0.1 * 0.04),
            ("out_of_bounds", {}, {"out_of_bounds": True}, 1.0),
        ):
            terms = {"named": {"function": name, "weight": 2.0} | parameters}
            config = RewardConfig(terms=terms, gate=OPEN)
            with self.subTest(name, **parameters):
                self.assert_terms(self.reward(config, **changes), named=2 * expected)

    def test_the_gate_closes_four_terms(self):
        """At the goal without contact nothing but reach is paid; with it, 1 + 4 + 4 + 10."""
        held = {"grasp": 1.0, "position": 4.0, "rotation": 4.0, "success": 10.0}
        touching = {"touching": {"force": 0.1}}
        opposing = {"opposing": {"force": 0.1}}
        for gate, changes, expected in (
            (touching, {}, {}),
            (touching, {"tip_force": self.PRESS}, held),
            (opposing, {"tip_force": self.PRESS}, {"grasp": 1.0}),
            (opposing, {"tip_force": self.SQUEEZE}, held),
            (OPEN, {}, held | {"grasp": 0.0}),
            ({"near": {"tips": 0.5, "palm": 9.0}}, {}, {}),
            ({"near": {"tips": 9.0, "palm": 0.1}}, {}, {}),
        ):
            with self.subTest(gate, **changes):
                reward = self.reward(RewardConfig(gate=gate), **FAR, **changes)
                self.assert_terms(reward, **expected)
                self.assertEqual(reward.gate, "position" in expected)
                self.assertEqual(reward.success, "success" in expected)
                self.assertEqual(reward.grasped, "tip_force" in changes)

    def test_two_fingertips_grasp_only_between_them(self):
        """A closed jaw that pushes with both tips is paid nothing by the default recipe, and as much in the paper's."""
        jaw = {"tip_distance": [0.2, 0.2]}
        for config, forces, expected in (
            (TASK.reward, self.PRESS[[0, 2]], 0.0),
            (TASK.reward, self.SQUEEZE[[0, 2]], 1.0),
            (RewardConfig(), self.PRESS[[0, 2]], 1.0),
        ):
            reward = self.reward(config, **FAR, **jaw, tip_force=forces)
            self.assertEqual(reward.terms["grasp"], expected)
            self.assertTrue(reward.grasped)
        reward = self.reward(TASK.reward, **FAR, tip_force=self.PRESS)
        self.assertEqual(reward.terms["grasp"], 1.0)  # a hand with three fingertips

    def test_the_published_reward(self):
        """Numbers from the published paper: -2.5 min(P, 3) - 2.5 min(M, 0.5) + G (3 (1.4 - 3 d) + [d <= 0.02] 15 / (1 + 10 d))."""
        config = RECIPES["published"].task.reward
        for tips, palm, shift, degrees, gate in (
            (0.15, 0.1, 0.0, 0.0, True),
            (0.15, 0.1, 0.015, 0.0, True),
            (0.15, 0.1, 0.1, 0.0, True),
            (0.15, 0.1, 0.0, 40.0, True),
            (0.15, 0.1, 0.0, 60.0, True),
            (0.25, 0.1, 0.0, 0.0, False),
            (0.15, 0.25, 0.0, 0.0, False),
            (2.0, 0.9, 0.0, 0.0, False),
        ):
            # a turn about z moves two of the four points, which are 5 cm from the axis
            d = shift + 0.05 * math.sin(math.radians(degrees / 2))
            reward = self.reward(
                config,
                tip_distance=[tips] * 3,
                palm_distance=palm,
                object_pos=[0.5, 0.3 + shift, 0.1],
                object_quat=turned(degrees),
                points=[[0.05, 0, 0], [0, 0.05, 0], [0, 0, 0.05], [0, 0, -0.05]],
                action=[0.5, 0, 0.2, 0],
            )
            success = gate and d <= 0.02
            actions = 0.005 * 0.29 + 0.05 * 0.25 + 0.005 * 0.04
            expected = -2.5 * min(3 * tips, 3) - 2.5 * min(palm, 0.5) - actions
            expected += gate * 3 * (1.4 - 3 * d) + success * 15 / (1 + 10 * d)
            with self.subTest(tips=tips, palm=palm, d=d):
                self.assertEqual((reward.gate, reward.success), (gate, success))
                self.assertAlmostEqual(reward.total, 0.01 / 30 * expected, delta=5e-7)

    def test_success_needs_two_centimetres_and_fifteen_degrees_and_contact(self):
        for distance, degrees, changes, expected in (
            (0.0195, 14.8, {}, True),
            (0.0205, 14.8, {}, False),
            (0.0195, 15.2, {}, False),
            (0.0, 0.0, {"tip_force": torch.zeros(3, 3)}, False),
            (0.03, 0.0, {"success_position": 0.04}, True),
            (0.015, 0.0, {"success_position": 0.01}, False),
        ):
            inputs = {"object_pos": [0.5, 0.3, 0.1 + distance], "tip_force": self.PRESS}
            inputs["object_quat"] = turned(degrees, (1.0, 0, 0))
            reward = self.reward(**(inputs | changes))
            self.assertEqual(reward.success, expected, (distance, degrees, changes))
            self.assertEqual(reward.terms["success"], 10.0 * expected)

    def test_a_term_of_the_users_own_is_added_and_evaluations_leave_it_out(self):
        own = f"{__name__}:height"
        terms = RewardConfig().terms | {own: {"weight": 0.5}}
        config = RewardConfig(terms=terms | {"reach": {"weight": 0.0, "width": 1.0}})
        self.assert_terms(self.reward(config), **{own: 0.05})
        self.assertEqual(config.own, {own: {"weight": 0.5}})
        task = TaskConfig(reward=config)
        self.assertEqual(from_dict(TaskConfig, json.loads(json.dumps(asdict(task)))), task)
        self.assertEqual([*evaluation_task(task).reward.terms], [*RewardConfig().terms])
        with patch(f"{__name__}.height", lambda x, *, most=2.0: most * x.object_pos[:, 2]):
            self.assert_terms(self.reward(config), **{own: 0.1})  # defined again, as in a notebook
            other = RewardConfig(terms={own: {"weight": 0.5, "most": 3.0}})
            self.assert_terms(self.reward(other), **{own: 0.15})
        self.assertEqual(float(self.reward(RewardConfig(terms={})).total), 0.0)

    def test_what_is_not_a_term_is_refused(self):
        for name, term, error, problem in (
            ("no_such_module:f", {}, RunError, "No module named.*Add its folder to PYTHONPATH"),
            (f"{__name__}:no_such_function", {}, RunError, "test_task.py has no function 'no_such_function'"),
            (f"{__name__}:IDENTITY", {}, RunError, "test_task.py has no function 'IDENTITY'"),
            (f"{__name__}:one_number", {}, RunError, r"gave \(\). Return a tensor of shape \(1,\)"),
            (f"{__name__}:misspelt", {}, RunError, r"line \d+ of .*test_task.py: AttributeError: .*'object_position'"),
            (f"{__name__}:height", {"most": 1.0}, ValueError, r"height has wrong entries .unknown: most; known: "),
            ("raech", {"width": 1.0}, ValueError, "Unknown reward term 'raech'. One of your own is named module:function. Choose from: reach, best_reach"),
            ("reach", {"width": -1.0}, ValueError, r"terms\.reach\.width is -1.0, expected a number above 0"),
            ("reach", {"width": 1.0, "with": 1.0}, ValueError, "unknown: with .width\\?.; known: width"),
            ("reach", {}, ValueError, r"terms\.reach has wrong entries .missing: width"),
        ):  # fmt: skip
            with self.subTest(name, **term), self.assertRaisesRegex(error, problem):
                self.reward(RewardConfig(terms={name: {"weight": 1.0} | term}))
        with self.assertRaisesRegex(ValueError, "Unknown gate 'ajar'. Choose from: touching"):
            self.reward(RewardConfig(gate={"ajar": {}}))
        unweighted = "reward term 'a:b' has .*expected a weight.*terms.a:b.weight 1.0"
        for terms, words in (
            ({"a:b": {"most": 0.3}}, unweighted),
            ({"a:b": {"weight": "1"}}, unweighted),
            ({"a:b": {"weight": math.nan}}, "terms is "),
            ({"a:b": {"weight": 1.0, "most": [1.0]}}, "terms is "),
            ({"a:b": 1.0}, "terms is "),
            (["a:b"], "terms is "),
        ):
            with refuses(self, words, ValueError, terms):
                RewardConfig(terms=terms)

    def test_the_contact_gate_needs_the_thumb_and_another_finger(self):
        for forces, expected in (
            ([1.0, 0, 0], False),
            ([0, 1, 1], False),
            ([1, 0, 1], True),
            ([1, 1, 0], True),
            ([0.09, 1, 1], False),
            ([1, 0.1, 0.1], False),
            ([0.11, 0.11, 0], True),
            ([0, 0, 0], False),
        ):
            pressed = tensor(forces)[None, :, None] * tensor([0.6, 0.0, -0.8])
            self.assertEqual(contact_gate(pressed, 0.1), expected, forces)
        down = [0.0, 0, -5]
        left = [-5.0, 0, -1]
        right = [5.0, 0, -1]
        none = [0.0, 0, 0]
        for hand, touches, opposes in (
            ((down, down, down), True, False),
            ((left, right, none), True, True),
            ((left, none, right), True, True),
            ((left, left, down), True, False),
            ((none, left, right), False, False),
        ):
            forces = tensor([hand])
            self.assertEqual(contact_gate(forces, 0.1), touches, hand)
            self.assertEqual(contact_gate(forces, 0.1, opposing=True), opposes, hand)


DEFAULT = {
    "observation": {
        "cloud": "paired", "rotation": "matrix", "cloud_scale": 5.0, "contact_force_scale": 0.03,
        "joint_target": True,
    },
    "reward": {
        "reach_width": 0.4, "reach_near": 1.0, "reach_distance": "present", "contact": "opposing",
        "raw_actions": True,
    },
}  # fmt: skip
PUBLISHED = {
    "observation": {
        "content": "published", "cloud": "paired", "cloud_scale": 5.0,
        "noise": dict.fromkeys(("joint_pos", "joint_vel", "object_pos", "object_rot", "cloud"), 0.0),
    },
    "reward": {
        "reach": 0.0, "grasp": 0.0, "position": 0.0, "rotation": 0.0, "proximity": -2.5, "palm_proximity": -2.5,
        "contact": "near", "points": 4.2, "success": 15.0, "success_shape": "points", "action_rate_arm": -0.05,
        "scale": 0.01 / 30,
    },
}  # fmt: skip
PAPER = {
    "observation": {"rotation": "quaternion"},
    "reward": {"tracking": "presence", "contact": "any"},
}


class EarlierOptionsTest(TestCase):
    """Files of 0.1 to 0.3 have options in place of terms."""

    def test_they_mean_terms(self):
        live = {"observation": DEFAULT["observation"] | {"rotation": "to_goal"}}
        for name, options in (
            ("paper", PAPER),
            ("default", DEFAULT),
            ("live", DEFAULT | live),
            ("published", PUBLISHED),
        ):
            task = RECIPES[name].task
            found = from_dict(TaskConfig, options)
            expected = deepcopy(task.reward)
            observed = deepcopy(task.observation)
            # Only recipes of today ask the tips of a jaw to oppose each other,
            expected.terms.get("grasp", {}).pop("opposing_jaw", None)
            # and show the object as the hand sees it.
            if "palm_cloud" in observed.perception:
                observed.policy.pop("tip_to_object")
                observed.perception["paired_cloud"] = observed.perception.pop("palm_cloud")
            with self.subTest(name):
                self.assertEqual(found.observation, observed)
                self.assertEqual(found.reward, expected)
                self.assertEqual([*found.reward.terms], [*task.reward.terms])
                for group in GROUPS:
                    names = [[*getattr(each, group)] for each in (found.observation, observed)]
                    self.assertEqual(*names, "the order of random draws")

    def test_options_that_no_recipe_has(self):
        options = {"cloud_history": 3, "joint_vel_scale": 0.2, "content": "published"}
        found = from_dict(ObservationConfig, options)
        self.assertEqual(found.perception, {"cloud": {"frames": 3, "noise": 0.002, "scale": 1.0}})
        self.assertEqual(found.privileged["true_joint_vel"], {"scale": 0.2})
        options = {
            "success": 0.0,
            "success_shape": "points",
            "own": {"a:b": 2.0},
            "action_rate": 0.0,
        }
        found = from_dict(RewardConfig, options).terms
        self.assertEqual(found["success"]["weight"], 0.0)
        self.assertEqual(found["a:b"], {"weight": 2.0})
        self.assertNotIn("action_rate", found)

    def test_wrong_values_are_refused(self):
        for part, options, words in (
            (
                "reward",
                {"contact": "gentle"},
                r"reward\.contact is 'gentle', expected one of 'any'",
            ),
            ("reward", {"tracking": "speed"}, "tracking is 'speed'. This option was removed"),
            ("reward", {"contact": "any", "grip": 1}, "unknown: grip"),
            ("observation", {"rotation": [1]}, r"observation\.rotation is \[1\], expected one of"),
            ("observation", {"cloud_points": 10**9}, "at most 100,000 points"),
        ):
            with refuses(self, words, FileFormatError):
                from_dict(TaskConfig, {part: options})


class FlagsTest(TestCase):
    """Flags and studies change terms alike."""

    def test_flags_that_set_terms(self):
        terms = "--config.task.reward.terms."
        near_gate = {"terms": {}, "gate": {"near": {"tips": 0.6, "palm": 2}, "touching": False}}
        gate = "--config.task.reward.gate."
        for flags, changes in (
            (f"{terms}reach.width .4", {"reward": {"terms": {"reach": {"width": 0.4}}}}),
            (f"{terms}action-rate.limited=False", {"reward": {"terms": {"action_rate": {"limited": False}}}}),
            (f"{terms}grasp false", {"reward": {"terms": {"grasp": False}}}),
            (f"{terms}pk.my_terms:up.weight -5", {"reward": {"terms": {"pk.my_terms:up": {"weight": -5}}}}),
            (f"{gate}near.tips 0.6 {gate}near.palm 2 {gate}touching false", {"reward": near_gate}),
            (
                "--config.task.observation.proprio.joint-target true --config.task.observation.proprio.tip_pos false",
                {"observation": {"proprio": {"joint_target": {}, "tip_pos": False}}},
            ),
        ):  # fmt: skip
            arguments = ["--out", "x", *flags.split(), "--config.task.reward.scale", "2"]
            with self.subTest(flags):
                found = take_terms(CONFIG, arguments)
                expected = merged(asdict(CONFIG), {"task": changes})
                self.assertEqual(found, from_dict(TrainConfig, expected))
                self.assertNotEqual(found, CONFIG)
                self.assertEqual(arguments, ["--out", "x", "--config.task.reward.scale", "2"])
        self.assertIs(take_terms(CONFIG, ["--out", "x"]), CONFIG)
        changed = merged(
            {"reach": {"weight": 1.0, "width": 0.1}}, {"reach": {"function": "best_reach"}}
        )
        self.assertEqual(
            changed, {"reach": {"function": "best_reach"}}, "parameters of another function"
        )

    def test_flags_that_set_no_term_are_refused(self):
        for flags, error, words in (
            (
                "--config.task.reward.terms.reach.width nan",
                RunError,
                "width is nan, expected a finite number or a word",
            ),
            ("--config.task.reward.terms.reach 3", FileFormatError, "expected terms: name -> "),
            ("--config.task.reward.reach-width 3", RunError, "reach_width is no option any more"),
            (
                "--config.task.observation.rotation=matrix",
                RunError,
                "rotation is no option any more",
            ),
        ):
            with refuses(self, words, error, flags):
                take_terms(CONFIG, flags.split())


class TerminationTest(TestCase):
    def test_bounds(self):
        table = TableSpec(center=(0.5, 0.3), half_size=(0.7, 0.5, 0.02))
        middle = tensor([0.5, 0.3, 0.1])
        for axis, limit in ((0, 1.3), (0, -0.3), (1, 0.9), (1, -0.3), (2, 1.0), (2, -0.05)):
            for share, expected in ((0.99, False), (1.01, True)):
                pos = middle.clone()
                pos[axis] += share * (limit - middle[axis])
                self.assertEqual(out_of_bounds(pos[None], table), expected, pos)


class ActionTest(TestCase):
    robot = toy_robot()

    def space(self, **changes):
        return ActionSpace(self.robot, ActionConfig(**changes))

    def test_hand_is_absolute_and_arm_relative(self):
        space = self.space(arm_step=0.05)
        target = tensor([[0.1, 0.5, -0.5, 0.0, 0.0, 0.3, 0.01]])
        assert_close(space.step, tensor([0.05] * 3 + [0.0] * 4))
        still = space.targets(torch.zeros(1, 7), target, target - 0.02)
        # a loaded arm that sags would otherwise sink a little further at every step of zero action
        assert_close(still[:, :3], target[:, :3])
        assert_close(still[:, 3:], tensor([[-0.55, 0.55, 0.8, 0.02]]))
        half = space.targets(torch.full((1, 7), 0.5), target, target)
        assert_close(half[:, 3:], tensor([[-0.025, 1.075, 1.2, 0.03]]))
        # actions are limited to [-1, 1]
        full = space.targets(torch.full((1, 7), 5.0), target, target)
        assert_close(full, tensor([[0.15, 0.55, -0.45, 0.5, 1.6, 1.6, 0.04]]))
        full = space.targets(torch.full((1, 7), -5.0), target, target)
        assert_close(full, tensor([[0.05, 0.45, -0.55, -1.6, -0.5, 0.0, 0.0]]))
        for away in (-9.0, 9.0):
            found = space.action_for(target + away, target)
            assert_close(found, torch.full((1, 7), away).sign())

    def test_a_step_of_a_jaw_is_limited_by_force(self):
        """The OpenArm's pads press with 1,000 N for each metre by which the jaws' target is beyond them."""
        robot = robots.load("openarm")
        jaw = robot.hand_indices[0]
        for force, expected in ((None, 0.004), (8.0, 0.004), (2.0, 0.002)):
            config = ActionConfig(hand="relative", hand_step=0.1, jaw_step=force)
            self.assertAlmostEqual(float(ActionSpace(robot, config).step[jaw]), expected)
        limited = self.space(hand="relative", hand_step=0.1, jaw_step=1e-3)
        free = self.space(hand="relative", hand_step=0.1)
        assert_close(limited.step, free.step, msg="more than one joint moves this hand")

    def test_arm_targets_stay_near_the_joint_and_within_its_limits(self):
        space = self.space(arm_step=0.05, arm_lead=0.15)
        blocked = torch.zeros(1, 7)
        target = blocked.clone()
        for _ in range(10):
            target = space.targets(tensor([[0.0, 1, -1, 0, 0, 0, 0]]), target, blocked)
        assert_close(target[:, 1:3], tensor([[0.15, -0.15]]))
        near = tensor([[0.29, 2.99, -1.99, 0, 0, 0, 0]])
        moved = space.targets(tensor([[1.0, 1, -1, 0, 0, 0, 0]]), near, near)
        assert_close(moved[:, :3], tensor([[0.3, 3.0, -2.0]]))

    def test_a_relative_hand_that_does_nothing_holds_its_targets(self):
        space = self.space(hand="relative", hand_step=0.05, hand_lead=0.4)
        # the last one slides, by 4 cm in all
        target = tensor([[0.1, 0.5, -0.5, -0.2, 0.4, 0.3, 0.01]])
        # joints that an object keeps from following
        pressed = target - tensor([0.1] * 6 + [0.004])
        assert_close(space.targets(torch.zeros(1, 7), target, pressed)[:, 3:], target[:, 3:])
        moved = space.targets(tensor([[0.0, 0, 0, 1, -1, 0.5, 1]]), target, pressed)
        assert_close(moved[:, 3:], tensor([[-0.15, 0.35, 0.325, 0.012]]))
        for _ in range(20):
            moved = space.targets(torch.ones(1, 7), moved, pressed)
        held = pressed[:, 3:] + tensor([0.4, 0.4, 0.4, 0.016])
        assert_close(moved[:, 3:], held, msg="it presses no harder than its lead allows")
        action = space.action_for(target + tensor([0.02] * 6 + [0.0008]), target)
        assert_close(action[:, 3:], torch.full((1, 4), 0.4))

    def test_action_for_undoes_targets(self):
        g = generator()
        space = self.space()
        target = space.lower + (space.upper - space.lower) * torch.rand(50, 7, generator=g)
        wanted = space.targets(2 * torch.rand(50, 7, generator=g) - 1, target, target)
        again = space.targets(space.action_for(wanted, target), target, target)
        assert_close(again, wanted, atol=1e-5, rtol=0)


class LatencyTest(TestCase):
    def test_values_come_late_and_are_mixed_between_whole_steps(self):
        worlds = Worlds(5, torch.device("cpu"))
        line = DelayLine(worlds, "line", 1, 2.0, lambda _: tensor([0.0, 0.5, 1.0, 1.5, 2.0]))
        worlds.draw(torch.ones(5, dtype=torch.bool), generator())
        line.fill(torch.ones(5, dtype=torch.bool), torch.zeros(5, 1))

        def delayed(value):
            return line.push(torch.full((5, 1), value))[:, 0].tolist()

        for value, expected in (
            (10.0, [10, 5, 0, 0, 0]),
            (20.0, [20, 15, 10, 5, 0]),
            (30.0, [30, 25, 20, 15, 10]),
        ):
            self.assertEqual(delayed(value), expected)
        line.fill(tensor([False, False, True, False, False]), torch.full((5, 1), 7.0))
        self.assertEqual(delayed(40.0), [40, 35, 7, 25, 20])


class RandomizationTest(TestCase):
    def test_a_pairs_friction_is_the_mean_of_its_materials(self):
        c = RandomizationConfig(elastomer=0.8, metal=0.1, table=0.5)
        assert_close(
            pair_friction(tensor([0.5, 1.0]), c), tensor([[0.65, 0.3, 0.5], [0.9, 0.55, 0.75]])
        )
        nominal = sample_friction(3, RandomizationConfig(enabled=False), generator())
        assert_close(nominal, pair_friction(torch.full((3,), 0.75), c))

    def test_friction_comes_from_the_buckets(self):
        c = RandomizationConfig(friction=(0.5, 1.0), hand_friction=(0.5, 1.0))
        tip, link, table = sample_friction(20_000, c, generator()).unbind(-1)
        material = 2 * table - c.table
        drawn = 2 * link - (2 * tip - c.elastomer)
        for values in (material, drawn):
            assert_range(values, 0.5, 1.0, atol=2e-3)
            self.assertAlmostEqual(values.mean(), 0.75, delta=0.005)
        self.assertEqual(len(material.mul(1e5).round().unique()), 250)
        with patch("xreset.task.randomization.MATERIALS", 2):
            material = 2 * sample_friction(100, c, generator())[:, 2] - c.table
        # the middles of the halves of the range
        assert_close(material.unique(), tensor([0.625, 0.875]))

    def test_drives_are_scaled_by_their_own_ranges(self):
        ranges = {
            "arm_stiffness": (0.5, 0.6),
            "hand_stiffness": (0.7, 0.8),
            "arm_damping": (0.9, 1.0),
            "hand_damping": (1.1, 1.2),
            "effort": (1.3, 1.4),
        }
        is_arm = tensor([True, False])
        factors = sample_drives(is_arm, 2000, RandomizationConfig(**ranges), generator())
        for row, name in enumerate(("stiffness", "damping", "effort")):
            for joint, group in enumerate(("arm_", "hand_")):
                limits = ranges[name if name == "effort" else group + name]
                assert_range(factors[:, row, joint], *limits, atol=1e-3)

    def test_offsets_have_any_direction_and_lengths_of_the_range(self):
        offset = sample_offset(4000, (0.01, 0.03), generator())
        length = offset.norm(dim=-1)
        assert_range(length, 0.01, 0.03, atol=1e-4)
        self.assertAlmostEqual(length.mean(), 0.02, delta=2e-4)
        direction = offset / length[:, None]
        self.assertLess(direction.mean(dim=0).abs().max(), 0.03)
        assert_close(direction.square().mean(dim=0), torch.full((3,), 1 / 3), atol=0.02, rtol=0)


class PushTest(TestCase):
    """Two objects in turn, in 4000 worlds, with masses, orientations and factors on the inertia of their own."""

    N = 4000
    DT = 0.02
    IS_ARM = tensor([True, True, False])
    KP = tensor([50.0, 200.0, 3.0])
    EFFORT = tensor([10.0, 80.0, 0.9])

    def setUp(self):
        g = generator(1)
        turns = torch.nn.functional.normalize(torch.randn(2, 4, generator=g), dim=-1)
        axes = quat_to_matrix(turns)
        inertia = axes @ torch.diag_embed(tensor([[1.0, 3, 9], [8, 1, 2]])) @ axes.mT
        self.own_mass = tensor([0.5, 2.0])
        objects = [
            SimpleNamespace(inertia=(1e-4 * i).numpy(), mass=float(mass))
            for i, mass in zip(inertia, self.own_mass, strict=True)
        ]
        self.inertia = 1e-4 * inertia
        joints = [
            SimpleNamespace(drive=SimpleNamespace(kp=float(kp), effort=float(effort)))
            for kp, effort in zip(self.KP, self.EFFORT, strict=True)
        ]
        robot = SimpleNamespace(joints=joints)
        scene = SimpleNamespace(control_dt=self.DT, objects=objects, robot=robot)
        self.index = torch.arange(self.N) % 2
        self.backend = SimpleNamespace(scene=scene, device="cpu", object_index=self.index)
        quat = torch.nn.functional.normalize(torch.randn(self.N, 4, generator=g), dim=-1)
        self.state = State.at_rest(torch.zeros(self.N, 3), torch.zeros(self.N, 3), quat)
        self.mass = 0.1 + torch.rand(self.N, generator=g)
        self.scale = 0.5 + torch.rand(self.N, generator=g)

    def pushed(self, **config):
        """Pushes after a step, and the offsets of the joints' targets."""
        worlds = Worlds(self.N, torch.device("cpu"))
        config = PushConfig(object_velocity=0.5, object_spin=4.0, arm_torque=0.3, **config)
        pushes = Pushes(worlds, self.backend, config, self.IS_ARM)
        g = generator()
        worlds.draw(torch.ones(self.N, dtype=torch.bool), g)
        return pushes, pushes.act(self.state, self.mass, self.scale, g)

    def test_pushes_are_as_large_as_stated_in_any_direction(self):
        """Impulses, divided by mass and by inertia in the world's axes; torques, by the drives' stiffness."""
        pushes, offsets = self.pushed(probability=(1.0, 1.0))
        velocity = pushes.force * self.DT / self.mass[:, None]
        axes = quat_to_matrix(self.state.object_quat)
        of_world = axes @ self.inertia[self.index] @ axes.mT
        share = self.mass / self.own_mass[self.index] * self.scale
        spin = torch.linalg.solve(of_world * share[:, None, None], pushes.torque * self.DT)
        for change, largest in ((velocity, 0.5), (spin, 4.0)):
            size = change.norm(dim=-1)
            assert_range(size, 0.0, largest, atol=1e-3 * largest)
            self.assertAlmostEqual(size.mean(), largest / 2, delta=0.01 * largest)
            self.assertLess(change.mean(dim=0).abs().max(), 0.02 * largest)
        torque = offsets * self.KP
        for joint in (0, 1):
            limit = float(0.3 * self.EFFORT[joint])
            assert_range(torque[:, joint], -limit, limit, atol=2e-3 * limit)
        self.assertFalse(offsets[:, 2].any())

    def test_each_kind_of_push_comes_by_itself(self):
        pushes, offsets = self.pushed(probability=(0.5, 0.5))
        happens = [values.any(dim=-1) for values in (pushes.force, pushes.torque, offsets)]
        for a, b in product(range(3), repeat=2):
            share = (happens[a] & happens[b]).float().mean()
            self.assertAlmostEqual(share, 0.5 if a == b else 0.25, delta=0.03)

    def test_probabilities_are_drawn_evenly_in_their_logarithm(self):
        pushes, _ = self.pushed(probability=(0.001, 0.1))
        exponent = pushes._probability.log10()
        assert_range(exponent, -3.0, -1.0, atol=2e-3)
        self.assertAlmostEqual(exponent.mean(), -2.0, delta=0.03)


class TrackerTest(TestCase):
    N = 4000

    def tracker(self, latency=(0.0, 0.0), enabled=True, **faults):
        """A function that observes poses [N, 3], [N, 4]; ``fresh`` [N] are worlds that have just begun."""
        worlds = Worlds(self.N, torch.device("cpu"))
        config = RandomizationConfig(
            enabled=enabled, observation_latency=latency, tracker=TrackerConfig(**faults)
        )
        tracker = Tracker(worlds, config)
        g = generator()
        worlds.draw(torch.ones(self.N, dtype=torch.bool), g)

        def observe(pos, quat=IDENTITY, fresh=False):
            fresh = torch.as_tensor(fresh).expand(self.N)
            pos = torch.as_tensor(pos)[..., None].expand(self.N, 3)
            return tracker.observe(pos, quat.expand(self.N, 4), fresh, g)

        return observe

    def test_errors_are_even_about_each_axis(self):
        quat = turned(70, (0.6, 0.0, 0.8))
        for kind, pos_limit, rot_limit in (("bias", 0.02, 0.1), ("noise", 0.05, 0.2)):
            faults = {f"position_{kind}": pos_limit, f"rotation_{kind}": rot_limit}
            pos, seen = self.tracker(**faults)(1.0, quat, fresh=True)
            angle = quat_to_axis_angle(quat_multiply(seen, quat_conjugate(quat).expand(self.N, 4)))
            for axis in range(3):
                assert_range(pos[:, axis] - 1.0, -pos_limit, pos_limit, atol=2e-3 * pos_limit)
                assert_range(angle[:, axis], -rot_limit, rot_limit, atol=2e-3 * rot_limit)

    def test_between_two_steps_an_orientation_turns_evenly_and_the_short_way(self):
        """About another axis in each world; a quaternion's sign changes from step to step in some of them."""
        g = generator(1)
        axes = torch.nn.functional.normalize(torch.randn(self.N, 3, generator=g), dim=-1)

        def turn(degrees):
            return quat_from_axis_angle(math.radians(degrees) * axes)

        observe = self.tracker(latency=(0.5, 0.5))
        observe(0.0, turn(10), fresh=True)
        for step in range(1, 5):
            sign = torch.randn(self.N, 1, generator=g).sign()
            pos, quat = observe(2.0 * step, sign * turn(10 + 100 * step))
            assert_close(pos, torch.full((self.N, 3), 2.0 * step - 1.0))
            between = turn(100 * step - 40)
            between = between * (quat * between).sum(dim=-1, keepdim=True).sign()
            assert_close(quat, between, atol=1e-5, rtol=0)

    def test_poses_may_come_seldom_and_go_missing(self):
        for period, faults in (
            (3, {"interval": (2.6, 2.6)}),
            (3, {"interval": (3.4, 3.4)}),
            (5, {"loss": 1.0, "loss_steps": (3.6, 3.6)}),
            (5, {"loss": 1.0, "loss_steps": (4.4, 4.4)}),
        ):
            observe = self.tracker(**faults)
            for step in range(12):
                pos, _ = observe(float(step), fresh=step == 0)
                self.assertTrue((pos == step - step % period).all(), (faults, step))

    def test_a_delay_jitters_evenly_from_none_up_to_the_longest_one(self):
        for jitter, least, mean in ((0.5, 1.5, 1.875), (3.0, 0.0, 4 / 3)):
            observe = self.tracker(latency=(2.0, 2.0), jitter=jitter)
            for step in range(4):
                pos, _ = observe(float(step), fresh=step == 0)
            delay = 3.0 - pos[:, 0]
            assert_range(delay, least, 2.0, atol=2e-3)
            self.assertAlmostEqual(delay.mean(), mean, delta=0.02)

    def test_a_new_episode_does_not_show_the_pose_of_the_last_one(self):
        begins = torch.arange(self.N) % 2 == 1
        for observe in (self.tracker(interval=(5.0, 5.0)), self.tracker(latency=(2.0, 2.0))):
            observe(1.0, fresh=True)
            observe(2.0)
            pos, _ = observe(3.0, fresh=begins)
            self.assertEqual(pos[:2, 0].tolist(), [1.0, 3.0])

    def test_without_randomization_it_sees_what_is_there(self):
        faults = {"position_bias": 0.1, "rotation_noise": 0.1, "loss": 1.0, "interval": (3.0, 3.0)}
        observe = self.tracker(latency=(2.0, 2.0), enabled=False, **faults)
        observe(0.0, fresh=True)
        pos, quat = observe(1.0, turned(30))
        assert_close(pos, torch.ones(self.N, 3))
        assert_close(quat, turned(30).expand(self.N, 4))


class ReadingTest(TestCase):
    def test_distances_and_the_motion_of_the_center(self):
        """Distances again in the world frame; velocities from the poses a moment later."""
        n = 4
        tips = 3
        g = generator()

        def rand(*shape):
            return torch.randn(n, *shape, generator=g)

        quat = torch.nn.functional.normalize(rand(4), dim=-1)
        still = State.at_rest(rand(2), rand(3), quat)
        state = replace(still, object_linvel=rand(3), object_angvel=rand(3))
        zeros = torch.zeros(n, 1 + tips, 3)
        links = Links(pos=rand(1 + tips, 3), quat=rand(1 + tips, 4), linvel=zeros, angvel=zeros)
        force = zeros[:, 1:]
        healthy = torch.zeros(n, dtype=torch.bool)
        backend = SimpleNamespace(
            state=lambda: state,
            links=lambda: links,
            contacts=lambda: Contacts(
                tip_force=force, tip_touch=force.any(dim=-1), table_force=zeros[:, 0]
            ),
            health=lambda: Health(nonfinite=healthy, overflow=healthy),
        )
        points = rand(20, 3)
        center = rand(3)
        bad = tensor([False, True, False, False])
        reading = Reading.of(backend, points, bad, center)
        self.assertTrue(torch.equal(reading.health.nonfinite, bad))
        self.assertIs(Reading.of(backend, points, bad, None).task_state, state)

        pos, linvel, angvel = (
            getattr(state, f"object_{name}").double().numpy()
            for name in ("pos", "linvel", "angvel")
        )
        turn = Rotation.from_quat(quat.double().numpy(), scalar_first=True)

        def place(local, seconds=0.0):
            turned = Rotation.from_rotvec(seconds * angvel) * turn
            return turned.apply(local.double().numpy()) + pos + seconds * linvel

        places = np.stack([place(points[:, i]) for i in range(20)], axis=1)
        gap = np.linalg.norm(links.pos[:, 1:, None].numpy() - places[:, None], axis=-1)
        assert_allclose(reading.tip_distance, gap.min(axis=-1), rtol=1e-5)
        assert_allclose(reading.task_state.object_pos, place(center), atol=1e-5)
        velocity = (place(center, 1e-6) - place(center)) / 1e-6
        assert_allclose(reading.task_state.object_linvel, velocity, atol=1e-4)

    def test_a_log_has_means_over_the_worlds_that_it_names(self):
        g = generator()
        masks = torch.rand(5, 40, generator=g) < tensor([0.2, 0.4, 0.6, 0.7, 0.5])[:, None]
        grasped, success, done, sound, from_home = masks
        from_home[:] = False
        from_home[7] = success[7] = True
        term = torch.randn(40, generator=g)
        term[~sound] = math.nan
        reward = Reward(
            total=term, terms={"reach": term}, grasped=grasped, gate=~success, success=success
        )
        totals = {"health/total": tensor(7)}
        names, values = step_log(reward, done, sound=sound, from_home=from_home, totals=totals)
        every = np.ones(40, dtype=bool)
        expected = {
            "reward/reach": (term, sound),
            "task/grasped": (grasped, every),
            "task/success": (success, every),
            "task/grasped_from_home": (grasped, from_home),
            "task/success_from_home": (success, from_home),
            "episode/ended": (done, every),
        }
        means = {
            name: float(value.numpy()[np.asarray(of)].mean())
            for name, (value, of) in expected.items()
        }
        found = dict(zip(names, values.tolist(), strict=True))
        self.assertEqual(found.pop("health/total"), 7)
        assert_close(found, means, rtol=0, atol=1e-6)
        _, values = step_log(reward, done, sound=sound, from_home=from_home & False, totals=totals)
        found = dict(zip(names, values.tolist(), strict=True))
        self.assertEqual(found["task/success_from_home"], 0.0)


class ResetTest(TestCase):
    robot = toy_robot()
    bank = toy_bank(robot)
    SOUPS = torch.zeros(4000, dtype=torch.long)

    def sample(self, index=SOUPS, objects=(SOUP, SPAM), bank=None, **config):
        """Draw starts; by default all at home, of the soup can."""
        config = ResetConfig(**({"demo_probability": 0.0} | config))
        distribution = ResetDistribution(bank or self.bank, self.robot, objects, config)
        return distribution.sample(index, generator())

    def of(self, reset, name):
        """What the bank states of the demonstrations that were drawn."""
        return torch.as_tensor(getattr(self.bank, name))[reset.sequence]

    def test_share_of_bank_resets(self):
        for p in (0.0, 0.25, 0.5, 1.0):
            share = (self.sample(demo_probability=p).state >= 0).float().mean()
            self.assertAlmostEqual(share, p, delta=0.03 * (0 < p < 1))

    def test_bank_resets_are_states_of_the_bank(self):
        reset = self.sample(tensor([0, 1] * 500), demo_probability=1.0)
        # the toy bank numbers its states
        state = ((reset.object_pos[:, 0] - 0.6) * 100).round().long()
        self.assertEqual(reset.state.tolist(), state.tolist())
        assert_close(reset.joint_pos, torch.as_tensor(self.bank.joint_pos)[state])
        assert_close(reset.object_quat, torch.as_tensor(self.bank.object_quat_wxyz)[state])
        self.assertEqual(reset.sequence.tolist(), self.bank.sequence_index[state].tolist())
        assert_close(reset.goal_pos, self.of(reset, "goal_pos"))
        assert_close(reset.goal_quat, self.of(reset, "goal_quat_wxyz"))

    def test_which_states_are_drawn(self):
        """Every state of the object, and of no other; home where there is none."""
        some = self.bank.with_states(self.bank.object_name == SOUP)
        one = self.bank.with_states(np.arange(6) == 3)
        empty = self.bank.with_states(np.zeros(6, dtype=bool))
        for objects, index, options, states, sequences in (
            ((SOUP, SPAM), 0, {}, {0, 1, 4, 5}, {0, 2}),
            ((SOUP, SPAM), 1, {}, {2, 3}, {1}),
            ((SPAM, SOUP), 0, {}, {2, 3}, {1}),
            ((SPAM,), 0, {}, {2, 3}, {1}),
            ((SOUP, SPAM), 0, {"pre_contact_only": True}, {0, 4}, {0, 2}),
            ((SOUP, SPAM), 1, {"bank": some}, set(), {1}),
            ((SOUP, SPAM), 1, {"bank": one}, {3}, {1}),
            ((SOUP, SPAM), 0, {"bank": empty}, set(), {0, 2}),
        ):
            with self.subTest(objects=objects, index=index, options=list(options)):
                many = torch.full((200,), index)
                reset = self.sample(many, objects, demo_probability=1.0, **options)
                drawn = ((reset.object_pos[reset.state >= 0, 0] - 0.6) * 100).round().int()
                self.assertEqual(set(drawn.tolist()), states)
                self.assertEqual(set(reset.sequence.tolist()), sequences)
        with self.assertRaisesRegex(
            DemoError, f"no demonstration of 011_banana; it has {SOUP}, {SPAM}"
        ):
            self.sample(objects=(SOUP, "011_banana"))

    def test_demonstrations_and_states_are_drawn_evenly_where_all_fail_alike(self):
        """The soup can has one state of demonstration 0 and two of demonstration 2. A share of the draws chooses the
        demonstration first."""
        bank = self.bank.with_states(np.arange(6) != 1)
        for share in (0.0, 0.5):
            reset = self.sample(bank=bank, demo_probability=0.5, adaptive_share=share)
            of_bank = reset[reset.state >= 0]
            first = (1 - share) / 3 + share / 2
            second = (1 - share) / 3 + share / 4
            states = ((of_bank.object_pos[:, 0] - 0.6) * 100).round()
            for state, expected in ((0, first), (4, second), (5, second)):
                own = states == state
                with self.subTest(share=share, state=state):
                    self.assertAlmostEqual(own.float().mean(), expected, delta=0.03)
                    self.assertAlmostEqual(of_bank.gravity_fraction[own].mean(), 0.5, delta=0.05)
            of_second = (reset.sequence[reset.state < 0] == 2).float().mean()
            self.assertAlmostEqual(of_second, 0.5, delta=0.03)

    def test_demonstrations_that_fail_are_drawn_more_often(self):
        """The soup can's two demonstrations are 0, which always succeeds, and 2, which never does."""
        shares = ((0.0, 0.5), (0.5, 0.25 + 0.5 / 1.05), (1.0, 1 / 1.05))
        for (share, expected), objects in product(shares, ((SOUP, SPAM), (SPAM, SOUP))):
            for p in (0.0, 1.0):
                config = ResetConfig(demo_probability=p, adaptive_share=share)
                distribution = ResetDistribution(self.bank, self.robot, objects, config)
                distribution.success_rate[0] = 1.0
                reset = distribution.sample(self.SOUPS + objects.index(SOUP), generator())
                of_second = (reset.sequence == 2).float().mean()
                with self.subTest(share=share, p=p, objects=objects):
                    self.assertAlmostEqual(of_second, expected, delta=0.02)
                    self.assertEqual(set(reset.sequence.tolist()), {0, 2})
                    assert_close(reset.goal_pos, self.of(reset, "goal_pos"))
                    self.assertEqual((reset.state >= 0).all(), p == 1.0)

    def test_crossed_goals_have_the_place_lift_and_turn_of_another_demonstration(self):
        """The soup can's demonstrations are 0 and 2; a goal of either is drawn for each of them, from home and bank."""
        turns = [
            Rotation.from_quat(quat, scalar_first=True)
            for quat in (self.bank.start_quat_wxyz, self.bank.goal_quat_wxyz)
        ]
        start, goal = turns
        for share, p in ((1.0, 0.0), (0.5, 1.0)):
            config = {"crossed_goals": share, "demo_probability": p}
            reset = self.sample(**config)
            found = {}
            for own, other in product((0, 2), (0, 2)):
                place = self.bank.goal_pos[other].copy()
                lift = place[2] - self.bank.start_pos[other, 2]
                place[2] = self.bank.start_pos[own, 2] + lift
                turn = goal[other] * start[other].inv() * start[own]
                quat = torch.as_tensor(turn.as_quat(scalar_first=True), dtype=torch.float32)
                angle = quat_angle(reset.goal_quat, quat.expand(len(reset.goal_quat), 4))
                far = (reset.goal_pos - torch.as_tensor(place)).norm(dim=1)
                here = (far < 1e-5) & (angle < 1e-2) & (reset.sequence == own)
                found[own, other] = here.float().mean()
            own_share = 0.5 - share / 4
            for (own, other), observed in found.items():
                expected = own_share if own == other else share / 4
                with self.subTest(share=share, own=own, other=other):
                    self.assertAlmostEqual(observed, expected, delta=0.03)
            plain = self.sample(**config | {"crossed_goals": 0.0})
            assert_close(plain.joint_pos, reset.joint_pos)
            assert_close(plain.object_pos, reset.object_pos)
        sunk = replace(self.bank, goal_pos=self.bank.start_pos - np.float32([0, 0, 0.01]))
        reset = self.sample(bank=sunk, demo_probability=0.0, crossed_goals=1.0)
        start = torch.as_tensor(self.bank.start_pos)[reset.sequence]
        assert_close(reset.goal_pos[:, 2], start[:, 2])

    def test_a_demonstration_without_states_is_drawn_at_home_only(self):
        bank = self.bank.with_states(self.bank.sequence_index != 2)
        reset = self.sample(bank=bank, demo_probability=1.0, adaptive_share=1.0)
        self.assertTrue((reset.state >= 0).all())
        self.assertEqual(set(reset.sequence.tolist()), {0})

    def test_rate_of_success_is_that_of_the_last_episodes(self):
        config = ResetConfig(adaptive_share=0.5)
        distribution = ResetDistribution(self.bank, self.robot, (SOUP, SPAM), config)
        sequence = tensor([0, 0, 1, 2])
        ended = tensor([True, True, True, False])
        distribution.record(sequence, tensor([True, False, True, True]), ended)
        assert_close(distribution.success_rate, tensor([0.05, 0.05, 0.0]))
        for _ in range(200):
            distribution.record(sequence, tensor([True, False, True, True]), ended)
        assert_close(distribution.success_rate, tensor([0.5, 1.0, 0.0]), rtol=0, atol=1e-3)
        many = torch.ones(100, dtype=torch.long)
        distribution.record(many, many == 0, many == 1)
        assert_close(distribution.success_rate[1], tensor(0.0))

    def test_gravity(self):
        """Of bank resets uniform, of home resets alpha = 1 + eta / 9.81 with eta ~ N(0, 1), clipped."""
        gravity = self.sample(demo_probability=1.0).gravity_fraction
        assert_range(gravity, 0.0, 1.0, atol=0.01)
        self.assertAlmostEqual(gravity.mean(), 0.5, delta=0.02)
        gravity = self.sample().gravity_fraction
        self.assertAlmostEqual(gravity.mean(), 1.0, delta=0.01)
        self.assertAlmostEqual(gravity.std(), 1 / 9.81, delta=0.005)
        with patch("xreset.resets.distribution.GRAVITY_CLIP", 0.1):
            assert_range(self.sample().gravity_fraction, 0.9, 1.1)
        for options in (
            {"demo_probability": 1.0, "random_gravity": False},
            {"home_gravity_std": 0.0},
        ):
            self.assertTrue((self.sample(**options).gravity_fraction == 1).all())

    def test_home_spawns_are_uniform_around_the_demonstrations_start(self):

        def offset(reset):
            return reset.object_pos - self.of(reset, "start_pos")

        reset = self.sample()
        self.assertEqual(reset.state.unique().tolist(), [-1])
        for axis, limit in enumerate((0.02, 0.02, 0.0)):
            assert_range(offset(reset)[:, axis], -limit, limit, atol=2e-4)
        yaw = quat_angle(reset.object_quat, self.of(reset, "start_quat_wxyz")).rad2deg()
        self.assertAlmostEqual(yaw.max(), 25.0, delta=0.1)
        self.assertAlmostEqual(yaw.mean(), 12.5, delta=0.5)
        start_quat = self.of(reset, "start_quat_wxyz")
        turn = quat_to_axis_angle(quat_multiply(reset.object_quat, quat_conjugate(start_quat)))
        assert_range(turn[:, 2].rad2deg(), -25.0, 25.0, atol=0.1)
        drawn = torch.column_stack((offset(reset)[:, :2], turn[:, 2], reset.gravity_fraction))
        assert_close(drawn.T.corrcoef(), torch.eye(4), atol=0.05, rtol=0)
        assert_range(offset(self.sample(spawn_xy=0.0, spawn_yaw=0.0)), 0.0, 0.0)
        self.assertAlmostEqual(offset(self.sample(training_xy=0.1)).max(), 0.1, delta=1e-3)
        lying = np.tile(turned(90, (1.0, 0, 0)).numpy(), (3, 1))
        found = self.sample(bank=replace(self.bank, start_quat_wxyz=lying)).object_quat
        # the object's y is vertical
        axis = quat_rotate(found, tensor([0.0, 1, 0]))
        assert_close(axis, tensor([0.0, 0, 1]).expand_as(axis), atol=1e-6, rtol=0)

    def test_goals_of_states_and_of_evaluations_are_the_demonstrated_ones(self):
        options = {"goal_xy": 0.03, "goal_z": 0.05, "goal_yaw": 0.5}
        reset = self.sample(demo_probability=0.5, **options)
        moved = (reset.goal_pos != self.of(reset, "goal_pos")).all(dim=1)
        self.assertTrue(torch.equal(moved, reset.state < 0))
        task = evaluation_task(TaskConfig(reset=ResetConfig(training_xy=0.1, **options)))
        self.assertEqual(task.reset, evaluation_task(TaskConfig()).reset)

    def test_starts_turn_about_the_origin_that_the_task_names(self):
        """Of boxes the center is the middle of their corners."""
        middles = tensor([[0.03, -0.01, 0.02], [-0.02, 0.04, -0.03]])
        corners = np.array([*product((-0.02, 0.02), (-0.01, 0.01), (-0.03, 0.03))])
        objects = [
            SimpleNamespace(name=name, vertices=corners + middle.numpy())
            for name, middle in zip((SOUP, SPAM), middles, strict=True)
        ]
        index = tensor([0, 1] * 10)
        config = ResetConfig(demo_probability=0.0, spawn_xy=0.0, spawn_yaw=1.0)
        for frame, origins in (("mesh", torch.zeros(2, 3)), ("center", middles)):
            task = TaskConfig(object_frame=frame, reset=config)
            resets = ResetDistribution.of(self.bank, self.robot, objects, task)
            reset = resets.sample(index, generator())
            origin = origins[index]
            place = reset.object_pos + quat_rotate(reset.object_quat, origin)
            assert_close(place, self.of(reset, "start_pos") + origin)

    def test_goals_turn_about_pivots_whose_heights_limit_them(self):
        """A pivot that is above its place at the start is not lowered beneath it; one that is below is not lowered."""
        pivots = {SOUP: np.array([0.03, -0.01, 0.02]), SPAM: np.array([-0.02, 0.04, -0.03])}
        config = ResetConfig(demo_probability=0.0, goal_xy=0.03, goal_z=0.05, goal_yaw=0.5)
        index = tensor([0, 1] * 2000)
        pivot = torch.as_tensor(np.stack(list(pivots.values())), dtype=torch.float32)[index]
        for raised in (0.2, 0.04, -0.1):
            goals = self.bank.start_pos + np.float32([0, 0, raised])
            bank = replace(self.bank, goal_pos=goals)
            resets = ResetDistribution(bank, self.robot, (SOUP, SPAM), config, pivots=pivots)
            reset = resets.sample(index, generator())
            start, goal = (
                pos[reset.sequence] + quat_rotate(quat[reset.sequence], pivot)
                for pos, quat in (
                    (torch.as_tensor(bank.start_pos), torch.as_tensor(bank.start_quat_wxyz)),
                    (torch.as_tensor(bank.goal_pos), torch.as_tensor(bank.goal_quat_wxyz)),
                )
            )
            offset = reset.goal_pos + quat_rotate(reset.goal_quat, pivot) - goal
            for name, own in ((SOUP, index == 0), (SPAM, index == 1)):
                lowest = -float((goal - start)[own][0, 2].clamp(0.0, 0.05))
                with self.subTest(name, raised=raised):
                    for axis, low, high in ((0, -0.03, 0.03), (1, -0.03, 0.03), (2, lowest, 0.05)):
                        assert_range(offset[own, axis], low, high, atol=3e-4)
            quat = self.of(reset, "goal_quat_wxyz")
            turn = quat_to_axis_angle(quat_multiply(reset.goal_quat, quat_conjugate(quat)))
            assert_range(turn[:, 2], -0.5, 0.5, atol=2e-3)
            assert_range(turn[:, :2], 0.0, 0.0, atol=1e-5)

    def test_home_joints_spread_as_the_paper_says_and_stay_within_limits(self):
        joints = self.sample().joint_pos
        space = ActionSpace(self.robot, ActionConfig())
        self.assertTrue(((joints >= space.lower) & (joints <= space.upper)).all())
        spread = joints.std(dim=0)
        # an arm joint far from its limits
        self.assertAlmostEqual(spread[1], 0.075, delta=0.004)
        self.assertAlmostEqual(spread[4], 0.10, delta=0.005)  # a finger joint


class ObservationTest(TestCase):
    N = 5
    J = 7
    E = 2

    def setUp(self):
        g = generator()

        def rand(*shape):
            return torch.randn(self.N, *shape, generator=g)

        def quat(*shape):
            return torch.nn.functional.normalize(rand(*shape, 4), dim=-1)

        still = State.at_rest(rand(self.J), rand(3), quat())
        moving = {"joint_vel": rand(self.J), "object_linvel": rand(3), "object_angvel": rand(3)}
        links = {name: rand(1 + self.E, 3) for name in ("pos", "linvel", "angvel")}
        self.x = obs.ObservationInput(
            state=replace(still, **moving),
            links=Links(quat=quat(1 + self.E), **links),
            joint_target=rand(self.J),
            joint_lower=torch.full((self.J,), -2.0),
            joint_upper=torch.full((self.J,), 3.0),
            points=torch.zeros(self.N, 1, 3),
            normals=torch.zeros(self.N, 1, 3),
            observed_pos=rand(3),
            observed_quat=quat(),
            goal_pos=rand(3),
            goal_quat=quat(),
            start_quat=quat(),
            gravity_fraction=rand(),
            previous_action=rand(self.J),
            tip_force=10 * rand(self.E, 3),
            tip_distance=rand(self.E).abs(),
            reward=rand(),
            generator=generator(),
        )
        still = merged(asdict(ObservationConfig()), {"proprio": {"joint_vel": {"scale": 0.2}}})
        self.config = ObservationConfig(**still).without_noise()

    def terms(self, x, config):
        """Value of every term by name, in all groups; the layout has their widths."""
        found = {}
        for group in GROUPS:
            found |= obs.Observer(config).terms(group, x)
        return found

    def value(self, x=None, **term):
        """The value of one term, given by name and parameters."""
        config = ObservationConfig(policy=term)
        (value,) = obs.Observer(config).terms("policy", x or self.x).values()
        return value

    def test_each_term_that_is_a_quantity(self):
        x = self.x
        state = x.state
        scaled = {"joint_pos": state.joint_pos, "target_pos": x.joint_target}
        expected = {
            "object_pos": x.observed_pos,
            "goal_pos": x.goal_pos,
            "gravity_fraction": x.gravity_fraction[:, None],
            "previous_action": x.previous_action,
            "joint_vel": 0.2 * state.joint_vel,
            "true_joint_vel": 0.2 * state.joint_vel,
            "joint_target": x.joint_target - state.joint_pos,
            "palm_pos": x.links.pos[:, 0],
            "palm_linvel": x.links.linvel[:, 0],
            "palm_angvel": x.links.angvel[:, 0],
            "tip_pos": x.links.pos[:, 1:].flatten(1),
            "tip_force": (0.1 * x.tip_force).clamp(-1.0, 1.0).flatten(1),
            "object_linvel": state.object_linvel,
            "object_angvel": state.object_angvel,
            "goal_offset": x.goal_pos - state.object_pos,
            "least_tip_distance": x.tip_distance.amin(1, keepdim=True),
            "reward": x.reward[:, None],
        }
        # limits -2, 3 become -1, 1
        expected |= {name: (value - 0.5) / 2.5 for name, value in scaled.items()}
        parameters = {name: {"noise": 0.0} for name in ("object_pos", "joint_pos")}
        parameters |= {"joint_vel": {"noise": 0.0, "scale": 0.2}, "true_joint_vel": {"scale": 0.2}}
        parameters |= {"tip_force": {"scale": 0.1}}
        for name, value in expected.items():
            with self.subTest(name):
                assert_close(self.value(**{name: parameters.get(name, {})}), value)

    def test_each_term_that_is_a_rotation(self):
        """A rotation is one observation, whatever the sign of its quaternion, and leads where it should."""
        x = self.x
        negated = replace(
            x,
            state=replace(x.state, object_quat=-x.state.object_quat),
            links=replace(x.links, quat=-x.links.quat),
            observed_quat=-x.observed_quat,
            goal_quat=-x.goal_quat,
            start_quat=-x.start_quat,
        )
        palm = x.links.quat[:, 0]
        to_goal = quat_multiply(x.goal_quat, quat_conjugate(x.observed_quat))
        for name, parameters, quat in (
            ("object_quat", {"noise": 0.0}, x.observed_quat),
            ("goal_quat", {}, x.goal_quat),
            ("palm_quat", {}, palm),
            ("object_rotation", {"noise": 0.0}, x.observed_quat),
            ("goal_rotation", {}, x.goal_quat),
            ("palm_rotation", {}, palm),
            ("rotation_to_goal", {"noise": 0.0}, to_goal),
            ("rotation_from_start", {}, quat_multiply(x.goal_quat, quat_conjugate(x.start_quat))),
        ):
            found = self.value(**{name: parameters})
            with self.subTest(name):
                assert_close(self.value(negated, **{name: parameters}), found)
                if name.endswith("quat"):
                    self.assertTrue((found[:, 0] >= 0).all())
                    assert_close(quat_angle(found, quat), torch.zeros(self.N), atol=1e-3, rtol=0)
                else:
                    for axis, column in zip(torch.eye(3), found.split(3, dim=-1)):
                        assert_close(column, quat_rotate(quat, axis.expand(self.N, 3)))
        turn = quat_from_axis_angle(self.value(goal_turn={}))
        corrected = quat_multiply(turn, x.state.object_quat)
        assert_close(quat_angle(corrected, x.goal_quat), torch.zeros(self.N), atol=2e-3, rtol=0)

    def test_with_cameras_a_goal_does_not_depend_on_the_axes_of_a_mesh(self):
        c = RECIPES["live"].task.observation
        widths = obs.layout(self.J, self.E, c, VisionConfig(cameras=(FRONT,)))
        self.assertEqual([*widths], ["goal", "proprio", "view"])
        self.assertEqual([*widths["goal"]], ["goal_pos", "rotation_from_start", "previous_action"])
        drawn_otherwise = turned(100, (0.6, 0.0, 0.8)).expand(self.N, 4)
        quats = {
            n: quat_multiply(getattr(self.x, n), drawn_otherwise)
            for n in ("start_quat", "goal_quat")
        }
        observed = obs.Observer(c).group
        assert_close(observed("goal", replace(self.x, **quats)), observed("goal", self.x))

    def test_the_published_observation(self):
        c = RECIPES["published"].task.observation
        widths = obs.layout(28, 5, c)
        flat = sum(widths["policy"].values()) + sum(widths["proprio"].values())
        # the paper's 648 inputs
        self.assertEqual((flat, flat + widths["perception"]["paired_cloud"]), (72, 648))
        points = torch.randn(self.N, 64, 3, generator=generator())
        found = obs.Observer(c).group("policy", replace(self.x, points=points))
        cloud = quat_rotate(self.x.observed_quat[:, None], points) + self.x.observed_pos[:, None]
        distance = (self.x.links.pos[:, :, None] - cloud[:, None]).norm(dim=-1).amin(dim=-1)
        vectors = found[:, :-1].unflatten(1, (-1, 3))
        assert_close(vectors.norm(dim=-1), distance[:, 1:])
        assert_close(found[:, -1], distance[:, 0])
        ends = self.x.links.pos[:, 1:] + vectors
        gaps = (ends[:, :, None] - cloud[:, None]).norm(dim=-1).amin(dim=-1)
        self.assertLess(gaps.max(), 1e-5)

    def test_the_layout_has_the_widths_and_the_order_of_the_groups(self):
        for name, recipe in RECIPES.items():
            c = recipe.task.observation
            points = torch.zeros(self.N, c.cloud_points, 3)
            x = replace(self.x, points=points, normals=points)
            for group, widths in obs.layout(self.J, self.E, c).items():
                value = obs.Observer(c).group(group, x)
                self.assertEqual(value[0].numel(), sum(widths.values()), (name, group))
                self.assertEqual([*widths], [*getattr(c, group)])

    def test_clouds(self):
        points, normals = torch.randn(2, self.N, 10, 3, generator=generator(1))
        x = replace(self.x, points=points, normals=normals)
        now = quat_rotate(self.x.observed_quat[2], points[2, 7]) + self.x.observed_pos[2]
        goal = quat_rotate(self.x.goal_quat[2], points[2, 7]) + self.x.goal_pos[2]
        to_palm = quat_conjugate(self.x.links.quat[2, 0])
        of_palm = quat_rotate(to_palm, now - self.x.links.pos[2, 0])
        normal = quat_rotate(to_palm, quat_rotate(self.x.observed_quat[2], normals[2, 7]))
        near = torch.cat((5.0 * now, 5.0 * of_palm, 5.0 * (goal - now), normal))
        for name, parameters, expected in (
            ("cloud", {"frames": 3, "scale": 1.0}, now),
            ("cloud", {"frames": 1, "scale": 5.0}, 5.0 * now),
            ("paired_cloud", {"scale": 5.0}, 5.0 * torch.cat((now, goal, goal - now))),
            ("palm_cloud", {"scale": 5.0}, near),
        ):
            c = ObservationConfig(perception={name: {"noise": 0.0} | parameters}, cloud_points=10)
            cloud = obs.Observer(c).group("perception", x)
            shape = (parameters.get("frames", 1), 10, len(expected))
            self.assertEqual((tuple(cloud.shape[1:]), obs.cloud_shape(c)), (shape, shape))
            for frame in cloud[2, :, 7]:
                assert_close(frame, expected)

    def test_noise_has_the_configured_spread_and_touches_only_what_is_measured(self):
        many = torch.zeros(4000, dtype=torch.long)
        same = ("joint_lower", "joint_upper", "generator")
        x = replace(self.x, **{k: v[many] for k, v in vars(self.x).items() if k not in same})
        noise = {
            "policy": {"object_pos": {"noise": 0.02}, "object_quat": {"noise": 0.05}},
            "proprio": {"joint_pos": {"noise": 0.01}, "joint_vel": {"noise": 0.1}},
            "perception": {"cloud": {"noise": 0.03}},
        }
        c = ObservationConfig(**merged(asdict(self.config), noise))
        terms = self.terms(replace(x, points=torch.zeros(len(many), 1000, 3)), c)
        expected = {"object_pos": 0.02, "joint_pos": 0.01 / 2.5, "joint_vel": 0.1 * 0.2}
        for name, value in terms.items():
            if name not in ("object_quat", "cloud"):
                spread = torch.full(value.shape[1:], expected.get(name, 0.0))
                assert_close(value.std(dim=0), spread, rtol=0.1, atol=1e-6)
        angle = quat_angle(terms["object_quat"], x.observed_quat).square().mean().sqrt()
        self.assertAlmostEqual(angle, 0.05 * math.sqrt(3), delta=0.005)
        away = terms["cloud"][:, 0] - x.observed_pos[:, None]
        self.assertAlmostEqual(away.std(), 0.03, delta=0.001)

    def test_what_is_not_an_observation_is_refused(self):
        for name, parameters, words in (
            ("smell", {}, "Unknown observation 'smell'. Choose from: object_pos"),
            (
                "my:smell",
                {},
                "Unknown observation 'my:smell'. Only reward terms may be functions of your own",
            ),
            (
                "joint_vel",
                {"noise": 0.1},
                r"policy\.joint_vel has wrong entries .missing: scale",
            ),
            ("tip_force", {"scale": "x"}, r"policy\.tip_force\.scale is 'x', expected a number"),
        ):
            with refuses(self, words, ValueError):
                self.value(**{name: parameters})


class EvaluationTaskTest(TestCase):
    def test_only_what_evaluation_fixes_is_changed(self):
        task = TaskConfig(
            action=ActionConfig(arm_step=0.03),
            reset=ResetConfig(spawn_xy=0.05, demo_probability=0.5, crossed_goals=0.5),
        )
        for timestep, substeps, expected in (
            (1 / 240, 4, (1 / 240, 4)),
            (1 / 120, 2, (1 / 240, 4)),
            (1 / 100, 1, (1 / 100, 1)),
        ):
            found = evaluation_task(replace(task, timestep=timestep, substeps=substeps))
            self.assertEqual((found.timestep, found.substeps), expected)
        fixed = {
            "reset": replace(
                task.reset, demo_probability=0.0, home_gravity_std=0.0, crossed_goals=0.0
            ),
            "randomization": replace(task.randomization, enabled=False),
            "observation": task.observation.without_noise(),
        }
        self.assertEqual(evaluation_task(task), replace(task, **fixed))


class PolicyTest(TestCase):
    robot = toy_robot()
    TASK = TaskConfig()

    def refused(self, words, task=None, **changes):
        contract = asdict(policy_contract(self.robot, self.TASK, (SOUP,))) | changes
        with refuses(self, f"(?s)p.onnx.*{words}", PolicyError, words):
            read = parsed_contract("p.onnx", contract)
            check_contract("p.onnx", read, self.robot, task or self.TASK)

    def test_its_own_robot_and_task_are_accepted(self):
        contract = asdict(policy_contract(self.robot, self.TASK, (SOUP,)))
        contract["task"]["observation"] = {"cloud_history": 5}  # a file of an earlier version
        for task in (self.TASK, evaluation_task(self.TASK)):
            check_contract("p.onnx", parsed_contract("p.onnx", contract), self.robot, task)

    def test_refusals_name_what_differs(self):
        layout = policy_contract(self.robot, self.TASK, ()).observation_layout
        tactile = layout | {"policy": layout["policy"] | {"tactile": 4}}
        robot = "is a policy of the robot 'openarm', not of 'toy'. Give a policy of 'toy'"
        first, second, *_, last = self.robot.joint_names
        order = f"joint order .joint_names.0.: '{last}', here '{first}'; .*, here '{second}'.*; and . more"
        schema = "schema is 'xreset-policy/9', expected one of 'xreset-policy/1'"
        for words, name, value in (
            (robot, "robot", "openarm"),
            (schema, "schema", "xreset-policy/9"),
            (order, "joint_names", list(reversed(self.robot.joint_names))),
            ("another fingertips", "fingertip_names", ["index", "thumb"]),
            ("another version of the robot", "robot_fingerprint", "00"),
            ("another version of the robot", "robot_fingerprint", ""),
            ("policy.tactile: 4, here None", "observation_layout", tactile),
        ):
            self.refused(words, **{name: value})
        fewer, scaled = (
            {"observation": replace(self.TASK.observation, **change)}
            for change in (
                {"perception": {"cloud": {"frames": 3, "noise": 0.002, "scale": 1.0}}},
                {"perception": {"cloud": {"frames": 5, "noise": 0.1, "scale": 5.0}}},
            )
        )
        relative = {"action": ActionConfig(hand="relative")}
        for words, changes in (
            ("observation layout .perception.cloud: 960, here 576", fewer),
            ("another action mapping .hand: 'absolute', here 'relative'", relative),
            (
                "another scale of observations .perception: .*'scale': 1.0.*, here .*'scale': 5.0",
                scaled,
            ),
            ("another time between actions .control_dt: 0.01666.*, here 0.02083", {"substeps": 5}),
        ):
            self.refused(words, replace(self.TASK, **changes))

    def test_a_policy_without_training(self):
        action = ZeroPolicy(7).act({"policy": torch.zeros(300, 22)})
        self.assertEqual(tuple(action.shape), (300, 7))
        self.assertFalse(action.any())
