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
            arrays = {"origin": np.array(step["origin"]), "axis": axis, "cross": cross, "twice": cross @ cross}
            self._steps.append(step | arrays)

    def links(self, joint_pos: Array, joint_vel: Array) -> Links:
        """Return the links of joint positions and velocities [N, J]."""
        count = len(joint_pos)
        joint_pos = joint_pos.astype(np.float64)
        joint_vel = joint_vel.astype(np.float64)
        base = np.array(self._chain["base"])
        rotations = [np.tile(base[:3, :3], (count, 1, 1))]
        positions = [np.tile(base[:3, 3], (count, 1))]
        velocities = [np.zeros((count, 3))]
        spins = [np.zeros((count, 3, 3))]  # matrices W with W @ v = angular velocity x v
        for step in self._steps:
            parent = step["parent"]
            rotation = rotations[parent] @ step["origin"][:3, :3]
            arm = rotations[parent] @ step["origin"][:3, 3]
            spin = spins[parent]
            drift = 0.0
            if step["joint"] is not None:
                value = (step["multiplier"] * joint_pos[:, step["joint"]] + step["offset"])[:, None]
                speed = (step["multiplier"] * joint_vel[:, step["joint"]])[:, None]
                if step["type"] == "prismatic":
                    axis = rotation @ step["axis"]
                    arm = arm + axis * value
                    drift = axis * speed
                else:
                    spin = spin + speed[:, None] * (rotation @ step["cross"] @ rotation.transpose(0, 2, 1))
                    # Rodrigues' formula
                    turn = np.sin(value)[:, None] * step["cross"] + (1.0 - np.cos(value))[:, None] * step["twice"]
                    rotation = rotation + rotation @ turn
            rotations.append(rotation)
            positions.append(positions[parent] + arm)
            velocities.append(velocities[parent] + (spins[parent] @ arm[..., None])[..., 0] + drift)
            spins.append(spin)
        palm = self._chain["palm"]
        spin = spins[palm]
        return Links(
            palm_pos=positions[palm].astype(np.float32),
            palm_quat=_quaternion(rotations[palm]).astype(np.float32),
            palm_linvel=velocities[palm].astype(np.float32),
            palm_angvel=np.stack((spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]), axis=1).astype(np.float32),
            tip_pos=np.stack([positions[tip] for tip in self._chain["tips"]], axis=1).astype(np.float32),
        )


def _quaternion(matrix: Array) -> Array:
    """[N, 4] quaternions of rotation matrices [N, 3, 3] (Shepperd's method)."""
    skew = matrix - matrix.transpose(0, 2, 1)
    vector = np.stack((skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]), axis=1)
    trace = np.trace(matrix, axis1=1, axis2=2)
    candidates = np.empty((len(matrix), 4, 4))
    candidates[:, 0, 0] = 1.0 + trace
    candidates[:, 0, 1:] = vector
    candidates[:, 1:, 0] = vector
    candidates[:, 1:, 1:] = matrix + matrix.transpose(0, 2, 1) + np.eye(3) * (1.0 - trace)[:, None, None]
    best = np.diagonal(candidates, axis1=1, axis2=2).argmax(axis=1)
    chosen = candidates[np.arange(len(matrix)), best]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)
