"""SIGKILL at random moments: every command is killed some times, then given again until it ends; nothing may be lost but the time.

A file under its final name must always be whole, and at the end no leftover may lie beside it or in shared memory.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

XRESET = [sys.executable, "-m", "xreset"]
SMALL = [
    *(
        "--config.model.lstm",
        "16",
        "--config.model.mlp",
        "16",
        "--config.model.pointnet",
        "8",
        "8",
        "--config.ppo.horizon",
        "8",
    ),
    *(
        "--config.ppo.minibatch-size",
        "64",
        "--config.save-interval",
        "2",
        "--config.task.observation.cloud-points",
        "16",
    ),
]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=10, help="of each command")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    chance = random.Random(options.seed)
    shared = set(Path("/dev/shm").glob("xreset-*"))
    rows, failed = [], False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        demos, moved, bank, run = (folder / f for f in ("demos.npz", "retargeted.npz", "bank.npz", "run"))
        subprocess.run(
            [*XRESET, "demos", "synth", "--out", demos, "--objects", "soup", "--per-object", "2"],
            check=True,
            capture_output=True,
        )
        train = [
            "train",
            "--out",
            run,
            "--robot",
            "openarm",
            "--resets",
            bank,
            "--backend",
            "mujoco",
            "--device",
            "cpu",
            "--num-envs",
            "4",
        ]
        train += ["--iterations", "60", *SMALL]
        verbs: dict[str, tuple[Path, Callable[[], list]]] = {
            "retarget": (moved, lambda: ["retarget", demos, "--robot", "openarm", "--out", moved]),
            "resets": (bank, lambda: ["resets", moved, "--out", bank]),
            "train": (run / "policy.onnx", lambda: train),
            "train --resume": (run / "policy.onnx", lambda: ["train", "--out", run, "--resume", "--iterations", "120"]),
            "eval": (run / "eval" / "mujoco.json", lambda: ["eval", run, "--demos", demos, "--episodes", "4"]),
        }
        for verb, (result, command) in verbs.items():
            seconds, killed, before, ended = 20.0, 0, 0, 0
            while killed < options.kills and ended < 3:
                argv = resume(command(), run) if verb == "train" else command()
                delay = chance.uniform(0.2, seconds)
                if attempt(argv, delay) is None:
                    killed += 1
                else:
                    ended, seconds = ended + 1, max(2.0, 0.7 * seconds)
                if verb.startswith("train"):
                    found = len(list((run / "checkpoints").glob("[0-9]*.pt")))
                    failed |= found < before
                    before = found
            argv = resume(command(), run) if verb == "train" else command()
            done = attempt(argv, None)
            left = [
                p.name for p in folder.rglob("*") if p.name.endswith((".part", ".lock")) or p.name.endswith(".partial")
            ]
            good = done == 0 and result.exists() and not left
            failed |= not good
            rows.append(f"| {verb} | {killed} | {'yes' if good else 'NO'} | {', '.join(left) or '-'} |")
            print(rows[-1], flush=True)
    orphans = set(Path("/dev/shm").glob("xreset-*")) - shared
    print("| command | kills | then went on to its end | left behind |\n|---|---|---|---|", *rows, sep="\n")
    print(f"\nfiles in shared memory that the next start removes: {len(orphans)}; seed {options.seed}")
    return int(failed)


def resume(argv: list, run: Path) -> list:
    """The same command, or ``--resume`` once there is a checkpoint."""
    return ["train", "--out", run, "--resume"] if list((run / "checkpoints").glob("[0-9]*.pt")) else argv


def attempt(argv: list, delay: float | None) -> int | None:
    """Exit status, or None if it was killed after ``delay`` seconds; an error is shown."""
    process = subprocess.Popen(
        [*XRESET, *map(str, argv)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        env=os.environ,
        text=True,
    )
    try:
        said, _ = process.communicate(timeout=delay)
    except subprocess.TimeoutExpired:
        process.send_signal(signal.SIGKILL)
        process.communicate()
        time.sleep(0.3)  # workers notice that their input has ended
        return None
    if process.returncode:
        print(f"xreset {' '.join(map(str, argv))}\n{said}")
    return process.returncode


if __name__ == "__main__":
    raise SystemExit(main())
