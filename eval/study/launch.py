"""Run the steps of a plan on this machine, one after the other.

The same study may run several times at once, also on machines that share ``--out``: a step that another process is
doing is left to it.
"""

from __future__ import annotations

import shlex
import signal
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

from xreset.eval.study.plan import Plan
from xreset.eval.study.steps import XRESET, Step


def launch(plan: Plan, steps: Sequence[Step], say: Callable[[str], None] = print) -> list[str]:
    """Run steps in the order of the plan. The commands of a step run one after another, as long as each succeeds and
    another command is left.

    Args:
        plan: plan of the study.
        steps: steps to run.
        say: called with a line for each step that begins or ends.

    Returns:
        Sentences that name the steps that failed or cannot start.

    Raises:
        KeyboardInterrupt: the launch was stopped by a signal; the command has ended.
    """
    problems = []
    wanted = [step.name for step in steps]
    for step in plan.steps.values():
        if step.name not in wanted:
            continue
        undone = [need for need in step.needs if plan.steps[need].left()]
        if undone:
            problems.append(f"{step.name} cannot start: {', '.join(undone)} is not done.")
        elif step.busy():
            problems.append(f"{step.name} is in progress in another process.")
        elif problem := _run(step, plan.out / "logs" / f"{step.name.replace(' ', '-')}.log", say):
            problems.append(problem)
    return problems


def _run(step: Step, log: Path, say: Callable[[str], None]) -> str:
    """Run the commands of a step, and return why it is not done; empty if it is."""
    before: list[str] = []
    while True:
        left, commands = step.todo()
        if not left:
            say(f"{step.name}: done")
            return ""
        problem = "it ended before it was done"
        if commands[0] != before:
            before = commands[0]
            say(f"{step.name}: begun")
            if not _call(before, log):
                continue
            problem = log.read_text(errors="replace").strip().splitlines()[-1]
        say(f"{step.name}: {problem}")
        return f"{step.name}: {problem}. Its output: {log}"


def _call(command: Sequence[str], log: Path) -> int:
    """Run a command, whose output goes to the log, and return its exit status. A signal to end ends the command first:
    a training then writes a checkpoint."""
    stops: list[int] = []

    def stop(number: int, _: object) -> None:
        stops.append(number)
        process.terminate()

    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        file.write(f"$ {shown_command(command)}\n")
        file.flush()
        # In a session of its own, because Ctrl-C reaches a whole session: the command is ended softly, once.
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        signals = (signal.SIGINT, signal.SIGTERM)
        handlers = [signal.signal(number, stop) for number in signals]
        try:
            process.wait()
        finally:
            for number, handler in zip(signals, handlers, strict=True):
                signal.signal(number, handler)
    if stops:
        raise KeyboardInterrupt
    return process.returncode


def shown_command(command: Sequence[str]) -> str:
    """Return a command as a user would type it."""
    return shlex.join(command).replace(shlex.join(XRESET), "xreset")
