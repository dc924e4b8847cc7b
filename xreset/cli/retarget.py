"""``xreset retarget``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def retarget(
    demos: Annotated[Path, tyro.conf.Positional],
    *,
    robot: str,
    out: Path,
    objects: Path | None = None,
    max_per_object: int | None = None,
    restart: bool = False,
    picture: Path | None = None,
) -> None:
    """Turn human demonstrations into robot trajectories.

    What is finished is kept in the folder OUT.partial until all is: after a stop, the same command goes on from there.

    Args:
        demos: Archive of demonstrations (see `xreset demos`).
        robot: Name of a robot, or the folder of its description.
        out: File to write.
        objects: Folder of real meshes; default: the built-in stand-ins.
        max_per_object: Only the first so many sequences of each object.
        restart: Begin anew, whatever an earlier run has finished.
        picture: PNG to write: one grasp per object, the human keypoints over it.
    """
    from dataclasses import asdict

    import numpy as np
    from rich.console import Console
    from rich.progress import Progress
    from rich.table import Table

    from xreset import robots
    from xreset.demos import demo_objects, read_demos
    from xreset.files import file_hash
    from xreset.retarget import pipeline
    from xreset.retarget.partial import discard

    console = Console()
    spec = robots.load(robot)
    chosen = read_demos(demos)
    if max_per_object is not None:
        chosen = chosen.select(max_per_object=max_per_object)
    specs = demo_objects(chosen, objects)
    config = pipeline.RetargetConfig()
    partial = out.with_name(f"{out.name}.partial")
    if restart:
        discard(partial)
    try:
        with Progress(console=console, transient=True) as bar:
            task = bar.add_task("sequences", total=chosen.num_sequences)
            result = pipeline.retarget(
                chosen, spec, list(specs.values()), config,
                progress=lambda done, total: bar.update(task, completed=done, total=total), partial=partial,
            )  # fmt: skip
    except KeyboardInterrupt:
        if partial.is_dir():
            console.print(f"What is finished is kept in {partial}; give the same command again to continue, with --restart to begin anew.")
        raise
    pipeline.write_retargeted(
        out,
        result,
        config={"retarget": asdict(config), "robot": robot, "max_per_object": max_per_object},
        inputs={"demos": file_hash(demos), "robot": spec.fingerprint} | {f"object {s.name}": s.source for s in specs.values()},
    )
    discard(partial)

    if picture is not None:
        from xreset.render import write_png
        from xreset.retarget.picture import grasp_sheet

        write_png(picture, grasp_sheet(result, pipeline.rest_on_table(chosen, list(specs.values())), spec, list(specs.values())))

    table = Table(
        "object", "sequences", "frames", "annotated", "valid", "fingertips [mm]", "invalid because of", title=f"retargeted to {spec.name}"
    )
    owner = np.repeat(np.arange(len(result.object_name)), np.diff(result.frame_offsets))
    names = result.object_name[owner]
    for name in [*sorted(specs), "all"]:
        mine = (names == name) | (name == "all")
        annotated, valid = result.annotated & mine, result.valid & mine
        counts = np.bincount(result.reason[annotated], minlength=len(result.reason_names))
        table.add_row(
            name,
            str(len(set(owner[mine]))),
            str(int(mine.sum())),
            str(int(annotated.sum())),
            f"{int(valid.sum())} ({valid.sum() / max(annotated.sum(), 1):.0%})",
            f"{1e3 * result.hand_error[annotated].mean():.1f}" if annotated.any() else "-",
            ", ".join(f"{reason} {n}" for reason, n in zip(result.reason_names[1:], counts[1:], strict=True) if n),
            end_section=name == sorted(specs)[-1],
        )
    console.print(table)
    console.print(f"{int(result.valid.sum())} valid frames of {len(result.valid)} in {out}")


COMMAND = retarget
