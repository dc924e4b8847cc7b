"""``xreset distill``."""

from __future__ import annotations

import math
from pathlib import Path

from xreset.cameras.config import STUDENT_VISION, VisionConfig
from xreset.cli._common import Meshes, Policy, Several, given_flags, refuse_changes
from xreset.errors import RunError


def distill(
    teacher: Policy = "",
    *,
    out: Path,
    resets: Path | None = None,
    robot: str | None = None,
    meshes: Meshes = None,
    camera: Several = (),
    vision: VisionConfig = STUDENT_VISION,
    engine: str = "mujoco-warp",
    device: str | None = None,
    num_envs: int = 1024,
    iterations: int | None = None,
    minutes: float = math.inf,
    seed: int = 0,
    resume: bool = False,
) -> None:
    """Train a policy that sees, by imitating one that is told the object's pose and shape.

    Args:
        out: Run folder to make, or to continue.
        resets: Reset bank, made by `xreset resets`.
        robot: Name or folder of the robot; default: that of the bank.
        camera: front, side, or wrist; give it again for two cameras. Default: front.
        vision: Images, their timing, and what the policy gets from them.
        engine: Physics engine to train on.
        device: cpu or cuda; default: cuda where there is a GPU and the engine can use it.
        num_envs: Worlds to simulate (per GPU).
        iterations: Total number of iterations; default: 2000.
        minutes: Longest time to train now. Then the run stops as with Ctrl-C, and --resume continues it.
        seed: Seed of every random number.
        resume: Continue the run in --out from its newest checkpoint.
    """
    from xreset.learning import train as training

    if resume:
        if any(flag.startswith(("--camera", "--vision")) for flag in given_flags()):
            raise RunError(
                "--resume continues with the run's own cameras. Omit --camera and --vision."
            )
        refuse_changes(
            out,
            teacher=teacher,
            robot=robot,
            resets=resets,
            meshes=meshes,
            engine=engine,
            device=device,
            num_envs=num_envs,
            seed=seed,
        )
        training.resume(out, iterations=iterations, minutes=minutes)
        return
    if not teacher or resets is None:
        raise RunError(
            "A new run needs a teacher and --resets. To continue the run in --out, add --resume."
        )
    training.distill(
        teacher,
        resets,
        out=out,
        cameras=camera or ("front",),
        vision=vision,
        robot=robot,
        meshes=meshes,
        engine=engine,
        device=device,
        num_envs=num_envs,
        iterations=iterations,
        minutes=minutes,
        seed=seed,
    )


COMMAND = distill
