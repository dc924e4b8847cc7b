"""The command line in a test."""

import contextlib
import functools
import inspect
import io
from unittest.mock import patch

from xreset.cli import main


def xreset(*arguments):
    """Run ``xreset ARGUMENTS``: its exit code, and what it prints as output and as errors."""
    code = 0
    out = io.StringIO()
    err = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main([str(argument) for argument in arguments])
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
