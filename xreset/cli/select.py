"""``xreset select``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rich.table import Table

from xreset.cli._common import Flat, Several, Source, chosen_engines
from xreset.cli._terminal import console
from xreset.eval.setting import Setting


def select(
    folder: Source,
    *,
    demos: Path,
    backend: Several = (),
    most: int = 8,
    episodes: int = 2,
    setting: Flat[Setting] = Setting(),
    starts: int | None = None,
) -> None:
    """Choose the checkpoint of a training that is best in its worst engine.

    choice.json records the choice, and the run's policy.onnx becomes the chosen checkpoint until the run has newer
    ones. The episodes use other starts than xreset eval.

    Args:
        folder: Run folder, or a folder of exported policies (.onnx).
        demos: Demonstrations whose starts and goals are played.
        backend: Physics engine; give it again for more engines. Default: mujoco, pybullet and sapien.
        most: Largest number of checkpoints to play, spread over the training; the newest is included.
        episodes: Episodes of each demonstration.
        setting: Robot, meshes, device and worlds; --seed is not used, see --starts.
        starts: Seed of the starts; default: one that evaluations do not use.
    """
    from xreset.eval import select as selection

    engines = chosen_engines(backend or ("mujoco", "pybullet", "sapien"), setting.device)

    def say(name: str, engine: str, score: float | None) -> None:
        if score is not None:
            console.print(f"{name} in {engine}: {100 * score:.1f} %")

    setting = replace(setting, seed=selection.SEED if starts is None else starts)
    choice = selection.select(folder, engines, demos, setting, most=most, episodes=episodes, progress=say)
    table = Table("checkpoint", title="task progress", title_justify="left")
    for e in engines:
        table.add_column(e.name, justify="right")
    table.add_column("worst", justify="right")
    for candidate in choice.candidates:
        cells = [
            f"{100 * candidate.task_progress[e.name]:.1f} %" if e.name in candidate.task_progress else ""
            for e in engines
        ]
        mark = " (chosen)" if candidate.name == choice.chosen else ""
        at_most = "" if len(candidate.task_progress) == len(engines) else "at most "
        table.add_row(candidate.name + mark, *cells, f"{at_most}{100 * candidate.worst:.1f} %")
    console.print(table)
    console.print(f"chosen: {choice.sentence()}")
    console.print(f"recorded in {folder / 'choice.json'}")


COMMAND = select
