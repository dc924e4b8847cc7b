"""Two processes train together on the CPU, job scripts start them, and what a process finds out about itself."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from textwrap import dedent
from unittest import TestCase, mock

import torch
from torch.testing import assert_close

from tests.command import started
from tests.data import InFolder
from tests.toy_training import WithBank
from xreset.learning.distributed import Processes
from xreset.learning.recipes import starting_config
from xreset.learning.run import checkpoints

ROOT = Path(__file__).resolve().parents[1]
SMALL = (
    "--config.task.observation.cloud-points 16 --config.task.distance-points 64 --config.model.pointnet 8 6 "
    "--config.model.lstm 12 --config.model.mlp 16 --config.ppo.horizon 8 --config.ppo.mini-epochs 2 "
    "--config.model.normalize-returns --config.ppo.minibatch-size 32 --config.save-interval 1 "
    "--config.task.reset.adaptive-share 0.5"
)


class TwoProcesses(WithBank):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.out = cls.folder / "run"
        new = f"--robot openarm --resets {cls.bank} --engine mujoco --device cpu --num-envs 8 --seed 3"
        first = f"--out {cls.out} --iterations 2 {new} {SMALL}"
        second = f"--out {cls.out} --iterations 40"
        command = [sys.executable, "tests/train_worker.py", str(cls.folder), first, second]
        environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900
        )
        if done.returncode:
            raise AssertionError(f"it ended with {done.returncode}:\n{done.stdout}\n{done.stderr}")
        cls.output = done.stdout
        cls.first = cls.ends("first")
        cls.second = cls.ends("second")

    @classmethod
    def ends(cls, name):
        """What the two processes of a training end with."""
        files = [cls.folder / f"{name}-{rank}.pt" for rank in (0, 1)]
        return [torch.load(file, weights_only=True) for file in files]

    def test_both_learn_the_same_from_other_episodes(self):
        for one, two in (self.first, self.second):
            for model in (
                "actor",
                "critic",
            ):  # weights, and the normalisers' mean, variance and count
                assert_close(one[model], two[model], rtol=0, atol=0, msg=model)
            self.assertEqual(one["learning_rate"], two["learning_rate"])
            self.assertFalse(torch.equal(one["policy_obs"], two["policy_obs"]))
            self.assertFalse(torch.equal(one["random"], two["random"]))
        steps = 2 * 8 * 8  # processes x horizon x worlds
        count = next(
            value for name, value in self.first[0]["actor"].items() if name.endswith("count")
        )
        self.assertEqual(count, 2 * steps)
        self.assertEqual(
            [end["env_steps"] for end in (*self.first, *self.second)],
            [2 * steps] * 2 + [3 * steps] * 2,
        )
        for before, after in zip(self.first, self.second, strict=True):
            assert_close(before["actor"], after["start_actor"], rtol=0, atol=0)

    def test_demonstrations_have_the_same_rates_of_success_in_both(self):
        """The processes begin with rates of 0 and 1; a resumed run begins with those of the checkpoint."""
        one, two = self.first
        assert_close(one["success_rate"], two["success_rate"], rtol=0, atol=0)
        assert_close(one["success_rate"], torch.full((3,), 0.5), rtol=0, atol=0.2)
        for end in self.second:
            assert_close(end["start_success_rate"], one["success_rate"], rtol=0, atol=0)

    def test_the_main_process_alone_writes(self):
        # one for each training
        self.assertEqual(len([*self.out.glob("events.out*")]), 2)
        self.assertEqual((self.out / "policy.onnx").read_text(), "0")
        self.assertEqual(self.output.count("continuing after iteration 2"), 1)

    def test_a_request_to_one_process_stops_both_after_the_same_iteration(self):
        self.assertEqual([end["stopped_by"] for end in self.second], [None, signal.SIGTERM])
        self.assertEqual(
            [c.name for c in checkpoints(self.out)], ["000001.pt", "000002.pt", "000003.pt"]
        )


SCRIPTS = ROOT / "examples" / "cluster"
TOOLS = {
    "xreset": f'#!/bin/bash\nexec {sys.executable} -m xreset "$@"\n',
    "torchrun": f'#!/bin/bash\nexec {sys.executable} -m torch.distributed.run "$@"\n',
    "scontrol": '#!/bin/bash\n[ "$1" = show ] && echo localhost || echo "$*" >> "$REQUEUED"\n',
    # two nodes; like the original, it passes SIGTERM on
    "srun": """#!/bin/bash
        trap 'kill -TERM $nodes' TERM
        for node in 1 2; do "$@" & nodes="$nodes $!"; done
        code=0
        for node in $nodes; do
          while kill -0 "$node" 2> /dev/null; do wait "$node" || code=$?; done
        done
        exit $code
    """,
}
"""What a cluster has, on one machine."""
STAND_IN = """
    import os, signal, sys, time
    from pathlib import Path

    def stop(*_):
        file.write_text(file.read_text() + " stopped")
        sys.exit(143)

    train, option, out, *others = sys.argv[1:]
    assert (train, option) == ("train", "--out")
    file = Path(out + "-" + os.environ["RANK"])
    signal.signal(signal.SIGTERM, stop)
    file.write_text(os.environ["WORLD_SIZE"] + " " + "|".join(others))
    time.sleep(60)
"""
"""In place of the package: a training that notes its arguments and that it was asked to stop."""


class ScriptsTest(InFolder):
    """The job scripts, with stand-ins of Slurm's commands."""

    def setUp(self):
        super().setUp()
        self.requeued = self.folder / "requeued"
        tools = self.folder / "bin"
        tools.mkdir()
        for name, text in TOOLS.items():
            (tools / name).write_text(dedent(text))
            (tools / name).chmod(0o755)
        self.tools = tools
        own = {"SLURM_JOB_ID": str(os.getpid()), "SLURM_NNODES": "2", "SLURM_GPUS_ON_NODE": "1"}
        own |= {"SLURM_JOB_NODELIST": "a,b", "REQUEUED": str(self.requeued), "OMP_NUM_THREADS": "1"}
        self.environment = os.environ | own | {"PATH": f"{tools}:{os.environ['PATH']}"}
        self.environment["PYTHONPATH"] = str(ROOT)

    def start(self, script, *arguments):
        command = ("bash", SCRIPTS / script, *arguments)
        return self.enterContext(started(*command, cwd=self.folder, env=self.environment))

    def test_two_nodes_find_each_other_and_stop_in_time(self):
        package = self.folder / "stand-in" / "xreset"
        package.mkdir(parents=True)
        (package / "__init__.py").touch()
        (package / "__main__.py").write_text(dedent(STAND_IN))
        self.environment["PYTHONPATH"] = str(package.parent)
        out = self.folder / "nodes"
        job = self.start("train_many.slurm", out, "--resets", "a b.npz")
        told = [out.with_name(f"nodes-{rank}") for rank in (0, 1)]
        while not all(file.exists() for file in told) and job.poll() is None:
            time.sleep(0.05)
        job.send_signal(signal.SIGTERM)
        said = job.communicate()[0]
        self.assertNotEqual(job.returncode, 0, said)
        self.assertEqual(self.requeued.read_text(), f"requeue {os.getpid()}\n", said)
        for file in told:
            self.assertEqual(file.read_text(), "2 --resets|a b.npz stopped")

    def test_a_training_that_was_stopped_is_queued_again_and_a_failed_one_is_not(self):
        (self.tools / "srun").write_text('#!/bin/bash\necho "$*"\nexit "$CODE"\n')
        for code, queued in ((0, False), (1, False), (137, False), (143, True)):
            self.environment["CODE"] = str(code)
            self.requeued.unlink(missing_ok=True)
            job = self.start("train.slurm", "runs/soup", "--resets", "a b.npz")
            said = job.communicate()[0]
            with self.subTest(code):
                self.assertEqual(said, "xreset train --out runs/soup --resets a b.npz\n")
                self.assertEqual((job.returncode, self.requeued.exists()), (code, queued))

    def test_the_container_has_the_versions_of_the_lock(self):
        container = (SCRIPTS / "Dockerfile").read_text()
        setup = (ROOT / "ci" / "_venv.sh").read_text()
        [torch_version] = set(re.findall(r"torch==[0-9.]+[0-9]", container))
        self.assertIn(f"install {torch_version}\n", setup)
        self.assertIn("--no-deps --require-hashes -r", container)
        [version] = re.findall(r"FROM python:3\.([0-9]+)-", container)
        self.assertIn(f"COPY ci/locks/py3{version}.txt", container)
        self.assertTrue((ROOT / "ci" / "locks" / f"py3{version}.txt").is_file())

    def test_the_recipe_of_the_example_is_one(self):
        config = starting_config(str(SCRIPTS / "mine.toml"))
        self.assertEqual((config.save_interval, config.model.lstm), (200, 512))


class Environment(TestCase):
    def test_what_a_process_knows(self):
        alone = Processes.of_environment()
        self.assertEqual(
            (alone, alone.is_main, alone.device("cuda"), alone.seed(5)),
            (Processes(), True, "cuda", 5),
        )
        with mock.patch.dict(os.environ, {"RANK": "5", "LOCAL_RANK": "1", "WORLD_SIZE": "8"}):
            fifth = Processes.of_environment()
        self.assertEqual(
            (fifth.is_main, fifth.device("cuda:0"), fifth.device("cpu")), (False, "cuda:1", "cpu")
        )
        self.assertNotEqual(fifth.seed(0), alone.seed(0))
