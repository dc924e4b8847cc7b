"""Joint torques for Bullet: what :mod:`xreset.backends.pybullet` drives robots with."""

from __future__ import annotations

from typing import Any

import numpy as np

from xreset.backends.rigid import Mechanism, MovingJoints

_MASS_MATRIX_STEPS = 8
"""Bullet steps between two updates of the mass matrix."""


class BulletDrives:
    """Joint torques: PD drives with effort limits, armature, dry friction and mimic couplings.

    Arrays are over the D moving joints in the order of the bodies, which is Bullet's link order. With M the mass matrix
    and c the Coriolis torque, drives that have armature A and are implicit in their damping give the acceleration
    a = (M + B)^-1 (tau - c), where tau is the PD torque and B = diag(A + dt kd). Bullet integrates a = M^-1 (tau' - c),
    so it does the same when given tau' = tau - B a. Mimic joints are coupled by a stiff spring and damper, which add
    J^T (dt^2 k + dt b) J to B; a drive's torque, and its dt kd, are shared with those that follow its joint.

    In contact that alone is wrong: a held joint does not move with a, and would lack the torque B a. So this step is
    assumed to have the torque r that contacts and limits gave in the last step, r = M dv / dt - (tau' - c):
    a = (M + B)^-1 (tau - c + r). A held joint then gets the whole of tau, and an impact delivers the momentum of M + B,
    both after about 1 + B / M steps. That is one or two for ordinary drives; it is far too many where B dwarfs M, as
    with armature on the light links of a hand.
    """

    def __init__(self, client: Any, body: int, robot: Mechanism, dt: float) -> None:
        self._p = client
        self._body = body
        self._dt = dt
        spec = robot.robot
        count = len(robot.joint_names)
        self._links = list(range(1, count + 1))  # link 0 is the base
        self._joints = joints = MovingJoints(spec, robot.joint_names)
        self.driven = joints.driven
        """[J] position of each actuated joint among the moving ones."""
        self.scale(np.ones_like(joints.nominal))
        self.reset(spec.home, np.zeros_like(spec.home), spec.home)

        self._M = M = self._mass_matrix(spec.home)
        self._added = np.zeros_like(M)
        self._inverse = np.zeros_like(M)
        self._saturated = np.zeros(0, dtype=bool)
        rows = np.arange(len(joints.mimic))
        self._J = np.zeros((len(rows), count))
        """Rate of each mimic joint's lag behind its source, by joint."""
        self._J[rows, joints.mimic] = -1.0
        self._J[rows, self.driven[joints.source]] = joints.multiplier
        inertia = 1.0 / np.diag(np.linalg.inv(M))[joints.mimic]
        self._stiffness = inertia / dt**2  # critically damped, as stiff as one step can feel
        self._damping = 2.0 * inertia / dt
        self._coupling = self._J.T @ (
            (dt**2 * self._stiffness + dt * self._damping)[:, None] * self._J
        )

        # Bullet's joints start with a motor that brakes them.
        client.setJointMotorControlArray(
            body, self._links, client.VELOCITY_CONTROL, forces=np.zeros(count)
        )

    def reset(self, position: np.ndarray, velocity: np.ndarray, target: np.ndarray) -> None:
        """Set positions, velocities and targets [J] of the actuated joints; mimic joints follow."""
        q, v = self._joints.spread(position, velocity)
        self._p.resetJointStatesMultiDof(
            self._body, self._links, q[:, None].tolist(), v[:, None].tolist()
        )
        self.target = target
        """[J] drive targets."""
        self._mass_matrix_age = 0
        self._last_step: tuple[np.ndarray, np.ndarray] | None = None

    def scale(self, factors: np.ndarray) -> None:
        """Set factors [3, J] on stiffness, damping and effort limit."""
        self._kp, self._kd, self._effort = factors * self._joints.nominal
        self._mass_matrix_age = 0  # the implicit damping has to be factorised again

    def read(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities [D] of all moving joints."""
        states = self._p.getJointStates(self._body, self._links)
        return np.array([state[0] for state in states]), np.array([state[1] for state in states])

    def apply(self) -> None:
        """Apply the torques of one Bullet step."""
        q, v = self.read()
        joints = self._joints
        dt = self._dt
        wanted = self._kp * (self.target - q[self.driven]) - self._kd * v[self.driven]
        # np.clip takes three times as long
        given = np.minimum(np.maximum(wanted, -self._effort), self._effort)
        tau = given @ joints.shares
        if len(joints.mimic):
            lag = (
                joints.multiplier * q[self.driven[joints.source]] + joints.offset - q[joints.mimic]
            )
            rate = self._J @ v
            tau -= self._J.T @ (self._stiffness * (lag + dt * rate) + self._damping * rate)
        bias = np.array(
            self._p.calculateInverseDynamics(self._body, q.tolist(), v.tolist(), [0.0] * len(q))
        )
        net = tau - bias
        if self._last_step is not None:
            last_velocity, last_net = self._last_step
            net += self._M @ (v - last_velocity) / dt - last_net
        saturated = np.abs(wanted) > self._effort
        if self._mass_matrix_age == 0 or saturated.tobytes() != self._saturated.tobytes():
            self._factorise(q, saturated)
        self._mass_matrix_age = (self._mass_matrix_age + 1) % _MASS_MATRIX_STEPS
        if joints.has_dry_friction:
            stopping = (
                -(v / dt + self._inverse @ net)[self.driven] / np.diag(self._inverse)[self.driven]
            )
            brake = np.clip(stopping, -joints.friction_loss, joints.friction_loss)
            tau[self.driven] += brake
            net[self.driven] += brake
        tau -= self._added @ (self._inverse @ net)
        self._last_step = (v, tau - bias)
        self._p.setJointMotorControlArray(
            self._body, self._links, self._p.TORQUE_CONTROL, forces=tau.tolist()
        )

    def _mass_matrix(self, q: np.ndarray) -> np.ndarray:
        return np.array(self._p.calculateMassMatrix(self._body, q.tolist()))

    def _factorise(self, q: np.ndarray, saturated: np.ndarray) -> None:
        """Invert M + B; a drive at its effort limit has no damping left to be implicit in."""
        shares = self._joints.shares
        armature = np.zeros(len(q))
        armature[self.driven] = self._joints.armature
        damping = np.where(saturated, 0.0, self._dt * self._kd)
        self._added = self._coupling + np.diag(armature) + shares.T @ (damping[:, None] * shares)
        self._M = self._mass_matrix(q)
        self._inverse = np.linalg.inv(self._M + self._added)
        self._saturated = saturated
