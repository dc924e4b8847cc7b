"""The page that plays a policy without an install: its physics next to MuJoCo's, and the page in a headless browser."""

import functools
import http.server
import threading
import time
import unittest
from pathlib import Path
from tempfile import TemporaryDirectory
from unittest.mock import patch

import numpy as np
import torch
from numpy.testing import assert_allclose, assert_array_equal

from ci import try_page
from tests.browser import Browser, find_chromium, wait_until
from tests.wasm_engine import WasmBackend, ask, installed
from xreset.backends.mjcf import compile_scene
from xreset.eval.play.session import Session
from xreset.geometry.description import load_robot
from xreset.objects.catalogue import load_object
from xreset.physics import State
from xreset.physics.tensors import one_thread
from xreset.spec import SceneSpec

CAN = "005_tomato_soup_can"
BANANA = "011_banana"
DRILL = "035_power_drill"
STEPS = 75
"""Control steps of a grasp."""
FREE = 20
"""Of these, the first ones, in which the robot touches nothing."""
MOUSE = {"button": "left", "buttons": 1, "clickCount": 1}


class PhysicsTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        installed()
        cls.enterClassContext(one_thread())

    def grasp(self, name):
        """Let a policy grasp an object in MuJoCo, and give the same targets to WebAssembly.

        Returns for each control step the largest difference of the joints [rad] and of the object's position [m].
        """
        session = Session("many-objects", object_name=name)
        self.addCleanup(session.close)
        start = session.world.state
        high = start["object_pos"] + np.array((0.0, 0.0, 0.2))
        session.move_goal(high, start["object_quat"])
        moments = [session.step() for _ in range(STEPS)]
        lift = moments[-1].object_pos[2] - moments[0].object_pos[2]
        self.assertGreater(lift, 0.02, "the object was not lifted")
        backend = WasmBackend(session.scene, 1, workers=0)
        self.addCleanup(backend.close)
        backend.set_state(State(**{name: torch.tensor(x)[None] for name, x in start.items()}))
        rows = []
        for moment in moments:
            backend.set_joint_targets(torch.as_tensor(moment.joint_target)[None])
            backend.step()
            state = backend.state()
            joints = np.abs(state.joint_pos[0].numpy() - moment.joint_pos).max()
            moved = np.abs(state.object_pos[0].numpy() - moment.object_pos).max()
            rows.append((joints, moved))
        return np.array(rows)

    def test_a_grasp_is_nearly_the_same_as_in_mujoco(self):
        for name in (CAN, BANANA):
            with self.subTest(name):
                rows = self.grasp(name)
                joints, moved = rows[:FREE].max(axis=0)
                self.assertLess(joints, 1e-6)  # states are read in single precision
                self.assertLess(moved, 5e-5)
                # MuJoCo 3.14 and 4.0 differ in contacts of hulls and of round shapes
                joints, moved = rows.max(axis=0)
                self.assertLess(joints, 0.1)
                self.assertLess(moved, 0.01)

    def test_every_number_of_the_model_is_the_engines_own(self):
        robot = load_robot("ur7e-sharpa")
        scene = SceneSpec(robot=robot, objects=(load_object(DRILL),))
        model = compile_scene(scene, 0, sensors=True).model
        numbers = {}
        for name in dir(model):
            value = getattr(model, name)
            if isinstance(value, np.ndarray) and value.dtype.kind in "fi" and name[0] != "_":
                numbers[name] = value
        world = ask(do="build", scene=try_page.physics_part(scene, 0))
        there = ask(do="arrays", world=world, names=list(numbers))
        compared = 0
        for name, found in zip(numbers, there, strict=True):
            if found is not None:  # this version of MuJoCo has it
                assert_array_equal(found, numbers[name].ravel(), err_msg=name)
                compared += numbers[name].size > 0
        self.assertGreater(compared, 100)


class PolicyTest(unittest.TestCase):
    def test_its_targets_and_errors_are_those_of_xreset_play(self):
        installed()
        self.enterContext(one_thread())
        session = Session("many-objects", object_name=CAN)
        self.addCleanup(session.close)
        folder = Path(self.enterContext(TemporaryDirectory()))
        try_page.write_policy(folder)
        obj = try_page.object_part(session.scene.objects[0], session.known)
        ask(do="load", folder=str(folder), object=obj)
        goal = {"goalPos": session.goal_pos.tolist(), "goalQuat": session.goal_quat.tolist()}
        for _ in range(45):
            state = session.world.state
            target = ask(
                do="act",
                reading={
                    "jointPos": state["joint_pos"].tolist(),
                    "jointVel": state["joint_vel"].tolist(),
                    "objectPos": state["object_pos"].tolist(),
                    "objectQuat": state["object_quat"].tolist(),
                    "tipForce": session.world.tip_force.ravel().tolist(),
                },
                target=session.target.tolist(),
                **goal,
            )
            moment = session.step()
            assert_allclose(target, moment.joint_target, rtol=0, atol=1e-5)
        place = {"objectPos": moment.object_pos.tolist(), "objectQuat": moment.object_quat.tolist()}
        errors = ask(do="errors", scene={"object": obj}, reading=place, **goal)
        assert_allclose(errors, (moment.distance, moment.angle, moment.success), atol=1e-6)


class Files(http.server.SimpleHTTPRequestHandler):
    """Files of a folder, without a log."""

    def log_message(self, *_):
        pass


class PageTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        program = find_chromium()
        installed()
        folder = Path(cls.enterClassContext(TemporaryDirectory()))
        with patch("xreset.eval.play.session.STARTS", 2):  # of which each object needs one
            try_page.build(folder, (CAN, DRILL))
        cls.folder = folder
        handler = functools.partial(Files, directory=str(folder))
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        cls.addClassCleanup(server.server_close)
        cls.addClassCleanup(server.shutdown)
        cls.url = f"http://127.0.0.1:{server.server_port}/index.html"
        cls.browser = Browser(program)
        cls.addClassCleanup(cls.browser.close)

    def open(self, width=480, height=480, *, phone=False):
        self.addCleanup(self.browser.open, "about:blank")
        self.browser.problems.clear()
        self.browser.resize(width, height, phone=phone)
        self.browser.open(self.url)
        self.until("xreset.times.ready")
        self.until("xreset.session.time > 0.1")

    def until(self, condition):
        """Wait for a condition in JavaScript; long, because frames drawn without a GPU can take seconds."""
        script = f"Boolean(window.xreset && ({condition}))"
        wait_until(lambda: self.browser.evaluate(script), condition, seconds=300)

    def test_the_object_follows_the_goal_that_is_dragged(self):
        self.open()
        self.until("xreset.session.distance < 0.03")
        start = self.browser.evaluate("xreset.view.ballOnPage")
        before = np.array(self.browser.evaluate("xreset.session.goalPos"))
        self.assertFalse(self.browser.evaluate("document.getElementById('hint').hidden"))
        self.browser.drag(start, (start[0] - 50, start[1] - 30))
        after = np.array(self.browser.evaluate("xreset.session.goalPos"))
        self.assertGreater(np.linalg.norm(after - before), 0.05)
        self.assertTrue(self.browser.evaluate("document.getElementById('hint').hidden"))
        self.until("xreset.session.distance < 0.03")
        self.assertEqual(self.browser.problems, [])

    def test_pause_stops_time_and_another_object_can_be_chosen(self):
        self.open()
        self.browser.click("document.getElementById('pause')")
        time.sleep(0.3)
        before = self.browser.evaluate("xreset.session.time")
        time.sleep(0.3)
        self.assertEqual(self.browser.evaluate("xreset.session.time"), before)
        self.assertIn("Paused", self.browser.text())
        self.browser.click("document.getElementById('pause')")
        self.browser.click(f"document.querySelector('[data-name=\"{DRILL}\"]')")
        self.until("xreset.session.scene.object.mass > 0.8 && xreset.session.time > 0.1")
        self.assertEqual(self.browser.problems, [])

    def press_the_robot(self):
        """Press the mouse on a link of the arm that can be seen; returns where, in pixels."""
        for link in (6, 5, 4):
            x, y = self.browser.evaluate(f"xreset.view.onPage(xreset.view.parts[{link}].position)")
            self.browser.send("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, **MOUSE)
            if self.browser.evaluate("Number.isInteger(xreset.session.hand?.body)"):
                return x, y
            self.browser.send("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, **MOUSE)
        raise AssertionError("no link of the arm can be grabbed")

    def test_a_pull_at_the_robot_acts_until_it_is_let_go(self):
        self.open()
        pause = "document.getElementById('pause').click()"
        self.browser.evaluate(pause)  # the robot waits for a slow mouse
        x, y = self.press_the_robot()
        self.browser.send("Input.dispatchMouseEvent", type="mouseMoved", x=x - 60, y=y, **MOUSE)
        before = self.browser.evaluate("xreset.session.time")
        self.browser.evaluate(pause)
        self.until(f"xreset.session.time > {before} + 0.1")
        ahead = (
            "xreset.session.physics.data.ctrl.reduce((most, target, j) => "
            "Math.max(most, Math.abs(target - xreset.session.target[j])), 0)"
        )
        self.assertGreater(self.browser.evaluate(ahead), 0.01)
        self.browser.send("Input.dispatchMouseEvent", type="mouseReleased", x=x - 60, y=y, **MOUSE)
        self.assertIsNone(self.browser.evaluate("xreset.session.hand"))
        self.assertEqual(self.browser.problems, [])

    def test_a_ring_turns_the_goal_and_the_shape_between_the_rings_moves_it(self):
        self.open()
        self.browser.click("document.getElementById('pause')")
        goal = np.array(self.browser.evaluate("xreset.view.onPage(xreset.view.goal.position)"))
        place = "[...xreset.session.goalPos, ...xreset.session.goalQuat]"
        start = np.array(self.browser.evaluate(place))
        self.browser.drag(goal, goal + np.array((40, 0)), steps=2)
        moved = np.array(self.browser.evaluate(place))
        self.assertGreater(np.linalg.norm(moved[:3] - start[:3]), 0.02)
        assert_allclose(moved[3:], start[3:], atol=1e-6)
        x, y = self.browser.evaluate("xreset.view.onPage(xreset.view.goal.position)")
        for distance in range(8, 80, 2):
            self.browser.send(
                "Input.dispatchMouseEvent", type="mouseMoved", x=x + distance, y=y + distance / 4
            )
            if self.browser.evaluate("Boolean(xreset.view.rings.axis)"):
                break
        at = np.array((x + distance, y + distance / 4))
        self.browser.drag(at, at + np.array((5, -40)), steps=2)
        turned = np.array(self.browser.evaluate(place))
        self.assertGreater(np.abs(turned[3:] - moved[3:]).max(), 0.05)
        self.assertEqual(self.browser.problems, [])

    def test_everything_fits_on_a_phone_and_nothing_is_loaded_from_elsewhere(self):
        self.open(360, 740, phone=True)
        width = self.browser.evaluate("document.documentElement.scrollWidth")
        self.assertLessEqual(width, 360)
        boxes = self.browser.evaluate(
            "['header', '#status', '#pause', '#restart', '#objects'].map(name => "
            "{ const box = document.querySelector(name).getBoundingClientRect();"
            " return [box.left, box.top, box.right, box.bottom]; })"
        )
        for left, top, right, bottom in boxes:
            self.assertGreaterEqual(min(left, top), 0)
            self.assertLessEqual(right, 360)
            self.assertLessEqual(bottom, 740)
        x, y = self.browser.evaluate("xreset.view.ballOnPage")
        self.assertTrue(0 < x < 360 and boxes[0][3] < y < boxes[1][1], "the goal is covered")
        names = self.browser.evaluate("performance.getEntriesByType('resource').map(e => e.name)")
        self.assertGreater(len(names), 10)
        address = self.url.rpartition("/")[0]
        self.assertEqual([name for name in names if not name.startswith(address)], [])
        size = sum(file.stat().st_size for file in self.folder.rglob("*") if file.is_file())
        self.assertLess(size, 32e6)
