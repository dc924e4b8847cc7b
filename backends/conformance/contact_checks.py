"""Checks of contact: forces and their signs, friction, and what mass does to them."""

from __future__ import annotations

import torch
from torch import Tensor

from xreset.backends.base import State
from xreset.backends.conformance.harness import Bench, largest, replace_fields, snapshot
from xreset.backends.conformance.results import Check, Measure
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
        Measure(what="force right after setting", measured=at_once, tolerance=1e-6, unit="N"),
        Measure(what="vertical force", measured=largest(force[:, 2] / weight - 1.0), tolerance=0.02, unit="of m g"),
        Measure(what="horizontal force", measured=largest(force[:, :2] / weight[:, None]), tolerance=0.02, unit="of m g"),
        Measure(what="force of the fingers", measured=largest(contacts.tip_force), tolerance=1e-6, unit="N"),
        Measure(what="fingers that say they touch", measured=float(contacts.tip_touch.sum()), tolerance=0.5),
        Measure(what="sinking", measured=largest(state.object_pos[:, 2] - bench.start().object_pos[:, 2]), tolerance=2e-3, unit="m"),
        Measure(what="sliding", measured=largest(state.object_pos[:, :2] - bench.start().object_pos[:, :2]), tolerance=2e-3, unit="m"),
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
    return [Measure(what="vertical force", measured=largest(force / (GRAVITY * mass) - 1.0), tolerance=0.02, unit="of m g")]


def table_friction(bench: Bench) -> list[Measure]:
    """Push the same object on the table with two frictions, set before the state: with 0.7 mu m g it must stay, with 1.5 mu m g slide.

    The slide begins at rest, because some contact models lift an object that slides fast.
    """
    backend = bench.altered()
    worlds = _bricks(bench)
    mu = torch.tensor([0.4, 0.15])
    friction = torch.tensor([0.9, 0.5, 0.6]).repeat(bench.NUM_WORLDS, 1)
    friction[worlds, 2] = mu
    backend.set_friction(friction.to(backend.device))
    start = bench.start(backend.device)
    backend.set_state(start)
    backend.step(_SETTLE // 2)
    weight = GRAVITY * bench.objects[0].mass

    def push(ratio: float, steps: int) -> State:
        force = torch.zeros(bench.NUM_WORLDS, 3)
        force[worlds, 0] = ratio * mu * weight
        backend.set_object_wrench(force.to(backend.device), torch.zeros_like(force).to(backend.device))
        backend.step(steps)
        return snapshot(backend.state())

    stuck = push(0.7, 48)
    crept = stuck.object_pos[worlds] - start.object_pos.cpu()[worlds]
    measures = [Measure(what="creep at 0.7 mu m g", measured=largest(crept[:, :2]), tolerance=2e-3, unit="m")]
    before, after = push(1.5, 8), push(1.5, 24)
    gained = (after.object_linvel - before.object_linvel)[worlds]
    for i in range(len(worlds)):
        drag = 1.5 * float(mu[i]) - float(gained[i, 0]) / (24 * bench.scene.timestep * GRAVITY)  # of the friction, in m g
        measures.append(Measure(what=f"drag at mu = {mu[i]:.2f}", measured=abs(drag / float(mu[i]) - 1.0), tolerance=0.1, unit="of mu m g"))
    measures.append(Measure(what="sideways velocity", measured=largest(after.object_linvel[worlds, 1]), tolerance=0.03, unit="m/s"))
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
        Measure(what="vertical force", measured=largest(total[:, 2] / weight - 1.0), tolerance=0.05, unit="of m g"),
        Measure(what="horizontal force", measured=largest(total[:, :2] / weight), tolerance=0.05, unit="of m g"),
        Measure(what="squeeze missing", measured=float((3.0 - squeeze).clamp_min(0.0).max()), tolerance=1.5, unit="N"),
        Measure(what="fingers that do not say they touch", measured=float((~contacts.tip_touch.cpu()[bricks]).sum()), tolerance=0.5),
        Measure(what="force of the table", measured=largest(contacts.table_force[bricks]), tolerance=1e-6, unit="N"),
        Measure(what="slip", measured=largest(end.object_pos[bricks, 2] - state.object_pos[bricks, 2]), tolerance=5e-3, unit="m"),
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
        Measure(what="slip at mu = 0.9", measured=abs(float(fallen[held])), tolerance=5e-3, unit="m"),
        Measure(what="fall missing at mu = 0.05", measured=max(0.0, 0.1 - float(fallen[dropped])), tolerance=0.05, unit="m"),
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
        group="contact",
        statement="the table pushes a resting object up with m g; nothing else does, and nothing right after setting",
        cause="a contact force has the wrong sign, frame, scale or step; or readings survive setting a state; or contacts overflow",
        run=resting_weight,
    ),
    Check(
        name="object_mass",
        group="contact",
        statement="the object's mass is set world by world, and setting a state keeps it",
        cause="mass is shared by all worlds or lost with the state, or what derives from it is stale",
        run=object_mass,
        capabilities=("object_mass",),
    ),
    Check(
        name="table_friction",
        group="contact",
        statement="the table holds or brakes an object with the friction of the pair",
        cause="friction is combined (product, average) from coefficients that were not solved for the pair; or shared by all worlds",
        run=table_friction,
        capabilities=("friction", "object_wrench"),
    ),
    Check(
        name="held_object",
        group="contact",
        statement="fingers carry a held object; each one's force on it has the right sign and names the right finger",
        cause="forces are by the object, not on it; or go to the wrong finger; or the mimic jaw gives way; or the drive's force is wrong",
        run=held_object,
        own_robot_only=True,
    ),
    Check(
        name="tip_friction",
        group="contact",
        statement="an object is held or slips by the friction of the pair with the fingertips",
        cause="the fingertips' friction is not set where their contact links are, or not world by world",
        run=tip_friction,
        capabilities=("friction",),
        own_robot_only=True,
    ),
)
