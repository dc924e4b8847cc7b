"""Paths of the arm's joints: followed frame after frame from distinct solutions of one frame, compared, and put together from pieces.

Shape letters: S sequences, T frames, K paths of a sequence, B paths of all, C chosen frames, n arm joints, G links with
support points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.arm.cost import Frame, solve, system
from xreset.retarget.arm.model import ArmModel, ArmTargets, arm_jump, measure
from xreset.retarget.arm.splice import splice, spread_over
from xreset.retarget.validity import Thresholds, classify
from xreset.tensors import Tensors

Progress = Callable[[float], None]
"""Called with the fraction that is done."""

_HOME_BIAS = 1e-3
"""Preference among solutions of the first frame for those near home [1/rad^2]."""
_DISTINCT = 0.5
"""Solutions of the first frame differ if a joint differs by this much [rad or m]."""


@dataclass(frozen=True, kw_only=True)
class Paths(Tensors):
    """Paths of the arm's joints, and what has been found of their frames."""

    joints: Tensor
    """[S, K, T, n]"""
    sound: Tensor
    """[S, K, T] bool: valid if the joints do not jump there. Whether they do depends on the frame before, and so on the direction and on
    where paths are spliced; all else holds wherever the frame ends up, and is measured once."""

    def reversed(self) -> Paths:
        """The same from the last frame to the first."""
        return self.map(lambda x: x.flip(2))


@dataclass(frozen=True, kw_only=True)
class ArmProblem:
    """What paths are to be found for."""

    model: ArmModel
    targets: ArmTargets
    hand_poses: Tensor
    """[S, T, G, 4, 4] see :meth:`ArmModel.hand_poses`: they follow from the targets, and are worked out once."""
    thresholds: Thresholds
    config: ArmConfig

    def select(self, *index: Tensor) -> ArmProblem:
        """That of some sequences, or of some frames of them: every tensor is indexed alike."""
        return replace(self, targets=self.targets[index], hand_poses=self.hand_poses[index])

    def repeated(self, count: int) -> ArmProblem:
        """Every sequence so many times, one after the other: [S count, ...]."""
        return self.select(torch.arange(len(self.hand_poses)).repeat_interleave(count))

    def reversed(self) -> ArmProblem:
        """The same from the last frame to the first."""
        return replace(self, targets=self.targets.reversed(), hand_poses=self.hand_poses.flip(1))

    def reasons(self, joints: Tensor) -> Tensor:
        """[S, T] why frames of the paths [S, T, n] are invalid, 0 where they are valid: see :func:`~xreset.retarget.validity.classify`."""
        return classify(measure(self.model, self.targets, joints), self.thresholds)

    def examined(self, joints: Tensor) -> Paths:
        """The paths [S, K, T, n], with what is found of their frames."""
        measures = measure(self.model, self.repeated(joints.shape[1]).targets, joints.flatten(0, 1))
        unjumped = replace(measures, arm_jump=torch.zeros_like(measures.arm_jump))
        return Paths(joints=joints, sound=(classify(unjumped, self.thresholds) == 0).view(joints.shape[:3]))


def follow(problem: ArmProblem, start: Tensor, progress: Progress, *, self_collision: bool = False) -> Tensor:
    """[S, T, n] joints along the path, every frame warm-started from the one before; the first from ``start`` [S, n]."""
    config, frames = problem.config, problem.hand_poses.shape[1]
    path: list[Tensor] = []
    for t in range(frames):
        q, previous, steps = (path[-1], path[-1], config.iterations) if path else (start, None, config.first_iterations)
        path.append(solve(problem.model, _frame(problem, t, previous), q, config, steps, self_collision=self_collision))
        progress((t + 1) / frames)
    return torch.stack(path, dim=1)


def branches(problem: ArmProblem, progress: Progress) -> Paths:
    """The paths from distinct solutions of the first frame."""
    starts = _first_frames(problem)  # [S, K, n]
    paths = follow(problem.repeated(starts.shape[1]), starts.flatten(0, 1), progress)
    return problem.examined(paths.view(*starts.shape[:2], *paths.shape[1:]))


def best(problem: ArmProblem, paths: Paths) -> tuple[Tensor, Tensor]:
    """[S, T, n] of the paths the one that is worth most, and its worth [S]: see the config."""
    jump = arm_jump(paths.joints, problem.targets.annotated[:, None])
    valid = (paths.sound & (jump <= problem.thresholds.arm_jump)).sum(-1)
    detour = (paths.joints - problem.model.home).square().sum(-1).mean(-1)
    most, which = (valid - problem.config.detour_cost * detour).max(dim=1)
    return paths.joints[torch.arange(len(which)), which], most


def mend(problem: ArmProblem, known: Paths, missed: Tensor, progress: Progress) -> Tensor:
    """[S, T, n] the best that can be put together from pieces of the ``known`` paths and of new ones.

    The new ones lead both ways from some of the frames that are ``missed`` [S, T], solved afresh: a path from either end may be stuck at a
    limit there, on the wrong side of the arm's null space.
    """
    owner, paths = _reseeded(problem, missed, progress)
    count = torch.bincount(owner, minlength=len(missed))
    column = torch.arange(len(owner)) - (count.cumsum(0) - count)[owner]
    new = known.joints[:, :1].repeat(
        1, int(count.max()), 1, 1
    )  # sequences with fewer new paths than others repeat a known one
    new[owner, column] = paths
    known = Paths.cat((known, problem.examined(new)), dim=1)

    annotated = problem.targets.annotated
    detour = problem.config.detour_cost * (known.joints - problem.model.home).square().sum(-1) * annotated[:, None]
    return splice(
        known.joints,
        worth=known.sound.to(known.joints.dtype),
        cost=detour / annotated.sum(1)[:, None, None],
        annotated=annotated,
        jump=problem.thresholds.arm_jump,
        switch_cost=problem.config.switch_cost,
    )


def _reseeded(problem: ArmProblem, missed: Tensor, progress: Progress) -> tuple[Tensor, Tensor]:
    """Paths both ways from distinct solutions of missed frames [S, T] that can be solved: their sequences [B], ascending, and [B, T, n]."""
    owner, seed = spread_over(missed, problem.config.reseeds)
    alone = problem.select(owner[:, None], seed[:, None])  # [C, 1, ...]
    starts = _first_frames(alone)  # [C, K, n]
    solved = alone.repeated(starts.shape[1]).reasons(starts.flatten(0, 1)[:, None])[:, 0] == 0
    again = torch.zeros(starts.shape[:2], dtype=torch.bool)
    again[:, 1:] = (starts[:, 1:] == starts[:, :-1]).all(-1)  # how frames with fewer distinct solutions are filled up
    kept = solved & ~again.flatten()
    start = starts.flatten(0, 1)[kept]
    owner, seed = (values.repeat_interleave(starts.shape[1])[kept] for values in (owner, seed))

    frames = missed.shape[1]
    if not len(seed):
        return owner, start.new_zeros(0, frames, start.shape[1])
    steps = torch.arange(int(torch.maximum(seed, frames - 1 - seed).max()) + 1)
    both = torch.cat((seed[:, None] + steps, seed[:, None] - steps)).clamp(
        0, frames - 1
    )  # [2B, N] frames in the order of following
    followed = follow(problem.select(owner.repeat(2)[:, None], both), start.repeat(2, 1), progress)
    paths = start.new_zeros(len(owner), frames, start.shape[1])
    row = torch.arange(len(owner)).repeat(2)
    for step in reversed(steps.tolist()):  # the first visit of a frame is the one that stays
        paths[row, both[:, step]] = followed[:, step]
    return owner, paths


def _first_frames(problem: ArmProblem) -> Tensor:
    """[S, K, n] distinct solutions of the first frame: the one that home leads to, then the best others; the last one fills up."""
    model, config = problem.model, problem.config
    sequences, restarts, home = len(problem.hand_poses), config.restarts, model.home
    generator = torch.Generator().manual_seed(config.seed)
    spread = (
        torch.rand(restarts, len(home), generator=generator, dtype=home.dtype) * 2.0 - 1.0
    )  # every sequence gets the same
    spread[0] = 0.0
    lower, upper = torch.maximum(model.lower, home - torch.pi), torch.minimum(model.upper, home + torch.pi)
    start = torch.where(spread < 0, home + spread * (home - lower), home + spread * (upper - home))
    frame = _frame(problem.repeated(restarts), 0, None)
    solved = solve(model, frame, start.repeat(sequences, 1), config, config.first_iterations, self_collision=False)
    cost = system(model, frame, solved, config, self_collision=False).cost.view(sequences, restarts)
    solved = solved.view(sequences, restarts, -1)
    order = (cost + _HOME_BIAS * (solved - home).square().sum(-1)).argsort(dim=1)
    chosen = torch.empty(sequences, min(config.branches, restarts), len(home), dtype=home.dtype)
    for s in range(sequences):
        kept = [solved[s, 0]]  # the one that home leads to
        for i in order[s]:
            candidate = solved[s, i]
            if all((candidate - other).abs().max() > _DISTINCT for other in kept):
                kept.append(candidate)
            if len(kept) == chosen.shape[1]:
                break
        for k in range(chosen.shape[1]):
            chosen[s, k] = kept[min(k, len(kept) - 1)]
    return chosen


def _frame(problem: ArmProblem, t: int, previous: Tensor | None) -> Frame:
    targets = problem.targets
    return Frame(
        pos=targets.root_pos[:, t],
        quat=targets.root_quat[:, t],
        hand_poses=problem.hand_poses[:, t],
        hand_joints=targets.hand_joints[:, t],
        previous=previous,
    )
