"""``xreset select``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from xreset.cli._terminal import Console
from xreset.eval import select as selection
from xreset.eval import trial
from xreset.eval.setting import Setting


def select(
    folder: Annotated[Path, tyro.conf.Positional],
    *,
    demos: Path,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),  # a default would be appended to
    most: int = 8,
    episodes: int = 2,
    setting: Annotated[Setting, tyro.conf.arg(name="")] = Setting(),  # noqa: B008
    starts: int | None = None,
) -> None:
    """Choose among a training's checkpoints by all engines: the one that does best in the engine in which it does worst.

    The choice is recorded in choice.json; a run's policy is then the chosen checkpoint, until the run has newer ones. The episodes that
    decide begin with other starts than those of xreset eval.

    Args:
        folder: Run folder, or a folder of exported policies (.onnx).
        demos: Demonstrations whose starts and goals are played.
        backend: Physics engine; give it again for more engines. Default: mujoco, pybullet and sapien.
        most: Checkpoints to play at most, spread over all of them, the newest one included.
        episodes: Episodes of each demonstration.
        setting: Robot, meshes, device and worlds; --seed is not used, see --starts.
        starts: Seed of the starts that decide; default: one that no evaluation uses unless it is told to.
    """
    engines = [
        trial.engine(name, device=setting.device) for name in dict.fromkeys(backend or ("mujoco", "pybullet", "sapien"))
    ]
    console = Console()

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
