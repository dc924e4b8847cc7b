"""From which demonstrated states a policy reaches the goal: what it can do already, and where its training is stuck.

Demonstrated states are the stages of the task from its end backwards: held at the goal, lifted, touched, approached. A policy learns them
in about that order, so the first stage from which it fails is what training has to discover next.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from xreset.errors import DemoError
from xreset.eval.evaluate import Subject
from xreset.eval.metrics import MetricsConfig
from xreset.eval.rollout import play
from xreset.eval.setting import Setting
from xreset.eval.trial import Engine, Trial
from xreset.files import file_hash, write_json
from xreset.policy import Policy
from xreset.resets.bank import check_objects, read_bank
from xreset.resets.distribution import bank_starts
from xreset.schedule import schedule
from xreset.task.reading import Reading

SCHEMA = "xreset-frontier/1"

NEAR = (0.20, 0.05, 0.02)
"""Distances of the nearest fingertip from the object's surface that divide the approach [m]."""
LIFT, HIGH = 0.01, 0.10
"""Heights of the object's origin above the demonstration's start from which it counts as lifted, and as lifted high [m]."""
STAGES = (
    "hand over 20 cm away",
    "hand 5 to 20 cm away",
    "hand 2 to 5 cm away",
    "hand under 2 cm away",
    "lifted by 1 to 10 cm",
    "lifted by over 10 cm",
)


@dataclass(frozen=True, kw_only=True)
class Tried:
    """What became of one demonstrated state."""

    state: int
    """Its row in the bank."""
    sequence_name: str
    frame: int
    object: str
    stage: str
    """One of :data:`STAGES`."""
    reached: bool
    """Whether the object was at the goal at any time."""
    stayed: bool
    """Whether it was there at the episode's end."""


def stage_of(tip_distance: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """[M] index into :data:`STAGES`.

    Args:
        tip_distance: [M] distance of the nearest fingertip from the object's surface [m].
        lift: [M] height of the object's origin above where the demonstration began [m].
    """
    on_table = sum((tip_distance <= edge).astype(int) for edge in NEAR)
    return np.where(lift < LIFT, on_table, np.where(lift < HIGH, 4, 5))


def try_policy(
    policy: Policy,
    engine: Engine,
    trial: Trial,
    rows: np.ndarray,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Tried]:
    """Let a policy go on from states of a bank, at rest and at full gravity, for one episode each.

    Args:
        rows: [M] states to try.
        progress: called with (control steps done, control steps in all).
    """
    bank = trial.bank
    plan = schedule(np.array([trial.names.index(name) for name in bank.object_name[rows]]), trial.num_envs)
    found: dict[int, Tried] = {}
    with trial.worlds(engine, torch.as_tensor(plan.object_index)) as (env, points):
        for number, (items, fresh) in enumerate(plan):
            chosen = rows[items]
            env.reset(start=bank_starts(bank, chosen).to(env.device))
            lift = bank.object_pos[chosen, 2] - bank.start_pos[bank.sequence_index[chosen], 2]
            stage = stage_of(env.reading().tip_distance.amin(dim=-1).cpu().numpy(), lift)

            def look(step: int, _: Reading, number: int = number) -> None:
                if step:
                    progress(number * env.max_episode_length + step, len(plan.rounds) * env.max_episode_length)

            result, _ = play(policy, env, points, MetricsConfig(), look)
            for world in np.flatnonzero(fresh):
                row = int(chosen[world])
                found[row] = Tried(
                    state=row,
                    sequence_name=str(bank.sequence_name[bank.sequence_index[row]]),
                    frame=int(bank.frame_index[row]),
                    object=str(bank.object_name[row]),
                    stage=STAGES[stage[world]],
                    reached=bool(result.reorient_once[world]),
                    stayed=bool(result.reorient[world]),
                )
    return [found[row] for row in sorted(found)]


def by_stage(tried: list[Tried]) -> list[dict[str, Any]]:
    """One entry per stage that has states: its name, how many were tried, and the shares that reached the goal and stayed there."""
    out = []
    for stage in STAGES:
        mine = [t for t in tried if t.stage == stage]
        if mine:
            reached, stayed = (
                round(float(np.mean([getattr(t, what) for t in mine])), 6) for what in ("reached", "stayed")
            )
            out.append({"stage": stage, "states": len(mine), "reached": reached, "stayed": stayed})
    return out


def frontier(
    subject: Subject,
    engines: Sequence[Engine],
    resets: Path,
    setting: Setting,
    out: Path,
    *,
    states: int,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[dict[str, Any]]:
    """Try states of a bank in each engine and write ``OUT/BACKEND.json``.

    Args:
        setting: meshes, seed of the draw, worlds at a time.
        states: how many to draw from the bank, without repetition; all if it has fewer.
        progress: called with (engine, control steps done, control steps in all).

    Returns:
        What was written, in the order of the engines.

    Raises:
        DemoError: the bank holds no state.
    """
    bank = read_bank(resets, robot=subject.robot)
    if not bank.num_states:
        raise DemoError(
            f"{resets} holds no state to try: every candidate was rejected. Look at its reasons (xreset resets)."
        )
    trial = subject.trial(bank, setting)
    check_objects(resets, bank, trial.objects)
    rows = np.sort(np.random.default_rng(setting.seed).permutation(bank.num_states)[:states])
    inputs = subject.inputs | {"resets": file_hash(resets)}
    written = []
    for engine in engines:
        tried = try_policy(subject.policy(subject.robot, None), engine, trial, rows, partial(progress, engine.name))
        content = {
            "schema": SCHEMA,
            "backend": engine.name,
            "backend_version": engine.version,
            "robot": subject.robot.name,
            "policy": subject.label,
            "seed": setting.seed,
            "inputs": inputs,
            "stages": by_stage(tried),
            "tried": [asdict(t) for t in tried],
        }
        write_json(out / f"{engine.name}.json", content)
        written.append(content)
    return written
