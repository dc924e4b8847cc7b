"""Choosing among checkpoints: the best in its worst engine, what is played for it, and what the choice does afterwards."""

import json
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock, patch

from tests import toy_grasp, toy_results
from tests.command import refused, xreset
from tests.data import InFolder
from xreset import TaskConfig, evaluate, stress
from xreset.errors import FileFormatError, PolicyError, RunError
from xreset.eval.engines.attribution import attribute
from xreset.eval.select import candidates_in, select
from xreset.eval.setting import Setting
from xreset.learning.run import read_choice

SEED = 1_000_003
SCORES = {
    "300.pt": {"a": 0.90, "b": 0.60, "c": 0.80},
    "200.pt": {"a": 0.80, "b": 0.75, "c": 0.75},
    "100.pt": {"a": 0.95, "b": 0.95, "c": 0.70},
    "050.pt": {"a": 0.99, "b": 0.10, "c": 0.99},
}


class SelectTest(InFolder):
    def setUp(self):
        super().setUp()
        (self.folder / "checkpoints").mkdir()
        for name in SCORES:
            (self.folder / "checkpoints" / name).write_bytes(name.encode())
        self.demos = self.folder / "demos.npz"
        self.demos.write_bytes(b"demos")
        self.played: list[tuple[str, str, int]] = []

    def choose(self, **options):
        def load_policy(path, robot):
            self.assertEqual(robot, "my/robot", "the run's, which may be a folder")
            return SimpleNamespace(start=lambda motion: f"{path.stem}.pt")

        def load_trial(policy, demos, seed, **_):
            return SimpleNamespace(seed=seed, task=TaskConfig())

        def play(policy, trial, engine, conditions, *, episodes):
            name = policy.start(None)
            self.played.append((name, engine.name, trial.seed))
            return toy_results.swept([SCORES[name][engine.name]] * episodes, {}), ()

        def export(checkpoint, file):
            file.write_bytes(checkpoint.read_bytes())

        engines = [SimpleNamespace(name=name, version="1") for name in "abc"]
        run = SimpleNamespace(meshes=None, robot="my/robot")
        patches = {"load_policy": load_policy, "load_trial": load_trial, "play": play}
        patches |= {"export_checkpoint": export, "read_run": lambda folder: run}
        with patch.multiple("xreset.eval.select", **patches):
            return select(self.folder, engines, self.demos, Setting(seed=SEED), **options)  # pyright: ignore[reportArgumentType]

    def test_the_best_worst_engine_decides(self):
        choice = self.choose()
        self.assertEqual(choice, read_choice(self.folder))
        self.assertEqual({seed for *_, seed in self.played}, {SEED})
        self.assertEqual(
            choice.sentence(),
            "200.pt, 75.0 % in its worst engine (b), of 4 checkpoints in 3 engines; the newest, 300.pt, has 60.0 %.",
        )
        order = dict.fromkeys(SCORES, "")
        for name, played_in, _ in self.played:
            order[name] += played_in
        # where the best is worst comes first; one that cannot win is given up
        self.assertEqual(order, {"300.pt": "abc", "200.pt": "bca", "100.pt": "bc", "050.pt": "b"})
        with patch.dict(SCORES, {"100.pt": SCORES["200.pt"]}):
            self.assertEqual(self.choose().chosen, "200.pt", "of equals the newer one")

    def test_some_of_many_are_spread_over_all(self):
        names = [path.name for path in candidates_in(self.folder, 2)]
        self.assertEqual(names, ["300.pt", "050.pt"])
        self.assertEqual(len(candidates_in(self.folder, 9)), 4)
        self.assertRaisesRegex(RunError, "no checkpoint", candidates_in, self.folder / "nowhere", 2)

    def test_the_seed_of_the_selection_is_refused(self):
        choice = self.choose()
        policy = replace(toy_grasp.policy(), selection_seed=choice.seed)
        trial = Mock(seed=SEED)
        for measure in (
            lambda: evaluate(policy, self.demos, [], seed=SEED),
            lambda: stress(policy, self.demos, [], seed=SEED),
            lambda: attribute(policy, Mock(), Mock(), trial, self.folder, episodes=1),
        ):
            self.assertRaisesRegex(PolicyError, f"Seed {SEED} chose this checkpoint", measure)
        policy.check_seed(0)

    def test_the_choice_is_recorded_before_the_policy_is_replaced(self):
        policy = self.folder / "policy.onnx"
        policy.write_bytes(b"of the newest")
        interrupted = patch("xreset.eval.select.write_whole", side_effect=KeyboardInterrupt)
        with interrupted, self.assertRaises(KeyboardInterrupt):
            self.choose()
        self.assertEqual(read_choice(self.folder).chosen, "200.pt")
        self.assertEqual(policy.read_bytes(), b"of the newest")
        self.choose()
        self.assertEqual(policy.read_bytes(), b"200.pt")

    def test_the_command_takes_the_seed_of_the_starts(self):
        for words, seed in (((), SEED), (("--seed", 5), 5)):
            with patch("xreset.eval.select.select", side_effect=KeyboardInterrupt) as chosen:
                xreset("select", self.folder, "--demos", self.demos, "--engine", "mujoco", *words)
            self.assertEqual(chosen.call_args.args[3].seed, seed)
        told = refused("select", self.folder, "--demos", self.demos, "--seed", -1)
        self.assertIn("--seed is -1, expected a whole number from 0", told)

    def test_a_damaged_choice_is_refused(self):
        self.choose()
        file = self.folder / "choice.json"
        content = json.loads(file.read_text())
        for changes, problem in (
            ({"chosen": "7.pt"}, "chosen is '7.pt', expected one"),
            ({"seed": -1}, "seed is -1"),
        ):
            file.write_text(json.dumps(content | changes))
            self.assertRaisesRegex(FileFormatError, problem, read_choice, self.folder)
        self.assertIn(
            "--most is 0, expected",
            refused("select", self.folder, "--demos", self.demos, "--most", "0"),
        )
