"""Trained policies that ship with xreset: ``NAME.onnx`` in this folder, the card ``NAME.toml``, and the deployed graph
without its weights, ``NAME.graph``.

The command line knows such a policy as NAME.
"""

from __future__ import annotations

import json
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


def shipped_graphs() -> dict[str, Path]:
    """Name -> file with the deployed graph (``docs/live.md``) of every such policy without cameras.

    ``ci/ship_policies.py`` writes these files. The weights are cut out of a graph, because the policy's own file has
    them. A line of JSON lists the cuts: where in the rest a piece was, and its offset and length in the policy's file.
    The rest follows."""
    return {file.stem: file for file in sorted(FOLDER.glob("*.graph"))}


def graph_of(network: bytes) -> bytes | None:
    """Return the deployed graph of an exported policy's content; None if it does not ship with xreset."""
    for name, file in shipped_graphs().items():
        if (FOLDER / f"{name}.onnx").read_bytes() == network:
            cuts, _, rest = file.read_bytes().partition(b"\n")
            pieces = []
            end = 0
            for at, offset, length in json.loads(cuts):
                pieces += [rest[end:at], network[offset : offset + length]]
                end = at
            return b"".join([*pieces, rest[end:]])
    return None


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
