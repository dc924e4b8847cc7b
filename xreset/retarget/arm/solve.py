"""Arm inverse kinematics: arm joints that carry a retargeted hand along its path, the hand's joints held fixed (the
paper, appendix D.b).

    q_t = argmin  50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint
    limits,

by Levenberg-Marquardt with projected steps (``cost``), frame after frame, batched over sequences (``paths``).

The first frame starts from random restarts. The best few distinct solutions are all followed, and the one with most
valid frames wins, because the first frame does not show which branch lasts. Where a frame fails, the same is tried
backwards from the last frame: the branch that reaches the goal may look worse than others at the start. Where shapes of
the robot then collide, the path is followed once more with a cost for it, which is too slow to be used everywhere.
Where the wrist is still missed, some of those frames are solved again and followed both ways, and all paths are spliced
into one.

Shape letters: S sequences, T frames, K paths of a sequence, C sequences to improve, n arm joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel, ArmTargets, measure
from xreset.retarget.arm.paths import (
    ArmProblem,
    Paths,
    Progress,
    best,
    branches,
    follow,
    repaired,
)
from xreset.retarget.validity import REASONS, Measures, Thresholds

_WRIST_MISSED = ("joint limit", "wrist position", "wrist orientation")
"""Reasons of frames whose wrist is not where it should be."""


def track(
    model: ArmModel,
    targets: ArmTargets,
    thresholds: Thresholds,
    config: ArmConfig | None = None,
    progress: Progress = lambda _: None,
) -> tuple[Tensor, Measures]:
    """Find arm joints along the hand's path.

    Args:
        model: the robot.
        targets: the path.
        thresholds: limits of a valid frame; they decide between branches.
        config: weights and effort.
        progress: called with the fraction that is done.

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
    forwards = branches(problem, lambda done: progress(0.3 * done))
    joints, worth = best(problem, forwards)
    failing = (problem.reasons(joints) > REASONS.index("hand error")).any(dim=1).nonzero()[:, 0]
    if len(failing):
        part = problem.select(failing)
        joints[failing] = _rescued(part, forwards[failing], joints[failing], worth[failing], progress)
    progress(1.0)
    return joints, measure(model, targets, joints)


def _rescued(
    problem: ArmProblem,
    forwards: Paths,
    joints: Tensor,
    worth: Tensor,
    progress: Progress,
) -> Tensor:
    """[S, T, n] better paths than ``joints`` [S, T, n], where there are any, for sequences with frames that fail.

    Args:
        problem: the problem of these sequences.
        forwards: their paths from the first frame.
        joints: the best of those.
        worth: [S] its worth.
        progress: called with the fraction that is done.
    """
    paths = forwards
    if problem.targets.annotated.shape[1] > 1:
        turned = problem.reversed()
        backwards = branches(turned, lambda done: progress(0.3 + 0.3 * done))
        back, other = best(turned, backwards)
        joints = torch.where((other > worth)[:, None, None], back.flip(1), joints)
        paths = Paths.cat((forwards, backwards.reversed()), dim=1)

    def without_collision(part: ArmProblem, rows: Tensor, _: Tensor) -> Tensor:
        return follow(
            part,
            joints[rows, 0],
            lambda done: progress(0.6 + 0.1 * done),
            self_collision=True,
        )

    def mended(part: ArmProblem, rows: Tensor, missed: Tensor) -> Tensor:
        present = part.examined(joints[rows, None])  # it may have been followed again
        known = Paths.cat((present, paths[rows]), dim=1)
        return repaired(part, known, missed, lambda done: progress(0.7 + 0.3 * done))

    _improve(problem, joints, ("self collision",), without_collision)
    if problem.config.reseeds:
        _improve(problem, joints, _WRIST_MISSED, mended)
    return joints


def _improve(
    problem: ArmProblem,
    joints: Tensor,
    reasons: Sequence[str],
    search: Callable[[ArmProblem, Tensor, Tensor], Tensor],
) -> None:
    """Search new paths for sequences with a frame that is invalid for one of the reasons; keep those with more valid
    frames.

    Args:
        problem: the problem of the sequences.
        joints: [S, T, n] paths, changed in place.
        reasons: some of :data:`~xreset.retarget.validity.REASONS`.
        search: finds new paths [C, T, n], given the problem of the C sequences concerned, their indices [C] and their
            frames that are invalid for one of the reasons [C, T].
    """
    reason = problem.reasons(joints)
    concerned = torch.isin(reason, torch.tensor([REASONS.index(name) for name in reasons]))
    rows = concerned.any(dim=1).nonzero()[:, 0]
    if not len(rows):
        return
    part = problem.select(rows)
    new = search(part, rows, concerned[rows])
    better = (part.reasons(new) == 0).sum(1) > (reason[rows] == 0).sum(1)
    joints[rows[better]] = new[better]
