"""The MuJoCo model of a scene, and what the two MuJoCo backends do beyond the conformance suite."""

import gc
import weakref
from contextlib import ExitStack, nullcontext
from dataclasses import replace
from functools import partial
from itertools import product
from unittest import TestCase, skipIf
from unittest.mock import Mock, patch

import mujoco
import mujoco_warp
import numpy as np
import torch
import warp as wp
from mujoco_warp._src import collision_driver, constraint, solver
from mujoco_warp._src.types import CollisionType, GeomType
from numpy.testing import assert_array_equal
from torch import tensor
from torch.testing import assert_close

from tests.data import InFolder, refuses
from tests.engine_checks import EngineChecks
from xreset.backends import mujoco_warp as mujoco_warp_backend
from xreset.backends import mujoco_warp_step
from xreset.backends.conformance.grasp_checks import grasp
from xreset.backends.conformance.harness import Bench
from xreset.backends.conformance.scene import flat_objects, gripper, objects, scene, shape, solid
from xreset.backends.mjcf import compile_scene
from xreset.backends.mjcf_model import SceneModel
from xreset.backends.mujoco import MujocoBackend, MujocoWorld
from xreset.backends.mujoco_warp import MujocoWarpBackend
from xreset.backends.mujoco_warp_setup import (
    compile_kernels,
    contact_room,
    differing_fields,
    order_pairs,
)
from xreset.backends.mujoco_warp_step import (
    HESSIAN_WAVES,
    constraints,
    finish,
    forked_step,
    keep_contacts,
    smooth_dynamics,
)
from xreset.errors import BackendUnavailableError, ObjectError, RobotError, XResetError
from xreset.physics.plugins import device_for, make_backend
from xreset.spec import FingertipSpec, SceneSpec


def colliding_geoms(model):
    """Pairs of geoms that the engine lets touch, after all were made into large spheres that overlap."""
    model.geom_type[:] = mujoco.mjtGeom.mjGEOM_SPHERE
    model.geom_size[:, 0] = model.geom_rbound[:] = model.geom_aabb[:, 3:] = 10.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return {frozenset((model.geom(a).name, model.geom(b).name)) for a, b in data.contact.geom}


def worlds(backend):
    """The worlds of a backend without worker processes."""
    return backend._team._worlds


def streams_of_a_gpu(main=None):
    """Let code that takes streams run on the CPU, which has none: one kernel after the other."""
    stack = ExitStack()
    stack.enter_context(patch.object(wp, "get_stream", return_value=main or Mock()))
    stack.enter_context(patch.object(wp, "ScopedStream", lambda *_, **__: nullcontext()))
    return stack


def everything(backend):
    """Copies of all readings; the table's forces are the last."""
    tensors = []
    for bundle in (backend.state(), backend.links(), backend.contacts()):
        tensors += [value.clone() for value in vars(bundle).values()]
    return tensors


class Model(InFolder):
    at: SceneModel

    @classmethod
    def setUpClass(cls):
        cls.scene = scene()
        cls.at = compile_scene(cls.scene, 0)

    def collisions(self, **changes):
        robot = replace(self.scene.robot, **changes)
        return colliding_geoms(compile_scene(replace(self.scene, robot=robot), 0).model)

    def collisions_of_the_robot(self, **changes):
        pairs = self.collisions(**changes)
        return {pair for pair in pairs if "robot/" in min(pair) and "robot/" in max(pair)}

    def test_what_may_collide(self):
        # the pad is fixed to finger_b
        bodies = ("base", "column", "wrist", "jaw_a", "finger_b")
        base, column, wrist, jaw_a, pad_b = (f"robot/{body}/0" for body in bodies)
        # jaw_a and column are excluded
        expected = {frozenset((jaw_a, pad_b)), frozenset((column, pad_b))}
        for link in (column, wrist, jaw_a, pad_b):
            expected |= {frozenset(("table", link))}  # the base is excluded
        for other in ("table", base, column, wrist, jaw_a, pad_b):
            expected |= {frozenset(("object/box/0", other))}
        self.assertEqual(self.collisions(), expected)

    def test_links_of_one_body_are_told_apart(self):
        # finger_b has no shape; its pad may collide with jaw_a, a second fixed link of the same body may not
        box = '<collision><geometry><box size="0.01 0.01 0.01"/></geometry></collision>'
        text = (
            gripper()
            .urdf.read_text()
            .replace('<link name="tip_b"/>', f'<link name="tip_b">{box}</link>')
        )
        urdf = self.folder / "robot.urdf"
        urdf.write_text(text)
        own = self.collisions_of_the_robot(
            urdf=urdf,
            self_collision_links=("jaw_a", "pad_b", "tip_b"),
            collision_exclude=(("jaw_a", "tip_b"),),
        )
        self.assertEqual(own, {frozenset(("robot/jaw_a/0", "robot/finger_b/0"))})

    def test_neighbours_of_a_fixed_base_never_collide(self):
        own = self.collisions_of_the_robot(
            self_collision_links=("base", "column", "wrist"), collision_exclude=()
        )
        wrist = "robot/wrist/0"
        self.assertEqual(
            own, {frozenset(("robot/base/0", wrist)), frozenset(("robot/column/0", wrist))}
        )

    def test_slots_hold_any_of_the_objects(self):
        models = [compile_scene(self.scene, i, slots_for=range(3)) for i in range(3)]
        # of one box, one cylinder and two hulls
        self.assertEqual([int(m.parked.sum()) for m in models], [3, 3, 2])
        same = (
            "geom_type",
            "mesh_vert",
            "mesh_graph",
            "geom_contype",
            "geom_bodyid",
            "geom_condim",
            "dof_parentid",
        )
        for field in same:
            for other in models[1:]:
                assert_array_equal(
                    getattr(models[0].model, field), getattr(other.model, field), field
                )
        expected = {
            "geom_size",
            "geom_pos",
            "geom_aabb",
            "geom_rbound",
            "geom_dataid",
            "dof_invweight0",
        }
        expected |= {f"body_{name}" for name in ("mass", "ipos", "iquat", "inertia", "invweight0")}
        self.assertLessEqual(expected, set(differing_fields([m.model for m in models])))

    def test_bad_objects_and_robots(self):
        brick = objects()[0]
        robot = self.scene.robot
        tip = FingertipSpec(
            name="thumb", link="nowhere", contact_links=("jaw_a",), keypoint="thumb4"
        )
        flat = np.diag((1e-4, 1e-4, 3e-4))
        for changes, error, message in (
            ({"objects": (replace(brick, pieces=()),)}, ObjectError, "no collision piece"),
            ({"objects": (replace(brick, mass=0.0),)}, ObjectError, "mass"),
            ({"objects": (replace(brick, inertia=flat),)}, ObjectError, "moments of inertia"),
            ({"robot": replace(robot, fingertips=(tip,))}, RobotError, "nowhere"),
            ({"robot": replace(robot, mimics=())}, RobotError, "jaw_b_slide"),
        ):
            with self.assertRaisesRegex(error, message):
                compile_scene(replace(self.scene, **changes), 0)


class MujocoTest(EngineChecks, TestCase):
    backend_class = MujocoBackend


class Creep(TestCase):
    def test_held_objects_hardly_sink_at_the_timestep_of_evaluations(self):
        """At 120 Hz friction is softer, so that fewer Newton iterations are enough. Processors differ by a tenth."""
        for hz, low, high in ((240, 0.0, 4e-5), (120, 1e-4, 2e-4)):
            timed = replace(scene(), timestep=1 / hz)
            with MujocoBackend(timed, 1, object_index=tensor([0]), workers=0) as backend:
                state, _ = grasp(Bench(MujocoBackend, timed))
                backend.set_state(state[[0]])
                heights = []
                for seconds in (1, 4):
                    backend.step(seconds * hz)
                    heights.append(float(backend.state().object_pos[0, 2]))
            speed = (heights[0] - heights[1]) / 4  # m/s
            with self.subTest(hz=hz):
                self.assertGreater(speed, low)
                self.assertLess(speed, high)


class BothBackends(TestCase):
    """MuJoCo C is the reference for MuJoCo-Warp. The worlds are built once: compiling kernels takes about a minute."""

    @classmethod
    def setUpClass(cls):
        cls.scene = replace(scene(), timestep=1 / 120)  # as trainings have it
        index = tensor([0, 1, 2, 0])
        cls.warp = MujocoWarpBackend(cls.scene, 4, object_index=index)
        cls.c = MujocoBackend(cls.scene, 4, object_index=index, workers=0)
        cls.bench = Bench(lambda *_, **__: cls.c, cls.scene)

    @classmethod
    def tearDownClass(cls):
        cls.warp.close()
        cls.c.close()

    def both(self):
        return self.warp, self.c

    def test_held_forces_agree(self):
        """Their means, once the grip has settled: single precision makes each sway by 0.03 N about them."""
        state, _ = grasp(self.bench)
        means = []
        for backend in self.both():
            backend.set_state(state)
            backend.step(160)
            forces = []
            for _ in range(60):
                backend.step()
                forces.append(backend.contacts().tip_force.clone())
            means.append(torch.stack(forces).mean(dim=0)[[0, 3]])
        assert_close(*means, atol=0.02, rtol=0.0)
        assert_close(self.warp.contacts().tip_touch, self.c.contacts().tip_touch)

    def test_a_scene_is_checked_when_it_is_made(self):
        good = self.scene
        one = SceneSpec(robot=good.robot, objects=good.objects[0])
        self.assertEqual(one.objects, good.objects[:1], "a single object need not be in a list")
        for changes, words in (
            ({"robot": "openarm"}, "robot is 'openarm', expected a RobotSpec: xreset.load_robot"),
            ({"objects": ["soup"]}, "objects has 'soup', expected an ObjectSpec"),
            ({"objects": None}, "objects has None, expected an ObjectSpec"),
            ({"timestep": 0}, "timestep is 0, expected a number above 0"),
        ):
            with refuses(self, words, XResetError):
                replace(good, **changes)
        with self.assertRaisesRegex(XResetError, "scene is RobotSpec.*, expected a SceneSpec"):
            make_backend("mujoco", good.robot, 2)


class Steps(TestCase):
    def test_the_forked_step_is_the_engine_s_in_any_order(self):
        """The streams may end in any order."""

        def reversed_step(m, d):
            constraints(m, d)
            smooth_dynamics(m, d)
            finish(m, d)

        def step_on_streams(m, d):
            with streams_of_a_gpu():
                forked_step((Mock(), Mock()), m, d)

        def make_constraint(m, d):
            mujoco_warp.make_constraint(m, d)
            keep_contacts(d)

        def engine_step(m, d):
            with patch.object(constraint, "make_constraint", make_constraint):
                mujoco_warp.step(m, d)

        # The kind that the scene has: boxes of the gripper and the table, hulls of the bracket.
        own_stream = (GeomType.BOX, GeomType.MESH)
        results = []
        for step in (engine_step, partial(forked_step, ()), reversed_step, step_on_streams):
            with (
                patch.object(mujoco_warp_backend, "engine_step", return_value=step),
                patch.object(mujoco_warp_step, "OWN_STREAM", own_stream),
                MujocoWarpBackend(scene(), 8) as backend,
            ):
                state = backend.state().clone()
                backend.set_state(
                    replace(state, object_linvel=state.object_linvel + tensor([0.3, 0.0, -0.5]))
                )
                # A parameter that changes what positions lead to.
                backend.set_object_com(tensor([0.01, 0.0, 0.0]).expand(8, 3))
                for target in torch.linspace(0.0, 0.3, 40):
                    backend.set_joint_targets(state.joint_target + target)
                    backend.step(2)
                results.append(everything(backend))
        self.assertGreater(results[0][-1].abs().max(), 0.1, "something touches")
        for other in results[1:]:
            for a, b in zip(results[0], other, strict=True):
                assert_close(a, b, rtol=0, atol=0)

    def test_a_step_with_all_iterations_is_the_one_that_ends_early(self):
        results = []
        for many in (1, 9):
            with (
                patch.object(mujoco_warp_backend, "_MANY_WORLDS", many),
                MujocoWarpBackend(scene(), 8) as backend,
            ):
                target = backend.state().joint_target.clone()
                for further in torch.linspace(0.0, 0.3, 20):
                    backend.set_joint_targets(target + further)
                    backend.step(2)
                self.assertEqual(backend._model.opt.graph_conditional, many == 9)
                results.append(everything(backend))
        for a, b in zip(*results, strict=True):
            assert_close(a, b, rtol=0, atol=0)

    def test_a_gpu_adds_contacts_in_more_blocks(self):
        waves = []

        def solve(m, d):
            waves.append(solver._JTDAJ_OVERSUBSCRIBE_WAVES)

        engine = solver._JTDAJ_OVERSUBSCRIBE_WAVES
        with (
            MujocoWarpBackend(scene(), 1) as backend,
            streams_of_a_gpu(),
            patch.object(mujoco_warp, "solve", solve),
        ):
            for streams in ((Mock(), Mock()), ()):
                forked_step(streams, backend._model, backend._data)
        self.assertEqual(waves, [HESSIAN_WAVES, engine])
        self.assertGreater(HESSIAN_WAVES, engine)

    def test_a_gpu_waits_for_contacts_and_free_motion_before_it_needs_them(self):
        calls = Mock()
        with (
            MujocoWarpBackend(scene(), 1) as backend,
            streams_of_a_gpu(calls.main),
            patch.object(collision_driver, "nxn_broadphase", calls.broadphase),
            patch.object(collision_driver, "convex_narrowphase", calls.convex),
            patch.object(mujoco_warp, "make_constraint", calls.make_constraint),
            patch.object(mujoco_warp, "solve", calls.solve),
        ):
            table = dict(collision_driver.MJ_COLLISION_TABLE)
            forked_step((calls.free_motion, calls.aside), backend._model, backend._data)
        self.assertEqual(collision_driver.MJ_COLLISION_TABLE, table)
        self.assertEqual(
            [name for name, _, _ in calls.mock_calls],
            [
                "free_motion.wait_stream",
                "broadphase",
                "aside.wait_stream",
                "convex",
                "convex",
                "main.wait_stream",
                "make_constraint",
                "main.wait_stream",
                "solve",
            ],
        )
        awaited = [arguments for _, arguments, _ in calls.main.wait_stream.mock_calls]
        self.assertEqual(awaited, [(calls.aside,), (calls.free_motion,)])
        kinds = [arguments[3] for _, arguments, _ in calls.convex.mock_calls]
        self.assertEqual(kinds[0], [mujoco_warp_step.OWN_STREAM])
        convex = [kind for kind, way in table.items() if way == CollisionType.CONVEX]
        self.assertCountEqual([*kinds[0], *kinds[1]], convex)

    def test_pairs_of_geoms_that_few_worlds_have_are_tested_last(self):
        several = replace(scene(), objects=flat_objects())  # one and two hulls, and none
        results = []
        pairs = []
        for order in (order_pairs, lambda model: None):
            with (
                patch.object(mujoco_warp_backend, "order_pairs", order),
                MujocoWarpBackend(several, 4) as backend,
            ):
                backend.step(40)
                results.append(everything(backend))
                pairs.append(backend._model.nxn_geom_pair_filtered.numpy())
                is_absent = backend._model.geom_dataid.numpy() < 0
                is_absent &= backend._model.geom_type.numpy() == GeomType.MESH
        for a, b in zip(*results, strict=True):
            assert_close(a, b, rtol=0, atol=1e-5)
        absent = [is_absent.sum(axis=0)[each].max(axis=1).tolist() for each in pairs]
        self.assertEqual(absent[0], sorted(absent[1]))
        self.assertNotEqual(absent[0], absent[1])
        self.assertEqual(set(absent[0]), {0, 2, 3})
        self.assertCountEqual(*(each.tolist() for each in pairs))


class Kernels(TestCase):
    def test_a_sequence_is_compiled_without_a_launch(self):
        @wp.kernel(module="unique")
        def count_down(left: wp.array[int]):
            left[0] = left[0] - 1

        def run():
            wp.capture_while(left, lambda: wp.launch(count_down, 1, [left], device="cpu"))

        left = wp.full(1, 3, dtype=int, device="cpu")
        self.assertEqual(compile_kernels("cpu", run), 1)
        self.assertEqual(left.numpy()[0], 3, "nothing is launched")
        with patch.object(wp.Module, "_compile", side_effect=AssertionError("late")):
            run()
        self.assertEqual(left.numpy()[0], 0)

    def test_warp_suggests_block_sizes_for_compiled_kernels_only(self):
        @wp.kernel(module="unique")
        def clear(values: wp.array[int]):
            values[wp.tid()] = 0

        def suggest(kernel, device=None):
            if kernel.module.load(device) is None:  # as on a GPU
                raise RuntimeError("not compiled")
            return 128, 1

        def run():
            size, _ = wp.get_suggested_block_size(clear, "cpu")
            sizes.append(size)
            wp.launch(clear, 4, [values], device="cpu", block_dim=size)

        sizes = []
        values = wp.ones(4, dtype=int, device="cpu")
        with patch.object(wp, "get_suggested_block_size", suggest):
            self.assertEqual(compile_kernels("cpu", run), 1)
        self.assertEqual(sizes, [256, 128])
        self.assertEqual(values.numpy().sum(), 4, "nothing is launched")


class Limits(TestCase):
    def test_a_closed_backend_keeps_no_scene_alive(self):
        held = scene()
        seen = weakref.ref(held)
        with MujocoBackend(held, 2, workers=0) as backend:
            first, second = worlds(backend)
            self.assertIs(first._at, MujocoWorld(held, 0)._at)  # what is in use is compiled once
            self.assertIsNot(first._at, second._at)
        del held, backend, first, second
        gc.collect()
        self.assertIsNone(seen())

    def test_warp_counts_contacts_that_found_no_room(self):
        with patch.object(mujoco_warp_backend, "contact_room", return_value=(1, 1, 220)):
            backend = MujocoWarpBackend(scene(), 4, object_index=torch.zeros(4, dtype=torch.long))
        backend.step(8)
        self.assertTrue(backend.health().overflow.all())  # the pool is everyone's
        state = backend.state().clone()
        # no contacts
        state = replace(state, object_pos=state.object_pos + tensor([0.0, 0.0, 1.0]))
        backend.set_state(state[[2]], tensor([2]))
        self.assertEqual(backend.health().overflow.tolist(), [True, True, False, True])
        backend.set_state(state)
        backend.step(1)
        self.assertFalse(backend.health().overflow.any())

    def test_an_object_of_many_pieces_has_room_for_its_contacts(self):
        """Sixteen feet on the table: 256 rows of constraints."""
        places = product((-0.03, -0.01, 0.01, 0.03), repeat=2)
        feet = [shape("box", (0.002, 0.002, 0.005), (x, y, 0.0)) for x, y in places]
        standing = replace(scene(), objects=(solid("feet", 0.4, tuple(feet)),))
        for pieces, overflows in ((16, False), (1, True)):
            room = patch.object(
                mujoco_warp_backend, "contact_room", return_value=contact_room(pieces)
            )
            with room, MujocoWarpBackend(standing, 2) as backend:
                backend.step(8)
                self.assertEqual(backend.health().overflow.tolist(), [overflows] * 2, pieces)

    def test_c_reports_the_engine_s_warnings_of_a_full_buffer(self):
        backend = MujocoBackend(scene(), 1, workers=0)
        step = mujoco.mj_step2

        def full(model, data):
            step(model, data)
            data.warning[int(mujoco.mjtWarning.mjWARN_CNSTRFULL)].number += 1

        with patch.object(mujoco, "mj_step2", full):
            backend.step(1)
        self.assertTrue(backend.health().overflow[0])
        backend.step(1)
        self.assertTrue(backend.health().overflow[0], "it stays until the state is set")
        backend.set_state(backend.state().clone())
        backend.step(1)
        self.assertFalse(backend.health().overflow[0])

    def test_no_steps_and_a_closed_engine_are_refused(self):
        backend = MujocoWarpBackend(scene(), 1)
        self.assertRaisesRegex(ValueError, "substeps is 0, expected", backend.step, 0)
        backend.close()
        backend.close()
        for call in (backend.state, backend.step, backend.links, backend.contacts, backend.health):
            self.assertRaisesRegex(XResetError, "closed", call)

    @skipIf(torch.cuda.is_available(), "there is a CUDA device")
    def test_no_such_device(self):
        self.assertEqual(MujocoWarpBackend.devices(), ["cpu"])
        with self.assertRaisesRegex(BackendUnavailableError, "cpu"):
            MujocoWarpBackend(scene(), 1, device="cuda")

    def test_where_an_engine_runs(self):
        with patch.object(MujocoWarpBackend, "devices", return_value=["cuda", "cpu"]):
            for device in ("cpu", "cuda", "cuda:1"):
                self.assertEqual(device_for("mujoco-warp", device), device)
                self.assertEqual(device_for("mujoco", device), "cpu")
            with self.assertRaisesRegex(
                BackendUnavailableError, "Unknown device 'gpu'. Expected cpu, cuda"
            ):
                device_for("mujoco", "gpu")
