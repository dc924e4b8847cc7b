"""A small reset bank for tests, with soup and spam, three demonstrations and six states, all numbers distinct; and trajectories."""

from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any
from unittest.mock import patch

import numpy as np

from xreset import ResetBank, Retargeted, make_backend
from xreset.geometry.shapes import transform

SOUP = "005_tomato_soup_can"
SPAM = "010_potted_meat_can"
ONLY_FRAMES = {"closing": None, "squeeze": None, "transfer": None}
"""Arguments of `make_bank` for a bank of states that are frames and do not press."""


@contextmanager
def in_this_process():
    """Try states and make environments without worker processes."""
    here = partial(make_backend, workers=0)
    with (
        patch("xreset.resets.probe.make_backend", here),
        patch("xreset.env.manipulation.make_backend", here),
    ):
        yield


def shifted(obj, shift):
    """The object with a mesh that is shifted [3] in its frame."""
    move = transform(np.eye(3), shift)
    pieces = [replace(p, T_body_shape=move @ p.T_body_shape) for p in obj.pieces]
    moved = {"com": obj.com + shift, "vertices": obj.vertices + shift}
    return replace(obj, pieces=tuple(pieces), **moved)


def toy_bank(robot, **changes):
    """The bank; ``changes`` replace fields. Numbers are in single precision.

    Demonstrations 0 (soup), 1 (spam) and 2 (soup) start at x = 0.50, 0.51, 0.52 and end 0.2 higher, turned by 90 degrees about x. States:
    two of each, the second after first contact, and the object's x of state i is 0.6 + i / 100.
    """
    num = len(robot.joints)
    sequence = np.array([0, 0, 1, 1, 2, 2], dtype=np.int32)
    owners = np.array([SOUP, SPAM, SOUP])
    upright = np.array([1.0, 0, 0, 0])
    turned = np.sqrt([0.5, 0.5, 0, 0])
    start = np.stack([[0.50 + s / 100, 0.3, 0.05] for s in range(3)])
    fields: dict[str, Any] = {
        "robot": robot.name,
        "robot_fingerprint": robot.fingerprint,
        "engines": ("mujoco",),
        "joint_names": robot.joint_names,
        "joint_pos": np.arange(6)[:, None] * 0.01 + np.arange(num) * 0.001,
        "object_pos": np.stack([[0.6 + i / 100, 0.3, 0.15] for i in range(6)]),
        "object_quat_wxyz": np.tile(upright, (6, 1)),
        "object_name": owners[sequence],
        "sequence_index": sequence,
        "frame_index": np.array([3, 9, 4, 8, 5, 7], dtype=np.int32),
        "post_contact": np.array([False, True] * 3),
        "sequence_name": np.array(["demo_a", "demo_b", "demo_c"]),
        "sequence_object": owners,
        "start_pos": start,
        "start_quat_wxyz": np.tile(upright, (3, 1)),
        "goal_pos": start + np.array([0, 0, 0.2]),
        "goal_quat_wxyz": np.tile(turned, (3, 1)),
        "object_names": (SOUP, SPAM),
        "object_sources": ("stand-in", "stand-in"),
        "rejected_sequence_index": np.array([0, 1, 1], dtype=np.int32),
        "rejected_frame_index": np.array([1, 2, 5], dtype=np.int32),
        "rejected_post_contact": np.array([False, False, True]),
        "rejected_reason": np.array([0, 1, 1], dtype=np.int32),
        "reason_names": ("out of bounds", "object linear velocity"),
    }
    for name, value in (fields | changes).items():
        is_double = isinstance(value, np.ndarray) and value.dtype == np.float64
        fields[name] = value.astype(np.float32) if is_double else value
    return ResetBank(**fields)


def toy_retargeted(robot, objects, offsets, **changes):
    """Trajectories of demonstrations with these objects; ``changes`` replace fields.

    Every frame is valid. The robot is at home, and an object stays at the origin, upright.
    """
    frames = offsets[-1]
    last = np.array(offsets[1:]) - 1
    upright = np.tile([1.0, 0, 0, 0], (frames, 1))
    object_pos = changes.get("object_pos", np.zeros((frames, 3)))
    object_quat = changes.get("object_quat_wxyz", upright)
    fields: dict[str, Any] = {
        "robot": robot.name,
        "robot_fingerprint": robot.fingerprint,
        "sequence_name": np.array([f"demo{i}" for i in range(len(objects))]),
        "object_name": np.array(objects),
        "hand_side": np.array(["right"] * len(objects)),
        "frame_offsets": np.array(offsets),
        "fps": 30.0,
        "joint_names": robot.joint_names,
        "joint_pos": np.tile(robot.home, (frames, 1)),
        "palm_pos": np.zeros((frames, 3)),
        "palm_quat_wxyz": upright,
        "fingertip_names": robot.fingertip_names,
        "fingertip_pos": np.zeros((frames, len(robot.fingertips), 3)),
        "object_pos": object_pos,
        "object_quat_wxyz": object_quat,
        "goal_pos": object_pos[last],
        "goal_quat_wxyz": object_quat[last],
        "annotated": np.ones(frames, dtype=bool),
        "valid": np.ones(frames, dtype=bool),
        "reason": np.zeros(frames, dtype=np.int64),
        "reason_names": ("valid", "other"),
        "contact": np.zeros(frames, dtype=bool),
        "first_contact": np.full(len(objects), -1),
        "hand_error": np.zeros(frames),
        "wrist_error": np.zeros(frames),
    }
    return Retargeted(**(fields | changes))
