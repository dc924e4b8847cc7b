"""``xreset attribute``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def attribute(
    policy: Annotated[str, tyro.conf.Positional],
    *,
    demos: Path,
    towards: str,
    backend: str = "mujoco",
    only: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    what_if: bool = False,
    object: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),
    max_demos: int | None = None,
    episodes: int = 1,
    seed: int = 0,
    robot: str | None = None,
    objects: Path | None = None,
    num_envs: int = 64,
    device: str = "cpu",
    out: Path | None = None,
) -> None:
    """Tell which physical difference between two engines costs a policy its skill.

    Both engines are measured, through the interface alone: sliding and torsional friction, object mass and inertia, drive stiffness and
    damping, timestep, contact softness, latency. Then the policy plays in one engine, in that engine with one property at a time changed to
    the other's value, with all of them at once, and in the other engine: the same episodes from the same starts.

    Args:
        policy: Run folder, exported policy (.onnx), name of a policy that ships with xreset (xreset policies list), or a baseline: zero,
            random, ik (open-loop kinematic retargeting).
        demos: Demonstrations (xreset demos) or retargeted trajectories (xreset retarget): starts and goals, and the path of ik.
        towards: Engine towards which the properties are changed, usually the one in which the policy does worse.
        backend: Engine in which they are changed.
        only: Property to try; give it again for several. Default: all in which the engines differ.
        what_if: Also try the properties in which they do not differ, with changes of a usual size.
        object: Object to play with; give it again for several. Default: all.
        max_demos: Demonstrations to play at most, spread over all.
        episodes: Episodes per demonstration.
        seed: Seed of the perturbations of the starts.
        robot: Name or folder of the robot; default: the policy's.
        objects: Folder of real meshes; default: what the policy was trained with, else the stand-ins.
        num_envs: Worlds at a time.
        device: Where GPU engines run: cpu or cuda.
        out: Folder for attribution.json and attribution.png; default: attribute/ beside the policy's results.
    """
    import numpy as np

    from xreset.cli._terminal import Console, Progress
    from xreset.errors import DemoError, XResetError
    from xreset.eval.engines.attribution import attribute as experiment
    from xreset.eval.engines.figures import write_plot
    from xreset.eval.engines.tables import not_tried, rich_table, verdict
    from xreset.eval.engines.trials import engine
    from xreset.eval.evaluate import load_motion, resolve
    from xreset.files import file_hash, write_json
    from xreset.objects import load_objects
    from xreset.task.config import evaluation_task

    if min(episodes, num_envs, 1 if max_demos is None else max_demos) < 1:
        raise XResetError(f"--episodes, --num-envs and --max-demos must be at least 1, found {episodes}, {num_envs} and {max_demos}.")
    if backend == towards:
        raise XResetError(f"--backend and --towards are both {backend!r}; an engine does not differ from itself.")
    console = Console()
    subject = resolve(policy, robot, seed)
    a, b = engine(backend, device=device), engine(towards, device=device)
    folder = subject.meshes(objects)
    bank, trajectories = load_motion(demos, subject.robot, folder, trajectories=subject.label == "ik")
    there = sorted({*map(str, bank.sequence_object)})
    if unknown := sorted(set(object) - set(there)):
        raise DemoError(f"{demos} has no {', '.join(unknown)}; it has {', '.join(there)}.")
    chosen = np.flatnonzero(np.isin(bank.sequence_object, object or there))
    if max_demos is not None and max_demos < len(chosen):
        chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, max_demos).round().astype(int))]
    loaded = load_objects(sorted({*map(str, bank.sequence_object[chosen])}), folder)
    out = out or subject.folder.parent / "attribute"
    with Progress(console) as bar:
        task = bar.add_task("", total=None)
        found = experiment(
            lambda: subject.policy(subject.robot, trajectories), a, b, subject.robot, loaded, bank, evaluation_task(subject.task),
            episodes=episodes, seed=seed, num_envs=num_envs, sequences=chosen, only=only, what_if=what_if,
            progress=lambda run, done, total: bar.update(task, description=run, completed=done, total=total or None),
        )  # fmt: skip
    count = f"{len(found.rows[0].episodes)} episodes of {len(chosen)} demonstrations, seed {seed}"
    title = f"{subject.label} on {subject.robot.name}: what costs the skill between {backend} and {towards}\n{count}"
    content = found.as_dict() | {
        "policy": subject.label,
        "robot": subject.robot.name,
        "seed": seed,
        "demonstrations": len(chosen),
        "versions": {a.name: a.version, b.name: b.version},
        "objects_folder": str(folder) if folder else None,
        "inputs": subject.inputs | {"demos": file_hash(demos)},
    }
    write_json(out / "attribution.json", content)
    write_plot(out / "attribution.png", found, title)
    console.print(rich_table(found, title))
    for line in not_tried(found):
        console.print(line, style="dim", highlight=False)
    console.print(verdict(found), highlight=False)
    console.print(f"results in {out}")


COMMAND = attribute
