"""Engine plugins: how they are found and what goes wrong; and the examples, where their engines are installed."""

import importlib
import re
import sys
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar
from unittest import SkipTest, TestCase
from unittest.mock import patch

from torch.testing import assert_close

from tests.command import succeeds
from tests.data import InFolder
from tests.engine_checks import with_drive
from xreset.backends.conformance import CHECKS, run
from xreset.backends.conformance.scene import scene
from xreset.errors import BackendUnavailableError, CapabilityError
from xreset.physics import plugins
from xreset.physics.plugins import backend_status, make_backend

EXAMPLES = {"drake": "pydrake", "newton": "newton"}
"""What each example's engine is imported as."""


def folder_of(engine):
    return Path(__file__).resolve().parents[1] / "examples" / f"xreset-{engine}"


def declared(engine):
    """The entry point of an example, as its pyproject.toml states it."""
    project = tomllib.loads((folder_of(engine) / "pyproject.toml").read_text())["project"]
    [(name, value)] = project["entry-points"][plugins.ENGINES].items()
    return EntryPoint(name=name, value=value, group=plugins.ENGINES)


class Unavailable(TestCase):
    def assert_unavailable(self, engine, pattern):
        with self.assertRaisesRegex(BackendUnavailableError, pattern):
            make_backend(engine, scene(), 1)
        self.assertRegex(backend_status(engine).reason or "", pattern)


class PluginTest(InFolder, Unavailable):
    """Without any foreign engine: a package in a folder of its own, made known by an entry point."""

    def plugin(self, source, value="someones_engine:SomeonesBackend"):
        (self.folder / "someones_engine.py").write_text(source)
        self.enterContext(patch.object(sys, "path", [str(self.folder), *sys.path]))
        self.enterContext(patch.dict(sys.modules))
        sys.modules.pop("someones_engine", None)
        entry = EntryPoint(name="someones", value=value, group=plugins.ENGINES)
        self.enterContext(patch.object(plugins, "entry_points", return_value=[entry]))

    def test_a_plugin_is_found_built_and_tested_like_any_engine(self):
        self.plugin(
            "from xreset.backends.mujoco import MujocoBackend\n"
            "class SomeonesBackend(MujocoBackend):\n"
            "    name = 'someones'\n"
            "    @classmethod\n"
            "    def engine_version(cls): return '7.1'\n"
        )
        self.assertEqual(backend_status("someones").version, "7.1")
        with make_backend("someones", scene(), 1) as backend:
            self.assertEqual(backend.name, "someones")
        said = succeeds("engines check --engine someones --check state_round_trip")
        self.assertIn("someones 7.1", said)
        self.assertIn("no check failed", said)

    def test_a_plugin_that_cannot_be_used_says_why(self):
        backend = "SomeonesBackend"
        install = "from xreset.errors import BackendUnavailableError as E\nraise E('pip install their-engine')\n"
        for source, name, pattern in (
            (
                "import nothing\n",
                backend,
                r"(?s)'someones' \(someones_engine:SomeonesBackend\) does not load.*nothing",
            ),
            ("", "Misspelt", "does not load.*Misspelt"),
            (
                f"def {backend}(scene, num_worlds): ...\n",
                backend,
                "a class that inherits from xreset.physics.Backend",
            ),
            (
                "from xreset.backends.pool import PoolBackend\n"
                f"class {backend}(PoolBackend):\n    name = 'someones'\n",
                backend,
                "^the engine 'someones' is not complete. Add to SomeonesBackend: "
                "capabilities, engine_version, world_class.$",
            ),
            (install, backend, "^pip install their-engine$"),
        ):
            with self.subTest(source):
                self.plugin(source, value=f"someones_engine:{name}")
                self.assert_unavailable("someones", pattern)

    def test_a_defect_of_one_plugin_does_not_hide_the_others(self):
        self.plugin(
            "from xreset.backends.mujoco import MujocoBackend\n"
            "class SomeonesBackend(MujocoBackend):\n"
            "    @classmethod\n"
            "    def engine_version(cls): raise KeyError('version')\n"
        )
        self.assertIn("engine_version() fails: KeyError", backend_status("someones").reason or "")
        self.assertIn("someones", succeeds("engines list"))


class ExampleTest(Unavailable):
    def test_without_its_engine_an_example_says_what_to_install(self):
        for engine, package in EXAMPLES.items():
            ours = f"xreset_{engine}"
            modules: dict[str, Any] = {package: None}
            for name, module in sys.modules.items():
                if not name.startswith(ours):
                    modules[name] = None if name.split(".")[0] == package else module
            with (
                self.subTest(engine),
                patch.object(sys, "path", [str(folder_of(engine)), *sys.path]),
                patch.dict(sys.modules, modules, clear=True),
                patch.object(plugins, "entry_points", return_value=[declared(engine)]),
            ):
                self.assert_unavailable(engine, f"pip install '?{engine}")

    def test_they_use_the_public_interface_only(self):
        public = {
            "xreset.physics",
            "xreset.physics.torch_warp",
            "xreset.backends.pool",
            "xreset.backends.batch",
            "xreset.backends.rigid",
            "xreset.geometry.rotations",
            "xreset.spec",
            "xreset.errors",
        }
        for engine in EXAMPLES:
            for file in folder_of(engine).rglob("*.py"):
                for module in re.findall(
                    r"^\s*(?:from|import) (xreset\.\S+)", file.read_text(), re.MULTILINE
                ):
                    self.assertIn(module, public, file.name)
                self.assertNotRegex(file.read_text(), r"from xreset\..* import .*\b_\w", file.name)


class EngineTest:
    """The quick checks of the suite, mixed into a ``TestCase``. Skipped where the engine is not installed."""

    engine: ClassVar[str]
    checks: ClassVar[str]
    options: ClassVar[dict[str, Any]] = {}

    @classmethod
    def setUpClass(cls):
        try:
            importlib.import_module(EXAMPLES[cls.engine])
        except ImportError:
            raise SkipTest(
                f"{cls.engine} is not installed: pip install -e examples/xreset-{cls.engine}"
            ) from None
        cls.enterClassContext(patch.object(sys, "path", [str(folder_of(cls.engine)), *sys.path]))
        cls.backend = declared(cls.engine).load()

    def make(self, scene, num_worlds, *, object_index=None):
        return self.backend(scene, num_worlds, object_index=object_index, **self.options)

    def test_checks_of_the_suite(self):  # pyright: ignore[reportGeneralTypeIssues]
        for result in run(self.make, only=self.checks.split()):
            with self.subTest(result.name):
                said = f"{result.worst} {result.problem}"
                self.assertIn(result.verdict, ("passed", "known difference"), said)
        for known in self.backend.known_differences:
            self.assertIn(known.check, {check.name for check in CHECKS})


class NewtonTest(EngineTest, TestCase):
    engine = "newton"
    checks = """
        state_round_trip links_after_set nothing_stays selected_worlds twins masked_set mass_properties free_spin
        object_gravity object_wrench resting_weight held_object tip_friction broken_world
    """

    def test_what_it_lacks_is_refused(self):
        rough = with_drive(scene().robot, "lift", friction_loss=0.1)
        words = "no dry friction of joints on the CPU: give the robot's drives a friction_loss of 0"
        with self.assertRaisesRegex(CapabilityError, words):
            self.make(scene(rough), 1)


class DrakeTest(EngineTest, TestCase):
    engine = "drake"
    options: ClassVar[dict[str, Any]] = {"workers": 0}
    checks = """
        state_round_trip links_after_set nothing_stays masked_set mass_properties drive_equation free_spin
        object_gravity object_wrench resting_weight set_as_built held_object tip_friction broken_world
    """

    def test_a_pair_has_its_friction(self):
        from xreset_drake.model import OBJECT_FRICTION, friction_of_other  # pyright: ignore[reportMissingImports]

        for pair in (0.0, 0.3, 1.2):
            other = friction_of_other(pair)
            self.assertAlmostEqual(2 * OBJECT_FRICTION * other / (OBJECT_FRICTION + other), pair)

    def test_a_world_that_drake_gives_up_is_broken_until_it_is_set(self):
        with self.make(scene(), 1) as backend:
            good = backend.state().clone()
            [world] = backend._team._worlds
            with (
                patch.object(world, "_simulator") as simulator,
                self.assertWarnsRegex(
                    UserWarning,
                    "gives up on a world, which counts as not finite from now on: too much",
                ),
            ):
                simulator.AdvanceTo.side_effect = RuntimeError("too much")
                backend.step()
            self.assertTrue(backend.health().nonfinite[0])
            self.assertTrue(backend.links().pos.isnan().all())
            backend.set_state(good)
            backend.step()
            self.assertFalse(backend.health().nonfinite[0])
            assert_close(backend.state().object_pos, good.object_pos, atol=1e-3, rtol=0)
