"""Arm inverse kinematics: arm joints that carry a retargeted hand along its path, the hand's joints held fixed (the paper, appendix D.b).

    q_t = argmin  50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint limits,

by Levenberg-Marquardt with projected steps (``cost``), frame after frame, batched over sequences (``paths``). The first frame
starts from random restarts; the best few distinct solutions are all followed, and the one with most valid frames wins: the first frame
cannot tell which branch lasts. The same is tried backwards from the last frame where a frame fails: the branch that reaches the goal may
look worse than others at the start. Where shapes of the robot then collide, the path is followed once more with a cost for it, which is too
slow to pay always. Where the wrist is still missed, some of those frames are solved afresh and followed both ways, and all paths become one
(``splice``).

Shape letters: S sequences, T frames, K paths of a sequence, n arm joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.model import ArmModel, ArmTargets, measure
from xreset.retarget.arm.paths import ArmProblem, Paths, Progress, best, branches, follow, mend
from xreset.retarget.validity import REASONS, Measures, Thresholds

__all__ = ["ArmConfig", "ArmModel", "ArmTargets", "measure", "track"]

_MISSED = ("joint limit", "wrist position", "wrist orientation")
"""The reasons of frames whose wrist is not where it should be."""


def track(
    model: ArmModel,
    targets: ArmTargets,
    thresholds: Thresholds,
    config: ArmConfig | None = None,
    progress: Progress | None = None,
) -> tuple[Tensor, Measures]:
    """Arm joints along the hand's path.

    Args:
        thresholds: of a valid frame; they decide between branches.
        progress: called with the fraction that is done.

    Returns:
        [S, T, n] arm joints, and what was measured of every frame ([S, T] each).
    """
    poses = model.hand_poses(targets.hand_joints)
    problem = ArmProblem(
        model=model, targets=targets, hand_poses=poses, thresholds=thresholds, config=config or ArmConfig()
    )
    report = progress or (lambda _: None)

    forwards = branches(problem, lambda done: report(0.3 * done))
    joints, worth = best(problem, forwards)
    failing = (problem.reasons(joints) > REASONS.index("hand error")).any(dim=1).nonzero()[:, 0]
    if len(failing):
        joints[failing] = _rescued(problem.select(failing), forwards[failing], joints[failing], worth[failing], report)
    report(1.0)
    return joints, measure(model, targets, joints)


def _rescued(problem: ArmProblem, forwards: Paths, joints: Tensor, worth: Tensor, report: Progress) -> Tensor:
    """[S, T, n] better paths than ``joints`` [S, T, n], where there are any, of sequences with frames that fail.

    Args:
        forwards: their paths from the first frame.
        joints: the best of those.
        worth: [S] its worth.
        report: called with the fraction that is done.
    """
    paths = forwards
    if problem.targets.annotated.shape[1] > 1:
        turned = problem.reversed()
        backwards = branches(turned, lambda done: report(0.3 + 0.3 * done))
        back, other = best(turned, backwards)
        joints = torch.where((other > worth)[:, None, None], back.flip(1), joints)
        paths = Paths.cat((forwards, backwards.reversed()), dim=1)

    def apart(part: ArmProblem, rows: Tensor, _: Tensor) -> Tensor:
        return follow(part, joints[rows, 0], lambda done: report(0.6 + 0.1 * done), self_collision=True)

    def mended(part: ArmProblem, rows: Tensor, missed: Tensor) -> Tensor:
        present = part.examined(joints[rows, None])  # it may have been followed anew
        return mend(part, Paths.cat((present, paths[rows]), dim=1), missed, lambda done: report(0.7 + 0.3 * done))

    _improve(problem, joints, ("self collision",), apart)
    if problem.config.reseeds:
        _improve(problem, joints, _MISSED, mended)
    return joints


def _improve(
    problem: ArmProblem, joints: Tensor, reasons: Sequence[str], again: Callable[[ArmProblem, Tensor, Tensor], Tensor]
) -> None:
    """Find new paths for sequences with a frame that is invalid for one of the reasons; where more frames are valid then, replace the old.

    Args:
        joints: [S, T, n] paths, changed in place.
        reasons: some of :data:`~xreset.retarget.validity.REASONS`.
        again: finds new paths [C, T, n], given the problem of the C sequences concerned, their indices [C] and their frames that are
            invalid for one of the reasons [C, T].
    """
    reason = problem.reasons(joints)
    concerned = torch.isin(reason, torch.tensor([REASONS.index(name) for name in reasons]))
    rows = concerned.any(dim=1).nonzero()[:, 0]
    if not len(rows):
        return
    part = problem.select(rows)
    new = again(part, rows, concerned[rows])
    better = (part.reasons(new) == 0).sum(1) > (reason[rows] == 0).sum(1)
    joints[rows[better]] = new[better]
