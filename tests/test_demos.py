"""Demonstrations: the archive, DexYCB's layout, synthetic ones, and the commands."""

import contextlib
import importlib.util
import io
import tempfile
import unittest
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from tests.data import data_dir
from xreset.cli import main
from xreset.demos import hand
from xreset.demos.align import grounded, levelled, on_something
from xreset.demos.archive import concatenate, demo_objects, read_demos, write_demos
from xreset.demos.dexycb import read_dexycb
from xreset.demos.grasp import TIPS, Solid
from xreset.demos.info import summarize
from xreset.demos.synth import synthesize
from xreset.errors import DemoError, FileFormatError, ObjectError
from xreset.objects.catalogue import object_names

PARENTS = [0 if k % 4 == 1 else k - 1 for k in range(1, 21)]


def angles(a, b):
    """Angles between orientations (w, x, y, z) [rad]."""
    return (Rotation.from_quat(a, scalar_first=True).inv() * Rotation.from_quat(b, scalar_first=True)).magnitude()


class WithFolder(unittest.TestCase):
    def setUp(self):
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)


class Archive(WithFolder):
    @classmethod
    def setUpClass(cls):
        cls.demos = synthesize(["soup", "banana"], per_object=2, seed=1, fps=10)

    def changed(self, name, index, value):
        array = getattr(self.demos, name).copy()
        array[index] = value
        return replace(self.demos, **{name: array})

    def test_round_trip_is_exact(self):
        first, second = self.folder / "a.npz", self.folder / "b.npz"
        write_demos(first, self.demos, config={"seed": 1})
        again = read_demos(first)
        for field in fields(self.demos):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(self.demos, field.name), field.name)
        write_demos(second, again, config={"seed": 1})
        self.assertEqual(first.read_bytes(), second.read_bytes())

    def test_optional_arrays_are_kept(self):
        T = np.eye(4)[None]
        write_demos(self.folder / "a.npz", replace(self.demos, subjects=np.array(["synthetic"]), T_level_from_table=T))
        again = read_demos(self.folder / "a.npz")
        self.assertEqual(again.subjects.tolist(), ["synthetic"])
        np.testing.assert_array_equal(again.T_level_from_table, T)

    def test_hand_less_frames_may_be_nan(self):
        demos = replace(self.changed("hand_valid", [0, 1], False))
        points, quats = demos.hand_keypoints.copy(), demos.wrist_quat_wxyz.copy()
        points[:2], quats[:2] = np.nan, np.nan
        write_demos(self.folder / "a.npz", replace(demos, hand_keypoints=points, wrist_quat_wxyz=quats))
        self.assertEqual(int((~read_demos(self.folder / "a.npz").hand_valid).sum()), 2)

    def test_bad_values_name_sequence_and_frame(self):
        second = self.demos.frames(1)
        cases = [
            (
                self.changed("hand_keypoints", (second.start + 3, 8, 1), np.nan),
                r"hand_keypoints is not finite in frame 3 of sequence 1",
            ),
            (
                self.changed("wrist_quat_wxyz", second.start + 4, np.nan),
                r"wrist_quat_wxyz is not finite in frame 4 of sequence 1",
            ),
            (
                self.changed("object_pos", (second.start, 2), np.inf),
                r"object_pos is not finite in frame 0 of sequence 1",
            ),
            (
                self.changed("object_quat_wxyz", second.stop - 1, (1, 1, 0, 0)),
                r"object_quat_wxyz has length 1.4142 in frame \d+ of sequence 1 .* unit",
            ),
            (self.changed("hand_side", 2, "Right"), r"sequence 2 .* hand_side 'Right', expected 'right' or 'left'"),
            (self.changed("frame_offsets", 2, 0), "frame_offsets must increase"),
            (self.changed("frame_offsets", -1, 5), "expected 0 to"),
            (self.changed("sequence_name", 1, str(self.demos.sequence_name[0])), "must be unique"),
            (replace(self.demos, fps=0.0), "fps"),
            (replace(self.demos, subjects=np.array(["a"])), "belong together"),
        ]
        for demos, message in cases:
            with self.subTest(message), self.assertRaisesRegex(DemoError, message):
                write_demos(self.folder / "bad.npz", demos)
            self.assertEqual(list(self.folder.iterdir()), [])

    def test_reader_refuses_what_the_writer_would(self):
        write_demos(self.folder / "a.npz", self.demos)
        with np.load(self.folder / "a.npz") as file:
            arrays = dict(file)
        arrays["hand_keypoints"][7, 0, 0] = np.nan
        np.savez(self.folder / "nan.npz", **arrays)
        with self.assertRaisesRegex(
            FileFormatError, r"nan\.npz.*hand_keypoints is not finite in frame 7 of sequence 0 \(synthetic/005"
        ):
            read_demos(self.folder / "nan.npz")
        arrays.pop("hand_valid")
        np.savez(self.folder / "short.npz", **arrays)
        with self.assertRaisesRegex(FileFormatError, "no array 'hand_valid'"):
            read_demos(self.folder / "short.npz")
        data = (self.folder / "a.npz").read_bytes()
        for keep in (0.1, 0.5, 0.95):
            (self.folder / "cut.npz").write_bytes(data[: int(keep * len(data))])
            with self.assertRaisesRegex(FileFormatError, "damaged or truncated"):
                read_demos(self.folder / "cut.npz")

    def test_select(self):
        self.assertEqual(self.demos.select(objects=["banana"]).object_name.tolist(), ["011_banana"] * 2)
        self.assertEqual(self.demos.select(max_per_object=1).num_sequences, 2)
        picked = self.demos.select(indices=[3, 0])
        self.assertEqual(picked.sequence_name.tolist(), self.demos.sequence_name[[3, 0]].tolist())
        np.testing.assert_array_equal(
            picked.hand_keypoints[picked.frames(0)], self.demos.hand_keypoints[self.demos.frames(3)]
        )
        np.testing.assert_array_equal(picked.goal_pose[0][1], self.demos.object_pos[self.demos.frames(0)][-1])
        np.testing.assert_array_equal(picked.start_pose[1][1], self.demos.object_quat_wxyz[0])
        name = str(self.demos.sequence_name[1])
        self.assertEqual(self.demos.select(names=[name], sides=["right"]).sequence_name.tolist(), [name])
        for options, message in (
            ({"objects": ["tuna"]}, "'tuna'. Choose from: 005_tomato_soup_can"),
            ({"sides": ["left"]}, "no hand_side left. Choose from: \\['right"),
            ({"names": ["x"]}, "no sequence_name x"),
            ({"indices": [4]}, "there are 4 sequences"),
            ({"indices": [0], "objects": ["banana"]}, "No sequence meets"),
        ):
            with self.assertRaisesRegex(DemoError, message):
                self.demos.select(**options)

    def test_concatenate(self):
        parts = [self.demos.select(indices=[i]) for i in range(4)]
        whole = concatenate(parts)
        for field in fields(self.demos):
            np.testing.assert_array_equal(getattr(whole, field.name), getattr(self.demos, field.name), field.name)
        with self.assertRaisesRegex(DemoError, "unique"):
            concatenate([self.demos, self.demos])
        with self.assertRaisesRegex(DemoError, "frame rates"):
            concatenate([parts[0], replace(parts[1], fps=25.0)])

    def test_unknown_object(self):
        demos = self.changed("object_name", 3, "055_baseball")
        write_demos(self.folder / "a.npz", demos)  # the archive may hold any object
        with self.assertRaisesRegex(DemoError, r"_001' needs the object '055_baseball'.*Choose from: 003_cracker_box"):
            demo_objects(read_demos(self.folder / "a.npz"))
        self.assertEqual(list(demo_objects(self.demos)), ["005_tomato_soup_can", "011_banana"])

    def test_levelled_applies_the_subjects_transform_once(self):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0.02, 0, 0]).as_matrix()
        T[:3, 3] = (0, 0, 0.01)
        demos = replace(
            self.demos, subjects=np.array(["other", "synthetic"]), T_level_from_table=np.stack([np.eye(4), T])
        )
        level = levelled(demos)
        np.testing.assert_allclose(level.object_pos, demos.object_pos @ T[:3, :3].T + T[:3, 3], atol=1e-6)
        np.testing.assert_allclose(level.hand_keypoints, demos.hand_keypoints @ T[:3, :3].T + T[:3, 3], atol=1e-6)
        np.testing.assert_allclose(angles(demos.object_quat_wxyz, level.object_quat_wxyz), 0.02, atol=1e-5)
        np.testing.assert_allclose(levelled(level).object_pos, level.object_pos, atol=1e-7)
        self.assertIs(levelled(self.demos), self.demos)
        with self.assertRaisesRegex(DemoError, "not for synthetic"):
            levelled(replace(demos, subjects=np.array(["other", "third"])))

    def test_grounded_puts_the_first_frame_on_the_table(self):
        up = np.array([0, 0, 0.013])
        raised = replace(
            self.demos, object_pos=self.demos.object_pos + up, hand_keypoints=self.demos.hand_keypoints + up
        )
        down = grounded(raised, demo_objects(raised))
        np.testing.assert_allclose(down.object_pos, self.demos.object_pos, atol=1e-6)
        np.testing.assert_allclose(down.hand_keypoints, self.demos.hand_keypoints, atol=1e-6)

    def test_grounded_leaves_alone_what_starts_on_top_of_something(self):
        first = self.demos.frames(0)
        up = np.zeros((self.demos.num_frames, 3))
        up[:, 2], up[first, 2] = -0.03, 0.05  # the others are below the table: they are lifted, however far
        moved = replace(
            self.demos, object_pos=self.demos.object_pos + up, hand_keypoints=self.demos.hand_keypoints + up[:, None]
        )
        objects = demo_objects(moved)
        self.assertEqual(on_something(moved, objects).tolist(), [True] + [False] * (len(moved) - 1))
        after = grounded(moved, objects)
        np.testing.assert_allclose(after.object_pos[first], self.demos.object_pos[first] + [0, 0, 0.05], atol=1e-6)
        np.testing.assert_allclose(
            after.hand_keypoints[first], self.demos.hand_keypoints[first] + [0, 0, 0.05], atol=1e-6
        )
        np.testing.assert_allclose(after.object_pos[first.stop :], self.demos.object_pos[first.stop :], atol=1e-6)

    def test_summary(self):
        soup, banana = summarize(self.demos)
        self.assertEqual((soup.object_name, soup.sequences, soup.right), ("005_tomato_soup_can", 2, 2))
        self.assertEqual(banana.frames, self.demos.frames(3).stop - self.demos.frames(2).start)
        goal, start = self.demos.goal_pose, self.demos.start_pose
        self.assertAlmostEqual(
            banana.goal_distance, np.median(np.linalg.norm(goal[0] - start[0], axis=1)[2:]), places=6
        )
        self.assertAlmostEqual(banana.goal_angle, np.median(angles(start[1], goal[1])[2:]), places=5)


class DexYCB(WithFolder):
    """A small data set in DexYCB's layout, made from known motion in the table frame."""

    SERIALS = ("840412060917", "932122060861")

    def setUp(self):
        super().setUp()
        rng = np.random.default_rng(0)
        self.demos = synthesize(["spam"], per_object=1, seed=3, fps=5)
        self.poses = {}  # pose of each camera, and of the tag, in the world frame
        for key in (*self.SERIALS, "apriltag"):
            self.poses[key] = (Rotation.random(random_state=rng), rng.normal(size=3))
        self.poses[self.SERIALS[0]] = (Rotation.identity(), np.zeros(3))
        self.sequence = self.folder / "20200709-subject-01" / "20200709_141754"
        self.calibration = self.folder / "calibration" / "extrinsics_20200702_151821" / "extrinsics.yml"
        self.write()

    def write(self):
        frames = self.demos.num_frames
        tag_rot, tag_pos = self.poses["apriltag"]
        self.calibration.parent.mkdir(parents=True)
        rows = {key: np.column_stack((rot.as_matrix(), pos)).ravel().tolist() for key, (rot, pos) in self.poses.items()}
        lines = ["extrinsics:"]
        for key, values in rows.items():
            lines += [f"  '{key}': !!python/tuple", *(f"  - {value!r}" for value in values)]
        self.calibration.write_text("\n".join([*lines, f"master: '{self.SERIALS[0]}'"]) + "\n")
        self.sequence.mkdir(parents=True)
        self.meta = {
            "extrinsics": "20200702_151821",
            "mano_sides": ["right"],
            "num_frames": frames,
            "serials": list(self.SERIALS),
            "ycb_grasp_ind": 1,
            "ycb_ids": [2, 9],
        }
        self.write_meta()
        object_rot = tag_rot * Rotation.from_quat(self.demos.object_quat_wxyz, scalar_first=True)
        pose_y = np.zeros((frames, 2, 7), dtype=np.float32)
        pose_y[:, 0, 3] = 1
        pose_y[:, 1] = np.column_stack((object_rot.as_quat(), tag_rot.apply(self.demos.object_pos) + tag_pos))
        pose_m = np.zeros((frames, 1, 51), dtype=np.float32)
        pose_m[:, 0, :3] = (tag_rot * Rotation.from_quat(self.demos.wrist_quat_wxyz, scalar_first=True)).as_rotvec()
        pose_m[0] = 0  # no hand yet
        np.savez(self.sequence / "pose.npz", pose_y=pose_y, pose_m=pose_m)
        world = tag_rot.apply(self.demos.hand_keypoints.reshape(-1, 3)) + tag_pos
        for serial in self.SERIALS:
            rot, pos = self.poses[serial]
            joints = rot.inv().apply(world - pos).reshape(frames, 1, 21, 3).astype(np.float32)
            joints[0] = -1
            (self.sequence / serial).mkdir()
            for frame in range(frames):
                np.savez(self.sequence / serial / f"labels_{frame:06d}.npz", joint_3d=joints[frame])

    def write_meta(self, **changes):
        (self.sequence / "meta.yml").write_text(yaml.safe_dump(self.meta | changes))

    def labels(self, serial, frame):
        return self.sequence / serial / f"labels_{frame:06d}.npz"

    def check(self, read):
        self.assertEqual(read.sequence_name.tolist(), ["20200709-subject-01/20200709_141754"])
        self.assertEqual((read.object_name[0], read.hand_side[0], read.fps), ("010_potted_meat_can", "right", 30.0))
        self.assertEqual(read.hand_valid.tolist(), [False] + [True] * (self.demos.num_frames - 1))
        self.assertTrue(np.isnan(read.hand_keypoints[0]).all() and np.isnan(read.wrist_quat_wxyz[0]).all())
        np.testing.assert_allclose(read.hand_keypoints[1:], self.demos.hand_keypoints[1:], atol=1e-5)
        np.testing.assert_allclose(read.object_pos, self.demos.object_pos, atol=1e-5)
        self.assertLess(angles(read.object_quat_wxyz, self.demos.object_quat_wxyz).max(), 1e-5)
        self.assertLess(angles(read.wrist_quat_wxyz[1:], self.demos.wrist_quat_wxyz[1:]).max(), 1e-5)

    def test_reads_back_the_table_frame(self):
        self.check(read_dexycb(self.folder))

    def test_another_camera_fills_in(self):
        self.labels(self.SERIALS[0], 4).unlink()
        for frame in range(6, 9):
            self.labels(self.SERIALS[0], frame).unlink()
        self.check(read_dexycb(self.folder))

    def test_only_what_is_asked_for(self):
        self.check(read_dexycb(self.folder, objects=["spam"], sides=["right"]))
        with self.assertRaisesRegex(DemoError, r"None of the 1 sequences.*010_potted_meat_can \(right\)"):
            read_dexycb(self.folder, objects=["soup"])
        with self.assertRaisesRegex(DemoError, "None of the 1 sequences"):
            read_dexycb(self.folder, sides=["left"])
        with self.assertRaises(ObjectError):
            read_dexycb(self.folder, objects=["teapot"])

    def test_incomplete(self):
        with self.subTest("labels"):
            for serial in self.SERIALS:
                self.labels(serial, 5).rename(self.folder / serial)
            with self.assertRaisesRegex(DemoError, r"labels_000005\.npz.*Unpack"):
                read_dexycb(self.folder)
            for serial in self.SERIALS:
                (self.folder / serial).rename(self.labels(serial, 5))
        with self.subTest("frames"):
            self.write_meta(num_frames=self.demos.num_frames + 1)
            with self.assertRaisesRegex(DemoError, r"pose_y has shape .* but meta\.yml asks for"):
                read_dexycb(self.folder)
        with self.subTest("cameras"):
            self.write_meta(serials=["000000000000"])
            with self.assertRaisesRegex(DemoError, "no camera of meta.yml"):
                read_dexycb(self.folder)
        with self.subTest("grasped object"):
            self.write_meta(ycb_grasp_ind=2)
            with self.assertRaisesRegex(DemoError, "ycb_grasp_ind is 2"):
                read_dexycb(self.folder)
        self.write_meta()
        with self.subTest("tag"):
            text = self.calibration.read_text()
            self.calibration.write_text(text.replace("apriltag", "tag"))
            with self.assertRaisesRegex(DemoError, "no pose 'apriltag'"):
                read_dexycb(self.folder)
        with self.subTest("calibration"):
            self.calibration.unlink()
            with self.assertRaisesRegex(DemoError, "calibration"):
                read_dexycb(self.folder)
        with self.subTest("damaged labels"):
            self.calibration.write_text(text)
            self.labels(self.SERIALS[0], 3).write_bytes(b"PK")
            with self.assertRaisesRegex(DemoError, "labels_000003.npz cannot be read"):
                read_dexycb(self.folder)
        with self.subTest("nothing"), self.assertRaisesRegex(DemoError, "no DexYCB sequence"):
            read_dexycb(self.folder / "calibration")

    def test_yaml_is_read_safely(self):
        marker = self.folder / "marker"
        for tag in (f"!!python/object/apply:os.mkdir ['{marker}']", "!!python/name:os.system"):
            (self.sequence / "meta.yml").write_text(f"extrinsics: {tag}\n")
            with self.assertRaisesRegex(DemoError, "not valid YAML"):
                read_dexycb(self.folder)
        self.assertFalse(marker.exists())


class RealData(unittest.TestCase):
    def test_official_layout_agrees_with_the_prepared_sequence(self):
        demos = read_dexycb(data_dir() / "dexycb_layout")
        self.assertEqual(sorted(demos.hand_side.tolist()), ["left", "right", "right"])
        with np.load(data_dir() / "dexycb_sequence.npz") as file:
            expected = dict(file)
        own = demos.select(names=[str(expected["sequence_name"])])
        self.assertEqual(own.object_name[0], str(expected["object_name"]))
        valid = np.isfinite(expected["hand_keypoints_table"]).all(axis=(1, 2))
        np.testing.assert_array_equal(own.hand_valid, valid)
        np.testing.assert_allclose(own.hand_keypoints[valid], expected["hand_keypoints_table"][valid], atol=1e-4)
        np.testing.assert_allclose(own.object_pos, expected["object_pose_table"][:, :3, 3], atol=1e-4)
        for quat, pose in ((own.object_quat_wxyz, "object_pose_table"), (own.wrist_quat_wxyz, "wrist_pose_table")):
            turn = Rotation.from_quat(quat[valid], scalar_first=True).inv() * Rotation.from_matrix(
                expected[pose][valid, :3, :3]
            )
            self.assertLess(np.degrees(turn.magnitude()).max(), 0.1)

    def test_archives_agree_with_the_official_layout(self):
        layout = read_dexycb(data_dir() / "dexycb_layout")
        compared = 0
        for name in ("dexycb_right_9x20.npz", "dexycb_left_9x10.npz"):
            archive = read_demos(data_dir() / name)
            shared = sorted(set(layout.sequence_name.tolist()) & set(archive.sequence_name.tolist()))
            for sequence in shared:
                a, b = archive.select(names=[sequence]), layout.select(names=[sequence])
                compared += 1
                self.assertEqual(a.hand_side[0], b.hand_side[0])
                np.testing.assert_array_equal(a.hand_valid, b.hand_valid)
                np.testing.assert_allclose(a.hand_keypoints, b.hand_keypoints, atol=1e-5)
                np.testing.assert_allclose(a.object_pos, b.object_pos, atol=1e-5)
                self.assertLess(angles(a.wrist_quat_wxyz[a.hand_valid], b.wrist_quat_wxyz[a.hand_valid]).max(), 1e-4)
        self.assertEqual(compared, 3)

    def test_objects_rest_on_the_table(self):
        demos = levelled(read_demos(data_dir() / "dexycb_right_9x20.npz"))
        self.assertEqual(sorted(set(demos.object_name.tolist())), list(object_names()))
        shift = grounded(demos, demo_objects(demos)).object_pos[:, 2] - demos.object_pos[:, 2]
        shift = np.abs(shift[demos.frame_offsets[:-1]])
        self.assertLess(np.median(shift), 0.006)
        self.assertLess(np.percentile(shift, 90), 0.012)
        self.assertLessEqual(on_something(demos, demo_objects(demos)).sum(), 3)  # a few objects start on top of others


class Hand(unittest.TestCase):
    def test_bones_keep_their_lengths(self):
        rng = np.random.default_rng(0)
        points = hand.keypoints(rng.uniform(hand.LOWER, hand.UPPER, (50, 17)))
        lengths = np.linalg.norm(points[:, 1:] - points[:, PARENTS], axis=-1)
        np.testing.assert_allclose(lengths, lengths[:1].repeat(50, axis=0), atol=1e-12)
        np.testing.assert_allclose(lengths[0].reshape(5, 4)[1:, 1:], hand.FINGER_LENGTHS, atol=1e-12)

    def test_flexion_bends_towards_the_palm(self):
        straight = hand.keypoints(np.zeros(17))
        for finger in range(4):
            bent = np.zeros(17)
            bent[3 * finger + 1] = 0.5
            moved = hand.keypoints(bent) - straight
            tip = 8 + 4 * finger
            self.assertLess(moved[tip, 1], -0.02)
            np.testing.assert_allclose(np.delete(moved, range(tip - 2, tip + 1), axis=0), 0, atol=1e-12)

    def test_left_is_the_mirror_image(self):
        np.testing.assert_allclose(hand.keypoints(hand.RELAXED, "left"), hand.keypoints(hand.RELAXED) * (-1, 1, 1))

    def test_axes(self):
        for side, sign in (("right", 1), ("left", -1)):
            axes = hand.hand_axes(np.array([0, -1.0, 0]), np.array([0, 0, -1.0]), side)
            self.assertAlmostEqual(np.linalg.det(axes), 1)
            points = hand.keypoints(np.zeros(17), side) @ axes.T
            np.testing.assert_allclose(points[12] / np.linalg.norm(points[12]), [0, -1, 0], atol=0.05)
            self.assertGreater(
                sign * points[4, 0], 0.02
            )  # palm down, seen from behind: a right hand's thumb is on the left, towards +x


class Synthetic(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.demos = concatenate(
            [synthesize(None, per_object=1, seed=0), synthesize(["soup", "banana"], per_object=1, seed=0, side="left")]
        )
        cls.objects = demo_objects(cls.demos)

    def sequences(self):
        for i in range(self.demos.num_sequences):
            with self.subTest(str(self.demos.sequence_name[i])):
                one = self.demos.select(indices=[i])
                lifted = int(np.argmax(one.object_pos[:, 2] > one.object_pos[0, 2] + 1e-6))
                yield one, self.objects[str(one.object_name[0])], lifted

    def in_object(self, demos, points):
        """Points [F, K, 3] in the object's frame."""
        rotation = Rotation.from_quat(demos.object_quat_wxyz, scalar_first=True).as_matrix()
        return np.einsum("fji,fkj->fki", rotation, points - demos.object_pos[:, None])

    def distances(self, demos, obj):
        solid = Solid.of(obj, np.zeros(3), Rotation.identity())
        return solid.distance(self.in_object(demos, demos.hand_keypoints.astype(float)))

    def test_all_nine_objects(self):
        self.assertEqual(self.demos.object_name[:9].tolist(), list(object_names()))

    def test_the_same_seed_gives_the_same_bits(self):
        again = synthesize(["banana", "soup"], per_object=1, seed=0)  # another order, fewer objects
        for name in ("banana", "soup"):
            a, b = self.demos.select(objects=[name], sides=["right"]), again.select(objects=[name])
            for array in ("hand_keypoints", "wrist_quat_wxyz", "object_pos", "object_quat_wxyz"):
                self.assertEqual(getattr(a, array).tobytes(), getattr(b, array).tobytes())
        other = synthesize(["soup"], per_object=1, seed=1)
        self.assertFalse(np.array_equal(other.object_pos[0], again.select(objects=["soup"]).object_pos[0]))

    @unittest.skipUnless(importlib.util.find_spec("manifold3d"), "manifold3d is not installed")
    def test_a_wall_of_ones_own_mesh_is_held_from_both_sides(self):
        with tempfile.TemporaryDirectory() as folder:
            trimesh.creation.annulus(0.0365, 0.04, 0.09, sections=16).export(Path(folder) / "tube.obj")
            demos = synthesize(None, per_object=1, seed=0, meshes=folder)
        tips = self.in_object(demos, demos.hand_keypoints.astype(float))[-1, TIPS]
        radius = np.linalg.norm(tips[:3, :2], axis=1)  # thumb, index, middle
        inside = radius < 0.0365
        self.assertTrue(((radius < 0.040) == inside).all(), radius)  # none is in the wall
        self.assertNotEqual(inside[0], inside[1])
        self.assertEqual(inside[1], inside[2])
        self.assertLess(np.abs(tips[:3, 2]).max(), 0.045)

    def test_starts_at_rest_in_the_workspace(self):
        for one, obj, lifted in self.sequences():
            np.testing.assert_array_equal(one.object_pos[:lifted, :2], one.object_pos[:1, :2].repeat(lifted, axis=0))
            x, y, _ = one.object_pos[0]
            self.assertTrue(0.33 <= x <= 0.81 and 0.04 <= y <= 0.47)
            rotation = Rotation.from_quat(one.object_quat_wxyz, scalar_first=True)
            lowest = [(r.apply(obj.vertices) + p)[:, 2].min() for r, p in zip(rotation, one.object_pos, strict=True)]
            self.assertAlmostEqual(lowest[0], 0, delta=1e-4)
            self.assertGreater(min(lowest), -1e-4)
            self.assertTrue(20 <= lifted <= 45 and 60 <= one.num_frames <= 90)
            self.assertTrue(0.139 < one.object_pos[-1, 2] - one.object_pos[0, 2] < 0.411)
            self.assertGreater(one.hand_keypoints[0, 0, 1], 0.5)  # the person is at +y

    def test_thumb_and_fingers_oppose_each_other_on_the_surface(self):
        for one, obj, lifted in self.sequences():
            distance = self.distances(one, obj)[lifted, TIPS]
            self.assertTrue((np.abs(distance[:3]) < 0.008).all(), distance)  # thumb, index, middle
            tips = one.hand_keypoints[lifted, TIPS].astype(float)
            to_fingers = tips[1:3].mean(axis=0) - tips[0]
            span = np.linalg.norm(to_fingers)
            points = tips[0] + np.linspace(0, 1, 41)[1:-1, None] * to_fingers
            solid = Solid.of(
                obj,
                one.object_pos[lifted].astype(float),
                Rotation.from_quat(one.object_quat_wxyz[lifted], scalar_first=True),
            )
            inside = solid.distance(points) < 0
            self.assertGreater(inside.mean() * span, 0.008)  # the object is between them
            self.assertGreater(inside.mean(), 0.5)

    def test_the_hand_goes_through_nothing(self):
        for one, obj, _ in self.sequences():
            self.assertGreater(self.distances(one, obj)[:, 1:].min(), -0.002)
            self.assertGreater(one.hand_keypoints[..., 2].min(), 0.0)

    def test_smooth_and_rigid(self):
        for one, _, lifted in self.sequences():
            points = one.hand_keypoints.astype(float)
            acceleration = np.diff(points, n=2, axis=0) * 30**2
            self.assertLess(np.linalg.norm(acceleration, axis=-1).max(), 20)
            lengths = np.linalg.norm(points[:, 1:] - points[:, PARENTS], axis=-1)
            np.testing.assert_allclose(lengths, lengths[:1].repeat(len(lengths), axis=0), atol=1e-6)
            held = self.in_object(one, points)[lifted - 1 :]
            np.testing.assert_allclose(held, held[:1].repeat(len(held), axis=0), atol=1e-5)

    def test_wrist_orientation_is_that_of_manos_root(self):
        knuckles = [5, 9, 13, 17]
        for one, _, _ in self.sequences():
            rotation = Rotation.from_quat(one.wrist_quat_wxyz, scalar_first=True).as_matrix()
            local = np.einsum("fji,fkj->fki", rotation, one.hand_keypoints[:, knuckles] - one.hand_keypoints[:, :1])
            expected = hand.FINGER_BASES * ((-1, 1, 1) if one.hand_side[0] == "left" else (1, 1, 1))
            np.testing.assert_allclose(local, expected[None].repeat(one.num_frames, axis=0), atol=1e-5)

    def test_same_conventions_as_real_hands(self):
        """Knuckles of real hands in the wrist's frame lie where the model's are, for both sides."""
        for file, side in (("dexycb_right_9x20.npz", "right"), ("dexycb_left_9x10.npz", "left")):
            real = read_demos(data_dir() / file)
            valid = real.hand_valid
            rotation = Rotation.from_quat(real.wrist_quat_wxyz[valid], scalar_first=True).as_matrix()
            points = real.hand_keypoints[valid]
            local = np.einsum("fji,fkj->fki", rotation, points - points[:, :1]).mean(axis=0)
            model = hand.keypoints(hand.RELAXED, side)
            np.testing.assert_allclose(local[[5, 9, 13, 17]], model[[5, 9, 13, 17]], atol=0.01)
            np.testing.assert_allclose(local, model, atol=0.04)  # real fingers are bent more or less

    def test_bad_options(self):
        with self.assertRaises(ObjectError):
            synthesize(["teapot"])
        with self.assertRaisesRegex(DemoError, "per_object is 0"):
            synthesize(["soup"], per_object=0)
        with self.assertRaisesRegex(DemoError, "per_object is 1000000000 .* 1 to 100000"):
            synthesize(["soup"], per_object=10**9)
        with self.assertRaisesRegex(DemoError, "fps is 1"):
            synthesize(["soup"], fps=1)


class Commands(WithFolder):
    def run_command(self, *arguments):
        out, err = io.StringIO(), io.StringIO()
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                main(["demos", *map(str, arguments)])
                code = 0
            except SystemExit as exit:
                code = exit.code
        return code, out.getvalue(), err.getvalue()

    def test_synth_then_info(self):
        file = self.folder / "demos.npz"
        code, out, err = self.run_command(
            "synth", "--out", file, "--objects", "soup", "--per-object", 1, "--side", "both", "--fps", 10
        )
        self.assertEqual(code, 0, err)
        first = file.read_bytes()
        self.assertEqual(read_demos(file).hand_side.tolist(), ["right", "left"])
        code, info, _ = self.run_command("info", file)
        self.assertEqual((code, info), (0, out))
        self.assertRegex(info, r"005_tomato_soup_can\W+1\W+1\W")
        self.run_command("synth", "--out", file, "--objects", "soup", "--per-object", 1, "--side", "both", "--fps", 10)
        self.assertEqual(file.read_bytes(), first)

    def test_import(self):
        layout = data_dir() / "dexycb_layout"
        file = self.folder / "demos.npz"
        code, out, err = self.run_command("import", "dexycb", layout, "--out", file, "--objects", "cheez-its")
        self.assertEqual(code, 0, err)
        self.assertEqual(read_demos(file).object_name.tolist(), ["003_cracker_box"] * 2)
        self.assertIn("2 sequences", out)

    def test_errors_leave_no_file(self):
        file = self.folder / "demos.npz"
        code, _, err = self.run_command("import", "dexycb", self.folder, "--out", file)
        self.assertEqual(code, 1)
        self.assertIn("no DexYCB sequence", err)
        code, _, err = self.run_command("synth", "--out", file, "--objects", "teapot")
        self.assertEqual(code, 1)
        self.assertIn("Unknown object 'teapot'", err)
        self.assertEqual(list(self.folder.iterdir()), [])


class Plausible(unittest.TestCase):
    """What another convention would explain is said; what is right, is not doubted."""

    def test_other_conventions(self):
        from xreset.demos.keypoints import ORDERS
        from xreset.demos.plausible import doubts

        for side in ("right", "left"):
            demos = synthesize(["soup"], 1, side=side)
            self.assertEqual(doubts(demos), [])
            mano = np.empty_like(demos.hand_keypoints)
            mano[:, ORDERS["mano"]] = demos.hand_keypoints
            high, end = demos.object_pos + np.float32([0, 0, 0.9]), demos.object_pos.copy()
            end[-1], turn = end[0], demos.object_quat_wxyz.copy()
            turn[-1] = turn[0]
            for words, changes in (
                ("MANO's order", {"hand_keypoints": mano}),
                (r"\(x, y, z, w\)", {"wrist_quat_wxyz": demos.wrist_quat_wxyz[:, [1, 2, 3, 0]]}),
                ("1 of 1 sequences begins .* Are these coordinates of a camera", {"object_pos": high}),
                ("1 of 1 sequences begins .* at its goal already", {"object_pos": end, "object_quat_wxyz": turn}),
            ):
                with self.subTest(words, side=side):
                    (doubt,) = doubts(replace(demos, **changes))
                    self.assertRegex(doubt, words)

    def test_millimetres_are_refused(self):
        demos = synthesize(["soup"], 1)
        with tempfile.TemporaryDirectory() as folder, self.assertRaisesRegex(DemoError, "Are these millimetres"):
            write_demos(Path(folder) / "d.npz", replace(demos, hand_keypoints=1000 * demos.hand_keypoints))

    def test_recorded_demonstrations_are_not_doubted(self):
        from xreset.demos.plausible import doubts

        for name in ("dexycb_right_9x20.npz", "dexycb_left_9x10.npz"):
            demos = read_demos(data_dir() / name)
            objects = demo_objects(demos)
            self.assertEqual(doubts(demos, objects), [])
            for field, words in (
                ("object_quat_wxyz", "of the objects stand on the table if"),
                ("wrist_quat_wxyz", "ut w first"),
            ):
                (doubt,) = doubts(replace(demos, **{field: getattr(demos, field)[:, [1, 2, 3, 0]]}), objects)
                self.assertIn(words, doubt)


if __name__ == "__main__":
    unittest.main()
