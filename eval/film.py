"""Films of a policy, from Python: one episode in one world of an environment."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xreset.env import ManipulationEnv
from xreset.errors import XResetError
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.eval.report.clips import encode_mp4
from xreset.files import write_whole


def film(
    policy: str | Path | PolicySpec,
    env: ManipulationEnv,
    path: str | Path,
    *,
    world: int = 0,
    fps: float = 20.0,
    size: tuple[int, int] = (640, 480),
) -> None:
    """Play one episode in every world, and write an mp4 of one of them at its own speed.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`.
        env: where it plays; all worlds are reset first. :meth:`PolicySpec.make_env` makes one.
        path: file to write.
        world: index of the world to show. The goal is drawn as a translucent object. Below are the images of the
            task's cameras.
        fps: fewest frames per second; there are more if the control rate is no multiple of them.
        size: width and height in pixels, both even.

    Raises:
        PolicyError: the policy is unknown, or cannot play in this environment.
        XResetError: there is no such world, or the film cannot be encoded.
    """
    if not 0 <= world < env.num_envs:
        raise XResetError(f"World {world} does not exist. Choose one from 0 to {env.num_envs - 1}.")
    policy = load_policy(policy)
    env.reset()
    player = policy.begin(env)
    every = max(1, int(1.0 / (fps * env.backend.scene.control_dt) + 1e-6))
    frames = [_frame(env, world, size)]
    for step in range(1, env.max_episode_length + 1):
        env.advance(player.act(env.get_observations()))
        if step % every == 0:
            frames.append(_frame(env, world, size))
    write_whole(
        Path(path), encode_mp4(np.stack(frames), 1.0 / (every * env.backend.scene.control_dt))
    )


def _frame(env: ManipulationEnv, world: int, size: tuple[int, int]) -> np.ndarray:
    """Draw a world, above what the policy's cameras show of it."""
    picture = env.render(world, size)
    if env.vision is None:
        return picture
    return np.vstack((picture, env.vision.cameras.picture(world, size[0])))
