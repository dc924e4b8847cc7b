"""Replaying an action sequence in several engines, and in the reference from starts that differ by next to nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from xreset.errors import XResetError
from xreset.eval.engines.actions import Actions
from xreset.eval.engines.divergence import Differences, Parting, Thresholds, differences, first_of, partings, worst
from xreset.eval.engines.recording import OpenLoopEpisode, Recording, record
from xreset.eval.trial import Engine
from xreset.files import write_json
from xreset.physics import State
from xreset.records import write_npz

SCHEMA = "xreset-partings/1"
REPLAYS_SCHEMA = "xreset-replays/1"


@dataclass(frozen=True, kw_only=True)
class EngineTrace:
    """What one engine did, and where it parts from the reference."""

    engine: Engine
    recording: Recording
    """Its first world is the sequence's own."""
    differences: Differences
    partings: tuple[Parting, ...]

    @property
    def name(self) -> str:
        """Name of the engine."""
        return self.engine.name

    @property
    def lifted(self) -> float:
        """Height of the object at the end above its start [m]; NaN if it is not finite."""
        height = float(self.recording.lifted[0])
        return height if math.isfinite(height) else math.nan

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content, without the partings."""
        first = first_of(self.partings)
        return {
            "name": self.name,
            "version": self.engine.version,
            "device": self.engine.device,
            "lifted_m": _finite(self.lifted),
            "finite_until": float(self.differences.time[-1]) if len(self.differences.time) else 0.0,
            "broken": bool(self.recording.broken[0]),
            "parts_first": None if first is None else first.quantity,
        }


@dataclass(frozen=True, kw_only=True)
class TraceResult:
    """The outcome of :func:`trace`."""

    actions: Actions
    thresholds: Thresholds
    reference: EngineTrace
    engines: tuple[EngineTrace, ...]
    """The other engines."""
    noise: tuple[Parting, ...]
    """The reference against itself from perturbed starts: the worst of them for each quantity."""
    noise_differences: tuple[Differences, ...]
    perturbation: float
    """Size of the perturbations [m, rad]."""

    def within_noise(self, parting: Parting) -> bool:
        """Whether the reference parts as far from itself, and no later, from a start that hardly differs."""
        for n in self.noise:
            if n.quantity == parting.quantity and n.unit == parting.unit and parting.largest <= n.largest:
                return parting.time is None or (n.time is not None and n.time <= parting.time)
        return False

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content."""
        actions = self.actions
        engines = []
        for e in self.engines:
            parts = [asdict(p) | {"within_noise": self.within_noise(p)} for p in e.partings]
            engines.append(e.as_dict() | {"partings": parts})
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
            "reference_version": self.reference.engine.version,
            "reference_lifted_m": _finite(self.reference.lifted),
            "noise": {
                "perturbation": self.perturbation,
                "starts": len(self.noise_differences),
                "partings": [asdict(p) for p in self.noise],
            },
            "engines": engines,
        }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


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
        actions: the sequence.
        reference: engine that the others are compared with.
        engines: the others.
        thresholds: the differences from which engines count as parted.
        perturbed: number of perturbed starts in the reference. Long contact is chaotic: what such a start does to the
            reference itself is no fault of an engine.
        perturbation: size of the perturbations: each joint [rad, m] and each coordinate of the object [m] is moved by
            plus or minus this.
        seed: seed of the signs.
        progress: called with the name of each engine as it begins.

    Raises:
        XResetError: the reference itself does not stay finite.
    """
    thresholds = thresholds or Thresholds()
    if perturbed < 0 or not perturbation > 0:
        raise XResetError(
            f"There are {perturbed} perturbed starts of size {perturbation}; expected at least 0, and a size above 0."
        )
    dt = actions.scene.control_dt

    def replayed(engine: Engine, start: State) -> Recording:
        progress(engine.name)
        worlds = len(start.joint_pos)
        targets = actions.joint_target[:, None].expand(-1, worlds, -1).contiguous()
        episode = OpenLoopEpisode(start=start, targets=targets)
        return record(engine, actions.scene, torch.zeros(worlds, dtype=torch.long), episode)

    def compared(engine: Engine, recording: Recording) -> EngineTrace:
        d = differences(recording, expected, dt, thresholds)
        return EngineTrace(
            engine=engine, recording=recording, differences=d, partings=partings(d, actions.robot, thresholds)
        )

    expected = replayed(reference, _perturbed(actions.start, perturbed, perturbation, seed))
    base = compared(reference, expected)
    steps = len(base.differences.time)
    if steps < len(actions.joint_target):
        raise XResetError(
            f"the reference {reference.name!r} is not finite after {steps * dt:.3f} s of this sequence, so nothing can "
            "be compared with it. Choose another --reference, or another sequence."
        )
    noise = tuple(differences(expected, expected, dt, thresholds, world=1 + i) for i in range(perturbed))
    return TraceResult(
        actions=actions,
        thresholds=thresholds,
        reference=base,
        engines=tuple(compared(engine, replayed(engine, actions.start)) for engine in engines),
        noise=worst([partings(d, actions.robot, thresholds) for d in noise]) if noise else (),
        noise_differences=noise,
        perturbation=perturbation,
    )


def write_trace(folder: Path, result: TraceResult) -> None:
    """Write ``trace.json`` (the partings) and ``replays.npz`` (what every engine did)."""
    every = (result.reference, *result.engines)
    actions = result.actions
    write_json(folder / "trace.json", result.as_dict())

    def stacked(name: str) -> np.ndarray:
        return np.stack([getattr(e.recording, name)[:, 0].numpy() for e in every])

    arrays = {
        "engine": np.array([e.name for e in every]),
        "joint_names": np.array(actions.robot.joint_names),
        "fingertip_names": np.array(actions.robot.fingertip_names),
        "time": result.reference.differences.time,
        "joint_target": actions.joint_target.numpy(),
        "joint_pos": stacked("joint_pos"),
        "object_pos": stacked("object_pos"),
        "object_quat_wxyz": stacked("object_quat"),
        "tip_force": stacked("tip_force"),
    }
    config = {"actions": actions.label, "object": actions.object.name, "robot": actions.robot.name}
    write_npz(folder / "replays.npz", REPLAYS_SCHEMA, arrays, config=config)


def _perturbed(start: State, count: int, size: float, seed: int) -> State:
    """[1 + count] the start itself, then perturbed copies."""
    generator = torch.Generator().manual_seed(seed)
    copies = {name: value.expand(1 + count, -1).clone() for name, value in vars(start).items()}
    for name in ("joint_pos", "object_pos"):
        rows = copies[name][1:]
        rows += size * (2.0 * torch.randint(2, rows.shape, generator=generator) - 1.0)
    return State(**copies)
