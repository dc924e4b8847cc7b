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
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from xreset.errors import XResetError
from xreset.eval.study.plan import Plan, Step

_POLL = 0.5
"""[s]"""


def visible_gpus() -> tuple[int, ...]:
    """Return the numbers of the GPUs of this machine that may be used."""
    import torch

    count = torch.cuda.device_count()
    listed = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    numbers = [int(text) for text in listed.split(",") if text.strip().isdecimal()]
    return tuple(numbers[:count] or range(count))


def launch(
    plan: Plan, steps: Sequence[Step], *, per_gpu: int = 1, say: Callable[[str], None] = print
) -> list[str]:
    """Run steps, each as soon as the steps that it needs are done.

    Args:
        per_gpu: trainings at a time on each GPU.

    Returns:
        What failed, or cannot start: sentences.
    """
    gpus = visible_gpus()
    # None: the CPU, on which steps come one at a time
    free: list[int | None] = [*gpus * per_gpu, None]
    problems = []
    waiting = {}
    for step in steps:
        if step.gpu and not gpus:
            problems.append(f"{step.name} cannot start: it needs a GPU, this machine has none.")
        else:
            waiting[step.name] = step
    running: dict[str, tuple[Step, Future[str], int | None]] = {}
    processes: list[subprocess.Popen] = []
    busy: set[str] = set()

    def collect() -> None:
        """Note which steps have ended."""
        for name, (step, job, place) in list(running.items()):
            if job.done():
                del running[name]
                free.append(place)
                problem = job.result()
                if step.busy():  # another process was faster
                    waiting[name] = step
                elif step.done():
                    say(f"{name}: done")
                else:
                    problem = problem or "it ended before it was done"
                    say(f"{name}: {problem}")
                    problems.append(f"{name}: {problem}. Its output: {log_of(plan.out, name)}")

    def begin(step: Step) -> None:
        """Start a step if a place is free, unless it is done, in progress elsewhere, or cannot start."""
        places = [place for place in free if (place is not None) == step.gpu]
        if step.busy():
            if step.name not in busy:
                say(f"{step.name}: in progress in another process; waiting for its end")
            busy.add(step.name)
        elif places:  # only now, because a training reads its newest checkpoint to say what is left
            waiting.pop(step.name)
            undone = [need for need in step.needs if not plan.steps[need].done()]
            if undone:
                problems.append(f"{step.name} cannot start: {', '.join(undone)} is not done.")
            elif not step.done():
                place = max(places, key=places.count)  # the GPU with the most free places
                free.remove(place)
                job = pool.submit(_run, step, place, log_of(plan.out, step.name), processes)
                running[step.name] = (step, job, place)
                say(f"{step.name}: begun{'' if place is None else f' on GPU {place}'}")

    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with ThreadPoolExecutor(len(free)) as pool:
            try:
                while waiting or running:
                    collect()
                    for step in list(waiting.values()):
                        if not any(need in waiting or need in running for need in step.needs):
                            begin(step)
                    time.sleep(_POLL)
            except KeyboardInterrupt:
                say(
                    "Stopping: trainings write a checkpoint. The same command continues from there."
                )
                for process in processes:
                    process.terminate()
                raise
    finally:
        signal.signal(signal.SIGTERM, before)
    return problems


def _run(step: Step, gpu: int | None, log: Path, processes: list[subprocess.Popen]) -> str:
    """Run a step's commands one after another while they succeed, and return what went wrong, in a line."""
    environment = os.environ | {"CUDA_VISIBLE_DEVICES": "" if gpu is None else str(gpu)}
    log.parent.mkdir(parents=True, exist_ok=True)
    try:
        commands = step.commands()
    except XResetError as error:
        return str(error)
    for command in commands:
        with log.open("a") as file:
            file.write(f"$ {shown_command(command)}\n")
            file.flush()
            # In a session of its own, because Ctrl-C reaches a whole session: launch() ends the command softly, once.
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )
            processes.append(process)
            code = process.wait()
        if code != 0:
            return log.read_text(errors="replace").strip().splitlines()[-1]
    return ""


def log_of(out: Path, name: str) -> Path:
    """Return the file with the output of a step's commands."""
    return out / "logs" / f"{name.replace(' ', '-')}.log"


def shown_command(command: Sequence[str]) -> str:
    """Return a command as a user would type it."""
    return shlex.join(command).replace(f"{shlex.quote(sys.executable)} -m xreset", "xreset")
