"""Makes text and values of files safe to print."""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterable, Sequence
from pathlib import PurePath
from typing import Any

_LISTED = 8
"""Names that are listed of many."""
_REPR = reprlib.Repr()
_REPR.maxlevel = 2
_REPR.maxdict = 4
_REPR.maxstring = 80
_REPR.maxother = 80


def shown(value: Any) -> str:
    """Return a value as Python writes it, in one line and shortened: the content of a file may have any size. A path is
    shown as a text."""
    try:
        value = str(value) if isinstance(value, PurePath) else value
        text = re.sub(r"\n\s*", " ", _REPR.repr(value))
    except ValueError:  # Python refuses to write thousands of digits
        text = "a number of thousands of digits"
    return text if len(text) <= 200 else f"{text[:160]}...{text[-30:]}"


def texts(given: str | Iterable[str]) -> tuple[str, ...]:
    """Return the texts that a user gave, one or several, without repeats."""
    return (given,) if isinstance(given, str) else tuple(dict.fromkeys(given))


def listed(names: Sequence[str]) -> str:
    """Return names, separated by commas; of many, the first ones, and how many more there are."""
    more = len(names) - _LISTED
    return ", ".join(names) if more < 2 else f"{', '.join(names[:_LISTED])} and {more} more"


def quantity(count: int, noun: str) -> str:
    """Return ``1 frame`` or ``3 frames``, given the noun in the singular."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


class Brief:
    """Base of dataclasses made with ``repr=False``, which print arrays as their shapes, and other values shortened."""

    def __repr__(self) -> str:
        parts = []
        for name, value in vars(self).items():
            shape = getattr(value, "shape", None)
            parts.append(f"{name}={shown(value) if shape is None else f'array{list(shape)}'}")
        return f"{type(self).__name__}({', '.join(parts)})"


def is_plain(text: str) -> bool:
    """Return whether a text has only printable characters and line ends, none that controls a terminal."""
    return text.isprintable() or all(c.isprintable() or c in "\n\t" for c in text)


def plain(text: str) -> str:
    """Return the text with every character that :func:`is_plain` refuses as an escape."""
    return "".join(c if is_plain(c) else ascii(c)[1:-1] for c in text)


def short_name(name: str, gap: str = " ") -> str:
    """Return ``tomato soup can`` for ``005_tomato_soup_can``, with ``gap`` between the words."""
    return re.sub(r"^\d+_(?=.)", "", name).replace("_", gap)
