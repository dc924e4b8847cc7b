"""Pictures of objects next to the convex pieces that stand for them in physics."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np

from xreset.geometry.shapes import shape_mesh
from xreset.pictures.meshes import OBJECT_COLOR, object_mesh
from xreset.pictures.render import Camera, add_caption, draw_bodies
from xreset.spec import ObjectSpec

TILE_SIZE = (420, 360)
"""Width and height of a picture [pixels]."""


def draw_pieces(objects: Sequence[ObjectSpec], captions: Sequence[str]) -> np.ndarray:
    """Draw a row for each object: its mesh, and its convex pieces in different colors, both from above the front.

    Args:
        captions: one line below each row.

    Returns:
        [H, W, 3] uint8.
    """
    rows = []
    for obj, caption in zip(objects, captions, strict=True):
        mesh = object_mesh(obj)
        middle = mesh.bounds.mean(axis=0)
        eye = middle + np.array([0.55, -0.75, 0.75]) * 1.15 * mesh.scale
        camera = Camera(eye=tuple(eye.tolist()), target=tuple(middle.tolist()))
        pieces = [shape_mesh(piece) for piece in obj.pieces]
        hues = [colorsys.hsv_to_rgb(0.618 * i % 1, 0.55, 0.95) for i in range(len(pieces))]
        whole = draw_bodies([mesh], [OBJECT_COLOR], camera, TILE_SIZE)
        parts = draw_bodies(pieces, hues, camera, TILE_SIZE)
        rows.append(add_caption(np.hstack((whole, parts)), [caption], 1))
    return np.vstack(rows)
