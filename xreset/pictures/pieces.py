"""What stands for objects in physics, beside their meshes."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import numpy as np

from xreset.geometry.shapes import shape_mesh
from xreset.pictures.meshes import OBJECT_COLOR
from xreset.pictures.raster import Camera, draw_bodies
from xreset.pictures.view.sheet import TILE_SIZE, font, written
from xreset.spec import ObjectSpec

_CAPTION = 26
"""Height of a line under a picture [pixels]."""


def draw_pieces(objects: Sequence[ObjectSpec], captions: Sequence[str]) -> np.ndarray:
    """A row for each object: its mesh, and its convex pieces in colours of their own, both from above the front.

    Args:
        captions: a line under each.

    Returns:
        [H, W, 3] uint8.

    Raises:
        XResetError: Pillow, which writes the captions, is not installed.
    """
    face = font()
    rows = []
    for obj in objects:
        low, high = obj.vertices.min(axis=0), obj.vertices.max(axis=0)
        middle, reach = (low + high) / 2, float(np.linalg.norm(high - low))
        eye = middle + np.array([0.55, -0.75, 0.75]) * 1.15 * reach
        camera = Camera(eye=tuple(eye.tolist()), target=tuple(middle.tolist()))
        pieces = [shape_mesh(piece) for piece in obj.pieces]
        hues = [colorsys.hsv_to_rgb(0.618 * i % 1, 0.55, 0.95) for i in range(len(pieces))]
        sides = [
            ([(obj.vertices, obj.faces)], [OBJECT_COLOR]),
            ([(mesh.vertices, mesh.faces) for mesh in pieces], hues),
        ]
        picture = np.concatenate([draw_bodies(meshes, colors, camera, TILE_SIZE) for meshes, colors in sides], axis=1)
        rows.append(np.concatenate((picture, np.full((_CAPTION, picture.shape[1], 3), 255, np.uint8))))
    lines = [(6, i * (TILE_SIZE[1] + _CAPTION) + TILE_SIZE[1], (caption,)) for i, caption in enumerate(captions)]
    return written(np.concatenate(rows), face, lines)
