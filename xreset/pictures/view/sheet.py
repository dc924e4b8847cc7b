"""Sheets of captioned pictures: the moments of a demonstration for every object, and one example of every reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from xreset.errors import XResetError, needs
from xreset.pictures.view.data import View
from xreset.pictures.view.picture import Drawer

MOMENTS = ("first contact", "mid-lift", "goal")
TILE_SIZE = (420, 360)
"""Width and height of a tile's picture [pixels]."""
_LINE = 16
"""[pixels] height of a line of a caption."""


@dataclass(frozen=True, kw_only=True)
class Tile:
    """One place on a sheet."""

    caption: tuple[str, ...]
    row: int | None
    """Row of the view that is drawn; None for a caption that has no example."""


def moment_tiles(view: View) -> list[Tile]:
    """First contact, mid-lift and goal of one demonstration of each object, in the order of the view's objects.

    First contact is the first row that touches the object; mid-lift the first one after it in which the object has risen half as high as
    it ever does; the goal the last row with an annotated hand. The demonstration is the object's first in which all three are valid, or
    else its first with any contact. Objects without contact have tiles without row.
    """
    tiles = []
    for index, spec in enumerate(view.objects):
        sequences = np.unique(view.sequence[view.object_index == index]).tolist()
        found = [rows for s in sequences if (rows := _moments(view, view.choose(sequence=s))) is not None]
        rows = next(
            (rows for rows in found if not any(view.reason[row] for row in rows)),
            found[0] if found else (None,) * len(MOMENTS),
        )
        tiles += [
            Tile(caption=_caption(f"{spec.name}: {name}", view, row), row=row)
            for name, row in zip(MOMENTS, rows, strict=True)
        ]
    return tiles


def _moments(view: View, rows: np.ndarray) -> tuple[int, int, int] | None:
    """The three rows among those of one sequence; None without contact."""
    shown = [row for row in rows.tolist() if view.reason[row] != "not annotated"]
    touched = [row for row in shown if view.post_contact[row]]
    if not touched:
        return None
    height = view.object_pos[touched, 2] - view.object_pos[rows[0], 2]
    return touched[0], touched[int(np.argmax(height >= height.max() / 2))], touched[-1]


def reason_tiles(view: View) -> list[Tile]:
    """One example of every reason that the file knows: the middle one of the rows that have it.

    Raises:
        XResetError: the view knows no reasons.
    """
    if not view.reasons:
        raise XResetError(
            "a reset bank holds only states that were accepted: give the robot trajectories it was made from (--retargeted)."
        )
    tiles = []
    for reason, count in list(view.counts().items())[1:]:
        rows = view.choose(reason=reason)
        row = int(rows[len(rows) // 2]) if count else None
        tiles.append(Tile(caption=_caption(f"{reason}: {count} of {len(view.frame)}", view, row), row=row))
    return tiles


def draw_sheet(
    view: View, tiles: Sequence[Tile], *, progress: Callable[[int, int], None] = lambda done, total: None
) -> np.ndarray:
    """Draw tiles beside and below one another, each near to hand and object, captions under them.

    Args:
        progress: called with (tiles drawn, tiles in all).

    Returns:
        [H, W, 3] uint8.

    Raises:
        XResetError: Pillow, which writes the captions, is not installed.
    """
    face = font()
    drawer = Drawer(view, size=TILE_SIZE, smooth=True)
    columns, (width, height) = 3, TILE_SIZE
    full = height + _LINE * max((len(tile.caption) for tile in tiles), default=0) + _LINE // 2
    sheet = np.full((-(-len(tiles) // columns) * full, columns * width, 3), 255, dtype=np.uint8)
    for i, tile in enumerate(tiles):
        top, left = i // columns * full, i % columns * width
        picture = np.full((height, width, 3), 240, np.uint8) if tile.row is None else drawer.draw(tile.row, near=True)
        sheet[top : top + height, left : left + width] = picture
        progress(i + 1, len(tiles))
    return written(
        sheet,
        face,
        [(i % columns * width + 6, i // columns * full + height, tile.caption) for i, tile in enumerate(tiles)],
    )


def _caption(first: str, view: View, row: int | None) -> tuple[str, ...]:
    if row is None:
        return first, "no example in this file"
    state, _, sequence, frame, *others = view.text(row)
    return first, state, f"{sequence}, {frame}", *others


def font() -> Any:
    """For :func:`written`; ``XResetError`` if Pillow is not installed."""
    with needs("Pillow", "viewer"):
        from PIL import ImageFont
    return ImageFont.load_default(13)


def written(picture: np.ndarray, face: Any, captions: Sequence[tuple[int, int, tuple[str, ...]]]) -> np.ndarray:
    """A picture with lines of text at some (x, y)."""
    from PIL import Image, ImageDraw

    image = Image.fromarray(picture)
    pen = ImageDraw.Draw(image)
    for x, y, lines in captions:
        for i, line in enumerate(lines):
            pen.text((x, y + 3 + i * _LINE), line, fill=(0, 0, 0) if i == 0 else (70, 70, 70), font=face)
    return np.asarray(image)
