"""``xreset engines trace``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from xreset.checks import Options
from xreset.cli._common import Flat, Several, Source, usable_engines
from xreset.cli._terminal import Progress, console
from xreset.eval import trial
from xreset.eval.engines import actions, film, replay, sources, trace_view
from xreset.eval.setting import Place, Sequence


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
        output: Files to write.
    """
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
            played, base, engines, seed=place.seed,
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
