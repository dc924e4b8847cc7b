"""Named starting points for a training's configuration; flags change single numbers of them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from math import pi, radians
from pathlib import Path

from xreset.cameras.config import VisionConfig
from xreset.errors import RunError
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.run import read_run
from xreset.learning.schedules import ScheduleConfig
from xreset.task.config import (
    ActionConfig,
    NoiseConfig,
    ObservationConfig,
    PushConfig,
    RandomizationConfig,
    ResetConfig,
    RewardConfig,
    TaskConfig,
    TerminationConfig,
    TrackerConfig,
)
from xreset.text import plain


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A configuration and what it is for."""

    config: TrainConfig
    about: str


_MINUTES = TrainConfig(
    task=TaskConfig(
        timestep=1 / 120,
        substeps=4,
        action=ActionConfig(hand="relative", arm_step=0.06, hand_step=0.1),
        observation=ObservationConfig(
            cloud="paired", rotation="matrix", cloud_scale=5.0, contact_force_scale=0.03, joint_target=True
        ),
        reward=RewardConfig(
            reach_width=0.4, reach_near=1.0, reach_distance="present", contact="opposing", raw_actions=True
        ),
    ),
    model=ModelConfig(initial_std=0.3),
    ppo=PpoConfig(mini_epochs=3, minibatch_size=16384, precision="bfloat16", desired_kl=0.02, entropy=0.0),
)
"""Without the paper's entropy bonus the standard deviation only shrinks. With that and a doubled ``desired_kl`` a
policy learns in a fraction of the iterations (docs/lab-book.md). With 4,096 worlds an iteration has twelve steps of the
optimizer. Control at 30 Hz, as in the published paper: two seeds had 4 to 6 points more than at 60 Hz after equal
minutes, with joint targets that move as fast (docs/lab-book.md)."""

_ROBUST = replace(
    _MINUTES,
    task=replace(
        _MINUTES.task,
        randomization=RandomizationConfig(
            arm_stiffness=(0.7, 1.4),
            arm_damping=(0.7, 1.4),
            hand_stiffness=(0.7, 1.4),
            hand_damping=(0.5, 2.0),
            effort=(0.7, 1.2),
            action_latency=(0.0, 1.0),
            observation_latency=(0.0, 1.0),
            hand_friction=(0.05, 0.6),
            force_gain=(0.5, 2.0),
            torsional_friction=(0.25, 2.0),
            object_inertia=(0.7, 1.4),
            object_com=(0.0, 0.01),
        ),
    ),
)
"""Sources of the ranges. Drives: policies that went from simulation to a real hand had factors of 0.75 to 1.5 on
stiffness and 0.3 to 3 on damping (OpenAI et al. 2018, Learning Dexterous In-Hand Manipulation; Handa et al. 2022,
DeXtreme, manual randomization), Isaac Lab's dexterous lift has 0.5 to 2 on both. Latency: one control step is 33 ms; in
DeXtreme a pose is up to two steps of 33 ms old. Hand friction: from bare metal (0.1 in Table IX) to a skin. Torsional
friction: PhysX leaves 0.3 of it next to a second contact point. The cost of each range for a policy that was trained
without it: docs/sim-to-sim.md."""

_LIVE = replace(
    _ROBUST,
    task=replace(
        _ROBUST.task,
        object_frame="center",
        observation=replace(_ROBUST.task.observation, rotation="to_goal"),
        reset=replace(_ROBUST.task.reset, goal_xy=0.03, goal_z=0.05, goal_yaw=pi / 6),
        randomization=replace(
            _ROBUST.task.randomization,
            action_latency=(0.0, 4.0),
            lost_actions=(0.0, 0.2),
            observation_latency=(0.0, 6.0),
            proprio_latency=(0.0, 1.0),
            tracker=TrackerConfig(
                interval=(1.0, 2.0),
                jitter=1.0,
                position_bias=0.005,
                rotation_bias=radians(3.75),
                position_noise=0.005,
                rotation_noise=radians(3.75),
                loss=0.01,
                loss_steps=(3.0, 15.0),
            ),
            push=PushConfig(probability=(0.002, 0.02), object_velocity=0.5, object_spin=5.0, arm_torque=0.25),
        ),
    ),
)
"""From the published paper's table A3: delays of 133 ms (actions), 200 ms (poses) and 33 ms (joints), errors of poses,
shifts of goals. There the arm's actions are late by at most 50 ms. The tracker has 15 or 30 poses a second and loses
the object for 0.1 to 0.5 s. Lost actions, lost poses and the size of pushes have no source."""

_PUBLISHED = TrainConfig(
    task=TaskConfig(
        timestep=1 / 120,
        substeps=4,
        object_frame="center",
        distance_points=64,
        action=ActionConfig(hand="relative", arm_step=0.0125, hand_step=1 / 24),
        observation=ObservationConfig(
            content="published",
            cloud="paired",
            cloud_scale=5.0,
            noise=NoiseConfig(joint_pos=0.0, joint_vel=0.0, object_pos=0.0, object_rot=0.0, cloud=0.0),
        ),
        reward=RewardConfig(
            reach=0.0,
            grasp=0.0,
            position=0.0,
            rotation=0.0,
            proximity=-2.5,
            palm_proximity=-2.5,
            contact="near",
            points=4.2,
            success=15.0,
            success_shape="points",
            action_rate_arm=-0.05,
            scale=0.01 / 30,
        ),
        termination=TerminationConfig(episode_seconds=12.0),
        reset=ResetConfig(
            demo_probability=0.9,
            random_gravity=False,
            home_gravity_std=0.0,
            training_xy=0.10,
            goal_xy=0.03,
            goal_z=0.05,
            goal_yaw=pi / 6,
        ),
        randomization=RandomizationConfig(
            friction=(0.2, 1.3),
            object_com=(0.0, 0.01),
            arm_stiffness=(0.7, 1.3),
            arm_damping=(0.7, 1.3),
            hand_stiffness=(0.7, 1.3),
            hand_damping=(0.7, 1.3),
            effort=(0.7, 1.3),
            action_latency=(0.0, 1.5),
            hand_latency=(0.0, 4.0),
            observation_latency=(0.0, 6.0),
            proprio_latency=(0.0, 1.0),
            tracker=TrackerConfig(
                position_bias=0.005,
                rotation_bias=radians(3.75),
                position_noise=0.005,
                rotation_noise=radians(3.75),
            ),
            push=PushConfig(
                probability=(0.001, 0.1), object_velocity=1.25, object_spin=30.0, arm_torque=0.5, when="gated"
            ),
        ),
    ),
    model=ModelConfig(pointnet=(64, 128, 128), critic_mlp=(512, 512, 256), normalize_returns=True),
    ppo=PpoConfig(horizon=32, sequence_length=32, entropy=0.0, bounds_loss=1e-4, value_loss=4.0),
)
"""docs/paper.md has the source of each option, and what the published paper leaves open."""

RECIPES: dict[str, Recipe] = {
    "paper": Recipe(config=TrainConfig(), about="the paper's tables VIII and IX, for hours on several GPUs"),
    "minutes": Recipe(
        config=_MINUTES,
        about=(
            "what taught an object alone in minutes on one GPU (docs/lab-book.md): 4,096 worlds, with closing states "
            "that press"
        ),
    ),
    "robust": Recipe(
        config=_ROBUST,
        about="minutes, with random drives, latency, friction of the hand and force readings (docs/sim-to-sim.md)",
    ),
    "published": Recipe(
        config=_PUBLISHED,
        about=(
            "the published paper's method (docs/paper.md), for hours on one GPU with 8,192 worlds; its bank needs the "
            "published filter"
        ),
    ),
    "live": Recipe(
        config=_LIVE,
        about=(
            "robust, for a real loop: late and lost actions, a late and faulty pose tracker, pushes, moved goals; the "
            "frame of a mesh does not matter"
        ),
    ),
}
"""Name -> recipe."""


def default_recipe(fine_tuned: str | Path | None) -> str:
    """Return where the configuration comes from if nothing is said: a run that is fine-tuned, else the paper."""
    is_run = fine_tuned is not None and (Path(fine_tuned) / "run.json").is_file()
    return str(fine_tuned) if is_run else "paper"


def starting_config(like: str) -> TrainConfig:
    """Return the configuration of a recipe, or of a run without the reward terms that its user added.

    Such a term names code to import. A file must not decide that, so the terms have to be named again
    (:func:`dropped_terms`).

    Args:
        like: name of a recipe, or a run folder.

    Raises:
        RunError: it is neither.
    """
    if like in RECIPES:
        return RECIPES[like].config
    if not Path(like).exists():
        recipes = "; ".join(f"{name}, {recipe.about}" for name, recipe in RECIPES.items())
        raise RunError(f"There is no recipe and no run folder {like!r}. Recipes: {recipes}.")
    config = read_run(like).config
    reward = replace(config.task.reward, own={})
    return replace(config, task=replace(config.task, reward=reward))


def dropped_terms(like: str) -> str | None:
    """Return a note on a run's own reward terms, which :func:`starting_config` leaves out; None if there are none."""
    own = {} if like in RECIPES else read_run(like).config.task.reward.own
    if not own:
        return None
    return (
        f"{like} was trained with reward terms of your own. They are off, because a run folder must not decide which "
        f"code is imported. If you trust this code, add {own_terms_flag(own)}."
    )


def own_terms_flag(own: dict[str, float]) -> str:
    """Return the option of ``xreset train`` that names reward terms of the user's own."""
    terms = [f"{shlex.quote(plain(name))} {weight:g}" for name, weight in own.items()]
    return " ".join(["--config.task.reward.own", *terms])


def student_config(teacher: TaskConfig, vision: VisionConfig) -> TrainConfig:
    """Return the configuration of a distillation.

    Ranges of the cameras: mounts and calibrations err by a centimetre and two degrees, images are up to 33 ms older
    than the newest.

    Args:
        teacher: the teacher's task, without cameras.
        vision: the cameras of the student.
    """
    control_dt = teacher.timestep * teacher.substeps
    randomization = replace(
        teacher.randomization,
        camera_shift=(0.0, 0.01),
        camera_turn=(0.0, radians(2.0)),
        camera_fov=(0.97, 1.03),
        camera_noise=(0.5, 2.0),
        camera_latency=(0.0, round(1 / 30 / control_dt, 3)),
    )
    return TrainConfig(
        task=replace(teacher, vision=vision, randomization=randomization, reward=replace(teacher.reward, own={})),
        model=ModelConfig(pointnet=(64, 128, 128), lstm=256, mlp=(256, 128), initial_std=0.1),
        ppo=PpoConfig(horizon=24, sequence_length=12, mini_epochs=2, minibatch_size=8192, learning_rate=5e-4),
        schedule=ScheduleConfig(teacher=((0.0, 1.0), (0.2, 0.0))),
        iterations=2000,
    )
