"""The conformance suite can fail: engines with one deliberate defect each, and the checks that must notice it."""

import json
import unittest
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import ClassVar, get_args
from unittest import mock

import mujoco
import numpy as np
import torch

from tests.command import refused, succeeds
from tests.data import InFolder
from xreset.backends.conformance import CHECKS, CheckResult, Measure, run
from xreset.backends.conformance.harness import Worlds
from xreset.backends.conformance.results import largest
from xreset.backends.conformance.scene import objects
from xreset.backends.mjcf_model import OBJECT
from xreset.backends.mujoco import MujocoBackend, MujocoWorld
from xreset.backends.rigid import OTHER_LINK, TABLE, conjugate, rotate
from xreset.errors import BackendUnavailableError, XResetError
from xreset.eval.engines import contract
from xreset.eval.engines.verbs import check_engines
from xreset.physics import Capability, KnownDifference

Defect = type[MujocoWorld] | type[MujocoBackend]
DEFECTS: list[tuple[Defect, tuple[str, ...]]] = []


def breaks(*checks):
    """Note which checks must go red with a defect."""

    def note(defect):
        DEFECTS.append((defect, checks))
        return defect

    return note


def outcome(defect, *checks, **attributes):
    """Results of some checks on a broken world or backend."""
    if issubclass(defect, MujocoBackend):
        broken = type("Broken", (defect,), attributes)
    else:
        broken = type("Broken", (MujocoBackend,), {"world_class": defect, **attributes})
    results = run(partial(broken, workers=0), only=checks)
    return {result.name: result for result in results}


# What is set and read -------------------------------------------------------------------------------------------------


@breaks("joint_order")
class TargetsInAlphabeticalOrder(MujocoWorld):
    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self._order = np.argsort(scene.robot.joint_names)

    def set_joint_targets(self, targets):
        super().set_joint_targets(targets[self._order])


@breaks("links_after_set", "joint_order")
class JointStatePermutedBothWays(MujocoWorld):
    def set_state(self, state):
        super().set_state({**state, "joint_pos": state["joint_pos"][::-1]})

    def get_state(self):
        state = super().get_state()
        return {**state, "joint_pos": state["joint_pos"][::-1]}


class _Stepping(MujocoWorld):
    """Knows whether it has been stepped since its state was set, and where the links were then."""

    _stepped = False

    def set_state(self, state):
        self._links_before = tuple(value.copy() for value in super().links())
        super().set_state(state)
        self._stepped = False

    def step(self, n):
        self._links_before = tuple(value.copy() for value in super().links())
        super().step(n)
        self._stepped = True


@breaks("state_round_trip")
class TargetNotResetWithTheState(_Stepping):
    def set_state(self, state):
        kept = self._data.ctrl.copy()
        super().set_state(state)
        self._data.ctrl[:] = kept

    def set_joint_targets(self, targets):
        if not self._stepped:
            super().set_joint_targets(targets)


@breaks("state_round_trip", "same_pixels")
class ObjectReadOneCentimetreTooHigh(MujocoWorld):
    def get_state(self):
        state = super().get_state()
        return {**state, "object_pos": state["object_pos"] + (0.0, 0.0, 0.01)}


@breaks("links_after_set")
class StaleKinematics(_Stepping):
    def links(self):
        return super().links() if self._stepped else self._links_before


@breaks("links_after_steps")
class LinksOfTheStepBefore(_Stepping):
    def links(self):
        return self._links_before if self._stepped else super().links()


@breaks("links_after_steps")
class LinkVelocitiesHalvedAfterAStep(_Stepping):
    def links(self):
        pos, quat, linvel, angvel = super().links()
        return (pos, quat, linvel / 2, angvel / 2) if self._stepped else (pos, quat, linvel, angvel)


@breaks("mimic_joints")
class MimicJointThatDoesNotFollow(MujocoWorld):
    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self._data.eq_active[:] = 0
        self._model.eq_active0[:] = 0


# Worlds ---------------------------------------------------------------------------------------------------------------


@breaks("nothing_stays", "object_wrench")
class WrenchThatSurvivesTheState(MujocoWorld):
    _kept = np.zeros(3)

    def set_object_wrench(self, force, torque):
        self._kept = force if force.any() else self._kept
        super().set_object_wrench(self._kept, torque)


@breaks("worlds_independent")
class WorldsThatInfluenceOneAnother(MujocoWorld):
    seen: ClassVar[list[float]] = []

    def step(self, n):
        self.seen.append(float(self._data.qpos[self._at.qpos[1]]))
        self._data.qfrc_applied[self._at.dof[1]] = sum(self.seen[-4:])
        super().step(n)


@breaks("selected_worlds")
class SettingOneWorldBrakesTheOthers(MujocoWorld):
    others: ClassVar[list[MujocoWorld]] = []

    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self.others.append(self)

    def set_state(self, state):
        super().set_state(state)
        for other in self.others:
            other._data.qvel[:] *= 0.9


@breaks("selected_worlds")
class LinksThatStayWhereSomeWorldsAreSet(MujocoBackend):
    def set_state(self, state, worlds=None):
        before = self._links.clone()
        super().set_state(state, worlds)
        if worlds is not None:
            self._links.map(torch.Tensor.copy_, before)


@breaks("resting_weight")
class SettingOneWorldClearsTheContactsOfAll(MujocoBackend):
    def set_state(self, state, worlds=None):
        super().set_state(state, worlds)
        self._contacts.table_force.zero_()


@breaks("masked_set")
class MaskedValuesInTheOrderOfTheMask(MujocoBackend):
    def set_where(self, mask, state, parameters):
        super().set_where(mask, state[mask.long().argsort(descending=True)], parameters)


@breaks("twins", "repeatable")
class SharedRandomStream(MujocoWorld):
    random: ClassVar = np.random.default_rng(0)

    def step(self, n):
        self._data.qfrc_applied[self._at.dof] = 1e-6 * self.random.normal(size=len(self._at.dof))
        super().step(n)


@breaks("objects_in_a_batch")
class BatchWithTheFirstWorldsBody(MujocoBackend):
    """Mass and inertia of world 0 in every world."""

    def __init__(self, scene, num_worlds, **options):
        super().__init__(scene, num_worlds, **options)
        first, *others = self._team._worlds
        for other in others:
            other._model.body_mass[:] = first._model.body_mass
            other._model.body_inertia[:] = first._model.body_inertia


@breaks("broken_world")
class HiddenBrokenWorld(MujocoWorld):
    def health(self, state):
        return False, False


# The robot ------------------------------------------------------------------------------------------------------------


def remodelled(*checks):
    """Make a defect of a function that changes the engine's model once it is made."""

    def note(change):
        class World(MujocoWorld):
            def __init__(self, scene, object_index):
                super().__init__(scene, object_index)
                change(self._model, self._at)
                mujoco.mj_setConst(self._model, mujoco.MjData(self._model))

        World.__name__ = change.__name__
        breaks(*checks)(World)

    return note


@remodelled("mass_properties")
def mass_invented_for_a_link(model, at):
    model.body_mass[at.moving_bodies[1]] += 0.001


@remodelled("joint_tracking", "drive_equation")
def stiffness_scaled(model, at):
    model.actuator_gainprm[:, 0] *= 0.8
    model.actuator_biasprm[:, 1] *= 0.8


@remodelled("drive_equation", "effort_limit")
def drive_without_effort_limit(model, at):
    model.actuator_forcelimited[:] = 0


@breaks("drive_equation")
class OneStepInPlaceOfAControlStep(MujocoBackend):
    def step(self, substeps=None):
        super().step(substeps or 1)


@breaks("drive_equation")
class DrivesThatLeaveTheirEffortLimitLate(MujocoWorld):
    """By four steps."""

    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self._pull = np.zeros((4, len(scene.robot.joints)))

    def step(self, n):
        target = self._ctrl.copy()
        limit = self._model.actuator_forcerange[:, 1]
        for _ in range(n):
            force = self._data.actuator_force
            saturated = np.where(np.abs(force) >= limit, np.sign(force), 0.0)
            self._pull = np.vstack((self._pull[1:], saturated))
            self._ctrl[:] = target + self._pull.sum(axis=0)
            super().step(1)
        self._ctrl[:] = target


@remodelled("joint_friction")
def joints_without_dry_friction(model, at):
    model.dof_frictionloss[:] = 0.0


@remodelled("joint_limits")
def joints_without_limits(model, at):
    model.jnt_limited[:] = 0


@remodelled("gravity_compensation")
def gravity_on_the_robot(model, at):
    model.body_gravcomp[1:-1] = 0.0


@breaks("own_weight")
class GravityFractionOfTheWholeWorld(MujocoWorld):
    def set_object_gravity(self, fraction):
        self._model.opt.gravity[2] = -9.81 * fraction


# The object -----------------------------------------------------------------------------------------------------------


@breaks("free_fall")
class DampedByDefault(MujocoWorld):
    """By 4 % a second, as Bullet does."""

    def step(self, n):
        super().step(n)
        at = self._at
        self._data.qvel[at.object_dof : at.object_dof + 6] *= 0.96 ** (n / 240)


@breaks("free_spin")
class AngularVelocityInTheBodyFrame(MujocoWorld):
    def set_state(self, state):
        super().set_state(state)
        self._data.qvel[self._angular] = state["object_angvel"]

    def get_state(self):
        return {**super().get_state(), "object_angvel": self._data.qvel[self._angular].copy()}

    @property
    def _angular(self):
        return slice(self._at.object_dof + 3, self._at.object_dof + 6)


@breaks("free_spin")
class LinearVelocityOfTheCentreOfMass(MujocoWorld):
    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self._com = scene.objects[object_index].com

    def _shift(self, state):
        return np.cross(state["object_angvel"], rotate(state["object_quat"], self._com))

    def set_state(self, state):
        super().set_state({**state, "object_linvel": state["object_linvel"] - self._shift(state)})

    def get_state(self):
        state = super().get_state()
        return {**state, "object_linvel": state["object_linvel"] + self._shift(state)}


@breaks("long_spin")
class SpinWithoutGyroscopicTorque(MujocoWorld):
    """The angular velocity stays, and with it the momentum only of a body that turns about a principal axis."""

    def step(self, n):
        for _ in range(n):
            spin = self.get_state()["object_angvel"].copy()
            super().step(1)
            quat = self.get_state()["object_quat"]
            inverse = conjugate(quat)
            self._object_spin[:] = rotate(inverse, spin)


@breaks("object_wrench")
class WrenchAtTheOriginOfTheMeshFrame(MujocoWorld):
    def set_object_wrench(self, force, torque):
        body = self._at.object_body
        arm = self._data.xpos[body] - self._data.xipos[body]
        super().set_object_wrench(force, torque + np.cross(arm, force))


@breaks("object_wrench")
class WrenchInTheObjectsFrame(MujocoWorld):
    def set_object_wrench(self, force, torque):
        quat = self.get_state()["object_quat"]
        super().set_object_wrench(rotate(quat, force), rotate(quat, torque))


@breaks("object_gravity", "set_as_built", "sliding_distance", "slope", "tip_friction")
class ParametersLostWithTheState(MujocoWorld):
    def set_state(self, state):
        at = self._at
        self._model.body_gravcomp[at.object_body] = 0.0
        self._model.body_mass[at.object_body] = at.model.body_mass[at.object_body]
        self._model.geom_friction[:] = at.model.geom_friction
        super().set_state(state)


@breaks("set_as_built", "object_wrench")
class MassWithoutInertia(MujocoWorld):
    def set_object_inertia(self, inertia):
        kept = self._model.body_inertia[self._at.object_body].copy()
        super().set_object_inertia(inertia)
        self._model.body_inertia[self._at.object_body] = kept


@breaks("object_inertia_set")
class InertiaScaledTwice(MujocoWorld):
    def set_object_inertia(self, inertia):
        scale = inertia.moments[0] / self._at.model.body_inertia[self._at.object_body, 0]
        super().set_object_inertia(inertia.changed(scale=scale))


@breaks("object_com_set")
class ShapesMoveWithTheCentreOfMass(MujocoWorld):
    def set_object_inertia(self, inertia):
        super().set_object_inertia(inertia)
        offset = inertia.com - self._at.model.body_ipos[self._at.object_body]
        mine = self._model.geom_bodyid == self._at.object_body
        self._model.geom_pos[mine] = self._at.model.geom_pos[mine] + offset


# Contact --------------------------------------------------------------------------------------------------------------


class WithOtherContacts(MujocoWorld):
    def contacts(self):
        return self.changed(*super().contacts())


@breaks("resting_weight", "held_object")
class ContactForceByTheObject(WithOtherContacts):
    def changed(self, tip_force, touch, table_force):
        return -tip_force, touch, -table_force


@breaks("resting_on_a_side")
class ContactForceInTheObjectsFrame(WithOtherContacts):
    def changed(self, tip_force, touch, table_force):
        inverse = conjugate(self.get_state()["object_quat"])
        return rotate(inverse[None], tip_force), touch, rotate(inverse, table_force)


@breaks("held_object")
class FingersMixedUp(WithOtherContacts):
    def changed(self, tip_force, touch, table_force):
        return tip_force[::-1], touch[::-1], table_force


@breaks("pressing")
class FingersThatTouchTogether(WithOtherContacts):
    def changed(self, tip_force, touch, table_force):
        return tip_force, np.full_like(touch, touch.any()), table_force


@breaks("pressing")
class ContactsWithoutForceThatCountAsATouch(WithOtherContacts):
    """Contacts are found 2 mm before bodies meet."""

    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self._model.geom_margin[:] = 2e-3
        self._model.geom_gap[:] = 2e-3

    def changed(self, tip_force, touch, table_force):
        for contact in self._data.contact:
            roles = self._at.geom_role[contact.geom]
            if OBJECT in roles and max(roles) >= 0:
                touch[max(roles)] = True
        return tip_force, touch, table_force


@breaks("pressing")
class ForceOfOtherLinksBookedAsTheTables(WithOtherContacts):
    def changed(self, tip_force, touch, table_force):
        force = np.zeros(6)
        for i, contact in enumerate(self._data.contact):
            first, second = self._at.geom_role[contact.geom]
            if {first, second} == {OBJECT, OTHER_LINK}:
                mujoco.mj_contactForce(self._model, self._data, i, force)
                sign = 1.0 if second == OBJECT else -1.0  # a force acts on the second geom
                table_force = table_force + sign * contact.frame.reshape(3, 3).T @ force[:3]
        return tip_force, touch, table_force


@remodelled("robot_collisions")
def robot_that_collides_with_the_object_only(model, at):
    of_robot = (at.geom_role >= 0) | (at.geom_role == OTHER_LINK)
    model.geom_contype[of_robot] = 0
    model.geom_conaffinity[of_robot] = 1


@breaks("robot_friction")
class OtherLinksWithTheFingertipsFriction(MujocoWorld):
    def set_friction(self, friction):
        super().set_friction(friction[[0, 0, 2]])


@remodelled("robot_friction")
def robot_on_the_table_with_the_objects_friction(model, at):
    model.geom_priority[at.geom_role == TABLE] = 1


@remodelled("rest_and_bounce")
def collision_margin(model, at):
    model.geom_margin[:] = 5e-4
    model.geom_pos[at.geom_role == OBJECT, 2] -= 5e-4


@remodelled("rest_and_bounce")
def bouncy_contacts(model, at):
    model.geom_solref[:] = (-2e4, -20.0)


@breaks("drive_scale")
class DriveScalesThatAccumulate(MujocoWorld):
    def set_drives(self, scale):
        self._scale = getattr(self, "_scale", 1.0) * scale
        super().set_drives(self._scale)


@breaks("sliding_distance", "slope")
class FrictionSquared(MujocoWorld):
    """As the product of two bodies that both have the pair's coefficient."""

    def set_friction(self, friction):
        super().set_friction(np.square(friction))


@breaks("sliding_height", "pushed_object")
class SlidingObjectsThrownUp(MujocoWorld):
    """As MuJoCo's own step does."""

    def step(self, n):
        mujoco.mj_step(self._model, self._data, n)
        self._ahead = False


@breaks("slope")
class FrictionPyramid(SlidingObjectsThrownUp):
    def __init__(self, scene, object_index):
        super().__init__(scene, object_index)
        self._model.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL


@breaks("torsional_friction_set")
class TorsionalFrictionAtLeastAsBuilt(MujocoWorld):
    """Set on one of two surfaces whose larger value counts."""

    def set_torsional_friction(self, torsional):
        self._model.geom_friction[1:, 1] = torsional


@breaks("torsional_friction")
class TorsionalFrictionTimesSlidingFriction(MujocoWorld):
    def set_friction(self, friction):
        super().set_friction(friction)
        self._model.geom_friction[:, 1] = (
            self._at.model.geom_friction[:, 1] * self._model.geom_friction[:, 0]
        )


@breaks("coupled_jaw")
class EveryCoupledJointWithTheWholeDrive(MujocoWorld):
    def step(self, n):
        follower = self._at.dof[-1]
        for _ in range(n):
            self._data.qfrc_applied[follower] = self._data.actuator_force[-1]
            super().step(1)


@remodelled("shaken_grasp")
def weak_fingers(model, at):
    model.actuator_forcerange[-1] = (-2.5, 2.5)


class TheSuiteCanFail(unittest.TestCase):
    def test_every_defect_is_noticed(self):
        for defect, checks in DEFECTS:
            for name, result in outcome(defect, *checks).items():
                with self.subTest(defect=defect.__name__, check=name):
                    self.assertEqual(result.verdict, "failed")
                    self.assertEqual(
                        result.problem, "", "it must fail by a measure, not by an exception"
                    )
                    self.assertTrue(result.check.cause)

    def test_every_check_has_a_defect_that_it_notices(self):
        noticed = set(chain.from_iterable(checks for _, checks in DEFECTS))
        self.assertEqual({check.name for check in CHECKS} - noticed, set())

    def test_every_capability_is_needed_by_a_check(self):
        needed = set(chain.from_iterable(check.capabilities for check in CHECKS))
        self.assertEqual(set(get_args(Capability)) - needed, set())

    def test_contacts_that_are_missed_are_called_so(self):
        class World(WithOtherContacts):
            def changed(self, tip_force, touch, table_force):
                return 0.0 * tip_force, touch & False, table_force

        for check, name in (
            ("coupled_jaw", "fingers that do not touch"),
            ("pushed_object", "without the foot"),
        ):
            found = {m.what: m.measured for m in outcome(World, check)[check].measures}
            self.assertGreaterEqual(found.get(name, 0.0), 1.0)

    def test_missing_capability_must_be_refused(self):
        lacking = MujocoBackend.capabilities - {"object_gravity"}
        result = outcome(MujocoWorld, "object_gravity", capabilities=lacking)["object_gravity"]
        self.assertEqual(result.verdict, "unsupported")
        self.assertIn("object gravity", result.problem)
        with mock.patch.object(MujocoBackend, "_require", lambda *_: None):
            result = outcome(MujocoWorld, "object_gravity", capabilities=lacking)["object_gravity"]
        self.assertEqual(result.verdict, "failed")
        self.assertIn("did not refuse", result.problem)
        result = outcome(MujocoWorld, "masked_set", capabilities=frozenset())["masked_set"]
        self.assertEqual(result.verdict, "passed")  # with states alone

    def test_an_exception_is_a_failure_of_that_check_only(self):
        class World(MujocoWorld):
            def set_object_inertia(self, inertia):
                raise ArithmeticError("boom")

        results = outcome(World, "set_as_built", "resting_weight")
        self.assertIn("boom", results["set_as_built"].problem)
        self.assertEqual(results["set_as_built"].verdict, "failed")
        self.assertEqual(results["resting_weight"].verdict, "passed")


class Harness(InFolder):
    def test_verdicts(self):
        known = KnownDifference(check="free_fall", measure="x", bound=2.0, reason="r")
        nan = float("nan")
        for difference, verdicts in (
            (None, {0.9: "passed", 1.1: "failed", nan: "failed"}),
            (known, {0.5: "passed", 1.5: "known difference", 2.5: "failed", nan: "failed"}),
        ):
            for measured, verdict in verdicts.items():
                measure = Measure(what="x", measured=measured, tolerance=1.0, known=difference)
                self.assertEqual(measure.verdict, verdict, f"{measured}, {difference}")

    def test_a_backend_declares_its_known_differences(self):
        class Different(MujocoBackend):
            def state(self):
                return replace(super().state(), object_linvel=-super().state().object_linvel)

        for bound, robot, verdict in (
            (10.0, None, "known difference"),
            (0.1, None, "failed"),
            (10.0, "another", "failed"),
        ):
            known = KnownDifference(
                check="free_fall", measure="velocity", bound=bound, reason="r", robot=robot
            )
            with mock.patch.object(Different, "known_differences", (known,)):
                [result] = run(partial(Different, workers=0), only=["free_fall"])
            self.assertEqual(result.verdict, verdict)

    def test_unknown_check(self):
        self.assertRaisesRegex(XResetError, "free_fall", run, MujocoBackend, only=["no_such_check"])
        known = KnownDifference(check="free_fal", measure="x", bound=2.0, reason="r")
        with (
            mock.patch.object(MujocoBackend, "known_differences", (known,)),
            self.assertRaisesRegex(XResetError, "known_differences names unknown checks: free_fal"),
        ):
            run(partial(MujocoBackend, workers=0), only=["free_fall"])

    def test_a_failure_says_by_how_much_and_where(self):
        errors = [("lift", torch.tensor(0.01)), ("turn", torch.tensor([0.0, -0.01204]))]
        measured, where = largest(iter(errors))
        failed = Measure(what="peak", measured=measured, tolerance=0.012, unit="rad", where=where)
        self.assertEqual(contract.shown(failed), "peak: 0.01204, tolerance 0.012 rad (turn)")
        passed = replace(failed, measured=0.0119)
        self.assertEqual(contract.shown(passed), "peak: 0.0119, tolerance 0.012 rad")
        with mock.patch.object(MujocoWorld, "set_object_gravity", lambda *_: None):
            [result] = run(partial(MujocoBackend, workers=0), only=["object_gravity"])
        self.assertIn(result.measures[0].where, {obj.name for obj in objects()})

    def test_a_can_is_not_compared_where_the_last_bits_differ(self):
        class LastBitsOfAGpu(MujocoWorld):
            count = 0

            def set_state(self, state):
                LastBitsOfAGpu.count += 1
                noise = 1e-10 * np.sin(np.arange(4.0) + LastBitsOfAGpu.count)
                super().set_state({**state, "object_quat": state["object_quat"] + noise})

        checks = ("set_as_built", "object_inertia_set", "object_com_set")
        for exact, verdict in ((True, "failed"), (False, "passed")):
            with mock.patch.object(Worlds, "exact", exact):
                results = outcome(LastBitsOfAGpu, *checks)
            for name, result in results.items():
                self.assertEqual(result.verdict, verdict, name)
                found = {m.where for m in result.measures if m.verdict == "failed"}
                self.assertEqual(found, {"can"} if exact else set(), name)

    def test_an_unknown_engine_is_refused_before_another_is_checked(self):
        said = []
        with self.assertRaisesRegex(BackendUnavailableError, "Unknown engine 'nonsense'"):
            check_engines(["mujoco", "nonsense"], only=["free_fall"], say=said.append)
        self.assertEqual(said, [])

    def test_a_backend_that_cannot_be_built_is_not_a_failed_check(self):
        def make(scene, num_worlds, *, object_index=None):
            raise BackendUnavailableError("not here")

        with self.assertRaises(BackendUnavailableError):
            run(make, only=["free_fall"])

    def test_command(self):
        file = self.folder / "c.json"
        words = "engines check --engine mujoco --check free_fall"
        command = (words, "--out", file)
        said = succeeds(*command)
        self.assertIn("no check failed", said)
        data = json.loads(file.read_text())
        self.assertEqual(data["schema"], "xreset-conformance/2")
        self.assertEqual(data["command"], f"xreset {words}")
        [check] = data["runs"][0]["checks"]
        self.assertEqual(check["verdict"], "passed")
        with self.subTest("a check that is named shows every number"):
            self.assertEqual(said.count("passed:"), len(check["measures"]))
        broken = Measure(what="x", measured=float("nan"), tolerance=1.0)

        def red(check, bench):
            return CheckResult(check=check, verdict="failed", measures=(broken,))

        with mock.patch("xreset.backends.conformance._run_one", red):
            refused(*command)
        self.assertEqual(
            json.loads(file.read_text())["runs"][0]["checks"][0]["measures"][0]["measured"], "nan"
        )
