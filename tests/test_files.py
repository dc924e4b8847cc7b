"""Files: whole or not at all, checked before use; typed configuration; the reset bank's refusals."""

import fcntl
import io
import json
import os
import re
import subprocess
import sys
import threading
import tracemalloc
import zipfile
from contextlib import ExitStack, chdir, contextmanager
from dataclasses import asdict, dataclass, replace
from errno import EACCES, EMFILE, ENOSPC
from typing import ClassVar, Literal
from unittest import TestCase
from unittest.mock import patch

import numpy as np
from numpy.testing import assert_array_equal

from tests.data import InFolder as WithFolder
from tests.data import refuses
from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_robot import toy_hand_arm
from xreset import (
    ResetBank,
    TaskConfig,
    __version__,
    read_bank,
    write_bank,
    write_demos,
    write_goals,
    write_retargeted,
)
from xreset.errors import FileFormatError, XResetError
from xreset.files.checks import from_dict
from xreset.files.records import Field, arrays_of, read_npz, write_npz
from xreset.files.storage import (
    atomic_folder,
    atomic_write,
    claim,
    code_version,
    read_json,
    read_toml,
    stated_path,
    write_json,
)
from xreset.spec import check_robot

SCHEMA = {
    "points": Field(("F", 3), "f"),
    "offsets": Field(("S+1",), "i"),
    "names": Field(("S",), "U"),
    "good": Field(("F",), "b"),
    "note": Field((), "U", required=False),
}
ARRAYS = {
    "points": np.arange(12.0).reshape(4, 3),
    "offsets": np.array([0, 1, 4]),
    "names": np.array(["a", "b"]),
    "good": np.array([True, False, True, True]),
}


class InFolder(WithFolder):
    def setUp(self):
        super().setUp()
        self.file = self.folder / "file.npz"

    def assert_only(self, *names):
        self.assertEqual(sorted(f.name for f in self.folder.iterdir()), sorted(names))

    def refused(self, *words):
        return self.assertRaisesRegex(FileFormatError, "(?s)" + ".*".join(words))


@contextmanager
def limited_memory(test, megabytes):
    """The block may allocate no more at once."""
    tracemalloc.start()
    try:
        yield
        test.assertLess(tracemalloc.get_traced_memory()[1], megabytes << 20)
    finally:
        tracemalloc.stop()


class AtomicWriteTest(InFolder):
    def test_a_file_is_replaced_whole_or_not_at_all(self):
        path = self.folder / "deep" / "er" / "a.txt"
        for text in ("first", "second"):
            with atomic_write(path) as file:
                file.write(text.encode())
            self.assertEqual(path.read_text(), text)
        with self.assertRaises(ZeroDivisionError), atomic_write(path) as file:
            file.write(b"new")
            raise ZeroDivisionError
        self.assertEqual(path.read_text(), "second")
        self.assertEqual([f.name for f in path.parent.iterdir()], ["a.txt"])

    def test_the_file_has_the_usual_permissions(self):
        self.addCleanup(os.umask, os.umask(0o022))
        for umask in (0o022, 0o077):
            os.umask(umask)
            file = self.folder / "a.json"
            folder = self.folder / f"made-{umask}"
            write_json(file, {})
            with atomic_folder(folder):
                pass
            for path, usual in ((file, 0o666), (folder, 0o777)):
                with self.subTest(path, umask=oct(umask)):
                    self.assertEqual(path.stat().st_mode & 0o777, usual & ~umask)

    def test_what_cannot_be_written(self):
        path = self.folder / "a.json"
        write_json(path, {"old": 1})
        full = OSError(ENOSPC, os.strerror(ENOSPC))
        with (
            patch("os.fsync", side_effect=full),
            self.assertRaisesRegex(XResetError, "No space left.*free some space"),
        ):
            write_json(path, {"new": 2})
        self.assertEqual(read_json(path), {"old": 1})
        self.assertRaisesRegex(XResetError, "cannot write", write_json, path / "b.json", {})
        with self.assertRaises(ValueError):
            write_json(path, {"x": float("nan")})
        self.assert_only("a.json")


class AtomicFolderTest(InFolder):
    def test_it_appears_whole_or_not_at_all(self):
        made = self.folder / "new" / "made"
        with self.assertRaisesRegex(ValueError, "half"), atomic_folder(made) as part:
            (part / "a").write_text("1")
            raise ValueError("half")
        self.assertEqual(list(made.parent.iterdir()), [])
        with self.refused(f"^{made / 'a'} is wrong$"), atomic_folder(made) as part:
            raise FileFormatError(f"{part / 'a'} is wrong")
        file = self.folder / "file"
        file.touch()
        for folder in (file / "made", file / "a" / "made"):
            with self.assertRaisesRegex(XResetError, f"^cannot write {folder}: "):
                atomic_folder(folder).__enter__()
        file.unlink()
        for error in (OSError(ENOSPC, "full"), OSError(ENOSPC, "full", "PART")):
            message = f"^cannot write {made}: full. "
            with self.assertRaisesRegex(XResetError, message), atomic_folder(made) as part:
                if error.filename:
                    error.filename = str(part / "a")
                raise error
        with self.assertRaises(FileNotFoundError), atomic_folder(made):
            (self.folder / "missing").read_bytes()
        made.mkdir()  # an empty one makes room
        with atomic_folder(made) as part:
            (part / "a").write_text("1")
            self.assertEqual(list(made.iterdir()), [])
        self.assertEqual([path.name for path in made.parent.rglob("*")], ["made", "a"])


class ClaimTest(InFolder):
    def test_one_writer_at_a_time(self):
        program = "import sys\nfrom xreset.files.storage import claim\nwith claim(sys.argv[1]):\n    print('mine', flush=True)\n    sys.stdin.read()\n"
        for path in (self.folder, self.file):
            with self.subTest(path):
                command = [sys.executable, "-c", program, str(path)]
                with subprocess.Popen(
                    command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
                ) as other:
                    self.assertEqual(other.stdout.readline(), "mine\n")
                    with (
                        self.assertRaisesRegex(XResetError, "another command is writing"),
                        claim(path),
                    ):
                        self.fail("two writers")
                    other.kill()  # what a killed one held is free
                with claim(path):
                    pass
        self.assert_only()

    def test_what_a_killed_writer_left_is_removed(self):
        def leave():
            (self.folder / ".xreset-abc.part").write_bytes(b"half")
            (self.folder / ".xreset-abd.part" / "meshes").mkdir(parents=True)

        leave()
        with claim(self.file):
            self.assert_only(".file.npz.lock")
        leave()
        with claim(self.folder):
            self.assert_only()
        leave()
        with atomic_folder(self.folder / "made"):
            self.assertEqual(len(list(self.folder.iterdir())), 1)

    def test_what_is_not_left_over_is_not_removed(self):
        (self.folder / ".album.part").mkdir()
        with atomic_write(f"{self.folder}/a") as file, atomic_folder(self.folder / "b") as made:
            for path in (self.file, self.folder):
                with claim(path):
                    pass
            file.write(b"whole")
            (made / "c").touch()
        self.assert_only(".album.part", "a", "b")
        self.assertEqual((self.folder / "a").read_bytes(), b"whole")
        self.assertTrue((self.folder / "b" / "c").exists())

    def test_the_lock_of_a_file_that_was_replaced_meanwhile_is_none(self):
        """The command that held it has ended, and a third one has begun."""
        others = self.enterContext(ExitStack())
        lock = fcntl.flock

        def late(*args):
            held.side_effect = lock
            (self.folder / ".file.npz.lock").unlink()
            others.enter_context(claim(self.file))
            lock(*args)

        with (
            patch("fcntl.flock", side_effect=late) as held,
            self.assertRaisesRegex(XResetError, "another command is writing"),
            claim(self.file),
        ):
            self.fail("two writers")

    def test_a_claim_waits_for_a_command_that_ends(self):
        looking = claim(self.folder)
        looking.__enter__()
        end = threading.Timer(0.05, looking.__exit__, (None, None, None))
        end.start()
        self.addCleanup(end.join)
        with claim(self.folder):
            pass


class StatedPathTest(InFolder):
    def test_the_working_folder_comes_before_those_above_the_file(self):
        """Before, a file of the same name in the run's folder was taken."""
        run = self.folder / "runs" / "a"
        run.mkdir(parents=True)
        (run / "resets.npz").touch()
        self.enterContext(chdir(self.folder))
        self.assertEqual(
            stated_path("resets.npz", run / "run.json"), str(run.resolve() / "resets.npz")
        )
        (self.folder / "resets.npz").touch()
        self.assertEqual(stated_path("resets.npz", run / "run.json"), "resets.npz")
        self.assertIsNone(stated_path("other.npz", run / "run.json"))


class JsonTest(InFolder):
    def test_the_version_is_recorded_and_does_not_matter(self):
        path = self.folder / "a.json"
        write_json(path, {"schema": "x/1", "a": 1})
        self.assertEqual(
            json.loads(path.read_text()), {"schema": "x/1", "xreset": code_version(), "a": 1}
        )
        self.assertEqual(read_json(path, "x/1"), {"a": 1})
        write_npz(self.folder / "a.npz", "x/1", {"a": np.zeros(2)})
        meta = json.loads(str(np.load(f"{self.folder}/a.npz")["meta"]))
        self.assertRegex(
            meta["xreset"], rf"^{re.escape(__version__)}(\+g[0-9a-f]{{12}}(\.dirty)?)?$"
        )
        self.assertEqual(meta["xreset"], code_version())

    def test_refusals(self):
        path = self.folder / "a.json"
        with self.refused("there is no", "a.json"):
            read_json(path)
        with self.refused("is a folder or a device"):
            read_json(self.folder)
        for text, words in (
            ('{"schema": "x/1"', "not valid JSON"),
            ("[1]", "a JSON list"),
            ("\xff\xfe", "not valid JSON"),
            ('{"a": ' + "[" * 100_000, "nested too deeply"),
            ('{"a": ' + "[" * 101 + "]" * 101 + "}", "nested too deeply"),
            ('{"a": ' * 1200 + "1" + "}" * 1200, "nested too deeply"),
            ('{"a": ' + "1" * 5000 + "}", "not valid JSON"),
            ('{"a": NaN}', "NaN is not a number"),
            (r'{"a": ["\ud800"]}', "control a terminal"),
            (r'{"\u001b[31m": 1}', "control a terminal"),
        ):
            path.write_text(text, encoding="latin-1")
            with self.subTest(text), self.refused(words):
                read_json(path)
        path.write_text("{" + " " * (1 << 20) + "}")
        with patch.dict(os.environ, XRESET_MAX_FILE_MB="17"):
            self.assertEqual(read_json(path), {})
        with (
            patch.dict(os.environ, XRESET_MAX_FILE_MB="16"),
            self.refused("has 1 MB, too many for JSON"),
        ):
            read_json(path)
        path.write_text('{"schema": "x/1"}')
        with self.refused("schema version 'x/1'", "reads 'x/2'"):
            read_json(path, "x/2")
        with self.refused("states schema 'x/1', expected 'y/1'"):
            read_json(path, "y/1")


class NpzTest(InFolder):
    def write(self, schema="test/1", **changes):
        write_npz(
            self.file,
            schema,
            {k: v for k, v in (ARRAYS | changes).items() if v is not None},
            config={"p": 0.5},
            inputs={"a": "ff"},
        )

    def read(self):
        return read_npz(self.file, "test/1", SCHEMA, what="a test file")

    def test_round_trip(self):
        self.write(note="hello")
        found = self.read()
        for name, value in ARRAYS.items():
            assert_array_equal(found[name], value)
            self.assertEqual(found[name].dtype, value.dtype)
        self.assertEqual(str(found["note"]), "hello")
        self.assertEqual(json.loads(str(found["meta"]))["config"], {"p": 0.5})
        self.assertEqual(json.loads(str(found["meta"]))["inputs"], {"a": "ff"})

    def test_a_configuration_may_hold_infinity(self):
        config = {"limits": {"error": np.inf, "jump": 0.1}}
        write_npz(self.file, "test/1", ARRAYS, config=config)
        found = json.loads(str(self.read()["meta"]), parse_constant=self.fail)
        self.assertEqual(found["config"], {"limits": {"error": "Infinity", "jump": 0.1}})

    def test_the_same_content_gives_the_same_bytes(self):
        self.write()
        first = self.file.read_bytes()
        with (
            patch("time.time", return_value=2e9),
            patch("time.localtime", return_value=(2033, 5, 18, 3, 33, 20, 2, 138, 0)),
        ):
            self.write()
        self.assertEqual(self.file.read_bytes(), first)
        self.write(points=ARRAYS["points"] + 1)
        self.assertNotEqual(self.file.read_bytes(), first)

    def test_objects_are_neither_written_nor_read(self):
        with self.assertRaisesRegex(TypeError, "object"):
            self.write(names=np.array([{}, {}], dtype=object))
        self.assert_only()
        np.savez(
            self.file,
            schema="test/1",
            **(ARRAYS | {"names": np.array(["a", None], dtype=object)}),
            allow_pickle=True,
        )
        with self.refused("cannot be read as a test file"):
            self.read()

    def test_damaged_files(self):
        self.write(points=np.random.default_rng(0).random((4, 3)))
        whole = self.file.read_bytes()
        flipped = bytearray(whole)
        with zipfile.ZipFile(self.file) as archive:
            info = archive.getinfo("points.npy")
        flipped[info.header_offset + 60 + info.compress_size // 2] ^= 0xFF
        for name, content in {
            "half": whole[: len(whole) // 2],
            "empty": b"",
            "text": b"hello",
            "bits": flipped,
        }.items():
            with self.subTest(name):
                self.file.write_bytes(content)
                with self.refused("cannot be read as a test file", "damaged or truncated"):
                    self.read()

    def test_a_file_that_cannot_be_opened_is_not_called_damaged(self):
        self.write()
        for number, words in ((EACCES, "Permission denied"), (EMFILE, "Too many open")):
            problem = OSError(number, os.strerror(number), str(self.file))
            for opens in ("zipfile.ZipFile", "xreset.files.storage.os.open"):
                with (
                    self.subTest(opens),
                    patch(opens, side_effect=problem),
                    self.assertRaises(FileFormatError) as caught,
                ):
                    self.read()
                self.assertIn(words, str(caught.exception))
                self.assertNotIn("damaged", str(caught.exception))

    def test_toml(self):
        file = self.folder / "file.toml"
        with self.refused("cannot be read", "Make one"):
            read_toml(file, hint=" Make one.")
        for content, words in (
            (b"schema = ", "not valid TOML"),
            (b"\xff", "not valid TOML"),
            (b"mass = " + b"9" * 5000, "not valid TOML"),
            (b"a = " + b"[" * 5000, "not valid TOML"),
            (b"[" + b".".join([b"a"] * 200) + b"]", "nested too deeply"),
            (b"schema = 'other/1'", "states schema 'other/1', expected 'test/1'"),
        ):
            with self.subTest(content[:12]):
                file.write_bytes(content)
                with self.refused(words):
                    read_toml(file, "test/1")

    def test_wrong_schema_and_version(self):
        self.write("test/2")
        with self.refused("schema version 'test/2'", "reads 'test/1'", "Make the file again"):
            self.read()
        self.write("other/1")
        with self.refused("states schema 'other/1', expected 'test/1'"):
            self.read()
        np.savez(self.file, **ARRAYS)
        with self.refused("states no schema"):
            self.read()

    def test_wrong_content_is_named(self):
        for words, change in (
            ("no array 'names'; found good, meta, offsets", {"names": None}),
            (r"'points' has shape \(4, 2\), expected \(F, 3\)", {"points": np.zeros((4, 2))}),
            (r"'points' has shape \(12,\), expected \(F, 3\)", {"points": np.zeros(12)}),
            (
                "'points' has type int64, expected floating-point",
                {"points": np.zeros((4, 3), dtype=np.int64)},
            ),
            (
                r"'good' has shape \(5,\), but F = 4 by array 'points'",
                {"good": np.ones(5, dtype=bool)},
            ),
            (
                r"'names' has shape \(3,\), but S = 2 by array 'offsets'",
                {"names": np.array(["a", "b", "c"])},
            ),
            ("'note' has type", {"note": 3.0}),
        ):
            self.write(**change)
            with self.subTest(words), self.refused("not valid as a test file", words):
                self.read()

    def test_numbers_are_native(self):
        self.write(
            offsets=np.array([0, 1, 4], dtype=">u4"), points=ARRAYS["points"].astype(np.longdouble)
        )
        found = self.read()
        self.assertEqual(
            (found["offsets"].dtype, found["points"].dtype), (np.dtype("=i8"), np.dtype("=f8"))
        )
        assert_array_equal(found["points"], ARRAYS["points"])
        self.write(offsets=np.array([0, 1, 2**63], dtype=np.uint64))
        with self.refused("more than 63 bits"):
            self.read()

    def test_what_unpacks_to_too_much_is_refused_before(self):
        self.write(points=np.zeros((400_000, 3)), good=np.zeros(400_000, dtype=bool))
        with (
            patch.dict(os.environ, XRESET_MAX_FILE_MB="9"),
            limited_memory(self, 100),
            self.refused("take 9 MB unpacked", "XRESET_MAX_FILE_MB"),
        ):
            self.read()
        with patch.dict(os.environ, XRESET_MAX_FILE_MB="10"):
            self.read()
        self.write()
        with zipfile.ZipFile(self.file) as file:
            members = {name: file.read(name) for name in file.namelist()}
        content = io.BytesIO()
        np.save(content, np.zeros(10 << 20, np.uint8))
        with zipfile.ZipFile(self.file, "w", zipfile.ZIP_DEFLATED) as file:
            for name, member in {"points": content.getvalue(), **members}.items():
                file.writestr(name, member)
        with (
            patch.dict(os.environ, XRESET_MAX_FILE_MB="9"),
            limited_memory(self, 5),
            self.refused("take 10 MB unpacked, the largest is 'points'"),
        ):
            self.read()
        self.write(offsets=np.zeros(1_500_000, dtype=np.int8))  # becomes int64
        with patch.dict(os.environ, XRESET_MAX_FILE_MB="9"), self.refused("take 11 MB unpacked"):
            self.read()
        with (
            patch.dict(os.environ, XRESET_MAX_FILE_MB="many"),
            self.assertRaisesRegex(XResetError, "expected a whole number"),
        ):
            self.read()

    def test_values_that_are_refused(self):
        schema = SCHEMA | {
            "points": Field(("F", 3), "f", within=(-100, 100)),
            "turn": Field((4,), "f", unit=True),
        }
        texts = [
            {"names": np.array(["a", text])}
            for text in ("\x1b[31m", "\x9b1m", "a\u202eb", "\ud800")
        ]
        for words, changes in (
            ("'points' holds non-finite", {"points": np.full((4, 3), np.nan)}),
            (
                "'points' holds 1e.30, expected numbers from -100 to 100",
                {"points": np.full((4, 3), 1e30)},
            ),
            ("'turn' holds quaternions that are not unit", {"turn": np.zeros(4)}),
            *(("array 'names' holds the text", change) for change in texts),
        ):
            self.write(**{"turn": np.array([1.0, 0, 0, 0])} | changes)
            with self.subTest(words), self.refused(words):
                read_npz(self.file, "test/1", schema, what="a test file")


@dataclass(frozen=True, kw_only=True)
class Inner:
    size: float
    mode: Literal["a", "b"] = "a"


@dataclass(frozen=True, kw_only=True)
class Outer:
    inner: Inner
    widths: tuple[int, ...]
    pair: tuple[float, float]
    name: str | None = None
    on: bool = False


class TypedTest(TestCase):
    GOOD = Outer(
        inner=Inner(size=1.5, mode="b"), widths=(1, 2, 3), pair=(0.0, 1.0), name="x", on=True
    )

    def test_round_trip_through_json(self):
        for value in (self.GOOD, replace(self.GOOD, name=None)):
            self.assertEqual(from_dict(Outer, json.loads(json.dumps(asdict(value)))), value)

    def test_what_is_missing_takes_its_default(self):
        """Files outlive the fields that are added after them; what has no default must be there."""
        data = asdict(TaskConfig(timestep=0.01))
        del data["timestep"], data["reset"]
        self.assertEqual(from_dict(TaskConfig, data), TaskConfig())

    def test_an_entry_may_have_its_earlier_name(self):
        class Renamed(Inner):
            RENAMED: ClassVar = {"length": "size"}

        self.assertEqual(from_dict(Renamed, {"length": 1.5}), Renamed(size=1.5))
        with self.assertRaisesRegex(FileFormatError, "unknown: length"):
            from_dict(Renamed, {"length": 1.5, "size": 1.5})

    def test_only_a_newer_version_is_named(self):
        for version, is_newer in (
            ("9.9+g1a2b3c4d5e6f", True),
            (f"{__version__}.1", True),
            (f"{__version__}+g1a2b3c4d5e6f", False),
            ("0.1.0", False),
            (None, False),
            (9, False),
        ):
            with self.subTest(version), self.assertRaises(FileFormatError) as caught:
                from_dict(Inner, {"size": 1.0, "sise": 2.0}, "a.json", version)
            expected = "a.json has wrong entries (unknown: sise (size?); known: size, mode)."
            if is_newer:
                expected += (
                    f"\nIt was written by xreset {version!r}, and this is xreset {__version__}. "
                    "Update xreset, or make it again."
                )
            self.assertEqual(str(caught.exception), expected)

    def test_refusals_name_the_entry(self):
        good = asdict(self.GOOD)
        for words, data in (
            ("unknown: extra", good | {"extra": 1}),
            ("missing: pair", {k: v for k, v in good.items() if k != "pair"}),
            (
                "configuration.inner has wrong entries.*missing: size",
                good | {"inner": {"mode": "b"}},
            ),
            (
                "inner.mode is 'c', expected one of 'a', 'b'",
                good | {"inner": {"size": 1.0, "mode": "c"}},
            ),
            ("pair has 3 entries, expected 2", good | {"pair": [1.0, 2.0, 3.0]}),
            ("on is 1, expected True or False", good | {"on": 1}),
            (r"widths\[0\] is True, expected a whole number", good | {"widths": [True]}),
            (r"widths\[1\] is 2.5, expected a whole number", good | {"widths": [1, 2.5]}),
            ("configuration is 3, expected an object", 3),
            (
                r"widths\[0\] is a number of thousands of digits, expected a whole number",
                good | {"widths": [2**15000]},
            ),
            (
                r"pair is .{1,200}, expected a list",
                good | {"pair": {str(i): ["x" * 1000] * 1000 for i in range(1000)}},
            ),
        ):
            with refuses(self, words, FileFormatError):
                from_dict(Outer, data)

    def test_a_message_about_many_entries_is_short(self):
        good = asdict(self.GOOD)
        for words, data in (
            (r"\nand 19980 more", good | {"widths": ["x"] * 20_000}),
            ("and 19980 more", good | {f"{i}{'x' * 5000}": 1 for i in range(20_000)}),
        ):
            with self.subTest(words), self.assertRaisesRegex(FileFormatError, words) as caught:
                from_dict(Outer, data)
            self.assertLess(len(str(caught.exception)), 20_000)


class BankTest(InFolder):
    def setUp(self):
        super().setUp()
        self.robot = toy_hand_arm(self.folder)

    def write(self, **changes):
        write_bank(
            self.file,
            toy_bank(self.robot, **changes),
            config={"steps": 8},
            inputs={"retargeted": "ab"},
        )

    def test_another_record_is_not_written(self):
        """The file could not be read."""
        self.write()
        content = self.file.read_bytes()
        bank = toy_bank(self.robot)
        for write, name in (
            (write_demos, "Demos"), (write_retargeted, "Retargeted"), (write_goals, "GoalSet"),
        ):  # fmt: skip
            words = f"Found ResetBank.*, expected {name}. Nothing was written"
            with refuses(self, words, XResetError, name):
                write(self.file, bank)
        with self.assertRaisesRegex(XResetError, "expected ResetBank. Nothing"):
            write_bank(self.file, content)
        self.assertEqual(self.file.read_bytes(), content)

    def test_a_bank_that_could_not_be_read_is_not_written(self):
        bank = toy_bank(self.robot)
        for words, changes in (
            (
                "'object_pos' holds .*, expected numbers from -100 to 100. Units are metres",
                {"object_pos": bank.object_pos + 1000},
            ),
            ("'object_pos' has shape .* but L = 5", {"joint_pos": bank.joint_pos[:5]}),
            ("'post_contact' has type int", {"post_contact": bank.post_contact.astype(int)}),
            ("goal_pos is None, expected an array", {"goal_pos": None}),
            ("goal_pos is .*, expected an array. Nothing", {"goal_pos": [[0.0], [0.0, 1.0]]}),
        ):
            with refuses(self, words, XResetError):
                write_bank(self.file, replace(bank, **changes))
        with self.assertRaisesRegex(XResetError, "config .* PosixPath .* Use numbers, texts"):
            write_bank(self.file, bank, config={"demos": self.file})
        self.assertFalse(self.file.exists())

    def test_one_line_says_what_a_bank_is(self):
        words = f"ResetBank({self.robot.name!r}, 6 states, 3 sequences, 2 objects)"
        self.assertEqual(repr(toy_bank(self.robot)), words)

    def test_round_trip(self):
        """What a bank does not have is not in its file."""
        optional = {"joint_target": np.zeros((6, 7)), "frame_part": np.full(6, 0.5)}
        optional["transferred"] = np.arange(6) > 3
        for changes in ({}, {"rejected_reason": np.zeros(3, dtype=np.int32)}, optional):
            self.write(**changes)
            with np.load(self.file) as file:
                self.assertEqual(
                    optional.keys() & set(file.files), optional.keys() & changes.keys()
                )
            found = read_bank(self.file, robot=self.robot)
            made = toy_bank(self.robot, **changes)
            for name, value in vars(made).items():
                self.assertEqual(type(getattr(found, name)), type(value), name)
                assert_array_equal(getattr(found, name), value, name)

    def test_some_of_the_states_and_none(self):
        bank = toy_bank(self.robot)
        chosen = bank.with_states(np.array([True, False, False, False, True, False]))
        assert_array_equal(chosen.sequence_index, [0, 2])
        assert_array_equal(chosen.joint_pos, bank.joint_pos[[0, 4]])
        write_bank(self.file, bank.with_states(np.zeros(6, dtype=bool)))
        found = read_bank(self.file, robot=self.robot)
        self.assertEqual(
            (found.num_states, len(found.goal_pos)), (0, 3), "starts and goals are left"
        )

    def test_a_bank_of_the_robot_before_it_was_changed(self):
        self.write()
        self.robot.urdf.write_text(
            self.robot.urdf.read_text().replace('mass value="0.1"', 'mass value="0.2"')
        )
        with self.refused("another version of 'toy'", "Make it again"):
            read_bank(self.file, robot=self.robot)

    def test_a_bank_of_other_joints_names_the_first(self):
        names = [*self.robot.joint_names]
        for index, found, here, joints in (
            (1, "'finger'", f"'{names[1]}'", (names[0], "finger", *names[2:])),
            (6, "missing", f"'{names[6]}'", names[:6]),
            (7, "'eighth'", "missing", (*names, "eighth")),
        ):
            self.write()
            bank = replace(read_bank(self.file), joint_names=tuple(joints))
            words = f"version of 'toy': joint_names\\[{index}\\] is {found}, here {here}"
            with self.refused(words, "Make it again"):
                check_robot(self.file, "reset bank", bank, self.robot)

    def test_bad_content(self):
        bank = toy_bank(self.robot)

        def with_value(name, index, value):
            array = getattr(bank, name).copy()
            array[index] = value
            return {name: array}

        for words, changes in (
            ("'sequence_index' points beyond 'sequence_name'", with_value("sequence_index", 1, 3)),
            ("another object than its sequence", with_value("object_name", 0, SPAM)),
            (
                f"does not list \\['{SPAM}'\\]",
                {"object_names": (SOUP,), "object_sources": ("stand-in",)},
            ),
            (
                "'rejected_sequence_index' points beyond 'sequence_name'",
                with_value("rejected_sequence_index", 0, 7),
            ),
            ("'rejected_reason' points beyond 'reason_names'", with_value("rejected_reason", 0, 2)),
            ("but J = 7", {"joint_pos": np.zeros((6, 8), dtype=np.float32)}),
        ):
            arrays = arrays_of(ResetBank, toy_bank(self.robot, **changes))
            write_npz(self.file, "xreset-resets/1", arrays)
            with self.subTest(words), self.refused("not valid as a reset bank", words):
                read_bank(self.file, robot=self.robot)
            with self.assertRaisesRegex(XResetError, f"was not written, .*{words}"):
                self.write(**changes)
