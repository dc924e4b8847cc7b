"""Trained policies that ship with xreset: ``NAME.onnx`` in this folder, and the card ``NAME.toml``.

The command line knows such a policy as NAME.
"""

from __future__ import annotations

from pathlib import Path

from xreset.files.checks import from_dict, frozen
from xreset.files.storage import read_toml

FOLDER = Path(__file__).parent
"""Folder of the policies and their cards."""
SCHEMA = "xreset-policy-card/1"


@frozen
class Card:
    """Description of a policy, with measured results."""

    schema: str
    about: str
    data: str
    """Data of the training."""
    recipe: str
    """Recipe of the training, and how long it took."""
    licence: str
    results: dict[str, dict[str, str]]
    """Episodes -> engine -> task progress with its interval."""


def shipped() -> dict[str, Path]:
    """Name -> file of every policy that ships with this installation, in order of name."""
    return {file.stem: file for file in sorted(FOLDER.glob("*.onnx"))}


def card(file: Path) -> Card:
    """The card of a policy's file; ``FileFormatError`` if it is missing or damaged."""
    path = file.with_suffix(".toml")
    return from_dict(
        Card, read_toml(path, SCHEMA, hint=f" It is the card of {file.name}."), str(path)
    )


def run_folder(run: str | Path) -> Path:
    """Return the folder of a run; or that of a shipped policy's results, if no file or folder has its name."""
    if not Path(run).exists() and str(run) in shipped():
        return results_folder(str(run))
    return Path(run)


def results_folder(name: str) -> Path:
    """Where the results of a shipped policy go by default, as a run's lie in its run folder."""
    return Path("runs") / name
