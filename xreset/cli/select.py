"""``xreset select``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from xreset.cli._common import Flat, Several, Source
from xreset.cli._terminal import console, show_table
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
        folder: Run folder.
        demos: Demonstrations whose starts and goals are played.
        backend: Physics engine; give it again for more engines. Default: mujoco, pybullet and sapien.
        most: Largest number of checkpoints to play, spread over the training; the newest is included.
        episodes: Episodes of each demonstration.
        setting: Robot, meshes, device and worlds; --seed is not used, see --starts.
        starts: Seed of the starts; default: one that evaluations do not use.
    """
    from xreset.eval import rollout
    from xreset.eval import select as selection

    engines = rollout.chosen_engines(backend or ("mujoco", "pybullet", "sapien"), setting.device)

    def say(name: str, engine: str, score: float) -> None:
        console.print(f"{name} in {engine}: {100 * score:.1f} %")

    setting = replace(setting, seed=selection.SEED if starts is None else starts)
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
