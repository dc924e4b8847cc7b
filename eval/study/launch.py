"""Run the steps of a plan, one after another. Each is finished or continued by commands of ``xreset``."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Callable, Sequence

from xreset.eval.study.plan import Plan
from xreset.eval.study.steps import XRESET, Step


def launch(plan: Plan, steps: Sequence[Step], say: Callable[[str], None] = print) -> list[str]:
    """Run steps in their order. A step whose command fails does not stop the others, but those that need it.

    Args:
        plan: plan of the study.
        steps: steps to run, unless they are done.
        say: called with a line before each command.

    Returns:
        Sentences that name the steps that failed or cannot start.
    """
    problems = []
    for step in steps:
        if not step.left():
            continue
        undone = [need for need in step.needs if plan.steps[need].left()]
        if undone:
            problems.append(f"{step.name} cannot start: {', '.join(undone)} is not done.")
            continue
        _, commands = step.todo()
        for command in commands:
            say(f"\n+ {shown_command(command)}")
            if _run(command):
                break
        if left := step.left():
            problems.append(f"{step.name}: {left}")
    return problems


def _run(command: Sequence[str]) -> int:
    """Run a command and return its exit status. Ctrl-C reaches the command as well, which may take time to end."""
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL)
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.wait()
        raise


def shown_command(command: Sequence[str]) -> str:
    """Return a command as a user would type it."""
    return shlex.join(command).replace(shlex.join(XRESET), "xreset")
