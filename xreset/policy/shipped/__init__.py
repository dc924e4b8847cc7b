"""Trained policies that ship with xreset: ``NAME.onnx`` in this folder, the card ``NAME.toml``, and the deployed graph
without its weights, ``NAME.graph``. With a checkpoint, ``NAME.pt``, a policy can learn on: it holds actor and critic,
without the weights that the policy's file has.

The command line knows such a policy as NAME. The name of a robot means the policy of the same name, or the one whose
card states the robot as ``default_of``.
"""

from __future__ import annotations

import json
from pathlib import Path

from xreset.files.checks import from_dict, frozen
from xreset.files.storage import read_toml
from xreset.physics.plugins import robot_names

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
    default_of: str | None = None
    """Robot whose name means this policy; not needed where the policy is named after the robot."""


def shipped() -> dict[str, Path]:
    """Name -> file of every policy that ships with this installation, in order of name."""
    return {file.stem: file for file in sorted(FOLDER.glob("*.onnx"))}


def shipped_name(name: str) -> str | None:
    """Return the name of the shipped policy that a name means: its own, or that of a robot; None: there is none."""
    files = shipped()
    if name in files:
        return name
    for other, file in files.items():
        if file.with_suffix(".toml").exists() and card(file).default_of == name:
            return other
    return None


def default_policies() -> dict[str, str]:
    """Robot -> name of the shipped policy that the robot's name means."""
    found = {}
    for robot in robot_names():
        name = shipped_name(robot)
        if name is not None:
            found[robot] = name
    return found


def no_policy_for(robot: str) -> str:
    """Return what to tell a user who wants the policy of a robot that has none."""
    others = ", ".join(default_policies()) or "no robot"
    return (
        f"No policy ships for the robot {robot!r}, only for {others}: train one with "
        f"xreset run DEMOS --robot {robot} --out RUN, and give its folder RUN."
    )


def shipped_graphs() -> dict[str, Path]:
    """Name -> file with the deployed graph (``docs/live.md``) of every such policy without cameras."""
    return {file.stem: file for file in sorted(FOLDER.glob("*.graph"))}


def shipped_checkpoints() -> dict[str, Path]:
    """Name -> checkpoint of every such policy that can learn on, without its optimizer."""
    return {file.stem: file for file in sorted(FOLDER.glob("*.pt"))}


def graph_of(network: bytes) -> bytes | None:
    """Return the deployed graph of an exported policy's content; None if it does not ship with xreset."""
    for file in shipped_graphs().values():
        if file.with_suffix(".onnx").read_bytes() == network:
            return whole(file)
    return None


def whole(file: Path) -> bytes:
    """Return the content of a file, together with the weights that it leaves to its policy's file.

    ``ci/ship_policies.py`` writes such files next to ``NAME.onnx``. They begin with a list in a line of JSON, which has
    an entry for each piece that was cut out: its place in the rest, and its offset and length in the policy's file. The
    rest follows. Other files are returned as they are.
    """
    content = file.read_bytes()
    if not content.startswith(b"["):
        return content
    network = file.with_suffix(".onnx").read_bytes()
    cuts, _, rest = content.partition(b"\n")
    pieces = []
    end = 0
    for at, offset, length in json.loads(cuts):
        pieces += [rest[end:at], network[offset : offset + length]]
        end = at
    return b"".join([*pieces, rest[end:]])


def card(file: Path) -> Card:
    """The card of a policy's file; ``FileFormatError`` if it is missing or damaged."""
    path = file.with_suffix(".toml")
    return from_dict(
        Card, read_toml(path, SCHEMA, hint=f" It is the card of {file.name}."), str(path)
    )


def run_folder(run: str | Path) -> Path:
    """Return the folder of a run; or that of a shipped policy's results, if no file or folder has its name."""
    name = None if Path(run).exists() else shipped_name(str(run))
    return Path(run) if name is None else results_folder(name)


def results_folder(name: str) -> Path:
    """Where the results of a shipped policy go by default, as a run's lie in its run folder."""
    return Path("runs") / name
