"""Every policy that ships with xreset fits the robots, observations and objects of this version, and still has its skill."""

import json
import subprocess
import sys
import tempfile
import unittest
from importlib.util import find_spec

import numpy as np
import torch
from numpy.testing import assert_allclose

from xreset import OnnxPolicy, evaluate, synthesize
from xreset.eval.policy_spec import BASELINES, load_policy
from xreset.live.deploy import deployed_graph
from xreset.objects.catalogue import object_names
from xreset.policy.onnx_policy import observation_shapes
from xreset.policy.shipped import card, graph_of, shipped, shipped_graphs
from xreset.runtime import Controller, Reading

LARGEST = 5e6
"""What a policy may add to every download [bytes]."""
LARGEST_GRAPH = 2e5
"""The same of its deployed graph without weights."""
FLOOR = 0.6
"""Mean task progress of the episodes below; an object that is grasped and lifted makes 0.66."""

ABSENT = "rsl_rl,onnx,onnxscript,tensorboard,warp,mujoco_warp,mujoco,pybullet,sapien,coal,viser"
ACT = """
import json, sys
sys.modules.update(dict.fromkeys(sys.argv[1].split(",")))
import torch
from xreset.policy.onnx_policy import OnnxPolicy, observation_shapes
for file in sys.argv[2:]:
    policy = OnnxPolicy(file)
    shapes = observation_shapes(policy.contract, file)
    actions = policy.act({group: torch.zeros(3, *shape) for group, shape in shapes.items()})
    print(json.dumps([list(actions.shape), bool(actions.isfinite().all())]))
"""


def step_at_random(controller):
    """Take three steps with the same readings for every controller."""
    random = np.random.default_rng(0)
    home = np.array([joint["home"] for joint in controller.contract["joints"]])
    tips = len(controller.contract["fingertips"])
    points = 0.05 * random.standard_normal(controller.shapes["object_points"])
    upright = (1.0, 0.0, 0.0, 0.0)
    controller.begin(points, (0.5, 0.3, 0.2), upright, home, (0.0, 0.0, 0.01))
    for _ in range(3):
        turned = random.standard_normal(4)
        reading = Reading(
            joint_pos=home + 0.05 * random.standard_normal(len(home)),
            joint_vel=random.standard_normal(len(home)),
            joint_time=0.0,
            object_pos=0.3 + 0.1 * random.standard_normal(3),
            object_quat=turned / np.linalg.norm(turned),
            object_time=0.0,
            tip_force=random.standard_normal((tips, 3)),
        )
        controller.step(reading)


class ShippedPolicyTest(unittest.TestCase):
    def setUp(self):
        self.assertTrue(shipped(), "no policy ships: is package data missing?")

    def test_it_acts_without_engines_and_training(self):
        files = list(shipped().values())
        command = [sys.executable, "-c", ACT, ABSENT, *map(str, files)]
        out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
        for line, file in zip(out.splitlines(), files, strict=True):
            self.assertEqual(
                json.loads(line), [[3, len(OnnxPolicy(file).contract.joint_names)], True]
            )

    def test_it_fits_this_version_and_has_a_card(self):
        for name, file in shipped().items():
            with self.subTest(name):
                spec = load_policy(name)
                content = file.read_bytes()
                self.assertLess(len(content), LARGEST)
                self.assertNotIn(b".py", content, "the file tells nothing of where it was made")
                self.assertNotIn(name, BASELINES)
                found = card(file)
                self.assertTrue(found.licence and found.data and found.recipe)
                engines = set().union(*found.results.values())
                self.assertLessEqual({"mujoco", "mujoco-warp", "pybullet", "sapien"}, engines)
                trained = set(OnnxPolicy(file).contract.objects)
                self.assertEqual(set(spec.objects_of(None)), trained & set(object_names()))

    @unittest.skipUnless(find_spec("mujoco"), "mujoco is not installed")
    @unittest.skipUnless(find_spec("onnxscript"), "onnxscript is not installed")
    def test_its_graph_is_what_this_version_would_export(self):
        without_graph = set(shipped())
        for name, file in shipped_graphs().items():
            with self.subTest(name):
                self.assertLess(file.stat().st_size, LARGEST_GRAPH)
                spec = load_policy(name)
                self.assertEqual(spec.graph, graph_of(spec.exported()))
                without_graph.remove(name)
                shipped_one = Controller(spec.graph)
                fresh = Controller(deployed_graph(spec.exported(), spec.robot, spec.task))
                self.assertEqual(shipped_one.contract["joints"], fresh.contract["joints"])
                for controller in (shipped_one, fresh):
                    step_at_random(controller)
                assert_allclose(shipped_one.target, fresh.target, rtol=0, atol=1e-6)
                assert_allclose(shipped_one.observations, fresh.observations, rtol=0, atol=1e-5)
        for name in without_graph:
            self.assertTrue(load_policy(name).task.vision.cameras, name)

    @unittest.skipUnless(find_spec("onnx"), "onnx is not installed")
    def test_half_precision_changes_its_actions_little(self):
        content = shipped()["many-objects"].read_bytes()
        from ci.ship_policies import halved  # needs onnx

        half = halved(content)
        self.assertLess(len(half), 0.6 * len(content))
        generator = torch.Generator().manual_seed(0)
        policies = [OnnxPolicy("policy", each) for each in (content, half)]
        observations = {
            name: torch.randn(8, *shape, generator=generator)
            for name, shape in observation_shapes(policies[0].contract, "policy").items()
        }
        for _ in range(3):
            whole, rounded = (policy.act(observations) for policy in policies)
            self.assertGreater(whole.abs().max(), 0.1)
            assert_allclose(rounded, whole, rtol=0, atol=0.02)

    def test_it_still_grasps_and_lifts(self):
        for name, file in shipped().items():
            with self.subTest(name):
                demos = synthesize(OnnxPolicy(file).contract.objects[:1], 2)
                with tempfile.TemporaryDirectory() as folder:
                    (result,) = evaluate(name, demos, num_envs=2, out=folder, episodes=1)
                self.assertEqual(list(result.inputs), ["policy"])
                self.assertEqual(len(result.episodes), 2)
                self.assertGreaterEqual(result.mean("task_progress"), FLOOR)
