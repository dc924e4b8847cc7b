"""Which checkpoint of a run is its policy, where not the newest one: ``RUN/choice.json``, made by ``xreset select``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

from xreset import __version__
from xreset.checks import Checked, NotNegative, Positive, from_dict
from xreset.files import read_json, write_json

FILE = "choice.json"
SCHEMA = "xreset-choice/1"


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One checkpoint."""

    name: str
    """File name of the checkpoint or policy."""
    task_progress: dict[str, float]
    """Engine -> mean over the episodes; without the engines in which it was not played, because it could not be chosen any more."""

    def __post_init__(self) -> None:
        values = self.task_progress.values()
        if not values or not all(0 <= value <= 1 for value in values):
            raise ValueError(
                f"task_progress is {self.task_progress}, expected an engine at least, and numbers from 0 to 1"
            )

    @property
    def worst(self) -> float:
        """The least of what was played."""
        return min(self.task_progress.values())


@dataclass(frozen=True, kw_only=True)
class Choice(Checked):
    """What was tried, and what was taken: the best in its worst engine."""

    chosen: str
    """Name of the candidate."""
    policy_hash: str
    """SHA-256 of the chosen one as an ONNX file."""
    candidates: tuple[Candidate, ...]
    """The newest first."""
    engines: dict[str, str]
    """Name -> version."""
    seed: NotNegative[int]
    """Of the starts that were played; results with another seed are of other starts."""
    episodes_per_demo: Positive[int]
    demos: str
    """SHA-256 of the demonstrations."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.chosen not in [c.name for c in self.candidates]:
            raise ValueError(f"chosen is {self.chosen!r}, expected one of the candidates")

    @property
    def candidate(self) -> Candidate:
        """The chosen one."""
        return next(c for c in self.candidates if c.name == self.chosen)

    def sentence(self) -> str:
        """What was chosen and by what, in one line."""
        last, own = self.candidates[0], self.candidate
        worst = (
            f"{100 * own.worst:.1f} % in its worst engine ({min(own.task_progress, key=own.task_progress.__getitem__)})"
        )
        against = "it is the newest" if last is own else f"the newest, {last.name}, has {100 * last.worst:.1f} %"
        return (
            f"{self.chosen}, {worst}, of {len(self.candidates)} checkpoints in {len(self.engines)} engines; {against}."
        )


def write_choice(folder: Path, choice: Choice) -> None:
    """Write ``choice.json``."""
    write_json(folder / FILE, {"schema": SCHEMA, "xreset": __version__} | asdict(choice))


def read_choice(folder: Path) -> Choice | None:
    """The choice that was made in a folder; None: there was none.

    Raises:
        FileFormatError: the file is damaged, or of another version.
    """
    path = folder / FILE
    if not path.is_file():
        return None
    data = read_json(path, SCHEMA)
    data.pop("xreset", None)
    return from_dict(Choice, data, str(path))
