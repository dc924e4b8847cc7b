"""``xreset run``: the whole path, as the single commands."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterator, Sequence
from pathlib import Path

from xreset.cli import perform
from xreset.cli._common import quick_engines
from xreset.cli._terminal import console
from xreset.cli._verbs import verb
from xreset.errors import RunError
from xreset.files.checks import PositiveFloat, PositiveInt, Seed, obeys_rules
from xreset.files.records import stated_inputs
from xreset.files.storage import claim_folder, file_hash
from xreset.files.text import quantity, texts
from xreset.learning.run import read_run
from xreset.physics.plugins import Device, EngineName, RobotName, backend_class, robot_names
from xreset.policy.shipped import shipped_checkpoints, shipped_name

_MINUTES = 25.0
_MINUTES_ON = 7.0
"""Length of the training where nothing else is said: from new networks, and from those of a policy that has learned."""
_RETARGET = 0.025
_RESETS = 0.038
"""Seconds of one core to retarget a frame, and to make the bank's states of a frame: the longest of the six robots that
ship, whose times are 0.017 to 0.025 and 0.021 to 0.038 (nine YCB objects, 1,310 frames)."""
_EPISODE = {"mujoco": 0.09, "sapien": 0.12, "pybullet": 0.6}
"""Engine -> seconds of one core to play a second of an episode with UR7e + Sharpa, nine YCB objects. The jaw of the
OpenArm takes about half of them."""


@obeys_rules
def run(
    demos: str | Path,
    *,
    robot: RobotName,
    out: str | Path,
    meshes: str | Path | None = None,
    engine: EngineName | Sequence[EngineName] = (),
    recipe: str | None = None,
    weights: str | Path | None = None,
    device: Device | None = None,
    num_envs: PositiveInt = 4096,
    minutes: PositiveFloat | None = None,
    iterations: PositiveInt | None = None,
    seed: Seed = 0,
    episodes: PositiveInt = 5,
) -> None:
    """Take demonstrations to a trained policy: retarget, make the bank, train, evaluate in several engines, report.

    Each step is a command of its own, which is printed; --help of the command lists what it can do besides. The files
    are motion.npz, resets.npz, and those of the run in the folder. After a kill, give the same command again: steps
    that are done are left out, and the training continues.

    Args:
        demos: archive of demonstrations (xreset demos).
        robot: name of a robot, or the folder of its description.
        out: run folder to make, or to continue.
        meshes: folder of real meshes; default: the built-in stand-ins.
        engine: physics engine to evaluate in, or several; default: all that can be used here but MuJoCo-Warp, which is
            slow on a CPU.
        recipe: recipe of the training, or another run's folder; default: the recipe of the headline results, or that
            of the weights.
        weights: run or policy with whose networks the training starts, as in xreset train; none for new ones. Default:
            the policy that ships for the robot, if it has a checkpoint and no recipe is given.
        device: where to train: cpu or cuda; default: cuda where there is a GPU.
        num_envs: worlds of the training.
        minutes: time of the whole training, without compiling kernels; default: 25, or 7 with weights, unless
            iterations are given.
        iterations: iterations of the whole training.
        seed: seed of the training and of the evaluations' starts.
        episodes: episodes of each demonstration in each engine.

    Raises:
        XResetError: a step fails, or a file in the folder was made from others.
    """
    from xreset.demos.archive import demo_objects, read_demos
    from xreset.eval.study.steps import engines_left
    from xreset.geometry.description import load_robot
    from xreset.learning.recipes import starting_config
    from xreset.learning.verbs import ENGINE
    from xreset.resets.inputs import load_inputs
    from xreset.resets.schedule import shared_worlds

    demos = Path(demos)
    out = Path(out)
    # what the last steps would refuse, after minutes of work; engines last, because they take seconds to load
    archive = read_demos(demos)
    spec = load_robot(robot)
    weights = _weights(weights, recipe, robot)
    config = starting_config(str(recipe or weights or "default"))
    task = config.task
    if weights is not None:
        from xreset.learning.train import networks_to_start_with

        networks_to_start_with(weights, [spec], config)
    shared_worlds(archive.object_names, num_envs, task.reset.object_share)
    engines = quick_engines(texts(engine), "cpu")
    backend_class(ENGINE).engine_version()
    if minutes is None and iterations is None:
        minutes = _MINUTES if weights is None else _MINUTES_ON
    console.print(
        f"{quantity(archive.num_sequences, 'demonstration')}, {quantity(archive.num_frames, 'frame')}; engines: "
        f"{', '.join(engines)}"
    )
    played = archive.num_sequences * episodes * task.termination.episode_seconds
    for line in _times(archive.num_frames, played, engines, minutes):
        console.print(line)
    if str(robot) not in robot_names():
        console.print("These are times of robots that ship; those of another robot are not known.")
    if weights is not None:
        console.print(
            f"The training starts from the networks of {weights} (--weights none: from new ones)."
        )
    motion = out / "motion.npz"
    bank = out / "resets.npz"
    _refuse_other_training(out, bank)
    demo_objects(archive, meshes)  # cuts meshes that no command has cut before
    with claim_folder(out):  # refused if it cannot be made, or another command writes into it
        pass
    if motion.is_file():
        load_inputs(motion, robot=spec, meshes=meshes, accept=("motion",))  # refuses another
    if not _made_from(motion, demos=file_hash(demos)):
        _step("retarget", demos, robot=robot, out=motion, meshes=meshes)
    if not _made_from(bank, retargeted=file_hash(motion)):
        own = robot if os.path.isdir(robot) else None
        _step("resets", motion, out=bank, robot=own, meshes=meshes)
    _step(
        "train",
        out=out,
        resets=bank,
        robot=robot,
        meshes=meshes,
        recipe=recipe,
        weights=weights,
        device=device,
        num_envs=num_envs,
        minutes=minutes,
        iterations=iterations,
        seed=seed,
    )
    files = {"demos": demos, "policy": out / "policy.onnx"}
    trained = task.termination.episode_seconds
    results = out / "eval"
    left = engines_left(results, engines, files, seed=seed, episodes=episodes, trained=trained)
    if left:
        named = [f"--engine={name}" for name in left]
        _step("eval", out, *named, demos=demos, episodes=episodes, seed=seed, meshes=meshes)
    _step("report", out, meshes=meshes)


def _weights(
    weights: str | Path | None, recipe: str | None, robot: str | Path
) -> str | Path | None:
    """Return whose networks the training starts with; None: new ones.

    Args:
        weights: as in ``run``.
        recipe: as in ``run``: its networks may be others than those of the policy that ships.
        robot: name or folder of the robot.
    """
    if weights is not None:
        return None if str(weights) == "none" else weights
    known = shipped_name(str(robot))
    return known if recipe is None and known in shipped_checkpoints() else None


def _times(
    frames: int, seconds: float, engines: Sequence[str], minutes: float | None
) -> Iterator[str]:
    """Yield sentences about the time of the steps.

    Args:
        frames: frames of the demonstrations.
        seconds: time of all episodes in one engine [s].
        engines: engines of the evaluation.
        minutes: length of the training; None: it ends after iterations.
    """
    steps = {"retarget": frames * _RETARGET, "resets": frames * _RESETS}
    for name in engines:
        if name in _EPISODE:
            steps[f"eval in {name}"] = seconds * _EPISODE[name]
    cores = quantity(os.cpu_count() or 1, "core")
    times = ", ".join(f"{name} {max(value / 60, 0.1):.2g}" for name, value in steps.items())
    yield f"About how many minutes of one core the steps take: {times}. This machine has {cores}."
    unknown = [name for name in engines if name not in _EPISODE]
    if unknown:
        yield f"The time of eval in {', '.join(unknown)} is not known."
    if minutes is None:
        yield "The time of train is not known: it ends after its iterations."
    else:
        yield f"train takes {minutes:g} minutes, and compiles kernels first."


def _refuse_other_training(out: Path, bank: Path) -> None:
    """Refuse, with ``RunError``, a run folder whose training has another bank than the folder's own."""
    if not (out / "run.json").is_file():
        return
    used = Path(read_run(out).resets)
    if used.exists() and used.resolve() != bank.resolve():
        raise RunError(f"{out} holds a training with {used}. Choose another --out.")


def _made_from(path: Path, **sources: str) -> bool:
    """Return whether a file exists that was made from these sources: name -> hash.

    Raises:
        RunError: it was made from others, or does not state what from.
    """
    if not path.is_file():
        return False
    stated = stated_inputs(path)
    for name, wanted in sources.items():
        if stated.get(name) != wanted:
            raise RunError(
                f"{path} was made with another {_NAMES[name]}. Choose another --out, or remove the file."
            )
    console.print(f"{path} is there")
    return True


_NAMES = {"demos": "archive of demonstrations", "retargeted": "motion"}


def _step(verb: str, *words: object, **options: object) -> None:
    """Print a command of ``xreset``, and run it. Options without a value are left out."""
    from xreset.eval.study.steps import flags

    command = [verb, *map(str, words), *flags(options)]
    console.print(f"\n+ xreset {shlex.join(command)}", style="bold")
    perform(command)


COMMAND = verb(run)
