"""``xreset engines trace``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Flat, Several, Source, usable_engines
from xreset.cli._terminal import Progress, console
from xreset.eval.setting import Place
from xreset.files import write_json


def trace(
    source: Source,
    *,
    backend: Several = (),
    reference: str = "mujoco",
    object: str | None = None,
    episode: int = 0,
    place: Flat[Place] = Place(),
    out: Path = Path("runs/trace"),
) -> None:
    """Replay the same actions from the same state in several engines, and show when and by how much they diverge.

    Args:
        source: Source of the actions. Demonstrations or robot motion: an open-loop grasp and lift. The trace of an
            evaluation (eval/BACKEND.trace.npz): an episode of the policy. An actions.npz of this command.
        backend: Engine to compare with the reference; give it again for more. Default: all that can be used here.
        reference: Engine that the others are compared with.
        object: Object, if the source has several; default: the first.
        episode: Which of the object's grasps or recorded episodes.
        place: Robot, meshes, seed, device.
        out: Folder for trace.json, trace.png, and actions.npz: the actions, and what every engine did.
    """
    from xreset.eval import trial
    from xreset.eval.engines import actions, replay, trace_view

    base = trial.engine(reference, device=place.device)
    names = [name for name in dict.fromkeys(backend) or usable_engines() if name != reference]
    engines = [trial.engine(name, device=place.device) for name in names]
    with Progress() as bar:
        task = bar.add_task("actions", total=None)
        played = actions.from_file(source, place, object, episode)
        result = replay.trace(
            played,
            base,
            engines,
            seed=place.seed,
            progress=lambda name: bar.update(task, description=name),
        )
        replays = {e.name: e.recording for e in (result.reference, *result.engines)}
        actions.write_actions(out / "actions.npz", played, replays)
        write_json(out / "trace.json", result.as_dict())
        trace_view.write_plot(out / "trace.png", result)
    console.print(trace_view.rich_table(result))
    for sentence in trace_view.sentences(result):
        console.print(sentence)
    console.print(f"results in {out}")


COMMAND = trace
