"""What costs a skill: probes against what was altered, the wrapper, and altered engines whose one mistake is named."""

import io
import json
import math
import tempfile
import unittest
from dataclasses import fields, replace
from pathlib import Path

import torch

from tests import toy_grasp
from tests.command import xreset
from tests.toy_results import episodes
from xreset.errors import CapabilityError, XResetError
from xreset.eval.engines.alteration import Alteration, altered_engine, change_towards
from xreset.eval.engines.attribution import Attribution, Row, attribute
from xreset.eval.engines.attribution_view import amount, label, not_tried, rich_table, verdict, write_plot
from xreset.eval.engines.measure import Measured, measure
from xreset.eval.sensitivity import COMPARED, Effect
from xreset.eval.trial import Engine, engine
from xreset.physics import State
from xreset.spec import SceneSpec
from xreset.task.config import RandomizationConfig, ResetConfig, TaskConfig, TerminationConfig

SCENE = SceneSpec(robot=toy_grasp.robot(), objects=(toy_grasp.brick(),), friction=toy_grasp.FRICTION)

TASK = TaskConfig(
    reset=ResetConfig(demo_probability=0.0, home_gravity_std=0.0, spawn_xy=0.0, spawn_yaw=0.0, home_noise=False),
    termination=TerminationConfig(episode_seconds=0.8),
    # Pair friction is the mean of two materials: 0.9 with the fingertips, and half of it is too little.
    randomization=RandomizationConfig(enabled=False, friction=(0.9, 0.9), elastomer=0.9, metal=0.5, table=0.5),
)

STATED = Measured(
    tip_friction=0.9, link_friction=0.5, table_friction=0.6, torsional_friction=0.002, patch_torsional_friction=1.0, mass=1.0, inertia=1.0,
    arm_stiffness=1.0, arm_damping=1.0, hand_stiffness=1.0, hand_damping=1.0, timestep=1 / 240, contact_give=5e-5, delay=0.0,
)  # fmt: skip


def mujoco() -> Engine:
    return engine("mujoco", workers=0)


class ProbesTest(unittest.TestCase):
    def assert_measured(self, found: Measured, **expected: float):
        for name, value in (vars(STATED) | expected).items():
            if name == "contact_give" and name not in expected:
                continue
            # Numerical damping is part of what is measured. So is what the coupling of the jaws gives way in a step: 1 to 4 % of their
            # drive's stiffness with the steps used here, 0.3 % with a 16th of them.
            relative = {"arm_damping": 0.10, "hand_damping": 0.10, "hand_stiffness": 0.05}.get(name, 0.03)
            self.assertAlmostEqual(getattr(found, name), value, delta=max(relative * value, 1e-9), msg=name)

    def test_mujoco_has_what_the_scene_says(self):
        self.assert_measured(measure(mujoco(), SCENE))

    def test_everything_that_is_altered_is_measured(self):
        alteration = Alteration(
            tip_friction=0.5, link_friction=1.2, table_friction=0.8, torsional_friction=1.5, mass=1.3, inertia=0.7, arm_stiffness=0.8,
            arm_damping=1.2, hand_stiffness=0.5, hand_damping=0.9, timestep=0.5, delay=1,
        )  # fmt: skip
        found = measure(altered_engine(mujoco(), alteration), SCENE)
        self.assert_measured(
            found, tip_friction=0.45, link_friction=0.6, table_friction=0.48, torsional_friction=0.003, mass=1.3, inertia=0.7,
            arm_stiffness=0.8, arm_damping=1.2, hand_stiffness=0.5, hand_damping=0.9, timestep=1 / 480, delay=1.0,
        )  # fmt: skip

    def test_a_softer_contact_gives_more(self):
        """With the square of its time constant, or less where MuJoCo's impedance grows with depth."""
        hard, soft = (
            measure(altered_engine(mujoco(), Alteration(contact_time=factor)), SCENE) for factor in (1.0, 2.0)
        )
        self.assertTrue(3.0 < soft.contact_give / hard.contact_give < 4.1, (hard.contact_give, soft.contact_give))

    def test_engines_that_step_finer_are_seen(self):
        found = measure(engine("pybullet", workers=0), SCENE)
        self.assertAlmostEqual(found.timestep, 1 / 480, delta=1e-5)
        self.assertAlmostEqual(found.torsional_friction, 0.002, delta=2e-5)
        self.assertAlmostEqual(found.patch_torsional_friction, 1.0, delta=0.01)

    def test_an_engine_that_lets_friction_act_at_two_points_is_seen(self):
        """PhysX: half of the load at each of two points 2 mm apart, so sliding friction with a lever of 1 mm, and no torsional friction."""
        for factor in (1.0, 2.0):
            found = measure(altered_engine(engine("sapien", workers=0), Alteration(torsional_friction=factor)), SCENE)
            self.assertAlmostEqual(found.torsional_friction, factor * 0.002, delta=2e-5)
            self.assertAlmostEqual(found.patch_torsional_friction * found.torsional_friction, 0.6 * 0.001, delta=2e-5)

    def test_no_torsional_friction_is_measured_as_none(self):
        found = measure(altered_engine(mujoco(), Alteration(torsional_friction=0.0)), SCENE)
        self.assertAlmostEqual(found.torsional_friction, 0.0, delta=2e-5)
        self.assertTrue(math.isnan(found.patch_torsional_friction))


class AlteredBackendTest(unittest.TestCase):
    def make(self, **alteration):
        backend = altered_engine(mujoco(), Alteration(**alteration)).make(SCENE, 2, torch.zeros(2, dtype=torch.long))
        self.addCleanup(backend.close)
        return backend

    def test_callers_see_their_own_scene(self):
        backend = self.make(mass=2.0, timestep=0.5, hand_stiffness=0.5)
        self.assertIs(backend.scene, SCENE)
        self.assertEqual((backend.name, backend.num_worlds), ("mujoco", 2))
        mass = backend.mass_properties().mass[:, -1]
        torch.testing.assert_close(mass, torch.full((2,), 2.0 * SCENE.objects[0].mass))
        backend.set_object_mass(torch.full((2,), 0.4))
        torch.testing.assert_close(backend.mass_properties().mass[:, -1], torch.full((2,), 0.8))

    def test_targets_come_late_and_a_reset_forgets_them(self):
        backend = self.make(delay=2)
        start = State(**{name: value.clone() for name, value in vars(backend.state()).items()})
        inner = backend._inner
        told = []
        for step in range(4):
            backend.set_joint_targets(start.joint_target + 0.01 * (step + 1))
            told.append(float((inner.state().joint_target - start.joint_target)[0, 0]))
            backend.step()
        self.assertEqual([round(x, 4) for x in told], [0.0, 0.0, 0.01, 0.02])
        torch.testing.assert_close(backend.state().joint_target, start.joint_target + 0.04)
        backend.set_state(start[torch.tensor([1])], torch.tensor([1]))
        backend.set_joint_targets(start.joint_target + 0.05)
        left = (inner.state().joint_target - start.joint_target)[:, 0]
        self.assertEqual([round(float(x), 4) for x in left], [0.03, 0.0])

    def test_a_step_lasts_as_long_as_it_should(self):
        backend, plain = self.make(timestep=0.5), self.make()
        for b in (backend, plain):
            start = State(**{name: value.clone() for name, value in vars(b.state()).items()})
            b.set_state(
                replace(
                    start, object_pos=torch.tensor([[0.9, 0.5, 0.5]] * 2), object_linvel=torch.tensor([[1.0, 0, 0]] * 2)
                )
            )
            b.step(3)
            b.step()
        self.assertAlmostEqual(float(backend.state().object_pos[0, 0]), 0.9 + 7 / 240, places=5)
        self.assertAlmostEqual(float(plain.state().object_pos[0, 0]), 0.9 + 7 / 240, places=5)

    def test_contacts_need_a_dial(self):
        with self.assertRaisesRegex(CapabilityError, "'pybullet' has no dial for the softness of contacts"):
            altered_engine(engine("pybullet"), Alteration(contact_time=2.0))

    def test_alterations_add_up(self):
        both = Alteration(mass=2.0, delay=1).and_(Alteration(mass=1.5, tip_friction=0.5, delay=1))
        self.assertEqual(both, Alteration(mass=3.0, tip_friction=0.5, delay=2))


class PropertiesTest(unittest.TestCase):
    def change(self, name: str, engine: str = "mujoco", a: Measured = STATED, **b: float):
        return change_towards(name, a, replace(STATED, **b), engine, SCENE)

    def test_every_measured_number_is_a_property(self):
        self.assertEqual([p.measured for p in COMPARED.values()], [f.name for f in fields(Measured)])

    def test_equal_values_are_not_tried(self):
        for name, compared in COMPARED.items():
            self.assertEqual(self.change(name), "the same in both, as far as is measured", name)
            for value in compared.what_if:
                self.assertNotEqual(Alteration(**{compared.altered: value}), Alteration(), name)

    def test_a_factor_leads_to_the_other_value(self):
        self.assertEqual(self.change("tip friction", tip_friction=0.45), Alteration(tip_friction=0.5))
        self.assertEqual(self.change("hand damping", hand_damping=1.5), Alteration(hand_damping=1.5))
        self.assertEqual(self.change("latency", delay=2.0), Alteration(delay=2))

    def test_torsional_friction_may_vanish_but_not_come_from_nothing(self):
        self.assertEqual(self.change("torsional friction", torsional_friction=0.0), Alteration(torsional_friction=0.0))
        none = replace(STATED, torsional_friction=0.0)
        self.assertIn("nothing times any factor", self.change("torsional friction", a=none, torsional_friction=0.002))
        self.assertEqual(
            self.change("patch torsional friction", patch_torsional_friction=0.3), Alteration(torsional_friction=0.3)
        )
        left = replace(STATED, patch_torsional_friction=0.3)
        self.assertIn(
            "not changeable in sapien",
            self.change("patch torsional friction", "sapien", a=left, patch_torsional_friction=1.0),
        )

    def test_a_finer_timestep_leaves_contacts_as_they_are(self):
        self.assertEqual(self.change("timestep", timestep=1 / 480), Alteration(timestep=0.5, contact_time=2.0))
        self.assertEqual(self.change("timestep", "sapien", timestep=1 / 480), Alteration(timestep=0.5))

    def test_what_cannot_be_changed_says_why(self):
        self.assertIn("as stiff as its timestep allows", self.change("contact softness", contact_give=0.0))
        self.assertIn(
            "not changeable in sapien: PhysX's contacts are rigid",
            self.change("contact softness", "sapien", contact_give=1e-3),
        )
        self.assertIn("cannot be made to come earlier", self.change("latency", a=replace(STATED, delay=1.0), delay=0.0))
        self.assertIn("no other timestep comes nearer", self.change("timestep", timestep=1.1 / 240))
        self.assertIn("could not be measured in B", self.change("tip friction", tip_friction=math.nan))


class AttributeTest(unittest.TestCase):
    """A grasp that just holds, and engines with one deliberate mistake each."""

    def attribute(self, b: Engine, **options) -> Attribution:
        return attribute(toy_grasp.policy(), mujoco(), b, toy_grasp.trial(TASK, num_envs=3), episodes=1, **options)

    def test_half_the_friction_is_what_costs_the_grasp(self):
        b = toy_grasp.with_scene(mujoco(), "slippery", lambda scene: scene)
        found = self.attribute(replace(altered_engine(b, Alteration(tip_friction=0.5)), name="slippery"))
        self.assertEqual(found.rows[0].mean("grasp"), 1.0)
        self.assertEqual(found.rows[-1].mean("grasp"), 0.0)
        towards = [row.name for row in found.rows if row.kind == "towards"]
        self.assertEqual(towards, ["tip friction"])
        self.assertAlmostEqual(found.rows[1].alteration.tip_friction, 0.5, delta=0.01)
        worst = found.costs()
        assert worst is not None
        self.assertEqual((worst.name, found.share(worst)), ("tip friction", 1.0))
        self.assertIn("'tip friction' alone brings about 100% of it", verdict(found))

    def test_half_the_drives_stiffness_is_told_from_friction(self):
        found = self.attribute(
            replace(altered_engine(mujoco(), Alteration(hand_stiffness=0.5, table_friction=0.7)), name="weak")
        )
        self.assertEqual(
            [row.name for row in found.rows if row.kind == "towards"], ["table friction", "hand stiffness"]
        )
        worst = found.costs()
        assert worst is not None
        self.assertEqual(worst.name, "hand stiffness")
        self.assertEqual(found.rows[1].effect.difference_ci95, (0.0, 0.0))
        self.assertEqual([row.name for row in found.rows if row.kind == "all"], ["all 2 at once"])

    def test_the_same_engine_leaves_nothing_to_attribute(self):
        found = self.attribute(replace(mujoco(), name="same"), only=["tip friction"], what_if=True)
        self.assertEqual(
            [(row.kind, row.name) for row in found.rows],
            [("as it is", "mujoco"), ("what if", "tip friction"), ("other", "same")],
        )
        self.assertIsNone(found.costs())
        self.assertIn("nothing to attribute", verdict(found))
        self.assertIn("not tried: object mass (1 in mujoco, 1 in same): not asked for", list(not_tried(found)))

    def test_torsional_friction_is_tried_without_and_with_more_of_it(self):
        found = self.attribute(replace(mujoco(), name="same"), only=["torsional friction"], what_if=True)
        tried = [(row.alteration.torsional_friction, amount(row)) for row in found.rows if row.kind == "what if"]
        self.assertEqual(tried, [(0.0, "none"), (2.0, "x 2")])

    def test_a_change_that_goes_too_far_is_told_from_the_others(self):
        b = replace(
            altered_engine(engine("sapien", workers=0), Alteration(table_friction=0.7, mass=1.1)), name="sapien"
        )
        found = self.attribute(b, only=["table friction", "patch torsional friction", "object mass"])
        kinds = ["as it is", "towards", "at most", "towards", "all", "other"]
        self.assertEqual([row.kind for row in found.rows], kinds)
        names = ["mujoco", "table friction", "patch torsional friction", "object mass", "all 2 at once", "sapien"]
        self.assertEqual([row.name for row in found.rows], names)
        self.assertAlmostEqual(found.rows[2].alteration.torsional_friction, 0.7 * 0.7 / 2, delta=0.01)
        self.assertEqual(found.rows[4].alteration.torsional_friction, 1.0)

    def test_an_unknown_property_is_refused(self):
        with self.assertRaisesRegex(XResetError, "Unknown property colour. Choose from: tip friction, .*latency"):
            self.attribute(mujoco(), only=["colour"])


def row(kind: str, name: str, *scores: float) -> Row:
    """A run of two episodes of each demonstration; in A as it is, every score is 0.66."""
    effect = Effect.of(episodes(list(scores)), episodes([0.66] * len(scores)))
    return Row(kind=kind, name=name, alteration=Alteration(mass=0.8), episodes=episodes(list(scores)), effect=effect)  # pyright: ignore[reportArgumentType]


A = row("as it is", "mujoco", *[0.66] * 8)
B = row("other", "sapien", *[0.33] * 8)


class OutcomeTest(unittest.TestCase):
    def found(self, *rows: Row) -> Attribution:
        return Attribution(
            a="mujoco", b="sapien", measured_a=STATED, measured_b=replace(STATED, mass=0.8), rows=rows, skipped={}
        )

    def test_shares_of_the_gap(self):
        found = self.found(
            A,
            row("towards", "tip friction", *[0.33] * 4, *[0.66] * 4),
            row("towards", "object mass", *[0.33] * 6, *[0.66] * 2),
            row("towards", "latency", *[0.99] * 8),
            B,
        )
        self.assertAlmostEqual(found.share(found.rows[1]), 0.5)
        self.assertAlmostEqual(found.share(found.rows[3]), -1.0)
        self.assertEqual(found.costs(), found.rows[2])

    def test_a_bound_is_named_only_where_nothing_else_matters(self):
        bound = row("at most", "patch torsional friction", *[0.0] * 8)
        found = self.found(A, bound, row("towards", "tip friction", *[0.33] * 6, *[0.66] * 2), B)
        self.assertEqual(found.costs(), found.rows[2])
        found = self.found(A, bound, B)
        self.assertEqual(found.costs(), bound)
        self.assertIn(
            "'patch torsional friction' may bring about 200% of it, at most (changed in every contact", verdict(found)
        )
        self.assertEqual(label(bound), "patch torsional friction (at most)")

    def test_a_difference_of_one_demonstration_among_many_does_not_matter(self):
        found = self.found(A, row("other", "sapien", 0.33, 0.33, *[0.66] * 6))
        self.assertFalse(found.gap.is_certain)
        self.assertTrue(math.isnan(found.share(found.rows[-1])))
        self.assertIsNone(found.as_dict()["rows"][-1]["share_of_gap"])

    def test_json_table_and_plot(self):
        found = self.found(
            A,
            row("towards", "object mass", *[0.33] * 8),
            B,
        )
        data = json.loads(json.dumps(found.as_dict(), allow_nan=False))
        self.assertEqual((data["schema"], data["costs_most"]), ("xreset-attribution/1", "object mass"))
        self.assertEqual(data["rows"][1]["difference"]["mean"], -0.33)
        from rich.console import Console

        with io.StringIO() as sink:
            console = Console(width=100, file=sink)
            console.print(rich_table(found, "title"))
            for expected in ("object mass", "1 -> 0.8", "-33.0", "100%"):
                self.assertIn(expected, sink.getvalue())
        with tempfile.TemporaryDirectory() as folder:
            write_plot(Path(folder) / "plot.png", found, "title")
            self.assertEqual((Path(folder) / "plot.png").read_bytes()[:8], b"\x89PNG\r\n\x1a\n")


class CommandTest(unittest.TestCase):
    def test_bad_input(self):
        options = ("--demos", "none.npz", "--robot", "ur7e-sharpa", "--towards")
        for message, policy, *more in (
            ("does not differ from itself|Choose two engines", "zero", "mujoco"),
            ("expected a whole number from 1", "zero", "sapien", "--episodes", "0"),
            ("Unknown backend 'havok'", "zero", "havok"),
            ("there is no none.npz", "zero", "sapien"),
            ("Unknown policy", "none", "sapien"),
        ):
            with self.subTest(message):
                code, _, err = xreset("engines", "attribute", policy, *options, *more)
                self.assertEqual(code, 1)
                self.assertRegex(err, message)


if __name__ == "__main__":
    unittest.main()
