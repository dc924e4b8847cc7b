"""Options that this version no longer has, and that files of earlier versions state."""

from __future__ import annotations

from itertools import product
from typing import Any

REMOVED: dict[str, dict[str, Any]] = {
    "ActionConfig": {"hand_smoothing": 1.0, "hand_zero": "middle"},
    "RewardConfig": {
        "tracking": "presence",
        "progress": 8.0,
        "progress_width": 0.15,
        "rotation_shape": "tanh",
        "rotation_near": 0.0,
        "rotation_near_width": 0.3,
    },
    "TerminationConfig": {"object_low": -0.05, "object_high": 1.0, "margin": 0.10},
    "ResetConfig": {
        "frontier": 0.0,
        "frontier_over": "bank",
        "frontier_power": 1.0,
        "frontier_rate": 0.1,
        "home_gravity_clip": 0.3,
        "home_noise": True,
    },
    "RandomizationConfig": {"friction_buckets": 250},
    "ModelConfig": {
        "initial_hand_std": None,
        "synergy_std": None,
        "activation": "elu",
        "normalize_observations": True,
        "conv": [16, 32, 32],
    },
    "PpoConfig": {
        "critic_learning_rate": None,
        "clip_values": True,
        "grad_norm": 1.0,
        "gae_lambda": 0.95,
        "clip": 0.2,
        "schedule": "adaptive",
    },
    "TrainConfig": {
        "random_episode_start": True,
        "target_success": None,
        "schedule": tuple(
            entries | {"teacher": teacher}
            for entries, teacher in product(
                (
                    {},
                    {"success_position": [], "faults": []},
                    {"success_position": [], "faults": [], "demo_probability": []},
                ),
                ([], [[0.0, 1.0], [0.2, 0.0]]),
            )
        ),
    },
    "Data": {"goals": None, "synthetic_seed": 0},
    "Evaluation": {"unseen": False},
    "EvalResult": {"measured": {}},
    "Runs": {"evaluations": [], "gpus": 1},
    # a student that saw something else has another layout of observations, with which it is refused
    "VisionConfig": {"view": ("points", "depth"), "goal_image": (True, False)},
    "TableSpec": {"rows": "object", "object": None},
}
"""Data class -> option -> the value that means what is done now, or a tuple of values. Files with another value are
refused."""
