"""Play a policy in an engine. Every engine plays the same episodes from the same states.

Shape letters: N worlds, J joints.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import field, fields, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from xreset.env.manipulation import ManipulationEnv, make_scene
from xreset.errors import XResetError
from xreset.eval.metrics import Episode, EpisodeMetrics, MetricPoints
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.results import Rollouts, Trace
from xreset.files.checks import frozen
from xreset.files.progress import Progress, unseen
from xreset.files.records import schema_of
from xreset.physics import Backend, State
from xreset.physics.plugins import backend_class, device_for, make_backend
from xreset.policy.onnx_policy import Policy
from xreset.resets.bank import ResetBank
from xreset.resets.distribution import Reset, ResetDistribution
from xreset.resets.goals import GoalSet
from xreset.resets.inputs import Data, Inputs, load_inputs
from xreset.resets.schedule import schedule
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task.config import TaskConfig, evaluation_task, with_episodes_of
from xreset.task.reading import Reading
from xreset.task.terminations import out_of_bounds

TRACE_INTERVAL = 0.05
"""Time between the states of a trace [s]."""

MakeBackend = Callable[[SceneSpec, int, Tensor], Backend]
"""Makes the worlds of a scene, given their number and the index of the object in each world [N]."""


@frozen
class Engine:
    """An engine to play in."""

    name: str
    """Name of the engine."""
    make: MakeBackend
    version: str
    device: str = "cpu"
    """Device that its worlds run on: cpu or cuda."""

    @property
    def slow(self) -> bool:
        """Whether it is too slow on its device to play many episodes."""
        return self.name == "mujoco-warp" and self.device == "cpu"


def engine(name: str, *, device: str = "cpu", **options: Any) -> Engine:
    """Return an installed engine.

    Args:
        name: name of the engine.
        device: where the engine runs if it can; else it runs on the CPU.
        options: keywords of its :class:`~xreset.physics.Backend`.

    Raises:
        BackendUnavailableError: the engine cannot be used here.
    """
    version = backend_class(name).engine_version()
    used = device_for(name, device)

    def make(scene: SceneSpec, num_worlds: int, object_index: Tensor) -> Backend:
        return make_backend(
            name, scene, num_worlds, object_index=object_index, device=used, **options
        )

    return Engine(name=name, make=make, version=version, device=used)


def chosen_engines(engines: str | Engine | Iterable[str | Engine], device: str) -> list[Engine]:
    """Return engines, given by name or as such, each once; ``XResetError`` if there is none, or if two would write the
    same file."""
    names = (engines,) if isinstance(engines, str | Engine) else tuple(engines)
    if not names:
        raise XResetError("No engine is named. Name one or several of them.")
    chosen = [
        each if isinstance(each, Engine) else engine(each, device=device)
        for each in dict.fromkeys(names)
    ]
    counts = Counter(each.name for each in chosen)
    for name, count in counts.items():
        if count > 1:
            raise XResetError(
                f"{count} engines are called {name!r}, and their results would have the same file. Play them one after "
                "another, with another folder (out) each."
            )
    return chosen


@frozen
class Trial:
    """Everything that decides how an episode goes, except the policy and the engine."""

    robot: RobotSpec
    objects: tuple[ObjectSpec, ...]
    bank: ResetBank
    """Starts and goals; and states, for episodes that begin with them."""
    task: TaskConfig
    """Usually :func:`xreset.task.config.evaluation_task` of the policy's own task."""
    seed: int = 0
    """Seed of the perturbations of robot and object: the same in every engine and for every number of worlds."""
    num_envs: int = 64
    """Worlds that run at the same time."""
    motion: Retargeted | None = None
    """Motion for the baseline ``ik``; None for other policies."""
    meshes: Path | None = None
    """Folder of the object meshes; None: the stand-ins."""
    inputs: dict[str, str] = field(default_factory=dict)
    """SHA-256 of the policy and of the demos; of their starts and goals if they are in no file."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the objects."""
        return tuple(o.name for o in self.objects)

    def starts(self, device: str | torch.device = "cpu") -> ResetDistribution:
        """Return the distribution of starts. Drawn on the CPU, they are the same in every engine."""
        return ResetDistribution.of(self.bank, self.robot, self.objects, self.task, device)

    @contextmanager
    def worlds(self, engine: Engine, object_index: Tensor) -> Iterator[ManipulationEnv]:
        """Make an environment in an engine; object_index: [N] index of the object in each world."""
        # The scene's friction is a placeholder, because the environment sets friction itself.
        scene = make_scene(self.robot, self.objects, self.task)
        with engine.make(scene, len(object_index), object_index) as backend:
            yield ManipulationEnv(backend, self.task, self.starts(backend.device), seed=self.seed)


def load_trial(
    policy: PolicySpec,
    source: str | Path | Data,
    *,
    meshes: str | Path | None = None,
    seed: int = 0,
    num_envs: int = 64,
    episode_seconds: float | None = None,
) -> Trial:
    """Load what a policy is to play. For the baseline ``ik``, demonstrations are retargeted here.

    Args:
        policy: the policy, whose robot and task are taken.
        source: demonstrations, motion or a goal set, or a file of one of these; or a loaded bank. Objects of a goal set
            start as stated, because these starts are perturbed already; only the robot's joints are perturbed.
        meshes: folder of object meshes; default: the folder that the file states, else that of the policy's training.
        seed: seed of the perturbations.
        num_envs: worlds that run at the same time.
        episode_seconds: length of an episode [s]; default: as in the policy's training.

    Raises:
        XResetError: the length is not a number, too large, or less than a control step.
    """
    task = evaluation_task(policy.task)
    if episode_seconds is not None:
        task = with_episodes_of(task, episode_seconds)
    inputs = load_inputs(
        source,
        robot=policy.robot,
        meshes=meshes,
        else_meshes=policy.meshes,
        accept=("demos", "motion", "goals"),
    )
    bank = inputs.bank
    hashes = {} if policy.hash is None else {"policy": policy.hash}
    hashes["demos"] = _hash_of_demos(inputs)
    used = [o for o in inputs.objects if o.name in bank.sequence_object]
    if isinstance(inputs.data, GoalSet):
        task = replace(task, reset=replace(task.reset, spawn_xy=0.0, spawn_yaw=0.0))
    return Trial(
        robot=policy.robot,
        objects=tuple(sorted(used, key=lambda o: o.name)),
        bank=bank,
        task=task,
        seed=seed,
        num_envs=num_envs,
        motion=inputs.motion() if policy.follows_motion else None,
        meshes=inputs.meshes,
        inputs=hashes,
    )


def _hash_of_demos(inputs: Inputs) -> str:
    """Return the SHA-256 of the demonstrations' file, also for motion that was made of it; of starts and goals that are
    in no file."""
    stated = inputs.made_from.get("demos") or inputs.hash
    if stated:
        return stated
    bank = inputs.bank
    digest = sha256()
    for name, column in schema_of(ResetBank).items():
        if column.shape[:1] == ("S",):
            digest.update(str(getattr(bank, name).tolist()).encode())
    return digest.hexdigest()


def roll_out(
    policy: Policy,
    engine: Engine,
    trial: Trial,
    *,
    episodes: int,
    progress: Progress = unseen,
) -> Rollouts:
    """Play demonstrations ``episodes`` times each.

    Args:
        policy: the policy.
        engine: the engine.
        trial: what is played.
        episodes: episodes of each demonstration, each with another perturbation of robot and object.
        progress: called with (control steps done, control steps in all).
    """
    traces: list[Trace] = []
    steps = 0
    seconds = 0.0

    def play(played: Round) -> None:
        nonlocal steps, seconds
        env = played.env
        length = env.max_episode_length
        every = max(1, round(TRACE_INTERVAL / env.backend.scene.control_dt))
        every = length // max(1, length // every)  # the first and another state at least
        shown = [world for world in played.fresh if played.repetition[world] == 0]
        policy.begin(env)
        states = [env.reading().state[shown].to("cpu")]
        targets = []
        for step in range(1, length + 1):
            before = time.perf_counter()
            reading, _ = env.advance(policy.act(env.get_observations()))
            played.update_metrics(reading)
            seconds += time.perf_counter() - before
            targets.append(env.joint_target[shown].cpu())
            if step % every == 0:
                states.append(reading.state[shown].to("cpu"))
            progress(played.number * length + step, played.total * length)
        steps += length * env.num_envs
        traces.extend(_traces(env, shown, every, states, targets))

    return Rollouts(
        episodes=play_rounds(engine, trial, episodes, play),
        traces=tuple(sorted(traces, key=lambda t: t.sequence)),
        control_steps_per_second=steps / seconds,
    )


@frozen
class Round:
    """Worlds that were just reset, each to play one episode."""

    env: ManipulationEnv
    metrics: EpisodeMetrics
    """Metrics of these episodes."""
    sequence: np.ndarray
    """[N] index of each world's demonstration."""
    repetition: np.ndarray
    """[N] number of the perturbation of its start."""
    seeds: list[tuple[int, int, int]]
    """N seeds of what is drawn in each world: the trial's, the demonstration and the repetition."""
    fresh: list[int]
    """Worlds that play a new episode; the others repeat one, because all worlds of an engine step together."""
    number: int
    """Index of the round."""
    total: int
    """Number of rounds."""

    def update_metrics(self, reading: Reading) -> None:
        """Add the reading after a control step to the metrics."""
        position = reading.task_state.object_pos
        table = self.env.backend.scene.table
        self.metrics.update(reading, out_of_bounds(position, table))


def play_rounds(
    engine: Engine, trial: Trial, episodes: int, play: Callable[[Round], None]
) -> tuple[Episode, ...]:
    """Play each demonstration ``episodes`` times, in as many rounds as the worlds of an engine need.

    Args:
        play: plays a round, and calls :meth:`Round.update_metrics` after every control step.

    Returns:
        The episodes, in the order of the demonstrations, then of the perturbations of a start.
    """
    bank = trial.bank
    count = len(bank.sequence_name)
    sequence = np.repeat(np.arange(count), episodes)
    repetition = np.tile(np.arange(episodes), count)
    objects = [trial.names.index(name) for name in bank.sequence_object[sequence]]
    starts = trial.starts()
    plan = schedule(np.array(objects), trial.num_envs)
    found: list[Episode] = []
    with trial.worlds(engine, torch.as_tensor(plan.object_index)) as env:
        points = MetricPoints.of(trial.objects, trial.task.object_frame).to(env.device)
        points = points[env.backend.object_index]
        for number, (items, fresh) in enumerate(plan):
            seeds = []
            for s, r in zip(sequence[items].tolist(), repetition[items].tolist(), strict=True):
                seeds.append((trial.seed, s, r))
            start = episode_starts(starts, seeds)
            env.reset(start=start.to(env.device), seeds=seeds)
            played = Round(
                env=env,
                seeds=seeds,
                metrics=EpisodeMetrics(env.reading(), env.task_goal_pos, env.goal_quat, points),
                sequence=sequence[items],
                repetition=repetition[items],
                fresh=np.flatnonzero(fresh).tolist(),
                number=number,
                total=len(plan.rounds),
            )
            play(played)
            found += [_episode(played, world, bank) for world in played.fresh]
    return tuple(sorted(found, key=lambda e: (e.sequence, e.repetition)))


def episode_starts(distribution: ResetDistribution, seeds: Sequence[tuple[int, int, int]]) -> Reset:
    """Return one start for each world, on the CPU.

    A start depends only on its seed, not on the engine and the number of worlds.

    Args:
        distribution: distribution of starts.
        seeds: N seeds; see :attr:`Round.seeds`.
    """
    parts = []
    for seed in seeds:
        state = np.random.SeedSequence(seed).generate_state(1)
        generator = torch.Generator().manual_seed(int(state[0]))
        _, sequence, _ = seed
        parts.append(distribution.home(torch.tensor([sequence]), generator))
    return Reset.cat(parts)


def _episode(played: Round, world: int, bank: ResetBank) -> Episode:
    """Return the result of one world's episode. Its fields have the names of the metrics."""
    values: dict[str, Any] = {}
    for f in fields(Episode):
        if hasattr(played.metrics, f.name):
            value = getattr(played.metrics, f.name)[world].item()
            values[f.name] = value if isinstance(value, bool) else round(value, 6)
    sequence = int(played.sequence[world])
    return Episode(
        sequence=sequence,
        sequence_name=str(bank.sequence_name[sequence]),
        object=str(bank.sequence_object[sequence]),
        repetition=int(played.repetition[world]),
        **values,
    )


def _traces(
    env: ManipulationEnv, worlds: list[int], every: int, states: list[State], targets: list[Tensor]
) -> Iterator[Trace]:
    """Yield the traces of some worlds.

    Args:
        env: the environment.
        worlds: indices of the worlds.
        every: control steps from one state to the next.
        states: states of these worlds, one for each time.
        targets: drive targets of these worlds, for each control step.
    """
    scene = env.backend.scene
    goal_pos = env.goal_pos[worlds].cpu().numpy()
    goal_quat = env.goal_quat[worlds].cpu().numpy()
    paths = State.cat([state[None] for state in states])
    joint_target = torch.stack(targets).numpy()
    for i, world in enumerate(worlds):
        path = paths[:, i]
        yield Trace(
            sequence=int(env.sequence[world]),
            object=scene.objects[int(env.backend.object_index[world])].name,
            goal_pos=goal_pos[i],
            goal_quat=goal_quat[i],
            time=every * np.arange(len(states)) * scene.control_dt,
            joint_target=joint_target[:, i],
            joint_pos=path.joint_pos.numpy(),
            object_pos=path.object_pos.numpy(),
            object_quat=path.object_quat.numpy(),
        )
