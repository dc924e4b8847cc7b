"""``xreset select``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Flat, Several, Source, quick_engines
from xreset.cli._terminal import console, show_table
from xreset.eval.setting import Setting
from xreset.files.checks import PositiveInt


def select(
    folder: Source,
    *,
    demos: Path,
    engine: Several = (),
    most: PositiveInt = 8,
    episodes: PositiveInt = 2,
    setting: Flat[Setting] = Setting(seed=1_000_003),
) -> None:
    """Choose the checkpoint of a training that is best in its worst engine.

    choice.json records the choice, and the run's policy.onnx becomes the chosen checkpoint until the run has newer
    ones. The episodes use other starts than xreset eval.

    Args:
        folder: Run folder.
        demos: Demonstrations whose starts and goals are played.
        engine: Physics engine; give it again for more engines. Default: all that can be used here, but not
            MuJoCo-Warp on a CPU, where it is slow.
        most: Largest number of checkpoints to play, spread over the training; the newest is included.
        episodes: Episodes of each demonstration.
        setting: Robot, meshes, seed of the starts, device and worlds; the default seed is one that evaluations do
            not use.
    """
    from xreset.eval import select as selection

    engines = quick_engines(engine, setting.device)

    def say(name: str, engine: str, score: float) -> None:
        console.print(f"{name} in {engine}: {100 * score:.1f} %")

    choice = selection.select(
        folder, engines, demos, setting, most=most, episodes=episodes, progress=say
    )
    names = [engine.name for engine in engines]
    table = [("checkpoint", *names, "worst")]
    for candidate in choice.candidates:
        scores = {name: f"{100 * score:.1f} %" for name, score in candidate.task_progress.items()}
        mark = " (chosen)" if candidate.name == choice.chosen else ""
        at_most = "" if len(scores) == len(names) else "at most "
        worst = f"{at_most}{100 * candidate.worst:.1f} %"
        table.append((candidate.name + mark, *(scores.get(name, "") for name in names), worst))
    show_table(table, title="task progress")
    console.print(f"chosen: {choice.sentence()}")
    console.print(f"recorded in {folder / 'choice.json'}")


COMMAND = select
