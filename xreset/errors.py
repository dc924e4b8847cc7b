"""Errors that a user can fix.

The command line prints these without a traceback; any other exception is a defect of xreset.
A message says what was found, what was expected, and what to do.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager

_LONG_WORD = re.compile(r"\S{1000,}")
_LONGEST = 8000


class XResetError(Exception):
    """Base of every error that a user can fix. A message that repeats a very long name of a file is shortened."""

    def __str__(self) -> str:
        text = _LONG_WORD.sub(lambda word: f"{word[0][:160]}...{word[0][-30:]}", super().__str__())
        return text if len(text) <= _LONGEST else f"{text[:_LONGEST]} ... {text[-1000:]}"


class WrongValueError(XResetError, ValueError):
    """An argument, or a field of a configuration, has a value that it may not have."""


class FileFormatError(XResetError):
    """A file does not fit its reader: wrong schema, missing key, wrong shape or type, damaged, or bad values."""


class RobotError(XResetError):
    """A robot's description is wrong, or the robot is unknown."""


class ObjectError(XResetError):
    """An object is unknown or its geometry cannot be used."""


class DemoError(XResetError):
    """Demonstrations cannot be read, or lack something."""


class GoalError(XResetError):
    """A goal cannot be reached, or a start is not at rest on the table."""


class BackendUnavailableError(XResetError):
    """A physics engine cannot be used here: the message says why, and which command fixes it."""


class CapabilityError(XResetError):
    """An engine cannot do what was asked: the message names the capability, the engine and an alternative."""


class PolicyError(XResetError):
    """A policy does not fit the robot, the observation layout or the task it is asked to run with."""


class RunError(XResetError):
    """A training run or its folder does not allow what was asked."""


class Stopped(KeyboardInterrupt):
    """A training was asked to stop by a signal and did: its checkpoint and its policy are written.

    Attributes:
        number: the signal, such as ``signal.SIGTERM``.
    """

    def __init__(self, number: int) -> None:
        super().__init__(f"the training was stopped by signal {number}")
        self.number = number


@contextmanager
def needs(package: str, extra: str, error: type[XResetError] = XResetError) -> Iterator[None]:
    """Around the import of a package that not every installation has: where it fails, says which extra of xreset brings
    it."""
    try:
        yield
    except ImportError as problem:
        raise error(
            f"{package} cannot be imported ({problem}). Install it with: pip install 'xreset[{extra}]'"
        ) from problem
