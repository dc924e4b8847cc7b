"""Replaying an action sequence in several engines, and in the reference from starts that differ by next to nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch

from xreset.errors import XResetError
from xreset.eval.engines.actions import Actions
from xreset.eval.engines.divergence import THRESHOLDS, Differences, Divergence, differences, worst
from xreset.eval.engines.recording import Recording, play
from xreset.eval.trial import Engine
from xreset.physics import State

SCHEMA = "xreset-divergence/1"
PERTURBED = 4
"""Perturbed starts in the reference. Long contact is chaotic: what such a start does to the reference itself is no
fault of an engine."""
PERTURBATION = 1e-6
"""Each joint [rad, m] and each coordinate of the object [m] is moved by plus or minus this."""


@dataclass(frozen=True, kw_only=True)
class EngineTrace:
    """What one engine did, and where it diverges from the reference."""

    engine: Engine
    recording: Recording
    """Its first world is the sequence's own."""
    differences: Differences

    @property
    def name(self) -> str:
        """Name of the engine."""
        return self.engine.name

    @property
    def divergences(self) -> tuple[Divergence, ...]:
        """How each quantity diverges; empty if no step is finite."""
        return self.differences.first()

    @property
    def lifted(self) -> float | None:
        """Height of the object at the end above its start [m]; None if it is not finite."""
        height = float(self.recording.lifted[0])
        return height if math.isfinite(height) else None


@dataclass(frozen=True, kw_only=True)
class TraceResult:
    """The outcome of :func:`trace`."""

    actions: Actions
    reference: EngineTrace
    engines: tuple[EngineTrace, ...]
    """The other engines."""
    noise: tuple[Differences, ...]
    """The reference from each perturbed start against itself."""

    @property
    def worst_noise(self) -> tuple[Divergence, ...]:
        """The worst of the perturbed starts for each quantity."""
        return worst([noise.first() for noise in self.noise])

    def within_noise(self, found: Divergence) -> bool:
        """Whether the reference diverges as far from itself, and no later, from a start that hardly differs."""
        for noise in self.worst_noise:
            if noise.quantity == found.quantity and found.largest <= noise.largest:
                return found.time is None or (noise.time is not None and noise.time <= found.time)
        return False

    def as_dict(self) -> dict[str, Any]:
        """Return JSON-able content."""
        actions = self.actions
        engines = []
        for e in (self.reference, *self.engines):
            engines.append(
                {
                    "name": e.name,
                    "version": e.engine.version,
                    "device": e.engine.device,
                    "lifted_m": e.lifted,
                    "finite_steps": len(e.differences.time),
                    "divergences": [asdict(d) | {"within_noise": self.within_noise(d)} for d in e.divergences],
                }
            )
        return {
            "schema": SCHEMA,
            "label": actions.label,
            "robot": actions.robot.name,
            "object": actions.object.name,
            "steps": len(actions.joint_target),
            "thresholds": THRESHOLDS,
            "reference": self.reference.name,
            "noise": [asdict(d) for d in self.worst_noise],
            "engines": engines,
        }


def trace(
    actions: Actions,
    reference: Engine,
    engines: Sequence[Engine],
    *,
    seed: int = 0,
    progress: Callable[[str], None] = lambda name: None,
) -> TraceResult:
    """Replay a sequence in each engine and compare with the reference.

    Args:
        actions: the sequence.
        reference: engine that the others are compared with.
        engines: the others.
        seed: seed of the perturbed starts.
        progress: called with the name of each engine as it begins.

    Raises:
        XResetError: the reference itself does not stay finite.
    """
    dt = actions.scene.control_dt

    def replayed(engine: Engine, start: State) -> Recording:
        progress(engine.name)
        worlds = len(start.joint_pos)
        targets = actions.joint_target[:, None].expand(-1, worlds, -1).contiguous()
        with engine.make(actions.scene, worlds, torch.zeros(worlds, dtype=torch.long)) as backend:
            return play(backend, start, targets)

    def compared(engine: Engine, recording: Recording) -> EngineTrace:
        found = differences(recording, expected, actions.robot, dt)
        return EngineTrace(engine=engine, recording=recording, differences=found)

    expected = replayed(reference, _perturbed(actions.start, seed))
    base = compared(reference, expected)
    steps = len(base.differences.time)
    if steps < len(actions.joint_target):
        raise XResetError(
            f"the reference {reference.name!r} is not finite after {steps * dt:.3f} s of this sequence, so nothing can "
            "be compared with it. Choose another --reference, or another sequence."
        )
    noise = [differences(expected, expected, actions.robot, dt, world=1 + i) for i in range(PERTURBED)]
    return TraceResult(
        actions=actions,
        reference=base,
        engines=tuple(compared(engine, replayed(engine, actions.start)) for engine in engines),
        noise=tuple(noise),
    )


def _perturbed(start: State, seed: int) -> State:
    """[1 + PERTURBED] the start itself, then perturbed copies."""
    generator = torch.Generator().manual_seed(seed)
    copies = {name: value.expand(1 + PERTURBED, -1).clone() for name, value in vars(start).items()}
    for name in ("joint_pos", "object_pos"):
        rows = copies[name][1:]
        rows += PERTURBATION * (2.0 * torch.randint(2, rows.shape, generator=generator) - 1.0)
    return State(**copies)
