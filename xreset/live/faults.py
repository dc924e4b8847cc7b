"""Faults between a policy and a robot: late and wrong poses, late and lost targets, pushes.

Shape letters: N worlds, C control steps, J joints.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.env.manipulation import ManipulationEnv
from xreset.files.checks import Checked, NonNegativeFloat, Share, frozen
from xreset.geometry.shapes import turn_of
from xreset.live.engine import EngineDriver
from xreset.runtime import Reading

_NEVER = np.iinfo(np.int64).max
"""Physics step in which a target takes effect that is lost, or that has taken effect already."""


@frozen
class Faults(Checked):
    """Faults of one robot and its tracker; all are off by default.

    Errors of poses are uniform per axis, as in the published table A3 and in trainings
    (:class:`xreset.task.config.TrackerConfig`). Directions, gaps and pushes are drawn, so that the same episode has the
    same ones in every engine.
    """

    LOSS_PERIOD: ClassVar[float] = 2.0
    """The tracker loses the object once in each interval of this length [s]."""
    PUSH_PERIOD: ClassVar[float] = 1.5
    """There is one push in each interval of this length [s]."""

    tracker_interval: NonNegativeFloat = 0.0
    """Time from one pose to the next [s], rounded to control steps; 0: every control step."""
    pose_delay: NonNegativeFloat = 0.0
    """Time from the moment of a pose to its arrival [s]."""
    pose_jitter: NonNegativeFloat = 0.0
    """Largest difference of a pose's delay from ``pose_delay`` [s]. Poses may therefore overtake each other."""
    position_noise: NonNegativeFloat = 0.0
    """Largest error of each pose, along each axis [m]."""
    position_bias: NonNegativeFloat = 0.0
    """Largest error that lasts for the episode, along each axis [m]."""
    angle_noise: NonNegativeFloat = 0.0
    """Largest error of each pose about each axis [rad]."""
    angle_bias: NonNegativeFloat = 0.0
    """Largest error that lasts for the episode, about each axis [rad]."""
    lost_frames: NonNegativeFloat = 0.0
    """Time for which the tracker loses the object, once per ``LOSS_PERIOD`` [s]."""
    arm_delay: NonNegativeFloat = 0.0
    """Time from sending the arm's targets to their effect [s], rounded to physics steps."""
    hand_delay: NonNegativeFloat = 0.0
    """Time from sending the hand's targets to their effect [s], rounded to physics steps."""
    missed_deadlines: Share = 0.0
    """Share of the targets that come too late to be used, so that the drives keep the last ones."""
    object_push: NonNegativeFloat = 0.0
    """Change of the object's velocity by each push [m/s]: a force in a random direction for one control step."""
    arm_push: NonNegativeFloat = 0.0
    """Torque of each push on every joint of the arm for one control step, at most this share of the drive's limit."""
    drawn_delays: bool = False
    """Whether each episode draws each of its delays between 0 and the configured one."""


class FaultyDriver(EngineDriver):
    """Worlds of an environment with the same faults, each with draws of its own."""

    def __init__(
        self,
        env: ManipulationEnv,
        faults: Faults,
        seeds: Sequence[Sequence[int]],
        look: Callable[[], None] = lambda: None,
    ) -> None:
        """Wrap worlds that were just reset.

        Args:
            env: the worlds.
            faults: faults of all worlds.
            seeds: seed of each world's draws.
            look: called after every control step.
        """
        super().__init__(env, look)
        scene = env.backend.scene
        self._dt = scene.control_dt
        steps = env.max_episode_length + 1
        generators = [np.random.default_rng(list(seed)) for seed in seeds]

        def drawn(*shape: int) -> np.ndarray:
            """[N, ...] uniform numbers in [-1, 1), which do not depend on the faults."""
            return np.stack([generator.uniform(-1.0, 1.0, shape) for generator in generators])

        delay_share = (drawn(3, 1) + 1.0) / 2.0
        if not faults.drawn_delays:
            delay_share = np.ones_like(delay_share)
        pose_share, arm_share, hand_share = delay_share.swapaxes(0, 1)
        self._interval = max(1, round(faults.tracker_interval / self._dt))
        self._pose_delay = faults.pose_delay * pose_share + faults.pose_jitter * drawn(steps)
        """[N, C] s"""
        bias = np.repeat((faults.position_bias, faults.angle_bias), 3)
        noise = np.repeat((faults.position_noise, faults.angle_noise), 3)
        self._error = bias * drawn(1, 6) + noise * drawn(steps, 6)
        """[N, C, 6] position [m], then rotation vector [rad]."""
        gaps = int(steps * self._dt / Faults.LOSS_PERIOD) + 1
        self._lost = self._lost_steps(faults.lost_frames, drawn(gaps), steps)
        is_arm = env.actions.is_arm.cpu().numpy()
        delay = np.where(is_arm, faults.arm_delay * arm_share, faults.hand_delay * hand_share)
        self._delay = np.round(delay / scene.timestep).astype(np.int64)
        """[N, J] physics steps."""
        self._missed = (drawn(steps) + 1.0) / 2.0 < faults.missed_deadlines
        self._plan_pushes(faults, drawn, steps)
        self._frames: list[dict[str, np.ndarray]] = []
        """Poses that have not arrived in every world, with their time of arrival."""
        self._observed: dict[str, np.ndarray] = {}
        self._pending: list[tuple[np.ndarray, np.ndarray]] = []
        """Targets [N, J] that have not taken effect in every joint, each after the physics step [N, J] when it does."""
        self._applied = env.joint_target.cpu().numpy().copy()

    def _lost_steps(self, length: float, draws: np.ndarray, steps: int) -> np.ndarray:
        """[N, C] whether the pose of a step is lost.

        Args:
            length: length of a gap [s].
            draws: [N, gaps] place of each gap in its interval, in [-1, 1).
            steps: C.
        """
        period = Faults.LOSS_PERIOD
        latest = max(0.0, period - length)
        start = period * np.arange(draws.shape[1]) + (draws + 1.0) / 2.0 * latest
        time = np.arange(steps)[None, :, None] * self._dt
        inside = (time >= start[:, None]) & (time < start[:, None] + length)
        return inside.any(axis=2)

    def _plan_pushes(self, faults: Faults, drawn: Callable[..., np.ndarray], steps: int) -> None:
        """Set the changes of the object's velocity [N, C, 3] and the offsets of the targets [N, C, J]."""
        robot = self.env.backend.scene.robot
        count = int(steps * self._dt / Faults.PUSH_PERIOD) + 1
        moment = Faults.PUSH_PERIOD * (np.arange(count) + (drawn(count) + 1.0) / 2.0)
        step = np.round(moment / self._dt).astype(int)
        direction = drawn(count, 3)
        direction /= np.linalg.norm(direction, axis=2, keepdims=True)
        # The drive's own spring exerts the torque: its target is moved.
        reach = [j.drive.effort / j.drive.kp if j.group == "arm" else 0.0 for j in robot.joints]
        offset = drawn(count, len(reach)) * np.array(reach)
        self._velocity = np.zeros((len(step), steps, 3))
        self._offset = np.zeros((len(step), steps, len(reach)))
        world, event = np.nonzero(step < steps)
        at = step[world, event]
        self._velocity[world, at] = faults.object_push * direction[world, event]
        self._offset[world, at] = faults.arm_push * offset[world, event]

    @property
    def _step(self) -> int:
        return min(self._substeps // self.env.backend.scene.substeps, self._error.shape[1] - 1)

    def read(self) -> Reading:
        """Return joints as they are, and the pose that has arrived last."""
        reading = super().read()
        k = self._step
        now = self.now()
        has_pose = (k % self._interval == 0) & ~self._lost[:, k]
        arrival = np.where(has_pose, now + self._pose_delay[:, k], np.inf)
        if k == 0:  # the tracker has watched the object before
            arrival = np.zeros_like(arrival)
        self._frames.append({"arrival": arrival, **self._with_errors(reading, k)})
        for frame in self._frames:
            arrived = frame["arrival"] <= now + 1e-9
            for name in ("object_pos", "object_quat", "object_time"):
                old = self._observed.get(name, frame[name])
                rows = arrived.reshape(-1, *[1] * (old.ndim - 1))
                self._observed[name] = np.where(rows, frame[name], old)
            frame["arrival"][arrived] = np.inf
        self._frames = [frame for frame in self._frames if np.isfinite(frame["arrival"]).any()]
        return replace(reading, **self._observed)

    def _with_errors(self, reading: Reading, k: int) -> dict[str, np.ndarray]:
        """Return the pose that the tracker measures in step k. Without an error it is exactly the true one."""
        error = self._error[:, k]
        has_error = error.any(axis=1)[:, None]
        pos = (reading.object_pos + error[:, :3]).astype(np.float32)
        turned = Rotation.from_rotvec(error[:, 3:]) * turn_of(reading.object_quat)
        quat = turned.as_quat(scalar_first=True).astype(np.float32)
        return {
            "object_pos": np.where(has_error, pos, reading.object_pos),
            "object_quat": np.where(has_error, quat, reading.object_quat),
            "object_time": np.asarray(reading.object_time),
        }

    def send(self, target: np.ndarray) -> None:
        """Send targets [N, J], which take effect later, or never."""
        due = self._substeps + self._delay
        due[self._missed[:, self._step]] = _NEVER
        self._pending.append((due, target))

    def _advance(self, substeps: int) -> None:
        """Advance within one control step, and stop in between to apply the targets that become due."""
        backend = self.env.backend
        k = self._step
        if self._velocity.any():
            mass = self.env.variation.parameters["object_mass"][:, None]
            velocity = torch.as_tensor(
                self._velocity[:, k], dtype=torch.float32, device=backend.device
            )
            backend.set_object_wrench(mass * velocity / self._dt, torch.zeros_like(velocity))
        now = self._substeps
        end = now + substeps
        while now < end:
            next_due = end
            for due, target in self._pending:
                is_due = due <= now
                self._applied = np.where(is_due, target, self._applied)
                due[is_due] = _NEVER
                next_due = min(next_due, int(due.min()))
            pushed = (self._applied + self._offset[:, k]).astype(np.float32)
            self._target = torch.as_tensor(pushed, device=backend.device)
            super()._advance(next_due - now)
            now = next_due
        self._pending = [(due, target) for due, target in self._pending if (due < _NEVER).any()]
