"""Judges what a robot can grasp without training: accepted states of a reset bank hold, are lifted and are turned.

Each state starts a program of open-loop targets. The targets press on the object. First it has no weight, so that the
fingers close; then it has all of it for a second; then the arm raises the hand by 10 cm; then it turns the hand by 45
degrees about the palm's x axis. The object must stay where it was in the hand.

Shape letters: M states, N worlds, J joints, n arm joints, P phases.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xreset.errors import RobotError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import (
    matrix_to_quat,
    quat_angle,
    quat_conjugate,
    quat_from_axis_angle,
    quat_multiply,
    quat_normalize,
    quat_rotate_inverse,
    quat_to_axis_angle,
)
from xreset.physics import Backend, State
from xreset.pictures.render import Camera, Renderer, add_caption, pose_matrix
from xreset.resets.bank import ResetBank
from xreset.resets.config import SqueezeConfig
from xreset.resets.fingers import Fingers, fingers_of, squeeze_targets
from xreset.resets.probe import probe
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

SCHEMA = "xreset-judge/1"
PHASES = ("hold", "lift", "turn")
LIFT = 0.01
"""Height of the object's origin above the demonstration's start from which a state is lifted [m]."""
SECONDS = 1.0
"""Time for which a state must hold the object [s]."""
HEIGHT = 0.10
"""How far the arm raises the hand [m]."""
TURN = float(np.pi / 4)
"""By how much it turns the hand [rad]."""
DISTANCE = 0.03
"""Largest change of the object's position in the palm's frame [m]."""
ANGLE = float(np.pi / 4)
"""Largest change of its orientation in the palm's frame [rad]."""
_CLOSE_STEPS = 15
"""Control steps without weight."""
_MOVE_SECONDS = 0.75
_REST_SECONDS = 0.25
_WAYPOINTS = 15
_ITERATIONS = 3
_REACHED = (0.02, 0.15)
"""[m], [rad] Largest errors of the arm at the end of a motion that it can make."""
_TILE = (224, 176)


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What became of the tried states of one object in one engine."""

    backend: str
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


@dataclass(frozen=True, kw_only=True)
class Judgement:
    """Result of :func:`judge`."""

    robot: str
    rows: tuple[Judged, ...]
    """For each engine one for each object, and their sum."""
    without: tuple[str, ...]
    """Objects of which the bank has no lifted grasp."""
    shots: dict[str, list[dict[str, np.ndarray]]]
    """Object -> the best state's ``joint_pos``, ``object_pos`` and ``object_quat`` at the start and after each phase,
    in the first engine."""

    def share(self, backend: str, object_name: str, phase: str) -> float:
        """Return the share of an object's states that pass a phase."""
        row = next(row for row in self.rows if (row.backend, row.object_name) == (backend, object_name))
        return getattr(row, phase) / row.tried

    @property
    def kept(self) -> list[str]:
        """Objects of which at least half of the states pass all phases in every engine."""
        least = {row.object_name: 1.0 for row in self.rows if row.object_name != "all"}
        for row in self.rows:
            if row.object_name in least:
                least[row.object_name] = min(least[row.object_name], row.turn / row.tried)
        return [name for name, share in least.items() if share >= 0.5]

    def as_dict(self) -> dict[str, Any]:
        """Return what a JSON file holds."""
        return {
            "schema": SCHEMA,
            "robot": self.robot,
            "rows": [asdict(row) for row in self.rows],
            "without_lifted_grasp": list(self.without),
            "kept_in_every_engine": self.kept,
        }


def judge(
    bank: ResetBank,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    backends: Sequence[str] = ("mujoco",),
    *,
    states: int = 8,
    squeeze: SqueezeConfig | None = None,
    num_envs: int = 32,
    device: str = "cpu",
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Judgement:
    """Judge which objects a robot holds, lifts and turns.

    Args:
        bank: states that physics accepted.
        robot: the bank's robot.
        objects: the bank's objects.
        backends: engines.
        states: number of states of each object: those in the air in which the thumb and another finger are nearest to
            the object, as many from each demonstration as possible.
        squeeze: how hard fingers press, and which; default: 5 N, fingers within 1 cm.
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        progress: called with (states done, states in all).

    Raises:
        RobotError: the bank has no lifted grasp of any object.
    """
    squeeze = squeeze or SqueezeConfig(force=5.0, reach=0.01)
    height = bank.object_pos[:, 2] - bank.start_pos[bank.sequence_index, 2]
    lifted = np.flatnonzero(bank.post_contact & (height > LIFT))
    used = tuple(spec for spec in objects if spec.name in set(bank.object_name[lifted].tolist()))
    if not used:
        raise RobotError(
            f"robot {robot.name!r}: the bank has no state in which an object is in the air. Look at the reasons of "
            "xreset resets and xreset retarget."
        )
    names = [spec.name for spec in used]
    object_name = bank.object_name[lifted]
    index = np.array([names.index(name) for name in object_name.tolist()])
    arrays = (bank.joint_pos, bank.object_pos, bank.object_quat_wxyz)
    fingers = fingers_of(robot, used, object_name, *(array[lifted] for array in arrays))
    chosen = _tightest(fingers, index, bank.sequence_index[lifted], states, squeeze.reach)
    if not len(chosen):
        raise RobotError(
            f"robot {robot.name!r}: in no lifted state are the thumb and another finger within "
            f"{1e3 * squeeze.reach:g} mm of the object. Check the fingertips' frames (xreset robots check --picture), "
            "or raise --squeeze.reach."
        )
    targets = squeeze_targets(robot, fingers, bank.joint_pos[lifted], squeeze)[chosen]
    rows = lifted[chosen]
    index = index[chosen]
    present = sorted(set(index.tolist()))
    used = tuple(used[i] for i in present)
    names = [spec.name for spec in used]
    index = np.searchsorted(present, index)
    scene = SceneSpec(robot=robot, objects=used)
    joint_pos, object_pos, object_quat = (torch.as_tensor(array[rows], dtype=torch.float32) for array in arrays)
    start = State.at_rest(joint_pos, object_pos, object_quat, torch.as_tensor(targets))
    program = _Program(scene)
    ends = {}
    for number, name in enumerate(backends):
        table = probe(
            name, scene, index, start, program.play, gravity=0.0, steps=_CLOSE_STEPS, num_envs=num_envs, device=device,
            progress=lambda done, number=number: progress(number * len(rows) + done, len(backends) * len(rows)),
        )  # fmt: skip
        ends[name] = program.read(table, start)
    judged = []
    for name in backends:
        groups = {label: index == i for i, label in enumerate(names)}
        groups["all"] = np.ones(len(rows), dtype=bool)
        passed = ends[name].passed
        for label, mine in groups.items():
            counts = dict(zip(PHASES, passed[mine].sum(axis=0).tolist(), strict=True))
            fails = int((~ends[name].reached[mine]).sum())
            judged.append(Judged(backend=name, object_name=label, tried=int(mine.sum()), arm_fails=fails, **counts))
    first = ends[backends[0]]
    shots = {}
    for i, label in enumerate(names):
        mine = np.flatnonzero(index == i)
        shots[label] = first.moments(int(mine[first.passed[mine].sum(axis=1).argmax()]))
    without = sorted({*bank.object_names} - set(names))
    return Judgement(robot=robot.name, rows=tuple(judged), without=tuple(without), shots=shots)


def _tightest(fingers: Fingers, index: np.ndarray, sequence: np.ndarray, count: int, reach: float) -> np.ndarray:
    """Return rows of the states that grasp most tightly, ``count`` of each object, from its sequences in turn."""
    thumb = fingers.gap[:, fingers.finger == 0].amin(dim=-1)
    other = fingers.gap[:, fingers.finger != 0].amin(dim=-1)
    gap = torch.maximum(thumb, other).numpy()
    rank = np.zeros(len(gap), dtype=int)
    for number in np.unique(sequence):
        mine = np.flatnonzero(sequence == number)
        rank[mine[np.argsort(gap[mine], kind="stable")]] = np.arange(len(mine))
    chosen = []
    for number in np.unique(index):
        mine = np.flatnonzero((index == number) & (gap < reach))
        chosen += mine[np.lexsort((gap[mine], rank[mine]))][:count].tolist()
    return np.array(sorted(chosen), dtype=np.int64)


@dataclass(frozen=True, kw_only=True)
class _Ends:
    """Where states [M] are at the start and after each phase."""

    joint_pos: np.ndarray
    """[M, 1 + P, J]"""
    object_pos: np.ndarray
    """[M, 1 + P, 3]"""
    object_quat: np.ndarray
    """[M, 1 + P, 4]"""
    passed: np.ndarray
    """[M, P] bool"""
    reached: np.ndarray
    """[M] bool: whether the arm can raise and turn the hand."""

    def moments(self, row: int) -> list[dict[str, np.ndarray]]:
        """Return where a state is at the start and after each phase."""
        moments = []
        for i in range(len(PHASES) + 1):
            moment = (self.joint_pos[row, i], self.object_pos[row, i], self.object_quat[row, i])
            moments.append(dict(zip(("joint_pos", "object_pos", "object_quat"), moment, strict=True)))
        return moments


class _Program:
    """The motion of hand and arm, and what is recorded of it."""

    def __init__(self, scene: SceneSpec) -> None:
        self.scene = scene
        self.kinematics = Kinematics(scene.robot)
        self.arm = torch.as_tensor(scene.robot.arm_indices)

    def steps(self, seconds: float) -> int:
        """Return a number of control steps."""
        return round(seconds / self.scene.control_dt)

    def play(self, backend: Backend, start: State) -> Tensor:
        """Go through the phases; return [N, 2 + P (J + 14) + 1]: errors of the arm, joints, poses of object and palm
        after each phase, and whether the simulation is sound."""
        backend.set_object_gravity(torch.ones(backend.num_worlds, device=backend.device))
        joints = start.joint_pos.double().cpu()
        targets = start.joint_target.double().cpu()
        palm = self.kinematics.link_poses(joints, [self.scene.robot.palm])[:, 0]
        up, up_error = self.path(joints, palm, rise=HEIGHT, turn=0.0)
        turned = [self.path(up[-1], palm, rise=HEIGHT, turn=sign * TURN) for sign in (1, -1)]
        better = (turned[0][1] <= turned[1][1])[None, :, None]
        turn = torch.where(better, turned[0][0], turned[1][0])
        turn_error = torch.minimum(turned[0][1], turned[1][1])
        records = [up_error[:, None], turn_error[:, None]]
        for _ in range(self.steps(SECONDS)):
            backend.step()
        records += self.snapshot(backend)
        before = joints
        for path in (up, turn):
            self.move(backend, targets, before, path)
            records += self.snapshot(backend)
            before = path[-1]
        health = backend.health()
        sound = ~(health.nonfinite | health.overflow)
        return torch.cat([*records, sound.cpu().double()[:, None]], dim=1).float()

    def snapshot(self, backend: Backend) -> list[Tensor]:
        """Return joints, object pose and palm pose of every world."""
        state = backend.state()
        links = backend.links()
        parts = (state.joint_pos, state.object_pos, state.object_quat, links.pos[:, 0], links.quat[:, 0])
        return [part.double().cpu() for part in parts]

    def path(self, joints: Tensor, palm: Tensor, *, rise: float, turn: float) -> tuple[Tensor, Tensor]:
        """Move the palm [N, 4, 4] up and turn it about its x axis; return joints [waypoints, N, J] from ``joints`` on,
        and the error at the end as a share of what is allowed [N]."""
        quat = matrix_to_quat(palm[:, :3, :3])
        here = self.kinematics.link_poses(joints, [self.scene.robot.palm])[:, 0]
        risen = (here[:, 2, 3] - palm[:, 2, 3])[:, None]
        waypoints = []
        error = joints
        for number in range(1, _WAYPOINTS + 1):
            share = number / _WAYPOINTS
            goal = palm[:, :3, 3].clone()
            goal[:, 2:] += risen + share * (rise - risen)
            axis = goal.new_tensor([share * turn, 0.0, 0.0]).expand_as(goal)
            goal_quat = quat_multiply(quat, quat_from_axis_angle(axis))
            for _ in range(_ITERATIONS):
                at = self.kinematics.jacobian(joints, [self.scene.robot.palm])
                away = quat_multiply(goal_quat, quat_conjugate(matrix_to_quat(at.rot[:, 0])))
                error = torch.cat((goal - at.pos[:, 0], quat_to_axis_angle(quat_normalize(away))), dim=1)
                J = torch.cat((at.linear[:, 0], at.angular[:, 0]), dim=1)[..., self.arm]
                damping = 1e-4 * torch.eye(len(self.arm), dtype=J.dtype)
                step = torch.linalg.solve(J.mT @ J + damping, J.mT @ error[..., None])[..., 0]
                joints = joints.clone()
                joints[:, self.arm] += step.clamp(-0.2, 0.2)
                joints = self.kinematics.clamp(joints)
            waypoints.append(joints)
        position = error[:, :3].norm(dim=1) / _REACHED[0]
        return torch.stack(waypoints), torch.maximum(position, error[:, 3:].norm(dim=1) / _REACHED[1])

    def move(self, backend: Backend, targets: Tensor, before: Tensor, path: Tensor) -> None:
        """Move the arm's targets along waypoints; the hand's stay."""
        points = torch.cat((before[None], path))
        count = self.steps(_MOVE_SECONDS)
        for number in range(1, count + self.steps(_REST_SECONDS) + 1):
            place = min(number / count, 1.0) * len(path)
            first = min(int(place), len(path) - 1)
            between = torch.lerp(points[first], points[first + 1], place - first)
            now = targets.clone()
            now[:, self.arm] = between[:, self.arm]
            backend.set_joint_targets(now.float().to(backend.device))
            backend.step()

    def read(self, table: np.ndarray, start: State) -> _Ends:
        """Return what :meth:`play` recorded of all states."""
        joints = start.joint_pos.shape[1]
        reached = table[:, :2] < 1
        sound = table[:, -1] > 0.5
        parts = torch.as_tensor(table[:, 2:-1].reshape(len(table), len(PHASES), joints + 14)).double()
        joint_pos, object_pos, object_quat, palm_pos, palm_quat = parts.split([joints, 3, 4, 3, 4], dim=-1)
        palm = self.kinematics.link_poses(start.joint_pos.double(), [self.scene.robot.palm])
        pos, quat = _relative(
            start.object_pos[:, None].double(), start.object_quat[:, None].double(), palm[..., :3, 3],
            matrix_to_quat(palm[..., :3, :3]),
        )  # fmt: skip
        now_pos, now_quat = _relative(object_pos, object_quat, palm_pos, palm_quat)
        near = ((now_pos - pos).norm(dim=-1) < DISTANCE) & (quat_angle(now_quat, quat) < ANGLE)
        kept = near.numpy().astype(int).cumprod(axis=1) > 0
        kept[:, 1:] &= reached.astype(int).cumprod(axis=1) > 0

        def with_start(first: Tensor, later: Tensor) -> np.ndarray:
            return torch.cat((first[:, None].double(), later), dim=1).numpy()

        return _Ends(
            joint_pos=with_start(start.joint_pos, joint_pos),
            object_pos=with_start(start.object_pos, object_pos),
            object_quat=with_start(start.object_quat, object_quat),
            passed=kept & sound[:, None],
            reached=np.logical_and(reached[:, 0], reached[:, 1]),
        )


def _relative(pos: Tensor, quat: Tensor, frame_pos: Tensor, frame_quat: Tensor) -> tuple[Tensor, Tensor]:
    """Return poses in the frame of others."""
    return quat_rotate_inverse(frame_quat, pos - frame_pos), quat_multiply(quat_conjugate(frame_quat), quat)


def judge_picture(judgement: Judgement, robot: RobotSpec, objects: Sequence[ObjectSpec]) -> np.ndarray:
    """[H, W, 3] uint8: one row for each object: its best state at the start, and after each phase in the first engine,
    with the share of states that pass the phase in each engine."""
    backends = list(dict.fromkeys(row.backend for row in judgement.rows))
    by_name = {spec.name: spec for spec in objects}
    rows = []
    for name, moments in judgement.shots.items():
        renderer = Renderer(SceneSpec(robot=robot, objects=(by_name[name],)), size=_TILE, smooth=True)
        tiles = []
        for phase, moment in zip(("start", *PHASES), moments, strict=True):
            target = moment["object_pos"]
            camera = Camera(eye=tuple(target + np.array((0.42, -0.42, 0.22))), target=tuple(target))
            pose = pose_matrix(target, moment["object_quat"])
            tile = renderer.draw(moment["joint_pos"], pose, camera=camera)
            caption = [name if phase == "start" else phase]
            if phase != "start":
                caption += [f"{backend} {judgement.share(backend, name, phase):.0%}" for backend in backends]
            tiles.append(add_caption(tile, caption, 1 + len(backends)))
        rows.append(np.hstack(tiles))
    return np.vstack(rows)
