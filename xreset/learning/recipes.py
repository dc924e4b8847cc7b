"""Named starting points for a training's configuration; flags change single numbers of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from xreset.errors import RunError
from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.run import read_run
from xreset.task.config import ActionConfig, ObservationConfig, RewardConfig, TaskConfig


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """A configuration and what it is for."""

    config: TrainConfig
    about: str


_MINUTES = TrainConfig(
    task=TaskConfig(
        timestep=1 / 120,
        substeps=2,
        action=ActionConfig(hand_zero="home"),
        observation=ObservationConfig(rotation="matrix", cloud_scale=5.0, contact_force_scale=0.03),
        reward=RewardConfig(reach_width=0.4, reach_near=1.0, contact="opposing", raw_actions=True),
    ),
    model=ModelConfig(initial_std=0.3),
    ppo=PpoConfig(precision="bfloat16", desired_kl=0.02, entropy=0.0),
)
"""The paper's entropy bonus of 0.005 makes the standard deviation grow; one that only shrinks, and steps of twice the size, learn in a
fraction of the iterations. What the task's levers are for stands with their fields, what they did in docs/results.md."""

RECIPES: dict[str, Recipe] = {
    "paper": Recipe(config=TrainConfig(), about="the paper's tables VIII and IX, for hours on several GPUs"),
    "minutes": Recipe(
        config=_MINUTES,
        about="what taught an object alone in minutes on one GPU (docs/results.md): --num-envs 8192, and a bank with closing states",
    ),
}
"""Name -> recipe."""


def starting_config(like: str) -> TrainConfig:
    """The configuration of a recipe, or of a run.

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
    return read_run(like).config
