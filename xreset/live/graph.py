"""A deployed policy as one ONNX graph: readings in, joint targets out.

The graph is made of the code that trains: :mod:`xreset.task.observations` and :mod:`xreset.task.actions` are exported
by torch, and joined with the network of an exported policy. ``docs/live.md`` has the inputs and outputs.

Shape letters: N robots, J joints, E fingertips, P points, H frames of history, K numbers per point, M numbers in the
memory.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy
from math import prod
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from xreset.errors import PolicyError, needs
from xreset.files.text import shown
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat, quat_rotate
from xreset.physics import Links, State
from xreset.policy.to_onnx import exported_module
from xreset.spec import RobotSpec
from xreset.task.actions import ActionSpace
from xreset.task.config import TaskConfig
from xreset.task.observations import ObservationInput, Observer, cloud_shape
from xreset.task.slots import Slots

if TYPE_CHECKING:
    from onnx import ModelProto, ValueInfoProto

OPSET = 18
"""Version of the ONNX operators: browsers and older runtimes know it."""
_IR_VERSION = 9
_EXAMPLES = 2
"""Robots in the example that torch exports: not 1, so that their number stays free."""


class _Observed(ObservationInput):
    """What a robot knows, without the noise of trainings."""

    def noisy(self, values: Tensor, std: float) -> Tensor:
        return values

    def noisy_quat(self, std: float) -> Tensor:
        return self.observed_quat


class Observe(nn.Module):
    """From readings and memory to the network's inputs.

    Memory [N, M] holds, in this order: 1 after the first step, the last action [J], the object's orientation in the
    first step [4], the clouds [H * P * K] if the network sees more than one frame, and the network's own state.
    """

    def __init__(self, robot: RobotSpec, task: TaskConfig, state_widths: Sequence[int]) -> None:
        super().__init__()
        self._observer = Observer(task.observation, Slots.of(robot, task.joint_slots))
        self._links = robot.tracked_links
        self._kinematics = Kinematics(robot, dtype=torch.float32)
        actions = ActionSpace(robot, task.action)
        self._lower = actions.lower.nan_to_num(neginf=-torch.pi)
        self._upper = actions.upper.nan_to_num(posinf=torch.pi)
        self._has_center = task.object_frame == "center"
        self._cloud_shape = cloud_shape(task.observation)
        has_history = self._cloud_shape[0] > 1
        self.kept = 4 + prod(self._cloud_shape) * has_history
        """Numbers of the memory that neither the network nor the actions write."""
        self._widths = (1, len(robot.joints), 4, self.kept - 4, *state_widths)
        self.memory = sum(self._widths)
        """M"""

    def forward(
        self,
        joint_pos: Tensor,
        joint_vel: Tensor,
        joint_target: Tensor,
        object_pos: Tensor,
        object_quat: Tensor,
        tip_force: Tensor,
        goal_pos: Tensor,
        goal_quat: Tensor,
        object_points: Tensor,
        object_normals: Tensor,
        object_center: Tensor,
        memory: Tensor,
    ) -> tuple[Tensor, ...]:
        """Return the flat observations, the clouds, the network's state, the kept part of the memory, and links."""
        has_begun, action, start_quat, clouds, *state = memory.split(self._widths, dim=1)
        is_first = has_begun < 0.5
        start_quat = torch.where(is_first, object_quat, start_quat)
        origin = object_pos
        goal = goal_pos
        if self._has_center:
            origin = object_pos + quat_rotate(object_quat, object_center)
            goal = goal_pos + quat_rotate(goal_quat, object_center)
            object_points = object_points - object_center[:, None]
        pos, rot, linvel, angvel = self._kinematics.motion(joint_pos, joint_vel, self._links)
        unknown: Any = None  # no robot measures it
        x = _Observed(
            state=State(
                joint_pos=joint_pos,
                joint_vel=joint_vel,
                joint_target=joint_target,
                object_pos=origin,
                object_quat=object_quat,
                object_linvel=unknown,
                object_angvel=unknown,
            ),
            links=Links(pos=pos, quat=matrix_to_quat(rot), linvel=linvel, angvel=angvel),
            joint_target=joint_target,
            joint_lower=self._lower,
            joint_upper=self._upper,
            points=object_points,
            normals=object_normals,
            observed_pos=origin,
            observed_quat=object_quat,
            goal_pos=goal,
            goal_quat=goal_quat,
            start_quat=start_quat,
            gravity_fraction=torch.ones_like(joint_pos[:, 0]),
            previous_action=action,
            tip_force=tip_force,
            tip_distance=unknown,
            reward=unknown,
            generator=unknown,
        )
        flat = torch.cat((self._group("policy", x), self._group("proprio", x)), dim=1)
        cloud = self._group("perception", x)
        if clouds.shape[1]:
            before = clouds.unflatten(1, self._cloud_shape)
            history = torch.cat((before[:, 1:], cloud[:, -1:]), dim=1)
            cloud = torch.where(is_first[:, :, None, None], cloud, history)
            clouds = cloud.flatten(1)
        kept = torch.cat((start_quat, clouds), dim=1)
        return flat, cloud, *(value[None] for value in state), kept, pos

    def _group(self, group: str, x: ObservationInput) -> Tensor:
        """[N, ...] observations of a group; ``PolicyError`` for those that no robot measures."""
        values = []
        for name, function in self._observer.functions(group).items():
            try:
                values.append(function(x))
            except (AttributeError, TypeError):
                values.append(None)
            if not isinstance(values[-1], Tensor):
                raise PolicyError(
                    f"The policy observes {name!r}, which no robot measures. Train without this observation."
                )
        return torch.cat(values, dim=-1)


class Act(nn.Module):
    """From the network's outputs to joint targets, and the memory without the network's state."""

    def __init__(self, robot: RobotSpec, task: TaskConfig) -> None:
        super().__init__()
        self._actions = ActionSpace(robot, task.action)
        self._slots = Slots.of(robot, task.joint_slots)

    def forward(
        self, action: Tensor, joint_pos: Tensor, joint_target: Tensor, kept: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the joint targets [N, J] and the memory; ``kept`` is the part of it that :class:`Observe` returns."""
        if self._slots is not None:
            action = action[:, self._slots.of_joint]
        action = action.clamp(-1.0, 1.0)
        target = self._actions.targets(action, joint_target, joint_pos)
        return target, torch.cat((torch.ones_like(action[:, :1]), action, kept), dim=1)


def _num_actions(robot: RobotSpec, task: TaskConfig) -> int:
    return task.sizes(len(robot.joints), len(robot.fingertips))[0]


def _input_shapes(robot: RobotSpec, task: TaskConfig) -> dict[str, tuple[int, ...]]:
    """Return the readings that a graph may take, and the shape of each for one robot."""
    joints = (len(robot.joints),)
    return {
        "joint_pos": joints,
        "joint_vel": joints,
        "joint_target": joints,
        "object_pos": (3,),
        "object_quat": (4,),
        "tip_force": (len(robot.fingertips), 3),
        "goal_pos": (3,),
        "goal_quat": (4,),
        "object_points": (task.observation.cloud_points, 3),
        "object_normals": (task.observation.cloud_points, 3),
        "object_center": (3,),
    }


def policy_graph(network: bytes | nn.Module, robot: RobotSpec, task: TaskConfig) -> ModelProto:
    """Return the graph of a policy, without metadata; arguments and errors as for
    :func:`xreset.live.deploy.deployed_graph`."""
    with needs("onnx", "deploy", PolicyError):
        import onnx
    if task.vision.cameras:
        raise PolicyError(
            "The policy has cameras, which the runtime does not support. Use a policy without cameras."
        )
    if isinstance(network, nn.Module):
        middle = _exported_module(network, robot, task)
    else:
        try:
            # networks that were not exported by torch may not state the shapes of their outputs
            middle = onnx.shape_inference.infer_shapes(onnx.load_from_string(network))
        except Exception as error:  # of the parser, which takes any object
            raise PolicyError(
                f"network is {shown(network)}, expected the content of an ONNX file, or a module of torch ({error})."
            ) from error
    middle = _prefixed(middle, "network/")
    wanted = [value.name.removeprefix("network/") for value in middle.graph.input]
    widths = [value.type.tensor_type.shape.dim[2].dim_value for value in middle.graph.input[2:]]
    observe = Observe(robot, task, widths)
    shapes = _input_shapes(robot, task) | {"memory": (observe.memory,)}
    zeros = {name: torch.zeros(_EXAMPLES, *shape) for name, shape in shapes.items()}
    with torch.no_grad():
        observe(*zeros.values())  # errors of one sentence
    first = _prefixed(
        exported_module(observe, zeros, [*wanted, "kept", "links"], opset=OPSET), "observe/"
    )
    last = exported_module(
        Act(robot, task),
        {  # torch takes two inputs that are one tensor for one input
            "action": torch.zeros(_EXAMPLES, _num_actions(robot, task)),
            "joint_pos": zeros["joint_pos"],
            "joint_target": zeros["joint_target"],
            "kept": torch.zeros(_EXAMPLES, observe.kept),
        },
        ["target", "memory"],
        opset=OPSET,
    )
    last = _prefixed(last, "act/")
    joined = onnx.compose.merge_models(
        first, middle, io_map=[(f"observe/{name}", f"network/{name}") for name in wanted]
    )
    widths = {value.name: value.type.tensor_type.shape.dim[-1] for value in first.graph.output}
    action, *states = [value.name for value in middle.graph.output]
    joined = onnx.compose.merge_models(
        joined, last, io_map=[(action, "act/action"), ("observe/kept", "act/kept")]
    )
    if "observe/flat" in widths:
        shape = ["worlds", widths["observe/flat"].dim_value]
        joined.graph.output.append(
            onnx.helper.make_tensor_value_info("observe/flat", onnx.TensorProto.FLOAT, shape)
        )
    _finish(joined, states, observe.memory)
    return joined


def _finish(model: ModelProto, states: Sequence[str], memory: int) -> None:
    """Join the states with the memory, share the inputs of the parts, and name inputs and outputs.

    Args:
        model: the joined parts; changed in place.
        states: outputs with the network's new state, each [1, N, width].
        memory: M.
    """
    import onnx

    del model.opset_import[1:]  # every part brought the same one
    graph = model.graph
    graph.initializer.append(onnx.numpy_helper.from_array(np.zeros(1, np.int64), "first_axis"))
    rows = [f"{name}/row" for name in states]
    for name, row in zip(states, rows, strict=True):
        graph.node.append(onnx.helper.make_node("Squeeze", [name, "first_axis"], [row]))
    graph.node.append(
        onnx.helper.make_node("Concat", ["act/memory", *rows], ["memory_out"], axis=1)
    )
    used: set[str] = set()
    for node in graph.node:
        used.update(node.input)
    names = {
        "observe/memory": "memory_in",
        "act/target": "target",
        "observe/links": "links",
        "observe/flat": "observations",
    }
    inputs = {}
    for value in graph.input:
        names.setdefault(value.name, value.name.rpartition("/")[2])
        if value.name in used:
            value.name = names[value.name]
            inputs[value.name] = value
    outputs = {}
    for value in graph.output:
        value.name = names.get(value.name, value.name)
        outputs[value.name] = value
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        node.output[:] = [names.get(name, name) for name in node.output]
    out = onnx.helper.make_tensor_value_info(
        "memory_out", onnx.TensorProto.FLOAT, ["worlds", memory]
    )
    _replace(graph.input, inputs.values())
    shown = [outputs[name] for name in ("links", "observations") if name in outputs]
    _replace(graph.output, (outputs["target"], out, *shown))


def _replace(listed: Any, values: Iterable[ValueInfoProto]) -> None:
    """Set the inputs or outputs of a graph."""
    copies = [type(value).FromString(value.SerializeToString()) for value in values]
    del listed[:]
    listed.extend(copies)


def _prefixed(model: ModelProto, prefix: str) -> ModelProto:
    """Return a model with other names of everything, for :data:`OPSET`, and without the exporter's notes on nodes and
    values: lines of source code with paths of its machine."""
    import onnx

    model = onnx.compose.add_prefix(model, prefix)
    model.ir_version = _IR_VERSION
    del model.opset_import[:]
    model.opset_import.append(onnx.helper.make_opsetid("", OPSET))
    del model.metadata_props[:]
    del model.graph.value_info[:]
    return model


def _exported_module(network: nn.Module, robot: RobotSpec, task: TaskConfig) -> ModelProto:
    """Return a memoryless network of any learner as an ONNX model."""
    network = deepcopy(network).cpu().eval()  # the learner goes on with its own
    observe = Observe(robot, task, ())
    zeros = [torch.zeros(_EXAMPLES, *shape) for shape in _input_shapes(robot, task).values()]
    with torch.no_grad():
        flat, cloud, *_ = observe(*zeros, torch.zeros(_EXAMPLES, observe.memory))
        action = network(flat, cloud)
    expected = (_EXAMPLES, _num_actions(robot, task))
    if not isinstance(action, Tensor) or tuple(action.shape) != expected:
        found = tuple(action.shape) if isinstance(action, Tensor) else type(action).__name__
        raise PolicyError(
            f"The network gives {found} for observations {tuple(flat.shape)} and clouds {tuple(cloud.shape)}, expected "
            f"actions {expected}."
        )
    return exported_module(network, {"flat": flat, "cloud": cloud}, ["actions"], opset=OPSET)
