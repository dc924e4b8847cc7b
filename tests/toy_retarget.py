"""Targets for tests of retargeting, retargeting with little effort, and derivatives by central differences."""

import dataclasses
from unittest.mock import patch

import numpy as np
import torch
from torch.testing import assert_close

from xreset.geometry.rotations import matrix_to_quat, quat_from_axis_angle, quat_multiply
from xreset.geometry.shapes import box, surface_of
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmTargets
from xreset.retarget.hand.config import HandWeights
from xreset.retarget.hand.cost import system
from xreset.retarget.hand.model import HandState, HandTargets
from xreset.retarget.pipeline import RetargetConfig
from xreset.spec import ObjectSpec

FLOAT = torch.float64


def double(values):
    """A tensor of 64-bit numbers."""
    return torch.tensor(values, dtype=FLOAT)


UPRIGHT = double([1.0, 0.0, 0.0, 0.0])
LITTLE_EFFORT = RetargetConfig(
    hand=HandWeights(tolerance=0.1), arm=ArmSearch(restarts=8, branches=1)
)


def retargets_quickly():
    """Motion is found with little effort where no configuration is given."""
    return patch("xreset.retarget.pipeline.RetargetConfig", lambda: LITTLE_EFFORT)


def box_object(*boxes):
    """An object made of boxes (center, size)."""
    pieces = tuple(box(center, size) for center, size in boxes)
    vertices, faces = surface_of(pieces)
    return ObjectSpec(
        name="block",
        pieces=pieces,
        mass=1.0,
        com=np.zeros(3),
        inertia=np.eye(3),
        vertices=vertices,
        faces=faces,
    )


def hand_targets(keypoints, fields, **changes):
    """Keypoints [S, T, P, 3] that touch nothing, and an upright object far away."""
    shape = keypoints.shape[:2]
    targets = HandTargets(
        keypoints=keypoints,
        annotated=torch.ones(shape, dtype=torch.bool),
        contact_points=torch.zeros_like(keypoints),
        in_contact=torch.zeros(keypoints.shape[:3], dtype=torch.bool),
        held=torch.ones(shape, dtype=torch.bool),
        object_pos=torch.full((*shape, 3), 9.0, dtype=FLOAT),
        object_quat=UPRIGHT.expand(*shape, 4),
        object_index=torch.zeros(len(keypoints), dtype=torch.long),
        fields=fields,
    )
    return dataclasses.replace(targets, **changes)


def arm_targets(model, joints):
    """The path of the hand root along all joints [S, T, J], free of errors."""
    T = model.kinematics.link_poses(joints, [model.robot.hand_root])[:, :, 0]
    shape = joints.shape[:2]
    return ArmTargets(
        root_pos=T[..., :3, 3].clone(),
        root_quat=matrix_to_quat(T[..., :3, :3]),
        hand_joints=joints[..., model.robot.hand_indices],
        annotated=torch.ones(shape, dtype=torch.bool),
        hand_error=torch.zeros(shape, dtype=FLOAT),
        hand_clearance=torch.ones(shape, dtype=FLOAT),
    )


def slope(function, x, index, step=1e-6):
    """Derivative of a function by the elements of x at an index, which is moved by a step both ways."""
    shift = torch.zeros_like(x)
    shift[index] = step
    return (function(x + shift) - function(x - shift)) / (2 * step)


def check_gradient(model, targets, config, state, frames):
    """Assert that the gradient of the hand's cost is its derivative by every variable of some frames."""

    def cost(shift):
        joints, move, turn = shift.split((state.joints.shape[-1], 3, 3), dim=-1)
        moved = HandState(
            joints=state.joints + joints,
            root_pos=state.root_pos + move,
            root_quat=quat_multiply(quat_from_axis_angle(turn), state.root_quat),
        )
        return system(model, targets, config, moved).cost

    gradient = system(model, targets, config, state).gradient
    atol = 2e-4 * float(gradient.abs().max())
    for frame in frames:
        for k in range(gradient.shape[-1]):
            half = slope(cost, torch.zeros_like(gradient), (slice(None), frame, k)) / 2
            assert_close(gradient[:, frame, k], half, rtol=2e-3, atol=atol)
