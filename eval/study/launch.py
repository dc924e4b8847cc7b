"""Run the steps of a plan as processes on this machine, spread over its GPUs.

The same study may run several times at once, also on machines that share ``--out``. A step waits while another process
writes its folder, and finds out what is left to do when it begins.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from xreset.eval.study.plan import Plan
from xreset.eval.study.steps import XRESET, Step

_POLL = 0.5
"""Time between two looks at the processes [s]."""
_CPU = ""
"""The place of steps without a GPU, which run one at a time; also their CUDA_VISIBLE_DEVICES."""


def visible_gpus() -> list[str]:
    """Return the GPUs of this machine that may be used, as CUDA_VISIBLE_DEVICES names them."""
    import torch

    count = torch.cuda.device_count()
    listed = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
    return listed.split(",")[:count]


def launch(
    plan: Plan, steps: Sequence[Step], *, per_gpu: int = 1, say: Callable[[str], None] = print
) -> list[str]:
    """Run steps, each as soon as the steps that it needs are done. The commands of a step run one after another, as
    long as each succeeds and another command is left.

    Args:
        plan: plan of the study.
        steps: steps to run.
        per_gpu: largest number of simultaneous trainings on each GPU.
        say: called with a line for each step that begins, waits or ends.

    Returns:
        Sentences that name the steps that failed or cannot start.

    Raises:
        KeyboardInterrupt: the launch was stopped by a signal; the processes have ended.
    """
    launched = _Launch(plan, steps, visible_gpus(), per_gpu, say)
    stops: list[int] = []  # a signal that raised would lose the process that begins at that moment
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _: stops.append(number)) for number in signals]
    try:
        while (launched.waiting or launched.running) and not stops:
            launched.advance()
            time.sleep(_POLL)
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
        processes = [process for _, _, process in launched.running.values()]
        if stops:
            say("Stopping: trainings write a checkpoint. The same command continues from there.")
            for process in processes:
                process.terminate()
        for process in processes:
            process.wait()
    if stops:
        raise KeyboardInterrupt
    return launched.problems


class _Launch:
    """Steps that wait, run and have failed, and the free places of a machine."""

    def __init__(
        self,
        plan: Plan,
        steps: Sequence[Step],
        gpus: list[str],
        per_gpu: int,
        say: Callable[[str], None],
    ) -> None:
        self._plan = plan
        self._say = say
        self._free = [*gpus * per_gpu, _CPU]
        self._busy: set[str] = set()
        self.waiting: dict[str, Step] = {}
        self.running: dict[str, tuple[str, Path, subprocess.Popen]] = {}
        """Name of a step -> its place, its log and its process."""
        self.problems: list[str] = []
        for step in steps:
            if step.gpu and not gpus:
                self.problems.append(
                    f"{step.name} cannot start: it needs a GPU, this machine has none."
                )
            else:
                self.waiting[step.name] = step

    def advance(self) -> None:
        """End the steps whose process has ended, and begin those whose needs are neither waiting nor running."""
        for name, (_, _, process) in list(self.running.items()):
            if process.poll() is not None:
                self._end(self._plan.steps[name])
        for step in self._plan.steps.values():
            ready = not {*self.waiting, *self.running}.intersection(step.needs)
            if step.name in self.waiting and ready:
                self._begin(step)

    def _begin(self, step: Step) -> None:
        """Start a step if a place is free, unless it is done, in progress elsewhere, or cannot start."""
        name = step.name
        places = [place for place in self._free if (place != _CPU) == step.gpu]
        if step.busy():
            if name not in self._busy:
                self._say(f"{name}: in progress in another process; waiting for its end")
            self._busy.add(name)
            return
        if not places:
            return
        del self.waiting[name]
        # Only after a place is free, because a training reads its newest checkpoint to say what is left.
        undone = [need for need in step.needs if self._plan.steps[need].left()]
        if undone:
            self.problems.append(f"{name} cannot start: {', '.join(undone)} is not done.")
            return
        _, commands = step.todo()
        if commands:
            place = max(places, key=places.count)  # the GPU with the most free places
            self._free.remove(place)
            log = self._plan.out / "logs" / f"{name.replace(' ', '-')}.log"
            self.running[name] = (place, log, _start(commands[0], place, log))
            where = "" if place == _CPU else f" on GPU {place}"
            self._say(f"{name}: begun{where}")

    def _end(self, step: Step) -> None:
        """Free the place of a step that has ended, and report it, or queue it again if it has another command."""
        name = step.name
        place, log, process = self.running.pop(name)
        self._free.append(place)
        left, commands = step.todo()
        has_more = left and process.returncode == 0 and commands[0] != process.args
        if has_more or step.busy():  # busy: another process was faster
            self.waiting[name] = step
        elif not left:
            self._say(f"{name}: done")
        else:
            problem = "it ended before it was done"
            if process.returncode:
                problem = log.read_text(errors="replace").strip().splitlines()[-1]
            self._say(f"{name}: {problem}")
            self.problems.append(f"{name}: {problem}. Its output: {log}")


def _start(command: Sequence[str], gpu: str, log: Path) -> subprocess.Popen:
    """Start a command on a GPU, or on :data:`_CPU`; its output goes to the log."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as file:
        file.write(f"$ {shown_command(command)}\n")
        file.flush()
        # In a session of its own, because Ctrl-C reaches a whole session: launch() ends the command softly, once.
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"CUDA_VISIBLE_DEVICES": gpu},
            start_new_session=True,
        )


def shown_command(command: Sequence[str]) -> str:
    """Return a command as a user would type it."""
    return shlex.join(command).replace(shlex.join(XRESET), "xreset")
