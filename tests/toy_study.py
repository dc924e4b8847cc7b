"""Steps of a study that take no time: a shell command that writes a file."""

from __future__ import annotations

from pathlib import Path

from xreset.eval.study.steps import Step, Todo


def shell_step(name: str, writes: Path, command: str, *needs: str, gpu: bool = False) -> Step:
    """Return a step that is done when its folder holds ``done``."""

    def todo() -> Todo:
        if (writes / "done").exists():
            return "", []
        return "to do", [["sh", "-c", f"mkdir -p {writes} && cd {writes} && {command}"]]

    return Step(name=name, kind="data", folder=writes, todo=todo, needs=needs, gpu=gpu)
