"""The command line in a test."""

import contextlib
import functools
import inspect
import io
import os
import shlex
import signal
import subprocess
import threading
from unittest.mock import patch

from xreset.cli import main

# A process in the background of a script ignores Ctrl-C, and so do its children, which some tests interrupt.
signal.signal(signal.SIGINT, signal.default_int_handler)


def xreset(*arguments):
    """Run ``xreset ARGUMENTS``, in which a text may hold several words, quoted as in a shell: its exit code, and what it
    prints as output and as errors."""
    words = []
    for argument in arguments:
        words += shlex.split(argument) if isinstance(argument, str) else [str(argument)]
    code = 0
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as end:
            code = int(end.code or 0)
    return code, out.getvalue(), err.getvalue()


def succeeds(*arguments):
    """All that a command prints, which ends well."""
    code, out, err = xreset(*arguments)
    assert code == 0, err
    return out + err


def refused(*arguments):
    """All that a command prints, which ends with status 1."""
    code, out, err = xreset(*arguments)
    assert code == 1, f"exit status {code}: {err}"
    return out + err


@contextlib.contextmanager
def started(*words, seconds=120, **options):
    """Start a program whose output the test reads, and yield its process. After the time limit the program and its own
    children are killed, so that no reader waits for ever, and the test fails."""
    late = threading.Event()
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    command = [str(word) for word in words]
    with subprocess.Popen(command, start_new_session=True, **pipes | options) as process:

        def kill():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)

        def end():
            late.set()
            kill()

        limit = threading.Timer(seconds, end)
        limit.start()
        try:
            yield process
        finally:
            limit.cancel()
            kill()
            if late.is_set():
                raise AssertionError(f"{' '.join(command)} did not end within {seconds} s")


@contextlib.contextmanager
def calls_of(module, name):
    """Take the place of a function of the library, whose signature is that of a command, and yield the arguments of its
    calls: dictionaries by name."""
    original = getattr(module, name)
    calls = []

    @functools.wraps(original)
    def record(*positional, **named):
        bound = inspect.signature(original).bind(*positional, **named)
        bound.apply_defaults()
        calls.append(bound.arguments)

    with patch.object(module, name, record):
        yield calls
