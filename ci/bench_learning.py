"""learning: whether a small training learns as it did, as JSON with the stored band (ci/learning.json); exit status 1 if it does not.

A gripper takes a brick between its jaws and lifts it (tests/toy_learning.py), in the default task without random
properties. --device cpu: MuJoCo, 60 iterations, 40 seconds. --device cuda: mujoco-warp, the paper's networks in
bfloat16, as many iterations on every GPU; three minutes with compiling.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

from benchlib import Options
from rich.console import Console

from xreset.learning.config import ModelConfig
from xreset.physics.plugins import make_backend

BAND = Path(__file__).with_name("learning.json")
_GPU_WORLDS = 2048
_GPU_ITERATIONS = 200


def add_arguments(group: argparse._ArgumentGroup) -> None:
    group.add_argument("--seed", type=int, default=0)


def run(options: Options, console: Console) -> None:
    sys.path.append(str(BAND.parents[1]))  # for tests/, behind an installed xreset
    from tests.toy_learning import RECIPE, WORLDS, scene, trained

    seed = int(str(options.extra["seed"]))
    gpu = options.device.startswith("cuda")
    config = RECIPE
    if gpu:
        ppo = replace(config.ppo, minibatch_size=8192, precision="bfloat16")
        config = replace(
            config,
            model=ModelConfig(initial_std=config.model.initial_std),
            ppo=ppo,
            iterations=_GPU_ITERATIONS,
        )
        backend = make_backend(
            "mujoco-warp", scene(config.task), _GPU_WORLDS, device=options.device
        )
    else:
        backend = make_backend("mujoco", scene(config.task), WORLDS, workers=0)
    with backend:
        began = time.perf_counter()
        figures, steps = trained(seed, backend, config)
    figures = figures | {"env_steps": steps, "seconds": round(time.perf_counter() - began, 1)}
    kind = options.device.partition(":")[0]
    band: dict[str, list[float]] | None = json.loads(BAND.read_text()).get(kind)
    outside = [
        name for name, (low, high) in (band or {}).items() if not low <= figures[name] <= high
    ]
    verdict = (
        "no band is stored"
        if band is None
        else f"outside: {', '.join(outside)}"
        if outside
        else "inside"
    )
    print(
        json.dumps(
            {"device": kind, "seed": seed, "worlds": backend.num_worlds}
            | figures
            | {"band": band, "verdict": verdict},
            indent=2,
        )
    )
    if band is None:
        console.print(
            f"There is no band for {kind} yet: put one into {BAND.name}, from three seeds or more."
        )
    if outside:
        raise SystemExit(1)
