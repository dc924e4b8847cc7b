"""Sheets of captioned pictures: the moments of a demonstration for every object, and one example of every reason."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from xreset.errors import XResetError
from xreset.pictures.view.data import View
from xreset.pictures.view.picture import Drawer

MOMENTS = ("first contact", "mid-lift", "goal")
TILE_SIZE = (420, 360)
"""Width and height of a tile's picture [pixels]."""
_COLUMNS = 3
_LINE = 16
"""Height of a line of a caption [pixels]."""


@dataclass(frozen=True, kw_only=True)
class Tile:
    """One place on a sheet."""

    caption: tuple[str, ...]
    row: int | None
    """Row of the view that is drawn; None for a caption without an example."""


def moment_tiles(view: View) -> list[Tile]:
    """Return tiles of first contact, mid-lift and goal of one demonstration of each object, in the view's order of
    objects.

    First contact is the first row that touches the object. Mid-lift is the first later row in which the object has
    risen half as high as it ever does. The goal is the last row with an annotated hand. The demonstration is the
    object's first in which all three rows are valid, or else its first with any contact. The tiles of an object without
    contact have no row.
    """
    tiles = []
    for index, spec in enumerate(view.objects):
        rows = _moments_of_object(view, index)
        for name, row in zip(MOMENTS, rows, strict=True):
            tiles.append(_tile(f"{spec.name}: {name}", view, row))
    return tiles


def _moments_of_object(view: View, index: int) -> tuple[int | None, ...]:
    first: tuple[int | None, ...] | None = None
    for sequence in np.unique(view.sequence[view.object_index == index]).tolist():
        rows = _moments(view, view.choose(sequence=sequence))
        if rows is None:
            continue
        if not any(view.reason[row] for row in rows):
            return rows
        first = first or rows
    return first or (None, None, None)


def _moments(view: View, rows: np.ndarray) -> tuple[int, int, int] | None:
    """Return the three rows among the rows of one sequence; None without contact."""
    touched = [row for row in rows.tolist() if view.post_contact[row] and view.reason[row] != "not annotated"]
    if not touched:
        return None
    height = view.object_pos[touched, 2] - view.object_pos[rows[0], 2]
    half_way = int(np.argmax(height >= height.max() / 2))
    return touched[0], touched[half_way], touched[-1]


def reason_tiles(view: View) -> list[Tile]:
    """Return a tile for every reason of the file: the middle one of its rows.

    Raises:
        XResetError: the view has no reasons.
    """
    if not view.reasons:
        raise XResetError(
            "A reset bank alone holds only accepted states. Add the robot trajectories it was made from: --retargeted."
        )
    tiles = []
    for reason in view.reasons:
        rows = view.choose(reason=reason)
        row = int(rows[len(rows) // 2]) if len(rows) else None
        tiles.append(_tile(f"{reason}: {len(rows)} of {len(view.frame)}", view, row))
    return tiles


def _tile(title: str, view: View, row: int | None) -> Tile:
    if row is None:
        return Tile(caption=(title, "no example in this file"), row=None)
    state, _, sequence, frame, *others = view.text(row)
    return Tile(caption=(title, state, f"{sequence}, {frame}", *others), row=row)


def draw_sheet(
    view: View, tiles: Sequence[Tile], *, progress: Callable[[int, int], None] = lambda done, total: None
) -> np.ndarray:
    """Draw tiles in three columns, each near to hand and object, with captions below.

    Args:
        progress: called with (tiles drawn, tiles in all).

    Returns:
        [H, W, 3] uint8.
    """
    drawer = Drawer(view, size=TILE_SIZE, smooth=True)
    width, height = TILE_SIZE
    lines = max((len(tile.caption) for tile in tiles), default=0)
    pictures = []
    for done, tile in enumerate(tiles, start=1):
        if tile.row is None:
            picture = np.full((height, width, 3), 240, np.uint8)
        else:
            picture = drawer.draw(tile.row, near=True)
        pictures.append(add_caption(picture, tile.caption, lines))
        progress(done, len(tiles))
    while len(pictures) % _COLUMNS:
        pictures.append(np.full_like(pictures[0], 255))
    rows = [np.hstack(pictures[i : i + _COLUMNS]) for i in range(0, len(pictures), _COLUMNS)]
    return np.vstack(rows)


def add_caption(picture: np.ndarray, caption: Sequence[str], lines: int) -> np.ndarray:
    """Return a picture with text below it, on a white band with room for a number of lines."""
    height, width, _ = picture.shape
    image = Image.new("RGB", (width, height + _LINE * lines + _LINE // 2), "white")
    image.paste(Image.fromarray(picture))
    pen = ImageDraw.Draw(image)
    color = "black"
    for number, line in enumerate(caption):
        pen.text((6, height + 3 + number * _LINE), line, fill=color, font=ImageFont.load_default(13))
        color = "dimgray"
    return np.asarray(image)
