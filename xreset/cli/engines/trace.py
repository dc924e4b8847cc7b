"""``xreset engines trace``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from xreset.checks import Options
from xreset.cli._common import usable_engines
from xreset.cli._terminal import Console, Progress
from xreset.errors import XResetError
from xreset.eval import trial
from xreset.eval.engines import actions, divergence, film, replay, sources, trace_view
from xreset.eval.setting import Place, Sequence


@dataclass(frozen=True, kw_only=True)
class Limits(Options):
    """From which difference on engines have diverged."""

    joint_threshold: float = 0.02
    """Difference of a joint from which it has diverged [rad; a tenth of it in m for a prismatic joint]."""
    position_threshold: float = 0.005
    """Difference of the object's position [m]."""
    angle_threshold: float = 5.0
    """Difference of the object's orientation [degrees]."""
    force_threshold: float = 2.0
    """Difference of a fingertip's force [N], averaged over 50 ms."""
    contact_time: float = 0.05
    """How long other fingers must touch than in the reference [s]."""
    perturbed: int = 4
    """Number of starts in the reference that differ by next to nothing: how far they get is the noise floor."""
    perturbation: float = 1e-6
    """By how much they differ, each joint [rad, m] and each coordinate of the object [m]."""

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
    """What is written."""

    strip: bool = False
    """Also write strip.png: pictures at several times, engines one below another."""
    mp4: bool = False
    """Also write film.mp4: engines side by side."""
    out: Path = Path("runs/trace")
    """Folder for trace.json, replays.npz, actions.npz and trace.png."""


def trace(
    source: Annotated[Path, tyro.conf.Positional],
    *,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    reference: str = "mujoco",
    sequence: Annotated[Sequence, tyro.conf.arg(name="")] = Sequence(),  # noqa: B008
    place: Annotated[Place, tyro.conf.arg(name="")] = Place(),  # noqa: B008
    limits: Annotated[Limits, tyro.conf.arg(name="")] = Limits(),
    output: Annotated[Output, tyro.conf.arg(name="")] = Output(),
) -> None:
    """Replay one action sequence from one state in several engines, and say when, where and by how much they diverge.

    Args:
        source: Where the sequence comes from. Demonstrations, retargeted trajectories or a reset bank: an open-loop grasp and lift of one
            of their grasps; with --policy: an episode of that policy. An evaluation's trace (eval/BACKEND.trace.npz): the actions of a
            recorded episode. An actions.npz of this command: the same once more.
        backend: Engine to compare with the reference; give it again for several. Default: all that can be used here.
        reference: Engine that the others are compared with, and in which a policy plays.
        sequence: Which.
        place: Robot, meshes, seed, device.
        limits: When engines have diverged.
        output: Files.
    """
    thresholds = divergence.Thresholds(
        joint=limits.joint_threshold,
        travel=0.1 * limits.joint_threshold,
        position=limits.position_threshold,
        angle=math.radians(limits.angle_threshold),
        force=limits.force_threshold,
        contact_time=limits.contact_time,
    )
    console, out = Console(), output.out
    base = trial.engine(reference, device=place.device)
    names = [name for name in dict.fromkeys(backend) or usable_engines(console) if name != reference]
    engines = [trial.engine(name, device=place.device) for name in names]
    with Progress(console) as bar:
        task = bar.add_task("actions", total=None)

        def show(what: str) -> Callable[[int, int], None]:
            return lambda done, total: bar.update(task, description=what, completed=done, total=total)

        if sequence.policy is None:
            played = sources.from_file(source, sequence, place)
        else:
            played = sources.from_policy(source, base, sequence, place, show("policy"))
        result = replay.trace(
            played, base, engines, thresholds=thresholds, perturbed=limits.perturbed, perturbation=limits.perturbation, seed=place.seed,
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
        console.print(sentence, highlight=False)
    console.print(f"results in {out}")


COMMAND = trace
