"""From which demonstrated states a policy reaches the goal: what it can do, and where its training is stuck.

Demonstrated states are the stages of the task from its end backwards: held at the goal, lifted, touched, approached. A
policy learns them in about that order, so training has to discover the first stage from which the policy fails.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from xreset.errors import DemoError
from xreset.eval.policy_spec import PolicySpec
from xreset.eval.rollout import Progress, play_rounds
from xreset.eval.trial import Engine, Trial
from xreset.files import write_json
from xreset.policy import Policy
from xreset.resets.distribution import bank_starts

SCHEMA = "xreset-frontier/1"

NEAR = (0.20, 0.05, 0.02)
"""Distances of the nearest fingertip from the object's surface that divide the approach [m]."""
LIFT = 0.01
"""Height of the object's origin above the demonstration's start from which the object counts as lifted [m]."""
HIGH = 0.10
"""Height from which it counts as lifted high [m]."""
STAGES = (
    "hand over 20 cm away",
    "hand 5 to 20 cm away",
    "hand 2 to 5 cm away",
    "hand under 2 cm away",
    "lifted by 1 to 10 cm",
    "lifted by over 10 cm",
)


@dataclass(frozen=True, kw_only=True)
class StateOutcome:
    """Outcome of one demonstrated state."""

    state: int
    """Row of the state in the bank."""
    sequence_name: str
    frame: int
    object: str
    stage: str
    """One of :data:`STAGES`."""
    reached: bool
    """Whether the object was at the goal at any time."""
    stayed: bool
    """Whether the object was at the goal at the episode's end."""


def stage_of(tip_distance: np.ndarray, lift: np.ndarray) -> np.ndarray:
    """Return indices [M] into :data:`STAGES`.

    Args:
        tip_distance: [M] distance of the nearest fingertip from the object's surface [m].
        lift: [M] height of the object's origin above the demonstration's start [m].
    """
    on_table = sum((tip_distance <= edge).astype(int) for edge in NEAR)
    lifted = np.where(lift < HIGH, 4, 5)
    return np.where(lift < LIFT, on_table, lifted)


def try_policy(
    policy: Policy, engine: Engine, trial: Trial, rows: np.ndarray, progress: Progress = lambda done, total: None
) -> list[StateOutcome]:
    """Let a policy continue from states of a bank, at rest and at full gravity, for one episode each.

    Args:
        policy: what acts.
        engine: where it acts.
        trial: the bank, and how it is played.
        rows: [M] states to try.
        progress: called with (control steps done, control steps in all).
    """
    bank = trial.bank
    objects = [trial.names.index(name) for name in bank.object_name[rows]]
    found: dict[int, StateOutcome] = {}
    with closing(play_rounds(engine, trial, objects, lambda items: bank_starts(bank, rows[items]))) as rounds:
        for r in rounds:
            chosen = rows[r.items]
            lift = bank.object_pos[chosen, 2] - bank.start_pos[bank.sequence_index[chosen], 2]
            stage = stage_of(r.env.reading().tip_distance.amin(dim=-1).cpu().numpy(), lift)
            result, _ = r.play(policy, lambda step, reading: None, progress)
            for world in r.fresh:
                row = int(chosen[world])
                found[row] = StateOutcome(
                    state=row,
                    sequence_name=str(bank.sequence_name[bank.sequence_index[row]]),
                    frame=int(bank.frame_index[row]),
                    object=str(bank.object_name[row]),
                    stage=STAGES[stage[world]],
                    reached=bool(result.reorient_once[world]),
                    stayed=bool(result.reorient[world]),
                )
    return [found[row] for row in sorted(found)]


def by_stage(tried: list[StateOutcome]) -> list[dict[str, Any]]:
    """Return an entry for each stage with states: their number, and the shares that reached the goal and stayed."""
    table = pd.DataFrame(tried)
    out = []
    for stage in STAGES:
        own = table[table["stage"] == stage]
        if len(own):
            shares = own[["reached", "stayed"]].mean().round(6)
            out.append({"stage": stage, "states": len(own)} | shares.to_dict())
    return out


def frontier(
    policy: PolicySpec,
    trial: Trial,
    engines: Sequence[Engine],
    out: Path,
    *,
    states: int,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[dict[str, Any]]:
    """Try states of a bank in each engine and write ``OUT/BACKEND.json``.

    Args:
        policy: what is tried.
        trial: the bank, from :func:`~xreset.eval.trial.load_trial`; its seed draws the states.
        engines: where it is tried.
        out: folder for the results.
        states: how many states to draw from the bank, without repetition; all if the bank has fewer.
        progress: called with (engine, control steps done, control steps in all).

    Returns:
        The contents of the files, in the order of the engines.

    Raises:
        DemoError: the bank holds no state.
        PolicyError: the seed chose this checkpoint.
    """
    policy.check_seed(trial.seed)
    bank = trial.bank
    if not bank.num_states:
        raise DemoError(
            "The bank holds no state to try: every candidate was rejected. xreset resets shows the reasons."
        )
    rows = np.sort(np.random.default_rng(trial.seed).permutation(bank.num_states)[:states])
    written = []
    for engine in engines:
        tried = try_policy(policy.start(None), engine, trial, rows, partial(progress, engine.name))
        content = {
            "schema": SCHEMA,
            "backend": engine.name,
            "backend_version": engine.version,
            "robot": trial.robot.name,
            "policy": policy.name,
            "seed": trial.seed,
            "inputs": trial.inputs,
            "stages": by_stage(tried),
            "tried": [asdict(t) for t in tried],
        }
        write_json(out / f"{engine.name}.json", content)
        written.append(content)
    return written
