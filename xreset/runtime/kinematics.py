"""Poses of the palm and the fingertips from joint positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from .driver import Array, Links


class Kinematics:
    """Poses of the palm and the fingertips from joint positions, as the contract describes the robot."""

    def __init__(self, chain: dict[str, Any]) -> None:
        self._chain = chain
        self._steps = []
        for step in chain["steps"]:
            axis = np.array(step["axis"])
            cross = np.cross(np.eye(3), axis)  # cross @ v = axis x v
            arrays = {
                "origin": np.array(step["origin"]),
                "axis": axis,
                "cross": cross,
                "twice": cross @ cross,
            }
            self._steps.append(step | arrays)

    def links(self, joint_pos: Array, joint_vel: Array) -> Links:
        """Return the links of joint positions and velocities [N, J]."""
        poses = [np.tile(np.array(self._chain["base"]), (len(joint_pos), 1, 1))]
        for step in self._steps:
            pose = poses[step["parent"]] @ step["origin"]
            if step["joint"] is not None:
                value = (
                    step["multiplier"] * joint_pos[:, step["joint"], None].astype(np.float64)
                    + step["offset"]
                )
                rotation = pose[:, :3, :3]
                if step["type"] == "prismatic":
                    pose[:, :3, 3] += value * (rotation @ step["axis"])
                else:  # Rodrigues' formula
                    angle = value[:, None]
                    pose[:, :3, :3] += rotation @ (
                        np.sin(angle) * step["cross"] + (1 - np.cos(angle)) * step["twice"]
                    )
            poses.append(pose)
        palm = self._chain["palm"]
        palm_pos = poses[palm][:, :3, 3]
        linvel = np.zeros_like(palm_pos)
        angvel = np.zeros_like(palm_pos)
        index = palm
        while index > 0:
            step = self._steps[index - 1]
            if step["joint"] is not None:
                speed = step["multiplier"] * joint_vel[:, step["joint"], None].astype(np.float64)
                axis = speed * (poses[index][:, :3, :3] @ step["axis"])
                if step["type"] == "prismatic":
                    linvel += axis
                else:
                    angvel += axis
                    linvel += np.cross(axis, palm_pos - poses[index][:, :3, 3])
            index = step["parent"]
        found = {
            "palm_pos": palm_pos,
            "palm_quat": _quaternion(poses[palm][:, :3, :3]),
            "palm_linvel": linvel,
            "palm_angvel": angvel,
            "tip_pos": np.stack([poses[tip][:, :3, 3] for tip in self._chain["tips"]], axis=1),
        }
        return Links(**{name: value.astype(np.float32) for name, value in found.items()})


def _quaternion(matrix: Array) -> Array:
    """[N, 4] quaternions of rotation matrices [N, 3, 3] (Shepperd's method)."""
    skew = matrix - matrix.transpose(0, 2, 1)
    vector = np.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), axis=1)
    trace = np.trace(matrix, axis1=1, axis2=2)[:, None, None]
    square = matrix + matrix.transpose(0, 2, 1) + np.eye(3) * (1.0 - trace)
    candidates = np.block([[1.0 + trace, vector[:, None]], [vector[:, :, None], square]])
    best = np.diagonal(candidates, axis1=1, axis2=2).argmax(axis=1)
    chosen = candidates[np.arange(len(matrix)), best]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
