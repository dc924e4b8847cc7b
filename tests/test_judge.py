"""The judge of a robot: which accepted states hold, lift and turn their object."""

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation

from tests import toy_grasp
from tests.command import refused, succeeds
from tests.data import InFolder
from tests.toy_bank import shifted
from tests.toy_grasp import OPEN, brick, robot
from tests.toy_robot import toy_robot
from xreset import SqueezeConfig, load_robot, write_bank
from xreset.errors import DemoError, RobotError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import quat_of, turn_of
from xreset.resets.programs import palm_path
from xreset.robot_tools import judge as judging
from xreset.robot_tools.verbs import judge


def bank():
    """Six states with the brick between the jaws, 5 cm above where the demonstrations start; half are before contact."""
    found = toy_grasp.grasps()
    found.start_pos[:, 2] -= 0.05
    return found


class Judge(InFolder):
    def test_a_firm_grip_holds_and_lifts(self):
        squeeze = SqueezeConfig(force=4.0)
        found = judge(bank(), robot(), (brick(),), squeeze=squeeze)
        self.assertLess(len(repr(found)), 1000)
        brick_row, sum_row = found.rows
        self.assertEqual((brick_row.object_name, sum_row.object_name), ("brick", "all"))
        self.assertEqual((brick_row.tried, brick_row.hold, brick_row.lift), (3, 3, 3))
        # its arm cannot turn that way
        self.assertEqual((sum_row.arm_fails, sum_row.turn), (3, 0))
        self.assertEqual(found.prospects, {"brick": 0.0})
        # the toy bank's targets are the joints' positions, and its hand is no jaw
        reached = [(row.object_name, row.reached, row.lost) for row in found.reach]
        self.assertEqual(reached, [(name, 0, {"no grasp": 3}) for name in ("brick", "all")])
        rise = np.diff(found.shots["brick"][:, -5])  # of the object's z
        self.assertGreater(rise[1], 0.08)

    def test_the_tightest_grasp_of_each_demonstration_is_tried_first(self):
        """In the fourth state one finger is nearer to the brick than in the third, and the other farther."""
        own = bank()
        jaws = [0.0206, 0.0205, 0.024, 0.023, 0.027, 0.027]
        jaw = robot().joint_names.index("jaw_a_slide")
        own.joint_pos[:, jaw] = jaws
        home = torch.as_tensor(robot().home)
        across = Kinematics(robot()).link_poses(home, ["wrist"])[0, :3, 0].numpy()
        own.object_pos[3] += 0.0025 * across
        own.post_contact[:] = True
        with patch.object(judging, "probe", return_value=np.zeros((2, 40))) as tried:
            judge(own, robot(), (brick(),), states=2)
        start = tried.call_args.args[3]
        assert_allclose(start.joint_pos, own.joint_pos[[1, 2]])
        self.assertLess(start.joint_target[0, jaw], 0.005, "two fingertips press with 20 N")

    def test_the_origin_of_a_mesh_may_be_anywhere(self):
        """This one moves by centimeters where the brick turns a little in the hand."""
        shift = np.array([0, 40.0, 40.0])
        own = bank()
        moved = {}
        for name in ("object", "start", "goal"):
            turn = turn_of(getattr(own, f"{name}_quat_wxyz"))
            place = getattr(own, f"{name}_pos") - turn.apply(shift)
            moved[f"{name}_pos"] = place.astype(np.float32)
        far = (replace(own, **moved), robot(), (shifted(brick(), shift),))
        row, _ = judge(*far, squeeze=SqueezeConfig(force=4.0)).rows
        self.assertEqual((row.tried, row.hold, row.lift), (3, 3, 3))

    def test_prospects_are_states_that_turn_times_demonstrations_in_reach(self):
        def row(engine, name, turn):
            return judging.Judged(
                engine=engine, object_name=name, tried=8, hold=8, lift=8, turn=turn, arm_fails=0
            )

        def reach(name, reached):
            return judging.Reached(object_name=name, demonstrations=4, reached=reached, lost={})

        found = judging.Judgement(
            robot="hand",
            rows=(row("a", "can", 4), row("a", "box", 8), row("b", "can", 0), row("b", "box", 0)),
            without=("pen",),
            reach=(reach("can", 4), reach("box", 3), reach("pen", 4), reach("all", 11)),
            shots={},
        )
        expected = [("box", 0.75), ("can", 0.5), ("pen", 0.0)]
        self.assertEqual([*found.prospects.items()], expected)

    def test_the_arm_raises_and_then_turns_the_palm(self):
        kinematics = Kinematics(load_robot("ur7e-sharpa"))
        joints = torch.as_tensor(kinematics.robot.home)[None]
        palm = kinematics.link_poses(joints, ["palm"])[:, 0]
        for turn in (0.0, judging.TURN):
            path, error = judging.arm_path(kinematics, joints, palm, turn=turn)
            self.assertLess(error, 1.0)
            joints = path[-1]
            relative = torch.linalg.inv(palm[0]) @ kinematics.link_poses(joints, ["palm"])[0, 0]
            self.assertAlmostEqual(torch.atan2(relative[2, 1], relative[2, 2]), turn, delta=0.03)
        rise = kinematics.link_poses(path, ["palm"])[..., 2, 3] - palm[0, 2, 3]
        assert_allclose(rise, judging.HEIGHT, atol=0.005, err_msg="it stays up while it turns")

    def test_joints_of_a_path_are_the_best_compromise_and_what_is_missing_is_told(self):
        """The toy's arm has three joints, too few for this pose."""
        kinematics = Kinematics(toy_robot())
        home = kinematics.home[None]
        palm = kinematics.link_poses(home, ["palm"])[0, 0].numpy()
        pos = palm[:3, 3] + [0.02, -0.03, 0.01]
        turn = Rotation.from_rotvec([0.1, 0.05, -0.1]) * Rotation.from_matrix(palm[:3, :3])
        goal = (torch.as_tensor(pos)[None, None], torch.as_tensor(quat_of(turn))[None, None])
        for iterations, length in ((1, 0.3), (200, 0.05), (200, 1.0)):
            path, missing = palm_path(
                kinematics, home, *goal, iterations=iterations, turn_length=length
            )
            end = kinematics.jacobian(path[-1], ["palm"])
            left = (turn * Rotation.from_matrix(end.rot[0, 0].numpy()).inv()).as_rotvec()
            assert_allclose(missing[0], [*(pos - end.pos[0, 0].numpy()), *left], atol=1e-9)
            # no joint of the arm can lower the squared error
            slope = (
                missing[:, :3] @ end.linear[0, 0] + length**2 * missing[:, 3:] @ end.angular[0, 0]
            )
            if iterations > 1:
                self.assertLess(slope[0, kinematics.robot.arm_indices].abs().max(), 1e-6)

    def test_a_bank_without_grasps_in_the_air_is_refused(self):
        low = replace(
            bank(), object_pos=bank().object_pos - np.array([0, 0, 0.05], dtype=np.float32)
        )
        with self.assertRaisesRegex(RobotError, "no state in which an object is in the air"):
            judge(low, robot(), (brick(),))
        wide = bank().joint_pos.copy()
        wide[:, robot().joint_names.index("jaw_a_slide")] = OPEN + 0.03
        with self.assertRaisesRegex(RobotError, "within 10 mm of the object"):
            judge(replace(bank(), joint_pos=wide), robot(), (brick(),))
        names = {"object_names": ("brick", "can"), "object_sources": ("stand-in", "stand-in")}
        more = replace(bank(), sequence_object=np.array(["brick", "brick", "can"]), **names)
        with self.assertRaisesRegex(DemoError, "not given: can. Given: brick."):
            judge(more.with_states(np.arange(4)), robot(), (brick(),))

    def test_a_weak_grip_drops_in_the_command(self):
        self.enterContext(toy_grasp.found())
        write_bank(f"{self.folder}/bank.npz", bank())
        words = "--engine mujoco --squeeze.force 0.2 --picture"
        picture = self.folder / "judge.png"
        said = succeeds("robots judge", self.folder / "bank.npz", words, picture)
        self.assertRegex(said, r"brick +│ +3 +│ 0, 0, 0")
        self.assertIn("in 3 of 3 states", said)
        self.assertIn("place counts frames in which the arm follows the human", said)
        self.assertIn("demonstrations in reach): brick 0%", said)
        self.assertEqual(Image.open(picture).size[0], 4 * judging._TILE[0])
        with patch.object(judging, "try_grasps", side_effect=RobotError("tried")) as tried:
            refused("robots judge", self.folder / "bank.npz")
            self.assertIn("mujoco", tried.call_args.args[3])
            self.assertNotIn("mujoco-warp", tried.call_args.args[3], "it is slow on a CPU")
            refused("robots judge", self.folder / "bank.npz", "--engine mujoco")
            self.assertEqual([*tried.call_args.args[3]], ["mujoco"])
