"""Steps worlds of each engine in turn, resets them often and breaks some on purpose, and watches the memory of its processes."""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from bench_env import motion
from benchlib import OBJECT

from xreset import robots
from xreset.env.manipulation import ManipulationEnv, make_scene
from xreset.objects.catalogue import load_objects
from xreset.physics.plugins import backend_names, backend_status, make_backend
from xreset.resets.distribution import ResetDistribution
from xreset.task.config import TaskConfig

WORLDS = 4
GROWTH = 8.0
"""Most that memory may grow [MB], from the mean of the second tenth of the time to that of the last: caches fill in the first."""


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="for all engines together")
    parser.add_argument(
        "--engine",
        action="append",
        default=[],
        help="engine; again for more (default: all that work here)",
    )
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        return soak(options.one, 60 * options.minutes)
    names = options.engine or [
        name for name in backend_names() if backend_status(name).reason is None
    ]
    print(
        "| engine | minutes | control steps of a world | resets | broken on purpose | memory at first, at the end | |\n"
        + "|---" * 7
        + "|"
    )
    # each in a process of its own, whose memory is only that engine's
    each = str(options.minutes / len(names))
    return max(
        subprocess.run([sys.executable, __file__, "--one", name, "--minutes", each]).returncode
        for name in names
    )


def soak(name: str, seconds: float) -> int:
    robot = robots.load("ur7e-sharpa")
    task = TaskConfig()
    scene = make_scene(robot, tuple(load_objects([OBJECT], None)), task)
    chance = torch.Generator().manual_seed(0)
    used = []
    steps = 0
    starts = 0
    broken = 0
    with (
        tempfile.TemporaryDirectory() as folder,
        make_backend(name, scene, WORLDS, device="cpu") as backend,
    ):
        bank = motion(robot, Path(folder))
        env = ManipulationEnv(
            backend, task, ResetDistribution(bank, robot, bank.object_names, task.reset)
        )
        begin = time.monotonic()
        while time.monotonic() < begin + seconds:
            *_, done, _ = env.step(2 * torch.rand(WORLDS, env.num_actions, generator=chance) - 1)
            starts += int(done.sum())
            if steps % 20 == 0:
                env.reset(torch.randint(WORLDS, (1,), generator=chance))
                starts += 1
            if steps % 200 == 0:
                one = torch.randint(WORLDS, (1,), generator=chance)
                state = backend.state()[one]
                state.object_linvel[:] = torch.nan
                backend.set_state(state, one)
                broken += 1
            if time.monotonic() > begin + len(used) * seconds / 200:
                used.append(memory())
            steps += 1
        assert int(env.nonfinite_count) >= broken - 1, (
            f"{broken} worlds were broken, {int(env.nonfinite_count)} noticed"
        )
    first, last = (float(np.mean(part)) for part in (used[20:40], used[-20:]))
    verdict = "constant" if last - first < GROWTH else "GREW"
    print(
        f"| {name} | {seconds / 60:.0f} | {steps:,} | {starts:,} | {broken} | {first:.1f} MB, {last:.1f} MB | {verdict} |",
        flush=True,
    )
    return int(verdict == "GREW")


def memory() -> float:
    """Resident memory of this process and of its workers [MB]."""
    parents = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue  # it has ended meanwhile
    pages = 0
    for process, parent in parents.items():
        if os.getpid() in (process, parent):
            try:
                pages += int(Path(f"/proc/{process}/statm").read_text().split()[1])
            except OSError:
                continue
    return pages * resource.getpagesize() / 1e6


if __name__ == "__main__":
    raise SystemExit(main())
