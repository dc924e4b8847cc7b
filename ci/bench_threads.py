"""threads: retargeting a synthetic demonstration while other processes run, by default and with one thread: the ratios must be about 1."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from benchlib import OBJECT, Options, run_time, seconds_of
from rich.console import Console
from rich.table import Table

from xreset.backends.pool import usable_cores


def run(options: Options, console: Console) -> None:
    xreset = [sys.executable, "-m", "xreset"]
    busy = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(2 * usable_cores())
    ]
    table = Table(
        "",
        "wall [s]",
        "CPU [s]",
        title=f"threads: one demonstration for {options.robot}, {len(busy)} other processes",
    )
    try:
        with tempfile.TemporaryDirectory() as folder:
            demos = Path(folder) / "demos.npz"
            run_time(
                [
                    *xreset,
                    "demos",
                    "synth",
                    "--meshes",
                    OBJECT,
                    "--per-object",
                    "1",
                    "--out",
                    str(demos),
                ]
            )
            found = {}
            for name, changes in (
                ("as it is", {}),
                ("OMP_NUM_THREADS=1", {"OMP_NUM_THREADS": "1"}),
            ):
                command = [
                    *xreset,
                    "retarget",
                    str(demos),
                    "--robot",
                    options.robot,
                    "--out",
                    f"{folder}/{len(found)}.npz",
                ]
                environment = {
                    k: v for k, v in os.environ.items() if k != "OMP_NUM_THREADS"
                } | changes
                before = resource.getrusage(resource.RUSAGE_CHILDREN)
                wall = seconds_of(
                    lambda c=command, e=environment: subprocess.run(
                        c, env=e, check=True, stdout=subprocess.DEVNULL
                    )
                )
                after = resource.getrusage(resource.RUSAGE_CHILDREN)
                found[name] = (
                    wall,
                    after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
                )
                table.add_row(name, *(f"{value:.1f}" for value in found[name]))
    finally:
        for process in busy:
            process.kill()
            process.wait()
    many, one = found.values()
    table.add_row("ratio", *(f"{a / b:.2f}" for a, b in zip(many, one, strict=True)))
    console.print(table)
