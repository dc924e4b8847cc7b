"""Judges what a robot can grasp without training: accepted states of a reset bank hold, are lifted and are turned.

Each state starts a program of open-loop targets. The targets press on the object. First it has no weight, so that the
fingers close; then it has all of it for a second; then the arm raises the hand by 10 cm; then it turns the hand by 45
degrees about the palm's x axis. The object must stay where it was in the hand.

Apart from physics, it counts the demonstrations that the robot can follow at all with a rigid grasp: what no training
can improve.

Shape letters: M states, N worlds, J joints, n arm joints, P phases.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.files.checks import frozen
from xreset.files.progress import Progress
from xreset.files.text import Brief
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import (
    matrix_to_quat,
    quat_angle,
    quat_from_axis_angle,
    quat_multiply,
    relative_pose,
)
from xreset.physics import Backend, State
from xreset.pictures.render import Camera, Renderer, add_caption
from xreset.resets.bank import ResetBank
from xreset.resets.config import SqueezeConfig
from xreset.resets.fingers import Fingers, fingers_of, squeeze_targets
from xreset.resets.grasps import losses, raised
from xreset.resets.probe import of_center, probe
from xreset.resets.programs import palm_path
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec, objects_named

PHASES = ("hold", "lift", "turn")
LIFT = 0.01
"""Height of the center of mass above the demonstration's start from which a state is lifted [m]."""
HEIGHT = 0.10
"""How far the arm raises the hand [m]."""
TURN = np.pi / 4
"""How far the arm turns the hand [rad]."""
DISTANCE = 0.03
"""Largest change of the center of mass in the palm's frame [m]."""
ANGLE = np.pi / 4
"""Largest change of the object's orientation in the palm's frame [rad]."""
_REACH = 0.010
"""A finger presses if it is nearer than this to the object [m]: farther away than in a bank's states, because it has
time to close before the object gets its weight."""
_WORLDS = 32
"""Worlds at a time."""
_CLOSE_STEPS = 15
"""Control steps without weight."""
_MOVE_STEPS = 45
_REST_STEPS = 15
"""Control steps in which a phase moves the arm and lets it rest, a second together."""
_WAYPOINTS = 15
"""Waypoints of the arm in a motion."""
_ITERATIONS = 3
"""Steps of damped least squares to each waypoint."""
_REACHED = (0.02, 0.15)
"""[m], [rad] Largest errors of the arm at the end of a motion that it can make."""
_TILE = (224, 176)


@frozen
class Judged:
    """What became of the tried states of one object in one engine."""

    engine: str
    object_name: str
    """``all`` in a sum over objects."""
    tried: int
    hold: int
    """States that hold the object for a second at full gravity."""
    lift: int
    """States of these that also keep it while the arm raises the hand."""
    turn: int
    """States of these that also keep it while the arm turns the hand."""
    arm_fails: int
    """States in which the arm cannot raise or turn the hand so far; they count as not lifted or not turned."""


@frozen
class Reached:
    """How many demonstrations of an object the robot can follow with a rigid grasp
    (:func:`xreset.resets.grasps.losses`)."""

    object_name: str
    """``all`` in a sum over objects."""
    demonstrations: int
    reached: int
    """Demonstrations with a grasp that is clear of the table at the start, and that the arm carries to the goal."""
    lost: dict[str, int]
    """Reason -> number of the others, the most frequent first."""


@frozen
class Judgement(Brief):
    """Result of :func:`xreset.robot_tools.verbs.judge`."""

    robot: str
    rows: tuple[Judged, ...]
    """For each engine one for each object, and their sum."""
    without: tuple[str, ...]
    """Objects for which the bank has no lifted grasp."""
    reach: tuple[Reached, ...]
    """One for each object of the bank's demonstrations, and their sum."""
    shots: dict[str, np.ndarray]
    """Object -> [1 + P, J + 7] joint positions, position and orientation of the object in its best state, at the start
    and after each phase in the first engine."""

    @property
    def prospects(self) -> dict[str, float]:
        """Object -> share of its states that hold, lift and turn it in the first engine, times the share of its
        demonstrations in reach; the largest first. What trained policies reach has this order, roughly."""
        turned = {row.object_name: row.turn / row.tried for row in reversed(self.rows)}
        shares = {}
        for row in self.reach[:-1]:  # the last one is their sum
            shares[row.object_name] = (
                turned.get(row.object_name, 0.0) * row.reached / row.demonstrations
            )
        return dict(sorted(shares.items(), key=lambda item: -item[1]))


def try_grasps(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    engines: Sequence[str],
    *,
    states: int,
    squeeze: SqueezeConfig,
    device: str,
    progress: Progress,
) -> Judgement:
    """Try the states of a bank, and count the demonstrations in reach; see :func:`xreset.robot_tools.verbs.judge`."""
    tried, start = _grasps(bank, robot, objects, states, squeeze)
    count = tried.num_states
    used = [spec for spec in objects if spec.name in tried.object_name]
    names = [spec.name for spec in used]
    scene = SceneSpec(robot=robot, objects=tuple(used))
    groups = {name: np.flatnonzero(tried.object_name == name) for name in names}
    rows = []
    shots: dict[str, np.ndarray] = {}
    for number, engine in enumerate(engines):
        before = number * count
        table = probe(
            engine, scene, tried.object_name, start, partial(_play, Kinematics(robot)), gravity=0.0,
            steps=_CLOSE_STEPS, num_envs=_WORLDS, device=device,
            progress=lambda done, before=before: progress(before + done, len(engines) * count),
        )  # fmt: skip
        verdicts = table[:, : 1 + len(PHASES)].astype(int)
        for name, mine in {**groups, "all": np.arange(count)}.items():
            able, hold, lift, turn = verdicts[mine].sum(axis=0).tolist()
            row = Judged(
                engine=engine,
                object_name=name,
                tried=len(mine),
                hold=hold,
                lift=lift,
                turn=turn,
                arm_fails=len(mine) - able,
            )
            rows.append(row)
        if number == 0:
            for name, mine in groups.items():
                best = mine[verdicts[mine, 1:].sum(axis=1).argmax()]
                later = table[best, 1 + len(PHASES) :].reshape(len(PHASES), -1)
                shots[name] = np.vstack((_shot(start[[best]]).numpy(), later))
    without = sorted({*bank.object_names} - set(names))
    return Judgement(
        robot=robot.name,
        rows=tuple(rows),
        without=tuple(without),
        reach=reach_of(bank, robot, objects, progress),
        shots=shots,
    )


def reach_of(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    progress: Progress,
) -> tuple[Reached, ...]:
    """Count the demonstrations that a robot can follow with a rigid grasp, for each object and in all."""
    reasons = losses(bank, robot, objects, progress=progress)
    groups = {name: bank.sequence_object == name for name in bank.object_names}
    groups["all"] = np.ones(len(reasons), dtype=bool)
    rows = []
    for name, mine in groups.items():
        counts = Counter(reasons[mine].tolist())
        reached = counts.pop("", 0)
        row = Reached(
            object_name=name,
            demonstrations=int(mine.sum()),
            reached=reached,
            lost=dict(counts.most_common()),
        )
        rows.append(row)
    return tuple(rows)


def _grasps(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    states: int,
    squeeze: SqueezeConfig,
) -> tuple[ResetBank, State]:
    """Return the states to try, and how they start: at rest, with targets that press on the object."""
    objects_named(objects, bank.object_names)
    height = raised(bank, objects)
    lifted = bank.with_states(np.flatnonzero(bank.own_grasp & bank.post_contact & (height > LIFT)))
    if not lifted.num_states:
        raise RobotError(
            f"robot {robot.name!r}: the bank has no state in which an object is in the air. Look at the reasons of "
            "xreset resets and xreset retarget."
        )
    fingers = fingers_of(
        robot,
        objects,
        lifted.object_name,
        lifted.joint_pos,
        lifted.object_pos,
        lifted.object_quat_wxyz,
    )
    chosen = _tightest(fingers, lifted, states)
    if not chosen:
        raise RobotError(
            f"robot {robot.name!r}: in no lifted state are the thumb and another finger within "
            f"{1e3 * _REACH:g} mm of the object. Check the fingertips' frames (xreset robots check --picture)."
        )
    force = squeeze.newtons(len(robot.fingertips)) * fingers.pressing(_REACH)
    targets = squeeze_targets(robot, fingers, lifted.joint_pos, force)[chosen]
    tried = lifted.with_states(np.array(chosen))
    arrays = (tried.joint_pos, tried.object_pos, tried.object_quat_wxyz, targets)
    return tried, State.at_rest(*map(torch.as_tensor, arrays))


def _tightest(fingers: Fingers, bank: ResetBank, count: int) -> list[int]:
    """Return the rows of the ``count`` tightest grasps of each object, taken from its sequences in turn."""
    thumb = fingers.gap[:, fingers.finger == 0].amin(dim=-1)
    other = fingers.gap[:, fingers.finger != 0].amin(dim=-1)
    gap = torch.maximum(thumb, other).numpy()
    rank = np.zeros(len(gap), dtype=int)
    for number in np.unique(bank.sequence_index):
        mine = np.flatnonzero(bank.sequence_index == number)
        rank[mine[np.argsort(gap[mine], kind="stable")]] = np.arange(len(mine))
    chosen = []
    for name in np.unique(bank.object_name):
        mine = np.flatnonzero((bank.object_name == name) & (gap < _REACH))
        chosen += mine[np.lexsort((gap[mine], rank[mine]))][:count].tolist()
    return sorted(chosen)


def _shot(state: State) -> Tensor:
    """[N, J + 7] a row of :attr:`Judgement.shots` for each world: joint positions, then position and orientation of the
    object."""
    return torch.cat((state.joint_pos, state.object_pos, state.object_quat), dim=1)


def _play(kinematics: Kinematics, backend: Backend, start: State) -> Tensor:
    """Go through the phases; return [N, 1 + P + P (J + 7)]: whether the arm can raise and turn the hand, which phases
    are passed, then the joints and the object's pose after each phase."""
    backend.set_object_gravity(torch.ones(backend.num_worlds, device=backend.device))
    start = of_center(backend, start).to("cpu").map(Tensor.double)
    joints = start.joint_pos
    palm = kinematics.link_poses(joints, [kinematics.robot.palm])[:, 0]
    up, up_error = arm_path(kinematics, joints, palm, turn=0.0)
    right, turn_error = arm_path(kinematics, up[-1], palm, turn=TURN)
    left, left_error = arm_path(kinematics, up[-1], palm, turn=-TURN)
    turn = torch.where((turn_error <= left_error)[:, None], right, left)
    turn_error = turn_error.minimum(left_error)
    pos, quat = relative_pose(
        start.object_pos, start.object_quat, palm[:, :3, 3], matrix_to_quat(palm[:, :3, :3])
    )
    able = (up_error < 1) & (turn_error < 1)
    still = torch.stack((joints, joints))
    kept = torch.ones_like(able)
    passed = []
    shots = []
    for path, error in ((still, torch.zeros_like(up_error)), (up, up_error), (turn, turn_error)):
        _move(backend, start.joint_target, path, kinematics.robot.arm_indices)
        state = backend.state()
        now = of_center(backend, state).to("cpu").map(Tensor.double)
        links = backend.links().to("cpu").map(Tensor.double)
        now_pos, now_quat = relative_pose(
            now.object_pos, now.object_quat, links.pos[:, 0], links.quat[:, 0]
        )
        near = ((now_pos - pos).norm(dim=-1) < DISTANCE) & (quat_angle(now_quat, quat) < ANGLE)
        kept = kept & near & (error < 1)
        passed.append(kept)
        shots.append(_shot(state.to("cpu").map(Tensor.double)))
    health = backend.health()
    sound = ~(health.nonfinite | health.overflow).cpu()
    return torch.cat((able[:, None], torch.stack(passed, dim=1) & sound[:, None], *shots), dim=1)


def arm_path(
    kinematics: Kinematics, joints: Tensor, palm: Tensor, *, turn: float
) -> tuple[Tensor, Tensor]:
    """Move the palm up by :data:`HEIGHT` and turn it about its x axis.

    Args:
        kinematics: of the whole robot.
        joints: [N, J] where the path begins.
        palm: [N, 4, 4] pose from which the palm rises [m] and turns [rad].
        turn: angle at the end [rad].

    Returns:
        Joints [1 + waypoints, N, J], and the error at the end as a share of what is allowed [N].
    """
    risen = kinematics.link_poses(joints, [kinematics.robot.palm])[:, 0, 2, 3] - palm[:, 2, 3]
    share = torch.linspace(0.0, 1.0, 1 + _WAYPOINTS, dtype=joints.dtype)[1:, None]
    pos = palm[:, :3, 3].repeat(_WAYPOINTS, 1, 1)
    pos[..., 2] += risen + share * (HEIGHT - risen)
    axis = torch.nn.functional.pad(share * turn, (0, 2))  # about x
    start = matrix_to_quat(palm[:, :3, :3]).expand(_WAYPOINTS, -1, -1)
    turned = quat_multiply(start, quat_from_axis_angle(axis)[:, None].expand_as(start))
    path, missing = palm_path(
        kinematics, joints, pos, turned, iterations=_ITERATIONS, turn_length=1.0
    )
    error = torch.maximum(
        missing[:, :3].norm(dim=1) / _REACHED[0], missing[:, 3:].norm(dim=1) / _REACHED[1]
    )
    return torch.cat((joints[None], path)), error


def _move(backend: Backend, targets: Tensor, path: Tensor, arm: np.ndarray) -> None:
    """Move the arm's targets along waypoints [W, N, J], and let it rest; the hand keeps its targets [N, J]."""
    for number in range(1, _MOVE_STEPS + _REST_STEPS + 1):
        place = min(number / _MOVE_STEPS, 1.0) * (len(path) - 1)
        first = min(int(place), len(path) - 2)
        now = targets.clone()
        now[:, arm] = torch.lerp(path[first], path[first + 1], place - first)[:, arm]
        backend.set_joint_targets(now.float().to(backend.device))
        backend.step()


def judge_picture(
    judgement: Judgement, robot: RobotSpec, objects: Sequence[ObjectSpec]
) -> np.ndarray:
    """[H, W, 3] uint8: one row for each object: its best state at the start, and after each phase in the first engine,
    with the share of states that pass the phase in each engine."""
    by_name = {spec.name: spec for spec in objects}
    pictures = []
    for name, shots in judgement.shots.items():
        rows = [row for row in judgement.rows if row.object_name == name]
        renderer = Renderer(
            SceneSpec(robot=robot, objects=(by_name[name],)), size=_TILE, smooth=True
        )
        tiles = []
        for phase, shot in zip(("start", *PHASES), shots, strict=True):
            target = shot[-7:-4]
            camera = Camera(eye=tuple(target + np.array((0.42, -0.42, 0.22))), target=tuple(target))
            tile = renderer.draw(shot[:-7], (target, shot[-4:]), camera=camera)
            caption = [name]
            if phase != "start":
                caption = [
                    phase,
                    *(f"{row.engine} {getattr(row, phase) / row.tried:.0%}" for row in rows),
                ]
            tiles.append(add_caption(tile, caption, 1 + len(rows)))
        pictures.append(np.hstack(tiles))
    return np.vstack(pictures)
