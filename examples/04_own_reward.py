"""A reward term of your own: a function that the configuration names. Nothing in xreset changes.

PYTHONPATH=examples xreset train ... --config.task.reward.terms.04_own_reward:upright.weight 0.5
"""

import sys
from pathlib import Path

import torch
from torch import Tensor

import xreset
from xreset.geometry.rotations import quat_rotate
from xreset.task.config import RewardConfig, TaskConfig
from xreset.task.rewards import RewardInput


def upright(x: RewardInput) -> Tensor:
    """[N] cosine of the angle between the object's z axis and the vertical, from 5 cm above its start."""
    axis = quat_rotate(
        x.object_quat, x.object_pos.new_tensor([0.0, 0.0, 1.0]).expand_as(x.object_pos)
    )
    lifted = x.object_pos[:, 2] - x.start_pos[:, 2] > 0.05
    # no `if` on what a tensor holds: a GPU replays this as part of a graph
    return axis[:, 2] * lifted


def main(bank: Path) -> None:
    """Act at random, and show what the term pays."""
    robot = xreset.load_robot("openarm")
    states = xreset.read_bank(bank)
    objects = [xreset.load_object(name) for name in states.object_names]
    term = f"{Path(__file__).stem}:upright"  # module:function
    terms = RewardConfig().terms | {term: {"weight": 0.5}}
    task = TaskConfig(reward=RewardConfig(terms=terms))
    with xreset.make_env(robot, objects, states, task, num_envs=16) as env:
        paid = torch.stack(
            [
                env.step(torch.zeros(16, env.num_actions))[3]["log"][f"reward/{term}"]
                for _ in range(10)
            ]
        )
    print(f"{term} pays {paid.mean():.3f} per step and world, at most 0.5")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "bank.npz"))
