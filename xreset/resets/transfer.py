"""More states at poses of a demonstration, in grasps of other demonstrations of the same object.

Where the retargeting of a demonstration fails, often at its goal, the bank has no state. Grasps of other demonstrations
may hold the object there. Such a grasp, hand and object together, is moved to the pose, and the arm's inverse
kinematics finds the arm's joints. The state is kept if the robot is then no deeper in the object than retargeting
allows, and the hand holds the object at its full weight in every engine of the bank.

Shape letters: L states of the bank, J joints, W poses of demonstrations, M candidates (each a grasp at a pose).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from xreset.files.processes import batches
from xreset.files.progress import Progress
from xreset.geometry.collision import object_depth
from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.shapes import turn_of
from xreset.physics import Backend, State
from xreset.resets.bank import ResetBank
from xreset.resets.config import TransferConfig
from xreset.resets.grasps import carried
from xreset.resets.probe import rejections, stays
from xreset.retarget.arm.config import QUICK
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import track_each
from xreset.retarget.file import Retargeted
from xreset.retarget.validity import Thresholds, classify
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec, objects_named

# These limits were measured together (docs/lab-book.md, "Grasps of other demonstrations"), and none was varied.
_RAISED = 0.03
"""Poses are those of frames in which the object is raised by more than this [m]."""
_THRESHOLDS = Thresholds(wrist_position=0.005, wrist_orientation=float(np.radians(3.0)))
"""How exactly the arm must carry the hand: a grasp holds as long as the hand keeps its place at the object. At these
limits the hand may have come deep into the object."""
_STEPS = 30
"""Control steps of 1/60 s for which the hand must hold the object: 99 % of the states that hold for so long hold for
5 s."""
_MOVED = 0.02
"""Farthest that a held object may move in this time [m]."""
_TURNED = float(np.radians(15.0))
"""Farthest that a held object may turn in this time [rad]."""
_POSES = 4
"""Most poses of each demonstration: evenly from the first frame in which the object is raised to the last, usually the
goal."""
_CANDIDATES = 40
"""Most grasps that are tried at each pose."""
_SPARE = 2
"""Candidates that are tried at a time at each pose, beyond the states that it lacks: some do not hold."""
_SEED = 0
"""Seed of the grasps that are drawn."""
_BATCH = 512
"""Candidates whose inverse kinematics is solved at a time, at most; limits the memory that this takes."""
_SMALL_BATCH = 64
"""Candidates up to which one batch takes less time than a second process takes to start."""


def add_transfers(
    bank: ResetBank,
    retargeted: Retargeted,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    config: TransferConfig,
    *,
    num_envs: int,
    device: str,
    progress: Progress,
) -> ResetBank:
    """Return a bank with more states: grasps of other demonstrations of the same object, at poses of each
    demonstration. The arguments determine the result.

    The new states come after those of the bank, and :attr:`ResetBank.transferred` marks them. The hand keeps the joints
    and the drive targets of the grasp, and its place at the object. An object of which the bank has a single
    demonstration gets no state, and so does a bank without a state that presses on an object in the air.

    Args:
        bank: made from ``retargeted``. The hand must hold the object in every engine of the bank.
        retargeted: the motion.
        robot: the robot of both.
        objects: the objects of both.
        config: how many states.
        num_envs: worlds at a time.
        device: where engines run that can use it; the others run on the CPU.
        progress: called with what is done and what is to be done in all.
    """
    grasps = np.flatnonzero(carried(bank, robot, objects))
    if not len(grasps):
        return bank
    poses = _raised_frames(retargeted, objects)
    pose, grasp = _candidates(bank, grasps, retargeted.sequence_of_frame[poses])
    used = objects_named(objects, bank.object_name[grasp])
    scene = SceneSpec(robot=robot, objects=tuple(used.values()))
    place = np.arange(len(pose)) - np.searchsorted(pose, pose)
    rows = [np.zeros(0, dtype=int)]
    states = []
    depths = []
    each = 1 + len(bank.engines)
    work = len(pose) * each
    until = np.zeros(len(poses), dtype=int)  # candidates of each pose that have been tried
    before = 0
    while True:
        missing = config.per_pose - np.bincount(pose[np.concatenate(rows)], minlength=len(poses))
        more = np.where(missing > 0, missing + _SPARE, 0)
        tried = np.flatnonzero((place >= until[pose]) & (place < (until + more)[pose]))
        if not len(tried):
            break
        until += more
        share = len(tried) * each
        holding, held, depth = _holding(
            bank,
            grasp[tried],
            retargeted,
            poses[pose[tried]],
            scene,
            num_envs=num_envs,
            device=device,
            progress=lambda part, before=before, share=share: progress(before + share * part, work),
        )
        before += share
        rows.append(tried[held])
        states.append(holding)
        depths.append(depth)
    progress(work, work)
    if not states:
        return replace(bank, transferred=np.zeros(bank.num_states, dtype=bool))
    order = np.argsort(np.concatenate(rows))
    held = np.concatenate(rows)[order]
    kept = _first_of_each(held, pose, config.per_pose)
    chosen = order[np.searchsorted(held, kept)]
    added = State.cat(states)[torch.as_tensor(chosen)]
    return _joined(bank, added, retargeted, poses[pose[kept]], np.concatenate(depths)[chosen])


def _holding(
    bank: ResetBank,
    grasp: np.ndarray,
    retargeted: Retargeted,
    frame: np.ndarray,
    scene: SceneSpec,
    *,
    num_envs: int,
    device: str,
    progress: Callable[[float], None],
) -> tuple[State, np.ndarray, np.ndarray]:
    """Try grasps at poses; arguments as of :func:`add_transfers` and :func:`_carried`.

    Returns:
        The states in which the arm reaches the grasp, the robot is not deep in the object and the hand holds it in
        every engine; their candidates, ascending; and how deep the robot is in the object [m].
    """
    count = len(grasp)
    engines = len(bank.engines)
    names = bank.object_name[grasp]
    states, is_reached = _carried(
        bank,
        grasp,
        retargeted,
        frame,
        scene.robot,
        lambda done: progress(done / count / (1 + engines)),
    )
    held = np.flatnonzero(is_reached)
    depth = np.full(count, np.inf)
    depth[held] = _depth(scene, names[held], states[held])
    held = np.flatnonzero(depth <= _THRESHOLDS.object_depth)
    lost = rejections(
        bank.engines,
        scene,
        names[held],
        states[torch.as_tensor(held)],
        _lost,
        gravity=1.0,
        steps=_STEPS,
        num_envs=num_envs,
        device=device,
        progress=lambda done, work: progress((1 + engines * done / work) / (1 + engines)),
    )
    held = held[lost < 0]
    return states[torch.as_tensor(held)], held, depth[held]


def _raised_frames(retargeted: Retargeted, objects: Sequence[ObjectSpec]) -> np.ndarray:
    """[W] some frames of every demonstration, evenly spread over those in which the object is raised. The last one is
    the goal if the object is raised there."""
    chosen = []
    is_raised = retargeted.shift(objects)[:, 2] > _RAISED
    for number in range(len(retargeted.sequence_name)):
        frames = retargeted.frames(number)
        raised = np.flatnonzero(is_raised[frames])
        spread = np.linspace(0, len(raised) - 1, min(_POSES, len(raised)))
        chosen += (frames.start + raised[spread.astype(int)]).tolist()
    return np.array(chosen, dtype=int)


def _candidates(
    bank: ResetBank, grasps: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Draw grasps of other demonstrations for each pose of a demonstration ``owner`` [W]: pose [M], ascending, and
    state of the bank [M]."""
    random = np.random.default_rng(_SEED)
    pose = []
    grasp = []
    for number, sequence in enumerate(owner):
        same_object = bank.object_name[grasps] == bank.sequence_object[sequence]
        others = grasps[same_object & (bank.sequence_index[grasps] != sequence)]
        drawn = random.permutation(others)[:_CANDIDATES]
        pose += [number] * len(drawn)
        grasp += drawn.tolist()
    return np.array(pose, dtype=int), np.array(grasp, dtype=int)


def _carried(
    bank: ResetBank,
    grasp: np.ndarray,
    retargeted: Retargeted,
    frame: np.ndarray,
    robot: RobotSpec,
    progress: Callable[[int], None],
) -> tuple[State, np.ndarray]:
    """Move grasps, hand and object together, to poses.

    Args:
        bank: the bank that has the grasps.
        grasp: [M] state of the bank.
        retargeted: the motion.
        frame: [M] frame of the motion to whose pose the object is brought.
        robot: the robot.
        progress: called with the number of candidates done.

    Returns:
        States [M] at rest, and whether the arm reaches each of them [M].
    """
    model = ArmModel(robot)
    pos = retargeted.object_pos[frame]
    quat = retargeted.object_quat_wxyz[frame]
    joint_pos = bank.joint_pos[grasp].astype(float)
    root = model.kinematics.link_poses(torch.as_tensor(joint_pos), [robot.hand_root])[:, 0].numpy()
    turn = turn_of(quat) * turn_of(bank.object_quat_wxyz[grasp]).inv()
    root_pos = pos + turn.apply(root[:, :3, 3] - bank.object_pos[grasp])
    root_turn = turn * Rotation.from_matrix(root[:, :3, :3])
    root_quat = matrix_to_quat(torch.as_tensor(root_turn.as_matrix()))
    hand_joints = torch.as_tensor(joint_pos[:, model.hand.joint_indices])
    parts = batches(np.arange(len(grasp)), small=_SMALL_BATCH, most=_BATCH)
    paths = [
        ArmTargets.of_poses(
            torch.as_tensor(root_pos[rows]), root_quat[rows], hand_joints[rows, None]
        )
        for rows in parts
    ]
    solved = track_each(robot, paths, _THRESHOLDS, QUICK)
    is_reached = np.zeros(len(grasp), dtype=bool)
    for rows, (arm, measures) in zip(parts, solved, strict=True):
        joint_pos[rows[:, None], robot.arm_indices] = arm[:, 0].numpy()
        is_reached[rows] = (classify(measures, _THRESHOLDS) == 0)[:, 0].numpy()
        progress(int(rows[-1]) + 1)
    joint_target = joint_pos.copy()
    joint_target[:, robot.hand_indices] = bank.targets[grasp][:, robot.hand_indices]
    arrays = (joint_pos, pos, quat, joint_target)
    return State.at_rest(*map(torch.as_tensor, arrays)), is_reached


def _depth(scene: SceneSpec, object_name: np.ndarray, states: State) -> np.ndarray:
    """[M] depth of the robot in the object of states [m]."""
    poses = (states.joint_pos, states.object_pos, states.object_quat)
    arrays = [tensor.numpy() for tensor in poses]
    return object_depth(scene.robot, scene.objects, object_name, *arrays)


def _lost(backend: Backend, start: State) -> Tensor:
    """[N] -1 where the object of a world is where it was at the start, else 0."""
    return torch.where(stays(backend, start, moved=_MOVED, turned=_TURNED), -1, 0)


def _first_of_each(rows: np.ndarray, group: np.ndarray, count: int) -> np.ndarray:
    """Return the first ``count`` rows of each group; ``rows`` and ``group[rows]`` ascend."""
    groups = group[rows]
    place = np.arange(len(rows)) - np.searchsorted(groups, groups)
    return rows[place < count]


def _joined(
    bank: ResetBank, states: State, retargeted: Retargeted, frame: np.ndarray, depth: np.ndarray
) -> ResetBank:
    """Return the bank with states [M] at poses of frames [M] after its own; ``depth`` [M] is that of the robot in the
    object."""
    count = len(frame)
    sequence = retargeted.sequence_of_frame[frame]
    within = frame - retargeted.frame_offsets[sequence]
    added = {
        "joint_pos": states.joint_pos.numpy(),
        "joint_target": states.joint_target.numpy(),
        "object_pos": states.object_pos.numpy(),
        "object_quat_wxyz": states.object_quat.numpy(),
        "object_name": bank.sequence_object[sequence],
        "sequence_index": sequence.astype(bank.sequence_index.dtype),
        "frame_index": within.astype(bank.frame_index.dtype),
        "post_contact": np.ones(count, dtype=bool),
        "object_depth": depth.astype(np.float32),
        "transferred": np.ones(count, dtype=bool),
    }
    own = {name: getattr(bank, name) for name in added}
    own["transferred"] = np.zeros(bank.num_states, dtype=bool)
    if bank.frame_part is not None:
        own["frame_part"] = bank.frame_part
        added["frame_part"] = np.zeros(count, dtype=np.float32)
    joined = {name: np.concatenate((own[name], values)) for name, values in added.items()}
    return replace(bank, **joined)
