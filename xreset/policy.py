"""Policies as evaluation sees them: something that turns observations into actions, world by world.

A trained policy is an ONNX file that carries its own contract: robot, joint order, observation layout, action mapping and control rate.
Running one needs neither warp nor rsl-rl.
"""

from __future__ import annotations

import json
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch
from torch import Tensor

from xreset.checks import from_dict
from xreset.errors import PolicyError, needs
from xreset.files import max_bytes, parse_json
from xreset.spec import RobotSpec
from xreset.task.config import NoiseConfig, TaskConfig
from xreset.task.observations import layout
from xreset.text import shown

if TYPE_CHECKING:
    from tensordict import TensorDict

    from xreset.env import ManipulationEnv

SCHEMA = "xreset-policy/1"
METADATA_KEY = "xreset"
"""Key of the ONNX metadata entry that holds the contract as JSON."""
INPUTS = ("flat", "cloud", "h_in", "c_in")
"""Of the ONNX graph: the observation's groups ``policy`` and ``proprio`` side by side, its point clouds, and the LSTM's state."""
OUTPUTS = ("actions", "h_out", "c_out")
"""Of the ONNX graph: actions, and the LSTM's next state."""


class Policy(Protocol):
    """What evaluation asks of a policy."""

    name: str

    def begin(self, env: ManipulationEnv) -> None:
        """Called when episodes have just begun in every world of the environment."""
        ...

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] actions in [-1, 1]."""
        ...


def policy_contract(robot: RobotSpec, task: TaskConfig, objects: tuple[str, ...]) -> dict[str, Any]:
    """Everything that must agree between training and evaluation, as JSON."""
    return {
        "schema": SCHEMA,
        "robot": robot.name,
        "robot_fingerprint": robot.fingerprint,
        "joint_names": list(robot.joint_names),
        "fingertip_names": list(robot.fingertip_names),
        "objects": list(objects),
        "observation_layout": layout(len(robot.joints), len(robot.fingertips), task.observation),
        "control_dt": task.timestep * task.substeps,
        "task": json.loads(json.dumps(asdict(task))),  # as it will be read back: lists for tuples
    }


def check_contract(source: str, contract: dict[str, Any], robot: RobotSpec, task: TaskConfig) -> None:
    """Refuse to run a policy where its observations or actions would mean something else.

    Raises:
        PolicyError: names the first thing that differs.
    """
    here = policy_contract(robot, task, ())
    check_contract_entries(source, contract)
    if contract["robot_fingerprint"] == robot.like:
        here |= {key: contract[key] for key in ("robot", "robot_fingerprint")}
    for key, what in (("robot", "robot"), ("joint_names", "joint order"), ("fingertip_names", "fingertips")):
        if contract[key] != here[key]:
            raise PolicyError(
                f"{source} was trained with another {what}: {contract[key]}, here it is {here[key]}. Use --robot {contract['robot']}."
            )
    fingerprint = contract["robot_fingerprint"]
    if fingerprint != robot.like and not robot.has_fingerprint(fingerprint):
        raise PolicyError(
            f"{source} was trained on another version of {robot.name!r}: its URDF or description has changed. Train again."
        )
    if contract["observation_layout"] != here["observation_layout"]:
        differing = [
            f"{group}.{term}: {theirs.get(term)} in the policy, {ours.get(term)} here"
            for group in here["observation_layout"]
            for theirs, ours in [(contract["observation_layout"].get(group, {}), here["observation_layout"][group])]
            for term in dict.fromkeys([*theirs, *ours])
            if theirs.get(term) != ours.get(term)
        ]
        raise PolicyError(
            f"{source} was trained with another observation layout ({'; '.join(differing)}). Use the run's own configuration."
        )
    trained = from_dict(TaskConfig, contract["task"], f"{source}: task")
    quiet = NoiseConfig()
    meanings = (
        ("another action mapping", trained.action, task.action),
        (
            "other scales of observations",
            replace(trained.observation, noise=quiet),
            replace(task.observation, noise=quiet),
        ),
    )
    for what, of_policy, of_task in meanings:
        differing = [
            f"{f.name}: {getattr(of_policy, f.name)!r} in the policy, {getattr(of_task, f.name)!r} here"
            for f in fields(of_policy)
            if getattr(of_policy, f.name) != getattr(of_task, f.name)
        ]
        if differing:
            raise PolicyError(
                f"{source} was trained with {what} ({'; '.join(differing)}). Use the run's own configuration."
            )
    if abs(contract["control_dt"] - here["control_dt"]) > 1e-9:
        raise PolicyError(
            f"{source} acts every {contract['control_dt']:.6f} s, here a control step lasts {here['control_dt']:.6f} s."
        )


_ENTRIES: dict[str, type | tuple[type, ...]] = {
    "robot": str, "robot_fingerprint": str, "joint_names": list, "fingertip_names": list, "objects": list, "observation_layout": dict,
    "control_dt": (int, float), "task": dict,
}  # fmt: skip


def check_contract_entries(source: str, contract: dict[str, Any]) -> None:
    """Refuse a contract that lacks an entry or holds one of another type; ``PolicyError``."""
    if contract.get("schema") != SCHEMA:
        raise PolicyError(
            f"{source} has policy schema {contract.get('schema')!r}, expected {SCHEMA!r}. Export it again."
        )
    wrong = [name for name, kind in _ENTRIES.items() if not isinstance(contract.get(name), kind)]
    texts = ("joint_names", "fingertip_names", "objects")
    wrong += [name for name in texts if name not in wrong and not all(isinstance(text, str) for text in contract[name])]
    if "observation_layout" not in wrong and not _is_layout(contract["observation_layout"]):
        wrong.append("observation_layout")
    if wrong:
        raise PolicyError(
            f"{source} states a contract in which {', '.join(wrong)} is missing or of another type. Export it again."
        )


def _is_layout(layout: dict[str, Any]) -> bool:
    widths = [width for terms in layout.values() for width in (terms.values() if isinstance(terms, dict) else [None])]
    return {"policy", "proprio"} <= set(layout) and all(type(width) is int and 0 < width < 1 << 20 for width in widths)


def _read_contract(path: Path, metadata: dict[str, str]) -> dict[str, Any]:
    if METADATA_KEY not in metadata:
        raise PolicyError(f"{path} is an ONNX file without xreset's contract: it was not exported by xreset.")
    try:
        contract = parse_json(metadata[METADATA_KEY])
    except ValueError as error:
        raise PolicyError(f"{path} holds a contract that is not valid JSON ({error}). Export it again.") from error
    check_contract_entries(str(path), contract)
    return contract


_MAX_LSTM = 65536
"""Units of an LSTM: far more than any policy has, and its state still fits into memory."""


class OnnxPolicy:
    """A trained policy from an ONNX file, with its recurrent state."""

    def __init__(self, path: str | Path) -> None:
        """Load the file.

        Raises:
            PolicyError: it is missing, damaged, or not a policy of xreset.
        """
        path = Path(path)
        if not path.is_file():
            raise PolicyError(f"there is no policy file {path}.")
        with needs("onnxruntime", "eval", PolicyError):
            import onnxruntime
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        if path.stat().st_size > max_bytes():
            raise PolicyError(f"{path} has {path.stat().st_size >> 20} MB, more than XRESET_MAX_FILE_MB allows.")
        try:
            self._session = onnxruntime.InferenceSession(
                path.read_bytes(), options, providers=["CPUExecutionProvider"], enable_fallback=0
            )  # to nothing else, which it would announce
            metadata = self._session.get_modelmeta().custom_metadata_map
        except Exception as error:
            raise PolicyError(
                f"{path} cannot be read as an ONNX policy: {shown(str(error))}. Is it damaged?"
            ) from error
        self.contract = _read_contract(path, metadata)
        inputs = tuple(given.name for given in self._session.get_inputs())
        if inputs != INPUTS:
            raise PolicyError(
                f"{path} takes the inputs {shown(inputs)}; a policy takes {', '.join(INPUTS)}. Export it again."
            )
        self._lstm_dim = self._try(path)
        self.name = path.stem if path.stem != "policy" else path.resolve().parent.name
        self._state: list[np.ndarray] | None = None

    def _try(self, path: Path) -> int:
        """One step with zeros, so that what cannot act is refused before work begins; returns the units of the LSTM."""
        shape = self._session.get_inputs()[2].shape
        width = shape[2] if len(shape) == 3 else None
        if not isinstance(width, int) or not 0 < width <= _MAX_LSTM:
            raise PolicyError(
                f"{path} has an LSTM state of shape {shown(shape)}, expected (1, worlds, 1 to {_MAX_LSTM}). Export it again."
            )
        task = from_dict(TaskConfig, self.contract["task"], f"{path}: task").observation
        layout_, worlds = self.contract["observation_layout"], 2
        shapes = {
            "flat": (worlds, sum(sum(layout_[group].values()) for group in ("policy", "proprio"))),
            "cloud": (worlds, *task.cloud_shape),
            "h_in": (1, worlds, width),
            "c_in": (1, worlds, width),
        }
        try:
            found: Any = self._session.run(
                None, {name: np.zeros(shape, dtype=np.float32) for name, shape in shapes.items()}
            )
        except Exception as error:
            raise PolicyError(f"{path} cannot act: {shown(str(error))}. Export it again.") from error
        expected = [(worlds, len(self.contract["joint_names"])), shapes["h_in"], shapes["c_in"]]
        if [getattr(value, "shape", None) for value in found] != expected or any(
            value.dtype != np.float32 for value in found
        ):
            described = ", ".join(
                f"{value.dtype} {value.shape}" if isinstance(value, np.ndarray) else type(value).__name__
                for value in found
            )
            raise PolicyError(
                f"{path} gives {described} for {worlds} worlds, expected float32 {', '.join(map(str, expected))}. Export it again."
            )
        if not all(np.isfinite(value).all() for value in found):
            raise PolicyError(
                f"{path} gives numbers that are not finite: its training broke down, or the file is damaged."
            )
        return width

    def begin(self, env: ManipulationEnv) -> None:
        """Zero the recurrent state."""
        self._state = None

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] mean action, on the observations' device."""
        flat = torch.cat((observations["policy"], observations["proprio"]), dim=-1)
        n = flat.shape[0]
        if self._state is None or self._state[0].shape[1] != n:
            self._state = [np.zeros((1, n, self._lstm_dim), dtype=np.float32) for _ in range(2)]
        feed = {
            "flat": flat.cpu().numpy(),
            "cloud": observations["perception"].cpu().numpy(),
            "h_in": self._state[0],
            "c_in": self._state[1],
        }
        actions, h, c = self._session.run(None, feed)
        self._state = [np.array(h), np.array(c)]
        return torch.as_tensor(actions, device=flat.device).clamp(-1.0, 1.0)


class ZeroPolicy:
    """Action zero: the arm stays, the hand goes where action zero sends it. A baseline and a smoke test."""

    name = "zero"

    def __init__(self, num_actions: int) -> None:
        self._num_actions = num_actions

    def begin(self, env: ManipulationEnv) -> None:
        """Nothing to forget."""

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] zeros."""
        flat = observations["policy"]
        return torch.zeros(flat.shape[0], self._num_actions, device=flat.device)


class RandomPolicy:
    """Uniform actions in [-1, 1], the same for the same seed in every engine."""

    name = "random"

    def __init__(self, num_actions: int, seed: int) -> None:
        self._num_actions, self._generator = num_actions, torch.Generator().manual_seed(seed)

    def begin(self, env: ManipulationEnv) -> None:
        """Nothing to forget."""

    def act(self, observations: TensorDict) -> Tensor:
        """[N, J] uniform."""
        flat = observations["policy"]
        return (2.0 * torch.rand(flat.shape[0], self._num_actions, generator=self._generator) - 1.0).to(flat.device)
