"""``xreset engines list``."""

from __future__ import annotations

from rich.table import Table

from xreset.cli._terminal import console
from xreset.plugins import backend_names, backend_status


def engines() -> None:
    """List physics engines: name, version, device, and why one cannot be used here."""
    table = Table("backend", "engine version", "device", "available")
    for name in backend_names():
        status = backend_status(name)
        table.add_row(
            name, status.version or "-", status.device, "yes" if status.reason is None else f"no: {status.reason}"
        )
    console.print(table)


COMMAND = engines
