"""xreset view: what is shown of each kind of file, the pictures, and the page (without a browser)."""

import io
import signal
import subprocess
import sys
import tempfile
import time
import unittest
import urllib.request
from contextlib import redirect_stderr, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from unittest import mock

import numpy as np

from tests.toy_bank import SOUP, SPAM, toy_bank
from xreset import robots
from xreset.cli import main
from xreset.demos.archive import Demos, write_demos
from xreset.errors import FileFormatError, XResetError
from xreset.kinematics import Kinematics
from xreset.render import INVALID_COLOR, write_png
from xreset.resets.bank import write_bank
from xreset.retarget.file import Retargeted, write_retargeted
from xreset.view.data import load_view
from xreset.view.picture import drawer

FRAMES = 4
NAMES = np.array(["demo_a", "demo_b"])
OBJECTS = np.array([SOUP, SPAM])
UPRIGHT = np.array([1.0, 0, 0, 0])
OFFSETS = np.array([0, FRAMES, 2 * FRAMES], dtype=np.int32)


def toy_demos() -> Demos:
    """Two demonstrations; the hand is far off in frames 0 and 1, at the object's side in 2, not annotated in 3."""
    pos = np.tile([0.5, 0.3, 0.1], (2 * FRAMES, 1))
    keypoints = pos[:, None] + np.full((1, 21, 3), [0.03, 0, 0])
    keypoints[FRAMES:, :, 1] += 0.01
    keypoints[[0, 1, 4, 5], :, 2] += 0.3
    valid = np.tile([True, True, True, False], 2)
    keypoints[~valid] = np.nan
    return Demos(
        sequence_name=NAMES, subject=np.array(["s", "s"]), object_name=OBJECTS, hand_side=np.array(["right", "right"]),
        frame_offsets=OFFSETS, hand_keypoints=keypoints.astype(np.float32), hand_valid=valid,
        wrist_quat_wxyz=np.tile(UPRIGHT, (2 * FRAMES, 1)).astype(np.float32), object_pos=pos.astype(np.float32),
        object_quat_wxyz=np.tile(UPRIGHT, (2 * FRAMES, 1)).astype(np.float32), fps=30.0,
    )  # fmt: skip


def toy_retargeted(robot) -> Retargeted:
    """The robot at home in every frame; frame 1 of each sequence is not valid, first contact is in frame 2."""
    total = 2 * FRAMES
    reason = np.tile([0, 1, 0, 0], 2).astype(np.int32)
    pos, quat = np.tile([0.5, 0.3, 0.1], (total, 1)), np.tile(UPRIGHT, (total, 1))
    pos[:, 0] += np.arange(total) / 100
    tips = len(robot.fingertips)
    return Retargeted(
        robot=robot.name, robot_fingerprint=robot.fingerprint, sequence_name=NAMES, object_name=OBJECTS,
        hand_side=np.array(["right", "right"]), frame_offsets=OFFSETS, fps=30.0, joint_names=robot.joint_names,
        joint_pos=np.tile(robot.home, (total, 1)).astype(float), palm_pos=pos, palm_quat_wxyz=quat, fingertip_names=robot.fingertip_names,
        fingertip_pos=np.zeros((total, tips, 3)), object_pos=pos, object_quat_wxyz=quat, goal_pos=pos[[3, 7]], goal_quat_wxyz=quat[[3, 7]],
        annotated=np.ones(total, dtype=bool), valid=reason == 0, reason=reason, reason_names=("valid", "joint limit"),
        contact=np.tile([False, False, True, False], 2), first_contact=np.array([2, 2], dtype=np.int32),
        hand_error=np.zeros(total), wrist_error=np.zeros(total),
    )  # fmt: skip


class WithFiles(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.folder = Path(folder.name)
        cls.robot = robots.load("openarm")
        cls.demos, cls.retargeted, cls.bank = (cls.folder / f"{name}.npz" for name in ("demos", "retargeted", "bank"))
        write_demos(cls.demos, toy_demos())
        write_retargeted(cls.retargeted, toy_retargeted(cls.robot), config={}, inputs={})
        write_bank(cls.bank, toy_bank(cls.robot), config={}, inputs={})

    def run_view(self, *argv) -> tuple[int, str]:
        """Exit code and all that was printed."""
        out, code = io.StringIO(), 0
        with redirect_stdout(out), redirect_stderr(out):
            try:
                main(["view", *map(str, argv)])
            except SystemExit as stop:
                code = stop.code if isinstance(stop.code, int) else 1
        return code, out.getvalue()


class Data(WithFiles):
    def test_demonstrations(self):
        view = load_view(self.demos)
        self.assertEqual((view.kind, view.robot, view.rate), ("demonstrations", None, 30.0))
        np.testing.assert_array_equal(view.choose(sequence=1), [4, 5, 6, 7])
        np.testing.assert_array_equal(view.frame, [0, 1, 2, 3] * 2)
        np.testing.assert_array_equal(view.contact, [False, False, True, False] * 2)
        np.testing.assert_array_equal(view.post_contact, [False, False, True, True] * 2)
        self.assertEqual(view.text(3)[0], "hand not annotated")
        self.assertIn("21 keypoints", view.text(2)[-1])
        lowest = view.object_pos[0, 2] + view.objects[0].vertices[:, 2].min()
        self.assertAlmostEqual(lowest, 0.0, delta=2e-3)  # the object rests on the table, and the hand has moved with it
        assert view.human is not None
        np.testing.assert_allclose(view.human.keypoints[2, 0], view.object_pos[2] + [0.03, 0, 0], atol=1e-6)

    def test_robot_trajectories(self):
        view = load_view(self.retargeted)
        self.assertEqual([bool(reason) for reason in view.reason], [False, True, False, False] * 2)
        self.assertEqual(view.text(1)[:2], ("not valid: joint limit", SOUP))
        self.assertEqual(view.text(6)[2:], ("sequence 1: demo_b", "frame 2", "after contact, human touches"))
        np.testing.assert_array_equal(view.choose(phase="before contact"), [0, 1, 4, 5])
        self.assertIsNone(view.human)

    def test_human_hands_are_found_by_sequence_name(self):
        swapped = self.folder / "swapped.npz"
        write_demos(swapped, toy_demos().select(indices=[1, 0]))
        human, same = load_view(self.retargeted, demos=swapped).human, load_view(self.retargeted, demos=self.demos).human
        assert human is not None and same is not None
        np.testing.assert_array_equal(human.keypoints, same.keypoints)
        np.testing.assert_array_equal(np.flatnonzero(human.touching.all(axis=1)), [2, 6])
        self.assertGreater(human.keypoints[6, 0, 1], human.keypoints[2, 0, 1] + 0.005)
        with self.assertRaisesRegex(XResetError, "demo_c"):
            load_view(self.bank, demos=swapped)

    def test_bank(self):
        view = load_view(self.bank)
        np.testing.assert_array_equal(view.choose(), range(6))
        np.testing.assert_array_equal(view.choose(object_name=SOUP), [0, 1, 4, 5])
        np.testing.assert_array_equal(view.choose(object_name=SOUP, phase="after contact"), [1, 5])
        np.testing.assert_array_equal(view.choose(sequence=1, phase="before contact"), [2])
        self.assertEqual(view.text(3), ("stable in physics", SPAM, "sequence 1: demo_b", "frame 8", "after contact"))

    def test_wrong_use_is_explained(self):
        with self.assertRaisesRegex(FileFormatError, "no file"):
            load_view(self.folder / "none.npz")
        text = self.folder / "text.npz"
        text.write_text("hello")
        with self.assertRaisesRegex(FileFormatError, "npz"):
            load_view(text)
        with self.assertRaisesRegex(XResetError, "demonstrations only"):
            load_view(self.demos, demos=self.demos)
        with self.assertRaisesRegex(FileFormatError, "robot"):
            load_view(self.bank, robot="ur7e-sharpa")
        with self.assertRaisesRegex(XResetError, "no sequence 2"):
            load_view(self.retargeted).choose(sequence=2)
        with self.assertRaisesRegex(XResetError, SPAM):
            load_view(self.bank).choose(object_name="cup")


class Pictures(WithFiles):
    def test_an_invalid_robot_is_red(self):
        draw = drawer(load_view(self.retargeted), size=(160, 120))
        valid, invalid = draw(0).astype(int), draw(1).astype(int)
        redness = [(picture[..., 0] - picture[..., 1] > 60) & (picture[..., 2] < picture[..., 0] - 60) for picture in (valid, invalid)]
        self.assertGreater(redness[1].sum(), redness[0].sum() + 200)

    def test_demonstrations_have_no_robot_but_a_hand(self):
        view = load_view(self.demos)
        draw = drawer(view, size=(160, 120))
        hand_away, touching, unknown = draw(0).astype(int), draw(2).astype(int), draw(3).astype(int)
        yellow = [((p[..., 0] > 240) & (p[..., 1] > 190) & (p[..., 2] < 60)).sum() for p in (hand_away, touching, unknown)]
        self.assertGreater(yellow[1], 0)
        self.assertEqual((yellow[0], yellow[2]), (0, 0))

    def test_png_from_the_command_line(self):
        out = self.folder / "view.png"
        code, text = self.run_view(self.retargeted, "--png", out, "--sequence", "1", "--frame", "1")
        self.assertEqual(code, 0, text)
        self.assertIn("not valid: joint limit", text)
        expected = self.folder / "expected.png"
        write_png(expected, drawer(load_view(self.retargeted), size=(960, 720), smooth=True)(5))
        self.assertEqual(out.read_bytes(), expected.read_bytes())
        code, text = self.run_view(self.retargeted, "--png", out, "--frame", "4")
        self.assertEqual(code, 1)
        self.assertIn("no frame 4", text)

    @unittest.skipUnless(find_spec("imageio_ffmpeg"), "imageio-ffmpeg is not installed")
    def test_mp4_from_the_command_line(self):
        out = self.folder / "view.mp4"
        code, text = self.run_view(self.bank, "--mp4", out, "--sequence", "0")
        self.assertEqual(code, 0, text)
        self.assertIn("2 frames", text)
        self.assertEqual(out.read_bytes()[4:8], b"ftyp")

    def test_without_viser_the_message_says_what_to_install(self):
        with mock.patch.dict(sys.modules, {"viser": None}):
            code, text = self.run_view(self.bank)
        self.assertEqual(code, 1)
        self.assertIn("pip install 'xreset[viewer]'", text)


@unittest.skipUnless(find_spec("viser"), "viser is not installed")
class Served(WithFiles):
    def page(self, path: Path, **options):
        from xreset.view.page import Page

        with redirect_stdout(io.StringIO()):
            page = Page(load_view(path), port=8930, **options)
        self.addCleanup(page.close)
        return page

    def test_the_scene_follows_the_controls(self):
        page = self.page(self.retargeted, sequence=1)
        scene = page._scene
        self.assertEqual(page.row, 4)
        page._frame.value = 1
        page.show()
        self.assertIn("joint limit", page._text.content)
        np.testing.assert_allclose(scene._objects[1].position, page.view.object_pos[5])
        self.assertEqual([handle.visible for handle in scene._objects], [False, True])
        kinematics = Kinematics(self.robot)
        where = kinematics.link_poses(kinematics.base.new_tensor(self.robot.home))[:, :3, 3].numpy()
        for i, link in scene._links.items():
            np.testing.assert_allclose(link.position, where[i], atol=1e-6)
            self.assertGreater(link.color[0], 255 * 0.6 * INVALID_COLOR[0])
            self.assertLess(link.color[2], link.color[0])
        page._frame.value = 2
        page.show()
        self.assertFalse(all(link.color[2] < link.color[0] for link in scene._links.values()))

    def test_a_bank_is_filtered(self):
        page = self.page(self.bank)
        page._object.value, page._phase.value = SOUP, "after contact"
        page._choose()
        self.assertEqual((page.row, page._frame.max), (1, 1))
        page._step(1)
        page.show()
        self.assertEqual(page.row, 5)
        page._sequence.value = "1: demo_b"
        page._choose()
        self.assertIsNone(page.row)
        self.assertIn("nothing", page._text.content)
        self.assertFalse(any(link.visible for link in page._scene._links.values()))

    def test_the_command_serves_until_interrupted(self):
        command = [sys.executable, "-u", "-m", "xreset", "view", str(self.bank), "--port", "8960"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
            self.addCleanup(process.kill)
            assert process.stdout is not None
            line = next((line for line in process.stdout if "reset states at" in line), "")
            self.assertIn("6 reset states", line)
            with urllib.request.urlopen(line.split()[-1], timeout=20) as answer:
                self.assertIn(b"<html", answer.read())
            time.sleep(0.5)  # past the line that follows the address
            process.send_signal(signal.SIGINT)
            rest = process.stdout.read()
            self.assertEqual(process.wait(timeout=20), 0, rest)
        self.assertIn("closed.", rest)
        self.assertNotIn("Traceback", rest)


if __name__ == "__main__":
    unittest.main()
