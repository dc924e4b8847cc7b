"""Put demonstrations onto the table: its height under each object (the paper, appendix D.a)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from xreset.demos.archive import Demos
from xreset.objects.rest import rest_height
from xreset.spec import ObjectSpec

CALIBRATION_ERROR = 0.020
"""Largest height above the table at which an object counts as standing on it [m]. In 270 sequences of DexYCB all but
one are within 12 mm; that one is 44 mm up."""


def start_height(demos: Demos, objects: Mapping[str, ObjectSpec]) -> np.ndarray:
    """[S] height of the object's lowest vertex in each sequence's first frame [m]."""
    heights = []
    for name, pos, quat in zip(demos.object_name.tolist(), *demos.start_pose, strict=True):
        heights.append(pos[2] - rest_height(objects[name], quat))
    return np.array(heights)


def on_something(demos: Demos, objects: Mapping[str, ObjectSpec]) -> np.ndarray:
    """[S] bool: whether the object starts so high that it must stand on something else than the table."""
    return start_height(demos, objects) > CALIBRATION_ERROR


def grounded(demos: Demos, objects: Mapping[str, ObjectSpec]) -> Demos:
    """Shift every sequence along z so that its object's lowest vertex is at z = 0 in the first frame.

    A sequence whose object starts on top of something else stays where it is: its hand would else reach into the table.
    The scene does not have the thing below the object, so in physics the object first drops by that height.
    """
    height = start_height(demos, objects)
    height[height > CALIBRATION_ERROR] = 0.0
    shift = np.zeros((demos.num_frames, 3))
    shift[:, 2] = -height[demos.sequence_of_frame]
    return replace(
        demos,
        hand_keypoints=(demos.hand_keypoints + shift[:, None]).astype(demos.hand_keypoints.dtype),
        object_pos=(demos.object_pos + shift).astype(demos.object_pos.dtype),
    )
