"""Grasps and action sequences from files: what the arguments of ``xreset engines compare`` and ``... trace`` mean."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path

import numpy as np

from xreset.demos.archive import SCHEMA_NAME as DEMOS
from xreset.description import load_robot
from xreset.errors import DemoError, FileFormatError
from xreset.eval.engines.actions import SCHEMA as ACTIONS
from xreset.eval.engines.actions import Actions, grasp_and_lift, play_policy, read_actions, recorded_actions, robot_of
from xreset.eval.engines.grasps import Frames, find_grasps
from xreset.eval.policy_spec import load_policy
from xreset.eval.results import TRACE_SCHEMA, mesh_folder, read_result, read_traces
from xreset.eval.setting import Place, Sequence
from xreset.eval.trial import Engine, load_trial
from xreset.inputs import load_inputs
from xreset.objects.catalogue import load_object
from xreset.records import npz_schema
from xreset.resets.bank import SCHEMA as BANK
from xreset.resets.bank import ResetBank
from xreset.retarget.file import SCHEMA as RETARGETED
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
    if isinstance(inputs.data, ResetBank):
        frames = Frames.of_bank(inputs.data)
    else:
        frames = Frames.of_retargeted(inputs.motion(partial(progress, "retargeting")))
    return inputs.robot, inputs.objects, frames


def from_file(source: Path, sequence: Sequence, place: Place) -> Actions:
    """An open-loop grasp and lift of demonstrations, retargeted trajectories or a reset bank; or recorded actions, also of an evaluation.

    Raises:
        FileFormatError: the file is of another kind, or for another robot.
        DemoError: there is no such grasp.
    """
    schema = npz_schema(source)
    if schema == ACTIONS:
        return read_actions(
            source, load_robot(place.robot or robot_of(source)), lambda name: load_object(name, place.objects)
        )
    if schema == TRACE_SCHEMA:
        return _from_evaluation(source, sequence, place)
    if schema not in (DEMOS, RETARGETED, BANK):
        raise FileFormatError(
            f"{source} states schema {schema!r}, expected {DEMOS!r} (xreset demos), {RETARGETED!r} (xreset retarget), {BANK!r} "
            f"(xreset resets), {TRACE_SCHEMA!r} (xreset eval) or {ACTIONS!r} (xreset engines trace)."
        )
    only = () if sequence.object is None else (sequence.object,)
    spec, objects, frames = load_frames(source, robot=place.robot, objects_folder=place.objects, only=only)
    name = _object(source, objects[0].name if only else None, frames.object_name.tolist())
    thing = next(o for o in objects if o.name == name)
    grasps = find_grasps(frames, spec, (thing,), len(frames.frame), where="table")
    if sequence.episode >= len(grasps):
        raise DemoError(
            f"{source} shows {len(grasps)} grasps of {name} on the table, so --episode is at most {len(grasps) - 1}."
        )
    return grasp_and_lift(spec, thing, grasps, sequence.episode)


def from_policy(
    source: Path,
    engine: Engine,
    sequence: Sequence,
    place: Place,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Actions:
    """The actions of a policy in one engine.

    Args:
        source: demonstrations or retargeted trajectories.
        progress: called with (control steps done, control steps in all).
    """
    assert sequence.policy is not None, "no policy"
    policy = load_policy(sequence.policy, robot=place.robot, seed=place.seed)
    trial = load_trial(policy, source, objects=place.objects, seed=place.seed)
    name = _object(source, sequence.object, trial.bank.sequence_object.tolist())
    mine = np.flatnonzero(trial.bank.sequence_object == name)
    if sequence.episode >= len(mine):
        raise DemoError(f"{source} has {len(mine)} demonstrations of {name}, so --episode is at most {len(mine) - 1}.")
    return play_policy(
        policy.start(trial.motion),
        engine,
        trial,
        sequence=int(mine[sequence.episode]),
        repetition=sequence.repetition,
        progress=progress,
    )


def _from_evaluation(source: Path, sequence: Sequence, place: Place) -> Actions:
    """The actions of a recorded episode: an evaluation records the first of each demonstration."""
    name = source.name.removesuffix(".trace.npz")
    summary = read_result(source.with_name(f"{name}.json"))
    spec = load_robot(place.robot or summary.robot)
    traces = read_traces(source.parent, name, spec.joint_names)
    chosen = _object(source, sequence.object, [t.object for t in traces])
    mine = [t for t in traces if t.object == chosen]
    if sequence.episode >= len(mine):
        raise DemoError(f"{source} records {len(mine)} episodes of {chosen}, so --episode is at most {len(mine) - 1}.")
    found = mine[sequence.episode]
    if found.joint_target is None:
        raise FileFormatError(f"{source} holds states without the actions that led to them. Evaluate again.")
    folder = mesh_folder(place.objects, summary.objects_folder)
    thing = load_object(found.object, folder)
    return recorded_actions(spec, thing, found, label=f"{summary.policy} in {name}, demonstration {found.sequence}")


def _object(source: Path, wanted: str | None, there: list[str]) -> str:
    names = list(dict.fromkeys(there))
    if not names:
        raise DemoError(
            f"{source} shows no frame after first contact, so there is no grasp in it. Retarget more demonstrations."
        )
    if wanted is None:
        return names[0]
    if wanted not in names:
        raise DemoError(f"{source} has no {wanted}; it has {', '.join(names)}.")
    return wanted
