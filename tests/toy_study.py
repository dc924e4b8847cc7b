"""Steps of a study that take no time: a shell command that writes a file."""

from __future__ import annotations

from dataclasses import dataclass

from xreset.eval.study.plan import Step


@dataclass(frozen=True, kw_only=True)
class ShellStep(Step):
    """Done when its folder holds ``done``."""

    command: str

    def done(self) -> bool:
        return (self.writes / "done").exists()

    def commands(self) -> list[list[str]]:
        return [["sh", "-c", f"mkdir -p {self.writes} && cd {self.writes} && {self.command}"]]
