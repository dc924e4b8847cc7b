"""Training from files to a policy on the MuJoCo C engine: run folder, resume, clean stop, export."""

import json
import os
import signal
import tempfile
import threading
import time
import unittest
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from tests.toy_bank import SOUP, SPAM, toy_bank
from xreset import robots
from xreset.errors import FileFormatError, RunError
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.run import checkpoints, latest_checkpoint, read_run
from xreset.learning.runner import read_checkpoint
from xreset.learning.train import ensure_policy, load_inputs, resumed, start_run, train
from xreset.policy import OnnxPolicy, check_contract
from xreset.resets.bank import write_bank
from xreset.task.config import ObservationConfig, TaskConfig

try:
    import xreset.backends.mujoco  # noqa: F401
except ImportError as error:
    raise unittest.SkipTest(str(error)) from error

CONFIG = TrainConfig(
    task=TaskConfig(observation=ObservationConfig(cloud_points=16), distance_points=64),
    model=ModelConfig(pointnet=(8, 6), lstm=12, mlp=(16,)),
    ppo=PpoConfig(horizon=8, mini_epochs=2, minibatch_size=16),
    iterations=2,
    save_interval=1,
)


class TrainingTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.folder = Path(folder.name)
        cls.robot = robots.load("openarm")
        home = np.tile(cls.robot.home, (6, 1)).astype(np.float32)
        cls.bank = cls.folder / "bank.npz"
        write_bank(cls.bank, toy_bank(cls.robot, joint_pos=home), config={}, inputs={})
        cls.out = cls.folder / "run"
        cls.info = cls.start(cls.out)
        train(cls.out, cls.info)

    @classmethod
    def start(cls, out, **changes):
        inputs = load_inputs(changes.pop("robot", "openarm"), changes.pop("resets", cls.bank), None)
        options = {"backend": "mujoco", "device": "cpu", "num_envs": 4, "seed": 3, "config": CONFIG, "out": out}
        return start_run(inputs, **(options | changes))

    def test_the_run_says_how_it_was_made(self):
        info = read_run(self.out)
        self.assertEqual(info, self.info)
        self.assertEqual(info.config, CONFIG)
        self.assertEqual(info.contract["objects"], [SOUP, SPAM])
        self.assertEqual(info.contract["joint_names"], list(self.robot.joint_names))

    def test_checkpoints_and_curves_are_written(self):
        self.assertEqual([c.name for c in checkpoints(self.out)], ["000001.pt", "000002.pt"])
        self.assertTrue(list(self.out.glob("events.out.tfevents.*")))
        self.assertFalse([f for f in self.out.rglob("*") if f.name.endswith(".part")])
        content = read_checkpoint(latest_checkpoint(self.out))
        self.assertEqual((content["iteration"], content["env_steps"]), (2, 2 * 8 * 4))

    def test_the_policy_fits_the_robot_and_acts(self):
        policy = OnnxPolicy(self.out / "policy.onnx")
        check_contract("policy", policy.contract, self.robot, CONFIG.task)

    def test_the_same_seed_gives_the_same_policy(self):
        again = self.folder / "again"
        train(again, self.start(again))
        one, two = (read_checkpoint(latest_checkpoint(run))["actor_state_dict"] for run in (self.out, again))
        for name, value in one.items():
            torch.testing.assert_close(value, two[name], msg=name)
        other = self.folder / "other"
        train(other, self.start(other, seed=4))
        changed = read_checkpoint(latest_checkpoint(other))["actor_state_dict"]
        self.assertTrue(any(not torch.equal(value, changed[name]) for name, value in one.items()))

    def test_resume_continues_where_it_stopped(self):
        out = self.folder / "resumed"
        train(out, self.start(out))
        before = read_checkpoint(latest_checkpoint(out))
        train(out, resumed(out, iterations=3), resume=True)
        after = read_checkpoint(latest_checkpoint(out))
        self.assertEqual((after["iteration"], after["env_steps"]), (3, 3 * 8 * 4))
        self.assertGreater(after["elapsed"], before["elapsed"])
        self.assertEqual(read_run(out).config.iterations, 3)
        steps = [int(s["step"]) for s in after["optimizer_state_dict"]["state"].values()]
        self.assertEqual(set(steps), {3 * 2 * 2})  # iterations x epochs x minibatches: the optimiser was not started anew

    def test_ctrl_c_ends_after_an_iteration_with_a_checkpoint_and_a_policy(self):
        out = self.folder / "stopped"
        info = self.start(out, config=replace(CONFIG, iterations=100000, save_interval=100000))

        def interrupt():
            while not list(out.glob("events.out.tfevents.*")):
                time.sleep(0.05)
            time.sleep(0.5)
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        train(out, info)
        content = read_checkpoint(latest_checkpoint(out))
        self.assertGreater(content["iteration"], 0)
        self.assertEqual(latest_checkpoint(out).name, f"{content['iteration']:06d}.pt")
        self.assertTrue((out / "policy.onnx").is_file())

    def test_a_policy_that_is_missing_is_exported_from_the_checkpoint(self):
        out = self.folder / "exported"
        train(out, self.start(out))
        made = OnnxPolicy(out / "policy.onnx")
        (out / "policy.onnx").unlink()
        again = OnnxPolicy(ensure_policy(out))
        self.assertEqual(made.contract, again.contract)

    def test_a_run_is_never_overwritten(self):
        with self.assertRaisesRegex(RunError, "holds a run already.*--resume"):
            self.start(self.out)

    def test_a_bank_without_states_needs_p_zero(self):
        empty = self.folder / "empty.npz"
        write_bank(empty, toy_bank(self.robot).select(sequences=np.zeros(3, dtype=bool)), config={}, inputs={})
        with self.assertRaisesRegex(RunError, "no state to reset to.*demo-probability 0"):
            self.start(self.folder / "none", resets=empty)
        self.assertFalse((self.folder / "none").exists())

    def test_a_bank_that_has_changed_is_refused(self):
        bank = self.folder / "changing.npz"
        write_bank(bank, toy_bank(self.robot), config={}, inputs={})
        out = self.folder / "changed"
        info = self.start(out, resets=bank)
        write_bank(bank, toy_bank(self.robot, post_contact=np.zeros(6, dtype=bool)), config={}, inputs={})
        with self.assertRaisesRegex(RunError, "not the file that this run was started with"):
            train(out, info)

    def test_a_bank_for_another_robot_is_refused(self):
        with self.assertRaisesRegex(FileFormatError, "reset bank for the robot 'openarm'"):
            self.start(self.folder / "none", robot="ur7e-sharpa")

    def test_a_damaged_checkpoint_is_named(self):
        file = self.folder / "000009.pt"
        file.write_bytes(latest_checkpoint(self.out).read_bytes()[:1000])
        with self.assertRaisesRegex(RunError, "cannot be read as a checkpoint"):
            read_checkpoint(file)

    def test_a_run_of_another_configuration_is_named(self):
        data = json.loads((self.out / "run.json").read_text())
        data["config"]["task"]["action"]["gripper"] = 1.0
        out = self.folder / "foreign"
        out.mkdir()
        (out / "run.json").write_text(json.dumps(data))
        with self.assertRaisesRegex(FileFormatError, r"config\.task\.action.*unknown: gripper"):
            read_run(out)


if __name__ == "__main__":
    unittest.main()
