"""``xreset engines trace``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from xreset.checks import Options
from xreset.cli._common import Flat, Several, Source, usable_engines
from xreset.cli._terminal import Progress, console
from xreset.errors import XResetError
from xreset.eval import trial
from xreset.eval.engines import actions, divergence, film, replay, sources, trace_view
from xreset.eval.setting import Place, Sequence


@dataclass(frozen=True, kw_only=True)
class Limits(Options):
    """Differences from which engines count as diverged."""

    joint_threshold: float = 0.02
    """Difference of a joint [rad; a tenth of it in m for a prismatic joint]."""
    position_threshold: float = 0.005
    """Difference of the object's position [m]."""
    angle_threshold: float = 5.0
    """Difference of the object's orientation [degrees]."""
    force_threshold: float = 2.0
    """Difference of a fingertip's force [N], averaged over 50 ms."""
    contact_time: float = 0.05
    """Time for which other fingers touch than in the reference [s]."""
    perturbed: int = 4
    """Number of slightly different starts in the reference, which give the noise floor."""
    perturbation: float = 1e-6
    """Difference of these starts, for each joint [rad, m] and each coordinate of the object [m]."""

    def __post_init__(self) -> None:
        limits = (
            self.joint_threshold,
            self.position_threshold,
            self.angle_threshold,
            self.force_threshold,
            self.contact_time,
        )
        if min(limits) <= 0:
            raise XResetError(f"thresholds must be above 0, found {', '.join(map(str, limits))}.")


@dataclass(frozen=True, kw_only=True)
class Output(Options):
    """Files to write."""

    strip: bool = False
    """Also write strip.png: pictures at several times, one row for each engine."""
    mp4: bool = False
    """Also write film.mp4: engines next to each other."""
    out: Path = Path("runs/trace")
    """Folder for trace.json, replays.npz, actions.npz and trace.png."""


def trace(
    source: Source,
    *,
    backend: Several = (),
    reference: str = "mujoco",
    sequence: Flat[Sequence] = Sequence(),
    place: Flat[Place] = Place(),
    limits: Flat[Limits] = Limits(),
    output: Flat[Output] = Output(),
) -> None:
    """Replay the same actions from the same state in several engines, and show when and by how much they diverge.

    Args:
        source: Source of the actions. Demonstrations, robot motion or a reset bank: an open-loop grasp and lift; with
            --policy, an episode of that policy. The trace of an evaluation (eval/BACKEND.trace.npz): a recorded
            episode. An actions.npz of this command.
        backend: Engine to compare with the reference; give it again for more. Default: all that can be used here.
        reference: Engine that the others are compared with, and in which a policy plays.
        sequence: The episode or grasp to replay.
        place: Robot, meshes, seed, device.
        limits: Differences from which engines count as diverged.
        output: Files to write.
    """
    thresholds = divergence.Thresholds(
        joint=limits.joint_threshold,
        travel=0.1 * limits.joint_threshold,
        position=limits.position_threshold,
        angle=math.radians(limits.angle_threshold),
        force=limits.force_threshold,
        contact_time=limits.contact_time,
    )
    out = output.out
    base = trial.engine(reference, device=place.device)
    names = [name for name in dict.fromkeys(backend) or usable_engines() if name != reference]
    engines = [trial.engine(name, device=place.device) for name in names]
    with Progress() as bar:
        task = bar.add_task("actions", total=None)

        def show(what: str) -> Callable[[int, int], None]:
            return lambda done, total: bar.update(task, description=what, completed=done, total=total)

        if sequence.policy is None:
            played = sources.from_file(source, sequence, place)
        else:
            played = sources.from_policy(source, base, sequence, place, show("policy"))
        result = replay.trace(
            played, base, engines, thresholds=thresholds, perturbed=limits.perturbed,
            perturbation=limits.perturbation, seed=place.seed,
            progress=lambda name: bar.update(task, description=name, completed=0, total=None),
        )  # fmt: skip
        actions.write_actions(out / "actions.npz", played)
        replay.write_trace(out, result)
        trace_view.write_plot(out / "trace.png", result)
        if output.strip:
            film.write_strip(out / "strip.png", result, progress=show("strip"))
        if output.mp4:
            film.write_film(out / "film.mp4", result, progress=show("film"))
    console.print(trace_view.rich_table(result))
    for sentence in trace_view.sentences(result):
        console.print(sentence)
    console.print(f"results in {out}")


COMMAND = trace
