"""Run an exported policy on a robot: observations, forward kinematics, the policy, and the loop around a driver.

This file needs numpy and onnxruntime, and nothing else of xreset: ``xreset export deploy`` copies it next to a policy.
It has not been tried on hardware. Read ``docs/live.md`` before a robot moves.

Shape letters: N robots that act in step (one, except in rehearsals), J joints, E fingertips, P points. Units are SI and
radians, quaternions (w, x, y, z), the frame is the world's: z up, the table's top at z = 0, the robot's base as the
contract says.
"""

from __future__ import annotations

import hashlib
import json
import logging
import resource
import sys
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

try:
    from xreset.errors import XResetError
except ImportError:  # a deployed policy runs without xreset
    XResetError = Exception  # pyright: ignore

SCHEMA = "xreset-deploy/1"
LIVE_SCHEMA = "xreset-live/1"
"""Schema of the messages of ``xreset serve``."""
CONTRACT = "contract.json"
POLICY = "policy.onnx"

Array = np.ndarray


class LiveError(XResetError):  # pyright: ignore
    """A deployed policy cannot be read, or a robot cannot go on."""


# Rotations ------------------------------------------------------------------------------------------------------------
# Products and sums are fused as torch fuses them on processors with AVX2, so that observations are equal bit for bit.


def _fused(a: Array, b: Array, c: Array) -> Array:
    """Return a * b + c in float32, rounded once."""
    return (a.astype(np.float64) * b + c).astype(np.float32)


def _cross(a: Array, b: Array) -> Array:
    parts = []
    for i, j in ((1, 2), (2, 0), (0, 1)):
        parts.append(_fused(a[..., i], b[..., j], -(a[..., j] * b[..., i])))
    return np.stack(parts, axis=-1)


def rotate(quat: Array, vector: Array) -> Array:
    """[..., 3] vectors turned by unit quaternions [..., 4], in float32; both broadcast."""
    w = quat[..., :1]
    u, v = np.broadcast_arrays(quat[..., 1:], vector)
    t = np.float32(2.0) * _cross(u, v)
    return _fused(w, t, v) + _cross(u, t)


def _multiply(a: Array, b: Array) -> Array:
    """[N, 4] product of quaternions [N, 4], in float32: rotation b first, then a."""
    u = a[:, 1:]
    v = b[:, 1:]
    products = a * b
    w = products[:, :1] - ((products[:, 1] + products[:, 2]) + products[:, 3])[:, None]
    return np.concatenate((w, _fused(b[:, :1], u, _fused(a[:, :1], v, _cross(u, v)))), axis=1)


def _scaled(joints: Array, lower: Array, upper: Array) -> Array:
    """[N, J] joint positions between their limits, in [-1, 1]."""
    return np.float32(2.0) * (joints - lower) / (upper - lower) - np.float32(1.0)


def _shown(quat: Array, rotation: str) -> Array:
    """[N, 4] or [N, 6] a rotation as the policy observes it."""
    if rotation == "quaternion":
        return np.where(quat[:, :1] < 0, -quat, quat)
    return rotate(quat[:, None], np.eye(3, dtype=np.float32)[:2]).reshape(len(quat), 6)


# What a driver reads --------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Links:
    """Palm and fingertips in the world frame."""

    palm_pos: Array
    """[N, 3]"""
    palm_quat: Array
    """[N, 4]"""
    palm_linvel: Array
    """[N, 3]"""
    palm_angvel: Array
    """[N, 3]"""
    tip_pos: Array
    """[N, E, 3]"""


@dataclass(frozen=True, kw_only=True)
class Reading:
    """The newest data of a robot and of an object tracker. A driver of one robot leaves out the axis N."""

    joint_pos: Array
    """[N, J] in the order of the contract's joints."""
    joint_vel: Array
    """[N, J]"""
    joint_time: float | Array
    """[N] when the joints were measured, on the driver's clock [s]."""
    object_pos: Array
    """[N, 3] origin of the object's mesh frame."""
    object_quat: Array
    """[N, 4]"""
    object_time: float | Array
    """[N] when the pose was true: the camera's time, not the time of its arrival [s]."""
    tip_force: Array | None = None
    """[N, E, 3] force of each fingertip on the object, world frame [N]; None: the robot does not measure it."""
    links: Links | None = None
    """None: they follow from the joints."""

    def batched(self) -> Reading:
        """Return the reading with the axis N, in float32 (times: float64)."""
        if np.ndim(self.joint_pos) == 2:
            return self
        changed: dict[str, Any] = {}
        for name in ("joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force"):
            value = getattr(self, name)
            changed[name] = None if value is None else np.asarray(value, dtype=np.float32)[None]
        for name in ("joint_time", "object_time"):
            changed[name] = np.array([getattr(self, name)], dtype=np.float64)
        if self.links is not None:
            changed["links"] = Links(**{name: np.asarray(value)[None] for name, value in vars(self.links).items()})
        return replace(self, **changed)


class Driver(ABC):
    """A robot and an object tracker. No method may block for longer than a small part of a control step."""

    @abstractmethod
    def read(self) -> Reading:
        """Return the newest data, however old they are."""

    @abstractmethod
    def send(self, target: Array) -> None:
        """Send joint targets [J] (of N robots: [N, J])."""

    @abstractmethod
    def stop(self) -> None:
        """Hold still. The runner calls it once, after it has slowed down, and also when a method has failed."""

    def now(self) -> float:
        """Return the time on the clock of the readings [s]."""
        return time.monotonic()

    def wait_until(self, moment: float) -> None:
        """Return at that time on the clock."""
        time.sleep(max(0.0, moment - self.now()))


# From a reading to joint targets --------------------------------------------------------------------------------------


class Kinematics:
    """Poses of the palm and the fingertips from joint positions, as the contract describes the robot."""

    def __init__(self, chain: dict[str, Any]) -> None:
        self._chain = chain
        self._steps = []
        for step in chain["steps"]:
            axis = np.array(step["axis"])
            cross = np.cross(np.eye(3), axis)  # cross @ v = axis x v
            arrays = {"origin": np.array(step["origin"]), "axis": axis, "cross": cross, "twice": cross @ cross}
            self._steps.append(step | arrays)

    def links(self, joint_pos: Array, joint_vel: Array) -> Links:
        """Return the links of joint positions and velocities [N, J]."""
        count = len(joint_pos)
        joint_pos = joint_pos.astype(np.float64)
        joint_vel = joint_vel.astype(np.float64)
        base = np.array(self._chain["base"])
        rotations = [np.tile(base[:3, :3], (count, 1, 1))]
        positions = [np.tile(base[:3, 3], (count, 1))]
        velocities = [np.zeros((count, 3))]
        spins = [np.zeros((count, 3, 3))]  # matrices W with W @ v = angular velocity x v
        for step in self._steps:
            parent = step["parent"]
            rotation = rotations[parent] @ step["origin"][:3, :3]
            arm = rotations[parent] @ step["origin"][:3, 3]
            spin = spins[parent]
            drift = 0.0
            if step["joint"] is not None:
                value = (step["multiplier"] * joint_pos[:, step["joint"]] + step["offset"])[:, None]
                speed = (step["multiplier"] * joint_vel[:, step["joint"]])[:, None]
                if step["type"] == "prismatic":
                    axis = rotation @ step["axis"]
                    arm = arm + axis * value
                    drift = axis * speed
                else:
                    spin = spin + speed[:, None] * (rotation @ step["cross"] @ rotation.transpose(0, 2, 1))
                    # Rodrigues' formula
                    turn = np.sin(value)[:, None] * step["cross"] + (1.0 - np.cos(value))[:, None] * step["twice"]
                    rotation = rotation + rotation @ turn
            rotations.append(rotation)
            positions.append(positions[parent] + arm)
            velocities.append(velocities[parent] + (spins[parent] @ arm[..., None])[..., 0] + drift)
            spins.append(spin)
        palm = self._chain["palm"]
        spin = spins[palm]
        return Links(
            palm_pos=positions[palm].astype(np.float32),
            palm_quat=_quaternion(rotations[palm]).astype(np.float32),
            palm_linvel=velocities[palm].astype(np.float32),
            palm_angvel=np.stack((spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]), axis=1).astype(np.float32),
            tip_pos=np.stack([positions[tip] for tip in self._chain["tips"]], axis=1).astype(np.float32),
        )


def _quaternion(matrix: Array) -> Array:
    """[N, 4] quaternions of rotation matrices [N, 3, 3] (Shepperd's method)."""
    x, y, z = np.moveaxis(np.diagonal(matrix, axis1=1, axis2=2), 1, 0)
    m = matrix
    a = m[:, 2, 1] - m[:, 1, 2]
    b = m[:, 0, 2] - m[:, 2, 0]
    c = m[:, 1, 0] - m[:, 0, 1]
    d = m[:, 1, 0] + m[:, 0, 1]
    e = m[:, 0, 2] + m[:, 2, 0]
    f = m[:, 2, 1] + m[:, 1, 2]
    rows = ((1 + x + y + z, a, b, c), (a, 1 + x - y - z, d, e), (b, d, 1 - x + y - z, f), (c, e, f, 1 - x - y + z))
    candidates = np.stack([np.stack(row, axis=-1) for row in rows], axis=1)
    best = np.diagonal(candidates, axis1=1, axis2=2).argmax(axis=1)
    chosen = candidates[np.arange(len(matrix)), best]
    return chosen / np.linalg.norm(chosen, axis=1, keepdims=True)


class OnnxActor:
    """The network of an exported policy with its recurrent state. It runs on one core, so that its time is even."""

    def __init__(self, content: bytes) -> None:
        """Load the content of a policy's ONNX file."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        options.intra_op_num_threads = 1
        try:
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise LiveError(f"The policy cannot be read as ONNX: {error}. Export it again.") from error
        self._inputs = self._session.get_inputs()
        self._state: list[Array] = []

    def begin(self, robots: int) -> None:
        """Forget everything."""
        self._state = [np.zeros((1, robots, given.shape[2]), np.float32) for given in self._inputs[2:]]

    def act(self, flat: Array, cloud: Array) -> Array:
        """[N, J] actions for observations [N, F] and clouds [N, H, P, K]."""
        values = (flat, cloud, *self._state)
        feed = {given.name: value for given, value in zip(self._inputs, values, strict=True)}
        actions, *self._state = map(np.asarray, self._session.run(None, feed))
        return np.clip(actions, -1.0, 1.0)


_KNOWN = {
    "observation": {
        "cloud_points", "cloud", "cloud_history", "rotation", "cloud_scale", "contact_force_scale", "joint_target",
        "joint_vel_scale", "content",
    },
    "action": {"arm_step", "arm_lead", "hand", "hand_step", "hand_lead", "hand_zero"},
}  # fmt: skip
"""Options of observations and actions that this file carries out."""


def check_contract(contract: dict[str, Any], source: str) -> None:
    """Refuse, with ``LiveError``, a contract of another schema or with options that this file does not carry out."""
    if contract.get("schema") != SCHEMA:
        raise LiveError(
            f"{source} has schema {str(contract.get('schema'))[:60]!r}, this runtime reads {SCHEMA!r}. "
            "Export the policy again and use the runtime.py of the same folder."
        )
    for part, known in _KNOWN.items():
        unknown = sorted(set(contract[part]) - known)
        if unknown:
            raise LiveError(
                f"{source} needs {part} options that this runtime does not know: {', '.join(unknown)}. "
                "Export the policy again and use the runtime.py of the same folder."
            )


def read_contract(folder: str | Path) -> dict[str, Any]:
    """Read the contract of a folder that ``xreset export deploy`` wrote.

    Raises:
        LiveError: the folder is incomplete, of another version, or its policy is another file than the contract names.
    """
    folder = Path(folder)
    path = folder / CONTRACT
    try:
        contract = json.loads(path.read_text())
        content = (folder / POLICY).read_bytes()
    except (OSError, ValueError) as error:
        raise LiveError(f"{folder} is no exported policy ({error}). Make one: xreset export deploy") from error
    check_contract(contract, str(path))
    found = hashlib.sha256(content).hexdigest()
    if found != contract["policy_sha256"]:
        raise LiveError(
            f"{folder / POLICY} has SHA-256 {found[:12]}, the contract names {contract['policy_sha256'][:12]}. "
            "Export the policy again."
        )
    return contract


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
    """

    def __init__(self, contract: dict[str, Any], actor: OnnxActor | Any = None) -> None:
        """Prepare.

        Args:
            contract: what the policy expects.
            actor: its network.
        """
        self.contract = contract
        self.dt: float = contract["control_dt"]
        self._actor = actor
        self._kinematics = Kinematics(contract["kinematics"])
        joints = contract["joints"]

        def column(name: str, otherwise: float) -> Array:
            values = [otherwise if joint[name] is None else joint[name] for joint in joints]
            return np.array(values, dtype=np.float32)

        self.lower = column("lower", -np.inf)
        self.upper = column("upper", np.inf)
        self._scaled_lower = column("lower", -np.pi)
        self._scaled_upper = column("upper", np.pi)
        self._mapping = {name: column(name, 0.0) for name in ("step", "lead", "zero", "below", "above")}
        self.step_size = self._mapping["step"]
        self._is_arm = np.array([joint["group"] == "arm" for joint in joints])

    def begin(
        self, object_points: Array, goal_pos: Array, goal_quat: Array, target: Array, center: Array | None = None
    ) -> None:
        """Begin an episode.

        Args:
            object_points: [N, P, 3] or [P, 3] points of the object, in its frame; see :meth:`points`.
            goal_pos: [N, 3] or [3] goal position.
            goal_quat: [N, 4] or [4] goal orientation.
            target: [N, J] or [J] present joint targets of the robot.
            center: [N, 3] or [3] origin that the object has for the policy, in its frame; see :meth:`center`. Needed
                where the contract's ``object_frame`` is ``center``.
        """
        self.target = np.atleast_2d(np.asarray(target, dtype=np.float32))
        count = len(self.target)
        expected = self.contract["observation"]["cloud_points"]
        points = np.asarray(object_points, dtype=np.float32)
        if points.shape[-2:] != (expected, 3):
            raise LiveError(f"The object has points of shape {points.shape}, expected ({expected}, 3).")
        self._center: Array | None = None
        if self.contract["object_frame"] == "center":
            if center is None:
                raise LiveError("This policy needs the center of the object. Give center, as Controller.center does.")
            self._center = np.broadcast_to(np.asarray(center, dtype=np.float32), (count, 3))
            points = points - self._center[:, None]
        self._points = np.broadcast_to(points, (count, expected, 3))
        self.set_goal(goal_pos, goal_quat)
        self.action = np.zeros_like(self.target)
        self._cloud: Array | None = None
        self._actor.begin(count)

    def set_goal(self, pos: Array, quat: Array) -> None:
        """Set the goal pose, also while the policy acts; shapes as for :meth:`begin`."""
        count = len(self.target)
        self._goal_quat = np.broadcast_to(np.asarray(quat, dtype=np.float32), (count, 4))
        goal_pos = np.broadcast_to(np.asarray(pos, dtype=np.float32), (count, 3))
        self._goal_pos = self._origin(goal_pos, self._goal_quat)

    def _origin(self, pos: Array, quat: Array) -> Array:
        """[N, 3] where the policy's origin of the object is, for poses [N, 3], [N, 4] of the object's frame."""
        return pos if self._center is None else pos + rotate(quat, self._center)

    def points(self, name: str) -> Array:
        """[P, 3] points of an object of the contract."""
        objects = self.contract["objects"]
        if name not in objects:
            raise LiveError(f"The contract has no object {name!r}. Choose from: {', '.join(objects)}.")
        return np.array(objects[name]["points"], dtype=np.float32)

    def center(self, name: str) -> Array:
        """[3] center of an object of the contract, in its frame."""
        self.points(name)  # refuses an unknown name
        return np.array(self.contract["objects"][name]["center"], dtype=np.float32)

    def step(self, reading: Reading) -> Array:
        """[N, J] new joint targets for a reading with the axis N."""
        flat, cloud = self.observe(reading)
        self.action = self._actor.act(flat, cloud)
        self.target = self._targets(self.action, reading.joint_pos)
        return self.target

    def observe(self, reading: Reading) -> tuple[Array, Array]:
        """Return the policy's inputs: [N, F] flat, and the cloud [N, H, P, K]."""
        o = self.contract["observation"]
        links = reading.links or self._kinematics.links(reading.joint_pos, reading.joint_vel)
        count = len(self.target)
        force = reading.tip_force
        if force is None:
            force = np.zeros_like(links.tip_pos)
        limits = (self._scaled_lower, self._scaled_upper)
        if o["content"] == "published":
            joints = [_scaled(reading.joint_pos, *limits), _scaled(self.target, *limits)]
            return np.concatenate((*self._observe_geometry(reading, links), *joints), axis=1), self._observe_cloud(
                reading
            )
        pose = [self._origin(reading.object_pos, reading.object_quat)]
        if o["rotation"] == "to_goal":
            inverse = reading.object_quat * np.array([1, -1, -1, -1], np.float32)
            pose += [self._goal_pos, _shown(_multiply(self._goal_quat, inverse), o["rotation"])]
        else:
            pose += [_shown(reading.object_quat, o["rotation"]), self._goal_pos]
            pose += [_shown(self._goal_quat, o["rotation"])]
        parts = [
            *pose,
            np.ones((count, 1), np.float32),  # the share of its weight that the object has
            self.action,
            _scaled(reading.joint_pos, *limits),
            np.float32(o["joint_vel_scale"]) * reading.joint_vel,
            links.palm_pos,
            _shown(links.palm_quat, o["rotation"]),
            links.palm_linvel,
            links.palm_angvel,
            links.tip_pos.reshape(count, -1),
            np.clip(np.float32(o["contact_force_scale"]) * force, -1.0, 1.0).reshape(count, -1),
        ]
        if o["joint_target"]:
            parts.append(self.target - reading.joint_pos)
        return np.concatenate(parts, axis=1), self._observe_cloud(reading)

    def _world_points(self, reading: Reading) -> Array:
        """[N, P, 3] the object's points."""
        origin = self._origin(reading.object_pos, reading.object_quat)
        return rotate(reading.object_quat[:, None], self._points) + origin[:, None]

    def _observe_geometry(self, reading: Reading, links: Links) -> tuple[Array, Array]:
        """Return vectors from the fingertips to the nearest points [N, 3 E], and the palm's least distance [N, 1]."""
        count = len(self.target)
        links_pos = np.concatenate((links.palm_pos[:, None], links.tip_pos), axis=1)
        offsets = self._world_points(reading)[:, None] - links_pos[:, :, None]
        nearest = np.square(offsets).sum(axis=-1).argmin(axis=-1)
        vectors = np.take_along_axis(offsets, nearest[:, :, None, None], axis=2)[:, :, 0]
        x, y, z = np.split(np.square(vectors[:, 0]), 3, axis=1)
        return vectors[:, 1:].reshape(count, -1), np.sqrt(x + y + z)

    def _observe_cloud(self, reading: Reading) -> Array:
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
        m = self._mapping
        new = self.target + m["step"] * action
        new = np.clip(new, joint_pos - m["lead"], joint_pos + m["lead"])
        if self.contract["action"]["hand"] == "absolute":
            hand = m["zero"] + np.where(action < 0, m["below"], m["above"]) * action
            new = np.where(self._is_arm, new, hand)
        return np.clip(new, self.lower, self.upper)


class RemoteController(Controller):
    """A policy that ``xreset serve`` runs, perhaps on another computer. It needs websockets on this one."""

    def __init__(self, url: str, timeout: float = 0.5) -> None:
        """Connect.

        Args:
            url: address of the server, such as ``ws://127.0.0.1:8765``.
            timeout: longest time to wait for an answer [s].

        Raises:
            LiveError: there is no such server, or it is of another version.
        """
        from websockets.sync.client import connect

        self._timeout = timeout
        try:
            self._socket = connect(url, open_timeout=5, max_size=None, compression=None)
        except Exception as error:
            raise LiveError(f"No policy is served at {url} ({error}). Start it: xreset serve POLICY") from error
        hello = self._receive()
        if "error" in hello:
            raise LiveError(hello["error"])
        if hello.get("schema") != LIVE_SCHEMA:
            raise LiveError(f"{url} speaks {str(hello.get('schema'))[:60]!r}, this runtime speaks {LIVE_SCHEMA!r}.")
        check_contract(hello["contract"], url)
        super().__init__(hello["contract"])

    def begin(
        self, object_points: Array, goal_pos: Array, goal_quat: Array, target: Array, center: Array | None = None
    ) -> None:
        """Begin an episode of one robot."""
        self.target = np.atleast_2d(np.asarray(target, dtype=np.float32))
        values = {"points": object_points, "goal_pos": goal_pos, "goal_quat": goal_quat, "target": target}
        self._ask({"begin": _lists(values | {"center": center})})

    def set_goal(self, pos: Array, quat: Array) -> None:
        """Set the goal pose."""
        self._ask({"goal": _lists({"goal_pos": pos, "goal_quat": quat})})

    def step(self, reading: Reading) -> Array:
        """[1, J] new joint targets for a reading with the axis N."""
        names = ("joint_pos", "joint_vel", "object_pos", "object_quat", "tip_force")
        values = {name: getattr(reading, name) for name in names}
        found = self._ask({"step": _lists({name: None if v is None else v[0] for name, v in values.items()})})
        self.target = np.array([found["target"]], dtype=np.float32)
        return self.target

    def close(self) -> None:
        """End the connection."""
        self._socket.close()

    def _ask(self, message: dict[str, Any]) -> dict[str, Any]:
        try:
            self._socket.send(json.dumps(message))
        except Exception as error:
            raise LiveError("the server has gone") from error
        answer = self._receive()
        if "error" in answer:
            raise LiveError(answer["error"])
        return answer

    def _receive(self) -> dict[str, Any]:
        try:
            return json.loads(self._socket.recv(timeout=self._timeout))
        except TimeoutError as error:
            raise LiveError(f"the server has not answered for {self._timeout:g} s") from error
        except Exception as error:
            raise LiveError("the server has gone") from error


def _lists(values: dict[str, Any]) -> dict[str, Any]:
    """Return arrays as lists, which JSON can hold; None is left out."""
    return {name: np.asarray(value).tolist() for name, value in values.items() if value is not None}


def load_controller(folder: str | Path) -> Controller:
    """Return the controller of a folder that ``xreset export deploy`` wrote; ``LiveError`` if it cannot be used."""
    contract = read_contract(folder)
    return Controller(contract, OnnxActor((Path(folder) / POLICY).read_bytes()))


# The loop -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True)
class Limits:
    """When a runner stops a robot. None of these numbers was tried on hardware."""

    pose_age: float = 1.0
    """Oldest pose of the object that the policy may act on [s]."""
    joint_age: float = 0.1
    """Oldest joint positions that the policy may act on [s]."""
    joint_margin: float = 0.1
    """How far a joint may be beyond its limit [rad, m]."""
    late: float = 0.5
    """Longest time that one control step may take [s]."""
    slow_down: float = 0.25
    """Time in which targets come to rest [s]."""


@dataclass(kw_only=True)
class Outcome:
    """What became of a run."""

    reasons: list[str | None]
    """[N] why each robot was stopped; None: the time was over."""
    steps: int = 0
    """Control steps that the policy took."""
    missed: int = 0
    """Control steps that were left out, because the one before took too long."""
    refused: Array = field(default_factory=lambda: np.zeros(0, dtype=int))
    """[N] poses that were not used: not finite, or with a time stamp that ran backwards."""

    @property
    def reason(self) -> str | None:
        """Why the first robot was stopped."""
        return self.reasons[0]


class Runner:
    """Keeps a policy's rate on a driver, and stops softly when it cannot go on.

    A pose that is late is used until it is ``pose_age`` old. A pose that is not finite, or older than the last one, is
    ignored. After a fault the targets slow down within ``slow_down``, and then stay.
    """

    def __init__(self, controller: Controller, driver: Driver, limits: Limits | None = None) -> None:
        """Prepare a run.

        Args:
            controller: what acts; its episode has begun.
            driver: where it acts.
            limits: when to stop; None: the defaults.
        """
        self.controller = controller
        self.driver = driver
        self.limits = limits or Limits()
        count = len(controller.target)
        self.outcome = Outcome(reasons=[None] * count, refused=np.zeros(count, dtype=int))
        self._stopped_at = np.full(count, np.inf)
        self._reading: Reading | None = None
        self._refusals = ["no newer one has come"] * count
        self._sent = controller.target
        self._move = np.zeros_like(self._sent)
        self._begun = driver.now()

    def run(self, seconds: float = float("inf")) -> Outcome:
        """Run until the time is over, until every robot has stopped, or until Ctrl-C; then stop the driver."""
        try:
            self._loop(self.driver.now() + seconds - self.controller.dt / 2)
        except KeyboardInterrupt:
            self._stop_all("Ctrl-C was pressed.")
            self._loop(float("inf"))
        finally:
            self.driver.stop()
        return self.outcome

    def _loop(self, end: float) -> None:
        due = self.driver.now()
        while self.driver.now() < min(end, self._stopped_at.max() + self.limits.slow_down):
            if not self._tick():
                return
            due += self.controller.dt
            late = self.driver.now() - due
            if late > 0:
                self.outcome.missed += 1
                due += late  # the rate is kept from here on; no step is made up for
            if late > self.limits.late:
                self._stop_all(f"A control step took {late:.2f} s too long.")
            self.driver.wait_until(due)

    def _tick(self) -> bool:
        """Read, act and send once; return whether the driver still takes targets."""
        now = self.driver.now()
        target = self._sent
        if np.isinf(self._stopped_at).any():
            target = self._act(now)
        going = np.isinf(self._stopped_at)[:, None]
        self._move = np.where(going, target - self._sent, self._move)
        # A target that moves by steps slows down; one that jumps, as an absolute hand target does, stays.
        share = np.clip(1.0 - (now - self._stopped_at) / self.limits.slow_down, 0.0, 1.0)[:, None]
        step = self.controller.step_size
        slowed = self._sent + (share * np.clip(self._move, -step, step)).astype(np.float32)
        slowed = np.clip(slowed, self.controller.lower, self.controller.upper)
        self._sent = np.where(going, target, slowed)
        try:
            self.driver.send(self._sent)
        except Exception as error:
            self._stop_all(f"The driver could not send targets: {error}.")
            return False
        return True

    def _act(self, now: float) -> Array:
        """Return the policy's targets; where it cannot act, the last ones."""
        try:
            self._take(self.driver.read().batched(), now)
        except Exception as error:
            self._stop_all(f"The driver could not read: {error}.")
            return self._sent
        self._check(now)
        going = np.isinf(self._stopped_at)
        reading = self._reading
        has_come = np.isfinite(reading.object_time) & np.isfinite(reading.joint_time) if reading else ~going
        if reading is None or not going.any() or not has_come[going].all():
            return self._sent
        try:
            target = self.controller.step(reading)
        except Exception as error:
            self._stop_all(f"The policy could not act: {error}.")
            return self._sent
        self.outcome.steps += 1
        sound = np.isfinite(target).all(axis=1)
        for robot in np.flatnonzero(going & ~sound):
            self._stop(int(robot), "The policy gave numbers that are not finite.")
        return np.where(sound[:, None], target, self._sent)

    def _take(self, new: Reading, now: float) -> None:
        """Keep what is sound of a reading, and the last sound values of the rest."""
        joints_sound = _finite(new.joint_pos) & _finite(new.joint_vel)
        if new.tip_force is not None:
            joints_sound &= _finite(new.tip_force.reshape(len(joints_sound), -1))
        length = np.linalg.norm(new.object_quat, axis=1)
        pose_sound = _finite(new.object_pos) & (np.abs(length - 1.0) < 0.01)
        old = self._reading
        if old is None:
            nothing = np.full(len(joints_sound), -np.inf)
            old = replace(new, joint_time=nothing, object_time=nothing)
        forward = new.object_time >= old.object_time
        real = new.object_time <= now + 0.1
        for fine, problem in (
            (real, "newer ones have time stamps ahead of the robot's clock"),
            (forward, "the time stamps of newer ones run backwards"),
            (pose_sound, "newer ones hold numbers that are not finite, or no unit quaternion"),
        ):
            for robot in np.flatnonzero(~fine):
                self._refusals[robot] = problem
        usable = pose_sound & forward & real
        self.outcome.refused += ~usable
        for robot in np.flatnonzero(usable & (new.object_time > old.object_time)):
            self._refusals[robot] = "no newer one has come"
        joint_names = ("joint_pos", "joint_vel", "joint_time", "tip_force", "links")
        kept = {name: _rows(joints_sound, getattr(new, name), getattr(old, name)) for name in joint_names}
        for name in ("object_pos", "object_quat", "object_time"):
            kept[name] = _rows(usable, getattr(new, name), getattr(old, name))
        self._reading = Reading(**kept)

    def _check(self, now: float) -> None:
        """Stop the robots whose data are too old, or whose joints are beyond a limit."""
        reading = self._reading
        assert reading is not None
        limits = self.limits
        for time_of, limit, text in (
            (reading.object_time, limits.pose_age, "The pose of the object is {age:.2f} s old: {refusal}."),
            (reading.joint_time, limits.joint_age, "The joint positions are {age:.2f} s old, or not finite."),
        ):
            age = now - np.maximum(time_of, self._begun)
            for robot in np.flatnonzero(age > limit):
                self._stop(int(robot), text.format(age=age[robot], refusal=self._refusals[robot]))
        below = reading.joint_pos < self.controller.lower - limits.joint_margin
        above = reading.joint_pos > self.controller.upper + limits.joint_margin
        for robot, joint in np.argwhere(below | above):
            bound = (self.controller.lower if below[robot, joint] else self.controller.upper)[joint]
            name = self.controller.contract["joints"][joint]["name"]
            found = reading.joint_pos[robot, joint]
            self._stop(int(robot), f"Joint {name} is at {found:.2f}, beyond its limit {bound:.2f}.")

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


def _finite(values: Array) -> Array:
    return np.asarray(np.isfinite(values).all(axis=1))


def _rows(chosen: Array, new: Any, old: Any) -> Any:
    """Return the chosen rows [N] of new values, and the other rows of old ones."""
    if new is None or chosen.all():
        return new
    if isinstance(new, Links):
        parts = {each.name: _rows(chosen, getattr(new, each.name), getattr(old, each.name)) for each in fields(Links)}
        return Links(**parts)
    return np.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def measure(controller: Controller, steps: int = 1000) -> dict[str, float]:
    """Return mean and 99th percentile of the time of a step [ms], and the memory of the process [MB].

    The robot is at home, the object in front of it; the numbers mean nothing else.
    """
    contract = controller.contract
    home = np.array([joint["home"] for joint in contract["joints"]], dtype=np.float32)
    pos = np.array([0.5, 0.0, 0.1])
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    points = np.zeros((contract["observation"]["cloud_points"], 3))
    controller.begin(points, pos, quat, home, np.zeros(3))
    reading = Reading(
        joint_pos=home,
        joint_vel=np.zeros_like(home),
        joint_time=0.0,
        object_pos=pos,
        object_quat=quat,
        object_time=0.0,
        tip_force=np.zeros((len(contract["fingertips"]), 3)),
    )
    times = []
    for _ in range(steps):
        began = time.perf_counter()
        controller.step(reading.batched())
        times.append(1000.0 * (time.perf_counter() - began))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {"mean_ms": float(np.mean(times)), "p99_ms": float(np.percentile(times, 99)), "memory_mb": memory}


def main() -> None:
    """Check the folder of this file, and measure how long a step takes on this computer."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else __file__)
    try:
        controller = load_controller(folder if folder.is_dir() else folder.parent)
    except LiveError as error:
        sys.exit(f"runtime.py: {error}")
    contract = controller.contract
    found = measure(controller)
    print(f"{contract['robot']}, {len(contract['joints'])} joints, one step every {1000 * controller.dt:.1f} ms")
    print(f"objects: {', '.join(contract['objects'])}")
    print(
        f"a step takes {found['mean_ms']:.2f} ms (99th percentile {found['p99_ms']:.2f} ms) on one core; "
        f"{found['memory_mb']:.0f} MB of memory"
    )


if __name__ == "__main__":
    main()
