"""Mirrored demonstrations: the plane of symmetry, and what becomes of object and hand."""

import dataclasses

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial import cKDTree

from tests.command import succeeds
from tests.data import InOneFolder
from tests.test_demos import in_frame
from tests.toy_bank import shifted
from tests.toy_retarget import box_object
from xreset import load_object, merge_demos, read_demos, synthesize, write_demos
from xreset.demos.mirror import mirrored, symmetry
from xreset.errors import DemoError
from xreset.geometry.shapes import turn_of
from xreset.spec import TableSpec


def reflect(points):
    return points * [-1.0, 1.0, 1.0] + [2.0 * TableSpec().center[0], 0.0, 0.0]


class MirrorTest(InOneFolder):
    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.demos = synthesize(["mustard"], 1, 0, side="left")
        cls.object = shifted(load_object("mustard"), np.array([0.03, 0.02, 0.01]))
        cls.symmetries = {cls.object.name: symmetry(cls.object)}
        cls.found = mirrored(cls.demos, cls.symmetries)

    def test_finds_the_plane_of_a_body_with_one(self):
        """An L has one plane of symmetry only, here z = 0.01; a third arm out of the plane leaves none."""
        arms = [((0, 0, 0.01), (0.12, 0.03, 0.04)), ((0.045, 0.05, 0.01), (0.03, 0.08, 0.04))]
        found = symmetry(box_object(*arms))
        self.assertLess(found.deviation, 0.001)
        self.assertGreater(abs(found.normal[2]), 0.9999)
        self.assertAlmostEqual(found.offset * np.sign(found.normal[2]), 0.01, delta=2e-4)
        crooked = symmetry(box_object(*arms, ((0, 0, 0.06), (0.03, 0.03, 0.08))))
        self.assertGreater(crooked.deviation, 0.008)

    def test_the_object_and_the_hand_are_where_their_reflections_are(self):
        for frame in (0, self.demos.num_frames // 2, self.demos.num_frames - 1):
            placed = []
            for demos in (self.demos, self.found):
                turn = turn_of(demos.object_quat_wxyz[frame])
                self.assertAlmostEqual(np.linalg.det(turn.as_matrix()), 1.0, delta=5e-6)
                placed.append(turn.apply(self.object.vertices) + demos.object_pos[frame])
            distance, _ = cKDTree(placed[1]).query(reflect(placed[0]))
            self.assertLess(np.percentile(distance, 95), 0.004)
        assert_allclose(self.found.hand_keypoints, reflect(self.demos.hand_keypoints), atol=1e-6)

    def test_a_left_hand_becomes_a_right_hand(self):
        """In its own frame, a left hand is the mirror image in x of a right one."""
        self.assertEqual(self.found.hand_side.tolist(), ["right"])
        left, right = (
            in_frame(demos.hand_keypoints[:, 0], demos.wrist_quat_wxyz, demos.hand_keypoints)
            for demos in (self.demos, self.found)
        )
        assert_allclose(right, left * [-1.0, 1.0, 1.0], atol=1e-5)

    def test_an_object_that_is_not_symmetric_is_refused(self):
        crooked = dataclasses.replace(self.symmetries[self.object.name], deviation=0.0045)
        with self.assertRaisesRegex(DemoError, r"mustard_bottle 4\.5 mm"):
            mirrored(self.demos, {self.object.name: crooked})

    def test_the_command_mirrors_the_left_hands_of_an_archive(self):
        files = [self.folder / name for name in ("demos.npz", "mirrored.npz")]
        write_demos(files[0], merge_demos([self.demos, synthesize(["soup"], 1, 0)]))
        said = succeeds("demos select", files[0], "--mirror --out", files[1])
        self.assertRegex(said, r"mustard_bottle: \d\.\d mm from its reflection, mirrored")
        found = read_demos(files[1])
        self.assertEqual(found.object_name.tolist(), ["006_mustard_bottle"])
        assert_array_equal(found.hand_keypoints, self.found.hand_keypoints)
