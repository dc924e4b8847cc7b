"""Mirrored demonstrations: left hands become right hands, for training a right-handed robot.

The world is reflected in the vertical plane through the table's center that the person stands in. A reflected object is
no rigid motion of the object, unless the object is its own mirror image: with W the world's reflection, T the object's
pose and M the reflection in the object's own plane of symmetry, W T M is a proper pose, and shows what W T would show.
So only objects that are symmetric within a stated tolerance can be mirrored. The deviation from symmetry is measured on
the collision pieces, which are what physics touches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from xreset.demos.archive import Demos, levelled
from xreset.errors import DemoError
from xreset.files.checks import frozen
from xreset.geometry.shapes import perpendicular, turn_of
from xreset.spec import ObjectSpec, TableSpec

_SAMPLES = 600
"""Points of a surface that measure its symmetry."""
TOLERANCE = 0.004
"""Largest deviation of an object from its mirror image [m]; those of the twenty DexYCB objects are up to 2.3 mm."""
_ACROSS = np.array([-1.0, 1.0, 1.0])


@frozen
class Symmetry:
    """The plane in which an object is most nearly its own mirror image: normal . x = offset, in the mesh frame."""

    normal: np.ndarray
    """[3] unit vector."""
    offset: float
    """[m]"""
    deviation: float
    """Distance from the reflected surface to the surface, 95th percentile over the surface [m]."""


def symmetry(obj: ObjectSpec) -> Symmetry:
    """Find the best plane of symmetry of an object's surface: from the principal axes of its points, refined by Nelder
    and Mead's method."""
    from xreset.geometry.surface import Surface

    surface = Surface(obj)
    points, _ = surface.samples(_SAMPLES)
    center = points.mean(axis=0)

    def deviations(parameters: np.ndarray, axis: np.ndarray) -> np.ndarray:
        normal, offset = _plane(parameters, axis, center)
        reflected = points - 2.0 * (points @ normal - offset)[:, None] * normal
        return surface.nearest(reflected)[1]

    def mean_square(parameters: np.ndarray, axis: np.ndarray) -> float:
        return np.square(deviations(parameters, axis)).mean()

    axes = np.linalg.svd(points - center)[2]
    options = {"maxfev": 80, "initial_simplex": 0.1 * np.eye(4, 3)}
    fits = [
        minimize(mean_square, np.zeros(3), (axis,), method="Nelder-Mead", options=options)
        for axis in axes
    ]
    best = np.argmin([fit.fun for fit in fits])
    normal, offset = _plane(fits[best].x, axes[best], center)
    deviation = np.percentile(deviations(fits[best].x, axes[best]), 95)
    return Symmetry(normal=normal, offset=offset, deviation=float(deviation))


def mirrored(demos: Demos, symmetries: Mapping[str, Symmetry]) -> Demos:
    """Reflect demonstrations: left hands become right hands and vice versa; names end in ``-mirrored``.

    Args:
        demos: demonstrations; they are levelled first.
        symmetries: of each object, by name. Sequences of objects that deviate by more than :data:`TOLERANCE` are
            omitted.

    Raises:
        DemoError: no object is symmetric enough; the message lists the deviations.
    """
    measured = {name: symmetries[name].deviation for name in demos.object_names}
    kept = [name for name, deviation in measured.items() if deviation <= TOLERANCE]
    if not kept:
        listed = ", ".join(
            f"{name} {1e3 * deviation:.1f} mm" for name, deviation in measured.items()
        )
        raise DemoError(
            f"No object is its own mirror image within {1e3 * TOLERANCE:g} mm: {listed}. Omit --mirror."
        )
    demos = levelled(demos).select(objects=kept)
    shift = np.array([2.0 * TableSpec().center[0], 0.0, 0.0])
    symmetry_of_frame = [
        symmetries[name] for name in demos.object_name[demos.sequence_of_frame].tolist()
    ]
    normals = np.array([found.normal for found in symmetry_of_frame])
    offsets = np.array([found.offset for found in symmetry_of_frame])
    turn = turn_of(demos.object_quat_wxyz).as_matrix()
    reflection = np.eye(3) - 2.0 * normals[:, :, None] * normals[:, None, :]
    pos = demos.object_pos + np.einsum("fij,fj->fi", turn, 2.0 * offsets[:, None] * normals)
    quat = Rotation.from_matrix(_ACROSS[:, None] * turn @ reflection).as_quat(scalar_first=True)
    # S R S with S the reflection in x: the axis of a rotation is an axial vector
    wrist = demos.wrist_quat_wxyz * np.array([1.0, 1.0, -1.0, -1.0])
    kind = demos.object_pos.dtype
    return replace(
        demos,
        sequence_name=np.array([f"{name}-mirrored" for name in demos.sequence_name.tolist()]),
        hand_side=np.where(demos.hand_side == "left", "right", "left"),
        hand_keypoints=(demos.hand_keypoints * _ACROSS + shift).astype(kind),
        wrist_quat_wxyz=wrist.astype(kind),
        object_pos=(pos * _ACROSS + shift).astype(kind),
        object_quat_wxyz=quat.astype(kind),
    )


def _plane(
    parameters: np.ndarray, axis: np.ndarray, center: np.ndarray
) -> tuple[np.ndarray, float]:
    """Return normal [3] and offset [m] of a plane through the center, across an axis, which is tilted by two angles
    [rad] and moved by a length [0.1 m]."""
    u = perpendicular(axis)
    normal = axis + parameters[0] * u + parameters[1] * np.cross(axis, u)
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ center + 0.1 * parameters[2])
