"""Depth cameras of a task. The numbers of an ideal camera are 0; the defaults are those of a stereo camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field
from typing import Annotated

from xreset.errors import WrongValueError, XResetError
from xreset.files.checks import (
    Checked,
    NonNegativeFloat,
    PositiveFloat,
    PositiveInt,
    Rule,
    Share,
    first_repeated,
    frozen,
)
from xreset.files.text import shown

Point = Annotated[
    tuple[float, float, float],
    Rule("three finite numbers", lambda p: all(map(math.isfinite, p))),
]
Pixels = Annotated[int, Rule("a number from 8 to 1024", lambda n: 8 <= n <= 1024)]


@frozen
class DepthNoise(Checked):
    """Errors of depth images.

    A stereo camera measures the inverse of the depth, so that its errors grow with the square of the depth (Khoshelham
    and Elberink 2012, Accuracy and Resolution of Kinect Depth Data).
    """

    spread: NonNegativeFloat = 0.002
    """Standard deviation of the depth at 1 m [m]."""
    step: NonNegativeFloat = 0.002
    """Distance between two depths that the camera can tell apart at 1 m [m]."""
    holes: Share = 0.01
    """Share of the pixels that see nothing."""
    edges: Share = 0.2
    """Share of the pixels next to an edge that see nothing."""
    edge: PositiveFloat = 0.03
    """Step in depth that counts as an edge [m]. A plane has none, however steeply the camera sees it."""


@frozen
class CameraConfig(Checked):
    """A depth camera, fixed in the world or on a link of the robot."""

    link: str | None = None
    """Link of the URDF that carries the camera; ``palm`` is the robot's palm; None: the camera is fixed in the
    world."""
    pos: Point = (1.20, 0.22, 0.55)
    """Position of the camera in the frame of the link or of the world [m]."""
    target: Point = (0.53, 0.22, 0.21)
    """Point in the middle of the picture, in the same frame [m]. The frame's z axis is up in the picture."""
    fov: Annotated[float, Rule("an angle between 0.05 and 3 rad", lambda x: 0.05 <= x <= 3.0)] = (
        math.radians(52.0)
    )
    """Vertical field of view [rad]."""
    near: NonNegativeFloat = 0.1
    """Least depth that the camera measures [m]."""
    far: PositiveFloat = 2.0
    """Largest depth that the camera measures [m]."""
    noise: DepthNoise = field(default_factory=DepthNoise)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.near < self.far:
            raise WrongValueError(
                f"near is {self.near}, expected less than far, which is {self.far}"
            )
        if math.dist(self.pos, self.target) < 1e-3:
            raise WrongValueError(f"target is {self.target}, expected another point than pos")


@frozen
class VisionConfig(Checked):
    """What a policy sees of the object: points of depth images in the world, without those of the table and the robot,
    whose geometry is known. Without cameras it is told pose and shape."""

    cameras: tuple[CameraConfig, ...] = ()
    width: Pixels = 64
    """Pixels of an image, the same for all cameras."""
    height: Pixels = 64
    interval: PositiveInt = 2
    """Control steps from one image to the next: 2 is 30 Hz where control runs at 60 Hz."""
    latency: NonNegativeFloat = 0.0
    """Age of an image when the policy gets it [control steps], rounded to whole steps."""
    points: PositiveInt = 128
    """Points of the object that the policy sees, drawn at random from the pixels; and as many of the object at its
    goal, as the same cameras would see it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        pixels = len(self.cameras) * self.width * self.height
        if 0 < pixels < self.points:
            raise WrongValueError(
                f"points is {self.points}, expected at most {pixels}, one for each pixel"
            )

    @property
    def view_shape(self) -> tuple[int, int, int]:
        """Shape of one world's view: the object and its goal; points; coordinates and 1 (0: no point)."""
        return 2, self.points, 4


FRONT = CameraConfig()
"""A camera in front of the table, opposite the robot."""
SIDE = CameraConfig(pos=(0.55, -0.45, 0.55), target=(0.55, 0.22, 0.18))
WRIST = CameraConfig(
    link="palm", pos=(-0.10, 0.0, 0.06), target=(0.10, 0.0, 0.10), near=0.03, far=1.0, fov=1.4
)
"""A camera behind the palm that looks along the fingers."""
CAMERAS = {"front": FRONT, "side": SIDE, "wrist": WRIST}
"""Name -> camera."""


def camera_of(camera: str | CameraConfig) -> CameraConfig:
    """Return a camera, or the one of a name; ``XResetError`` if it is unknown."""
    if isinstance(camera, CameraConfig):
        return camera
    if camera not in CAMERAS:
        raise XResetError(f"Unknown camera {shown(camera)}. Choose from: {', '.join(CAMERAS)}.")
    return CAMERAS[camera]


def check_each_once(cameras: Sequence[CameraConfig]) -> None:
    """Refuse a camera that is given twice: its second image says what the first one does."""
    if (i := first_repeated(cameras)) is not None:
        camera = cameras[i]
        names = [name for name, known in CAMERAS.items() if known == camera]
        which = f"The camera {names[0]!r}" if names else f"The camera at {camera.pos}"
        raise XResetError(f"{which} is given twice. Give each camera once (--camera).")
