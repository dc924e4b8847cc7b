"""Does the steps of a plan, through submitit: as processes on this machine, spread over its GPUs, or as jobs of Slurm.

A step looks at what is there when it begins, so one that was killed, requeued or started twice goes on or finds itself done.
"""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from xreset.errors import RunError, XResetError, needs
from xreset.eval.study.plan import Plan, Step

Cluster = Literal["local", "slurm"]
_POLL = 0.5
"""[s]"""
_REQUEUES = 1000
"""How often a job of Slurm whose time is over may go on in another."""
_NO_LIMIT = 60 * 24 * 365
"""[min]"""


class Places:
    """Room for steps on this machine: so many at a time on each GPU, and one on the CPU beside them."""

    CPU = -1

    def __init__(self, gpus: Sequence[int], per_gpu: int) -> None:
        """All free."""
        self.per_gpu = per_gpu
        self.free = dict.fromkeys(gpus, per_gpu) | {self.CPU: 1}

    def take(self, gpus: int) -> list[int] | None:
        """Room for a step, or None while there is none. A step of several GPUs has each to itself."""
        each = self.per_gpu if gpus > 1 else 1
        room = sorted(
            (p for p, free in self.free.items() if free >= each and (p == self.CPU) == (gpus == 0)),
            key=lambda p: -self.free[p],
        )
        taken = room[: max(gpus, 1)]
        if len(taken) < max(gpus, 1):
            return None
        for place in taken:
            self.free[place] -= each
        return taken

    def give(self, places: Sequence[int]) -> None:
        """Free what a step had."""
        for place in places:
            self.free[place] += self.per_gpu if len(places) > 1 else 1


def visible_gpus() -> tuple[int, ...]:
    """Numbers of the GPUs of this machine that may be used."""
    import torch

    listed = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    count = torch.cuda.device_count()
    numbers = [int(text) for text in listed.split(",") if text.strip().isdecimal()]
    return tuple(numbers[:count]) if numbers else tuple(range(count))


def launch(
    plan: Plan,
    steps: Sequence[Step],
    *,
    cluster: Cluster,
    per_gpu: int = 1,
    options: dict[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> list[str]:
    """Do steps that are not done, each as soon as those that it needs are done.

    Args:
        per_gpu: trainings at a time on each GPU of this machine.
        options: of ``submitit.SlurmExecutor``, such as ``partition`` and ``time`` [min].

    Returns:
        What failed, or could not begin: sentences.

    Raises:
        XResetError: submitit is missing, or refuses the options.
    """
    submitit = _submitit()
    places = Places(visible_gpus() if cluster == "local" else (), per_gpu)
    waiting, running, problems = {s.name: s for s in steps}, {}, []
    told: set[str] = set()
    try:
        while waiting or running:
            for name, (step, job, taken) in list(running.items()):
                if not job.done():
                    continue
                del running[name]
                places.give(taken)
                problem = _problem_of(job) or (None if step.done() else "it ended before it was done")
                say(f"{name}: {problem or 'done'}")
                problems += [f"{name}: {problem}. What it printed: {log_of(plan.out, name)}"] if problem else []
            for name, step in list(waiting.items()):
                if any(need in waiting or need in running for need in step.needs):
                    continue
                if undone := [need for need in step.needs if not plan.steps[need].done()]:
                    problems.append(f"{name} could not begin: {', '.join(undone)} is not done.")
                    del waiting[name]
                elif cluster == "local" and step.gpus > len(places.free) - 1:
                    problems.append(
                        f"{name} could not begin: it needs {_count(step.gpus)}, and here is {len(places.free) - 1}."
                    )
                    del waiting[name]
                elif step.busy():
                    if name not in told:
                        told.add(name)
                        say(f"{name}: another command is at it; waiting for its end")
                elif step.done():
                    del waiting[name]
                elif (taken := places.take(step.gpus) if cluster == "local" else []) is not None:
                    executor = _executor(submitit, plan.out, cluster, step, taken, options or {})
                    running[name] = (waiting.pop(name), _submitted(executor, Job(step, plan.out)), taken)
                    on = f" on GPU {', '.join(map(str, taken))}" if step.gpus and taken else ""
                    say(f"{name}: begun{on} (job {running[name][1].job_id})")
            if waiting or running:
                time.sleep(_POLL)
    except KeyboardInterrupt:
        if cluster == "local":
            for _, job, _ in running.values():
                os.kill(int(job.job_id), signal.SIGTERM)  # of submitit's process for the job, which hands it on
            say("Stopping: trainings write a checkpoint. The same command goes on from there.")
        else:
            say("The jobs of Slurm go on (scancel ends them). The same command waits for them.")
        raise
    return problems


@dataclass
class Job:
    """What submitit runs: the commands that a step needs now. Returns what went wrong, in a line; None if nothing."""

    step: Step
    out: Path
    process: subprocess.Popen | None = None

    def __call__(self) -> str | None:
        """Run them, one after another, while they succeed."""
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda number, _: self.process and self.process.send_signal(number))
        try:
            for command in [] if self.step.done() else self.step.commands():
                if (code := self._run(command)) != 0:
                    return _last_line(log_of(self.out, self.step.name)) or f"it ended with {code}"
        except XResetError as error:
            return str(error)
        return None

    def checkpoint(self) -> Any:
        """Called by submitit when a job's time is over: the training writes its checkpoint, and the job goes on in another."""
        if self.process is not None:
            self.process.terminate()
            os.waitid(
                os.P_PID, self.process.pid, os.WEXITED | os.WNOWAIT
            )  # a signal handler inside of wait(), which has a lock
        return _submitit().helpers.DelayedSubmission(Job(self.step, self.out))

    def _run(self, command: list[str]) -> int:
        log = log_of(self.out, self.step.name)
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as file:
            file.write(f"$ {shown_command(command)}\n")
            file.flush()
            self.process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT)
            return self.process.wait()


def log_of(out: Path, name: str) -> Path:
    """Where the commands of a step print."""
    return out / "logs" / f"{name.replace(' ', '-')}.log"


def shown_command(command: Sequence[str]) -> str:
    """A command to read, and to give by hand."""
    text = shlex.join(command)
    python = shlex.quote(sys.executable)
    return text.replace(f"{python} -m torch.distributed.run", "torchrun").replace(f"{python} -m xreset", "xreset")


def _submitit() -> Any:
    with needs("submitit, which runs studies,", "study"):
        import submitit
    return submitit


def _executor(
    submitit: Any, out: Path, cluster: Cluster, step: Step, gpus: Sequence[int], options: dict[str, Any]
) -> Any:
    folder = out / "logs" / "jobs"
    try:
        if cluster == "local":
            executor = submitit.LocalExecutor(folder)
            visible = tuple(g for g in gpus if g != Places.CPU)
            executor.update_parameters(gpus_per_node=step.gpus, visible_gpus=visible, timeout_min=_NO_LIMIT)
        else:
            executor = submitit.SlurmExecutor(folder, max_num_timeout=_REQUEUES)
            executor.update_parameters(job_name=step.name.replace(" ", "-"), gpus_per_node=step.gpus, **options)
    except (RuntimeError, ValueError, OSError) as error:
        raise RunError(f"submitit cannot start jobs ({cluster}): {error}") from error
    return executor


def _submitted(executor: Any, job: Job) -> Any:
    """Submit, leaving Ctrl-C to :func:`launch`: submitit's own process would kill the training a second after it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        return executor.submit(job)
    finally:
        signal.signal(signal.SIGINT, before)


def _problem_of(job: Any) -> str | None:
    """Why a job failed, in a line."""
    try:
        return job.result()
    except Exception as error:  # submitit has several, and re-raises what the job raised
        lines = [line for line in str(error).splitlines() if line.strip()]
        return lines[-1] if lines else type(error).__name__


def _last_line(log: Path) -> str:
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1] if lines else ""


def _count(gpus: int) -> str:
    return "a GPU" if gpus == 1 else f"{gpus} GPUs"
