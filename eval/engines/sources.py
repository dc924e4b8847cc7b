"""Action sequences from files: what the arguments of ``xreset trace`` mean."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from xreset.demos.archive import SCHEMA_NAME as DEMOS
from xreset.description import load_robot
from xreset.errors import DemoError, FileFormatError, XResetError
from xreset.eval.engines.actions import SCHEMA as ACTIONS
from xreset.eval.engines.actions import Actions, grasp_and_lift, play_policy, read_actions, recorded_actions, robot_of
from xreset.eval.evaluate import load_motion, resolve
from xreset.eval.results import TRACE_SCHEMA, mesh_folder, read_result, read_traces
from xreset.files import npz_schema
from xreset.objects import load_object, load_objects
from xreset.resets.bank import SCHEMA as BANK
from xreset.resets.bank import read_bank
from xreset.retarget.file import read_retargeted
from xreset.retarget.pipeline import SCHEMA as RETARGETED
from xreset.task.config import evaluation_task

if TYPE_CHECKING:
    from xreset.eval.engines.trials import Engine


def from_file(source: Path, *, object_name: str | None, episode: int, robot: str | None, objects: Path | None) -> Actions:
    """An open-loop grasp and lift of demonstrations, retargeted trajectories or a reset bank; or recorded actions, also of an evaluation.

    Args:
        source: the file.
        object_name: object, if the file has several; None: its first.
        episode: which of the object's grasps.
        robot: name or folder of the robot; None: the file's.
        objects: folder of meshes; None: stand-ins.

    Raises:
        FileFormatError: the file is of another kind, or for another robot.
        DemoError: there is no such grasp.
    """
    from xreset.eval.engines.grasps import Frames, find_grasps

    schema = npz_schema(source)
    if schema == ACTIONS:
        return read_actions(source, load_robot(robot or robot_of(source)), lambda name: load_object(name, objects))
    if schema == BANK:
        bank = read_bank(source)
        spec = load_robot(robot or bank.robot)
        frames = Frames.of_bank(read_bank(source, robot=spec))
    elif schema in (DEMOS, RETARGETED):
        spec = load_robot(robot or _robot_of_retargeted(source, schema))
        _, trajectories = load_motion(source, spec, objects, trajectories=True)
        assert trajectories is not None
        frames = Frames.of_retargeted(trajectories)
    elif schema == TRACE_SCHEMA:
        return _from_evaluation(source, object_name, episode, robot, objects)
    else:
        raise FileFormatError(
            f"{source} states schema {schema!r}, expected {DEMOS!r} (xreset demos), {RETARGETED!r} (xreset retarget), {BANK!r} "
            f"(xreset resets), {TRACE_SCHEMA!r} (xreset eval) or {ACTIONS!r} (xreset trace)."
        )
    name = _object(source, object_name, dict.fromkeys(frames.object_name.tolist()))
    thing = load_object(name, objects)
    grasps = find_grasps(frames, spec, (thing,), len(frames.frame), where="table")
    if episode >= len(grasps):
        raise DemoError(f"{source} shows {len(grasps)} grasps of {name} on the table, so --episode is at most {len(grasps) - 1}.")
    return grasp_and_lift(spec, thing, grasps, episode)


def from_policy(
    policy: str,
    demos: Path,
    engine: Engine,
    *,
    object_name: str | None,
    episode: int,
    repetition: int,
    robot: str | None,
    objects: Path | None,
    seed: int,
    progress: Callable[[int, int], None],
) -> Actions:
    """The actions of a policy in one engine.

    Args:
        policy: run folder, .onnx file or baseline, as for ``xreset eval``.
        demos: demonstrations or retargeted trajectories.
        engine: where it plays.
        object_name: object, if there are several; None: the first.
        episode: which of the object's demonstrations.
        repetition: which perturbation of its start.
        robot: name or folder of the robot; None: the policy's.
        objects: folder of meshes; None: the policy's own, or the stand-ins.
        seed: of the perturbations and of the random policy.
        progress: called with (control steps done, control steps in all).
    """
    subject = resolve(policy, robot, seed)
    folder = subject.meshes(objects)
    bank, trajectories = load_motion(demos, subject.robot, folder, trajectories=subject.label == "ik")
    name = _object(demos, object_name, dict.fromkeys(bank.sequence_object.tolist()))
    mine = np.flatnonzero(bank.sequence_object == name)
    if episode >= len(mine):
        raise DemoError(f"{demos} has {len(mine)} demonstrations of {name}, so --episode is at most {len(mine) - 1}.")
    (thing,) = load_objects([name], folder)
    return play_policy(
        subject.policy(subject.robot, trajectories),
        engine,
        subject.robot,
        thing,
        bank,
        evaluation_task(subject.task),
        sequence=int(mine[episode]),
        repetition=repetition,
        seed=seed,
        progress=progress,
    )


def _from_evaluation(source: Path, object_name: str | None, episode: int, robot: str | None, objects: Path | None) -> Actions:
    """The actions of a recorded episode: an evaluation records the first of each demonstration."""
    name = source.name.removesuffix(".trace.npz")
    summary = read_result(source.with_name(f"{name}.json"))
    spec = load_robot(robot or summary.robot)
    traces = read_traces(source.parent, name, spec.joint_names)
    chosen = _object(source, object_name, dict.fromkeys(t.object for t in traces))
    mine = [t for t in traces if t.object == chosen]
    if episode >= len(mine):
        raise DemoError(f"{source} records {len(mine)} episodes of {chosen}, so --episode is at most {len(mine) - 1}.")
    found = mine[episode]
    if found.joint_target is None:
        raise FileFormatError(f"{source} holds states without the actions that led to them. Evaluate again.")
    folder = mesh_folder(objects, summary.objects_folder)
    thing = load_object(found.object, folder)
    return recorded_actions(spec, thing, found, label=f"{summary.policy} in {name}, demonstration {found.sequence}")


def _robot_of_retargeted(source: Path, schema: str) -> str:
    if schema == DEMOS:
        raise XResetError(f"{source} holds human demonstrations, which are for no robot yet: give --robot.")
    return read_retargeted(source).robot


def _object(source: Path, wanted: str | None, there: Sequence[str] | dict[str, None]) -> str:
    names = list(there)
    if not names:
        raise DemoError(f"{source} shows no frame after first contact, so there is no grasp in it. Retarget more demonstrations.")
    if wanted is None:
        return names[0]
    if wanted not in names:
        raise DemoError(f"{source} has no {wanted}; it has {', '.join(names)}.")
    return wanted
