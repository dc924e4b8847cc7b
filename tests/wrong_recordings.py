"""Recordings as a tracker would write them, and kinds of errors that such files have."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from xreset.demos.hand import ORDERS
from xreset.demos.keypoints import Convention
from xreset.geometry.shapes import transformed, turn_of
from xreset.spec import TableSpec

CAMERA = np.eye(4)
CAMERA[:3, :3] = Rotation.from_euler("xyz", [2.2, 0.1, 3.0]).as_matrix()
CAMERA[:3, 3] = (0.4, 1.3, 0.9)
"""Pose of a camera that looks down at the table."""
OPENGL = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class File:
    """What a file of a tracker holds and what its user says about it."""

    points: np.ndarray
    pos: np.ndarray
    turn: Rotation
    fps: float
    side: str
    name: str
    camera: np.ndarray | None = None
    order: str = "mediapipe"
    quat: str = "wxyz"

    def arrays(self):
        """The arrays of an npz file."""
        return {
            "keypoints": self.points,
            "object_pos": self.pos,
            f"object_quat_{self.quat}": self.turn.as_quat(scalar_first=self.quat == "wxyz"),
            "object": np.array(self.name),
            "side": np.array(self.side),
            "sequence": np.array("a"),
        }

    @property
    def other_side(self):
        return {"right": "left", "left": "right"}[self.side]

    def of(self, rows, **changes):
        """The file with some of its frames."""
        parts = {name: getattr(self, name)[rows] for name in ("points", "pos", "turn")}
        return replace(self, **parts | changes)

    @property
    def convention(self):
        """What the user says."""
        frame = "table" if self.camera is None else "camera"
        return Convention(
            order=self.order, units="m", frame=frame, table_from_camera=self.camera, fps=self.fps
        )


def file_of(demos):
    """A file in the table's frame that holds the only sequence of demonstrations."""
    seen = demos.hand_valid[:, None, None]
    return File(
        points=np.where(seen, demos.hand_keypoints, np.nan).astype(float),
        pos=demos.object_pos.astype(float),
        turn=turn_of(demos.object_quat_wxyz),
        fps=float(demos.fps),
        side=str(demos.hand_side[0]),
        name=str(demos.object_name[0]),
    )


def moved(file, hand=None, obj=None):
    """The file with the hand moved by a matrix [4, 4], which may mirror, and the object by another one."""
    if hand is not None:
        file = replace(file, points=transformed(file.points, hand))
    if obj is not None:
        turn = Rotation.from_matrix(obj[:3, :3]) * file.turn
        file = replace(file, pos=transformed(file.pos, obj), turn=turn)
    return file


def matrix(turn=None, shift=(0.0, 0.0, 0.0)):
    """A matrix [4, 4] of a linear map [3, 3] and a translation."""
    T = np.eye(4)
    if turn is not None:
        T[:3, :3] = turn
    T[:3, 3] = shift
    return T


def with_rows(values, rows, new):
    """A copy of an array with other values in some rows."""
    changed = values.copy()
    changed[rows] = new
    return changed


def about(axis, degrees, center=(0.0, 0.0, 0.0)):
    """A rotation about an axis through a point."""
    turn = matrix(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())
    return matrix(shift=center) @ turn @ matrix(shift=-np.array(center))


def camera_files(file):
    """Yield name and file of errors of a camera's pose."""
    to_camera = np.linalg.inv(CAMERA)
    seen = replace(moved(file, to_camera, to_camera), camera=CAMERA)
    hand_only = replace(moved(file, to_camera, None), camera=CAMERA)
    object_only = replace(moved(file, None, to_camera), camera=CAMERA)
    opengl = matrix(OPENGL)
    yield "right: camera", seen
    yield "camera: matrix inverted", replace(seen, camera=to_camera)
    yield "camera: coordinates said to be the table's", replace(seen, camera=None)
    yield "camera: coordinates are the table's", replace(file, camera=CAMERA)
    yield "camera: hand in camera's frame, object in table's", hand_only
    yield "camera: object in camera's frame, hand in table's", object_only
    yield "camera: OpenGL's axes", moved(seen, opengl, opengl)
    yield "camera: OpenGL's axes, hand alone", moved(seen, opengl, None)
    yield "camera: OpenGL's axes, object alone", moved(seen, None, opengl)
    other = about("z", 30, (0.5, 0.3, 0.0)) @ matrix(shift=(0.1, 0.1, 0.1)) @ CAMERA
    yield "camera: matrix of another camera", replace(seen, camera=other)
    transposed = matrix(CAMERA[:3, :3].T, CAMERA[:3, 3])
    yield "camera: rotation transposed", replace(seen, camera=transposed)
    small = matrix(CAMERA[:3, :3], 1e-3 * CAMERA[:3, 3])
    yield "camera: translation a thousandth", replace(seen, camera=small)
    yield "camera: tilted by 15 degrees", replace(seen, camera=about("x", 15) @ CAMERA)
    turn = Rotation.from_matrix(to_camera[:3, :3]).inv() * seen.turn
    yield "camera: object's orientation in the table's frame", replace(seen, turn=turn)
    mirror = matrix(np.diag([-1.0, 1.0, 1.0]))
    yield "camera: mirrored hand", replace(moved(seen, mirror), side=file.other_side)
    quats = np.roll(seen.turn.as_quat(scalar_first=True), -1, axis=1)
    yield "camera: quaternions (x, y, z, w)", replace(seen, turn=turn_of(quats))


def table_files(file):
    """Yield name and file of errors of the table's frame."""
    center = (*TableSpec().center, 0.0)
    for name, T in (
        ("y up", about("x", -90)),
        ("x up", about("y", 90)),
        ("z down", about("x", 180)),
        ("turned by 180 degrees", about("z", 180)),
        ("turned by 180 degrees about the table's center", about("z", 180, center)),
        ("turned by 90 degrees", about("z", 90)),
        ("tilted by 15 degrees", about("x", 15, (0.5, 0.9, 0.0))),
        ("10 cm too low", matrix(shift=(0.0, 0.0, -0.1))),
        ("10 cm too high", matrix(shift=(0.0, 0.0, 0.1))),
        ("25 mm too low", matrix(shift=(0.0, 0.0, -0.025))),
        ("25 mm too high", matrix(shift=(0.0, 0.0, 0.025))),
        ("1 m to the side", matrix(shift=(1.0, 0.0, 0.0))),
    ):
        yield f"table: {name}", moved(file, T, T)


def hand_files(file, rng):
    """Yield name and file of errors of the hand's numbers."""
    points = file.points
    wrist = points[:, :1]
    for axis in range(3):
        mirror = np.eye(3)
        mirror[axis, axis] = -1.0
        mirrored = replace(moved(file, matrix(mirror)), side=file.other_side)
        yield f"hand: mirrored in {'xyz'[axis]}", mirrored
    yield "hand: other side", replace(file, side=file.other_side)
    mirror = np.diag([-1.0, 1.0, 1.0])
    flipped = Rotation.from_matrix(mirror @ file.turn.as_matrix() @ mirror)
    left_handed = moved(file, matrix(mirror))
    yield "hand: left-handed coordinates", replace(left_handed, pos=file.pos @ mirror, turn=flipped)
    for scale in (0.8, 1.3):
        yield f"hand: size times {scale}", replace(file, points=wrist + scale * (points - wrist))
        yield f"hand: positions times {scale}", replace(file, points=scale * points)
    yield "hand: relative to the wrist", replace(file, points=points - wrist)
    centered = points - points.mean(axis=1, keepdims=True)
    yield "hand: relative to its center", replace(file, points=centered)
    local = np.einsum("fji,fkj->fki", file.turn.as_matrix(), points - file.pos[:, None])
    yield "hand: in the object's frame", replace(file, points=local)
    for shift in ((0.06, 0.0, 0.06), (0.0, 0.3, 0.0), (0.0, 0.0, -0.1)):
        yield f"hand: shifted by {shift}", replace(file, points=points + shift)
    yield "hand: in millimetres", replace(file, points=1e3 * points)
    yield "hand: in centimetres", replace(file, points=1e2 * points)
    mano = np.argsort(ORDERS["mano"])
    yield "order: MANO's as MediaPipe's", replace(file, points=points[:, mano])
    yield "order: MediaPipe's as MANO's", replace(file, order="mano")
    fingers = points[:, 1:].reshape(-1, 5, 4, 3)
    for name, changed in (
        ("little finger to thumb", fingers[:, ::-1]),
        ("tips to bases", fingers[:, :, ::-1]),
        ("thumb last", fingers[:, [1, 2, 3, 4, 0]]),
        ("ring finger before middle finger", fingers[:, [0, 1, 3, 2, 4]]),
    ):
        order = np.concatenate((wrist, changed.reshape(-1, 20, 3)), axis=1)
        yield f"order: {name}", replace(file, points=order)
    wrist_last = np.roll(points, -1, axis=1)
    yield "order: wrist last", replace(file, points=wrist_last)
    image = points / (2.0 - points[..., 2:])
    yield "hand: coordinates of an image", replace(file, points=image)
    yield "hand: of another recording", replace(file, points=points[::-1] + np.full(3, 0.1))
    jitter = rng.normal(0.0, 0.03, (len(points), 1, 3))
    yield "hand: trembles by 3 cm", replace(file, points=points + jitter)


def tracking_files(file):
    """Yield name and file of frames in which a tracker failed."""
    points = file.points
    away = np.linalg.norm(file.pos - file.pos[0], axis=1) > 0.05
    moving = np.flatnonzero(away & np.isfinite(points).all(axis=(1, 2)))
    middle = int(moving[len(moving) // 2])
    for value in (0.0, -1.0, 999.0):
        absent = with_rows(np.where(np.isnan(points), value, points), slice(3), value)
        yield f"absent: hand is {value:g}", replace(file, points=absent)
    one = with_rows(points, np.s_[middle : middle + 4, 7], 0.0)
    yield "absent: one keypoint is 0", replace(file, points=one)
    for value in (0.0, -1.0):
        pos = with_rows(file.pos, slice(middle, middle + 3), value)
        yield f"absent: object is at {value:g}", replace(file, pos=pos)
    for way, jump in (("30 cm", [0.3, 0.0, 0.0]), ("10 cm", [0.0, 0.1, 0.0])):
        jumped = with_rows(points, middle, points[middle] + jump)
        yield f"jump: hand by {way}", replace(file, points=jumped)
    pos = with_rows(file.pos, middle, file.pos[middle] + [0.3, 0.0, 0.0])
    yield "jump: object by 30 cm", replace(file, pos=pos)
    half_turn = np.zeros((len(pos), 3))
    half_turn[middle, 2] = np.pi
    yield (
        "jump: object turns by 180 degrees",
        replace(file, turn=Rotation.from_rotvec(half_turn) * file.turn),
    )
    first = int(moving[0])
    held = slice(first, first + max(2, round(0.6 * file.fps)))
    yield "frozen: hand", replace(file, points=with_rows(points, held, points[first]))
    still = np.broadcast_to(points[middle], points.shape)
    yield "frozen: hand all the time", replace(file, points=still)
    standing = np.broadcast_to(file.pos[0], file.pos.shape)
    first_turn = Rotation.from_quat(np.tile(file.turn[0].as_quat(), (len(pos), 1)))
    yield "frozen: object all the time", replace(file, pos=standing, turn=first_turn)
    yield "frozen: object", replace(file, pos=with_rows(file.pos, held, file.pos[first]))
    turns = with_rows(np.arange(len(pos)), held, first)
    yield "frozen: orientation of the object", replace(file, turn=file.turn[turns])
    rng = np.random.default_rng(1)
    noise = rng.normal(0.0, 0.01, pos.shape)
    yield "object: trembles by 1 cm", replace(file, pos=file.pos + noise)
    tremor = Rotation.from_rotvec(rng.normal(0.0, np.radians(8.0), pos.shape))
    yield "object: trembles by 8 degrees", replace(file, turn=tremor * file.turn)
    twice = np.repeat(np.arange(len(pos)), 2)
    yield "copies: every frame twice", file.of(twice, fps=2 * file.fps)
    held = np.arange(len(pos)) // 3 * 3
    yield "copies: hand at a third of the rate", replace(file, points=points[held])
    slow = replace(file, pos=file.pos[held], turn=file.turn[held])
    yield "copies: object at a third of the rate", slow
    unseen = with_rows(points, slice(first - 2, None), np.nan)
    yield "absent: hand while the object moves", replace(file, points=unseen)


def object_files(file, obj):
    """Yield name and file of errors of the object's poses."""
    for scale in (1e3, 1e2, 0.1, 1e-2, 1e-3):
        yield f"object: positions times {scale:g}", replace(file, pos=scale * file.pos)
    quats = file.turn.as_quat(scalar_first=True)
    yield "object: (x, y, z, w) named wxyz", replace(file, turn=turn_of(np.roll(quats, -1, axis=1)))
    yield "object: (w, x, y, z) named xyzw", replace(file, turn=turn_of(np.roll(quats, 1, axis=1)))
    inverse = file.turn.inv()
    yield "object: orientation inverted", replace(file, turn=inverse)
    yield "object: pose inverted", replace(file, pos=-inverse.apply(file.pos), turn=inverse)
    yield "object: never turns", replace(file, turn=Rotation.identity(len(quats)))
    size = np.ptp(obj.vertices, axis=0)
    for axis in range(3):
        for shift in (0.02, -0.02, 0.05, -0.05):
            offset = np.zeros(3)
            offset[axis] = shift
            yield (
                f"mesh: origin {100 * shift:g} cm along {'xyz'[axis]}",
                replace(file, pos=file.pos + file.turn.apply(offset)),
            )
    middle = (obj.vertices.min(axis=0) + obj.vertices.max(axis=0)) / 2
    bottom = middle - [0.0, 0.0, size[2] / 2]
    for name, origin in (("center", middle), ("bottom", bottom)):
        if np.linalg.norm(origin) > 0.02:
            yield (
                f"mesh: origin at its {name}",
                replace(file, pos=file.pos + file.turn.apply(origin)),
            )
    yield "mesh: upside down", replace(file, turn=file.turn * Rotation.from_euler("x", np.pi))
    yield "mesh: y up", replace(file, turn=file.turn * Rotation.from_euler("x", np.pi / 2))


def time_files(file):
    """Yield name and file of errors of times."""
    points = file.points
    frames = np.arange(len(points))
    for seconds in (0.1, -0.1, 0.2, -0.2, 0.5, 1.0):
        late = frames - round(seconds * file.fps)
        inside = (late >= 0) & (late < len(points))
        delayed = np.full_like(points, np.nan)
        delayed[inside] = points[late[inside]]
        yield f"time: hand {1e3 * seconds:g} ms late", replace(file, points=delayed)
    whole = file.of(slice(None, None, -1))
    yield "time: hand backwards", replace(file, points=whole.points)
    yield "time: object backwards", replace(whole, points=points)
    yield "time: all backwards", whole
    half = np.minimum(frames // 2, len(points) - 1)
    yield "time: hand at half speed", replace(file, points=points[half])
    for factor in (5.0, 0.2):
        yield f"time: rate times {factor:g}", replace(file, fps=factor * file.fps)
    away = np.linalg.norm(file.pos - file.pos[0], axis=1)
    lifted = int(np.argmax(away > 0.08))
    yield "time: begins in the air", file.of(slice(lifted, None))
    yield "time: ends before the lift", file.of(slice(int(np.argmax(away > 0.005))))


def wrong_files(demos, obj):
    """Yield name and file of every kind of error of the only sequence of demonstrations; names of right ones begin with
    ``right``."""
    file = file_of(demos)
    rng = np.random.default_rng(0)
    yield "right: table", file
    yield from camera_files(file)
    yield from table_files(file)
    yield from hand_files(file, rng)
    yield from tracking_files(file)
    yield from object_files(file, obj)
    yield from time_files(file)
