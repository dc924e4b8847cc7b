"""What the CPU engines must do beyond the conformance suite: laws of mechanics, compared with closed forms; a mix-in for their tests."""

from __future__ import annotations

import unittest
from dataclasses import fields, replace
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from xreset.backends.conformance.scene import gripper, objects, scene
from xreset.backends.pool import PoolBackend
from xreset.geometry.dynamics import mass_matrix
from xreset.geometry.kinematics import Kinematics
from xreset.physics import State
from xreset.spec import GRAVITY, Geometry, ObjectSpec, RobotSpec, SceneSpec, Shape


def copy(state: State) -> State:
    return State(**{f.name: getattr(state, f.name).clone() for f in fields(State)})


def body(
    name: str, *shapes: Geometry | Shape, mass: float = 0.4, com=(0.0, 0.0, 0.0), inertia: np.ndarray | None = None
) -> ObjectSpec:
    return ObjectSpec(
        name=name,
        pieces=tuple(s if isinstance(s, Shape) else Shape(geometry=s) for s in shapes),
        mass=mass,
        com=np.array(com),
        inertia=np.diag([4e-4, 6e-4, 8e-4]) if inertia is None else inertia,
        vertices=np.zeros((4, 3)),
        faces=np.zeros((1, 3), dtype=int),
    )


def hull_box(*half: float) -> Geometry:
    import trimesh

    mesh = trimesh.creation.box(extents=2.0 * np.array(half))
    return Geometry(kind="hull", vertices=np.asarray(mesh.vertices), faces=np.asarray(mesh.faces))


def moved(geometry: Geometry, *pos: float) -> Shape:
    T = np.eye(4)
    T[:3, 3] = pos
    return Shape(geometry=geometry, T_body_shape=T)


FLAT = (
    body("box", Geometry(kind="box", size=(0.05, 0.06, 0.02))),
    body("hull", hull_box(0.05, 0.06, 0.02)),
    body("hull with a low centre of mass", hull_box(0.05, 0.06, 0.02), com=(0.0, 0.0, -0.005)),
    body(
        "two hulls",
        moved(hull_box(0.025, 0.06, 0.02), 0.025, 0.0, 0.0),
        moved(hull_box(0.025, 0.06, 0.02), -0.025, 0.0, 0.0),
    ),
    body("cylinder", Geometry(kind="cylinder", size=(0.06, 0.02))),
)
"""Objects that rest 20 mm above the table."""


def with_drive(robot: RobotSpec, name: str, **changes: float) -> RobotSpec:
    joints = tuple(replace(j, drive=replace(j.drive, **changes)) if j.name == name else j for j in robot.joints)
    return replace(robot, joints=joints)


class EngineChecks:
    """Mixed into a ``unittest.TestCase`` that names the backend."""

    backend_class: ClassVar[type[PoolBackend]]
    one_step_options: ClassVar[dict[str, Any]] = {}
    """Options with which the engine makes a single step per physics step, so that momentum can be balanced."""

    def make(self: unittest.TestCase, what: SceneSpec, num_worlds: int = 1, **options) -> PoolBackend:
        backend = self.backend_class(what, num_worlds, workers=0, **options)  # pyright: ignore[reportAttributeAccessIssue]
        self.addCleanup(backend.close)
        return backend

    def grasp(self, **options) -> tuple[PoolBackend, State]:
        """The suite's gripper with its jaws just around a brick in the air, about to close."""
        backend = self.make(scene(), 1, **options)
        robot, brick = gripper(), objects()[0]
        state = copy(backend.state())
        jaw = robot.joint_names.index("jaw_a_slide")
        state.joint_pos[0, jaw], state.joint_target[0, jaw] = 0.0201, 0.010  # the brick is 40 mm wide
        T_world_wrist = Kinematics(robot).link_poses(state.joint_pos[0].double(), ["wrist"])[0].numpy()
        T_wrist_box = np.eye(4)
        T_wrist_box[2, 3] = 0.075  # between the pads
        T = T_world_wrist @ T_wrist_box @ np.linalg.inv(brick.pieces[0].T_body_shape)
        state.object_pos[0] = torch.tensor(T[:3, 3])
        state.object_quat[0] = torch.tensor(Rotation.from_matrix(T[:3, :3]).as_quat(scalar_first=True))
        backend.set_state(state)
        return backend, state

    # Objects ----------------------------------------------------------------------------------------------------------

    def test_objects_rest_at_their_height(self):
        backend = self.make(replace(scene(), objects=FLAT), len(FLAT))
        for _ in range(30):
            backend.step()
        height = backend.state().object_pos[:, 2]
        torch.testing.assert_close(height, torch.full((len(FLAT),), 0.02), atol=5e-5, rtol=0)

    def test_sliding_distance_is_the_same_in_all_directions(self):
        backend = self.make(replace(scene(), objects=FLAT), len(FLAT))
        start = copy(backend.state())
        for angle in (0.0, np.pi / 4):
            direction = torch.tensor([np.cos(angle), np.sin(angle), 0.0], dtype=torch.float32)
            backend.set_state(replace(start, object_linvel=direction.repeat(len(FLAT), 1)))
            for _ in range(60):
                backend.step()
            distance = (backend.state().object_pos - start.object_pos) @ direction
            expected = 1.0 / (2 * 0.6 * GRAVITY)
            torch.testing.assert_close(
                distance, torch.full((len(FLAT),), expected), atol=0, rtol=0.06, msg=f"{angle}: {distance}"
            )

    def test_torsional_friction_brakes_a_spinning_ball(self):
        ball = body("ball", Geometry(kind="sphere", size=(0.03,)))
        backend = self.make(replace(scene(), objects=(ball,)))
        backend.set_state(replace(copy(backend.state()), object_angvel=torch.tensor([[0.0, 0.0, 10.0]])))
        backend.step(24)
        braking = (10.0 - float(backend.state().object_angvel[0, 2])) / 0.1
        self.assertAlmostEqual(braking, 0.002 * 0.4 * GRAVITY / 8e-4, delta=0.2)

    def test_free_motion_of_an_uneven_body(self):
        inertia = np.array([[4e-4, 1e-4, -5e-5], [1e-4, 6e-4, 2e-5], [-5e-5, 2e-5, 8e-4]])
        uneven = body("uneven", hull_box(0.02, 0.03, 0.04), com=(0.01, -0.005, 0.004), inertia=inertia)
        backend = self.make(replace(scene(), objects=(uneven,)))
        start = replace(
            copy(backend.state()),
            object_pos=torch.tensor([[0.5, 0.2, 0.5]]),
            object_quat=torch.nn.functional.normalize(torch.tensor([[-0.5, 0.3, 0.6, 0.2]])),
            object_linvel=torch.tensor([[0.3, 0.2, 1.0]]),
            object_angvel=torch.tensor([[1.0, -4.0, 6.0]]),
        )
        backend.set_state(start)
        force, torque = np.array([0.5, -1.0, 2.0]), np.array([0.002, -0.001, 0.0015])
        backend.set_object_gravity(torch.tensor([0.5]))
        backend.set_object_wrench(torch.tensor(force)[None], torch.tensor(torque)[None])
        backend.step(24)

        turn = Rotation.from_quat(start.object_quat[0].double().numpy(), scalar_first=True)
        omega = start.object_angvel[0].double().numpy()
        com = start.object_pos[0].double().numpy() + turn.apply(uneven.com)
        velocity = start.object_linvel[0].double().numpy() + np.cross(omega, turn.apply(uneven.com))
        momentum = turn.apply(inertia @ turn.inv().apply(omega))
        n = 1000
        for _ in range(n):  # Euler's equations by the midpoint rule
            dt = 0.1 / n
            middle = Rotation.from_rotvec(omega * dt / 2) * turn
            momentum = momentum + torque * dt
            omega = middle.apply(np.linalg.solve(inertia, middle.inv().apply(momentum)))
            turn = Rotation.from_rotvec(omega * dt) * turn
            velocity = velocity + (force / 0.4 - [0, 0, GRAVITY / 2]) * dt
            com = com + velocity * dt
        state = backend.state()
        np.testing.assert_allclose(state.object_angvel[0], omega, atol=0.05)  # engines are of first order, at 7 rad/s
        np.testing.assert_allclose(
            state.object_linvel[0], velocity - np.cross(omega, turn.apply(uneven.com)), atol=1e-3
        )
        np.testing.assert_allclose(state.object_pos[0], com - turn.apply(uneven.com), atol=2e-3)
        found = Rotation.from_quat(state.object_quat[0].double().numpy(), scalar_first=True)
        self.assertLess((found * turn.inv()).magnitude(), 4e-3)

    # Joints -----------------------------------------------------------------------------------------------------------

    def test_a_drive_pushes_with_its_effort_and_no_more(self):
        robot = with_drive(gripper(), "lift", effort=8.0)
        backend = self.make(scene(robot))
        state = copy(backend.state())
        lift = robot.joint_names.index("lift")
        state.joint_target[0, lift] += 0.25
        backend.set_state(state)
        backend.step(4)
        M = mass_matrix(robot, robot.home) + np.diag([j.drive.armature for j in robot.joints])
        pushed = np.linalg.solve(M, np.eye(len(M))[lift] * 8.0)[lift]
        # The other joints hold, so the true inertia lies between this joint's alone and this.
        held = 8.0 / M[lift, lift]
        speed = float(backend.state().joint_vel[0, lift]) / (4 / 240)
        self.assertGreater(speed, 0.97 * min(held, pushed))
        self.assertLess(speed, 1.03 * max(held, pushed))

    def test_dry_friction_stops_and_holds(self):
        robot = with_drive(gripper(), "finger_b_bend", kp=0.0, kd=0.0, friction_loss=0.005)
        for joint in ("lift", "swing", "turn"):
            robot = with_drive(robot, joint, kp=5000.0, kd=500.0)
        backend = self.make(scene(robot))
        bend = robot.joint_names.index("finger_b_bend")
        state = copy(backend.state())
        state.joint_vel[0, bend] = 2.0
        backend.set_state(state)
        inertia = 1.0 / np.linalg.inv(mass_matrix(robot, robot.home))[bend, bend]
        stop = 2.0 * inertia / 0.005
        n = int(0.5 * stop * 240)
        self.assertGreater(n, 5)
        backend.step(n)
        self.assertAlmostEqual(float(backend.state().joint_vel[0, bend]), 2.0 - 0.005 / inertia * n / 240, delta=0.2)
        backend.step(n + 12)
        rest = float(backend.state().joint_pos[0, bend])
        backend.step(24)
        self.assertAlmostEqual(float(backend.state().joint_pos[0, bend]), rest, delta=2e-4)

    def test_dry_friction_holds_against_a_weak_drive_only(self):
        robot = with_drive(gripper(), "finger_b_bend", kp=1.0, kd=0.05, friction_loss=0.05)
        backend = self.make(scene(robot))
        bend = robot.joint_names.index("finger_b_bend")
        for offset, moves in ((0.04, False), (0.2, True)):
            state = copy(backend.state())
            state.joint_target[0, bend] = offset
            backend.set_state(state)
            backend.step(240)
            self.assertEqual(float(backend.state().joint_pos[0, bend]) > 0.02, moves, offset)

    def test_a_mimic_joint_shares_its_sources_force(self):
        backend, _ = self.grasp()
        backend.set_object_gravity(torch.zeros(1))
        backend.step(240)
        robot = gripper()
        jaw = robot.joint_names.index("jaw_a_slide")
        state = backend.state()
        drive = robot.joints[jaw].drive.kp * float(state.joint_pos[0, jaw] - state.joint_target[0, jaw])
        along = Kinematics(robot).link_poses(state.joint_pos[0].double(), ["wrist"])[0, :3, 0].float()
        force = (
            backend.contacts().tip_force[0] @ along
        ).abs()  # equal, since the brick does not move: F + 1.1 F = drive
        torch.testing.assert_close(force, torch.full((2,), drive / 2.1), rtol=0.03, atol=0.0)

    def test_the_robot_falls_where_its_weight_is_not_compensated(self):
        robot = with_drive(gripper(), "lift", kp=0.0, kd=0.0, armature=0.0)
        for compensated in (True, False):
            backend = self.make(scene(replace(robot, gravity_compensated=compensated)))
            before = float(backend.links().linvel[0, 0, 2])
            backend.step(24)
            fall = before - float(backend.links().linvel[0, 0, 2])
            self.assertAlmostEqual(fall, 0.0 if compensated else GRAVITY * 0.1, delta=0.03)

    # Contacts ---------------------------------------------------------------------------------------------------------

    def test_contact_forces_explain_the_objects_motion(self):
        backend, _ = self.grasp(**self.one_step_options)
        brick = objects()[0]
        backend.set_object_wrench(torch.tensor([[0.5, 0.3, 0.2]]), torch.zeros(1, 3))
        lift = gripper().joint_names.index("lift")
        targets = backend.state().joint_target.clone()

        def com_velocity() -> np.ndarray:
            state = backend.state()
            arm = Rotation.from_quat(state.object_quat[0].numpy(), scalar_first=True).apply(brick.com)
            return state.object_linvel[0].numpy() + np.cross(state.object_angvel[0].numpy(), arm)

        worst, press = 0.0, 0.0
        for i in range(60):
            targets[0, lift] = 0.02 * np.sin(i / 5)
            backend.set_joint_targets(targets)
            before = com_velocity()
            backend.step(1)
            needed = brick.mass * ((com_velocity() - before) * 240 + [0, 0, GRAVITY]) - [0.5, 0.3, 0.2]
            contacts = backend.contacts()
            worst = max(worst, np.abs(contacts.tip_force[0].sum(0).numpy() - needed).max())
            press = max(press, float(contacts.tip_force[0, 0].norm()))
        self.assertGreater(press, 3.0)
        self.assertLess(worst, 0.01 * press)

    def test_a_state_gives_the_same_future_whatever_was_before(self):
        backend, start = self.grasp()

        def future(b: PoolBackend) -> torch.Tensor:
            b.set_state(start)
            rows = []
            for _ in range(10):
                b.step()
                rows.append(torch.cat([b.state().joint_pos[0], b.state().object_pos[0], b.contacts().tip_force[0, 0]]))
            return torch.stack(rows)

        first = future(backend)
        away = copy(backend.state())
        away.object_pos[0] = torch.tensor([0.57, 0.3, 0.05])
        away.joint_target[0, -1] = 0.0
        backend.set_state(away)
        backend.step(50)
        torch.testing.assert_close(future(backend), first, rtol=0, atol=0)
        torch.testing.assert_close(future(self.make(scene())), first, rtol=0, atol=0)

    def test_only_the_links_named_collide_with_one_another(self):
        jaw, bend = (gripper().joint_names.index(name) for name in ("jaw_a_slide", "finger_b_bend"))
        closed = {}
        for links in (("jaw_a", "pad_b"), ()):
            backend = self.make(scene(replace(gripper(), self_collision_links=links)), 2)
            state = copy(backend.state())
            state.object_pos[:] = torch.tensor([0.9, 0.5, 0.05])
            state.joint_pos[:, jaw], state.joint_target[:, jaw] = 0.05, 0.005
            state.joint_target[:, bend] = torch.tensor([0.6, -0.6])  # towards the other jaw, and away from it
            backend.set_state(state)
            backend.step(240)
            closed[links] = backend.state().joint_pos[:, jaw].sort().values
        torch.testing.assert_close(closed[()], torch.full((2,), 0.005), atol=1e-3, rtol=0)
        self.assertAlmostEqual(float(closed["jaw_a", "pad_b"][0]), 0.005, delta=1e-3)
        self.assertGreater(float(closed["jaw_a", "pad_b"][1]), 0.008)

    def test_links_collide_with_the_table_unless_excluded(self):
        lift = gripper().joint_names.index("lift")
        lowest = {}
        for excluded in (("base",), ("base", "jaw_a", "pad_b", "wrist", "column")):
            robot = replace(gripper(), table_exclude=excluded, base_pos=(0.57, 0.05, -0.05))
            backend = self.make(scene(robot))
            state = copy(backend.state())
            state.object_pos[0] = torch.tensor([0.9, 0.6, 0.05])
            down = 1.0 if self._sinks(backend, lift) else -1.0
            state.joint_target[0, lift] = 0.19 * down
            backend.set_state(state)
            backend.step(480)
            lowest[excluded] = float(backend.links().pos[0, 1:, 2].min())
        blocked, free = lowest.values()
        self.assertGreater(blocked, -0.01)
        self.assertLess(free, blocked - 0.02)

    def _sinks(self, backend: PoolBackend, lift: int) -> bool:
        """Whether a larger lift position is lower."""
        start = copy(backend.state())
        before = float(backend.links().pos[0, 0, 2])
        higher = copy(start)
        higher.joint_pos[0, lift] += 0.01
        backend.set_state(higher)
        after = float(backend.links().pos[0, 0, 2])
        backend.set_state(start)
        return after < before
