import unittest

import numpy as np
import torch

from xreset import robots
from xreset.geometry.kinematics import Kinematics
from xreset.retarget.hand import terms

FLOAT = torch.float64
STEP = 1e-6


class TermTest(unittest.TestCase):
    """Every term's half gradient is half the numerical derivative of its cost; its curvature is symmetric and not negative."""

    def setUp(self):
        generator = torch.Generator().manual_seed(0)
        self.x, self.target = (torch.randn(4, 3, 3, dtype=FLOAT, generator=generator) for _ in range(2))
        self.weight = torch.rand(4, 3, dtype=FLOAT, generator=generator)

    def check(self, term, x):
        found = term(x)
        for k in range(x.shape[1]):
            for i in range(3):
                shift = torch.zeros_like(x)
                shift[:, k, i] = STEP
                slope = (term(x + shift).cost - term(x - shift).cost) / (4 * STEP)
                torch.testing.assert_close(found.gradient[:, k, i], slope, atol=1e-8, rtol=1e-6)
        torch.testing.assert_close(found.curvature, found.curvature.mT)
        self.assertGreaterEqual(torch.linalg.eigvalsh(found.curvature).min().item(), -1e-12)
        return found

    def test_difference(self):
        found = self.check(lambda x: terms.difference(x, self.target, self.weight), self.x)
        torch.testing.assert_close(found.curvature[..., 0, 0], self.weight)

    def test_direction(self):
        found = self.check(lambda x: terms.direction(x, self.target, self.weight), self.x)
        along = (found.curvature @ self.x[..., None])[..., 0]  # no change of length changes a direction
        torch.testing.assert_close(along, torch.zeros_like(along), atol=1e-12, rtol=0)

    def test_contact_within_the_margin_below_and_above_the_knee(self):
        gap = torch.tensor([0.05, 0.11, 0.5], dtype=FLOAT)[:, None] * torch.nn.functional.normalize(self.x, dim=-1)
        found = self.check(lambda x: terms.contact(x, self.target, self.weight, 0.1, 0.02), self.target + gap)
        self.assertTrue((found.gradient[:, 0] == 0).all())
        cornered = terms.contact(
            self.target + gap, self.target, self.weight, 0.1, 1e-9
        ).cost  # the paper's: 0, 1 cm and 40 cm beyond
        torch.testing.assert_close(
            cornered, self.weight @ torch.tensor([0.0, 0.01, 0.4], dtype=FLOAT), atol=1e-8, rtol=0
        )

    def test_attraction(self):
        d = torch.tensor([[0.1, -0.3, 0.99, 1.2]], dtype=FLOAT)
        weight = torch.tensor([2.0, 3.0, 4.0, 5.0], dtype=FLOAT)
        found = terms.attraction(d, weight, 1.0)
        for k in range(4):
            shift = torch.zeros_like(d)
            shift[0, k] = STEP
            slope = (terms.attraction(d + shift, weight, 1.0).cost - terms.attraction(d - shift, weight, 1.0).cost) / (
                4 * STEP
            )
            torch.testing.assert_close(found.gradient[:, k], slope, atol=1e-8, rtol=1e-6)
        self.assertEqual(found.gradient[0, 3].item(), 0.0)  # beyond its reach
        self.assertTrue((found.curvature >= 0).all())
        near = torch.full((1, 4), 1e-3, dtype=FLOAT)
        torch.testing.assert_close(terms.attraction(near, weight, 1.0).cost, near.square() @ weight, atol=0, rtol=1e-5)

    def test_change(self):
        d = torch.tensor([[0.1, -0.3, 0.5]], dtype=FLOAT)
        weight = torch.tensor([2.0, 3.0, 4.0], dtype=FLOAT)
        limit = torch.tensor([0.2, 0.2, torch.inf], dtype=FLOAT)
        cost, gradient, curvature = terms.change(d, weight, limit, 100.0)
        for k in range(3):
            shift = torch.zeros_like(d)
            shift[0, k] = STEP
            slope = (
                terms.change(d + shift, weight, limit, 100.0)[0] - terms.change(d - shift, weight, limit, 100.0)[0]
            ) / (4 * STEP)
            torch.testing.assert_close(gradient[:, k], slope, atol=1e-8, rtol=1e-6)
        torch.testing.assert_close(curvature, torch.tensor([[2.0, 103.0, 4.0]], dtype=FLOAT))
        torch.testing.assert_close(cost, torch.tensor([2 * 0.01 + 3 * 0.09 + 4 * 0.25 + 100 * 0.01], dtype=FLOAT))


class RobotKinematicsTest(unittest.TestCase):
    def test_both_robots_agree_with_mujoco_in_a_thousand_configurations(self):
        import mujoco

        for name in ("ur7e-sharpa", "openarm"):
            with self.subTest(robot=name):
                robot = robots.load(name)
                kinematics = Kinematics(robot)
                description = mujoco.MjSpec.from_file(str(robot.urdf))
                description.compiler.fusestatic = False
                model = description.compile()
                data = mujoco.MjData(model)
                generator = torch.Generator().manual_seed(0)
                share = torch.rand(1000, len(robot.joints), dtype=FLOAT, generator=generator)
                q = kinematics.lower + (kinematics.upper - kinematics.lower) * share
                poses = kinematics.link_poses(q, base=torch.eye(4, dtype=FLOAT)).numpy()
                mimics = {mimic.joint: mimic for mimic in robot.mimics}
                values = np.zeros((1000, model.nq))
                for j in range(model.njnt):
                    joint = model.joint(j).name
                    mimic = mimics.get(joint)
                    column = q[:, robot.joint_names.index(mimic.source if mimic else joint)].numpy()
                    values[:, model.jnt_qposadr[j]] = mimic.multiplier * column + mimic.offset if mimic else column
                links = [i for i, link in enumerate(kinematics.link_names) if link != kinematics.root]
                bodies = [model.body(kinematics.link_names[i]).id for i in links]
                for row in range(1000):
                    data.qpos[:] = values[row]
                    mujoco.mj_kinematics(model, data)
                    np.testing.assert_allclose(poses[row, links, :3, 3], data.xpos[bodies], atol=1e-6)
                    np.testing.assert_allclose(poses[row, links, :3, :3].reshape(-1, 9), data.xmat[bodies], atol=1e-6)


if __name__ == "__main__":
    unittest.main()
