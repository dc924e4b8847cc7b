"""Where a robot should stand: the base placement from which its arm reaches most of what human hands did.

Hand retargeting says where the hand root must be in every frame of some demonstrations. Each frame is solved on its own, from several
starts, so the figure is what the arm *can* reach; what it follows without a jump is for ``xreset retarget`` to say. Candidates are drawn at
random, then around the best of them (the cross-entropy method).

Shape letters: F frames, n arm joints.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.errors import RobotError
from xreset.retarget.arm import ArmConfig, ArmModel, ArmTargets, track
from xreset.retarget.validity import Thresholds, classify
from xreset.robots.placement import PlaceConfig, Placement, Reach, Search
from xreset.rotations import matrix_to_quat
from xreset.spec import RobotSpec

_LENGTH = 0.10
"""Length that counts as much as one radian in the measure of dexterity [m]."""
_SHRINK = 0.6
"""Factor by which the spread of candidates about the best shrinks from round to round."""


def place(
    robot: RobotSpec,
    wrists: ArmTargets,
    avoid: np.ndarray,
    config: PlaceConfig | None = None,
    progress: Callable[[float, Placement, Reach], None] = lambda done, placement, reach: None,
) -> Search:
    """The placement from which the robot reaches most wrist poses.

    Args:
        robot: the robot; its own placement is the first candidate.
        wrists: [F, 1, ...] what hand retargeting asks of the arm; see :func:`single_frames`.
        avoid: [., 3] points that the base keeps clear of.
        config: ranges and effort.
        progress: called with the share that is done, the best placement yet and its reach.

    Raises:
        RobotError: there is no wrist pose to reach.
    """
    config = config or PlaceConfig()
    if not len(wrists.annotated):
        raise RobotError(f"robot {robot.name!r}: there is no frame to reach; hand retargeting followed none within its threshold.")
    random = np.random.default_rng(config.seed)
    order = random.permutation(len(wrists.annotated))
    tried, kept = order[: config.frames], order[config.frames :][: config.final_frames]
    kept = kept if len(kept) else tried
    own = Placement(pos=robot.base_pos, quat=robot.base_quat)
    found = [(own, reach(robot, own, _chosen(wrists, tried), config))]
    steps = config.rounds * config.candidates
    draws = _draws(robot, avoid, config, random, found)
    for step, candidate in enumerate(draws):
        found.append((candidate, reach(robot, candidate, _chosen(wrists, tried), config)))
        found.sort(key=lambda pair: pair[1].rank, reverse=True)
        progress((step + 1) / (steps + 2), *found[0])
    best, last = found[0][0], _chosen(wrists, kept)
    return Search(
        best=best,
        best_reach=reach(robot, best, last, config),
        own_reach=reach(robot, own, last, config),
        home=_home(robot, best),
        frames=len(kept),
    )


def reach(robot: RobotSpec, placement: Placement, wrists: ArmTargets, config: PlaceConfig) -> Reach:
    """What the robot reaches of wrist poses [F, 1, ...] from a placement."""
    model = ArmModel(replace(robot, base_pos=placement.pos, base_quat=placement.quat))
    thresholds = Thresholds(hand_error=np.inf, wrist_position=config.position, wrist_orientation=np.radians(config.orientation))
    joints, measures = track(model, wrists, thresholds, ArmConfig(restarts=4, branches=2, first_iterations=40))
    reached = (classify(measures, thresholds) == 0)[:, 0]
    if not bool(reached.any()):
        return Reach(reached=0.0, dexterity=0.0)
    full = model.full(joints[reached, 0], wrists.hand_joints[reached, 0])
    jacobian = model.kinematics.jacobian(full, [robot.hand_root])
    rows = torch.cat((jacobian.linear[:, 0] / _LENGTH, jacobian.angular[:, 0]), dim=1)[..., model.arm]
    return Reach(reached=float(reached.double().mean()), dexterity=float(torch.linalg.svdvals(rows)[:, -1].mean()))


def single_frames(paths: list[ArmTargets], hand_error: float) -> ArmTargets:
    """[F, 1, ...] the annotated frames of paths, each on its own, that hand retargeting follows within ``hand_error`` [m]."""

    def flat(name: str) -> torch.Tensor:
        return torch.cat([getattr(path, name)[path.annotated & (path.hand_error <= hand_error)] for path in paths])[:, None]

    return ArmTargets(**{name: flat(name) for name in vars(paths[0])})


def _draws(
    robot: RobotSpec, avoid: np.ndarray, config: PlaceConfig, random: np.random.Generator, found: list[tuple[Placement, Reach]]
) -> Iterator[Placement]:
    """Candidates: first evenly over the ranges, then around the best that ``found`` holds by then."""
    own_tilt = float(np.degrees(np.arccos(np.clip(Rotation.from_quat(robot.base_quat, scalar_first=True).as_matrix()[2, 2], -1, 1))))
    tilt = config.tilt or (own_tilt, own_tilt)
    low = np.array([config.x[0], config.y[0], config.z[0], -180.0, tilt[0], -180.0])
    high = np.array([config.x[1], config.y[1], config.z[1], 180.0, tilt[1], 180.0])
    for number in range(config.rounds):
        centres = [_parameters(placement) for placement, _ in found[: config.elite]]
        for _ in range(config.candidates):
            while True:
                if number == 0:
                    drawn = random.uniform(low, high)
                else:
                    spread = (high - low) / 4 * _SHRINK**number
                    drawn = centres[random.integers(len(centres))] + spread * random.standard_normal(6)
                drawn[:3], drawn[4] = np.clip(drawn[:3], low[:3], high[:3]), np.clip(drawn[4], *tilt)
                if not len(avoid) or np.linalg.norm(avoid - drawn[:3], axis=1).min() >= config.clear:
                    break
            yield _placement(drawn)


def _placement(parameters: np.ndarray) -> Placement:
    """From (x, y, z, azimuth, tilt, spin): the base is spun about its z axis, which is tilted towards an azimuth; angles in degrees."""
    turn = Rotation.from_euler("ZYZ", parameters[3:], degrees=True)
    x, y, z = (float(v) for v in parameters[:3])
    a, b, c, d = (float(v) for v in turn.as_quat(canonical=True, scalar_first=True))
    return Placement(pos=(x, y, z), quat=(a, b, c, d))


def _parameters(placement: Placement) -> np.ndarray:
    R = Rotation.from_quat(placement.quat, scalar_first=True).as_matrix()
    tilt = np.arccos(np.clip(R[2, 2], -1.0, 1.0))
    azimuth = np.arctan2(R[1, 2], R[0, 2]) if np.sin(tilt) > 1e-6 else 0.0
    back = Rotation.from_euler("ZY", (azimuth, tilt)).inv().as_matrix() @ R
    return np.array([*placement.pos, *np.degrees((azimuth, tilt, np.arctan2(back[1, 0], back[0, 0])))])


def _chosen(wrists: ArmTargets, frames: np.ndarray) -> ArmTargets:
    return ArmTargets(**{name: value[torch.as_tensor(frames)] for name, value in vars(wrists).items()})


def _home(robot: RobotSpec, placement: Placement) -> np.ndarray | None:
    """[n] arm joints near home, from a placement, that hold the hand where the description's own placement and home hold it."""
    own, model = ArmModel(robot), ArmModel(replace(robot, base_pos=placement.pos, base_quat=placement.quat))
    home = torch.as_tensor(robot.home)[None, None]
    root = own.kinematics.link_poses(home, [robot.hand_root])[..., 0, :, :]
    hand = home[..., torch.as_tensor(own.hand.joint_indices)]
    target = ArmTargets(
        root_pos=root[..., :3, 3],
        root_quat=matrix_to_quat(root[..., :3, :3]),
        hand_joints=hand,
        annotated=torch.ones(1, 1, dtype=torch.bool),
        hand_error=torch.zeros(1, 1, dtype=root.dtype),
        hand_clearance=torch.zeros(1, 1, dtype=root.dtype),
    )
    joints, measures = track(model, target, Thresholds())
    return joints[0, 0].numpy() if int(classify(measures, Thresholds())) == 0 else None
