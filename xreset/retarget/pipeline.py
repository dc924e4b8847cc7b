"""Retarget human demonstrations to robot trajectories: contacts, hand, arm, validity (the paper, appendix D.b).

Shape letters: F frames of all sequences, S sequences of a batch padded to T frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from xreset.demos.archive import Demos, rest_on_table
from xreset.demos.examine import human_contacts
from xreset.files.checks import Checked, frozen
from xreset.files.processes import batches, in_processes
from xreset.files.progress import Progress, unseen
from xreset.geometry.collision import ObjectCollision, object_depth
from xreset.geometry.fields import DistanceFields
from xreset.geometry.rotations import matrix_to_quat, quat_to_matrix
from xreset.geometry.surface import prepared_surface
from xreset.physics.tensors import one_thread
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmModel, ArmTargets, arm_jump
from xreset.retarget.arm.solve import track_each
from xreset.retarget.file import Retargeted
from xreset.retarget.hand.clearance import contact_distance
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.model import HandModel, HandState, HandTargets
from xreset.retarget.hand.solve import retarget_hand
from xreset.retarget.push import pushed_out
from xreset.retarget.validity import REASONS, Thresholds, classify, too_deep
from xreset.spec import ObjectSpec, RobotSpec, objects_named

_SEQUENCES_PER_BATCH = 45
"""At most: enough to use the processor well; few enough to keep memory below about 1 GB and to show progress."""
_SMALL_BATCH = 10
"""Sequences up to which one batch takes less time than a second process takes to start."""
_FRAMES_AT_ONCE = 512
"""Frames whose measures are taken at a time; limits the memory that this takes."""
_THRESHOLDS = Thresholds()
"""Limits of a valid frame."""
_THUMB = slice(1, 5)
"""Keypoints of the thumb."""
_FINGERS = slice(5, None)
"""Keypoints of the other fingers."""


@frozen
class RetargetConfig(Checked):
    """Options and constants of retargeting. With robot, objects and demonstrations they determine the result."""

    hand: HandWeights = HandWeights()
    arm: ArmSearch = ArmSearch()


def follow(
    demos: Demos,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    config: RetargetConfig = RetargetConfig(),
    *,
    progress: Progress = unseen,
    device: str = "cpu",
) -> Retargeted:
    """Return the robot's motion that follows demonstrations; see :func:`xreset.retarget.verbs.retarget_demos`."""
    hands = HandMotions(demos, robot, objects, config, device=device)
    demos = hands.demos
    arm = ArmModel(robot)
    count = demos.num_frames
    frames = _Frames(
        joint_pos=np.tile(robot.home, (count, 1)),
        root_pos=np.zeros((count, 3)),
        root_quat=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        reason=np.full(count, REASONS.index("not annotated"), dtype=np.int32),
        hand_error=np.full(count, np.inf),
        wrist_error=np.full(count, np.inf),
        object_depth=np.full(count, np.inf),
    )
    batches = list(hands.batches(lambda done, total: progress(done / 2, total)))
    paths = [_arm_targets(hands.model, arm, batch.targets, batch.motion) for batch in batches]
    followed = track_each(robot, paths, _THRESHOLDS, config.arm)
    total = sum(len(path.annotated) for path in paths)
    done = total / 2
    for batch, path, (joints, measures) in zip(batches, paths, followed, strict=True):
        rows = batch.rows
        is_frame = batch.is_frame
        done += len(path.annotated) / 2
        progress(done, total)
        frames.joint_pos[rows] = arm.full(joints, path.hand_joints)[is_frame]
        frames.root_pos[rows] = path.root_pos[is_frame]
        frames.root_quat[rows] = path.root_quat[is_frame]
        frames.reason[rows] = classify(measures, _THRESHOLDS)[is_frame]
        frames.hand_error[rows] = path.hand_error[is_frame]
        frames.wrist_error[rows] = measures.wrist_position[is_frame]
    seen = demos.hand_valid
    frames.hand_error[~seen] = np.inf
    frames.wrist_error[~seen] = np.inf
    frames.object_depth[seen] = object_depth(
        robot,
        objects,
        demos.object_name[demos.sequence_of_frame[seen]],
        frames.joint_pos[seen],
        demos.object_pos[seen],
        demos.object_quat_wxyz[seen],
    )
    _push_out(frames, hands, arm)
    reason = too_deep(frames.reason, frames.object_depth, _THRESHOLDS)

    joint_pos = frames.joint_pos
    links = arm.kinematics.link_poses(torch.as_tensor(joint_pos), robot.tracked_links)
    contact_error = hands.contact_error(arm, joint_pos)
    contact = np.asarray(hands.touching.any(axis=1))
    goal_pos, goal_quat = demos.goal_pose
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
        object_pos=demos.object_pos,
        object_quat_wxyz=demos.object_quat_wxyz,
        goal_pos=goal_pos,
        goal_quat_wxyz=goal_quat,
        annotated=demos.hand_valid,
        valid=reason == 0,
        reason=reason,
        reason_names=REASONS,
        contact=contact,
        first_contact=_first_contact(demos, contact),
        hand_error=frames.hand_error,
        wrist_error=frames.wrist_error,
        contact_error=contact_error,
        object_depth=frames.object_depth,
    )


@dataclass
class _Frames:
    """The robot in all frames, and measures that decide which are valid. The arrays change in place."""

    joint_pos: np.ndarray
    """[F, J]"""
    root_pos: np.ndarray
    """[F, 3] target of the hand root's position."""
    root_quat: np.ndarray
    """[F, 4] target of its orientation."""
    reason: np.ndarray
    """[F] index into :data:`REASONS`, without depths in the object."""
    hand_error: np.ndarray
    """[F]"""
    wrist_error: np.ndarray
    """[F]"""
    object_depth: np.ndarray
    """[F]"""


@one_thread()
def _push_out(frames: _Frames, hands: HandMotions, arm: ArmModel) -> None:
    """Push the robot out of the object in frames that are too deep and otherwise valid, where this makes them valid."""
    limit = _THRESHOLDS.object_depth
    rows = np.flatnonzero((frames.reason == 0) & (frames.object_depth > limit))
    demos = hands.demos
    pos = torch.as_tensor(demos.object_pos[rows])
    rot = quat_to_matrix(torch.as_tensor(demos.object_quat_wxyz[rows]))
    index = torch.as_tensor(hands.object_index[demos.sequence_of_frame[rows]])
    collision = ObjectCollision(arm.kinematics, hands.objects)
    before = torch.as_tensor(frames.joint_pos[rows])
    joints, depth = pushed_out(arm.kinematics, collision, before, index, pos, rot, limit)

    hand_joints = joints[:, None, torch.as_tensor(arm.hand.joint_indices)]
    root_pos = torch.as_tensor(frames.root_pos[rows])
    root_quat = torch.as_tensor(frames.root_quat[rows])
    targets = replace(
        ArmTargets.of_poses(root_pos, root_quat, hand_joints),
        hand_error=hands.fingertip_error(arm, joints, rows)[:, None],
        hand_clearance=arm.hand_clearance(hand_joints),
    )
    measures = arm.problem(targets, _THRESHOLDS).measures(joints[:, None, arm.arm])
    good = ((classify(measures, _THRESHOLDS)[:, 0] == 0) & (depth <= limit)).numpy()
    rows = rows[good]
    frames.joint_pos[rows] = joints[good]
    frames.object_depth[rows] = depth[good]
    frames.hand_error[rows] = measures.hand_error[good, 0]
    frames.wrist_error[rows] = measures.wrist_position[good, 0]

    has_next = demos.hand_valid.copy()
    has_next[demos.frame_offsets[1:] - 1] = False
    arm_joints = torch.as_tensor(frames.joint_pos[:, arm.robot.arm_indices])
    jump = arm_jump(arm_joints, torch.as_tensor(has_next)).numpy()
    jumps = (frames.reason == 0) & (jump > _THRESHOLDS.arm_jump)
    frames.reason[jumps] = REASONS.index("arm jump")


def _first_contact(demos: Demos, contact: np.ndarray) -> np.ndarray:
    """Return the first frame [S] within each sequence that has ``contact`` [F]; -1 if no frame has."""
    first = np.full(len(demos), -1, dtype=np.int32)
    for sequence in range(len(demos)):
        own = contact[demos.frames(sequence)]
        if own.any():
            first[sequence] = own.argmax()
    return first


def wrist_paths(
    demos: Demos,
    robot: RobotSpec,
    objects: Sequence[ObjectSpec],
    *,
    progress: Progress = unseen,
) -> list[ArmTargets]:
    """Return the paths of the hand root that the arm has to follow, in batches. Arguments and errors as in
    :func:`follow`."""
    hands = HandMotions(demos, robot, objects)
    arm = ArmModel(robot)
    return [
        _arm_targets(hands.model, arm, batch.targets, batch.motion)
        for batch in hands.batches(progress)
    ]


class HandMotions:
    """Demonstrations on the table, the contacts of the human hands, and the robot hand's motions that follow them."""

    def __init__(
        self,
        demos: Demos,
        robot: RobotSpec,
        objects: Sequence[ObjectSpec],
        config: RetargetConfig = RetargetConfig(),
        *,
        device: str = "cpu",
    ) -> None:
        """Find the contacts; arguments and errors as of :func:`follow`."""
        self.model = HandModel(robot, device=device)
        """The robot's hand."""
        self._config = config
        named = objects_named(objects, demos.object_names)
        surfaces = {name: prepared_surface(spec) for name, spec in named.items()}
        self.objects = tuple(named.values())
        """The objects of the demonstrations."""
        _, self.object_index = np.unique(demos.object_name, return_inverse=True)
        """[S] index of the object of each sequence."""
        self._fields = DistanceFields.join([surface.field for surface in surfaces.values()])
        self.demos = demos = rest_on_table(demos, objects)
        self._contact_points, self.touching = human_contacts(demos, surfaces)
        """Contact points [F, 21, 3] of the human keypoints, and whether each keypoint [F, 21] touches the object."""
        self._keypoints = np.where(demos.hand_valid[:, None, None], demos.hand_keypoints, 0.0)

    def batches(self, progress: Progress = unseen) -> Iterator[HandBatch]:
        """Retarget the hand alone, in batches of sequences with an annotated hand; on the CPU, on all cores."""
        owner = self.demos.sequence_of_frame
        lengths = np.diff(self.demos.frame_offsets)
        todo = np.unique(owner[self.demos.hand_valid])
        parts = []
        for sequences in batches(todo, small=_SMALL_BATCH, most=_SEQUENCES_PER_BATCH):
            rows = np.flatnonzero(np.isin(owner, sequences))
            is_frame = np.arange(lengths[sequences].max()) < lengths[sequences, None]
            parts.append((rows, is_frame, self._targets(sequences, rows, is_frame)))
        compute = in_processes if self.model.device.type == "cpu" else map
        follow_hand = partial(
            _hand_motion, self.model.robot, str(self.model.device), self._config.hand
        )
        motions = compute(follow_hand, [targets for _, _, targets in parts])
        done = 0
        for (rows, is_frame, targets), motion in zip(parts, motions, strict=True):
            yield HandBatch(rows, is_frame, targets, motion)
            done += len(is_frame)
            progress(done, len(todo))

    @one_thread()
    def contact_error(self, arm: ArmModel, joint_pos: np.ndarray) -> np.ndarray:
        """[F] mean distance between the points that keypoints touch and the surfaces of the links that follow them [m],
        infinite where none touches, for a robot with this hand and its joints [F, J]."""
        error = np.full(len(joint_pos), np.inf)
        model = self.model
        some = self.touching[:, model.keypoint_indices].any(axis=1)
        touching = np.flatnonzero(some & self.demos.hand_valid)
        for first in range(0, len(touching), _FRAMES_AT_ONCE):
            rows = touching[first : first + _FRAMES_AT_ONCE]
            joints = torch.as_tensor(joint_pos[rows])
            root = arm.kinematics.link_poses(joints, [model.robot.hand_root])[:, 0]
            state = HandState(
                joints=joints[:, torch.as_tensor(model.kinematics.joint_indices)],
                root_pos=root[:, :3, 3],
                root_quat=matrix_to_quat(root[:, :3, :3]),
            ).to(model.device)
            touched = torch.as_tensor(self._contact_points[rows][:, model.keypoint_indices])
            gap = contact_distance(model, model.bodies(state), touched.to(model.device))
            where = self.touching[rows][:, model.keypoint_indices]
            error[rows] = gap.cpu().numpy().mean(axis=1, where=where)
        return error

    def fingertip_error(self, arm: ArmModel, joint_pos: Tensor, rows: np.ndarray) -> Tensor:
        """[B] mean distance of the fingertips from the human's in frames ``rows`` [B], for a robot with this hand and
        its joints [B, J] [m]."""
        tips = np.flatnonzero(self.model.is_tip.cpu())
        links = [self.model.keypoint_links[tip] for tip in tips]
        human = torch.as_tensor(self._keypoints[rows][:, self.model.keypoint_indices[tips]])
        return (arm.kinematics.points(joint_pos, links) - human).norm(dim=-1).mean(dim=-1)

    def _targets(
        self, sequences: np.ndarray, rows: np.ndarray, is_frame: np.ndarray
    ) -> HandTargets:
        """Return the targets of a batch, padded with frames that are not annotated."""
        demos = self.demos
        hand = self.model

        def padded(values: np.ndarray) -> Tensor:
            out = np.zeros((*is_frame.shape, *values.shape[1:]), dtype=values.dtype)
            out[is_frame] = values[rows]
            return torch.as_tensor(out)

        held = np.logical_and(
            self.touching[:, _THUMB].any(axis=1), self.touching[:, _FINGERS].any(axis=1)
        )
        return HandTargets(
            keypoints=padded(self._keypoints[:, hand.keypoint_indices]),
            annotated=padded(demos.hand_valid),
            contact_points=padded(self._contact_points[:, hand.keypoint_indices]),
            in_contact=padded(self.touching[:, hand.keypoint_indices]),
            held=padded(held),
            object_pos=padded(demos.object_pos),
            object_quat=padded(demos.object_quat_wxyz),
            object_index=torch.as_tensor(self.object_index[sequences]),
            fields=self._fields,
        )


@dataclass(frozen=True)
class HandBatch:
    """S sequences, padded to T frames, of which B are frames of the demonstrations."""

    rows: np.ndarray
    """[B] indices of the frames among all frames."""
    is_frame: np.ndarray
    """[S, T] bool: whether an element of the batch is one of these frames."""
    targets: HandTargets
    """What the hand follows."""
    motion: HandState
    """The hand's motion."""


def _hand_motion(
    robot: RobotSpec, device: str, weights: HandWeights, targets: HandTargets
) -> HandState:
    """Return the hand's motion; a function of a module, for other processes."""
    return retarget_hand(HandModel(robot, device=device), targets, weights)


def _arm_targets(
    hand: HandModel, arm: ArmModel, targets: HandTargets, motion: HandState
) -> ArmTargets:
    """Return the path that the arm has to follow for a motion of the hand."""
    followed = hand.keypoints(motion.to(hand.device)).to(targets.keypoints.device)
    tips_off = (followed - targets.keypoints)[:, :, hand.is_tip.cpu()].norm(dim=-1)
    return ArmTargets(
        root_pos=motion.root_pos,
        root_quat=motion.root_quat,
        hand_joints=motion.joints,
        annotated=targets.annotated,
        hand_error=tips_off.mean(-1),
        hand_clearance=arm.hand_clearance(motion.joints),
    )
