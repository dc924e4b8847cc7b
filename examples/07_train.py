"""Train from Python, as `xreset train` does: here for seconds, on the CPU, to show the path and not a skill."""

import sys
from dataclasses import replace
from pathlib import Path

from xreset.learning.config import ModelConfig, PpoConfig, TrainConfig
from xreset.learning.train import load_inputs, start_run, train


def main(bank: Path, out: Path) -> None:
    """Write the run folder ``out``: configuration, checkpoints, curves for TensorBoard, and ``policy.onnx``."""
    config = TrainConfig(
        model=ModelConfig(pointnet=(16, 32, 16), lstm=32, mlp=(32,)),  # the default is the paper's
        ppo=PpoConfig(horizon=8, minibatch_size=64),
        iterations=2,
    )
    config = replace(
        config, task=replace(config.task, termination=replace(config.task.termination, episode_seconds=2.0))
    )
    inputs = load_inputs("openarm", bank, objects=None)
    info = start_run(inputs, backend="mujoco", device="cpu", num_envs=8, seed=0, config=config, out=out)
    train(out, info, inputs)  # train(out, info, resume=True) goes on after a kill
    print(f"trained {config.iterations} iterations: {out / 'policy.onnx'}")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "bank.npz"),
        Path(sys.argv[2] if len(sys.argv) > 2 else "runs/example"),
    )
