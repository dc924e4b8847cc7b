"""Demonstrations of other trackers: orders, units, frames, rates, poses; unknown conventions are refused."""

import csv
import itertools
import os
import re
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from unittest import mock

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.command import refused, succeeds, xreset
from tests.data import InFolder, data_dir, refuses
from tests.test_demos import angles, assert_same_motion
from tests.wrong_recordings import CAMERA
from xreset import read_demos, synthesize
from xreset.demos.keypoints import ORDERS, Convention, read_keypoints
from xreset.errors import DemoError, FileFormatError
from xreset.geometry.shapes import turn_of

PLAIN = Convention(order="mediapipe", units="m", frame="table", fps=10.0)


def written(points, order):
    """[F, 21, 3] this project's keypoints in the order of others."""
    return points[:, np.argsort(ORDERS[order])]


def seen_from(T, demos):
    """Keypoints, object positions and orientations of one sequence in the frame of a camera at pose T."""
    turn = Rotation.from_matrix(T[:3, :3]).inv()
    points = (demos.hand_keypoints.astype(float) - T[:3, 3]) @ T[:3, :3]
    pos = (demos.object_pos.astype(float) - T[:3, 3]) @ T[:3, :3]
    return points, pos, turn * turn_of(demos.object_quat_wxyz)


def write_csv(path, points, pos, turn, scale=1.0, columns=MappingProxyType({}), quat="wxyz"):
    """One row for each frame, as a tracker would; ``columns``: name -> value or values to add."""
    names = [f"{axis}{k}" for k, axis in itertools.product(range(21), "xyz")]
    names += ["object_x", "object_y", "object_z", *(f"object_q{axis}" for axis in quat)]
    quats = turn.as_quat(scalar_first=quat == "wxyz")
    with open(path, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow([*columns, *names])
        for i in range(len(points)):
            numbers = np.concatenate((scale * points[i].ravel(), scale * pos[i], quats[i]))
            cells = ["" if np.isnan(x) else f"{x:.9f}" for x in numbers]
            table.writerow(
                [*(np.broadcast_to(value, len(points))[i] for value in columns.values()), *cells]
            )


class Synthetic(InFolder):
    @classmethod
    def setUpClass(cls):
        cls.demos = synthesize(["soup"], per_object=1, seed=1, fps=10)

    def setUp(self):
        super().setUp()
        self.points = self.demos.hand_keypoints.astype(float)
        self.turn = turn_of(self.demos.object_quat_wxyz)
        self.arrays = {
            "keypoints": self.points,
            "object_pos": self.demos.object_pos,
            "object_quat_wxyz": self.demos.object_quat_wxyz,
            "object": np.array(str(self.demos.object_name[0])),
            "side": np.array("right"),
        }

    def npz(self, **changes):
        path = self.folder / "a.npz"
        arrays = self.arrays | changes
        np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
        return path

    def same(self, found):
        # synthetic hands are the average hand
        assert_same_motion(self.demos, found, atol=2e-6, angle=1e-3)
        self.assertEqual(found.object_name.tolist(), self.demos.object_name.tolist())

    def refused(self, message, convention=PLAIN, **changes):
        with self.assertRaisesRegex(DemoError, message):
            read_keypoints(self.npz(**changes), convention)

    def test_every_order_unit_and_frame_arrives_the_same(self):
        points, pos, turn = seen_from(CAMERA, self.demos)
        pose = np.tile(np.eye(4), (len(pos), 1, 1))
        pose[:, :3, :3] = turn.as_matrix()
        for order, (units, scale) in itertools.product(ORDERS, (("m", 1.0), ("mm", 1e3))):
            pose[:, :3, 3] = scale * pos
            changes = {"object_pos": None, "object_quat_wxyz": None, "object_pose": pose}
            path = self.npz(keypoints=scale * written(points, order), **changes)
            convention = replace(
                PLAIN, order=order, units=units, frame="camera", table_from_camera=CAMERA
            )
            with self.subTest(order=order, units=units):
                self.same(read_keypoints(path, convention))

    def test_the_person_is_named_by_the_file_alone(self):
        self.assertEqual(read_keypoints(self.npz(), PLAIN).subject.tolist(), ["unknown"])
        found = read_keypoints(self.npz(subject=np.array("ann")), PLAIN)
        self.assertEqual(found.subject.tolist(), ["ann"])

    def test_spaces_around_the_cells_of_a_table_do_not_count(self):
        path = self.folder / "a.csv"
        names = ["a", " a", "a "] * len(self.points)
        columns = {"sequence": names[: len(self.points)], "object": " soup", "side": " right"}
        write_csv(path, self.points, self.demos.object_pos, self.turn, columns=columns)
        found = read_keypoints(path, PLAIN)
        self.same(found)
        self.assertEqual(found.sequence_name.tolist(), ["a"])

    def test_quaternions_say_their_order(self):
        wxyz = self.demos.object_quat_wxyz
        xyzw = np.roll(wxyz, -1, axis=1)
        self.same(read_keypoints(self.npz(object_quat_wxyz=None, object_quat_xyzw=xyzw), PLAIN))
        self.refused("must be given once", object_quat_xyzw=xyzw)
        words = "object_pos and .* of frame {} should be a position and a unit quaternion"
        self.refused(words.format(0), object_quat_wxyz=2 * wxyz)
        pos = self.demos.object_pos.copy()
        pos[3] = np.nan
        path = self.folder / "a.csv"
        columns = {"object": "soup", "side": "right"}
        write_csv(path, self.points, pos, self.turn, columns=columns)
        self.assertRaisesRegex(DemoError, words.format(3), read_keypoints, path, PLAIN)

    def test_what_is_not_known_is_asked_for(self):
        self.refused("--table-from-camera FILE", replace(PLAIN, frame="camera"))
        self.refused("table must not have one", replace(PLAIN, table_from_camera=np.eye(4)))
        self.refused("Add --object", object=None)
        self.refused("Add --side", side=None)
        self.refused("Add --fps", replace(PLAIN, fps=None))

    def test_what_contradicts_the_numbers_is_refused(self):
        points = self.points
        from_wrist = points - points[:, :1]
        swelling = np.linspace(0.4, 2.5, len(points))[:, None, None]
        for words, changed in (
            (r"is \d+,\d{3} mm, .*Is the unit right", 1e3 * points),
            ("--order mano", written(points, "mano")),
            ("relative to the hand", points - points.mean(axis=1, keepdims=True)),
            ("The keypoints are not metric", points[:, :1] + swelling * from_wrist),
            ("write NaN, where the hand was not seen", np.where(swelling < 1.8, -1.0, points)),
        ):
            self.refused(words, keypoints=changed)
        other = "It is the other hand .*or the coordinates are left-handed"
        self.refused(other, side=np.array("left"))
        self.refused("file says 20 frames per second, but --fps says 10", fps=np.array(20.0))
        single = self.npz(fps=np.float32(29.97))
        self.assertEqual(read_keypoints(single, replace(PLAIN, fps=29.97)).fps, 29.97)
        for words, changes in (
            ("Is the unit right", {"units": "mm"}),
            ("--order mediapipe", {"order": "mano"}),
            ("file says side 'right', but --side says 'left'", {"side": "left"}),
        ):
            self.refused(words, replace(PLAIN, **changes))
        points, pos, turn = seen_from(CAMERA, self.demos)
        seen = {"keypoints": points, "object_pos": pos}
        seen["object_quat_wxyz"] = turn.as_quat(scalar_first=True)
        self.refused("Are these the camera's coordinates", **seen)
        inverse = replace(PLAIN, frame="camera", table_from_camera=np.linalg.inv(CAMERA))
        self.refused("matrix may be inverted: its inverse puts", inverse, **seen)

    def test_damage_is_named(self):
        self.refused("no frame has all 21 keypoints", keypoints=np.full_like(self.points, np.nan))
        for words, changes in (
            ("has shape .* expected .*21, 3", {"keypoints": self.points[:, :20]}),
            ("objects are never read", {"side": np.array([None])}),
        ):
            with self.assertRaisesRegex(FileFormatError, words):
                read_keypoints(self.npz(**changes), PLAIN)
        with self.assertRaisesRegex(FileFormatError, "no schema, .*archive of xreset demos"):
            read_demos(self.npz())
        (self.folder / "empty").mkdir()
        with self.assertRaisesRegex(FileFormatError, "there is no .*b.csv .a tracker's keypoints"):
            read_keypoints(self.folder / "b.csv", PLAIN)
        with self.assertRaisesRegex(DemoError, "no .npz and no .csv"):
            read_keypoints(f"{self.folder}/empty", PLAIN)

    def test_times_are_resampled(self):
        frames = len(self.points)
        time = 5.0 + np.arange(frames) / 10
        self.assertEqual(read_keypoints(self.npz(time=time), replace(PLAIN, fps=None)).fps, 10.0)
        found = read_keypoints(self.npz(time=time), replace(PLAIN, fps=30.0))
        self.assertEqual((found.fps, found.num_frames), (30.0, 3 * (frames - 1) + 1))
        assert_allclose(found.hand_keypoints[::3], self.demos.hand_keypoints, atol=1e-6)
        half = (self.demos.object_pos[1:] + 2 * self.demos.object_pos[:-1]) / 3
        assert_allclose(found.object_pos[1::3], half, atol=1e-6)
        time[5:] += 0.07
        self.refused("--fps to resample", replace(PLAIN, fps=None), time=time)
        self.refused("must be in seconds", replace(PLAIN, fps=None), time=1e3 * (time - 5.0))
        backwards = r"must increase .* is \d.* in frame 0 and \d.* in the next one"
        self.refused(backwards, time=time[::-1].copy())
        moves = np.linalg.norm(np.diff(self.demos.object_pos, axis=0), axis=1)
        hole = time + (np.arange(frames) > np.argmax(moves))
        words = f"nothing is known for 1.1. s after frame {np.argmax(moves)}, in which the object"
        self.refused(words, replace(PLAIN, fps=30.0), time=hole)
        still = time + (np.arange(frames) > 0)
        quats = self.demos.object_quat_wxyz.copy()
        quats[0] = (turn_of((1, 0, 0, 1)) * self.turn[0]).as_quat(scalar_first=True)
        words = "moves by 0 mm and turns by 90 degrees"
        self.refused(words, replace(PLAIN, fps=30.0), time=still, object_quat_wxyz=quats)
        found = read_keypoints(self.npz(time=still), replace(PLAIN, fps=30.0))
        self.assertEqual(found.num_frames, 3 * (frames + 9) + 3)
        self.assertEqual(np.flatnonzero(~found.hand_valid).tolist(), [*range(1, 33)])
        time[-1] = 2e8
        self.refused("more than 100000 frames", replace(PLAIN, fps=30.0), time=time)

    def test_rounded_times_have_the_rate_that_was_meant(self):
        frames = np.arange(len(self.points))
        for rate, digits in ((60.0, 6), (60.0, 3), (120.0, 4), (30 / 1.001, 6), (25.3, 6)):
            time = (1.7e9 + frames / rate).round(digits)
            with self.subTest(rate=rate, digits=digits):
                demos = read_keypoints(self.npz(time=time), replace(PLAIN, fps=None))
                self.assertAlmostEqual(demos.fps, rate, delta=1e-3)
        self.refused("file says 30 frames", replace(PLAIN, fps=None), time=time, fps=np.array(30.0))

    def test_names_and_frames_without_a_hand(self):
        self.points[:3] = np.nan
        for name, official in (("soup", "005_tomato_soup_can"), ("my_cup", "my_cup")):
            own = read_keypoints(self.npz(object=np.array(name)), PLAIN)
            self.assertEqual(own.object_name.tolist(), [official])
            self.assertEqual(np.flatnonzero(~own.hand_valid).tolist(), [0, 1, 2])

    def test_a_csv_of_several_sequences(self):
        path = self.folder / "two.csv"
        columns = {"sequence": "a", "object": "soup", "side": "right", "confidence": 0.9}
        write_csv(path, self.points, self.demos.object_pos, self.turn, columns=columns, quat="xyzw")
        first = path.read_text()
        path.write_text(first + re.sub("(?m)^a,", "b,", first.split("\n", 1)[1]))
        found = read_keypoints(path, PLAIN)
        self.assertEqual(found.sequence_name.tolist(), ["a", "b"])
        self.same(found.select(sequences=["a"]))
        for words, text in (
            (
                "could not convert string to float: 'oops'",
                re.sub(r"(?m)(^a,[^,]*,right,0.9,)[^,]*", r"\1oops", first),
            ),
            ("lacks the columns .*z20", first.replace("z20", "depth")),
            ("line 2 has 1 cells, .* 74 columns.*cut off", first.split("\n")[0] + "\n3\n"),
            ("separated by semicolons", first.replace(",", ";")),
            ("more than 21 keypoints, such as x21.*OpenXR", first.replace("confidence", "x21")),
            ("same name", first.replace("z20", "z19")),
            ("first line has numbers", first.partition("\n")[2]),
            ("rows of a sequence must follow", re.sub(r"(?m)^a(.*\n)a", r"a\1b", first)),
            ("column side changes", first.replace(",right,", ",left,", 1)),
        ):
            path.write_text(text)
            with refuses(self, words, DemoError):
                read_keypoints(path, PLAIN)
        path.write_bytes(first.encode() + b"," * (2 << 20))
        with (
            mock.patch.dict(os.environ, XRESET_MAX_FILE_MB="1"),
            refuses(self, "it has 2 MB, more than XRESET_MAX_FILE_MB", DemoError),
        ):
            read_keypoints(path, PLAIN)

    def test_comments_capitals_and_a_side_with_one(self):
        path = self.folder / "A.CSV"
        columns = {"object": "soup", "side": "Right"}
        write_csv(path, self.points, self.demos.object_pos, self.turn, columns=columns)
        path.write_text(f"# a tracker\n{path.read_text()}# the end\n")
        self.same(read_keypoints(path, PLAIN))
        (self.folder / "._A.CSV").touch()  # what macOS leaves on other drives
        self.same(read_keypoints(self.folder, PLAIN))

    def test_command(self):
        source = self.folder / "in"
        source.mkdir()
        for name in ("one", "two"):
            write_csv(
                source / f"{name}.csv", self.points, self.demos.object_pos, self.turn, scale=1e3
            )
        np.savetxt(self.folder / "T.txt", np.eye(4))
        out = self.folder / "out.npz"
        command = ("demos import keypoints", source, "--out", out)
        code, _, said = xreset(*command)
        self.assertNotEqual(code, 0)
        for option in ("--order", "--units", "--coordinates"):
            self.assertIn(option, said)
        self.assertFalse(out.exists())
        words = "--order mediapipe --units mm --coordinates camera --fps 10 --side right --object 005_tomato_soup_can"
        np.savetxt(self.folder / "mm.txt", np.eye(4) + 500 * np.eye(4, k=3))
        said = refused(*command, words, "--table-from-camera", self.folder / "mm.txt")
        self.assertIn("Are these millimetres?", said)
        self.assertIn(
            "2 sequences",
            succeeds(*command, words, "--table-from-camera", f"{self.folder}/T.txt"),
        )
        self.assertEqual(read_demos(out).sequence_name.tolist(), ["one", "two"])


class Real(InFolder):
    def test_wrists_of_dexycb_are_those_of_mano(self):
        demos = read_demos(data_dir() / "dexycb_right_9x20.npz").select(indices=[0])
        seen = demos.hand_valid
        time = np.arange(demos.num_frames) / 30
        columns = {"object": str(demos.object_name[0]), "side": "right", "time": time}
        points, pos, turn = seen_from(CAMERA, demos)
        write_csv(
            Path(self.folder, "a.csv"), points, pos, turn, scale=1e3, columns=columns, quat="xyzw"
        )
        convention = replace(PLAIN, units="mm", frame="camera", table_from_camera=CAMERA, fps=None)
        found = read_keypoints(self.folder, convention)
        assert_array_equal(found.hand_valid, seen)
        self.assertLess(np.abs(found.hand_keypoints - demos.hand_keypoints)[seen].max(), 1e-4)
        off = angles(found.wrist_quat_wxyz[seen], demos.wrist_quat_wxyz[seen])
        self.assertLess(off.max(), np.radians(3.7))
