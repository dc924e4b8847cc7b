"""Train from Python, as `xreset train` does: here for seconds, on the CPU, to show the path and not a skill."""

import sys
from dataclasses import replace

import xreset
from xreset.learning.config import ModelConfig, PpoConfig


def main(bank: str, out: str) -> None:
    """Write the run folder ``out``: configuration, checkpoints, curves for TensorBoard, and ``policy.onnx``."""
    config = xreset.TrainConfig(
        model=ModelConfig(pointnet=(16, 32, 16), lstm=32, mlp=(32,)),  # small, for a CPU
        ppo=PpoConfig(horizon=8, minibatch_size=64),
        iterations=2,
    )
    episodes = replace(config.task.termination, episode_seconds=2.0)
    config = replace(config, task=replace(config.task, termination=episodes))
    xreset.train(bank, out=out, config=config, engine="mujoco", num_envs=8)
    policy = xreset.load_policy(out)
    print(
        f"trained {policy.name} for {config.iterations} iterations, on {', '.join(policy.objects)}"
    )


if __name__ == "__main__":
    main(
        sys.argv[1] if len(sys.argv) > 1 else "bank.npz",
        sys.argv[2] if len(sys.argv) > 2 else "runs/example",
    )
