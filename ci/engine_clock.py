"""Runs a training with a clock around its engine, for the section mjlab of the benchmark.

    engine_clock.py RECORD CLASS METHODS MODEL DATA MODULE ARGUMENTS...

METHODS of CLASS (package.module:Class) are timed, where there is a GPU on its own clock. MODEL and DATA are the attributes of its
instances with MuJoCo's model and MuJoCo-Warp's data. MODULE runs as a program. RECORD is JSON: the name of each call, when it began
[s since 1970] and how long it took [s]; what was simulated, and versions. The name is the first argument, or else that of the method.
Nothing of xreset is imported, because mjlab needs another version of MuJoCo.
"""

import functools
import importlib
import json
import runpy
import sys
import time
from importlib.metadata import version
from operator import attrgetter
from pathlib import Path

import torch

_PACKAGES = ("mujoco-warp", "warp-lang", "rsl-rl-lib", "torch")


def main() -> None:
    record, place, methods, model, data, module, *arguments = sys.argv[1:]
    home, name = place.split(":")
    engine = getattr(importlib.import_module(home), name)
    calls = []
    simulated = []

    def watched(method):
        @functools.wraps(method)
        def call(self, *args, **kwargs):
            simulated[:] = [attrgetter(model)(self), attrgetter(data)(self)]  # before it is closed
            began = time.time()
            start = _now()
            result = method(self, *args, **kwargs)
            calls.append((args[0] if args else method.__name__, began, start, _now()))
            return result

        return call

    for method in methods.split(","):
        setattr(engine, method, watched(getattr(engine, method)))
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    except SystemExit as end:
        if end.code:
            raise
    times = [(name, began, _seconds(start, end)) for name, began, start, end in calls]
    about = _scene(*simulated) | {package: version(package) for package in _PACKAGES}
    Path(record).write_text(json.dumps({"calls": times, "about": about}))


def _now():
    """A moment: an event in the GPU's queue, or the time [s]."""
    if not torch.cuda.is_available():
        return time.perf_counter()
    event = torch.cuda.Event(enable_timing=True)
    event.record()
    return event


def _seconds(start, end) -> float:
    if isinstance(start, float):
        return end - start
    torch.cuda.synchronize()
    return start.elapsed_time(end) / 1e3


def _scene(model, data) -> dict[str, float]:
    """Sizes and settings of the model, and means over the worlds after the last step."""
    worlds = data.nworld
    return {
        "physics step, ms": 1e3 * model.opt.timestep,
        "bodies": model.nbody - 1,
        "degrees of freedom": model.nv,
        "shapes that can touch": int(((model.geom_contype | model.geom_conaffinity) != 0).sum()),
        "most Newton iterations": model.opt.iterations,
        "most steps of the line search": model.opt.ls_iterations,
        "contacts at the end": int(data.nacon.numpy()[0]) / worlds,
        "rows of constraints at the end": float(data.nefc.numpy().mean()),
        "Newton iterations at the end": float(data.solver_niter.numpy().mean()),
    }


if __name__ == "__main__":
    main()
