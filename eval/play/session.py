"""A live episode: one robot, one object and one goal that a user moves while the policy acts.

The policy is its deployed graph, as on a robot, and the world is one of an engine in numpy: torch is not needed.
Shape letters: J joints, E fingertips.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from xreset.backends.single import SingleWorld
from xreset.demos.verbs import synthesize
from xreset.errors import XResetError
from xreset.eval.metrics import GOAL_ANGLE, GOAL_DISTANCE
from xreset.eval.policy_spec import PolicySpec, default_policy, load_policy
from xreset.files.checks import frozen
from xreset.geometry.dynamics import drive_values
from xreset.geometry.kinematics import on_host
from xreset.geometry.shapes import turn_of
from xreset.geometry.urdf import joint_limits
from xreset.live.deploy import known_of
from xreset.objects.catalogue import ALIASES, canonical_name, object_names
from xreset.objects.rest import rest_height
from xreset.resets.bank import ResetBank
from xreset.resets.inputs import load_inputs
from xreset.runtime import Controller, Reading
from xreset.spec import GRAVITY, ObjectSpec, PairFriction, RobotSpec, SceneSpec
from xreset.task.config import TaskConfig, evaluation_task
from xreset.task.terminations import out_of_bounds

RESTS = "zero"
"""Name of the policy of a robot that no policy was trained for: the robot rests."""
KEPT_SECONDS = 60.0
"""How much of the past a session keeps, for films [s]."""
STARTS = 8
"""Synthetic demonstrations that starts and goals are drawn from."""
LEAST_FRICTION = 0.05
"""Least friction of a pair that touches the object."""
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
    """[J] targets of the drives, without a pull at the robot."""
    object_pos: np.ndarray
    object_quat: np.ndarray
    goal_pos: np.ndarray
    goal_quat: np.ndarray
    tip_force: np.ndarray
    """[E, 3] force of each fingertip on the object [N]."""
    distance: float
    """From the object's origin in the policy's task to its goal [m]."""
    angle: float
    """From the object's orientation to the goal's [rad]."""
    success: bool
    """Whether the object is at its goal, as at the end of an evaluation."""


@dataclass(kw_only=True)
class _Pull:
    """A spring from a point of the object or of the robot to the user's pointer."""

    link: str | None
    """Link of the robot; None: the object."""
    point: np.ndarray
    """[3] in the frame of the link or object."""
    to: np.ndarray
    """[3] world."""


class Session:
    """A live episode. Nothing ends it: the time limit and the bounds of the training do not hold.

    A session belongs to one thread.

    Attributes:
        policy: the policy that acts.
        world: the robot and the object in an engine.
        scene: what the world was built from.
        goal_pos: [3] goal of the object's mesh frame [m].
        goal_quat: [4]
        time: seconds since the session's begin.
        history: the last :data:`KEPT_SECONDS` of this object and robot, oldest first.
        away: whether the object is taken away.
        objects: names of the objects to choose from.
        known: what the policy takes of the object: ``points`` and ``normals`` [P, 3] of its surface and its ``center``
            [3], in its mesh frame [m].
        bank: starts and goals.
        random: source of starts and goals.
    """

    def __init__(
        self,
        policy: str | Path | PolicySpec | None = None,
        *,
        object_name: str | None = None,
        engine: str = "mujoco",
        robot: str | Path | None = None,
        demos: Path | None = None,
        meshes: Path | None = None,
    ) -> None:
        """Load what is to be played.

        Args:
            policy: as for :func:`~xreset.eval.policy_spec.load_policy`, without cameras; of the baselines only
                :data:`RESTS`. None: as :func:`~xreset.eval.policy_spec.default_policy` says.
            object_name: name of the object; None: the soup can, or else the first object.
            engine: name of the engine.
            robot: default: the policy's.
            demos: starts and goals, from any file of demonstrations, motion or reset states; None: synthetic ones.
            meshes: folder of object meshes; None: the folder of the policy's training, or the stand-ins.

        Raises:
            XResetError: the policy, the object, the robot or the engine cannot be used.
        """
        self._demos = demos
        self._folder = meshes
        self.random = np.random.default_rng(0)
        self.time = 0.0
        self._open(policy or default_policy(robot), robot, object_name, engine)

    # Choosing ---------------------------------------------------------------------------------------------------------

    def choose_policy(
        self, policy: str | Path | PolicySpec, *, robot: str | Path | None = None
    ) -> None:
        """Let another policy act, and begin again. Arguments and errors as for the constructor's."""
        self._open(policy, robot, self.object_name, self.engine)

    def choose_object(self, name: str) -> None:
        """Play with another object, and begin again; ``XResetError`` if it is unknown."""
        self._open(self.policy, None, name, self.engine)

    def choose_engine(self, name: str) -> None:
        """Go on in another engine at the same state, with the same memory of the policy.

        Raises:
            XResetError: the engine cannot be used; the session goes on in the present one.
        """
        world = SingleWorld(name, self.scene, self.world.state)
        self.world.close()
        self.world = world

    @property
    def engine(self) -> str:
        """Name of the engine."""
        return self.world.engine

    @property
    def object_name(self) -> str:
        """Name of the object."""
        return self.scene.objects[0].name

    def _open(
        self,
        policy: str | Path | PolicySpec,
        robot: str | Path | None,
        object_name: str | None,
        engine: str,
    ) -> None:
        """Open a world; where this fails, the session stays as it was."""
        policy = load_policy(policy, robot=robot)
        folder = policy.meshes_folder(self._folder)
        if self._demos is None:
            names = object_names(folder)
        else:
            inputs = load_inputs(
                self._demos, robot=policy.robot, meshes=self._folder, else_meshes=policy.meshes
            )
            folder = inputs.meshes
            names = inputs.bank.object_names
        usual = ALIASES["soup"]
        name = canonical_name(object_name or (usual if usual in names else names[0]), names)
        rests = policy.content is None and policy.name == RESTS
        controller = None if rests else Controller(policy.graph, policy.name)
        source = self._demos or synthesize([name], STARTS, meshes=folder)
        inputs = load_inputs(source, robot=policy.robot, meshes=folder, only=[name])
        scene = scene_of(policy.robot, inputs.objects[0], policy.task)
        start, *goal = self._drawn(inputs.bank, scene)
        world = SingleWorld(engine, scene, start)
        if hasattr(self, "world"):
            self.world.close()
        self.world = world
        self.scene = scene
        self.goal_pos, self.goal_quat = goal
        self.policy = policy
        self.objects = names
        self.bank = inputs.bank
        self._controller = controller
        self._kinematics = on_host(policy.robot)
        self._stiffness = drive_values(policy.robot, "kp")
        shapes = {} if controller is None else controller.shapes
        self.known = known_of(scene.objects[0], shapes.get("object_points", (64, 3))[0])
        self.history: deque[Moment] = deque(maxlen=round(KEPT_SECONDS / self.control_dt))
        self._clear()

    # Playing ----------------------------------------------------------------------------------------------------------

    @property
    def control_dt(self) -> float:
        """Duration of a control step [s]."""
        return self.scene.control_dt

    def begin(self, *, keep_goal: bool = False) -> None:
        """Begin again: the robot at home, and a start and a goal drawn from the demonstrations.

        Args:
            keep_goal: Draw a start only, and leave the goal where it is.
        """
        start, *goal = self._drawn(self.bank, self.scene)
        if not keep_goal:
            self.goal_pos, self.goal_quat = goal
        self.world.set_state(start)
        self._clear()

    def _drawn(
        self, bank: ResetBank, scene: SceneSpec
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Draw a demonstration of the object: return the state at its start, and the pose of its goal."""
        own = np.flatnonzero(np.asarray(bank.sequence_object) == scene.objects[0].name)
        drawn = self.random.choice(own)
        home = np.clip(scene.robot.home, *joint_limits(scene.robot))
        start = {
            "joint_pos": home,
            "joint_vel": np.zeros_like(home),
            "joint_target": home,
            "object_pos": bank.start_pos[drawn],
            "object_quat": bank.start_quat_wxyz[drawn],
            "object_linvel": np.zeros(3),
            "object_angvel": np.zeros(3),
        }
        return start, bank.goal_pos[drawn], bank.goal_quat_wxyz[drawn]

    def _clear(self) -> None:
        self.away = False
        self._taken = False
        self._touched = self.time
        self._pull: _Pull | None = None
        self.history.clear()
        self.target = self.world.state["joint_target"].astype(np.float32)
        """[J] the present targets of the drives, without a pull at the robot."""
        self._center = self.known["center"]
        if self._controller is not None:
            self._controller.begin(self.known, self.goal_pos, self.goal_quat, self.target)
        self._set_gravity()

    def step(self) -> Moment:
        """Take one control step.

        Raises:
            XResetError: the engine's numbers are no longer finite; a new episode has begun.
        """
        self._act()
        offset, force, torque = self._pulled()
        self.world.step(self.target + offset, self.scene.substeps, force, torque)
        self.time += self.control_dt
        if not self.world.is_finite:
            self.begin()
            raise XResetError(
                f"The simulation in {self.engine} broke down. A new episode has begun."
            )
        if self.away or self.world.state["object_pos"][2] < -1.0:
            self._remove_object()  # an object that has fallen off the table does not fall for ever
        state = self.world.state
        turn = turn_of(state["object_quat"])
        goal_turn = turn_of(self.goal_quat)
        gap = state["object_pos"] - self.goal_pos
        if self.policy.task.object_frame == "center":
            gap = gap + turn.apply(self._center) - goal_turn.apply(self._center)
        distance = float(np.linalg.norm(gap))
        angle = float((turn.inv() * goal_turn).magnitude())
        moment = Moment(
            time=self.time,
            engine=self.engine,
            joint_pos=state["joint_pos"],
            joint_vel=state["joint_vel"],
            joint_target=self.target,
            object_pos=state["object_pos"],
            object_quat=state["object_quat"],
            goal_pos=self.goal_pos,
            goal_quat=self.goal_quat,
            tip_force=self.world.tip_force,
            distance=distance,
            angle=angle,
            success=distance <= GOAL_DISTANCE and angle <= GOAL_ANGLE,
        )
        self.history.append(moment)
        if self.away or self._pull is not None or moment.tip_force.any():
            self._touched = self.time
        return moment

    def _act(self) -> None:
        """Let the policy set the targets."""
        controller = self._controller
        if controller is None:
            return
        state = self.world.state
        reading = Reading(
            joint_pos=state["joint_pos"],
            joint_vel=state["joint_vel"],
            joint_time=self.time,
            object_pos=state["object_pos"],
            object_quat=state["object_quat"],
            object_time=self.time,
            tip_force=self.world.tip_force,
        )
        controller.set_goal(self.goal_pos, self.goal_quat)
        self.target = controller.step(reading)[0]

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
        return bool(out_of_bounds(self.world.state["object_pos"], self.scene.table))

    # The user's hand --------------------------------------------------------------------------------------------------

    def move_goal(self, pos: ArrayLike, quat: ArrayLike) -> None:
        """Set the goal, at the nearest position above the table that the object can have.

        Args:
            pos: [3] position of the object's mesh frame [m].
            quat: [4] orientation (w, x, y, z).
        """
        table = self.scene.table
        turned = np.array(quat, dtype=float) / np.linalg.norm(quat)
        middle = np.array((*table.center, 0.0))
        half = np.array((*table.half_size[:2], GOAL_HEIGHT))
        low = middle - half
        low[2] = float(rest_height(self.scene.objects[0], turned))
        self.goal_pos = np.clip(pos, low, np.maximum(middle + half, low))
        self.goal_quat = turned

    def grab(self, link: str | None, at: Sequence[float]) -> None:
        """Begin to pull at a point: of a link of the robot, or of the object (None).

        Args:
            at: [3] the point, world frame [m].
        """
        point = np.array(at, dtype=float)
        state = self.world.state
        if link is None:
            turn = turn_of(state["object_quat"])
            local = turn.inv().apply(point - state["object_pos"])
        else:
            T = self._kinematics.link_poses(state["joint_pos"], [link])[0]
            local = T[:3, :3].T @ (point - T[:3, 3])
        self._pull = _Pull(link=link, point=local, to=point)

    def pull(self, to: Sequence[float]) -> None:
        """Pull the grabbed point towards a point [3], world frame [m]. Without :meth:`grab`, nothing happens."""
        if self._pull is not None:
            self._pull.to = np.array(to, dtype=float)

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
        still = {"object_linvel": np.zeros(3), "object_angvel": np.zeros(3)}
        self.world.set_state(self.world.state | still | {"object_pos": np.array(AWAY)})
        self._set_gravity()

    def _set_gravity(self) -> None:
        self.world.set_object_gravity(0.0 if self.away else 1.0)

    def _pulled(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what a pull at the robot adds to the targets [J], and force and torque [3] of one at the object."""
        offset = np.zeros_like(self._stiffness)
        force = np.zeros(3)
        torque = np.zeros(3)
        if self._pull is None:
            return offset, force, torque
        if self._pull.link is None:
            force, torque = self._pull_object(self._pull)
        else:
            offset = self._pull_robot(self._pull, self._pull.link)
        return offset, force, torque

    def _pull_object(self, pull: _Pull) -> tuple[np.ndarray, np.ndarray]:
        """Return force and torque [3] of a damped spring, which also carries the object's weight."""
        body = self.scene.objects[0]
        state = self.world.state
        turn = turn_of(state["object_quat"])
        arm = turn.apply(pull.point - body.com)
        stretch = pull.to - state["object_pos"] - turn.apply(pull.point)
        stretch = stretch * min(1.0, PULL_LENGTH / max(float(np.linalg.norm(stretch)), 1e-6))
        spring = body.mass * PULL_RATE**2 * stretch
        damping = 2 * PULL_RATE
        weight = np.array((0.0, 0.0, body.mass * GRAVITY))
        force = spring - body.mass * damping * state["object_linvel"] + weight
        inertia = float(np.linalg.eigvalsh(body.inertia)[-1])
        return force, np.cross(arm, spring) - inertia * damping * state["object_angvel"]

    def _pull_robot(self, pull: _Pull, link: str) -> np.ndarray:
        """[J] what to add to the targets, so that the drives give the torques of a force at the point as well.

        A force F at a point with Jacobian J acts as the joint torques J^T F. A drive gives kp (target - q), so a target
        that is J^T F / kp farther gives as much, up to the drive's effort limit.
        """
        joint_pos = self.world.state["joint_pos"]
        at = self._kinematics.jacobian(joint_pos, [link], pull.point[None])
        force = ROBOT_STIFFNESS * (pull.to - at.pos[0])
        force = force * min(1.0, ROBOT_FORCE / max(float(np.linalg.norm(force)), 1e-6))
        return (at.linear[0].T @ force) / self._stiffness

    def close(self) -> None:
        """Close the engine."""
        self.world.close()


def scene_of(robot: RobotSpec, obj: ObjectSpec, task: TaskConfig) -> SceneSpec:
    """Return the scene in which a policy is played: that of its evaluations, with the friction of the object."""
    task = evaluation_task(task)
    middle = sum(task.randomization.friction) / 2
    pairs = task.randomization.pair_friction(middle if obj.friction is None else obj.friction)
    tip, link, table = (max(pair, LEAST_FRICTION) for pair in pairs)
    return SceneSpec(
        robot=robot,
        objects=(obj,),
        friction=replace(PairFriction(), tip=tip, link=link, table=table),
        timestep=task.timestep,
        substeps=task.substeps,
    )
