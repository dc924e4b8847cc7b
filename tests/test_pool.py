"""The process pool, with a toy world: what is checked here holds for every engine that runs in it."""

import os
import signal
import subprocess
import sys
import tempfile
import textwrap
import time
from contextlib import contextmanager
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from unittest import TestCase, mock

import numpy as np
import torch
from torch import tensor
from torch.testing import assert_close

from tests.command import started
from tests.data import refuses
from tests.toy_world import ToyBackend, ToyWorld, toy_scene
from xreset.backends.pool import World, is_finite
from xreset.backends.rigid import OTHER_LINK, TABLE
from xreset.backends.workers import STATE_FIELDS, arrays_in, layout_of
from xreset.errors import CapabilityError, RobotError, WrongValueError, XResetError
from xreset.geometry.kinematics import Kinematics
from xreset.physics import Parameters, State
from xreset.spec import PairFriction

REPOSITORY = Path(__file__).resolve().parents[1]


def random_state(n, seed):
    rng = torch.Generator().manual_seed(seed)
    width = {"object_pos": 3, "object_quat": 4, "object_linvel": 3, "object_angvel": 3}
    return State(
        **{f.name: torch.rand(n, width.get(f.name, 2), generator=rng) for f in fields(State)}
    )


class Readings(TestCase):
    """What the pool makes of a world's readings."""

    def world(self, scene=None, **methods):
        backend = type(
            "Broken",
            (ToyBackend,),
            {"world_class": type("BrokenWorld", (ToyWorld,), methods)},
        )(scene or toy_scene(), 1, workers=0)
        self.addCleanup(backend.close)
        return backend

    def test_the_first_readings_of_a_world_are_checked(self):
        def changed(**fields):
            return lambda world: world.state | fields

        def without_quat(world):
            return {name: world.state[name] for name in STATE_FIELDS if name != "object_quat"}

        def contacts(*values):
            return lambda world: values

        force = np.zeros((2, 3))
        touch = np.zeros(2, dtype=bool)
        for method, reading, message in (
            ("get_state", without_quat, r"get_state\(\) lacks object_quat"),
            ("get_state", changed(speed=0.0), "has the unknown field speed"),
            ("get_state", lambda world: {**without_quat(world), "object_qaut": 0}, "unknown field object_qaut, expected"),
            ("get_state", changed(joint_pos=np.zeros(3)), r"joint_pos has shape \(3,\) and type float64, expected \(2,\)"),
            ("get_state", lambda world: None, r"get_state\(\) returns None, expected joint_pos, "),
            ("links", lambda world: (np.zeros((1, 3)), *ToyWorld.links(world)[1:]), r"links\(\): pos has shape \(1, 3\)"),
            ("links", lambda world: ToyWorld.links(world)[:3], "expected pos, quat, linvel, angvel"),
            ("contacts", contacts(force, touch.astype(float), force[0]), "tip_touch has .* float64, expected .* bool"),
            ("contacts", contacts(force[0], touch, force[0]), "tip_force has shape"),
            ("contacts", lambda world: [(7, np.zeros(3))], "a contact has the owner 7, expected TABLE"),
            ("contacts", lambda world: [(0, np.zeros(2))], r"the force of a contact has shape \(2,\), expected \(3,\)"),
            ("health", lambda world, state: (0.0, False), "nonfinite has .* float64, expected .* bool"),
        ):  # fmt: skip
            with (
                refuses(self, f"world 0: .*{message}", WrongValueError, message),
            ):
                self.world(**{method: reading}).step(1)

    def test_misspelt_capabilities_are_refused(self):
        with self.assertRaisesRegex(XResetError, "Broken.capabilities has unknown names: frictoin"):
            type("Broken", (ToyBackend,), {"capabilities": frozenset({"frictoin", "friction"})})

    def test_the_pool_adds_weight_sums_contacts_and_computes_links(self):
        methods = {
            "contacts": lambda world: [(TABLE, world.force), (1, world.force), (OTHER_LINK, world.force)],
            "links": World.links,
            "set_object_gravity": World.set_object_gravity,
        }  # fmt: skip
        from xreset.backends.conformance.scene import scene

        pool = self.world(scene(), **methods)
        with mock.patch.object(
            ToyBackend, "capabilities", ToyBackend.capabilities | {"object_gravity"}
        ):
            pool.set_object_gravity(tensor([0.25]))
        pool.set_object_mass(tensor([3.0]))
        pool.set_object_wrench(tensor([[1.0, 0.0, 0.0]]), torch.zeros(1, 3))
        pool.step(1)
        force = tensor([1.0, 0.0, -0.25 * 3.0 * 9.81])
        contacts = pool.contacts()
        assert_close(contacts.table_force[0], force)
        assert_close(contacts.tip_force[0], torch.stack((torch.zeros(3), force)))
        self.assertEqual(contacts.tip_touch[0].tolist(), [False, True])
        pool.set_state(pool.state().clone())
        self.assertFalse(contacts.tip_touch.any() or contacts.table_force.any())
        kinematics = Kinematics(pool.scene.robot)
        state = pool.state()
        poses = kinematics.link_poses(state.joint_pos.double(), pool.scene.robot.tracked_links)
        assert_close(pool.links().pos, poses[..., :3, 3].float())


class PoolTest(TestCase):
    """Every test runs in this process and in two workers."""

    @classmethod
    def setUpClass(cls):
        cls.pools = [ToyBackend(toy_scene(), 5, workers=workers) for workers in (0, 2)]

    @classmethod
    def tearDownClass(cls):
        for pool in cls.pools:
            pool.close()

    def each(self):
        for pool, kind in zip(self.pools, ("in process", "two workers"), strict=True):
            with self.subTest(kind):
                pool.set_state(random_state(5, 0))
                yield pool

    def test_some_worlds_are_set_and_the_others_keep_their_targets(self):
        for pool in self.each():
            expected = random_state(5, 0)
            expected.joint_target[:] = torch.arange(10.0).reshape(5, 2) / 100
            pool.set_joint_targets(expected.joint_target)
            new = random_state(2, 1)
            expected[tensor([4, 1])] = new
            pool.set_state(new, tensor([4, 1]))
            for name in STATE_FIELDS:
                assert_close(getattr(pool.state(), name), getattr(expected, name), rtol=0, atol=0)
            pool.step(1)
            assert_close(pool.state().joint_pos, expected.joint_target)

    def test_step_moves_each_world_by_its_own_inputs(self):
        for pool in self.each():
            before = pool.state().clone()
            velocity = before.object_linvel.clone()
            targets = torch.arange(10.0).reshape(5, 2) / 100
            pool.set_joint_targets(targets)
            assert_close(pool.state().joint_target, targets)
            force = torch.zeros(5, 3)
            force[2, 1] = 0.5
            pool.set_object_wrench(force, torch.zeros(5, 3))
            pool.step(3)
            state = pool.state()
            assert_close(state.joint_pos, targets)
            assert_close(pool.links().pos[:, 1, 2], targets[:, 0])
            assert_close(pool.links().angvel[:, 0, 0], tensor([0.0, 1.0, 0.0, 1.0, 0.0]))
            velocity[2, 1] += 3 * 0.5 / 1.0
            assert_close(state.object_linvel, velocity)
            assert_close(state.object_pos, before.object_pos + 3 * velocity)
            assert_close(pool.contacts().tip_force[:, :, 2], torch.full((5, 2), 3.0))
            self.assertEqual(pool.contacts().tip_touch.tolist(), [[True, False]] * 5)
            pool.set_state(random_state(1, 2), tensor([3]))
            self.assertEqual(
                pool.contacts().table_force[:, 2].tolist(), [-3.0, -3.0, -3.0, 0.0, -3.0]
            )

    def test_mass_of_some_worlds(self):
        for pool in self.each():
            pool.set_object_mass(tensor([4.0, 8.0]), tensor([4, 0]))
            pool.set_object_wrench(torch.ones(5, 3), torch.zeros(5, 3))
            before = pool.state().object_linvel.clone()
            pool.step(1)
            assert_close(
                (pool.state().object_linvel - before)[:, 0], tensor([0.125, 0.5, 1.0, 0.5, 0.25])
            )
            pool.set_object_mass(tensor([1.0, 1.0]), tensor([4, 0]))

    def test_every_broken_number_of_a_state_is_noticed(self):
        good = {name: getattr(random_state(1, 0), name)[0].numpy() for name in STATE_FIELDS}
        self.assertTrue(is_finite(good))
        for name, bad in product(STATE_FIELDS, (np.nan, np.inf, -np.inf)):
            broken = good[name].copy()
            broken[-1] = bad
            self.assertFalse(is_finite({**good, name: broken}), f"{bad} in {name}")

    def test_health_sticks_until_the_state_is_set_and_a_broken_world_rests(self):
        for pool in self.each():
            bad = random_state(5, 0)
            bad.object_pos[1, 0] = float("nan")
            bad.joint_target[2, 0] = 5.0
            pool.set_state(bad)
            self.assertEqual(pool.health().nonfinite.nonzero(), 1)
            self.assertEqual(pool.health().overflow.nonzero(), 2)
            pool.set_joint_targets(torch.zeros(5, 2))
            pool.step(1)
            self.assertEqual(pool.health().overflow.nonzero(), 2)
            assert_close(pool.state().joint_pos[1], bad.joint_pos[1])
            assert_close(pool.state().joint_pos[0], torch.zeros(2))
            pool.set_state(random_state(5, 0))
            self.assertFalse(pool.health().nonfinite.any() or pool.health().overflow.any())

    def test_an_exception_names_its_world_and_leaves_the_pool_usable(self):
        for pool in self.each():
            targets = torch.zeros(5, 2)
            targets[3, 0] = 13.0
            pool.set_joint_targets(targets)
            with self.assertRaisesRegex(
                RuntimeError,
                r"(?s)'toy', world 3, step: ZeroDivisionError: unlucky.*in set_joint_targets",
            ):
                pool.step(1)
            targets[3, 0] = 14.0
            pool.set_joint_targets(targets)
            self.assertRaisesRegex(RobotError, "world 3: not like that", pool.step, 1)
            pool.set_joint_targets(torch.ones(5, 2))
            pool.step(1)
            assert_close(pool.state().joint_pos, torch.ones(5, 2))

    def test_wrong_input(self):
        for pool in self.each():
            words = r"joint_target has shape \(5, 3\), expected \(5, 2\)"
            self.assertRaisesRegex(ValueError, words, pool.set_joint_targets, torch.zeros(5, 3))
            self.assertRaisesRegex(ValueError, "substeps is 0, expected", pool.step, 0)
            with self.assertRaisesRegex(ValueError, "joint_pos has shape"):
                pool.set_state(random_state(4, 0))
            self.assertRaisesRegex(ValueError, "substeps is 2.5, expected", pool.step, 2.5)
            mask = tensor([True, False, False, True, True])
            for worlds in (tensor([5]), tensor([-1]), tensor([0.5]), tensor([[0]]), mask):
                words = r"worlds is tensor.*, expected \[M\] indices from 0 to 4"
                with self.assertRaisesRegex(ValueError, words):
                    pool.set_state(random_state(len(worlds), 0), worlds)
            parameters = Parameters(object_mass=torch.ones(5))
            for not_mask in (tensor([0, 1]), mask[:4], mask.long()):
                with self.assertRaisesRegex(ValueError, r"mask is .*, expected \[5\] bool"):
                    pool.set_where(not_mask, random_state(5, 0), parameters)
            before = pool._wrench.clone()
            for name, *wrench in (("force", 4, 2), ("torque", 3, 2)):
                with self.assertRaisesRegex(ValueError, rf"{name} has shape .*expected \(5, 3\)"):
                    pool.set_object_wrench(*(torch.ones(5, width) for width in wrench))
            assert_close(pool._wrench, before)
            for value in (0.0, -1.0, float("nan")):
                with self.assertRaisesRegex(ValueError, "object_mass is .*, expected .* above 0"):
                    pool.set_object_mass(torch.full((5,), value))
            with self.assertRaisesRegex(ValueError, "friction is .*, expected .* at least 0"):
                pool.set_friction(-torch.ones(5, 3))
            with self.assertRaisesRegex(CapabilityError, "'toy' does not support object gravity"):
                pool.set_object_gravity(torch.ones(5))
        for index in (tensor([0.7]), tensor([2]), tensor([0, 0])):
            with self.assertRaisesRegex(ValueError, r"object_index is .*, expected \[1\] indices"):
                ToyBackend(toy_scene(), 1, object_index=index, workers=0)
        with self.assertRaisesRegex(CapabilityError, "CPU only"):
            ToyBackend(toy_scene(), 1, device="cuda")

    def test_options_reach_the_worlds(self):
        with ToyBackend(toy_scene(), 2, workers=0, gain=3.0) as pool:
            pool.set_joint_targets(torch.ones(2, 2))
            pool.step(1)
            assert_close(pool.state().joint_pos, torch.full((2, 2), 3.0))
        for workers in (0, 1):
            with (
                refuses(self, "world 0, build: TypeError", RuntimeError, workers),
            ):
                ToyBackend(toy_scene(), 2, workers=workers, gain=None)
        words = "'toy' has no option 'nonsense'. Choose from: object_index, device, workers, gain"
        with self.assertRaisesRegex(XResetError, words):
            ToyBackend(toy_scene(), 2, nonsense=1)


class MemoryTest(TestCase):
    def test_numbers_are_aligned_and_of_single_precision(self):
        """However many flags stand before them, and where a scene states whole numbers."""
        scene = toy_scene()
        whole = tuple(replace(spec, mass=1) for spec in scene.objects)
        friction = PairFriction(tip=1, link=1, table=1, torsional=0)
        scene = replace(scene, objects=whole, friction=friction)
        for n in range(1, 5):
            layout = layout_of(scene, torch.zeros(n, dtype=torch.long))
            for name, array in arrays_in(bytearray(layout.itemsize), layout).items():
                with self.subTest(name, n=n):
                    self.assertTrue(array.flags.aligned)
                    self.assertIn(array.dtype, (np.float32, np.bool_))


class DeathTest(TestCase):
    def test_a_dead_worker_is_reported_and_closes_the_pool(self):
        pool = ToyBackend(toy_scene(), 4, workers=2)
        targets = torch.zeros(4, 2)
        targets[2, 0] = 666.0
        pool.set_joint_targets(targets)
        with self.assertRaisesRegex(
            XResetError, r"SIGKILL during 'step'; it ran the worlds \[0, 2\]\."
        ):
            pool.step(1)
        self.assertRaisesRegex(XResetError, "is closed", pool.step, 1)

    @contextmanager
    def script(self, body):
        source = "from tests.toy_world import *\n" + textwrap.dedent(body)
        with tempfile.NamedTemporaryFile("w", suffix=".py") as file:
            file.write(source)
            file.flush()
            environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
            with started(
                sys.executable, file.name, env=environment, stderr=subprocess.PIPE
            ) as process:
                yield process

    def test_a_script_without_main_guard_or_close_ends_cleanly(self):
        body = """
        pool = ToyBackend(toy_scene(), 2, workers=1)
        pool.step()
        print(pool._team._workers[0]._process.pid)
        """
        with self.script(body) as process:
            out, err = process.communicate()
            self.assertEqual((process.returncode, err), (0, ""))
            self.assert_gone(int(out))

    def test_ctrl_c_and_a_killed_parent_leave_no_worker(self):
        body = """
        pool = ToyBackend(toy_scene(), 2, workers=1)
        print(pool._team._workers[0]._process.pid, flush=True)
        while True:
            pool.step()
        """
        for number in (signal.SIGINT, signal.SIGKILL):
            with self.script(body) as process:
                worker = int(process.stdout.readline())
                process.send_signal(number)
                _, err = process.communicate()
                self.assertEqual(err.count("Traceback"), 1 if number == signal.SIGINT else 0, err)
                self.assert_gone(worker)

    def assert_gone(self, pid):
        for _ in range(100):
            try:
                os.kill(pid, 0)
            except ProcessLookupError:
                return
            if "Z" in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]:
                return  # nobody's child any more, waiting for init
            time.sleep(0.05)
        self.fail(f"worker {pid} still runs")

    def test_a_world_class_that_workers_cannot_import_is_refused(self):
        class Mine(ToyWorld):
            pass

        with (
            mock.patch.object(ToyBackend, "world_class", Mine),
            self.assertRaisesRegex(XResetError, "Move it to a module, or pass workers=0"),
        ):
            ToyBackend(toy_scene(), 2, workers=1)
