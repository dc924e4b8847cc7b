"""Arm inverse kinematics: arm joints that carry a retargeted hand along its path, the hand's joints held fixed (the
paper, appendix D.b).

    q_t = argmin  50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q) + E_jump(q),   within
    the joint limits,

by Levenberg-Marquardt with projected steps, frame after frame, batched over sequences.

The first frame starts from random restarts. The best few distinct solutions are all followed, and the one with most
valid frames wins, because the first frame does not show which branch lasts. Where a frame fails, the same is tried
backwards from the last frame: the branch that reaches the goal may look worse than others at the start. Where the wrist
is still missed, some of those frames are solved again and followed both ways, and all paths are spliced into one.

Shape letters: S sequences, T frames, K paths of a sequence, B paths of all, C chosen frames, n arm joints, G links with
support points.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from xreset.files.processes import in_processes
from xreset.geometry.rotations import matrix_to_axis_angle, matrix_to_quat
from xreset.physics.tensors import Tensors, one_thread
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmModel, ArmProblem, ArmTargets, arm_jump
from xreset.retarget.least_squares import Quadratic, change_cost, damped, free_to_move, minimize
from xreset.retarget.validity import REASONS, Measures, Thresholds, classify
from xreset.spec import RobotSpec

_CONVERGED = 1e-5
"""Steps smaller than this end the iteration [rad or m]."""
_WRIST_MISSED = torch.tensor(
    [REASONS.index(name) for name in ("joint limit", "wrist position", "wrist orientation")]
)
"""Reasons of frames in which the wrist misses its target."""
_HOME_BIAS = 1e-3
"""Preference among solutions of the first frame for those near home [1/rad^2]."""
_DISTINCT = 0.5
"""Solutions of a first frame are distinct if a joint differs by more than this [rad or m]."""


@dataclass(frozen=True)
class Paths(Tensors):
    """K paths of each sequence."""

    joints: Tensor
    """[S, K, T, n] arm joints [rad or m]."""
    sound: Tensor
    """[S, K, T] bool: whether a frame is valid if the joints do not jump there."""


@one_thread()
def track(
    model: ArmModel, targets: ArmTargets, thresholds: Thresholds, config: ArmSearch | None = None
) -> tuple[Tensor, Measures]:
    """Find arm joints along the hand's path.

    Args:
        model: the robot.
        targets: the path.
        thresholds: limits of a valid frame; they decide between branches.
        config: weights and effort.

    Returns:
        Arm joints [S, T, n], and the measures [S, T] of every frame.
    """
    problem = model.problem(targets, thresholds, config)
    forwards = branches(problem)
    joints, worth = best_path(problem, forwards)
    measures = problem.measures(joints)
    reason = classify(measures, thresholds)
    failing = (reason > REASONS.index("hand error")).any(dim=1).nonzero()[:, 0]
    if len(failing) and problem.annotated.shape[1] > 1:  # of a single frame all solutions are known
        part = problem[failing]
        better = _better_paths(part, forwards[failing], joints[failing], worth[failing])
        joints[failing] = better
        measures[failing] = part.measures(better)
    return joints, measures


def reach_poses(
    model: ArmModel,
    root: Tensor,
    hand_joints: Tensor,
    thresholds: Thresholds,
    config: ArmSearch | None = None,
) -> tuple[Tensor, Tensor]:
    """Find arm joints that carry the hand to poses, each for itself.

    Args:
        model: the robot.
        root: [S, 4, 4] poses of the hand root.
        hand_joints: [J_hand], or [S, 1, J_hand] rad (m).
        thresholds: limits of a valid pose.
        config: weights and effort.

    Returns:
        Arm joints [S, n], and the reason why each pose is not valid [S], 0 if it is:
        :func:`~xreset.retarget.validity.classify`.
    """
    targets = ArmTargets.of_poses(root[:, :3, 3], matrix_to_quat(root[:, :3, :3]), hand_joints)
    joints, measures = track(model, targets, thresholds, config)
    return joints[:, 0], classify(measures, thresholds)[:, 0]


def track_each(
    robot: RobotSpec, paths: Sequence[ArmTargets], thresholds: Thresholds, config: ArmSearch
) -> Iterator[tuple[Tensor, Measures]]:
    """Yield what :func:`track` returns for each path, computed on all cores."""
    yield from in_processes(partial(_track, robot, thresholds, config), paths)


def _track(
    robot: RobotSpec, thresholds: Thresholds, config: ArmSearch, path: ArmTargets
) -> tuple[Tensor, Measures]:
    return track(ArmModel(robot), path, thresholds, config)


def _better_paths(problem: ArmProblem, paths: Paths, joints: Tensor, worth: Tensor) -> Tensor:
    """[S, T, n] better paths than ``joints`` for sequences with failing frames; ``joints`` where none is found.

    Args:
        problem: the problem of these sequences.
        paths: paths of these sequences from the first frame.
        joints: [S, T, n] the best of these paths.
        worth: [S] worth of the best path.
    """
    turned = problem.reversed()
    backwards = branches(turned)
    back, other = best_path(turned, backwards)
    joints = torch.where((other > worth)[:, None, None], back.flip(1), joints)
    paths = Paths.cat((paths, backwards.map(lambda x: x.flip(2))), dim=1)
    if problem.config.reseeds:
        reason = problem.reasons(joints)
        missed = torch.isin(reason, _WRIST_MISSED)
        rows = missed.any(dim=1).nonzero()[:, 0]
        if len(rows):
            part = problem[rows]
            new = repaired(part, paths[rows], missed[rows])
            better = (part.reasons(new) == 0).sum(1) > (reason[rows] == 0).sum(1)
            joints[rows[better]] = new[better]
    return joints


def follow(problem: ArmProblem, start: Tensor) -> Tensor:
    """[S, T, n] joints along the path from a solution ``start`` [S, n] of the first frame. Every other frame is solved
    from the joints of the frame before."""
    path = [start]
    for t in range(1, problem.annotated.shape[1]):
        iterations = problem.config.iterations
        path.append(solve(problem[:, t], path[-1], iterations, previous=path[-1]))
    return torch.stack(path, dim=1)


def branches(problem: ArmProblem) -> Paths:
    """Return the paths from distinct solutions of the first frame."""
    starts = _first_frame_solutions(problem)  # [S, K, n]
    paths = follow(problem.repeated(starts.shape[1]), starts.flatten(0, 1))
    return judged_paths(problem, paths.unflatten(0, starts.shape[:2]))


def judged_paths(problem: ArmProblem, paths: Tensor) -> Paths:
    """Return the paths [S, K, T, n], and which of their frames are sound.

    Only jumps depend on the frame before, and thus on the direction of a path and on splices. The other measures depend
    on the frame alone, so they are taken once.
    """
    sound = torch.zeros(paths.shape[:3], dtype=torch.bool)
    for k in range(paths.shape[1]):  # one after the other, because measures take memory
        measures = problem.measures(paths[:, k])
        no_jumps = replace(measures, arm_jump=torch.zeros_like(measures.arm_jump))
        sound[:, k] = classify(no_jumps, problem.thresholds) == 0
    return Paths(paths, sound)


def best_path(problem: ArmProblem, paths: Paths) -> tuple[Tensor, Tensor]:
    """Return the path [S, T, n] of the highest worth, and its worth [S]: valid frames less the cost of the detour."""
    jump = arm_jump(paths.joints, problem.annotated[:, None])
    valid = (paths.sound & (jump <= problem.thresholds.arm_jump)).sum(-1)
    detour = _detour(problem, paths.joints).sum(-1)
    worth, which = (valid - problem.config.detour_cost * detour).max(dim=1)
    return paths.joints[torch.arange(len(which)), which], worth


def _detour(problem: ArmProblem, joints: Tensor) -> Tensor:
    """[S, K, T] squared distance from home of each annotated frame of the paths [S, K, T, n], over the number of
    annotated frames; 0 in other frames."""
    annotated = problem.annotated[:, None]
    distance = (joints - problem.model.home).square().sum(-1)
    return distance * annotated / annotated.sum(-1, keepdim=True).clamp_min(1)


def repaired(problem: ArmProblem, known: Paths, missed: Tensor) -> Tensor:
    """[S, T, n] the best path from pieces of known and of new paths.

    New paths lead both ways from some of the ``missed`` frames [S, T], which are solved again. Known paths may be stuck
    at a limit in these frames, on the wrong side of the arm's null space.
    """
    config = problem.config
    owner, paths = _paths_from_missed_frames(problem, missed)
    count = torch.bincount(owner, minlength=len(missed))
    column = torch.arange(len(owner)) - (count.cumsum(0) - count)[owner]
    # Sequences with fewer new paths than others repeat a known one.
    new = known.joints[:, :1].repeat(1, int(count.max()), 1, 1)
    new[owner, column] = paths
    known = Paths.cat((known, judged_paths(problem, new)), dim=1)
    joints = known.joints

    return splice(
        joints,
        worth=known.sound.to(joints.dtype),
        cost=config.detour_cost * _detour(problem, joints),
        annotated=problem.annotated,
        jump=problem.thresholds.arm_jump,
        switch_cost=config.switch_cost,
    )


def _paths_from_missed_frames(problem: ArmProblem, missed: Tensor) -> tuple[Tensor, Tensor]:
    """Follow paths both ways from distinct valid solutions of some missed frames.

    Args:
        problem: the problem.
        missed: [S, T] bool: the frames.

    Returns:
        The sequences [B] of the paths, ascending, and the paths [B, T, n].
    """
    owner, seed = spread_over(missed, problem.config.reseeds)
    alone = problem[owner[:, None], seed[:, None]]  # [C, 1, ...]
    starts = _first_frame_solutions(alone)  # [C, K, n]
    count = starts.shape[1]
    is_new = torch.ones(starts.shape[:2], dtype=torch.bool)
    # frames with fewer solutions repeat the last one
    is_new[:, 1:] = (starts[:, 1:] != starts[:, :-1]).any(-1)
    start = starts.flatten(0, 1)
    kept = (alone.repeated(count).reasons(start[:, None])[:, 0] == 0) & is_new.flatten()
    start = start[kept]
    owner = owner.repeat_interleave(count)[kept]
    seed = seed.repeat_interleave(count)[kept]

    frames = missed.shape[1]
    paths = start.new_zeros(len(owner), frames, start.shape[1])
    if not len(seed):
        return owner, paths
    steps = torch.arange(int(torch.maximum(seed, frames - 1 - seed).max()) + 1)
    # [2B, N] frames
    both_ways = torch.cat((seed[:, None] + steps, seed[:, None] - steps)).clamp(0, frames - 1)
    followed = follow(problem[owner.repeat(2)[:, None], both_ways], start.repeat(2, 1))
    row = torch.arange(len(owner)).repeat(2)
    for step in reversed(steps.tolist()):  # backwards, so that the first visit of a frame is kept
        paths[row, both_ways[:, step]] = followed[:, step]
    return owner, paths


def _first_frame_solutions(problem: ArmProblem) -> Tensor:
    """[S, K, n] distinct solutions of the first frame: the solution from home, then the best others. If there are fewer
    than K, the last one is repeated."""
    config = problem.config
    home = problem.model.home
    sequences = len(problem.hand_poses)
    start = _random_starts(problem.model, config)
    frame = problem[:, :1].repeated(config.restarts)[:, 0]
    solved = solve(frame, start.repeat(sequences, 1), config.first_iterations)
    cost = system(frame, solved, torch.arange(len(solved))).cost
    shape = (sequences, config.restarts)
    solved = solved.unflatten(0, shape)
    order = (cost.view(shape) + _HOME_BIAS * (solved - home).square().sum(-1)).argsort(dim=1)
    number = min(config.branches, config.restarts)
    chosen = []
    for solutions, ranking in zip(solved, order, strict=True):
        from_home = solutions[0]
        chosen.append(_distinct_solutions(from_home, solutions[ranking], number))
    return torch.stack(chosen) if chosen else home.new_zeros(0, number, len(home))


def _random_starts(model: ArmModel, config: ArmSearch) -> Tensor:
    """[restarts, n] starts of a first frame, the same for every sequence: home, then random ones within the limits and
    within half a turn of home."""
    home = model.home
    generator = torch.Generator().manual_seed(config.seed)
    spread = (
        torch.rand(config.restarts, len(home), generator=generator, dtype=home.dtype) * 2.0 - 1.0
    )
    spread[0] = 0.0
    lower = torch.maximum(model.lower, home - torch.pi)
    upper = torch.minimum(model.upper, home + torch.pi)
    return home + spread * torch.where(spread < 0, home - lower, upper - home)


def _distinct_solutions(first: Tensor, candidates: Tensor, number: int) -> Tensor:
    """[number, n] the first solution [n], then those of the candidates [..., n] that differ from all before. If there
    are fewer, the last one is repeated."""
    kept = [first]
    for candidate in candidates:
        if len(kept) == number:
            break
        if all((candidate - other).abs().max() > _DISTINCT for other in kept):
            kept.append(candidate)
    kept += [kept[-1]] * number
    return torch.stack(kept[:number])


def splice(
    paths: Tensor,
    *,
    worth: Tensor,
    cost: Tensor,
    annotated: Tensor,
    jump: float,
    switch_cost: float,
) -> Tensor:
    """Return the best path that follows one of the given paths in every frame, by dynamic programming over the frames.

        maximize sum_t worth[k_t, t] [not a jump at t] - cost[k_t, t] - switch_cost [k_t != k_{t-1}]

    A jump at t is a joint's change by more than ``jump`` since frame t - 1, if frame t - 1 is annotated.

    Args:
        paths: [S, K, T, n] joints.
        worth: [S, K, T] worth of each frame of a path without a jump.
        cost: [S, K, T] cost of each frame of a path.
        annotated: [S, T] bool.
        jump: largest change of a joint that is not a jump [rad or m].
        switch_cost: cost of a change from one path to another.

    Returns:
        [S, T, n] joints.
    """
    sequences, number, frames, _ = paths.shape
    switch = switch_cost * (1.0 - torch.eye(number, dtype=paths.dtype))
    value = worth[:, :, 0] - cost[:, :, 0]
    came_from = []
    for t in range(1, frames):
        # [S, K before, K now]
        change = (paths[:, None, :, t] - paths[:, :, None, t - 1]).abs().amax(-1)
        jumps = (change > jump) & annotated[:, t - 1, None, None]
        total = value[:, :, None] - switch + worth[:, None, :, t] * ~jumps
        most, before = total.max(dim=1)
        value = most - cost[:, :, t]
        came_from.append(before)
    rows = torch.arange(sequences)
    chosen = [value.argmax(dim=1)]
    for before in reversed(came_from):
        chosen.append(before[rows, chosen[-1]])
    return paths[rows[:, None], torch.stack(chosen[::-1], dim=1), torch.arange(frames)]


def spread_over(flags: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Choose at most ``count`` of the true elements of each row of ``flags`` [S, T], evenly spread. Return their rows
    [C], ascending, and columns [C]."""
    rows = []
    frames = []
    for row, flagged in enumerate(flags):
        places = flagged.nonzero()[:, 0]
        number = min(count, len(places))
        chosen = places[((torch.arange(number) + 0.5) * len(places) / max(number, 1)).long()]
        frames.append(chosen)
        rows.append(torch.full_like(chosen, row))
    return torch.cat(rows), torch.cat(frames)


# One frame ------------------------------------------------------------------------------------------------------------


def solve(
    frame: ArmProblem, start: Tensor, iterations: int, previous: Tensor | None = None
) -> Tensor:
    """[B, n] joints that minimize the cost of one frame, by Levenberg-Marquardt. Every element of the batch has its own
    damping.

    A joint at a limit stays there while the cost pulls it outwards. Steps are clamped to the limits.

    Args:
        frame: the problem of one frame, without the axis T.
        start: [B, n] first guess.
        iterations: largest number of steps.
        previous: [B, n] joints of the frame before; None where there is none.
    """
    model = frame.model

    def evaluate(q: Tensor, rows: Tensor) -> Quadratic:
        return system(frame, q, rows, previous)

    def step(q: Tensor, here: Quadratic, damping: Tensor) -> Tensor:
        free = free_to_move(q, here.gradient, model.lower, model.upper)
        diagonal = here.curvature.diagonal(dim1=-2, dim2=-1).clamp_min(1e-3)
        moved = q + torch.linalg.solve(*damped(here, diagonal, damping, free))
        return moved.clamp(model.lower, model.upper)

    def done(before: Tensor, after: Tensor, *_: Tensor) -> Tensor:
        return ((after - before).abs() < _CONVERGED).all(dim=1)

    return minimize(start, evaluate, step, done, iterations, damping_range=(1e-9, 1e9))


def system(frame: ArmProblem, q: Tensor, rows: Tensor, previous: Tensor | None = None) -> Quadratic:
    """Compute the cost of one frame and its Gauss-Newton approximation at ``q`` [R, n], for the rows [R] of the batch;
    other arguments as of :func:`solve`."""
    model = frame.model
    config = frame.config
    base = model.kinematics.base
    links = model.kinematics.twists(model.full(q, 0.0), model.carriers, base.expand(len(q), 4, 4))
    coupling = links.coupling[:, model.arm]
    position_scale = config.position_weight**0.5
    orientation_scale = config.orientation_weight**0.5
    linear, angular = links.twists.split(3, dim=1)  # [R, 3, m]
    origin = links.pos[:, 0]
    at_origin = linear + torch.linalg.cross(angular, (origin - base[:3, 3])[..., None], dim=1)
    moves = torch.cat((position_scale * at_origin, orientation_scale * angular), dim=1)
    turn = links.rot[:, 0] @ frame.root_rot[rows].mT
    off = (
        position_scale * (origin - frame.root_pos[rows]),
        orientation_scale * matrix_to_axis_angle(turn),
    )
    jacobian = (moves * links.carried[0]) @ coupling
    found = Quadratic.of_residuals(torch.cat(off, dim=1), jacobian)
    low = model.low_points(
        links.pos, links.rot, frame.middles, frame.hand_poses, rows, config.table_margin
    )
    if len(low.frame):
        scale = config.collision_weight**0.5
        x, y, _ = (low.point - base[:3, 3])[..., None].unbind(1)
        twist = links.twists[low.frame]
        rises = twist[:, 2] + twist[:, 3] * y - twist[:, 4] * x  # of the point
        slope = -scale * (rises * links.carried[low.carrier]) @ coupling
        value = scale * (config.table_margin - low.height)
        found.cost.index_add_(0, low.frame, value.square())
        found.gradient.index_add_(0, low.frame, value[:, None] * slope)
        found.curvature.index_add_(0, low.frame, slope[:, :, None] * slope[:, None])
    if previous is not None:
        smoothness = q.new_full(q.shape[1:], config.smoothness_weight)
        change = change_cost(q - previous[rows], smoothness, config.jump_limit, config.jump_weight)
        found.cost.add_(change.cost)
        found.gradient.add_(change.gradient)
        found.curvature.diagonal(dim1=-2, dim2=-1).add_(change.curvature)
    return found
