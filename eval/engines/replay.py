"""Replaying an action sequence in several engines, and in the reference from starts that differ by next to nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from xreset.errors import XResetError
from xreset.eval.engines.actions import Actions
from xreset.eval.engines.divergence import (
    Differences,
    Parting,
    Thresholds,
    differences,
    first_of,
    lifted,
    partings,
    worst,
)
from xreset.eval.engines.episodes import Episode, Recording, play
from xreset.eval.trial import Engine
from xreset.files import write_json
from xreset.physics import State
from xreset.records import write_npz

SCHEMA = "xreset-partings/1"
REPLAYS_SCHEMA = "xreset-replays/1"


@dataclass(frozen=True, kw_only=True)
class EngineTrace:
    """What one engine did, and where it parts from the reference."""

    name: str
    version: str
    device: str
    recording: Recording
    """Its first world is the sequence's own."""
    differences: Differences
    partings: tuple[Parting, ...]
    lifted: float
    """How much higher the object is at the end [m]; NaN if it is not finite."""


@dataclass(frozen=True, kw_only=True)
class TraceResult:
    """The outcome of :func:`trace`."""

    actions: Actions
    thresholds: Thresholds
    reference: EngineTrace
    engines: tuple[EngineTrace, ...]
    """The others."""
    noise: tuple[Parting, ...]
    """The reference against itself from perturbed starts: for each quantity, the worst of them."""
    noise_differences: tuple[Differences, ...]
    perturbation: float
    """Size of the perturbations [m, rad]."""

    def within_noise(self, parting: Parting) -> bool:
        """Whether the reference, from a start that differs by next to nothing, parts from itself no later and gets as far."""
        return any(
            n.quantity == parting.quantity
            and n.unit == parting.unit
            and parting.largest <= n.largest
            and (parting.time is None or (n.time is not None and n.time <= parting.time))
            for n in self.noise
        )

    def as_dict(self) -> dict[str, Any]:
        """JSON-able content."""
        actions = self.actions

        def engine(e: EngineTrace) -> dict[str, Any]:
            first = first_of(e.partings)
            return {
                "name": e.name,
                "version": e.version,
                "device": e.device,
                "lifted_m": e.lifted if math.isfinite(e.lifted) else None,
                "finite_until": float(e.differences.time[-1]) if len(e.differences.time) else 0.0,
                "broken": bool(e.recording.broken[0]),
                "parts_first": None if first is None else first.quantity,
                "partings": [asdict(p) | {"within_noise": self.within_noise(p)} for p in e.partings],
            }

        return {
            "schema": SCHEMA,
            "actions": {
                "label": actions.label,
                "robot": actions.robot.name,
                "object": actions.object.name,
                "object_source": actions.object.source,
                "steps": len(actions.joint_target),
                "timestep": actions.scene.timestep,
                "substeps": actions.scene.substeps,
                "friction": asdict(actions.scene.friction),
                "phases": [{"name": name, "start": start} for name, start in actions.phases],
            },
            "thresholds": asdict(self.thresholds),
            "reference": self.reference.name,
            "reference_version": self.reference.version,
            "reference_lifted_m": self.reference.lifted if math.isfinite(self.reference.lifted) else None,
            "noise": {
                "perturbation": self.perturbation,
                "starts": len(self.noise_differences),
                "partings": [asdict(p) for p in self.noise],
            },
            "engines": [engine(e) for e in self.engines],
        }


def trace(
    actions: Actions,
    reference: Engine,
    engines: Sequence[Engine],
    *,
    thresholds: Thresholds | None = None,
    perturbed: int = 4,
    perturbation: float = 1e-6,
    seed: int = 0,
    progress: Callable[[str], None] = lambda name: None,
) -> TraceResult:
    """Replay a sequence in each engine and compare with the reference.

    Args:
        thresholds: from which differences on engines count as parted.
        perturbed: number of perturbed starts in the reference: long contact is chaotic, and what such a start does to the reference
            itself, no engine can be blamed for.
        perturbation: size of the perturbations: each joint [rad, m] and each coordinate of the object [m] is moved by plus or minus this.
        seed: of the signs.
        progress: called with the name of each engine as it begins.

    Raises:
        XResetError: the reference itself does not stay finite.
    """
    thresholds = thresholds or Thresholds()
    if perturbed < 0 or not perturbation > 0:
        raise XResetError(
            f"the number of perturbed starts is {perturbed} and their size {perturbation}; expected at least 0, and above 0."
        )
    dt = actions.scene.control_dt
    progress(reference.name)
    theirs = _replay(actions, reference, _perturbed(actions.start, perturbed, perturbation, seed))
    base = _engine_trace(reference, theirs, theirs, actions, thresholds)
    if len(base.differences.time) < len(actions.joint_target):
        raise XResetError(
            f"the reference {reference.name!r} is not finite after {len(base.differences.time) * dt:.3f} s of this sequence, so nothing "
            "can be compared with it. Choose another --reference, or another sequence."
        )
    noise = tuple(differences(theirs, theirs, dt, thresholds, world=1 + i) for i in range(perturbed))
    found = []
    for engine in engines:
        progress(engine.name)
        found.append(_engine_trace(engine, _replay(actions, engine, actions.start), theirs, actions, thresholds))
    return TraceResult(
        actions=actions,
        thresholds=thresholds,
        reference=base,
        engines=tuple(found),
        noise=worst([partings(d, actions.robot, thresholds) for d in noise]) if noise else (),
        noise_differences=noise,
        perturbation=perturbation,
    )


def write_trace(folder: Path, result: TraceResult) -> None:
    """Write ``trace.json`` (the partings) and ``replays.npz`` (what every engine did)."""
    every = (result.reference, *result.engines)
    write_json(folder / "trace.json", result.as_dict())
    robot = result.actions.robot

    def stacked(name: str) -> np.ndarray:
        return np.stack([getattr(e.recording, name)[:, 0].numpy() for e in every])

    write_npz(
        folder / "replays.npz",
        REPLAYS_SCHEMA,
        {
            "engine": np.array([e.name for e in every]),
            "joint_names": np.array(robot.joint_names),
            "fingertip_names": np.array(robot.fingertip_names),
            "time": result.reference.differences.time,
            "joint_target": result.actions.joint_target.numpy(),
            "joint_pos": stacked("joint_pos"),
            "object_pos": stacked("object_pos"),
            "object_quat_wxyz": stacked("object_quat"),
            "tip_force": stacked("tip_force"),
        },
        config={"actions": result.actions.label, "object": result.actions.object.name, "robot": robot.name},
    )


def _replay(actions: Actions, engine: Engine, start: State) -> Recording:
    worlds = len(start.joint_pos)
    targets = actions.joint_target[:, None].expand(-1, worlds, -1)
    with engine.make(actions.scene, worlds, torch.zeros(worlds, dtype=torch.long)) as backend:
        return play(backend, Episode(start=start, targets=targets.contiguous()))


def _engine_trace(
    engine: Engine, found: Recording, reference: Recording, actions: Actions, thresholds: Thresholds
) -> EngineTrace:
    d = differences(found, reference, actions.scene.control_dt, thresholds)
    return EngineTrace(
        name=engine.name,
        version=engine.version,
        device=engine.device,
        recording=found,
        differences=d,
        partings=partings(d, actions.robot, thresholds),
        lifted=lifted(found),
    )


def _perturbed(start: State, count: int, size: float, seed: int) -> State:
    """[1 + count] the start itself, then perturbed copies."""
    generator = torch.Generator().manual_seed(seed)

    def repeated(value: torch.Tensor, moved: bool) -> torch.Tensor:
        rows = value.expand(1 + count, -1).clone()
        if moved:
            rows[1:] += size * (2.0 * torch.randint(2, rows[1:].shape, generator=generator) - 1.0)
        return rows

    moved = ("joint_pos", "object_pos")
    names = State.__dataclass_fields__
    return replace(start, **{name: repeated(getattr(start, name), name in moved) for name in names})
