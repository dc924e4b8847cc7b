"""Finds the base placement from which a robot's arm reaches most of what human hands did.

Hand retargeting says where the hand root must be in every frame of some demonstrations. Candidates are drawn at random,
then around the best of them (the cross-entropy method), and tried on single frames, from several starts: what the arm
*can* reach. The few best, and the robot's own placement, then follow whole motions as in ``xreset retarget``, and the
one that follows most wins.

Shape letters: F frames, n arm joints.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.errors import RobotError
from xreset.files.processes import in_processes
from xreset.files.progress import Progress, unseen
from xreset.geometry.collision import table_clearance
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.shapes import quat_of, turn_of
from xreset.physics.tensors import one_thread
from xreset.retarget.arm.config import QUICK
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import track
from xreset.retarget.validity import Thresholds, classify
from xreset.robot_tools.homes import hold_near
from xreset.robot_tools.placement import Finalist, PlaceConfig
from xreset.spec import RobotSpec, TableSpec

_POSITION = 0.005
_ORIENTATION = np.radians(5.0)
"""[m], [rad] Largest distance and angle of a reached hand root from its target."""
_FRAMES = 100
"""Frames that each candidate is tried on, each on its own."""
_ELITE = 5
"""Best candidates: the next round is drawn around them, and in the end they and the description's own placement are the
finalists."""
_CANDIDATES = 40
"""Candidates of each round."""
_SEED = 0
"""Seed of the frames and of the candidates."""
_FINAL_FRAMES = 600
"""Frames on which the finalists are tried."""
_LENGTH = 0.10
"""[m] Length that counts as much as one radian in the measure of dexterity."""
_FIRST = 12
"""Frames that a candidate is tried on first: most candidates fail on so many of them that they are given up."""
_DRAWS = 1000
"""Times that a candidate is drawn until it is clear of wrists and objects; then the round goes without it."""
_UPRIGHT = 45.0
"""[degrees] A base with less tilt than this stands on something."""
_SHRINK = 0.6
"""Factor by which the spread of candidates about the best shrinks from round to round."""
_HOME_CLEAR = 0.02
"""[m] Least height above the table of a home that keeps the old joint positions."""


def place(
    robot: RobotSpec,
    paths: list[ArmTargets],
    avoid: np.ndarray,
    config: PlaceConfig = PlaceConfig(),
    progress: Progress = unseen,
) -> list[Finalist]:
    """Find the placement from which the robot follows most of the motions.

    Args:
        robot: the robot; its own placement is the first candidate, and a finalist.
        paths: what hand retargeting asks of the arm: see :func:`xreset.retarget.pipeline.wrist_paths`.
        avoid: [., 3] points that the base keeps clear of.
        progress: called with (placements tried, most placements to try).

    Returns:
        The finalists, those with a home first, and of these the one that follows most.

    Raises:
        RobotError: there is no wrist pose to reach, or no room for the base.
    """
    wrists = single_frames(paths, Thresholds().hand_error)
    count = len(wrists.annotated)
    if not count:
        raise RobotError(
            f"robot {robot.name!r}: there is no frame to reach; hand retargeting followed none within its threshold."
        )
    random = np.random.default_rng(_SEED)
    order = torch.as_tensor(random.permutation(count))
    tried = wrists[order[:_FRAMES]]
    kept = wrists[order[_FRAMES:][:_FINAL_FRAMES]]
    if not len(kept.annotated):
        kept = tried
    found = [(reach(robot, tried), robot)]
    done = 0
    total = config.rounds * _CANDIDATES + _ELITE + 1
    for number in range(config.rounds):
        elite = found[:_ELITE]
        least = _rank(elite[-1][0])[0] if len(elite) == _ELITE else 0
        centers = [candidate for _, candidate in elite]
        candidates = _candidates(robot, avoid, config, random, number, centers)
        reaching = partial(reach, wrists=tried, least=least)
        for reached in zip(in_processes(reaching, candidates), candidates, strict=True):
            found.append(reached)
            done += 1
            progress(done, total)
        found.sort(key=lambda pair: _rank(pair[0]), reverse=True)
    chosen = [robot]
    if config.rounds:
        chosen += [candidate for _, candidate in found[:_ELITE] if candidate is not robot]
    finalists = []
    following = partial(_followed, wrists=kept, paths=paths)
    frames = sum(int(path.annotated.sum()) for path in paths)
    for candidate, measured in zip(chosen, in_processes(following, chosen), strict=True):
        reached, dexterity, followed = measured
        with_home, rule = _with_home(candidate, robot)
        finalists.append(
            Finalist(
                robot=with_home,
                reached=reached,
                dexterity=dexterity,
                followed=followed / frames,
                frames=frames,
                sequences=sum(len(path.annotated) for path in paths),
                home_rule=rule,
            )
        )
        progress(done + len(finalists), total)
    return sorted(
        finalists, key=lambda finalist: (finalist.home_rule != "", finalist.followed), reverse=True
    )


def _rank(reached: tuple[float, float]) -> tuple[int, float]:
    """Return what candidates are compared by: reach to half a percent, then dexterity."""
    return round(reached[0] * 200), reached[1]


def _followed(
    robot: RobotSpec, wrists: ArmTargets, paths: list[ArmTargets]
) -> tuple[float, float, int]:
    """Return what :func:`reach` returns, and the number of the paths' frames that the robot follows."""
    model = ArmModel(robot)
    valid = 0
    for path in paths:
        _, measures = track(model, path, Thresholds())
        valid += int((classify(measures, Thresholds()) == 0).sum())
    return *reach(robot, wrists), valid


@one_thread()
def reach(robot: RobotSpec, wrists: ArmTargets, least: int = 0) -> tuple[float, float]:
    """Return the share of wrist poses [F, 1, ...] that the robot reaches, and its dexterity: see :class:`Finalist`.

    The trial ends early when the first number of the robot's rank can no longer be ``least`` or more; frames that were
    not tried then count as reached.
    """
    model = ArmModel(robot)
    thresholds = Thresholds(
        hand_error=np.inf, wrist_position=_POSITION, wrist_orientation=_ORIENTATION
    )
    frames = len(wrists.annotated)
    possible = frames
    dexterity = torch.zeros(0, dtype=torch.float64)
    for part in (wrists[:_FIRST], wrists[_FIRST:]) if least else (wrists,):
        if round(200 * possible / frames) < least:
            break
        joints, measures = track(model, part, thresholds, QUICK)
        reached = (classify(measures, thresholds) == 0)[:, 0]
        possible -= int((~reached).sum())
        configurations = model.full(joints[reached, 0], part.hand_joints[reached, 0])
        jacobian = model.kinematics.jacobian(configurations, [robot.hand_root])
        rows = torch.cat((jacobian.linear[:, 0] / _LENGTH, jacobian.angular[:, 0]), dim=1)[
            ..., model.arm
        ]
        dexterity = torch.cat((dexterity, torch.linalg.svdvals(rows)[:, -1]))
    return possible / frames, float(dexterity.mean()) if len(dexterity) else 0.0


def single_frames(paths: list[ArmTargets], hand_error: float) -> ArmTargets:
    """[F, 1, ...] the annotated frames of paths, each by itself, that hand retargeting follows within ``hand_error``
    [m]."""
    parts = [path[path.annotated & (path.hand_error <= hand_error)] for path in paths]
    return ArmTargets.cat(parts).map(lambda x: x[:, None])


def _candidates(
    robot: RobotSpec,
    avoid: np.ndarray,
    config: PlaceConfig,
    random: np.random.Generator,
    number: int,
    elite: list[RobotSpec],
) -> list[RobotSpec]:
    """Return the candidates of a round: first evenly over the ranges, then around the elite."""
    tilt = _parameters(robot)[[4, 4]]  # as the description has it
    turn = (-180.0, 180.0)
    low, high = np.array([config.x, config.y, config.z, turn, tilt, turn]).T
    spread = (high - low) / 4 * _SHRINK**number
    centers = [_parameters(candidate) for candidate in elite]
    bounded = [0, 1, 2, 4]  # all but the angles that go round
    candidates = []
    for _ in range(_CANDIDATES):
        for _ in range(_DRAWS):
            if number == 0:
                drawn = random.uniform(low, high)
            else:
                drawn = centers[random.integers(len(centers))] + spread * random.standard_normal(6)
            drawn[bounded] = np.clip(drawn[bounded], low[bounded], high[bounded])
            away = avoid - drawn[:3]
            if drawn[4] < _UPRIGHT:
                away[:, 2] = away[:, 2].clip(min=0)  # what carries the base is below it
            if not len(avoid) or np.linalg.norm(away, axis=1).min() >= config.clear:
                candidates.append(_placed(robot, drawn))
                break
    if number == 0 and not candidates:
        raise RobotError(
            f"robot {robot.name!r}: no place in the searched ranges is {config.clear:g} m away from all wrists and "
            "objects. Lower --search.clear, or widen --search.x, --search.y or --search.z."
        )
    return candidates


def _placed(robot: RobotSpec, parameters: np.ndarray) -> RobotSpec:
    """Return the robot with its base at (x, y, z, azimuth, tilt, spin): the base is spun about its z axis, which is
    tilted towards an azimuth; angles in degrees."""
    turn = Rotation.from_euler("ZYZ", parameters[3:], degrees=True)
    quat = quat_of(turn)
    return replace(robot, base_pos=tuple(parameters[:3].tolist()), base_quat=tuple(quat.tolist()))


def _parameters(robot: RobotSpec) -> np.ndarray:
    """[6] parameters of a robot's base, as :func:`_placed` takes them."""
    turn = turn_of(robot.base_quat)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of an upright base, whose azimuth is 0
        spin, tilt, azimuth = turn.as_euler("zyz", degrees=True)
    return np.array([*robot.base_pos, azimuth, tilt, spin])


def _with_home(placed: RobotSpec, robot: RobotSpec) -> tuple[RobotSpec, str]:
    """Return the placed robot with a home of its arm, and how it was chosen; empty if none is found.

    The first of these that the arm can reach, clear of the table and of itself: the pose of the hand at the
    description's home; the nearest of poses next to and above it; the description's joints.
    """
    if placed == robot:
        return robot, "as described"
    home = torch.as_tensor(robot.home)
    found = hold_near(placed, Kinematics(robot).link_poses(home, [robot.hand_root])[0].numpy())
    if found is not None:
        held, moved = found
        return held, "the hand where it was" + moved
    if table_clearance(Kinematics(placed), home[None], TableSpec()) > _HOME_CLEAR:
        return placed, "the joints as they were"
    return placed, ""
