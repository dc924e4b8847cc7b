"""The interface of a robot: readings and joint targets.

Shape letters: N robots that act in step (one, except in rehearsals), J joints, E fingertips. Units are SI and radians,
quaternions (w, x, y, z), the frame is the world's: z up, the table's top at z = 0, the robot's base as the contract
says.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

Array = np.ndarray


@dataclass(frozen=True, kw_only=True)
class Reading:
    """The newest data of a robot and of an object tracker. A driver of one robot leaves out the axis N.

    Attributes:
        joint_pos: [N, J] in the order of the contract's joints.
        joint_vel: [N, J]; None: only for policies whose graph has no input of that name.
        joint_time: [N] when the joints were measured, on the driver's clock [s].
        object_pos: [N, 3] origin of the object's mesh frame.
        object_quat: [N, 4] (w, x, y, z)
        object_time: [N] when the image was taken, not when the pose arrived, on the driver's clock [s].
        tip_force: [N, E, 3] force of each fingertip on the object, world frame [N]; None: the robot does not measure
            it.
    """

    joint_pos: Array
    joint_vel: Array | None = None
    joint_time: float | Array
    object_pos: Array
    object_quat: Array
    object_time: float | Array
    tip_force: Array | None = None

    def batched(self) -> Reading:
        """Return a copy with the axis N, in float32 (times: float64). Drivers may go on to use their own arrays.

        Raises:
            ValueError: data that no robot may leave out are None.
        """
        has_axis = np.ndim(self.joint_pos) == 2
        rows = {}
        for name, value in vars(self).items():
            if value is None and name not in ("joint_vel", "tip_force"):
                raise ValueError(
                    f"{name} is None. Without a new value, give the last one and its time"
                )
            if value is not None:
                dtype = np.float64 if name.endswith("_time") else np.float32
                row = np.array(value, dtype=dtype)
                rows[name] = row if has_axis else row[None]
        return Reading(**rows)


class Driver(ABC):
    """A robot and an object tracker. No method may block for longer than a small part of a control step."""

    @abstractmethod
    def read(self) -> Reading:
        """Return the newest data, however old they are."""

    @abstractmethod
    def send(self, target: Array) -> None:
        """Send joint targets [J]; [N, J] if the readings have the axis N."""

    @abstractmethod
    def stop(self) -> None:
        """Hold still. The runner calls it once, after it has slowed down, and also when a method has failed."""

    def now(self) -> float:
        """Return the time on the clock of the readings [s]. Override it together with :meth:`wait_until`."""
        return time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Wait until that time on the clock of :meth:`now` [s]."""
        time.sleep(max(0.0, moment - self.now()))
