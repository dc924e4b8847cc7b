"""The colored bar of the page: one slot for each row, green where it is good, else in the color of its reason."""

from __future__ import annotations

from collections import Counter
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


def mark(at: int, count: int) -> str:
    """Return the HTML of a pointer under slot ``at`` of a bar with ``count`` slots."""
    left = 100 * (at + 0.5) / count
    return (
        '<div style="position:relative;height:11px;margin:0 1em">'
        f'<div style="position:absolute;left:{left:.2f}%;transform:translateX(-50%);font-size:9px;line-height:11px">'
        "&#9650;</div></div>"
    )


def legend(reasons: Sequence[str], good: str) -> str:
    """Return the HTML of the colors on the bar with their numbers of rows; ``good`` is the name of good rows."""
    items = ""
    for reason, count in sorted(Counter(reasons).items()):
        items += (
            '<span style="margin-right:1em;white-space:nowrap">'
            f'<span style="color:{_css_color(reason)}">&#9632;</span> {escape(reason or good)} {count}</span>'
        )
    return f'<div style="margin:0 1em;font-size:0.8em">{items}</div>'


def _css_color(reason: str) -> str:
    red, green, blue = (round(255 * part) for part in reason_color(reason))
    return f"#{red:02x}{green:02x}{blue:02x}"
