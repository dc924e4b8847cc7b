"""An action sequence that can be replayed anywhere: a state, the drives' target at each control step, and the physics
meant.

Actions are kept as joint targets, not as a policy's outputs: what a policy's output becomes depends on where the joints
are (see :mod:`xreset.task.actions`), and would no longer be the same in every engine. Shape letters: T control steps, J
joints, P phases.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from xreset.description import load_robot
from xreset.errors import FileFormatError
from xreset.eval.engines.episodes import GraspMotion, closing_episode
from xreset.eval.engines.grasps import Grasps
from xreset.eval.rollout import Progress, Trace, episode_starts, play
from xreset.eval.trial import Engine, Trial, nominal_scene
from xreset.physics import State
from xreset.policy import Policy
from xreset.records import JOINT, POSITION, Field, Schema, read_npz, write_npz
from xreset.resets.bank import check_robot
from xreset.spec import ObjectSpec, PairFriction, RobotSpec, SceneSpec
from xreset.task.config import TaskConfig
from xreset.task.reading import Reading

SCHEMA = "xreset-actions/1"

_STATE_KEYS = {f.name: f"start_{f.name}_wxyz" if f.name == "object_quat" else f"start_{f.name}" for f in fields(State)}

_FIELDS: Schema = {
    "robot": Field((), "U"),
    "robot_fingerprint": Field((), "U"),
    "joint_names": Field(("J",), "U"),
    "object_name": Field((), "U"),
    "object_source": Field((), "U"),
    "label": Field((), "U"),
    "timestep": Field((), "f", within=(1e-6, 1.0)),
    "substeps": Field((), "i", within=(1, 1e6)),
    "friction": Field((3,), "f", within=(0.0, 100.0)),
    "phase_name": Field(("P",), "U"),
    "phase_start": Field(("P",), "f", within=(0.0, 1e6)),
    "joint_target": Field(("T", "J"), "f", within=JOINT),
    "start_joint_pos": Field(("J",), "f", within=JOINT),
    "start_joint_vel": Field(("J",), "f", within=(-1e4, 1e4)),
    "start_joint_target": Field(("J",), "f", within=JOINT),
    "start_object_pos": Field((3,), "f", within=POSITION),
    "start_object_quat_wxyz": Field((4,), "f", unit=True),
    "start_object_linvel": Field((3,), "f", within=(-1e4, 1e4)),
    "start_object_angvel": Field((3,), "f", within=(-1e4, 1e4)),
}


@dataclass(frozen=True, kw_only=True)
class Actions:
    """One action sequence from one state."""

    scene: SceneSpec
    """With one object."""
    label: str
    """Description for people."""
    start: State
    """[1, ...]"""
    joint_target: torch.Tensor
    """[T, J] rad (m): the drives' targets from the beginning of each control step."""
    phases: tuple[tuple[str, float], ...] = ()
    """Parts of the sequence: name, and begin [s]."""

    @property
    def robot(self) -> RobotSpec:
        """The scene's robot."""
        return self.scene.robot

    @property
    def object(self) -> ObjectSpec:
        """The scene's object."""
        return self.scene.objects[0]

    def phase_at(self, time: float) -> str:
        """Return the name of the phase at a time [s]; empty if there are no phases."""
        begun = [name for name, start in self.phases if start <= time]
        return begun[-1] if begun else ""


def grasp_and_lift(robot: RobotSpec, thing: ObjectSpec, grasps: Grasps, number: int = 0) -> Actions:
    """Return the open-loop try of a grasp: the hand, open around the object at rest, closes, lifts and shakes."""
    motion = GraspMotion()
    scene = SceneSpec(robot=robot, objects=(thing,))
    dt = scene.control_dt
    one = slice(number, number + 1)
    episode = closing_episode(robot, grasps.joint_pos[one], grasps.object_pos[one], grasps.object_quat[one], dt, motion)
    phases = []
    step = 0
    for name, seconds in (
        ("settle", motion.settle),
        ("close", motion.close),
        ("hold", motion.hold),
        ("lift", motion.lift),
        ("carry", motion.hold),
        ("shake x", motion.shake),
        ("shake y", motion.shake),
    ):
        phases.append((name, step * dt))
        step += round(seconds / dt)
    return Actions(
        scene=scene,
        label=f"grasp and lift of {thing.name}, {grasps.label[number]}",
        start=episode.start,
        joint_target=episode.targets[:, 0],
        phases=tuple(phases),
    )


def play_policy(
    policy: Policy,
    engine: Engine,
    trial: Trial,
    *,
    sequence: int,
    repetition: int = 0,
    progress: Progress = lambda done, total: None,
) -> Actions:
    """Let a policy act through one episode in one engine, and record the drives' targets.

    Args:
        policy: what acts.
        engine: where it acts.
        trial: what it plays.
        sequence: index of the demonstration.
        repetition: number of the perturbation of its start, as ``xreset eval`` counts them.
        progress: called with (control steps done, control steps in all).
    """
    bank = trial.bank
    thing = trial.names.index(str(bank.sequence_object[sequence]))
    start = episode_starts(trial.starts(), np.array([sequence]), np.array([repetition]), trial.seed)
    targets: list[torch.Tensor] = []
    with trial.worlds(engine, torch.tensor([thing])) as (env, points):
        env.reset(start=start.to(env.device))

        def look(step: int, _: Reading) -> None:
            if step:
                targets.append(env.joint_target[0].cpu().clone())
                progress(step, env.max_episode_length)

        play(policy, env, points, look)
    played = f"{bank.sequence_name[sequence]} (perturbation {repetition}, seed {trial.seed})"
    return Actions(
        scene=replace(trial.nominal_scene, objects=(trial.objects[thing],)),
        label=f"{policy.name} in {engine.name}, {played}",
        start=State.at_rest(start.joint_pos, start.object_pos, start.object_quat),
        joint_target=torch.stack(targets),
    )


def recorded_actions(robot: RobotSpec, thing: ObjectSpec, trace: Trace, *, label: str) -> Actions:
    """Return the actions of an episode that an evaluation has recorded; it began at rest, with the physics of an
    evaluation.

    Raises:
        FileFormatError: the episode was not played at the control rate of the default task.
    """
    assert trace.joint_target is not None, "the trace holds no actions"
    scene = nominal_scene(robot, (thing,), TaskConfig())
    interval = float(trace.time[1] - trace.time[0])
    length = len(trace.joint_target) * scene.control_dt
    if not trace.time[-1] <= length + 1e-6 < trace.time[-1] + interval + 1e-6:
        raise FileFormatError(
            f"{len(trace.joint_target)} actions at {1 / scene.control_dt:.0f} Hz last {length:.2f} s, but the episode "
            f"lasts {trace.time[-1]:.2f} s: it was played at another control rate. Give --policy instead."
        )
    first = [
        torch.as_tensor(x[:1], dtype=torch.float32) for x in (trace.joint_pos, trace.object_pos, trace.object_quat)
    ]
    target = torch.as_tensor(trace.joint_target, dtype=torch.float32)
    return Actions(scene=scene, label=label, start=State.at_rest(*first), joint_target=target)


def write_actions(path: str | Path, actions: Actions) -> None:
    """Write an action sequence; see :func:`xreset.records.write_npz`."""
    scene = actions.scene
    friction = scene.friction
    arrays: dict[str, Any] = {
        "robot": actions.robot.name,
        "robot_fingerprint": actions.robot.fingerprint,
        "joint_names": np.array(actions.robot.joint_names),
        "object_name": actions.object.name,
        "object_source": actions.object.source,
        "label": actions.label,
        "timestep": np.float64(scene.timestep),
        "substeps": np.int64(scene.substeps),
        "friction": np.array([friction.tip, friction.link, friction.table]),
        "phase_name": np.array([name for name, _ in actions.phases], dtype=np.str_),
        "phase_start": np.array([start for _, start in actions.phases], dtype=np.float64),
        "joint_target": actions.joint_target.numpy(),
    }
    for name, key in _STATE_KEYS.items():
        arrays[key] = getattr(actions.start, name)[0].numpy()
    write_npz(path, SCHEMA, arrays)


def read_actions(path: str | Path, robot: RobotSpec | str | None, objects: Callable[[str], ObjectSpec]) -> Actions:
    """Read an action sequence.

    Args:
        path: the file.
        robot: the robot, its name or its folder; default: the robot that the file names.
        objects: gives an object by its name.

    Raises:
        FileFormatError: the file is damaged, or for another robot or object geometry.
    """
    a = read_npz(path, SCHEMA, _FIELDS, what="an action sequence", check=_check)
    spec = robot if isinstance(robot, RobotSpec) else load_robot(robot or str(a["robot"]))
    names = tuple(a["joint_names"].tolist())
    fingerprint = str(a["robot_fingerprint"])
    check_robot(path, "action sequence", spec, name=str(a["robot"]), joint_names=names, fingerprint=fingerprint)
    thing = objects(str(a["object_name"]))
    if thing.source != str(a["object_source"]):
        raise FileFormatError(
            f"{path} was made with another geometry of {thing.name} ({a['object_source']}, here {thing.source}). "
            "Give the same --objects folder."
        )
    tip, link, table = a["friction"].tolist()
    scene = SceneSpec(
        robot=spec,
        objects=(thing,),
        friction=PairFriction(tip=tip, link=link, table=table),
        timestep=float(a["timestep"]),
        substeps=int(a["substeps"]),
    )
    start = {name: torch.as_tensor(a[key], dtype=torch.float32)[None] for name, key in _STATE_KEYS.items()}
    return Actions(
        scene=scene,
        label=str(a["label"]),
        start=State(**start),
        joint_target=torch.as_tensor(a["joint_target"], dtype=torch.float32),
        phases=tuple(zip(a["phase_name"].tolist(), a["phase_start"].tolist(), strict=True)),
    )


def _check(arrays: dict[str, np.ndarray]) -> str | None:
    return None if len(arrays["joint_target"]) else "it has no control step."
