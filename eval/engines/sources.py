"""Grasps and action sequences from files: what the arguments of ``xreset engines compare`` and ``... trace`` mean."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from xreset.description import load_robot
from xreset.errors import DemoError
from xreset.eval.engines.actions import SCHEMA as ACTIONS
from xreset.eval.engines.actions import Actions, grasp_and_lift, read_actions, recorded_actions
from xreset.eval.engines.grasps import find_grasps
from xreset.eval.results import TRACE_SCHEMA, mesh_folder, read_result, read_traces
from xreset.eval.setting import Place
from xreset.inputs import load_inputs
from xreset.objects.catalogue import load_object
from xreset.records import npz_schema
from xreset.retarget.file import Retargeted
from xreset.spec import ObjectSpec, RobotSpec


def load_motion(
    path: Path,
    *,
    robot: str | None = None,
    objects_folder: Path | None = None,
    only: Iterable[str] = (),
    progress: Callable[[float, int], None] = lambda done, total: None,
) -> tuple[RobotSpec, tuple[ObjectSpec, ...], Retargeted]:
    """Load robot, objects and motion; demonstrations are retargeted here.

    Args:
        path: file of motion, or of demonstrations.
        robot: name or folder; default: the robot that the file names. Demonstrations need it.
        objects_folder: folder of object meshes; None: the stand-ins.
        only: names of the objects to use; default: all objects of the file.
        progress: called with (sequences retargeted, sequences in all).

    Raises:
        XResetError: the file, the robot or an object cannot be used, or they do not belong together.
    """
    inputs = load_inputs(path, robot=robot, objects=objects_folder, only=only, accept=("demos", "motion"))
    return inputs.robot, inputs.objects, inputs.motion(progress)


def from_file(source: Path, place: Place, thing: str | None = None, episode: int = 0) -> Actions:
    """Return an open-loop grasp and lift of a grasp in the file; or recorded actions, also those of an evaluation.

    Args:
        source: demonstrations, motion, the trace of an evaluation, or recorded actions.
        place: robot and meshes.
        thing: name of an object of the file; default: its first.
        episode: which of the object's grasps or recorded episodes.

    Raises:
        FileFormatError: the file is of another kind, or for another robot.
        DemoError: the file shows no such grasp.
    """
    schema = npz_schema(source)
    if schema == ACTIONS:
        return read_actions(source, place.robot, lambda name: load_object(name, place.objects))
    if schema == TRACE_SCHEMA:
        return _from_evaluation(source, place, thing, episode)
    only = () if thing is None else (thing,)
    spec, objects, motion = load_motion(source, robot=place.robot, objects_folder=place.objects, only=only)
    first = objects[0].name if only else motion.object_name[0]
    grasped = next(o for o in objects if o.name == first)
    grasps = find_grasps(motion, spec, (grasped,), len(motion.valid), where="table")
    _check_episode(episode, len(grasps), f"{source} shows {len(grasps)} grasps of {grasped.name} on the table")
    return grasp_and_lift(spec, grasped, grasps, episode)


def _from_evaluation(source: Path, place: Place, wanted: str | None, episode: int) -> Actions:
    """Return the actions of a recorded episode: an evaluation records the first episode of each demonstration."""
    name = source.name.removesuffix(".trace.npz")
    summary = read_result(source.with_name(f"{name}.json"))
    spec = load_robot(place.robot or summary.robot)
    traces = read_traces(source.parent, name, spec.joint_names)
    names = list(dict.fromkeys(trace.object for trace in traces))
    chosen = wanted or names[0]
    if chosen not in names:
        raise DemoError(f"{source} has no {chosen}; it has {', '.join(names)}.")
    mine = [trace for trace in traces if trace.object == chosen]
    _check_episode(episode, len(mine), f"{source} records {len(mine)} episodes of {chosen}")
    found = mine[episode]
    thing = load_object(chosen, mesh_folder(place.objects, summary.objects_folder))
    return recorded_actions(spec, thing, found, label=f"{summary.policy} in {name}, demonstration {found.sequence}")


def _check_episode(episode: int, count: int, found: str) -> None:
    if episode >= count:
        raise DemoError(f"{found}, so --episode is at most {count - 1}.")
