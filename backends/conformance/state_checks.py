"""Checks of what is set and read: states, links, targets, selected worlds, health."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from xreset.backends.base import Links, State
from xreset.backends.conformance.harness import ROUND_TRIP, Bench, compare_states, largest, replace_fields, snapshot, start_state
from xreset.backends.conformance.results import Check, Measure
from xreset.backends.conformance.scene import reorder_joints
from xreset.kinematics import Kinematics
from xreset.rotations import matrix_to_quat, quat_normalize
from xreset.spec import SceneSpec

_SETTLED: dict[str, tuple[float, str]] = {
    "joint_pos": (1e-5, "rad, m"),
    "joint_vel": (1e-3, "rad/s, m/s"),
    "joint_target": (2e-6, "rad, m"),
    "object_pos": (1e-5, "m"),
    "object_quat": (1e-4, ""),
    "object_linvel": (1e-3, "m/s"),
    "object_angvel": (1e-2, "rad/s"),
}
"""Tolerance of a state that two runs of the same steps must reach: GPUs add numbers in any order."""


def random_state(bench: Bench, scene: SceneSpec, num_worlds: int, seed: int, device: torch.device | str = "cpu") -> State:
    """[N] states with every field away from its default: joints well within their limits, the object in the air, spinning."""
    random = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return 2.0 * torch.rand(*shape, generator=random) - 1.0

    joints = Kinematics(scene.robot)
    home = torch.as_tensor(scene.robot.home, dtype=torch.float64)
    lower, upper = joints.lower.clamp_min(-3.0), joints.upper.clamp_max(3.0)
    reach = 0.3 * (upper - lower)
    count = len(home)
    pos = (home + reach * uniform(num_worlds, count)).clamp(lower + 0.1 * reach, upper - 0.1 * reach)
    return State(
        joint_pos=pos.float(),
        joint_vel=0.5 * uniform(num_worlds, count),
        joint_target=(pos + 0.2 * reach * uniform(num_worlds, count)).float(),
        object_pos=torch.tensor([*bench.place, 1.5]) + 0.05 * uniform(num_worlds, 3),
        object_quat=quat_normalize(uniform(num_worlds, 4)),
        object_linvel=uniform(num_worlds, 3),
        object_angvel=4.0 * uniform(num_worlds, 3),
    ).to(device)


def link_measures(kinematics: Kinematics, state: State, links: Links, tolerance: float = 1e-5) -> list[Measure]:
    """Tracked links against the project's own kinematics of the same state."""
    q, qd = state.joint_pos.double().cpu(), state.joint_vel.double().cpu()
    tracked = kinematics.robot.tracked_links
    poses = kinematics.link_poses(q, tracked)
    jacobian = kinematics.jacobian(q, tracked)
    quat, found = matrix_to_quat(poses[..., :3, :3]), links.quat.double().cpu()
    found = torch.where((quat * found).sum(-1, keepdim=True) < 0, -found, found)
    linvel, angvel = (jacobian.linear @ qd[:, None, :, None])[..., 0], (jacobian.angular @ qd[:, None, :, None])[..., 0]
    return [
        Measure(what="pos", measured=largest(links.pos.cpu() - poses[..., :3, 3]), tolerance=tolerance, unit="m"),
        Measure(what="quat", measured=largest(found - quat), tolerance=tolerance),
        Measure(what="linvel", measured=largest(links.linvel.cpu() - linvel), tolerance=10.0 * tolerance, unit="m/s"),
        Measure(what="angvel", measured=largest(links.angvel.cpu() - angvel), tolerance=10.0 * tolerance, unit="rad/s"),
    ]


def state_round_trip(bench: Bench) -> list[Measure]:
    """Set a random state in every world and read it back."""
    backend = bench.backend()
    state = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=1)
    backend.set_state(state.to(backend.device))
    return compare_states(snapshot(backend.state()), state, ROUND_TRIP)


def links_after_set(bench: Bench) -> list[Measure]:
    """Set a random state and compare the tracked links with the URDF's kinematics, without a step."""
    backend = bench.backend()
    state = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=2)
    backend.set_state(state.to(backend.device))
    return link_measures(bench.kinematics, state, backend.links())


def links_after_steps(bench: Bench) -> list[Measure]:
    """Move every joint and compare the tracked links with the kinematics of the joint positions on the way; mimic joints show here."""
    backend = bench.backend()
    target = torch.as_tensor(bench.scene.robot.home, dtype=torch.float32) + _small_motion(bench.kinematics)
    backend.set_joint_targets(target.expand(bench.NUM_WORLDS, -1).contiguous().to(backend.device))
    worst: dict[str, float] = {}
    for _ in range(6):
        backend.step(4)
        for measure in link_measures(bench.kinematics, snapshot(backend.state()), backend.links())[:2]:
            worst[measure.what] = max(worst.get(measure.what, 0.0), measure.measured)
    loose = 1e-3 if bench.scene.robot.mimics else 1e-5  # a mimic joint follows through a stiff constraint, not exactly
    return [Measure(what=what, measured=error, tolerance=loose, unit="m" if what == "pos" else "") for what, error in worst.items()]


def joint_order(bench: Bench) -> list[Measure]:
    """Name the joints in another order: states still go by name, and a target moves the joint that it names."""
    scene = reorder_joints(bench.scene)
    kinematics = Kinematics(scene.robot)
    count = len(scene.robot.joints)
    which = torch.zeros(count, dtype=torch.long)
    with bench.other(scene, count, object_index=which) as backend:
        state = random_state(bench, scene, count, seed=3)
        backend.set_state(state.to(backend.device))
        links = backend.links()
        measures = link_measures(kinematics, state, links)[:2]
        measures += compare_states(snapshot(backend.state()), state, {name: ROUND_TRIP[name] for name in ("joint_pos", "joint_vel")})

        start = bench.placed(start_state(scene, which)).to(backend.device)
        motion = _small_motion(kinematics).to(backend.device)
        backend.set_state(start)
        backend.set_joint_targets(start.joint_pos + torch.diag(motion))  # world i moves joint i
        backend.step(144)  # until they rest: on the way, an arm's motion shakes its fingers
        moved = ((backend.state().joint_pos - start.joint_pos) / motion).cpu()
        wrong = moved - torch.eye(count)
        measures.append(Measure(what="way missing of the joint named", measured=largest(wrong.diagonal()), tolerance=0.1, unit="of it"))
        others = wrong - torch.diag(wrong.diagonal())
        measures.append(Measure(what="way of others", measured=largest(others), tolerance=0.1, unit="of theirs"))
    return measures


def nothing_stays(bench: Bench) -> list[Measure]:
    """Disturb one world, then set it and an undisturbed one with the same object to the same state: both must go on alike."""
    backend = bench.backend()
    disturbed, calm = 0, len(bench.scene.objects)  # hold the same object
    start = bench.start()
    target = start.joint_pos.clone()
    target[disturbed] += _small_motion(bench.kinematics)
    backend.set_joint_targets(target.to(backend.device))
    wrench = torch.zeros(bench.NUM_WORLDS, 3)
    wrench[disturbed] = torch.tensor([0.5, 0.3, 2.0])
    if "object_wrench" in backend.capabilities:
        backend.set_object_wrench(wrench.to(backend.device), 0.01 * wrench.to(backend.device))
    backend.step(16)
    backend.set_state(start.to(backend.device))
    backend.step(16)
    state = snapshot(backend.state())
    measures = compare_states(state[[disturbed]], state[[calm]], _SETTLED)
    if bench.scene.robot.gravity_compensated:
        drift = largest(state.joint_pos[disturbed] - start.joint_pos[disturbed])
        measures.append(Measure(what="drift from the target", measured=drift, tolerance=1e-3, unit="rad, m"))
    return measures


def selected_worlds(bench: Bench) -> list[Measure]:
    """Set two worlds, in descending order, in the middle of a motion: they have the new state, the others go on as if nothing had been."""
    new = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=4)
    chosen, rest = [3, 1], [0, 2]

    def run(interfere: bool) -> tuple[State, State]:
        backend = bench.backend()
        moving = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=5)
        backend.set_state(moving.to(backend.device))
        backend.step(4)
        if interfere:
            backend.set_state(new[chosen].to(backend.device), torch.tensor(chosen, device=backend.device))
        right_after = snapshot(backend.state())
        backend.step(4)
        return right_after, snapshot(backend.state())

    at_set, after = run(interfere=True)
    untouched_at_set, untouched = run(interfere=False)
    return [
        *compare_states(at_set[chosen], new[chosen], ROUND_TRIP),
        *compare_states(at_set[rest], untouched_at_set[rest], _SETTLED),
        *compare_states(after[rest], untouched[rest], _SETTLED),
    ]


def worlds_independent(bench: Bench) -> list[Measure]:
    """Run twice, the second time with one world quite different: the others must not notice."""

    def run(disturb: bool) -> State:
        backend = bench.backend()
        state = bench.start()
        if disturb:
            wild = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=6)
            state = State(**{f.name: torch.cat((getattr(state, f.name)[:1], getattr(wild, f.name)[1:2], getattr(state, f.name)[2:]))
                             for f in fields(State)})  # fmt: skip
        backend.set_state(state.to(backend.device))
        backend.step(32)
        return snapshot(backend.state())

    others = [0, 2, 3]
    return compare_states(run(True)[others], run(False)[others], _SETTLED)


def objects_in_a_batch(bench: Bench) -> list[Measure]:
    """Drop different objects in one batch, and each of them alone: the same must happen."""

    def drop(state: State) -> State:
        return replace_fields(state, object_pos=state.object_pos + torch.tensor([0.0, 0.0, 0.002]))

    backend = bench.backend()
    backend.set_state(drop(bench.start()).to(backend.device))
    backend.step(48)
    together = snapshot(backend.state())
    weights = backend.contacts().table_force.cpu().clone()
    measures = []
    for i, thing in enumerate(bench.scene.objects):
        which = torch.tensor([i])
        with bench.other(bench.scene, 1, object_index=which) as alone:
            alone.set_state(drop(bench.placed(start_state(bench.scene, which))).to(alone.device))
            alone.step(48)
            state = snapshot(alone.state())
            force = alone.contacts().table_force[0, 2].cpu()
        measures.append(
            Measure(what=f"pos of {thing.name}", measured=largest(together.object_pos[i] - state.object_pos[0]), tolerance=1e-4, unit="m")
        )
        quat, other = together.object_quat[i], state.object_quat[0]
        error = min(largest(quat - other), largest(quat + other))
        measures.append(Measure(what=f"quat of {thing.name}", measured=error, tolerance=2e-3))
        weight = thing.mass * 9.81
        measures.append(
            Measure(what=f"weight of {thing.name}", measured=abs(float(weights[i, 2] - force)) / weight, tolerance=0.05, unit="of m g")
        )
    return measures


def broken_world(bench: Bench) -> list[Measure]:
    """Give one world a velocity that is not a number: health names it and no other, the others go on, and setting it again heals it."""
    backend = bench.backend()
    good = bench.start()
    backend.set_state(good.to(backend.device))
    backend.step(4)
    expected = snapshot(backend.state())

    bad = bench.start()
    bad.object_linvel[1] = float("nan")
    backend.set_state(bad.to(backend.device))
    backend.step(4)
    flags = backend.health().nonfinite.cpu()
    others = [0, 2, 3]
    wrong = (flags != torch.tensor([False, True, False, False])).float()
    measures = [Measure(what="worlds named wrongly", measured=float(wrong.sum()), tolerance=0.5)]
    measures += compare_states(snapshot(backend.state())[others], expected[others], _SETTLED)
    backend.set_state(good[[1]].to(backend.device), torch.tensor([1], device=backend.device))
    backend.step(1)
    measures.append(Measure(what="worlds broken after healing", measured=float(backend.health().nonfinite.sum()), tolerance=0.5))
    measures.append(
        Measure(what="healed object_pos", measured=largest(backend.state().object_pos[1].cpu() - good.object_pos[1]), tolerance=1e-3)
    )
    return measures


def _small_motion(kinematics: Kinematics) -> Tensor:
    """[J] a small way for each joint, towards the middle of its range."""
    home = torch.as_tensor(kinematics.robot.home, dtype=torch.float64)
    lower, upper = kinematics.lower.clamp_min(-3.0), kinematics.upper.clamp_max(3.0)
    step = 0.05 * (upper - lower)
    return torch.where(home > (lower + upper) / 2, -step, step).float()


CHECKS = (
    Check(
        name="state_round_trip",
        group="state",
        statement="a state that is set is read back, every field of it",
        cause="a field is dropped, permuted or changed: velocities, quaternion order, body-frame angular velocity, joint order",
        run=state_round_trip,
    ),
    Check(
        name="links_after_set",
        group="state",
        statement="link poses and velocities belong to the state just set, without a step",
        cause="kinematics are stale after a write; a velocity is of a centre of mass or in the body's frame; a mimic joint is not set",
        run=links_after_set,
    ),
    Check(
        name="links_after_steps",
        group="state",
        statement="link poses belong to the joint positions after steps, mimic joints included",
        cause="links are read before the last integration; or mimic joints do not follow",
        run=links_after_steps,
    ),
    Check(
        name="joint_order",
        group="state",
        statement="joints go by name, whatever order the robot spec has",
        cause="the engine's own joint order shows through in states or in targets",
        run=joint_order,
    ),
    Check(
        name="nothing_stays",
        group="state",
        statement="setting a state leaves nothing of the past: no target, velocity, force or warm start",
        cause="targets are not reset with the state; or warm starts, external forces or contact caches survive it",
        run=nothing_stays,
    ),
    Check(
        name="selected_worlds",
        group="state",
        statement="setting some worlds gives each its state and leaves the others alone",
        cause="indices are sorted or ignored; or setting some worlds resets something of all",
        run=selected_worlds,
    ),
    Check(
        name="worlds_independent",
        group="state",
        statement="worlds do not influence one another",
        cause="worlds share memory, a collision space, a random stream or a solver's convergence test",
        run=worlds_independent,
    ),
    Check(
        name="objects_in_a_batch",
        group="state",
        statement="a world with its own object in a batch does what that object does alone",
        cause="a model field (shape, mass, inertia, bounds or something derived from them) is world 0's in all worlds",
        run=objects_in_a_batch,
    ),
)

LAST = (
    Check(
        name="broken_world",
        group="state",
        statement="a world that is not finite is named, harms no other, and is healed by setting it",
        cause="the engine hides it (automatic reset), spreads it, or keeps it in a cache",
        run=broken_world,
    ),
)
"""Run at the end: an engine that cannot stand numbers that are not finite may take the process with it."""
