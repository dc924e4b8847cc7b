"""Checks of worlds as such: nothing of the past stays in one, none influences another, and the same input gives the same output."""

from __future__ import annotations

import math
from dataclasses import fields

import torch
from torch import Tensor

from xreset.backends.conformance.harness import (
    ROUND_TRIP,
    Bench,
    advanced,
    compare_states,
    largest,
    random_state,
    replace_fields,
    small_motion,
    snapshot,
)
from xreset.backends.conformance.results import Measure, Skipped, checks_of
from xreset.physics import Backend, Parameters, State

check = checks_of("worlds")

_SAME: dict[str, tuple[float, str]] = {
    "joint_pos": (1e-5, "rad, m"),
    "joint_vel": (1e-3, "rad/s, m/s"),
    "joint_target": (2e-6, "rad, m"),
    "object_pos": (1e-5, "m"),
    "object_quat": (1e-4, ""),
    "object_linvel": (1e-3, "m/s"),
    "object_angvel": (1e-2, "rad/s"),
}
"""Tolerance of a state that two runs of the same steps must reach: GPUs add numbers in any order."""

_EXACT = {name: (0.0, unit) for name, (_, unit) in _SAME.items()}
"""The same where they are added in one order."""


@check(
    "setting a state leaves nothing of the past: no target, velocity, force or warm start",
    "targets are not reset with the state; or warm starts, external forces or contact caches survive it",
)
def nothing_stays(bench: Bench) -> list[Measure]:
    """Disturb one world, then set it and an undisturbed one with the same object to the same state: both must go on alike."""
    backend = bench.backend()
    disturbed, calm = 0, len(bench.scene.objects)  # hold the same object
    start = bench.start()
    target = start.joint_pos.clone()
    target[disturbed] += small_motion(bench.kinematics)
    backend.set_joint_targets(target.to(backend.device))
    wrench = torch.zeros(bench.NUM_WORLDS, 3)
    wrench[disturbed] = torch.tensor([0.5, 0.3, 2.0])
    if "object_wrench" in backend.capabilities:
        backend.set_object_wrench(wrench.to(backend.device), 0.01 * wrench.to(backend.device))
    backend.step(16)
    state = advanced(backend, start, 16)
    measures = compare_states(state[[disturbed]], state[[calm]], _SAME)
    if bench.scene.robot.gravity_compensated:
        drift = largest(state.joint_pos[disturbed] - start.joint_pos[disturbed])
        measures.append(Measure("drift from the target", drift, 1e-3, "rad, m"))
    return measures


@check(
    "setting some worlds gives each its state and leaves the others alone",
    "indices are sorted or ignored; or setting some worlds resets something of all",
)
def selected_worlds(bench: Bench) -> list[Measure]:
    """Set two worlds, in descending order, in the middle of a motion: they have the new state, the others go on as if nothing had been."""
    new = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=4)
    chosen, rest = [3, 1], [0, 2]

    def run(interfere: bool) -> tuple[State, State]:
        backend = bench.backend()
        advanced(backend, random_state(bench, bench.scene, bench.NUM_WORLDS, seed=5), 4)
        if interfere:
            backend.set_state(new[chosen].to(backend.device), torch.tensor(chosen, device=backend.device))
        right_after = snapshot(backend.state())
        backend.step(4)
        return right_after, snapshot(backend.state())

    at_set, after = run(interfere=True)
    untouched_at_set, untouched = run(interfere=False)
    return [
        *compare_states(at_set[chosen], new[chosen], ROUND_TRIP, "set"),
        *compare_states(at_set[rest], untouched_at_set[rest], _SAME, "others' at once"),
        *compare_states(after[rest], untouched[rest], _SAME, "others' later"),
    ]


@check(
    "worlds do not influence one another",
    "worlds share memory, a collision space, a random stream or a solver's convergence test",
)
def worlds_independent(bench: Bench) -> list[Measure]:
    """Run twice, the second time with one world quite different: the others must not notice."""

    def run(disturb: bool) -> State:
        backend = bench.backend()
        state = bench.start()
        if disturb:
            wild = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=6)
            state = State(**{f.name: torch.cat((getattr(state, f.name)[:1], getattr(wild, f.name)[1:2], getattr(state, f.name)[2:]))
                             for f in fields(State)})  # fmt: skip
        return advanced(backend, state, 32)

    others = [0, 2, 3]
    return compare_states(run(True)[others], run(False)[others], _SAME)


@check(
    "a world with its own object in a batch does what that object does alone",
    "a model field (shape, mass, inertia, bounds or something derived from them) is world 0's in all worlds",
)
def objects_in_a_batch(bench: Bench) -> list[Measure]:
    """Drop different objects in one batch, and each of them alone: the same must happen."""

    def drop(state: State) -> State:
        return replace_fields(state, object_pos=state.object_pos + torch.tensor([0.0, 0.0, 0.002]))

    backend = bench.backend()
    together = advanced(backend, drop(bench.start()), 48)
    weights = backend.contacts().table_force.cpu().clone()
    measures = []
    for i, thing in enumerate(bench.scene.objects):
        which = torch.tensor([i])
        with bench.other(bench.scene, 1, object_index=which) as alone:
            state = advanced(alone, drop(bench.placed(State.initial(bench.scene, which))), 48)
            force = alone.contacts().table_force[0, 2].cpu()
        measures.append(
            Measure(f"pos of {thing.name}", largest(together.object_pos[i] - state.object_pos[0]), 1e-4, "m")
        )
        quat, other = together.object_quat[i], state.object_quat[0]
        error = min(largest(quat - other), largest(quat + other))
        measures.append(Measure(f"quat of {thing.name}", error, 2e-3))
        weight = thing.mass * 9.81
        measures.append(Measure(f"weight of {thing.name}", abs(float(weights[i, 2] - force)) / weight, 0.05, "of m g"))
    return measures


@check(
    "two worlds in the same state stay equal, on a CPU to the last bit",
    "worlds share a random stream; a world's number, place or neighbours enter its physics; contacts come in another order",
)
def twins(bench: Bench) -> list[Measure]:
    """Set two worlds with the same object to the same state, let them go through contacts and motions alike: they must stay equal."""
    backend = bench.backend()
    end = _busy(bench, backend)
    one, other = 0, len(bench.scene.objects)  # hold the same object
    tolerances = _SAME if backend.device.type == "cuda" else _EXACT
    return compare_states(end[[one]], end[[other]], tolerances)


@check(
    "on a CPU, the same input gives the same output to the last bit, whatever was before and in new worlds too",
    "a random stream, time or memory's addresses enter the physics; contact caches or warm starts survive the setting of a state",
)
def repeatable(bench: Bench) -> list[Measure]:
    """Do the same twice, with something else in between, and once more in worlds newly built: every bit must be the same.

    The worlds that the checks share will not do: the masses that another check has put back in them are rounded to single precision.
    """
    with bench.other(bench.scene, bench.NUM_WORLDS, bench.object_index) as backend:
        if backend.device.type != "cpu":
            raise Skipped("only CPUs add numbers in the same order every time")
        first = _busy(bench, backend)
        advanced(backend, random_state(bench, bench.scene, bench.NUM_WORLDS, seed=9), 30)
        measures = compare_states(_busy(bench, backend), first, _EXACT, "again,")
    with bench.other(bench.scene, bench.NUM_WORLDS, bench.object_index) as new:
        return measures + compare_states(_busy(bench, new), first, _EXACT, "newly built,")


@check(
    "setting the worlds of a mask does what the single setters do for those worlds, and nothing to the others",
    "values are taken in the order of the mask instead of the worlds; the mask is ignored; derived quantities are left out",
    capabilities=("object_mass", "friction", "object_gravity"),
)
def masked_set(bench: Bench) -> list[Measure]:
    """Set state, mass, friction and gravity of the worlds of a mask in the middle of a motion: as the single setters do."""
    chosen = [3, 1]
    new = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=11)
    scale = torch.tensor([2.0, 0.5, 1.5, 0.7])
    parameters: dict[str, Tensor] = {
        "object_mass": torch.tensor([thing.mass for thing in bench.objects]) * scale,
        "object_inertia": scale.flip(0),
        "object_com": 0.01 * scale[:, None] * torch.tensor([1.0, -1.0, 0.5]),
        "friction": torch.tensor([[0.8, 0.4, 0.3], [0.7, 0.5, 0.9], [0.6, 0.3, 0.45], [0.9, 0.6, 0.2]]),
        "torsional_friction": 2e-3 * scale,
        "object_gravity": torch.tensor([0.9, 0.5, 0.1, 0.0]),
        "drives": scale[:, None, None].expand(-1, 3, len(bench.scene.robot.joints)),
    }

    def run(masked: bool) -> State:
        backend = bench.altered()
        backend.set_state(random_state(bench, bench.scene, bench.NUM_WORLDS, seed=12).to(backend.device))
        backend.step(4)
        values = {name: value for name, value in parameters.items() if name in backend.capabilities}
        values = {name: value.float().to(backend.device) for name, value in values.items()}
        if masked:
            mask = torch.zeros(bench.NUM_WORLDS, dtype=torch.bool, device=backend.device)
            mask[chosen] = True
            backend.set_where(mask, new.to(backend.device), Parameters(**values))
        else:
            worlds = torch.tensor(chosen, device=backend.device)
            for name, value in values.items():
                getattr(backend, f"set_{name}")(value[worlds], worlds)
            backend.set_state(new[chosen].to(backend.device), worlds)
        backend.step(12)
        return snapshot(backend.state())

    return compare_states(run(masked=True), run(masked=False), _SAME)


def _busy(bench: Bench, backend: Backend) -> State:
    """[N] states after 0.4 s in which tilted, spinning objects fall on the table and every joint moves, alike in all worlds."""
    start = bench.start()
    n, device = bench.NUM_WORLDS, backend.device
    start = replace_fields(
        start,
        object_pos=start.object_pos + torch.tensor([0.0, 0.0, 0.02]),
        object_quat=torch.tensor([0.98, 0.17, 0.1, 0.02]) / torch.tensor([0.98, 0.17, 0.1, 0.02]).norm(),
        object_linvel=torch.tensor([0.2, -0.1, 0.0]),
        object_angvel=torch.tensor([0.0, 1.0, 2.0]),
    )
    backend.set_state(start.to(device))
    motion = small_motion(bench.kinematics)
    for k in range(24):
        targets = start.joint_pos + motion * math.sin(k / 4)
        backend.set_joint_targets(targets.expand(n, -1).contiguous().to(device))
        backend.step(4)
    return snapshot(backend.state())


@check(
    "a world that is not finite is named, harms no other, and is healed by setting it",
    "the engine hides it (automatic reset), spreads it, or keeps it in a cache",
    last=True,
)
def broken_world(bench: Bench) -> list[Measure]:
    """Give one world a velocity that is not a number: health names it and no other, the others go on, and setting it again heals it."""
    backend = bench.backend()
    good = bench.start()
    expected = advanced(backend, good, 4)

    bad = bench.start()
    bad.object_linvel[1] = float("nan")
    after = advanced(backend, bad, 4)
    flags = backend.health().nonfinite.cpu()
    others = [0, 2, 3]
    wrong = (flags != torch.tensor([False, True, False, False])).float()
    measures = [Measure("worlds named wrongly", float(wrong.sum()), 0.5)]
    measures += compare_states(after[others], expected[others], _SAME, "others'")
    backend.set_state(good[[1]].to(backend.device), torch.tensor([1], device=backend.device))
    backend.step(1)
    measures.append(Measure("worlds broken after healing", float(backend.health().nonfinite.sum()), 0.5))
    measures.append(
        Measure("healed object_pos", largest(backend.state().object_pos[1].cpu() - good.object_pos[1]), 1e-3)
    )
    return measures
