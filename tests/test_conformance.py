"""Every backend that can be used here keeps the contracts; and the suite that says so can fail."""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
import unittest
from dataclasses import replace
from pathlib import Path
from typing import ClassVar
from unittest import mock

import numpy as np
import torch

from xreset.backends import backend_names, backend_status, make_backend
from xreset.backends.base import KnownDifference
from xreset.backends.conformance import CHECKS, CheckResult, Measure, run
from xreset.backends.mujoco import MujocoBackend, MujocoWorld
from xreset.cli import main
from xreset.errors import BackendUnavailableError


def make_local(name: str):
    """A maker of the backend with its worlds in this process, where it has a choice."""
    options = {"workers": 0} if name in ("mujoco", "pybullet", "sapien") else {}
    return lambda scene, num_worlds, *, object_index=None: make_backend(name, scene, num_worlds, object_index=object_index, **options)


def explain(result: CheckResult) -> str:
    wrong = "; ".join(f"{m.what} {m.measured:.3g} > {m.tolerance:.3g} {m.unit}" for m in result.measures if m.verdict != "passed")
    return f"{result.name}: {result.check.statement}: {result.problem or wrong}"


class EveryBackend(unittest.TestCase):
    def test_every_available_backend_passes(self):
        for name in backend_names():
            status = backend_status(name)
            with self.subTest(backend=name):
                if status.reason is not None:
                    self.skipTest(f"{name}: {status.reason}")
                results = run(make_local(name))
                self.assertEqual([r.name for r in results], [c.name for c in CHECKS])
                self.assertEqual([explain(r) for r in results if r.verdict != "passed"], [])


class TheSuiteCanFail(unittest.TestCase):
    """Each world below breaks one contract that engines have broken before; the check for it must go red."""

    def outcome(self, world: type[MujocoWorld], *checks: str, capabilities: frozenset | None = None) -> dict[str, CheckResult]:
        class Broken(MujocoBackend):
            world_class: ClassVar = world

        if capabilities is not None:
            Broken.capabilities = capabilities
        results = run(
            lambda scene, num_worlds, *, object_index=None: Broken(scene, num_worlds, object_index=object_index, workers=0), only=checks
        )
        return {result.name: result for result in results}

    def assert_red(self, world: type[MujocoWorld], *checks: str):
        for name, result in self.outcome(world, *checks).items():
            self.assertEqual(result.verdict, "failed", name)
            self.assertTrue(result.check.cause)
            self.assertEqual(result.problem, "", "it must fail by a measure, not by an exception")

    def test_joints_in_alphabetical_order(self):
        class World(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                self._order = np.argsort(scene.robot.joint_names)

            def set_joint_targets(self, targets):
                super().set_joint_targets(targets[self._order])

        self.assert_red(World, "joint_order")

    def test_joint_state_permuted_both_ways(self):
        class World(MujocoWorld):
            def set_state(self, state):
                super().set_state({**state, "joint_pos": state["joint_pos"][::-1]})

            def get_state(self):
                state = super().get_state()
                return {**state, "joint_pos": state["joint_pos"][::-1]}

        self.assert_red(World, "links_after_set", "joint_order")

    def test_angular_velocity_in_the_body_frame(self):
        class World(MujocoWorld):
            def set_state(self, state):
                super().set_state(state)
                at = self._at
                self._data.qvel[at.object_dof + 3 : at.object_dof + 6] = state["object_angvel"]

            def get_state(self):
                at = self._at
                return {**super().get_state(), "object_angvel": self._data.qvel[at.object_dof + 3 : at.object_dof + 6].copy()}

        self.assertEqual(self.outcome(World, "state_round_trip")["state_round_trip"].verdict, "passed")
        self.assert_red(World, "free_fall")

    def test_linear_velocity_of_the_centre_of_mass(self):
        class World(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                self._com = scene.objects[object_index].com

            def _shift(self, state):
                w, *xyz = state["object_quat"]
                u = np.array(xyz)
                arm = self._com + 2 * np.cross(u, np.cross(u, self._com) + w * self._com)
                return np.cross(state["object_angvel"], arm)

            def set_state(self, state):
                super().set_state({**state, "object_linvel": state["object_linvel"] - self._shift(state)})

            def get_state(self):
                state = super().get_state()
                return {**state, "object_linvel": state["object_linvel"] + self._shift(state)}

        self.assert_red(World, "free_fall")

    def test_target_not_reset_with_the_state(self):
        class World(MujocoWorld):
            def set_state(self, state):
                kept = self._data.ctrl.copy()
                super().set_state(state)
                self._data.ctrl[:] = kept

            def set_joint_targets(self, targets):
                if self._stepped:
                    return
                super().set_joint_targets(targets)

        self.assert_red(World, "state_round_trip")

    def test_wrench_that_survives_the_state(self):
        class World(MujocoWorld):
            _kept = np.zeros(3)

            def set_object_wrench(self, force, torque):
                self._kept = force if force.any() else self._kept
                super().set_object_wrench(self._kept, torque)

        self.assert_red(World, "nothing_stays", "object_wrench")

    def test_stale_kinematics(self):
        class World(MujocoWorld):
            def _update_kinematics(self):
                if self._stepped:
                    super()._update_kinematics()

        self.assert_red(World, "links_after_set")

    def test_links_of_the_step_before(self):
        class World(MujocoWorld):
            def _update_kinematics(self):
                if not self._stepped:
                    super()._update_kinematics()

        self.assert_red(World, "links_after_steps")

    def test_mimic_joint_that_does_not_follow(self):
        class World(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                self._data.eq_active[:] = 0
                self._model.eq_active0[:] = 0

        self.assert_red(World, "links_after_steps")

    def test_contact_force_by_the_object(self):
        class World(MujocoWorld):
            def contacts(self):
                tip_force, touch, table_force = super().contacts()
                return -tip_force, touch, -table_force

        self.assert_red(World, "resting_weight", "held_object")

    def test_fingers_mixed_up(self):
        class World(MujocoWorld):
            def contacts(self):
                tip_force, touch, table_force = super().contacts()
                return tip_force[::-1], touch[::-1], table_force

        self.assert_red(World, "held_object")

    def test_contact_force_that_survives_the_state(self):
        class World(MujocoWorld):
            _last = None

            def contacts(self):
                if self._stepped:
                    self._last = super().contacts()
                return super().contacts() if self._last is None else self._last

        self.assertEqual(self.outcome(World, "resting_weight")["resting_weight"].verdict, "passed")  # no step came before
        results = self.outcome(World, "nothing_stays", "resting_weight")
        self.assertEqual(results["nothing_stays"].verdict, "passed")
        self.assertEqual(results["resting_weight"].verdict, "failed")

    def test_worlds_that_influence_one_another(self):
        class World(MujocoWorld):
            seen: ClassVar[list[float]] = []

            def step(self, n):
                self.seen.append(float(self._data.qpos[self._at.joint_qpos[1]]))
                self._data.qfrc_applied[self._at.joint_dof[1]] = sum(self.seen[-4:])
                super().step(n)

        self.assert_red(World, "worlds_independent")

    def test_setting_one_world_brakes_the_others(self):
        class World(MujocoWorld):
            others: ClassVar[list[MujocoWorld]] = []

            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                self.others.append(self)

            def set_state(self, state):
                super().set_state(state)
                for other in self.others:
                    other._data.qvel[:] *= 0.9

        self.assert_red(World, "selected_worlds")

    def test_every_world_has_the_first_object(self):
        class World(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, 0 if object_index == 2 else object_index)

        self.assert_red(World, "free_fall", "resting_weight")

    def test_parameters_lost_with_the_state(self):
        class World(MujocoWorld):
            def set_state(self, state):
                at = self._at
                self._model.body_gravcomp[at.object_body] = 0.0
                self._model.body_mass[at.object_body] = at.model.body_mass[at.object_body]
                self._model.geom_friction[:] = at.model.geom_friction
                super().set_state(state)

        self.assert_red(World, "object_gravity", "object_mass", "table_friction", "tip_friction")

    def test_wrench_at_the_origin_of_the_mesh_frame(self):
        class World(MujocoWorld):
            def set_object_wrench(self, force, torque):
                data, body = self._data, self._at.object_body
                arm = data.xpos[body] - data.xipos[body]
                super().set_object_wrench(force, torque + np.cross(arm, force))

        self.assert_red(World, "object_wrench")

    def test_drive_without_armature_or_effort_limit(self):
        class NoArmature(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                self._model.dof_armature[:] = 0.0

        class NoLimit(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                self._model.actuator_forcelimited[:] = 0

        self.assert_red(NoArmature, "drive_equation")
        self.assert_red(NoLimit, "drive_equation")

    def test_hidden_broken_world(self):
        class World(MujocoWorld):
            def health(self):
                return False, False

        self.assert_red(World, "broken_world")

    def test_missing_capability_must_be_refused(self):
        lacking = MujocoBackend.capabilities - {"object_gravity"}
        result = self.outcome(MujocoWorld, "object_gravity", capabilities=lacking)["object_gravity"]
        self.assertEqual(result.verdict, "unsupported")
        self.assertIn("object gravity", result.problem)
        with mock.patch.object(MujocoBackend, "_require", lambda *_: None):
            result = self.outcome(MujocoWorld, "object_gravity", capabilities=lacking)["object_gravity"]
        self.assertEqual(result.verdict, "failed")
        self.assertIn("did not refuse", result.problem)

    def test_an_exception_is_a_failure_of_that_check_only(self):
        class World(MujocoWorld):
            def set_object_mass(self, mass):
                raise ArithmeticError("boom")

        results = self.outcome(World, "object_mass", "resting_weight")
        self.assertIn("boom", results["object_mass"].problem)
        self.assertEqual(results["object_mass"].verdict, "failed")
        self.assertEqual(results["resting_weight"].verdict, "passed")


class Harness(unittest.TestCase):
    def test_a_number_that_is_not_finite_is_not_ok(self):
        for measured, verdict in ((float("nan"), "failed"), (1.1, "failed"), (0.9, "passed")):
            self.assertEqual(Measure(what="x", measured=measured, tolerance=1.0).verdict, verdict)

    def test_a_known_difference_is_accepted_up_to_its_bound(self):
        known = KnownDifference(check="free_fall", measure="x", bound=2.0, reason="r")
        for measured, verdict in ((0.5, "passed"), (1.5, "known difference"), (2.5, "failed"), (float("nan"), "failed")):
            self.assertEqual(Measure(what="x", measured=measured, tolerance=1.0, known=known).verdict, verdict)

    def test_a_backend_declares_its_known_differences(self):
        def differing(bound, robot=None):
            class Different(MujocoBackend):
                known_differences: ClassVar = (
                    KnownDifference(check="free_fall", measure="linvel", bound=bound, reason="it is upside down", robot=robot),
                )

                def state(self):
                    return replace(super().state(), object_linvel=-super().state().object_linvel)

            def make(scene, num_worlds, *, object_index=None):
                return Different(scene, num_worlds, object_index=object_index, workers=0)

            return run(make, only=["free_fall"])[0].verdict

        self.assertEqual(differing(10.0), "known difference")
        self.assertEqual(differing(0.1), "failed")
        self.assertEqual(differing(10.0, robot="another"), "failed")

    def test_unknown_check(self):
        with self.assertRaisesRegex(ValueError, "free_fall"):
            run(make_local("mujoco"), only=["no_such_check"])

    def test_a_backend_that_cannot_be_built_is_not_a_failed_check(self):
        def make(scene, num_worlds, *, object_index=None):
            raise BackendUnavailableError("not here")

        with self.assertRaises(BackendUnavailableError):
            run(make, only=["free_fall"])

    def test_command(self):
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "c.json"
            with contextlib.redirect_stdout(io.StringIO()) as out:
                main(["conformance", "--backend", "mujoco", "--check", "free_fall", "--json", str(file)])
            self.assertIn("no check failed", out.getvalue())
            data = json.loads(file.read_text())
            self.assertEqual(data["schema"], "xreset-conformance/2")
            self.assertEqual([c["verdict"] for c in data["runs"][0]["checks"]], ["passed"])
            broken = Measure(what="x", measured=float("nan"), tolerance=1.0)
            check = next(check for check in CHECKS if check.name == "free_fall")
            red = CheckResult(check=check, verdict="failed", measures=(broken,))
            with (
                mock.patch("xreset.backends.conformance._run_one", lambda check, bench: red),
                contextlib.redirect_stdout(io.StringIO()),
                self.assertRaises(SystemExit) as raised,
            ):
                main(["conformance", "--backend", "mujoco", "--check", "free_fall", "--json", str(file)])
            self.assertEqual(raised.exception.code, 1)
            self.assertEqual(json.loads(file.read_text())["runs"][0]["checks"][0]["measures"][0]["measured"], "nan")


if __name__ == "__main__":
    torch.set_num_threads(1)
    unittest.main()
