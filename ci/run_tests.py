"""Runs the unittest suite, one process per core, and ends with one line: ``N passed, N failed, N skipped``.

usage: run_tests.py [--quick] [NAME ...]      (default: every tests/test_*.py; --quick: those in QUICK)
"""

from __future__ import annotations

import io
import multiprocessing
import os
import sys
import time
import unittest
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, os.getcwd())


QUICK = (
    "task", "robots", "files", "render", "eval.MetricsTest", "eval.BootstrapTest", "kinematics",
    "docs.PageTest", "docs.DocumentedTest.test_every_command_and_option_exists", "schedule", "accounts",
    "engines_page",
)  # fmt: skip
"""Tests of `--quick`, which need neither physics nor all of the package: modules, classes or methods."""

SLOW = (
    "conformance_engines", "import_robot", "examine", "training", "examples", "study", "learns", "shipped_policy",
    "objects", "deploy", "arm", "parity", "cli", "report", "retarget", "distributed", "demos", "play", "play_browser",
    "try_page", "backends_mujoco", "mujoco_warp_depth",
)  # fmt: skip
"""Modules that begin first, so that none of them is alone at the end. The last two take kernels of the first from the
cache."""

MOST_PROCESSES = 4
"""Most test processes at a time: each takes up to 2 GB."""


@dataclass
class Outcome:
    """Outcome of the tests of one module."""

    name: str
    seconds: float
    passed: int
    failed: int
    skipped: list[str]
    text: str  # output of unittest, with tracebacks


class Result(unittest.TextTestResult):
    """Counts passes."""

    passed = 0

    def addSuccess(self, test):
        super().addSuccess(test)
        self.passed += 1

    def addExpectedFailure(self, test, err):
        super().addExpectedFailure(test, err)
        self.passed += 1


def keep_to_a_core(cores) -> None:
    """Take one of the cores for this process, so that what it tests starts no processes for the others."""
    os.sched_setaffinity(0, {cores.get()})


def run(name: str) -> Outcome:
    """Run the tests of one module, class or method."""
    began = time.perf_counter()
    text = io.StringIO()
    suite = unittest.TestLoader().loadTestsFromName(name)
    result = unittest.TextTestRunner(stream=text, resultclass=Result, buffer=True).run(suite)
    failed = len(result.failures) + len(result.errors) + len(result.unexpectedSuccesses)
    skipped = [f"skipped {test}: {reason}" for test, reason in result.skipped]
    return Outcome(
        name, time.perf_counter() - began, result.passed, failed, skipped, text.getvalue()
    )


def run_all(names: list[str], processes: int):
    """Yield the outcome of each name, in the order in which they end."""
    if processes == 1:
        yield from map(run, names)
        return
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    spawned = multiprocessing.get_context("spawn")
    cores = spawned.Queue()
    for core in os.sched_getaffinity(0):
        cores.put(core)
    with ProcessPoolExecutor(
        processes, mp_context=spawned, initializer=keep_to_a_core, initargs=(cores,)
    ) as pool:
        name_of = {pool.submit(run, name): name for name in names}
        for done in as_completed(name_of):
            try:
                yield done.result()
            except BrokenProcessPool:
                yield Outcome(
                    name_of[done],
                    0.0,
                    0,
                    1,
                    [],
                    "A test process died, of this module or of one that ran at the same time.\n",
                )


def main() -> int:
    arguments = sys.argv[1:]
    names = [a for a in arguments if not a.startswith("-")]
    if "--quick" in arguments:
        names += [f"tests.test_{name}" for name in QUICK]
    if not names:
        names = sorted(f"tests.{file.stem}" for file in Path("tests").glob("test_*.py"))
        slow = [f"tests.test_{name}" for name in SLOW]
        names = slow + [name for name in names if name not in slow]
    processes = min(len(os.sched_getaffinity(0)), len(names), MOST_PROCESSES)
    outcomes = []
    for outcome in run_all(names, processes):
        outcomes.append(outcome)
        summary = (
            f"{outcome.passed} passed, {outcome.failed} failed, {len(outcome.skipped)} skipped"
        )
        print(f"{outcome.seconds:7.1f} s  {outcome.name}: {summary}", flush=True)
        if outcome.failed:
            print(outcome.text, flush=True)
    for outcome in outcomes:
        for line in outcome.skipped:
            print(line)
    passed = sum(outcome.passed for outcome in outcomes)
    failed = sum(outcome.failed for outcome in outcomes)
    skipped = sum(len(outcome.skipped) for outcome in outcomes)
    for outcome in outcomes:
        if outcome.failed:
            print(f"failed: {outcome.name}")
    if not passed and not failed:
        failed = 1
        print("no test ran")
    print(f"{passed} passed, {failed} failed, {skipped} skipped")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
