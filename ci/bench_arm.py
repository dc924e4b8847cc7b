"""arm: time of the arm's inverse kinematics, and the share of wrist poses within reach that it solves along the path."""

from __future__ import annotations

from argparse import _ArgumentGroup
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from benchlib import Options, seconds_of
from rich.console import Console

from xreset import robots
from xreset.demos.archive import demo_objects, read_demos
from xreset.demos.verbs import synthesize
from xreset.retarget.arm.config import ArmSearch
from xreset.retarget.arm.model import ArmModel, ArmTargets
from xreset.retarget.arm.solve import track
from xreset.retarget.pipeline import wrist_paths
from xreset.retarget.validity import Measures, Thresholds

SOLVED = Thresholds(
    hand_error=np.inf, wrist_position=0.005, wrist_orientation=float(np.radians(5.0))
)
_SAMPLE = 1000


def add_arguments(group: _ArgumentGroup) -> None:
    group.add_argument(
        "--arm-demos", type=Path, help="demonstrations (default: one synthetic one per object)"
    )
    group.add_argument("--arm-objects", type=Path, help="folder of their meshes")


def run(options: Options, console: Console) -> None:
    robot = robots.load(options.robot)
    given = options.extra["arm_demos"]
    folder = options.extra["arm_objects"]
    demos = read_demos(given) if isinstance(given, Path) else synthesize(per_object=1, seed=0)
    objects = list(demo_objects(demos, folder if isinstance(folder, Path) else None).values())
    paths: list[ArmTargets] = []
    hand = seconds_of(lambda: paths.extend(wrist_paths(demos, robot, objects)))
    model = ArmModel(robot)
    measures: list[Measures] = []
    arm = seconds_of(lambda: measures.extend(track(model, path, SOLVED)[1] for path in paths))
    console.print(
        f"{options.robot}: {demos.num_sequences} sequences, {demos.num_frames} frames: hand {hand:.1f} s, arm {arm:.1f} s"
    )

    above = [path.annotated & (path.root_pos[..., 2] > 0) for path in paths]

    def of_frames(depth: float) -> torch.Tensor:
        rows = [_follows(found, depth)[mask] for found, mask in zip(measures, above, strict=True)]
        return torch.cat(rows)

    solved = of_frames(1e9)
    free = of_frames(SOLVED.table_depth)
    chosen = torch.as_tensor(np.random.default_rng(0).permutation(len(free))[:_SAMPLE])
    alone = ArmTargets.cat([path[mask] for path, mask in zip(paths, above, strict=True)])
    alone = alone[chosen].map(lambda x: x[:, None])
    config = replace(ArmSearch(), restarts=16, reseeds=0, collision_weight=0.0)
    within = _follows(
        track(model, alone, replace(SOLVED, table_depth=1e9, self_depth=1e9), config)[1], 1e9
    )[:, 0]
    console.print(f"wrist above the table in {len(free)} annotated frames")
    console.print(
        f"followed to 5 mm and 5 degrees: {_share(solved)}; and free of table and self: {_share(free)}"
    )
    console.print(f"within reach by 16 restarts on each of {len(chosen)} frames: {_share(within)}")
    console.print(f"of these followed and free: {_share(free[chosen][within])}")


def _follows(found: Measures, depth: float) -> torch.Tensor:
    """[S, T] whether the wrist is where it should be, no deeper than ``depth`` [m] in table or self."""
    near = (found.wrist_position <= SOLVED.wrist_position) & (
        found.wrist_orientation <= SOLVED.wrist_orientation
    )
    return near & (found.table_clearance >= -depth) & (found.self_clearance >= -depth)


def _share(flags: torch.Tensor) -> str:
    return f"{float(flags.double().mean()):.1%}"
