"""N worlds of the task in any engine, stepped by hand; a world whose episode has ended begins the next by itself."""

import sys
from pathlib import Path

import torch

import xreset


def main(bank: Path, engine: str = "mujoco", steps: int = 60) -> None:
    """Act at random; ``bank``: a file of ``xreset resets``, or of example 02."""
    robot = xreset.load_robot("openarm")
    states = xreset.read_bank(bank)
    objects = [xreset.load_object(name) for name in states.object_names]
    with xreset.make_env(robot, objects, states, engine=engine, num_envs=4) as env:
        print(
            "observations:",
            {name: tuple(value.shape) for name, value in env.get_observations().items()},
        )
        total = torch.zeros(env.num_envs)
        for _ in range(steps):
            action = 2 * torch.rand(env.num_envs, env.num_actions) - 1
            _observations, reward, _done, _extras = env.step(action)
            total += reward
        picture = env.render(world=0)  # [480, 640, 3]
        print(
            f"a picture of the first world: {picture.shape}, mean brightness {picture.mean():.0f}"
        )
        state = env.backend.state()  # everything in SI units; quaternions are (w, x, y, z)
        print(
            f"heights of the objects [m]: {[round(z, 3) for z in state.object_pos[:, 2].tolist()]}"
        )
    print(
        f"return after {steps} steps of {env.backend.scene.control_dt * 1e3:.1f} ms: {total.mean():.3f}"
    )


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "bank.npz"))
