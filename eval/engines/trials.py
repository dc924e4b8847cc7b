"""What a comparison tries in every engine: closings, presses, holds and paths.

Shape letters: G grasps (one per world), M chosen grasps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from xreset.eval.engines.episodes import GraspMotion, closing_episode, lifting_episode, squeezing_state
from xreset.eval.engines.grasps import Grasps
from xreset.eval.engines.recording import OpenLoopEpisode, Recording, play
from xreset.eval.trial import Engine
from xreset.physics import State
from xreset.spec import RobotSpec, SceneSpec


@dataclass(frozen=True, kw_only=True)
class ParityConfig:
    """What is tried."""

    motion: GraspMotion = field(default_factory=GraspMotion)
    frictions: tuple[float, ...] = (0.5, 0.8)
    """Pair frictions of hand and object in the holds."""
    in_air: float = 1 / 3
    """Share of the common states that demonstrations show in the air; the others come from closings."""
    press_mass: float = 1e6
    """Factor on the mass of an object that nothing shall move."""
    press_time: float = 0.25
    """Forces are averaged over the last of these seconds of a press."""
    path_time: float = 1.0
    """Length of a path [s]."""
    path_grasps: int = 16
    """Largest number of grasps whose paths are compared."""


@dataclass(frozen=True, kw_only=True)
class CommonStates:
    """States from which every engine lifts and shakes."""

    label: tuple[str, ...]
    """Sequence, frame, and whether the demonstration shows it or which engine closed the hand."""
    object_index: Tensor
    """[G]"""
    start: State
    """[G, ...]"""

    def __getitem__(self, chosen: Tensor) -> CommonStates:
        """Select grasps [M]."""
        label = tuple(self.label[i] for i in chosen.tolist())
        return CommonStates(label=label, object_index=self.object_index[chosen], start=self.start[chosen])


def try_closings(tested: Engine, scene: SceneSpec, grasps: Grasps, config: ParityConfig) -> tuple[Recording, Recording]:
    """Close each hand at the scene's frictions.

    Returns:
        The closing around objects too heavy to move, up to the lift; and the whole try around objects at rest on the
        table.
    """
    dt = scene.control_dt
    episode = closing_episode(scene.robot, grasps.joint_pos, grasps.object_pos, grasps.object_quat, dt, config.motion)
    closing = OpenLoopEpisode(start=episode.start, targets=episode.targets[: config.motion.closing_steps(dt)])
    with tested.make(scene, len(grasps), grasps.object_index) as backend:
        whole = play(backend, episode)
        mass = torch.tensor([scene.objects[i].mass for i in grasps.object_index.tolist()], device=backend.device)
        backend.set_object_mass(config.press_mass * mass)
        backend.set_object_gravity(torch.zeros_like(mass))
        return play(backend, closing), whole


def try_holds(tested: Engine, scene: SceneSpec, common: CommonStates, config: ParityConfig) -> tuple[Recording, ...]:
    """Lift and shake, once with each of the frictions."""
    episode = lifting_episode(scene.robot, common.start, scene.control_dt, config.motion)
    recordings = []
    with tested.make(scene, len(common.object_index), common.object_index) as backend:
        for mu in config.frictions:
            friction = torch.tensor([mu, mu, scene.friction.table], device=backend.device)
            backend.set_friction(friction.repeat(backend.num_worlds, 1))
            recordings.append(play(backend, episode))
    return tuple(recordings)


def common_states(
    robot: RobotSpec,
    table: Grasps,
    air: Grasps,
    closings: Mapping[str, Recording],
    count: int,
    dt: float,
    config: ParityConfig,
) -> CommonStates:
    """Return states that favor no engine: some from demonstrations in the air, the others from the closings of all
    engines in turn.

    A closing counts if a fingertip touches the object when the hand has closed.

    Args:
        robot: the robot.
        table: grasps of the closings.
        air: grasps in the air.
        closings: whole closings, by engine.
        count: largest number of states; there are fewer where hands have closed on nothing.
        dt: control step [s].
        config: share of the states in the air.
    """
    shown = min(round(count * config.in_air), len(air))
    held = squeezing_state(robot, air.joint_pos[:shown], air.object_pos[:shown], air.object_quat[:shown], config.motion)
    labels = [f"{label} as demonstrated" for label in air.label[:shown]]
    states = [held]
    index = [air.object_index[:shown]]
    last = config.motion.closing_steps(dt) - 1
    names = list(closings)
    for g in range(len(table)):
        first = g % len(names)
        for name in names[first:] + names[:first]:
            if len(labels) < count and closings[name].tip_touch[last, g].any():
                labels.append(f"{table.label[g]} closed in {name}")
                states.append(closings[name].state_after(last)[torch.tensor([g])])
                index.append(table.object_index[[g]])
                break
    return CommonStates(label=tuple(labels), object_index=torch.cat(index), start=State.cat(states))
