"""The training loop on rsl-rl's runner: iterations, checkpoints, a clean stop."""

from __future__ import annotations

import math
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from rsl_rl.runners import OnPolicyRunner
from tensordict import TensorDict
from torch import Tensor

from xreset.env import ManipulationEnv
from xreset.errors import RunError
from xreset.learning.checkpoint import must_fit, read_checkpoint, read_state, write_state
from xreset.learning.config import TrainConfig, rsl_rl_config
from xreset.learning.distributed import Processes
from xreset.learning.faults import FaultBudget, dump_faults, too_many_faults
from xreset.learning.log import TrainingLog
from xreset.learning.schedules import value_at


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
        super().__init__(env, settings, log_dir=None, device=str(env.device))  # pyright: ignore[reportArgumentType]
        self.world = env
        self.iteration = 0
        self.env_steps = 0
        self.elapsed = 0.0
        self._log_state: dict[str, Any] | None = None
        self._worlds_continue = False
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
        if init_at_random_ep_len and not self._worlds_continue:
            env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
        self.alg.train_mode()
        if self.is_distributed:
            self.alg.broadcast_parameters()
        obs = env.get_observations()
        log = None
        if self.processes.is_main:
            log = TrainingLog(self.folder, env.num_envs, str(env.device), total, self.wandb)
            log.clock.resume(self.iteration)
            if self._log_state is not None:
                log.restore(self._log_state)
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
                    self.save_checkpoint(log)
                    saved_at = self.iteration
        if self.iteration != saved_at or not self.iteration:
            self.save_checkpoint(log)
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
        if schedule.demo_probability:
            self.world.resets.demo_probability.fill_(value_at(schedule.demo_probability, progress))
        if schedule.success_position:
            self.world.set_success_position(value_at(schedule.success_position, progress))
        if schedule.faults:
            self.world.variation.set_fault_scale(value_at(schedule.faults, progress))
        if schedule.teacher:
            self.alg.teacher_share = value_at(schedule.teacher, progress)

    def _agreed(self, stop: bool) -> bool:
        """Whether any process is to stop: then all do, after the same iteration."""
        return bool(self.processes.sum(torch.tensor(int(stop), device=self.device)))

    def save_checkpoint(self, log: TrainingLog | None = None) -> None:
        """Write ``checkpoints/ITERATION.pt`` and ``worlds.pt``. All processes must call it; the main one writes.

        ``worlds.pt`` holds the worlds, the models' memories and the running means of the log: with it a run continues
        in the middle of its episodes. Only the newest one is kept.
        """
        worlds = self.processes.gather(self._worlds_state())
        random = self.processes.gather(self._random_state())
        if not self.processes.is_main:
            return
        state = {"iteration": self.iteration, "processes": worlds, "log": None if log is None else log.state()}
        write_state(self.folder / "worlds.pt", state)
        content = self.alg.save() | {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "elapsed": self.elapsed,
            "learning_rate": self.alg.learning_rate,
            "random": random,
        }
        write_state(self.folder / "checkpoints" / f"{self.iteration:06d}.pt", content)

    def load_checkpoint(self, path: Path) -> None:
        """Continue from a checkpoint: models, optimizer, counters and random state; the worlds too if ``worlds.pt``
        fits."""
        content = read_checkpoint(path, self.device)
        with must_fit(path):
            self.alg.load(content, None, strict=True)
            self.alg.learning_rate = float(content["learning_rate"])
            self.iteration = content["iteration"]
            self.env_steps = content["env_steps"]
            self.elapsed = float(content["elapsed"])
            if self.processes.rank < len(content["random"]):
                self._set_random_state(content["random"][self.processes.rank])
        self._continue_worlds()

    def load_networks(self, path: Path) -> None:
        """Start with the actor and the critic of another run's checkpoint, with normalization and standard deviation.

        An adaptive learning rate starts where the other run's rate was: a new run's rate would undo in one step what
        the networks have learned.
        """
        content = read_checkpoint(path, self.device)
        with must_fit(path):
            self.alg.load(content, {"actor": True, "critic": True}, strict=True)
        if self.train_config.ppo.schedule == "adaptive":
            self.alg.learning_rate = content["learning_rate"]

    def _worlds_state(self) -> dict[str, Any]:
        """Return the state of this process's worlds, and of the models' memories of them."""
        memories = {"actor": self.alg.actor.get_hidden_state(), "critic": self.alg.critic.get_hidden_state()}
        return {"env": self.world.snapshot(), "memories": memories}

    def _continue_worlds(self) -> None:
        """Continue in the middle of episodes if ``worlds.pt`` fits; otherwise the episodes start again."""
        path = self.folder / "worlds.pt"
        if not path.exists():
            return
        before = self.world.snapshot()
        models = {"actor": self.alg.actor, "critic": self.alg.critic}
        try:
            content = read_state(path, self.device)
            with must_fit(path):
                if content["iteration"] != self.iteration or self.processes.rank >= len(content["processes"]):
                    return
                mine = content["processes"][self.processes.rank]
                if not self.world.restore(mine["env"]):
                    return
                for name, model in models.items():
                    model.reset(hidden_state=mine["memories"][name])
                self._log_state = content["log"]
            self._worlds_continue = True
        except RunError:
            print(f"{path} is damaged or of another run: episodes start again.", flush=True)
            self.world.restore(before)
            for model in models.values():
                model.reset()

    def _random_state(self) -> dict[str, Tensor | None]:
        """Return the state of the random numbers that this process draws."""
        return {
            "env": self.world.rng_state().cpu(),
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state() if torch.cuda.is_available() else None,
        }

    def _set_random_state(self, state: dict[str, Tensor | None]) -> None:
        if state["torch"] is not None:
            torch.set_rng_state(state["torch"].cpu())
        if state["cuda"] is not None and torch.cuda.is_available():
            torch.cuda.set_rng_state(state["cuda"].cpu())
        if state["env"] is not None and state["env"].shape == self.world.rng_state().shape:
            self.world.set_rng_state(state["env"])

    def _check_faults(self, budget: FaultBudget) -> None:
        """End the run if too many worlds broke, leaving them in ``faults.npz``. Every process comes to the same
        result."""
        env = self.world
        total = torch.stack((env.nonfinite_count, env.overflow_count))
        nonfinite, overflow = self.processes.sum(total - self._faults_before).tolist()
        self._faults_before = total
        if problem := budget.add(nonfinite, overflow):
            path = self.folder / (f"faults-{self.processes.rank}.npz" if self.is_distributed else "faults.npz")
            dump_faults(path, env, self.train_config, iteration=self.iteration)
            raise too_many_faults(problem, path, self.folder)

    def _check_finite(self, obs: TensorDict) -> None:
        """Refuse observations that are not finite, once per iteration: they come from worlds whose health was sound."""
        for group, value in obs.items():
            bad = ~value.flatten(1).isfinite().all(dim=1)
            if bool(bad.any()):
                worlds = bad.nonzero().squeeze(-1)[:10].tolist()
                raise RunError(
                    f"the observation group {group!r} is not finite in {int(bad.sum())} worlds (first: {worlds}) at "
                    f"iteration {self.iteration}. Continue from the last checkpoint: "
                    f"xreset train --out {self.folder} --resume"
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
