"""Which physics engines there are, and which of them can be used here."""

from __future__ import annotations

import traceback
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

from xreset.errors import BackendUnavailableError, XResetError

if TYPE_CHECKING:
    from xreset.backends.base import Backend
    from xreset.spec import SceneSpec

GROUP = "xreset.backends"
"""Entry-point group: ``name = "package.module:BackendClass"``."""


@dataclass(frozen=True)
class BackendStatus:
    """Whether a backend can be used here."""

    name: str
    version: str | None
    """Engine version; None if unavailable."""
    device: str
    """``cpu``, ``cuda`` or ``cuda, cpu``."""
    reason: str | None
    """Why it is unavailable, and the command that mends it; None if available."""


def _entries() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def backend_names() -> list[str]:
    """Names of all registered backends, in order of registration."""
    return list(_entries())


def backend_class(name: str) -> type[Backend]:
    """The class of a backend.

    Raises:
        BackendUnavailableError: no backend of that name, or its plugin does not load.
    """
    entries = _entries()
    if name not in entries:
        known = ", ".join(sorted(entries)) or "none (is xreset installed? run: pip install -e .)"
        raise BackendUnavailableError(f"there is no backend {name!r}; there are {known}.")
    what = f"the backend {name!r} ({entries[name].value})"
    try:
        cls = entries[name].load()
    except XResetError:
        raise
    except Exception as error:
        trace = traceback.format_exc(limit=-2)
        raise BackendUnavailableError(f"{what} does not load: {error}\n{trace}") from error
    from xreset.backends.base import Backend

    if not (isinstance(cls, type) and issubclass(cls, Backend)):
        raise BackendUnavailableError(f"{what} is {cls!r}, expected a class that inherits from xreset.backends.base.Backend.")
    return cls


def device_for(name: str, device: str) -> str:
    """Where a backend runs, if those that can run on ``device`` are to run there: on it, or else on the CPU.

    Raises:
        BackendUnavailableError: no backend of that name, or nothing that could be a device.
    """
    kind = device.partition(":")[0]
    if kind not in ("cpu", "cuda"):
        raise BackendUnavailableError(f"there is no device {device!r}; expected cpu, cuda or one of several GPUs, such as cuda:1.")
    return device if kind in backend_class(name).devices() else "cpu"


def make_backend(name: str, scene: SceneSpec, num_worlds: int, **options: Any) -> Backend:
    """Build a backend by name; see :class:`xreset.backends.base.Backend` for the options."""
    cls = backend_class(name)
    cls.engine_version()  # fails with reason and remedy where the engine is missing
    return cls(scene, num_worlds, **options)


def backend_status(name: str) -> BackendStatus:
    """Whether the backend can be used here, without raising."""
    try:
        cls = backend_class(name)
        version = cls.engine_version()
    except BackendUnavailableError as error:
        return BackendStatus(name, None, "-", str(error))
    except Exception as error:  # a plugin's defect must not hide the other engines
        return BackendStatus(name, None, "-", f"its engine_version() fails: {type(error).__name__}: {error}")
    return BackendStatus(name, version, ", ".join(cls.devices()), None)
