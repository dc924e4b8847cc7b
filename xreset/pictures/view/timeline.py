"""The coloured bar of the page: one slot for each row, green where it is good, in the reason's colour where not."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from itertools import groupby

from xreset.pictures.meshes import Color
from xreset.pictures.view.colors import GOOD_COLOR, reason_color


def bar(reasons: Sequence[str]) -> str:
    """HTML of a bar over rows with these reasons; empty text where a row is good."""
    slots = "".join(
        f'<div title="{escape(reason)}" style="flex:{len(list(group))};background:{_css(_color(reason))}"></div>'
        for reason, group in groupby(reasons)
    )
    return f'<div style="display:flex;height:12px;margin:0.6em 1em 0">{slots}</div>'


def mark(at: int, count: int) -> str:
    """HTML of a pointer that stands under slot ``at`` of a bar with ``count`` slots."""
    left = 100 * (at + 0.5) / count
    return (
        '<div style="position:relative;height:11px;margin:0 1em">'
        f'<div style="position:absolute;left:{left:.2f}%;transform:translateX(-50%);font-size:9px;line-height:11px">&#9650;</div></div>'
    )


def legend(reasons: Sequence[str], good: str) -> str:
    """HTML that says which colour is which, of those on the bar, and how often it is there; ``good`` is what good rows are called."""
    counts = {reason: sum(r == reason for r in reasons) for reason in dict.fromkeys(sorted(reasons))}
    items = "".join(
        f'<span style="margin-right:1em;white-space:nowrap"><span style="color:{_css(_color(reason))}">&#9632;</span> '
        f"{escape(reason or good)} {count}</span>"
        for reason, count in counts.items()
    )
    return f'<div style="margin:0 1em;font-size:0.8em">{items}</div>'


def _color(reason: str) -> Color:
    return reason_color(reason) if reason else GOOD_COLOR


def _css(color: Color) -> str:
    return f"#{''.join(f'{round(255 * part):02x}' for part in color)}"
