"""mjlab: training next to mjlab's task Mjlab-Lift-Cube-Yam, one after the other on one machine, each with its defaults.

Ours starts from --resets. mjlab comes from --mjlab, for example a folder made by `pip install --target FOLDER mjlab`. --num-envs is for
both. --iterations are timed, after 10 that are not: these record CUDA graphs. Scenes and networks differ; the table says in what.

engine     MuJoCo-Warp's part of the time, on the GPU's clock: steps, and what it computes for new states
rest       the other part of collecting: actions, observations, rewards, resets and the policy
learning   the part that is left
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from benchlib import Options
from rich.console import Console
from rich.table import Table

from xreset.errors import XResetError
from xreset.files.storage import read_json

NUM_ENVS = 4096
_DROPPED = 10
"""First iterations, which are not timed."""
_ENGINES = {
    "xreset": ("xreset.backends.mujoco_warp:MujocoWarpBackend", "_run", "_at.model", "_data"),
    "mjlab": ("mjlab.sim.sim:Simulation", "step,forward", "mj_model", "wp_data"),
}
"""What ``engine_clock.py`` watches."""
_CURVES = {
    "xreset": ("speed/env_steps_per_second", "speed/collect_seconds", "speed/learn_seconds"),
    "mjlab": ("Perf/total_fps", "Perf/collection_time", "Perf/learning_time"),
}
"""Control steps of all worlds per second, and the two parts of an iteration [s]."""
_RATIOS = ("control steps per second", "simulated seconds per second", "memory, GB")


def add_arguments(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--mjlab", help="where mjlab is, as in PYTHONPATH (default: left out)")


def run(options: Options, console: Console) -> None:
    extra = options.extra
    if extra["mjlab"] is None or extra["resets"] is None:
        console.print("mjlab: left out. Give --mjlab and --resets.")
        return
    total = _DROPPED + int(str(extra["iterations"]))
    ours = f"xreset train --num-envs {options.num_envs} --iterations {total}".split()
    ours += ["--device", options.device, "--resets", str(extra["resets"])]
    if extra["meshes"]:
        ours += ["--meshes", str(extra["meshes"])]
    theirs = ["mjlab.scripts.train", "Mjlab-Lift-Cube-Yam", "--agent.logger", "tensorboard"]
    theirs += f"--env.scene.num-envs {options.num_envs} --agent.max-iterations {total}".split()
    with tempfile.TemporaryDirectory() as folder:
        columns = [
            _measure("xreset", [*ours, "--out", f"{folder}/run"], options, Path(folder)),
            _measure("mjlab", [*theirs, "--log-root", f"{folder}/logs"], options, Path(folder)),
        ]
    robot = Path(str(extra["resets"])).stem
    table = Table("", f"xreset, {robot}", "mjlab", "ratio", title=f"{options.num_envs} worlds")
    for name, value in columns[0].items():
        other = columns[1][name]
        ratio = f"{value / other:.2f}" if name in _RATIOS and other else ""
        table.add_row(name, _shown(value), _shown(other), ratio)
    console.print(table)


def _measure(name: str, command: list[str], options: Options, home: Path) -> dict[str, float]:
    """Run a training, and return what the table says about it."""
    record = home / f"{name}.json"
    output = home / f"{name}.log"
    clock = Path(__file__).with_name("engine_clock.py")
    environment = dict(os.environ)
    if name == "mjlab":
        paths = (options.extra["mjlab"], os.environ.get("PYTHONPATH"))
        environment["PYTHONPATH"] = os.pathsep.join(str(path) for path in paths if path)
    if options.device == "cpu":
        environment["CUDA_VISIBLE_DEVICES"] = ""
    watched = [sys.executable, "-P", str(clock), str(record), *_ENGINES[name], *command]
    before = _gpu_memory()
    memory = 0.0
    with output.open("w") as log:
        process = subprocess.Popen(watched, stdout=log, stderr=log, env=environment)
        while process.poll() is None:
            memory = max(memory, _gpu_memory() - before)
            time.sleep(0.2)
    if process.returncode:
        end = output.read_text()[-2000:]
        raise XResetError(f"The training of {name} failed. The end of its output:\n{end}")
    curves = _curves(home / ("run" if name == "xreset" else "logs"), name)
    found = read_json(record)
    return {**_speed(curves, found, options.num_envs), "memory, GB": memory, **found["about"]}


def _speed(curves: list[list], found: dict[str, Any], worlds: int) -> dict[str, float]:
    """Return speeds and shares, from the learning curves and what ``engine_clock.py`` found."""
    start = curves[0][_DROPPED - 1].wall_time
    rates, collecting, learning = (_values(curve) for curve in curves)
    whole = collecting.sum() + learning.sum()
    # the rates are whole numbers
    horizon = round(rates[0] * (collecting[0] + learning[0]) / worlds)
    steps = horizon * len(rates)
    calls = [call for call in found["calls"] if call[1] > start]
    engine = sum(duration for _, _, duration in calls)
    physics_steps = sum(call[0] == "step" for call in calls)
    simulated = physics_steps * found["about"]["physics step, ms"] / 1e3
    return {
        "control steps per second": steps * worlds / whole,
        "simulated seconds per second": simulated * worlds / whole,
        "engine, %": 100 * engine / whole,
        "rest, %": 100 * (collecting.sum() - engine) / whole,
        "learning, %": 100 * learning.sum() / whole,
        "control steps of a world per iteration": horizon,
        "physics steps per control step": physics_steps / steps,
    }


def _values(curve: list) -> np.ndarray:
    """Return the values of the iterations that are timed."""
    return np.array([entry.value for entry in curve[_DROPPED:]])


def _curves(folder: Path, name: str) -> list[list]:
    """Return the learning curves in a folder, whose entries have ``value`` and ``wall_time``."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    file = next(folder.rglob("events.out.tfevents*"))
    events = EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload()
    return [events.Scalars(curve) for curve in _CURVES[name]]


def _gpu_memory() -> float:
    """What all processes use of the GPU [GB]; 0 without a GPU."""
    if not torch.cuda.is_available():
        return 0.0
    free, total = torch.cuda.mem_get_info()
    return (total - free) / 1e9


def _shown(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
