"""``xreset retarget``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from xreset.accounts import accounts_path, described, write_accounts
from xreset.cli._common import Objects, Source
from xreset.cli._terminal import Progress, console
from xreset.files import file_hash
from xreset.retarget.arm.config import ArmConfig
from xreset.retarget.hand.config import HandConfig

if TYPE_CHECKING:
    from xreset.retarget import file


def retarget(
    demos: Source,
    *,
    robot: str,
    out: Path,
    objects: Objects = None,
    max_per_object: int | None = None,
    device: str = "cpu",
    hand: HandConfig = HandConfig(),
    arm: ArmConfig = ArmConfig(),
) -> None:
    """Turn human demonstrations into robot motion.

    Args:
        demos: Archive of demonstrations (`xreset demos`).
        robot: Name of a robot, or the folder of its description.
        out: File to write.
        max_per_object: Use only the first sequences of each object, at most this many.
        device: Where hand retargeting runs: cpu or cuda. The arm runs on the CPU.
        hand: Weights of hand retargeting.
        arm: Weights and effort of the arm's inverse kinematics.
    """
    from xreset import description
    from xreset.demos import align, archive, plausible
    from xreset.retarget import file, pipeline

    spec = description.load_robot(robot)
    chosen = archive.read_demos(demos)
    if max_per_object is not None:
        chosen = chosen.select(max_per_object=max_per_object)
    for doubt in plausible.doubts(chosen):
        console.print(f"note: {doubt}", style="yellow")
    specs = archive.demo_objects(chosen, objects)
    config = pipeline.RetargetConfig(hand=hand, arm=arm)
    with Progress() as bar:
        count = bar.count("sequences")
        result = pipeline.retarget_demos(chosen, spec, list(specs.values()), config, progress=count, device=device)
    file.write_retargeted(
        out,
        result,
        config={"retarget": asdict(config), "robot": robot, "max_per_object": max_per_object},
        inputs={"demos": file_hash(demos), "robot": spec.fingerprint}
        | {f"object {s.name}": s.source for s in specs.values()},
    )
    write_accounts(accounts_path(out), of="frames", rows=result.accounts())
    console.print(_table(result))
    for index in np.flatnonzero(align.on_something(archive.levelled(chosen), specs)):
        console.print(
            f"{chosen.sequence_name[index]}: the object starts on top of something that is not in the scene; "
            "it was not lowered to the table."
        )
    console.print(
        f"{int(result.valid.sum())} valid frames of {len(result.valid)} in {out}; counts in {accounts_path(out)}"
    )


def _table(result: file.Retargeted) -> Table:
    """Return a table of kept and lost frames, by object and phase."""
    table = Table(
        "object",
        "phase",
        "frames",
        "annotated",
        "valid",
        "fingertips [mm]",
        "invalid because of",
        title=f"retargeted to {result.robot}",
    )
    names = result.object_name[result.sequence_of_frame]
    for row in result.accounts():
        mine = result.annotated & ((names == row.object_name) | (row.object_name == "all"))
        if row.phase != "both":
            mine &= result.post_contact == (row.phase == "post-contact")
        annotated = row.without("not annotated")
        table.add_row(
            row.object_name,
            row.phase,
            str(row.total),
            str(annotated.total),
            f"{row.kept} ({annotated.share:.0%})" if annotated.total else "0",
            f"{1e3 * result.hand_error[mine].mean():.1f}" if mine.any() else "-",
            described(annotated.lost),
        )
    return table


COMMAND = retarget
