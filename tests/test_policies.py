"""Policies as files, and found by the name under which they ship."""

import contextlib
import json
import os
import tempfile
import unittest
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper
from tensordict import TensorDict

from tests.test_cli import run
from tests.toy_bank import SOUP
from tests.toy_policy import write_policy
from xreset import policies, robots
from xreset.demos.archive import write_demos
from xreset.demos.synth import synthesize
from xreset.errors import PolicyError
from xreset.eval.policy_spec import load_policy
from xreset.learning.export import export_onnx
from xreset.learning.model import PointNetLstmModel
from xreset.policy import OnnxPolicy, policy_contract
from xreset.task.config import ObservationConfig, TaskConfig, TerminationConfig

TASK = TaskConfig(
    observation=ObservationConfig(cloud_history=2, cloud_points=8),
    termination=TerminationConfig(episode_seconds=0.5),
    distance_points=32,
)
GROUPS = {"actor": ["policy", "proprio", "perception"]}


class WithPolicy(unittest.TestCase):
    """An untrained policy of the OpenArm, exported once, in a folder of its own."""

    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = robots.load("openarm")
        cls.contract = policy_contract(cls.robot, TASK, (SOUP,))
        torch.manual_seed(0)
        cls.model = PointNetLstmModel(
            cls.observations(2), GROUPS, "actor", len(cls.robot.joints), hidden_dims=[128, 64], pointnet_dims=[64, 32], lstm_dim=128,
            distribution_cfg={"class_name": "GaussianDistribution", "std_type": "log"},
        )  # fmt: skip
        cls.model.update_normalization(cls.observations(50, seed=9))
        cls.file = cls.folder / "exported.onnx"
        export_onnx(cls.model, cls.file, cls.contract)

    @classmethod
    def observations(cls, batch: int, seed: int = 0) -> TensorDict:
        g = torch.Generator().manual_seed(seed)
        widths = {group: (sum(terms.values()),) for group, terms in cls.contract["observation_layout"].items()}
        widths["perception"] = (TASK.observation.cloud_history, TASK.observation.cloud_points, 3)
        return TensorDict({k: torch.randn(batch, *w, generator=g) for k, w in widths.items()}, batch_size=[batch])


class OnnxPolicyTest(WithPolicy):
    def test_nothing_of_the_exporting_machine_is_in_the_file(self):
        self.assertNotIn(b".py", self.file.read_bytes())

    def test_what_cannot_act_is_refused_before_work_begins(self):
        """One step with zeros at loading: whatever the graph is like, evaluation meets no surprise."""
        path = self.folder / "tried.onnx"
        OnnxPolicy(write_policy(path, self.contract))
        layout = self.contract["observation_layout"]
        for words, changes in (
            ("numbers that are not finite", {"value": np.nan}),
            (r"gives float32 \(2, 3\), ", {"actions": 3}),
            ("cannot act", {"kind": TensorProto.INT64}),
            ("cannot act", {"lstm": "width"}),
            ("cannot act", {"lstm": 10**11}),
            ("cannot act", {"lstm": -5}),
            ("gives float32 .* for 2 worlds, expected", {"outputs": 2}),
            ("nested too deeply", {"metadata": '{"a": ' + "[" * 100_000}),
            (
                "observation_layout is missing",
                {"metadata": json.dumps(self.contract | {"observation_layout": layout | {"policy": {"x": -1}}})},
            ),
            ("joint_names is missing", {"metadata": json.dumps(self.contract | {"joint_names": [1, 2]})}),
        ):
            with (
                self.subTest(words, **{k: str(v)[:40] for k, v in changes.items()}),
                self.assertRaisesRegex(PolicyError, words),
            ):
                OnnxPolicy(write_policy(path, self.contract, **changes))
        write_policy(path, self.contract)
        path.write_bytes(path.read_bytes().replace(b'"schema"', b"\xff\xfe\xff\xfe\xff\xfe\xff\xfe"))
        with self.assertRaises(PolicyError):
            OnnxPolicy(path)

    def test_a_damaged_contract_or_another_graph_is_refused(self):
        model, damaged = onnx.load(str(self.file)), self.folder / "damaged.onnx"
        entry = next(e for e in model.metadata_props if e.key == "xreset")
        contract = entry.value
        partial = json.dumps(
            {name: value for name, value in json.loads(contract).items() if name != "robot"} | {"task": []}
        )
        for text, said in (
            ("{nope", "not valid JSON"),
            ("[]", r"a JSON list, expected an object"),
            ("{}", "policy schema None"),
            (partial, "in which robot, task is missing or of another type"),
        ):
            entry.value = text
            damaged.write_bytes(model.SerializeToString())
            with self.subTest(text), self.assertRaisesRegex(PolicyError, said):
                OnnxPolicy(damaged)
        graph = helper.make_graph(
            [helper.make_node("Identity", ["x"], ["y"])],
            "identity",
            [helper.make_tensor_value_info("x", TensorProto.FLOAT, [2])],
            [helper.make_tensor_value_info("y", TensorProto.FLOAT, [2])],
        )
        other = helper.make_model(graph, opset_imports=model.opset_import, ir_version=model.ir_version)
        helper.set_model_props(other, {"xreset": contract})
        damaged.write_bytes(other.SerializeToString())
        with self.assertRaisesRegex(PolicyError, r"takes the inputs \(.x.,\); a policy takes flat, cloud, h_in, c_in"):
            OnnxPolicy(damaged)


class ShippedTest(WithPolicy):
    def setUp(self):
        """A folder of shipped policies with one in it, and another folder to work in."""
        here = tempfile.TemporaryDirectory()
        self.addCleanup(here.cleanup)
        self.enterContext(contextlib.chdir(here.name))
        ours = Path(here.name) / "site"
        ours.mkdir()
        (ours / "skilled.onnx").write_bytes(self.file.read_bytes())
        self.enterContext(mock.patch.object(policies, "FOLDER", ours))
        self.enterContext(mock.patch.dict(os.environ, {"COLUMNS": "200"}))

    def test_a_name_means_the_shipped_file(self):
        self.assertEqual(list(policies.shipped()), ["skilled"])
        subject = load_policy("skilled")
        self.assertEqual(
            (subject.name, subject.robot.name, subject.folder), ("skilled", "openarm", Path("runs/skilled/eval"))
        )
        self.assertEqual(subject.task, TASK)
        self.assertEqual(subject.hash, load_policy(self.file).hash)

    def test_the_list_is_of_cards(self):
        code, _, err = run("policies", "list")
        self.assertEqual(code, 1)
        self.assertIn("the card of skilled.onnx", err)
        card = policies.FOLDER / "skilled.toml"
        text = (
            'schema = "xreset-policy-card/1"\nabout = "Lifts."\ndata = "four demonstrations"\nrecipe = "one minute"\nlicence = "MIT"\n'
            '[results.seen]\nmujoco = "90 %"\n[results.others]\nsapien = "70 %"\n'
        )
        card.write_text(text)
        code, out, err = run("policies", "list")
        self.assertEqual((code, err), (0, ""))
        for part in (
            "skilled: Lifts.",
            "four demonstrations",
            "one minute",
            "MIT",
            "openarm",
            SOUP,
            "mujoco",
            "90 %",
            "sapien",
            "70 %",
        ):
            self.assertIn(part, out)
        for wrong, problem in (
            (text.replace("card/1", "card/9"), "states schema"),
            (text + "[more]\n", "unknown: more"),
            ("= 1", "not valid TOML"),
        ):
            card.write_text(wrong)
            self.assertIn(problem, run("policies", "list")[2])

    def test_it_knows_which_objects_it_was_not_trained_with(self):
        self.assertEqual(load_policy("skilled").unseen((SOUP, "mug", "bowl")), ("bowl", "mug"))
        self.assertEqual(load_policy("zero", robot="openarm").unseen((SOUP, "mug")), ())

    def test_an_unknown_name_lists_those_that_ship(self):
        expected = "Unknown policy 'skiled'. Give a run folder, a .onnx file, or one of: zero, random, ik"
        for command, options in ((("eval",), ()), (("engines", "attribute"), ("--towards", "pybullet"))):
            code, _, err = run(*command, "skiled", "--demos", "x.npz", *options)
            self.assertEqual(code, 1)
            self.assertIn(f"{expected}, skilled.", err)
        next(policies.FOLDER.iterdir()).unlink()
        with self.assertRaisesRegex(PolicyError, f"{expected}[.]"):
            load_policy("skiled")

    @unittest.skipUnless(find_spec("mujoco"), "mujoco is not installed")
    def test_it_is_evaluated_traced_and_reported_by_name(self):
        write_demos("demos.npz", synthesize([SOUP], 1))
        self.assertEqual(run("eval", "skilled", "--demos", "demos.npz", "--episodes", "1")[0], 0)
        self.assertEqual(json.loads(Path("runs/skilled/eval/mujoco.json").read_text())["policy"], "skilled")
        code, out, err = run("report", "skilled")
        self.assertEqual((code, err), (0, ""))
        self.assertTrue(Path("runs/skilled/report/index.html").is_file(), out)


if __name__ == "__main__":
    unittest.main()
