"""Arm inverse kinematics: arm joints that carry a retargeted hand along its path, the hand's joints held fixed (the
paper, appendix D.b).

    q_t = argmin  50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint
    limits,

by Levenberg-Marquardt with projected steps (``cost``), frame after frame, batched over sequences (``paths``).

The first frame starts from random restarts. The best few distinct solutions are all followed, and the one with most
valid frames wins, because the first frame does not show which branch lasts. Where a frame fails, the same is tried
backwards from the last frame: the branch that reaches the goal may look worse than others at the start. Where the wrist
is still missed, some of those frames are solved again and followed both ways, and all paths are spliced into one.

Shape letters: S sequences, T frames, K paths of a sequence, C sequences to improve, n arm joints.
"""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel, ArmTargets, measure
from xreset.retarget.arm.paths import ArmProblem, Paths, best, branches, repaired
from xreset.retarget.validity import REASONS, Measures, Thresholds

_WRIST_MISSED = ("joint limit", "wrist position", "wrist orientation")
"""Reasons of frames whose wrist is not where it should be."""


def track(
    model: ArmModel, targets: ArmTargets, thresholds: Thresholds, config: ArmConfig | None = None
) -> tuple[Tensor, Measures]:
    """Find arm joints along the hand's path.

    Args:
        model: the robot.
        targets: the path.
        thresholds: limits of a valid frame; they decide between branches.
        config: weights and effort.

    Returns:
        [S, T, n] arm joints, and the measures of every frame ([S, T] each).
    """
    problem = ArmProblem(
        model=model,
        targets=targets,
        hand_poses=model.hand_poses(targets.hand_joints),
        thresholds=thresholds,
        config=config or ArmConfig(),
    )
    forwards = branches(problem)
    joints, worth = best(problem, forwards)
    failing = (problem.reasons(joints) > REASONS.index("hand error")).any(dim=1).nonzero()[:, 0]
    if len(failing):
        part = problem.select(failing)
        joints[failing] = _rescued(part, forwards[failing], joints[failing], worth[failing])
    return joints, measure(model, targets, joints)


def _rescued(problem: ArmProblem, paths: Paths, joints: Tensor, worth: Tensor) -> Tensor:
    """[S, T, n] better paths than ``joints`` [S, T, n], where there are any, for sequences with frames that fail.

    Args:
        problem: the problem of these sequences.
        paths: their paths from the first frame.
        joints: the best of those.
        worth: [S] its worth.
    """
    if problem.targets.annotated.shape[1] > 1:
        turned = problem.reversed()
        backwards = branches(turned)
        back, other = best(turned, backwards)
        joints = torch.where((other > worth)[:, None, None], back.flip(1), joints)
        paths = Paths.cat((paths, backwards.reversed()), dim=1)
    if problem.config.reseeds:
        reason = problem.reasons(joints)
        missed = torch.isin(reason, torch.tensor([REASONS.index(name) for name in _WRIST_MISSED]))
        rows = missed.any(dim=1).nonzero()[:, 0]
        if len(rows):
            part = problem.select(rows)
            new = repaired(part, paths[rows], missed[rows])
            better = (part.reasons(new) == 0).sum(1) > (reason[rows] == 0).sum(1)
            joints[rows[better]] = new[better]
    return joints
