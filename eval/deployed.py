"""Policies as one graph from readings to joint targets, to play and to export: without torch where a graph is there."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from xreset.errors import PolicyError
from xreset.files.checks import frozen
from xreset.geometry.description import load_robot
from xreset.live.deploy import is_deployed, made_for, with_objects
from xreset.objects.catalogue import object_names
from xreset.policy.onnx_policy import METADATA_KEY
from xreset.policy.shipped import shipped, shipped_graphs
from xreset.runtime import Controller
from xreset.runtime.contract import POLICY
from xreset.spec import ObjectSpec, RobotSpec

if TYPE_CHECKING:
    from xreset.eval.policy_spec import PolicySpec

RESTS = "zero"
"""Name of the policy of a robot that no policy was trained for: the robot rests."""


@frozen
class Deployed:
    """A policy and the robot that it moves."""

    name: str
    robot: RobotSpec
    graph: bytes | None
    """Content of the deployed policy; None: the robot rests."""
    meshes: Path | None = None
    """Folder of object meshes of the training; None: the stand-ins."""
    objects: tuple[str, ...] = ()
    """Names of the objects of the training."""

    def listing(self, objects: Sequence[ObjectSpec]) -> bytes:
        """Return the graph with a contract that lists these objects; ``PolicyError`` if there is none."""
        if self.graph is None:
            raise PolicyError(
                f"The baseline {self.name!r} is not an exported policy. Give a run folder or a .onnx file."
            )
        return with_objects(self.graph, objects)


def load_deployed(
    policy: str | Path | Deployed | PolicySpec, robot: str | Path | None = None
) -> Deployed:
    """Load a policy as a graph.

    The graphs of policies that ship with xreset are part of it, and a deployed policy is a graph. That of another
    policy is exported, which takes torch and some seconds; a cache keeps it.

    Args:
        policy: as for :func:`~xreset.eval.policy_spec.load_policy`, or one of this function.
        robot: name or folder of the robot; default: the policy's own. :data:`RESTS` needs it.

    Raises:
        PolicyError: the policy is unknown, is another baseline, has cameras, or does not fit the robot.
    """
    if isinstance(policy, Deployed):
        return policy
    if policy == RESTS:
        if robot is None:
            raise PolicyError(
                f"The policy {RESTS!r} needs a robot. Name it (robot=... or --robot)."
            )
        return Deployed(name=RESTS, robot=load_robot(robot), graph=None)
    if isinstance(policy, str | Path):
        name = str(policy)
        file = Path(policy)
        if os.path.isdir(file / "runtime"):  # of xreset export deploy
            file = file / POLICY
        if name in shipped_graphs() and not os.path.exists(name):
            graph = shipped_graphs()[name]
            if robot is None or made_for(graph.read_bytes(), load_robot(robot)):
                return deployed(graph, robot)
        elif name in shipped() and not os.path.exists(name):
            raise PolicyError(
                f"The policy {name!r} has cameras, so no graph plays it. Choose from: {', '.join(shipped_graphs())}."
            )
        if file.suffix == ".onnx" and file.is_file() and is_deployed(file.read_bytes()):
            return deployed(file, robot)
    from xreset.eval.policy_spec import PolicySpec, load_policy  # torch

    spec = policy if isinstance(policy, PolicySpec) else load_policy(policy, robot=robot)
    return Deployed(
        name=spec.name,
        robot=spec.robot,
        graph=spec.graph,
        meshes=spec.meshes,
        objects=spec.objects or (),
    )


def deployed(file: Path, robot: str | Path | None = None) -> Deployed:
    """Return the policy of a file with a graph, whoever trained it; ``PolicyError`` if it does not fit the robot."""
    content = file.read_bytes()
    controller = Controller(content, str(file))
    contract = controller.contract
    spec = load_robot(robot or contract["robot"])
    names = tuple(joint["name"] for joint in contract["joints"])
    if names != spec.joint_names:
        raise PolicyError(
            f"{file} has the joints {', '.join(names)}, but the robot {spec.name!r} has {', '.join(spec.joint_names)}."
        )
    return Deployed(
        name=file.parent.resolve().name if file.name == POLICY else file.stem,
        robot=spec,
        graph=content,
        objects=tuple(contract.get("objects", ())) or trained_objects(controller),
    )


def observation_names(controller: Controller) -> dict[str, slice]:
    """Return the name of each part of :attr:`Controller.observations`, and its place; none if nobody states them."""
    layout = _trained(controller).get("observation_layout", {})
    places = {}
    begin = 0
    for group in ("policy", "proprio"):
        for name, width in layout.get(group, {}).items():
            places[name] = slice(begin, begin + width)
            begin += width
    return places


def played_objects(trained: Sequence[str], folder: Path | None) -> tuple[str, ...]:
    """Return those of a training's objects that a folder has, or else all objects of the folder.

    The folder may lack some objects of the training, such as shapes that were made for this training only.

    Args:
        trained: names of the objects of the training.
        folder: folder of meshes; None: the stand-ins.
    """
    names = object_names(folder)
    return tuple(name for name in names if name in trained) or names


def trained_objects(controller: Controller) -> tuple[str, ...]:
    """Return the objects of the training; none if nobody states them."""
    return tuple(_trained(controller).get("objects", ()))


def _trained(controller: Controller) -> dict[str, Any]:
    """Return the contract of the training, as JSON."""
    return json.loads(controller.metadata.get(METADATA_KEY, "{}"))
