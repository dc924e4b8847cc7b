import dataclasses
import math
import unittest

import torch

from tests.test_retarget import box_object
from xreset import robots
from xreset.demos.archive import demo_objects
from xreset.demos.synth import synthesize
from xreset.geometry.rotations import quat_from_axis_angle, quat_multiply, quat_rotate
from xreset.geometry.surface import Surface
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.model import HandModel, HandState, HandTargets
from xreset.retarget.hand.solve import retarget_hand
from xreset.retarget.pipeline import RetargetConfig, hand_motions

FLOAT = torch.float64
UP = torch.tensor([0.0, 0.0, 1.0], dtype=FLOAT)
BOX = Surface(box_object(((0, 0, 0), (0.05, 0.05, 0.1))))


class PadsTest(unittest.TestCase):
    """The OpenArm's jaw about a box 5 cm thick, far above the table. It opens along its root's y axis and reaches along z."""

    @classmethod
    def setUpClass(cls):
        cls.model = HandModel(robots.load("openarm"))

    def aslant(self, angle: float, *, held: bool = True, frames: int = 6) -> tuple[HandState, HandTargets]:
        """A jaw turned by an angle [rad] about its axis of approach, its pads 2 mm from the box's edges, and keypoints that are its own."""
        turn = quat_from_axis_angle(torch.tensor([0.0, 0.0, angle], dtype=FLOAT)).expand(1, frames, 4)
        half = 0.025 * (math.cos(angle) + math.sin(angle)) + 0.002
        joints = torch.full(
            (1, frames, 1), half - 0.0005, dtype=FLOAT
        )  # 0.5 mm is either pad from the middle of the closed jaw
        middle = self.model.keypoints(joints, torch.zeros(1, frames, 3, dtype=FLOAT), turn)[:, :, 1:].mean(dim=2)
        state = HandState(joints=joints, root_pos=UP - middle, root_quat=turn)
        keypoints = self.model.keypoints(joints, state.root_pos, turn)
        flags = torch.ones(1, frames, dtype=torch.bool)
        targets = HandTargets(
            keypoints=keypoints,
            annotated=flags,
            contact_points=torch.zeros_like(keypoints),
            in_contact=torch.zeros(keypoints.shape[:3], dtype=torch.bool),
            held=flags & held,
            object_pos=UP.expand(1, frames, 3),
            object_quat=torch.tensor([1.0, 0, 0, 0], dtype=FLOAT).expand(1, frames, 4),
            object_index=torch.zeros(1, dtype=torch.long),
            fields=BOX.field,
        )
        return state, targets

    def degrees_off(self, targets: HandTargets, config: HandConfig) -> float:
        """Largest angle between the jaw's axis and the box's face."""
        motion = retarget_hand(self.model, targets, config)
        axis = quat_rotate(motion.root_quat, torch.tensor([0.0, 1.0, 0.0], dtype=FLOAT).expand(*motion.root_pos.shape))
        return math.degrees(axis[..., 1].abs().clamp_max(1.0).acos().max().item())

    def test_pads_are_the_faces_that_meet(self):
        balls = self.model.balls
        for side, link in ((1.0, "right_finger"), (-1.0, "left_finger")):
            mine = balls.link[self.model.pad_balls] == balls.links.index(link)
            pad = self.model.pad_balls[mine]
            centers = balls.centers[pad]
            radii = balls.radii[pad]
            self.assertLess((side * centers[:, 1] + radii - 0.0055).abs().max().item(), 1.1e-3)
            self.assertGreater(centers[:, 2].max().item() - centers[:, 2].min().item(), 0.05)
            self.assertAlmostEqual(self.model.pad_shares[mine].sum().item(), 1.0)
        for name in ("ur7e-sharpa", "xarm7-leap"):
            self.assertEqual(len(HandModel(robots.load(name)).pad_balls), 0, name)

    def test_a_jaw_that_holds_is_turned_to_the_faces(self):
        _, targets = self.aslant(math.radians(20))
        self.assertLess(self.degrees_off(targets, HandConfig()), 5.0)
        self.assertGreater(self.degrees_off(targets, HandConfig(pad_weight=0.0)), 15.0)
        _, free = self.aslant(math.radians(20), held=False)
        self.assertGreater(self.degrees_off(free, HandConfig()), 15.0)

    def test_gradient_is_the_derivative_of_the_cost(self):
        state, targets = self.aslant(math.radians(17), frames=2)
        config = HandConfig(clearance_weight=0.0)
        found = system(self.model, targets, config, state)
        without = system(self.model, targets, dataclasses.replace(config, pad_weight=0.0), state)
        self.assertGreater((found.cost - without.cost).item(), 1e-3)
        step = 1e-6
        for k in range(7):
            costs = []
            for sign in (1.0, -1.0):
                shift = torch.zeros_like(found.gradient)
                shift[:, 1, k] = sign * step
                moved = HandState(
                    joints=state.joints + shift[..., :1],
                    root_pos=state.root_pos + shift[..., 1:4],
                    root_quat=quat_multiply(quat_from_axis_angle(shift[..., 4:]), state.root_quat),
                )
                costs.append(system(self.model, targets, config, moved).cost)
            slope = (costs[0] - costs[1]) / (4 * step)  # gradient is half the derivative
            torch.testing.assert_close(
                found.gradient[:, 1, k], slope, rtol=2e-3, atol=2e-4 * float(found.gradient.abs().max())
            )

    def test_an_object_is_held_between_the_human_s_thumb_and_a_finger(self):
        demos = synthesize(["soup"], per_object=1, seed=1)
        objects = list(demo_objects(demos).values())
        config = HandConfig(clearance_growth=(), iterations=0)
        [(_, targets, _)] = hand_motions(demos, self.model.robot, objects, RetargetConfig(hand=config))
        self.assertFalse(targets.held[0, 0])
        self.assertTrue(targets.held[0, -1])


if __name__ == "__main__":
    unittest.main()
