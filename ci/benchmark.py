"""Measures speed on this machine. Compare only figures of one run during which nothing else ran.

A section is a module ci/bench_NAME.py. Its docstring says what it measures; run(options, console) prints the result. Optional:
add_arguments(group) adds options, and NUM_ENVS is the number of worlds without --num-envs. ci/benchlib.py has what sections share.
"""

from __future__ import annotations

import argparse
import importlib
import platform
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import torch
from benchlib import Options
from rich.console import Console

from xreset.backends.workers import usable_cores

_NUM_ENVS = 8
"""Worlds of a section without NUM_ENVS."""


def sections() -> dict[str, ModuleType]:
    """Sections by name."""
    files = sorted(Path(__file__).parent.glob("bench_*.py"))
    return {file.stem.removeprefix("bench_"): importlib.import_module(file.stem) for file in files}


def main() -> None:
    known = sections()
    parser = argparse.ArgumentParser(
        prog="ci/benchmark",
        description="\n".join(
            [__doc__ or "", *(module.__doc__ or "" for module in known.values())]
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "sections",
        nargs="*",
        metavar="section",
        help=f"what to measure: {', '.join(known)} (default: all)",
    )
    parser.add_argument("--robot", default="ur7e-sharpa")
    parser.add_argument(
        "--engine", action="append", default=[], help="engine; again for more (default: all)"
    )
    own = ", ".join(
        f"{name} {module.NUM_ENVS}" for name, module in known.items() if hasattr(module, "NUM_ENVS")
    )
    parser.add_argument("--num-envs", type=int, help=f"worlds (default: {_NUM_ENVS}; {own})")
    parser.add_argument("--device", default="cpu", help="for the engines that can: cuda")
    parser.add_argument("--seconds", type=float, default=3.0, help="per measurement")
    for name, module in known.items():
        if hasattr(module, "add_arguments"):
            module.add_arguments(parser.add_argument_group(f"section {name}"))
    arguments = vars(parser.parse_args())
    chosen = arguments.pop("sections") or list(known)
    if unknown := set(chosen) - set(known):
        parser.error(
            f"Unknown section {', '.join(sorted(unknown))}. Choose from: {', '.join(known)}."
        )

    num_envs = arguments.pop("num_envs")
    common = {name: arguments.pop(name) for name in ("robot", "device", "seconds")}
    options = Options(
        **common, num_envs=_NUM_ENVS, engines=tuple(arguments.pop("engine")), extra=arguments
    )
    console = Console(width=160)
    gpu = f", {torch.cuda.get_device_name()}" if options.device.startswith("cuda") else ""
    console.print(f"{platform.machine()}, {usable_cores()} cores{gpu}")
    for name in chosen:
        worlds = getattr(known[name], "NUM_ENVS", _NUM_ENVS) if num_envs is None else num_envs
        known[name].run(replace(options, num_envs=worlds), console)


if __name__ == "__main__":
    main()
