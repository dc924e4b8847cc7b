"""``xreset engines list``."""

from __future__ import annotations

from xreset.cli._terminal import show_table
from xreset.plugins import backend_names, backend_status


def engines() -> None:
    """List physics engines: name, version, device, and why one cannot be used here."""
    table = [("backend", "engine version", "device", "available")]
    for name in backend_names():
        status = backend_status(name)
        available = "yes" if status.reason is None else f"no: {status.reason}"
        table.append((name, status.version or "-", status.device, available))
    show_table(table)


COMMAND = engines
