"""Replay an action sequence in several engines, and find when, where and by how much they diverge from a reference.

The reference also replays the sequence from slightly perturbed starts. Shape letters: T control steps, J joints, E
fingertips.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import torch
from rich.table import Table
from rich.text import Text
from scipy.ndimage import binary_opening

from xreset.errors import XResetError
from xreset.eval.engines.actions import Actions
from xreset.eval.engines.recording import Recording, play
from xreset.eval.rollout import Engine
from xreset.files.checks import frozen
from xreset.geometry.rotations import quat_angle
from xreset.geometry.urdf import prismatic_joints
from xreset.physics import State
from xreset.spec import SceneSpec

PERTURBED = 4
"""Number of perturbed starts in the reference. Long contact is chaotic, so an engine that diverges no more than the
reference from such a start is not at fault."""
PERTURBATION = 1e-6
"""Change of each joint [rad, m] and of each coordinate of the object [m] in a perturbed start, with random sign."""
THRESHOLDS = {
    "joints": 0.02,
    "object position": 0.005,
    "object orientation": math.radians(5.0),
    "contacts": 1.0,
    "contact force": 2.0,
}
"""Least difference of engines that have diverged: of the joint that differs most [rad; 1 m of a prismatic joint counts
as 10 rad], of the object's origin [m] and orientation [rad], the number of fingers that touch in one engine only, and
of the magnitude of a fingertip's force [N]."""
WINDOW = 0.05
"""Time over which forces are averaged [s], because the contact force of a single step is noisy."""
TOUCH = 0.1
"""Averaged force from which a fingertip counts as touching [N]."""
CONTACT_TIME = 0.05
"""Contacts have diverged if other fingers than in the reference touch for this time [s]."""


@frozen
class Divergence:
    """How one quantity of :data:`THRESHOLDS` diverges from the reference."""

    quantity: str
    time: float | None
    """Time at which the difference first reaches the threshold [s]; None if never."""
    where: str
    """Joint or fingers that differ at that time; empty if never, and for quantities of the object."""
    end: float
    """Difference at the end."""
    largest: float
    """Largest difference."""


@frozen
class EngineTrace:
    """The recording of one engine, and how it differs from the reference."""

    engine: Engine
    recording: Recording
    """Recording whose first world starts from the unperturbed state."""
    steps: int
    """Number of control steps before the first that is not finite in one of both engines."""
    divergences: tuple[Divergence, ...]
    """Divergence of each quantity; empty if no step is finite."""

    @property
    def lifted(self) -> float | None:
        """Height of the object at the end above its start [m]; None if it is not finite."""
        height = float(self.recording.lifted[0])
        return height if math.isfinite(height) else None


def compared(
    engine: Engine, found: Recording, reference: Recording, scene: SceneSpec, *, world: int = 0
) -> EngineTrace:
    """Compare a world of a recording with the first world of the reference's recording, which is as long.

    Args:
        engine: engine of the recording.
        found: the recording.
        reference: the reference's recording.
        scene: scene of both.
        world: index of the world of ``found``.
    """
    robot = scene.robot
    dt = scene.control_dt
    scale = np.where(prismatic_joints(robot), 10.0, 1.0)
    fingers = robot.fingertip_names
    force = found.tip_force[:, world].norm(dim=-1).double().numpy()
    other = reference.tip_force[:, 0].norm(dim=-1).double().numpy()
    joint = (found.joint_pos[:, world] - reference.joint_pos[:, 0]).abs().double().numpy() * scale
    position = (
        (found.object_pos[:, world] - reference.object_pos[:, 0]).double().norm(dim=-1).numpy()
    )
    angle = quat_angle(
        found.object_quat[:, world].double(), reference.object_quat[:, 0].double()
    ).numpy()
    broken = ~np.isfinite(np.column_stack((joint, position, angle, force, other))).all(axis=1)
    steps = int(broken.argmax()) if broken.any() else len(joint)
    force = _averaged(force[:steps], dt)
    other = _averaged(other[:steps], dt)
    change = np.abs(force - other)
    touch = force >= TOUCH
    differs = touch != (other >= TOUCH)
    values = {
        "joints": joint[:steps].max(axis=1),
        "object position": position[:steps],
        "object orientation": angle[:steps],
        "contacts": differs.sum(axis=1),
        "contact force": change.max(axis=1),
    }

    def where(quantity: str, step: int) -> str:
        """Return which joint or which fingers differ."""
        if quantity == "joints":
            return robot.joint_names[joint[step].argmax()]
        if quantity == "contact force":
            return fingers[change[step].argmax()]
        if quantity != "contacts":
            return ""
        return ", ".join(
            f"{fingers[i]} {'touches' if touch[step, i] else 'does not touch'}"
            for i in np.flatnonzero(differs[step])
        )

    divergences = []
    if steps:
        for quantity, value in values.items():
            divergences.append(_divergence(quantity, value, dt, partial(where, quantity)))
    return EngineTrace(engine=engine, recording=found, steps=steps, divergences=tuple(divergences))


def _divergence(
    quantity: str, value: np.ndarray, dt: float, where: Callable[[int], str]
) -> Divergence:
    """Return the divergence of a quantity.

    Args:
        quantity: its name.
        value: [T] difference after each control step.
        dt: control step [s].
        where: returns the joint or the fingers that differ, given a step.
    """
    beyond = value >= THRESHOLDS[quantity]
    if quantity == "contacts":
        beyond = binary_opening(beyond, np.ones(max(1, round(CONTACT_TIME / dt))))
    step = int(beyond.argmax())
    diverges = bool(beyond[step])
    return Divergence(
        quantity=quantity,
        time=(step + 1) * dt if diverges else None,
        where=where(step) if diverges else "",
        end=float(value[-1]),
        largest=float(value.max()),
    )


def _averaged(force: np.ndarray, dt: float) -> np.ndarray:
    """[T, E] mean over the window that ends at each step; the window is shorter at the beginning."""
    steps = max(1, round(WINDOW / dt))
    return pd.DataFrame(force).rolling(steps, min_periods=1).mean().to_numpy()


@frozen
class TraceResult:
    """The outcome of :func:`trace`."""

    actions: Actions
    reference: EngineTrace
    engines: tuple[EngineTrace, ...]
    """The other engines."""
    noise: tuple[EngineTrace, ...]
    """The reference from each perturbed start, compared with the reference."""

    @property
    def worst_noise(self) -> tuple[Divergence, ...]:
        """The earliest time and the largest differences of the perturbed starts for each quantity."""
        out = []
        for same in zip(*(noise.divergences for noise in self.noise), strict=True):
            first = min(same, key=lambda d: d.time or math.inf)
            out.append(
                replace(first, end=max(d.end for d in same), largest=max(d.largest for d in same))
            )
        return tuple(out)

    def within_noise(self, found: Divergence) -> bool:
        """Return whether the reference diverges at least as far and as early from itself, from the perturbed starts."""
        for noise in self.worst_noise:
            if noise.quantity == found.quantity and found.largest <= noise.largest:
                return found.time is None or (noise.time or math.inf) <= found.time
        return False

    def as_dict(self) -> dict[str, Any]:
        """Return the content of ``trace.json``."""
        actions = self.actions
        engines = []
        for e in (self.reference, *self.engines):
            engines.append(
                {
                    "name": e.engine.name,
                    "version": e.engine.version,
                    "device": e.engine.device,
                    "lifted_m": e.lifted,
                    "finite_steps": e.steps,
                    "divergences": [
                        asdict(d) | {"within_noise": self.within_noise(d)} for d in e.divergences
                    ],
                }
            )
        return {
            "label": actions.label,
            "robot": actions.robot.name,
            "object": actions.object.name,
            "steps": len(actions.joint_target),
            "thresholds": THRESHOLDS,
            "reference": self.reference.engine.name,
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
    scene = actions.scene

    def replayed(engine: Engine, start: State) -> Recording:
        progress(engine.name)
        worlds = len(start.joint_pos)
        targets = actions.joint_target[:, None].expand(-1, worlds, -1).contiguous()
        with engine.make(scene, worlds, torch.zeros(worlds, dtype=torch.long)) as backend:
            return play(backend, start, targets)

    expected = replayed(reference, _perturbed(actions.start, seed))
    base, *noise = (
        compared(reference, expected, expected, scene, world=i) for i in range(1 + PERTURBED)
    )
    if base.steps < len(actions.joint_target):
        raise XResetError(
            f"the reference {reference.name!r} is not finite after {base.steps * scene.control_dt:.3f} s of this "
            "sequence, so nothing can be compared with it. Choose another --reference, or another sequence."
        )
    traces = [
        compared(engine, replayed(engine, actions.start), expected, scene) for engine in engines
    ]
    return TraceResult(actions=actions, reference=base, engines=tuple(traces), noise=tuple(noise))


def _perturbed(start: State, seed: int) -> State:
    """Return states [1 + PERTURBED, ...]: the start, then perturbed copies."""
    generator = torch.Generator().manual_seed(seed)
    copies = {name: value.expand(1 + PERTURBED, -1).clone() for name, value in vars(start).items()}
    for name in ("joint_pos", "object_pos"):
        rows = copies[name][1:]
        rows += PERTURBATION * (2.0 * torch.randint(2, rows.shape, generator=generator) - 1.0)
    return State(**copies)


# For a terminal -------------------------------------------------------------------------------------------------------

_SHOWN = {
    "joints": ("mrad", 1e3),
    "object position": ("mm", 1e3),
    "object orientation": ("deg", math.degrees(1.0)),
    "contacts": ("fingers", 1.0),
    "contact force": ("N", 1.0),
}
"""Unit of a quantity in texts, and the factor to it."""


def shown(quantity: str, value: float) -> str:
    """Return a difference as text, with two significant digits and without an exponent."""
    unit, scale = _SHOWN[quantity]
    return f"{float(f'{value * scale:.2g}'):g} {unit}"


def rich_table(result: TraceResult) -> Table:
    """Return a table with a column for each engine and one for the reference's noise, and a row for each quantity."""
    reference = result.reference.engine.name
    title = f"{result.actions.label}\n{result.actions.robot.name}: when, where and by how much engines diverge"
    table = Table("", title=f"{title} from {reference}", title_justify="left", show_lines=True)
    for e in result.engines:
        table.add_column(f"{e.engine.name} {e.engine.version}")
    table.add_column(f"{reference}, {len(result.noise)} starts moved by {PERTURBATION:.0e}")
    table.add_row("object lifted by", *map(_height, (*result.engines, result.reference)))
    for i, noise in enumerate(result.worst_noise):
        cells = []
        for e in result.engines:
            found = e.divergences[i] if e.divergences else None
            cells.append(_cell(found, result.within_noise(found)) if found else "-")
        quantity = f"{noise.quantity}\n(from {shown(noise.quantity, THRESHOLDS[noise.quantity])})"
        table.add_row(quantity, *cells, _cell(noise, False))
    return table


def _cell(found: Divergence, noise: bool) -> Text:
    lines = ["never"]
    if found.time is not None:
        lines = [f"{found.time:.3f} s"]
        if noise:
            lines.append("within noise")
    if found.where:
        lines.append(found.where)
    lines += [
        f"end {shown(found.quantity, found.end)}",
        f"most {shown(found.quantity, found.largest)}",
    ]
    return Text("\n".join(lines), "dim" if noise and found.time is not None else "")


def _height(engine: EngineTrace) -> str:
    return "not finite" if engine.lifted is None else f"{1e3 * engine.lifted:.0f} mm"


def sentences(result: TraceResult) -> Iterator[str]:
    """Yield a sentence for each engine that says where it diverges first."""
    same = result.reference.engine.name
    for traced in result.engines:
        name = traced.engine.name
        beyond = [d for d in traced.divergences if d.time and not result.within_noise(d)]
        if traced.steps < len(result.actions.joint_target):
            end = traced.steps * result.actions.scene.control_dt
            yield f"{name} is no longer finite after {end:.3f} s, where the comparison ends."
        elif not beyond:
            yield f"{name} stays with {same}: within the thresholds, or as near as {same} stays to itself."
        else:
            first = min(beyond, key=lambda d: d.time or 0.0)
            where = f": {first.where}" if first.where else ""
            yield f"{name} diverges first in {first.quantity} at {first.time:.3f} s{where}."
