"""Checks of worlds as such: nothing of the past stays, none influences another, and results repeat."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from xreset.backends.conformance.harness import (
    FRICTIONS,
    Bench,
    Worlds,
    replace_fields,
    small_motion,
    stacked,
    state_errors,
)
from xreset.backends.conformance.results import Measured, Skipped
from xreset.physics import Parameter, State
from xreset.physics.tensors import where
from xreset.spec import GRAVITY


def nothing_stays(bench: Bench) -> Measured:
    """Disturb one world, then set it and a calm one with the same object to one state: both must continue alike."""
    worlds = bench.worlds()
    disturbed, calm = bench.twins
    start = bench.start()
    target = start.joint_pos.clone()
    target[disturbed] += small_motion(bench.kinematics)
    worlds.set_targets(target)
    if "object_wrench" in worlds.backend.capabilities:
        force = torch.zeros(bench.NUM_WORLDS, 3)
        force[disturbed] = torch.tensor([0.5, 0.3, 2.0])
        worlds.push(force, 0.01 * force)
    worlds.step(16)
    state = worlds.advance(start, 16)
    errors = state_errors(state[[disturbed]], state[[calm]])
    if bench.scene.robot.gravity_compensated:
        errors["drift from the target"] = state.joint_pos[disturbed] - start.joint_pos[disturbed]
    return errors


def selected_worlds(bench: Bench) -> Measured:
    """Set two worlds, in descending order, during a motion: they have the new state, the others continue."""
    new = bench.random_state(seed=4)
    start = bench.random_state(seed=5)
    chosen = [3, 1]
    rest = [0, 2]

    def run(interfere: bool) -> tuple[State, Tensor, State]:
        worlds = bench.worlds()
        worlds.advance(start, 4)
        if interfere:
            worlds.set(new, chosen)
        right_after = worlds.state()
        links = worlds.links().pos
        worlds.step(4)
        return right_after, links, worlds.state()

    at_set, links, after = run(interfere=True)
    untouched_at_set, expected_links, untouched = run(interfere=False)
    poses = bench.kinematics.link_poses(new.joint_pos.double(), bench.scene.robot.tracked_links)
    expected_links[chosen] = poses[chosen, :, :3, 3].float()
    return {
        "links": links - expected_links,
        **state_errors(at_set[chosen], new[chosen], "set"),
        **state_errors(at_set[rest], untouched_at_set[rest], "others' at once"),
        **state_errors(after[rest], untouched[rest], "others' later"),
    }


def worlds_independent(bench: Bench) -> Measured:
    """Run twice, the second time with one world quite different: the others must not notice."""
    state = bench.start()
    wild = bench.random_state(seed=6)
    others = [0, 2, 3]
    is_wild = torch.arange(len(state.joint_pos)) == 1
    disturbed = bench.worlds().advance(where(is_wild, wild, state), 32)
    calm = bench.worlds().advance(state, 32)
    return state_errors(disturbed[others], calm[others])


def objects_in_a_batch(bench: Bench) -> Measured:
    """Drop different objects in one batch, and each of them alone: the same must happen."""

    def drop(worlds: Worlds, start: State) -> tuple[State, Tensor]:
        higher = start.object_pos + torch.tensor([0.0, 0.0, 0.002])
        end = worlds.advance(replace_fields(start, object_pos=higher), 48)
        return end, worlds.contacts().table_force[:, 2]

    together, forces = drop(bench.worlds(), bench.start())
    errors = {}
    for i, obj in enumerate(bench.scene.objects):
        with bench.other(bench.scene, [i]) as alone:
            state, force = drop(alone, bench.initial(bench.scene, [i]))
        difference = state_errors(together[[i]], state)
        errors[f"pos of {obj.name}"] = difference["object_pos"]
        errors[f"quat of {obj.name}"] = difference["object_quat"]
        errors[f"weight of {obj.name}"] = float(forces[i] - force[0]) / (obj.mass * GRAVITY)
    return errors


def twins(bench: Bench) -> Measured:
    """Set two worlds with the same object to the same state and let both move and touch alike: they must stay equal."""
    end = _busy(bench, bench.worlds())
    one, other = bench.twins
    return state_errors(end[[one]], end[[other]])


def repeatable(bench: Bench) -> Measured:
    """Do the same twice, with something else in between, and once in new worlds: every bit must be the same.

    The shared worlds are not used, because masses that another check has restored are rounded to single precision.
    """
    with bench.other(bench.scene, bench.object_index) as worlds:
        if not worlds.exact:
            raise Skipped("only CPUs add numbers in the same order every time")
        first = _busy(bench, worlds)
        worlds.advance(bench.random_state(seed=9), 30)
        again = _busy(bench, worlds)
    with bench.other(bench.scene, bench.object_index) as new:
        in_new_worlds = _busy(bench, new)
    return {
        **state_errors(again, first, "again,"),
        **state_errors(in_new_worlds, first, "newly built,"),
    }


def masked_set(bench: Bench) -> Measured:
    """Set state and parameters of the worlds of a mask during a motion: the same as with the single setters."""
    chosen = [3, 1]
    start = bench.random_state(seed=12)
    new = bench.random_state(seed=11)
    scale = torch.tensor([2.0, 0.5, 1.5, 0.7])
    parameters: dict[Parameter, Tensor] = {
        "object_mass": bench.masses * scale,
        "object_inertia": scale.flip(0),
        "object_com": 0.01 * scale[:, None] * torch.tensor([1.0, -1.0, 0.5]),
        "friction": FRICTIONS,
        "torsional_friction": 2e-3 * scale,
        "object_gravity": torch.tensor([0.9, 0.5, 0.1, 0.0]),
        "drives": scale[:, None, None].expand(-1, 3, len(bench.scene.robot.joints)),
    }
    parameters = {
        name: value for name, value in parameters.items() if name in bench.backend.capabilities
    }

    def run(masked: bool) -> State:
        worlds = bench.worlds()
        worlds.advance(start, 4)
        if masked:
            worlds.set_where(chosen, new, parameters)
        else:
            for name, value in parameters.items():
                worlds.set_parameter(name, value, chosen)
            worlds.set(new, chosen)
        worlds.step(12)
        return worlds.state()

    return state_errors(run(masked=True), run(masked=False))


def broken_world(bench: Bench) -> Measured:
    """Give one world numbers that are not finite: health names it alone, the others continue, setting it heals it.

    This check comes last, because an engine may end the process.
    """
    worlds = bench.worlds()
    good = bench.start()
    expected = worlds.advance(good, 4)
    others = [0, 2, 3]
    errors = []
    for field, value in (
        ("object_linvel", torch.nan),
        ("object_pos", torch.inf),
        ("joint_vel", torch.nan),
    ):
        bad = good.clone()
        getattr(bad, field)[1] = value
        after = worlds.advance(bad, 4)
        wrong = worlds.nonfinite() != torch.tensor([False, True, False, False])
        worlds.set(good, [1])
        worlds.step(1)
        found = {
            "worlds named wrongly": wrong.sum(),
            **state_errors(after[others], expected[others], "others'"),
            "worlds broken after healing": worlds.nonfinite().sum(),
            "healed object_pos": worlds.state().object_pos[1] - good.object_pos[1],
        }
        errors.append(found)
    return stacked(errors)


def _busy(bench: Bench, worlds: Worlds) -> State:
    """[N] states after 0.4 s in which tilted, spinning objects fall and every joint moves, alike in all worlds."""
    start = bench.start()
    tilt = torch.tensor([0.98, 0.17, 0.1, 0.02])
    start = replace_fields(
        start,
        object_pos=start.object_pos + torch.tensor([0.0, 0.0, 0.02]),
        object_quat=tilt / tilt.norm(),
        object_linvel=torch.tensor([0.2, -0.1, 0.0]),
        object_angvel=torch.tensor([0.0, 1.0, 2.0]),
    )
    motion = small_motion(bench.kinematics)
    worlds.path(start, (start.joint_pos + motion * math.sin(k / 4) for k in range(24)), 4)
    return worlds.state()
