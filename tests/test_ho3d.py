"""HO-3D's layout, with small files made here; and pickles that want to do more than hold arrays."""

import os
import pickle
import shutil
import tracemalloc

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from tests.command import succeeds
from tests.data import InFolder
from tests.test_demos import assert_same_motion
from tests.test_keypoints import CAMERA, seen_from, written
from xreset import synthesize
from xreset.demos.ho3d import read_ho3d
from xreset.demos.pickles import array_of, read_pickle
from xreset.errors import DemoError

OPENGL = np.diag([1.0, -1.0, -1.0])
WRONG_ORDER = [0, 13, 14, 15, 16, *range(1, 13), *range(17, 21)]


class Ho3d(InFolder):
    """A synthetic demonstration as HO-3D would hold it comes back as it was."""

    @classmethod
    def setUpClass(cls):
        cls.demos = synthesize(["soup"], per_object=1, seed=1, fps=10)

    def setUp(self):
        super().setUp()
        self.cameras = self.folder / "cameras"
        self.cameras.mkdir()
        np.savetxt(self.cameras / "SM2.txt", CAMERA)
        self.meta = self.folder / "ho3d/train/SM2/meta"
        self.meta.mkdir(parents=True)

    def write(self, leave_out=(), **changes):
        points, pos, turn = seen_from(CAMERA, self.demos)
        points = written(points, "mano") @ OPENGL
        for i in range(self.demos.num_frames):
            path = self.meta / f"{i:04d}.pkl"
            path.unlink(missing_ok=True)
            if i in leave_out:
                continue
            data = {
                "handJoints3D": points[i] if self.demos.hand_valid[i] else None,
                "objRot": Rotation.from_matrix(OPENGL @ turn[i].as_matrix()).as_rotvec()[:, None],
                "objTrans": OPENGL @ pos[i],
                "objName": str(self.demos.object_name[0]),
                "handBeta": np.zeros(10),
                "objLabel": np.int64(5),
            }
            data |= {name: change(i, data[name]) for name, change in changes.items()}
            path.write_bytes(pickle.dumps(data, protocol=2))

    def read(self, **options):
        return read_ho3d(
            **{"root": self.folder / "ho3d", "fps": 10.0, "cameras": self.cameras, **options}
        )

    def refused(self, words, **options):
        with self.subTest(words), self.assertRaisesRegex(DemoError, words):
            self.read(**options)

    def test_an_imported_demonstration_is_as_it_was(self):
        self.write()
        found = self.read()
        assert_same_motion(self.demos, found, angle=1e-3)
        self.assertEqual((found.sequence_name[0], found.hand_side[0]), ("SM2", "right"))
        self.assertEqual(found.object_name[0], self.demos.object_name[0])

    def test_numbers_of_frames_need_no_zeros(self):
        self.write()
        for path in self.meta.glob("*.pkl"):
            path.rename(self.meta / f"{int(path.stem)}.pkl")
        assert_same_motion(self.demos, self.read(), angle=1e-3)

    def test_the_command_names_sequences_without_a_camera(self):
        self.write()
        shutil.copytree(self.meta, self.meta.parents[1] / "MC1" / "meta")
        options = ("--fps", 10, "--cameras", self.cameras, "--out", self.folder / "out.npz")
        out = succeeds("demos", "import", "ho3d", f"{self.folder}/ho3d", *options)
        self.assertRegex(out, "left out, because .* has no camera's pose: MC1\n")

    def test_frames_that_are_missing_or_not_annotated(self):
        last = self.demos.num_frames - 1
        self.write(leave_out=(7,), objRot=lambda i, value: value if 2 <= i < last else None)
        found = self.read()
        self.assertEqual(found.num_frames, last - 2)  # cut off at the ends
        middle = (self.demos.object_pos[6] + self.demos.object_pos[8]) / 2
        # interpolated between others
        assert_allclose(found.object_pos[5], middle, atol=1e-5)

    def test_refusals(self):
        for words, changes in (
            ("evaluation has the wrist alone", {"handJoints3D": lambda i, v: np.zeros(3)}),
            ("objName is", {"objName": lambda i, v: ("thing",)}),
            ("no frame with an object", {"objTrans": lambda i, v: v * np.nan}),
            ("object changes", {"objName": lambda i, v: f"thing_{i}"}),
            (
                "State the order",
                {"handJoints3D": lambda i, v: None if v is None else v[WRONG_ORDER]},
            ),
        ):
            self.write(**changes)
            self.refused(words)
        self.write()
        self.refused("no camera pose for any sequence.*SM2.txt", cameras=self.folder / "ho3d")
        self.refused("no HO-3D sequence", root=self.folder)
        far = self.meta / f"{10**9 - 1}.pkl"
        far.write_bytes((self.meta / "0000.pkl").read_bytes())
        self.refused("more than 100000 frames")
        far.rename(self.meta / f"{10**40}.pkl")
        self.refused("not named by a frame's number")


class Evil:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


class Pickles(InFolder):
    def load(self, content):
        path = self.folder / "x.pkl"
        path.write_bytes(content)
        return read_pickle(path)

    def refused(self, words, content):
        with self.subTest(words), self.assertRaisesRegex(DemoError, words):
            self.load(content)

    def test_arrays_of_protocols_and_orders(self):
        arrays = {
            "c": np.arange(6.0).reshape(2, 3),
            "f": np.asfortranarray(np.arange(6).reshape(2, 3)),
            "big": np.array([1.5, 2.5], dtype=">f4"),
        }
        for protocol in range(5):
            found = self.load(pickle.dumps(arrays, protocol=protocol))
            for name, value in arrays.items():
                with self.subTest(name, protocol=protocol):
                    assert_array_equal(array_of(found[name]), value)

    def test_protocol_5_is_refused(self):
        self.refused("protocol 5; save it with", pickle.dumps({"a": np.zeros(3)}, protocol=5))

    def test_a_pickle_of_python_2(self):
        kind = b"cnumpy\ndtype\n(S'f8'\nI0\nI1\ntR(I3\nS'<'\nNNNI-1\nI-1\nI0\ntb"
        data = (
            b"(dS'a'\ncnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR(I1\n(I1\nt"
            + kind
        )
        data += b"I00\nS'\\x00\\x00\\x00\\x00\\x00\\x00\\xf8?'\ntbs."
        assert_array_equal(array_of(self.load(data)["a"]), [1.5])

    def test_nothing_that_a_pickle_names_is_called(self):
        target = self.folder / "made"
        self.refused("it asks for", pickle.dumps({"a": Evil(target)}))
        self.refused("builtins.eval", b"cbuiltins\neval\n(S'1'\ntR.")
        self.refused("persistent", b"Pname\n.")
        self.refused("expected a dictionary", pickle.dumps([1]))
        call = f"(dS'a'\ncnumpy.testing\nrundocs\n(S'{target}'\ntRs."
        self.assertEqual(self.load(call.encode())["a"].arguments, (str(target),))
        self.assertFalse(target.exists())

    def test_what_is_not_an_array_is_refused(self):
        good = pickle.dumps({"a": np.zeros(3)}, protocol=2)
        for words, wrong in (
            ("cannot reshape", good.replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85")),
            ("an array of 'O8', expected numbers", good.replace(b"f8", b"O8")),
        ):
            with self.subTest(words), self.assertRaisesRegex(ValueError, words):
                array_of(self.load(wrong)["a"])

    def test_a_number_in_the_file_reserves_no_memory(self):
        tracemalloc.start()
        self.addCleanup(tracemalloc.stop)
        self.load(b"\x80\x02}r\x00\x00\x00\x10.")  # a value that is stored under the number 2^28
        # a bytearray of 1 TiB
        self.refused("cannot be read", b"\x80\x04\x96" + (1 << 40).to_bytes(8, "little") + b".")
        self.refused("more than a megabyte", pickle.dumps({"a": np.zeros(200_000)}))
        self.assertLess(tracemalloc.get_traced_memory()[1], 8 << 20)
