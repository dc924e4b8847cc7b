"""threads: retargeting, and training on the CPU, while other processes run, by default and with one thread: the ratios must be about 1."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from contextlib import contextmanager

from benchlib import OBJECT, Options, run_time, seconds_of
from rich.console import Console
from rich.table import Table

from xreset.backends.pool import usable_cores

_XRESET = [sys.executable, "-m", "xreset"]
_WORLDS = 18
_ITERATIONS = 4


def run(options: Options, console: Console) -> None:
    with tempfile.TemporaryDirectory() as folder:
        demos = f"{folder}/demos.npz"
        motion = f"{folder}/motion.npz"
        bank = f"{folder}/bank.npz"
        robot = ("--robot", options.robot)
        run_time(
            [*_XRESET, "demos", "synth", "--objects", OBJECT, "--per-object", "1", "--out", demos]
        )
        run_time([*_XRESET, "retarget", demos, *robot, "--out", motion])
        run_time([*_XRESET, "resets", motion, "--out", bank])
        retarget = [*_XRESET, "retarget", demos, *robot]
        train = [*_XRESET, "train", "--resets", bank, "--engine", "mujoco", "--device", "cpu"]
        train += ["--num-envs", str(_WORLDS), "--iterations", str(_ITERATIONS)]
        with _busy_processes(2 * usable_cores()) as count:
            table = Table("", "", "wall [s]", "CPU [s]", title=f"threads: {count} other processes")
            for name, command in (
                (f"one demonstration for {options.robot}", retarget),
                (f"training, {_WORLDS} worlds, {_ITERATIONS} iterations", train),
            ):
                many = _times([*command, "--out", f"{folder}/many-{command[3]}"], {})
                one = {"OMP_NUM_THREADS": "1"}
                alone = _times([*command, "--out", f"{folder}/one-{command[3]}"], one)
                ratio = [f"{a / b:.2f}" for a, b in zip(many, alone, strict=True)]
                table.add_row(name, "as it is", *(f"{value:.1f}" for value in many))
                table.add_row("", "OMP_NUM_THREADS=1", *(f"{value:.1f}" for value in alone))
                table.add_row("", "ratio", *ratio)
    console.print(table)


@contextmanager
def _busy_processes(count: int):
    """Run processes that need a core each."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield count
    finally:
        for process in busy:
            process.kill()
            process.wait()


def _times(command: list[str], variables: dict[str, str]) -> tuple[float, float]:
    """Wall and CPU time of a command with these environment variables [s]."""
    environment = {k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"} | variables
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    wall = seconds_of(
        lambda: subprocess.run(command, env=environment, check=True, stdout=subprocess.DEVNULL)
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
