"""Writes files whole or not at all, reads JSON and TOML, and lets one process at a time write a file."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
import secrets
import shlex
import shutil
import stat
import subprocess
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path
from typing import IO, Any, TypeVar

from xreset import __version__
from xreset.errors import FileFormatError, XResetError
from xreset.files.text import is_plain, shown

T = TypeVar("T")
RAISE_LIMIT = "If it is what you expect, raise the limit: set XRESET_MAX_FILE_MB (default 1024)."
"""Advice for a file that is too large."""

INVOCATION: list[str] = []
"""Words of the command that is running; none in a program that calls functions of xreset."""
MEASURED = "xreset-measured/1"
"""Schema of results that are written for a user, and that xreset does not read."""
_MOST_LEVELS = 100
"""Most levels of nested JSON or TOML; some versions of Python read far more than other functions can walk through."""
_TOO_DEEP = "it is nested too deeply"


def max_bytes() -> int:
    """Most memory that the arrays of a file may take: 1 GiB, or ``XRESET_MAX_FILE_MB``. Small files can unpack to any
    size."""
    text = os.environ.get("XRESET_MAX_FILE_MB", "1024")
    if not text.isdecimal():
        raise XResetError(f"XRESET_MAX_FILE_MB is {text!r}, expected a whole number of megabytes.")
    return int(text) << 20


@contextmanager
def atomic_write(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a temporary binary file that replaces ``path`` when the block ends, and is removed if the block raises.

    Raises:
        XResetError: the file cannot be written (no such folder, no permission, disk full, a device); ``path`` is then
            as it was before.
    """
    path = Path(path)
    try:
        # root could replace /dev/null by a file
        if path.exists() and not path.is_file() and not path.is_dir():
            raise XResetError(f"cannot write {path}: it is a device. Choose another place.")
        with _temporary(path.parent, Path.touch) as temporary, open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
            temporary.replace(path)
    except OSError as error:
        raise _cannot_write(path, error) from error


def write_whole(path: str | Path, content: bytes | memoryview | str) -> None:
    """Write a file at once, text as UTF-8; see :func:`atomic_write`."""
    with atomic_write(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def matches(folder: Path, pattern: str) -> list[Path]:
    """Return the paths in a folder that match a pattern, sorted; none if there is no such folder.

    Raises:
        XResetError: the folder cannot be read; for ``Path.glob`` it is empty.
    """
    if not os.path.isdir(folder):
        return []
    try:
        os.scandir(os.path.join(folder, ".")).close()
    except PermissionError as error:
        raise XResetError(
            f"Cannot read the folder {folder}: {error.strerror}. Change its permissions, or give another."
        ) from error
    return sorted(folder.glob(pattern))


def must_be_new(path: Path) -> None:
    """Refuse, with ``XResetError``, a folder with content, or a file, where a folder will be made."""
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise XResetError(
            f"{path} is there already. Nothing was changed; give another folder, or remove it."
        )


@contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Make a temporary folder that becomes ``path`` when the block ends, and is removed if the block raises.

    What killed processes have left next to it is removed.

    Raises:
        XResetError: there is a file or a folder with content of this name, or the folder cannot be made or written.
    """
    path = Path(os.path.realpath(path))
    try:
        must_be_new(path)
        with _temporary(path.parent, Path.mkdir) as temporary:
            remove_leftovers(path.parent)
            try:
                yield temporary
            except XResetError as error:  # the user knows only the folder's own name
                raise type(error)(str(error).replace(str(temporary), str(path))) from error
            temporary.replace(path)
    except OSError as error:
        name = str(error.filename or "")  # a full disk names no file
        if name and ".xreset-" not in name and Path(name) not in path.parents:
            raise  # it is about another file
        raise _cannot_write(path, error) from error


def _cannot_write(path: Path, error: OSError) -> XResetError:
    """Return the error about a file or folder that is as it was before."""
    reason = error.strerror or str(error)
    return XResetError(
        f"cannot write {path}: {reason}. Nothing was changed; free some space or choose another place."
    )


@contextmanager
def _temporary(folder: Path, make: Callable[[Path], None]) -> Iterator[Path]:
    """Make a temporary file or folder, and remove it at the end if it is still there.

    It is locked while the block runs: this tells other processes that it is not a leftover.
    """
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = None
    # again if another process took it for a leftover before it was locked
    while descriptor is None:
        temporary = folder / f".xreset-{secrets.token_hex(4)}.part"
        make(temporary)
        with suppress(FileNotFoundError):
            descriptor = _lock(temporary)
    try:
        yield temporary
    finally:
        _remove(temporary)
        os.close(descriptor)


def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files and folders that killed processes have left in a folder."""
    for leftover in folder.glob(".xreset-*.part"):
        with suppress(OSError):
            descriptor = _lock(leftover, required=True)
            if descriptor is not None:
                try:
                    _remove(leftover)
                finally:
                    os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def claim(path: str | Path) -> Iterator[None]:
    """Reserve a file, or an existing folder, for this process while the block runs, and remove what killed processes
    have left there.

    Raises:
        XResetError: another command is writing it.
    """
    path = Path(path)
    if path.is_dir():
        folder = lock = path
    else:
        folder = path.parent
        lock = folder / f".{path.name}.lock"
    try:
        descriptor = _patient_lock(lock)
    except OSError as error:
        raise XResetError(
            f"cannot write {path}: {error.strerror or error}. Choose another place."
        ) from error
    if descriptor is None:
        raise XResetError(
            f"another command is writing {path}. Wait for its end, or choose another place."
        )
    try:
        remove_leftovers(folder)
        yield
    finally:
        if lock != path:
            lock.unlink(missing_ok=True)
        os.close(descriptor)


@contextmanager
def claim_folder(path: str | Path) -> Iterator[None]:
    """Make a folder unless it exists, and :func:`claim` it.

    Raises:
        XResetError: another command is writing into the folder, or it cannot be made or written.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise XResetError(
            f"cannot make the folder {path}: {error.strerror or error}. Choose another place."
        ) from error
    if not os.access(path, os.W_OK):  # results would be lost at the end
        raise XResetError(f"cannot write {path}: the folder is read-only. Choose another place.")
    with claim(path):
        yield


def _patient_lock(path: Path) -> int | None:
    """Lock a folder, or a file that is made for this; try for a quarter of a second, because a command may just end."""
    for _ in range(5):
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.is_dir():
            path.touch()
        # The process that held the lock may just have removed the file.
        with suppress(FileNotFoundError):
            descriptor = _lock(path)
            if descriptor is not None:
                return descriptor
        time.sleep(0.05)
    return None


def _lock(path: Path, *, required: bool = False) -> int | None:
    """Lock a file or folder, until the descriptor that is returned is closed or this process ends.

    Args:
        required: whether a file system without locks is an error (``OSError``).

    Returns:
        The descriptor, or None if another process has locked the path, or replaced it meanwhile.
    """
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if os.path.samestat(os.fstat(descriptor), os.stat(path)):
            return descriptor
    except BlockingIOError:
        pass
    except OSError as error:
        if error.errno in (errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS) and not required:
            return descriptor
        os.close(descriptor)
        raise
    os.close(descriptor)
    return None


@cache
def code_version() -> str:
    """Return the version of xreset and the commit that is running, as files record them: ``0.2.0+g1a2b3c4d5e6f``.

    ``.dirty`` is added if files of the checkout were changed. A package that was not installed from a repository has no
    commit.
    """
    root = Path(__file__).parent.parent.parent
    commit = ""
    if (root / ".git").exists():
        command = ["git", "--no-optional-locks", "-C", str(root), "describe", "--always"]
        command += ["--dirty=.dirty", "--abbrev=12", "--exclude=*"]
        environment = {
            name: value for name, value in os.environ.items() if not name.startswith("GIT_")
        }
        with suppress(OSError, subprocess.TimeoutExpired):
            found = subprocess.run(
                command, capture_output=True, text=True, timeout=20, env=environment
            )
            commit = found.stdout.strip()
    else:
        # There may be no package, or one of another origin.
        with suppress(PackageNotFoundError, ValueError, AttributeError):
            origin = json.loads(distribution("xreset").read_text("direct_url.json") or "{}")
            commit = str(origin.get("vcs_info", {}).get("commit_id", ""))[:12]
    return f"{__version__}+g{commit}" if commit else __version__


def this_command() -> str:
    """Return the running command as text, without the folders of files and the file of the results."""
    if not INVOCATION:
        return "a program that uses xreset"
    words = list(INVOCATION)
    if "--out" in words:
        i = words.index("--out")
        del words[i : i + 2]
    names = [Path(word).name if Path(word).exists() else word for word in words]
    return shlex.join(["xreset", *names])


def measured(content: dict[str, Any]) -> dict[str, Any]:
    """Return results with the version and the command that measured them, which tells what they are."""
    about = {"xreset_version": code_version(), "command": this_command()}
    return {"schema": MEASURED} | content | about


def write_json(path: str | Path, data: Any) -> None:
    """Write ``data`` as indented JSON; non-finite numbers are refused (``ValueError``). Data with a ``schema`` get
    :func:`code_version` as ``xreset``."""
    if isinstance(data, dict) and "schema" in data:
        data = {"schema": data["schema"], "xreset": code_version()} | data
    write_whole(path, json.dumps(data, indent=2, allow_nan=False) + "\n")


def read_json(
    path: str | Path, schema: str | None = None, *, keep_version: bool = False
) -> dict[str, Any]:
    """Read a JSON object; with ``schema``, its ``schema`` entry must be that, and is removed, and so is the version of
    xreset that wrote it unless ``keep_version``."""
    path = Path(path)
    must_exist(path, "JSON file")
    # objects in memory are about 16 times larger
    if path.stat().st_size > max_bytes() // 16:
        raise FileFormatError(
            f"{path} has {path.stat().st_size >> 20} MB, too many for JSON. {RAISE_LIMIT}"
        )
    try:
        data = parse_json(path.read_bytes())
    except ValueError as error:
        raise FileFormatError(
            f"{path} is not valid JSON ({error}). It may be truncated; make it again."
        ) from error
    if schema is not None:
        check_schema(path, data.pop("schema", None), schema)
        if not keep_version:
            data.pop("xreset", None)
    return data


def read_toml(
    path: Path,
    schema: str | None = None,
    *,
    error: type[XResetError] = FileFormatError,
    hint: str = "",
) -> dict[str, Any]:
    """Read a TOML file; with ``schema``, its ``schema`` entry must be that. ``hint`` ends the message if it cannot
    be read.

    Raises:
        XResetError: the file cannot be read, is not TOML, or states another schema; of class ``error``.
    """
    try:
        data = tomllib.loads(path.read_bytes().decode())
        _check_content(data)
    except OSError as problem:
        raise error(f"{path} cannot be read ({problem.strerror}).{hint}") from problem
    # of TOML, of decoding, of numbers of thousands of digits
    except (ValueError, RecursionError) as problem:
        raise error(f"{path} is not valid TOML: {problem}.") from problem
    if schema is not None and data.get("schema") != schema:
        raise error(f"{path} states schema {shown(data.get('schema'))}, expected {schema!r}.")
    return data


def parse_json(text: str | bytes) -> dict[str, Any]:
    """Return a JSON object whose numbers are finite and whose texts can be printed.

    Raises:
        ValueError: the text is not one; the message is half a sentence.
    """
    try:
        text = text.decode() if isinstance(text, bytes) else text
        data = json.loads(text, parse_constant=_no_constant)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    except UnicodeDecodeError:
        raise ValueError("it is not UTF-8") from None
    if not isinstance(data, dict):
        raise ValueError(f"it holds a JSON {type(data).__name__}, expected an object")
    _check_content(data)
    return data


def _no_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number of JSON")


def _check_content(data: Any) -> None:
    """Raise ``ValueError`` for data that are nested deeper than functions may be, or texts that cannot be printed."""
    level = [data]
    for _ in range(_MOST_LEVELS):
        below = []
        for value in level:
            if isinstance(value, dict):
                below += [*value.keys(), *value.values()]
            elif isinstance(value, list):
                below += value
            elif isinstance(value, str) and not is_plain(value):
                raise ValueError(
                    f"the text {shown(value)} holds characters that control a terminal, or are none"
                )
        level = below
    if level:
        raise ValueError(_TOO_DEEP)


def file_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def stated_path(stated: str, file: str | Path, content: str = "") -> str | None:
    """Return a file or folder that another file states, or None if it is gone. It may be relative to the working folder
    or to one of the folders above that file. ``content``: what a folder must have."""
    if os.path.exists(Path(stated) / content):
        return stated
    for place in Path(file).resolve().parents:
        if os.path.exists(place / stated / content):
            return str(place / stated)
    return None


def must_exist(path: Path, what: str) -> None:
    """Refuse, with ``FileFormatError``, a path where no regular file is, or one that may not be read; ``what`` it ought
    to be is for the message."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise FileFormatError(
            f"there is no {path} ({what}). Check the path, or make the file first."
        ) from None
    # a name too long, a folder that may not be entered, a zero in the name
    except (OSError, ValueError) as error:
        raise FileFormatError(f"there is no {shown(str(path))} ({what}): {error}.") from error
    if not stat.S_ISREG(mode):
        raise FileFormatError(f"{path} is a folder or a device, expected a file ({what}).")
    try:
        os.close(os.open(path, os.O_RDONLY))
    except OSError as error:  # no right to read it, or too many open files
        raise FileFormatError(f"{path} cannot be read: {error.strerror}.") from error


def check_schema(path: Path, found: Any, expected: str, what: str | None = None) -> None:
    """Refuse, with ``FileFormatError``, a file that states another schema than the one expected.

    Args:
        what: what the file ought to be, for messages; default: its version, as the schema states it.
    """
    if found == expected:
        return
    name, _, version = expected.rpartition("/")
    if isinstance(found, str) and found.rpartition("/")[0] == name:
        raise FileFormatError(
            f"{path} has schema version {shown(found)}; this xreset ({__version__}) reads {expected!r}. Make the file "
            "again."
        )
    stated = f"states schema {shown(found)}" if found else "states no schema"
    what = what or f"version {version} of {name}"
    raise FileFormatError(f"{path} {stated}, expected {expected!r} ({what}). Is it the right file?")
