"""Makes text and values of files safe to print."""

from __future__ import annotations

import re
import reprlib
from typing import Any


class _Repr(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 2
        self.maxdict = 4
        self.maxstring = 80
        self.maxother = 80

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() < 10_000 else f"an integer of {x.bit_length()} bits"


_REPR = _Repr()


def shown(value: Any) -> str:
    """Return a value as Python writes it, shortened: the content of a file may have any size."""
    text = _REPR.repr(value)
    return text if len(text) <= 200 else f"{text[:160]}...{text[-30:]}"


def is_plain(text: str) -> bool:
    """Return whether a text has only printable characters and line ends, none that controls a terminal."""
    return text.isprintable() or all(c.isprintable() or c in "\n\t" for c in text)


def plain(text: str) -> str:
    """Return the text with every character that :func:`is_plain` refuses as an escape."""
    return text if is_plain(text) else "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


def short_name(name: str, gap: str = " ") -> str:
    """Return ``tomato soup can`` for ``005_tomato_soup_can``, with ``gap`` between the words."""
    return re.sub(r"^\d+_(?=.)", "", name).replace("_", gap)
