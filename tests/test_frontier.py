"""From which demonstrated states a policy goes on to the goal."""

import tempfile
import unittest
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np

from tests.command import xreset
from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_robot import toy_hand_arm
from xreset.errors import DemoError
from xreset.eval.frontier import STAGES, StateOutcome, by_stage, frontier, stage_of
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.trial import engine, load_trial
from xreset.files import read_json
from xreset.objects.catalogue import load_objects
from xreset.objects.rest import rest_height
from xreset.policy import ZeroPolicy
from xreset.resets.bank import read_bank, write_bank
from xreset.task.config import ObservationConfig, TaskConfig, TerminationConfig

try:
    import mujoco  # noqa: F401
except ImportError as error:
    raise unittest.SkipTest(str(error)) from error


class StageTest(unittest.TestCase):
    def test_distance_counts_until_the_object_is_lifted(self):
        distance = np.array([0.21, 0.19, 0.051, 0.049, 0.021, 0.019, 0.0, 0.5, 0.0])
        lift = np.array([0.0, 0.009, 0.0, -0.01, 0.0, 0.0, 0.0, 0.011, 0.11])
        self.assertEqual(stage_of(distance, lift).tolist(), [0, 1, 1, 2, 2, 3, 3, 4, 5])

    def test_shares_of_each_stage_that_occurs(self):
        def tried(stage: str, reached: bool, stayed: bool) -> StateOutcome:
            return StateOutcome(
                state=0, sequence_name="a", frame=0, object=SOUP, stage=stage, reached=reached, stayed=stayed
            )

        found = by_stage([tried(STAGES[4], True, False), tried(STAGES[0], False, False), tried(STAGES[4], True, True)])
        self.assertEqual(
            found,
            [
                {"stage": STAGES[0], "states": 1, "reached": 0.0, "stayed": 0.0},
                {"stage": STAGES[4], "states": 2, "reached": 1.0, "stayed": 0.5},
            ],
        )


class FrontierTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = Path(cls.enterClassContext(tempfile.TemporaryDirectory()))
        cls.robot = toy_hand_arm(cls.folder)
        objects = {o.name: o for o in load_objects((SOUP, SPAM))}
        bank = toy_bank(cls.robot)
        # Objects stand on the table: state 1 where its goal is, state 4 at its goal but 30 cm too high, the others 10 cm beside it.
        names, sequence = bank.object_name.tolist(), bank.sequence_index
        rest = [rest_height(objects[name], np.array([1.0, 0, 0, 0])) for name in bank.sequence_object.tolist()]
        goal = np.column_stack((bank.start_pos[:, :2], rest)).astype(np.float32)
        goal[2, 2] += 0.3
        pos = goal[sequence] + np.array([0.1, 0, 0], dtype=np.float32)
        pos[[1, 4]] = goal[sequence[[1, 4]]]
        upright = np.tile([1.0, 0, 0, 0], (3, 1)).astype(np.float32)
        cls.names = names
        cls.bank = replace(
            bank,
            object_pos=pos,
            goal_pos=goal,
            goal_quat_wxyz=upright,
            start_pos=np.column_stack((goal[:, :2], rest)).astype(np.float32),
            object_sources=tuple(objects[name].source for name in bank.object_names),
        )
        cls.resets = cls.folder / "resets.npz"
        write_bank(cls.resets, cls.bank, config={}, inputs={})
        cls.task = TaskConfig(
            termination=TerminationConfig(episode_seconds=0.5), observation=ObservationConfig(cloud_points=16), distance_points=64,
        )  # fmt: skip

    def run_frontier(self, resets: Path, states: int = 100, num_envs: int = 4) -> list[dict]:
        policy = PolicySpec(
            name="zero",
            start=lambda motion: ZeroPolicy(len(self.robot.joints)),
            robot=self.robot,
            task=self.task,
            folder=self.folder / "eval",
        )
        trial = load_trial(policy, resets, num_envs=num_envs, accept=("bank",))
        return frontier(policy, trial, [engine("mujoco")], self.folder / "out", states=states)

    def test_every_state_is_tried_once_and_what_became_of_it_is_written(self):
        (result,) = self.run_frontier(self.resets)
        written = read_json(self.folder / "out" / "mujoco.json", result["schema"])
        self.assertEqual({"schema": result["schema"]} | written, result)
        tried = result["tried"]
        self.assertEqual([t["state"] for t in tried], list(range(6)))
        self.assertEqual([t["object"] for t in tried], self.names)
        self.assertEqual([t["frame"] for t in tried], self.bank.frame_index.tolist())
        self.assertEqual(
            [t["reached"] for t in tried], [False, True, False, False, True, False], "there, or falling from there"
        )
        self.assertEqual(
            [t["stayed"] for t in tried],
            [False, True, False, False, False, False],
            "at full gravity nothing stays in the air",
        )
        self.assertEqual(tried[4]["stage"], "lifted by over 10 cm")
        self.assertEqual(sum(row["states"] for row in result["stages"]), 6)

        (few,) = self.run_frontier(self.resets, num_envs=2)
        self.assertEqual(few["tried"], tried, "the number of worlds changes nothing")

    def test_the_seed_chooses_among_the_states(self):
        outcome = StateOutcome(
            state=0, sequence_name="a", frame=0, object=SOUP, stage=STAGES[0], reached=True, stayed=True
        )
        with mock.patch("xreset.eval.frontier.try_policy", return_value=[outcome]) as tried:
            self.run_frontier(self.resets, states=3)
        self.assertEqual(len(set(tried.call_args.args[3].tolist())), 3)

    def test_a_bank_without_states_is_an_error(self):
        empty = self.folder / "empty.npz"
        write_bank(empty, self.bank.with_states(np.zeros(6, dtype=bool)), config={}, inputs={})
        self.assertEqual(read_bank(empty).num_states, 0)
        with self.assertRaisesRegex(DemoError, "bank holds no state to try"):
            self.run_frontier(empty)

    def test_the_command_refuses_what_cannot_go_on_from_a_state(self):
        for arguments, words in (
            (("ik", "--robot", "ur7e-sharpa"), "cannot continue from a state"),
            (("zero", "--states", "0"), "expected a whole number from 1"),
        ):
            self.assertIn(words, xreset("frontier", *arguments, "--resets", self.resets)[2])


if __name__ == "__main__":
    unittest.main()
