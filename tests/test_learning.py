"""The model, the sequence storage, the export and the run folder; no physics."""

import copy
import json
import math
from dataclasses import asdict, replace
from unittest import TestCase, skipUnless
from unittest.mock import Mock, patch

import numpy as np
import torch
from numpy.testing import assert_allclose
from tensordict import TensorDict
from torch.testing import assert_close
from torch.utils._pytree import tree_flatten_with_path

from tests.data import InFolder, refuses
from tests.toy_training import CONFIG
from xreset import VisionConfig, robots
from xreset.errors import FileFormatError
from xreset.files.checks import from_dict, merged
from xreset.learning import distillation
from xreset.learning.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.distributed import Processes
from xreset.learning.export import exported
from xreset.learning.model import PointNetLstmModel, ReturnCritic
from xreset.learning.ppo import CLIP, SequencePpo
from xreset.policy.onnx_policy import OnnxPolicy, policy_contract
from xreset.task.config import (
    ObservationConfig,
    PushConfig,
    RandomizationConfig,
    ResetConfig,
    TaskConfig,
    TerminationConfig,
    TrackerConfig,
)

N = 3
T = 8
L = 4
A = 5
GROUPS = ("policy", "proprio", "perception")
SMALL = CONFIG.model


def observations(*batch, seed=0):
    g = torch.Generator().manual_seed(seed)
    widths = {"policy": (7,), "proprio": (9,), "perception": (5, 10, 3), "privileged": (4,)}
    return TensorDict(
        {k: torch.randn(*batch, *w, generator=g) for k, w in widths.items()}, batch_size=list(batch)
    )


def with_real_history(obs, first):
    """Observations [T, N] whose cloud histories are as an environment makes them: shifted by one per step, copies after a reset."""
    cloud = obs["perception"].clone()
    for t in range(len(cloud)):
        newest = cloud[t, :, -1:]
        if t:
            cloud[t] = torch.cat((cloud[t - 1, :, 1:], newest), dim=1)
        cloud[t] = torch.where(first[t][:, None, None, None], newest.expand_as(cloud[t]), cloud[t])
    obs["perception"] = cloud
    return obs


class ModelTest(TestCase):
    def test_the_gpu_s_lstm_is_the_library_s(self):
        """Here with a stand-in for its kernel."""

        def cell(inputs, recurrent, c, bias, recurrent_bias):
            i, f, g, o = (inputs + recurrent + bias + recurrent_bias).chunk(4, dim=-1)
            c = f.sigmoid() * c + i.sigmoid() * g.tanh()
            return o.sigmoid() * c.tanh(), c, None

        first = torch.zeros(T, N, dtype=torch.bool)
        first[[2, 6], [1, 0]] = True
        g = torch.Generator().manual_seed(0)
        states = tuple(torch.randn(2, 1, 2 * N, SMALL.lstm, generator=g))
        obs = with_real_history(observations(T, N), first)
        found = []
        for on_gpu, low in ((False, False), (True, False), (True, True)):
            torch.manual_seed(0)
            model = PointNetLstmModel(observations(N), GROUPS, A, SMALL, stochastic=True)
            pointnet = model.trunk.pointnet
            pointnet.use_bfloat16 = low
            with (
                patch.object(torch.Tensor, "is_cuda", on_gpu),
                patch.object(torch.ops.aten, "_thnn_fused_lstm_cell", cell),
                patch.object(
                    pointnet, "forward", lambda cloud, mlp=pointnet.mlp: mlp(cloud).amax(dim=-2)
                ),
            ):
                output = model(obs, masks=first, hidden_state=states)
                output.square().sum().backward()
            found.append((output.detach(), model.trunk.lstm.weight_ih_l0.grad))
        library, full, low = found
        assert_close(full, library)
        for value, expected in zip(low, library, strict=True):
            self.assertTrue(0.0 < float((value - expected).norm()) < 0.01 * float(expected.norm()))


def places(alg):
    """Return the addresses of the tensors that an update reads: a captured update always reads these addresses."""
    read = vars(alg.storage) | {"rate": alg._rate, "sums": alg._sums}
    del read["rewards"]  # an update reads the returns of the rewards
    read["observations"] = dict(alg.storage.observations.items())
    for name in ("actor", "critic"):
        read[name] = getattr(alg, name).state_dict()
    leaves, _ = tree_flatten_with_path(read)
    return {str(path): leaf.data_ptr() for path, leaf in leaves if isinstance(leaf, torch.Tensor)}


class StorageTest(TestCase):
    def bandit(self, normalize_returns, device="cpu", capture=True):
        """The algorithm, and the mean actions before and after three updates, on an environment whose reward is
        -|action - 0.5|. Without ``capture`` a GPU is given every kernel of an update by itself."""

        model = replace(SMALL, initial_std=0.5, normalize_returns=normalize_returns)
        config = TrainConfig(model=model, ppo=PpoConfig(horizon=8, minibatch_size=128))
        torch.manual_seed(0)
        obs = observations(64).to(device)
        alg = SequencePpo(obs, A, config, device, Processes())
        alg._graphs.active &= capture
        # a scene in which nothing moves
        obs["perception"] = obs["perception"][:, -1:].expand(-1, 5, -1, -1)
        before = alg.actor(obs).detach()
        alg.actor.reset()
        self.places = []
        for iteration in range(3):
            torch.manual_seed(iteration)
            with torch.no_grad():
                for _ in range(8):
                    actions = alg.act(obs)
                    reward = -(actions - 0.5).abs().mean(-1)
                    alg.process_env_step(obs, reward, torch.zeros(64, device=device), {})
                alg.compute_returns(obs)
            alg.update()
            self.places.append(places(alg))
        alg.actor.reset()
        return alg, before, alg.actor(obs).detach()

    def test_what_an_update_reads_stays_where_it_is(self):
        for normalize_returns in (False, True):
            self.bandit(normalize_returns)
            self.assertGreater(len(self.places[0]), 40)
            self.assertEqual(self.places[1], self.places[0])
            self.assertEqual(self.places[2], self.places[0])

    @skipUnless(
        torch.cuda.is_available(), "there is no CUDA device: updates are captured on GPUs only"
    )
    def test_a_captured_update_learns_what_a_plain_one_does(self):
        # Adam moves a weight by about the rate whatever its gradient's size, so that one whose sign hangs on the last bits of a kernel may
        # end 60 steps x 3e-4 away: 0.018. The adaptive rate multiplies that: a step more or less of it is a factor of 1.5.
        for normalize_returns in (False, True):
            (one, before, plain), (two, _, captured) = (
                self.bandit(normalize_returns, "cuda", capture) for capture in (False, True)
            )
            self.assertFalse(one._graphs._graphs)
            self.assertTrue(two._graphs._graphs)
            self.assertGreater((plain - before).abs().mean(), 0.05)
            assert_close(captured, plain, rtol=0.0, atol=5e-2)


class UpdateTest(TestCase):
    """One rollout of four worlds and its update, against the formulas written out."""

    WORLDS = 4
    FIRST = ([2, 3, 6, 6], [1, 0, 0, 2])
    """Steps, and worlds that begin an episode. The step before (2, 1) ends at its time limit; that before (3, 0) fails."""

    def algorithm(self, normalize_returns=False, *, adaptive=False, **ppo):
        """A learner; the rate stays as it is unless it is to be adaptive."""
        torch.manual_seed(0)
        model = replace(SMALL, initial_std=0.5, normalize_returns=normalize_returns)
        options = {"horizon": T, "sequence_length": L, "minibatch_size": 10**6, "mini_epochs": 1}
        config = TrainConfig(model=model, ppo=PpoConfig(**(options | ppo)))
        alg = SequencePpo(observations(self.WORLDS), A, config, "cpu", Processes())
        if not adaptive:
            self.enterContext(patch.object(alg, "_adapt_rate"))
        # some means lie beyond the bounds, on both sides
        alg.actor.mlp[-1].bias.data += torch.linspace(-2.0, 2.0, A)
        return alg

    def roll_out(self, alg, seed=0):
        """Fill the storage; return rewards and ends of episodes [T, 4], and the critic's last values [4, 1]."""
        first = torch.zeros(T + 1, self.WORLDS, dtype=torch.bool)
        first[self.FIRST] = True
        first[T, 3] = True
        obs = with_real_history(observations(T + 1, self.WORLDS, seed=seed), first)
        rewards = torch.randn(T, self.WORLDS, generator=torch.Generator().manual_seed(seed))
        time_outs, faulty = torch.zeros(2, T, self.WORLDS)
        time_outs[1, 1] = 1.0
        faulty[2, 0] = 1.0
        with torch.no_grad():
            for model in (alg.actor, alg.critic):
                model.reset()
            for t in range(T):
                alg.act(obs[t])
                extras = {"time_outs": time_outs[t], "faulty": faulty[t].bool()}
                alg.process_env_step(obs[t + 1], rewards[t], first[t + 1], extras)
            alg.compute_returns(obs[T])
            last = alg.critic(obs[T])
        return rewards, first[1:], last

    def test_returns_and_advantages(self):
        """Sums of discounted errors until the episode's end; the value of a time limit's state is bootstrapped."""
        discount = 0.9
        decay = 0.7
        with patch("xreset.learning.ppo.GAE_LAMBDA", decay):
            alg = self.algorithm(discount=discount)
        rewards, ends, last = self.roll_out(alg)
        values = torch.cat((alg.storage.values[..., 0], last.T)).double().numpy()
        rewards = rewards.double().numpy()
        rewards[1, 1] += discount * values[1, 1]
        advantages = np.zeros((T, self.WORLDS))
        for world in range(self.WORLDS):
            for start in range(T):
                weight = 1.0
                for t in range(start, T):
                    following = 0.0 if ends[t, world] else discount * values[t + 1, world]
                    error = rewards[t, world] + following - values[t, world]
                    # a faulty step teaches nothing
                    advantages[start, world] += weight * error * ((t, world) != (2, 0))
                    weight *= discount * decay
                    if ends[t, world]:
                        break
        assert_allclose(alg.storage.returns[..., 0], advantages + values[:T], atol=1e-5)
        normalized = (advantages - advantages.mean()) / advantages.std(ddof=1)
        normalized[2, 0] = 0.0
        assert_allclose(alg.storage.advantages[..., 0], normalized, atol=1e-5)

    def perturbed(self, alg, seed):
        """A rollout of another policy and critic, and copies of the networks."""
        self.roll_out(alg, seed)
        storage = alg.storage
        g = torch.Generator().manual_seed(10 + seed)
        storage.actions_log_prob += 0.4 * torch.randn(storage.actions_log_prob.shape, generator=g)
        storage.values += torch.randn(storage.values.shape, generator=g)
        return copy.deepcopy((alg.actor, alg.critic))

    def step_by_step(self, model, storage):
        """[T, 4, ...] outputs of a model along the rollout; gradients end with each sequence."""
        outputs = []
        zeros = torch.zeros(1, self.WORLDS, SMALL.lstm)
        model.reset(hidden_state=(zeros, zeros))
        for t in range(T):
            if t % L == 0:
                model.reset(hidden_state=tuple(part.detach() for part in model.state))
            outputs.append(model(storage.observations[t]))
            model.reset(storage.dones[t, :, 0])
        return torch.stack(outputs)

    def expected(self, models, storage, clip, unit):
        """The losses by name."""
        actor, critic = models
        mean = self.step_by_step(actor, storage)
        values = self.step_by_step(critic, storage)
        log_std = actor.distribution.log_std_param
        distance = (storage.actions - mean) / log_std.exp()
        log_prob = -(distance.square() / 2 + log_std + math.log(2 * math.pi) / 2).sum(dim=-1)
        ratio = (log_prob - storage.actions_log_prob[..., 0]).exp()
        advantage = storage.advantages[..., 0]
        gain = torch.minimum(ratio * advantage, ratio.clamp(1 - clip, 1 + clip) * advantage)
        change = (values - storage.values).clamp(-clip * unit, clip * unit)
        errors = [(v - storage.returns) / unit for v in (values, storage.values + change)]
        beyond = torch.where(mean > 1.1, mean - 1.1, torch.where(mean < -1.1, mean + 1.1, 0.0))
        return {
            "value": torch.maximum(errors[0].square(), errors[1].square()).mean(),
            "surrogate": -gain.mean(),
            "entropy": (log_std + math.log(2 * math.pi * math.e) / 2).sum(),
            "bounds": beyond.square().sum(dim=-1).mean(),
        }

    def test_gradients_are_those_of_the_weighted_losses(self):
        for limit in (1e3, 0.01):
            weights = {"value_loss": 0.7, "entropy": 0.02, "bounds_loss": 0.3}
            with patch("xreset.learning.ppo.GRAD_NORM", limit):
                alg = self.algorithm(learning_rate=1e-3, **weights)
            models = self.perturbed(alg, 0)
            losses = self.expected(models, alg.storage, CLIP, 1.0)
            signs = {"value": 0.7, "surrogate": 1.0, "entropy": -0.02, "bounds": 0.3}
            sum(weight * losses[name] for name, weight in signs.items()).backward()
            flat = alg.storage.observations.flatten(0, 1)
            # left over from another minibatch
            alg.actor.mlp[-1].bias.grad = torch.ones(A)
            alg.update()
            for model, own in zip((alg.actor, alg.critic), models, strict=True):
                gradients = [p.grad for p in own.parameters()]
                norm = float(torch.cat([grad.flatten() for grad in gradients]).norm())
                self.assertGreater(norm, 0.02)
                share = min(1.0, limit / norm)
                for found, grad in zip(model.parameters(), gradients, strict=True):
                    assert_close(found.grad, share * grad, rtol=1e-3, atol=1e-5 * share)
                for name, found in model.named_parameters():
                    moved = found - own.get_parameter(name)
                    # the first step of Adam
                    self.assertAlmostEqual(moved.abs().max(), 1e-3, delta=1e-5)
                seen = torch.cat([flat[group] for group in model.obs_groups], dim=-1)
                assert_close(model.trunk.normalizer.mean, seen.mean(dim=0))

    def test_losses_are_means_over_epochs_and_minibatches(self):
        """Also of later updates, and in units of the returns' deviation."""
        for normalize in (False, True):
            options = {"mini_epochs": 2, "minibatch_size": 16}
            alg = self.algorithm(normalize, learning_rate=1e-9, **options)
            self.assertEqual(alg.num_mini_batches, 2)
            seen = []
            for seed in (0, 1):
                models = self.perturbed(alg, seed)
                seen.append(alg.storage.returns.clone())
                unit = torch.cat(seen).std(unbiased=False) if normalize else 1.0
                with torch.no_grad():
                    expected = self.expected(models, alg.storage, CLIP, unit)
                found = alg.update()
                expected = {name: float(value) for name, value in expected.items()}
                assert_close(found, expected, rtol=1e-4, atol=1e-5)

    def test_an_adaptive_rate_follows_the_policy_s_change(self):
        """By how much the means move makes the divergence of two Gaussians: the change's square / (2 std^2), summed."""
        desired = 0.02
        for share, rate, expected in (
            (0.0, 1e-3, 1e-3),
            (0.45, 1e-3, 1.5e-3),
            (0.55, 1e-3, 1e-3),
            (1.95, 1e-3, 1e-3),
            (2.05, 1e-3, 1e-3 / 1.5),
            (2.05, 1.2e-5, 1e-5),
            (0.45, 9e-3, 1e-2),
        ):
            alg = self.algorithm(adaptive=True, desired_kl=desired)
            for processes in (1, 2):
                alg.learning_rate = rate
                alg.is_multi_gpu = processes > 1
                alg.gpu_world_size = processes
                self.roll_out(alg)
                mean, std = alg.storage.distribution_params
                mean += std * math.sqrt(2 * share * desired / A)
                with (
                    self.subTest(share=share, rate=rate, processes=processes),
                    # processes that are all alike
                    patch("torch.distributed.all_reduce", lambda total: total.mul_(2)),
                    patch.object(alg, "reduce_parameters"),
                ):
                    alg.update()
                    self.assertAlmostEqual(alg.learning_rate, expected, delta=1e-9)
                    self.assertEqual(alg.optimizer.param_groups[0]["lr"], alg.learning_rate)


class DistillationTest(TestCase):
    def test_a_student_that_is_its_teacher_has_nothing_to_learn(self):
        """Also where an episode ends within a rollout."""
        first = torch.zeros(T + 1, N, dtype=torch.bool)
        first[[2, 6], [1, 0]] = True
        obs = with_real_history(observations(T + 1, N), first)
        ppo = PpoConfig(horizon=T, sequence_length=L, minibatch_size=10**6, mini_epochs=1)
        config = TrainConfig(model=replace(SMALL, initial_std=0.1), ppo=ppo)
        with patch.multiple(distillation, OnnxPolicy=Mock(), network_of=Mock()):
            alg = distillation.SequenceDistillation(obs[0], A, config, "cpu", Processes(), Mock())
        alg.teacher = copy.deepcopy(alg.student)
        with torch.no_grad():
            for t in range(T):
                alg.act(obs[t])
                alg.process_env_step(obs[t + 1], torch.zeros(N), first[t + 1], {})
        self.assertLess(alg.update()["behavior"], 1e-10)
        alg.teacher.mlp[-1].bias.data += 3.0
        alg.act(obs[T])
        self.assertEqual(alg.transition.privileged_actions.unique().tolist(), [1.0])


class ReturnCriticTest(TestCase):
    def test_values_stay_when_their_unit_changes(self):
        torch.manual_seed(0)
        critic = ReturnCritic(observations(N), GROUPS, 1, SMALL)
        obs = observations(N)
        before = critic(obs)
        seen = []
        for shift in (0.0, 10.0, 10.0, 10.0):
            seen.append(
                3.0 * torch.randn(4000, generator=torch.Generator().manual_seed(0)) + 7.0 + shift
            )
            critic.take_returns(seen[-1], Processes())
            critic.reset()
            assert_close(critic(obs), before, atol=1e-4, rtol=1e-4)
            everything = torch.cat(seen)
            moments = (everything.mean(), everything.std(unbiased=False))
            assert_close((critic.return_mean, critic.return_std), moments)


class ExportTest(InFolder):
    def test_exported_equals_eager_over_50_steps(self):
        """With paired points, of which each has nine numbers; other tests export histories and images."""

        def seen(seed):
            points = torch.randn(4, 1, 10, 9, generator=torch.Generator().manual_seed(seed))
            return observations(4, seed=seed).update({"perception": points})

        model = PointNetLstmModel(seen(0), GROUPS, A, SMALL, stochastic=True)
        model.update_normalization(seen(9))
        task = TaskConfig(
            observation=ObservationConfig(
                cloud_points=10, perception={"paired_cloud": {"noise": 0.002, "scale": 1.0}}
            )
        )
        layout = {
            "policy": {"all": 7},
            "proprio": {"all": 9},
            "perception": {"paired_cloud": 10 * 9},
        }
        contract = policy_contract(robots.load("openarm"), task, ())
        file = self.folder / "policy.onnx"
        contract = replace(contract, observation_layout=layout, joint_names=tuple("abcde"))
        file.write_bytes(exported(model, contract))
        self.assertNotIn(
            b".py", file.read_bytes(), "nothing of the exporting machine is in the file"
        )
        policy = OnnxPolicy(file)
        with torch.no_grad():
            for t in range(50):
                assert_close(policy.act(seen(t)), model(seen(t)).clamp(-1, 1), atol=1e-5, rtol=0)
        begun = policy.another()
        begun.act(seen(1))
        with patch("xreset.policy.onnx_policy.check_contract"):
            begun.begin(Mock())
        first = OnnxPolicy(file).act(seen(0))
        for fresh in (policy.another(), begun):
            self.assertTrue(fresh.act(seen(0)).equal(first), "no episode remembers another")
        self.assertFalse(policy.act(seen(0)).equal(first))


class CheckpointTest(InFolder):
    def test_a_small_file_does_not_fill_the_memory(self):
        path = self.folder / "000001.pt"
        weights = {"weight": torch.zeros(1).expand(10**11)}
        counters = {"iteration": 1, "env_steps": 1, "elapsed": 0.1, "learning_rate": 1e-3}
        write_checkpoint(
            path,
            Checkpoint(actor_state_dict=weights, optimizer_state_dict={"state": {}}, **counters),
        )
        self.assertLess(path.stat().st_size, 10_000)
        with self.assertRaisesRegex(FileFormatError, "expected tensors of finite numbers"):
            read_checkpoint(path)


class ConfigTest(TestCase):
    def test_table_viii(self):
        ppo = PpoConfig()
        self.assertEqual((ppo.minibatches(4096), ppo.horizon, ppo.sequence_length), (2, 16, 4))
        # no minibatch has less than two worlds
        small = replace(ppo, minibatch_size=1)
        self.assertEqual([small.minibatches(worlds) for worlds in (1, 3, 8)], [1, 1, 4])

    def test_numbers_that_make_no_sense_are_refused(self):
        for make, options, problem in (
            (
                PpoConfig,
                {"sequence_length": 5},
                "sequence_length is 5, expected a divisor of the horizon, which is 16",
            ),
            (PpoConfig, {"discount": 1.01}, "discount is 1.01, expected a number from 0 to 1"),
            (PpoConfig, {"entropy": float("nan")}, "entropy is nan"),
            (PpoConfig, {"desired_kl": float("inf")}, "desired_kl is inf, expected .* finite"),
            (ModelConfig, {"initial_std": 0.0}, "initial_std is 0.0, expected a number above 0"),
            (
                TrainConfig,
                {"iterations": 1.5},
                "iterations is 1.5, expected a whole number above 0",
            ),
            (ModelConfig, {"initial_std": "1"}, "initial_std is '1', expected a number above 0"),
            (
                ResetConfig,
                {"random_gravity": "false"},
                "random_gravity is 'false', expected True or False",
            ),
            (ResetConfig, {"object_share": {"soup": "3"}}, "expected names of .* numbers above 0"),
            (ResetConfig, {"object_share": {"soup": 10**400}}, "expected .* numbers above 0"),
            (
                TaskConfig,
                {"termination": TerminationConfig(episode_seconds=0.01)},
                "episode_seconds is 0.01, expected a number from 0.0167, which is one control step, to 1,000,000",
            ),
            (ModelConfig, {"mlp": (64, 0)}, "mlp is .*expected one width or more"),
            (
                TaskConfig,
                {"object_frame": "centre"},
                "is 'centre', expected one of 'mesh', 'center'",
            ),
            (TaskConfig, {"reward": {"grasp": 2}}, "reward is {'grasp': 2}, expected RewardConfig"),
            (TrainConfig, {"task": None}, "task is None, expected TaskConfig"),
            (ObservationConfig, {"perception": {}}, "perception is {}, expected one term"),
            (VisionConfig, {"cameras": "front"}, "cameras is 'front', expected several of: Camera"),
            (
                RandomizationConfig,
                {"friction": (1.0, 0.5)},
                "friction is .1.0, 0.5., expected two finite numbers",
            ),
            (
                RandomizationConfig,
                {"tracker": TrackerConfig(jitter=1.0)},
                "changes observation_latency, which is 0",
            ),
            (PushConfig, {"probability": (0.0, 0.1)}, "expected two numbers above 0"),
            (PushConfig, {"probability": (0.1, 0.2, 0.3)}, "expected two numbers above 0"),
            (PpoConfig, {"horizon": 16.0}, "horizon is 16.0, expected a whole number above 1"),
            (PpoConfig, {"learning_rate": True}, "learning_rate is True, expected a number"),
            (ModelConfig, {"lstm": None}, "lstm is None, expected a whole number above 0"),
            (ModelConfig, {"mlp": (64.5,)}, "mlp is .64.5,., expected one width or more"),
            (TaskConfig, {"joint_slots": (7,)}, "joint_slots is .7,., expected two whole numbers"),
            (TaskConfig, {"joint_slots": (7, 0)}, "joint_slots is .*, expected two whole numbers"),
            (
                RandomizationConfig,
                {"friction": (0.5,)},
                "friction is .0.5,., expected two finite numbers",
            ),
            (
                ObservationConfig,
                {"policy": {"object_pos": {"noise": np.float32(0.1)}}},
                "expected terms: name -> parameter -> finite number or word",
            ),
        ):
            with refuses(self, problem, ValueError):
                make(**options)

    def test_values_are_kept_as_files_hold_them(self):
        """A run is continued if its configuration equals the one in run.json."""
        given = RandomizationConfig(friction=[0.5, 1.0], metal=np.float32(0.5))
        found = from_dict(RandomizationConfig, json.loads(json.dumps(asdict(given))))
        self.assertEqual(found, given)

    def test_removed_options_are_ignored_where_they_were_off(self):
        """Files of earlier versions hold them."""
        config = TrainConfig(task=TaskConfig(timestep=0.01))
        data = json.loads(json.dumps(asdict(config)))
        self.assertEqual(from_dict(TrainConfig, data), config)
        reset = {"frontier": 0.0, "frontier_over": "bank", "frontier_power": 1.0}
        reset |= {"frontier_rate": 0.1, "home_gravity_clip": 0.3, "home_noise": True}
        ends = {"object_low": -0.05, "object_high": 1.0, "margin": 0.1}
        clipping = {"clip": 0.2, "clip_values": True, "grad_norm": 1.0}
        removed = {
            "task": {
                "reset": reset,
                "termination": ends,
                "randomization": {"friction_buckets": 250},
                "action": {"hand_smoothing": 1.0, "hand_zero": "middle"},
                "vision": {"view": "depth", "goal_image": False},
            },
            "model": {"activation": "elu", "conv": [16, 32, 32]},
            "ppo": clipping | {"gae_lambda": 0.95, "schedule": "adaptive"},
            "schedule": {
                "faults": [],
                "demo_probability": [],
                "success_position": [],
                "teacher": [],
            },
            "random_episode_start": True,
            "target_success": None,
        }
        data = merged(data, removed)
        self.assertEqual(from_dict(TrainConfig, data), config)
        data["task"]["reset"]["frontier"] = 0.75
        data["model"]["synergy_std"] = 0.4
        with self.assertRaises(FileFormatError) as caught:
            from_dict(TrainConfig, data)
        for value in ("task.reset.frontier is 0.75", "model.synergy_std is 0.4"):
            self.assertIn(f"configuration.{value}. This option was removed;", str(caught.exception))
