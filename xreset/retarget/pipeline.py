"""From human demonstrations to robot trajectories: contacts, hand, arm, validity (the paper, appendix D.b)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from xreset.demos.align import grounded, levelled
from xreset.demos.archive import Demos
from xreset.errors import DemoError
from xreset.geometry.fields import DistanceFields
from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.surface import Surface, keypoint_contacts
from xreset.retarget.arm.solve import ArmConfig, ArmModel, ArmTargets, track
from xreset.retarget.file import SCHEMA, Retargeted, read_retargeted, write_retargeted
from xreset.retarget.hand.config import HandConfig
from xreset.retarget.hand.model import HandModel
from xreset.retarget.hand.solve import HandMotion, HandTargets, retarget_hand
from xreset.retarget.partial import Batch, Partial, run_key
from xreset.retarget.validity import REASONS, Thresholds, classify
from xreset.spec import ObjectSpec, RobotSpec
from xreset.tensors import one_thread

__all__ = [
    "SCHEMA",
    "RetargetConfig",
    "Retargeted",
    "read_retargeted",
    "rest_on_table",
    "retarget_demos",
    "write_retargeted",
]

_SEQUENCES_PER_BATCH = 24
"""Enough to make batching pay; few enough to keep memory below about 1 GB and progress visible."""


@dataclass(frozen=True, kw_only=True)
class RetargetConfig:
    """Everything that decides the result, besides robot, objects and demonstrations."""

    hand: HandConfig = field(default_factory=HandConfig)
    arm: ArmConfig = field(default_factory=ArmConfig)
    thresholds: Thresholds = field(default_factory=Thresholds)
    contact_distance: float = 0.020
    """A human keypoint nearer than this to the object's surface touches it [m]."""


@dataclass(kw_only=True)
class Timing:
    """Wall time spent [s]; batches that an earlier run has finished do not count."""

    hand: float = 0.0
    arm: float = 0.0


def rest_on_table(demos: Demos, objects: Sequence[ObjectSpec]) -> Demos:
    """The demonstrations over a level table on which each object rests in its first frame (the paper, appendix D.a).

    Raises:
        DemoError: an object of the demonstrations is not among ``objects``.
    """
    return grounded(levelled(demos), _by_name(demos, objects))


def retarget_demos(
    demos: Demos,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    config: RetargetConfig | None = None,
    *,
    progress: Callable[[float, int], None] = lambda done, total: None,
    partial: Path | None = None,
    timing: Timing | None = None,
    device: str = "cpu",
) -> Retargeted:
    """Retarget demonstrations; sequences are independent of one another, and the result depends on nothing but the arguments.

    With ``partial``, every finished batch of sequences is kept in that folder, and a second call with the same other arguments goes on
    from there, to the same result, bit by bit. Whoever has the result calls :func:`xreset.retarget.partial.discard`.

    Args:
        demos: human demonstrations; they need not rest on the table yet.
        objects: geometry of every object that the demonstrations name.
        progress: called with (sequences done, sequences in all).
        partial: folder for what is finished, made when needed; batches in it that other arguments made are not used.
        timing: to add the time spent to.
        device: where hand retargeting runs; the arm runs on the CPU.

    Returns:
        Trajectories of every sequence; a sequence whose hand was never annotated stays at home, without a valid frame.

    Raises:
        DemoError: an object of the demonstrations is not among ``objects``.
        RobotError: the robot's description does not allow retargeting.
    """
    config = config or RetargetConfig()
    work = _Work(demos, objects, config)
    demos, hand, arm = work.demos, HandModel(robot, device=device), ArmModel(robot)
    kept = None
    if partial is not None:
        kept = Partial(
            partial, run_key(demos, robot, list(work.objects.values()), config, _SEQUENCES_PER_BATCH, device)
        )
    joint_pos = np.tile(robot.home, (demos.num_frames, 1))
    reason = np.full(demos.num_frames, REASONS.index("not annotated"), dtype=np.int32)
    hand_error, wrist_error = np.full(demos.num_frames, np.inf), np.full(demos.num_frames, np.inf)
    for number, (sequences, report) in enumerate(work.batches(progress)):
        solved = kept.read(number) if kept else None
        if solved is None:
            targets = work.hand_targets(hand, sequences)
            with one_thread():
                solved = _solve(demos, sequences, hand, arm, targets, config, report, timing or Timing())
            if kept:
                kept.write(number, solved)
        rows = np.concatenate([np.arange(demos.num_frames)[demos.frames(i)] for i in sequences])
        joint_pos[rows], reason[rows] = solved.joint_pos, solved.reason
        hand_error[rows], wrist_error[rows] = solved.hand_error, solved.wrist_error
        report(1.0)

    links = arm.kinematics.link_poses(torch.as_tensor(joint_pos), robot.tracked_links)
    contact = np.asarray(work.touches.any(axis=1))
    return Retargeted(
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        sequence_name=demos.sequence_name,
        object_name=demos.object_name,
        hand_side=demos.hand_side,
        frame_offsets=demos.frame_offsets,
        fps=demos.fps,
        joint_names=robot.joint_names,
        joint_pos=joint_pos,
        palm_pos=links[:, 0, :3, 3].numpy(),
        palm_quat_wxyz=matrix_to_quat(links[:, 0, :3, :3]).numpy(),
        fingertip_names=robot.fingertip_names,
        fingertip_pos=links[:, 1:, :3, 3].numpy(),
        object_pos=demos.object_pos.astype(np.float64),
        object_quat_wxyz=demos.object_quat_wxyz.astype(np.float64),
        goal_pos=demos.goal_pose[0].astype(np.float64),
        goal_quat_wxyz=demos.goal_pose[1].astype(np.float64),
        annotated=demos.hand_valid,
        valid=reason == 0,
        reason=reason,
        reason_names=REASONS,
        contact=contact,
        first_contact=np.array([_first(contact[demos.frames(i)]) for i in range(demos.num_sequences)], dtype=np.int32),
        hand_error=hand_error,
        wrist_error=wrist_error,
    )


def hand_motions(
    demos: Demos,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    config: RetargetConfig | None = None,
    *,
    device: str = "cpu",
    progress: Callable[[float, int], None] = lambda done, total: None,
) -> Iterator[tuple[list[int], HandTargets, HandMotion]]:
    """Hand retargeting alone, in batches: which sequences, what the hand was to follow, what it does. Arguments as in :func:`retarget`."""
    config = config or RetargetConfig()
    work, hand = _Work(demos, objects, config), HandModel(robot, device=device)
    for sequences, report in work.batches(progress):
        targets = work.hand_targets(hand, sequences)
        with one_thread():
            motion = retarget_hand(hand, targets, config.hand, report)
        yield sequences, targets, motion


def wrist_paths(
    demos: Demos,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    config: RetargetConfig | None = None,
    *,
    progress: Callable[[float, int], None] = lambda done, total: None,
) -> list[ArmTargets]:
    """What hand retargeting asks of the arm, in batches of sequences. Arguments and errors as in :func:`retarget`."""
    hand, arm = HandModel(robot), ArmModel(robot)
    motions = hand_motions(demos, robot, objects, config, progress=progress)
    return [_arm_targets(hand, arm, targets, motion) for _, targets, motion in motions]


def _by_name(demos: Demos, objects: Sequence[ObjectSpec]) -> dict[str, ObjectSpec]:
    by_name = {spec.name: spec for spec in objects}
    if missing := sorted(set(demos.object_name.tolist()) - set(by_name)):
        raise DemoError(
            f"the demonstrations hold objects that were not given: {', '.join(missing)}; given were {', '.join(by_name)}."
        )
    return {name: by_name[name] for name in sorted(set(demos.object_name.tolist()))}


class _Work:
    """Demonstrations on the table, what their hands touch, and the batches in which they are retargeted."""

    def __init__(self, demos: Demos, objects: Sequence[ObjectSpec], config: RetargetConfig) -> None:
        self.objects = _by_name(demos, objects)
        self.demos = demos = rest_on_table(demos, objects)
        self._surfaces = {name: Surface(spec) for name, spec in self.objects.items()}
        self._touched, self.touches = np.zeros((demos.num_frames, 21, 3)), np.zeros((demos.num_frames, 21), dtype=bool)
        """Contact points [F, 21, 3] and contact [F, 21] of all human keypoints."""
        for i, name in enumerate(demos.object_name.tolist()):
            rows = demos.frames(i)
            keypoints = np.where(
                demos.hand_valid[rows, None, None], demos.hand_keypoints[rows].astype(np.float64), np.nan
            )
            pos, quat = demos.object_pos[rows].astype(np.float64), demos.object_quat_wxyz[rows].astype(np.float64)
            contacts = keypoint_contacts(self._surfaces[name], keypoints, pos, quat, config.contact_distance)
            self._touched[rows], self.touches[rows] = contacts

    def batches(self, progress: Callable[[float, int], None]) -> Iterator[tuple[list[int], Callable[[float], None]]]:
        """Sequences that have a hand, some at a time, each time with a function that takes the share of them that is done."""
        todo = [i for i in range(self.demos.num_sequences) if self.demos.hand_valid[self.demos.frames(i)].any()]
        for begin in range(0, len(todo), _SEQUENCES_PER_BATCH):
            sequences = todo[begin : begin + _SEQUENCES_PER_BATCH]

            def report(share: float, start: int = begin, size: int = len(sequences)) -> None:
                progress(start + share * size, len(todo))

            yield sequences, report

    def hand_targets(self, hand: HandModel, sequences: Sequence[int]) -> HandTargets:
        """Targets of some sequences, padded with frames that are not annotated."""
        demos = self.demos
        keypoints = np.where(demos.hand_valid[:, None, None], demos.hand_keypoints, 0.0)[:, hand.keypoint_indices]

        def padded(values: np.ndarray) -> Tensor:
            rows = [demos.frames(i) for i in sequences]
            out = np.zeros(
                (len(rows), max(row.stop - row.start for row in rows), *values.shape[1:]), dtype=values.dtype
            )
            for s, row in enumerate(rows):
                out[s, : row.stop - row.start] = values[row]
            return torch.as_tensor(out)

        return HandTargets(
            keypoints=padded(keypoints.astype(np.float64)),
            annotated=padded(demos.hand_valid),
            contact_points=padded(self._touched[:, hand.keypoint_indices]),
            in_contact=padded(self.touches[:, hand.keypoint_indices]),
            held=padded(
                np.asarray(self.touches[:, 1:5].any(axis=1) & self.touches[:, 5:].any(axis=1))
            ),  # keypoints of the thumb: 1 to 4
            object_pos=padded(demos.object_pos.astype(np.float64)),
            object_quat=padded(demos.object_quat_wxyz.astype(np.float64)),
            object_index=torch.tensor(
                [list(self._surfaces).index(name) for name in demos.object_name[list(sequences)].tolist()]
            ),
            fields=DistanceFields.join([surface.field for surface in self._surfaces.values()]),
        )


def _solve(
    demos: Demos,
    sequences: Sequence[int],
    hand: HandModel,
    arm: ArmModel,
    targets: HandTargets,
    config: RetargetConfig,
    progress: Callable[[float], None],
    timing: Timing,
) -> Batch:
    """Hand, arm and validity of some sequences; ``targets`` are theirs."""
    started = perf_counter()
    motion = retarget_hand(hand, targets, config.hand, lambda share: progress(0.5 * share))
    arm_targets = _arm_targets(hand, arm, targets, motion)
    between = perf_counter()
    joints, measures = track(arm, arm_targets, config.thresholds, config.arm, lambda share: progress(0.5 + 0.5 * share))
    timing.hand += between - started
    timing.arm += perf_counter() - between
    lengths = [rows.stop - rows.start for rows in map(demos.frames, sequences)]

    def unpadded(values: Tensor) -> np.ndarray:
        return torch.cat([values[s, :length] for s, length in enumerate(lengths)]).numpy()

    return Batch(
        joint_pos=unpadded(arm.full(joints, arm_targets.hand_joints)),
        reason=unpadded(classify(measures, config.thresholds)),
        hand_error=unpadded(arm_targets.hand_error.masked_fill(~targets.annotated, np.inf)),
        wrist_error=unpadded(measures.wrist_position.masked_fill(~targets.annotated, np.inf)),
    )


def _arm_targets(hand: HandModel, arm: ArmModel, targets: HandTargets, motion: HandMotion) -> ArmTargets:
    """What a hand's motion asks of the arm."""
    return ArmTargets(
        root_pos=motion.root_pos,
        root_quat=motion.root_quat,
        hand_joints=motion.joints,
        annotated=targets.annotated,
        hand_error=(motion.keypoints - targets.keypoints)[:, :, hand.is_tip.cpu()].norm(dim=-1).mean(-1),
        hand_clearance=arm.hand_clearance(motion.joints),
    )


def _first(flags: np.ndarray) -> int:
    return int(flags.argmax()) if flags.any() else -1
