"""Check an exported policy, and measure how long a step takes on this computer: ``python -m runtime`` in its folder."""

from __future__ import annotations

import resource
import sys
import time
from pathlib import Path

import numpy as np

from . import LiveError, load_controller

_STEPS = 1000


def main() -> None:
    """Take steps with a robot at home, and print the time of a step and the memory of the process."""
    try:
        controller = load_controller(Path(__file__).parents[1])
    except LiveError as error:
        sys.exit(f"runtime: {error}")
    contract = controller.contract
    reading = controller.begin_at_home().batched()
    milliseconds = []
    for _ in range(_STEPS):
        began = time.perf_counter()
        controller.step(reading)
        milliseconds.append(1000.0 * (time.perf_counter() - began))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{contract['robot']}, {len(contract['joints'])} joints, one step every {1000 * controller.dt:.1f} ms"
    )
    print(f"objects: {', '.join(contract['objects'])}")
    slowest = np.percentile(milliseconds, 99)
    print(
        f"a step takes {np.mean(milliseconds):.2f} ms (99th percentile {slowest:.2f} ms) on one core; "
        f"{memory:.0f} MB of memory"
    )


if __name__ == "__main__":
    main()
