"""Trained policies that ship with xreset: one exported file each, ``NAME.onnx`` in this folder, known to the command line as NAME."""

from __future__ import annotations

from pathlib import Path

FOLDER = Path(__file__).parent
"""Where they lie."""


def shipped() -> dict[str, Path]:
    """Name -> file of every policy that ships with this installation, in order of name."""
    return {file.stem: file for file in sorted(FOLDER.glob("*.onnx"))}


def results_folder(name: str) -> Path:
    """Where the results of a shipped policy go by default, as a run's lie in its run folder."""
    return Path("runs") / name
