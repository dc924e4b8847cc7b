"""Steps of a study that take no time: a shell command that writes a file."""

from __future__ import annotations

from pathlib import Path

from xreset.eval.study.plan import Step


def shell_step(name: str, writes: Path, command: str, *needs: str, gpu: bool = False) -> Step:
    """Return a step that is done when its folder holds ``done``."""
    return Step(
        name=name,
        kind="data",
        writes=writes,
        left=lambda: "" if (writes / "done").exists() else "to do",
        commands=lambda: [["sh", "-c", f"mkdir -p {writes} && cd {writes} && {command}"]],
        needs=needs,
        gpu=gpu,
    )
