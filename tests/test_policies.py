"""Policies as files, and found by the name under which they ship."""

import contextlib
import os
import shutil
import tempfile
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from unittest import mock

import numpy as np
import torch

from tests.command import refused, succeeds
from tests.data import InOneFolder, refuses
from tests.toy_bank import SOUP
from tests.toy_policy import write_policy
from xreset import load_policy, robots
from xreset.errors import PolicyError
from xreset.eval.policy_spec import default_policy
from xreset.physics.plugins import robot_folder
from xreset.policy import shipped
from xreset.policy.onnx_policy import OnnxPolicy, observation_shapes, policy_contract
from xreset.task.config import ObservationConfig, TaskConfig, TerminationConfig

TASK = TaskConfig(
    observation=ObservationConfig(
        cloud_points=8, perception={"cloud": {"frames": 2, "noise": 0.002, "scale": 1.0}}
    ),
    termination=TerminationConfig(episode_seconds=0.5),
    distance_points=32,
)


class WithPolicy(InOneFolder):
    """A policy of the OpenArm in a folder of its own."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.contract = asdict(policy_contract(robots.load("openarm"), TASK, (SOUP,)))
        cls.file = write_policy(cls.folder / "written.onnx", cls.contract)


class OnnxPolicyTest(WithPolicy):
    def test_what_an_environment_does_not_give_is_refused(self):
        policy = OnnxPolicy(self.file)
        seen = torch.zeros(2, 9)
        for observations, words in (
            ({}, r"observations\['policy'\] is None, expected a tensor \[N, ...\]"),
            ({"policy": seen.numpy()}, r"observations\['policy'\] is array"),
            ({"policy": seen, "proprio": seen[0]}, r"observations\['proprio'\] is tensor"),
        ):
            with refuses(self, words, PolicyError):
                policy.act(observations)

    def test_what_cannot_act_is_refused_before_work_begins(self):
        """One step with zeros at loading: whatever the graph is like, evaluation meets no surprise."""
        path = self.folder / "tried.onnx"
        OnnxPolicy(write_policy(path, self.contract))
        layout = self.contract["observation_layout"] | {"policy": {"x": -1}}
        negative = {"observation_layout": layout}
        partial = {name: value for name, value in self.contract.items() if name != "robot"}
        for words, changes in (
            ("numbers that are not finite", {"value": np.nan}),
            ("numbers that are not finite", {"state": "Log"}),
            (r"gives \['float32 \(2, 3\)', ", {"actions": 3}),
            ("cannot act", {"lstm": "width"}),
            ("cannot act", {"lstm": 10**11}),
            ("cannot act", {"outputs": 2}),
            ("nested too deeply", {"metadata": '{"a": ' + "[" * 100_000}),
            ("not valid JSON", {"metadata": "{nope"}),
            ("a JSON list, expected an object", {"metadata": "[]"}),
            ("missing: .*schema.* Export the policy again", {"metadata": "{}"}),
            ("missing: robot", {"metadata": partial}),
            (
                "unknown: eyes.* by xreset '9.9', .* Update xreset",
                {"metadata": self.contract | {"eyes": 2}, "version": "9.9"},
            ),
            (r"task is \[\], expected an object", {"metadata": self.contract | {"task": []}}),
            ("observation_layout.policy.x is -1", {"metadata": self.contract | negative}),
            (r"joint_names\[0\] is 1", {"metadata": self.contract | {"joint_names": [1, 2]}}),
        ):
            with (
                self.subTest(words, **{k: str(v)[:40] for k, v in changes.items()}),
                self.assertRaisesRegex(PolicyError, words),
            ):
                OnnxPolicy(write_policy(path, self.contract, **changes))
        write_policy(path, self.contract)
        path.write_bytes(
            path.read_bytes().replace(b'"schema"', b"\xff\xfe\xff\xfe\xff\xfe\xff\xfe")
        )
        with self.assertRaises(PolicyError):
            OnnxPolicy(path)
        for name in ("none.onnx", f"{'long' * 100}.onnx"):
            with refuses(self, "there is no .*onnx.* .policy.", PolicyError, name):
                OnnxPolicy(self.folder / name)
        path.write_bytes(b"hello")
        self.assertRaisesRegex(PolicyError, "cannot be read as an ONNX policy", OnnxPolicy, path)
        (other := self.folder / "demos.npz").write_bytes(b"hello")
        words = "demos.npz is not an exported policy, expected a run folder, a .onnx file"
        self.assertRaisesRegex(PolicyError, words, OnnxPolicy, other)

    def test_the_policy_that_was_loaded_plays_even_if_its_file_is_replaced(self):
        path = write_policy(self.folder / "replaced.onnx", self.contract)
        loaded = load_policy(path)
        shapes = observation_shapes(OnnxPolicy(path).contract, "it")
        observed = {name: torch.full((2, *shape), 0.01) for name, shape in shapes.items()}
        expected = OnnxPolicy(path).act(observed)
        write_policy(path, self.contract, value=-0.5)
        self.assertTrue((OnnxPolicy(path).act(observed) != expected).all())
        for _ in range(2):
            self.assertTrue((loaded.start(None).act(observed) == expected).all())
        self.assertEqual(sha256(loaded.exported()).hexdigest(), loaded.hash)
        larger = {name: 9.0 * value for name, value in observed.items()}
        self.assertTrue((OnnxPolicy(path).act(larger) == -1.0).all())

    def test_a_training_checkpoint_is_recognised(self):
        run = self.folder / "run"
        checkpoint = run / "checkpoints" / "000100.pt"
        checkpoint.parent.mkdir(parents=True)
        torch.save({"iteration": 100}, checkpoint)
        words = "000100.pt is a training checkpoint, expected .* in its run folder .RUN/checkpoints"
        self.assertRaisesRegex(PolicyError, words, OnnxPolicy, checkpoint)
        told = refused("eval", checkpoint, "--demos x.npz")
        self.assertIn(f"{run} is not a run folder", " ".join(told.split()))
        elsewhere = self.folder / "elsewhere.pt"
        shutil.copy(checkpoint, elsewhere)
        self.assertRegex(refused("eval", elsewhere, "--demos x.npz"), "elsewhere.pt is a training")


CARD = """schema = "xreset-policy-card/1"
about = "Lifts."
data = "four demonstrations"
recipe = "one minute"
licence = "MIT"
[results.seen]
mujoco = "90 %"
[results.others]
sapien = "70 %"
"""


class ShippedTest(WithPolicy):
    def setUp(self):
        """A folder of shipped policies with one in it, and another folder to work in."""
        here = self.enterContext(tempfile.TemporaryDirectory())
        self.enterContext(contextlib.chdir(here))
        ours = Path(here, "site")
        ours.mkdir()
        (ours / "skilled.onnx").write_bytes(self.file.read_bytes())
        self.enterContext(mock.patch.object(shipped, "FOLDER", ours))
        self.enterContext(mock.patch.dict(os.environ, {"COLUMNS": "200"}))

    def test_a_name_means_the_shipped_file(self):
        self.assertEqual(list(shipped.shipped()), ["skilled"])
        subject = load_policy("skilled")
        words = "PolicySpec('skilled', 'openarm', 1 object, results in runs/skilled/eval)"
        self.assertEqual(repr(subject), words)
        self.assertEqual(subject.task, TASK)
        self.assertEqual(subject.hash, load_policy(self.file).hash)

    def test_the_list_shows_the_cards(self):
        self.assertIn("the card of skilled.onnx", refused("policies list"))
        card = shipped.FOLDER / "skilled.toml"
        card.write_text(CARD)
        out = succeeds("policies list")
        for part in (
            "skilled: Lifts.",
            "four demonstrations",
            "one minute",
            "MIT",
            "openarm",
            SOUP,
            "90 %",
            "70 %",
        ):
            self.assertIn(part, out)
        self.assertEqual(succeeds("policies skilled"), out)
        self.assertIn("xreset eval skilled --demos DEMOS", out, "without a graph it is not played")
        (shipped.FOLDER / "skilled.graph").touch()
        self.assertIn("xreset play skilled", succeeds("policies skilled"))
        words = "Unknown policy 'nobody'. Choose from: skilled."
        self.assertIn(words, refused("policies skilled nobody"))
        card.write_text(CARD.replace("card/1", "card/9"))
        self.assertIn("states schema", refused("policies list"))

    def test_the_name_of_a_robot_means_the_policy_that_its_card_states(self):
        none = (
            "No policy ships for the robot 'openarm', only for no robot: train one with xreset run"
        )
        self.assertRaisesRegex(PolicyError, none, load_policy, "openarm")
        self.assertRaisesRegex(PolicyError, none, default_policy, "openarm")
        self.assertEqual(shipped.run_folder("openarm"), Path("openarm"))
        (shipped.FOLDER / "skilled.toml").write_text('default_of = "openarm"\n' + CARD)
        self.assertEqual(load_policy("openarm").name, "skilled")
        self.assertEqual(default_policy(robot_folder("openarm")), "skilled")
        self.assertEqual(shipped.run_folder("openarm"), Path("runs/skilled"))
        self.assertIn("openarm, whose name means this policy", succeeds("policies openarm"))
        other = "for the robot 'ur7e-robotiq', only for openarm: train one with xreset run DEMOS"
        for command in (
            "play --robot ur7e-robotiq",
            "eval ur7e-robotiq --demos x.npz",
            "stress ur7e-robotiq",
            "export deploy ur7e-robotiq --out robotiq",
        ):
            with self.subTest(command):
                self.assertIn(other, refused(command))
        shutil.copy(shipped.FOLDER / "skilled.onnx", shipped.FOLDER / "openarm.onnx")
        self.assertEqual(load_policy("openarm").name, "openarm")

    def test_a_policy_of_another_robot_is_refused(self):
        words = "skilled is a policy of the robot 'openarm', not of 'ur7e-robotiq'"
        for command in (
            "play skilled",
            "eval skilled --demos x.npz",
            "stress skilled",
            "export deploy skilled --out robotiq",
        ):
            with self.subTest(command):
                self.assertIn(words, refused(command, "--robot ur7e-robotiq"))

    def test_it_knows_which_objects_it_was_not_trained_with(self):
        self.assertEqual(load_policy("skilled").unseen((SOUP, "mug", "bowl")), ("bowl", "mug"))
        self.assertEqual(load_policy("zero", robot="openarm").unseen((SOUP, "mug")), ())

    def test_an_unknown_name_lists_those_that_ship(self):
        expected = "Unknown policy 'skiled'. Give a run folder, a .onnx file, or one of: zero, ik"
        self.assertIn(f"{expected}, skilled.", refused("eval skiled --demos x.npz"))
        next(shipped.FOLDER.iterdir()).unlink()
        self.assertRaisesRegex(PolicyError, f"{expected}[.]", load_policy, "skiled")
