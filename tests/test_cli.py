"""The command line: quick to start, and clear when it is used wrongly."""

import io
import json
import os
import re
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from importlib import import_module
from pathlib import Path
from typing import Annotated
from unittest import TestCase
from unittest.mock import Mock, patch

import numpy as np
import tyro

from tests.command import calls_of, refused, started, succeeds
from tests.command import xreset as run
from tests.data import InFolder
from xreset import synthesize, write_demos
from xreset.backends import pybullet
from xreset.cameras.config import WRIST
from xreset.cli import COMMANDS, _terminal, _verbs
from xreset.cli._options import RULES, checked
from xreset.cli._verbs import verb
from xreset.errors import XResetError
from xreset.files.checks import Option, Output, PositiveInt
from xreset.files.progress import unseen
from xreset.files.records import write_npz
from xreset.files.storage import claim_folder
from xreset.learning import verbs

HEAVY = {
    "torch",
    "warp",
    "mujoco",
    "mujoco_warp",
    "pybullet",
    "sapien",
    "matplotlib",
    "trimesh",
    "scipy",
    "rsl_rl",
}


def modules_after(code):
    """Top-level modules that are loaded after running some code in a new interpreter."""
    code += "\nimport sys, json; print('\\n' + json.dumps(sorted({m.split('.')[0] for m in sys.modules})))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(json.loads(done.stdout.strip().splitlines()[-1]))


def commands():
    """Words of every command, and of every group of commands."""
    found = []
    for name in COMMANDS:
        found.append([name])
        group = getattr(import_module(f"xreset.cli.{name}"), "COMMAND", None)
        if isinstance(group, dict):
            found += [[name, *verb.split()] for verb in group]
    return found


class StartedTest(TestCase):
    def test_no_test_waits_for_ever_for_a_program(self):
        """Nor for the program's child, which has its output open, too."""
        sleeping = "import subprocess; subprocess.run(['sleep', '60'])"
        began = time.monotonic()
        with (
            self.assertRaisesRegex(AssertionError, r"sleep.* did not end within 0\.5 s"),
            started(sys.executable, "-c", sleeping, seconds=0.5) as process,
        ):
            process.stdout.read()
        self.assertLess(time.monotonic() - began, 30)


class LightnessTest(TestCase):
    def test_import_and_help_load_nothing_heavy(self):
        code = "import xreset; from xreset.cli import main; main(['--help'])"
        self.assertFalse(modules_after(code) & (HEAVY | {"tyro", "numpy"}))

    def test_help_of_every_command_and_a_misspelt_property_load_nothing_heavy(self):
        tried = [([*words, "--help"], 0) for words in commands()]
        for option in ("--faults", "--demos x.npz"):
            tried.append((f"stress many-objects {option} --property pose-dely".split(), 1))
        code = (
            "from xreset.cli import main\n"
            f"for words, status in {tried}:\n"
            "  try: main(words)\n"
            "  except SystemExit as end: assert (end.code or 0) == status, words\n"
        )
        self.assertFalse(modules_after(code) & HEAVY)


class UsageTest(TestCase):
    def test_version(self):
        from xreset.files.storage import code_version

        self.assertEqual(run("--version"), (0, f"xreset {code_version()}\n", ""))

    def test_errors_are_found_before_work_begins(self):
        for words, arguments in (
            (r"Unknown command 'trian'[\s\S]* train ", "trian"),
            (
                r"^xreset resets: there is no /nowhere/moves\.npz",
                "resets /nowhere/moves.npz --out /nowhere/bank.npz",
            ),
            (
                r"^xreset retarget: there is no demos\.npz \(an archive of xreset demos\)",
                "retarget demos.npz --robot openarm --out /nowhere/moves.npz",
            ),
            (r"^xreset demos: there is no a\.npz", "demos select a.npz b.npz"),
            (
                r"Unknown engine 'bulet'\. Choose from: .*pybullet",
                "engines check --engine bulet",
            ),
            (
                r"--seed is -1, expected a whole number from 0 to 4294967295",
                "demos synth --out x.npz --seed -1",
            ),
            (
                r"--port is 87990, expected a whole number from 0 to 65535",
                "view none.npz --port 87990",
            ),
            (
                r"episode_seconds is -1.0, expected a number from 0.0167, which is one control step",
                "eval zero --robot openarm --demos none.npz --episode-seconds -1",
            ),
            (
                r"--fps is 0\.0, expected a number from 0\.1 to 10000",
                "demos import keypoints a --order mano --units m --coordinates table --out x.npz --fps 0",
            ),
            (r"--minutes is nan, expected a number above 0", "train --out x --minutes nan"),
            (
                r"reach\.width is nan, expected a finite number or a word",
                "train --out x --config.task.reward.terms.reach.width nan",
            ),
            (
                r"--objects is given more than once. Give all of its values together: --objects A B",
                "demos synth --out x.npz --objects soup --objects banana",
            ),
            (
                r"--config.model.critic-mlp is given more than once",
                "train --out x --config.model.critic-mlp 8 --config.model.critic_mlp=4",
            ),
            (r"Unknown device 'quantum'. Expected cpu, cuda or", "train --out x --device quantum"),
            (r"(File name too long|there is no)", "demos select " + "x" * 300),
            (r"there is nothing to report\. Give run folders", "report --robot openarm"),
            (
                r"--out is 'x\.xyz', expected a name that ends in \.png or \.mp4",
                "view d.npz --out x.xyz",
            ),
            (r"--out is 'x', expected a name that ends in \.json or \.md", "engines check --out x"),
            (r"--out is 'x\.md', expected", "engines compare x.npz --out x.md"),
            (r"--picture is 'x\.jpg', expected", "robots check openarm --picture x.jpg"),
            (
                r"--out is '\.', expected a file, not a folder",
                "retarget d.npz --robot openarm --out .",
            ),
            (
                r"cannot write /dev/null/x\.npz: /dev/null is a file, expected a folder",
                "goals nothing --robot openarm --out /dev/null/x.npz",
            ),
            (r"/dev/null/run: /dev/null is a file", "train --resets d.npz --out /dev/null/run"),
            (
                rf"{__file__} is a file, not a folder of meshes. Expected NAME",
                f"objects --meshes {__file__}",
            ),
            (
                rf"{__file__} is a file. Expected a robot's name, or the folder of its robot",
                f"goals soup --out x.npz --robot {__file__}",
            ),
            (
                r"--out is given more than once. Give the command once for each file",
                "view x.npz --out x.png --out x.mp4",
            ),
            (r"--out is empty\. Is a variable of the shell not set", "run d.npz --out="),
            (r"--host is empty\.", "view d.npz --host ''"),
            (r"An argument is empty\.", "policies ''"),
            (
                r"--objects has no value\. Give one or several, or omit it",
                "demos select d.npz --objects",
            ),
            (
                r"--scale is inf, expected a finite number",
                "objects import x.stl --out o --scale inf",
            ),
            (r"Give one archive, or several", "demos select"),
            (
                r"--out is e\.npz, which is --rest as well",
                "demos select d.npz --share 0.5 --out e.npz --rest ./e.npz",
            ),
        ):
            with self.subTest(arguments[:80]):
                code, out, err = run(arguments)
                self.assertEqual(code, 2 if arguments == "trian" else 1)
                self.assertRegex(err + out, words)
                self.assertNotIn("Traceback", err)

    def test_an_option_of_a_group_is_named_as_it_was_given(self):
        _, out, err = run("train --resets x.npz --out x --config.ppo.sequence-length 7")
        self.assertIn("config.ppo: sequence-length is 7", out + err)

    def test_a_word_in_place_of_a_number_is_named(self):
        for flag, words in (
            ("--iterations 1e3", "found '1e3', expected a whole number"),
            ("--minutes ten", "found 'ten', expected a number"),
        ):
            self.assertIn(words, "".join(run("train --out x", flag)[1:]))

    def test_earlier_names_of_flags_are_taken(self):
        for words, told in (
            ("engines check --backend bulet", ["--backend is now --engine"]),
            ("engines compare none --only mug", ["--only is now --object"]),
            ("goals --robot none --out g.npz --draw.seed 1", ["--draw.seed is now --seed", "none"]),
            ("objects import none --png x.png", ["--png is now --picture", "no none"]),
            ("view none --mp4=x.mp4", ["--mp4 is now --out", "none"]),
            ("engines check --engine bulet --page x.md", ["--page is now --out", "bulet"]),
            (
                "train --resume --out none",
                [
                    "--resume is gone: a training continues with --out RUN alone",
                    "no run to continue",
                ],
            ),
            (
                "engines check --engine bulet --verbose",
                ["--verbose is gone: checks that --check names", "bulet"],
            ),
            ("objects list --objects=none", ["--objects is now --meshes", "no folder 'none'"]),
            ("demos synth --out x.npz --objects nothing", ["Unknown object 'nothing'"]),
        ):
            with self.subTest(words):
                code, _, err = run(words)
                self.assertEqual(code, 1)
                self.assertEqual(len(err.splitlines()), max(2, len(told)) - ("synth" in words))
                for each in told:
                    self.assertIn(each, err)

    def test_flags_and_commands_that_are_gone_say_what_is_done_now(self):
        for words, told in (
            (
                "report a b --apart",
                "--apart is gone: runs that differ only in their seed share a row",
            ),
            ("report a --curve task/success", "--curve is gone: the page has success"),
            ("objects import a.stl --out b --density 900", "--density is gone: write it into NAME"),
            ("eval zero --demos none --settle", "--settle is gone: episodes begin as recorded"),
            ("resets none --out b.npz --squeeze.weight 0", "press with --squeeze.force and the"),
            ("resets none --out b.npz --squeeze.reach=0.1", "--squeeze.reach is gone: fingers"),
            ("demos synth --out a.npz --fps 10", "synth --fps is gone: demonstrations have 30"),
            ("select runs/soup", "select is gone: evaluate checkpoints"),
            (
                "engines attribute zero --towards sapien",
                "engines attribute is gone: xreset engines",
            ),
            ("engines trace none", "engines trace is gone: xreset engines compare"),
        ):
            with self.subTest(words):
                code, _, err = run(words)
                self.assertEqual(code, 2)
                self.assertIn(told, err)

    def test_help_of_training_is_short_and_fits_a_terminal(self):
        with patch.dict(os.environ, COLUMNS="80"):
            words = run("train --help")[1]
            parts = run("train --help-config")[1]
            reset = run("train --recipe paper --help-config task.reset")[1]
            terms = run("train --recipe any_object --help-config task.observation")[1]
        self.assertLessEqual(len(words.splitlines()), 80)
        for text in (words, reset):
            self.assertLessEqual(max(map(len, text.splitlines())), 80)
        self.assertNotIn("{None}", words + run("robots import --help")[1])
        self.assertNotIn("--config.task", words)
        for name in ("task.randomization.push", "ppo", "model"):
            self.assertIn(f" {name} ", parts)
        self.assertRegex(reset, r"--config.task.reset.random-gravity[\s\S]*\(default: True\)")
        self.assertNotIn("--config.task.reward", reset)
        shown = " ".join(terms.replace("│", " ").split())
        self.assertIn("object_pos.noise=0.003 goal_pos rotation_to_goal.noise=0.02", shown)
        self.assertNotIn("fixed", terms)
        refusal = run("train --help-config tusk")[2]
        self.assertIn("no part 'tusk'. Choose from: all, task, task.action", refusal)

    def test_help_of_every_command_fits_a_terminal(self):
        with patch.dict(os.environ, COLUMNS="80"):
            for words in commands():
                lines = run(*words, "--help")[1].splitlines()
                # the first line of a group lists its verbs
                self.assertLessEqual(max(map(len, lines[1:])), 80, words)

    def test_help_shows_a_switch_that_is_off_without_its_opposite(self):
        shown = set()
        for words in (*commands(), ["train", "--help-config task.reset"]):
            text = run(*words, "--help")[1]
            shown |= set(re.findall(r"--\S*no-[a-z-]+", text))
            self.assertNotRegex(text, r"\(default:[\s│]+(False)?\)")
        self.assertEqual(shown, {"--no-video"}, "films are drawn unless the user says no")
        self.assertIn("no none.npz", refused("demos select none.npz --no-mirror"), "still taken")

    def test_a_student_has_the_task_of_its_teacher_and_no_recipe(self):
        student = "train --teacher many-objects --out x --resets x.npz"
        for words, told in (
            ("--recipe paper", "follows from its teacher. Omit recipe"),
            ("--weights y", "Omit weights"),
        ):
            self.assertIn(told, refused(student, words))
        with calls_of(verbs, "train") as calls:
            for flag in ("--config.task.vision.width", "--vision.width"):
                run(student, "--camera wrist", flag, "32")
                vision = calls[-1]["config"].task.vision
                self.assertEqual((vision.width, vision.cameras), (32, (WRIST,)))
            run("distill", *student.split()[2:])
        given = (calls[-1]["teacher"], calls[-1]["bank"])
        self.assertEqual(given, (Path("many-objects"), (Path("x.npz"),)))

    def test_a_wrong_value_of_a_verb_names_the_option_and_the_help(self):
        code, out, err = run("robots place openarm --demos d.npz --search.clear -1")
        self.assertEqual(code, 2)
        self.assertRegex(
            err + out, r"parsing search: clear is -1.0, expected[\s\S]*xreset robots place --help"
        )

    def test_a_gpu_that_is_not_there(self):
        """It is also not there if only its driver knows it."""
        arguments = "resets none.npz --out x.npz --engine mujoco-warp --device cuda"
        for can_be_used, count in ((True, 0), (False, 1)):
            with (
                patch("torch.cuda.device_count", return_value=count),
                patch("torch.cuda.is_available", return_value=can_be_used),
            ):
                err = refused(arguments)
            self.assertIn("The device is cuda, but torch can use 0 GPUs", err)

    def test_what_reaches_the_terminal_is_text(self):
        err = refused("eval", "\x1b[31mred\x1b]0;title\x07", "--demos none.npz")
        self.assertIn("red", err)
        self.assertNotIn("\x1b", err)

    def test_a_table_that_is_too_wide_for_a_terminal_is_a_list(self):
        rows = [("object", "mass, kg"), ("tomato_soup_can", "0.349"), ("=[red]", "")]
        for width, expected in (
            (
                20,
                [
                    "object: tomato_soup_can",
                    "mass, kg: 0.349",
                    "",
                    "object: =[red]",
                    "mass, kg: ",
                    "",
                    "two objects",
                ],
            ),
            (40, None),
        ):
            narrow = _terminal.Console(file=io.StringIO(), width=width)
            with patch.object(_terminal, "console", narrow):
                _terminal.show_table(rows, caption="two objects")
            lines = narrow.file.getvalue().splitlines()
            if expected is None:
                self.assertIn("tomato_soup_can", lines[3])
            else:
                self.assertEqual(lines, expected)

    def test_a_message_repeats_no_endless_name(self):
        self.assertEqual(str(XResetError("a joint is missing")), "a joint is missing")
        said = str(XResetError(f"Unknown joint '{'j' * 50_000}'. Choose from: a, b."))
        self.assertRegex(said, r"^Unknown joint 'j+\.\.\.j+'\. Choose from: a, b\.$")
        self.assertLess(len(said), 300)
        self.assertLess(len(str(XResetError("a b " * 50_000))), 10_000)

    def test_without_a_terminal_progress_is_a_line_a_minute(self):
        with (
            patch.object(_terminal, "monotonic", iter([0, 10, 61, 70, 130]).__next__),
            redirect_stderr(io.StringIO()) as err,
            _terminal.Progress(_terminal.Console(file=io.StringIO())) as bar,
        ):
            count = bar.count("sequences")
            for done in range(1, 5):
                count(done, 8)
        self.assertEqual(err.getvalue(), "sequences: 25 %\nsequences: 50 %\n")

    def test_a_command_that_may_show_a_page_has_a_bar_only_when_it_draws(self):
        bar = _terminal.Progress(_terminal.Console(file=io.StringIO()))
        shown = []

        def show(*, say: Callable[[str], None], progress: Callable[[str, float, int], None]):
            shown.append(bar.live.is_started)
            progress("drawing", 1, 2)
            shown.append(bar.live.is_started)

        with patch.object(_verbs, "Progress", lambda: bar):
            _verbs.verb(show)()
        self.assertEqual([*shown, bar.live.is_started], [False, True, False])

    def test_training_without_its_packages_says_what_to_install(self):
        import_module("xreset.learning.train")  # what others need of it stays imported
        package = vars(sys.modules["xreset.learning"])
        with patch.dict(sys.modules, {"rsl_rl.models": None}), patch.dict(package):
            for name in ("train", "export", "model"):  # as where nothing is imported yet
                sys.modules.pop(f"xreset.learning.{name}", None)
                package.pop(name, None)
            said = refused("train --out x")
        self.assertRegex(said, r"^xreset train: rsl-rl-lib cannot .* pip install 'xreset\[train\]'")

    def test_a_missing_engine_is_named_with_the_command_that_installs_it(self):
        here = ".".join(map(str, sys.version_info[:2]))
        self.enterContext(patch.dict(sys.modules, pybullet=None))
        self.enterContext(patch.object(pybullet, "_engine", pybullet._engine.__wrapped__))
        self.enterContext(patch("xreset.cli.engines.backend_names", return_value=["pybullet"]))
        for newest, words in (
            ((3, 99), r"pip install 'xreset\[pybullet\]'"),
            ((3, 9), rf"PyBullet has no wheel for Python {here}\. Use Python 3\.9, or another"),
        ):
            with patch.object(pybullet, "_NEWEST_PYTHON", newest):
                said = re.sub(r"[\s│]+", " ", succeeds("engines list"))
                self.assertRegex(said, f"pybullet - - no: .*{words}")

    def test_naming_engines_replaces_the_default(self):
        for given, expected in (
            ((), "mujoco"),
            (("sapien", "pybullet"), ("sapien", "pybullet")),
        ):
            argv = ["eval", "zero", "--robot", "openarm", "--demos", "x.npz"]
            for name in given:
                argv += ["--engine", name]
            chosen = "xreset.eval.rollout.chosen_engines"
            with patch(chosen, side_effect=KeyboardInterrupt) as engines:
                self.assertEqual(run(*argv)[0], 130)
            self.assertEqual(engines.call_args.args[0], expected)


def sample(
    source: str | Path | Mock,
    names: Annotated[str | Sequence[str], Option("name")] = "everything",
    *,
    thing: Mock | None = None,
    count: PositiveInt = 1,
    out: Output | None = None,
    progress: Callable[[float, int], None] = unseen,
) -> str:
    """Do something.

    Args:
        source: a file, as for :func:`~xreset.somewhere.load`; or
            a name.
        names: what to do; ``all`` by default
        thing: an object of the library.
        count: how often.
        out: file to write.

    Raises:
        XResetError: never.
    """
    progress(1, 2)
    return f"{source!r} {names!r} {count} {out!r} {thing}"


class VerbTest(TestCase):
    def ran(self, *words):
        shown = []
        command = verb(sample, lambda found, options: shown.append((found, options["out"])))
        tyro.cli(checked(command), args=list(map(str, words)), registry=RULES)
        return shown[0]

    def test_the_signature_has_the_options_and_the_defaults(self):
        file = Path("d.npz")
        self.assertEqual(self.ran("d.npz"), (f"{file!r} 'everything' 1 None None", None))
        words = ("d.npz", "--name", "a", "--name", "b", "--count", 2, "--out", "o")
        out = Path("o")
        self.assertEqual(self.ran(*words), (f"{file!r} ('a', 'b') 2 {out!r} None", out))

    def test_the_docstring_is_the_help(self):
        command = verb(sample)
        entries = (command.__doc__ or "").split("Args:\n")[1].splitlines()
        self.assertEqual(entries[0], "    source: A file, as for load; or")
        self.assertEqual(entries[2], "    name: What to do; `all` by default.")
        self.assertEqual(len(entries), 5, "no thing, no errors")


class OutputTest(InFolder):
    def test_an_output_replaces_no_file_of_another_kind(self):
        demos = self.folder / "demos.npz"
        write_demos(demos, synthesize(["soup"], 1, fps=10))
        motion = self.folder / "motion.npz"
        write_npz(motion, "xreset-retargeted/1", {})
        mine = self.folder / "mine.npz"
        np.savez(mine, my_own=1)
        text = self.folder / "package.json"
        text.write_text('{"name": "mine"}')
        site = self.folder / "site"
        site.mkdir()
        page = site / "index.html"
        page.write_text("<title>My own</title>")
        readme = self.folder / "README.md"
        readme.write_text("# My own")
        another = r"of another kind \('xreset-{}/1'\)\. Nothing was overwritten; choose"
        own = "not one of xreset's"
        for command, out, words in (
            ("demos synth --objects soup", motion, another.format("retargeted")),
            ("demos import dexycb none", mine, own),
            ("demos import keypoints none --order mano --units m --coordinates table", text, own),
            ("demos select none.npz", mine, own),
            ("demos select none.npz --out new.npz --rest", motion, another.format("retargeted")),
            ("retarget none.npz --robot openarm", demos, another.format("demos")),
            ("resets none.npz", motion, another.format("retargeted")),
            ("goals soup --robot openarm", demos, another.format("demos")),
            ("engines check", text, own),
            ("engines check", readme, own),
            ("engines compare none.npz", text, own),
            ("export episodes none", demos, another.format("demos")),
        ):
            with self.subTest(command):
                before = out.read_bytes()
                flag = "" if command.endswith("--rest") else "--out"
                self.assertRegex(refused(command, flag, out), words)
                self.assertEqual(out.read_bytes(), before)
        self.assertRegex(refused("report none --out", site), own)
        self.assertEqual(page.read_text(), "<title>My own</title>")
        empty = self.folder / "empty.npz"
        empty.touch()
        for out in (empty, empty, demos):  # of its own kind
            succeeds("demos synth --objects soup --per-object 1 --out", out)

    def test_an_input_is_not_overwritten_and_a_name_is_no_input(self):
        file = self.folder / "d.npz"
        file.touch()
        words = f"--out is {file}, which the command reads. Nothing was overwritten"
        for command in (f"retarget {file} --robot openarm", f"demos select c.npz {file}"):
            self.assertIn(words, refused(command, "--out", file))
        said = refused("eval ik --robot openarm --demos none.npz --out ik")
        self.assertIn("there is no none.npz", said)

    def test_a_read_only_folder_is_refused_at_once(self):
        with patch("xreset.files.checks.os.access", return_value=False):
            said = refused("retarget none --robot openarm --out", self.folder / "new/motion.npz")
        self.assertIn(f"the folder {self.folder} is read-only. Choose another place", said)

    def test_a_read_only_folder_that_no_option_names_is_refused_before_the_work(self):
        with (
            patch("xreset.files.storage.os.access", return_value=False),
            self.assertRaisesRegex(XResetError, "the folder is read-only. Choose another place"),
            claim_folder(self.folder),
        ):
            self.fail("the work began")

    def test_a_folder_whose_name_has_a_dot_is_written_again(self):
        def write(*, out: Path) -> None:
            with claim_folder(out):
                (out / "result").touch()

        for _ in range(2):
            checked(write)(out=self.folder / "lr0.001")


class InstallationTest(InFolder):
    def installed(self, build):
        """Build a wheel with a function of setuptools, and return the folder that it is unpacked to."""
        clone = self.folder / "xreset"
        clone.mkdir()
        repository = Path(__file__).parents[1]
        for name in ("pyproject.toml", "README.md", "LICENSE", "xreset"):
            (clone / name).symlink_to(repository / name)
        call = f"from setuptools.build_meta import {build}; {build}('..')"
        subprocess.run([sys.executable, "-c", call], cwd=clone, check=True, capture_output=True)
        (wheel,) = self.folder.glob("*.whl")
        site = self.folder / "site-packages"
        zipfile.ZipFile(wheel).extractall(site)
        return site

    def test_an_editable_installation_works_in_the_parent_folder_of_a_clone(self):
        """Python takes a folder "xreset" of the current folder for a package unless the path has one as well."""
        site = self.installed("build_editable")
        use = (
            f"import site; site.addsitedir('{site}')\n"
            "import runpy, sys, xreset; xreset.load_robot('openarm'); sys.argv = ['xreset', '--version']\n"
            "runpy.run_module('xreset', run_name='__main__')"
        )
        command = [sys.executable, "-c", use]
        environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True
        )
        self.assertRegex(done.stdout + done.stderr, r"^xreset \d")

    def test_a_wheel_has_policies_robots_and_templates_without_a_clone(self):
        site = self.installed("build_wheel")
        use = (
            "import xreset\n"
            f"assert xreset.__file__.startswith({str(site)!r}), xreset.__file__\n"
            "policy = xreset.load_policy('many-objects')\n"
            "print(policy.robot.name, len(xreset.load_robot('openarm').joints))\n"
            "from xreset.eval.play.session import Session\n"
            "session = Session(policy)\n"
            "for _ in range(3):\n"
            "    session.step()\n"
            "session.close()\n"
            "from xreset.eval import pages\n"
            "assert 'report.html.j2' in pages._environment().list_templates()\n"
        )
        environment = os.environ | {"PYTHONPATH": str(site)}
        done = subprocess.run(
            [sys.executable, "-c", use],
            cwd=self.folder,
            env=environment,
            capture_output=True,
            text=True,
        )
        self.assertEqual((done.returncode, done.stdout), (0, "ur7e-sharpa 8\n"), done.stderr)

    def test_a_missing_package_is_named_with_the_extra_that_brings_it(self):
        from xreset import cli

        found = ["numpy>=1.26", "pandas>=2.2; extra == 'eval'", "pandas>=2.2; extra == 'all'"]
        with patch("importlib.metadata.requires", return_value=found):
            self.assertEqual(cli._extra_with("pandas"), "eval")
            self.assertIsNone(cli._extra_with("numpy"))
        missing = ModuleNotFoundError("No module named 'pandas'", name="pandas")
        with (
            patch("importlib.metadata.requires", return_value=found),
            patch.object(cli, "perform", side_effect=missing),
            self.assertRaises(SystemExit),
            redirect_stderr(io.StringIO()) as text,
        ):
            cli.main(["report", "x"])
        self.assertEqual(
            text.getvalue(),
            "xreset report: pandas is not installed. Install it with: pip install 'xreset[eval]'\n",
        )
