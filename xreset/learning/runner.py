"""The training loop on rsl-rl's runner: progress, TensorBoard, checkpoints, a clean stop."""

from __future__ import annotations

import io
import math
import signal
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import torch
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rsl_rl.runners import OnPolicyRunner
from torch import Tensor

from xreset.env import ManipulationEnv
from xreset.errors import RunError
from xreset.files import atomic_write
from xreset.learning.clock import LiftClock
from xreset.learning.config import TrainConfig, rsl_rl_config
from xreset.learning.curves import CurveFile
from xreset.learning.distributed import Processes
from xreset.learning.faults import FaultBudget, FaultCounts, dump_faults, too_many_faults
from xreset.learning.schedules import value_at
from xreset.text import shown


class TrainingRunner(OnPolicyRunner):
    """Runs PPO iterations on a :class:`~xreset.env.ManipulationEnv`."""

    def __init__(self, env: ManipulationEnv, config: TrainConfig, folder: Path) -> None:
        """Build algorithm and models; rsl-rl's own logging stays off."""
        self.folder = folder
        self.train_config = config
        torch.set_float32_matmul_precision("highest" if config.ppo.precision == "float32" else "high")
        super().__init__(env, rsl_rl_config(config, env.num_envs), log_dir=None, device=str(env.device))  # pyright: ignore[reportArgumentType]
        self.iteration = 0
        self.env_steps = 0
        self.elapsed = 0.0
        self._log_state: dict[str, Any] | None = None
        self._worlds_continue = False
        self._faults_seen = torch.zeros(2, dtype=torch.long, device=self.device)

    def _configure_multi_gpu(self) -> None:
        """What rsl-rl's runner does here, for CPUs too."""
        self.processes = Processes.of_environment()
        self.processes.join(self.device)
        self.gpu_global_rank, self.gpu_local_rank, self.gpu_world_size = (
            self.processes.rank,
            self.processes.local_rank,
            self.processes.count,
        )
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
        """Train until ``num_learning_iterations`` iterations are done in all; returns early, checkpoint written, after Ctrl-C.

        Args:
            num_learning_iterations: iterations in all, those of a resumed run included.
            init_at_random_ep_len: start the first episodes at random times.
            seconds: most time to spend here; the iteration that is under way then is finished.
        """
        env, alg, horizon = self.env, self.alg, self.cfg["num_steps_per_env"]
        if init_at_random_ep_len and not self._worlds_continue:
            env.episode_length_buf = torch.randint_like(env.episode_length_buf, high=int(env.max_episode_length))
        alg.train_mode()
        if self.is_distributed:
            alg.broadcast_parameters()
        obs = env.get_observations()
        log = (
            _Log(self.folder, env.num_envs, str(env.device), num_learning_iterations)
            if self.processes.is_main
            else None
        )
        if log is not None:
            log.clock.resume(self.iteration)
            if self._log_state is not None:
                log.restore(self._log_state)
        saved_at = self.iteration
        budget = FaultBudget(horizon * env.num_envs * self.gpu_world_size)
        begin = time.perf_counter()
        end = begin + seconds
        with _stop_on_interrupt() as stop:
            while self.iteration < num_learning_iterations and not self._agreed(
                bool(stop) or time.perf_counter() > end
            ):
                start = time.perf_counter()
                self._follow_schedule(max(self.iteration / num_learning_iterations, (start - begin) / seconds))
                with torch.no_grad():
                    for _ in range(horizon):
                        obs, reward, done, extras = env.step(alg.act(obs))
                        alg.process_env_step(obs, reward, done, extras)
                        if log is not None:
                            log.add(reward, done, extras["log"])
                    self._check_finite(obs)
                    self._check_faults(budget)
                    collected = time.perf_counter()
                    alg.compute_returns(obs)
                losses = alg.update()
                now = time.perf_counter()
                self.iteration += 1
                self.env_steps += horizon * env.num_envs * self.gpu_world_size
                self.elapsed += now - start
                if log is not None:
                    log.write(self, losses, collect=collected - start, learn=now - collected)
                if self.iteration % self.train_config.save_interval == 0:
                    self.save_checkpoint(log)
                    saved_at = self.iteration
        if self.iteration != saved_at or not self.iteration:
            self.save_checkpoint(log)
        if log is not None:
            log.close(stopped=self.iteration < num_learning_iterations)

    def _follow_schedule(self, progress: float) -> None:
        """Set what changes during a run to its values at a share of the run."""
        if points := self.train_config.schedule.demo_probability:
            cast(ManipulationEnv, self.env).resets.demo_probability.fill_(value_at(points, progress))

    def _agreed(self, stop: bool) -> bool:
        """Whether any process is to stop: then all do, after the same iteration."""
        return bool(self.processes.sum(torch.tensor(int(stop), device=self.device)))

    def save_checkpoint(self, log: _Log | None = None) -> None:
        """Write ``checkpoints/ITERATION.pt`` and ``worlds.pt``, each whole or not at all. The main process writes; all must call it.

        ``worlds.pt`` holds the worlds, the models' memories of them and the running means of the log: with it a run goes on in the middle
        of its episodes. Only the newest is kept, because nothing else needs it.
        """
        worlds = self.processes.gather(self._worlds_state())
        random = self.processes.gather(self._random_state())
        if not self.processes.is_main:
            return
        state = {"iteration": self.iteration, "processes": worlds, "log": None if log is None else log.state()}
        _write(self.folder / "worlds.pt", state)
        content = self.alg.save() | {
            "iteration": self.iteration,
            "env_steps": self.env_steps,
            "elapsed": self.elapsed,
            "learning_rate": self.alg.learning_rate,
            "random": random,
        }
        _write(self.folder / "checkpoints" / f"{self.iteration:06d}.pt", content)

    def load_checkpoint(self, path: Path) -> None:
        """Continue from a checkpoint: models, optimiser, learning rate, counters and random state; the worlds too if ``worlds.pt`` fits."""
        content = read_checkpoint(path, self.device)
        with _fits(path):
            self.alg.load(content, None, strict=True)
            self.alg.learning_rate = float(content["learning_rate"])
            self.iteration, self.env_steps, self.elapsed = (
                int(content["iteration"]),
                int(content["env_steps"]),
                float(content["elapsed"]),
            )
            if self.processes.rank < len(content["random"]):
                self._set_random_state(content["random"][self.processes.rank])
        self._continue_worlds()

    def load_networks(self, path: Path) -> None:
        """Begin with the actor and the critic of another run's checkpoint: weights, normalisation of observations, standard deviation.

        A learning rate that adapts begins where it was there: a new run's would undo in one step what they have learned.
        """
        content = read_checkpoint(path, self.device)
        with _fits(path):
            self.alg.load(content, {"actor": True, "critic": True}, strict=True)
        if self.train_config.ppo.schedule == "adaptive":
            self.alg.learning_rate = content["learning_rate"]

    def _worlds_state(self) -> dict[str, Any]:
        """Of the worlds of this process, and of the models' memories of them."""
        memories = {"actor": self.alg.actor.get_hidden_state(), "critic": self.alg.critic.get_hidden_state()}
        return {"env": cast(ManipulationEnv, self.env).snapshot(), "memories": memories}

    def _continue_worlds(self) -> None:
        """Go on in the middle of episodes, if ``worlds.pt`` fits; otherwise the episodes begin anew."""
        path, env = self.folder / "worlds.pt", cast(ManipulationEnv, self.env)
        if not path.exists():
            return
        before = env.snapshot()
        try:
            content = torch.load(path, map_location=self.device, weights_only=True)
            mine = (
                content["processes"][self.processes.rank] if self.processes.rank < len(content["processes"]) else None
            )
            if mine is None or content["iteration"] != self.iteration or not env.restore(mine["env"]):
                return
            for name, model in (("actor", self.alg.actor), ("critic", self.alg.critic)):
                model.reset(hidden_state=mine["memories"][name])
            self._worlds_continue, self._log_state = True, content["log"]
        except Exception:  # damaged, in whatever way: episodes are easily begun anew
            env.restore(before)
            for model in (self.alg.actor, self.alg.critic):
                model.reset()

    def _random_state(self) -> dict[str, Tensor | None]:
        """Of the numbers that this process draws."""
        return {
            "env": self.env.rng_state().cpu(),  # pyright: ignore[reportAttributeAccessIssue]
            "torch": torch.get_rng_state(),
            "cuda": torch.cuda.get_rng_state() if torch.cuda.is_available() else None,
        }

    def _set_random_state(self, state: dict[str, Tensor | None]) -> None:
        if state["torch"] is not None:
            torch.set_rng_state(state["torch"].cpu())
        if state["cuda"] is not None and torch.cuda.is_available():
            torch.cuda.set_rng_state(state["cuda"].cpu())
        if state["env"] is not None and state["env"].shape == self.env.rng_state().shape:  # pyright: ignore[reportAttributeAccessIssue]
            self.env.set_rng_state(state["env"])  # pyright: ignore[reportAttributeAccessIssue]

    def _check_faults(self, budget: FaultBudget) -> None:
        """End the run, leaving the broken worlds in ``faults.npz``, if there are too many; every process comes to the same conclusion."""
        env = cast(ManipulationEnv, self.env)
        total = torch.stack((env.nonfinite_count, env.overflow_count))
        nonfinite, overflow = self.processes.sum(total - self._faults_seen).tolist()
        self._faults_seen = total
        if problem := budget.add(FaultCounts(nonfinite=nonfinite, overflow=overflow)):
            path = self.folder / (f"faults-{self.processes.rank}.npz" if self.is_distributed else "faults.npz")
            dump_faults(path, env, self.train_config, iteration=self.iteration)
            raise too_many_faults(problem, path, self.folder)

    def _check_finite(self, obs: Any) -> None:
        """One look per iteration: what is not finite here comes from a world whose health said that it was sound."""
        for group, value in obs.items():
            bad = ~value.flatten(1).isfinite().all(dim=1)
            if bool(bad.any()):
                worlds = bad.nonzero().squeeze(-1)[:10].tolist()
                raise RunError(
                    f"the observation group {group!r} is not finite in {int(bad.sum())} worlds (first: {worlds}) "
                    f"at iteration {self.iteration}. "
                    f"Continue from the last checkpoint: xreset train --out {self.folder} --resume"
                )


def _write(path: Path, content: dict[str, Any]) -> None:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    with atomic_write(path) as file:
        file.write(buffer.getbuffer())


def read_checkpoint(path: Path, device: str | torch.device = "cpu") -> dict[str, Any]:
    """Read a checkpoint; only tensors and plain values are accepted.

    Raises:
        RunError: the file is damaged or no checkpoint.
    """
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except torch.OutOfMemoryError:
        raise
    except Exception as error:  # its message would advise to load without care
        raise RunError(
            f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and plain values. "
            "Move it away to continue from the one before; do not use it elsewhere if you do not know where it comes from."
        ) from error
    missing = [key for key in _CHECKPOINT_KEYS if not isinstance(content, dict) or key not in content]
    if missing:
        raise RunError(f"{path} is not a checkpoint of xreset: it has no entry {', '.join(missing)}.")
    return {key: content[key] for key in _CHECKPOINT_KEYS}


@contextmanager
def _fits(path: Path) -> Iterator[None]:
    """What a checkpoint's content does not allow becomes one error."""
    try:
        yield
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, RuntimeError) as error:
        reason = shown(str(error).splitlines()[0] if str(error) else type(error).__name__)
        raise RunError(
            f"{path} does not fit this run ({reason}). Was it written by another run, or another version of xreset?"
        ) from error


_CHECKPOINT_KEYS = (
    "actor_state_dict",
    "critic_state_dict",
    "optimizer_state_dict",
    "iteration",
    "env_steps",
    "elapsed",
    "learning_rate",
    "random",
)


class _Log:
    """Sums on the device during an iteration; one progress line and one set of TensorBoard scalars after it."""

    def __init__(self, folder: Path, num_envs: int, device: str, total: int) -> None:
        self.clock = LiftClock(folder)
        self._curves = CurveFile(folder)
        self._returns, self._lengths = torch.zeros(num_envs, device=device), torch.zeros(num_envs, device=device)
        self._finished = torch.zeros(3, device=device)  # sum of returns, sum of lengths, number of episodes
        self._recent: deque[list[float]] = deque(maxlen=20)
        self._names: tuple[str, ...] = ()
        self._sums: Tensor | None = None
        self._steps = 0
        self._console = Console()
        self._total = total
        self._progress = Progress(
            TextColumn("iteration"),
            MofNCompleteColumn(),
            BarColumn(bar_width=20),
            TextColumn("{task.fields[text]}"),
            TimeRemainingColumn(),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._progress.start()
        self._task = self._progress.add_task("training", total=total, text="")
        self._last_line = 0.0

    def add(self, reward: Tensor, done: Tensor, log: dict[str, Tensor]) -> None:
        ended = done.float()
        self._returns += reward
        self._lengths += 1
        self._finished += torch.stack(((self._returns * ended).sum(), (self._lengths * ended).sum(), ended.sum()))
        self._returns *= 1 - ended
        self._lengths *= 1 - ended
        self._names, values = tuple(log), torch.stack(list(log.values()))
        self._sums = values if self._sums is None else self._sums + values
        self._steps += 1

    def state(self) -> dict[str, Any]:
        """The running means, for :meth:`restore`."""
        return {"returns": self._returns, "lengths": self._lengths, "recent": list(self._recent)}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on with the running means of a checkpoint of the same number of worlds."""
        self._returns, self._lengths = state["returns"].clone(), state["lengths"].clone()
        self._recent.extend(state["recent"])

    def write(self, runner: TrainingRunner, losses: dict[str, float], *, collect: float, learn: float) -> None:
        it, alg = runner.iteration, runner.alg
        assert self._sums is not None, "an iteration has at least one step"
        means = dict(zip(self._names, (self._sums / self._steps).tolist(), strict=True))
        self._recent.append(self._finished.tolist())
        returns, lengths, episodes = (sum(column) for column in zip(*self._recent, strict=True))
        fps = self._steps * runner.env.num_envs * runner.gpu_world_size / (collect + learn)
        scalars = means | {f"loss/{name}": value for name, value in losses.items()}
        scalars |= {
            "policy/std": float(alg.get_policy().output_std.detach().mean()),
            "policy/learning_rate": alg.learning_rate,
            "speed/env_steps_per_second": fps,
            "speed/collect_seconds": collect,
            "speed/learn_seconds": learn,
        }
        if episodes:
            scalars |= {"episode/return": returns / episodes, "episode/length": lengths / episodes}
        self._curves.write(it, scalars)
        from_home = means["task/success_from_home"]
        self.clock.tick(from_home, iteration=it, env_steps=runner.env_steps, seconds=runner.elapsed)
        text = (
            f"return {returns / max(episodes, 1):7.3f}  grasped {means['task/grasped']:5.1%}  success {means['task/success']:5.1%}, "
            f"from home {from_home:5.1%}  {fps:,.0f} steps/s"
        )
        self._progress.update(self._task, completed=it, text=text)
        if not self._console.is_terminal and (time.monotonic() - self._last_line > 10 or it == self._total):
            self._last_line = time.monotonic()
            print(f"iteration {it}/{self._total}  {text}", flush=True)
        self._finished.zero_()
        self._sums, self._steps = None, 0

    def close(self, *, stopped: bool) -> None:
        self._progress.stop()
        self._curves.close()
        self.clock.write()
        if stopped:
            self._console.print("stopped after the current iteration; a checkpoint is written.")


_SAME_REQUEST = 2.0
"""[s] within which signals are one request."""


@contextmanager
def _stop_on_interrupt() -> Iterator[list[float]]:
    """The first Ctrl-C (or SIGTERM) puts an entry into the list that is yielded; another one, later than a moment, interrupts at once.

    Within that moment it is the same one: under torchrun a process gets Ctrl-C from the terminal, and from torchrun as well.
    """
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
