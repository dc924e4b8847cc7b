"""A live episode: one robot, one object and one goal that a user moves while the policy acts.

Shape letters: J joints, E fingertips, D numbers that the policy observes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from xreset.demos.synth import synthesize
from xreset.env.manipulation import ManipulationEnv
from xreset.errors import XResetError
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.files.checks import frozen
from xreset.geometry.dynamics import drive_values
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import quat_angle, quat_rotate, quat_rotate_inverse
from xreset.live.engine import GraphPolicy
from xreset.objects.catalogue import ALIASES, canonical_name, object_names
from xreset.objects.rest import rest_height
from xreset.physics import State
from xreset.policy.onnx_policy import Policy
from xreset.resets.inputs import Inputs, load_inputs
from xreset.spec import GRAVITY
from xreset.task.observations import layout
from xreset.task.terminations import out_of_bounds

KEPT_SECONDS = 60.0
"""How much of the past a session keeps, for curves, films and traces [s]."""
STARTS = 8
"""Synthetic demonstrations that starts and goals are drawn from."""
GOAL_HEIGHT = 0.6
"""Highest goal above the table [m]."""
PULL_RATE = 10.0
"""Natural frequency of a pull at the object, critically damped [rad/s]; its stiffness is the mass times its square."""
ROBOT_STIFFNESS = 500.0
"""Force of a pull at the robot for each metre [N/m]."""
ROBOT_FORCE = 150.0
"""Largest force of a pull at the robot [N]."""
PULL_LENGTH = 0.4
"""Distance from which a pull at the object does not become stronger [m]."""
AWAY = (0.57, 3.0, 0.5)
"""Where an object is that was taken away: out of everybody's reach [m]."""
DROPPED_SECONDS = 3.0
"""An object that no finger touches for so long, far from its goal, counts as dropped [s]."""
DROPPED_DISTANCE = 0.05
"""[m]"""


@frozen
class Moment:
    """What happened in one control step. Poses in the world frame, quaternions (w, x, y, z)."""

    time: float
    """Seconds since the session's begin."""
    engine: str
    joint_pos: np.ndarray
    """[J] rad (m)"""
    joint_vel: np.ndarray
    joint_target: np.ndarray
    """[J] targets of the drives."""
    object_pos: np.ndarray
    object_quat: np.ndarray
    goal_pos: np.ndarray
    goal_quat: np.ndarray
    tip_force: np.ndarray
    """[E, 3] force of each fingertip on the object [N]."""
    action: np.ndarray
    """[J] in [-1, 1]."""
    inputs: np.ndarray
    """[D] what the policy observed before it acted, without the point cloud: see :attr:`Session.inputs`."""
    reward: np.ndarray
    """Weighted terms, in the order of :attr:`Session.terms`."""
    distance: float
    """From the object to its goal [m]."""
    angle: float
    """From the object's orientation to the goal's [rad]."""
    success: bool
    """Whether the object is held at its goal."""


@dataclass(kw_only=True)
class _Pull:
    """A spring from a point of the object or of the robot to the user's pointer."""

    link: str | None
    """Link of the robot; None: the object."""
    point: Tensor
    """[3] in the frame of the link or object."""
    to: Tensor
    """[3] world."""


class Session:
    """A live episode. Nothing ends it: the time limit and the bounds of the training do not hold.

    A session belongs to one thread. Its engine runs on the CPU.

    Attributes:
        policy: the policy that acts.
        engine: name of the engine.
        env: one world, which has the policy's own task.
        time: seconds since the session's begin.
        history: the last :data:`KEPT_SECONDS` of this object and robot, oldest first.
        away: whether the object is taken away.
        inputs: name of each part of what the policy observes, and its place in :attr:`Moment.inputs`.
        terms: names of the reward's terms; empty before the first step.
        objects: names of the objects to choose from.
    """

    def __init__(
        self,
        policy: str | Path | PolicySpec = "many-objects",
        *,
        object_name: str | None = None,
        engine: str = "mujoco",
        robot: str | Path | None = None,
        demos: Path | None = None,
        meshes: Path | None = None,
        seed: int = 0,
    ) -> None:
        """Load what is to be played.

        Args:
            policy: as for :func:`~xreset.eval.policy_spec.load_policy`.
            object_name: name of the object; None: the soup can, or else the first object.
            engine: name of the engine.
            robot: default: the policy's.
            demos: starts and goals, from any file of demonstrations, motion or reset states; None: synthetic ones.
            meshes: folder of object meshes; None: the folder of the policy's training, or the stand-ins.
            seed: chooses starts and goals.

        Raises:
            XResetError: the policy, the object, the robot or the engine cannot be used.
        """
        self._demos = demos
        self._folder = meshes
        self._seed = seed
        self.engine = engine
        self.time = 0.0
        self._open(policy, robot, object_name)

    # Choosing ---------------------------------------------------------------------------------------------------------

    def choose_policy(
        self, policy: str | Path | PolicySpec, *, robot: str | Path | None = None
    ) -> None:
        """Let another policy act, and begin again. Arguments and errors as for the constructor's."""
        self._open(policy, robot, self.object_name)

    def choose_object(self, name: str) -> None:
        """Play with another object, and begin again; ``XResetError`` if it is unknown."""
        self._open(self.policy, None, name)

    def choose_engine(self, name: str) -> None:
        """Go on in another engine at the same state, with the same memory of the policy.

        Raises:
            XResetError: the engine cannot be used; the session goes on in the present one.
        """
        env = self._make_env(self.policy, self._inputs, name)
        env.restore(self.env.snapshot())
        self.env.close()
        self.env = env
        self.engine = name
        if isinstance(self._player, GraphPolicy):
            self._player.move(env)
        self._set_gravity()

    @property
    def object_name(self) -> str:
        """Name of the object."""
        return self.env.backend.scene.objects[0].name

    def _open(
        self,
        policy: str | Path | PolicySpec,
        robot: str | Path | None,
        object_name: str | None,
    ) -> None:
        """Open worlds; where this fails, the session stays as it was."""
        policy = load_policy(policy, robot=robot, seed=self._seed)
        folder = policy.meshes_folder(self._folder)
        if self._demos is None:
            names = object_names(folder)
        else:
            names = load_inputs(self._demos, robot=policy.robot, meshes=folder).bank.object_names
        usual = ALIASES["soup"]
        name = canonical_name(object_name or (usual if usual in names else names[0]), names)
        source = self._demos or synthesize([name], STARTS, self._seed, meshes=folder)
        inputs = load_inputs(source, robot=policy.robot, meshes=folder, only=[name])
        env = self._make_env(policy, inputs, self.engine)
        try:
            player = policy.begin(env)
        except BaseException:
            env.close()
            raise
        if hasattr(self, "env"):
            self.env.close()
        self.env = env
        self.policy = policy
        self.objects = names
        self._inputs = inputs
        self._player: Policy = player
        spec = policy.robot
        self._kinematics = Kinematics(spec)
        self._stiffness = torch.as_tensor(drive_values(spec, "kp")).float()
        self.inputs = _slices(
            layout(len(spec.joints), len(spec.fingertips), policy.task.observation)
        )
        self.terms: tuple[str, ...] = ()
        self.history: deque[Moment] = deque(maxlen=round(KEPT_SECONDS / self.control_dt))
        self._clear()

    # Playing ----------------------------------------------------------------------------------------------------------

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.env.backend.scene.control_dt

    def begin(self, *, keep_goal: bool = False) -> None:
        """Begin again: the robot at home, and a start and a goal drawn from the demonstrations.

        Args:
            keep_goal: Draw a start only, and leave the goal where it is.
        """
        goal = (self.env.goal_pos[0].clone(), self.env.goal_quat[0].clone())
        self.env.reset()
        if keep_goal:
            self.env.goal_pos[0], self.env.goal_quat[0] = goal
        self._player.begin(self.env)
        self._clear()

    def _clear(self) -> None:
        self.away = False
        self._taken = False
        self._touched = self.time
        self._pull: _Pull | None = None
        self.history.clear()

    def step(self) -> Moment:
        """Take one control step.

        Raises:
            XResetError: the engine's numbers are no longer finite; a new episode has begun.
        """
        observations = self.env.get_observations()
        action = self._player.act(observations)
        reading, reward = self.env.advance(action, self._apply_pull())
        self.time += self.control_dt
        if bool(reading.health.nonfinite):
            self.begin()
            raise XResetError(
                f"The simulation in {self.engine} broke down. A new episode has begun."
            )
        if self.away or reading.state.object_pos[0, 2] < -1.0:
            self._remove_object()  # an object that has fallen off the table does not fall for ever
        state = reading.state
        self.terms = tuple(reward.terms)
        values = {
            "joint_pos": state.joint_pos,
            "joint_vel": state.joint_vel,
            "joint_target": self.env.joint_target,
            "object_pos": state.object_pos,
            "object_quat": state.object_quat,
            "goal_pos": self.env.goal_pos,
            "goal_quat": self.env.goal_quat,
            "tip_force": reading.contacts.tip_force,
            "action": action,
            "inputs": torch.cat((observations["policy"], observations["proprio"]), dim=-1),
            "reward": torch.stack(list(reward.terms.values()), dim=-1),
        }
        moment = Moment(
            time=self.time,
            engine=self.engine,
            distance=float((state.object_pos - self.env.goal_pos).norm()),
            angle=float(quat_angle(state.object_quat, self.env.goal_quat)),
            success=bool(reward.success),
            **{name: value[0].detach().numpy().copy() for name, value in values.items()},
        )
        self.history.append(moment)
        if self.away or self._pull is not None or moment.tip_force.any():
            self._touched = self.time
        return moment

    @property
    def dropped(self) -> bool:
        """Whether the robot has lost the object or never grasped it, and the user has neither pulled nor taken it."""
        if self.away:
            return not self._taken
        long_ago = self.time - self._touched > DROPPED_SECONDS
        return long_ago and self.history[-1].distance > DROPPED_DISTANCE

    @property
    def lost(self) -> bool:
        """Whether the object has left the table."""
        env = self.env
        return bool(out_of_bounds(env.backend.state().object_pos, env.backend.scene.table))

    def cloud(self) -> np.ndarray:
        """[P, 3] the newest points of the object's surface that the policy observes, world frame [m]."""
        newest = self.env.get_observations()["perception"][0, -1, :, :3]
        return newest.numpy() / self.env.task.observation.cloud_scale

    # The user's hand --------------------------------------------------------------------------------------------------

    def move_goal(self, pos: ArrayLike, quat: ArrayLike) -> None:
        """Set the goal, at the nearest position above the table that the object can have.

        Args:
            pos: [3] position of the object's mesh frame [m].
            quat: [4] orientation (w, x, y, z).
        """
        scene = self.env.backend.scene
        turned = np.array(quat, dtype=float) / np.linalg.norm(quat)
        middle = np.array((*scene.table.center, 0.0))
        half = np.array((*scene.table.half_size[:2], GOAL_HEIGHT))
        low = middle - half
        low[2] = float(rest_height(scene.objects[0], turned))
        goal = np.clip(pos, low, np.maximum(middle + half, low))
        self.env.goal_pos[0] = torch.as_tensor(goal)
        self.env.goal_quat[0] = torch.as_tensor(turned)

    def grab(self, link: str | None, at: Sequence[float]) -> None:
        """Begin to pull at a point: of a link of the robot, or of the object (None).

        Args:
            at: [3] the point, world frame [m].
        """
        point = torch.tensor(at, dtype=torch.float32)
        state = self.env.backend.state()
        if link is None:
            local = quat_rotate_inverse(state.object_quat[0], point - state.object_pos[0])
        else:
            pose = self._kinematics.link_poses(state.joint_pos[0].double(), [link])[0].float()
            local = pose[:3, :3].T @ (point - pose[:3, 3])
        self._pull = _Pull(link=link, point=local, to=point)

    def pull(self, to: Sequence[float]) -> None:
        """Pull the grabbed point towards a point [3], world frame [m]. Without :meth:`grab`, nothing happens."""
        if self._pull is not None:
            self._pull.to = torch.tensor(to, dtype=torch.float32)

    def release(self) -> None:
        """Let go of what was grabbed."""
        self._pull = None

    def take_away(self) -> None:
        """Take the object out of everybody's reach, until :meth:`begin`. The policy observes it there."""
        self._taken = True
        self._remove_object()

    def _remove_object(self) -> None:
        self.away = True
        if self._pull is not None and self._pull.link is None:
            self.release()
        state = self.env.backend.state().clone()
        state.object_pos.copy_(torch.tensor([AWAY]))
        state.object_linvel.zero_()
        state.object_angvel.zero_()
        self.env.backend.set_state(state)
        self._set_gravity()

    def _set_gravity(self) -> None:
        fraction = (
            torch.zeros_like(self.env.gravity_fraction) if self.away else self.env.gravity_fraction
        )
        self.env.backend.set_object_gravity(fraction)

    def _apply_pull(self) -> Tensor | None:
        """Set the force on the object for the next step; return what a pull at the robot adds to the targets [1, J]."""
        backend = self.env.backend
        force = torch.zeros(3)
        torque = torch.zeros(3)
        offset = None
        if self._pull is not None:
            state = backend.state()
            if self._pull.link is None:
                force, torque = self._pull_object(self._pull, state)
            else:
                offset = self._pull_robot(self._pull, self._pull.link, state)
        if "object_wrench" in backend.capabilities:
            backend.set_object_wrench(force[None], torque[None])
        return offset

    def _pull_object(self, pull: _Pull, state: State) -> tuple[Tensor, Tensor]:
        """Return force and torque [3] of a damped spring, which also carries the object's weight."""
        body = self.env.backend.scene.objects[0]
        pos = state.object_pos[0]
        quat = state.object_quat[0]
        arm = quat_rotate(quat, pull.point - torch.as_tensor(body.com, dtype=torch.float32))
        stretch = pull.to - pos - quat_rotate(quat, pull.point)
        stretch = stretch * min(1.0, PULL_LENGTH / max(float(stretch.norm()), 1e-6))
        spring = body.mass * PULL_RATE**2 * stretch
        damping = 2 * PULL_RATE
        weight = torch.tensor((0.0, 0.0, body.mass * GRAVITY))
        force = spring - body.mass * damping * state.object_linvel[0] + weight
        inertia = float(np.linalg.eigvalsh(body.inertia)[-1])
        return force, torch.linalg.cross(arm, spring) - inertia * damping * state.object_angvel[0]

    def _pull_robot(self, pull: _Pull, link: str, state: State) -> Tensor:
        """[1, J] what to add to the targets, so that the drives give the torques of a force at the point as well.

        A force F at a point with Jacobian J acts as the joint torques J^T F. A drive gives kp (target - q), so a target
        that is J^T F / kp farther gives as much, up to the drive's effort limit.
        """
        joint_pos = state.joint_pos[0].double()
        at = self._kinematics.jacobian(joint_pos, [link], pull.point[None].double())
        force = ROBOT_STIFFNESS * (pull.to - at.pos[0])
        force = force * min(1.0, ROBOT_FORCE / max(float(force.norm()), 1e-6))
        torque = at.linear[0].T @ force
        return (torque.float() / self._stiffness)[None]

    def close(self) -> None:
        """Close the engine."""
        self.env.close()

    def _make_env(self, policy: PolicySpec, inputs: Inputs, engine: str) -> ManipulationEnv:
        return policy.make_env(inputs.objects, inputs.bank, engine=engine, seed=self._seed)


def _slices(groups: dict[str, dict[str, int]]) -> dict[str, slice]:
    places = {}
    begin = 0
    for group in ("policy", "proprio"):
        for name, width in groups[group].items():
            places[name] = slice(begin, begin + width)
            begin += width
    return places
