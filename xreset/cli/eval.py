"""``xreset eval``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def evaluate(
    policy: Annotated[str, tyro.conf.Positional],
    *,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),  # a default would be appended to
    demos: Path,
    episodes: int = 5,
    seed: int = 0,
    robot: str | None = None,
    objects: Path | None = None,
    num_envs: int = 64,
    device: str = "cpu",
    out: Path | None = None,
) -> None:
    """Evaluate a policy, or a baseline, in one or several engines.

    Args:
        policy: Run folder, exported policy (.onnx), name of a policy that ships with xreset (xreset policies list), or a baseline: zero,
            random, ik (open-loop kinematic retargeting).
        backend: Physics engine; give it again for more engines. Default: mujoco.
        demos: Demonstrations (xreset demos) or retargeted trajectories (xreset retarget): starts and goals, and the path of ik.
        episodes: Episodes per demonstration, each with another perturbation of robot and object.
        seed: Seed of the perturbations; they are the same in every engine.
        robot: Name or folder of the robot; default: the policy's.
        objects: Folder of real meshes; default: what the policy was trained with, else the stand-ins.
        num_envs: Worlds at a time.
        device: Where GPU engines run: cpu or cuda.
        out: Folder for the results; default: eval/ in the run folder or beside the policy; runs/NAME/eval for a policy that ships with
            xreset, runs/BASELINE-ROBOT/eval for a baseline.
    """
    from xreset.cli._bars import engine_bars
    from xreset.cli._terminal import Console
    from xreset.eval.evaluate import evaluate, resolve
    from xreset.eval.table import rich_table

    backends = list(dict.fromkeys(backend)) or ["mujoco"]
    console = Console()
    subject = resolve(policy, robot, seed)
    folder = out or subject.folder
    with engine_bars(console, backends) as progress:
        summaries = evaluate(
            subject,
            backends,
            demos,
            episodes=episodes,
            seed=seed,
            num_envs=num_envs,
            device=device,
            objects_folder=objects,
            out=folder,
            progress=progress,
        )
    console.print(rich_table(summaries))
    console.print(f"results in {folder}")


COMMAND = evaluate
