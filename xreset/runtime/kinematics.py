"""Poses of the palm and the fingertips from joint positions."""

from __future__ import annotations

from typing import Any

import numpy as np

from .driver import Array, Links


class Kinematics:
    """Poses of the palm and the fingertips from joint positions, as the contract describes the robot."""

    def __init__(self, chain: dict[str, Any]) -> None:
        """Prepare the matrices of every joint; ``chain`` is the contract's entry ``kinematics``."""
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
        """Return palm and fingertips for joint positions and velocities [N, J], in float32."""
        poses = self._poses(joint_pos)
        palm = poses[self._chain["palm"]]
        linvel, angvel = self._palm_velocity(poses, joint_vel)
        values = {
            "palm_pos": palm[:, :3, 3],
            "palm_quat": _quaternion(palm[:, :3, :3]),
            "palm_linvel": linvel,
            "palm_angvel": angvel,
            "tip_pos": np.stack([poses[tip][:, :3, 3] for tip in self._chain["tips"]], axis=1),
        }
        return Links(**{name: value.astype(np.float32) for name, value in values.items()})

    def _poses(self, joint_pos: Array) -> list[Array]:
        """Return the poses [N, 4, 4] of the base and of every link of the chain, world frame."""
        poses = [np.tile(np.array(self._chain["base"]), (len(joint_pos), 1, 1))]
        for step in self._steps:
            pose = poses[step["parent"]] @ step["origin"]
            if step["joint"] is not None:
                source = joint_pos[:, step["joint"], None].astype(np.float64)
                value = step["multiplier"] * source + step["offset"]
                rotation = pose[:, :3, :3]
                if step["type"] == "prismatic":
                    pose[:, :3, 3] += value * (rotation @ step["axis"])
                else:  # Rodrigues' formula
                    angle = value[:, None]
                    change = np.sin(angle) * step["cross"] + (1 - np.cos(angle)) * step["twice"]
                    pose[:, :3, :3] += rotation @ change
            poses.append(pose)
        return poses

    def _palm_velocity(self, poses: list[Array], joint_vel: Array) -> tuple[Array, Array]:
        """Return linear and angular velocity of the palm [N, 3]: the sum over the joints from the palm to the base."""
        palm = self._chain["palm"]
        palm_pos = poses[palm][:, :3, 3]
        linvel = np.zeros_like(palm_pos)
        angvel = np.zeros_like(palm_pos)
        index = palm
        while index > 0:
            step = self._steps[index - 1]
            if step["joint"] is not None:
                speed = step["multiplier"] * joint_vel[:, step["joint"], None].astype(np.float64)
                velocity = speed * (poses[index][:, :3, :3] @ step["axis"])
                if step["type"] == "prismatic":
                    linvel += velocity
                else:
                    angvel += velocity
                    linvel += np.cross(velocity, palm_pos - poses[index][:, :3, 3])
            index = step["parent"]
        return linvel, angvel


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
