"""The loop around a driver: it keeps the policy's rate, and stops the robot softly."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from .contract import LiveError
from .controller import REACH, Controller, is_unit
from .driver import Array, Driver, Reading


@dataclass(frozen=True, kw_only=True)
class Limits:
    """When a runner stops a robot. None of these numbers was tried on hardware.

    Attributes:
        pose_age: oldest pose of the object that the policy may act on [s].
        joint_age: oldest joint positions that the policy may act on [s].
        joint_margin: how far a joint may be beyond its limit [rad, m].
        joint_speed: largest speed of a joint, as a share of the speed limit in its URDF.
        target_speed: largest speed of a target, as a share of the same limit. Faster targets do not stop the robot:
            they are slowed down, and the policy continues from the slower ones.
        workspace: lowest and highest corner [m] of the box that palm and fingertips must not leave, world frame; None:
            no box.
        late: how late a control step may end [s].
        slow_down: time in which targets come to rest [s]; 0: at once.
        hold: time for which resting targets are still sent before the driver's ``stop`` is called [s], for robots that
            fall back to their own watchdog without new targets.
    """

    pose_age: float = 1.0
    joint_age: float = 0.1
    joint_margin: float = 0.1
    joint_speed: float = 2.0
    target_speed: float = float("inf")
    workspace: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    late: float = 0.5
    slow_down: float = 0.25
    hold: float = 0.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.name != "workspace" and not value >= 0:
                raise LiveError(f"{entry.name} is {value}, expected 0 or more.")
            # a joint without a speed limit has the limit infinity, and no share of it
            if entry.name in ("joint_speed", "target_speed") and value == 0:
                raise LiveError(f"{entry.name} is 0, expected a share above 0.")
        if self.slow_down == np.inf:
            raise LiveError("slow_down is inf, expected a finite time [s].")
        box = self.workspace
        if box is not None and (np.shape(box) != (2, 3) or not np.less(*box).all()):
            raise LiveError(
                f"workspace is {self.workspace}, expected the lowest and the highest corner of a box [m]."
            )


@dataclass(kw_only=True)
class Outcome:
    """What became of a run.

    Attributes:
        reasons: [N] why each robot was stopped; None: the time was over.
        steps: control steps that the policy took.
        missed: control steps that began late because the step before took too long.
        refused: [N] poses that were not used: not finite, far away, or with a time stamp that ran backwards.
    """

    reasons: list[str | None]
    steps: int = 0
    missed: int = 0
    refused: Array = field(default_factory=lambda: np.zeros(0, dtype=int))

    @property
    def reason(self) -> str | None:
        """Why the first robot was stopped."""
        return self.reasons[0]


_NO_NEWER = "no newer one has come"
_CLOCKS_DIFFER = 0.1
"""How far a time stamp, or the next control step, may be ahead of the driver's clock [s]."""


class Runner:
    """Keeps a policy's rate on a driver, and stops softly when it cannot go on.

    A pose that is late is used until it is ``pose_age`` old. Nothing is sent before the first usable data. Data that
    are not finite, older than the last ones, or ahead of the clock are ignored. After a fault the targets slow
    down within ``slow_down``, and then stay.
    """

    def __init__(
        self, controller: Controller, driver: Driver, limits: Limits | None = None
    ) -> None:
        """Prepare a run.

        Args:
            controller: what acts; its episode has begun.
            driver: where it acts.
            limits: when to stop; None: the defaults.

        Raises:
            LiveError: there is a workspace, and the policy's graph does not say where palm and fingertips are.
        """
        if (
            limits is not None
            and limits.workspace is not None
            and "links" not in controller.outputs
        ):
            raise LiveError(
                "The policy's graph has no output 'links', which a workspace needs. Leave out Limits.workspace."
            )
        self.controller = controller
        self.driver = driver
        self.limits = limits or Limits()

    def _prepare(self) -> None:
        """Begin now, and forget an earlier run: its data are old, and the controller may have begun another episode."""
        count = len(self.controller.target)
        self.outcome = Outcome(reasons=[None] * count, refused=np.zeros(count, dtype=int))
        self._stopped_at = np.full(count, np.inf)
        self._reading: Reading | None = None
        self._one_robot = False  # whether the driver's arrays have no axis N
        self._refusals = np.full(count, _NO_NEWER, dtype=object)
        """[N] why no newer pose is used."""
        self._sent = self.controller.target
        self._move = np.zeros_like(self._sent)
        self._begun = self.driver.now()

    def run(self, seconds: float = float("inf")) -> Outcome:
        """Run until the time is over, until every robot has stopped, or until Ctrl-C; then stop the driver.

        After a fault and after Ctrl-C the targets slow down first.
        """
        self._prepare()
        try:
            self._loop(self._begun + seconds - self.controller.dt / 2)
        except KeyboardInterrupt:
            self._interrupted()
        finally:
            self.driver.stop()
        return self.outcome

    def _interrupted(self) -> None:
        self._stop_all("Ctrl-C was pressed.")
        self._loop(float("inf"))

    @property
    def _running(self) -> Array:
        """[N] bool: robots that have not been stopped."""
        return np.isinf(self._stopped_at)

    def _loop(self, end: float) -> None:
        """Take control steps until a time [s], or until all robots have stopped and slowed down."""
        due = self.driver.now()
        rest = self.limits.slow_down + self.limits.hold
        while self.driver.now() < min(end, self._stopped_at.max() + rest):
            if not self._tick():
                return
            due += self.controller.dt
            late = self.driver.now() - due
            if late > 0:
                self.outcome.missed += 1
                due += late  # skipped steps are not made up for
            if late > self.limits.late:
                self._stop_all(f"A control step took {late:.2f} s too long.")
            self.driver.wait_until(due)
            early = due - self.driver.now()
            if early > _CLOCKS_DIFFER:  # further steps would move the robot too fast
                self._stop_all(
                    f"The driver waits {early:.2f} s too little, so the policy runs too fast. Override now() and "
                    "wait_until() together."
                )
                return

    def _tick(self) -> bool:
        """Read, act and send once; return whether the driver still takes targets."""
        now = self.driver.now()
        target = self._sent
        if self._running.any():
            target = self._act(now)
        running = self._running[:, None]
        self._move = np.where(running, target - self._sent, self._move)
        self._sent = np.where(running, target, self._slowed(now))
        if not self.outcome.steps:
            return True  # the targets of begin may be far from where the robot is
        sent = self._sent.copy()
        try:
            self.driver.send(sent[0] if self._one_robot else sent)
        except Exception as error:
            self._stop_all(f"The driver could not send targets: {_sentence(error)}")
            return False
        return True

    def _slowed(self, now: float) -> Array:
        """[N, J] targets of robots that come to rest: the last move, shrinking to 0 within ``slow_down``.

        Joints with absolute targets stay: their targets jump, and ``step_size`` is 0.
        """
        slow_down = self.limits.slow_down
        left = slow_down - np.maximum(now - self._stopped_at, 0.0)
        share = np.clip(left / max(slow_down, 1e-6), 0.0, 1.0)[:, None]
        step = self.controller.step_size
        slowed = self._sent + (share * np.clip(self._move, -step, step)).astype(np.float32)
        return np.clip(slowed, self.controller.lower, self.controller.upper)

    def _act(self, now: float) -> Array:
        """[N, J] targets of the policy, or the last ones for robots for which it cannot act."""
        try:
            newest = self.driver.read()
            self._one_robot = np.ndim(newest.joint_pos) == 1
            newest = newest.batched()
            self._check_shapes(newest)
            reading = self._merged(newest, now)
            self._reading = reading
        except Exception as error:
            self._stop_all(f"The driver could not read: {_sentence(error)}")
            return self._sent
        self._check(reading, now)
        running = self._running
        is_new = np.asarray(now - reading.object_time <= self.limits.pose_age)
        is_new &= now - reading.joint_time <= self.limits.joint_age
        # the time is -inf until the first sound reading, and the ages may be unlimited
        is_new &= np.isfinite(reading.object_time + reading.joint_time)
        if not running.any() or not is_new[running].all():
            return self._sent
        try:
            target = self.controller.step(reading)
        except Exception as error:
            self._stop_all(f"The policy could not act: {_sentence(error)}")
            return self._sent
        self.outcome.steps += 1
        sound = np.isfinite(target).all(axis=1)
        for robot in np.flatnonzero(running & ~sound):
            self._stop(int(robot), "The policy gave numbers that are not finite.")
        self._check_workspace()
        farthest = self.limits.target_speed * self.controller.speed * self.controller.dt
        target = np.clip(target, self._sent - farthest, self._sent + farthest)
        self.controller.target = target
        return np.where(sound[:, None], target, self._sent)

    def _check_workspace(self) -> None:
        """Stop the robots whose palm or fingertips have left the workspace."""
        box = self.limits.workspace
        links = self.controller.links
        if box is None or links is None:
            return
        outside = ((links < box[0]) | (links > box[1])).any(axis=2)
        for robot, link in np.argwhere(outside):
            name = self.controller.contract["links"][link]
            place = ", ".join(f"{value:.2f}" for value in links[robot, link])
            self._stop(int(robot), f"Link {name} is at ({place}), outside the workspace.")

    def _check_shapes(self, reading: Reading) -> None:
        """Raise ``LiveError`` if a reading has not as many numbers as the robot."""
        robots, joints = self._sent.shape
        one: dict[str, tuple[int, ...]] = {"joint_pos": (joints,), "joint_vel": (joints,)}
        one |= {"object_pos": (3,), "object_quat": (4,), "joint_time": (), "object_time": ()}
        for name, shape in one.items():
            value = getattr(reading, name)
            if value is not None and value.shape != (robots, *shape):
                raise LiveError(f"{name} has shape {value.shape}, expected {(robots, *shape)}.")

    def _merged(self, new: Reading, now: float) -> Reading:
        """Return a reading with the last sound values in place of its faulty ones."""
        joints_sound = _finite(new.joint_pos)
        if new.joint_vel is not None:
            joints_sound &= _finite(new.joint_vel)
        if new.tip_force is not None:
            joints_sound &= _finite(new.tip_force.reshape(len(joints_sound), -1))
        pose_sound = (np.abs(new.object_pos) <= REACH).all(axis=1) & is_unit(new.object_quat)
        old = self._reading
        if old is None:
            nothing = np.full(len(joints_sound), -np.inf)
            old = replace(new, joint_time=nothing, object_time=nothing)
        latest = now + _CLOCKS_DIFFER
        joints_sound &= (new.joint_time >= old.joint_time) & (new.joint_time <= latest)
        not_ahead = new.object_time <= latest
        in_order = new.object_time >= old.object_time
        self._refusals[~not_ahead] = "newer ones have time stamps ahead of the robot's clock"
        self._refusals[~in_order] = "the time stamps of newer ones run backwards"
        self._refusals[~pose_sound] = (
            f"newer ones hold numbers that are not finite, more than {REACH:g} m, or no unit quaternion"
        )
        usable = not_ahead & in_order & pose_sound
        self.outcome.refused += ~usable
        self._refusals[usable & (new.object_time > old.object_time)] = _NO_NEWER
        kept = {}
        for name in vars(new):
            chosen = usable if name.startswith("object") else joints_sound
            kept[name] = _rows(chosen, getattr(new, name), getattr(old, name))
        return Reading(**kept)

    def _check(self, reading: Reading, now: float) -> None:
        """Stop the robots whose data are too old, or whose joints are beyond a limit."""
        limits = self.limits
        lower = self.controller.lower
        upper = self.controller.upper
        age = now - np.maximum(reading.object_time, self._begun)
        for robot in np.flatnonzero(age > limits.pose_age):
            refusal = self._refusals[robot]
            self._stop(int(robot), f"The pose of the object is {age[robot]:.2f} s old: {refusal}.")
        age = now - np.maximum(reading.joint_time, self._begun)
        for robot in np.flatnonzero(age > limits.joint_age):
            self._stop(
                int(robot),
                f"The joint positions are {age[robot]:.2f} s old: newer ones have not come, are not finite, or have "
                "wrong time stamps.",
            )
        below = reading.joint_pos < lower - limits.joint_margin
        above = reading.joint_pos > upper + limits.joint_margin
        for robot, joint in np.argwhere(below | above):
            bound = lower[joint] if below[robot, joint] else upper[joint]
            name = self.controller.contract["joints"][joint]["name"]
            found = reading.joint_pos[robot, joint]
            self._stop(int(robot), f"Joint {name} is at {found:.2f}, beyond its limit {bound:.2f}.")
        if reading.joint_vel is not None:
            self._check_speed(reading.joint_vel)

    def _check_speed(self, joint_vel: Array) -> None:
        """Stop the robots with a joint that is too fast, given the joints' velocities [N, J]."""
        fastest = self.limits.joint_speed * self.controller.speed
        for robot, joint in np.argwhere(np.abs(joint_vel) > fastest):
            name = self.controller.contract["joints"][joint]["name"]
            found = abs(joint_vel[robot, joint])
            self._stop(
                int(robot),
                f"Joint {name} moves at {found:.2f}, faster than its limit {fastest[joint]:.2f}.",
            )

    def _stop_all(self, reason: str) -> None:
        for robot in range(len(self._stopped_at)):
            self._stop(robot, reason)

    def _stop(self, robot: int, reason: str) -> None:
        """Let a robot slow down, unless it does so already."""
        if np.isinf(self._stopped_at[robot]):
            self._stopped_at[robot] = self.driver.now()
            self.outcome.reasons[robot] = reason
            if len(self._stopped_at) == 1:
                logging.getLogger("xreset").warning("The robot stops. %s", reason)


def _sentence(error: Exception) -> str:
    return f"{str(error).rstrip('.')}."


def _finite(values: Array) -> Array:
    return np.asarray(np.isfinite(values).all(axis=1))


def _rows(chosen: Array, new: Any, old: Any) -> Any:
    """Return the chosen rows [N] of new values, and the other rows of old ones; zeros where there are none."""
    if new is None or chosen.all():
        return new
    if old is None:
        old = np.zeros_like(new)
    return np.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old)
