"""xreset view: rows of each kind of file, the pictures, and the page (without a browser)."""

import io
import shlex
import signal
import sys
import time
import urllib.request
from contextlib import redirect_stdout
from dataclasses import replace
from http.client import HTTPConnection
from itertools import count
from unittest import mock
from xml.etree import ElementTree

import msgspec
import numpy as np
import torch
import viser
from numpy.testing import assert_allclose, assert_array_equal
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests import toy_bank
from tests.browser import wait_until
from tests.command import refused, started, succeeds
from tests.data import InOneFolder, refuses
from tests.toy_bank import SOUP, SPAM
from tests.toy_goals import toy_goals
from xreset import (
    Demos,
    read_bank,
    robots,
    write_bank,
    write_demos,
    write_goals,
    write_retargeted,
)
from xreset.cli import _terminal
from xreset.errors import FileFormatError, XResetError
from xreset.geometry.kinematics import Kinematics
from xreset.pictures.meshes import rgb, tint
from xreset.pictures.render import write_png
from xreset.pictures.view.colors import reason_color
from xreset.pictures.view.load import load_view
from xreset.pictures.view.page import Page
from xreset.pictures.view.picture import Drawer
from xreset.pictures.view.server import WebPage, _own_page_only, is_own_page

FRAMES = 4
TOTAL = 2 * FRAMES
NAMES = np.array(["demo_a", "demo_b"])
OBJECTS = np.array([SOUP, SPAM])
UPRIGHT = np.tile([1.0, 0, 0, 0], (TOTAL, 1))


def toy_demos():
    """Two demonstrations with the can 6 mm above the table.

    The hand is far off in frames 0 and 1, at the object's side in 2, unknown in 3.
    """
    pos = np.tile([0.5, 0.3, 0.065], (TOTAL, 1))
    keypoints = pos[:, None] + np.full((1, 21, 3), [0.03, 0, 0])
    keypoints[FRAMES:, :, 1] += 0.01
    keypoints[[0, 1, 4, 5], :, 2] += 0.3
    valid = np.tile([True, True, True, False], 2)
    keypoints[~valid] = np.nan
    return Demos(
        sequence_name=NAMES,
        object_name=OBJECTS,
        hand_side=np.array(["right", "right"]),
        frame_offsets=np.array([0, FRAMES, TOTAL], dtype=np.int32),
        fps=30.0,
        subject=np.array(["s", "s"]),
        hand_keypoints=keypoints.astype(np.float32),
        hand_valid=valid,
        wrist_quat_wxyz=UPRIGHT.astype(np.float32),
        object_pos=pos.astype(np.float32),
        object_quat_wxyz=UPRIGHT.astype(np.float32),
    )


def toy_retargeted(robot):
    """The robot at home in every frame; frame 1 of each sequence is not valid, first contact is in frame 2."""
    reason = np.tile([0, 1, 0, 0], 2)
    pos = np.tile([0.5, 0.3, 0.1], (TOTAL, 1))
    pos[:, 0] += np.arange(TOTAL) / 100
    changes = {"palm_pos": pos, "object_pos": pos, "valid": reason == 0, "reason": reason}
    return toy_bank.toy_retargeted(
        robot,
        [SOUP, SPAM],
        [0, FRAMES, TOTAL],
        **changes,
        sequence_name=NAMES,
        reason_names=("valid", "joint limit", "arm jump"),
        contact=np.tile([False, False, True, False], 2),
        first_contact=np.array([2, 2]),
        hand_error=np.full(TOTAL, 0.0121),
        wrist_error=np.full(TOTAL, 0.0032),
    )


def send_value(page, control, value):
    """Give a control of a page a value, as a visitor with a program of his own can."""
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    message = {"type": "GuiUpdateMessage", "uuid": control._impl.uuid}
    message |= {"updates": {"value": value}}
    before = control.update_timestamp
    with connect(page.url.replace("http", "ws"), subprotocols=[protocol]) as socket:
        socket.send(msgspec.msgpack.encode(message))
        wait_until(lambda: control.update_timestamp != before, "the value to arrive")


class WithFiles(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.robot = robots.load("openarm")
        cls.demos = cls.folder / "demos.npz"
        cls.bank = cls.folder / "bank.npz"
        write_demos(cls.demos, toy_demos())
        cls.retargeted = cls.write(toy_retargeted(cls.robot), "retargeted")
        write_bank(cls.bank, toy_bank.toy_bank(cls.robot))

    @classmethod
    def write(cls, data, name):
        path = cls.folder / f"{name}.npz"
        write_retargeted(path, data)
        return path


class Data(WithFiles):
    def test_a_goal_set_is_shown_as_starts_with_the_robot_at_home(self):
        goals = toy_goals(self.robot)
        write_goals(self.folder / "goals.npz", goals)
        view = load_view(self.folder / "goals.npz")
        self.assertEqual((view.kind, view.is_motion, len(view.choose())), ("starts", False, 4))
        assert_allclose(view.joint_pos, np.tile(self.robot.home, (4, 1)))
        assert_allclose(view.object_pos, goals.start_pos)
        self.assertEqual(
            view.text(2), ("start, at rest", SPAM, "sequence 2: 010_potted_meat_can/lift_002")
        )

    def test_trajectories_beyond_the_joints_limits_are_refused(self):
        data = toy_retargeted(self.robot)
        data.joint_pos[1, 2] += 50.0  # in a frame that is not valid, and so is not used
        load_view(self.write(data, "beyond"))
        data.joint_pos[6, 2] = 1.575
        words = "beyond.npz holds joint3 = 1.575 in frame 6, but the joint goes from -1.571 to 1.571. Make"
        with self.assertRaisesRegex(FileFormatError, words):
            load_view(self.write(data, "beyond"))

    def test_demonstrations(self):
        view = load_view(self.demos)
        self.assertEqual((view.kind, view.robot, view.rate), ("demonstrations", None, 30.0))
        assert_array_equal(view.choose(sequence=1), [4, 5, 6, 7])
        assert_array_equal(view.frame, [0, 1, 2, 3] * 2)
        assert_array_equal(view.post_contact, [False, False, True, True] * 2)
        self.assertEqual(view.text(3)[0], "not annotated")
        can = view.objects[0]
        lowest = view.object_pos[0, 2] + can.vertices[:, 2].min()
        # the object rests on the table, and the hand has moved with it
        self.assertAlmostEqual(lowest, 0.0, delta=2e-3)
        assert_allclose(view.human_keypoints[2, 0], view.object_pos[2] + [0.03, 0, 0], atol=1e-6)

    def test_robot_trajectories(self):
        view = load_view(self.retargeted)
        self.assertIsNone(view.human_keypoints)
        named = replace(toy_retargeted(self.robot), object_name=np.array(["soup", "spam"]))
        self.assertEqual(
            load_view(self.write(named, "alias")).objects, view.objects, "the paper's names"
        )
        self.assertEqual(view.reason, ("", "joint limit", "", "") * 2)
        self.assertEqual(view.text(1)[:2], ("not valid: joint limit", SOUP))
        _, _, *text = view.text(6)
        self.assertRegex(
            " ".join(text),
            r"^sequence 1: demo_b frame 2 after contact off by 12 mm \(fingertips\), 3 mm \(wrist\)$",
        )
        assert_array_equal(view.choose(reason="joint limit"), [1, 5])
        assert_array_equal(view.choose(sequence=1, reason=""), [4, 6, 7])

    def test_human_hands_are_found_by_sequence_name(self):
        swapped = self.folder / "swapped.npz"
        write_demos(swapped, toy_demos().select(indices=[1, 0]))
        found = load_view(self.retargeted, demos=swapped)
        same = load_view(self.retargeted, demos=self.demos)
        assert_array_equal(found.human_keypoints, same.human_keypoints)
        assert_array_equal(np.flatnonzero(found.human_touching.all(axis=1)), [2, 6])
        self.assertGreater(found.human_keypoints[6, 0, 1], found.human_keypoints[2, 0, 1] + 0.005)
        self.assertRaisesRegex(XResetError, "demo_c", load_view, self.bank, demos=swapped)

    def test_bank(self):
        view = load_view(self.bank)
        assert_array_equal(view.choose(), range(6))
        assert_array_equal(view.choose(sequence=1), [2, 3])
        self.assertEqual(
            view.text(3),
            ("stable in physics", SPAM, "sequence 1: demo_b", "frame 8", "after contact"),
        )

    def test_wrong_use_is_explained(self):
        text = self.folder / "text.npz"
        text.write_text("hello")
        for words, kind, path, options in (
            ("there is no|There is no", FileFormatError, self.folder / "none.npz", {}),
            ("text.npz is not a file of xreset demos", FileFormatError, text, {}),
            ("demonstrations only", XResetError, self.demos, {"demos": self.demos}),
            ("for the robot 'openarm'", FileFormatError, self.bank, {"robot": "ur7e-sharpa"}),
            ("no sequence 2: the file has 2, counted from 0", XResetError, self.retargeted, {}),
        ):
            with refuses(self, words, kind):
                load_view(path, **options).choose(sequence=2)


class Pictures(WithFiles):
    def draw(self, path, *rows):
        """Small pictures of rows as integers."""
        drawer = Drawer(load_view(path), size=(160, 120))
        return [drawer.draw(row).astype(int) for row in rows]

    def test_an_invalid_robot_has_the_color_of_its_reason(self):
        valid, invalid = self.draw(self.retargeted, 0, 1)
        changed = np.abs(valid - invalid).max(axis=-1) > 12
        hue = invalid[changed].mean(axis=0) - invalid[changed].mean()
        wanted = np.array(reason_color("joint limit")) - np.mean(reason_color("joint limit"))
        self.assertGreater(hue @ wanted / np.linalg.norm(hue) / np.linalg.norm(wanted), 0.9)
        self.assertGreater(changed.sum(), 200)

    def test_demonstrations_have_no_robot_but_a_hand(self):
        # the hand is away, touches, is unknown
        for picture, seen in zip(self.draw(self.demos, 0, 2, 3), (False, True, False), strict=True):
            yellow = (picture > [240, 190, -1]) & (picture < [256, 256, 60])
            self.assertEqual(yellow.all(axis=-1).any(), seen)

    def test_png_and_film_from_the_command_line(self):
        out = self.folder / "view.png"
        self.assertIn(
            "not valid: joint limit",
            succeeds("view", self.retargeted, "--out", out, "--sequence 1 --frame 1"),
        )
        expected = self.folder / "expected.png"
        write_png(
            expected, Drawer(load_view(self.retargeted), size=(960, 720), smooth=True).draw(5)
        )
        self.assertEqual(out.read_bytes(), expected.read_bytes())
        film = self.folder / "view.mp4"
        with mock.patch.object(_terminal, "monotonic", count(0, 61).__next__):
            printed = succeeds("view", self.bank, "--out", film, "--sequence 0")
        self.assertEqual(
            printed, f"drawing 2 frames\n2 frames in {film}\ndrawing: 0 %\ndrawing: 50 %\n"
        )
        self.assertEqual(film.read_bytes()[4:8], b"ftyp")
        self.assertIn(
            "no frame 4: there are 4", refused("view", self.retargeted, "--out", out, "--frame 4")
        )
        one = self.folder / "one.npz"
        write_bank(one, read_bank(self.bank).with_states(np.array([0])))
        for words in (("--out", out), ("--out", film), ()):
            self.assertIn("Sequence 1 has no state", refused("view", one, "--sequence 1", *words))
        self.assertIn("Leave out the frame", refused("view", self.bank, "--out", film, "--frame 1"))

    def test_without_viser_the_message_says_what_to_install(self):
        with mock.patch.dict(sys.modules, {"viser": None}):
            self.assertIn("pip install 'xreset[viewer]'", refused("view", self.bank))


class Served(WithFiles):
    def page(self, path, **options):
        with redirect_stdout(io.StringIO()):
            page = Page(load_view(path), port=8930, **options)
        self.addCleanup(page.close)
        return page

    def test_the_scene_follows_the_controls(self):
        page = self.page(self.retargeted, sequence=1)
        scene = page._scene
        self.assertEqual(page.row, 4)
        kinematics = Kinematics(self.robot)
        poses = kinematics.link_poses(torch.tensor(self.robot.home)).numpy()
        for frame, color in ((1, reason_color("joint limit")), (2, None)):
            page._frame.value = frame
            page.show()
            self.assertEqual("joint limit" in page._text.content, color is not None)
            assert_allclose(scene._objects[1].position, page.view.object_pos[4 + frame])
            self.assertEqual([handle.visible for handle in scene._objects], [False, True])
            for name, link in scene._robot.links.items():
                assert_allclose(link.position, poses[kinematics.link_index(name), :3, 3], atol=1e-6)
                own = scene._robot._colors[name]
                assert_array_equal(link.color, rgb(tint(own, color) if color else own))

    def test_a_host_that_this_machine_does_not_have_is_refused(self):
        """viser alone waits for ever."""
        for host in ("203.0.113.7", "::2", "no host"):
            told = refused("view", self.retargeted, f"--host={shlex.quote(host)}")
            self.assertIn(f"Cannot serve the page at {host}:8080: ", told)
            self.assertIn("Choose another --host or --port", told)

    def test_the_page_opens_where_a_hand_is_and_says_what_is_green(self):
        demos = toy_demos()
        keypoints = demos.hand_keypoints.copy()
        keypoints[:2] = np.nan
        valid = demos.hand_valid.copy()
        valid[:2] = False
        path = self.folder / "late.npz"
        write_demos(path, replace(demos, hand_keypoints=keypoints, hand_valid=valid))
        page = self.page(path)
        self.assertEqual(page.row, 2)
        self.assertTrue(page._scene._keypoints.visible)
        self.assertEqual(self.page(path, frame=1).row, 1)
        client = mock.Mock()
        for aspect, moves in ((0.5, True), (1.5, False)):
            client.camera = mock.Mock(aspect=aspect, look_at=None)
            page._make_room(client)
            with self.subTest(aspect):
                self.assertEqual(client.camera.look_at is not None, moves)

    def test_frames_of_one_reason_are_picked(self):
        page = self.page(self.retargeted)
        page._sequence.value = "all"
        page._choose()
        page._reason.value = "joint limit (2)"
        page._choose()
        assert_array_equal(page._rows, [1, 5])
        page._step(1)
        page.show()
        self.assertEqual(page.row, 5)
        page._rows = page._rows[:1]
        page.show()  # a slider of one row has two places
        self.assertIn("1 of 1", page._text.content)
        page._rows = page._rows[:0]
        page.show()
        self.assertIn("nothing", page._text.content)

    def test_no_message_of_a_visitor_ends_the_page(self):
        page = self.page(self.retargeted)
        page._play.value = True
        for control, values in (
            (page._speed, (0, -1, float("nan"))),
            (page._frame, (-5, 10**6)),
            (page._sequence, ("nonsense", "")),
            (page._reason, ("nonsense",)),
        ):
            for value in values:
                with self.subTest(control=control, value=value):
                    send_value(page, control, value)
                    page._choose()
                    page.tick()
                    page.show()
                    self.assertIn(page.row, range(TOTAL))
        with (
            mock.patch.object(page, "tick", side_effect=[ValueError("x"), KeyboardInterrupt]),
            self.assertLogs("xreset"),
            self.assertRaises(KeyboardInterrupt),
        ):
            page.serve()

    def test_text_of_a_file_is_shown_as_text(self):
        """A browser shows that none of it runs: tests/test_view_browser.py."""
        name = "<iframe srcdoc='<script>1</script>'></iframe> **b** ![c](d) &amp;"
        moved = toy_retargeted(self.robot)
        names = np.array([name, "other"])
        reasons = (*moved.reason_names[:1], name, *moved.reason_names[2:])
        moved = replace(moved, sequence_name=names, reason_names=reasons)
        page = self.page(self.write(moved, "hostile"), frame=1)
        self.assertEqual(type(page._text).__name__, "GuiHtmlHandle")
        root = ElementTree.fromstring(page._text.content)
        self.assertEqual({element.tag for element in root.iter()}, {"div", "p", "b"})
        texts = list(root.itertext())
        self.assertEqual(texts[0], f"not valid: {name}")
        self.assertIn(f"sequence 0: {name}", texts)

    def test_the_command_serves_until_interrupted(self):
        command = (sys.executable, "-u", "-m", "xreset", "view", self.bank, "--port", "8960")
        process = self.enterContext(started(*command))
        line = next((line for line in process.stdout if " at http" in line), "")
        self.assertIn("6 reset states", line)
        with urllib.request.urlopen(line.split()[-1], timeout=20) as answer:
            self.assertIn(b"<html", answer.read())
        time.sleep(0.5)  # past the line that follows the address
        process.send_signal(signal.SIGINT)
        rest = process.stdout.read()
        self.assertEqual(process.wait(timeout=20), 0, rest)
        self.assertIn("closed.", rest)
        self.assertNotIn("Traceback", rest)


class OwnPageOnly(WithFiles):
    """A socket from another site, or a name that is made to point here, gets nothing."""

    def test_headers(self):
        for host, origin, served, expected in (
            ("localhost:8080", None, "127.0.0.1", True),
            ("127.0.0.1:8080", "http://127.0.0.1:8080", "127.0.0.1", True),
            ("[::1]:8080", "http://[::1]:8080", "::1", True),
            ("127.0.0.1:8080", "http://127.0.0.1:9999", "127.0.0.1", False),
            ("evil.example:8080", "http://evil.example:8080", "0.0.0.0", False),
            ("", None, "127.0.0.1", False),
            ("127.0.0.1:8080", "null", "127.0.0.1", False),
            ("mypc:8080", "http://mypc:8080", "0.0.0.0", True),
            ("mypc.local:8080", "http://mypc.local:8080", "0.0.0.0", True),
            ("other.local:8080", "http://other.local:8080", "0.0.0.0", False),
        ):
            with (
                self.subTest(host=host, origin=origin),
                mock.patch("xreset.pictures.view.server.gethostname", return_value="MyPC"),
            ):
                self.assertEqual(is_own_page(host, origin, served), expected)

    def test_the_server(self):
        with _own_page_only("127.0.0.1") as guarded:
            server = viser.ViserServer(host="127.0.0.1", port=8990, verbose=False)
        self.addCleanup(server.stop)
        self.assertTrue(guarded)
        address = f"127.0.0.1:{server.get_port()}"
        for hosts, status in (([address], 200), (["evil.example"], 403), ([address, address], 403)):
            connection = HTTPConnection(address, timeout=10)
            connection.putrequest("GET", "/", skip_host=True)
            for host in hosts:
                connection.putheader("Host", host)
            connection.endheaders()
            self.assertEqual(connection.getresponse().status, status)
            connection.close()
        with self.assertRaisesRegex(InvalidStatus, "403"):
            connect(f"ws://{address}", origin="http://evil.example", subprotocols=["viser-v0"])
        with connect(f"ws://{address}", origin=f"http://{address}"):
            pass

    def test_the_address_of_a_page(self):
        page = WebPage.__new__(WebPage)
        for host, expected in (("0.0.0.0", "localhost"), ("::1", "[::1]"), ("::", "[::1]")):
            page._server = mock.Mock(**{"get_host.return_value": host, "get_port.return_value": 80})
            self.assertEqual(page.url, f"http://{expected}:80")

    def test_a_server_that_cannot_be_restricted_is_stopped(self):
        with (
            mock.patch(
                "viser.ViserServer"
            ) as server,  # it starts without the function that is replaced
            self.assertRaisesRegex(XResetError, "cannot be restricted"),
        ):
            Page(load_view(self.bank))
        server.return_value.stop.assert_called_once()
