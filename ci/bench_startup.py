"""startup: seconds until the command line answers."""

from __future__ import annotations

import sys

import numpy as np
from benchlib import Options, run_time
from rich.console import Console


def run(options: Options, console: Console) -> None:
    times = [run_time([sys.executable, "-m", "xreset", "--help"]) for _ in range(3)]
    console.print(f"xreset --help: {np.median(times):.2f} s")
