"""Run the steps of a plan as processes on this machine, spread over its GPUs.

The same study may run several times at once, also on machines that share ``--out``: a step whose folder another process
writes is waited for, and a step looks at what is left to do when it begins.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from xreset.eval.study.plan import Plan
from xreset.eval.study.steps import Step

_POLL = 0.5
"""[s]"""


def visible_gpus() -> list[str]:
    """Return the GPUs of this machine that may be used, as CUDA_VISIBLE_DEVICES names them."""
    import torch

    count = torch.cuda.device_count()
    listed = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(count)))
    return listed.split(",")[:count]


def launch(
    plan: Plan, steps: Sequence[Step], *, per_gpu: int = 1, say: Callable[[str], None] = print
) -> list[str]:
    """Run steps, each as soon as the steps that it needs are done. A step has one command after another while they
    succeed and leave less to do.

    Args:
        per_gpu: trainings at a time on each GPU.

    Returns:
        What failed, or cannot start: sentences.
    """
    gpus = visible_gpus()
    free = [*gpus * per_gpu, ""]  # "": the CPU, on which steps come one at a time
    problems = []
    waiting: dict[str, Step] = {}
    running: dict[str, tuple[str, Path, subprocess.Popen]] = {}
    busy = set()
    for step in steps:
        if step.gpu and not gpus:
            problems.append(f"{step.name} cannot start: it needs a GPU, this machine has none.")
        else:
            waiting[step.name] = step

    def begin(step: Step) -> None:
        """Start a step if a place is free, unless it is done, in progress elsewhere, or cannot start."""
        name = step.name
        places = [place for place in free if bool(place) == step.gpu]
        if step.busy():
            if name not in busy:
                say(f"{name}: in progress in another process; waiting for its end")
            busy.add(name)
        elif places:  # only now, because a training reads its newest checkpoint to say what is left
            del waiting[name]
            undone = [need for need in step.needs if plan.steps[need].left()]
            if undone:
                problems.append(f"{name} cannot start: {', '.join(undone)} is not done.")
            elif commands := step.todo()[1]:
                place = max(places, key=places.count)  # the GPU with the most free places
                free.remove(place)
                log = plan.out / "logs" / f"{name.replace(' ', '-')}.log"
                running[name] = (place, log, _start(commands[0], place, log))
                say(f"{name}: begun{place and f' on GPU {place}'}")

    def end(step: Step) -> None:
        """Note how a step has ended, or that its next command is to come."""
        name = step.name
        place, log, process = running.pop(name)
        free.append(place)
        left, commands = step.todo()
        has_more = left and process.returncode == 0 and commands[0] != process.args
        if has_more or step.busy():  # another process was faster
            waiting[name] = step
        elif not left:
            say(f"{name}: done")
        else:
            problem = "it ended before it was done"
            if process.returncode:
                problem = log.read_text(errors="replace").strip().splitlines()[-1]
            say(f"{name}: {problem}")
            problems.append(f"{name}: {problem}. Its output: {log}")

    stops: list[int] = []  # a signal that raised would lose the process that begins at that moment
    signals = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda number, _: stops.append(number)) for number in signals]
    try:
        while (waiting or running) and not stops:
            for name, (_, _, process) in list(running.items()):
                if process.poll() is not None:
                    end(plan.steps[name])
            for step in plan.steps.values():
                ready = not {*waiting, *running}.intersection(step.needs)
                if step.name in waiting and ready:
                    begin(step)
            time.sleep(_POLL)
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)
        processes = [process for _, _, process in running.values()]
        if stops:
            say("Stopping: trainings write a checkpoint. The same command continues from there.")
            for process in processes:
                process.terminate()
        for process in processes:
            process.wait()
    if stops:
        raise KeyboardInterrupt
    return problems


def _start(command: Sequence[str], gpu: str, log: Path) -> subprocess.Popen:
    """Start a command on a GPU, or on the CPU if the GPU is ""."""
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
    return shlex.join(command).replace(f"{shlex.quote(sys.executable)} -m xreset", "xreset")
