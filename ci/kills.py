"""Kills each command some times at random moments, then repeats it until it ends. Only time may be lost.

A file under its final name must always be whole. At the end no temporary file may be left.
"""

from __future__ import annotations

import argparse
import random
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

XRESET = [sys.executable, "-m", "xreset"]
LEFTOVERS = (".part", ".lock", ".partial")
SHARED_MEMORY = Path("/dev/shm")

SMALL = (
    "--config.save-interval 2 --config.task.observation.cloud-points 16 --config.model.lstm 16 --config.model.mlp 16"
    " --config.model.pointnet 8 8 --config.ppo.horizon 8 --config.ppo.minibatch-size 64"
)


@dataclass(frozen=True)
class Command:
    """A command that is killed."""

    name: str
    arguments: str
    """As they are typed after ``xreset``."""
    result: Path
    """A file that exists when the command has ended."""
    checkpoints: Path | None = None
    """Folder of a training's checkpoints. No kill may make them fewer."""
    once: bool = False
    """Whether the command refuses to make its result again, so that it is removed first."""

    def saved(self) -> int:
        """Return how many checkpoints there are."""
        return len(list(self.checkpoints.glob("[0-9]*.pt"))) if self.checkpoints else 0


def commands(folder: Path) -> list[Command]:
    """Return the commands in the order in which each finds the files that it needs."""
    demos = folder / "demos.npz"
    motion = folder / "retargeted.npz"
    bank = folder / "bank.npz"
    run = folder / "run"
    eyes = folder / "eyes"
    where = "--engine mujoco --device cpu --num-envs 4"
    watch = (
        "--config.task.vision.width 8 --config.task.vision.height 8 --config.task.vision.points 16"
    )
    robot = "--arm tests/robots/arm.urdf --hand tests/robots/hand.xml"
    training = {"result": run / "policy.onnx", "checkpoints": run / "checkpoints"}
    return [
        Command("demos synth", f"demos synth --out {demos} --objects soup --per-object 2", demos),
        Command("retarget", f"retarget {demos} --robot openarm --out {motion}", motion),
        Command("resets", f"resets {motion} --out {bank}", bank),
        Command(
            "train",
            f"train --out {run} --robot openarm --resets {bank} {where} --iterations 60 {SMALL}",
            **training,
        ),
        Command("train, to continue", f"train --out {run} --iterations 120", **training),
        Command("eval", f"eval {run} --demos {demos} --episodes 4", run / "eval/mujoco.json"),
        Command(
            "stress",
            f"stress {run} --demos {demos} --engine mujoco --property object-mass",
            run / "stress/mujoco.json",
        ),
        Command(
            "stress --faults",
            f"stress {run} --demos {demos} --property pose-delay --property lost-frames",
            run / "faults/mujoco.json",
        ),
        Command(
            "distill",
            f"train --teacher {run} --out {eyes} --resets {bank} --iterations 60 {watch} {where}",
            eyes / "policy.onnx",
            eyes / "checkpoints",
        ),
        Command("report", f"report {run}", run / "report/index.html"),
        Command(
            "export deploy",
            f"export deploy {run} --out {folder}/deploy",
            folder / "deploy/leapp.yaml",
            once=True,
        ),
        Command(
            "export episodes",
            f"export episodes {run} --out {folder}/episodes.npz",
            folder / "episodes.npz",
        ),
        Command(
            "demos select",
            f"demos select {demos} --per-object 1 --out {folder}/one.npz",
            folder / "one.npz",
        ),
        Command(
            "goals", f"goals soup --robot openarm --out {folder}/goals.npz", folder / "goals.npz"
        ),
        Command(
            "objects make",
            f"objects make --out {folder}/shapes --count 8",
            folder / "shapes",
            once=True,
        ),
        Command(
            "robots import",
            f"robots import {robot} --out {folder}/robot",
            folder / "robot/robot.toml",
            once=True,
        ),
        Command("view", f"view {motion} --out {folder}/a.png", folder / "a.png"),
        Command(
            "study",
            f"study seconds --out {folder}/studies",
            folder / "studies/reports/seconds/index.html",
        ),
    ]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--command", action="append", default=[], help="kill only this command; again for more"
    )
    options = parser.parse_args()
    chance = random.Random(options.seed)
    shared = set(SHARED_MEMORY.glob("xreset-*"))
    rows = []
    failed = False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for command in commands(folder):
            wanted = options.kills if not options.command or command.name in options.command else 0
            killed, good = kill(command, wanted, chance)
            left = sorted(path.name for path in folder.rglob("*") if path.name.endswith(LEFTOVERS))
            good &= command.result.exists() and not left
            failed |= not good
            rows.append(
                f"| {command.name} | {killed} | {'yes' if good else 'NO'} | {', '.join(left) or '-'} |"
            )
            print(rows[-1], flush=True)
    orphans = set(SHARED_MEMORY.glob("xreset-*")) - shared
    print(
        "| command | kills | finished when repeated | left behind |\n|---|---|---|---|",
        *rows,
        sep="\n",
    )
    print(
        f"\nfiles in shared memory that the next start removes: {len(orphans)}; seed {options.seed}"
    )
    return int(failed)


def kill(command: Command, wanted: int, chance: random.Random) -> tuple[int, bool]:
    """Kill a command, then let it end.

    Returns:
        How often it was killed (fewer than wanted if it is quicker than the kills), and whether it ended well and lost no checkpoint.
    """
    seconds = 20.0
    killed = 0
    ended = 0
    saved = 0
    good = True
    while killed < wanted and ended < 3:
        remove_if_once(command)
        began = time.monotonic()
        if attempt(command.arguments, chance.uniform(0.2, seconds)) is None:
            killed += 1
        else:
            ended += 1
            seconds = time.monotonic() - began
        good &= command.saved() >= saved
        saved = command.saved()
    remove_if_once(command)
    return killed, good and attempt(command.arguments, None) == 0


def remove_if_once(command: Command) -> None:
    """Remove the folder of a command that makes a new one, if it is complete."""
    if command.once and command.result.exists():
        result = command.result
        shutil.rmtree(result if result.is_dir() else result.parent)


def attempt(arguments: str, delay: float | None) -> int | None:
    """Return the exit status, or None if the command was killed after ``delay`` seconds. An error is shown."""
    line = [*XRESET, *shlex.split(arguments)]
    process = subprocess.Popen(
        line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, text=True
    )
    try:
        said, _ = process.communicate(timeout=delay)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
        time.sleep(0.3)  # workers notice that their input has ended
        return None
    if process.returncode:
        print(f"xreset {arguments}\n{said}")
    return process.returncode


if __name__ == "__main__":
    raise SystemExit(main())
