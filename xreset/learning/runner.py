"""The training loop on rsl-rl's runner: iterations, checkpoints, a clean stop."""

from __future__ import annotations

import math
import signal
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict

from xreset.env import ManipulationEnv
from xreset.errors import RunError
from xreset.learning.checkpoint import Checkpoint, check_moments, must_fit, read_checkpoint, write_checkpoint
from xreset.learning.config import TrainConfig, rsl_rl_config, value_at
from xreset.learning.distributed import Processes
from xreset.learning.log import TrainingLog


class TrainingRunner(OnPolicyRunner):
    """Runs iterations of PPO, or of a distillation, on a :class:`~xreset.env.ManipulationEnv`.

    Attributes:
        iteration: number of iterations done.
        env_steps: control steps of all worlds of all processes.
        elapsed: time of all iterations [s].
        processes: this process among those that train together.
        wandb: project of Weights & Biases to which learning curves are sent; None: they are not sent.
    """

    wandb: str | None = None

    def __init__(self, env: ManipulationEnv, config: TrainConfig, folder: Path, *, teacher: Path | None = None) -> None:
        """Build algorithm and models; rsl-rl's own logging stays off.

        Args:
            teacher: exported policy to learn from by distillation; None: the rewards teach.
        """
        self.folder = folder
        self.train_config = config
        torch.set_float32_matmul_precision("highest" if config.ppo.precision == "float32" else "high")
        settings = rsl_rl_config(config, env.num_envs, teacher)
        with redirect_stdout(StringIO()):  # rsl-rl prints the models
            super().__init__(env, settings, log_dir=None, device=str(env.device))  # pyright: ignore[reportArgumentType]
        self.world = env
        self.iteration = 0
        self.env_steps = 0
        self.elapsed = 0.0
        self._faults_before = torch.zeros(2, dtype=torch.long, device=self.device)

    def _configure_multi_gpu(self) -> None:
        """Join the other processes: as in rsl-rl's runner, but on CPUs too."""
        self.processes = Processes.of_environment()
        self.processes.join(self.device)
        self.gpu_global_rank = self.processes.rank
        self.gpu_local_rank = self.processes.local_rank
        self.gpu_world_size = self.processes.count
        self.is_distributed = self.gpu_world_size > 1
        ranks = {
            "global_rank": self.gpu_global_rank,
            "local_rank": self.gpu_local_rank,
            "world_size": self.gpu_world_size,
        }
        self.cfg["multi_gpu"] = ranks if self.is_distributed else None

    def learn(
        self, num_learning_iterations: int, init_at_random_ep_len: bool = False, *, seconds: float = math.inf
    ) -> None:
        """Train until a number of iterations is done in all, and write a checkpoint. Ctrl-C ends after an iteration.

        Args:
            num_learning_iterations: iterations in all, those of a resumed run included.
            init_at_random_ep_len: start the first episodes at random times.
            seconds: most time to spend here; the present iteration is completed.
        """
        env = self.world
        total = num_learning_iterations
        if init_at_random_ep_len:
            env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        obs = env.get_observations()
        log = None
        if self.processes.is_main:
            log = TrainingLog(self.folder, env.num_envs, str(env.device), total, self.wandb)
            log.clock.resume(self.iteration)
        saved_at = self.iteration
        steps = self.cfg["num_steps_per_env"] * env.num_envs * self.gpu_world_size
        budget = FaultBudget(steps)
        begin = time.perf_counter()
        with _stop_on_interrupt() as requests:
            while self.iteration < total:
                if self._agreed(bool(requests) or time.perf_counter() - begin > seconds):
                    break
                start = time.perf_counter()
                self._follow_schedule(max(self.iteration / total, (start - begin) / seconds))
                with torch.no_grad():
                    obs = self._roll_out(obs, log)
                    self._check_finite(obs)
                    self._check_faults(budget)
                    collected = time.perf_counter()
                    self.alg.compute_returns(obs)
                losses = self.alg.update()
                now = time.perf_counter()
                self.iteration += 1
                self.env_steps += steps
                self.elapsed += now - start
                if log is not None:
                    scalars = {f"loss/{name}": value for name, value in losses.items()} | {
                        "policy/std": float(self.alg.get_policy().output_std.detach().mean()),
                        "policy/learning_rate": self.alg.learning_rate,
                        "speed/env_steps_per_second": steps / (now - start),
                        "speed/collect_seconds": collected - start,
                        "speed/learn_seconds": now - collected,
                    }
                    log.write(self.iteration, self.env_steps, self.elapsed, scalars)
                if self.iteration % self.train_config.save_interval == 0:
                    self.save_checkpoint()
                    saved_at = self.iteration
        if self.iteration != saved_at or not self.iteration:
            self.save_checkpoint()
        if log is not None:
            log.close(stopped=self.iteration < total)

    def _roll_out(self, obs: TensorDict, log: TrainingLog | None) -> TensorDict:
        """Let the policy act for a horizon; returns the last observations."""
        for _ in range(self.cfg["num_steps_per_env"]):
            obs, reward, done, extras = self.world.step(self.alg.act(obs))
            self.alg.process_env_step(obs, reward, done, extras)
            if log is not None:
                log.add(reward, done, extras["log"])
        return obs

    def _follow_schedule(self, progress: float) -> None:
        """Set what changes during a run to its values at a share of the run."""
        schedule = self.train_config.schedule
        if schedule.success_position:
            self.world.set_success_position(value_at(schedule.success_position, progress))
        if schedule.faults:
            self.world.variation.set_fault_scale(value_at(schedule.faults, progress))
        if schedule.teacher:
            self.alg.teacher_share = value_at(schedule.teacher, progress)

    def _agreed(self, stop: bool) -> bool:
        """Whether any process is to stop: then all do, after the same iteration."""
        return bool(self.processes.sum(torch.tensor(int(stop), device=self.device)))

    def save_checkpoint(self) -> None:
        """Write ``checkpoints/ITERATION.pt``, in the main process."""
        if not self.processes.is_main:
            return
        content = Checkpoint(
            **self.alg.save(),
            iteration=self.iteration,
            env_steps=self.env_steps,
            elapsed=self.elapsed,
            learning_rate=self.alg.learning_rate,
        )
        write_checkpoint(self.folder / "checkpoints" / f"{self.iteration:06d}.pt", content)

    def load_checkpoint(self, path: Path) -> None:
        """Continue from a checkpoint: models, optimizer and counters. Episodes begin again."""
        content = read_checkpoint(path, self.device)
        with must_fit(path):
            self.alg.load(vars(content), None, strict=True)
            check_moments(self.alg.optimizer)
        self.alg.learning_rate = content.learning_rate
        self.iteration = content.iteration
        self.env_steps = content.env_steps
        self.elapsed = content.elapsed

    def load_networks(self, path: Path) -> None:
        """Start with the actor and the critic of another run's checkpoint, with normalization and standard deviation.

        An adaptive learning rate starts where the other run's rate was: a new run's rate would undo in one step what
        the networks have learned.
        """
        content = read_checkpoint(path, self.device)
        with must_fit(path):
            self.alg.load(vars(content), {"actor": True, "critic": True}, strict=True)
        if self.train_config.ppo.schedule == "adaptive":
            self.alg.learning_rate = content.learning_rate

    def _check_faults(self, budget: FaultBudget) -> None:
        """End the run if too many worlds broke. Every process comes to the same result."""
        env = self.world
        total = torch.stack((env.nonfinite_count, env.overflow_count))
        nonfinite, overflow = self.processes.sum(total - self._faults_before).tolist()
        self._faults_before = total
        if problem := budget.add(nonfinite, overflow):
            raise RunError(
                f"The run ends: {problem}. Look for what the robot or an object does that the engine cannot simulate. "
                f"Then continue from the last checkpoint: xreset train --out {self.folder} --resume"
            )

    def _check_finite(self, obs: TensorDict) -> None:
        """Refuse observations that are not finite, once per iteration: they come from worlds whose health was sound."""
        for group, value in obs.items():
            if not bool(value.isfinite().all()):
                raise RunError(
                    f"The observation group {group!r} is not finite at iteration {self.iteration}. Continue from the "
                    f"last checkpoint: xreset train --out {self.folder} --resume"
                )


MAX_SHARE = 1e-3
"""Largest share of world-steps that may break; the run ends beyond it."""
WINDOW = 200
"""Iterations over which the share is taken. The first iterations may use the allowance of the whole window."""


class FaultBudget:
    """The faults of the last :data:`WINDOW` iterations."""

    def __init__(self, steps_per_iteration: int) -> None:
        """Start with none; ``steps_per_iteration`` is the number of world-steps of an iteration, over all processes."""
        self.allowed = MAX_SHARE * WINDOW * steps_per_iteration
        self._window_steps = WINDOW * steps_per_iteration
        self._recent: deque[tuple[int, int]] = deque(maxlen=WINDOW)

    def add(self, nonfinite: int, overflow: int) -> str | None:
        """Add an iteration's faults; return a message if there are too many.

        Args:
            nonfinite: number of worlds that were ended because a position or velocity was not finite.
            overflow: number of worlds that were ended because contacts or constraints were dropped.
        """
        self._recent.append((nonfinite, overflow))
        nonfinite = sum(counts[0] for counts in self._recent)
        overflow = sum(counts[1] for counts in self._recent)
        if nonfinite + overflow <= self.allowed:
            return None
        return (
            f"{nonfinite} worlds were not finite and {overflow} dropped contacts or constraints in the last "
            f"{len(self._recent)} iterations, more than {MAX_SHARE:.1%} of the {self._window_steps} world-steps of "
            f"{WINDOW} iterations"
        )


_SAME_REQUEST = 2.0
"""[s] within which signals are one request: under torchrun, Ctrl-C arrives from the terminal and from torchrun."""


@contextmanager
def _stop_on_interrupt() -> Iterator[list[float]]:
    """Yield the times of requests to stop (Ctrl-C or SIGTERM). A second request interrupts at once."""
    requests: list[float] = []

    def ask(_number: int, _frame: Any) -> None:
        if requests and time.monotonic() - requests[0] > _SAME_REQUEST:
            raise KeyboardInterrupt
        requests.append(time.monotonic())

    try:
        before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    except ValueError:  # not in the main thread: signals go elsewhere
        yield requests
        return
    try:
        yield requests
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
