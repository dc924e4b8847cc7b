"""xreset view in a real, headless browser: what the user moves there is what the server shows."""

import io
from contextlib import redirect_stdout
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from tests.browser import INPUT, Browser, find_chromium, wait_until
from tests.test_view import WithFiles, toy_demos
from xreset import write_demos
from xreset.pictures.view.load import load_view
from xreset.pictures.view.page import Page

SLIDER = INPUT + ".querySelector('[role=slider]')"


class InTheBrowser(WithFiles):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.browser = Browser(find_chromium())
        cls.addClassCleanup(cls.browser.close)

    def open(self, path, **options):
        """A page that the browser shows."""
        with redirect_stdout(io.StringIO()):
            page = Page(load_view(path, **options), port=8940)
        self.addCleanup(page.close)
        self.browser.problems.clear()
        # first: a page without its server is a problem
        self.addCleanup(self.browser.open, "about:blank")
        self.browser.open(page.url)
        self.until(
            lambda: self.exists(INPUT.format(label="sequence")) and "1 of" in self.browser.text(),
            "the controls",
        )
        return page

    def until(self, condition, what):
        """Wait; long, because frames drawn without a GPU can take seconds where other work has the cores."""
        try:
            wait_until(condition, what, seconds=60)
        except AssertionError as error:
            raise AssertionError(f"{error}; the page says: {self.browser.text()!r}") from None

    def exists(self, element):
        return self.browser.evaluate(
            f"(() => {{ try {{ return !!{element} }} catch {{ return false }} }})()"
        )

    def orange_pixels(self):
        """How much of the page has the object's colour."""
        rgb = self.browser.pixels()
        return int(((rgb[..., 0] - rgb[..., 2] > 60) & (rgb[..., 1] > 100)).sum())

    def test_text_of_a_file_is_shown_and_not_run(self):
        script = "parent.document.body.dataset.ran = 1"
        name = f"a <b>b</b> <iframe srcdoc='<script>{script}</script>'></iframe> *c* ![d](e) &lt;"
        path = self.folder / "hostile.npz"
        write_demos(path, replace(toy_demos(), sequence_name=np.array([name, "other"])))
        self.open(path)
        self.until(lambda: f"sequence 0: {name}" in self.browser.text(), "the name as it is")
        elements = "document.querySelectorAll('iframe, p img, p b b').length"
        self.assertEqual(
            self.browser.evaluate(f"[{elements}, document.body.dataset.ran ?? 0]"), [0, 0]
        )

    def assert_no_problem(self):
        self.browser.evaluate("1")  # takes in what is still under way
        self.assertEqual(self.browser.problems, [])

    def test_scrubbing_and_changing_the_sequence(self):
        page = self.open(self.retargeted, demos=self.demos)
        self.assertEqual(page.row, 0)
        self.assertIn("Green: the object at its goal.", self.browser.text())
        can = page._scene._objects[0]
        assert_allclose(can.position, page.view.object_pos[0])
        self.browser.evaluate(f"{SLIDER.format(label='frame')}.focus()")
        self.browser.key("ArrowRight")
        self.until(
            lambda: np.allclose(can.position, page.view.object_pos[1], rtol=0, atol=1e-6),
            "the can to move to frame 1",
        )
        self.until(
            lambda: "not valid: joint limit" in self.browser.text(), "the reason in the browser"
        )
        self.browser.key("End")
        self.until(
            lambda: page.row == 3 and not page._scene._keypoints.visible,
            "the last frame, where no hand is annotated",
        )
        self.browser.choose("sequence", "1: demo_b")
        self.until(
            lambda: [body.visible for body in page._scene._objects] == [False, True],
            "the other sequence's object",
        )
        self.assertEqual(page.row, 4)
        self.until(lambda: "sequence 1: demo_b" in self.browser.text(), "its name in the browser")
        self.assertGreater(self.orange_pixels(), 20, "the object is not to be seen")
        self.assert_no_problem()
