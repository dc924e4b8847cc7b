"""What costs a skill: measurements of altered engines, changes of the task, and engines whose one mistake is named."""

import math
from dataclasses import fields, replace
from unittest import TestCase
from unittest.mock import patch

import torch
from torch.testing import assert_close

from tests import toy_grasp
from tests.command import printed, refused, succeeds
from tests.data import InFolder
from tests.toy_results import swept
from xreset import XResetError, synthesize, write_demos
from xreset.eval.conditions import COMPARED, nominal_task
from xreset.eval.engines.attribution import (
    ALL,
    Attribution,
    attribute,
    change_towards,
    not_tried,
    rich_table,
    verdict,
)
from xreset.eval.engines.measure import Measured, measure
from xreset.eval.results import read_evaluation
from xreset.eval.rollout import engine
from xreset.task.config import RandomizationConfig, TaskConfig, TerminationConfig
from xreset.task.randomization import pair_friction

TASK = TaskConfig(
    reset=toy_grasp.AT_HOME,
    termination=TerminationConfig(episode_seconds=0.8),
    # Pair friction is the mean of two materials: 0.9 with the fingertips, and half of it is too little.
    randomization=RandomizationConfig(
        enabled=False, friction=(0.9, 0.9), elastomer=0.9, metal=0.5, table=0.5
    ),
)

STATED = Measured(
    tip_friction=0.9, link_friction=0.5, table_friction=0.6, torsional_friction=0.002, arm_stiffness=1.0, arm_damping=1.0,
    hand_stiffness=1.0, hand_damping=1.0, timestep=1 / 240,
)  # fmt: skip


def mujoco():
    return engine("mujoco", workers=0)


def altered(
    base, *, friction=1.0, stiffness=1.0, arm_stiffness=1.0, damping=1.0, torsional=1.0, finer=1
):
    """The engine with some mistakes: factors on friction and drives, and finer steps."""

    def change(asked):
        joints = []
        for joint in asked.robot.joints:
            kp = stiffness if joint.group == "hand" else arm_stiffness
            drive = replace(joint.drive, kp=kp * joint.drive.kp, kd=damping * joint.drive.kd)
            joints.append(replace(joint, drive=drive))
        pairs = asked.friction
        return replace(
            asked,
            robot=replace(asked.robot, joints=tuple(joints)),
            friction=replace(
                pairs,
                tip=friction * pairs.tip,
                torsional=torsional * pairs.torsional,
            ),
            timestep=asked.timestep / finer,
            substeps=asked.substeps * finer,
        )

    def make(asked, num_worlds, object_index):
        backend = base.make(change(asked), num_worlds, object_index)
        set_friction = backend.set_friction
        step = backend.step

        def rub(values, worlds=None):
            values = values.clone()
            values[:, 0] *= friction
            set_friction(values, worlds)

        def step_finer(substeps=None):
            step(None if substeps is None else substeps * finer)

        backend.set_friction = rub
        backend.step = step_finer
        return backend

    return replace(base, name="other", make=make)


class ProbesTest(TestCase):
    def assert_measured(self, found, **expected):
        for name, value in (vars(STATED) | expected).items():
            # Numerical damping is part of what is measured. So is what the coupling of the jaws gives way in a step: 1 to 4 % of their
            # drive's stiffness with the steps used here, 0.3 % with a 16th of them.
            relative = {"arm_damping": 0.10, "hand_damping": 0.10, "hand_stiffness": 0.05}.get(
                name, 0.03
            )
            self.assertAlmostEqual(
                getattr(found, name), value, delta=max(relative * value, 1e-9), msg=name
            )

    def test_what_the_scene_says_and_what_is_altered(self):
        self.assert_measured(measure(mujoco(), toy_grasp.scene()))
        mistakes = {"arm_stiffness": 0.8, "damping": 0.9, "torsional": 1.5, "finer": 2}
        found = measure(
            altered(mujoco(), friction=0.5, stiffness=0.5, **mistakes), toy_grasp.scene()
        )
        self.assert_measured(
            found, tip_friction=0.45, torsional_friction=0.003, arm_stiffness=0.8, arm_damping=0.9, hand_stiffness=0.5,
            hand_damping=0.9, timestep=1 / 480,
        )  # fmt: skip


class ChangeTest(TestCase):
    TASK = nominal_task(TASK)

    def change(self, name, b, a=None):
        prop = COMPARED[name]
        known = getattr(STATED, prop.measured) if a is None else a
        return change_towards(prop, known, b, self.TASK, mujoco())

    def drawn(self, name, b, a=None):
        found = self.change(name, b, a)
        assert not isinstance(found, str), found
        return found.randomization

    def test_every_measured_number_is_a_property(self):
        self.assertEqual(
            {p.measured for p in COMPARED.values()}, {f.name for f in fields(Measured)}
        )
        for name, prop in COMPARED.items():
            same = getattr(STATED, prop.measured)
            self.assertEqual(
                self.change(name, same),
                "the same in both, within the resolution of the measurement",
                name,
            )

    def test_a_property_gets_the_other_value(self):
        for pair, name in enumerate(("tip friction", "link friction", "table friction")):
            found = pair_friction(torch.tensor([0.9]), self.drawn(name, 0.45, 0.5))[0]
            expected = pair_friction(torch.tensor([0.9]), self.TASK.randomization)[0]
            expected[pair] *= 0.9
            assert_close(found, expected)
        self.assertEqual(self.drawn("hand damping", 1.5).hand_damping, (1.5, 1.5))
        self.assertEqual(self.drawn("torsional friction", 0.0).torsional_friction, (0.0, 0.0))
        finer = self.change("timestep", 1 / 480)
        assert not isinstance(finer, str)
        self.assertEqual((finer.timestep, finer.substeps), (1 / 480, 8))

    def test_what_cannot_be_changed_says_why(self):
        for name, a, b, why in (
            ("timestep", 1 / 240, 1.1 / 240, "no other timestep comes nearer"),
            ("torsional friction", 0.0, 0.002, "there is none in mujoco"),
            ("tip friction", 0.9, 0.2, "less than half of the object's own coefficient"),
            ("tip friction", 0.9, math.nan, "could not be measured in B"),
        ):
            with self.subTest(name):
                self.assertIn(why, str(self.change(name, b, a)))


class AttributeTest(InFolder):
    """A grasp that just holds, and engines with one deliberate mistake each."""

    def attribute(self, b, **options):
        return attribute(
            toy_grasp.policy(),
            mujoco(),
            b,
            toy_grasp.trial(TASK, num_envs=3),
            self.folder,
            episodes=1,
            **options,
        )

    def test_half_the_friction_is_what_costs_the_grasp(self):
        found = self.attribute(altered(mujoco(), friction=0.55))
        self.assertEqual((found.a.mean("grasp"), found.b.mean("grasp")), (1.0, 0.0))
        self.assertEqual([row.name for row in found.rows], ["mujoco", "tip friction", "other"])
        worst = found.costs()
        self.assertEqual((worst.name, found.share(worst)), ("tip friction", 1.0))
        self.assertIn("'tip friction' alone brings about 100% of it", verdict(found))
        a, b = read_evaluation(self.folder)
        again = Attribution(a=a, b=b)
        self.assertEqual(verdict(again), verdict(found), "read from the files")
        self.assertEqual(again.costs().name, "tip friction")
        self.assertLess(again.rows[1].effect.difference, -0.1)
        text = printed(rich_table(found, "title"))
        self.assertRegex(text, r"tip friction.* 0.\d+ -> 0.4\d+ .*100%")

    def test_half_the_drives_stiffness_is_told_from_torsional_friction(self):
        found = self.attribute(altered(mujoco(), stiffness=0.5, torsional=1.5))
        names = ["mujoco", "torsional friction", "hand stiffness", "all 2 at once", "other"]
        self.assertEqual([row.name for row in found.rows], names)
        worst = found.costs()
        self.assertEqual(worst.name, "hand stiffness")
        self.assertEqual(found.rows[1].effect.difference_ci95, (0.0, 0.0))

    def test_the_same_engine_leaves_nothing_to_attribute(self):
        found = self.attribute(replace(mujoco(), name="same"), only=["tip friction"])
        self.assertEqual(
            [(row.kind, row.name) for row in found.rows],
            [("as it is", "mujoco"), ("other", "same")],
        )
        self.assertIsNone(found.costs())
        self.assertIn("nothing to attribute", verdict(found))
        self.assertIn(
            "not tried: timestep (4.17 ms in mujoco, 4.17 ms in same): not asked for",
            list(not_tried(found)),
        )
        with self.assertRaisesRegex(
            XResetError, "Unknown property colour. Choose from: tip friction, .*timestep"
        ):
            self.attribute(mujoco(), only=["colour"])


def outcome(sweep, b=(0.33,) * 8):
    """An attribution; in A as it is, every score is 0.66."""
    conditions = {(name, 0.8): scores for name, scores in sweep.items()}
    measured = {"arm-stiffness": 1.0}
    a = swept([0.66] * 8, conditions, measured=measured, left_out={"timestep": "why"})
    return Attribution(a=a, b=swept(list(b), {}, "sapien", measured={"arm-stiffness": 0.8}))


class OutcomeTest(TestCase):
    def test_shares_of_the_gap(self):
        sweep = {
            "tip-friction": [0.33] * 4 + [0.66] * 4,
            "arm-stiffness": [0.33] * 6 + [0.66] * 2,
            "timestep": [0.99] * 8,
            ALL: [0.33] * 8,
        }
        found = outcome(sweep)
        names = ["mujoco", "tip friction", "arm stiffness", "timestep", "all 3 at once", "sapien"]
        self.assertEqual([row.name for row in found.rows], names)
        self.assertAlmostEqual(found.share(found.rows[1]), 0.5)
        self.assertAlmostEqual(found.share(found.rows[3]), -1.0)
        self.assertEqual(found.costs().name, "arm stiffness")
        self.assertIn("of it, all 3 at once 100%", verdict(found))
        unknown = "not tried: timestep (unknown in mujoco, unknown in sapien): why"
        self.assertEqual(list(not_tried(found)), [unknown])
        # one demonstration among many
        found = outcome({}, [0.33, 0.33] + [0.66] * 6)
        self.assertTrue(math.isnan(found.share(found.rows[-1])))
        self.assertIsNone(found.costs())


class CommandTest(InFolder):
    def test_the_command_says_what_was_found(self):
        demos = self.folder / "demos.npz"
        write_demos(demos, synthesize(["soup"], 1, seed=0))
        found = outcome({"arm-stiffness": [0.33] * 8})
        options = ("--robot", "openarm", "--demos", demos, "--towards", "sapien")
        options += ("--out", self.folder / "made", "--episodes", 3, "--seed", 4)
        options += ("--property", "arm stiffness")
        with patch("xreset.eval.engines.attribution.attribute", return_value=found) as attribute:
            said = succeeds("engines", "attribute", "zero", *options)
        spec, a, b, trial, out = attribute.call_args.args
        self.assertEqual((spec.name, a.name, b.name, trial.seed), ("zero", "mujoco", "sapien", 4))
        given = attribute.call_args.kwargs
        self.assertEqual((given["episodes"], [*given["only"]]), (3, ["arm stiffness"]))
        self.assertEqual(out, self.folder / "made")
        self.assertIn("'arm stiffness' alone brings about 100% of it", " ".join(said.split()))

    def test_bad_input(self):
        options = ("--demos", "none.npz", "--robot", "ur7e-sharpa", "--towards")
        for message, policy, other in (
            ("Choose two engines", "zero", "mujoco"),
            ("Unknown engine 'havok'", "zero", "havok"),
            ("there is no none.npz", "zero", "sapien"),
        ):
            with self.subTest(message):
                self.assertIn(message, refused("engines", "attribute", policy, *options, other))
