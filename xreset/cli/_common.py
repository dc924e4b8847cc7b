"""Types of arguments, and functions, that several commands share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from xreset.cli._terminal import console, show_table
from xreset.files import checks
from xreset.physics.plugins import Device as DeviceName
from xreset.physics.plugins import backend_names, backend_status
from xreset.retarget.accounts import Account, described

if TYPE_CHECKING:
    from xreset.eval import rollout

Source = Annotated[Path, Positional]
"""A file or folder, given without a flag."""
Several = Annotated[tuple[str, ...], UseAppendAction]
"""A flag that may be given again. Its default must be empty, because values are appended to it."""


# Options that several commands share, with their help -----------------------------------------------------------------

Robot = Annotated[
    str | None, arg(help="Name or folder of the robot; default: the policy's, or the file's.")
]
Meshes = Annotated[Path | None, arg(help="Folder of real meshes; default: the built-in stand-ins.")]
AllEngines = Annotated[
    Several,
    arg(help="Physics engine; give it again for more. Default: all that can be used here."),
]
Device = Annotated[
    DeviceName,
    arg(help="Where engines run that can use a GPU: cpu or cuda; the others run on the CPU."),
]
Host = Annotated[str, arg(help="Address to serve at; 0.0.0.0 allows other machines.")]
Port = Annotated[checks.Port, arg(help="Port to serve at; if it is taken, the next free one.")]


def usable_engines() -> list[str]:
    """Return the names of the engines that can be used here, and print why the others cannot."""
    statuses = [backend_status(name) for name in backend_names()]
    for status in statuses:
        if status.reason is not None:
            console.print(f"without {status.name}: {status.reason}")
    return [status.name for status in statuses if status.reason is None]


def in_all_engines(arguments: dict[str, Any]) -> None:
    """Let a command without engines use all that can be used here."""
    arguments["engines"] = arguments.get("engines") or usable_engines()


def in_quick_engines(arguments: dict[str, Any]) -> None:
    """Let a command without engines use all that can be used here and are not slow on the device."""
    arguments["engines"] = quick_engines(arguments.get("engines", ()), arguments["device"])


def quick_engines(names: Sequence[str], device: str) -> list[rollout.Engine]:
    """Return the engines of these names; without names, all that can be used here and are not slow on the device."""
    from xreset.eval import rollout

    engines = rollout.chosen_engines(names or usable_engines(), device)
    return [each for each in engines if names or not each.slow]


def show_accounts(rows: Sequence[Account], title: str) -> None:
    """Print how many frames or states of each object and phase are kept, and why the others are rejected."""
    table = [("object", "phase", "in all", "kept", "others")]
    for row in rows:
        kept = f"{row.kept} ({row.kept / row.total:.0%})" if row.total else "0"
        table.append((row.object_name, row.phase, str(row.total), kept, described(row.lost)))
    show_table(table, title=title)
