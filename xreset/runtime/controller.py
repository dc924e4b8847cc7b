"""Joint targets from readings: the graph of a deployed policy, and its memory.

Shape letters: N robots that act in step (one, except in rehearsals), J joints, E fingertips, P points.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .contract import LiveError, joint_values, parse_contract, read_graph
from .driver import Array, Reading

_MARGIN = 0.5
"""How far a target may be beyond a joint's limit when an episode begins [rad, m]."""
REACH = 10.0
"""Farthest place of an object, of a point of it, or of a goal [m]."""
_FASTEST = 100.0
"""Largest velocity of a joint in a reading [rad/s, m/s]."""
_STRONGEST = 1e4
"""Largest force of a fingertip in a reading [N]."""
_UNIT_TOLERANCE = 0.01
"""How far the length of a quaternion may be from 1."""
_MEMORY = "memory_in"
_OF_OBJECT = ("points", "normals", "center")
"""Entries of an object that a graph may take, as ``object_points``, ..."""
_READINGS = ("joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force")
"""Inputs that a :class:`Reading` has."""


def is_unit(quat: Array) -> Array:
    """[...] bool: whether quaternions [..., 4] have length 1, and no number that is not finite."""
    return np.abs(np.linalg.norm(quat, axis=-1) - 1.0) <= _UNIT_TOLERANCE


class Controller:
    """Turns readings into joint targets. It uses one core, so that its time varies little.

    Attributes:
        contract: what the policy expects.
        metadata: every entry of the graph's metadata.
        shapes: name and shape, for one robot, of every input of the graph.
        outputs: names of the graph's outputs, in their order.
        dt: duration of a control step [s].
        lower: [J] joint limits; -inf for a joint without.
        upper: [J]
        step_size: [J] farthest that a relative target moves in a control step; 0 for joints with absolute targets.
        speed: [J] the joints' own speed limits [rad/s, m/s]; inf for a joint without.
        target: [N, J] the present joint targets. The policy starts from them: a loop that sends others sets them here.
        links: [N, 1 + E, 3] palm and fingertips in the last reading, world frame [m]; None: the graph does not give
            them, or no step was taken.
        observations: [N, D] what the policy was told in the last step, without the object's points; None as for links.
    """

    def __init__(self, content: bytes, source: str = "The policy") -> None:
        """Load a deployed policy.

        Args:
            content: content of its file.
            source: what messages call it.

        Raises:
            LiveError: it cannot be read, or a robot must not follow its contract.
        """
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(
                content, options, providers=["CPUExecutionProvider"]
            )
            self.metadata: dict[str, str] = self._session.get_modelmeta().custom_metadata_map
            inputs = {value.name: value.shape for value in self._session.get_inputs()}
            self.outputs = [output.name for output in self._session.get_outputs()]
        except Exception as error:
            raise LiveError(
                f"{source} cannot be read as ONNX: {error}. Export it again."
            ) from error
        self.contract = parse_contract(self.metadata, source)
        self.dt: float = self.contract["control_dt"]
        self.lower = joint_values(self.contract, "lower", -np.inf)
        self.upper = joint_values(self.contract, "upper", np.inf)
        self.step_size = joint_values(self.contract, "step", 0.0)
        self.speed = joint_values(self.contract, "velocity", np.inf)
        self.links: Array | None = None
        self.observations: Array | None = None
        self._has_begun = False
        self.shapes = self._checked_shapes(inputs, source)
        try:
            self._try_step()
        except Exception as error:  # whatever a damaged graph leads to
            raise LiveError(
                f"{source} does not fit its contract ({type(error).__name__}: {error}). Export the policy again."
            ) from error

    def _checked_shapes(self, inputs: dict[str, Any], source: str) -> dict[str, tuple[int, ...]]:
        """Return the shapes of the graph's inputs for each robot; ``LiveError`` if there is an input that nobody
        gives."""
        joints = len(self.contract["joints"])
        tips = len(self.contract.get("fingertips", ()))
        known: dict[str, tuple[Any, ...]] = {
            "joint_pos": (joints,),
            "joint_vel": (joints,),
            "joint_target": (joints,),
            "object_pos": (3,),
            "object_quat": (4,),
            "tip_force": (tips, 3),
            "goal_pos": (3,),
            "goal_quat": (4,),
            "object_points": (None, 3),
            "object_normals": (None, 3),
            "object_center": (3,),
            _MEMORY: (None,),
        }
        shapes = {}
        for name, stated in inputs.items():
            shape = tuple(stated[1:])
            expected = known.get(name, ())
            fits = len(shape) == len(expected) > 0
            for found, wanted in zip(shape, expected, strict=False):
                fits = fits and isinstance(found, int) and wanted in (None, found)
            if not fits:
                raise LiveError(
                    f"{source} has the input {name[:60]!r} {list(shape)} for each robot, expected "
                    f"{list(expected) or ', '.join(known)}. Export it again."
                )
            shapes[name] = shape
        return shapes

    def begin(
        self,
        obj: Mapping[str, Any],
        goal_pos: Array,
        goal_quat: Array,
        target: Array,
    ) -> None:
        """Begin an episode.

        Args:
            obj: the object, as :meth:`object` returns it, in its own frame: ``points`` [N, P, 3] or [P, 3], the outward
                ``normals`` of its surface there, and its ``center`` [N, 3] or [3]; only those that the graph takes are
                needed.
            goal_pos: [N, 3] or [3] goal position.
            goal_quat: [N, 4] or [4] goal orientation.
            target: [N, J] or [J] present joint targets of the robot.

        Raises:
            LiveError: a shape is not the contract's, a number is not finite or far outside its range, a quaternion has
                another length than 1, or something of the object is missing. No episode goes on then.
        """
        self._has_begun = False
        given = np.atleast_2d(np.array(target, dtype=np.float32))
        joints = len(self.contract["joints"])
        if given.ndim != 2 or given.shape[1] != joints:
            raise LiveError(f"target has shape {np.shape(target)}, expected ({joints},).")
        self._check_joints("target", given)
        self.target = given
        self._given: dict[str, Array] = {}
        for entry in _OF_OBJECT:
            name = f"object_{entry}"
            if name not in self.shapes:
                continue
            if not isinstance(obj, Mapping) or entry not in obj:
                raise LiveError(
                    f"This policy needs {entry} of the object. Give an object with them, as Controller.object does."
                )
            self._given[name] = self._positions(name, obj[entry], *self.shapes[name])
        self._set_goal(goal_pos, goal_quat)
        if _MEMORY in self.shapes:
            self._given[_MEMORY] = np.zeros((len(given), *self.shapes[_MEMORY]), np.float32)
        self.links = None
        self.observations = None
        self._has_begun = True

    def set_goal(self, pos: Array, quat: Array) -> None:
        """Set the goal pose, also while the policy acts; shapes and errors as for :meth:`begin`."""
        self._must_have_begun()
        self._set_goal(pos, quat)

    def _set_goal(self, pos: Array, quat: Array) -> None:
        goal_quat = self._orientations("goal_quat", quat)
        self._given["goal_pos"] = self._positions("goal_pos", pos, 3)
        self._given["goal_quat"] = goal_quat

    def _must_have_begun(self) -> None:
        if not self._has_begun:
            raise LiveError("No episode has begun. Call begin first.")

    def _of_each(self, what: str, values: Array, *shape: int) -> Array:
        """[N, ...] copy of every robot's values in float32, given those [N, ...] or one robot's [...]."""
        array = np.array(values, np.float32)
        try:
            return np.broadcast_to(array, (len(self.target), *shape))
        except ValueError:
            raise LiveError(f"{what} has shape {array.shape}, expected {shape}.") from None

    def _positions(self, what: str, values: Array, *shape: int) -> Array:
        """Return positions [m] of every robot, as :meth:`_of_each`; ``LiveError`` if one is far away or not finite."""
        positions = self._of_each(what, values, *shape)
        farthest = np.abs(positions).max()
        if not farthest <= REACH:
            raise LiveError(
                f"{what} has the coordinate {farthest:g}, expected at most {REACH:g} m. Are these millimetres?"
            )
        return positions

    def _orientations(self, what: str, values: Array) -> Array:
        """[N, 4] quaternions, as :meth:`_of_each`; ``LiveError`` if one has another length than 1."""
        quat = self._of_each(what, values, 4)
        if not is_unit(quat).all():
            raise LiveError(f"{what} is {values}, expected a unit quaternion (w, x, y, z).")
        return quat

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
        joints = self._of_each("joint_pos", reading.joint_pos, len(self.lower))
        self._check_joints("joint_pos", joints)
        self._positions("The object", reading.object_pos, 3)
        self._orientations("object_quat", reading.object_quat)
        for name, unit, most in (("joint_vel", "rad/s", _FASTEST), ("tip_force", "N", _STRONGEST)):
            values = getattr(reading, name)
            largest = 0.0 if values is None else np.abs(values).max(initial=0.0)
            if not largest <= most:
                raise LiveError(f"{name} holds {largest:g}, expected at most {most:g} {unit}.")

    def rows(self, names: Sequence[str]) -> list[int]:
        """[J] place of each joint of the contract in a robot's own list of names.

        Raises:
            LiveError: the robot lacks a joint of the contract.
        """
        listed = list(names)
        wanted = [joint["name"] for joint in self.contract["joints"]]
        missing = [name for name in wanted if name not in listed]
        if missing:
            raise LiveError(
                f"The policy is for the robot {self.contract['robot']!r} with the joint {missing[0]!r}, but this robot "
                f"has the joints {', '.join(listed)}. Use a policy of this robot."
            )
        return [listed.index(name) for name in wanted]

    def object(self, name: str) -> dict[str, Any]:
        """Return an object for :meth:`begin`; ``LiveError`` if the contract has no such object."""
        objects = self.contract.get("objects", {})
        if name not in objects:
            raise LiveError(
                f"The contract has no object {str(name)[:60]!r}. Choose from: {', '.join(objects)}. For another one, "
                "export the policy again: xreset export deploy POLICY --object NAME --meshes FOLDER."
            )
        return objects[name]

    def step(self, reading: Reading) -> Array:
        """[N, J] new joint targets for a reading.

        Raises:
            LiveError: no episode has begun, data of the reading have another shape, or the policy needs joint
                velocities and the reading has none.
            ValueError: data that no robot may leave out are None.
        """
        self._must_have_begun()
        outputs = self._run(reading.batched())
        if "memory_out" in outputs:
            self._given[_MEMORY] = outputs["memory_out"]
        self.links = outputs.get("links")
        self.observations = outputs.get("observations")
        self.target = np.clip(outputs["target"], self.lower, self.upper)
        return self.target

    def _run(self, reading: Reading) -> dict[str, Array]:
        """Return the graph's outputs by name, for a reading with the axis N."""
        feed = {"joint_target": self.target, **self._given}
        robots = len(self.target)
        for name in _READINGS:
            value = getattr(reading, name)
            if name not in self.shapes:
                continue
            expected = (robots, *self.shapes[name])
            if value is None and name == "tip_force":
                value = np.zeros(expected, np.float32)
            if value is None:
                raise LiveError(f"The policy needs {name}, which the reading does not have.")
            if value.shape != expected:
                raise LiveError(f"{name} has shape {value.shape}, expected {expected}.")
            feed[name] = value
        feed = {name: feed[name] for name in self.shapes}
        outputs = [np.asarray(value) for value in self._session.run(None, feed)]
        return dict(zip(self.outputs, outputs, strict=True))

    def begin_at_home(self) -> Reading:
        """Begin an episode to try the policy, and return the reading of a robot that stays at home."""
        joints = joint_values(self.contract, "home", 0.0)
        origin = np.zeros(3)
        upright = np.array([1.0, 0.0, 0.0, 0.0])
        nowhere = {}
        for entry in _OF_OBJECT:
            nowhere[entry] = np.zeros(self.shapes.get(f"object_{entry}", ()))
        self.begin(nowhere, origin, upright, joints)
        return Reading(
            joint_pos=joints,
            joint_vel=0.0 * joints,
            joint_time=0.0,
            object_pos=origin,
            object_quat=upright,
            object_time=0.0,
        )

    def _try_step(self) -> None:
        """Take two steps from home, so that a policy that cannot act is refused before a robot moves."""
        joints = self.contract["joints"]
        reading = self.begin_at_home()
        target = self.step(reading)
        if target.shape != (1, len(joints)) or not np.isfinite(target).all():
            raise ValueError(f"the targets at home are {target}")
        links = len(self.contract.get("links", ()))
        if self.links is not None and self.links.shape != (1, links, 3):
            raise ValueError(f"links has shape {self.links.shape}, expected (1, {links}, 3)")
        if (_MEMORY in self.shapes) != ("memory_out" in self.outputs):
            raise ValueError("it has only one of memory_in and memory_out")
        self.step(reading)  # with the memory of the first step
        self._has_begun = False
        for name, obj in self.contract.get("objects", {}).items():
            for entry in _OF_OBJECT:
                expected = self.shapes.get(f"object_{entry}")
                found = np.shape(obj.get(entry))
                if expected not in (None, found):
                    raise ValueError(f"{name} has {entry} of shape {found}")


def load_controller(policy: str | Path) -> Controller:
    """Return the controller of a folder that ``xreset export deploy`` wrote, or of the policy's file in it.

    Raises:
        LiveError: it cannot be used.
    """
    return Controller(read_graph(policy), str(policy))
