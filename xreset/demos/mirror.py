"""Mirrored demonstrations: left hands become right hands, for training a right-handed robot.

The world is reflected in the vertical plane through the table's centre that the person stands in. A reflected object is no rigid motion of
the object, unless the object is its own mirror image: with W the world's reflection, T the object's pose and M the reflection in the
object's own plane of symmetry, W T M is a proper pose, and shows what W T would show. So only objects that are symmetric within a stated
tolerance can be mirrored, and how symmetric each one is gets measured on its collision pieces, which are what physics touches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from xreset.demos.align import levelled
from xreset.demos.archive import Demos
from xreset.errors import DemoError
from xreset.spec import ObjectSpec, TableSpec

_SAMPLES = 600


@dataclass(frozen=True, kw_only=True)
class Symmetry:
    """The plane in which an object is most nearly its own mirror image: normal . x = offset, in the mesh frame."""

    normal: np.ndarray
    """[3] unit vector."""
    offset: float
    """[m]"""
    deviation: float
    """Distance from the reflected surface to the surface, which 95 % of it keep [m]."""


def symmetry(obj: ObjectSpec) -> Symmetry:
    """The best plane of symmetry of an object's surface: from the principal axes of its points, refined by Nelder and Mead's method."""
    from xreset.geometry.surface import Surface

    surface = Surface(obj)
    points = surface.samples(_SAMPLES)
    centre = points.mean(axis=0)

    def deviations(parameters: np.ndarray, axis: np.ndarray) -> np.ndarray:
        normal, offset = _plane(parameters, axis, centre)
        return surface.nearest(_reflected(points, normal, offset))[1]

    axes = np.linalg.svd(points - centre)[2]
    options = {"maxfev": 80, "initial_simplex": 0.1 * np.eye(4, 3)}
    found = [
        minimize(
            lambda p, axis=axis: np.square(deviations(p, axis)).mean(),
            np.zeros(3),
            method="Nelder-Mead",
            options=options,
        )
        for axis in axes
    ]
    best = int(np.argmin([result.fun for result in found]))
    normal, offset = _plane(found[best].x, axes[best], centre)
    return Symmetry(
        normal=normal, offset=offset, deviation=float(np.percentile(deviations(found[best].x, axes[best]), 95))
    )


def mirrored(demos: Demos, symmetries: Mapping[str, Symmetry], *, tolerance: float) -> Demos:
    """The demonstrations reflected: left hands become right ones and the other way round; names end in ``-mirrored``.

    Args:
        demos: demonstrations; they are levelled first.
        tolerance: largest deviation from symmetry with which an object is mirrored [m]; sequences of others are left out.

    Raises:
        DemoError: no object is symmetric enough; the message says how far each one is from it.
    """
    measured = {name: symmetries[name].deviation for name in sorted(set(demos.object_name.tolist()))}
    kept = [name for name, deviation in measured.items() if deviation <= tolerance]
    if not kept:
        listed = ", ".join(f"{name} {1e3 * deviation:.1f} mm" for name, deviation in measured.items())
        raise DemoError(
            f"no object is its own mirror image within {1e3 * tolerance:g} mm: {listed}. Raise the tolerance, or go without."
        )
    demos = levelled(demos).select(objects=kept)
    across = np.array([-1.0, 1.0, 1.0])
    shift = np.array([2.0 * TableSpec().center[0], 0.0, 0.0])
    normals = np.array([symmetries[name].normal for name in demos.object_name.tolist()])[demos.sequence_of_frame]
    offsets = np.array([symmetries[name].offset for name in demos.object_name.tolist()])[demos.sequence_of_frame]
    turn = Rotation.from_quat(demos.object_quat_wxyz, scalar_first=True).as_matrix()
    own = np.eye(3) - 2.0 * normals[:, :, None] * normals[:, None, :]
    pos = demos.object_pos + np.einsum("fij,fj->fi", turn, 2.0 * offsets[:, None] * normals)
    wrist = demos.wrist_quat_wxyz * np.array(
        [1.0, 1.0, -1.0, -1.0]
    )  # S R S with S the reflection in x: the axis is an axial vector
    kind = demos.object_pos.dtype
    return replace(
        demos,
        sequence_name=np.array([f"{name}-mirrored" for name in demos.sequence_name.tolist()]),
        hand_side=np.where(demos.hand_side == "left", "right", "left"),
        hand_keypoints=(demos.hand_keypoints * across + shift).astype(kind),
        wrist_quat_wxyz=wrist.astype(kind),
        object_pos=(pos * across + shift).astype(kind),
        object_quat_wxyz=Rotation.from_matrix(across[:, None] * turn @ own).as_quat(scalar_first=True).astype(kind),
        subjects=None,
        T_level_from_table=None,
    )


def _plane(parameters: np.ndarray, axis: np.ndarray, centre: np.ndarray) -> tuple[np.ndarray, float]:
    """Normal and offset of the plane through the centre across an axis, tilted by two angles [rad] and moved by a length [0.1 m]."""
    u = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    u /= np.linalg.norm(u)
    normal = axis + parameters[0] * u + parameters[1] * np.cross(axis, u)
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ centre + 0.1 * parameters[2])


def _reflected(points: np.ndarray, normal: np.ndarray, offset: float) -> np.ndarray:
    return points - 2.0 * (points @ normal - offset)[:, None] * normal
