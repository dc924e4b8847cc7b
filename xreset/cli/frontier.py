"""``xreset frontier``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def frontier(
    policy: Annotated[str, tyro.conf.Positional],
    *,
    resets: Path,
    backend: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = (),  # a default would be appended to
    states: int = 400,
    seed: int = 0,
    robot: str | None = None,
    objects: Path | None = None,
    num_envs: int = 64,
    device: str = "cpu",
    out: Path | None = None,
) -> None:
    """Tell from which demonstrated states a policy reaches the goal: what it can do, and where its training is stuck.

    Args:
        policy: Run folder, exported policy (.onnx), name of a policy that ships with xreset (xreset policies list), or the baseline zero or
            random.
        resets: Reset bank (xreset resets) whose states are tried, at full gravity.
        backend: Physics engine; give it again for more engines. Default: mujoco.
        states: How many of its states are tried.
        seed: Seed of their choice.
        robot: Name or folder of the robot; default: the policy's.
        objects: Folder of real meshes; default: what the policy was trained with, else the stand-ins.
        num_envs: Worlds at a time.
        device: Where GPU engines run: cpu or cuda.
        out: Folder for the results; default: frontier/ in the run folder or beside the policy.
    """
    from rich.table import Table

    from xreset.cli._bars import engine_bars
    from xreset.cli._terminal import Console
    from xreset.errors import PolicyError
    from xreset.eval.evaluate import resolve
    from xreset.eval.frontier import STAGES, frontier

    if policy == "ik":
        raise PolicyError("ik follows a demonstration from its beginning and cannot go on from a state. Give a policy, zero or random.")
    backends = list(dict.fromkeys(backend)) or ["mujoco"]
    console = Console()
    subject = resolve(policy, robot, seed)
    folder = out or subject.folder.parent / "frontier"
    with engine_bars(console, backends) as progress:
        results = frontier(
            subject,
            backends,
            resets,
            states=states,
            seed=seed,
            num_envs=num_envs,
            device=device,
            objects_folder=objects,
            out=folder,
            progress=progress,
        )
    title = f"{subject.label} on {subject.robot.name} goes on from {len(results[0]['tried'])} demonstrated states:"
    table = Table("the episode begins with", title=f"{title}\nof them, at the goal at any time / at the end", title_justify="left")
    for result in results:
        table.add_column(result["backend"], justify="right", no_wrap=True)
    for stage in STAGES:  # (a state at the edge between two stages may count to another one in another engine)
        rows = [next((row for row in result["stages"] if row["stage"] == stage), None) for result in results]
        if any(rows):
            table.add_row(stage, *(f"{row['states']}: {row['reached']:.0%} / {row['stayed']:.0%}" if row else "-" for row in rows))
    console.print(table)
    console.print(f"results in {folder}")


COMMAND = frontier
