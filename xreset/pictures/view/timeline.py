"""The colored bar of the page: one slot for each row, green where it is good, else in the color of its reason."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import groupby

from xreset.pictures.view.colors import reason_color


def bar(reasons: Sequence[str]) -> str:
    """Return the HTML of a bar over rows with these reasons; the reason of a good row is an empty text."""
    slots = ""
    for reason, group in groupby(reasons):
        width = len(list(group))
        slots += f'<div title="{escape(reason)}" style="flex:{width};background:{_css_color(reason)}"></div>'
    return f'<div style="display:flex;height:12px;margin:0.6em 1em 0">{slots}</div>'


def _css_color(reason: str) -> str:
    red, green, blue = (round(255 * part) for part in reason_color(reason))
    return f"#{red:02x}{green:02x}{blue:02x}"
