"""Finds the physics engines and robots that are installed, and says which engines can be used here.

A package registers an engine with an entry point of the group :data:`ENGINES`, a robot with one of :data:`ROBOTS`;
xreset's own are listed in ``pyproject.toml`` in the same way. A plugin that fails to load is named with its traceback,
and does not affect the others.
"""

from __future__ import annotations

import ctypes
import os
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from inspect import Parameter, signature
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

from xreset.errors import BackendUnavailableError, RobotError, XResetError
from xreset.files.checks import Check
from xreset.files.storage import stated_path
from xreset.files.text import shown

if TYPE_CHECKING:
    from xreset.physics import Backend
    from xreset.spec import SceneSpec

ENGINES = "xreset.backends"
"""Entry-point group of engines: ``name = "package.module:BackendClass"``."""
ROBOTS = "xreset.robots"
"""Entry-point group of robots: ``name = "package.module"``, the module next to a ``robot.toml``."""
DESCRIPTION = "robot.toml"
"""Name of the description in a robot's folder."""
_KINDS = {ENGINES: ("engine", BackendUnavailableError), ROBOTS: ("robot", RobotError)}
"""What messages call a plugin of a group, and the class of its errors."""


def plugins(group: str) -> dict[str, EntryPoint]:
    """Return the entry points of a group by name, in order of registration, without loading them."""
    return dict(_registered(group, entry_points, _installed()))


@lru_cache(maxsize=8)
def _registered(
    group: str, find: Callable[..., Iterable[EntryPoint]], _: tuple[tuple[str, int], ...]
) -> dict[str, EntryPoint]:
    """Return what :func:`plugins` returns. Reading the metadata of every installed package takes 10 ms."""
    return {entry.name: entry for entry in find(group=group)}


def _installed() -> tuple[tuple[str, int], ...]:
    """Return what changes when a package is installed: the folders of packages, and when each was changed."""
    folders = [path or "." for path in sys.path if os.path.isdir(path or ".")]
    return tuple((folder, os.stat(folder).st_mtime_ns) for folder in folders)


def load_plugin(group: str, name: str) -> Any:
    """Load a plugin and return what its entry point names.

    Raises:
        BackendUnavailableError, RobotError: depending on the group: no plugin has that name, or it does not load.
    """
    noun, error_class = _KINDS[group]
    entry = _entry(group, name)
    try:
        return entry.load()
    except XResetError:
        raise
    except Exception as error:  # a plugin may fail in any way; the others must still work
        trace = traceback.format_exc(limit=-2)
        raise error_class(
            f"the {noun} {name!r} ({entry.value}) does not load: {error}\n{trace}"
        ) from error


def _entry(group: str, name: str) -> EntryPoint:
    """Return the plugin of a name, without loading it; see :func:`load_plugin` for the error."""
    noun, error_class = _KINDS[group]
    entries = plugins(group)
    if name not in entries:
        raise error_class(f"Unknown {noun} {shown(name)}. Choose from: {known_plugins(group)}.")
    return entries[name]


def known_plugins(group: str) -> str:
    """Return the names of a group for a message."""
    return ", ".join(sorted(plugins(group))) or "none (is xreset installed? run: pip install -e .)"


# Robots ---------------------------------------------------------------------------------------------------------------


def robot_names() -> list[str]:
    """Return the names of all registered robots, in order of registration, without loading them."""
    return list(plugins(ROBOTS))


def robot_folder(name_or_folder: str | Path) -> Path:
    """Return the folder of a robot, given its registered name or its path.

    Raises:
        RobotError: no robot and no folder has that name, a file has it, or the robot's package does not load.
    """
    name = str(name_or_folder)
    if name not in plugins(ROBOTS):
        folder = Path(name_or_folder)
        if os.path.isdir(folder):
            return folder.resolve()
        if os.path.isfile(folder):
            fix = f"Expected a robot's name, or the folder of its {DESCRIPTION}."
            if os.path.isfile(folder.parent / DESCRIPTION):
                fix = f"Give the robot's folder: {folder.parent}"
            raise RobotError(f"{folder} is a file. {fix}")
        known = known_plugins(ROBOTS)
        raise RobotError(
            f"Unknown robot {shown(name)}, and no folder has that name. Choose from: {known}; or give the folder of a "
            "robot of your own (--robot)."
        )
    module = load_plugin(ROBOTS, name)
    if not isinstance(module, ModuleType) or not module.__file__:
        raise RobotError(
            f"the robot {name!r}: {module!r} is not a module with a file; put an __init__.py next to its robot.toml."
        )
    return Path(module.__file__).resolve().parent


def _refuse_unknown_robot(robot: object) -> None:
    if isinstance(robot, str | Path):  # not one that is loaded
        robot_folder(robot)


RobotName = Annotated[str | Path, Check(_refuse_unknown_robot)]
"""Registered name or folder of a robot, in the annotation of an argument: a wrong one is refused before torch loads."""


def robot_of_file(file: str | Path, *stated: str) -> str:
    """Return the first name of a registered robot, or folder of another one, that a file states and that is here; see
    :func:`stated_path`. If none is, the last one is returned."""
    for robot in stated:
        found = robot if robot in robot_names() else stated_path(robot, file, DESCRIPTION)
        if found is not None:
            return found
    return stated[-1]


# Engines --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class BackendStatus:
    """Whether an engine can be used here."""

    name: str
    version: str | None
    """Engine version; None if unavailable."""
    device: str
    """``cpu``, ``cuda`` or ``cuda, cpu``."""
    reason: str | None
    """Why it is unavailable, and the command that fixes it; None if available."""


def backend_names() -> list[str]:
    """Return the names of all registered engines, in order of registration."""
    return list(plugins(ENGINES))


def _refuse_unknown_engines(engines: object) -> None:
    """Refuse the names of engines that are not registered. What is no name, such as an engine with options, passes."""
    for engine in engines if isinstance(engines, list | tuple) else (engines,):
        if isinstance(engine, str):
            _entry(ENGINES, engine)


EngineName = Annotated[str, Check(_refuse_unknown_engines)]
"""Registered name of an engine, alone or next to several, in the annotation of an argument: a wrong one is refused
before torch loads."""


def backend_class(name: str) -> type[Backend]:
    """Return the class of an engine.

    Raises:
        BackendUnavailableError: no engine of that name, or its plugin does not load or is not complete.
    """
    cls = load_plugin(ENGINES, name)
    from xreset.physics import Backend

    if not (isinstance(cls, type) and issubclass(cls, Backend)):
        raise BackendUnavailableError(
            f"the engine {name!r} is {cls!r}, expected a class that inherits from xreset.physics.Backend."
        )
    missing = set(cls.__abstractmethods__)
    for base in cls.__mro__:
        for attribute, kind in vars(base).get("__annotations__", {}).items():
            if "ClassVar" in str(kind) and not hasattr(cls, attribute):
                missing.add(attribute)
    if missing:
        raise BackendUnavailableError(
            f"the engine {name!r} is not complete. Add to {cls.__name__}: {', '.join(sorted(missing))}."
        )
    return cls


def device_for(name: str, device: str) -> str:
    """Where an engine runs, if those that can run on ``device`` are to run there: on it, or else on the CPU.

    Raises:
        BackendUnavailableError: no engine has that name, or the device is not one.
    """
    return device if _kind(device) in backend_class(name).devices() else "cpu"


def existing_device(device: str) -> str:
    """Return a device with its index.

    Raises:
        BackendUnavailableError: it is no device, or a GPU that this machine does not have.
    """
    kind = _kind(device)
    if kind == "cpu":
        return device
    import torch

    # device_count alone counts GPUs whose driver torch cannot use
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    index = int(device.partition(":")[2] or (torch.cuda.current_device() if count else 0))
    if index >= count:
        raise BackendUnavailableError(
            f"The device is {device}, but torch can use {count} GPUs. Check nvidia-smi, or use cpu."
        )
    return f"cuda:{index}"


Device = Annotated[str, Check(existing_device)]
"""Name of a device that this machine has: ``cpu``, ``cuda`` or one of several GPUs, such as ``cuda:1``."""


def _kind(device: str) -> str:
    """Return cpu or cuda."""
    if not re.fullmatch("cpu|cuda(:[0-9]{1,3})?", device):
        raise BackendUnavailableError(
            f"Unknown device {device!r}. Expected cpu, cuda or one of several GPUs, such as cuda:1."
        )
    return device.partition(":")[0]


def make_backend(name: str, scene: SceneSpec, num_worlds: int, **options: Any) -> Backend:
    """Build the worlds of an engine by its name; see :class:`xreset.physics.Backend` for the options.

    Raises:
        BackendUnavailableError: there is no such engine, or it cannot be used here.
        XResetError: the engine has no such option.
    """
    _kind(str(options.get("device", "cpu")))  # refuses an unknown device
    cls = backend_class(name)
    cls.engine_version()  # fails with reason and remedy where the engine is missing
    refuse_unknown_options(name, options, cls)
    return cls(scene, num_worlds, **options)


def refuse_unknown_options(
    engine: str, options: Iterable[str], taker: Callable[..., Any], also: Sequence[str] = ()
) -> None:
    """Refuse options that an engine does not have.

    Args:
        engine: name of the engine.
        options: names of the given options.
        taker: class whose first two arguments are no options, and whose others are. One that passes options on, as
            ``**options``, must refuse them itself.
        also: options that others take.
    """
    parameters = signature(taker).parameters
    if any(parameter.kind is Parameter.VAR_KEYWORD for parameter in parameters.values()):
        return
    known = [*also, *list(parameters)[2:]]
    unknown = [repr(option) for option in options if option not in known]
    if unknown:
        raise XResetError(
            f"The engine {engine!r} has no option {', '.join(unknown)}. Choose from: {', '.join(known)}."
        )


def backend_status(name: str) -> BackendStatus:
    """Return whether an engine can be used here; never raises."""
    try:
        cls = backend_class(name)
        version = cls.engine_version()
    except BackendUnavailableError as error:
        return BackendStatus(name, None, "-", str(error))
    except Exception as error:  # a plugin's defect must not hide the other engines
        return BackendStatus(
            name, None, "-", f"its engine_version() fails: {type(error).__name__}: {error}"
        )
    return BackendStatus(name, version, ", ".join(cls.devices()), None)


@contextmanager
def silence() -> Iterator[None]:
    """Drop what an engine prints in this block: it prints past Python, on the process's own streams."""
    library = ctypes.CDLL(None)  # its buffer holds what C has printed
    sys.stdout.flush()
    sys.stderr.flush()
    library.fflush(None)
    kept = os.dup(1), os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        library.fflush(None)
        for stream, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, stream)
            os.close(copy)
