"""Run the steps of a plan through submitit: as processes on this machine, spread over its GPUs, or as jobs of Slurm.

A step looks at what is left to do when it begins, so a step that was killed, requeued or started twice continues or
finds itself done.
"""

from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from xreset.errors import RunError, XResetError, needs
from xreset.eval.study.plan import Plan, Step
from xreset.files import write_whole

Cluster = Literal["local", "slurm"]
_POLL = 0.5
"""[s]"""
_REQUEUES = 1000
"""How often a job of Slurm may continue in another after its time is over."""
_NO_LIMIT = 60 * 24 * 365
"""[min]"""


class Places:
    """Slots for steps on this machine: some on each GPU, and one on the CPU."""

    CPU = -1

    def __init__(self, gpus: Sequence[int], per_gpu: int) -> None:
        """Start with every slot free."""
        self.per_gpu = per_gpu
        self.gpus = len(gpus)
        self.free = dict.fromkeys(gpus, per_gpu) | {self.CPU: 1}

    def take(self, gpus: int) -> list[int] | None:
        """Take slots for a step; None if too few are free. A step of several GPUs takes all slots of each."""
        if gpus == 0:
            candidates = [self.CPU]
        else:
            candidates = [place for place in self.free if place != self.CPU]
        each = self._slots(gpus)
        candidates = [place for place in candidates if self.free[place] >= each]
        candidates.sort(key=lambda place: -self.free[place])
        taken = candidates[: max(gpus, 1)]
        if len(taken) < max(gpus, 1):
            return None
        for place in taken:
            self.free[place] -= each
        return taken

    def give(self, places: Sequence[int]) -> None:
        """Free the slots of a step."""
        for place in places:
            self.free[place] += self._slots(len(places))

    def _slots(self, gpus: int) -> int:
        return self.per_gpu if gpus > 1 else 1


def visible_gpus() -> tuple[int, ...]:
    """Return the numbers of the GPUs of this machine that may be used."""
    import torch

    count = torch.cuda.device_count()
    listed = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    numbers = [int(text) for text in listed.split(",") if text.strip().isdecimal()]
    return tuple(numbers[:count] or range(count))


def launch(
    plan: Plan,
    steps: Sequence[Step],
    *,
    cluster: Cluster,
    per_gpu: int = 1,
    options: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> list[str]:
    """Run steps, each as soon as the steps that it needs are done.

    Args:
        per_gpu: trainings at a time on each GPU of this machine.
        options: options of ``submitit.SlurmExecutor``, such as ``partition`` and ``time`` [min].

    Returns:
        What failed, or cannot start: sentences.

    Raises:
        XResetError: submitit is missing, or refuses the options.
    """
    submitit = _submitit()
    places = Places(visible_gpus() if cluster == "local" else (), per_gpu)
    waiting = {step.name: step for step in steps}
    running: dict[str, tuple[Any, list[int]]] = {}
    problems = []
    finished: dict[str, bool] = {}  # each step is asked once: a training reads its newest checkpoint for the answer
    said_busy = set()

    def is_done(name: str) -> bool:
        if name not in finished:
            finished[name] = plan.steps[name].done()
        return finished[name]

    try:
        while waiting or running:
            for name, (job, taken) in list(running.items()):
                if job.done():
                    del running[name]
                    places.give(taken)
                    finished[name] = plan.steps[name].done()
                    problem = _problem_of(job) or ("" if finished[name] else "it ended before it was done")
                    say(f"{name}: {problem or 'done'}")
                    if problem:
                        problems.append(f"{name}: {problem}. Its output: {log_of(plan.out, name)}")
            for name, step in list(waiting.items()):
                if any(need in waiting or need in running for need in step.needs):
                    continue
                undone = [need for need in step.needs if not is_done(need)]
                problem = ""
                if undone:
                    problem = f"{', '.join(undone)} is not done"
                elif cluster == "local" and step.gpus > places.gpus:
                    problem = f"it needs {step.gpus} GPU{'s' * (step.gpus > 1)}, this machine has {places.gpus}"
                if problem:
                    problems.append(f"{name} cannot start: {problem}.")
                    finished[name] = False
                    del waiting[name]
                elif step.busy():
                    finished.pop(name, None)
                    if name not in said_busy:
                        said_busy.add(name)
                        say(f"{name}: in progress in another process; waiting for its end{_how_to_end(plan.out, name)}")
                elif is_done(name):
                    del waiting[name]
                else:
                    taken = places.take(step.gpus) if cluster == "local" else []
                    if taken is not None:
                        del waiting[name]
                        executor = _executor(submitit, plan.out, cluster, step, taken, options or {})
                        job = _submitted(executor, Job(step, plan.out))
                        running[name] = (job, taken)
                        on = f" on GPU {', '.join(map(str, taken))}" if step.gpus and taken else ""
                        say(f"{name}: begun{on} (job {job.job_id})")
            if waiting or running:
                time.sleep(_POLL)
    except KeyboardInterrupt:
        if cluster == "local":
            for job, _ in running.values():
                os.kill(int(job.job_id), signal.SIGTERM)  # submitit's process passes it on to the command
            say("Stopping: trainings write a checkpoint. The same command continues from there.")
        else:
            say("The jobs of Slurm continue (scancel ends them). The same command waits for them.")
        raise
    return problems


@dataclass
class Job:
    """What submitit runs: the commands that a step needs now. It returns what went wrong, in a line; None if nothing
    did."""

    step: Step
    out: Path
    process: subprocess.Popen | None = None

    def __call__(self) -> str | None:
        """Run the commands, one after another, while they succeed."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: self.process and self.process.send_signal(number))
        log = log_of(self.out, self.step.name)
        owner = log.with_suffix(".process")
        write_whole(owner, f"{os.getpid()} {socket.gethostname()}")
        try:
            for command in [] if self.step.done() else self.step.commands():
                code = self._run(command, log)
                if code != 0:
                    return _last_line(log.read_text(errors="replace")) or f"it ended with {code}"
        except XResetError as error:
            return str(error)
        finally:
            owner.unlink(missing_ok=True)
        return None

    def checkpoint(self) -> Any:
        """Let the training write its checkpoint, and continue in another job: submitit calls this when a job's time is
        over."""
        if self.process is not None:
            self.process.terminate()
            # Not wait(): this is a signal handler, perhaps inside of wait(), which holds a lock.
            os.waitid(os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT)
        return _submitit().helpers.DelayedSubmission(Job(self.step, self.out))

    def _run(self, command: list[str], log: Path) -> int:
        with log.open("a") as file:
            file.write(f"$ {shown_command(command)}\n")
            file.flush()
            self.process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
            return self.process.wait()


def log_of(out: Path, name: str) -> Path:
    """Return the file with the output of a step's commands."""
    return out / "logs" / f"{name.replace(' ', '-')}.log"


def _how_to_end(out: Path, name: str) -> str:
    """Return how to end a step that another study has begun; empty if it is not known."""
    try:
        process, host = log_of(out, name).with_suffix(".process").read_text().split()
    except (OSError, ValueError):
        return ""
    if not process.isdecimal() or not host.isprintable():
        return ""
    return f" (to end it: kill {process} on {host}; a training writes a checkpoint)"


def shown_command(command: Sequence[str]) -> str:
    """Return a command as a user would type it."""
    text = shlex.join(command)
    python = shlex.quote(sys.executable)
    return text.replace(f"{python} -m torch.distributed.run", "torchrun").replace(f"{python} -m xreset", "xreset")


def _submitit() -> Any:
    with needs("submitit, which runs studies,", "study"):
        import submitit
    return submitit


def _executor(submitit: Any, out: Path, cluster: Cluster, step: Step, gpus: list[int], options: dict[str, Any]) -> Any:
    folder = out / "logs" / "jobs"
    try:
        if cluster == "local":
            executor = submitit.LocalExecutor(folder)
            visible = tuple(gpu for gpu in gpus if gpu != Places.CPU)
            executor.update_parameters(gpus_per_node=step.gpus, visible_gpus=visible, timeout_min=_NO_LIMIT)
        else:
            executor = submitit.SlurmExecutor(folder, max_num_timeout=_REQUEUES)
            executor.update_parameters(job_name=step.name.replace(" ", "-"), gpus_per_node=step.gpus, **options)
    except (RuntimeError, ValueError, OSError) as error:
        raise RunError(f"submitit cannot start jobs ({cluster}): {error}") from error
    return executor


def _submitted(executor: Any, job: Job) -> Any:
    """Submit a job. Ctrl-C is left to :func:`launch`: submitit's own process would kill the training a second after
    it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return executor.submit(job)
    finally:
        signal.signal(signal.SIGINT, before)


def _problem_of(job: Any) -> str | None:
    """Return why a job failed, in a line; None if it did not."""
    try:
        return job.result()
    except Exception as error:  # submitit has several, and raises again what the job raised
        return _last_line(str(error)) or type(error).__name__


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else ""
