"""Joint targets from readings, computed as in the environment.

Shape letters: N robots that act in step (one, except in rehearsals), J joints, E fingertips, P points.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .contract import CONTRACT, LiveError, check_contract, check_hash, read_exported
from .driver import Array, Links, Reading
from .kinematics import Kinematics
from .rotations import is_unit, multiply, rotate

_MARGIN = 0.5
"""How far a target may be beyond a joint's limit when an episode begins [rad, m]."""
_REACH = 10.0
"""Farthest place of an object, of a point of it, or of a goal [m]."""
_FASTEST = 100.0
"""Largest velocity of a joint in a reading [rad/s, m/s]."""
_STRONGEST = 1e4
"""Largest force of a fingertip in a reading [N]."""


class OnnxActor:
    """The network of an exported policy with its recurrent state. It uses one core, so that its time varies little."""

    def __init__(self, content: bytes) -> None:
        """Load the content of a policy's ONNX file; ``LiveError`` if it cannot be read."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            raise LiveError(
                f"The policy cannot be read as ONNX: {error}. Export it again."
            ) from error
        self._inputs = self._session.get_inputs()
        self._state: list[Array] = []

    def begin(self, robots: int) -> None:
        """Zero the recurrent state of that many robots."""
        self._state = [
            np.zeros((1, robots, given.shape[2]), np.float32) for given in self._inputs[2:]
        ]

    def act(self, flat: Array, cloud: Array) -> Array:
        """[N, J] actions for observations [N, F] and clouds [N, H, P, K]."""
        values = (flat, cloud, *self._state)
        feed = {given.name: value for given, value in zip(self._inputs, values, strict=True)}
        outputs = [np.asarray(value) for value in self._session.run(None, feed)]
        self._state = outputs[1:]
        return np.clip(outputs[0], -1.0, 1.0)


class Controller:
    """Turns readings into joint targets, exactly as the environment does.

    Attributes:
        contract: what the policy expects.
        dt: duration of a control step [s].
        lower: [J] joint limits; -inf for a joint without.
        upper: [J]
        step_size: [J] farthest that a relative target moves in a control step; 0 for joints with absolute targets.
        action: [N, J] the last action.
        target: [N, J] the present joint targets.
        kinematics: palm and fingertips from joint positions.
    """

    def __init__(
        self,
        contract: dict[str, Any],
        actor: OnnxActor | Any = None,
        *,
        source: str = "The contract",
    ) -> None:
        """Prepare.

        Args:
            contract: what the policy expects.
            actor: the policy's network; None: a subclass acts itself.
            source: what messages call the contract.

        Raises:
            LiveError: the contract is of another version, or not complete.
        """
        check_contract(contract, source)
        self.contract = contract
        self.dt: float = contract["control_dt"]
        self._actor = actor
        self._has_begun = False
        self.kinematics = Kinematics(contract["kinematics"])
        joints = contract["joints"]

        def column(name: str, otherwise: float) -> Array:
            values = [otherwise if joint[name] is None else joint[name] for joint in joints]
            return np.array(values, dtype=np.float32)

        self.lower = column("lower", -np.inf)
        self.upper = column("upper", np.inf)
        self._scaled_lower = column("lower", -np.pi)
        self._scaled_upper = column("upper", np.pi)
        self._mapping = {
            name: column(name, 0.0) for name in ("step", "lead", "zero", "below", "above")
        }
        self.step_size = self._mapping["step"]
        self._is_arm = np.array([joint["group"] == "arm" for joint in joints])

    def begin(
        self,
        object_points: Array,
        goal_pos: Array,
        goal_quat: Array,
        target: Array,
        center: Array | None = None,
    ) -> None:
        """Begin an episode.

        Args:
            object_points: [N, P, 3] or [P, 3] points of the object, in its frame; see :meth:`points`.
            goal_pos: [N, 3] or [3] goal position.
            goal_quat: [N, 4] or [4] goal orientation.
            target: [N, J] or [J] present joint targets of the robot.
            center: [N, 3] or [3] origin that the object has for the policy, in its frame; see :meth:`center`. Needed
                where the contract's ``object_frame`` is ``center``.

        Raises:
            LiveError: a shape is not the contract's, a number is not finite or far outside its range, a quaternion has
                another length than 1, or ``center`` is missing. No episode goes on then.
        """
        self._has_begun = False
        given = np.atleast_2d(np.asarray(target, dtype=np.float32))
        joints = len(self.contract["joints"])
        if given.ndim != 2 or given.shape[1] != joints:
            raise LiveError(f"target has shape {np.shape(target)}, expected ({joints},).")
        self._check_joints("target", given)
        self.target = given
        expected = self.contract["observation"]["cloud_points"]
        shape = np.shape(object_points)
        if shape[-2:] != (expected, 3):
            raise LiveError(f"The object has points of shape {shape}, expected ({expected}, 3).")
        self._points = self._positions("The object", object_points, expected, 3)
        self._center: Array | None = None
        if self.contract["object_frame"] == "center":
            if center is None:
                raise LiveError(
                    "This policy needs the center of the object. Give center, as Controller.center does."
                )
            self._center = self._of_each(center, 3)
            self._points = self._points - self._center[:, None]
        self._set_goal(goal_pos, goal_quat)
        self.action = np.zeros_like(self.target)
        self._cloud: Array | None = None
        self._actor.begin(len(self.target))
        self._has_begun = True

    def set_goal(self, pos: Array, quat: Array) -> None:
        """Set the goal pose, also while the policy acts; shapes and errors as for :meth:`begin`."""
        self._must_have_begun()
        self._set_goal(pos, quat)

    def _set_goal(self, pos: Array, quat: Array) -> None:
        goal_quat = self._of_each(quat, 4)
        if not is_unit(goal_quat).all():
            raise LiveError(f"The goal has {quat}, expected a unit quaternion (w, x, y, z).")
        self._goal_pos = self._origin(self._positions("The goal", pos, 3), goal_quat)
        self._goal_quat = goal_quat

    def _must_have_begun(self) -> None:
        if not self._has_begun:
            raise LiveError("No episode has begun. Call begin first.")

    def _of_each(self, values: Array, *shape: int) -> Array:
        """[N, ...] values of every robot in float32, given those [N, ...] or one robot's [...]."""
        array = np.asarray(values, np.float32)
        try:
            return np.broadcast_to(array, (len(self.target), *shape))
        except ValueError:
            raise LiveError(f"Found numbers of shape {array.shape}, expected {shape}.") from None

    def _positions(self, what: str, values: Array, *shape: int) -> Array:
        """Return positions [m] of every robot, as :meth:`_of_each`; ``LiveError`` if one is far away or not finite."""
        positions = self._of_each(values, *shape)
        farthest = np.abs(positions).max()
        if not farthest <= _REACH:
            raise LiveError(
                f"{what} has the coordinate {farthest:g}, expected at most {_REACH:g} m. Are these millimetres?"
            )
        return positions

    def _check_joints(self, what: str, values: Array) -> None:
        """Raise ``LiveError`` if a value [N, J] is far beyond the limits of its joint, or not finite."""
        inside = (values >= self.lower - _MARGIN) & (values <= self.upper + _MARGIN)
        if not inside.all():
            robot, j = np.argwhere(~inside)[0]
            name = self.contract["joints"][j]["name"]
            raise LiveError(
                f"{what} of {name[:60]} is {values[robot, j]:g}, expected {self.lower[j]:g} to {self.upper[j]:g}. Are "
                "these degrees?"
            )

    def check_reading(self, reading: Reading) -> None:
        """Raise ``LiveError`` for numbers that no robot has, such as degrees or millimetres.

        A :class:`~xreset.runtime.Runner` judges readings itself; loops without one call this method before
        :meth:`step`.
        """
        self._must_have_begun()
        reading = reading.batched()
        self._check_joints("joint_pos", reading.joint_pos)
        self._positions("The object", reading.object_pos, 3)
        for name, unit, most in (("joint_vel", "rad/s", _FASTEST), ("tip_force", "N", _STRONGEST)):
            values = getattr(reading, name)
            largest = 0.0 if values is None else np.abs(values).max(initial=0.0)
            if not largest <= most:
                raise LiveError(f"{name} holds {largest:g}, expected at most {most:g} {unit}.")

    def _origin(self, pos: Array, quat: Array) -> Array:
        """[N, 3] where the policy's origin of the object is, for poses [N, 3], [N, 4] of the object's frame."""
        return pos if self._center is None else pos + rotate(quat, self._center)

    def points(self, name: str) -> Array:
        """[P, 3] points of an object, in its frame; ``LiveError`` if the contract has no such object."""
        return self._of_object(name, "points")

    def center(self, name: str) -> Array:
        """[3] center of an object, in its frame; ``LiveError`` if the contract has no such object."""
        return self._of_object(name, "center")

    def _of_object(self, name: str, entry: str) -> Array:
        objects = self.contract["objects"]
        if name not in objects:
            raise LiveError(
                f"The contract has no object {str(name)[:60]!r}. Choose from: {', '.join(objects)}."
            )
        return np.array(objects[name][entry], dtype=np.float32)

    def step(self, reading: Reading) -> Array:
        """[N, J] new joint targets for a reading.

        Raises:
            LiveError: no episode has begun, or data of the reading have another shape.
            ValueError: data that no robot may leave out are None.
        """
        reading = reading.batched()
        self._must_have_begun()
        robots, joints = self.target.shape
        shapes = {
            "joint_pos": (robots, joints),
            "joint_vel": (robots, joints),
            "object_pos": (robots, 3),
            "object_quat": (robots, 4),
        }
        if reading.tip_force is not None:
            shapes["tip_force"] = (robots, len(self.contract["fingertips"]), 3)
        for name, expected in shapes.items():
            shape = np.shape(getattr(reading, name))
            if shape != expected:
                raise LiveError(f"{name} has shape {shape}, expected {expected}.")
        flat, cloud = self.observe(reading)
        self.action = self._actor.act(flat, cloud)
        self.target = self._targets(self.action, reading.joint_pos)
        return self.target

    def observe(self, reading: Reading) -> tuple[Array, Array]:
        """Return the policy's inputs: [N, F] flat, and the cloud [N, H, P, K]."""
        links = reading.links or self.kinematics.links(reading.joint_pos, reading.joint_vel)
        if self.contract["observation"]["content"] == "published":
            terms = self._published_terms(reading, links)
        else:
            terms = self._draft_terms(reading, links)
        return np.concatenate(terms, axis=1), self._observe_cloud(reading)

    def _draft_terms(self, reading: Reading, links: Links) -> list[Array]:
        """Return the flat observations of the draft of the paper, each [N, ...]."""
        o = self.contract["observation"]
        count = len(self.target)
        pos = self._origin(reading.object_pos, reading.object_quat)
        if o["rotation"] == "to_goal":
            inverse = reading.object_quat * np.array([1, -1, -1, -1], np.float32)
            to_goal = multiply(self._goal_quat, inverse)
            poses = [pos, self._goal_pos, self._encoded(to_goal)]
        else:
            quat = self._encoded(reading.object_quat)
            poses = [pos, quat, self._goal_pos, self._encoded(self._goal_quat)]
        force = reading.tip_force
        if force is None:
            force = np.zeros_like(links.tip_pos)
        terms = [
            *poses,
            np.ones((count, 1), np.float32),  # gravity fraction: the object has its full weight
            self.action,
            self._scaled(reading.joint_pos),
            np.float32(o["joint_vel_scale"]) * reading.joint_vel,
            links.palm_pos,
            self._encoded(links.palm_quat),
            links.palm_linvel,
            links.palm_angvel,
            links.tip_pos.reshape(count, -1),
            np.clip(np.float32(o["contact_force_scale"]) * force, -1.0, 1.0).reshape(count, -1),
        ]
        if o["joint_target"]:
            terms.append(self.target - reading.joint_pos)
        return terms

    def _published_terms(self, reading: Reading, links: Links) -> list[Array]:
        """Return the flat observations of the published paper, each [N, ...]."""
        links_pos = np.concatenate((links.palm_pos[:, None], links.tip_pos), axis=1)
        offsets = self._world_points(reading)[:, None] - links_pos[:, :, None]
        nearest = np.square(offsets).sum(axis=-1).argmin(axis=-1)
        vectors = np.take_along_axis(offsets, nearest[:, :, None, None], axis=2)[:, :, 0]
        x, y, z = np.split(np.square(vectors[:, 0]), 3, axis=1)
        return [
            vectors[:, 1:].reshape(len(vectors), -1),
            np.sqrt(x + y + z),
            self._scaled(reading.joint_pos),
            self._scaled(self.target),
        ]

    def _scaled(self, joints: Array) -> Array:
        """[N, J] joint positions between their limits, in [-1, 1]."""
        lower = self._scaled_lower
        return np.float32(2.0) * (joints - lower) / (self._scaled_upper - lower) - np.float32(1.0)

    def _encoded(self, quat: Array) -> Array:
        """[N, 4] or [N, 6] a rotation as the policy observes it."""
        if self.contract["observation"]["rotation"] == "quaternion":
            return np.where(quat[:, :1] < 0, -quat, quat)
        return rotate(quat[:, None], np.eye(3, dtype=np.float32)[:2]).reshape(len(quat), 6)

    def _world_points(self, reading: Reading) -> Array:
        """[N, P, 3] the object's points in the world frame."""
        origin = self._origin(reading.object_pos, reading.object_quat)
        return rotate(reading.object_quat[:, None], self._points) + origin[:, None]

    def _observe_cloud(self, reading: Reading) -> Array:
        """[N, H, P, K] the cloud's history with this reading, or the paired points of this reading."""
        o = self.contract["observation"]
        scale = np.float32(o["cloud_scale"])
        cloud = self._world_points(reading)
        if o["cloud"] == "paired":
            goal = rotate(self._goal_quat[:, None], self._points) + self._goal_pos[:, None]
            return scale * np.concatenate((cloud, goal, goal - cloud), axis=-1)[:, None]
        frame = (scale * cloud)[:, None]
        if self._cloud is None:
            self._cloud = np.repeat(frame, o["cloud_history"], axis=1)
        self._cloud = np.concatenate((self._cloud[:, 1:], frame), axis=1)
        return self._cloud

    def _targets(self, action: Array, joint_pos: Array) -> Array:
        """[N, J] as :meth:`xreset.task.actions.ActionSpace.targets`."""
        m = self._mapping
        new = self.target + m["step"] * action
        new = np.clip(new, joint_pos - m["lead"], joint_pos + m["lead"])
        if self.contract["action"]["hand"] == "absolute":
            hand = m["zero"] + np.where(action < 0, m["below"], m["above"]) * action
            new = np.where(self._is_arm, new, hand)
        return np.clip(new, self.lower, self.upper)


def load_controller(folder: str | Path) -> Controller:
    """Return the controller of a folder that ``xreset export deploy`` wrote; ``LiveError`` if it cannot be used."""
    contract, content = read_exported(folder)
    source = str(Path(folder) / CONTRACT)
    try:
        controller = Controller(contract, OnnxActor(content), source=source)
        check_hash(folder, contract, content)
        _try_step(controller)
    except LiveError:
        raise
    except Exception as error:  # whatever a damaged contract leads to
        raise LiveError(
            f"{source} is damaged, or does not fit its policy ({type(error).__name__}: {error}). Export the policy "
            "again."
        ) from error
    return controller


def _try_step(controller: Controller) -> None:
    """Take a step from home, so that a policy that cannot act is refused before a robot moves."""
    contract = controller.contract
    for name in contract["objects"]:
        controller.points(name)
        controller.center(name)
    joints = np.array([joint["home"] for joint in contract["joints"]], np.float32)
    origin = np.zeros(3, np.float32)
    upright = np.array([1, 0, 0, 0], np.float32)
    points = np.zeros((contract["observation"]["cloud_points"], 3), np.float32)
    controller.begin(points, origin, upright, joints, origin)
    reading = Reading(
        joint_pos=joints,
        joint_vel=np.zeros_like(joints),
        joint_time=0.0,
        object_pos=origin,
        object_quat=upright,
        object_time=0.0,
    )
    target = controller.step(reading)
    if target.shape != (1, len(joints)) or not np.isfinite(target).all():
        raise ValueError(f"the targets at home are {target}")
    controller._has_begun = False
