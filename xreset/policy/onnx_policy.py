"""Policies that turn observations into actions, world by world.

A trained policy is an ONNX file with its contract: robot, joint order, observation layout, action mapping and control
rate. Reading a policy needs no torch, and running it neither warp nor rsl-rl.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from copy import copy
from dataclasses import asdict, replace
from hashlib import sha256
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from xreset.errors import FileFormatError, PolicyError, RobotError, WrongValueError, needs
from xreset.files.checks import parsed
from xreset.files.storage import code_version, max_bytes, must_exist, parse_json
from xreset.files.text import shown
from xreset.spec import RobotSpec
from xreset.task.config import TaskConfig
from xreset.task.contract import SCHEMA, Contract

if TYPE_CHECKING:  # functions import torch, so that policies are read without it
    from tensordict import TensorDict
    from torch import Tensor

    from xreset.env.manipulation import ManipulationEnv

METADATA_KEY = "xreset"
"""Key of the ONNX metadata entry that holds the contract as JSON."""
VERSION_KEY = "xreset-version"
"""Key of the ONNX metadata entry that holds the version and commit of xreset."""
CHECKPOINT_KEY = "xreset-checkpoint"
"""Key of the entry with the SHA-256 of the checkpoint."""
INPUTS = ("flat", "cloud", "h_in", "c_in")
"""Inputs of the ONNX graph: the two flat groups of ``TaskConfig.policy_groups`` in one [N, D], the clouds [N, H, P, K]
or images, and the LSTM's state, two tensors [1, N, units]."""
OUTPUTS = ("actions", "h_out", "c_out")
"""Outputs of the ONNX graph: mean actions [N, J], not limited yet, and the LSTM's next state."""

_LISTED = 3
"""Entries that a message names of all in which a contract differs."""


class Policy(Protocol):
    """Interface of a policy."""

    def begin(self, env: ManipulationEnv) -> None:
        """Prepare for new episodes in every world of the environment. A policy without memory does nothing."""

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] actions in [-1, 1]."""
        ...


def policy_contract(
    robot: RobotSpec,
    task: TaskConfig,
    objects: tuple[str, ...],
    others: Sequence[RobotSpec] = (),
) -> Contract:
    """Return everything that must agree between training and evaluation; ``others``: further robots of a training."""
    from xreset.task.observations import layout

    sizes = task.sizes(len(robot.joints), len(robot.fingertips))
    return Contract(
        schema=SCHEMA,
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        joint_names=robot.joint_names,
        fingertip_names=robot.fingertip_names,
        objects=objects,
        observation_layout=layout(*sizes, task.observation, task.vision),
        control_dt=task.control_dt,
        task=task,
        others={other.name: other.fingerprint for other in others},
    )


def contract_metadata(contract: Contract) -> dict[str, str]:
    """Return the entries of ONNX metadata that state a contract and the version of xreset.

    Keys keep their order: the order of the observations' terms is that of the policy's columns.
    """
    return {METADATA_KEY: json.dumps(asdict(contract)), VERSION_KEY: code_version()}


def check_robot_of(source: str, contract: Contract, robot: RobotSpec) -> None:
    """Refuse a policy of another robot; ``PolicyError`` as of :func:`check_contract`."""
    here = replace(
        contract,
        robot=robot.name,
        robot_fingerprint=robot.fingerprint,
        joint_names=robot.joint_names,
        fingertip_names=robot.fingertip_names,
    )
    _compare(source, contract, here, robot)


def check_contract(source: str, contract: Contract, robot: RobotSpec, task: TaskConfig) -> None:
    """Refuse to run a policy where its observations or actions would mean something else.

    Raises:
        PolicyError: a part of the contract differs. The message names the first such part.
    """
    try:
        here = policy_contract(robot, task, ())
    except WrongValueError as error:
        raise PolicyError(f"The contract of {source}: {error}. Export the policy again.") from error
    _compare(source, contract, here, robot)


def of_another_robot(source: str, trained: str, wanted: str) -> PolicyError:
    """Return the refusal of a policy, given the names of its robot and of the robot that shall play it."""
    return PolicyError(
        f"{source} is a policy of the robot {trained!r}, not of {wanted!r}. Give a policy of {wanted!r} (xreset "
        f"policies lists those that ship), or use the robot {trained!r}."
    )


def _compare(source: str, contract: Contract, here: Contract, robot: RobotSpec) -> None:
    """Raise ``PolicyError`` for the first part in which a contract differs from the one of a robot and a task here."""
    if contract.task.joint_slots is not None:
        contract = _for_robot(contract, robot)
    if robot.like and contract.robot_fingerprint == robot.like:
        here = replace(here, robot=contract.robot, robot_fingerprint=robot.like)
    if contract.robot != here.robot:
        raise of_another_robot(source, contract.robot, robot.name)
    use_robot = f"Use the robot {contract.robot!r}."
    fixes = {
        "joint order": use_robot,
        "fingertips": use_robot,
        "version of the robot": "Its URDF or description has changed. Train again.",
        "observation layout": "Use the run's own configuration, or train again if it is of an earlier xreset.",
    }
    meaning_here = _meaning(here)
    for part, trained in _meaning(contract).items():
        needed = meaning_here[part]
        differing = [
            f"{name}: {trained.get(name)!r}, here {needed.get(name)!r}"
            for name in trained | needed
            if trained.get(name) != needed.get(name)
        ]
        if len(differing) > _LISTED:
            differing = [*differing[:_LISTED], f"and {len(differing) - _LISTED} more"]
        if differing:
            fix = fixes.get(part, "Use the run's own configuration.")
            raise PolicyError(
                f"{source} was trained with another {part} ({'; '.join(differing)}). {fix}"
            )


def _for_robot(contract: Contract, robot: RobotSpec) -> Contract:
    """Return the contract of a policy for several robots as it is for one, of which the training may know nothing.

    Raises:
        PolicyError: the robot does not fit into the slots.
    """
    from xreset.task.slots import check_fits

    assert contract.task.joint_slots is not None
    try:
        check_fits(robot, contract.task.joint_slots)
    except RobotError as error:
        raise PolicyError(str(error)) from error
    known = {contract.robot: contract.robot_fingerprint} | contract.others
    return replace(
        contract,
        robot=robot.name,
        robot_fingerprint=known.get(robot.name, robot.fingerprint),
        joint_names=robot.joint_names,
        fingertip_names=robot.fingertip_names,
    )


def _meaning(contract: Contract) -> dict[str, dict[str, Any]]:
    """Return the entries that define what observations and actions mean, by part of the contract and name."""
    task = asdict(contract.task)
    observation = asdict(contract.task.observation.without_noise())
    order = {
        group: ", ".join(terms)
        for group, terms in asdict(contract.task.observation).items()
        if isinstance(terms, dict)
    }
    widths = {}
    for group, terms in contract.observation_layout.items():
        widths |= {f"{group}.{term}": width for term, width in terms.items()}
    return {
        "joint order": {f"joint_names[{i}]": name for i, name in enumerate(contract.joint_names)},
        "fingertips": {"fingertip_names": contract.fingertip_names},
        "version of the robot": {"robot_fingerprint": contract.robot_fingerprint},
        "time between actions": {"control_dt": contract.control_dt},
        "observation layout": widths,
        "order of observations": order,
        "action mapping": task["action"] | {"joint_slots": task["joint_slots"]},
        "scale of observations": observation,
        "frame of objects": {"object_frame": task["object_frame"]},
        "set of cameras": task["vision"],
    }


def parsed_contract(source: str, contract: Any, version: str | None = None) -> Contract:
    """Return a contract with types; ``PolicyError`` if it lacks an entry or holds one of another type.

    Args:
        source: name of the policy in messages.
        contract: as read from JSON.
        version: the version of xreset that exported the policy, if it states it.
    """
    typed, problems = parsed(Contract, contract, f"The contract of {source}", version)
    if typed is None:
        raise PolicyError(" ".join([*problems, "Export the policy again."]))
    return typed


def group_widths(contract: Contract, source: str) -> dict[str, int]:
    """Return the number of values of one world's observations, by group, in the order of ``TaskConfig.policy_groups``.

    Raises:
        PolicyError: the contract, which comes from ``source``, does not state the width of a group.
    """
    groups = contract.task.policy_groups
    if missing := [name for name in groups if name not in contract.observation_layout]:
        raise PolicyError(
            f"{source} does not state what it observes of {', '.join(missing)}. Export it again."
        )
    return {name: sum(contract.observation_layout[name].values()) for name in groups}


def observation_shapes(contract: Contract, source: str) -> dict[str, tuple[int, ...]]:
    """Return the shape of one world's observations, by group; errors as of :func:`group_widths`."""
    shapes: dict[str, tuple[int, ...]] = {}
    for name, width in group_widths(contract, source).items():
        shapes[name] = (width,)
    shapes[contract.task.policy_groups[-1]] = picture_shape(contract.task)
    return shapes


def picture_shape(task: TaskConfig) -> tuple[int, ...]:
    """Return the shape of the last of ``task.policy_groups`` for one world."""
    from xreset.task.observations import cloud_shape

    return task.vision.view_shape if task.vision.cameras else cloud_shape(task.observation)


def policy_content(path: Path) -> bytes:
    """Return the content of a policy's file; ``PolicyError`` if it cannot be read, or is too large."""
    try:
        must_exist(path, "policy")
    except FileFormatError as error:
        raise PolicyError(str(error)) from error
    if path.stat().st_size > max_bytes():
        raise PolicyError(
            f"{path} has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows."
        )
    return path.read_bytes()


class OnnxPolicy:
    """A trained policy from an ONNX file, with its recurrent state.

    Attributes:
        path: the file.
        name: name of the file, or of its folder if the file is called ``policy.onnx``.
        contract: see :func:`policy_contract`.
        content: content of the file.
        hash: SHA-256 of the content.
    """

    def __init__(self, path: str | Path, content: bytes | None = None) -> None:
        """Load the file.

        Args:
            path: file, or what messages call the content.
            content: content of the file; None: it is read.

        Raises:
            PolicyError: it is missing, damaged, or not a policy of xreset.
        """
        path = Path(path)
        self.path = path
        self.content = policy_content(path) if content is None else content
        self.hash = sha256(self.content).hexdigest()
        with needs("onnxruntime", "eval", PolicyError):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        # Otherwise onnxruntime's threads spin between the steps, which costs as much as the physics.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        try:
            self._session = onnxruntime.InferenceSession(
                self.content,
                options,
                providers=["CPUExecutionProvider"],
                enable_fallback=0,  # no other provider, which onnxruntime would announce
            )
            metadata = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:
            raise PolicyError(_why_unreadable(path, error)) from error
        self.contract = _read_contract(path, metadata)
        self._state: list[np.ndarray] | None = None
        self._try_step(path)
        self.name = path.stem if path.stem != "policy" else path.resolve().parent.name

    def _try_step(self, path: Path) -> None:
        """Take one step with zeros, so that a policy that cannot act is refused before work begins."""
        *flat, picture = group_widths(self.contract, str(path)).values()
        worlds = 2
        try:
            inputs = self._session.get_inputs()
            shape = inputs[1].shape[1:]
            if prod(shape) != picture:
                raise ValueError(
                    f"its picture is {shape}, and the contract states {picture} numbers"
                )
            self._lstm_dim: int = inputs[2].shape[2]
            outputs = self._outputs(
                np.zeros((worlds, sum(flat)), np.float32), np.zeros((worlds, *shape), np.float32)
            )
            found = [f"{value.dtype} {value.shape}" for value in outputs]
        except Exception as error:
            raise PolicyError(
                f"{path} cannot act: {shown(str(error))}. Export it again."
            ) from error
        state = (1, worlds, self._lstm_dim)
        shapes = ((worlds, self.contract.num_actions), state, state)
        expected = [f"float32 {shape}" for shape in shapes]
        if found != expected:
            raise PolicyError(
                f"{path} gives {found} for {worlds} worlds, expected {expected}. Export it again."
            )
        if not all(np.isfinite(value).all() for value in outputs):
            raise PolicyError(
                f"{path} gives numbers that are not finite: its training broke down, or the file is damaged."
            )

    def another(self) -> OnnxPolicy:
        """Return the same policy, whatever has become of its file, with a recurrent state of its own."""
        policy = copy(self)
        policy._state = None
        return policy

    def begin(self, env: ManipulationEnv) -> None:
        """Zero the recurrent state.

        Raises:
            PolicyError: observations or actions have another meaning in this environment.
        """
        check_contract(str(self.path), self.contract, env.backend.scene.robot, env.task)
        self._state = None

    def act(self, observations: TensorDict | dict[str, Tensor]) -> Tensor:
        """[N, J] mean action, on the observations' device."""
        import torch

        values = []
        for name in self.contract.task.policy_groups:
            value = observations.get(name, None)
            if not isinstance(value, torch.Tensor) or value.dim() < 2:
                raise PolicyError(
                    f"observations[{name!r}] is {shown(value)}, expected a tensor [N, ...] of env.get_observations()."
                )
            values.append(value)
        *flat, picture = values
        joined = torch.cat(flat, dim=-1)
        actions, *state = self._outputs(joined.cpu().numpy(), picture.cpu().numpy())
        self._state = [np.array(value) for value in state]
        return torch.as_tensor(actions, device=joined.device).clamp(-1.0, 1.0)

    def _outputs(self, flat: np.ndarray, picture: np.ndarray) -> list[np.ndarray]:
        """Return the graph's outputs: actions [N, J] without limits, and the LSTM's next state."""
        shape = (1, len(flat), self._lstm_dim)
        if self._state is None or self._state[0].shape != shape:
            self._state = [np.zeros(shape, dtype=np.float32) for _ in range(2)]
        values = dict(zip(INPUTS, (flat, picture, *self._state), strict=True))
        outputs: Any = self._session.run(OUTPUTS, values)
        return outputs


def _read_contract(path: Path, metadata: dict[str, str]) -> Contract:
    """Return the contract in an ONNX file's metadata; ``PolicyError`` if there is none, or it is damaged."""
    if METADATA_KEY not in metadata:
        raise PolicyError(
            f"{path} is an ONNX file without xreset's contract: it was not exported by xreset."
        )
    try:
        contract = parse_json(metadata[METADATA_KEY])
    except ValueError as error:
        raise PolicyError(
            f"{path} holds a contract that is not valid JSON ({error}). Export it again."
        ) from error
    return parsed_contract(str(path), contract, metadata.get(VERSION_KEY))


def _why_unreadable(path: Path, error: Exception) -> str:
    """Return what is wrong with a file that onnxruntime cannot read, and what to give instead."""
    expected = "a run folder, a .onnx file or the name of a policy that ships with xreset"
    if path.suffix == ".pt":
        return (
            f"{path} is a training checkpoint, expected {expected}. Give it in its run folder "
            "(RUN/checkpoints/NUMBER.pt), or export it with xreset.export_checkpoint."
        )
    if path.suffix != ".onnx":
        return f"{path} is not an exported policy, expected {expected}."
    return f"{path} cannot be read as an ONNX policy: {shown(str(error))}. Is it damaged?"
