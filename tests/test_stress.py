"""Sweeps of one property at a time: what is swept, what is found, and what is refused. No physics but for one short run."""

import json
from dataclasses import asdict, replace
from unittest import TestCase, mock

import numpy as np
from numpy.testing import assert_allclose

from tests.command import refused, succeeds, xreset
from tests.data import InFolder
from tests.toy_bank import SOUP
from tests.toy_results import episodes, toy_card
from xreset.errors import XResetError
from xreset.eval.sensitivity import SWEEPS, chosen, nominal_task
from xreset.eval.stress import curve, read_stress
from xreset.files.storage import claim, write_json
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
        for prop in SWEEPS:
            value = prop.values[0]
            found = prop.set_in(nominal_task(task), value)
            set_to = 3.0 if prop.unit == "ms" else value  # 50 ms are three control steps
            assert_allclose(getattr(found.randomization, prop.changed_field), (set_to, set_to))
            self.assertEqual(
                replace(
                    found.randomization, **{prop.changed_field: getattr(plain, prop.changed_field)}
                ),
                plain,
            )
            self.assertEqual(found.reset, task.reset)

    def test_values_of_ones_own(self):
        (prop,) = chosen(["arm-stiffness=2,0.5,1"])
        self.assertEqual((prop.option, prop.values), ("arm-stiffness", (0.5, 2.0)))
        self.assertEqual(chosen(["arm_stiffness=2,0.5"]), (prop,), "as the field is written")
        self.assertEqual(chosen("arm-stiffness=2,0.5"), (prop,), "one")
        self.assertEqual(chosen([]), SWEEPS)

    def test_refusals(self):
        for text, words in (
            ("colour", "Unknown property 'colour'. Choose from: object-friction, "),
            ("effort=much", "holds values that are not numbers. Write effort=VALUE"),
            ("effort=-1", "expected finite values of at least 0, other than the nominal 1"),
            ("effort=nan", "expected finite values"),
        ):
            with self.subTest(text), self.assertRaisesRegex(XResetError, words):
                chosen([text])
        (late,) = chosen(["action-latency=300"])
        with self.assertRaisesRegex(
            XResetError,
            "action-latency 300 control steps cannot be tried: .* fewer than the 300 of an episode",
        ):
            late.set_in(TaskConfig(), 300.0)
        (light,) = chosen(["object-mass=0"])
        with self.assertRaisesRegex(
            XResetError, "object-mass x 0 cannot be tried: mass_scale .*0.0.*above 0"
        ):
            light.set_in(TaskConfig(), 0.0)


class CurveTest(InFolder):
    def test_the_limit_is_interpolated_between_tried_values(self):
        base = [1.0, 0.6, 0.8, 0.8]

        def swept(option, changes):
            """The curve of a property; at each value every episode changes by so much."""
            (prop,) = chosen([option])
            found = {}
            for value, change in changes.items():
                found[value] = episodes(np.add(base, change).tolist())
            return curve(prop, episodes(base), found)

        stiffness = swept("arm-stiffness", {0.5: -0.3, 0.8: -0.05, 1.5: -0.02, 2.0: -0.08})
        self.assertEqual([p.value for p in stiffness.points], [0.5, 0.8, 1.0, 1.5, 2.0])
        self.assertAlmostEqual(stiffness.lower, 0.8 - 0.3 * 0.05 / 0.25)
        self.assertIsNone(stiffness.upper)
        assert_allclose(stiffness.points[0].difference_ci95, (-0.3, -0.3), atol=1e-9)
        self.assertEqual(stiffness.costs(), "x 0.74")
        late = swept("action-latency", {1.0: -0.15, 2.0: -0.3})
        harmless = swept("object-mass", {0.5: 0.0, 2.0: 0.0})
        scattered = swept("force-gain", {2.0: [-0.6, -0.6, 0.2, 0.2]})
        self.assertEqual(
            (scattered.loses_beyond(scattered.upper), stiffness.loses_beyond(stiffness.lower)),
            (False, True),
        )
        self.assertEqual(scattered.costs(), "x 1.5, or chance")
        self.assertEqual(
            (late.costs(), harmless.costs()), ("0.67 control steps", "none that was tried")
        )

    def test_cards_of_another_policy_are_left_out(self):
        for engine, inputs in (
            ("mujoco", {"policy": "old"}),
            ("sapien", {"policy": "new"}),
            ("pybullet", {}),
        ):
            card = toy_card(engine=engine, inputs=inputs)
            write_json(f"{self.folder}/{engine}.json", asdict(card))
        self.assertEqual(
            [c.engine for c in read_stress(self.folder, "new")], ["pybullet", "sapien"]
        )
        self.assertEqual(len(read_stress(self.folder)), 3)


class CommandTest(InFolder):
    def test_a_card_from_the_command_line(self):
        """A hand that does nothing, one demonstration and one value: files, table, picture; and an engine that cannot set drives."""
        from xreset.backends.mujoco import MujocoBackend

        demos = self.folder / "demos.npz"
        succeeds("demos", "synth", "--objects", SOUP, "--per-object", 1, "--out", demos)
        options = ("--robot", "openarm", "--demos", demos, "--episodes", 1)
        sweeps = ("--property", "arm-stiffness=0.5", "--property", "action-latency=1")
        sweeps += ("--property", "camera-latency=33")  # of cameras, which the policy does not have
        with mock.patch.object(
            MujocoBackend, "capabilities", MujocoBackend.capabilities - {"drives"}
        ):
            out = succeeds("stress", "zero", *options, "--out", self.folder, *sweeps)
            options += ("--out", self.folder / "none", "--property", "arm-stiffness=0.5")
            left_out = succeeds("stress", "zero", *options)
        self.assertIn("cannot be set", left_out)
        self.assertEqual([c.curves for c in read_stress(self.folder / "none")], [()])
        (card,) = read_stress(self.folder)
        self.assertEqual((card.schema, card.policy, card.episodes), ("xreset-stress/1", "zero", 1))
        self.assertEqual(card.left_out, ("arm-stiffness",))
        (curve,) = card.curves
        self.assertEqual(
            (curve.property, [p.value for p in curve.points]), ("action-latency", [0.0, 1.0])
        )
        self.assertEqual(curve.points[0].task_progress, card.task_progress)
        self.assertTrue((self.folder / "stress.png").read_bytes().startswith(b"\x89PNG"))
        for expected in (
            "left out in mujoco, which cannot set them: arm-stiffness",
            "cannot be set",
        ):
            self.assertIn(expected, out)
        self.assertNotIn("camera", out)
        before = (self.folder / "mujoco.json").read_bytes()
        played = [mock.Mock(episodes=episodes([0.8] * 2))] * 2
        options = (*options[:-4], "--out", self.folder, *sweeps)
        stop = mock.patch("xreset.eval.stress.roll_out", side_effect=[*played, KeyboardInterrupt])
        with claim(self.folder):
            self.assertIn("another command is writing", refused("stress", "zero", *options))
        with stop:
            self.assertEqual(xreset("stress", "zero", *options)[0], 130)
        self.assertEqual((self.folder / "mujoco.json").read_bytes(), before, "complete results")
        partial = json.loads((self.folder / "mujoco.partial").read_text())
        self.assertEqual([c["property"] for c in partial["curves"]], ["arm-stiffness"])
