"""Training from files to a policy on the MuJoCo C engine: run folder, resume, clean stop, export."""

import io
import json
import math
import multiprocessing
import os
import pty
import shutil
import signal
import sys
import threading
import time
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import asdict, replace
from itertools import count
from pathlib import Path
from unittest.mock import Mock, patch

import numpy as np
import onnx
import torch
from numpy.testing import assert_array_equal
from torch.testing import assert_close

from ci import ship_policies
from tests.command import calls_of, refused, succeeds
from tests.data import refuses
from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_goals import toy_goals
from tests.toy_training import CONFIG, OPTIONS, WithBank, quickly
from xreset import (
    OnnxPolicy,
    export_checkpoint,
    read_bank,
    robots,
    train,
    write_bank,
    write_goals,
)
from xreset.cli import main
from xreset.errors import FileFormatError, PolicyError, RunError, Stopped, XResetError
from xreset.eval.policy_spec import load_policy
from xreset.files.storage import claim, file_hash, write_json
from xreset.learning import verbs
from xreset.learning.checkpoint import load_moments, read_checkpoint
from xreset.learning.config import TrainConfig
from xreset.learning.exported import read_policy
from xreset.learning.recipes import RECIPES, own_terms_flags, starting_config
from xreset.learning.run import (
    checkpoints,
    latest_checkpoint,
    read_run,
)
from xreset.learning.runner import TrainingRunner, _stop_on_interrupt
from xreset.learning.train import cleanly, default_device, refuse_another_training
from xreset.physics.plugins import existing_device
from xreset.policy.onnx_policy import CHECKPOINT_KEY, check_contract
from xreset.task.config import RewardConfig

ONE = replace(CONFIG, iterations=1)


def newest(out):
    return read_checkpoint(latest_checkpoint(out))


def once_not_a_number(x, calls=count()):  # noqa: B008  counts the calls of all trainings
    return x.tip_distance[:, 0] * (math.nan if next(calls) == 2 else 1.0)


def exported_quickly(policy):
    """Export a policy of other weights in place of each checkpoint's, because an export takes seconds."""

    def export(actor, contract, *, checkpoint):
        model = onnx.load(policy)
        stated = {entry.key: entry.value for entry in model.metadata_props}
        onnx.helper.set_model_props(model, stated | {CHECKPOINT_KEY: file_hash(checkpoint)})
        return model.SerializeToString()

    return patch("xreset.learning.export.exported", export)


def work_in_a_terminal(file):
    """Print to the terminal until a request to stop comes, or for two seconds; write how many came, and end the process."""
    try:
        sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115  not the one that tests write to
        with _stop_on_interrupt(say=True) as requests:
            print("a line of progress", flush=True)
            file.write_text("ready")
            for _ in range(100):
                time.sleep(0.02)
                if requests:
                    break
            if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:
                print("a line of progress", flush=True)
        file.write_text(str(len(requests)))
        os._exit(0)
    finally:
        os._exit(1)


def run_command(words, printed):
    """Run a command in a fork, and write what it prints to a file."""
    torch.set_num_threads(1)  # the other threads are not in the fork
    with printed.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        main(words)


class TrainingTest(WithBank):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.out = cls.folder / "run"
        train(cls.bank, out=cls.out, config=CONFIG, **OPTIONS)

    def changed_run(self, out, **changes):
        """Change entries of run.json; returns the whole."""
        data = json.loads((out / "run.json").read_text())
        (out / "run.json").write_text(json.dumps(data | changes))
        return data

    def train(self, name, **changes):
        """Train a run of that name in the folder, without an export."""
        options = OPTIONS | {"bank": self.bank, "config": CONFIG} | changes
        with quickly():
            return train(out=self.folder / name, **options)

    def resume(self, out, **options):
        """Continue a run without an export; returns what it printed."""
        with quickly() as said:
            train(out=out, **options)
        return said.getvalue()

    def test_what_a_run_holds(self):
        info = read_run(self.out)
        self.assertEqual(info.config, CONFIG)
        self.assertEqual((info.engine, info.num_envs, info.seed), ("mujoco", 4, 3))
        self.assertEqual(
            (info.robot, info.resets, info.resets_hash),
            ("openarm", str(self.bank), file_hash(self.bank)),
        )
        self.assertEqual(info.contract.objects, (SOUP, SPAM))
        self.assertEqual(info.contract.joint_names, self.robot.joint_names)
        self.assertEqual([c.name for c in checkpoints(self.out)], ["000001.pt", "000002.pt"])
        self.assertTrue(list(self.out.glob("events.out.tfevents.*")))
        self.assertFalse([f for f in self.out.rglob("*") if f.name.endswith(".part")])
        content = newest(self.out)
        self.assertEqual((content.iteration, content.env_steps), (2, 2 * 8 * 4))

    def test_paths_are_found_from_another_working_directory(self):
        meshes = self.folder / "meshes"
        moved = self.folder / "runs" / "moved"
        for folder in (meshes, moved, self.folder / "openarm"):  # has the name of a robot
            folder.mkdir(parents=True)
        shutil.copy(self.out / "run.json", moved)
        self.changed_run(moved, resets="bank.npz")
        here = os.path.relpath(meshes, Path.cwd()) + "/"  # as stated, where it exists
        for stated, found in (("meshes", str(meshes.resolve())), ("gone", "gone"), (here, here)):
            self.changed_run(moved, meshes=stated)
            info = read_run(moved)
            expected = ("openarm", str(self.bank.resolve()), found)
            self.assertEqual((info.robot, info.resets, info.meshes), expected)
        self.changed_run(moved, robot="moved")  # the run has the robot's name
        robot = self.folder / "moved" / "robot.toml"
        robot.parent.mkdir()
        robot.touch()
        self.assertEqual(read_run(moved).robot, str(robot.parent.resolve()))

    def test_goals_need_no_demonstrations(self):
        """Every episode begins at home; fine-tuning continues with the run's networks and configuration; a bank keeps its
        states and gets the goals in addition."""
        goals = toy_goals(self.robot)
        write_goals(f"{self.folder}/goals.npz", goals)
        options = {"bank": None, "num_envs": 8}
        info = read_run(self.train("goals", goals=goals, **options))
        self.assertEqual((info.resets, info.robot), (f"{self.folder}/goals/goals.npz", "openarm"))
        self.assertEqual(
            (CONFIG.task.reset.demo_probability, info.config.task.reset.demo_probability),
            (0.5, 0.0),
        )
        file = self.folder / "goals.npz"
        tuned = self.train("tuned", goals=file, weights=self.out, config=None, **options)
        info = read_run(tuned)
        self.assertEqual(
            (info.config.model, info.config.iterations), (CONFIG.model, CONFIG.iterations)
        )
        self.assertEqual(info.weights, str(latest_checkpoint(self.out)))
        both = read_bank(read_run(self.train("both", goals=file)).resets)
        self.assertEqual(
            (both.num_states, len(both.sequence_name), both.object_names), (6, 7, (SOUP, SPAM))
        )
        assert_array_equal(both.goal_pos[3:], goals.goal_pos)

    def test_the_same_seed_gives_the_same_policy_and_resume_continues(self):
        one = newest(self.out)
        out = self.train("again")
        two = newest(out)
        assert_close(one.actor_state_dict, two.actor_state_dict)
        changed = newest(self.train("other", seed=4)).actor_state_dict
        self.assertTrue(
            any(not torch.equal(x, changed[name]) for name, x in one.actor_state_dict.items())
        )
        self.changed_run(out, resets="bank.npz")
        said = self.resume(out)
        self.assertEqual(read_run(out, as_stated=True).resets, "bank.npz", "not the path from here")
        self.assertIn(f"{out} is trained. To prolong the training, give more --iterations", said)
        said = self.resume(out, iterations=3)
        self.assertIn(f"policy after 3 iterations in {out / 'policy.onnx'}", said)
        after = newest(out)
        self.assertEqual((after.iteration, after.env_steps), (3, 3 * 8 * 4))
        self.assertGreater(after.elapsed, two.elapsed)
        self.assertEqual(read_run(out).total, 3)
        steps = {int(s["step"]) for s in after.optimizer_state_dict["state"].values()}
        self.assertEqual(
            steps, {3 * 2 * 2}, "iterations x epochs x minibatches: the optimiser went on"
        )

    def test_recipes_train(self):
        """The published one takes the longest steps through the network, so the network is small here."""
        for name in ("published", "live"):
            with self.subTest(name):
                base = RECIPES[name]
                small = replace(base.model, lstm=16)
                config = replace(
                    base, model=small, ppo=replace(base.ppo, mini_epochs=1), iterations=1
                )
                content = newest(self.train(f"recipe-{name}", config=config))
                self.assertEqual(
                    (content.iteration, content.env_steps), (1, 4 * config.ppo.horizon)
                )
                for value in content.actor_state_dict.values():
                    self.assertTrue(value.isfinite().all())

    def test_a_ctrl_c_that_arrives_twice_counts_once(self):
        with _stop_on_interrupt(say=True) as stop, patch("os.write") as written:
            self.assertFalse(stop)
            os.kill(os.getpid(), signal.SIGINT)
            os.kill(os.getpid(), signal.SIGTERM)
            self.assertEqual(len(stop), 2)
            written.assert_called_once()
            self.assertIn(b"stopping after this iteration", written.call_args.args[1])
            stop[0] = stop[0]._replace(time=stop[0].time - 60.0)
            with self.assertRaises(KeyboardInterrupt):
                os.kill(os.getpid(), signal.SIGINT)
                time.sleep(1.0)

    def test_a_run_that_is_stopped_has_a_checkpoint_and_can_go_on(self):
        """By Ctrl-C, or when its time is over."""
        out = self.folder / "stopped"

        def interrupt():
            while not list(out.glob("events.out.tfevents.*")):
                time.sleep(0.05)
            time.sleep(0.5)
            os.kill(os.getpid(), signal.SIGINT)

        threading.Thread(target=interrupt, daemon=True).start()
        endless = replace(CONFIG, iterations=100000, save_interval=100000)
        with self.assertRaises(Stopped) as raised:
            self.train("stopped", config=endless)
        self.assertEqual(raised.exception.number, signal.SIGINT)
        stopped = newest(out).iteration
        self.assertGreater(stopped, 0)
        self.assertEqual(latest_checkpoint(out).name, f"{stopped:06d}.pt")
        self.resume(out, minutes=(newest(out).elapsed * 1.1 + 0.1) / 60)
        done = newest(out).iteration
        self.assertGreater(done, stopped)
        self.assertIn(
            "is trained", self.resume(out), "it is continued with the minutes given before"
        )
        said = self.resume(out, minutes=newest(out).elapsed / 60)
        self.assertIn("is trained", said, "minutes are those of the whole training")
        self.resume(out, iterations=done + 1)
        self.assertEqual(newest(out).iteration, done + 1)

    def test_minutes_end_a_training_that_has_done_the_iterations_of_its_recipe(self):
        with patch("xreset.learning.runner.time", Mock(perf_counter=count().__next__)):
            out = self.train("minutes", config=ONE, minutes=0.1)  # an iteration takes 2 s
            self.assertEqual(newest(out).iteration, 3)
            self.assertIn("is trained", self.resume(out))
            self.assertIn("iteration 4/4, 0.1/1 min", self.resume(out, iterations=4, minutes=1.0))

    def test_the_default_gpu_is_the_one_that_cuda_means(self):
        """A run that began without a device goes on with ``--device cuda``."""
        self.assertEqual(default_device("mujoco-warp"), "cpu")
        with (
            patch("torch.cuda.is_available", return_value=True),
            patch("torch.cuda.device_count", return_value=2),
            patch("torch.cuda.current_device", return_value=0),
        ):
            self.assertEqual(default_device("mujoco-warp"), existing_device("cuda"))
            self.assertEqual(default_device("pybullet"), "cpu")

    def test_the_same_call_goes_on_and_another_one_is_refused(self):
        out = self.folder / "job-again"

        def again(**changes):
            return self.resume(out, **OPTIONS | {"bank": self.bank, "config": ONE} | changes)

        again()
        first = latest_checkpoint(out).read_bytes()
        self.assertIn("is trained", again())
        self.assertIn("continuing after iteration 1\n", again(config=CONFIG))
        self.assertEqual([c.name for c in checkpoints(out)], ["000001.pt", "000002.pt"])
        self.assertEqual((out / "checkpoints" / "000001.pt").read_bytes(), first)
        self.assertIn("is trained", again(iterations=2))
        other = self.folder / "other_bank.npz"
        write_bank(other, toy_bank(self.robot))
        slower = replace(ONE, ppo=replace(ONE.ppo, learning_rate=1e-5))
        observed = dict(ONE.task.observation.policy)
        del observed["goal_pos"]
        blind = replace(ONE.task, observation=replace(ONE.task.observation, policy=observed))
        terms = ONE.task.reward.terms | {"points": {"weight": 4.0, "zero": 0.5}}
        paid = replace(ONE.task, reward=replace(ONE.task.reward, terms=terms))
        for changes, problem in (
            ({"seed": 4}, "seed is 3 there and 4 here"),
            ({"num_envs": 5}, "num_envs is 4 there and 5 here"),
            ({"bank": other}, "hash of the reset bank is"),
            ({"weights": self.out}, "hash of the weights is None there"),
            ({"config": slower}, "ppo.learning_rate is .* there and 1e-05 here"),
            (
                {"config": replace(ONE, task=blind)},
                "task.observation.policy.goal_pos is {} there and None here",
            ),
            (
                {"config": replace(ONE, task=paid)},
                "task.reward.terms.points is None there and {'weight': 4.0",
            ),
        ):
            message = f"job-again holds another training: {problem}.*Choose another folder, or .*xreset train --out"
            with refuses(self, message, RunError, problem):
                again(**changes)
        present = read_run(out)
        with self.assertRaisesRegex(RunError, "robot is 'openarm' there and 'ur7e-sharpa' here"):
            refuse_another_training(out, present, replace(present, robot="ur7e-sharpa"), None)
        self.assertEqual(len(checkpoints(out)), 2)

    def test_the_same_call_goes_on_with_a_bank_that_has_no_file(self):
        out = self.folder / "in-memory"
        for _ in range(2):
            self.train("in-memory", bank=self.states, config=ONE)
        self.assertEqual(read_run(out).resets, str(out / "resets.npz"))
        with self.assertRaisesRegex(RunError, "hash of the reset bank"):
            self.train("in-memory", bank=toy_bank(self.robot), config=ONE)

    def test_a_command_that_is_stopped_exits_with_its_signal_and_the_same_one_finishes(self):
        out = self.folder / "job"
        words = (
            f"train --out {out} --resets {self.bank} --engine mujoco --device cpu --num-envs 4"
            f" --recipe {self.out} --iterations"
        ).split()
        printed = self.folder / "printed.txt"
        # a fork has imported everything
        fork = multiprocessing.get_context("fork").Process
        process = fork(target=run_command, args=([*words, "60"], printed))
        process.start()
        self.addCleanup(process.kill)
        while len(checkpoints(out)) < 2 and process.is_alive():
            time.sleep(0.05)
        process.terminate()
        process.join(120)
        said = printed.read_text()
        self.assertEqual(process.exitcode, 128 + signal.SIGTERM, said)
        done = newest(out).iteration
        self.assertLess(done, 60)
        self.assertIn("a checkpoint is written", said)
        self.assertTrue((out / "policy.onnx").is_file())
        with quickly() as again:
            main([*words, str(done + 1)])
        self.assertIn(f"continuing after iteration {done}\n", again.getvalue())
        self.assertEqual(newest(out).iteration, done + 1)

    def test_a_training_outlives_its_terminal(self):
        """The terminal closes: SIGHUP comes, and writing fails. With nohup it does not come."""
        for name, handler, requests in (
            ("closed", signal.SIG_DFL, "1"),
            ("nohup", signal.SIG_IGN, "0"),
        ):
            file = self.folder / name
            process, terminal = pty.fork()
            if process == 0:
                signal.signal(signal.SIGHUP, handler)
                work_in_a_terminal(file)
            while not file.exists() or file.read_text() != "ready":
                time.sleep(0.05)
            os.close(terminal)
            _, status = os.waitpid(process, 0)
            with self.subTest(name):
                self.assertEqual(
                    (os.waitstatus_to_exitcode(status), file.read_text()), (0, requests)
                )

    def test_a_recipe_may_be_a_file_of_the_users_own(self):
        path = self.folder / "mine.toml"
        path.write_text('extends = "live"\niterations = 7\nmodel.lstm = 64\n')
        live = RECIPES["live"]
        expected = replace(live, iterations=7, model=replace(live.model, lstm=64))
        self.assertEqual(starting_config(str(path)), expected)
        for text, problem in (
            ('extends = "nothing"', "extends is 'nothing'. Choose from: default"),
            ('replaces = ["task.nothing"]', "expected a list of names of tables"),
            ("replaces = 3", "expected a list of names of tables"),
            ("ppo.entropyy = 1.0", "mine.toml.ppo has wrong entries .unknown: entropyy"),
            (
                "ppo = 3",
                "mine.toml.ppo is 3, expected an object with the entries horizon, .*entropy",
            ),
            ('iterations = "many"', "iterations is 'many', expected"),
            ("x =", "is not valid TOML"),
        ):
            path.write_text(text)
            with refuses(self, problem, XResetError, text):
                starting_config(str(path))
        path.write_text("")
        self.assertEqual(starting_config(str(path)), RECIPES["default"])
        path.write_text('task.reward.terms."no_such_module:term".weight = 1.0')
        with redirect_stderr(io.StringIO()) as said:
            self.assertEqual(starting_config(str(path)).task.reward.own, {})
        self.assertIn("--config.task.reward.terms.no_such_module:term.weight=1.0", said.getvalue())

    def test_rates_of_success_of_demonstrations_are_kept(self):
        reset = replace(ONE.task.reset, adaptive_share=0.5)
        adaptive = replace(ONE, task=replace(ONE.task, reset=reset))
        out = self.train("adaptive", config=adaptive)
        rates = torch.tensor([0.25, 0.5, 1.0])
        content = torch.load(latest_checkpoint(out), weights_only=True)
        kept = {"resets_state_dict": {"success_rate": rates}}
        torch.save(content | kept, latest_checkpoint(out))
        self.resume(out, iterations=2)
        found = newest(out).resets_state_dict["success_rate"]
        assert_close(found, rates, rtol=0, atol=0.1)
        kept = {"resets_state_dict": {"success_rate": torch.ones(4)}}
        torch.save(content | kept, latest_checkpoint(out))
        with self.assertRaisesRegex(RunError, "000002.pt does not fit this run"):
            self.resume(out, iterations=3)
        del content["resets_state_dict"]  # as in earlier versions
        torch.save(content, latest_checkpoint(out))
        self.resume(out, iterations=3)
        found = newest(out).resets_state_dict["success_rate"]
        assert_close(found, torch.zeros(3), rtol=0, atol=0.1)

    def test_a_run_goes_on_at_the_share_that_was_done(self):
        """Stopped after two of many iterations, then resumed for as much time as it had taken."""
        out = self.train("halfway")
        progress = []
        with patch.object(TrainingRunner, "_let_teacher_lead", lambda _, x: progress.append(x)):
            self.resume(out, iterations=1000, minutes=2 * newest(out).elapsed / 60)
        self.assertGreater(progress[0], 0.5 - 1e-9)
        self.assertEqual(progress, sorted(progress))

    def test_a_configuration_starts_from_a_recipe_or_from_another_run(self):
        new = "train --robot openarm --resets bank.npz --out run"

        def parsed(arguments=""):
            with calls_of(verbs, "train") as calls:
                succeeds(new, arguments)
            return calls[0]["config"]

        self.assertEqual(parsed(), TrainConfig())
        self.assertEqual(RECIPES["default"], TrainConfig())
        live = parsed("--recipe live --config.ppo.entropy 0.001")
        self.assertEqual(
            (live.ppo.desired_kl, live.ppo.entropy, live.model.initial_std), (0.02, 0.001, 0.3)
        )
        without = replace(live.task, randomization=TrainConfig().task.randomization)
        ppo = replace(live.ppo, entropy=0.0)
        self.assertEqual(replace(live, task=without, ppo=ppo), RECIPES["any_object"])
        self.assertEqual(
            parsed(f"--recipe={self.out} --config.save-interval 7"),
            replace(CONFIG, save_interval=7),
        )
        for arguments, problem in (
            (
                "--recipe nothing",
                "no recipe, file, run folder or policy 'nothing'. Recipes: default, paper, any_object",
            ),
            ("--weights many-object", r"or policy 'many-object'.* \(--weights\): .*many-objects,"),
            (f"--recipe {self.folder}", "is not a run folder"),
        ):
            with self.subTest(arguments):
                self.assertRegex(refused(new, arguments), problem)

    def test_without_data_a_run_continues_as_it_was_started(self):
        """Its length may change; other options are not ignored."""
        for options, problem in (
            ("", ""),
            ("--iterations 2 --minutes 1", ""),
            ("--num-envs 8", "continues as it was started. Omit num_envs, give the whole command"),
            ("--seed=0", "Omit seed"),
            ("--recipe paper", "Omit recipe"),
            (f"--weights {self.out}", "Omit weights"),
            ("--config.ppo.horizon 16", "Omit config, .* or start another run"),
            ("--engine mujoco", "Omit engine"),
            ("--robot openarm", "Omit robot"),
            (f"--meshes {self.folder}", "Omit meshes"),
        ):
            with self.subTest(options):
                self.assert_resumed(f"train --out {self.out} {options}", problem)
        nothing = self.folder / "nothing"
        words = "needs a reset bank .*, a goal set .*, or both; .*nothing holds no run to continue"
        self.assert_resumed(f"train --out {nothing} --seed 0", words)
        self.assertFalse(nothing.exists())

    def test_a_number_of_iterations_that_has_passed_does_not_shorten_a_run(self):
        """The policy is exported where that is missing."""
        out = self.train("long")
        with redirect_stdout(io.StringIO()) as said, exported_quickly(self.out / "policy.onnx"):
            train(out=out, iterations=1)
        self.assertIn("is trained", said.getvalue())
        self.assertEqual(read_policy(out).content, (out / "policy.onnx").read_bytes())
        self.assertEqual(read_run(out).config, CONFIG)

    def test_an_own_term_that_is_not_finite_is_named(self):
        """Also if that was in one step of a rollout."""
        name = f"{__name__}:once_not_a_number"
        task = replace(CONFIG.task, reward=RewardConfig(terms={name: {"weight": 1.0}}))
        words = f"at iteration 0: privileged, reward. Do .* finite numbers \\({name}\\)"
        with self.assertRaisesRegex(RunError, words):
            self.train("not_a_number", config=replace(CONFIG, task=task))
        self.assertFalse((self.folder / "not_a_number").exists())

    def test_a_run_folder_does_not_decide_which_code_is_imported(self):
        """Reward terms of one's own are taken from the command line only."""
        code = self.folder / "code"
        code.mkdir()
        (code / "strangers_term.py").write_text(
            "def zero(x):\n    return x.tip_distance[:, 0] * 0\n"
        )
        sys.path.insert(0, str(code))
        self.addCleanup(sys.path.remove, str(code))
        stranger = self.folder / "stranger"
        shutil.copytree(self.out, stranger)
        own = {"strangers_term:zero": {"weight": 1.0}}
        config = asdict(CONFIG)
        config["task"]["reward"]["terms"] |= own
        self.changed_run(stranger, config=config)
        like = (
            f"--recipe {stranger} --robot openarm --resets {self.bank} --engine mujoco --device cpu "
            f"--num-envs 4 --iterations 1 --out {self.folder}"
        )
        resume = f"--out {stranger} --iterations 3"
        naming = "--config.task.reward.terms.strangers_term:zero.weight=1.0"

        def said(arguments):
            with quickly(), redirect_stderr(io.StringIO()) as text, suppress(SystemExit):
                main(["train", *arguments.split()])
            return text.getvalue()

        without = self.folder / "without"
        for arguments in (f"{like}/without", resume):
            self.assertIn(f"add {naming}", said(arguments))
        self.assertIn(f"add {naming} (in Python: to config).", said(resume))
        self.assertEqual(read_run(without).config.task.reward.own, {})
        self.assertEqual(len(checkpoints(stranger)), 2)
        self.assertNotIn("strangers_term", sys.modules)
        for arguments in (f"{like}/with", resume):
            with patch.object(TrainingRunner, "_agreed", return_value=True), quickly() as stopped:
                main(["train", *f"{arguments} {naming}".split()])
            out = arguments.partition("--out ")[2].split()[0]
            self.assertIn(f"To continue: xreset train --out {out} {naming}", stopped.getvalue())
            said(f"--out {out} {naming}")
        self.assertIn("strangers_term", sys.modules)
        self.assertEqual(read_run(f"{self.folder}/with").config.task.reward.own, own)
        self.assertEqual(len(checkpoints(stranger)), 3)
        number = own_terms_flags({"toy:term": {"weight": 0.1 + 0.2}}).split("=")[-1]
        self.assertEqual(float(number), 0.1 + 0.2)

    def test_a_run_begins_with_the_networks_of_another(self):
        given = latest_checkpoint(self.out)
        with patch("torch.optim.Adam.step"):  # the networks stay as they are
            out = self.train("onwards", config=ONE, weights=self.out)
        info = read_run(out)
        self.assertEqual((info.weights, info.weights_hash), (str(given), file_hash(given)))
        content = newest(out)
        before = read_checkpoint(given)
        # counters start at zero
        self.assertEqual((content.iteration, content.env_steps), (1, 8 * 4))
        runner = Mock(config=CONFIG, _load=read_checkpoint)
        TrainingRunner.load_networks(runner, given)
        self.assertEqual(runner.alg.learning_rate, before.learning_rate)  # the rate goes on
        for networks in ("actor_state_dict", "critic_state_dict"):
            for name, value in getattr(before, networks).items():
                if "normalizer" not in name:  # the critic's goes on to learn
                    assert_close(getattr(content, networks)[name], value, msg=name)
        count = "trunk.normalizer.count"
        seen = int(before.critic_state_dict[count])
        self.assertEqual(content.actor_state_dict[count], before.actor_state_dict[count])
        self.assertEqual(content.critic_state_dict[count], seen + 8 * 4)

    def test_a_run_that_is_stopped_before_it_learns_has_the_policy_that_it_began_with(self):
        config = replace(CONFIG, ppo=replace(CONFIG.ppo, average=0.5))
        with patch.object(TrainingRunner, "_agreed", return_value=True):
            out = self.train("at-once", config=config, weights=self.out)
        given = newest(self.out).policy_state_dict
        assert_close(newest(out).policy_state_dict, given, rtol=0, atol=0)

    def test_a_policy_that_ships_learns_on_from_its_checkpoint(self):
        self.enterContext(patch("xreset.policy.shipped.FOLDER", self.folder))
        shutil.copy(self.out / "policy.onnx", self.folder / "skilled.onnx")
        config = replace(starting_config("skilled"), iterations=1)
        self.assertEqual(config.task, CONFIG.task)
        options = {"config": config, "weights": "skilled"}
        self.assertRaisesRegex(PolicyError, "skilled holds no critic", self.train, "on", **options)
        network = self.folder / "skilled.onnx"
        file = self.folder / "skilled.pt"
        with patch.multiple(ship_policies, LARGE=0, SMALL=256):
            network.write_bytes(ship_policies.halved(network.read_bytes()))
            file.write_bytes(ship_policies.halved_checkpoint(self.out, network.read_bytes()))
        self.assertTrue(file.read_bytes().startswith(b"[["), "the policy has its weights")
        with patch("torch.optim.Adam.step"):  # the networks stay as they are
            content = newest(self.train("on", **options))
        info = read_run(self.folder / "on")
        self.assertEqual((info.weights, info.weights_hash), (str(file), file_hash(file)))
        before = newest(self.out)
        for networks, rtol in (("actor_state_dict", 1e-3), ("critic_state_dict", 4e-3)):
            for name, value in getattr(before, networks).items():
                if "normalizer" not in name:
                    found = getattr(content, networks)[name]
                    assert_close(found, value, rtol=rtol, atol=1e-4, msg=name)

    def test_the_policy_has_the_running_mean_of_the_weights(self):
        self.assertFalse(newest(self.out).average_state_dict, "no mean was asked for")
        config = replace(CONFIG, iterations=3, ppo=replace(CONFIG.ppo, average=0.5))
        out = self.train("average", config=config)
        self.resume(out, iterations=4)
        contents = [read_checkpoint(path) for path in checkpoints(out)]
        assert_close(contents[1].actor_state_dict, newest(self.out).actor_state_dict)
        expected = {}
        for t, content in enumerate(contents, start=1):
            weight = 1 / (1 + 0.5 * (t - 1))
            for name, value in content.actor_state_dict.items():
                earlier = expected.get(name, value)
                expected[name] = earlier + weight * (value - earlier)
                if name.endswith("normalizer.count"):
                    expected[name] = value
            assert_close(content.average_state_dict, expected)
        last = contents[-1].actor_state_dict
        self.assertTrue(any(not torch.equal(last[name], expected[name]) for name in last))
        with patch("xreset.learning.export.exported", return_value=b"") as export:
            export_checkpoint(latest_checkpoint(out), self.folder / "average.onnx")
        assert_close(export.call_args.args[0].state_dict(), expected)
        ships = self.folder / "average.pt"
        ships.write_bytes(ship_policies.halved_checkpoint(out, network=b""))
        begins = read_checkpoint(ships).actor_state_dict
        assert_close(begins, expected, rtol=1e-3, atol=1e-4, check_dtype=False)

    def test_a_run_without_a_mean_can_go_on_with_one(self):
        out = self.train("later")
        config = replace(CONFIG, iterations=3, ppo=replace(CONFIG.ppo, average=0.5))
        self.changed_run(out, config=asdict(config))
        before = newest(out).actor_state_dict
        self.resume(out)
        after = newest(out)
        name = "mlp.0.weight"
        middle = (before[name] + after.actor_state_dict[name]) / 2  # 1 / (1 + 0.5 * 2)
        assert_close(after.average_state_dict[name], middle)

    def test_the_policy_is_that_of_a_checkpoint_and_by_default_of_the_newest(self):
        out = self.folder / "exported"
        shutil.copytree(self.out, out)
        policy = out / "policy.onnx"
        contract = OnnxPolicy(policy).contract
        policy.unlink()
        self.enterContext(exported_quickly(self.out / "policy.onnx"))
        newest_policy = read_policy(out).content
        self.assertEqual(read_policy(out).contract, contract)
        self.assertFalse(policy.exists(), "loading writes nothing")
        names = ("000002.pt", "000001.pt")
        checkpoint = out / "checkpoints/000001.pt"
        first = read_policy(checkpoint).content
        self.assertNotEqual(first, newest_policy)
        spec = load_policy(checkpoint)
        self.assertEqual((spec.name, spec.content), ("exported-000001", first))
        self.assertEqual(spec.folder, out / "checkpoints/000001/eval")
        choice = {"chosen": "000001.pt", "candidates": [{"name": name} for name in names]}
        write_json(out / "choice.json", choice)  # of xreset 0.1 to 0.3
        self.assertEqual(read_policy(out).content, first)
        own = self.folder / "first.onnx"
        export_checkpoint(out / "checkpoints" / "000001.pt", own)
        self.assertEqual(own.read_bytes(), first)
        moved = shutil.copy(latest_checkpoint(out), self.folder)
        for checkpoint, target, problem in (
            (
                latest_checkpoint(out),
                "policy.pt",
                "^policy is 'policy.pt', expected a name that ends in .onnx",
            ),
            (out / "checkpoints" / "9.pt", own, "there is no .*9.pt .checkpoint"),
            (out, own, "is a folder or a device, expected a file .checkpoint"),
            (moved, own, "is not a run folder"),
        ):
            with refuses(self, problem, XResetError):
                export_checkpoint(checkpoint, target)
        policy.write_bytes(first)
        os.utime(latest_checkpoint(out), (2e9, 2e9))  # copied: its time says nothing
        with patch("xreset.learning.export.exported_checkpoint") as again:
            self.assertEqual(read_policy(out).content, first)
        again.assert_not_called()
        policy.write_bytes(first[:1000])
        self.assertEqual(read_policy(out).content, first, "a damaged file is not played")
        shutil.copy(out / "checkpoints" / "000002.pt", out / "checkpoints" / "000003.pt")
        self.assertNotEqual(
            read_policy(out).content, first, "the choice did not know the newest one"
        )

    def test_too_few_worlds_are_refused_before_objects_are_loaded(self):
        goals = self.folder / "goals.npz"
        write_goals(goals, toy_goals(self.robot))
        for data in ({}, {"goals": goals}, {"bank": None, "goals": goals}, {"bank": self.states}):
            with (
                self.subTest(data=data),
                patch("xreset.resets.inputs.load_objects") as loaded,
                self.assertRaisesRegex(XResetError, r"1 world cannot hold \d objects"),
            ):
                self.train("few", num_envs=1, **data)
            self.assertFalse(loaded.called, "cutting meshes takes minutes")
        self.assertFalse((self.folder / "few").exists())

    def test_what_cannot_be_trained_is_refused_and_leaves_no_run(self):
        cloud = {"cloud": {"frames": 3, "noise": 0.002, "scale": 1.0}}
        observation = replace(CONFIG.task.observation, perception=cloud)
        wide = replace(CONFIG, model=replace(CONFIG.model, lstm=16))
        bank = toy_bank(self.robot)
        empty = bank.with_states(np.zeros(6, dtype=bool))

        def with_task(**changes):
            return replace(CONFIG, task=replace(CONFIG.task, **changes))

        short = with_task(observation=observation)
        flat = replace(observation, perception={"object_pos": {"noise": 0.0}})
        double = replace(observation, policy=observation.policy | cloud)
        nothing = replace(observation, privileged={})
        before_contact = replace(CONFIG.task.reset, pre_contact_only=True)
        touching = bank.with_states(bank.post_contact)
        for words, options in (
            (
                "has 7 joints in its arm .* slots for 5 and 1",
                {"config": with_task(joint_slots=(5, 1))},
            ),
            ("perception has 'object_pos'. Surface", {"config": with_task(observation=flat)}),
            ("policy has 'cloud'. Surface points", {"config": with_task(observation=double)}),
            ("privileged has no terms", {"config": with_task(observation=nothing)}),
            (
                "no state before contact",
                {"config": with_task(reset=before_contact), "bank": touching},
            ),
            ("is not a run folder", {"weights": self.folder, "goals": toy_goals(self.robot)}),
            (r"{'lstm': 12}, .*{'lstm': 16}.*--recipe", {"weights": self.out, "config": wide}),
            (
                r"another observation layout .*--recipe .*run$",
                {"weights": self.out, "config": short},
            ),
            ("policy of the robot 'ur7e-sharpa', not of 'openarm'", {"weights": "many-objects"}),
            ("sees through cameras", {"weights": "many-objects-camera", "config": None}),
            (
                r"{'lstm': 12}, .*{'lstm': 16}",
                {"weights": self.out / "policy.onnx", "config": wide},
            ),
            ("onnx holds no critic.*Give the folder", {"weights": self.out / "policy.onnx"}),
            ("000002.pt is a file. Give the folder", {"weights": latest_checkpoint(self.out)}),
            (f"folder above has one: give {self.out}", {"weights": self.out / "checkpoints"}),
            ("Both recipe and config", {"recipe": "live"}),
            ("'mujoco' does not run on 'cuda'|can use 0 GPUs", {"device": "cuda"}),
            ("needs a reset bank .--resets., a goal set .--goals., or both", {"bank": None}),
            ("the goal set for 'ur7e-sharpa'", {"goals": toy_goals(robots.load("ur7e-sharpa"))}),
            (
                "different meshes of 005",
                {"goals": toy_goals(self.robot, object_sources=("abc", "stand-in"))},
            ),
            ("there is no teacher. Add --teacher, or", {"cameras": "front"}),
            ("bank is a goal set, .* Give it as goals", {"bank": toy_goals(self.robot)}),
            ("no state to reset to.*demo-probability 0", {"bank": empty}),
            ("reset bank for the robot 'openarm'", {"robot": "ur7e-sharpa"}),
        ):
            started = patch("xreset.learning.train.make_env", side_effect=AssertionError)
            with refuses(self, words, XResetError), started:
                self.train("refused", **options)
            self.assertEqual(list(self.folder.glob("refused/*.npz")), [], words)
        with patch.dict("sys.modules", {"wandb": None}), refuses(self, r"\[wandb\]", XResetError):
            self.train("refused", wandb="project")
        with (
            patch(
                "xreset.backends.mujoco.MujocoBackend.engine_version", side_effect=RunError("gone")
            ),
            self.assertRaisesRegex(RunError, "gone"),
        ):
            self.train("refused", bank=bank)
        self.assertFalse((self.folder / "refused").exists())
        (self.folder / "refused").mkdir()
        with (
            claim(self.folder / "refused"),
            self.assertRaisesRegex(XResetError, "nother (command|process) is writing"),
        ):
            self.train("refused", bank=bank)
        self.assertEqual([f for f in (self.folder / "refused").rglob("*") if f.is_file()], [])
        file = self.folder / "changing.npz"
        write_bank(file, bank)
        out = self.train("changed", bank=file, config=ONE)
        write_bank(file, empty)
        with self.assertRaisesRegex(RunError, "not the file that this run was started with"):
            self.resume(out, iterations=2)

    def test_an_exported_policy_keeps_the_order_of_its_observations(self):
        """A policy acts on columns: in another order it would see the goal where it was trained with the object."""
        trained = read_run(self.out).config.task
        contract = OnnxPolicy(self.out / "policy.onnx").contract
        terms = list(trained.observation.policy)
        self.assertNotEqual(terms, sorted(terms))
        for group in ("policy", "proprio", "perception", "privileged"):
            expected = list(getattr(trained.observation, group))
            self.assertEqual(list(getattr(contract.task.observation, group)), expected)
        self.assertEqual(list(contract.observation_layout["policy"]), terms)
        turned = dict(reversed(trained.observation.policy.items()))
        other = replace(trained, observation=replace(trained.observation, policy=turned))
        with self.assertRaisesRegex(PolicyError, "another order of observations"):
            check_contract("p.onnx", contract, self.robot, other)

    def test_a_run_whose_observations_meant_something_else_is_not_resumed(self):
        out = self.train("older", config=ONE)
        contract = self.changed_run(out)["contract"]
        terms = contract["observation_layout"]["policy"]
        _, terms["older"] = terms.popitem()
        self.changed_run(out, contract=contract)
        with self.assertRaisesRegex(PolicyError, "another observation layout .policy.older"):
            self.resume(out, iterations=2)

    def test_a_training_leaves_global_settings_as_they_were(self):
        self.addCleanup(torch.set_float32_matmul_precision, torch.get_float32_matmul_precision())
        torch.set_float32_matmul_precision("medium")
        torch.distributed.init_process_group(
            "gloo", store=torch.distributed.HashStore(), rank=0, world_size=1
        )
        self.addCleanup(torch.distributed.destroy_process_group)
        self.addCleanup(torch.set_num_threads, torch.get_num_threads())
        torch.set_num_threads(2)
        threads = []
        iterate = TrainingRunner._iterate

        def counted(runner, *parts):
            threads.append(torch.get_num_threads())
            return iterate(runner, *parts)

        with patch.object(TrainingRunner, "_iterate", counted):
            self.train("polite", config=ONE)
        self.assertEqual((threads, torch.get_num_threads()), ([1], 2))
        self.assertEqual(torch.get_float32_matmul_precision(), "medium")
        self.assertTrue(torch.distributed.is_initialized())

    def test_a_run_without_a_checkpoint_starts_again(self):
        """Killed before the first one: whether the same command is given again or only its folder, and whatever is left of the first."""

        def killed(runner, *total, minutes):
            runner.iteration = 1
            raise ZeroDivisionError

        for is_resumed in (True, False):
            with self.subTest(is_resumed=is_resumed):
                name = f"early-{is_resumed}"
                with (
                    patch.object(TrainingRunner, "learn", killed),
                    self.assertRaises(ZeroDivisionError),
                ):
                    self.train(name)
                out = self.folder / name
                (out / "events.out.tfevents.old").write_bytes(b"half")
                (out / ".xreset-abc.part").write_bytes(b"half")
                (out / "checkpoints" / ".xreset-abd.part").write_bytes(b"half")
                if is_resumed:
                    self.assertIn("starting from the beginning", self.resume(out))
                else:
                    self.train(name, seed=5)
                self.assertEqual(read_run(out).seed, 3 if is_resumed else 5)
                self.assertEqual(len(checkpoints(out)), 2)
                self.assertFalse(
                    [f.name for f in out.rglob("*") if f.name.endswith((".part", ".old", ".lock"))]
                )

    def test_too_little_memory_is_named(self):
        few = "4 worlds on cpu need more memory.*--num-envs"
        for error, wanted, said in (
            (torch.OutOfMemoryError("CUDA out of memory"), RunError, few),
            (RuntimeError("Failed to allocate 10 bytes on device 'cuda:0'"), RunError, few),
            (MemoryError(), RunError, few),
            (RuntimeError("cannot allocate a name"), RuntimeError, "a name"),
        ):
            broken = patch.object(TrainingRunner, "learn", side_effect=error)
            with broken, refuses(self, said, wanted, error):
                self.train("memory")

    def test_many_worlds_on_a_cpu_are_warned_of(self):
        stopped = patch("xreset.learning.train.run_training", side_effect=RunError("stopped"))
        for worlds, warned in ((300, True), (4, False)):
            said = io.StringIO()
            with stopped, redirect_stderr(said), self.assertRaisesRegex(RunError, "stopped"):
                self.train(f"worlds{worlds}", num_envs=worlds)
            self.assertEqual("--num-envs 8" in said.getvalue(), warned)

    def test_worlds_that_do_not_divide_into_minibatches_are_named(self):
        info = replace(read_run(self.out), device="cuda", config=TrainConfig())
        for worlds, words in ((4097, "Take 4,096 worlds"), (4096, "^$")):
            with (
                redirect_stderr(io.StringIO()) as said,
                cleanly(self.out, replace(info, num_envs=worlds)),
            ):
                self.assertRegex(said.getvalue(), words)

    def test_a_damaged_checkpoint_is_named(self):
        file = self.folder / "000009.pt"
        file.write_bytes(latest_checkpoint(self.out).read_bytes()[:1000])
        with self.assertRaisesRegex(FileFormatError, "cannot be read as a checkpoint"):
            read_checkpoint(file)
        good = torch.load(latest_checkpoint(self.out), weights_only=True)
        actor, critic, adam = (
            good[f"{name}_state_dict"] for name in ("actor", "critic", "optimizer")
        )
        for key, wrong in (
            ("iteration", "3"),
            ("iteration", -1),
            ("learning_rate", math.inf),
            ("actor_state_dict", []),
            ("actor_state_dict", actor | {"mlp.0.bias": "x"}),
            ("critic_state_dict", critic | {"later": torch.tensor(math.nan)}),
            (
                "optimizer_state_dict",
                adam | {"state": {0: {"step": torch.ones(()), "exp_avg": None}}},
            ),
            ("optimizer_state_dict", adam | {"state": []}),
            ("resets_state_dict", {"success_rate": torch.tensor([0.5, math.nan])}),
        ):
            torch.save(good | {key: wrong}, file)
            words = rf"(?s){file.name}\.{key} is .*, expected "
            with refuses(self, words, FileFormatError, key):
                read_checkpoint(file)
        optimizer = torch.optim.Adam([torch.zeros(2, requires_grad=True)])
        three = torch.zeros(3)
        moments = {"step": torch.ones(()), "exp_avg": three, "exp_avg_sq": three}
        with self.assertRaisesRegex(ValueError, r"exp_avg has shape \(3,\), expected \(2,\)"):
            load_moments(optimizer, {0: moments})

    def test_a_run_of_another_configuration_is_named(self):
        out = self.folder / "foreign"
        shutil.copytree(self.out, out)
        good = self.changed_run(out)
        config = asdict(CONFIG)
        config["task"]["action"]["gripper"] = 1.0
        contract = good["contract"] | {"joint_names": 3}
        for words, changes in (
            (r"config\.task\.action.*unknown: gripper", {"config": config}),
            ("num_envs is -5", {"num_envs": -5}),
            ("contract.joint_names is 3", {"contract": contract}),
            (
                r"\(of xreset '9.9'\).*unknown: later.*\nIt was written by xreset '9.9'.* Update xreset",
                {"later": 1, "xreset": "9.9"},
            ),
        ):
            self.changed_run(out, **good | changes)
            with refuses(self, words, FileFormatError):
                read_run(out)
