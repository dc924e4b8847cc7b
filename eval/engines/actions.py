"""An action sequence that every engine can replay: a start state, joint targets for each control step, and the physics.

Joint targets are stored, not a policy's outputs, because an output means another target where the joints are elsewhere
(see :mod:`xreset.task.actions`), so engines would not get the same targets. Shape letters: T control steps, J joints.
"""

from __future__ import annotations

from pathlib import Path

import torch

from xreset.errors import DemoError, FileFormatError
from xreset.eval.engines.grasps import Grasps, closing_episode, find_grasps
from xreset.eval.results import TRACE_SCHEMA, Trace, read_result, read_traces
from xreset.eval.rollout import nominal_scene
from xreset.files.checks import frozen
from xreset.files.records import npz_schema
from xreset.geometry.description import load_robot
from xreset.objects.catalogue import load_object
from xreset.physics import State
from xreset.resets.inputs import load_inputs
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec
from xreset.task.config import EVALUATION_TIMESTEP, TaskConfig


@frozen
class Actions:
    """One action sequence from one state."""

    scene: SceneSpec
    """Scene with one object."""
    label: str
    """Description for people."""
    start: State
    """[1, ...] state of one world."""
    joint_target: torch.Tensor
    """[T, J] targets of the joints' drives in each control step [rad (m)]."""

    @property
    def robot(self) -> RobotSpec:
        """The scene's robot."""
        return self.scene.robot

    @property
    def object(self) -> ObjectSpec:
        """The scene's object."""
        return self.scene.objects[0]


def from_file(
    source: Path,
    wanted: str | None = None,
    episode: int = 0,
    *,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
) -> Actions:
    """Load actions from a file: a recorded episode, or an open-loop grasp and lift of one of its grasps.

    Args:
        source: the trace of an evaluation, or demonstrations or motion with grasps.
        wanted: name of an object of the file; default: its first.
        episode: index among the object's grasps or recorded episodes.
        robot: name or folder of the robot; default: the file's.
        meshes: folder of real meshes; default: as the file names it, else the stand-ins.

    Raises:
        FileFormatError: the file is of another kind, or for another robot.
        DemoError: the file has no such object, grasp or episode.
    """
    schema = npz_schema(source)
    if schema == TRACE_SCHEMA:
        return _from_evaluation(source, wanted, episode, robot, meshes)
    inputs = load_inputs(
        source,
        robot=robot,
        meshes=meshes,
        only=(wanted,) if wanted else (),
        accept=("demos", "motion"),
    )
    motion = inputs.motion()
    grasped = next(o for o in inputs.objects if wanted or o.name == motion.object_name[0])
    grasps = find_grasps(motion, inputs.robot, (grasped,), len(motion.valid), where="table")
    _check_episode(
        episode, len(grasps), f"{source} shows {len(grasps)} grasps of {grasped.name} on the table"
    )
    return grasp_and_lift(inputs.robot, grasped, grasps[episode : episode + 1])


def _from_evaluation(
    source: Path,
    wanted: str | None,
    episode: int,
    robot: str | Path | None,
    meshes: str | Path | None,
) -> Actions:
    """Return the actions of a recorded episode: an evaluation records the first episode of each demonstration."""
    name = source.name.removesuffix(".trace.npz")
    summary = read_result(source.with_name(f"{name}.json"))
    spec = load_robot(robot or summary.robot)
    traces = read_traces(source.parent, name, spec.joint_names)
    chosen = wanted or traces[0].object
    mine = [trace for trace in traces if trace.object == chosen]
    if not mine:
        names = dict.fromkeys(trace.object for trace in traces)
        raise DemoError(f"{source} has no {chosen}; it has {', '.join(names)}.")
    _check_episode(episode, len(mine), f"{source} records {len(mine)} episodes of {chosen}")
    found = mine[episode]
    obj = load_object(chosen, summary.meshes_folder(meshes))
    return recorded_actions(
        spec, obj, found, label=f"{summary.policy} in {name}, demonstration {found.sequence}"
    )


def _check_episode(episode: int, count: int, found: str) -> None:
    if episode >= count:
        raise DemoError(f"{found}, so --episode is at most {count - 1}.")


def grasp_and_lift(robot: RobotSpec, obj: ObjectSpec, grasp: Grasps) -> Actions:
    """Return the actions of :func:`~xreset.eval.engines.grasps.closing_episode` for one grasp."""
    scene = SceneSpec(robot=robot, objects=(obj,))
    start, targets = closing_episode(scene, grasp)
    label = f"grasp and lift of {obj.name}, {grasp.label[0]}"
    return Actions(scene=scene, label=label, start=start, joint_target=targets[:, 0])


def recorded_actions(robot: RobotSpec, obj: ObjectSpec, trace: Trace, *, label: str) -> Actions:
    """Return the actions of an episode that an evaluation recorded: from rest, with the physics of an evaluation.

    Raises:
        FileFormatError: the trace has too few actions, or its control step is not a whole number of physics steps.
    """
    targets, every = trace.actions(label)
    dt = float(trace.time[1] - trace.time[0]) / every
    substeps = round(dt / EVALUATION_TIMESTEP)
    if abs(substeps * EVALUATION_TIMESTEP - dt) > 1e-5:
        raise FileFormatError(
            f"The episode was played with control steps of {dt:.4g} s, expected a multiple of 1/240 s. Replay another."
        )
    poses = (trace.joint_pos, trace.object_pos, trace.object_quat)
    first = [torch.as_tensor(pose[:1]) for pose in poses]
    target = torch.as_tensor(targets).float()
    scene = nominal_scene(robot, (obj,), TaskConfig(substeps=substeps))
    return Actions(scene=scene, label=label, start=State.at_rest(*first), joint_target=target)
