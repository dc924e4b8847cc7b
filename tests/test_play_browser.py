"""xreset play in a real, headless browser: what is dragged there moves, and the robot follows."""

import io
import unittest
from contextlib import redirect_stdout

import numpy as np
from scipy.spatial.transform import Rotation

from tests.browser import Browser, find_chromium, wait_until
from xreset.eval.play.page import Page
from xreset.eval.play.session import Session


class InTheBrowser(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.browser = Browser(find_chromium())
        cls.addClassCleanup(cls.browser.close)
        cls.session = Session("many-objects")
        cls.addClassCleanup(cls.session.close)
        with redirect_stdout(io.StringIO()):
            cls.page = Page(cls.session, port=8970)
        cls.addClassCleanup(cls.page.close)

    def setUp(self):
        # a low goal, so that the arm is in the picture
        self.session.random = np.random.default_rng(3)
        self.session.begin()
        self.browser.problems.clear()
        self.browser.resize(1000, 500)  # wide, because the controls cover 320 pixels on the right
        self.browser.open(self.page.url)
        self.until(lambda: "real time" in self.browser.text(), "the page to play")
        self.until(self.shows_the_object, "the object to be drawn")
        self.addCleanup(self.browser.open, "about:blank")

    def until(self, condition, what):
        """Play until a condition holds; long, because frames drawn without a GPU can take seconds."""

        def holds():
            self.page.tick()
            return condition()

        return wait_until(holds, what, seconds=300)

    def shows_the_object(self):
        """Whether the page has pixels of the object's color."""
        rgb = self.browser.pixels()
        return int(((rgb[150:, 40:640, 0] - rgb[150:, 40:640, 2]) > 60).sum()) > 50

    def pixel_of(self, point):
        """Where the page shows a point of the world."""
        camera = max(self.page._server.get_clients().items())[1].camera
        x, y, z = (
            Rotation.from_quat(camera.wxyz, scalar_first=True).inv().apply(point - camera.position)
        )
        focal = camera.image_height / 2 / np.tan(camera.fov / 2)
        return float(camera.image_width / 2 + focal * x / z), float(
            camera.image_height / 2 + focal * y / z
        )

    def pass_time(self, seconds):
        """Let the session play, faster than the page would show it."""
        for _ in range(round(seconds / self.session.control_dt)):
            moment = self.session.step()
        self.page.tick()
        return moment

    def test_what_is_dragged_moves(self):
        session = self.session
        goal = self.pass_time(0.1).goal_pos
        x, y = self.pixel_of(self.page._handle.position)
        self.browser.drag((x, y), (x - 60, y - 30))
        self.until(
            lambda: np.linalg.norm(session.history[-1].goal_pos - goal) > 0.05, "the goal to move"
        )
        self.assertFalse(self.page._hint.visible)
        self.assertGreater(session.history[-1].distance, 0.1)
        self.assertLess(self.pass_time(4.0).distance, 0.05)
        self.until(lambda: "At the goal" in self.browser.text(), "the page to say so")

        links = []
        session.grab = lambda link, at: links.append(link)
        self.addCleanup(delattr, session, "grab")
        x, y = self.pixel_of(self.page._robot.links["wrist_1_link"].position)
        self.browser.drag((x, y), (x + 80, y))
        self.until(lambda: links, "the arm to be pulled")
        self.assertIn(links[0], self.page._robot.links)

        self.browser.press("Take the object away")
        self.until(lambda: "The object is away" in self.browser.text(), "the object to be away")
        self.browser.press("Put the object back")
        self.until(lambda: not session.away, "the object to be back")
        # viser's own
        problems = [text for text in self.browser.problems if "passive event listener" not in text]
        self.assertEqual(problems, [])
        self.browser.resize(390, 844, phone=True)
        self.assertLessEqual(self.browser.evaluate("document.documentElement.scrollWidth"), 390)
