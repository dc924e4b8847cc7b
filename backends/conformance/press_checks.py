"""Checks of a foot that presses on an object, on the table and on its own robot, and of dry friction: closed forms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from xreset.backends.conformance.harness import SETTLE, Bench, Worlds
from xreset.backends.conformance.results import Measured, Skipped
from xreset.backends.conformance.robot_checks import with_drives
from xreset.backends.conformance.scene import flat_objects, presser, tin
from xreset.errors import CapabilityError
from xreset.geometry.kinematics import Kinematics
from xreset.geometry.rotations import matrix_to_quat
from xreset.physics import State
from xreset.spec import GRAVITY, RobotSpec, SceneSpec

_PLACES = {"object": (0.15, 0.04), "table": (0.0, 0.0), "shelf": (-0.15, 0.05)}
"""What the foot presses on -> position of the slide there, and height of the surface [m]."""
_FOOT = 0.02  # m from the frame of the foot down to its sole
_DEPTH = 0.01  # m that the target is below the surface: 10 N
_GAP = 0.001  # m between a foot that does not touch and the object
_FRICTIONS = ((0.4, 0.7, 0.9), (0.6, 0.3, 0.5))  # each of the three is once the largest of a pair
_DRAG = 0.01  # m/s
_PUSH = 0.2  # m/s
_CAPSULE = 0.008  # m, the radius of the palm
_TINS = 64


def pressing(bench: Bench) -> Measured:
    """Press on an object on the table with a thumb, an index finger and another link; only that one must be reported,
    and none from 1 mm above the object. Then throw tins with their rims against a capsule: none may fly on.

    The drive presses with kp (q - target), and the table carries that and the object's weight.
    """
    errors = {}
    for role in ("thumb", "index", "other link"):
        scene = _scene(bench, presser(**{role: ("foot",)} if role != "other link" else {}))
        start = _on(scene, ["object"])
        press_joint = scene.robot.joint_names.index("press")
        raised = start.joint_pos.clone()
        raised[:, press_joint] += _GAP
        above = replace(start, joint_pos=raised, joint_target=raised)
        with bench.other(scene) as worlds:
            end = worlds.advance(start, SETTLE)
            contacts = worlds.contacts()
            worlds.advance(above, SETTLE)
            apart = worlds.contacts()
        press = _press(scene, end)
        tips = list(scene.robot.fingertip_names)
        pressing = torch.tensor([tip == role for tip in tips])
        force = contacts.tip_force[0]
        expected = torch.zeros_like(force)
        expected[pressing, :2] = force[pressing, :2]  # a foot may rest against its own slide
        expected[pressing, 2] = -press
        carried = press + GRAVITY * scene.objects[0].mass
        errors[f"{role}: force of the fingers"] = zip(tips, (force - expected) / press)
        errors[f"{role}: force of the table"] = contacts.table_force[0, 2] / carried - 1.0
        wrong = (contacts.tip_touch[0] != pressing).float()
        errors[f"{role}: fingers wrong about a touch"] = zip(tips, wrong)
        errors[f"{role}: fingers that touch from afar"] = zip(tips, apart.tip_touch[0].float())
    errors["rims that are missed"] = _missed_rims(bench)
    return errors


def robot_collisions(bench: Bench) -> Measured:
    """Press on the table and on the robot's own shelf: both hold the foot, unless the description excludes them."""
    errors = {}
    free = replace(presser(), self_collision_links=(), table_exclude=("shelf", "foot"))
    places = ["table", "shelf"]
    for robot, what in ((presser(), "sinking into the"), (free, "held up by the excluded")):
        scene = _scene(bench, robot)
        start = _on(scene, places)
        with bench.other(scene, [0, 0]) as worlds:
            end = worlds.advance(start, SETTLE)
        press = scene.robot.joint_names.index("press")
        goal = start if robot is not free else replace(start, joint_pos=start.joint_target)
        off = (end.joint_pos - goal.joint_pos)[:, press]
        for place, error in zip(places, off, strict=True):
            errors[f"{what} {place}"] = error
    return errors


def robot_friction(bench: Bench) -> Measured:
    """Press on the object, the table and the robot's own shelf, and drag slowly: friction is that of the pair.

    The drive of the slide pulls with mu times the force with which the other drive presses.
    """
    errors: dict[str, list[tuple[str, Tensor]]] = {place: [] for place in _PLACES}
    for foot, shelf, places in (
        ("tip", "link", _PLACES),
        ("link", "link", _PLACES),
        ("tip", "tip", ("shelf",)),
    ):
        cases = list(product(places, _FRICTIONS))
        fingers = {"thumb": ("foot",) if foot == "tip" else ()}
        fingers["index"] = ("shelf",) if shelf == "tip" else ()
        scene = _scene(bench, presser(**{name: links for name, links in fingers.items() if links}))
        start = _on(scene, [place for place, _ in cases])
        with bench.other(scene, [0] * len(cases)) as worlds:
            worlds.set_parameter("friction", torch.tensor([values for _, values in cases]))
            found = _dragged(worlds, scene, start)
        for (place, (tip, link, table)), mu in zip(cases, found, strict=True):
            own = {"tip": tip, "link": link}
            expected = {
                "object": own[foot],
                "table": max(own[foot], table),
                "shelf": max(own[foot], own[shelf]),
            }[place]
            errors[place].append(
                (
                    f"{foot} on {shelf if place == 'shelf' else place}, mu {expected}",
                    mu / expected - 1.0,
                )
            )
    return {f"on the {place}": found for place, found in errors.items()}


def pushed_object(bench: Bench) -> Measured:
    """Push an object along the table: from 0.1 s after the impact on, the foot and the table touch it in every step."""
    scene = _scene(bench, presser(thumb=("foot",)))
    start = _on(scene, ["object"], depth=0.0)
    slide = scene.robot.joint_names.index("slide")
    press = scene.robot.joint_names.index("press")
    half = scene.objects[0].vertices[:, 0].max()
    target = start.joint_pos.clone()
    target[:, slide] -= half + _FOOT
    target[:, press] -= 0.035  # the sole is 5 mm above the table
    start = replace(start, joint_pos=target, joint_target=target.clone())
    forces = []
    with bench.other(scene) as worlds:
        worlds.set(start)
        for _ in range(round(0.6 / scene.timestep)):
            target[:, slide] += _PUSH * scene.timestep
            worlds.set_targets(target)
            worlds.step(1)
            contacts = worlds.contacts()
            forces.append(torch.stack((contacts.tip_force[0, 0, 0], contacts.table_force[0, 2])))
    pushing = torch.stack(forces) > 0.01 * GRAVITY * scene.objects[0].mass
    touched = int(pushing[:, 0].float().argmax())
    away = 1.0 - pushing[touched + round(0.1 / scene.timestep) :].float().mean(0)
    return {"without the foot": away[0], "without the table": away[1]}


def joint_friction(bench: Bench) -> Measured:
    """Step the target of a slide with dry friction, by more and by less than what the friction holds.

    m x'' = kp (target - x) - kd x' - loss while it moves; the damping is strong, so it stops once.
    """
    loss = 4.0
    robot = presser()
    index = robot.joint_names.index("slide")
    friction_loss = np.zeros(len(robot.joints))
    friction_loss[index] = loss
    scene = with_drives(_scene(bench, robot), friction_loss=friction_loss)
    steps = torch.tensor([0.02, -0.02, 0.003, -0.003])
    object_index = [0] * len(steps)
    start = _on(scene, ["table"] * len(steps), depth=-0.02)
    target = start.joint_target.clone()
    target[:, index] += steps
    try:
        with bench.other(scene, object_index) as worlds:
            path = worlds.path(start, [target] * 40, 4)[..., index].double().numpy()
    except CapabilityError as error:
        raise Skipped(str(error)) from error
    drive = robot.joints[index].drive
    mass = 2.0  # kg, of slider and foot
    times = 4 * scene.timestep * np.arange(1, 41)

    def motion(_, y: np.ndarray) -> list[float]:
        force = drive.kp * (0.02 - y[0]) - drive.kd * y[1] - loss
        return [y[1], force / mass if y[1] > 0 or force > 0 else 0.0]

    way = solve_ivp(motion, (0.0, times[-1]), [0.0, 0.0], t_eval=times, max_step=1e-3).y[0]
    signed = path * np.sign(steps.numpy())
    return {
        "way against friction": (signed[:, :2] - way[:, None]) / 0.02,
        "way within friction": signed[:, 2:] / 0.003,
    }


def _missed_rims(bench: Bench) -> Tensor:
    """Return how many tins fly on unnoticed that touch a capsule with an edge or a corner of their rim, 0.3 mm deep."""
    hull = tin()
    scene = replace(bench.scene, robot=presser(thumb=("palm",)), objects=(hull,))
    object_index = [0] * _TINS
    start = State.initial(scene, torch.tensor(object_index))
    kinematics = Kinematics(scene.robot)
    center = kinematics.points(kinematics.home, ["palm"])[0]
    for i in range(_TINS):
        # in the frame of the tin: the direction to the capsule, and the axis of the capsule
        angle = 2 * np.pi * i / _TINS
        out = np.array([np.cos(angle), np.sin(angle), 1.0]) / np.sqrt(2.0)
        tangent = np.array([-np.sin(angle), np.cos(angle), 0.0])
        axis = np.cos(i) * tangent + np.sin(i) * np.cross(out, tangent)
        height = hull.vertices @ out
        rim = hull.vertices[height > height.max() - 1e-9].mean(axis=0)
        # in the world, the capsule is along z, and the tin comes from the other side of x
        turn = np.stack((out, np.cross(axis, out), axis))
        reach = turn @ rim + np.array([_CAPSULE - 3e-4, 0.0, 0.0])
        start.object_pos[i] = center - torch.tensor(reach)
        start.object_quat[i] = matrix_to_quat(torch.tensor(turn))
    start.object_linvel[:, 0] = _PUSH
    with bench.other(scene, object_index) as worlds:
        worlds.advance(start, 1)
        touched = worlds.contacts().tip_touch[:, 0]
        # by the end of the step, a stiff engine may have stopped the tin already, and a stopped one does not press
        stopped = worlds.state().object_linvel[:, 0] < _PUSH / 2
        return (~(touched | stopped)).float().sum()


def _scene(bench: Bench, robot: RobotSpec) -> SceneSpec:
    return replace(bench.scene, robot=robot, objects=flat_objects()[:1])


def _on(scene: SceneSpec, places: Sequence[str], depth: float = _DEPTH) -> State:
    """Return states with the foot on some surfaces, about to press; the object is under it or out of its way."""
    start = State.initial(scene, torch.zeros(len(places), dtype=torch.long))
    names = scene.robot.joint_names
    x, y, z = scene.robot.base_pos
    for i, place in enumerate(places):
        slide, height = _PLACES[place]
        start.joint_pos[i, names.index("slide")] = slide
        start.joint_pos[i, names.index("press")] = height + _FOOT - z
        away = 0.0 if place == "object" else 0.3
        start.object_pos[i, :2] = torch.tensor([x + _PLACES["object"][0], y + away])
    target = start.joint_pos.clone()
    target[:, names.index("press")] -= depth
    return replace(start, joint_target=target)


def _press(scene: SceneSpec, state: State) -> Tensor:
    """[N] force of the drive that presses, at rest; never 0, because others are divided by it."""
    index = scene.robot.joint_names.index("press")
    drive = scene.robot.joints[index].drive
    return (drive.kp * (state.joint_pos - state.joint_target)[:, index]).clamp_min(1e-6)


def _dragged(worlds: Worlds, scene: SceneSpec, start: State) -> Tensor:
    """[N] friction of a foot that is dragged slowly: force of the slide's drive over that of the other."""
    index = scene.robot.joint_names.index("slide")
    drive = scene.robot.joints[index].drive
    worlds.advance(start, SETTLE)
    target = start.joint_target.clone()
    drags = []
    presses = []
    before = worlds.state().joint_pos[:, index]
    for step in range(480):
        target[:, index] += _DRAG * scene.timestep
        worlds.set_targets(target)
        worlds.step(1)
        state = worlds.state()
        now = state.joint_pos[:, index]
        if step >= 360:
            drags.append(
                drive.kp * (target[:, index] - (now + before) / 2)
                - drive.kd * (now - before) / scene.timestep
            )
            presses.append(_press(scene, state))
        before = now
    return torch.stack(drags).mean(0) / torch.stack(presses).mean(0)
