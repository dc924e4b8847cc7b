"""Demonstrations: the archive, DexYCB's layout, synthetic ones, and the commands."""

import re
from dataclasses import fields, replace
from unittest import TestCase
from unittest.mock import patch

import numpy as np
import trimesh
import yaml
from numpy.testing import assert_allclose, assert_array_equal, assert_array_less
from scipy.spatial.transform import Rotation

from tests.command import refused, succeeds
from tests.data import InFolder, data_dir, refuses
from xreset import synthesize
from xreset.demos import hand, synth
from xreset.demos.archive import (
    demo_objects,
    grounded,
    levelled,
    merge_demos,
    read_demos,
    write_demos,
)
from xreset.demos.dexycb import read_dexycb
from xreset.demos.examine import examine, surfaces_of
from xreset.demos.grasp import TIPS, Solid
from xreset.errors import DemoError, FileFormatError, XResetError
from xreset.geometry.shapes import turn_of
from xreset.objects.catalogue import load_object
from xreset.objects.rest import rest_height

ARCHIVES = (("dexycb_right_9x20.npz", "right"), ("dexycb_left_9x10.npz", "left"))
KNUCKLES = [5, 9, 13, 17]


def angles(a, b):
    """Angles between orientations (w, x, y, z) [rad]."""
    return (turn_of(a).inv() * turn_of(b)).magnitude()


def assert_same_motion(a, b, atol=1e-5, angle=1e-5):
    """Assert that objects, and hands where the first archive has them, move alike in two archives."""
    seen = a.hand_valid
    assert_allclose(a.hand_keypoints[seen], b.hand_keypoints[seen], atol=atol)
    assert_allclose(a.object_pos, b.object_pos, atol=atol)
    assert_array_less(angles(a.object_quat_wxyz, b.object_quat_wxyz), angle)
    assert_array_less(angles(a.wrist_quat_wxyz[seen], b.wrist_quat_wxyz[seen]), angle)


def in_frame(pos, quats, points):
    """Points [F, K, 3] in frames at positions [F, 3] and orientations [F, 4]."""
    return np.einsum("fji,fkj->fki", turn_of(quats).as_matrix(), points - pos[:, None])


class Archive(InFolder):
    @classmethod
    def setUpClass(cls):
        cls.demos = synthesize(["soup", "banana"], per_object=2, seed=1, fps=10)

    def changed(self, index, **values):
        arrays = {name: getattr(self.demos, name).copy() for name in values}
        for name, value in values.items():
            arrays[name][index] = value
        return replace(self.demos, **arrays)

    def moved(self, by):
        """The demonstrations moved by [F, 3]."""
        return replace(
            self.demos,
            object_pos=self.demos.object_pos + by,
            hand_keypoints=self.demos.hand_keypoints + by[:, None],
        )

    def assert_same(self, a, b):
        for field in fields(a):
            assert_array_equal(getattr(a, field.name), getattr(b, field.name), field.name)

    def test_round_trip_is_exact(self):
        file = self.folder / "a.npz"
        rich = self.changed(
            range(2), hand_valid=False, hand_keypoints=np.nan, wrist_quat_wxyz=np.nan
        )
        levels = np.eye(4)[None]
        rich = replace(rich, subjects=np.array(["synthetic"]), T_level_from_table=levels)
        for demos in (self.demos, rich):
            write_demos(file, demos, config={"seed": 1})
            written = file.read_bytes()
            again = read_demos(file)
            self.assert_same(again, demos)
            write_demos(file, again, config={"seed": 1})
            self.assertEqual(file.read_bytes(), written)
        words = f"Demos(4 sequences, {rich.num_frames} frames, 2 objects)"
        self.assertEqual(repr(read_demos(file)), words)

    def test_bad_values_name_sequence_and_frame(self):
        begin = self.demos.frames(1).start
        where = "First in frame {} of sequence 1".format
        for demos, message in (
            (
                self.changed((begin + 3, 8, 1), hand_keypoints=np.nan),
                "hand_keypoints are not finite.*" + where(3),
            ),
            (
                self.changed(begin + 4, wrist_quat_wxyz=np.nan),
                "wrist_quat_wxyz is not a unit .*" + where(4),
            ),
            (
                replace(self.demos, hand_keypoints=self.demos.hand_keypoints + 200),
                "hand_keypoints are far from the table",
            ),
            (self.changed((begin, 2), object_pos=200), "object_pos' holds 200, expected"),
            (
                self.changed(begin + 1, object_quat_wxyz=(1, 1, 0, 0)),
                "quaternions that are not unit",
            ),
            (
                self.changed(2, hand_side="Right"),
                r"sequence .* hand_side 'Right', expected 'right' or 'left'",
            ),
            (self.changed(2, frame_offsets=0), "frame_offsets must increase"),
            (self.changed(1, sequence_name=self.demos.sequence_name[0]), "must be unique"),
            (
                replace(self.demos, hand_keypoints=1000 * self.demos.hand_keypoints),
                "Are these millimetres",
            ),
            (replace(self.demos, fps=0.0), "fps"),
            (replace(self.demos, subjects=np.array(["a"])), "belong together"),
        ):
            with refuses(self, message, DemoError):
                write_demos(f"{self.folder}/bad.npz", demos)
            self.assertEqual(list(self.folder.iterdir()), [])
        path = self.folder / "a.npz"
        write_demos(path, self.demos)
        with np.load(path) as file:
            arrays = dict(file)
        arrays["hand_keypoints"][7, 0, 0] = np.nan
        np.savez(path, **arrays)
        with self.assertRaisesRegex(
            FileFormatError, r"a\.npz.*not finite.* frame 7 of sequence 0 \(synthetic/005"
        ):
            read_demos(path)

    def test_select(self):
        names = self.demos.sequence_name
        for options, indices in (
            ({"objects": ["banana"]}, [2, 3]),
            ({"objects": "banana", "side": "right"}, [2, 3]),
            ({"per_object": 1}, [0, 2]),
            ({"share": 0.1}, [0, 2]),
            ({"indices": [3, 0]}, [3, 0]),
            ({"sequences": names[1:2], "side": "right", "subjects": ["synthetic"]}, [1]),
        ):
            self.assertEqual(
                self.demos.select(**options).sequence_name.tolist(), names[indices].tolist()
            )
        last = self.changed(self.demos.frames(0).stop - 1, object_pos=1.0)
        assert_array_equal(last.select(indices=[3, 0]).goal_pose[0][1], np.ones(3))
        for options, message in (
            ({"side": "left"}, "no hand side left. Choose from: 'right'"),
            ({"indices": [4]}, "there are 4 sequences"),
            ({"indices": [1, 1]}, r"index occurs twice in \[1, 1\]"),
            (
                {"objects": ["soup", "cup", "mug"]},
                "Unknown objects 'cup', 'mug'. Choose from: 005_tomato_soup_can",
            ),
            ({"share": 0.0}, "share is 0, expected"),
            ({"per_object": 1, "pick": "last"}, "pick is 'last', expected first, spread or"),
            ({"indices": [True, False, False, True]}, r"whole numbers. Of a mask: np.flatnonzero"),
            ({"indices": [1.5]}, "expected whole numbers"),
        ):
            self.assertRaisesRegex(DemoError, message, self.demos.select, **options)
        words = "Demos.select.. got an unexpected .* 'most'; it takes objects, sequences, subjects"
        self.assertRaisesRegex(TypeError, words, self.demos.select, most=1)
        with self.assertRaisesRegex(XResetError, "^seed is -1, expected a whole number from 0"):
            self.demos.select(per_object=1, pick="random", seed=-1)

    def test_split_by_share_spread_and_chance(self):
        parts = []
        for i in range(6):
            names = np.array([f"{i}{j}" for j in range(4)])
            parts.append(replace(self.demos, sequence_name=names))
        demos = merge_demos(parts)  # 12 sequences of each object
        alone = demos.select(objects=["soup"])
        for options, soup in (
            ({"share": 0.25}, ["00", "01", "10"]),
            ({"per_object": 3, "pick": "spread"}, ["01", "21", "41"]),
            # the choice for an object depends on the seed alone
            (
                {"per_object": 3, "pick": "random", "seed": 1},
                alone.select(per_object=3, pick="random", seed=1).sequence_name.tolist(),
            ),
        ):
            with self.subTest(**options):
                kept, rest = demos.split(**options)
                self.assertEqual((len(kept), len(rest)), (6, 18))
                self.assertFalse(set(kept.sequence_name) & set(rest.sequence_name))
                self.assertEqual(kept.select(objects=["soup"]).sequence_name.tolist(), soup)
        other = alone.select(per_object=3, pick="random", seed=2)
        self.assertNotEqual(other.sequence_name.tolist(), soup)
        self.assertRaisesRegex(DemoError, "none is left", demos.split, share=1.0)

    def test_merge_demos(self):
        parts = [self.demos.select(indices=[i]) for i in range(4)]
        self.assert_same(merge_demos(parts), self.demos)
        T = np.eye(4)[None].copy()
        T[0, 2, 3] = 0.01
        tilted = replace(parts[0], subjects=np.array(["synthetic"]), T_level_from_table=T)
        self.assert_same(merge_demos([tilted]), levelled(tilted))
        for wrong, message in (
            ([*parts, parts[2]], "names must be unique"),
            ([parts[0], replace(parts[1], fps=25.0)], "rates"),
        ):
            self.assertRaisesRegex(DemoError, message, merge_demos, wrong)

    def test_unknown_object(self):
        file = self.folder / "a.npz"
        # the archive may hold any object
        write_demos(file, self.changed(3, object_name="055_baseball"))
        with self.assertRaisesRegex(
            DemoError, r"Unknown object '055_baseball'. Choose from: 003_cracker_box"
        ):
            demo_objects(read_demos(file))
        write_demos(file, self.changed(3, object_name="banana"))  # the paper's name
        self.assertEqual([*demo_objects(read_demos(file))], ["005_tomato_soup_can", "011_banana"])

    def test_an_object_and_its_mesh_have_one_name(self):
        for mesh in ("025_mug", "soup"):  # an official name stays, whatever the mesh is called
            trimesh.creation.box((0.05, 0.06, 0.07)).export(self.folder / f"{mesh}.obj")
        (soup,) = demo_objects(self.demos.select(indices=[0]), self.folder).values()
        self.assertEqual(soup.name, "005_tomato_soup_can")
        words = "name an object 'mug', which is '025_mug' here. Rename its mesh, or"
        with self.assertRaisesRegex(DemoError, words):
            demo_objects(self.changed(0, object_name="mug").select(indices=[0]), self.folder)

    def test_levelled_applies_the_subjects_transform_once(self):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0.02, 0, 0]).as_matrix()
        T[:3, 3] = (0, 0, 0.01)
        levels = np.stack([np.eye(4), T])
        demos = replace(
            self.demos, subjects=np.array(["other", "synthetic"]), T_level_from_table=levels
        )
        level = levelled(demos)
        for name in ("object_pos", "hand_keypoints"):
            expected = getattr(demos, name) @ T[:3, :3].T + T[:3, 3]
            assert_allclose(getattr(level, name), expected, atol=1e-6)
        for name in ("object_quat_wxyz", "wrist_quat_wxyz"):
            turned = Rotation.from_matrix(T[:3, :3]) * turn_of(getattr(demos, name))
            off = turned.inv() * turn_of(getattr(level, name))
            assert_allclose(off.magnitude(), 0, atol=1e-5)
        self.assertIs(levelled(level), level)
        self.assertIs(levelled(self.demos), self.demos)
        with self.assertRaisesRegex(DemoError, "not for synthetic"):
            levelled(replace(demos, subjects=np.array(["other", "third"])))

    def test_grounded_lowers_to_the_table_but_not_what_starts_on_top_of_something(self):
        objects = demo_objects(self.demos)
        first = self.demos.frames(0)
        up = np.zeros((self.demos.num_frames, 3))
        for height, elsewhere, stays in ((0.013, 0.013, 0.0), (0.05, -0.03, 0.05)):
            up[:, 2] = elsewhere  # below the table: lifted, however far
            up[first, 2] = height
            raised = self.moved(up)
            after = grounded(raised, objects)
            expected = np.zeros_like(up)
            expected[first, 2] = stays
            assert_allclose(after.object_pos, self.moved(expected).object_pos, atol=1e-6)
            assert_allclose(after.hand_keypoints, self.moved(expected).hand_keypoints, atol=1e-6)


class DexYCB(InFolder):
    """A small data set in DexYCB's layout, made from known motion in the table frame."""

    SERIALS = ("840412060917", "932122060861")

    @classmethod
    def setUpClass(cls):
        cls.demos = synthesize(["spam"], per_object=1, seed=3, fps=5)

    def setUp(self):
        super().setUp()
        rng = np.random.default_rng(0)
        poses = {}  # of each camera, and of the tag, in the world frame
        for key in (*self.SERIALS, "apriltag"):
            poses[key] = (Rotation.random(random_state=rng), rng.normal(size=3))
        poses[self.SERIALS[0]] = (Rotation.identity(), np.zeros(3))
        self.sequence = self.folder / "20200709-subject-01" / "20200709_141754"
        self.calibration = (
            self.folder / "calibration" / "extrinsics_20200702_151821" / "extrinsics.yml"
        )
        self.calibration.parent.mkdir(parents=True)
        entries = {}
        for key, (rot, pos) in poses.items():
            entries[key] = tuple(np.column_stack((rot.as_matrix(), pos)).ravel().tolist())
        # tuples have the tag that DexYCB's files have
        self.calibration.write_text(yaml.dump({"extrinsics": entries}))
        self.sequence.mkdir(parents=True)
        self.write_meta()
        frames = self.demos.num_frames
        tag_rot, tag_pos = poses["apriltag"]
        pose_y = np.zeros((frames, 2, 7), dtype=np.float32)
        pose_y[:, 0, 3] = 1
        pose_y[:, 1, :4] = (tag_rot * turn_of(self.demos.object_quat_wxyz)).as_quat()
        pose_y[:, 1, 4:] = tag_rot.apply(self.demos.object_pos) + tag_pos
        pose_m = np.zeros((frames, 1, 51), dtype=np.float32)
        pose_m[:, 0, :3] = (tag_rot * turn_of(self.demos.wrist_quat_wxyz)).as_rotvec()
        pose_m[0] = 0  # no hand yet, by either file
        np.savez(self.sequence / "pose.npz", pose_y=pose_y, pose_m=pose_m)
        world = tag_rot.apply(self.demos.hand_keypoints.reshape(-1, 3)) + tag_pos
        for serial in self.SERIALS:
            rot, pos = poses[serial]
            joints = rot.inv().apply(world - pos).reshape(frames, 1, 21, 3).astype(np.float32)
            joints[1] = -1
            (self.sequence / serial).mkdir()
            for frame in range(frames):
                np.savez(self.labels(serial, frame), joint_3d=joints[frame])

    def write_meta(self, **changes):
        meta = {
            "extrinsics": "20200702_151821",
            "mano_sides": ["right"],
            "num_frames": self.demos.num_frames,
            "serials": list(self.SERIALS),
            "ycb_grasp_ind": 1,
            "ycb_ids": [2, 9],
        }
        (self.sequence / "meta.yml").write_text(yaml.safe_dump(meta | changes))

    def labels(self, serial, frame):
        return self.sequence / serial / f"labels_{frame:06d}.npz"

    def check(self):
        read = read_dexycb(self.folder)
        self.assertEqual(read.sequence_name.tolist(), ["20200709-subject-01/20200709_141754"])
        self.assertEqual(
            (read.object_name[0], read.hand_side[0], read.fps),
            ("010_potted_meat_can", "right", 30.0),
        )
        assert_array_equal(read.hand_valid, np.arange(self.demos.num_frames) > 1)
        for name in ("hand_keypoints", "wrist_quat_wxyz"):
            self.assertTrue(np.isnan(getattr(read, name)[:2]).all())
        assert_same_motion(read, self.demos)

    def refused(self, message, root=None):
        with refuses(self, message, DemoError):
            read_dexycb(root or self.folder)

    def test_reads_back_the_table_frame(self):
        self.check()
        for frame in (4, 6, 7, 8):  # the other camera fills in
            self.labels(self.SERIALS[0], frame).unlink()
        self.check()

    def test_a_sequence_without_a_hand(self):
        """Is read by a scipy that refuses zero orientations, as the oldest that is allowed does."""
        made = Rotation.from_rotvec

        def from_rotvec(rotvec):
            self.assertTrue(len(rotvec))
            return made(rotvec)

        poses = dict(np.load(self.sequence / "pose.npz"))
        np.savez(self.sequence / "pose.npz", **poses | {"pose_m": 0 * poses["pose_m"]})
        with patch("xreset.demos.dexycb.Rotation.from_rotvec", from_rotvec):
            read = read_dexycb(self.folder)
        self.assertFalse(read.hand_valid.any())
        self.assertTrue(np.isnan(read.wrist_quat_wxyz).all())

    def test_incomplete(self):
        for changes, message in (
            (
                {"num_frames": self.demos.num_frames + 1},
                r"frames of meta\.yml: array .pose_y. has shape",
            ),
            ({"ycb_grasp_ind": 2}, "not a meta.yml of DexYCB.*list index out of range"),
            ({"mano_sides": ["up"]}, "side is out of range"),
        ):
            self.write_meta(**changes)
            self.refused(message)
        self.write_meta()
        poses = dict(np.load(self.sequence / "pose.npz"))
        np.savez(self.sequence / "pose.npz", **poses | {"pose_m": poses["pose_m"] + 1e4})
        self.refused("'pose_m' holds .* Unpack the sequence again")
        np.savez(self.sequence / "pose.npz", **poses)
        text = self.calibration.read_text()
        self.calibration.write_text(text.replace("tuple\n  - ", "tuple\n  - 7"))
        self.refused("expected the 12 numbers of a rotation")
        self.refused("no DexYCB sequence", root=self.folder / "calibration")
        self.calibration.write_text(text)
        for serial in self.SERIALS:
            self.labels(serial, 5).unlink()
        self.refused(r"labels_000005\.npz.*Unpack")

    def test_yaml_is_read_safely(self):
        marker = self.folder / "marker"
        for tag in (f"!!python/object/apply:os.mkdir ['{marker}']", "!!python/name:os.system"):
            (self.sequence / "meta.yml").write_text(f"extrinsics: {tag}\n")
            self.refused("not a meta.yml")
        self.assertFalse(marker.exists())
        (self.sequence / "meta.yml").write_text("[" * 5000)
        self.refused("not valid YAML")


class RealData(TestCase):
    def test_official_layout_agrees_with_the_archives(self):
        layout = read_dexycb(data_dir() / "dexycb_layout")
        self.assertEqual(sorted(layout.hand_side.tolist()), ["left", "right", "right"])
        compared = 0
        for name, _ in ARCHIVES:
            archive = read_demos(data_dir() / name)
            for sequence in np.intersect1d(layout.sequence_name, archive.sequence_name):
                compared += 1
                a, b = (demos.select(sequences=[sequence]) for demos in (archive, layout))
                for field in ("hand_side", "hand_valid"):
                    assert_array_equal(getattr(a, field), getattr(b, field))
                assert_same_motion(a, b, angle=1e-4)
        self.assertEqual(compared, 3)

    def test_synthetic_hands_have_the_conventions_of_real_hands(self):
        """Knuckles of real hands in the wrist's frame are where the model's are, for both sides."""
        for file, side in ARCHIVES:
            real = read_demos(data_dir() / file)
            points = real.hand_keypoints[real.hand_valid]
            local = in_frame(points[:, 0], real.wrist_quat_wxyz[real.hand_valid], points).mean(
                axis=0
            )
            model = hand.keypoints(hand.RELAXED, side)
            assert_allclose(local[KNUCKLES], model[KNUCKLES], atol=0.01)
            # real fingers are bent more or less
            assert_allclose(local, model, atol=0.04)


class Synthetic(InFolder):
    @classmethod
    def setUpClass(cls):
        right = synthesize(["soup", "tuna", "banana", "pitcher", "powerdrill"], 1, seed=0)
        left = synthesize(["soup", "banana"], per_object=1, seed=0, side="left")
        cls.demos = merge_demos([right, left])
        cls.objects = demo_objects(cls.demos)

    def hand_in_object(self, demos):
        return in_frame(
            demos.object_pos, demos.object_quat_wxyz, demos.hand_keypoints.astype(float)
        )

    def test_the_same_seed_gives_the_same_bits(self):
        with patch.multiple(synth, _FEW=1, _BATCH=1):  # in other processes
            again = synthesize(["banana", "soup"], per_object=1, seed=0)  # fewer objects
        for name in ("banana", "soup"):
            a = self.demos.select(objects=[name], side="right")
            b = again.select(objects=[name])
            for array in ("hand_keypoints", "wrist_quat_wxyz", "object_pos", "object_quat_wxyz"):
                self.assertEqual(getattr(a, array).tobytes(), getattr(b, array).tobytes())
        self.assertNotEqual(synthesize("soup", 1, seed=1).object_pos[0, 0], b.object_pos[0, 0])

    def test_the_hand_turns_the_object_to_a_pose_in_which_people_end(self):
        demos = synthesize(["soup"], 12, seed=0, side="both", fps=5)
        last = demos.frame_offsets[1:] - 1
        rotation = Rotation.from_quat(demos.object_quat_wxyz, scalar_first=True)
        turn = rotation[last] * rotation[demos.frame_offsets[:-1]].inv()
        self.assertGreater(np.degrees(turn.magnitude()).max(), 100)
        axes = Rotation.from_quat(demos.wrist_quat_wxyz[last], scalar_first=True).as_matrix()
        mirror = np.where(demos.hand_side == "right", 1, -1)[:, None]
        fingers = -mirror * axes[..., 0]
        palm = -axes[..., 1]
        sideways = np.cross([0.0, 0.0, 1.0], fingers) * mirror  # to +x with a right hand
        sideways /= np.linalg.norm(sideways, axis=1, keepdims=True)
        up = np.cross(fingers, sideways) * mirror
        angles = {
            synth.GOAL_HEADING: np.arctan2(fingers[:, 0], -fingers[:, 1]),
            synth.GOAL_PITCH: np.arcsin(fingers[:, 2]),
            synth.GOAL_ROLL: np.arctan2((palm * up).sum(axis=1), (palm * sideways).sum(axis=1)),
        }
        places = dict(zip(synth.GOAL, demos.object_pos[last, :2].T, strict=True))
        for bounds, values in (angles | places).items():
            self.assertTrue(bounds[0] - 1e-5 < values.min() < values.max() < bounds[1] + 1e-5)

    def test_objects_start_at_rest_on_any_side(self):
        demos = synthesize(["spam"], 12, seed=0, fps=5)
        first = demos.frame_offsets[:-1]
        start = demos.object_quat_wxyz[first]
        ups = Rotation.from_quat(start, scalar_first=True).inv().apply([0.0, 0.0, 1.0])
        sides = {tuple(side) for side in ups.round()}
        self.assertIn((0.0, 0.0, 1.0), sides)
        self.assertGreaterEqual(len(sides), 4)
        heights = rest_height(load_object("010_potted_meat_can"), start)
        assert_allclose(demos.object_pos[first, 2], heights, atol=1e-6)

    def test_a_wall_of_ones_own_mesh_is_held_from_both_sides(self):
        trimesh.creation.annulus(0.0365, 0.04, 0.09, sections=16).export(self.folder / "tube.obj")
        demos = synthesize(None, per_object=1, seed=0, meshes=self.folder)
        tips = self.hand_in_object(demos)[-1, TIPS]
        radius = np.linalg.norm(tips[:3, :2], axis=1)  # thumb, index, middle
        inside = radius < 0.0365
        self.assertTrue(((radius < 0.040) == inside).all(), radius)  # none is in the wall
        self.assertEqual([inside[0] != inside[1], inside[1] == inside[2]], [True, True])

    def test_the_origin_of_ones_own_mesh_may_be_anywhere(self):
        found = []
        shift = np.array([0.5, 0.9, 0.4])
        for at in (np.zeros(3), shift):
            mesh = trimesh.creation.box((0.05, 0.06, 0.12))
            mesh.apply_translation(at).export(self.folder / "brick.obj")
            found.append(synthesize(None, per_object=2, seed=0, fps=10, meshes=self.folder))
            self.assertEqual(examine(found[-1], surfaces_of(found[-1], self.folder)), [])
        centered, moved = found
        write_demos(self.folder / "a.npz", moved)
        said = succeeds("demos select", self.folder / "a.npz", "--meshes", self.folder)
        shown = re.search(r"brick.*100%\D+([\d.]+)\D+([\d.]+)\D+(\d+)", said).groups()
        way = centered.goal_pose[0] - centered.start_pose[0]
        turn = angles(centered.goal_pose[1], centered.start_pose[1])
        values = (100 * way[:, 2], 100 * np.linalg.norm(way, axis=1), np.degrees(turn))
        assert_allclose([*map(float, shown)], np.median(values, axis=1), atol=0.6)
        middle = moved.object_pos + turn_of(moved.object_quat_wxyz).apply(shift)
        assert_allclose(middle, centered.object_pos, atol=0.002)

    def test_a_line_enters_and_leaves_a_box_or_misses_it(self):
        box = load_object("003_cracker_box")
        low = box.vertices.min(axis=0)
        high = box.vertices.max(axis=0)
        solid = Solid.of(box, np.zeros(3), Rotation.identity())
        middle = (low + high) / 2
        beside = high + np.array([0.01, 0.0, 0.0])
        up = np.array([0.0, 0.0, 1.0])
        enter, leave, normal_in, normal_out = solid.crossings(np.stack((middle, beside)), up)
        half = (high - low)[2] / 2
        assert_allclose(enter, [[-half, np.inf]], atol=1e-8)
        assert_allclose(leave, [[half, -np.inf]], atol=1e-8)
        assert_allclose(normal_in[0, 0], -up, atol=1e-8)
        assert_allclose(normal_out[0, 0], up, atol=1e-8)

    def test_the_object_is_lifted_and_the_hand_reaches_opposes_and_holds(self):
        for index, name in enumerate(self.demos.sequence_name.tolist()):
            one = self.demos.select(indices=[index])
            obj = self.objects[str(one.object_name[0])]
            pos = one.object_pos.astype(float)
            lifted = int(np.argmax(pos[:, 2] > pos[0, 2] + 1e-6))
            points = one.hand_keypoints.astype(float)
            local = self.hand_in_object(one)
            with self.subTest(name):
                assert_array_equal(pos[1:lifted], pos[: lifted - 1])
                height = pos[:, 2] - rest_height(obj, one.object_quat_wxyz)
                self.assertAlmostEqual(height[0], 0, delta=1e-4)
                self.assertGreater(height.min(), -1e-4)
                self.assertTrue(0.139 < pos[-1, 2] - pos[0, 2] < 0.411)
                # thumb, index and middle finger are on the surface, and the hand goes through nothing
                distance = Solid.of(obj, np.zeros(3), Rotation.identity()).distance(local)
                self.assertTrue((np.abs(distance[lifted, TIPS[:3]]) < 0.008).all())
                self.assertGreater(distance[:, 1:].min(), -0.002)
                self.assertGreater(points[..., 2].min(), 0.0)
                # the object is between thumb and fingers
                solid = Solid.of(obj, pos[lifted], turn_of(one.object_quat_wxyz[lifted]))
                tips = points[lifted, TIPS]
                share = np.linspace(0, 1, 41)[1:-1, None]
                between = tips[0] + share * (tips[1:3].mean(axis=0) - tips[0])
                self.assertGreater((solid.distance(between) < 0).mean(), 0.5)
                # the hand comes from the person at +y, smoothly, keeps its bones, and holds
                self.assertGreater(points[0, 0, 1], 0.5)
                self.assertLess(np.abs(np.diff(points, n=2, axis=0)).max(), 0.02)
                self.assertLess(np.ptp(hand.bone_lengths(points), axis=0).max(), 2e-6)
                self.assertLess(np.ptp(local[lifted - 1 :], axis=0).max(), 2e-5)

    def test_bad_options(self):
        for words, options in (
            ("per_object is 1000000000 .* 1 to 100000", {"per_object": 10**9}),
            ("fps is 1", {"fps": 1}),
            ("side is 'top', expected", {"side": "top"}),
        ):
            self.assertRaisesRegex(DemoError, words, synthesize, ["soup"], **options)


class Commands(InFolder):
    def test_no_rest_is_written_without_a_selection(self):
        file = self.folder / "right.npz"
        rest = self.folder / "rest.npz"
        write_demos(file, synthesize(["soup"], 2, fps=10))
        said = refused("demos select", file, "--per-object 1 --mirror --rest", rest)
        self.assertIn("no hand side left", said)
        self.assertFalse(rest.exists())

    def test_what_is_given_twice_is_named(self):
        file = self.folder / "one.npz"
        out = self.folder / "out.npz"
        write_demos(file, synthesize(["soup"], 1, fps=10))
        said = refused("demos select", file, self.folder / "." / "one.npz", "--out", out)
        self.assertIn("one.npz is given twice. Give each archive once.", said)
        said = refused("demos synth --objects soup 005_tomato_soup_can --out", out)
        self.assertIn("The object 005_tomato_soup_can is given twice. Name each object once.", said)
        self.assertFalse(out.exists())

    def test_synth_then_info(self):
        file = self.folder / "demos.npz"
        synth = ("demos synth --objects soup --per-object 1 --side both --out", file)
        out = succeeds(*synth)
        first = file.read_bytes()
        self.assertEqual(read_demos(file).hand_side.tolist(), ["right", "left"])
        info = succeeds("demos select", file)
        self.assertIn(info, out)
        self.assertRegex(info, r"005_tomato_soup_can\W+1\W+1\W+\d+\W+100%")
        succeeds(*synth)
        self.assertEqual(file.read_bytes(), first)

    def test_select_of_several_archives_and_the_rest(self):
        file, left, rest, both = (
            f"{self.folder}/{name}.npz" for name in ("demos", "a", "b", "both")
        )
        write_demos(file, synthesize(["soup"], 2, fps=10))
        for words in (
            f"{file} --out {left} --rest {rest} --share 0.5",
            f"{left} {rest} --out {both}",
            f"{both} --out {left} --per-object 1 --pick spread",
        ):
            succeeds("demos select", words)
        names = read_demos(both).sequence_name.tolist()
        self.assertEqual(names, read_demos(file).sequence_name.tolist())
        self.assertEqual(read_demos(left).sequence_name.tolist(), names[1:])
        self.assertIn(
            "Nothing was overwritten",
            refused("demos select", file, "--out", left, "--rest", left, "--share 0.5"),
        )
        said = refused("demos select", file, "--share 0.5 --seed 3")
        self.assertIn("--seed 3 is for random picks. Add --pick random", said)
        one = f"{self.folder}/one.npz"
        write_demos(one, synthesize(["banana"], 1, fps=10))
        said = succeeds("demos select", file, one, "--per-object 1 --rest", rest)
        self.assertIn("011_banana: no sequence is left", said)

    def test_select_by_person(self):
        file, known, new = (f"{self.folder}/{name}.npz" for name in ("demos", "known", "new"))
        demos = synthesize(["soup"], 2, fps=10)
        write_demos(file, replace(demos, subject=np.array(["ann", "bob"])))
        said = succeeds("demos select", file, "--subjects ann --out", known, "--rest", new)
        self.assertRegex(said, r"known\.npz: 1 sequence, \d+ frames at")
        self.assertEqual(read_demos(known).subject.tolist(), ["ann"])
        self.assertEqual(read_demos(new).subject.tolist(), ["bob"])

    def test_import(self):
        file = self.folder / "demos.npz"
        self.assertIn(
            "no DexYCB sequence", refused("demos import dexycb", self.folder, "--out", file)
        )
        self.assertFalse(file.exists())
