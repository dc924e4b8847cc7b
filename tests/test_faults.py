"""Worlds that break: they are kept, counted and not learned from, and a run with too many of them ends with what they were like."""

import tempfile
import unittest
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_robot import toy_hand_arm
from xreset.env import ManipulationEnv, make_scene
from xreset.errors import RunError
from xreset.faults import FaultRecorder
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig, rsl_rl_config
from xreset.learning.faults import MAX_SHARE, WINDOW, FaultBudget
from xreset.learning.ppo import SequencePpo
from xreset.learning.run import checkpoints
from xreset.learning.runner import TrainingRunner
from xreset.objects.catalogue import load_objects
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import ObservationConfig, TaskConfig

try:
    from xreset.backends.mujoco import MujocoBackend
except ImportError as error:
    raise unittest.SkipTest(str(error)) from error

N = 4
CONFIG = TrainConfig(
    task=TaskConfig(observation=ObservationConfig(cloud_points=16), distance_points=64),
    model=ModelConfig(pointnet=(8, 6), lstm=12, mlp=(16,)),
    ppo=PpoConfig(horizon=8, mini_epochs=2, minibatch_size=16),
    iterations=3,
    save_interval=1,
)


class FaultyBackend(MujocoBackend):
    """An engine whose worlds break when they are told to, until they are set again."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.nonfinite, self.overflow = (torch.zeros(self.num_worlds, dtype=torch.bool) for _ in range(2))
        self.plan: dict[int, tuple[str, int]] = {}
        """Number of the step -> which of the two, and the world."""
        self.steps = 0

    def step(self, substeps=None):
        super().step(substeps)
        self.steps += 1
        if self.steps in self.plan:
            kind, world = self.plan[self.steps]
            getattr(self, kind)[world] = True

    def set_state(self, state, worlds=None):
        for broken in (self.nonfinite, self.overflow):
            broken[slice(None) if worlds is None else worlds] = False
        super().set_state(state, worlds)

    def state(self):
        state = super().state()
        return replace(state, object_pos=torch.where(self.nonfinite[:, None], torch.nan, state.object_pos))

    def health(self):
        health = super().health()
        return replace(health, nonfinite=health.nonfinite | self.nonfinite, overflow=health.overflow | self.overflow)


class Recorder(unittest.TestCase):
    def record(self, recorder: FaultRecorder, faulty: list[bool], start: float) -> None:
        n = len(faulty)
        values = {"world": torch.arange(n), "pose": start + torch.arange(n * 6.0).view(n, 2, 3)}
        recorder.record(torch.tensor(faulty), values)

    def make(self) -> FaultRecorder:
        return FaultRecorder({"world": (), "pose": (2, 3)}, torch.device("cpu"))

    def test_empty(self):
        arrays = self.make().arrays()
        self.assertEqual((arrays["world"].shape, arrays["pose"].shape), ((0,), (0, 2, 3)))

    def test_faults_are_kept_in_order(self):
        recorder = self.make()
        self.record(recorder, [False, True, True], 100)
        self.record(recorder, [False, False, False], 200)
        self.record(recorder, [True, False, False], 300)
        arrays = recorder.arrays()
        np.testing.assert_array_equal(arrays["world"], [1, 2, 0])
        np.testing.assert_array_equal(arrays["pose"][:, 1, 2], [100 + 6 + 5, 100 + 12 + 5, 300 + 5])

    def test_the_oldest_make_room(self):
        recorder = self.make()
        for i in range(recorder.CAPACITY + 3):
            self.record(recorder, [False, True], 100.0 * i)
        pose = recorder.arrays()["pose"][:, 0, 0]
        np.testing.assert_array_equal(pose, 100.0 * np.arange(3, recorder.CAPACITY + 3) + 6)

    def test_more_at_once_than_there_is_room_for(self):
        recorder = self.make()
        self.record(recorder, [True] * (recorder.CAPACITY + 50), 0.0)
        arrays = recorder.arrays()
        np.testing.assert_array_equal(arrays["world"], np.arange(recorder.CAPACITY))
        np.testing.assert_array_equal(arrays["pose"][:, 0, 0], 6.0 * np.arange(recorder.CAPACITY))


class Budget(unittest.TestCase):
    def test_the_share_of_a_window(self):
        budget = FaultBudget(1000)
        self.assertAlmostEqual(budget.allowed, MAX_SHARE * WINDOW * 1000)
        self.assertIsNone(budget.add(150, 50))
        self.assertRegex(budget.add(1, 0) or "", "151 worlds were not finite and 50 dropped .* 0.1%")

    def test_old_faults_are_forgotten(self):
        budget = FaultBudget(1000)
        budget.add(200, 0)
        for _ in range(WINDOW - 1):
            self.assertIsNone(budget.add(0, 0))
        self.assertIsNone(budget.add(0, 200))


class WithEnv(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = toy_hand_arm(cls.folder)
        cls.objects = load_objects((SOUP, SPAM))
        home = np.tile(cls.robot.home, (6, 1)).astype(np.float32)
        cls.bank = toy_bank(cls.robot, joint_pos=home)

    def make(self, plan: dict[int, tuple[str, int]]) -> ManipulationEnv:
        backend = FaultyBackend(make_scene(self.robot, self.objects, CONFIG.task), N, workers=0)
        self.addCleanup(backend.close)
        backend.plan = plan
        torch.manual_seed(0)
        return ManipulationEnv(
            backend, CONFIG.task, ResetDistribution(self.bank, self.robot, (SOUP, SPAM), CONFIG.task.reset), seed=0
        )


class Environment(WithEnv):
    def test_a_fault_is_kept_with_what_came_before(self):
        env = self.make({3: ("nonfinite", 2)})
        action = torch.full((N, 7), 0.3)
        for _ in range(2):
            env.step(action)
        before = env.backend.state()
        gravity = env.gravity_fraction.clone()
        sequence = env.sequence.clone()
        before = replace(before, joint_pos=before.joint_pos.clone(), object_pos=before.object_pos.clone())
        *_, extras = env.step(action)
        self.assertEqual(extras["faulty"].tolist(), [False, False, True, False])
        kept = env.faults.arrays()
        self.assertEqual(
            (kept["world"].tolist(), kept["episode_step"].tolist()), ([2.0], [2.0])
        )  # two steps were done before
        np.testing.assert_allclose(kept["before_joint_pos"][0], before.joint_pos[2])
        np.testing.assert_allclose(kept["before_object_pos"][0], before.object_pos[2])
        self.assertTrue(np.isnan(kept["after_object_pos"][0]).all())
        self.assertTrue(np.isfinite(kept["after_joint_pos"][0]).all())
        np.testing.assert_allclose((kept["gravity_fraction"][0], kept["sequence"][0]), (gravity[2], sequence[2]))
        self.assertGreater(kept["object_mass"][0], 0)
        moved = kept["target"][0] - kept["before_joint_target"][0]
        np.testing.assert_allclose(
            moved[:3], 0.3 * CONFIG.task.action.arm_step, atol=1e-6
        )  # the arm's first three joints

    def test_a_world_that_drops_contacts_begins_anew_and_is_counted_once(self):
        env = self.make({2: ("overflow", 1)})
        _, _, done, _ = env.step(torch.zeros(N, 7))
        self.assertEqual(done.tolist(), [0] * N)
        _, reward, done, extras = env.step(torch.zeros(N, 7))
        self.assertEqual((done.tolist(), extras["time_outs"].tolist()), ([0, 1, 0, 0], [0.0, 1.0, 0.0, 0.0]))
        self.assertTrue(bool(reward.isfinite().all()))
        _, _, done, extras = env.step(torch.zeros(N, 7))
        self.assertEqual((done.tolist(), extras["faulty"].any().item()), ([0] * N, False))
        self.assertEqual((int(env.overflow_count), int(env.nonfinite_count)), (1, 0))


class Learning(unittest.TestCase):
    def updated(self, faulty_reward: float, *, marked: bool) -> dict[str, torch.Tensor]:
        """Weights after one update in which world 1's step 2 had that reward, and was the last of its episode."""

        class Nothing:
            num_envs = N
            num_actions = 3
            device = "cpu"

        def observations(seed: int) -> TensorDict:
            g = torch.Generator().manual_seed(seed)
            widths = {"policy": (7,), "proprio": (9,), "perception": (1, 10, 3), "privileged": (4,)}
            return TensorDict({k: torch.randn(N, *w, generator=g) for k, w in widths.items()}, batch_size=[N])

        torch.manual_seed(0)
        alg = SequencePpo.construct_algorithm(
            observations(0), Nothing(), rsl_rl_config(CONFIG, N) | {"multi_gpu": None}, "cpu"
        )
        with torch.no_grad():
            for t in range(8):
                alg.act(observations(t))
                reward = torch.linspace(-1, 1, N)
                done = torch.zeros(N)
                faulty = torch.zeros(N, dtype=torch.bool)
                if t == 2:
                    reward[1] = faulty_reward
                    done[1] = 1.0
                    faulty[1] = marked
                alg.process_env_step(observations(t + 1), reward, done, {"time_outs": done * 0, "faulty": faulty})
            alg.compute_returns(observations(8))
        torch.manual_seed(1)
        alg.update()
        return alg.actor.state_dict() | {f"critic.{k}": v for k, v in alg.critic.state_dict().items()}

    def test_nothing_is_learned_from_a_faulty_step(self):
        one = self.updated(0.0, marked=True)
        two = self.updated(1000.0, marked=True)
        for name, value in one.items():
            torch.testing.assert_close(value, two[name], rtol=0, atol=0, msg=name)

    def test_without_the_mark_it_would_be(self):
        one = self.updated(0.0, marked=False)
        two = self.updated(1000.0, marked=False)
        self.assertTrue(any(not torch.equal(value, two[name]) for name, value in one.items()))


class Run(WithEnv):
    def train(self, name: str, plan: dict[int, tuple[str, int]]) -> tuple[TrainingRunner, Path]:
        folder = self.folder / name
        runner = TrainingRunner(self.make(plan), CONFIG, folder)
        with redirect_stdout(StringIO()):
            runner.learn(CONFIG.iterations)
        return runner, folder

    def test_few_faults_do_no_harm(self):
        runner, folder = self.train("few", {5: ("nonfinite", 0), 6: ("overflow", 3), 20: ("nonfinite", 1)})
        self.assertEqual(runner.iteration, 3)
        for name, value in runner.alg.actor.state_dict().items():
            self.assertTrue(bool(value.isfinite().all()), name)
        self.assertFalse(list(folder.glob("faults*")))

    def test_too_many_end_the_run_with_what_they_were_like(self):
        plan = {
            step: ("nonfinite" if step % 2 else "overflow", step % N) for step in range(9, 17)
        }  # all in the second iteration
        self.assertGreater(len(plan), FaultBudget(8 * N).allowed)
        with self.assertRaisesRegex(RunError, "4 worlds were not finite and 4 dropped contacts.*faults.npz.*--resume"):
            self.train("many", plan)
        with np.load(self.folder / "many" / "faults.npz", allow_pickle=False) as file:
            self.assertEqual(str(file["schema"]), "xreset-faults/1")
            self.assertIn('"horizon": 8', str(file["meta"]))
            np.testing.assert_array_equal(file["world"], [step % N for step in plan])
            np.testing.assert_array_equal(
                np.isnan(file["after_object_pos"]).all(axis=1), [step % 2 == 1 for step in plan]
            )
            self.assertTrue(np.isfinite(file["before_object_pos"]).all())
            self.assertEqual(file["before_joint_pos"].shape, (8, len(self.robot.joints)))
            self.assertEqual(file["joint_names"].tolist(), list(self.robot.joint_names))
            self.assertEqual(int(file["iteration"]), 1)
        self.assertEqual([c.name for c in checkpoints(self.folder / "many")], ["000001.pt"])


if __name__ == "__main__":
    unittest.main()
