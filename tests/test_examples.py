"""The numbered examples run as they are, in their order, and stay short; `import xreset` has the names that it promises."""

import contextlib
import importlib
import inspect
import io
import os
import re
import subprocess
import sys
from functools import partial
from pathlib import Path
from unittest import TestCase, mock

import trimesh

import xreset
from tests.data import InFolder, InOneFolder, refuses
from tests.toy_bank import ONLY_FRAMES
from tests.toy_retarget import retargets_quickly

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
NUMBERED = sorted(EXAMPLES.glob("[0-9]*.py"))


def run(name, *arguments):
    with (
        mock.patch.object(sys, "path", [str(EXAMPLES), *sys.path]),
        contextlib.redirect_stdout(io.StringIO()) as out,
    ):
        importlib.import_module(name).main(*arguments)
    return out.getvalue()


class FaceTest(TestCase):
    def test_every_name_is_there_and_documented(self):
        for name in xreset.__all__:
            self.assertTrue(getattr(xreset, name).__doc__, name)
        self.assertEqual({*dir(xreset)}, {*xreset.__all__, "__version__"})
        with self.assertRaises(AttributeError):
            xreset.no_such_name  # noqa: B018

    def test_every_type_in_the_signature_of_a_function_is_a_public_name(self):
        python = "Path Callable Sequence Iterable Mapping Module Literal None Any Self"
        ours = "Data PositiveInt PositiveFloat Seed"
        of_commands = "Annotated Device Option Output Port Pose Png Rate Progress NamedProgress"
        of_commands += " OutputFile ArchiveFile Onnx Mp4 EngineName RobotName"
        elsewhere = {*python.split(), *ours.split(), *of_commands.split()}
        functions = 0
        for name in xreset.__all__:
            value = getattr(xreset, name)
            if inspect.isfunction(value):
                functions += 1
                annotations = " ".join(map(str, value.__annotations__.values()))
                types = set(re.findall(r"\b[A-Z]\w+", annotations))
                self.assertLessEqual(types, {*xreset.__all__, *elsewhere}, name)
        self.assertGreater(functions, 20)


class ShelfTest(InFolder):
    def test_examples_are_numbered_and_short(self):
        self.assertEqual(
            [file.name[:2] for file in NUMBERED], [f"{number:02}" for number in range(13)]
        )
        for file in NUMBERED:
            self.assertLess(len(file.read_text().splitlines()), 70, file.name)

    def test_without_gymnasium_the_error_says_what_to_install(self):
        with mock.patch.dict(sys.modules, {"gymnasium": None}):
            sys.modules.pop("xreset.env.vector_env", None)
            vars(xreset).pop("VectorEnv", None)
            with self.assertRaisesRegex(
                xreset.errors.XResetError, r"pip install 'xreset\[gymnasium\]'"
            ):
                xreset.VectorEnv  # noqa: B018

    def test_an_engine_is_checked(self):
        lines = run("06_own_engine").splitlines()
        self.assertEqual([line.split()[0] for line in lines], ["passed", "passed", "failed"], lines)

    def test_a_shipped_policy_is_filmed_with_an_unseen_object(self):
        trimesh.creation.cylinder(radius=0.035, height=0.09).export(self.folder / "beaker.obj")
        film = partial(xreset.film, fps=2, size=(320, 240))
        make_bank = partial(xreset.make_bank, **ONLY_FRAMES)
        with mock.patch.multiple(xreset, film=film, make_bank=make_bank), retargets_quickly():
            run("00_film_a_policy", self.folder, "beaker", f"{self.folder}/film.mp4")
        self.assertGreater((self.folder / "film.mp4").stat().st_size, 2_000)

    def test_a_robot_is_checked(self):
        self.assertIn("my-robot: 0 errors", run("05_own_robot", self.folder))
        self.assertTrue((self.folder / "my-robot" / "robot.png").is_file())


class FromABankTest(InOneFolder):
    """Examples that need the files of the first two."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.loaded = run("01_load_and_view", cls.folder)
        with retargets_quickly():
            cls.retargeted = run("02_retarget_own_keypoints", cls.folder)
        cls.bank = cls.folder / "bank.npz"

    def test_a_bank_is_made(self):
        self.assertIn("2 demonstrations", self.loaded)
        self.assertRegex(self.retargeted, r"[1-9]\d* states are stable")
        self.assertGreater((self.folder / "demos.png").stat().st_size, 1000)

    def test_an_environment_is_stepped(self):
        said = run("03_step_an_environment", self.bank)
        self.assertIn("return after 60 steps", said)
        self.assertRegex(
            said, r"picture of the first world: \(480, 640, 3\), mean brightness [1-9]"
        )

    def environment(self, num_envs):
        bank = xreset.read_bank(self.bank)
        objects = [xreset.load_object(name) for name in bank.object_names]
        return xreset.make_env(xreset.load_robot("openarm"), objects, bank, num_envs=num_envs)

    def test_pictures_show_the_world_that_was_asked_for(self):
        with self.environment(2) as env:
            first = env.render(0, (64, 48))
            self.assertEqual(first.shape, (48, 64, 3))
            self.assertTrue((first == env.render(0, (64, 48))).all())
            env.goal_pos[1] += 0.1
            self.assertTrue((first != env.render(1, (64, 48))).any())
            with self.assertRaisesRegex(xreset.XResetError, "world is 2, expected one from 0 to 1"):
                env.render(2)

    def test_a_reward_term_pays(self):
        self.assertRegex(
            run("04_own_reward", self.bank), r"upright pays -?0\.[0-4]\d*[1-9]\d* per step"
        )

    def test_a_policy_is_trained(self):
        said = run("07_train", self.bank, self.folder / "run")
        self.assertIn("trained run for 2 iterations, on 005_tomato_soup_can", said)
        self.assertTrue((self.folder / "run" / "policy.onnx").is_file())

    def test_a_policy_is_evaluated(self):
        self.assertRegex(
            run("08_evaluate_and_plot", self.folder, ("mujoco",)), r"task progress [1-9]\d*%"
        )
        self.assertTrue((self.folder / "progress.png").is_file())

    def test_a_policy_plays_where_nothing_can_train(self):
        hidden = "import sys; sys.modules.update(dict.fromkeys(('rsl_rl', 'warp', 'mujoco_warp', 'onnx', 'tensorboard')))"
        program = f"{hidden}; sys.path.insert(0, {str(EXAMPLES)!r}); __import__('09_play_a_policy').main(sys.argv[1])"
        done = subprocess.run(
            [sys.executable, "-c", program, self.folder / "demos.npz"],
            capture_output=True, text=True, env=os.environ | {"OMP_NUM_THREADS": "1"},
        )  # fmt: skip
        self.assertEqual(done.returncode, 0, done.stderr)
        distance = done.stdout.partition("the object ends ")[2].partition(" cm")[0]
        self.assertLess(float(distance), 5.0, done.stdout)

    def test_a_policy_says_where_it_cannot_play(self):
        graph = self.folder / "graph.onnx"
        graph.write_bytes(xreset.load_policy("many-objects").graph)
        with self.environment(1) as env:
            for arguments, message in (
                (
                    ("many-objects", env, "film.mp4"),
                    "many-objects is a policy of the robot 'ur7e-sharpa', not of 'openarm'",
                ),
                (
                    (graph, env, "film.mp4"),
                    "The graph is a policy of the robot 'ur7e-sharpa', not of 'openarm'",
                ),
                (("no-such-policy", env, "film.mp4"), "no-such-policy"),
                (
                    ("zero", xreset.VectorEnv(env), "film.mp4"),
                    "^env is VectorEnv.* expected an env",
                ),
                (
                    ("many-objects", env, "film.gif"),
                    "^path is 'film.gif', expected a name that ends in .mp4",
                ),
            ):
                with refuses(self, message, xreset.XResetError):
                    xreset.film(*arguments)
            with self.assertRaisesRegex(xreset.XResetError, "^films of 641 x 480 pixels cannot be"):
                xreset.film("many-objects", env, "film.mp4", size=(641, 480))
            with self.assertRaisesRegex(xreset.XResetError, "World 1 does not exist"):
                xreset.film("many-objects", env, "film.mp4", world=1)
            with self.assertRaisesRegex(xreset.XResetError, "fps is 0, expected a number above"):
                xreset.film("many-objects", env, "film.mp4", fps=0)

    def test_other_learning_code_trains(self):
        self.assertRegex(run("10_gymnasium", self.bank), r"iteration 3: reward per step -?\d")
