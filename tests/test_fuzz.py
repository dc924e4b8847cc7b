"""Every reader, with damaged files: a small budget here, a large one by ``ci/fuzz``."""

from __future__ import annotations

import unittest
from importlib.util import find_spec

if not find_spec("hypothesis"):
    raise unittest.SkipTest("hypothesis is not installed (pip install 'xreset[dev]')")

from hypothesis import HealthCheck, given, settings

from tests.fuzzing import Reader, damages, outcome, readers
from tests.fuzzing_commands import outcome_of_command

EXAMPLES = 40


class EveryReader(unittest.TestCase):
    def test_a_whole_file_is_read(self):
        with readers() as found:
            for name, reader in found.items():
                with self.subTest(name):
                    self.assertEqual(outcome(reader, reader.file.read_bytes()), "read")

    def test_a_damaged_file_is_refused_in_one_sentence_or_its_content_is_sound(self):
        with readers() as found:
            for name, reader in found.items():
                with self.subTest(name):
                    self.fuzz(reader)

    def test_what_fuzzing_has_found(self):
        cases = (
            ("DexYCB calibration", lambda whole: whole.replace(b"1.0", b"1" + b"0" * 400, 1)),
            ("mesh .obj", lambda whole: whole.replace(b" -0.02000000", b" ", 3)),
            ("mesh .ply", lambda whole: whole[:-4] + b"\xff\xff\x01\x00"),
            (
                "run.json, compared",
                lambda whole: whole.replace(b'"resets": "b.npz"', b'"resets": 5'),
            ),
            (
                "run.json, compared",
                lambda whole: whole.replace(b'"contract": {', b'"contract": 0.5, "x": {'),
            ),
            ("study", lambda whole: whole + b"x = " + b"1" * 5000),
            ("URDF, imported", lambda whole: whole.replace(b'"0.08 0.08 0.02"', b'"0.08 0.08"')),
            (
                "URDF, imported",
                lambda whole: whole.replace(b'multiplier="0.8"', b'multiplier="x"', 1),
            ),
            (
                "URDF, imported",
                lambda whole: whole.replace(b'multiplier="0.8"', b'multiplier="inf"', 1),
            ),
            ("URDF, imported", lambda whole: b'<?xml version="1.0" encoding="utf-7"?>' + whole),
            ("MJCF, imported", lambda whole: whole.replace(b'axis="0 1 0"', b'axis="0 nan 0"', 1)),
            ("MJCF, imported", lambda whole: whole.replace(b'mass="0.4"', b'mass="inf"')),
        )
        with readers() as found:
            for name, damage in cases:
                whole = found[name].file.read_bytes()
                with self.subTest(name):
                    self.assertNotEqual(damage(whole), whole)
                    self.assertEqual(outcome(found[name], damage(whole)), "refused")

    def fuzz(self, reader: Reader) -> None:
        whole = reader.file.read_bytes()

        @settings(
            max_examples=EXAMPLES // 8 if reader.slow else EXAMPLES,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(damages(reader.kind))
        def run(damage):
            outcome(reader, damage(whole))

        run()


class CommandLines(unittest.TestCase):
    def test_junk_is_refused_in_one_short_message(self):
        for line in (
            ("eval", "x", "--demos", "y", "--device", "1" * 5000),
            ("engines", "page", "--from", "x" * 5000),
            ("demos", "mirror", "demos.npz", "--out", "null.npz"),
            ("demos", "merge", "demos.npz", "--out", "null.npz"),
            ("demos", "info", "\udcff\n.npz"),
        ):
            with self.subTest(line[:4]):
                self.assertEqual(outcome_of_command(list(line)), "refused")


if __name__ == "__main__":
    unittest.main()
