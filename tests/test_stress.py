"""Sweeps of one property at a time: what is swept, what is found, and what is refused. No physics but for one short run."""

import shutil
from dataclasses import replace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
from numpy.testing import assert_allclose

from tests.command import refused, succeeds, xreset
from tests.data import InFolder, refuses
from tests.toy_bank import SOUP
from tests.toy_results import swept
from xreset.errors import XResetError
from xreset.eval.conditions import PROPERTIES, SWEPT, chosen_properties, nominal_task
from xreset.eval.effects import by_property, curves, verdict
from xreset.eval.results import read_evaluation
from xreset.files.storage import claim
from xreset.policy.shipped import shipped
from xreset.task.config import RandomizationConfig, TaskConfig, evaluation_task


class StressedTest(TestCase):
    def test_nothing_is_random_and_one_thing_differs(self):
        task = evaluation_task(
            TaskConfig(
                randomization=RandomizationConfig(
                    arm_stiffness=(0.5, 2.0), friction=(0.4, 0.8), metal=0.2
                )
            )
        )
        plain = nominal_task(task).randomization
        self.assertEqual(
            (plain.friction, plain.mass_scale, plain.arm_stiffness, plain.metal),
            ((0.6000000000000001,) * 2, (1, 1), (1, 1), 0.2),
        )
        self.assertTrue(plain.enabled and not plain.scales_drives)
        for prop in SWEPT:
            value = prop.values[0]
            found = prop.at(value, nominal_task(task)).task
            set_to = 60 * value if prop.in_steps else value  # 60 control steps a second
            assert_allclose(getattr(found.randomization, prop.changed_field), (set_to, set_to))
            self.assertEqual(
                replace(
                    found.randomization, **{prop.changed_field: getattr(plain, prop.changed_field)}
                ),
                plain,
            )
            self.assertEqual(found.reset, task.reset)

    def test_images_are_late_by_whole_control_steps(self):
        (late,) = chosen_properties(["camera-latency=0.001,0.05,0.06"])
        task = replace(nominal_task(TaskConfig()), substeps=8)  # 30 control steps a second
        tried = [late.at(value, task) for value in late.values]
        self.assertEqual([condition.value for condition in tried], [0.033, 0.067, 0.067])
        drawn = [condition.task.randomization.camera_latency[0] for condition in tried]
        self.assertEqual(drawn, [1.0, 2.0, 2.0])

    def test_values_of_ones_own(self):
        (prop,) = chosen_properties(["arm-stiffness=2,0.5,1"])
        self.assertEqual((prop.option, prop.values), ("arm-stiffness", (0.5, 2.0)))
        self.assertEqual(
            chosen_properties(["arm_stiffness=2,0.5"]), (prop,), "as the field is written"
        )
        self.assertEqual(chosen_properties("arm-stiffness=2,0.5"), (prop,), "one")
        self.assertEqual(chosen_properties([]), SWEPT)
        twice = chosen_properties(["arm-stiffness=2", "arm-stiffness=0.5,2"])
        self.assertEqual(twice, (prop,), "a value that is played twice cannot be compared")

    def test_refusals(self):
        for text, words in (
            ("colour", "Unknown property 'colour'. Choose from: object-friction, .*pose-delay"),
            ("effort=much", "holds values that are not numbers. Write effort=VALUE"),
            ("effort=", "holds values that are not numbers. Write effort=VALUE"),
            ("effort=-1", "expected finite values of at least 0, other than the nominal 1"),
            ("effort=nan", "expected finite values"),
            ("pose-delay=200", "'pose-delay=200': 200 is too much. Give s, at most 2"),
            ("action-latency=1", "1 is too much. Give s, at most 0.5"),
        ):
            with refuses(self, words, XResetError, text):
                chosen_properties([text])
        (late,) = chosen_properties(["action-latency"])
        with self.assertRaisesRegex(
            XResetError, "action-latency 5 s cannot be tried: .* fewer than the 300 of an episode"
        ):
            late.at(5.0, TaskConfig())
        (missed,) = chosen_properties(["missed-deadlines=0.5"])
        with self.assertRaisesRegex(XResetError, "missed-deadlines 1.5 of the steps cannot be"):
            missed.at(1.5, TaskConfig())
        (light,) = chosen_properties(["object-mass=0"])
        with self.assertRaisesRegex(
            XResetError, "object-mass x 0 cannot be tried: mass_scale .*0.0.*above 0"
        ):
            light.at(0.0, TaskConfig())


class CurveTest(TestCase):
    def test_the_limit_is_interpolated_between_tried_values(self):
        base = 3 * [1.0, 0.6, 0.8, 0.8]
        sweep = {}
        for option, changes in (
            ("arm-stiffness", {0.5: -0.3, 0.8: -0.05, 1.5: -0.02, 2.0: -0.08}),
            ("action-latency", {0.01: -0.15, 0.02: -0.3}),
            ("object-mass", {0.5: 0.0, 2.0: 0.0}),
            ("force-gain", {2.0: 3 * [-0.6, -0.6, 0.2, 0.2]}),
        ):
            for value, change in changes.items():
                sweep[option, value] = np.add(base, change).tolist()
        stiffness, late, harmless, scattered = curves(swept(base, sweep))
        self.assertEqual([p.value for p in stiffness.points], [0.5, 0.8, 1.0, 1.5, 2.0])
        self.assertAlmostEqual(stiffness.lower, 0.8 - 0.3 * 0.05 / 0.25)
        self.assertIsNone(stiffness.upper)
        assert_allclose(stiffness.points[0].difference_ci95, (-0.3, -0.3), atol=1e-9)
        self.assertEqual(stiffness.costs(), "x 0.74")
        self.assertEqual(
            (scattered.loses_beyond(scattered.upper), stiffness.loses_beyond(stiffness.lower)),
            (False, True),
        )
        self.assertEqual(scattered.costs(), "x 1.5, or chance")
        self.assertEqual((late.costs(), harmless.costs()), ("0.0067 s", "no tested value"))

    def test_few_demonstrations_may_lose_by_chance(self):
        """Two lose in the same direction every second time."""
        for demonstrations, costs, verdict_begins in (
            (2, "0.029 s, or chance", "Not shown to be ready"),
            (5, "0.029 s, or chance", "Not shown to be ready"),
            (6, "0.029 s", "Not ready for a robot"),
        ):
            with self.subTest(demonstrations):
                count = 2 * demonstrations
                found = swept([0.8] * count, {("pose-delay", 0.2): [0.1] * count})
                self.assertEqual(curves(found)[0].costs(), costs)
                sentence, reasons = verdict([found])
                self.assertTrue(sentence.startswith(verdict_begins), sentence)
                self.assertIn("costs 70.0 points", reasons[0])

    def test_every_engine_has_its_own_curves(self):
        one = swept([0.8] * 2, {("effort", 0.4): [0.2] * 2})
        other = swept([0.8] * 2, {}, "sapien")
        found = by_property([other, one])
        self.assertEqual([curve is None for curve in found["effort"]], [True, False])
        unknown = swept([0.8] * 2, {("of-a-later-version", 3.0): [0.2] * 2})
        self.assertEqual(curves(unknown)[0].costs(), "1.3, or chance")

    def test_names_are_unique(self):
        self.assertEqual(len({prop.option for prop in PROPERTIES}), len(PROPERTIES))


class CommandTest(InFolder):
    def test_results_are_next_to_the_policy_by_default(self):
        run = self.folder / "run"
        run.mkdir()
        policy = shutil.copy(shipped()["many-objects"], run)
        for options, folder in (
            ("--property object-mass=2", "stress"),
            ("--property lost-frames=1", "faults"),
            ("--faults", "faults"),
        ):
            with patch("xreset.eval.experiment.play", side_effect=KeyboardInterrupt) as played:
                xreset("stress", policy, "--engine mujoco", options)
            self.assertEqual(played.call_args.args[4], run / folder)

    def test_an_unknown_engine_is_refused_before_demonstrations_are_made(self):
        with patch("xreset.demos.verbs.synthesize") as made:
            self.assertIn("Unknown engine", refused("stress openarm --engine none"))
        made.assert_not_called()

    def test_a_sweep_from_the_command_line(self):
        """A hand that does nothing, one demonstration and one value; and an engine that cannot set drives."""
        from xreset.backends.mujoco import MujocoBackend

        demos = self.folder / "demos.npz"
        succeeds("demos synth --objects", SOUP, "--per-object 1 --out", demos)
        options = ("--robot openarm --demos", demos, "--episodes 1")
        sweeps = "--property arm-stiffness=0.5 --property action-latency=0.02"
        sweeps += " --property camera-latency=0.03"  # of cameras, which the policy lacks
        with patch.object(MujocoBackend, "capabilities", MujocoBackend.capabilities - {"drives"}):
            out = succeeds("stress zero", *options, "--out", self.folder, sweeps)
        (found,) = read_evaluation(self.folder)
        self.assertEqual((found.policy, len(found.nominal)), ("zero", 1))
        self.assertEqual(list(found.left_out), ["arm-stiffness"])
        (row,) = found.changed[["property", "value"]].values.tolist()
        self.assertEqual(row, ["action-latency", 0.02])
        self.assertIn("left out in mujoco, which cannot set them: arm-stiffness", out)
        self.assertNotIn("camera", out)
        with patch("xreset.eval.report.clips.SIZE", (80, 60)):
            page = succeeds("report", self.folder)
        self.assertIn("index.html", page)
        text = (self.folder / "report" / "index.html").read_text()
        self.assertIn("What it tolerates", text)
        before = (self.folder / "mujoco.json").read_bytes()
        options += ("--out", self.folder, sweeps)
        with claim(self.folder):
            self.assertIn("another command is writing", refused("stress zero", *options))
        with patch("xreset.eval.experiment.roll_out", side_effect=KeyboardInterrupt):
            self.assertEqual(xreset("stress zero", *options)[0], 130)
        self.assertEqual((self.folder / "mujoco.json").read_bytes(), before, "complete results")
