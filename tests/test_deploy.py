"""A policy leaves xreset: as a folder that runs without it, and over the network."""

import json
import subprocess
import sys
import threading
from dataclasses import asdict, replace
from importlib.util import find_spec
from queue import Queue
from unittest import skipUnless
from unittest.mock import patch

import numpy as np
import torch

import xreset
from tests import toy_grasp
from tests.command import refused, succeeds
from tests.data import InFolder
from tests.test_examples import run
from tests.test_live import Scripted
from tests.toy_bank import SOUP
from tests.toy_policy import write_policy
from xreset import CameraConfig, TaskConfig, VisionConfig, load_policy, synthesize
from xreset.errors import PolicyError, XResetError
from xreset.eval.rollout import engine, episode_starts, load_trial
from xreset.live.deploy import deploy_contract, write_deployed
from xreset.live.engine import EngineDriver
from xreset.policy.onnx_policy import policy_contract
from xreset.runtime import (
    Controller,
    LiveError,
    Reading,
    RemoteController,
    Runner,
    load_controller,
    read_contract,
)
from xreset.runtime.contract import digest

POLICY = "soup-can"
STEPS = 30
REPLAY = """
import json, sys
class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("xreset", "torch", "scipy"):
            raise ImportError(name)
sys.meta_path.insert(0, Absent())
folder, recording = sys.argv[1:]
sys.path.insert(0, folder)
import numpy as np
import runtime
data = np.load(recording)
controller = runtime.load_controller(folder)
name = str(data["object"])
controller.begin(controller.points(name), data["goal_pos"], data["goal_quat"], data["target"], controller.center(name))
names = ("joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force")
worst = 0.0
for k in range(len(data["action"])):
    reading = runtime.Reading(joint_time=0.0, object_time=0.0, **{name: data[name][k] for name in names})
    controller.step(reading.batched())
    worst = max(worst, float(np.abs(controller.action - data["action"][k]).max()))
print(json.dumps({"worst": worst, "modules": sorted({"xreset", "torch", "scipy"} & set(sys.modules))}))
"""


@skipUnless(find_spec("mujoco"), "mujoco is not installed")
class RuntimeTest(InFolder):
    def test_it_acts_as_the_evaluation_in_a_process_without_xreset(self):
        self.assertIn(
            "28 joints at 60 Hz",
            succeeds("export", "deploy", POLICY, "--out", f"{self.folder}/can"),
        )
        spec = load_policy(POLICY)
        trial = load_trial(spec, synthesize([SOUP], 1))
        zero = np.zeros(1, int)
        frames = []
        with trial.worlds(engine("mujoco", workers=0), torch.zeros(1, dtype=torch.long)) as env:
            env.reset(start=episode_starts(trial.starts(), zero, zero, seed=0))
            policy = spec.begin(env)
            values = {
                "goal_pos": env.goal_pos,
                "goal_quat": env.goal_quat,
                "target": env.joint_target,
            }
            recording = {name: value[0].numpy().copy() for name, value in values.items()}
            for _ in range(STEPS):
                reading = EngineDriver(env).read()
                action = policy.act(env.get_observations())
                frames.append({"action": action.numpy(), **vars(reading)})
                env.advance(action)
        names = ("action", "joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force")
        for name in names:
            recording[name] = np.stack([frame[name][0] for frame in frames])
        np.savez(f"{self.folder}/recording.npz", object=SOUP, **recording)
        command = [
            sys.executable,
            "-I",
            "-c",
            REPLAY,
            f"{self.folder}/can",
            f"{self.folder}/recording.npz",
        ]
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


class ContractTest(InFolder):
    def setUp(self):
        super().setUp()
        self.task = TaskConfig()
        robot = toy_grasp.robot()
        trained = asdict(policy_contract(robot, self.task, ("brick",)))
        file = write_policy(self.folder / "toy.onnx", trained, value=0.01)
        self.out = self.folder / "out"
        self.contract = deploy_contract(robot, self.task, [toy_grasp.brick()], file.read_bytes())
        write_deployed(file.read_bytes(), self.contract, self.out)
        self.home = [joint["home"] for joint in self.contract["joints"]]

    def test_it_says_what_goes_in_and_out(self):
        self.assertEqual(read_contract(self.out), self.contract)
        self.assertEqual(
            [joint["name"] for joint in self.contract["joints"]],
            list(toy_grasp.robot().joint_names),
        )
        self.assertEqual(np.shape(self.contract["objects"]["brick"]["points"]), (64, 3))
        with self.assertRaisesRegex(PolicyError, "exists already"):
            write_deployed(b"", self.contract, self.out)
        with self.assertRaisesRegex(LiveError, "has no object 'hat'. Choose from: brick"):
            load_controller(self.out).points("hat")

    def test_an_episode_that_does_not_fit_is_refused(self):
        controller = load_controller(self.out)
        brick = self.contract["objects"]["brick"]
        good = {
            "object_points": brick["points"], "center": brick["center"], "target": self.home,
            "goal_pos": [0.5, 0.3, 0.2], "goal_quat": [1, 0, 0, 0],
        }  # fmt: skip
        for name, value, words in (
            ("target", self.home[1:], r"target has shape \(4,\), expected \(5,\)"),
            ("goal_pos", [0.5, 0.3], r"shape \(2,\), expected \(3,\)"),
            ("goal_quat", [1, 0, 0, 1], "expected a unit quaternion"),
            ("goal_quat", [float("nan")] * 4, "expected a unit quaternion"),
            ("target", [90.0] * 5, r"target of .* is 90, expected .* to .*\. Are these degrees"),
            ("target", [float("nan")] * 5, "target of .* is nan"),
            ("goal_pos", [500.0, 300.0, 200.0], "expected at most 10 m. Are these millimetres"),
            ("goal_pos", [float("nan")] * 3, "expected at most 10 m"),
            ("object_points", 1000 * np.array(brick["points"]), "The object .* at most 10 m. Are these millimetres"),
        ):  # fmt: skip
            with self.subTest(name), self.assertRaisesRegex(LiveError, words):
                controller.begin(**good | {name: value})
        controller.begin(**good)
        reading = Reading(
            joint_pos=self.home, joint_vel=[0.0] * 5, joint_time=0.0,
            object_pos=[0.5, 0.3, 0.1], object_quat=[1, 0, 0, 0], object_time=0.0,
        )  # fmt: skip
        controller.step(reading)
        for name, value in (("goal_pos", [500.0] * 3), ("target", [90.0] * 5)):
            controller.begin(**good)
            with self.subTest(f"no episode after a wrong {name}"):
                self.assertRaises(LiveError, controller.begin, **good | {name: value})
                self.assertRaisesRegex(LiveError, "No episode has begun", controller.step, reading)

    def test_a_reading_that_does_not_fit_is_refused(self):
        controller = load_controller(self.out)
        brick = self.contract["objects"]["brick"]
        reading = Reading(
            joint_pos=self.home, joint_vel=[0.0] * 5, joint_time=0.0,
            object_pos=[0.5, 0.3, 0.1], object_quat=[1, 0, 0, 0], object_time=0.0,
        )  # fmt: skip
        self.assertRaisesRegex(LiveError, "No episode has begun", controller.step, reading)
        goal = ([0.5, 0.3, 0.2], [1, 0, 0, 0])
        self.assertRaisesRegex(LiveError, "No episode has begun", controller.set_goal, *goal)
        controller.begin(brick["points"], *goal, self.home, brick["center"])
        self.assertEqual(controller.step(reading).shape, (1, 5))
        for changes, words in (
            ({"joint_pos": self.home[1:]}, r"joint_pos has shape \(1, 4\), expected \(1, 5\)"),
            ({"object_quat": [1, 0, 0]}, r"object_quat has shape \(1, 3\), expected \(1, 4\)"),
            ({"tip_force": [0, 0, 0]}, r"tip_force has shape \(1, 3\), expected \(1, 2, 3\)"),
        ):
            with self.subTest(words), self.assertRaisesRegex(LiveError, words):
                controller.step(replace(reading, **changes))

    def changed(self, place, value):
        """The contract with another value at a place, of a version that stated no hash."""
        contract = json.loads(json.dumps(self.contract))
        del contract["contract_sha256"]
        entry = contract
        for name in place[:-1]:
            entry = entry[name]
        entry[place[-1]] = value
        return contract

    def test_a_contract_that_no_robot_may_follow_is_refused(self):
        load = {"source": "It"}
        Controller(self.changed(("rate",), 60), **load)
        joint = ("joints", 1)
        step = ("kinematics", "steps", 1)
        mirrored = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
        for place, values in (
            (("control_dt",), (1e-30, -0.016, True, 50.0, None)),
            (("joints",), ([], [{}] * 5, [3])),
            ((*joint, "step"), (50.0, -0.01, None, "x", float("nan"))),
            ((*joint, "lead"), (50.0, -1.0)),
            ((*joint, "above"), (float("nan"), -1.0)),
            ((*joint, "home"), ("0",)),
            ((*joint, "lower"), (None, 1e9, float("-inf"))),
            ((*joint, "upper"), (None, -50.0)),
            ((*joint, "group"), ("leg",)),
            (("observation", "rotation"), ("euler", None)),
            (("observation", "joint_target"), (1,)),
            (("observation", "cloud_points"), (0, 64.0, 10**400)),
            (("observation", "cloud_scale"), ("x", -1.0)),
            (("observation",), ({},)),
            (("action", "hand"), ("quick",)),
            (("object_frame",), ("table",)),
            (("kinematics",), ({},)),
            (("kinematics", "base"), (mirrored, np.eye(3).tolist())),
            (("kinematics", "palm"), (-1, 99, 1.0)),
            (("kinematics", "tips"), ([0], [-1, 0], 0)),
            ((*step, "parent"), (-1, 2)),
            ((*step, "joint"), (-1, 5, None)),
            ((*step, "axis"), ([5, 0, 0], [0, 0, 0], [1, 0])),
            ((*step, "origin"), (mirrored, (1000 * np.eye(4)).tolist())),
            ((*step, "multiplier"), (float("inf"),)),
            (("objects", "brick"), ({}, 3)),
            (("objects", "brick", "points"), ([[0, 0, float("nan")]] * 64, [])),
        ):
            *_, last = (part for part in place if isinstance(part, str))
            for value in values:
                with self.subTest(place, value=value), self.assertRaisesRegex(LiveError, last):
                    Controller(self.changed(place, value), **load)

    @skipUnless(find_spec("websockets"), "websockets is not installed")
    def test_controller_server_and_runner_judge_quaternions_alike(self):
        from xreset.live.serve import _Episode

        episode = _Episode(load_controller(self.out))
        controller = episode._controller
        goal = {"goal_pos": [0.5, 0.3, 0.2], "goal_quat": [1, 0, 0, 0]}
        begin = {"begin": goal | {"object": "brick", "target": self.home}}
        self.assertEqual(episode.answer(json.dumps(begin)), {"begun": True})
        long = [1.3, 0, 0, 0]
        message = json.dumps({"goal": goal | {"goal_quat": long}})
        driver = Robot(
            self.home, lambda time, reading: replace(reading, object_quat=np.array(long))
        )
        self.assertIn("expected a unit quaternion", episode.answer(message)["error"])
        with self.assertRaisesRegex(LiveError, "expected a unit quaternion"):
            controller.set_goal(goal["goal_pos"], long)
        self.assertTrue(Runner(controller, driver).run(0.05).refused.all())
        with patch("xreset.runtime.rotations.UNIT_TOLERANCE", 0.5):
            self.assertEqual(episode.answer(message), {"goal": True})
            controller.set_goal(goal["goal_pos"], long)
            self.assertFalse(Runner(controller, driver).run(0.05).refused.any())

    def test_another_version_and_damage_are_refused(self):
        file = self.out / "contract.json"
        original = file.read_text()
        for change, words in (
            (
                {"schema": "xreset-deploy/9"},
                "has schema 'xreset-deploy/9', this runtime reads 'xreset-deploy/1'",
            ),
            ({"policy_sha256": "0" * 64}, "has SHA-256 .* the contract names 000000000000"),
            (
                {"observation": {"smell": 1}},
                "observation options that this runtime does not know: smell",
            ),
            ({"observation": None}, "contract.json lacks observation, or has another type"),
            ({"policy_sha256": None}, "contract.json lacks policy_sha256"),
            ({"joints": {}}, "contract.json lacks joints"),
            ({"rate": 30.0}, "contract.json was changed after its export"),
        ):
            file.write_text(json.dumps(self.contract | change))
            with self.subTest(words), self.assertRaisesRegex(LiveError, words):
                load_controller(self.out)
            self.assertRaisesRegex(LiveError, words, read_contract, self.out)
        file.write_text('{"a": ' * 200_000)
        self.assertRaisesRegex(LiveError, "is not an exported policy", load_controller, self.out)
        other = self.changed(("observation", "cloud_history"), 3)
        file.write_text(json.dumps(other | {"contract_sha256": digest(other)}))
        words = "contract.json is damaged, or does not fit its policy"
        self.assertRaisesRegex(LiveError, words, load_controller, self.out)
        file.write_text("[]")
        self.assertRaisesRegex(LiveError, "has schema 'None', this", load_controller, self.out)
        file.write_text(original[:100])
        self.assertRaisesRegex(LiveError, "is not an exported policy", load_controller, self.out)
        self.assertRaisesRegex(LiveError, "None is not an exported policy", load_controller, None)
        self.assertRaisesRegex(LiveError, "^The contract has schema", Controller, str(self.out))

    @skipUnless(find_spec("websockets"), "websockets is not installed")
    def test_served_it_acts_alike_and_a_lost_server_stops_the_robot(self):
        from websockets.exceptions import WebSocketException
        from websockets.sync.client import connect

        from xreset.live.serve import PolicyServer

        with self.assertRaisesRegex(XResetError, "port is 65536, expected"):
            PolicyServer(self.contract, b"", port=65536)
        server = PolicyServer(self.contract, (self.out / "policy.onnx").read_bytes(), port=0)
        thread = threading.Thread(target=server.serve)
        thread.start()
        self.addCleanup(thread.join)
        self.addCleanup(server.close)
        brick = self.contract["objects"]["brick"]
        start = (brick["points"], [0.5, 0.3, 0.2], [1, 0, 0, 0], self.home, brick["center"])
        local = load_controller(self.out)
        remote = RemoteController(server.url, timeout=20)
        driver = Robot(self.home)
        targets = []
        for controller in (local, remote):
            controller.begin(*start)
            targets.append([controller.step(driver.read()).copy() for _ in range(3)])
        np.testing.assert_array_equal(*targets)
        self.assertIn("brick: 5 joint targets", run("12_served_policy", server.url, 3))
        remote.set_goal([0.5, 0.3, 0.3], [0, 1, 0, 0])
        with (
            patch("xreset.live.serve._MOST_CLIENTS", 1),
            connect(server.url) as another,
            self.assertRaisesRegex(WebSocketException, "1 clients are connected"),
        ):
            another.recv(timeout=5)
        with self.assertRaises(WebSocketException):  # a page in a browser
            connect(server.url, origin="http://elsewhere.example")  # type: ignore[arg-type]

        def close_after_a_second(time, reading):
            if 1 < time < 1.03:
                server.close()
            return reading

        driver = Robot(self.home, close_after_a_second)
        with self.assertLogs("xreset"):
            outcome = Runner(remote, driver).run(10)
        self.assertEqual(
            (outcome.reason, driver.stops), ("The policy could not act: the server has gone.", 1)
        )
        words = rf"No policy is served at {server.url} \(.*\). Start it: xreset serve POLICY"
        with self.assertRaisesRegex(SystemExit, words):
            run("12_served_policy", server.url)

    @skipUnless(find_spec("websockets"), "websockets is not installed")
    def test_an_answer_that_comes_late_is_not_used(self):
        hello = {"schema": "xreset-live/1", "contract": self.contract}
        begin = {"begun": True}
        target = {"target": self.home}
        start = (np.zeros((64, 3)), [0.5, 0.3, 0.2], [1, 0, 0, 0], self.home)
        for answers, words in (
            ((hello, begin, TimeoutError, target), "has not answered for 0.5 s"),
            ((hello, begin, KeyboardInterrupt, target), ""),
            ((hello, begin, [], target), "is a list, expected an object"),
            ((hello, begin, ConnectionError, target), "has gone"),
        ):
            with self.subTest(words), patch("websockets.sync.client.connect") as connect:
                socket = connect.return_value
                socket.recv.side_effect = [
                    answer if isinstance(answer, type) else json.dumps(answer) for answer in answers
                ]
                remote = RemoteController("ws://127.0.0.1:9")
                remote.begin(*start)
                with self.assertRaisesRegex(BaseException, words):
                    remote.step(Robot(self.home).read())
                again = "Make a new RemoteController"
                self.assertRaisesRegex(LiveError, again, remote.begin, *start)
                self.assertRaisesRegex(LiveError, again, remote.step, Robot(self.home).read())
                self.assertEqual(socket.recv.call_count, 3)
        for answer in (begin, {"target": [0.0]}, {"target": ["x"]}):
            with self.subTest(answer), patch("websockets.sync.client.connect") as connect:
                connect.return_value.recv.side_effect = map(json.dumps, (hello, begin, answer))
                remote = RemoteController("ws://127.0.0.1:9")
                remote.begin(*start)
                with self.assertRaisesRegex(LiveError, "the server's (answer holds no )?target"):
                    remote.step(Robot(self.home).read())

    def test_the_example_of_a_driver(self):
        rows = 11
        brick = self.contract["objects"]["brick"]
        arrays = {
            "time": np.arange(rows) * 0.05,
            "frame_offsets": [0, rows],
            "object_name": ["brick"],
        }
        arrays |= {name: np.tile(self.home, (rows, 1)) for name in ("joint_pos", "joint_target")}
        arrays |= {"object_pos": np.tile(brick["center"], (rows, 1)), "goal_pos": [[0.5, 0.3, 0.2]]}
        arrays |= {
            "object_quat_wxyz": np.tile([1, 0, 0, 0], (rows, 1)),
            "goal_quat_wxyz": [[1, 0, 0, 0]],
        }
        np.savez(f"{self.folder}/episodes.npz", **arrays)
        said = run("11_own_driver", self.out, self.folder / "episodes.npz")
        self.assertIn("30 steps; stopped because: the recording is over", said)
        self.assertIn("the robot holds still", said)

    @skipUnless(find_spec("websockets"), "websockets is not installed")
    def test_a_wrong_message_gets_a_sentence(self):
        from xreset.live.serve import _Episode

        episode = _Episode(load_controller(self.out))
        begin = {
            "object": "brick",
            "goal_pos": [0, 0, 1],
            "goal_quat": [1, 0, 0, 0],
            "target": self.home,
        }
        for message, words in (
            ('{"a":' * 5000, "is not JSON"),
            ("[]", "exactly one key. Choose from: begin, goal, step"),
            ({"step": {}}, "no episode yet. Send begin first"),
            ({"begin": 3}, "begin is not an object"),
            ({"begin": begin | {"object": ["hat"]}}, "no object"),
            ({"begin": begin | {"goal_pos": [0, 0, float("nan")]}}, "goal_pos has shape"),
            (
                {"begin": begin | {"goal_pos": [0, 0, 10**400]}},
                "goal_pos holds something that is not a number",
            ),
            (
                {"begin": begin | {"goal_quat": [1, 1, 0, 0]}},
                "length 1.414, expected a unit quaternion",
            ),
        ):
            text = message if isinstance(message, str) else json.dumps(message)
            with self.subTest(text[:60]):
                self.assertRegex(episode.answer(text)["error"], words)
        self.assertEqual(episode.answer(json.dumps({"begin": begin})), {"begun": True})
        self.assertIn("joint_pos is missing", episode.answer('{"step": {}}')["error"])
        told = episode.answer(json.dumps({"begin": begin | {"object": "x" * 500_000}}))
        self.assertLess(len(told["error"]), 500)
        self.assertEqual(episode.answer(json.dumps({"begin": begin})), {"begun": True})
        reading = {
            "joint_pos": self.home, "joint_vel": [0] * 5, "object_pos": [0.5, 0.3, 0.1],
            "object_quat": [1, 0, 0, 0], "tip_force": [[0, 0, 0]] * 2,
        }  # fmt: skip
        self.assertIn("target", episode.answer(json.dumps({"step": reading})))
        for name, value, words in (
            ("joint_pos", [1e30] * 5, "joint_pos of .* is 1e.30, expected .*degrees"),
            ("joint_pos", [90.0] * 5, "degrees"),
            ("joint_vel", [3e38] * 5, r"joint_vel holds 3e\+38, expected at most 100 rad/s"),
            ("object_pos", [500.0, 0, 0], "The object has the coordinate 500.*millimetres"),
            ("tip_force", [[1e6, 0, 0]] * 2, "tip_force holds 1e.06"),
        ):
            answer = episode.answer(json.dumps({"step": reading | {name: value}}))
            with self.subTest(name):
                self.assertRegex(answer.get("error", ""), words)

    @skipUnless(find_spec("websockets"), "websockets is not installed")
    def test_the_command_serves_where_it_is_told_to(self):
        with (
            patch("xreset.live.serve.PolicyServer") as server,
            patch("xreset.pictures.view.server.serve_until_interrupted") as served,
        ):
            server.return_value.url = "ws://0.0.0.0:9"
            options = ("--host", "0.0.0.0", "--port", 9, "--object", "banana")
            said = succeeds("serve", "nine-objects", *options)
        contract, network = server.call_args.args
        self.assertEqual(list(contract["objects"]), ["011_banana"])
        self.assertEqual(network, load_policy("nine-objects").exported())
        self.assertEqual(server.call_args.kwargs, {"host": "0.0.0.0", "port": 9})
        served.assert_called_once_with(server.return_value)
        self.assertIn("nine-objects for ur7e-sharpa at ws://0.0.0.0:9, 60 steps per second", said)
        self.assertIn("There is no password", said)

    @skipUnless(find_spec("websockets"), "websockets is not installed")
    def test_a_policy_is_served_from_a_thread_of_a_notebook(self):
        said: Queue[str] = Queue()
        with patch("builtins.print", said.put):
            arguments = {"port": 0, "only": ["banana"]}
            threading.Thread(
                target=xreset.serve, args=["nine-objects"], kwargs=arguments, daemon=True
            ).start()
            url = said.get(timeout=60).split()[4].rstrip(",")
        controller = RemoteController(url)
        self.assertEqual(list(controller.contract["objects"]), ["011_banana"])
        controller.close()

    def test_a_baseline_and_cameras_are_refused(self):
        self.assertIn(
            "The baseline 'zero' is not an exported policy",
            refused("export", "deploy", "zero", "--robot", "openarm", "--out", f"{self.folder}/x"),
        )
        seeing = replace(self.task, vision=VisionConfig(cameras=(CameraConfig(),)))
        with self.assertRaisesRegex(PolicyError, "The policy has cameras"):
            deploy_contract(toy_grasp.robot(), seeing, [])


class Robot(Scripted):
    """The toy gripper at home."""

    def __init__(self, home, fault=lambda time, reading: reading):
        super().__init__(fault)
        self.home = np.array(home)

    def read(self):
        return replace(
            super().read(), joint_pos=self.home, joint_vel=0 * self.home, tip_force=np.zeros((2, 3))
        )
