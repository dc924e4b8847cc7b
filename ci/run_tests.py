"""Runs the unittest suite and ends with one line: ``N passed, N failed, N skipped``.

usage: run_tests.py [-v] [--quick] [MODULE ...]      (default: every tests/test_*.py; --quick: those that take seconds, no physics)
"""

from __future__ import annotations

import os
import signal
import sys
import time
import unittest

sys.path.insert(0, os.getcwd())


QUICK = (
    "accounts", "docs", "engines_page", "eval", "files", "kinematics", "mirror", "render", "retarget_terms", "robots",
    "schedule", "schedules", "task",
)  # fmt: skip
"""Modules of tests that a change of code is first tried with."""


class Result(unittest.TextTestResult):
    """Counts passes, and remembers how long each test class took."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.passed = 0
        self.seconds: dict[str, float] = {}

    def startTest(self, test):
        super().startTest(test)
        self._began = time.perf_counter()

    def stopTest(self, test):
        super().stopTest(test)
        name = type(test).__module__
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - self._began

    def addSuccess(self, test):
        super().addSuccess(test)
        self.passed += 1

    def addExpectedFailure(self, test, err):
        super().addExpectedFailure(test, err)
        self.passed += 1


def main() -> int:
    # What a script starts in the background ignores Ctrl-C, and so would every process that a test starts and interrupts.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    arguments = sys.argv[1:]
    verbosity = 2 if "-v" in arguments else 1
    names = [a for a in arguments if not a.startswith("-")]
    if "--quick" in arguments:
        names += [f"tests.test_{name}" for name in QUICK]
    loader = unittest.TestLoader()
    suite = loader.loadTestsFromNames(names) if names else loader.discover("tests", top_level_dir=".")
    result = unittest.TextTestRunner(resultclass=Result, verbosity=verbosity, buffer=True).run(suite)
    for test, reason in result.skipped:
        print(f"skipped {test}: {reason}")
    for name, seconds in sorted(result.seconds.items(), key=lambda item: -item[1]):
        print(f"{seconds:7.1f} s  {name}")
    failed = len(result.failures) + len(result.errors) + len(result.unexpectedSuccesses)
    if not result.passed and not failed:
        failed = 1
        print("no test ran")
    print(f"{result.passed} passed, {failed} failed, {len(result.skipped)} skipped")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
