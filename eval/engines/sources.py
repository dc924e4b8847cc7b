"""Grasps and action sequences from files: what the arguments of ``xreset engines compare`` and ``... trace`` mean."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np

from xreset.description import load_robot
from xreset.errors import DemoError, FileFormatError
from xreset.eval.engines.actions import SCHEMA as ACTIONS
from xreset.eval.engines.actions import Actions, grasp_and_lift, play_policy, read_actions, recorded_actions
from xreset.eval.engines.grasps import Frames, find_grasps
from xreset.eval.policy_spec import load_policy
from xreset.eval.results import TRACE_SCHEMA, mesh_folder, read_result, read_traces
from xreset.eval.rollout import Progress
from xreset.eval.setting import Place, Sequence
from xreset.eval.trial import Engine, load_trial
from xreset.inputs import load_inputs
from xreset.objects.catalogue import load_object
from xreset.records import npz_schema
from xreset.resets.bank import ResetBank
from xreset.spec import ObjectSpec, RobotSpec


def load_frames(
    path: Path,
    *,
    robot: str | None = None,
    objects_folder: Path | None = None,
    only: Iterable[str] = (),
    progress: Callable[[str, float, int], None] = lambda doing, done, total: None,
) -> tuple[RobotSpec, tuple[ObjectSpec, ...], Frames]:
    """Load robot, objects and frames of motion, of a reset bank, or of demonstrations, which are retargeted here.

    Args:
        path: file of any of the three kinds.
        robot: name or folder; default: the robot that the file names. Demonstrations need it.
        objects_folder: folder of object meshes; None: the stand-ins.
        only: names of the objects to use; default: all objects of the file.
        progress: called with (what is being done, sequences retargeted, sequences in all).

    Raises:
        XResetError: the file, the robot or an object cannot be used, or they do not belong together.
    """
    inputs = load_inputs(path, robot=robot, objects=objects_folder, only=only)
    data = inputs.data
    if not isinstance(data, ResetBank):
        data = inputs.motion(partial(progress, "retargeting"))
    return inputs.robot, inputs.objects, Frames.of(data)


def from_file(source: Path, sequence: Sequence, place: Place) -> Actions:
    """Return an open-loop grasp and lift of a grasp in the file; or recorded actions, also those of an evaluation.

    Raises:
        FileFormatError: the file is of another kind, or for another robot.
        DemoError: the file shows no such grasp.
    """
    schema = npz_schema(source)
    if schema == ACTIONS:
        return read_actions(source, place.robot, lambda name: load_object(name, place.objects))
    if schema == TRACE_SCHEMA:
        return _from_evaluation(source, sequence, place)
    only = () if sequence.object is None else (sequence.object,)
    spec, objects, frames = load_frames(source, robot=place.robot, objects_folder=place.objects, only=only)
    name = _object(source, objects[0].name if only else None, frames.object_name.tolist())
    thing = next(o for o in objects if o.name == name)
    grasps = find_grasps(frames, spec, (thing,), len(frames.frame), where="table")
    _check_episode(sequence, len(grasps), f"{source} shows {len(grasps)} grasps of {name} on the table")
    return grasp_and_lift(spec, thing, grasps, sequence.episode)


def from_policy(
    source: Path, engine: Engine, sequence: Sequence, place: Place, progress: Progress = lambda done, total: None
) -> Actions:
    """Return the actions of a policy in one engine.

    Args:
        source: demonstrations or retargeted motion.
        engine: where the policy plays.
        sequence: the policy, and what it plays.
        place: robot, meshes and seed.
        progress: called with (control steps done, control steps in all).
    """
    assert sequence.policy is not None, "no policy"
    policy = load_policy(sequence.policy, robot=place.robot, seed=place.seed)
    trial = load_trial(policy, source, objects=place.objects, seed=place.seed)
    names = trial.bank.sequence_object
    name = _object(source, sequence.object, names.tolist())
    mine = np.flatnonzero(names == name)
    _check_episode(sequence, len(mine), f"{source} has {len(mine)} demonstrations of {name}")
    chosen = int(mine[sequence.episode])
    player = policy.start(trial.motion)
    return play_policy(player, engine, trial, sequence=chosen, repetition=sequence.repetition, progress=progress)


def _from_evaluation(source: Path, sequence: Sequence, place: Place) -> Actions:
    """Return the actions of a recorded episode: an evaluation records the first episode of each demonstration."""
    name = source.name.removesuffix(".trace.npz")
    summary = read_result(source.with_name(f"{name}.json"))
    spec = load_robot(place.robot or summary.robot)
    traces = read_traces(source.parent, name, spec.joint_names)
    chosen = _object(source, sequence.object, [t.object for t in traces])
    mine = [t for t in traces if t.object == chosen]
    _check_episode(sequence, len(mine), f"{source} records {len(mine)} episodes of {chosen}")
    found = mine[sequence.episode]
    if found.joint_target is None:
        raise FileFormatError(f"{source} holds states without the actions that led to them. Evaluate again.")
    thing = load_object(found.object, mesh_folder(place.objects, summary.objects_folder))
    return recorded_actions(spec, thing, found, label=f"{summary.policy} in {name}, demonstration {found.sequence}")


def _check_episode(sequence: Sequence, count: int, found: str) -> None:
    if sequence.episode >= count:
        raise DemoError(f"{found}, so --episode is at most {count - 1}.")


def _object(source: Path, wanted: str | None, there: list[str]) -> str:
    """Return the wanted object, by default the first one of a file."""
    names = list(dict.fromkeys(there))
    if not names:
        raise DemoError(f"{source} shows no frame after first contact, so no grasp. Retarget more demonstrations.")
    if wanted is not None and wanted not in names:
        raise DemoError(f"{source} has no {wanted}; it has {', '.join(names)}.")
    return wanted or names[0]
