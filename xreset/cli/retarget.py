"""``xreset retarget``."""

from __future__ import annotations

from dataclasses import asdict
from time import monotonic
from typing import TYPE_CHECKING

import numpy as np

from xreset.cli._common import Meshes, Source, show_accounts
from xreset.cli._options import Output
from xreset.cli._terminal import Progress, console, show_notes
from xreset.files.storage import file_hash
from xreset.physics.plugins import Device
from xreset.retarget.hand.config import Jaw

if TYPE_CHECKING:
    from xreset.retarget.file import Retargeted


def retarget(
    demos: Source,
    *,
    robot: str,
    out: Output,
    meshes: Meshes = None,
    trust_recordings: bool = False,
    device: Device = "cpu",
    jaw: Jaw = "fingertips",
) -> None:
    """Turn human demonstrations into robot motion.

    Args:
        demos: Archive of demonstrations (`xreset demos`).
        robot: Name of a robot, or the folder of its description.
        out: File to write.
        trust_recordings: Use demonstrations that are certainly wrong all the same.
        device: Where hand retargeting runs: cpu or cuda. The arm runs on the CPU.
        jaw: What a parallel jaw follows: the human's fingertips, like every hand, or the published paper's analytic map
            from thumb tip to fingers.
    """
    from xreset.demos.archive import demo_objects, read_demos
    from xreset.geometry.description import load_robot
    from xreset.retarget.file import write_retargeted
    from xreset.retarget.pipeline import RetargetConfig, retarget_demos

    spec = load_robot(robot)
    chosen = read_demos(demos)
    if left := np.count_nonzero(chosen.hand_side == "left"):
        show_notes(
            [
                f"{left} of {len(chosen)} sequences are of left hands. For a right hand: xreset demos select --mirror"
            ]
        )
    specs = demo_objects(chosen, meshes)
    config = RetargetConfig(jaw=jaw)
    doubts = []

    def note(doubt: str) -> None:
        doubts.append(doubt)
        show_notes([doubt])

    begun = monotonic()
    with Progress() as bar:
        result = retarget_demos(
            chosen,
            spec,
            list(specs.values()),
            config,
            progress=bar.count("sequences"),
            device=device,
            trust=trust_recordings,
            note=note,
        )
    write_retargeted(
        out,
        result,
        config={
            "retarget": asdict(config),
            "robot": robot,
            "meshes": str(meshes) if meshes else None,
            "doubts": doubts,
        },
        inputs={"demos": file_hash(demos), "robot": spec.fingerprint}
        | {f"object {s.name}": s.source for s in specs.values()},
    )
    show_accounts(
        [row.without("not annotated") for row in result.accounts()],
        f"annotated frames retargeted to {result.robot}: those that are valid",
    )
    if result.annotated.any():
        console.print(_distances(result))
        took = 1e3 * (monotonic() - begun) / result.annotated.sum()
        console.print(f"{took:.0f} ms a frame, with all preparation")
    console.print(f"{int(result.valid.sum())} valid frames of {len(result.valid)} in {out}")


def _distances(result: Retargeted) -> str:
    """Return how near a motion comes to the human's hand and to the object."""
    text = f"fingertips are {1e3 * result.hand_error[result.annotated].mean():.1f} mm from the human's on average"
    if result.contact_error is not None and np.isfinite(result.contact_error).any():
        touching = np.isfinite(result.contact_error)
        text += f", links {1e3 * result.contact_error[touching].mean():.1f} mm from the points that they touch"
    if result.object_depth is not None and result.valid.any():
        depth = 1e3 * result.object_depth[result.valid]
        text += (
            f"; in valid frames the hand is at most {depth.max():.1f} mm deep in the object, over 2 mm in "
            f"{(depth > 2.0).mean():.1%}"
        )
    return text


COMMAND = retarget
