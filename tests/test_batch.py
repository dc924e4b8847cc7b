"""What :mod:`xreset.backends.batch` gives to engines that step all worlds at once, against the pool's numpy."""

from unittest import TestCase

import numpy as np
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from xreset.backends.batch import BatchBackend, LinkFrames, sum_contacts
from xreset.backends.conformance.scene import gripper, scene
from xreset.backends.rigid import (
    OTHER_LINK,
    TABLE,
    MovingJoints,
    TrackedFrames,
    mechanism,
    object_inertia,
)
from xreset.backends.rigid import sum_contacts as sum_of_one_world
from xreset.errors import CapabilityError, WrongValueError
from xreset.geometry.rotations import quat_normalize
from xreset.physics import Parameters, State, no_readings
from xreset.spec import GRAVITY


class Frozen(BatchBackend):
    """Worlds in which time stands still. Counts what it is asked for."""

    name = "frozen"
    capabilities = frozenset(
        ("object_mass", "object_inertia", "object_com", "object_gravity", "object_wrench")
    )

    def __init__(self, *args, **options):
        super().__init__(*args, **options)
        self.applied = []
        self.begin()

    @classmethod
    def engine_version(cls):
        return "1"

    def begin(self):
        self.apply_parameters()
        self.forget()

    def apply_parameters(self):
        self.applied.append(self.chosen.tolist())

    def step(self, substeps=None):
        self._contacts.table_force.fill_(float("nan"))
        self._health.nonfinite.fill_(True)

    def close(self):
        self._closed = True


def a_state(num_worlds):
    start = State.initial(scene(), torch.zeros(num_worlds, dtype=torch.long)).clone()
    return start.map(lambda x: x + torch.arange(1, num_worlds + 1).float().view(-1, 1))


class BatchTest(TestCase):
    def setUp(self):
        self.backend = Frozen(scene(), 4)

    def test_a_call_sets_the_worlds_that_it_names(self):
        backend = self.backend
        before = backend.state().clone()
        new = a_state(2)
        backend.set_object_wrench(torch.ones(4, 3), torch.ones(4, 3))
        backend.step()
        backend.set_state(new, torch.tensor([3, 1]))
        for name, value in vars(backend.state()).items():
            given = getattr(new, name)
            if name == "object_quat":
                given = given / given.norm(dim=-1, keepdim=True)
            expected = getattr(before, name).clone()
            expected[[3, 1]] = given
            assert_close(value, expected, atol=0, rtol=0)
        self.assertEqual(backend.applied[-1], [False, True, False, True])
        self.assertEqual(backend.health().nonfinite.tolist(), [True, False, True, False])
        self.assertEqual(
            backend.contacts().table_force.isnan().any(1).tolist(), [True, False, True, False]
        )
        backend.set_object_gravity(torch.zeros(4))
        self.assertEqual(backend.object_load()[:, 5].tolist(), [1, 0, 1, 0])

    def test_a_mask_does_what_indices_do(self):
        new = a_state(4)
        mask = torch.tensor([True, False, False, True])
        mass = torch.tensor([1.0, 2.0, 3.0, 4.0])
        self.backend.set_where(mask, new, Parameters(object_mass=mass))
        other = Frozen(scene(), 4)
        rows = torch.tensor([0, 3])
        other.set_object_mass(mass[rows], rows)
        other.set_state(new[rows], rows)
        for name, value in vars(self.backend.state()).items():
            assert_close(value, getattr(other.state(), name), atol=0, rtol=0)
        found = self.backend.object_properties().mass
        assert_close(found, other.object_properties().mass, atol=0, rtol=0)

    def test_what_it_cannot_do_and_wrong_shapes_are_refused(self):
        with self.assertRaisesRegex(CapabilityError, "friction"):
            self.backend.set_friction(torch.ones(4, 3))
        with self.assertRaisesRegex(CapabilityError, "friction"):
            mask = torch.ones(4, dtype=torch.bool)
            self.backend.set_where(mask, a_state(4), Parameters(friction=torch.ones(4, 3)))
        with self.assertRaisesRegex(WrongValueError, "object_mass has shape"):
            self.backend.set_object_mass(torch.ones(3))

    def test_mass_properties_and_weight_are_those_of_the_parameters(self):
        mass = torch.tensor([0.1, 0.2, 0.3, 0.4])
        scale = torch.tensor([1.0, 2.0, 0.5, 1.5])
        offset = torch.arange(12.0).view(4, 3) / 1000
        self.backend.set_object_mass(mass)
        self.backend.set_object_inertia(scale)
        self.backend.set_object_com(offset)
        self.backend.set_object_gravity(torch.tensor([0.0, 0.5, 1.0, 1.0]))
        found = self.backend.object_properties()
        for i, j in enumerate(self.backend.object_index.tolist()):
            nominal = object_inertia(scene().objects[j])
            expected = nominal.changed(
                mass=float(mass[i]), scale=float(scale[i]), offset=offset[i].numpy()
            )
            assert_allclose(found.com[i], expected.com, atol=1e-7)
            assert_allclose(found.inertia[i], expected.matrix, rtol=1e-5, atol=1e-10)
        weight = -GRAVITY * mass * torch.tensor([0.0, 0.5, 1.0, 1.0])
        assert_close(self.backend.object_load()[:, 2], weight)


class ReadingsTest(TestCase):
    def test_contacts_are_summed_as_in_a_pool(self):
        random = np.random.default_rng(3)
        tips = len(gripper().fingertips)
        world = random.integers(0, 3, 40)
        owner = random.choice([*range(tips), TABLE, OTHER_LINK], 40)
        force = random.normal(size=(40, 3)).astype(np.float32)
        force[owner == 1] = 0.0  # no touch
        _, contacts, _ = no_readings(gripper(), 3)
        contacts.tip_force.fill_(7.0)  # of an earlier step
        contacts.tip_touch.fill_(True)
        sum_contacts(contacts, *map(torch.as_tensor, (world, owner, force)))
        for i in range(3):
            mine = world == i
            expected = sum_of_one_world(tips, zip(owner[mine], force[mine], strict=True))
            for name, value in zip(
                ("tip_force", "tip_touch", "table_force"), expected, strict=True
            ):
                assert_allclose(getattr(contacts, name)[i], value, atol=1e-5)
        self.assertEqual(contacts.tip_touch.tolist(), [[True, False]] * 3)

    def test_links_are_found_as_in_a_pool(self):
        robot = mechanism(gripper())
        frames = TrackedFrames(robot)
        given = torch.Generator().manual_seed(2)
        count = len(frames.bodies)
        pos, velocity, spin = (torch.randn(5, count, 3, generator=given) for _ in range(3))
        quat = quat_normalize(torch.randn(5, count, 4, generator=given))
        links = LinkFrames(robot, torch.device("cpu")).locate(pos, quat, velocity, spin)
        for i in range(5):
            expected = frames.locate(*(x[i].double().numpy() for x in (pos, quat, velocity, spin)))
            for name, value in zip(("pos", "quat", "linvel", "angvel"), expected, strict=True):
                assert_allclose(getattr(links, name)[i], value, atol=1e-5)

    def test_couplings_spread_joints(self):
        robot = mechanism(gripper())
        joints = MovingJoints(gripper(), robot.joint_names)
        matrix, offset = joints.couplings
        position, velocity = np.random.default_rng(1).normal(size=(2, len(gripper().joints)))
        expected = joints.spread(position, velocity)
        assert_allclose(matrix @ position + offset, expected[0])
        assert_allclose(matrix @ velocity, expected[1])
        self.assertNotEqual(len(matrix), len(position))  # a mimic joint follows
