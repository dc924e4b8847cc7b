"""Every reader, with damaged files: a small budget here, a large one by ``ci/fuzz``."""

import re
from importlib import import_module
from pathlib import Path
from unittest import TestCase

import tyro
from hypothesis import HealthCheck, given, settings

from ci import kills
from tests.damage import damages
from tests.fuzzing import outcome, readers
from tests.fuzzing_commands import outcome_of_command
from xreset.cli._options import checked

EXAMPLES = 12


class EveryReader(TestCase):
    @classmethod
    def setUpClass(cls):
        cls.readers = cls.enterClassContext(readers())

    def test_a_whole_file_is_read(self):
        for name, reader in self.readers.items():
            with self.subTest(name):
                self.assertEqual(outcome(reader, reader.file.read_bytes()), "read")

    def test_a_damaged_file_is_refused_in_one_sentence_or_its_content_is_sound(self):
        for name, reader in self.readers.items():
            with self.subTest(name):
                self.fuzz(reader)

    def test_what_fuzzing_has_found(self):
        run = "run.json, compared"
        encoding = b'<?xml version="1.0" encoding="utf-7"?>'
        for name, old, new in (
            ("DexYCB calibration", b"1.0", b"1" + b"0" * 400),
            ("mesh .obj", rb"(?s) -0.02000000(.*?) -0.02000000(.*?) -0.02000000", rb" \1 \2 "),
            ("mesh .ply", rb"(?s)....\Z", b"\xff\xff\x01\x00"),
            (run, b'"resets": "b.npz"', b'"resets": 5'),
            (run, b'"contract": {', b'"contract": 0.5, "x": {'),
            ("study", rb"\Z", b"x = " + b"1" * 5000),
            ("URDF, imported", b'"0.08 0.08 0.02"', b'"0.08 0.08"'),
            ("URDF, imported", b'multiplier="0.8"', b'multiplier="x"'),
            ("URDF, imported", b'multiplier="0.8"', b'multiplier="inf"'),
            ("URDF, imported", rb"\A", encoding),
            ("MJCF, imported", b'axis="0 1 0"', b'axis="0 nan 0"'),
            ("MJCF, imported", b'mass="0.4"', b'mass="inf"'),
        ):
            reader = self.readers[name]
            whole = reader.file.read_bytes()
            damaged, count = re.subn(old, new, whole, count=1)
            with self.subTest(name, new=new[:20]):
                self.assertEqual(count, 1)
                self.assertEqual(outcome(reader, damaged), "refused")

    def fuzz(self, reader):
        whole = reader.file.read_bytes()

        @settings(
            max_examples=2 if reader.slow else EXAMPLES,
            deadline=None,
            derandomize=True,
            database=None,
            suppress_health_check=list(HealthCheck),
        )
        @given(damages(reader.kind))
        def run(damage):
            outcome(reader, damage(whole))

        run()


class CommandLines(TestCase):
    def test_junk_is_refused_in_one_short_message(self):
        for line in (
            ("eval", "x", "--demos", "y", "--device", "1" * 5000),
            ("engines", "page", "--from", "x" * 5000),
            ("demos", "select", "demos.npz", "--mirror", "--out", "null.npz"),
            ("demos", "select", "demos.npz", "--out", "null.npz"),
            ("demos", "select", "\udcff\n.npz"),
        ):
            with self.subTest(line[:4]):
                self.assertEqual(outcome_of_command(list(line)), "refused")

    def test_the_lines_of_the_kills_are_commands(self):
        """``ci/kills`` runs for an hour; a line that the command no longer takes is seen here."""
        for killed in kills.commands(Path("none")):
            name, *words = killed.arguments.split()
            if "--teacher" in words:  # whose observations have options
                words[words.index("--teacher") + 1] = "many-objects"
            module = import_module(f"xreset.cli.{name}")
            command = (
                module.command_for(words) if hasattr(module, "command_for") else module.COMMAND
            )
            if isinstance(command, dict):
                command = command[words.pop(0)]
            with self.subTest(killed.name):
                tyro.extras.get_parser(checked(command)).parse_args(words)
