"""A policy leaves xreset: one graph from readings to joint targets, in a folder that runs without xreset."""

import contextlib
import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from unittest import TestCase, mock, skipUnless

import numpy as np
import onnx
import onnxruntime
import torch
import yaml
from numpy.testing import assert_allclose, assert_array_equal

from tests import toy_grasp
from tests.command import refused, succeeds
from tests.data import InFolder, refuses
from tests.test_examples import EXAMPLES, run
from tests.toy_bank import SOUP
from tests.toy_policy import TASK, graph_of, toy_graph
from tests.toy_robot import endless_robot
from xreset import (
    CameraConfig,
    TaskConfig,
    VisionConfig,
    export_deploy,
    load_policy,
    synthesize,
)
from xreset.errors import PolicyError, XResetError
from xreset.eval.rollout import engine, episode_starts, load_trial, roll_out
from xreset.live import cache
from xreset.live.deploy import with_objects, write_deployed
from xreset.live.engine import EngineDriver
from xreset.live.graph import policy_graph
from xreset.live.leapp import leapp_description
from xreset.policy.onnx_policy import OnnxPolicy
from xreset.runtime import Controller, LiveError, Reading, load_controller
from xreset.runtime.contract import KEY, parse_contract
from xreset.task.config import ObservationConfig

POLICY = "many-objects"
STEPS = 30
REPLAY = """
import json, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("xreset", "torch", "scipy", "onnx"):
            raise ImportError(name)
sys.meta_path.insert(0, Absent())
folder, recording = sys.argv[1:]
sys.path.insert(0, folder)
import numpy as np
import runtime
data = np.load(recording)
controller = runtime.load_controller(folder)
name = str(data["object"])
controller.begin(controller.object(name), data["goal_pos"], data["goal_quat"], data["start"])
names = ("joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force")
worst = 0.0
for k in range(len(data["target"])):
    reading = runtime.Reading(joint_time=0.0, object_time=0.0, **{name: data[name][k] for name in names})
    worst = max(worst, float(np.abs(controller.step(reading) - data["target"][k]).max()))
modules = sorted({"xreset", "torch", "scipy", "onnx"} & set(sys.modules))
print(json.dumps({"worst": worst, "modules": modules}))
"""


def recorded(name, object_name, steps):
    """Return readings, goals and targets of the first steps of an evaluation's episode in MuJoCo."""
    spec = load_policy(name)
    trial = load_trial(spec, synthesize([object_name], 1))
    frames = []
    with trial.worlds(engine("mujoco", workers=0), torch.zeros(1, dtype=torch.long)) as env:
        env.reset(start=episode_starts(trial.starts(), [(0, 0, 0)]))
        policy = spec.begin(env)
        values = {"goal_pos": env.goal_pos, "goal_quat": env.goal_quat, "start": env.joint_target}
        recording = {name: value[0].numpy().copy() for name, value in values.items()}
        for _ in range(steps):
            reading = EngineDriver(env).read()
            env.advance(policy.act(env.get_observations()))
            frames.append({**vars(reading), "target": env.joint_target.numpy().copy()})
    names = ("target", "joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force")
    for name in names:
        recording[name] = np.stack([frame[name][0] for frame in frames])
    return recording


class RuntimeTest(InFolder):
    def test_the_graph_that_ships_is_not_that_of_a_changed_robot(self):
        spec = load_policy(POLICY)
        changed = replace(spec, robot=replace(spec.robot, home_std=(0.0, 0.0)))
        with self.assertRaisesRegex(PolicyError, "another version of the robot"):
            _ = changed.graph

    def test_it_acts_as_the_evaluation_in_a_process_without_xreset(self):
        said = succeeds("export deploy", POLICY, "--out", f"{self.folder}/can")
        self.assertIn("28 joints at 30 Hz", said)
        np.savez(f"{self.folder}/recording.npz", object=SOUP, **recorded(POLICY, SOUP, STEPS))
        command = [sys.executable, "-I", "-c", REPLAY]
        command += [f"{self.folder}/can", f"{self.folder}/recording.npz"]
        found = json.loads(
            subprocess.run(command, check=True, capture_output=True, text=True).stdout
        )
        self.assertEqual(found["modules"], [])
        self.assertLess(found["worst"], 1e-5)
        measured = subprocess.run(
            [sys.executable, "-m", "runtime"],
            capture_output=True,
            text=True,
            cwd=self.folder / "can",
        )
        self.assertIn("a step takes", measured.stdout)


class ToyTest(InFolder):
    """The graph of a toy policy of one matrix, for the gripper of the conformance suite."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.robot = toy_grasp.robot()
        cls.task = TASK

    def setUp(self):
        super().setUp()
        network, self.graph = toy_graph()
        self.network = self.folder / "toy.onnx"
        self.network.write_bytes(network)
        self.out = self.folder / "out"
        write_deployed(self.graph, self.out)
        self.controller = load_controller(self.out)
        self.contract = self.controller.contract
        self.home = [joint["home"] for joint in self.contract["joints"]]

    def begin(self, **changes):
        brick = self.contract["objects"]["brick"]
        good = {
            "obj": brick, "target": self.home,
            "goal_pos": [0.5, 0.3, 0.2], "goal_quat": [1, 0, 0, 0],
        }  # fmt: skip
        self.controller.begin(**good | changes)
        return Reading(
            joint_pos=self.home, joint_vel=[0.0] * 5, joint_time=0.0,
            object_pos=[0.5, 0.3, 0.1], object_quat=[1, 0, 0, 0], object_time=0.0,
        )  # fmt: skip

    def test_a_robot_with_other_joints_is_refused(self):
        for changes, words in (
            ({"joints": self.robot.joints[:-1]}, "joint_names.4. is '.*', here missing"),
            ({"base_pos": (0.0, 0.0, 0.1)}, "its URDF, a mesh or robot.toml has changed"),
        ):
            changed = replace(self.robot, **changes)
            words = f"another version of 'conformance-gripper': {words}"
            with (
                mock.patch("xreset.eval.policy_spec.load_robot", return_value=changed),
                refuses(self, words, PolicyError),
            ):
                load_policy(self.out / "policy.onnx", robot="changed")

    def test_the_graph_says_what_goes_in_and_out(self):
        model = onnx.load_from_string(self.graph)
        onnx.checker.check_model(model)
        self.assertEqual({node.domain for node in model.graph.node}, {""})
        self.assertEqual(
            [value.name for value in model.graph.output],
            ["target", "memory_out", "links", "observations"],
        )
        shapes = self.controller.shapes
        self.assertEqual(shapes["object_center"], (3,))
        self.assertEqual((shapes["joint_pos"], shapes["tip_force"]), ((5,), (2, 3)))
        self.assertEqual(
            [joint["name"] for joint in self.contract["joints"]], list(self.robot.joint_names)
        )
        self.assertEqual(np.shape(self.contract["objects"]["brick"]["points"]), (64, 3))
        self.assertTrue(set(shapes) <= set(self.contract["values"]))
        with self.assertRaisesRegex(XResetError, "is there already"):
            write_deployed(b"", self.out)
        with (
            mock.patch("xreset.eval.policy_spec.load_policy", side_effect=AssertionError),
            self.assertRaisesRegex(XResetError, "is there already"),
        ):
            export_deploy("many-objects", self.out)
        with self.assertRaisesRegex(
            LiveError, "has no object 'hat'. Choose from: brick.*--object NAME"
        ):
            self.controller.object("hat")

    def test_an_episode_that_does_not_fit_is_refused(self):
        brick = self.contract["objects"]["brick"]
        points = np.array(brick["points"])
        first = self.controller.step(self.begin())
        for name, value, words in (
            ("target", self.home[1:], r"target has shape \(4,\), expected \(5,\)"),
            ("goal_pos", [0.5, 0.3], r"goal_pos has shape \(2,\), expected \(3,\)"),
            ("goal_quat", [1, 0, 0, 1], "expected a unit quaternion"),
            ("goal_quat", [float("nan")] * 4, "expected a unit quaternion"),
            ("target", [90.0] * 5, r"target of .* is 90, expected .* to .*\. Are these degrees"),
            ("target", [float("nan")] * 5, "target of .* is nan"),
            ("goal_pos", [500.0, 300.0, 200.0], "expected at most 10 m. Are these millimetres"),
            ("goal_pos", [float("nan")] * 3, "expected at most 10 m"),
            ("obj", brick | {"points": 1000 * points}, "points has .* Are these millimetres"),
            ("obj", brick | {"points": points[1:]}, r"shape \(63, 3\), expected \(64, 3\)"),
            ("obj", {"points": points}, "needs normals of the object"),
            ("obj", brick | {"normals": points[1:]}, r"shape \(63, 3\), expected \(64, 3\)"),
            ("obj", points, "needs points of the object. Give an object"),
        ):
            reading = self.begin()
            target = self.controller.step(reading)
            assert_array_equal(target, first, "it remembers nothing of an earlier episode")
            with self.subTest(name, words=words):
                self.assertRaisesRegex(LiveError, words, self.begin, **{name: value})
                self.assertRaisesRegex(LiveError, "has begun", self.controller.step, reading)

    def test_targets_stay_within_the_limits_of_the_contract(self):
        contract = json.loads(json.dumps(self.contract))
        for joint in contract["joints"]:
            joint |= {"lower": joint["home"] - 1e-3, "upper": joint["home"] + 1e-3}
        self.controller = Controller(self.with_metadata(json.dumps(contract)))
        assert_allclose(self.controller.step(self.begin()), [self.home], atol=1.1e-3)
        target = np.float32(self.home)
        self.begin(target=target)
        target += 1  # the array of a robot
        assert_allclose(self.controller.target, [self.home], atol=1e-6)

    def test_a_reading_that_does_not_fit_is_refused(self):
        controller = self.controller
        goal = ([0.5, 0.3, 0.2], [1, 0, 0, 0])
        self.assertRaisesRegex(LiveError, "No episode has begun", controller.set_goal, *goal)
        reading = self.begin()
        self.assertEqual(controller.step(reading).shape, (1, 5))
        for changes, words in (
            ({"joint_pos": self.home[1:]}, r"joint_pos has shape \(1, 4\), expected \(1, 5\)"),
            ({"object_quat": [1, 0, 0]}, r"object_quat has shape \(1, 3\), expected \(1, 4\)"),
            ({"tip_force": [0, 0, 0]}, r"tip_force has shape \(1, 3\), expected \(1, 2, 3\)"),
            ({"joint_vel": None}, "needs joint_vel, which the reading does not have"),
        ):
            with refuses(self, words, LiveError):
                controller.step(replace(reading, **changes))
        for name, value, words in (
            ("joint_pos", [90.0] * 5, "joint_pos of .* is 90, expected .*degrees"),
            ("joint_vel", [3e38] * 5, r"joint_vel holds 3e\+38, expected at most 100 rad/s"),
            ("object_pos", [500.0, 0, 0], "The object has the coordinate 500.*millimetres"),
            ("tip_force", [[1e6, 0, 0]] * 2, "tip_force holds 1e.06"),
            ("joint_pos", self.home[1:], r"joint_pos has shape \(1, 4\), expected \(5,\)"),
            ("object_quat", [1, 0, 0, 1], "object_quat is .* expected a unit quaternion"),
        ):
            with refuses(self, words, LiveError, name):
                controller.check_reading(replace(reading, **{name: value}))

    def changed(self, place, value):
        """The text of the contract with another value at a place."""
        contract = json.loads(json.dumps(self.contract))
        entry = contract
        for name in place[:-1]:
            entry = entry[name]
        entry[place[-1]] = value
        return json.dumps(contract)

    def with_metadata(self, text):
        model = onnx.load_from_string(self.graph)
        onnx.helper.set_model_props(model, {KEY: text})
        return model.SerializeToString()

    def test_a_contract_that_no_robot_may_follow_is_refused(self):
        parse_contract({KEY: self.changed(("about",), "an entry of one's own")}, "It")
        joint = ("joints", 1)
        for place, values in (
            (("control_dt",), (1e-30, -0.016, True, 50.0, None)),
            (("joints",), ([], [{}] * 5, [3])),
            ((*joint, "step"), (50.0, -0.01, "x", float("nan"))),
            ((*joint, "home"), ("0",)),
            ((*joint, "lower"), (None, 1e9, float("-inf"))),
            ((*joint, "upper"), (None, -50.0)),
            ((*joint, "velocity"), (-1.0, 0.0, "x")),
            (("fingertips",), (3,)),
            (("objects", "brick"), ({}, 3)),
            (("objects", "brick", "points"), ([[0, 0, float("nan")]] * 64, [])),
            (("schema",), ("xreset-deploy/9",)),
        ):
            *_, last = (part for part in place if isinstance(part, str))
            for value in values:
                with self.subTest(place, value=value), self.assertRaisesRegex(LiveError, last):
                    parse_contract({KEY: self.changed(place, value)}, "It")

    def test_another_version_and_damage_are_refused(self):
        fewer = self.changed(("joints",), self.contract["joints"][1:])
        few_points = self.changed(("objects", "brick", "points"), [[0, 0, 0]] * 63)
        no_links = self.changed(("links",), [])
        forgetful = onnx.load_from_string(self.graph)
        del forgetful.graph.output[1]
        for content, words in (
            (self.network.read_bytes(), "no metadata entry 'xreset-deploy': it is not a deployed"),
            (
                self.with_metadata("[]"),
                "It has schema 'None', this runtime reads 'xreset-deploy/2'",
            ),
            (self.with_metadata("{" * 50_000), "has a contract that is not JSON"),
            (self.graph[:5000], "It cannot be read as ONNX"),
            (b"", "It cannot be read as ONNX"),
            (self.with_metadata(fewer), "has the input 'joint_pos'"),
            (self.with_metadata(few_points), "points"),
            (self.with_metadata(no_links), r"links has shape \(1, 3, 3\), expected \(1, 0, 3\)"),
            (forgetful.SerializeToString(), "only one of memory_in and memory_out"),
        ):
            with refuses(self, words, LiveError):
                Controller(content, "It")
        for folder in (None, self.folder / "nothing", "\0"):
            self.assertRaisesRegex(LiveError, "is not an exported policy", load_controller, folder)
        (self.out / "contract.json").write_text("{}")
        with self.assertRaisesRegex(LiveError, "of xreset 0.3 or earlier. Use the runtime in this"):
            load_controller(self.out)

    def test_a_graph_is_exported_once(self):
        network = self.network.read_bytes()
        made = []

        def graph(*arguments):
            made.append(arguments)
            return onnx.load_from_string(network)

        folder = self.folder / "cache"
        self.enterContext(mock.patch.dict(os.environ, {"XRESET_CACHE": str(folder)}))
        self.enterContext(mock.patch.object(cache, "policy_graph", graph))
        for _ in range(2):
            cache.cached_graph(network, self.robot, self.task)
        self.assertEqual(len(made), 1)
        (file,) = folder.rglob("*.onnx")
        file.write_bytes(file.read_bytes()[:-100])
        found = cache.cached_graph(network, self.robot, self.task)
        self.assertEqual(found.SerializeToString(), file.read_bytes())
        self.assertEqual(len(made), 2)
        other = replace(self.task, substeps=self.task.substeps + 1)
        for i, changed in enumerate(((network + b" ", self.task), (network, other))):
            cache.cached_graph(changed[0], self.robot, changed[1])
            self.assertEqual(len(made), 3 + i)
        with mock.patch.object(cache, "_MOST", 2):
            cache.cached_graph(network + b"  ", self.robot, self.task)
        self.assertEqual(len(list(folder.rglob("*.onnx"))), 2)
        file.parent.rename(folder / "moved")
        (folder / "graphs").write_bytes(b"")  # no folder can be made there
        cache.cached_graph(network, self.robot, self.task)
        self.assertEqual(len(made), 6)

    def test_a_folder_of_xreset_0_3_is_read(self):
        old = self.folder / "old"
        (old / "runtime").mkdir(parents=True)
        (old / "policy.onnx").write_bytes(self.network.read_bytes())
        spec = load_policy(old, robot=self.robot)
        self.assertIsInstance(spec.start(None), OnnxPolicy)
        contract = Controller(with_objects(spec.graph, [toy_grasp.brick()])).contract
        self.assertEqual(contract, self.contract)

    def test_the_example_of_a_driver(self):
        reading = self.begin()
        targets = np.concatenate([self.controller.step(reading) for _ in range(30)])[2::3]
        rows = 1 + len(targets)
        targets = np.concatenate((targets, targets[-1:]))
        self.assertGreater(np.abs(targets[0] - self.home).mean(), 0.01)
        arrays = {
            "time": np.arange(rows) * 0.05,
            "joint_names": [joint["name"] for joint in self.contract["joints"]][::-1],
            "frame_offsets": [0, rows],
            "object_name": ["brick"],
        }
        arrays |= {
            "joint_pos": np.tile(self.home[::-1], (rows, 1)),
            "joint_target": targets[:, ::-1],
        }
        arrays |= {"object_pos": [[0.5, 0.3, 0.1]] * rows, "goal_pos": [[0.5, 0.3, 0.2]]}
        arrays |= {
            "object_quat_wxyz": np.tile([1, 0, 0, 0], (rows, 1)),
            "goal_quat_wxyz": [[1, 0, 0, 0]],
        }
        np.savez(f"{self.folder}/episodes.npz", **arrays)
        said = run("11_own_driver", self.out, self.folder / "episodes.npz")
        self.assertIn("30 steps; stopped because: the recording is over", said)
        self.assertIn("the robot holds still", said)
        self.assertIn("by 0.000 rad", said)
        arrays["joint_names"][0] = "elbow"
        np.savez(f"{self.folder}/episodes.npz", **arrays)
        name = self.contract["joints"][-1]["name"]
        words = f"robot '{self.robot.name}' with the joint '{name}', but this robot has the joints elbow, "
        with self.assertRaisesRegex(Exception, words):
            run("11_own_driver", self.out, self.folder / "episodes.npz")

    def readings(self, steps):
        """Return numbers [steps, ...] for every input of the graph but the memory, by name."""
        rng = np.random.default_rng(0)
        upright = np.array([1.0, 0, 0, 0])
        inputs = {}
        for name, shape in self.controller.shapes.items():
            values = rng.normal(0.3, 0.02, (steps, *shape))
            inputs[name] = (
                np.where(np.ones(shape), values, 0) if shape != (4,) else [upright] * steps
            )
        inputs.pop("memory_in")
        return {name: np.asarray(value, np.float32) for name, value in inputs.items()}

    @skipUnless(shutil.which("g++"), "there is no compiler of C++")
    def test_cpp_gives_the_targets_of_python(self):
        library = next(Path(onnxruntime.__file__).parent.glob("capi/libonnxruntime.so.*"), None)
        if library is None:
            self.skipTest("onnxruntime has no library of its own")
        linked = self.folder / "libonnxruntime.so.1"
        linked.symlink_to(library)
        program = self.folder / "policy"
        stand_in = Path(__file__).parent / "stand_ins"
        command = ["g++", "-std=c++17", "-Wall", "-Werror", "-I", stand_in, "-o", program]
        command += [EXAMPLES / "deploy_cpp" / "policy.cpp", linked, f"-Wl,-rpath,{self.folder}"]
        subprocess.run(command, check=True)
        steps = 100
        readings = self.readings(steps)
        lines = []
        for k in range(steps):
            row = np.concatenate([value[k].ravel() for value in readings.values()])
            lines.append(" ".join(map("{:.9g}".format, row)))
        found = subprocess.run(
            [program, self.out / "policy.onnx", str(steps)],
            input="\n".join(lines), capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        found = np.array([line.split() for line in found.splitlines()], float)
        assert_allclose(found, self.expected(readings, steps), atol=1e-6)

        result = subprocess.run([program], capture_output=True, text=True, check=False)
        self.assertEqual(result.returncode, 2)
        self.assertIn("usage: policy POLICY.onnx STEPS", result.stderr)
        short = subprocess.run(
            [program, self.out / "policy.onnx", "2"],
            input=lines[0], capture_output=True, text=True, check=False,
        )  # fmt: skip
        self.assertEqual(short.returncode, 1)
        self.assertRegex(short.stderr, "the readings end, or are no number, at .* of step 1")

    def expected(self, readings, steps):
        """Return the graph's targets [steps, J], by onnxruntime."""
        session = onnxruntime.InferenceSession(self.graph, providers=["CPUExecutionProvider"])
        memory = np.zeros((1, *self.controller.shapes["memory_in"]), np.float32)
        targets = []
        for k in range(steps):
            feed = {name: value[k][None] for name, value in readings.items()}
            target, memory = session.run(["target", "memory_out"], feed | {"memory_in": memory})
            targets.append(target[0])
        return np.array(targets)

    @skipUnless(find_spec("leapp"), "leapp is not installed")
    def test_leapp_gives_the_targets_of_the_graph(self):
        from leapp.inference_manager import InferenceManager

        manager = InferenceManager(str(self.out / "leapp.yaml"))
        steps = 4
        readings = self.readings(steps)
        found = []
        for k in range(steps):
            given = {f"policy/{name}": torch.tensor(readings[name][k][None]) for name in readings}
            found.append(manager.run_policy(given)["policy/target"][0].numpy())
        assert_allclose(found, self.expected(readings, steps), atol=1e-6)

    def test_the_description_for_leapp_names_every_value(self):
        described = yaml.safe_load((self.out / "leapp.yaml").read_text())
        (node,) = described["models"].values()
        for part, names in (
            ("inputs", self.controller.shapes),
            ("outputs", self.controller.outputs),
        ):
            self.assertEqual([value["name"] for value in node[part]], list(names))
        self.assertEqual(
            described["pipeline"]["feedback_flow"], {"policy/memory_out": ["policy/memory_in"]}
        )
        own = onnx.load_from_string(self.graph)
        own.graph.node.append(onnx.helper.make_node("Identity", ["target"], ["score"]))
        score = onnx.helper.make_tensor_value_info("score", onnx.TensorProto.FLOAT, None)
        own.graph.output.append(score)
        self.assertNotIn("score", leapp_description(own.SerializeToString()))
        digest = hashlib.sha256((self.out / "policy.onnx").read_bytes()).hexdigest()
        self.assertEqual(node["parameters"]["sha256sum"], digest)

    def test_the_ros_2_node(self):
        with ros(self.contract, self.home) as published:
            run("12_ros2_node", str(self.out), "brick", 0.5)
            rclpy = sys.modules["rclpy"]
            handler = sys.modules["rclpy.signals"].SignalHandlerOptions.NO
        rclpy.init.assert_called_once_with(signal_handler_options=handler)
        self.assertEqual(len(published), 30)
        self.assertEqual(np.shape(published), (30, 5))
        joints = self.controller.contract["joints"]
        for target in published:
            for value, joint in zip(target, joints, strict=True):
                self.assertTrue(joint["lower"] - 1e-6 <= value <= joint["upper"] + 1e-6)

    def test_a_ros_2_node_without_velocities_moves_nothing(self):
        with (
            ros(self.contract, self.home, velocity=()) as published,
            self.assertLogs("xreset"),
        ):
            said = run("12_ros2_node", str(self.out), "brick", 30)
        self.assertIn("needs joint_vel, which the reading does not have", said)
        self.assertEqual(published, [])

    def test_a_ros_2_node_that_nobody_sends_to_any_more_stops(self):
        for kind, words in (
            ("PoseStamped", "The pose of the object is 1.0"),
            ("JointState", "The joint positions are 0.1"),
        ):
            with (
                self.subTest(kind),
                ros(self.contract, self.home, vanishing=kind) as published,
                self.assertLogs("xreset"),
            ):
                said = run("12_ros2_node", str(self.out), "brick", 30)
            self.assertIn(words, said)
            self.assertLess(len(published), 120)
            assert_allclose(np.diff(published[-3:], axis=0), 0, atol=1e-3)

    def test_an_evaluation_plays_the_graph_as_it_plays_the_network(self):
        trial = toy_grasp.trial(self.task)
        played = []
        for file in (self.network, self.out / "policy.onnx"):
            spec = load_policy(file, robot=self.robot)
            found = roll_out(spec.start(None), engine("mujoco", workers=0), trial, episodes=1)
            played.append(found)
        first, second = (rollouts.traces for rollouts in played)
        for a, b in zip(first, second, strict=True):
            assert_allclose(a.joint_target, b.joint_target, atol=1e-5)
            assert_allclose(a.object_pos, b.object_pos, atol=1e-4)


class EndlessTest(InFolder):
    def test_a_joint_may_turn_without_limits(self):
        robot = endless_robot(self.folder)
        controller = Controller(graph_of(robot, value=0.0)[1])
        turned = 100.0
        start = np.float32(robot.home)
        start[0] = turned
        nowhere = np.zeros(3)
        upright = np.array([1.0, 0, 0, 0])
        points = np.zeros(controller.shapes["object_points"])
        obj = {"points": points, "normals": points, "center": nowhere}
        controller.begin(obj, nowhere, upright, start)
        reading = Reading(
            joint_pos=start,
            joint_vel=np.zeros_like(start),
            joint_time=0.0,
            object_pos=np.float32(nowhere),
            object_quat=np.float32(upright),
            object_time=0.0,
        )
        controller.check_reading(reading)
        self.assertEqual(controller.step(reading)[0, 0], turned)


class RefusedTest(TestCase):
    def test_what_cannot_be_deployed(self):
        said = refused("export deploy zero --robot openarm --out x")
        self.assertIn("The baseline 'zero' is not an exported policy", said)
        robot = toy_grasp.robot()
        seeing = TaskConfig(vision=VisionConfig(cameras=(CameraConfig(),)))
        with self.assertRaisesRegex(PolicyError, "The policy has cameras"):
            policy_graph(b"", robot, seeing)
        for network in (b"hello", "mine.onnx"):
            words = f"network is {network!r}, expected the content of an ONNX file"
            with refuses(self, words, PolicyError):
                policy_graph(network, robot, TaskConfig())
        network = torch.nn.Linear(1, 1)
        for name in ("object_linvel", "reward", "least_tip_distance"):
            draft = ObservationConfig()
            task = TaskConfig(observation=replace(draft, policy=draft.policy | {name: {}}))
            with refuses(self, f"{name}', which no robot", PolicyError, name):
                policy_graph(network, robot, task)
        with self.assertRaisesRegex(PolicyError, r"The network gives \(2, 5, 64, 1\) .* expected"):
            policy_graph(OfCloud(), robot, TaskConfig())


class OfCloud(torch.nn.Module):
    """A network whose outputs have a wrong shape."""

    def forward(self, flat, cloud):
        return cloud[..., :1]


@contextlib.contextmanager
def ros(contract, home, vanishing=None, velocity=(0.0,) * 5):
    """A small stand-in for ROS 2: one node, whose topics send a robot at home; yields the published targets.

    After half a second, nobody sends messages of the kind ``vanishing`` any more.
    """
    published = []
    clock = SimpleNamespace(time=5.0)
    pose = SimpleNamespace(
        position=SimpleNamespace(x=0.5, y=0.3, z=0.1),
        orientation=SimpleNamespace(w=1.0, x=0.0, y=0.0, z=0.0),
    )
    callbacks = []

    def stamp():
        return SimpleNamespace(
            stamp=SimpleNamespace(sec=int(clock.time), nanosec=int(clock.time % 1 * 1e9))
        )

    def message(kind):
        if kind == "PoseStamped":
            return SimpleNamespace(header=stamp(), pose=pose)
        names = [joint["name"] for joint in contract["joints"]][::-1]
        return SimpleNamespace(header=stamp(), name=names, position=home[::-1], velocity=velocity)

    def spin_once(node, timeout_sec=0.01):
        clock.time += timeout_sec
        for kind, callback in callbacks:
            if kind != vanishing or clock.time < 5.5:
                callback(message(kind))

    node = mock.Mock()
    node.create_subscription = lambda kind, topic, callback, depth: callbacks.append(
        (kind, callback)
    )
    node.create_publisher.return_value.publish = lambda sent: published.append(sent.data)
    node.get_clock.return_value.now = lambda: SimpleNamespace(nanoseconds=clock.time * 1e9)
    modules = {
        "rclpy": mock.Mock(spin_once=spin_once, create_node=lambda name: node),
        "rclpy.signals": mock.Mock(),
        "geometry_msgs": mock.Mock(),
        "geometry_msgs.msg": mock.Mock(PoseStamped="PoseStamped"),
        "sensor_msgs": mock.Mock(),
        "sensor_msgs.msg": mock.Mock(JointState="JointState"),
        "std_msgs": mock.Mock(),
        "std_msgs.msg": mock.Mock(Float64MultiArray=SimpleNamespace),
    }
    with mock.patch.dict(sys.modules, modules):
        yield published
