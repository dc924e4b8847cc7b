"""``xreset export``: episodes, deploy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xreset import runtime
from xreset.cli._terminal import console
from xreset.cli._verbs import verb
from xreset.eval import verbs
from xreset.files.text import quantity

if TYPE_CHECKING:
    from xreset.eval.export.recorded import RecordedEpisodes


def _show_episodes(recording: RecordedEpisodes, options: Mapping[str, Any]) -> None:
    engines = ", ".join(recording.episodes["engine"].unique())
    console.print(
        f"{options['out']}: {quantity(len(recording.episodes), 'episode')} of {recording.robot.name} in {engines}, "
        f"{quantity(recording.offsets[-1], 'frame')} at {recording.fps:g} per second"
    )


def _show_deployed(out: Path, options: Mapping[str, Any]) -> None:
    contract = runtime.load_controller(out).contract
    named = []
    for name, entry in contract["objects"].items():
        named.append(f"{name} ({'stand-in' if entry['source'] == 'stand-in' else 'mesh'})")
    rate = 1.0 / contract["control_dt"]
    console.print(
        f"{out}: {options['policy']} for {contract['robot']}, {len(contract['joints'])} joints at {rate:g} Hz"
    )
    console.print(f"objects: {', '.join(named)}")
    console.print(f"Try it: cd {out} && python -m runtime")


COMMAND = {
    "episodes": verb(verbs.export_episodes, _show_episodes),
    "deploy": verb(verbs.export_deploy, _show_deployed),
}
