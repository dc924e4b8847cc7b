"""Foreign text and values, safe to show: in messages, in tables, in a terminal."""

from __future__ import annotations

import re
import reprlib
from typing import Any


class _Repr(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxdict, self.maxstring, self.maxother = 2, 4, 80, 80

    def repr_int(self, x: int, level: int) -> str:
        return super().repr_int(x, level) if x.bit_length() < 10_000 else f"an integer of {x.bit_length()} bits"


_REPR = _Repr()


def shown(value: Any) -> str:
    """A value as Python writes it, shortened: what a file holds may be of any size, or look small and unfold without
    end."""
    text = _REPR.repr(value)
    return text if len(text) <= 200 else f"{text[:160]}...{text[-30:]}"


def is_plain(text: str) -> bool:
    """Whether a text has only characters that can be seen, spaces and ends of lines; none that moves a cursor or turns
    a line round."""
    return text.isprintable() or all(c.isprintable() or c in "\n\t" for c in text)


def plain(text: str) -> str:
    """The text with every other character written as an escape."""
    return text if is_plain(text) else "".join(c if c.isprintable() or c in "\n\t" else ascii(c)[1:-1] for c in text)


def short_name(name: str, gap: str = " ") -> str:
    """``005_tomato_soup_can`` -> ``tomato soup can``, with another ``gap`` between its words for files."""
    return re.sub(r"^\d+_(?=.)", "", name).replace("_", gap)
