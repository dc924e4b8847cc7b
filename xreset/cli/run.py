"""``xreset run``: the whole path, as the single commands."""

from __future__ import annotations

import json
import os
import shlex
from pathlib import Path
from typing import Any

from xreset.cli import main
from xreset.cli._common import Meshes, Several, Source, quick_engines
from xreset.cli._terminal import console
from xreset.errors import RunError
from xreset.files.records import read_npz
from xreset.files.storage import file_hash

_RETARGET = 0.025
_RESETS = 0.055
_EPISODE = 1.0
"""About how many seconds of one core it takes to retarget a frame, to make the bank's states of a frame, and to play an
episode of 5 s in one engine (UR7e + Sharpa, nine YCB objects)."""


def run(
    demos: Source,
    *,
    robot: str,
    out: Path,
    meshes: Meshes = None,
    engine: Several = (),
    recipe: str = "default",
    device: str | None = None,
    num_envs: int = 4096,
    minutes: float = 25.0,
    iterations: int | None = None,
    seed: int = 0,
    episodes: int = 5,
) -> None:
    """Take demonstrations to a trained policy: retarget, make the bank, train, evaluate in several engines, report.

    Each step is a command of its own, which is printed; --help of the command lists what it can do besides. The files
    are motion.npz, resets.npz, and those of the run in the folder. After a kill, give the same command again: steps
    that are done are left out, and the training continues.

    Args:
        demos: Archive of demonstrations (`xreset demos`).
        robot: Name of a robot, or the folder of its description.
        out: Run folder to make, or to continue.
        engine: Physics engine to evaluate in; give it again for more. Default: all that can be used here.
        recipe: Recipe of the training, or another run's folder.
        device: Where to train: cpu or cuda; default: cuda where there is a GPU.
        num_envs: Worlds of the training.
        minutes: Time of the training, without compiling kernels.
        iterations: Most iterations of the training; default: the recipe's.
        seed: Seed of the training and of the evaluations' starts.
        episodes: Episodes of each demonstration in each engine.
    """
    from xreset.demos.archive import read_demos
    from xreset.geometry.description import load_robot
    from xreset.resets import bank as bank_file
    from xreset.retarget import file

    archive = read_demos(demos)
    spec = load_robot(robot)
    engines = [each.name for each in quick_engines(engine, "cpu")]
    _show_times(len(archive.sequence_name), archive.num_frames, minutes, episodes, engines)
    motion = out / "motion.npz"
    bank = out / "resets.npz"
    out.mkdir(parents=True, exist_ok=True)
    if not _made_from(motion, file.SCHEMA, demos=file_hash(demos), robot=spec.fingerprint):
        _step("retarget", demos, robot=robot, out=motion, meshes=meshes)
    if not _made_from(bank, bank_file.SCHEMA, retargeted=file_hash(motion)):
        own = robot if os.path.isdir(robot) else None
        _step("resets", motion, out=bank, robot=own, meshes=meshes)
    _train(
        out,
        minutes,
        iterations,
        robot=robot,
        resets=bank,
        meshes=meshes,
        recipe=recipe,
        device=device,
        num_envs=num_envs,
        seed=seed,
    )
    missing = [name for name in engines if not _is_evaluated(out, name, demos, seed, episodes)]
    if missing:
        _step("eval", out, demos=demos, episodes=episodes, seed=seed, meshes=meshes, engine=missing)
    _step("report", out, meshes=meshes)


def _show_times(
    sequences: int, frames: int, minutes: float, episodes: int, engines: list[str]
) -> None:
    """Print about how long each step takes on this machine."""
    cores = os.cpu_count() or 1
    played = sequences * episodes * len(engines)
    steps = {
        "retarget": frames * _RETARGET / 60 / cores,
        "resets": frames * _RESETS / 60 / min(cores, 2),
        "train": minutes,
        "eval": played * _EPISODE / 60 / cores,
    }
    times = ", ".join(f"{name} {max(value, 0.1):.2g}" for name, value in steps.items())
    console.print(
        f"{sequences} demonstrations, {frames} frames, {cores} cores; engines: {', '.join(engines)}. "
        f"About how many minutes each step takes: {times}."
    )


def _made_from(path: Path, schema: str, **sources: str) -> bool:
    """Return whether a file exists that was made from these sources: name -> hash.

    Raises:
        RunError: it was made from others.
    """
    if not path.is_file():
        return False
    meta = json.loads(str(read_npz(path, schema, {}, what="a file of xreset run")["meta"]))
    for name, wanted in sources.items():
        if meta["inputs"].get(name) != wanted:
            raise RunError(
                f"{path} was made with another {_NAMES[name]}. Choose another --out, or remove the file."
            )
    console.print(f"{path} is there")
    return True


_NAMES = {"demos": "archive of demonstrations", "robot": "robot", "retargeted": "motion"}


def _train(
    out: Path, minutes: float, iterations: int | None, *, resets: Path, **options: Any
) -> None:
    """Start the training, or continue it for what is left of its minutes and iterations."""
    from xreset.learning.clock import read_lift
    from xreset.learning.run import checkpoints, read_run

    if not checkpoints(out):
        _step("train", out=out, minutes=minutes, iterations=iterations, resets=resets, **options)
        return
    info = read_run(out)
    if info.resets_hash != file_hash(resets):
        raise RunError(f"The run in {out} was made with another bank. Choose another --out.")
    done = read_lift(out)
    most = iterations or info.config.iterations
    left = minutes - done.minutes
    if done.iteration >= most or left < _LEAST * minutes:
        console.print(f"{out} is trained: {done.iteration} iterations, {done.minutes:.1f} minutes")
        return
    _step("train", out=out, resume=True, minutes=round(left, 2), iterations=iterations)


_LEAST = 0.03
"""Share of the minutes for which a training is not started again: compiling takes longer."""


def _is_evaluated(out: Path, engine: str, demos: Path, seed: int, episodes: int) -> bool:
    """Return whether the policy has played these episodes in an engine."""
    from xreset.eval.results import read_result

    file = out / "eval" / f"{engine}.json"
    if not file.is_file():
        return False
    result = read_result(file)
    files = {"demos": demos, "policy": out / "policy.onnx"}
    hashes = {name: file_hash(path) for name, path in files.items()}
    is_same = (result.seed, result.episodes_per_demo) == (seed, episodes)
    return is_same and hashes.items() <= result.inputs.items()


def _step(verb: str, *words: object, **options: object) -> None:
    """Print a command of ``xreset``, and run it. Options without a value are left out, lists are repeated."""
    command = [verb, *map(str, words)]
    for name, value in options.items():
        flag = f"--{name.replace('_', '-')}"
        if isinstance(value, list):
            for each in value:
                command += [flag, str(each)]
        elif value is True:
            command.append(flag)
        elif value is not None:
            command += [flag, str(value)]
    console.print(f"\n+ xreset {shlex.join(command)}", style="bold")
    main(command)


COMMAND = run
