"""Replays in several engines: partings of constructed recordings, altered engines found at the right place, files, refusals."""

import json
import math
from dataclasses import replace
from functools import partial
from unittest import TestCase, mock

import numpy as np
import torch
from numpy.testing import assert_allclose
from torch import tensor
from torch.testing import assert_close

from tests import toy_grasp, toy_results
from tests.command import printed, refused, succeeds
from tests.data import InFolder
from tests.toy_bank import SOUP, SPAM
from tests.toy_grasp import recording
from xreset import robots
from xreset.errors import DemoError, FileFormatError, XResetError
from xreset.eval.engines.actions import (
    Actions,
    from_file,
    recorded_actions,
)
from xreset.eval.engines.replay import (
    THRESHOLDS,
    TraceResult,
    compared,
    rich_table,
    sentences,
    trace,
)
from xreset.eval.rollout import engine, roll_out
from xreset.geometry.rotations import quat_from_axis_angle
from xreset.physics import State
from xreset.task.config import RandomizationConfig, TaskConfig, TerminationConfig

DT = 1 / 60


def grasp_actions(steps=60):
    """The toy grasp: close and lift."""
    return Actions(
        scene=toy_grasp.scene(),
        label="toy grasp",
        start=toy_grasp.start(),
        joint_target=torch.as_tensor(
            np.stack([toy_grasp.targets(i) for i in range(steps)]), dtype=torch.float32
        ),
    )


def no_force():
    return torch.zeros(20, 1, 2, 3)


def assert_near(found, expected):
    assert_allclose(np.array(found, dtype=float), expected, atol=1e-6)


def compare(found, reference):
    traced = compared(engine("mujoco"), found, reference, toy_grasp.scene())
    return {d.quantity: d for d in traced.divergences}


class DivergenceTest(TestCase):
    def test_joints_position_and_orientation(self):
        joint = torch.zeros(20, 1, 5)
        joint[7:, 0, 3] = 0.03  # turn
        joint[12, 0, 1] = 0.05  # swing, for one step
        pos = torch.zeros(20, 1, 3)
        pos[10:, 0, 1] = 0.006
        quat = tensor([1.0, 0, 0, 0]).repeat(20, 1, 1)
        # its sign means nothing
        quat[15:] = -quat_from_axis_angle(tensor([0.0, 0.0, math.radians(6)]))
        found = compare(recording(joint_pos=joint, object_pos=pos, object_quat=quat), recording())
        d = found["joints"]
        self.assertEqual(d.where, "turn")
        assert_near((d.time, d.end, d.largest), (8 * DT, 0.03, 0.05))
        assert_near((found["object position"].time, found["object position"].end), (11 * DT, 0.006))
        orientation = found["object orientation"]
        assert_near((orientation.time, orientation.end), (16 * DT, math.radians(6)))
        joint = torch.zeros(20, 1, 5)
        joint[5:, 0, 0] = 0.003  # lift: 3 mm of a prismatic joint count as 30 mrad
        d = compare(recording(joint_pos=joint), recording())["joints"]
        assert_near((d.time, d.largest), (6 * DT, 0.03))

    def test_contacts_must_differ_for_a_while_and_name_the_finger(self):
        force = no_force()
        other = no_force()
        force[4, 0, 0] = tensor([0.0, 0.0, 0.2])  # the thumb flickers: too little over 50 ms
        other[9:, 0, 1, 0] = 1.0  # the index finger touches in the reference only
        d = compare(recording(tip_force=force), recording(tip_force=other))["contacts"]
        self.assertEqual(d.where, "index does not touch")
        self.assertAlmostEqual(d.time, 10 * DT)
        short = no_force()
        short[18:, 0, 0, 2] = 1.0  # two steps: shorter than 50 ms
        self.assertIsNone(compare(recording(tip_force=short), recording())["contacts"].time)
        short[17, 0, 0, 2] = 1.0
        d = compare(recording(tip_force=short), recording())["contacts"]
        self.assertAlmostEqual(d.time, 18 * DT)

    def test_forces_are_averaged_and_their_direction_does_not_count(self):
        force = no_force()
        other = no_force()
        force[:, 0, 0, 2] = 5.0
        other[:, 0, 0, 0] = 5.0
        force[10, 0, 1, 2] = 5.0  # one step of 5 N is 5 / 3 N over 50 ms
        d = compare(recording(tip_force=force), recording(tip_force=other))["contact force"]
        self.assertIsNone(d.time)
        self.assertAlmostEqual(d.largest, 5 / 3, places=5)

    def test_the_least_difference_of_each_quantity(self):
        steps = torch.ones(20, 1, 1)
        joint = 0.02 * tensor([0, 0, 0, 1.0, 0]) * steps
        still = tensor([1.0, 0, 0, 0]).expand(20, 1, 4)
        turn = tensor([0.0, 0.0, math.radians(5.0)]) * steps
        touch = no_force()
        touch[:, 0, 1, 2] = 0.1
        for quantity, made in (
            ("joints", lambda x: {"joint_pos": x * joint}),
            ("object position", lambda x: {"object_pos": x * tensor([0, 0.003, 0.004]) * steps}),
            ("object orientation", lambda x: {"object_quat": quat_from_axis_angle(x * turn)}),
            ("contacts", lambda x: {"tip_force": x * touch}),
            ("contact force", lambda x: {"tip_force": x * 20 * touch}),
        ):
            base = recording(object_quat=still)
            below, above = (compare(replace(base, **made(x)), base)[quantity] for x in (0.99, 1.01))
            self.assertEqual((below.time, below.where), (None, ""), quantity)
            self.assertAlmostEqual(above.time, DT, msg=quantity)

    def test_what_is_not_finite_ends_the_comparison(self):
        pos = torch.zeros(20, 1, 3)
        pos[:, 0, 0] = torch.arange(20) / 100
        pos[8:, 0, 1] = math.nan
        found = compare(recording(object_pos=pos), recording())
        self.assertAlmostEqual(found["object position"].end, 0.07, places=6)
        self.assertEqual(compare(recording(object_pos=pos * math.nan), recording()), {})


class TraceTest(TestCase):
    """Engines with a deliberate mistake, compared with MuJoCo as it is."""

    @classmethod
    def setUpClass(cls):
        cls.mujoco = engine("mujoco", workers=0)
        same = toy_grasp.with_scene(cls.mujoco, "same", lambda scene: scene)
        slippery = toy_grasp.with_scene(
            cls.mujoco, "slippery", lambda scene: toy_grasp.with_tip_friction(scene, 0.5)
        )
        broken = replace(cls.mujoco, name="broken", make=cls.broken)
        cls.result = trace(grasp_actions(), cls.mujoco, [same, slippery, broken])

    @classmethod
    def broken(cls, scene, num_worlds, object_index):
        backend = cls.mujoco.make(scene, num_worlds, object_index)
        inner = backend.step
        count = [0]

        def step(substeps=None):
            count[0] += 1
            inner(substeps)
            if count[0] == 20:
                values = {name: value.clone() for name, value in vars(backend.state()).items()}
                backend.set_state(
                    State(**values | {"object_pos": torch.full((num_worlds, 3), math.nan)})
                )

        backend.step = step
        return backend

    def test_the_same_engine_does_not_diverge(self):
        same = self.result.engines[0]
        self.assertTrue(all(d.time is None and d.largest < 1e-12 for d in same.divergences))
        for noise in self.result.noise:
            self.assertGreater(noise.divergences[0].largest, 0.0)
        self.assertIn("same stays with mujoco", next(sentences(self.result)))
        self.assertAlmostEqual(self.result.reference.lifted, toy_grasp.RAISED, delta=0.01)

    def test_the_reference_also_starts_a_micrometre_away_on_either_side(self):
        starts = []

        def make(*args):
            backend = self.mujoco.make(*args)
            begin = backend.set_state
            backend.set_state = lambda state: (starts.append(state), begin(state))
            return backend

        actions = replace(grasp_actions(), joint_target=grasp_actions().joint_target[:1])
        for seed in (0, 0, 1):
            trace(actions, replace(self.mujoco, make=make), [], seed=seed)
        for name, value in vars(starts[0]).items():
            change = (value - getattr(actions.start, name)).double()
            self.assertEqual(change[0].abs().max(), 0.0, name)
            if name in ("joint_pos", "object_pos"):
                assert_allclose(change[1:].abs(), 1e-6, atol=1e-7)
                self.assertLess(change[1:].sign().mean().abs(), 0.6, name)
                self.assertFalse(torch.equal(value, getattr(starts[2], name)))
            else:
                self.assertEqual(change.abs().max(), 0.0, name)
            assert_close(value, getattr(starts[1], name), rtol=0, atol=0)

    def test_noise_is_the_earliest_time_and_the_largest_differences(self):
        made = self.result.noise[0]
        first = made.divergences[0]
        ones = []
        for time, end, largest in ((None, 3.0, 4.0), (0.5, 1.0, 5.0), (0.2, 2.0, 2.0)):
            ones.append((replace(first, time=time, end=end, largest=largest, where=f"at {time}"),))
        noise = tuple(replace(made, divergences=each) for each in ones)
        (worst,) = replace(self.result, noise=noise).worst_noise
        self.assertEqual((worst.time, worst.where, worst.end, worst.largest), (0.2, "at 0.2", 3, 5))

    def test_half_the_friction_is_found_in_the_object_and_not_in_the_joints(self):
        slippery = self.result.engines[1]
        found = {d.quantity: d for d in slippery.divergences}
        self.assertGreater(found["object position"].end, 0.02)
        self.assertLess(slippery.lifted, 0.0)
        # Once the brick has gone, the jaws close further.
        self.assertGreater(found["joints"].time, found["object position"].time)
        self.assertIn("slippery diverges first in object position", list(sentences(self.result))[1])

    def test_noise_excuses_only_what_it_causes_by_then(self):
        position = next(
            d for d in self.result.engines[1].divergences if d.quantity == "object position"
        )
        for time, size, excused in (
            (-0.01, 1.0, True),
            (0.01, 1.0, False),
            (-0.01, 0.5, False),
            (None, 1.0, False),
        ):
            at = None if time is None else position.time + time
            noise = replace(position, time=at, largest=position.largest * size)
            with mock.patch.object(TraceResult, "worst_noise", (noise,)):
                self.assertEqual(self.result.within_noise(position), excused, (time, size))

    def test_an_engine_that_breaks_is_compared_until_it_does(self):
        broken = self.result.engines[2]
        self.assertEqual((broken.steps, broken.lifted), (19, None))
        self.assertIn("broken is no longer finite after 0.317 s", list(sentences(self.result))[2])
        with self.assertRaisesRegex(
            XResetError, "the reference 'broken' is not finite after 0.317 s"
        ):
            trace(grasp_actions(), broken.engine, [])

    def test_files_and_table(self):
        data = json.loads(json.dumps(self.result.as_dict(), allow_nan=False))
        self.assertEqual(
            [e["name"] for e in data["engines"]], ["mujoco", "same", "slippery", "broken"]
        )
        self.assertEqual(len(data["noise"]), len(THRESHOLDS))
        two = replace(self.result, engines=self.result.engines[1:2])
        text = printed(rich_table(two))
        for expected in ("slippery", "object position", "(from 5 mm)", "4 starts moved by 1e-06"):
            self.assertIn(expected, text)


class EvaluationTest(toy_results.InFolder):
    """Actions that an evaluation has recorded."""

    @classmethod
    def setUpClass(cls):
        task = TaskConfig(
            reset=toy_grasp.AT_HOME,
            randomization=RandomizationConfig(enabled=False),
            termination=TerminationConfig(episode_seconds=0.7),
        )
        trial = toy_grasp.trial(task, num_envs=1)
        mujoco = engine("mujoco", workers=0)
        cls.episode = roll_out(toy_grasp.OpenLoop(), mujoco, trial, episodes=1).traces[1]

    def actions(self, **changes):
        """The actions of the episode with some changes."""
        episode = replace(self.episode, **changes)
        return recorded_actions(toy_grasp.robot(), toy_grasp.brick(), episode, label="episode")

    def test_a_replay_in_the_same_engine_is_the_episode(self):
        time = self.episode.time
        actions = self.actions()
        self.assertEqual(len(actions.joint_target), 42)
        self.assertEqual(self.actions(time=2 * time).scene.substeps, 8)
        with self.assertRaisesRegex(FileFormatError, "steps of 0.015 s, expected a multiple"):
            self.actions(time=0.9 * time)
        replayed = trace(actions, engine("mujoco", workers=0), []).reference.recording
        every = slice(2, None, 3)  # control steps of 1/60 s between recorded states
        for name in ("object_pos", "joint_pos"):
            found = getattr(replayed, name)[every, 0]
            assert_allclose(found, getattr(self.episode, name)[1:], atol=1e-6)

    def test_from_files(self):
        robot = robots.load("openarm")
        made = toy_results.toy_rollouts(robot.home)

        def load(episode, thing=None, **changes):
            """The actions of an evaluation whose traces have some changes."""
            rollouts = replace(made, traces=tuple(replace(t, **changes) for t in made.traces))
            self.write_results("", rollouts, ("sapien",), robot.joint_names, robot="openarm")
            return from_file(self.folder / "eval" / "sapien.trace.npz", thing, episode)

        actions = load(0, SPAM)
        self.assertEqual(
            (actions.object.name, actions.label), (SPAM, "zero in sapien, demonstration 1")
        )
        assert_allclose(actions.joint_target, np.asarray(made.traces[1].joint_target), atol=1e-6)
        for episode in (0, 1):
            self.assertEqual(
                load(episode, object=SOUP).label, f"zero in sapien, demonstration {episode}"
            )
        with self.assertRaisesRegex(
            DemoError, f"records 1 episodes of {SPAM}, so --episode is at most 0"
        ):
            load(1, SPAM)
        self.assertRaisesRegex(DemoError, f"has no mug; it has {SOUP}, {SPAM}", load, 0, "mug")
        with self.assertRaisesRegex(FileFormatError, "states without the actions"):
            load(0, joint_target=None)

    def test_the_command_writes_what_it_compares(self):
        robot = robots.load("openarm")
        rollouts = toy_results.toy_rollouts(robot.home)
        self.write_results("", rollouts, ("mujoco",), robot.joint_names, robot="openarm")
        out = self.folder / "trace"
        options = ("--object", SPAM, "--engine", "mujoco", "--engine", "sapien", "--out", out)
        with mock.patch("xreset.eval.rollout.engine", partial(engine, workers=0)):
            said = succeeds("engines", "trace", self.folder / "eval/mujoco.trace.npz", *options)
        data = json.loads((out / "trace.json").read_text())
        self.assertEqual([e["name"] for e in data["engines"]], ["mujoco", "sapien"])
        self.assertRegex(said, "sapien (stays with mujoco|diverges first)")
        self.assertEqual(data["label"], "zero in mujoco, demonstration 1")


class CommandTest(InFolder):
    def test_a_file_of_another_kind(self):
        wrong = self.folder / "wrong.npz"
        np.savez(wrong, schema="xreset-replays/1")
        self.assertIn("expected 'xreset-demos/1'", refused("engines", "trace", wrong))
