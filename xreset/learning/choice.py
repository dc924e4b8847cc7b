"""The checkpoint that ``xreset select`` chose as a run's policy: ``RUN/choice.json``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from xreset.checks import Checked, NotNegative, Positive, Rule, Share, from_dict
from xreset.files import read_json, write_json

FILE = "choice.json"
SCHEMA = "xreset-choice/1"


@dataclass(frozen=True, kw_only=True)
class Candidate(Checked):
    """One checkpoint."""

    name: str
    """File name of the checkpoint or policy."""
    task_progress: Annotated[dict[str, Share[float]], Rule("an engine at least", bool)]
    """Engine -> mean over the episodes; without engines in which it was not played because it could no longer be
    chosen."""

    @property
    def worst(self) -> float:
        """Task progress in the worst engine."""
        return min(self.task_progress.values())


@dataclass(frozen=True, kw_only=True)
class Choice(Checked):
    """The candidates that were played, and the one that is best in its worst engine."""

    chosen: str
    """Name of the candidate."""
    policy_hash: str
    """SHA-256 of the chosen candidate as an ONNX file."""
    candidates: tuple[Candidate, ...]
    """The newest first."""
    engines: dict[str, str]
    """Name -> version."""
    seed: NotNegative[int]
    """Seed of the starts that were played; results with another seed are of other starts."""
    episodes_per_demo: Positive[int]
    demos: str
    """SHA-256 of the demonstrations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chosen not in [c.name for c in self.candidates]:
            raise ValueError(f"chosen is {self.chosen!r}, expected one of the candidates")

    @property
    def candidate(self) -> Candidate:
        """The chosen candidate."""
        return next(c for c in self.candidates if c.name == self.chosen)

    def sentence(self) -> str:
        """Return what was chosen and why, in one line."""
        newest = self.candidates[0]
        own = self.candidate
        engine = min(own.task_progress, key=own.task_progress.__getitem__)
        against = f"the newest, {newest.name}, has {100 * newest.worst:.1f} %"
        if newest is own:
            against = "it is the newest"
        return (
            f"{self.chosen}, {100 * own.worst:.1f} % in its worst engine ({engine}), of {len(self.candidates)} "
            f"checkpoints in {len(self.engines)} engines; {against}."
        )


def write_choice(folder: Path, choice: Choice) -> None:
    """Write ``choice.json``."""
    write_json(folder / FILE, {"schema": SCHEMA} | asdict(choice))


def read_choice(folder: Path) -> Choice | None:
    """Return the choice that was made in a folder, or None.

    Raises:
        FileFormatError: the file is damaged, or of another version.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    return from_dict(Choice, read_json(path, SCHEMA), str(path))
