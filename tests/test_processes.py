"""Independent pieces of work on all cores."""

import os
import signal
import subprocess
import sys
import warnings
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest import TestCase
from unittest.mock import patch

from xreset.errors import DemoError, XResetError
from xreset.files.processes import in_processes

SCRIPT = """
from math import sqrt
from xreset.files.processes import in_processes
print(list(in_processes(sqrt, [1.0, 4.0, 9.0])))
"""

CHILD = """
from multiprocessing import get_context
from time import sleep
from xreset.files.processes import in_processes
child = get_context("fork").Process(target=lambda: list(in_processes(sleep, 4 * [0.5])))
child.start()
child.join()
print(child.exitcode)
"""


KILLED = """
import os, signal, subprocess
from math import sqrt
from unittest.mock import patch
from xreset.files.processes import in_processes
with patch("joblib.cpu_count", return_value=2):
    list(in_processes(sqrt, [1.0, 4.0, 9.0]))
subprocess.run(["pkill", "-KILL", "--parent", str(os.getpid()), "--full", "LokyProcess"])
os.kill(os.getpid(), signal.SIGKILL)
"""


def process_of(job: int) -> tuple[int, int]:
    return job, os.getpid()


def refuse(job: int) -> None:
    raise DemoError(f"job {job} is wrong")


def die(job: int) -> None:
    if job:
        os.kill(os.getpid(), signal.SIGKILL)


class ProcessesTest(TestCase):
    def setUp(self):
        self.enterContext(patch("joblib.cpu_count", return_value=2))

    def test_results_come_in_order_from_other_processes(self):
        jobs, processes = zip(*in_processes(process_of, range(6)), strict=True)
        self.assertEqual(jobs, tuple(range(6)))
        self.assertNotIn(os.getpid(), processes)

    def test_a_process_that_ends_while_jobs_come_is_no_news(self):
        list(in_processes(process_of, range(2)))
        with warnings.catch_warnings(record=True) as said:
            warnings.warn("A worker stopped while some jobs were given", UserWarning, stacklevel=1)
        self.assertEqual(said, [])

    def test_one_job_stays_in_this_process(self):
        self.assertEqual(list(in_processes(process_of, [7])), [(7, os.getpid())])

    def test_errors_arrive_as_they_are(self):
        # whichever process is the first
        with self.assertRaisesRegex(DemoError, "^job [012] is wrong$"):
            list(in_processes(refuse, range(3)))

    def test_a_killed_process_is_said(self):
        with self.assertRaisesRegex(XResetError, "was killed.*LOKY_MAX_CPU_COUNT=1"):
            list(in_processes(die, range(3)))

    def test_a_killed_command_prints_nothing_later(self):
        run = subprocess.run([sys.executable, "-c", KILLED], capture_output=True, text=True)
        # the output ends when the last of its processes ends
        self.assertEqual((run.returncode, run.stderr), (-signal.SIGKILL, ""))

    def test_the_variables_of_a_command_stay_as_they_are(self):
        for given in ({}, {"PYTHONWARNINGS": "default"}):
            with patch.dict(os.environ, given):
                before = dict(os.environ)
                list(in_processes(process_of, range(3)))
                self.assertEqual(dict(os.environ), before)

    def test_a_script_needs_no_main_guard(self):
        script = Path(self.enterContext(TemporaryDirectory())) / "script.py"
        script.write_text(SCRIPT)
        run = subprocess.run([sys.executable, script], capture_output=True, text=True)
        self.assertEqual(run.stdout, "[1.0, 2.0, 3.0]\n", run.stderr)

    def test_a_child_process_does_not_wait_minutes_for_its_own(self):
        command = [sys.executable, "-c", CHILD]
        run = subprocess.run(command, capture_output=True, text=True, timeout=150)
        self.assertEqual(run.stdout.split()[-1], "0", run.stderr)
