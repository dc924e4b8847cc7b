"""Checks of contact: forces and their signs, friction, and what mass does to them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from xreset.backends.base import State
from xreset.backends.conformance.harness import Bench, Check, Measure, largest, replace_fields, snapshot
from xreset.rotations import matrix_to_quat
from xreset.spec import GRAVITY

_SETTLE = 120  # steps


def resting_weight(bench: Bench) -> list[Measure]:
    """Put objects on the table: no force right after setting, and after half a second the table pushes them up with their weight."""
    backend = bench.backend()
    fresh = backend.contacts()
    at_once = max(largest(fresh.table_force), largest(fresh.tip_force))
    backend.step(_SETTLE)
    contacts, state = backend.contacts(), snapshot(backend.state())
    weight = GRAVITY * torch.tensor([o.mass for o in bench.objects])
    force = contacts.table_force.cpu()
    return [
        Measure(what="force right after setting", error=at_once, tolerance=1e-6, unit="N"),
        Measure(what="vertical force", error=largest(force[:, 2] / weight - 1.0), tolerance=0.02, unit="of m g"),
        Measure(what="horizontal force", error=largest(force[:, :2] / weight[:, None]), tolerance=0.02, unit="of m g"),
        Measure(what="force of the fingers", error=largest(contacts.tip_force), tolerance=1e-6, unit="N"),
        Measure(what="fingers that say they touch", error=float(contacts.tip_touch.sum()), tolerance=0.5),
        Measure(what="sinking", error=largest(state.object_pos[:, 2] - bench.start().object_pos[:, 2]), tolerance=2e-3, unit="m"),
        Measure(what="sliding", error=largest(state.object_pos[:, :2] - bench.start().object_pos[:, :2]), tolerance=2e-3, unit="m"),
    ]


def object_mass(bench: Bench) -> list[Measure]:
    """Give the objects other masses, then set a state: the table must carry those."""
    backend = bench.altered()
    mass = torch.tensor([o.mass for o in bench.objects]).float() * torch.tensor([2.0, 0.5, 1.5, 0.7])
    backend.set_object_mass(mass[[0, 2, 3]].to(backend.device), torch.tensor([0, 2, 3], device=backend.device))
    backend.set_object_mass(mass[[1]].to(backend.device), torch.tensor([1], device=backend.device))
    backend.set_state(bench.start(backend.device))
    backend.step(_SETTLE)
    force = backend.contacts().table_force[:, 2].cpu()
    return [Measure(what="vertical force", error=largest(force / (GRAVITY * mass) - 1.0), tolerance=0.02, unit="of m g")]


def table_friction(bench: Bench) -> list[Measure]:
    """Slide the same object on the table with two frictions, set before the state: it must slow down by mu g."""
    backend = bench.altered()
    slow, fast = 0, len(bench.scene.objects)  # worlds with the same object
    friction = torch.tensor([0.9, 0.5, 0.6]).repeat(bench.NUM_WORLDS, 1)
    friction[slow, 2], friction[fast, 2] = 0.5, 0.2
    backend.set_friction(friction.to(backend.device))
    heading = -np.sign(bench.place[0] - bench.scene.table.center[0])  # towards the middle of the table
    state = replace_fields(bench.start(), object_linvel=torch.tensor([1.0 * heading, 0.0, 0.0]))
    backend.set_state(state.to(backend.device))
    backend.step(8)  # the contact settles
    before = snapshot(backend.state()).object_linvel
    backend.step(20)
    after = snapshot(backend.state()).object_linvel
    t = 20 * bench.scene.timestep
    measures = []
    for world in (slow, fast):
        mu = float(friction[world, 2])
        lost = float((before - after)[world, 0]) * heading
        error = abs(lost / (mu * GRAVITY * t) - 1.0)
        measures.append(Measure(what=f"deceleration at mu = {mu:.1f}", error=error, tolerance=0.1, unit="of mu g"))
    measures.append(Measure(what="sideways velocity", error=largest(after[[slow, fast], 1]), tolerance=0.03, unit="m/s"))
    return measures


def held_object(bench: Bench) -> list[Measure]:
    """Hold a brick between two jaws in the air: each finger's force points at the other finger, together they carry the weight."""
    backend = bench.backend()
    state, closing = _grasp(bench)
    backend.set_state(state.to(backend.device))
    backend.step(_SETTLE)
    end, contacts = snapshot(backend.state()), backend.contacts()
    bricks = _bricks(bench)
    force = contacts.tip_force.cpu()[bricks]
    weight = GRAVITY * bench.objects[0].mass
    total = force.sum(1)
    squeeze = torch.stack((force[:, 0] @ closing, -force[:, 1] @ closing), dim=1)  # of thumb and index finger, each towards the other
    return [
        Measure(what="vertical force", error=largest(total[:, 2] / weight - 1.0), tolerance=0.05, unit="of m g"),
        Measure(what="horizontal force", error=largest(total[:, :2] / weight), tolerance=0.05, unit="of m g"),
        Measure(what="squeeze missing", error=float((3.0 - squeeze).clamp_min(0.0).max()), tolerance=1.5, unit="N"),
        Measure(what="fingers that do not say they touch", error=float((~contacts.tip_touch.cpu()[bricks]).sum()), tolerance=0.5),
        Measure(what="force of the table", error=largest(contacts.table_force[bricks]), tolerance=1e-6, unit="N"),
        Measure(what="slip", error=largest(end.object_pos[bricks, 2] - state.object_pos[bricks, 2]), tolerance=5e-3, unit="m"),
    ]


def tip_friction(bench: Bench) -> list[Measure]:
    """Hold two bricks, one of them with slippery fingertips: that one must fall, the other must not."""
    backend = bench.altered()
    held, dropped = _bricks(bench)
    friction = torch.tensor([0.9, 0.5, 0.6]).repeat(bench.NUM_WORLDS, 1)
    friction[dropped, 0] = 0.05
    backend.set_friction(friction.to(backend.device))
    state, _ = _grasp(bench)
    backend.set_state(state.to(backend.device))
    backend.step(_SETTLE)
    fallen = state.object_pos[:, 2] - snapshot(backend.state()).object_pos[:, 2]
    return [
        Measure(what="slip at mu = 0.9", error=abs(float(fallen[held])), tolerance=5e-3, unit="m"),
        Measure(what="fall missing at mu = 0.05", error=max(0.0, 0.1 - float(fallen[dropped])), tolerance=0.05, unit="m"),
    ]


def _bricks(bench: Bench) -> list[int]:
    """Worlds that hold the first object."""
    return [0, len(bench.scene.objects)]


def _grasp(bench: Bench) -> tuple[State, Tensor]:
    """A state with the brick between the jaws of the suite's robot, which close; and the direction in which the thumb closes [3]."""
    robot = bench.scene.robot
    jaw = robot.joint_names.index("jaw_a_slide")
    state = bench.start()
    pos, target = state.joint_pos.clone(), state.joint_target.clone()
    pos[:, jaw], target[:, jaw] = 0.0201, 0.010  # the brick's box is 0.040 m wide
    T_world_wrist = bench.kinematics.link_poses(pos[0].double(), ["wrist"])[0]
    T_wrist_box = torch.eye(4, dtype=torch.float64)
    T_wrist_box[2, 3] = 0.075  # between the pads
    T_world_object = T_world_wrist @ T_wrist_box @ torch.linalg.inv(torch.as_tensor(bench.objects[0].pieces[0].T_body_shape))
    bricks = _bricks(bench)
    object_pos, object_quat = state.object_pos.clone(), state.object_quat.clone()
    object_pos[bricks] = T_world_object[:3, 3].float()
    object_quat[bricks] = matrix_to_quat(T_world_object[:3, :3]).float()
    grasp = replace_fields(state, joint_pos=pos, joint_target=target, object_pos=object_pos, object_quat=object_quat)
    return grasp, -T_world_wrist[:3, 0].float()


CHECKS = (
    Check(
        name="resting_weight",
        claim="the table pushes a resting object up with m g; nothing else does, and nothing right after setting",
        hint="a contact force has the wrong sign, frame, scale or step; or readings survive setting a state; or contacts overflow",
        run=resting_weight,
    ),
    Check(
        name="object_mass",
        claim="the object's mass is set world by world, and setting a state keeps it",
        hint="mass is shared by all worlds or lost with the state, or what derives from it is stale",
        run=object_mass,
        capability="object_mass",
    ),
    Check(
        name="table_friction",
        claim="an object slides on the table with the friction of the pair",
        hint="friction is combined (product, average) from coefficients that were not solved for the pair; or shared by all worlds",
        run=table_friction,
        capability="friction",
    ),
    Check(
        name="held_object",
        claim="fingers carry a held object; each one's force on it has the right sign and names the right finger",
        hint="forces are by the object instead of on it, or go to the wrong finger; or the mimic jaw gives way; or the drive's force is wrong",
        run=held_object,
        own_robot_only=True,
    ),
    Check(
        name="tip_friction",
        claim="an object is held or slips by the friction of the pair with the fingertips",
        hint="the fingertips' friction is not set where their contact links are, or not world by world",
        run=tip_friction,
        capability="friction",
        own_robot_only=True,
    ),
)
