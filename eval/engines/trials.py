"""What a comparison tries in every engine: closings, presses and holds.

Shape letters: G grasps (one per world).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from xreset.eval.engines.episodes import GraspMotion, closing_episode, lifting_targets, squeezed
from xreset.eval.engines.grasps import Grasps
from xreset.eval.engines.recording import Recording, play
from xreset.eval.trial import Engine
from xreset.geometry.kinematics import Kinematics
from xreset.physics import State
from xreset.spec import RobotSpec, SceneSpec

FRICTIONS = (0.5, 0.8)
"""Pair frictions of hand and object in the holds."""
IN_AIR = 1 / 3
"""Share of the common states that demonstrations show in the air; the others come from closings."""
PRESS_MASS = 1e6
"""Factor on the mass of an object that nothing shall move."""


@dataclass(frozen=True, kw_only=True)
class CommonStates:
    """States from which every engine lifts and shakes."""

    label: tuple[str, ...]
    """Sequence, frame, and whether the demonstration shows it or which engine closed the hand."""
    object_index: Tensor
    """[G]"""
    start: State
    """[G, ...]"""


def try_closings(tested: Engine, scene: SceneSpec, grasps: Grasps, tries: GraspMotion) -> tuple[Recording, Recording]:
    """Close each hand at the scene's frictions.

    Returns:
        The closing around objects too heavy to move, up to the lift; and the whole try around objects at rest on the
        table.
    """
    dt = scene.control_dt
    start, targets = closing_episode(scene.robot, grasps, dt, tries)
    with tested.make(scene, len(grasps), grasps.object_index) as backend:
        whole = play(backend, start, targets)
        mass = torch.tensor([scene.objects[i].mass for i in grasps.object_index.tolist()], device=backend.device)
        backend.set_object_mass(PRESS_MASS * mass)
        backend.set_object_gravity(torch.zeros_like(mass))
        return play(backend, start, targets[: tries.closing_steps(dt)]), whole


def try_holds(tested: Engine, scene: SceneSpec, common: CommonStates, tries: GraspMotion) -> tuple[Recording, ...]:
    """Lift and shake, once with each of the frictions."""
    targets = lifting_targets(scene.robot, common.start, scene.control_dt, tries)
    recordings = []
    with tested.make(scene, len(common.object_index), common.object_index) as backend:
        for mu in FRICTIONS:
            friction = torch.tensor([mu, mu, scene.friction.table], device=backend.device)
            backend.set_friction(friction.repeat(backend.num_worlds, 1))
            recordings.append(play(backend, common.start, targets))
    return tuple(recordings)


def common_states(
    robot: RobotSpec,
    table: Grasps,
    air: Grasps,
    closings: Mapping[str, Recording],
    count: int,
    dt: float,
    tries: GraspMotion,
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
        tries: how grasps are tried.
    """
    shown = air[: round(count * IN_AIR)]
    closed = squeezed(Kinematics(robot), shown.joint_pos, tries)
    states = [State.at_rest(shown.joint_pos, shown.object_pos, shown.object_quat, closed)]
    labels = [f"{label} as demonstrated" for label in shown.label]
    index = [shown.object_index]
    last = tries.closing_steps(dt) - 1
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
