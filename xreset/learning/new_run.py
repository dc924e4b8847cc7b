"""Train a new policy in one call."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from xreset.errors import RunError
from xreset.learning import train as training
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import starting_config
from xreset.learning.run import checkpoints
from xreset.resets.bank import ResetBank, read_bank, write_bank


def train(
    bank: str | Path | ResetBank,
    *,
    out: str | Path,
    recipe: str = "paper",
    config: TrainConfig | None = None,
    robot: str | Path | None = None,
    objects: str | Path | None = None,
    engine: str = "mujoco-warp",
    device: str | None = None,
    num_envs: int = 4096,
    iterations: int | None = None,
    minutes: float = math.inf,
    seed: int = 0,
    weights: str | Path | None = None,
) -> Path:
    """Train a new policy, and export it as ``policy.onnx`` in the run folder.

    Args:
        bank: reset bank, or its file. A bank without a file is written to ``resets.npz`` in the run folder.
        out: run folder to make.
        recipe: where the configuration comes from: ``paper``, ``minutes``, ``robust``, or another run's folder.
        config: the whole configuration, instead of a recipe.
        robot: name or folder of the robot; default: the robot that the bank names.
        objects: folder of object meshes; default: the built-in stand-ins.
        engine: name of the physics engine.
        device: cpu or cuda; default: cuda if there is a GPU that the engine can use.
        num_envs: number of worlds, in each process.
        iterations: number of iterations; default: as configured.
        minutes: most time to train now. The run can be continued later.
        seed: seed of every random number.
        weights: another run's folder, whose networks are the start; default: new networks.

    Returns:
        The run folder, which ``xreset.load_policy`` reads.

    Raises:
        RunError: the folder holds a run already, the time is not positive, or there is too little memory.
        XResetError: bank, robot, objects and configuration do not fit together.
    """
    out = Path(out)
    if not minutes > 0:
        raise RunError(f"minutes is {minutes}, expected more than 0.")
    if isinstance(bank, ResetBank):
        file = out / "resets.npz"
        if not checkpoints(out):
            write_bank(file, bank, config={}, inputs={})
    else:
        file = Path(bank)
    robot = robot or read_bank(file).robot
    config = config or starting_config(recipe)
    if iterations is not None:
        config = replace(config, iterations=iterations)
    inputs = training.load_inputs(str(robot), file, objects)
    info = training.start_run(
        inputs,
        backend=engine,
        device=device or training.default_device(engine),
        num_envs=num_envs,
        seed=seed,
        config=config,
        out=out,
        weights=Path(weights) if weights else None,
    )
    training.train(out, info, inputs, seconds=60 * minutes)
    return out
