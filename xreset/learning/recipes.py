"""Named starting points for a training's configuration; flags change single numbers of them."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path

from xreset.errors import RunError
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.run import read_run
from xreset.task.config import ActionConfig, ObservationConfig, RandomizationConfig, RewardConfig, TaskConfig
from xreset.text import plain


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A configuration and what it is for."""

    config: TrainConfig
    about: str


_MINUTES = TrainConfig(
    task=TaskConfig(
        timestep=1 / 120,
        substeps=2,
        action=ActionConfig(hand="relative"),
        observation=ObservationConfig(rotation="matrix", cloud_scale=5.0, contact_force_scale=0.03, joint_target=True),
        reward=RewardConfig(
            reach_width=0.4, reach_near=1.0, reach_distance="present", contact="opposing", raw_actions=True
        ),
    ),
    model=ModelConfig(initial_std=0.3),
    ppo=PpoConfig(mini_epochs=3, minibatch_size=16384, precision="bfloat16", desired_kl=0.02, entropy=0.0),
)
"""The paper's entropy bonus of 0.005 makes the standard deviation grow; one that only shrinks, and steps of twice the size, learn in a
fraction of the iterations. With 4,096 worlds its epochs and minibatches make twelve steps of the optimiser an iteration: as far as
``desired_kl`` lets it go. What the task's levers are for stands with their fields, what they did in docs/lab-book.md."""

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
            action_latency=(0.0, 2.0),
            observation_latency=(0.0, 2.0),
            hand_friction=(0.05, 0.6),
            force_gain=(0.5, 2.0),
            torsional_friction=(0.25, 2.0),
            object_inertia=(0.7, 1.4),
            object_com=(0.0, 0.01),
        ),
    ),
)
"""Drives: policies that went from simulation to a real hand had factors of 0.75 to 1.5 on stiffness and 0.3 to 3 on damping (OpenAI et al.
2018, Learning Dexterous In-Hand Manipulation; Handa et al. 2022, DeXtreme, manual randomisation), Isaac Lab's dexterous lift has 0.5
to 2 on both; here narrower for the arm, whose lag a policy has to guess. Latency: two control steps are 33 ms; DeXtreme lets a pose be two
of its steps old. Hand friction: from bare metal (Table IX has 0.1) to a skin. Effort: makers state approximate limits. Force gain: tactile
sensors without calibration. Torsional friction: PhysX leaves 0.3 of it beside a second point, a soft fingertip has more than a hard one.
What each costs a policy that never met it: docs/sim-to-sim.md."""

RECIPES: dict[str, Recipe] = {
    "paper": Recipe(config=TrainConfig(), about="the paper's tables VIII and IX, for hours on several GPUs"),
    "minutes": Recipe(
        config=_MINUTES,
        about="what taught an object alone in minutes on one GPU (docs/lab-book.md): 4,096 worlds, with closing states that press",
    ),
    "robust": Recipe(
        config=_ROBUST,
        about="minutes, with drives, latency, the hand's friction and its force readings at random (docs/sim-to-sim.md)",
    ),
}
"""Name -> recipe."""


def starting_config(like: str) -> TrainConfig:
    """Return the configuration of a recipe, or of a run without the reward terms that its user added.

    Such a term names code to import. A file must not decide that, so the terms have to be named again (:func:`dropped_terms`).

    Args:
        like: name of a recipe, or a run folder.

    Raises:
        RunError: it is neither.
    """
    if like in RECIPES:
        return RECIPES[like].config
    if not Path(like).exists():
        recipes = "; ".join(f"{name}, {recipe.about}" for name, recipe in RECIPES.items())
        raise RunError(f"there is no recipe and no run folder {like!r}. Recipes: {recipes}.")
    config = read_run(like).config
    reward = replace(config.task.reward, own={})
    return replace(config, task=replace(config.task, reward=reward))


def dropped_terms(like: str) -> dict[str, float]:
    """Return the user's own reward terms of a run, which :func:`starting_config` leaves out: ``module:function`` -> weight."""
    return {} if like in RECIPES else read_run(like).config.task.reward.own


def own_terms_flag(own: dict[str, float]) -> str:
    """Return the option of ``xreset train`` that names reward terms of the user's own."""
    terms = [f"{shlex.quote(plain(name))} {weight:g}" for name, weight in own.items()]
    return " ".join(["--config.task.reward.own", *terms])
