"""Engine plugins: how they are found and what goes wrong; and the example, where its engine is installed."""

from __future__ import annotations

import contextlib
import io
import sys
import tempfile
import tomllib
import unittest
from importlib.metadata import EntryPoint
from pathlib import Path
from unittest import mock

import torch

from xreset import plugins
from xreset.backends import backend_status, make_backend
from xreset.backends.conformance import run
from xreset.backends.conformance.scene import scene
from xreset.cli import main
from xreset.errors import BackendUnavailableError

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "xreset-drake"
MISSING = "Drake is not installed: pip install -e examples/xreset-drake"


def declared() -> EntryPoint:
    """The entry point of the example, as its pyproject.toml states it."""
    project = tomllib.loads((EXAMPLE / "pyproject.toml").read_text())["project"]
    [(name, value)] = project["entry-points"][plugins.ENGINES].items()
    return EntryPoint(name=name, value=value, group=plugins.ENGINES)


class PluginTest(unittest.TestCase):
    """Without any foreign engine: a package in a folder of its own, made known by an entry point."""

    def plugin(self, source: str, value: str = "someones_engine:SomeonesBackend") -> None:
        folder = Path(self.enterContext(tempfile.TemporaryDirectory()))
        (folder / "someones_engine.py").write_text(source)
        self.enterContext(mock.patch.object(sys, "path", [str(folder), *sys.path]))
        self.enterContext(mock.patch.dict(sys.modules))
        sys.modules.pop("someones_engine", None)
        entry = EntryPoint(name="someones", value=value, group=plugins.ENGINES)
        self.enterContext(mock.patch.object(plugins, "entry_points", lambda group: [entry]))

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
        with contextlib.redirect_stdout(io.StringIO()) as out:
            main(["engines", "check", "--backend", "someones", "--check", "state_round_trip"])
        self.assertIn("someones 7.1", out.getvalue())
        self.assertIn("no check failed", out.getvalue())

    def assert_unavailable(self, pattern: str) -> None:
        with self.assertRaisesRegex(BackendUnavailableError, pattern):
            make_backend("someones", scene(), 1)
        self.assertRegex(backend_status("someones").reason or "", pattern)

    def test_a_plugin_that_does_not_load_says_where(self):
        self.plugin("import no_such_engine\n")
        self.assert_unavailable(r"(?s)'someones' \(someones_engine:SomeonesBackend\) does not load.*no_such_engine")

    def test_an_entry_point_that_names_nothing(self):
        self.plugin("", value="someones_engine:Misspelt")
        self.assert_unavailable("does not load.*Misspelt")

    def test_an_entry_point_that_names_no_backend(self):
        self.plugin("def SomeonesBackend(scene, num_worlds): return None\n")
        self.assert_unavailable("expected a class that inherits from xreset.physics.Backend")

    def test_a_plugin_that_says_what_to_install_is_quoted(self):
        self.plugin("from xreset.errors import BackendUnavailableError\nraise BackendUnavailableError('pip install their-engine')\n")
        self.assert_unavailable("^pip install their-engine$")

    def test_a_defect_of_one_plugin_does_not_hide_the_others(self):
        self.plugin(
            "from xreset.backends.mujoco import MujocoBackend\n"
            "class SomeonesBackend(MujocoBackend):\n"
            "    @classmethod\n"
            "    def engine_version(cls): raise KeyError('version')\n"
        )
        self.assertIn("engine_version() fails: KeyError", backend_status("someones").reason or "")
        with contextlib.redirect_stdout(io.StringIO()) as out:
            main(["engines", "list"])
        self.assertIn("someones", out.getvalue())


class ExampleTest(unittest.TestCase):
    def setUp(self):
        self.enterContext(mock.patch.object(sys, "path", [str(EXAMPLE), *sys.path]))

    def test_without_its_engine_the_example_says_what_to_install(self):
        absent = {name: None for name in list(sys.modules) if name.split(".")[0] == "pydrake"} | {"pydrake": None}
        kept = {name: module for name, module in sys.modules.items() if not name.startswith("xreset_drake")}
        with (
            mock.patch.dict(sys.modules, kept | absent, clear=True),
            mock.patch.object(plugins, "entry_points", lambda group: [declared()]),
        ):
            with self.assertRaisesRegex(BackendUnavailableError, "pip install drake"):
                make_backend("drake", scene(), 1)
            self.assertIn("pip install drake", backend_status("drake").reason or "")

    def test_it_uses_the_public_interface_only(self):
        public = {"xreset.physics", "xreset.backends.pool", "xreset.backends.rigid", "xreset.spec", "xreset.errors"}
        for file in EXAMPLE.rglob("*.py"):
            for line in file.read_text().splitlines():
                words = line.split()
                if words[:1] in (["from"], ["import"]) and words[1].split(".")[0] == "xreset":
                    self.assertIn(words[1], public, f"{file.name}: {line}")
                    self.assertNotRegex(line, r"import .*\b_\w", f"{file.name}: {line}")


class DrakeTest(unittest.TestCase):
    """What the suite takes minutes for is left to `xreset engines check --backend drake`."""

    def setUp(self):
        try:
            import pydrake  # noqa: F401
        except ImportError:
            self.skipTest(MISSING)
        self.enterContext(mock.patch.object(sys, "path", [str(EXAMPLE), *sys.path]))
        from xreset_drake import backend  # pyright: ignore[reportMissingImports]

        self.module = backend

    def make(self, scene, num_worlds, *, object_index=None):
        return self.module.DrakeBackend(scene, num_worlds, object_index=object_index, workers=0)

    def test_checks_of_the_suite(self):
        wanted = [
            *("state_round_trip", "links_after_set", "nothing_stays", "masked_set", "mass_properties", "drive_equation", "free_spin"),
            *("object_gravity", "object_wrench", "resting_weight", "object_mass", "held_object", "tip_friction", "broken_world"),
        ]
        for result in run(self.make, only=wanted):
            with self.subTest(result.name):
                self.assertEqual(result.verdict, "passed", f"{result.worst} {result.problem}")

    def test_every_known_difference_names_a_check(self):
        from xreset.backends.conformance import CHECKS

        for known in self.module.DrakeBackend.known_differences:
            self.assertIn(known.check, {check.name for check in CHECKS})

    def test_a_pair_has_its_friction(self):
        from xreset_drake.model import OBJECT_FRICTION, friction_of_other  # pyright: ignore[reportMissingImports]

        for pair in (0.0, 0.3, 1.2):
            other = friction_of_other(pair)
            self.assertAlmostEqual(2 * OBJECT_FRICTION * other / (OBJECT_FRICTION + other), pair)

    def test_a_world_that_drake_gives_up_is_broken_until_it_is_set(self):
        with self.make(scene(), 1) as backend:
            good = backend.state()
            good = type(good)(**{name: value.clone() for name, value in vars(good).items()})
            [world] = backend._team._worlds
            with (
                mock.patch.object(world, "_simulator") as simulator,
                self.assertWarnsRegex(UserWarning, "gives up on a world, which counts as not finite from now on: too much"),
            ):
                simulator.AdvanceTo.side_effect = RuntimeError("too much")
                backend.step()
            self.assertTrue(bool(backend.health().nonfinite[0]))
            self.assertTrue(bool(backend.links().pos.isnan().all()))
            backend.set_state(good)
            backend.step()
            self.assertFalse(bool(backend.health().nonfinite[0]))
            torch.testing.assert_close(backend.state().object_pos, good.object_pos, atol=1e-3, rtol=0)


if __name__ == "__main__":
    torch.set_num_threads(1)
    unittest.main()
