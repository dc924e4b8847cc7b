"""Film one episode of a policy in one world of an environment."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from xreset.env.manipulation import ManipulationEnv, checked_env
from xreset.errors import XResetError
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.files.checks import Mp4, PositiveFloat, obeys_rules
from xreset.files.storage import write_whole
from xreset.pictures.render import check_film_size, encode_mp4


@obeys_rules
def film(
    policy: str | Path | PolicySpec,
    env: ManipulationEnv,
    path: Mp4,
    *,
    world: int = 0,
    fps: PositiveFloat = 20.0,
    size: tuple[int, int] = (640, 480),
) -> None:
    """Play one episode in every world, and write an mp4 of one of them at its own speed.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`.
        env: environment, such as :meth:`PolicySpec.make_env` makes; all worlds are reset first.
        path: file to write, which ends in ``.mp4``.
        world: index of the world to show. The goal is drawn as a translucent object. The images of the task's cameras
            are below.
        fps: least number of frames per second; the film has more if the control rate is not a multiple of it.
        size: width and height [pixels], both even.

    Raises:
        PolicyError: the policy is unknown, or cannot play in this environment.
        XResetError: the path does not end in ``.mp4``, ``env`` is no environment, the world does not exist, or the film
            cannot be encoded.
    """
    env = checked_env(env)
    check_film_size(size)
    if not 0 <= world < env.num_envs:
        raise XResetError(f"World {world} does not exist. Choose one from 0 to {env.num_envs - 1}.")
    policy = load_policy(policy)
    env.reset()
    player = policy.begin(env)
    control_dt = env.backend.scene.control_dt
    every = max(1, int(1.0 / (fps * control_dt) + 1e-6))  # control steps from one frame to the next
    frames = [_frame(env, world, size)]
    for step in range(1, env.max_episode_length + 1):
        env.advance(player.act(env.get_observations()))
        if step % every == 0:
            frames.append(_frame(env, world, size))
    write_whole(Path(path), encode_mp4(frames, 1.0 / (every * control_dt)))


def _frame(env: ManipulationEnv, world: int, size: tuple[int, int]) -> np.ndarray:
    """Return an image [H, W, 3] of a world, with the images of the policy's cameras below."""
    picture = env.render(world, size)
    if env.vision is None:
        return picture
    return np.vstack((picture, env.vision.cameras.picture(world, size[0])))
