"""Observations and rewards of xreset 0.1 to 0.3, whose files have an option where there is a table of terms today."""

from __future__ import annotations

from dataclasses import field
from typing import Any, Literal

from xreset.files.checks import (
    Checked,
    FiniteFloat,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    frozen,
)


@frozen
class NoiseOptions(Checked):
    """Standard deviations of the observation noise."""

    joint_pos: NonNegativeFloat = 0.005
    joint_vel: NonNegativeFloat = 0.05
    object_pos: NonNegativeFloat = 0.003
    object_rot: NonNegativeFloat = 0.02
    cloud: NonNegativeFloat = 0.002


@frozen
class ObservationOptions(Checked):
    """The fields of ``ObservationConfig``, with the defaults of 0.3."""

    cloud_points: PositiveInt = 64
    cloud: Literal["history", "paired"] = "history"
    cloud_history: PositiveInt = 5
    rotation: Literal["quaternion", "matrix", "to_goal"] = "quaternion"
    cloud_scale: PositiveFloat = 1.0
    contact_force_scale: NonNegativeFloat = 0.1
    joint_target: bool = False
    joint_vel_scale: NonNegativeFloat = 0.1
    content: Literal["draft", "published"] = "draft"
    noise: NoiseOptions = field(default_factory=NoiseOptions)

    def entries(self) -> dict[str, Any]:
        """Return the entries of today's ``ObservationConfig``."""
        form = "quat" if self.rotation == "quaternion" else "rotation"
        position = {"object_pos": {"noise": self.noise.object_pos}}
        turn = {"noise": self.noise.object_rot}
        goal_turn = f"goal_{form}"
        poses = position | {f"object_{form}": turn, "goal_pos": {}, goal_turn: {}}
        if self.rotation == "to_goal":
            poses = position | {"goal_pos": {}, "rotation_to_goal": turn}
            goal_turn = "rotation_from_start"
        joint_pos = {"joint_pos": {"noise": self.noise.joint_pos}}
        velocity = {"scale": self.joint_vel_scale}
        force = {"tip_force": {"scale": self.contact_force_scale}}
        privileged: dict[str, Any] = {name: {} for name in _PRIVILEGED}
        if self.content == "published":
            policy = {"tip_to_object": {}, "palm_distance": {}}
            proprio = joint_pos | {"target_pos": {}}
            privileged |= {"true_joint_vel": velocity} | force
        else:
            policy = poses | {"gravity_fraction": {}, "previous_action": {}}
            proprio = joint_pos | {"joint_vel": {"noise": self.noise.joint_vel} | velocity}
            links = ("palm_pos", f"palm_{form}", "palm_linvel", "palm_angvel", "tip_pos")
            proprio |= {name: {} for name in links} | force
            if self.joint_target:
                proprio["joint_target"] = {}
        cloud = {"noise": self.noise.cloud, "scale": self.cloud_scale}
        perception = {"paired_cloud": cloud}
        if self.cloud == "history":
            perception = {"cloud": {"frames": self.cloud_history} | cloud}
        return {
            "cloud_points": self.cloud_points,
            "policy": policy,
            "proprio": proprio,
            "perception": perception,
            "privileged": privileged,
            "goal": {"goal_pos": {}, goal_turn: {}, "previous_action": {}},
        }


_PRIVILEGED = (
    "object_linvel",
    "object_angvel",
    "goal_offset",
    "goal_turn",
    "least_tip_distance",
    "gravity_fraction",
    "reward",
)


@frozen
class RewardOptions(Checked):
    """The fields of ``RewardConfig``, with the defaults of 0.3."""

    reach: FiniteFloat = 1.0
    reach_width: PositiveFloat = 0.1
    reach_near: FiniteFloat = 0.0
    reach_near_width: PositiveFloat = 0.05
    reach_distance: Literal["best", "present"] = "best"
    grasp: FiniteFloat = 1.0
    position: FiniteFloat = 4.0
    position_width: PositiveFloat = 0.2
    rotation: FiniteFloat = 4.0
    rotation_width: PositiveFloat = 1.5
    proximity: FiniteFloat = 0.0
    proximity_cap: PositiveFloat = 3.0
    palm_proximity: FiniteFloat = 0.0
    palm_proximity_cap: PositiveFloat = 0.5
    points: FiniteFloat = 0.0
    points_zero: PositiveFloat = 1.4 / 3
    success: FiniteFloat = 10.0
    success_shape: Literal["pose", "points"] = "pose"
    success_position: PositiveFloat = 0.02
    success_rotation: PositiveFloat = 0.2617993877991494
    action: FiniteFloat = -0.005
    action_rate: FiniteFloat = -0.005
    action_rate_arm: FiniteFloat | None = None
    out_of_bounds: FiniteFloat = -500.0
    contact: Literal["any", "opposing", "near"] = "any"
    near_tips: PositiveFloat = 0.6
    near_palm: PositiveFloat = 0.2
    contact_threshold: NonNegativeFloat = 0.1
    raw_actions: bool = False
    own: dict[str, float] = field(default_factory=dict)
    scale: PositiveFloat = 0.01

    def entries(self) -> dict[str, Any]:
        """Return the entries of today's ``RewardConfig``."""
        force = {"force": self.contact_threshold}
        limited = {"limited": not self.raw_actions}
        far: dict[str, Any] = {"weight": self.reach, "width": self.reach_width}
        near: dict[str, Any] = {"weight": self.reach_near, "width": self.reach_near_width}
        near["function"] = "reach"
        if self.reach_distance == "best":
            far["function"] = "best_reach"
            near["function"] = "best_reach"
        success = {"weight": self.success, "rotation": self.success_rotation}
        if self.success_shape == "points":
            most = (
                {"weight": 1.0, "most": self.success}
                if self.success
                else {"weight": 0.0, "most": 1.0}
            )
            success = {"function": "near_success"} | most
        action_rate: dict[str, Any] = {"weight": self.action_rate} | limited
        if self.action_rate_arm is not None:
            parts = {"arm": -self.action_rate_arm, "hand": -self.action_rate}
            action_rate = {"function": "action_rate_of_parts", "weight": -1.0} | parts | limited
        terms: dict[str, dict[str, Any]] = {
            "reach": far,
            "reach_near": near,
            "grasp": {"weight": self.grasp} | force,
            "position": {"weight": self.position, "width": self.position_width},
            "rotation": {"weight": self.rotation, "width": self.rotation_width},
            "success": success,
            "action": {"weight": self.action} | limited,
            "action_rate": action_rate,
            "out_of_bounds": {"weight": self.out_of_bounds},
            "proximity": {"weight": self.proximity, "cap": self.proximity_cap},
            "palm_proximity": {"weight": self.palm_proximity, "cap": self.palm_proximity_cap},
            "points": {"weight": self.points, "zero": self.points_zero},
        }
        terms = {name: term for name, term in terms.items() if term["weight"] or name == "success"}
        distances = {"tips": self.near_tips, "palm": self.near_palm}
        gates = {
            "any": {"touching": force},
            "opposing": {"opposing": force},
            "near": {"near": distances},
        }
        return {
            "terms": terms | {name: {"weight": weight} for name, weight in self.own.items()},
            "gate": gates[self.contact],
            "success_position": self.success_position,
            "scale": self.scale,
        }
