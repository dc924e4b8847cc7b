"""Fuzzes every reader and command for some minutes, as tests/fuzzing.py, tests/damage.py and tests/fuzzing_commands.py describe."""

from __future__ import annotations

import argparse
import hashlib
import os
import resource
import sys
import time
import warnings
from collections import Counter
from pathlib import Path
from random import Random

sys.path.insert(0, os.getcwd())

from hypothesis import HealthCheck, Phase, given, seed, settings

from tests.damage import damages
from tests.fuzzing import Reader, outcome, readers
from tests.fuzzing_commands import commands, draw, outcome_of_command

GIGABYTES = 6
"""Address space that the process may take in addition to that at its start."""

ROUND = 20
"""Files of a reader in a round: few, so that a busy machine comes to the last reader as well."""

COMMAND_LINES = "command lines"
"""The name of the commands among the readers."""


def _round(
    name: str,
    reader: Reader,
    count: Counter,
    broken: dict[str, bytes],
    slowest: dict[str, float],
    number: int,
    end: float,
) -> None:
    whole = reader.file.read_bytes()

    @seed(number)
    @settings(
        max_examples=ROUND,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(damages(reader.kind))
    def run(damage):
        if time.monotonic() > end:
            return
        damaged = damage(whole)
        began = time.process_time()
        try:
            count[outcome(reader, damaged)] += 1
        except (AssertionError, MemoryError) as error:
            count["broken"] += 1
            broken.setdefault(f"{type(error).__name__}: {str(error)[:160]}", damaged)
        slowest[name] = max(slowest[name], time.process_time() - began)

    run()


def _command_lines(
    count: Counter, broken: dict[str, bytes], slowest: dict[str, float], number: int, end: float
) -> None:
    random = Random(number)
    options = commands()
    for _ in range(ROUND):
        if time.monotonic() > end:
            return
        line = draw(random, options)
        began = time.process_time()
        try:
            verdict = outcome_of_command(line)
            count["read" if verdict == "ran" else verdict] += 1
        except AssertionError as error:
            count["broken"] += 1
            broken.setdefault(str(error)[:160], repr(line).encode())
        slowest[COMMAND_LINES] = max(slowest[COMMAND_LINES], time.process_time() - began)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--reader", nargs="+", help="only these; 'command lines' for junk options")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    with readers() as found:
        chosen = {
            name: reader
            for name, reader in found.items()
            if not options.reader or name in options.reader
        }
        names = [
            *chosen,
            *([COMMAND_LINES] if COMMAND_LINES in (options.reader or [COMMAND_LINES]) else []),
        ]
        counts = {name: Counter() for name in names}
        broken: dict[str, dict[str, bytes]] = {name: {} for name in names}
        slowest = dict.fromkeys(names, 0.0)
        virtual = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(
            resource.RLIMIT_AS, (virtual + (GIGABYTES << 30), resource.RLIM_INFINITY)
        )
        end = time.monotonic() + 60 * options.minutes
        rounds = 0
        while time.monotonic() < end:
            rounds += 1
            for name, reader in chosen.items():
                _round(
                    name,
                    reader,
                    counts[name],
                    broken[name],
                    slowest,
                    options.seed * 1_000_003 + rounds,
                    end,
                )
            if COMMAND_LINES in names:
                _command_lines(
                    counts[COMMAND_LINES],
                    broken[COMMAND_LINES],
                    slowest,
                    options.seed * 1_000_003 + rounds,
                    end,
                )
    print(
        "| reader | files or command lines | refused | read and sound, or ran | broken | slowest |\n|---|---|---|---|---|---|"
    )
    for name, count in counts.items():
        print(
            f"| {name} | {count.total()} | {count['refused']} | {count['read']} | {count['broken']} | {slowest[name]:.1f} s |"
        )
    total = sum(counts.values(), Counter())
    print(f"| all | {total.total()} | {total['refused']} | {total['read']} | {total['broken']} | |")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"\nseed {options.seed}, {options.minutes:g} minutes, at most {peak:.0f} MB of memory")
    folder = Path("build/fuzz")
    for name, problems in broken.items():
        for problem, content in problems.items():
            folder.mkdir(parents=True, exist_ok=True)
            path = folder / f"{name.replace(' ', '-')}-{hashlib.sha256(content).hexdigest()[:12]}"
            path.write_bytes(content)
            print(f"{name}: {problem}\n  {path}")
    return 1 if total["broken"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
