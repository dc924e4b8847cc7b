"""``xreset trace``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from xreset.eval.engines.actions import Actions
    from xreset.eval.engines.trials import Engine


def trace(
    source: Annotated[Path, tyro.conf.Positional],
    *,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    reference: str = "mujoco",
    policy: str | None = None,
    object: str | None = None,
    episode: int = 0,
    repetition: int = 0,
    robot: str | None = None,
    objects: Path | None = None,
    joint_threshold: float = 0.02,
    position_threshold: float = 0.005,
    angle_threshold: float = 5.0,
    force_threshold: float = 2.0,
    contact_time: float = 0.05,
    perturbed: int = 4,
    perturbation: float = 1e-6,
    seed: int = 0,
    device: str = "cpu",
    strip: bool = False,
    mp4: bool = False,
    out: Path = Path("runs/trace"),
) -> None:
    """Replay one action sequence from one state in several engines, and say when, where and by how much they part.

    Args:
        source: Where the sequence comes from. Demonstrations, retargeted trajectories or a reset bank: an open-loop grasp and lift of one
            of their grasps; with --policy: an episode of that policy. An evaluation's trace (eval/BACKEND.trace.npz): the actions of a
            recorded episode. An actions.npz of this command: the same once more.
        backend: Engine to compare with the reference; give it again for several. Default: all that can be used here.
        reference: Engine that the others are compared with, and in which a policy plays.
        policy: Run folder, exported policy (.onnx), name of a policy that ships with xreset, or a baseline (zero, random, ik) that plays in
            the reference; its actions are replayed.
        object: Object, if the source has several; default: the first.
        episode: Which of the object's grasps, demonstrations or recorded episodes.
        repetition: With --policy: which perturbation of the demonstration's start.
        robot: Name or folder of the robot; default: the one that the source or policy is for.
        objects: Folder of real meshes; default: the stand-ins.
        joint_threshold: Difference of a joint from which it has parted [rad; a tenth of it in m for a prismatic joint].
        position_threshold: Difference of the object's position [m].
        angle_threshold: Difference of the object's orientation [degrees].
        force_threshold: Difference of a fingertip's force [N], averaged over 50 ms.
        contact_time: How long other fingers must touch than in the reference [s].
        perturbed: Number of starts in the reference that differ by next to nothing: how far they get is the noise floor.
        perturbation: By how much they differ, each joint [rad, m] and each coordinate of the object [m].
        seed: Of perturbations.
        device: Where GPU engines run: cpu or cuda.
        strip: Also write strip.png: pictures at several times, engines one below another.
        mp4: Also write film.mp4: engines side by side.
        out: Folder for trace.json, replays.npz, actions.npz and trace.png.
    """
    import math

    from xreset.cli._terminal import Console, Progress
    from xreset.errors import XResetError
    from xreset.eval.engines.actions import write_actions
    from xreset.eval.engines.divergence import Thresholds
    from xreset.eval.engines.film import write_film, write_strip
    from xreset.eval.engines.replay import trace as replay
    from xreset.eval.engines.replay import write_trace
    from xreset.eval.engines.trace_figure import write_plot
    from xreset.eval.engines.trace_table import rich_table, sentences
    from xreset.eval.engines.trials import engine

    limits = (joint_threshold, position_threshold, angle_threshold, force_threshold, contact_time)
    if min(limits) <= 0:
        raise XResetError(f"thresholds must be above 0, found {', '.join(map(str, limits))}.")
    if episode < 0 or repetition < 0:
        raise XResetError(f"--episode and --repetition count from 0, found {episode} and {repetition}.")
    thresholds = Thresholds(
        joint=joint_threshold,
        travel=0.1 * joint_threshold,
        position=position_threshold,
        angle=math.radians(angle_threshold),
        force=force_threshold,
        contact_time=contact_time,
    )
    console = Console()
    base = engine(reference, device=device)
    names = [name for name in dict.fromkeys(backend) or _usable(console) if name != reference]
    engines = [engine(name, device=device) for name in names]
    with Progress(console) as bar:
        task = bar.add_task("actions", total=None)

        def show(what: str) -> Callable[[int, int], None]:
            return lambda done, total: bar.update(task, description=what, completed=done, total=total)

        actions = _actions(
            source, base, policy=policy, object_name=object, episode=episode, repetition=repetition, robot=robot, objects=objects,
            seed=seed, progress=show("policy"),
        )  # fmt: skip
        result = replay(
            actions, base, engines, thresholds=thresholds, perturbed=perturbed, perturbation=perturbation, seed=seed,
            progress=lambda name: bar.update(task, description=name, completed=0, total=None),
        )  # fmt: skip
        write_actions(out / "actions.npz", actions)
        write_trace(out, result)
        write_plot(out / "trace.png", result)
        if strip:
            write_strip(out / "strip.png", result, progress=show("strip"))
        if mp4:
            write_film(out / "film.mp4", result, progress=show("film"))
    console.print(rich_table(result))
    for sentence in sentences(result):
        console.print(sentence, highlight=False)
    console.print(f"results in {out}")


def _usable(console) -> list[str]:
    """Names of the backends that can be used here; says why others cannot."""
    from xreset.plugins import backend_names, backend_status

    statuses = [backend_status(name) for name in backend_names()]
    for status in statuses:
        if status.reason is not None:
            console.print(f"left out {status.name}: {status.reason}")
    return [status.name for status in statuses if status.reason is None]


def _actions(
    source: Path,
    reference: Engine,
    *,
    policy: str | None,
    object_name: str | None,
    episode: int,
    repetition: int,
    robot: str | None,
    objects: Path | None,
    seed: int,
    progress: Callable[[int, int], None],
) -> Actions:
    """The sequence that the command's arguments mean."""
    from xreset.eval.engines import sources

    if policy is not None:
        return sources.from_policy(
            policy, source, reference, object_name=object_name, episode=episode, repetition=repetition, robot=robot, objects=objects,
            seed=seed, progress=progress,
        )  # fmt: skip
    return sources.from_file(source, object_name=object_name, episode=episode, robot=robot, objects=objects)


COMMAND = trace
