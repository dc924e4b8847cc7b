"""Checks of what is set and read: states, links, joint order, mimic joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from xreset.backends.conformance.harness import (
    ROUND_TRIP,
    Bench,
    compare_states,
    largest,
    random_state,
    rotation_angle,
    small_motion,
    snapshot,
)
from xreset.backends.conformance.results import Measure, Skipped, checks_of
from xreset.backends.conformance.scene import reorder_joints
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat
from xreset.geometry.urdf import robot_tree
from xreset.physics import Links, State
from xreset.spec import SceneSpec

check = checks_of("state")


def link_measures(
    kinematics: Kinematics,
    state: State,
    links: Links,
    which: Sequence[int] | slice = slice(None),
    tolerance: float = 1e-5,
) -> list[Measure]:
    """Tracked links (some or all of them) against the project's own kinematics of the same state."""
    q, qd = state.joint_pos.double().cpu(), state.joint_vel.double().cpu()
    tracked = kinematics.robot.tracked_links
    poses = kinematics.link_poses(q, tracked)
    jacobian = kinematics.jacobian(q, tracked)
    linvel, angvel = (jacobian.linear @ qd[:, None, :, None])[..., 0], (jacobian.angular @ qd[:, None, :, None])[..., 0]

    def off(found: Tensor, expected: Tensor) -> float:
        return largest(found.double().cpu()[:, which] - expected[:, which])

    angle = rotation_angle(links.quat.cpu(), matrix_to_quat(poses[..., :3, :3]))
    return [
        Measure("pos", off(links.pos, poses[..., :3, 3]), tolerance, "m"),
        Measure("angle", largest(angle[:, which]), tolerance, "rad"),
        Measure("linvel", off(links.linvel, linvel), 10.0 * tolerance, "m/s"),
        Measure("angvel", off(links.angvel, angvel), 10.0 * tolerance, "rad/s"),
    ]


@check(
    "a state that is set is read back, every field of it",
    "a field is dropped, permuted or changed: velocities, quaternion order, body-frame angular velocity, joint order",
)
def state_round_trip(bench: Bench) -> list[Measure]:
    """Set a random state in every world and read it back."""
    backend = bench.backend()
    state = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=1)
    backend.set_state(state.to(backend.device))
    return compare_states(snapshot(backend.state()), state, ROUND_TRIP)


@check(
    "link poses and velocities belong to the state just set, without a step",
    "kinematics are stale after a write; a velocity is of a centre of mass or in the body's frame; a mimic joint is not set",
)
def links_after_set(bench: Bench) -> list[Measure]:
    """Set a random state and compare the tracked links with the URDF's kinematics, without a step."""
    backend = bench.backend()
    state = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=2)
    backend.set_state(state.to(backend.device))
    return link_measures(bench.kinematics, state, backend.links())


@check("link poses belong to the joint positions after steps", "links are read before the last integration")
def links_after_steps(bench: Bench) -> list[Measure]:
    """Move every joint and compare the tracked links with the kinematics of the joint positions on the way."""
    return _on_the_way(bench, [i for i, moved in enumerate(_moved_by_mimics(bench.scene)) if not moved], 1e-5)


@check(
    "links behind a mimic joint are where its source puts them, at once when set, and on the way",
    "mimic joints are left out when a state is set; or the coupling is missing, soft, or on the wrong joint",
)
def mimic_joints(bench: Bench) -> list[Measure]:
    """The same for links that a mimic joint moves: it is set exactly, and then follows through a stiff coupling."""
    mine = [i for i, moved in enumerate(_moved_by_mimics(bench.scene)) if moved]
    if not mine:
        raise Skipped("no tracked link of this robot is moved by a mimic joint")
    backend = bench.backend()
    state = random_state(bench, bench.scene, bench.NUM_WORLDS, seed=10)
    backend.set_state(state.to(backend.device))
    at_once = link_measures(bench.kinematics, state, backend.links(), mine)
    return [replace(m, what=f"at once, {m.what}") for m in at_once] + [
        replace(m, what=f"on the way, {m.what}") for m in _on_the_way(bench, mine, 1e-3)
    ]


def _moved_by_mimics(scene: SceneSpec) -> list[bool]:
    """[K] whether a mimic joint moves each tracked link."""
    tree, mimics = robot_tree(scene.robot), {mimic.joint for mimic in scene.robot.mimics}
    by_child = {joint.child: joint for joint in tree.joints}

    def moved(link: str) -> bool:
        return link in by_child and (by_child[link].name in mimics or moved(by_child[link].parent))

    return [moved(link) for link in scene.robot.tracked_links]


def _on_the_way(bench: Bench, which: list[int], tolerance: float) -> list[Measure]:
    """The largest errors of some tracked links' poses while every joint moves."""
    backend = bench.backend()
    target = torch.as_tensor(bench.scene.robot.home, dtype=torch.float32) + small_motion(bench.kinematics)
    backend.set_joint_targets(target.expand(bench.NUM_WORLDS, -1).contiguous().to(backend.device))
    worst: dict[str, Measure] = {}
    for _ in range(6):
        backend.step(4)
        for measure in link_measures(bench.kinematics, snapshot(backend.state()), backend.links(), which, tolerance)[
            :2
        ]:
            if measure.what not in worst or not measure.measured <= worst[measure.what].measured:
                worst[measure.what] = measure
    return list(worst.values())


@check(
    "joints go by name, whatever order the robot spec has",
    "the engine's own joint order shows through in states or in targets",
)
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
        measures += compare_states(
            snapshot(backend.state()), state, {name: ROUND_TRIP[name] for name in ("joint_pos", "joint_vel")}
        )

        start = bench.placed(State.initial(scene, which)).to(backend.device)
        motion = small_motion(kinematics).to(backend.device)
        backend.set_state(start)
        backend.set_joint_targets(start.joint_pos + torch.diag(motion))  # world i moves joint i
        backend.step(240)  # until they rest, a second for soft drives: on the way, an arm's motion shakes its fingers
        moved = ((backend.state().joint_pos - start.joint_pos) / motion).cpu()
        wrong = moved - torch.eye(count)
        measures.append(Measure("way missing of the joint named", largest(wrong.diagonal()), 0.1, "of it"))
        others = wrong - torch.diag(wrong.diagonal())
        measures.append(Measure("way of others", largest(others), 0.1, "of theirs"))
    return measures
