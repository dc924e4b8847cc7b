"""The training loop: iterations, checkpoints, a clean stop."""

from __future__ import annotations

import os
import signal
import stat
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv
from xreset.env.several import SeveralEnvs
from xreset.errors import RunError
from xreset.learning.checkpoint import (
    Checkpoint,
    load_moments,
    must_fit,
    read_checkpoint,
    write_checkpoint,
)
from xreset.learning.config import TrainConfig
from xreset.learning.distillation import LED, SequenceDistillation
from xreset.learning.distributed import Processes
from xreset.learning.log import TrainingLog
from xreset.learning.ppo import SequencePpo
from xreset.learning.recipes import resume_command
from xreset.physics.tensors import one_thread

MAX_FAULTY_SHARE = 1e-3
"""Largest share of world-steps that may break; the run ends beyond it."""
_ONE_THREAD_BATCH = 1024
"""Largest minibatch [transitions] that is computed by one thread on the CPU. A second thread makes 144, 576 and 2304
transitions 0.9, 1.1 and 1.3 times as fast on a free core, and waits in a busy loop if the core is not free: a training
next to two busy processes on two cores is then slower by a third."""
FAULT_WINDOW = 200
"""Iterations over which the share is taken. The first iterations may use the allowance of the whole window."""


class TrainingRunner:
    """Runs iterations of PPO, or of a distillation, on a :class:`~xreset.env.manipulation.ManipulationEnv`.

    Attributes:
        iteration: number of iterations done.
        env_steps: control steps of all worlds of all processes.
        elapsed: time of all iterations [s].
        processes: this process among those that train together.
        alg: the algorithm, with its networks.
    """

    def __init__(
        self,
        env: ManipulationEnv | SeveralEnvs,
        config: TrainConfig,
        folder: Path,
        *,
        teacher: Path | None = None,
        wandb: str | None = None,
    ) -> None:
        """Build algorithm and networks.

        Args:
            env: the worlds of this process.
            config: the training.
            folder: run folder.
            teacher: exported policy to learn from by distillation; None: the rewards teach.
            wandb: project of Weights & Biases to which learning curves are sent; None: they are not sent.
        """
        self.env = env
        self.config = config
        self.folder = folder
        self.wandb = wandb
        self.device = str(env.device)
        torch.set_float32_matmul_precision(
            "highest" if config.ppo.precision == "float32" else "high"
        )
        self.processes = Processes.of_environment()
        self.processes.join(self.device)
        given = (env.get_observations(), env.num_actions, config, self.device, self.processes)
        self.alg: SequencePpo | SequenceDistillation
        if teacher is None:
            self.alg = SequencePpo(*given)
        else:
            self.alg = SequenceDistillation(*given, teacher)
        self.iteration = 0
        self.env_steps = 0
        self.elapsed = 0.0
        self._average = {}
        if config.ppo.average > 0:
            self._average = {name: value.clone() for name, value in self._actor_state().items()}
        self._fault_totals = deque([[0, 0]], maxlen=FAULT_WINDOW)
        self._resume_command = resume_command(folder, config.task.reward.own)

    def learn(self, total: int | None, *, minutes: float | None = None) -> int | None:
        """Train until a number of iterations is done in all or a time is over, and write a checkpoint.

        A signal (Ctrl-C, SIGTERM or SIGHUP) ends the training earlier, after an iteration. The first episodes start at
        random times, so that the worlds do not end them together.

        Args:
            total: iterations in all, those of a resumed run included; None: any number.
            minutes: time of training in all, that of a resumed run included; the present iteration is completed. None:
                any time.

        Returns:
            The signal that ended the training before its end; None: it ended by itself.
        """
        env = self.env
        env.episode_length_buf = torch.randint_like(
            env.episode_length_buf, high=env.max_episode_length
        )
        self.alg.train_mode()
        if self.processes.count > 1:
            self.alg.broadcast_parameters()
        obs = env.get_observations()
        log = None
        if self.processes.is_main:
            log = TrainingLog(
                self.folder,
                env.num_envs,
                self.device,
                total,
                self.wandb,
                minutes=minutes,
                done=self.iteration,
            )
        saved_at = self.iteration
        minibatch = min(self.config.ppo.minibatch_size, self.config.ppo.horizon * env.num_envs)
        is_small = self.device == "cpu" and minibatch <= _ONE_THREAD_BATCH
        with (
            one_thread() if is_small else nullcontext(),
            _stop_on_interrupt(say=self.processes.is_main) as requests,
        ):
            while not self._agreed(bool(requests) or self._progress(total, minutes) >= 1):
                self._let_teacher_lead(self._progress(total, minutes))
                obs = self._iterate(obs, log)
                if self.iteration % self.config.save_interval == 0:
                    self.save_checkpoint()
                    saved_at = self.iteration
                    if log is not None:
                        log.write_lift()
        if self.iteration != saved_at or not self.iteration:
            self.save_checkpoint()
        is_done = self._progress(total, minutes) >= 1
        if log is not None:
            log.close()
            if not is_done:
                print(
                    "stopped after the current iteration; a checkpoint is written. To continue: "
                    + self._resume_command
                )
        return requests[0].number if requests and not is_done else None

    def _progress(self, total: int | None, minutes: float | None) -> float:
        """Return the share of the training that is done, by iterations or by minutes, whichever is larger."""
        by_iterations = 0.0 if total is None else self.iteration / total
        by_minutes = 0.0 if minutes is None else self.elapsed / (60 * minutes)
        return max(by_iterations, by_minutes)

    def _agreed(self, stop: bool) -> bool:
        """Whether any process is to stop: then all do, after the same iteration."""
        return bool(self.processes.sum(torch.tensor(int(stop), device=self.device)))

    def _let_teacher_lead(self, progress: float) -> None:
        """Let the teacher of a student act in as many worlds as at a share of the run (:data:`LED`)."""
        if isinstance(self.alg, SequenceDistillation):
            self.alg.teacher_share = float(np.interp(progress, (0.0, LED), (1.0, 0.0)))

    def _iterate(self, obs: TensorDict, log: TrainingLog | None) -> TensorDict:
        """Collect a rollout, learn from it and write the log; return the last observations."""
        steps = self.config.ppo.horizon * self.env.num_envs * self.processes.count
        start = time.perf_counter()
        obs = self._roll_out(obs, log)
        self._check_faults(steps)
        collected = time.perf_counter()
        with torch.no_grad():
            self.alg.compute_returns(obs)
        losses = self.alg.update()
        learned = time.perf_counter()
        self.iteration += 1
        self.env_steps += steps
        self.elapsed += learned - start
        if self._average:
            self._take_average()
        if log is None:
            return obs
        scalars = {f"loss/{name}": value for name, value in losses.items()}
        scalars |= {
            "policy/std": float(self.alg.networks["actor"].mean_std()),
            "policy/learning_rate": self.alg.learning_rate,
            "speed/env_steps_per_second": steps / (learned - start),
            "speed/collect_seconds": collected - start,
            "speed/learn_seconds": learned - collected,
        }
        if isinstance(self.alg, SequenceDistillation):
            scalars["policy/teacher_share"] = self.alg.teacher_share
        log.write(self.iteration, self.env_steps, self.elapsed, scalars)
        return obs

    def _actor_state(self) -> dict[str, Tensor]:
        return self.alg.networks["actor"].state_dict()

    def _take_average(self) -> None:
        """Take the actor's state into its running mean."""
        weight = 1.0 / (1.0 + self.config.ppo.average * (self.iteration - 1))
        now = self._actor_state()
        for name, mean in self._average.items():
            if mean.is_floating_point():
                mean.lerp_(now[name], weight)
            else:  # the normalization's count of observations
                mean.copy_(now[name])

    @torch.no_grad()
    def _roll_out(self, obs: TensorDict, log: TrainingLog | None) -> TensorDict:
        """Let the policy act for a horizon, and return the last observations."""
        for _ in range(self.config.ppo.horizon):
            obs, reward, done, extras = self.env.step(self.alg.act(obs))
            self.alg.process_env_step(obs, reward, done, extras)
            if log is not None:
                log.add(reward, done, extras["log"])
        self._check_finite(obs)
        # each process plays its own episodes of the same demonstrations
        rates = self.env.resets.success_rate
        rates.copy_(self.processes.mean(rates))
        return obs

    def _check_finite(self, obs: TensorDict) -> None:
        """Refuse a rollout with numbers that are not finite, of which networks would learn nothing else, given its last
        observations. They come from worlds whose health was sound."""
        storage = self.alg.storage
        numbers = [*storage.observations.items(), *obs.items(), ("reward", storage.rewards)]
        are_finite = torch.stack([value.isfinite().all() for _, value in numbers]).tolist()
        if all(are_finite):
            return
        wrong = {name: None for (name, _), ok in zip(numbers, are_finite, strict=True) if not ok}
        if own := ", ".join(self.env.task.reward.own):
            remedy = f"Do your own reward terms return finite numbers ({own})?"
        else:
            remedy = f"Continue from the last checkpoint: {self._resume_command}"
        raise RunError(
            f"Numbers are not finite at iteration {self.iteration}: {', '.join(wrong)}. {remedy}"
        )

    def _check_faults(self, steps: int) -> None:
        """End the run if too many worlds broke. Every process comes to the same result.

        Args:
            steps: world-steps of an iteration, of all processes.
        """
        counts = torch.stack((self.env.nonfinite_count, self.env.overflow_count))
        now = self.processes.sum(counts).tolist()
        before = self._fault_totals[0]
        nonfinite = now[0] - before[0]
        overflow = now[1] - before[1]
        if nonfinite + overflow > MAX_FAULTY_SHARE * FAULT_WINDOW * steps:
            raise RunError(
                f"The run ends: {nonfinite} worlds were not finite and {overflow} dropped contacts or constraints in "
                f"the last {len(self._fault_totals)} iterations, more than {MAX_FAULTY_SHARE:.1%} of the "
                f"{FAULT_WINDOW * steps} world-steps of {FAULT_WINDOW} iterations. Look for what the robot or an "
                "object does that the engine cannot simulate. Then continue from the last checkpoint: "
                f"{self._resume_command}"
            )
        self._fault_totals.append(now)

    def save_checkpoint(self) -> None:
        """Write ``checkpoints/ITERATION.pt``, in the main process."""
        if not self.processes.is_main:
            return
        content = Checkpoint(
            **{
                f"{name}_state_dict": network.state_dict()
                for name, network in self.alg.networks.items()
            },
            optimizer_state_dict=self.alg.optimizer.state_dict(),
            iteration=self.iteration,
            env_steps=self.env_steps,
            elapsed=self.elapsed,
            learning_rate=self.alg.learning_rate,
            average_state_dict=self._average,
            resets_state_dict={"success_rate": self.env.resets.success_rate},
        )
        write_checkpoint(self.folder / "checkpoints" / f"{self.iteration:06d}.pt", content)

    def load_checkpoint(self, path: Path) -> None:
        """Continue from a checkpoint: models, optimizer, counters and rates of success. Episodes begin again."""
        content = self._load(path)
        with must_fit(path):
            load_moments(self.alg.optimizer, content.optimizer_state_dict["state"])
            if content.resets_state_dict:
                self.env.resets.success_rate.copy_(content.resets_state_dict["success_rate"])
        self.alg.learning_rate = content.learning_rate
        self.iteration = content.iteration
        self.env_steps = content.env_steps
        self.elapsed = content.elapsed

    def load_networks(self, path: Path) -> None:
        """Start with the actor and the critic of another run's checkpoint, with standard deviation and normalization.

        The learning rate starts where the other run's rate was: a new run's rate would undo in one step what the
        networks have learned.
        """
        content = self._load(path)
        self.alg.learning_rate = content.learning_rate

    def _load(self, path: Path) -> Checkpoint:
        """Read a checkpoint, and load its networks."""
        content = read_checkpoint(path, self.device)
        with must_fit(path):
            for name, network in self.alg.networks.items():
                network.load_state_dict(getattr(content, f"{name}_state_dict"))
            for name, mean in self._average.items():
                mean.copy_(content.policy_state_dict[name])
        return content


_SAME_REQUEST = 2.0
"""[s] within which signals are one request: under torchrun, Ctrl-C arrives from the terminal and from torchrun."""


_STOPPING = (
    b"\nstopping after this iteration. Ctrl-C again stops at once, without a new checkpoint.\n"
)
"""What standard error says after the first request."""


class _Request(NamedTuple):
    """A signal that asks to stop."""

    number: int
    time: float
    """Of the monotonic clock [s]."""


@contextmanager
def _stop_on_interrupt(*, say: bool = False) -> Iterator[list[_Request]]:
    """Yield the requests to stop: Ctrl-C, SIGTERM, or SIGHUP, which comes when the terminal closes. A second request
    interrupts at once.

    Args:
        say: whether the first request is answered on standard error, because an iteration may take minutes.
    """
    requests: list[_Request] = []

    def ask(number: int, _frame: Any) -> None:
        if number == signal.SIGHUP:
            _leave_terminal()
        if requests and time.monotonic() - requests[0].time > _SAME_REQUEST:
            raise KeyboardInterrupt
        if say and not requests:
            with suppress(OSError):  # print may be what the signal has interrupted
                os.write(2, _STOPPING)
        requests.append(_Request(number, time.monotonic()))

    numbers = [signal.SIGINT, signal.SIGTERM]
    if signal.getsignal(signal.SIGHUP) != signal.SIG_IGN:  # as nohup sets it
        numbers.append(signal.SIGHUP)
    try:
        before = {number: signal.signal(number, ask) for number in numbers}
    except ValueError:  # not in the main thread: signals go elsewhere
        yield requests
        return
    try:
        yield requests
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _leave_terminal() -> None:
    """Send what is printed from now on nowhere if it went to a terminal, because writing to a closed one fails."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        with suppress(OSError):
            if stat.S_ISCHR(os.fstat(stream).st_mode):
                os.dup2(nowhere, stream)
    os.close(nowhere)
