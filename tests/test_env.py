"""The environment and the rollouts on the MuJoCo C engine: episodes begin and end as they should, world by world."""

from contextlib import nullcontext
from dataclasses import replace
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import torch
import trimesh
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation
from torch import tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from tests.data import InFolder, refuses
from tests.toy_bank import SOUP, SPAM, toy_bank, toy_retargeted
from tests.toy_robot import toy_robot
from xreset import make_bank
from xreset.backends.mujoco import MujocoBackend
from xreset.env.manipulation import ManipulationEnv, make_env, make_scene
from xreset.errors import CapabilityError, XResetError
from xreset.eval.baselines import KinematicRetargeting, ZeroPolicy
from xreset.eval.conditions import Condition, chosen_properties, nominal_task
from xreset.eval.experiment import play
from xreset.eval.metrics import EpisodeMetrics, MetricPoints
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.rollout import Engine, Trial, roll_out
from xreset.geometry.rotations import quat_rotate
from xreset.learning.recipes import RECIPES
from xreset.objects.catalogue import load_object, load_objects
from xreset.physics import State
from xreset.physics.capture import GraphRunner
from xreset.physics.plugins import make_backend
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import (
    ActionConfig,
    ObservationConfig,
    PushConfig,
    RandomizationConfig,
    ResetConfig,
    RewardConfig,
    TaskConfig,
    TerminationConfig,
    TrackerConfig,
    evaluation_task,
)
from xreset.task.observations import layout

N = 3
TASK = TaskConfig(
    termination=TerminationConfig(episode_seconds=0.5),
    observation=ObservationConfig(cloud_points=16),
    distance_points=64,
)
QUIET = replace(TASK, observation=TASK.observation.without_noise())
REST = torch.zeros(N, 7)
"""Actions."""


class BreakableBackend(MujocoBackend):
    """An engine with worlds that are not finite, or drop contacts, until they are set again."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.broken = torch.zeros(self.num_worlds, dtype=torch.bool)
        self.overflow = self.broken.clone()

    def set_state(self, state, worlds=None):
        for failed in (self.broken, self.overflow):
            failed[slice(None) if worlds is None else worlds] = False
        super().set_state(state, worlds)

    def state(self):
        state = super().state()
        names = ("object_pos", "joint_pos")
        broken = self.broken[:, None]
        return replace(
            state, **{n: torch.where(broken, torch.nan, getattr(state, n)) for n in names}
        )

    def health(self):
        health = super().health()
        nonfinite = health.nonfinite | self.broken
        return replace(health, nonfinite=nonfinite, overflow=health.overflow | self.overflow)


class Waiting(TorchDispatchMode):
    """Records operations for which the host waits: reading a number, or a number of rows that depends on values."""

    NAMES = ("_local_scalar_dense", "nonzero", "masked_select", "unique", "is_nonzero")

    def __init__(self):
        super().__init__()
        self.operations = 0
        self.found = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.operations += 1
        indices = (
            args[1]
            if "index" in str(func) and len(args) > 1 and isinstance(args[1], (list, tuple))
            else ()
        )
        masks = [i for i in indices if isinstance(i, torch.Tensor) and i.dtype == torch.bool]
        if masks or any(name in str(func) for name in self.NAMES):
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))


def lifted(x):
    return x.object_pos[:, 2] - x.start_pos[:, 2]


class WithEnv(TestCase):
    robot = toy_robot()
    objects = load_objects((SOUP, SPAM))
    bank = toy_bank(robot)

    def make(self, task=TASK, seed=0, kind=MujocoBackend):
        scene = make_scene(self.robot, self.objects, task)
        backend = kind(scene, N, object_index=tensor([0, 1, 0]), workers=0)
        self.addCleanup(backend.close)
        resets = ResetDistribution(self.bank, self.robot, (SOUP, SPAM), task.reset)
        return ManipulationEnv(backend, task, resets, seed=seed)

    def play(self, env, steps, seed=0):
        """Observations of every step with random actions."""
        return [env.step(action)[0] for action in self.actions(steps, seed)]

    def actions(self, steps, seed=0):
        return 2 * torch.rand(steps, N, 7, generator=torch.Generator().manual_seed(seed)) - 1

    def assert_same(self, found, expected, worlds=slice(None)):
        """Every tensor of two states or observations is equal in these worlds."""
        found, expected = (
            dict(vars(x) if isinstance(x, State) else x.items()) for x in (found, expected)
        )
        for name, value in found.items():
            self.assertTrue(torch.equal(value[worlds], expected[name][worlds]), name)

    def assert_finite(self, observations):
        for group, value in observations.items():
            self.assertTrue(value.isfinite().all(), group)


class RefusalTest(WithEnv):
    def test_what_does_not_belong_together_is_refused(self):
        robot = self.robot
        objects = self.objects
        bank = self.bank
        names = tuple(f"other_{name}" for name in robot.joint_names)
        meshes = [replace(obj, source="0" * 64) for obj in objects]
        for words, *parts in (
            ("not those of .*'other_.*', here ", robot, objects, replace(bank, joint_names=names)),
            ("was made with", robot, meshes, bank),
            ("load_robot", robot.name, objects, bank),
            ("'soup'.*load_object", robot, ["soup"], bank),
            ("read_bank", robot, objects, "bank.npz"),
        ):
            with refuses(self, words, XResetError):
                make_env(*parts, num_envs=1)
        with refuses(self, "num_envs is 0, expected a whole number above 0", XResetError):
            make_env(robot, objects, bank, num_envs=0)
        motion = toy_retargeted(robot, [SOUP], [0, 2], joint_names=names)
        with self.assertRaisesRegex(
            XResetError, "a retargeted file for another version of .*'other_"
        ):
            make_bank(motion, robot, objects)

    def test_shares_of_worlds_that_cannot_be_are_refused(self):
        for words, share, num_envs in (
            ("object_share names mug, but the objects are", {"mug": 2.0}, 8),
            ("gets no world", {SOUP: 100.0}, 8),
        ):
            task = replace(TASK, reset=replace(TASK.reset, object_share=share))
            with refuses(self, words, XResetError):
                make_env(self.robot, self.objects, self.bank, task, num_envs=num_envs)
        with self.assertRaisesRegex(ValueError, "object_share .*numbers above 0"):
            ResetConfig(object_share={SOUP: 0.0})

    def test_options_that_an_engine_lacks_are_refused(self):
        scene = make_scene(self.robot, self.objects, TASK)
        words = "'mujoco-warp' has no option 'integrator'. Choose from: object_index, device"
        with self.assertRaisesRegex(XResetError, words):
            make_backend("mujoco-warp", scene, 2, integrator="discrete")

    def test_starts_and_goals_do_not_depend_on_the_robot(self):
        rows = np.zeros(self.bank.num_states, dtype=bool)
        bank = replace(self.bank.with_states(rows), joint_names=("other",))
        make_env(self.robot, self.objects, bank, num_envs=1).close()

    def test_an_object_gets_its_share_of_the_worlds(self):
        task = replace(TASK, reset=replace(TASK.reset, object_share={SPAM: 3.0}))
        with make_env(self.robot, self.objects, self.bank, task, num_envs=7) as env:
            # 7 worlds in the ratio 1:3 are 1.75 and 5.25
            self.assertEqual(env.backend.object_index.tolist(), [0, 0, 1, 1, 1, 1, 1])
        self.assertEqual(evaluation_task(task).reset.object_share, {})

    def test_what_is_not_one_value_for_each_world_is_refused(self):
        env = self.make()
        still = REST
        before = (env.worlds.clone(), vars(env.backend.state().clone()))
        for call, words in (
            (lambda: env.step(still[0]), r"expected \(3, 7\)"),
            (lambda: env.step(still[:1]), r"expected \(3, 7\)"),
            (lambda: env.step(still[:, :1]), r"expected \(3, 7\)"),
            (lambda: env.step(np.zeros((3, 7))), "a ndarray, expected a tensor"),
            (lambda: env.step(still, [True] * N), "^begin is a list, expected a tensor"),
            (lambda: env.step(still, torch.tensor([0])), r"^begin has the shape \(1,\), expected \(3,\)"),
            (lambda: env.advance(still, torch.zeros(7)), r"^push has the shape \(7,\), expected \(3, 7\)"),
            (lambda: env.reset(torch.tensor([N])), "^worlds is .*, expected indices from 0 to 2"),
            (lambda: env.reset([0, -1]), r"^worlds is \[0, -1\], expected indices from 0 to 2"),
        ):  # fmt: skip
            with refuses(self, words, XResetError):
                call()
        assert_close(env.worlds.clone(), before[0], equal_nan=True)
        assert_close(vars(env.backend.state()), before[1])

    def test_observations_do_not_hold_the_graph_of_an_action(self):
        observations, reward, *_ = self.make().step(torch.zeros(N, 7, requires_grad=True) * 1.0)
        for value in (*observations.values(), reward):
            self.assertFalse(value.requires_grad)


class StepTest(WithEnv):
    def test_observations_state_the_world(self):
        env = self.make(QUIET)
        observations = self.play(env, 5)[-1]
        widths = layout(7, 2, TASK.observation)
        shapes = {name: tuple(value.shape[1:]) for name, value in observations.items()}
        flat = {name: (sum(widths[name].values()),) for name in ("policy", "proprio")}
        self.assertEqual(shapes, flat | {"perception": (5, 16, 3), "privileged": (15,)})
        self.assert_finite(observations)
        state = env.backend.state()
        policy = observations["policy"]
        assert_close(policy[:, :3], state.object_pos)
        assert_close(policy[:, 7:10], env.goal_pos)
        assert_close(policy[:, 14], env.gravity_fraction)
        assert_close(policy[:, 15:], self.actions(5)[-1])
        scaled = env.actions.absolute_action(state.joint_pos)
        assert_close(observations["proprio"][:, 3:7], scaled[:, 3:])
        cloud = quat_rotate(state.object_quat[:, None], env._cloud_points)
        assert_close(observations["perception"][:, -1], cloud + state.object_pos[:, None])

    def test_actions_reach_the_drives(self):
        env = self.make()
        before = env.joint_target.clone()
        action = REST
        action[1, 1] = 1.0
        action[2, 3] = 2.0
        env.step(action)
        target = env.backend.state().joint_target
        assert_close(target, env.joint_target)
        assert_close(target[1, 1], before[1, 1] + TASK.action.arm_step)
        assert_close(target[0, :3], before[0, :3])
        assert_close(target[2, 3], env.actions.upper[3])

    def test_the_reach_reward_uses_the_best_distance_of_the_episode(self):
        env = self.make(replace(QUIET, action=ActionConfig(arm_step=0.3, arm_lead=1.0)))
        env.advance(torch.ones(N, 7))
        env.reset()
        readings = [env.reading()]
        reach = []
        for action in [1.0, -1.0, 1.0, -1.0]:
            for _ in range(5):
                reading, reward = env.advance(torch.full((N, 7), action))
                reach.append(reward.terms["reach"])
                readings.append(reading)
        distance = torch.stack([reading.tip_distance.mean(dim=-1) for reading in readings])
        best = distance.cummin(dim=0).values
        assert_close(
            torch.stack(reach), 1 - torch.tanh(best[1:] / TASK.reward.terms["reach"]["width"])
        )
        self.assertTrue((distance > best + 1e-3).any(), "the hand moved away at times")

    def test_a_reset_of_one_world_leaves_the_others_as_they_are(self):
        env = self.make()
        before = self.play(env, 3)[-1]
        env.reset(tensor([1]))
        after = env.get_observations()
        self.assert_same(after, before, [0, 2])
        self.assertFalse(torch.equal(after["policy"][1], before["policy"][1]))
        self.assertEqual(env.episode_length_buf.tolist(), [3, 0, 3])
        start = env._new_start[[1]].clone()
        env.reset([2], start=start)
        assert_close(env.goal_pos[2], start.goal_pos[0])

    def test_the_same_seed_gives_the_same_episodes(self):
        runs = [self.make(seed=seed) for seed in (3, 3, 4)]
        for action in self.actions(40):  # past the time limit: resets are drawn too
            results = [env.step(action) for env in runs]
        self.assert_same(results[0][0], results[1][0])
        self.assertTrue(torch.equal(results[0][1], results[1][1]))
        self.assertFalse(torch.equal(results[0][0]["policy"], results[2][0]["policy"]))


class GraphTest(TestCase):
    def test_the_first_calls_wait_for_the_stream_of_their_own_device(self):
        """Another device may be torch's current one."""
        with (
            patch("torch.cuda.Stream") as own,
            patch("torch.cuda.current_stream") as current_stream,
            patch("torch.cuda.stream", lambda _: nullcontext()),
        ):
            GraphRunner(torch.device("cuda:1")).run(self.id)
        current_stream.assert_called_once_with(torch.device("cuda:1"))
        own().wait_stream.assert_called_once_with(current_stream())
        current_stream().wait_stream.assert_called_once_with(own())


class ResetTest(WithEnv):
    def test_only_the_finished_world_is_reset(self):
        env = self.make(QUIET)
        other = self.make(QUIET)
        began = env.backend.state().object_quat.clone()
        for each in (env, other):
            self.play(each, 8)
        self.assertTrue(torch.equal(env.start_quat, began))
        env.episode_length_buf[1] = env.max_episode_length - 1
        action = self.actions(1, seed=5)[0]
        last_cloud = env.get_observations()["perception"].clone()
        mass = env.variation.parameters["object_mass"].clone()
        observations, _, done, extras = env.step(action)
        drawn_again = env.variation.parameters["object_mass"] != mass
        self.assertEqual(drawn_again.tolist(), [False, True, False])
        expected, *_ = other.step(action)
        self.assertEqual(done.tolist(), [0, 1, 0])
        self.assertEqual(extras["time_outs"].tolist(), [0.0, 1.0, 0.0])
        self.assertEqual(env.episode_length_buf.tolist(), [9, 0, 9])
        self.assert_same(env.backend.state(), other.backend.state(), [0, 2])
        self.assert_same(observations, expected, [0, 2])
        cloud = observations["perception"]
        assert_close(cloud[[0, 2], :-1], last_cloud[[0, 2], 1:])
        # the new episode's history is its first frame; it has no previous action and reward
        assert_close(cloud[1], cloud[1, :1].expand_as(cloud[1]))
        self.assertEqual(observations["policy"][1, 15:].abs().max(), 0.0)
        self.assertEqual(observations["privileged"][1, -1], 0.0)
        self.assertTrue(torch.equal(env.start_quat[[0, 2]], began[[0, 2]]))
        state = env.backend.state()
        assert_close(env.start_quat[1], state.object_quat[1])
        # the drives hold the new joint positions
        self.assertTrue(torch.equal(env.joint_target[1], state.joint_pos[1]))

    def test_ends_of_episodes_from_home_count_for_their_demonstration(self):
        """World 0 ends from home at its goal, world 1 elsewhere, world 2 at its goal from a state of the bank."""
        near = RewardConfig(gate={"near": {"tips": 10.0, "palm": 10.0}})
        reset = replace(TASK.reset, demo_probability=0.0, adaptive_share=0.5)
        env = self.make(replace(TASK, reward=near, reset=reset), kind=BreakableBackend)
        state = env.backend.state()
        env.goal_pos.copy_(state.object_pos)
        env.goal_quat.copy_(state.object_quat)
        env.goal_pos[1] += 0.3
        env.bank_state[2] = 0
        env.episode_length_buf[:] = env.max_episode_length - 1
        expected = torch.zeros(3)
        expected[env.sequence[0]] += 0.05
        env.step(REST)
        assert_close(env.resets.success_rate, expected)
        # as at the start of a training, and after each break
        env.resets.success_rate.fill_(1.0)
        env.episode_length_buf = torch.full((N,), env.max_episode_length - 1)
        _, _, done, _ = env.step(REST)
        self.assertTrue(done.all())
        assert_close(env.resets.success_rate, torch.ones(3), msg="the episodes were cut short")
        env.episode_length_buf[:] = env.max_episode_length - 1
        env.goal_pos += 0.3
        env.step(REST)
        self.assertLess(float(env.resets.success_rate.min()), 1.0)
        env.resets.success_rate.fill_(1.0)
        env.backend.overflow[:] = True
        env.step(REST)
        assert_close(env.resets.success_rate, torch.ones(3), msg="the simulations failed")

    def test_starts_come_from_the_distribution_and_may_press(self):
        """Drives begin with the bank's targets; from home they hold the joints."""
        task = replace(TASK, reset=ResetConfig(demo_probability=1.0))
        self.bank = replace(self.bank, joint_target=self.bank.joint_pos + 0.01)
        env = self.make(task)
        state = env.backend.state()
        self.assertTrue(env.from_bank.all())
        numbers = ((state.object_pos[:, 0] - 0.6) * 100).round().int().tolist()
        assert_close(state.joint_pos, torch.as_tensor(self.bank.joint_pos)[numbers])
        assert_close(env.goal_pos, torch.as_tensor(self.bank.goal_pos)[env.sequence])
        assert_close(state.joint_target, state.joint_pos + 0.01)
        assert_close(env.joint_target, state.joint_target)
        state = self.make(replace(task, reset=ResetConfig(demo_probability=0.0))).backend.state()
        self.assertTrue(torch.equal(state.joint_target, state.joint_pos))


class RobustnessTest(WithEnv):
    def task(self, **ranges):
        return replace(QUIET, randomization=RandomizationConfig(**ranges))

    def test_pose_joints_and_forces_are_observed_late(self):
        """Joints and forces by whole steps."""
        late = self.task(observation_latency=(2.0, 2.0), proprio_latency=(1.6, 1.6))
        found, present = (self.play(self.make(task), 6) for task in (late, self.task()))
        for now, before in zip(found[2:], present, strict=False):
            assert_close(now["policy"][:, :3], before["policy"][:, :3])
            assert_close(now["proprio"], before["proprio"])
        env = self.make(late)
        self.play(env, 4)
        before = [part.clone() for part in env.tracked_pose]
        env.reset(tensor([1]))
        for part, last in zip(env.tracked_pose, before, strict=True):
            self.assertEqual((part != last).any(dim=1).tolist(), [False, True, False])
        scaled = env.actions.absolute_action(env.backend.state().joint_pos)
        joints = env.get_observations()["proprio"][:, 3:7]
        assert_close(joints[1], scaled[1, 3:])  # the new episode's, from its first step
        self.assertGreater((joints - scaled[:, 3:])[[0, 2]].abs().amax(), 1e-3)

    def test_what_follows_from_late_joints_is_as_late(self):
        """The palm's pose, and the object in its frame; the critic has the present pose."""
        pose = {"palm_pos": {}, "palm_quat": {}}
        observation = ObservationConfig(
            cloud_points=4,
            policy=pose,
            proprio=pose,
            perception={"palm_cloud": {"noise": 0.0, "scale": 1.0}},
            privileged=pose,
        )
        late = replace(self.task(proprio_latency=(1.0, 1.0)), observation=observation)
        task = replace(late, randomization=QUIET.randomization)
        found, present = (self.play(self.make(each), 4) for each in (late, task))
        for now, before in zip(found[1:], present, strict=False):
            assert_close(now["policy"], before["policy"])
            assert_close(now["proprio"], before["policy"])
            pos, quat = now["policy"][:, None].split((3, 4), dim=-1)
            here, of_palm, _, _ = now["perception"][:, 0].split(3, dim=-1)
            assert_close(quat_rotate(quat, of_palm) + pos, here)
        for now, same in zip(found, present, strict=True):
            assert_close(now["privileged"], same["policy"])

    def test_arm_and_hand_may_be_late_apart(self):
        env = self.make(self.task(action_latency=(0.0, 0.0), hand_latency=(1.0, 1.0)))
        last = env.joint_target.clone()
        with patch.object(env.backend, "set_joint_targets") as sent:
            for action in self.actions(3):
                env.step(action)
                arm, hand = sent.call_args.args[0].split((3, 4), dim=-1)
                assert_close(arm, env.joint_target[:, :3])
                assert_close(hand, last[:, 3:])
                last = env.joint_target.clone()

    def test_a_lost_action_leaves_the_targets_where_they_are(self):
        held = []
        for share in (1.0, 0.5):
            env = self.make(self.task(lost_actions=(share, share)))
            for action in self.actions(20):
                before = env.joint_target.clone()
                env.step(action)
                held.append((env.joint_target == before).all(dim=-1).float())
        all_lost, half_lost = torch.stack(held).view(2, -1).mean(dim=-1).tolist()
        self.assertEqual(all_lost, 1.0)
        self.assertTrue(0.25 < half_lost < 0.75, half_lost)

    def observed(self, tracker):
        """Errors of the observed positions [steps, N, 3], and errors of the cloud's middle that follow from them."""
        env = self.make(self.task(tracker=tracker))
        errors = []
        cloud_errors = []
        for action in self.actions(12):
            observations, *_ = env.step(action)
            state = env.backend.state()
            cloud = quat_rotate(state.object_quat[:, None], env._cloud_points)
            errors.append(observations["policy"][:, :3] - state.object_pos)
            seen = observations["perception"][:, -1] - state.object_pos[:, None]
            cloud_errors.append((seen - cloud).mean(dim=1))
        return torch.stack(errors), torch.stack(cloud_errors)

    def test_a_tracker_has_one_bias_in_an_episode_and_new_noise_in_every_pose(self):
        bias, cloud_bias = self.observed(TrackerConfig(position_bias=0.01))
        self.assertTrue(((bias.abs() <= 0.01001) & (bias.abs() > 0)).all())
        assert_close(bias, bias[:1].expand_as(bias))
        assert_close(bias, cloud_bias)
        noise, _ = self.observed(TrackerConfig(position_noise=0.01))
        self.assertTrue((noise.abs() <= 0.01001).all() and (noise[1:] != noise[:-1]).all())
        position, cloud = self.observed(TrackerConfig(rotation_noise=0.1, rotation_bias=0.1))
        self.assertLess(position.abs().max(), 1e-6)
        self.assertGreater(cloud.abs().max(), 1e-4)

    def test_pushes_change_velocities_by_what_they_say(self):
        """The same spin needs less torque where the inertia is smaller."""
        push = PushConfig(probability=(1.0, 1.0), object_velocity=0.5, object_spin=4.0)
        env = self.make(self.task(push=push, object_inertia=(0.2, 0.2)))
        same = self.make(self.task())
        for each in (env, same):
            state = each.backend.state()
            raised = state.object_pos + tensor([0.0, 0.0, 0.3])
            each.backend.set_state(replace(state, object_pos=raised))
            each.step(REST)
        pushes = env.variation.pushes
        pushed = env.backend.state()
        free = same.backend.state()
        mass = env.variation.parameters["object_mass"][:, None]
        expected = pushes.force / mass * env.backend.scene.control_dt
        self.assertTrue(((expected.norm(dim=-1) > 0) & (expected.norm(dim=-1) <= 0.5)).all())
        spin = pushed.object_angvel - free.object_angvel
        self.assertTrue(((spin.norm(dim=-1) > 0) & (spin.norm(dim=-1) <= 4.2)).all())
        com = tensor([self.objects[i].com.tolist() for i in env.backend.object_index])
        arm = quat_rotate(pushed.object_quat, com)
        turning = torch.linalg.cross(pushed.object_angvel, arm)
        velocity = pushed.object_linvel + turning - free.object_linvel
        assert_close(velocity, expected, atol=0.01, rtol=0.02)

    def test_pushes_wait_for_the_gate_and_move_the_arms_targets(self):
        push = PushConfig(probability=(1.0, 1.0), object_velocity=0.5, arm_torque=0.5, when="gated")
        env = self.make(self.task(push=push))
        with patch.object(env.backend, "set_joint_targets") as sent:
            env.step(REST)
        pushes = env.variation.pushes
        self.assertFalse(pushes.force.any())
        share = tensor([joint.drive.kp / joint.drive.effort for joint in self.robot.joints])
        torque = (sent.call_args.args[0] - env.joint_target) * share
        self.assertTrue((torque[:, :3].abs() <= 0.5001).all() and (torque[:, :3] != 0).all())
        self.assertFalse(torque[:, 3:].any())
        pushes.gate.fill_(True)
        env.step(REST)
        self.assertGreater(pushes.force.norm(dim=-1).min(), 0.0)
        pushes.gate.fill_(True)
        env.reset(tensor([1]))
        self.assertEqual(pushes.gate.tolist(), [True, False, True])

    def test_forces_are_read_with_the_gain_of_the_episode(self):
        for (low, high), distinct in (((2.0, 3.0), N), ((1.0, 1.0), 1)):
            env = self.make(self.task(force_gain=(low, high)))
            contacts = env.backend.contacts()
            pressed = replace(contacts, tip_force=torch.full_like(contacts.tip_force, 0.1))
            with patch.object(env.backend, "contacts", lambda pressed=pressed: pressed):
                env.reset()
            force = env.get_observations()["proprio"][:, -6:]
            gain = force / (TASK.observation.proprio["tip_force"]["scale"] * 0.1)
            assert_close(gain, gain[:, :1].expand_as(gain))
            self.assertTrue((gain > low - 1e-5).all() and (gain < high + 1e-5).all())
            self.assertEqual(len(gain[:, 0].unique()), distinct)

    def test_without_randomization_each_object_has_its_own_mass_and_friction(self):
        """A pair's friction is the mean of its materials: of the object's own, or of the middle of the range."""
        self.objects = [
            replace(obj, mass=mass, friction=friction)
            for obj, mass, friction in zip(self.objects, (0.2, 0.6), (0.95, None), strict=True)
        ]
        slippery = replace(self.objects[1], friction=0.0)
        materials = {"elastomer": 0.8, "metal": 0.0, "table": 0.5}
        task = self.task(enabled=False, friction=(0.4, 0.8), **materials)
        for second, own in ((self.objects[1], 0.6), (slippery, 0.0)):
            self.objects[1] = second
            found = self.make(task).variation.parameters
            assert_close(found["object_mass"], tensor([0.2, 0.6, 0.2]))
            means = (tensor([0.95, own, 0.95])[:, None] + tensor(list(materials.values()))) / 2
            assert_close(found["friction"], means.clamp_min(0.05))

    def test_parameters_are_drawn_for_the_worlds_that_begin(self):
        wide = (0.5, 2.0)
        task = self.task(
            arm_stiffness=(0.5, 0.6),
            hand_damping=(2.0, 3.0),
            object_com=(0.01, 0.01),
            torsional_friction=wide,
            object_inertia=wide,
        )
        env = self.make(task)
        before = {name: value.clone() for name, value in env.variation.parameters.items()}
        with patch.object(env.backend, "set_where") as set_where:
            env.reset(tensor([2, 0]))
        mask, _, found = set_where.call_args.args
        self.assertEqual(mask.tolist(), [True, False, True])
        for name, value in before.items():
            same = (getattr(found, name) == value).view(N, -1).all(dim=1)
            self.assertEqual(same.tolist(), [False, True, False], name)
        self.assertTrue(torch.equal(found.object_gravity, env.gravity_fraction))
        mass = tensor([self.objects[i].mass for i in env.backend.object_index])
        for factor, low, high in (
            (found.object_mass / mass, 0.7, 1.3),
            (found.torsional_friction / env.backend.scene.friction.torsional, *wide),
            (found.object_inertia, *wide),
            (found.drives[:, 0, :3], 0.5, 0.6),
            (found.drives[:, 1, 3:], 2.0, 3.0),
            (found.drives[:, 2], 1.0, 1.0),
            (found.object_com.norm(dim=-1), 0.01, 0.01),
        ):
            self.assertTrue(((factor >= low - 1e-4) & (factor <= high + 1e-4)).all(), factor)
        self.assertNotIn("drives", self.make().variation.parameters)

    def test_an_engine_that_cannot_do_it_is_named(self):
        able = MujocoBackend.capabilities - {"drives", "object_com"}
        task = self.task(effort=(0.5, 1.0), object_com=(0.0, 0.01))
        with patch.object(MujocoBackend, "capabilities", able):
            self.make()
            words = "'mujoco' cannot set drives, object com in each world, which this task draws"
            self.assertRaisesRegex(CapabilityError, words, self.make, task)

    def test_a_step_with_all_of_it_never_waits_for_the_device(self):
        """As on a GPU, where any of these operations would stop the host until the device is done, and could not be captured."""
        live, published = (RECIPES[name].task for name in ("live", "published"))
        adaptive = replace(live, reset=replace(live.reset, adaptive_share=0.5))
        for task in (adaptive, published):
            env = self.make(task)
            waiting = Waiting()
            with patch.multiple(env._graphs, active=True, run=lambda part: part()):
                with patch.object(env.backend, "set_where"), waiting:
                    self.play(env, 1)
                self.assertGreater(waiting.operations, 500)
                self.assertEqual(waiting.found, [])
                with waiting:
                    # an engine on the CPU asks which worlds are reset: that must show
                    self.play(env, 1)
                self.assertEqual(waiting.found, ["aten.nonzero.default"])


class ObjectFrameTest(WithEnv, InFolder):
    """The same thing, drawn in another place and along other axes of its file."""

    TURN = Rotation.from_euler("xyz", (100, -35, 160), degrees=True)
    SHIFT = np.array([0.03, -0.12, 0.2])

    def loaded(self, mesh):
        path = self.folder / f"{SOUP}.obj"
        mesh.export(path, digits=12)
        return load_object(SOUP, self.folder)

    def moved_bank(self):
        """The bank with the poses that the moved mesh has where the other one was."""
        poses = {}
        for name in ("start", "goal", "object"):
            pos, quat = (f"{name}_{part}" for part in ("pos", "quat_wxyz"))
            turn = Rotation.from_quat(getattr(self.bank, quat), scalar_first=True)
            turn *= self.TURN.inv()
            poses[quat] = turn.as_quat(scalar_first=True).astype(np.float32)
            poses[pos] = (getattr(self.bank, pos) - turn.apply(self.SHIFT)).astype(np.float32)
        return replace(self.bank, **poses)

    def played(self, spec, bank, task):
        """Observations, rewards and actions of every step; the action is a function of the observations."""
        backend = MujocoBackend(make_scene(self.robot, (spec,), task), N, workers=0)
        self.addCleanup(backend.close)
        resets = ResetDistribution.of(bank, self.robot, (spec,), task)
        env = ManipulationEnv(backend, task, resets)
        found = []
        for _ in range(5):  # contact makes rounding grow from the seventh step on
            groups = sorted(env.get_observations().items())
            flat = torch.cat([value.flatten(1) for _, value in groups], dim=-1)
            weights = torch.randn(flat.shape[1], 7, generator=torch.Generator().manual_seed(0))
            action = torch.tanh(0.1 * flat @ weights)
            _, reward, *_ = env.step(action)
            found += [flat, action, reward]
        points = MetricPoints.of((spec,) * N, task.object_frame)
        metrics = EpisodeMetrics(env.reading(), env.task_goal_pos, env.goal_quat, points)
        return [
            *found,
            metrics.final_distance,
            metrics.final_position_error,
            metrics.final_angle,
            metrics._least_keypoint_distance,
        ]

    def test_the_frame_of_a_mesh_does_not_matter(self):
        live = RECIPES["live"].task
        terms = live.reward.terms | {f"{__name__}:lifted": {"weight": 100.0}}
        task = replace(
            live,
            distance_points=64,
            reward=replace(live.reward, terms=terms),
            randomization=RandomizationConfig(),
            reset=replace(live.reset, training_xy=0.05, random_gravity=True),
        )
        corners = default_rng(2).normal(size=(14, 3)) * (0.02, 0.03, 0.05)
        mesh = trimesh.convex.convex_hull(corners + np.array([0.0, 0.01, 0.05]))
        drawn = self.loaded(mesh)
        vertices = self.TURN.apply(mesh.vertices) + self.SHIFT
        moved = self.loaded(trimesh.Trimesh(vertices, mesh.faces, process=False))
        one = self.played(drawn, self.bank, task)
        other = self.played(moved, self.moved_bank(), task)
        for step, (a, b) in enumerate(zip(one, other, strict=True)):
            assert_close(a, b, atol=1e-4, rtol=1e-4, msg=lambda text, step=step: f"{step}: {text}")
        away, *_ = self.played(drawn, self.bank, replace(task, object_frame="mesh"))
        self.assertGreater((one[0] - away).abs().max(), 0.01)


class FailureTest(WithEnv):
    def test_leaving_at_the_time_limit_is_a_failure_not_a_time_out(self):
        env = self.make()
        env.episode_length_buf[:] = env.max_episode_length - 1
        state = env.backend.state()
        pos = state.object_pos.clone()
        pos[0, 2] = 2.0
        env.backend.set_state(replace(state, object_pos=pos))
        _, reward, done, extras = env.step(REST)
        self.assertEqual((done.tolist(), extras["time_outs"].tolist()), ([1] * N, [0.0, 1.0, 1.0]))
        self.assertAlmostEqual(reward[0], -5.0, delta=0.02)
        self.assertGreater(reward[1:].min(), -0.02)
        env = self.make(replace(TASK, object_frame="center"))
        env._center[1, 2] -= 0.5
        done = env.step(REST)[2]
        self.assertEqual(done.tolist(), [0, 1, 0], "the task's origin of the object is judged")

    def test_a_world_that_fails_ends_teaches_nothing_and_is_counted_once(self):
        """Whether its simulation breaks or its action is not finite; the other worlds go on."""
        env = self.make(kind=BreakableBackend)
        same = self.make()
        action = self.actions(1)[0]
        for count, value in enumerate((0.0, torch.nan, torch.inf), 1):
            bad = action.clone()
            bad[1, 3] = value
            env.backend.broken[1] = value == 0.0
            observations, reward, done, extras = env.step(bad)
            same.step(action)
            for told in (done, extras["faulty"], extras["time_outs"]):
                self.assertEqual(told.tolist(), [0, 1, 0])
            self.assertEqual(reward[1], 0.0)
            self.assertTrue(reward.isfinite().all())
            self.assert_finite(observations)
            self.assert_finite(extras["log"])
            self.assertEqual(extras["log"]["health/nonfinite_total"], count)
            self.assert_same(env.backend.state(), same.backend.state(), [0, 2])
        env.backend.overflow[1] = True  # dropped contacts, until the reset
        for world_ends in (True, False):
            _, reward, done, extras = env.step(action)
            self.assertEqual(done.tolist(), [0, world_ends, 0])
            self.assertEqual(extras["faulty"].tolist(), [False, world_ends, False])
        self.assertEqual((int(env.nonfinite_count), int(env.overflow_count)), (3, 1))
        self.assertNotEqual(reward[1], 0.0)


class RolloutTest(WithEnv):
    TASK = evaluation_task(TASK)

    def roll_out(self, policy, num_envs, backend=MujocoBackend, **options):
        def make(scene, num_worlds, object_index):
            return backend(scene, num_worlds, workers=0, object_index=object_index)

        objects = tuple(self.objects)
        parts = {"robot": self.robot, "objects": objects, "bank": self.bank, "task": self.TASK}
        trial = Trial(**parts, num_envs=num_envs, **options)
        return roll_out(policy, Engine(name="mujoco", make=make, version=""), trial, episodes=2)

    def test_every_demonstration_is_played_and_the_number_of_worlds_changes_nothing(self):
        one, found = (self.roll_out(ZeroPolicy(7), n) for n in (1, 6))
        self.assertEqual(
            [(e.sequence, e.repetition) for e in found.episodes],
            [*product(range(3), range(2))],
        )
        self.assertEqual([e.object for e in found.episodes], [SOUP, SOUP, SPAM, SPAM, SOUP, SOUP])
        self.assertEqual(found.episodes[2].sequence_name, "demo_b")
        shown = [(t.sequence, t.object) for t in found.traces]
        self.assertEqual(shown, [(0, SOUP), (1, SPAM), (2, SOUP)])
        trace = found.traces[0]
        self.assertEqual((trace.joint_pos.shape, trace.object_pos.shape), ((11, 7), (11, 3)))
        assert_allclose(np.diff(trace.time), 0.05)
        assert_allclose(trace.goal_pos, self.bank.goal_pos[0])
        self.assertGreater(found.control_steps_per_second, 0)
        self.assertEqual(one.episodes, found.episodes)
        for a, b in zip(one.traces, found.traces, strict=True):
            assert_array_equal(a.object_pos, b.object_pos)
            assert_array_equal(a.joint_pos, b.joint_pos)

    def test_each_repetition_has_a_start_of_its_own_and_the_seed_decides(self):
        class Watching(ZeroPolicy):
            def begin(self, env):
                # worlds: soup, soup, soup, soup, spam, spam
                self.seen = env.backend.state().object_pos.numpy().copy()

        def starts(**options):
            policy = Watching(7)
            self.roll_out(policy, 6, **options)
            return policy.seen

        found = starts()
        assert_array_equal(found, starts())
        # another seed, and the other repetition of each demonstration
        for difference in (found - starts(seed=1), found[0::2] - found[1::2]):
            self.assertGreater(np.abs(difference).max(axis=1).min(), 1e-4)
        away = np.abs(found - self.bank.start_pos[[0, 0, 2, 2, 1, 1]])
        self.assertTrue(0 < away[:, :2].max() <= 0.02 and away[:, 2].max() < 1e-6)

    def test_a_changed_friction_replaces_an_objects_own(self):
        """Else a sweep of the friction would change nothing for objects that state theirs."""
        seen = []

        class Watching(ZeroPolicy):
            def begin(self, env):
                seen.append(env.variation.parameters["friction"][:, 0].tolist())

        def make(scene, num_worlds, object_index):
            return MujocoBackend(scene, num_worlds, workers=0, object_index=object_index)

        def start(motion):
            return Watching(7)

        soup, spam = self.objects
        objects = (replace(soup, friction=0.3), spam)
        task = nominal_task(self.TASK)
        parts = {"robot": self.robot, "objects": objects, "bank": self.bank, "task": task}
        (friction,) = chosen_properties("object-friction")
        with TemporaryDirectory() as folder:
            play(
                PolicySpec(name="zero", start=start, robot=self.robot, task=TASK, folder=folder),
                Trial(**parts, num_envs=2),
                [Engine(name="mujoco", make=make, version="")],
                [Condition(task=task), friction.at(0.9, task)],
                Path(folder),
                episodes=1,
            )
        # of fingertips: the mean of the object's material and the elastomer, which has 0.8
        assert_allclose(seen[0], [(0.3 + 0.8) / 2, (0.75 + 0.8) / 2])
        assert_allclose(seen[-1], [(0.9 + 0.8) / 2] * 2)

    def test_a_world_that_breaks_down_is_reported_and_the_others_go_on(self):
        class BreaksOnce(BreakableBackend):
            steps = 0

            def step(self, substeps=None):
                super().step(substeps)
                BreaksOnce.steps += 1
                if BreaksOnce.steps == 10:
                    self.broken[0] = True

        found = self.roll_out(ZeroPolicy(7), 6, BreaksOnce)
        self.assertEqual([e.nonfinite for e in found.episodes], [True] + [False] * 5)
        self.assertTrue(all(np.isfinite(e.task_progress) for e in found.episodes))


class KinematicRetargetingTest(WithEnv):
    def test_plays_the_trajectory_at_its_own_speed_after_moving_there(self):
        self.robot = replace(self.robot, home_std=(0.0, 0.0))
        env = self.make(evaluation_task(replace(TASK, action=ActionConfig(arm_lead=10.0))))
        lengths = [7, 5, 6]
        rng = default_rng(0)
        low = env.actions.lower.numpy()
        high = env.actions.upper.numpy()
        shares = [0.5 + 0.02 * np.cumsum(rng.random((n, 7)), axis=0) for n in lengths]
        paths = [low + (high - low) * share for share in shares]
        for path in paths:
            path[:, :3] = 0.01 * path[:, :3] + 0.01  # the arm can follow
        retargeted = SimpleNamespace(
            joint_pos=np.concatenate(paths), frame_offsets=np.cumsum([0, *lengths]), fps=30.0
        )
        self.enterContext(patch("xreset.eval.baselines.LEAD_IN", 0.1))  # 6 control steps
        policy = KinematicRetargeting(retargeted)
        policy.begin(env)
        targets = []
        for _ in range(env.max_episode_length):
            env.advance(policy.act(env.get_observations()))
            targets.append(env.joint_target.numpy().copy())
        for world in range(N):
            path = paths[env.sequence[world]]
            found = np.stack(targets)[:, world]
            played = found[6 : 6 + 2 * len(path) : 2]  # 30 Hz frames at 60 Hz control
            for name, a, b in (
                ("path", played, path),
                ("it holds the last frame", found[-1], path[-1]),
                ("half of the lead-in", found[2], 0.5 * (0.01 + path[0])),
            ):
                assert_allclose(a, b, atol=1e-4, err_msg=name)
