"""Arm inverse kinematics: arm joints that carry a retargeted hand along its path, the hand's joints held fixed (the paper, appendix D.b).

    q_t = argmin  50 |p(q) - p_t|^2 + 10 d_R(R(q), R_t)^2 + lambda_s |q - q_{t-1}|^2 + E_coll(q),   within the joint limits,

by Levenberg-Marquardt with projected steps, frame after frame, batched over sequences. The first frame starts from random restarts; the
best few distinct solutions are all followed, and the one with most valid frames wins: the first frame cannot tell which branch lasts. The
same is tried backwards from the last frame where a frame fails: the branch that reaches the goal may look worse than others at the start.
Where the wrist is still missed, some of those frames are solved afresh and followed both ways, and all paths become one (`splice`).

E_coll = w sum of [margin - distance]_+^2 over the lowest points of the links (table) and, where a path without it collides, over the
pairs of shapes that coal finds near each other.

Shape letters: S sequences, T frames, B batch (sequences or branches), n arm joints, A arm links, H support points of the hand.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.kinematics import Kinematics
from xreset.retarget.collision import SelfCollision, height_above_table, table_points
from xreset.retarget.splice import splice, spread_over
from xreset.retarget.validity import REASONS, Measures, Thresholds, classify
from xreset.rotations import matrix_to_quat, quat_angle, quat_conjugate, quat_multiply, quat_to_axis_angle
from xreset.spec import RobotSpec, TableSpec

_SELF_SEARCH = 0.02
"""Distances between shapes are measured up to here [m]."""
_AT_LIMIT = 1e-6
"""A joint this near its limit is at it [rad or m]."""
_HOME_BIAS = 1e-3
"""Preference among solutions of the first frame for those near home [1/rad^2]."""
_DISTINCT = 0.5
"""Solutions of the first frame differ if a joint differs by this much [rad or m]."""
_CONVERGED = 1e-5
"""Steps smaller than this end the iteration [rad or m]."""
_MISSED = tuple(REASONS.index(name) for name in ("joint limit", "wrist position", "wrist orientation"))
"""The reasons of frames whose wrist is not where it should be."""


@dataclass(frozen=True, kw_only=True)
class ArmConfig:
    """Weights and effort of the arm's inverse kinematics; the first two weights as in the paper."""

    position_weight: float = 50.0
    """Squared distance of the hand root [1/m^2]."""
    orientation_weight: float = 10.0
    """Squared angle of the hand root [1/rad^2]."""
    smoothness_weight: float = 0.02
    """Squared change of the joints since the frame before [1/rad^2]; the paper's lambda_s, whose value it does not give."""
    collision_weight: float = 1000.0
    """Squared intrusion into the margins [1/m^2]."""
    table_margin: float = 0.002
    """Height that the robot keeps above the table [m]."""
    self_margin: float = 0.010
    """Distance that the robot's links keep from each other [m]."""
    restarts: int = 32
    """Random starts of the first and of the last frame (the first of them is the home configuration)."""
    branches: int = 4
    """Distinct solutions of the first and of the last frame that are followed; the one that home leads to is always among them."""
    detour_cost: float = 1.0
    """Valid frames that a path is worth less for each rad^2 of its mean squared distance from home. A policy starts at home: states in
    another branch of the arm's solutions are of no use to it, because the way there leads through half a turn of the shoulder."""
    reseeds: int = 2
    """Frames of a sequence, of those whose wrist is still missed, that are solved like a first frame and followed both ways; 0: none."""
    switch_cost: float = 0.5
    """Valid frames that each change from one of the followed paths to another must bring."""
    first_iterations: int = 60
    """Most steps for the frame that a path starts from."""
    iterations: int = 12
    """Most steps for every other frame."""
    seed: int = 0
    """Of the restarts."""


@dataclass(frozen=True, kw_only=True)
class ArmTargets:
    """What the arm should do."""

    root_pos: Tensor
    """[S, T, 3] position of the hand root."""
    root_quat: Tensor
    """[S, T, 4] orientation of the hand root."""
    hand_joints: Tensor
    """[S, T, J_hand]"""
    annotated: Tensor
    """[S, T] bool"""
    hand_error: Tensor
    """[S, T] mean fingertip error of the hand's retargeting [m]."""
    hand_clearance: Tensor
    """[S, T] smallest signed distance between the hand's own shapes [m]; the arm cannot change it."""


class ArmModel:
    """A robot as its arm's inverse kinematics sees it."""

    def __init__(self, robot: RobotSpec, table: TableSpec | None = None) -> None:
        """Raises ``RobotError`` if a joint of the arm lies behind the hand root, and ``XResetError`` if coal is missing."""
        self.robot = robot
        self.table = table or TableSpec()
        self.kinematics = Kinematics(robot)
        self.arm = torch.as_tensor(robot.arm_indices)
        """[n] indices of the arm's joints."""
        self.lower, self.upper = self.kinematics.lower[self.arm], self.kinematics.upper[self.arm]
        hand = Kinematics(robot, root=robot.hand_root)
        if set(hand.joint_indices) & set(robot.arm_indices):
            raise RobotError(
                f"robot {robot.name!r}: an arm joint lies behind the hand root {robot.hand_root!r}, expected hand joints only."
            )
        self.hand = hand
        in_hand = set(hand.link_names)

        support = table_points(robot, self.kinematics)
        points, radii = torch.as_tensor(support.points), torch.as_tensor(support.radii)
        of_hand = torch.tensor([link in in_hand for link in support.links], dtype=torch.bool)
        self.hand_links = tuple(link for link in support.links if link in in_hand)
        """Link of each of the hand's support points (length H)."""
        self.hand_points, self.hand_radii = points[of_hand], radii[of_hand]
        arm_links = dict.fromkeys(link for link in support.links if link not in in_hand)
        self.carriers: tuple[str, ...] = (robot.hand_root, *(link for link in self.kinematics.link_names if link not in in_hand))
        """Links whose motion the arm's joints determine: the hand root, which carries the hand, then the arm's links."""
        owner = [self.carriers.index(link) for link in arm_links]
        self.arm_support = [
            (carrier, points[[i for i, name in enumerate(support.links) if name == link]],
             radii[[i for i, name in enumerate(support.links) if name == link]])
            for carrier, link in zip(owner, arm_links, strict=True)
        ]  # fmt: skip
        """Per arm link with shapes: its index among the carriers, its support points and radii."""
        self.carrier_of = torch.tensor([0 if name in in_hand else self.carriers.index(name) for name in self.kinematics.link_names])
        """[L] index of the carrier of every link."""
        self.arm_collision = SelfCollision(robot, self.kinematics, moved_by_arm=True)
        self._hand_collision = SelfCollision(robot, hand, only=robot.self_collision_links)

    def hand_support(self, hand_joints: Tensor) -> Tensor:
        """[..., H, 3] the hand's support points in the frame of the hand root."""
        return self.hand.points(hand_joints, self.hand_links, self.hand_points)

    def hand_clearance(self, hand_joints: Tensor) -> Tensor:
        """[...] smallest signed distance between those of the hand's shapes that collide in physics [m]."""
        poses = self.hand.link_poses(hand_joints.flatten(0, -2)).numpy()
        return torch.as_tensor(self._hand_collision.clearance(poses, _SELF_SEARCH)).view(hand_joints.shape[:-1])

    def full(self, arm: Tensor, hand_joints: Tensor) -> Tensor:
        """[..., J] all joints in joint order."""
        q = arm.new_zeros(*arm.shape[:-1], len(self.robot.joints))
        q[..., self.arm] = arm
        q[..., torch.as_tensor(self.hand.joint_indices)] = hand_joints
        return q


@dataclass(frozen=True)
class _Frame:
    """One frame's problem for a batch."""

    pos: Tensor
    quat: Tensor
    support: Tensor
    """[B, H, 3] hand support points in the hand root's frame."""
    hand_joints: Tensor
    previous: Tensor | None
    """[B, n] joints of the frame before."""


@dataclass(frozen=True)
class _System:
    """Cost and its Gauss-Newton approximation."""

    cost: Tensor
    """[B]"""
    hessian: Tensor
    """[B, n, n]"""
    gradient: Tensor
    """[B, n] half the gradient."""


def track(
    model: ArmModel,
    targets: ArmTargets,
    thresholds: Thresholds,
    config: ArmConfig | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Tensor, Measures]:
    """Arm joints along the hand's path.

    Args:
        model: the robot.
        targets: hand root poses and hand joints.
        thresholds: of a valid frame; they decide between branches.
        config: weights and effort.
        progress: called with the fraction that is done.

    Returns:
        [S, T, n] arm joints, and what was measured of every frame ([S, T] each).
    """
    config = config or ArmConfig()
    support = model.hand_support(targets.hand_joints)
    report = progress or (lambda _: None)

    forwards = _branches(model, targets, support, config, lambda done: report(0.3 * done))
    joints, worth = _best(model, targets, forwards, thresholds, config)
    reason = classify(measure(model, targets, joints), thresholds)
    failing = (reason > REASONS.index("hand error")).any(dim=1).nonzero()[:, 0]
    paths = forwards.repeat(1, 2, 1, 1)  # [S, 2K, T, n] those of the first frame, then those of the last frame where there are any
    if len(failing):
        part = ArmTargets(**{name: value[failing].flip(1) for name, value in vars(targets).items()})
        backwards = _branches(model, part, support[failing].flip(1), config, lambda done: report(0.3 + 0.3 * done))
        paths[failing, forwards.shape[1] :] = backwards.flip(2)
        back, other = _best(model, part, backwards, thresholds, config)
        better = other > worth[failing]
        joints[failing[better]] = back[better].flip(1)

    reason = classify(measure(model, targets, joints), thresholds)
    repair = (reason == REASONS.index("self collision")).any(dim=1).nonzero()[:, 0]
    if len(repair):
        part = _take(targets, repair)
        apart = _follow(model, part, support[repair], joints[repair, 0], config, model.arm_collision, lambda done: report(0.6 + 0.1 * done))
        better = (classify(measure(model, part, apart), thresholds) == 0).sum(1) > (reason[repair] == 0).sum(1)
        joints[repair[better]] = apart[better]

    reason = classify(measure(model, targets, joints), thresholds)
    missed = torch.isin(reason, torch.tensor(_MISSED))
    mend = missed.any(dim=1).nonzero()[:, 0]
    if len(mend) and config.reseeds:
        part = _take(targets, mend)
        known = torch.cat((joints[mend, None], paths[mend]), dim=1)
        mended = _mend(model, part, support[mend], known, missed[mend], thresholds, config, lambda done: report(0.7 + 0.3 * done))
        better = (classify(measure(model, part, mended), thresholds) == 0).sum(1) > (reason[mend] == 0).sum(1)
        joints[mend[better]] = mended[better]
    report(1.0)
    return joints, measure(model, targets, joints)


def measure(model: ArmModel, targets: ArmTargets, joints: Tensor) -> Measures:
    """What is measured of every frame [S, T] of the paths ``joints`` [S, T, n]."""
    sequences, frames, _ = joints.shape
    poses = model.kinematics.link_poses(model.full(joints, targets.hand_joints).flatten(0, 1))
    root = poses[:, model.kinematics.link_index(model.robot.hand_root)]
    quat = matrix_to_quat(root[:, :3, :3])
    heights = [torch.full((len(poses), 1), torch.inf, dtype=poses.dtype)]  # what a robot without shapes would keep
    heights += [height_above_table(_place(root, model.hand_support(targets.hand_joints).flatten(0, 1)), model.hand_radii, model.table)]
    for carrier, points, radii in model.arm_support:
        link = poses[:, model.kinematics.link_index(model.carriers[carrier])]
        heights.append(height_above_table(_place(link, points), radii, model.table))
    apart = torch.as_tensor(model.arm_collision.clearance(poses.numpy(), _SELF_SEARCH)).view(sequences, frames)
    jump = torch.zeros(sequences, frames, dtype=joints.dtype)
    jump[:, 1:] = joints.diff(dim=1).abs().amax(-1)
    jump[:, 1:][~targets.annotated[:, :-1]] = 0.0
    return Measures(
        annotated=targets.annotated,
        hand_error=targets.hand_error,
        wrist_position=(root[:, :3, 3].view(sequences, frames, 3) - targets.root_pos).norm(dim=-1),
        wrist_orientation=quat_angle(quat.view(sequences, frames, 4), targets.root_quat),
        at_limit=((joints <= model.lower + _AT_LIMIT) | (joints >= model.upper - _AT_LIMIT)).any(-1),
        arm_jump=jump,
        table_clearance=torch.cat(heights, dim=1).amin(1).view(sequences, frames),
        self_clearance=torch.minimum(apart, targets.hand_clearance),
    )


def _take(targets: ArmTargets, sequences: Tensor) -> ArmTargets:
    return ArmTargets(**{name: value[sequences] for name, value in vars(targets).items()})


def _place(T: Tensor, points: Tensor) -> Tensor:
    """[B, H, 3] points given in the frames T [B, 4, 4], in the world."""
    return points @ T[:, :3, :3].mT + T[:, None, :3, 3]


def _frame(targets: ArmTargets, support: Tensor, t: int, previous: Tensor | None) -> _Frame:
    return _Frame(
        pos=targets.root_pos[:, t],
        quat=targets.root_quat[:, t],
        support=support[:, t],
        hand_joints=targets.hand_joints[:, t],
        previous=previous,
    )


def _branches(model: ArmModel, targets: ArmTargets, support: Tensor, config: ArmConfig, progress: Callable[[float], None]) -> Tensor:
    """[S, K, T, n] the paths from distinct solutions of the first frame."""
    starts = _first_frames(model, targets, support, config)  # [S, K, n]
    wide = torch.arange(len(starts)).repeat_interleave(starts.shape[1])
    paths = _follow(model, _take(targets, wide), support[wide], starts.flatten(0, 1), config, None, progress)
    return paths.view(*starts.shape[:2], *paths.shape[1:])


def _best(model: ArmModel, targets: ArmTargets, paths: Tensor, thresholds: Thresholds, config: ArmConfig) -> tuple[Tensor, Tensor]:
    """[S, T, n] of the paths [S, K, T, n] the one that is worth most, and its worth [S]: see the config."""
    sequences, branches = paths.shape[:2]
    many, flat = _take(targets, torch.arange(sequences).repeat_interleave(branches)), paths.flatten(0, 1)
    valid = (classify(measure(model, many, flat), thresholds) == 0).sum(1)
    worth = (valid - config.detour_cost * (flat - _home(model)).square().sum(-1).mean(1)).view(sequences, -1)
    best, branch = worth.max(dim=1)
    return paths[torch.arange(sequences), branch], best


def _mend(
    model: ArmModel,
    targets: ArmTargets,
    support: Tensor,
    known: Tensor,
    missed: Tensor,
    thresholds: Thresholds,
    config: ArmConfig,
    progress: Callable[[float], None],
) -> Tensor:
    """[S, T, n] the best that can be put together from pieces of the ``known`` paths [S, K, T, n] and of new ones.

    The new ones lead both ways from some of the frames that are ``missed`` [S, T], solved afresh: a path from either end may be stuck at a
    limit there, on the wrong side of the arm's null space.
    """
    owner, paths = _reseeded(model, targets, support, missed, thresholds, config, progress)
    count = torch.bincount(owner, minlength=len(known))
    column = torch.arange(len(owner)) - (count.cumsum(0) - count)[owner]
    new = known[:, :1].repeat(1, int(count.max()), 1, 1)  # sequences with fewer new paths than others repeat a known one
    new[owner, column] = paths
    known = torch.cat((known, new), dim=1)

    sequences, branches, frames, _ = known.shape
    measures = measure(model, _take(targets, torch.arange(sequences).repeat_interleave(branches)), known.flatten(0, 1))
    valid = classify(replace(measures, arm_jump=torch.zeros_like(measures.arm_jump)), thresholds) == 0
    detour = config.detour_cost * (known - _home(model)).square().sum(-1) * targets.annotated[:, None]
    return splice(
        known,
        worth=valid.view(sequences, branches, frames).to(known.dtype),
        cost=detour / targets.annotated.sum(1)[:, None, None],
        annotated=targets.annotated,
        jump=thresholds.arm_jump,
        switch_cost=config.switch_cost,
    )


def _reseeded(
    model: ArmModel,
    targets: ArmTargets,
    support: Tensor,
    missed: Tensor,
    thresholds: Thresholds,
    config: ArmConfig,
    progress: Callable[[float], None],
) -> tuple[Tensor, Tensor]:
    """[C, T, n] paths both ways from distinct solutions of missed frames [S, T] that can be solved, and their sequences [C], ascending."""
    owner, seed = spread_over(missed, config.reseeds)
    alone = ArmTargets(**{name: value[owner, seed][:, None] for name, value in vars(targets).items()})
    starts = _first_frames(model, alone, support[owner, seed][:, None], config)  # [C, K, n]
    wide = torch.arange(len(owner)).repeat_interleave(starts.shape[1])
    solved = classify(measure(model, _take(alone, wide), starts.flatten(0, 1)[:, None]), thresholds)[:, 0] == 0
    repeated = torch.zeros(starts.shape[:2], dtype=torch.bool)
    repeated[:, 1:] = (starts[:, 1:] == starts[:, :-1]).all(-1)
    wide, start = wide[solved & ~repeated.flatten()], starts.flatten(0, 1)[solved & ~repeated.flatten()]
    owner, seed = owner[wide], seed[wide]

    frames = targets.annotated.shape[1]
    if not len(seed):
        return owner, start.new_zeros(0, frames, start.shape[1])
    steps = torch.arange(int(torch.maximum(seed, frames - 1 - seed).max()) + 1)
    both = torch.cat((seed[:, None] + steps, seed[:, None] - steps)).clamp(0, frames - 1)  # [2C, N] frames in the order of following
    rows = owner.repeat(2)[:, None]
    part = ArmTargets(**{name: value[rows, both] for name, value in vars(targets).items()})
    followed = _follow(model, part, support[rows, both], start.repeat(2, 1), config, None, progress)
    paths = start.new_zeros(len(owner), frames, start.shape[1])
    row = torch.arange(len(owner)).repeat(2)
    for step in reversed(steps.tolist()):  # the first visit of a frame is the one that stays
        paths[row, both[:, step]] = followed[:, step]
    return owner, paths


def _home(model: ArmModel) -> Tensor:
    return torch.as_tensor(model.robot.home[model.robot.arm_indices])


def _first_frames(model: ArmModel, targets: ArmTargets, support: Tensor, config: ArmConfig) -> Tensor:
    """[S, K, n] distinct solutions of the first frame: the one that home leads to, then the best others."""
    sequences, restarts = len(targets.annotated), config.restarts
    home = _home(model)
    generator = torch.Generator().manual_seed(config.seed)
    spread = torch.rand(restarts, len(home), generator=generator, dtype=home.dtype) * 2.0 - 1.0  # every sequence gets the same
    spread[0] = 0.0
    lower, upper = torch.maximum(model.lower, home - torch.pi), torch.minimum(model.upper, home + torch.pi)
    start = torch.where(spread < 0, home + spread * (home - lower), home + spread * (upper - home))
    wide = torch.arange(sequences).repeat_interleave(restarts)
    frame = _frame(_take(targets, wide), support[wide], 0, None)
    solved = _solve(model, frame, start.repeat(sequences, 1), config, config.first_iterations, None)
    cost = _system(model, frame, solved, config, None).cost.view(sequences, restarts)
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


def _follow(
    model: ArmModel,
    targets: ArmTargets,
    support: Tensor,
    start: Tensor,
    config: ArmConfig,
    collision: SelfCollision | None,
    progress: Callable[[float], None],
) -> Tensor:
    """[B, T, n] joints along the path, every frame warm-started from the one before; the first from ``start`` [B, n]."""
    frames = targets.annotated.shape[1]
    path: list[Tensor] = []
    for t in range(frames):
        previous = path[-1] if path else None
        steps = config.iterations if path else config.first_iterations
        path.append(_solve(model, _frame(targets, support, t, previous), path[-1] if path else start, config, steps, collision))
        progress((t + 1) / frames)
    return torch.stack(path, dim=1)


def _solve(model: ArmModel, frame: _Frame, q: Tensor, config: ArmConfig, iterations: int, collision: SelfCollision | None) -> Tensor:
    """[B, n] minimiser of one frame's cost, from ``q``: Levenberg-Marquardt, each element of the batch with its own damping."""
    damping = torch.full((len(q),), 1e-3, dtype=q.dtype)
    now = _system(model, frame, q, config, collision)
    for _ in range(iterations):
        outward = ((q <= model.lower) & (now.gradient > 0)) | ((q >= model.upper) & (now.gradient < 0))
        free = (~outward).to(q.dtype)
        ridge = damping[:, None] * now.hessian.diagonal(dim1=-2, dim2=-1).clamp_min(1e-3) * free + (1.0 - free)
        H = now.hessian * free[:, :, None] * free[:, None, :] + torch.diag_embed(ridge)
        step = torch.linalg.solve(H, -now.gradient * free)
        trial_q = torch.minimum(torch.maximum(q + step, model.lower), model.upper)
        trial = _system(model, frame, trial_q, config, collision)
        better = trial.cost < now.cost
        moved = (trial_q - q).abs().amax(-1)
        q = torch.where(better[:, None], trial_q, q)
        now = _System(
            cost=torch.where(better, trial.cost, now.cost),
            hessian=torch.where(better[:, None, None], trial.hessian, now.hessian),
            gradient=torch.where(better[:, None], trial.gradient, now.gradient),
        )
        damping = torch.where(better, damping * 0.2, damping * 8.0).clamp(1e-9, 1e9)
        if bool((moved < _CONVERGED).all()):
            break
    return q


def _system(model: ArmModel, frame: _Frame, q: Tensor, config: ArmConfig, collision: SelfCollision | None) -> _System:
    """Cost of one frame and its Gauss-Newton approximation at ``q`` [B, n]."""
    full = model.full(q, frame.hand_joints)
    carriers = model.kinematics.jacobian(full, model.carriers)
    linear, angular = carriers.linear[..., model.arm], carriers.angular[..., model.arm]  # [B, 1 + A, 3, n]

    turn = quat_to_axis_angle(quat_multiply(matrix_to_quat(carriers.rot[:, 0]), quat_conjugate(frame.quat)))
    residuals = [config.position_weight**0.5 * (carriers.pos[:, 0] - frame.pos), config.orientation_weight**0.5 * turn]
    jacobians = [config.position_weight**0.5 * linear[:, 0], config.orientation_weight**0.5 * angular[:, 0]]
    if frame.previous is not None:
        scale = config.smoothness_weight**0.5
        residuals.append(scale * (q - frame.previous))
        jacobians.append(scale * torch.eye(q.shape[1], dtype=q.dtype).expand(len(q), -1, -1))
    hand = [(0, frame.support, model.hand_radii)] if len(model.hand_radii) else []
    for carrier, points, radii in hand + model.arm_support:
        arms = points @ carriers.rot[:, carrier].mT
        heights = height_above_table(arms + carriers.pos[:, None, carrier], radii, model.table)
        lowest = heights.argmin(dim=1)
        rows = torch.arange(len(q))
        value, row = _intrusion(heights[rows, lowest], config.table_margin, config.collision_weight)
        lift = linear[:, carrier, 2] + torch.linalg.cross(angular[:, carrier], arms[rows, lowest][..., None], dim=1)[:, 2]
        residuals.append(value[:, None])
        jacobians.append(row[:, None, None] * lift[:, None])
    r, J = torch.cat(residuals, dim=1), torch.cat(jacobians, dim=1)
    system = _System(cost=r.square().sum(1), hessian=J.mT @ J, gradient=(J.mT @ r[..., None])[..., 0])
    if collision is not None:
        _add_self_collision(system, model, full, carriers.pos, linear, angular, config, collision)
    return system


def _intrusion(distance: Tensor, margin: float, weight: float) -> tuple[Tensor, Tensor]:
    """Residual sqrt(w) [margin - d]_+ and its derivative by d."""
    scale = weight**0.5 * (distance < margin).to(distance.dtype)
    return scale * (margin - distance.clamp_max(margin)), -scale


def _add_self_collision(
    system: _System,
    model: ArmModel,
    full: Tensor,
    origins: Tensor,
    linear: Tensor,
    angular: Tensor,
    config: ArmConfig,
    collision: SelfCollision,
) -> None:
    """Add w [margin - d]_+^2 of every pair of near shapes, in place; d changes by n . (v_b - v_a) at the nearest points."""
    near = collision.near(model.kinematics.link_poses(full).numpy(), config.self_margin)
    batch = torch.as_tensor(near.configuration)
    normal, points = torch.as_tensor(near.normal), torch.as_tensor(near.points)
    approach = torch.zeros(len(batch), system.gradient.shape[1], dtype=full.dtype)
    for side, sign in ((0, -1.0), (1, 1.0)):
        carrier = model.carrier_of[torch.as_tensor(near.links[:, side])]
        reach = points[:, side] - origins[batch, carrier]
        velocity = linear[batch, carrier] + torch.linalg.cross(angular[batch, carrier], reach[..., None], dim=1)
        approach += sign * (normal[:, None] @ velocity)[:, 0]
    value, scale = _intrusion(torch.as_tensor(near.distance), config.self_margin, config.collision_weight)
    rows = scale[:, None] * approach
    system.cost.index_add_(0, batch, value.square())
    system.hessian.index_add_(0, batch, rows[:, :, None] * rows[:, None, :])
    system.gradient.index_add_(0, batch, rows * value[:, None])
