"""Studies: the file, the plan, running its steps, and the tables; and one whole study of seconds."""

import json
import re
import subprocess
from dataclasses import asdict, replace
from pathlib import Path
from unittest import TestCase
from unittest.mock import Mock, patch

import numpy as np

from tests.command import calls_of, succeeds
from tests.data import InFolder, InOneFolder, refuses
from tests.toy_bank import SOUP
from tests.toy_results import toy_result, toy_rollouts
from tests.toy_retarget import retargets_quickly
from xreset import synthesize, write_demos
from xreset.cli import main
from xreset.errors import FileFormatError, ObjectError, RunError, XResetError
from xreset.eval.results import write_result
from xreset.eval.study.file import SHIPPED, read_study, study_path
from xreset.eval.study.launch import launch
from xreset.eval.study.paper import paper_tables
from xreset.eval.study.plan import Plan, make_plan
from xreset.eval.study.report import write_page
from xreset.eval.study.steps import XRESET, Step, flags
from xreset.eval.study.tables import fill
from xreset.learning import verbs
from xreset.learning.config import TrainConfig
from xreset.learning.run import checkpoints, latest_checkpoint, read_run

HEAD = 'schema = "xreset-study/1"\nabout = "A test."\n'
DATA = "[data.toy]\nsynthetic_per_object = 1\n"
RUN = '[defaults]\ndata = "toy"\nrobot = "openarm"\nobjects = ["soup", "spam"]\ndevice = "cpu"\n'
BASE = HEAD + DATA + RUN


class Studied(InFolder):
    def setUp(self):
        super().setUp()
        self.out = self.folder / "out"

    def file(self, text):
        path = self.folder / "study.toml"
        path.write_text(text)
        return path

    def plan(self, text, **options):
        return make_plan(
            read_study(self.file(text)), "study", given=self.folder, out=self.out, **options
        )


class FileTest(Studied):
    def test_wrong_entries_are_named(self):
        a = "[runs.a]\n"
        none = "states schema None, expected 'xreset-study/1'"
        for text, message in (
            (
                f"{a}minuets = 3",
                r"runs\.a has wrong entries \(unknown: minuets \(minutes\?\); known: minutes, data, .*\)\.$",
            ),
            (f"{a}worlds = 3", r"\(unknown: worlds; known: data, .*, num_envs\)\.$"),
            (f"{a}seeds = [0, 0]", r"runs\.a\.seeds is \[0, 0\], expected one or more"),
            (f"{a}seeds = [{10**14}]", rf"runs\.a\.seeds\[0\] is {10**14}, expected a whole"),
            (f"{a}minutes = inf", r"runs\.a\.minutes is inf"),
            (f"{a}gpus = 4", r"runs\.a\.gpus is 4\. This option was removed"),
            (f"{a}[evaluations.eval]\nunseen = true", r"unseen is True\. This option was removed"),
            (f"{a}data = 'real'", r"runs\.a\.data is 'real', expected one of 'toy'"),
            (f"{a}weights = 'b'\n[runs.b]", r"runs\.a\.weights is 'b', expected one of none"),
            (f"{a}robot = '..'", r"runs\.a\.robot is '\.\.', expected the name"),
            ("[runs.'../a']", "'../a' cannot be the name of a folder"),
            (f"{a}[evaluations.checkpoints]", "is a folder in every run: call it"),
            ("[[tables]]\nruns = { b = 'B' }", r"tables\[0\]\.runs is 'b', expected one of none"),
            (
                "[[tables]]\npaper = 'X'\nruns = {}",
                r"tables\[0\]\.paper is 'X', expected one of 'I'",
            ),
            (
                "[[tables]]\nmetric = 'overflow'\nruns = {}",
                r"metric is 'overflow', expected one of 'task_progress'",
            ),
            (
                f"{a}[[tables]]\npaper = 'I'\nruns = {{ a = 'A' }}",
                r"runs is 'A', expected one of 'IK Oracle'",
            ),
            (
                f"{a}[runs.b]\n[[tables]]\nruns = {{ a = 'A', b = 'A' }}",
                r"tables\[0\]\.runs has two runs with the name 'A'",
            ),
        ):
            with refuses(self, message, FileFormatError):
                read_study(self.file(BASE + text))
        for text, message in (("schema = ", "is not valid TOML"), ("about = 'x'", none)):
            self.assertRaisesRegex(FileFormatError, message, read_study, self.file(text))
        with self.assertRaisesRegex(RunError, "Unknown study 'nothing'.*left_hands.*seconds"):
            study_path("nothing")

    def test_only_options_of_the_configuration_are_passed_on(self):
        message = r"is \[.*\], expected options that begin with --"
        for command, text, is_given in (
            ("retarget", "--picture /tmp/victim.png", False),
            ("retarget", "--device cpu --out=/tmp/victim.npz", False),
            ("retarget", "-h", False),
            ("resets", "--device cpu --out /tmp/victim.npz", False),
            ("resets", "--robot /tmp", False),
            ("retarget", "--device cpu", True),
            ("resets", "--closing.spacing 0.005 --num-envs 8 --engine mujoco", True),
            ("resets", "--squeeze.force 5", True),
            ("resets", "--settle", False),
        ):
            options = text.split()
            file = self.file(f"{HEAD}{DATA}{command} = {json.dumps(options)}\n{RUN}[runs.a]\n")
            with self.subTest(text):
                if is_given:
                    found = getattr(read_study(file).data["toy"], command)
                    self.assertEqual([*found], options)
                else:
                    words = rf"data\.toy\.{command} {message}"
                    self.assertRaisesRegex(FileFormatError, words, read_study, file)

    def test_defaults_hold_the_options_of_resets_of_all_data(self):
        default = ("--squeeze.force", "5")
        text = RUN.replace("[defaults]", f"[defaults]\nresets = {json.dumps(default)}")
        other = (
            f"[data.own]\nresets = ['--num-envs=8']\n[data.plain]\nresets = []\n{text}[runs.a]\n"
        )
        found = read_study(self.file(HEAD + DATA + other)).data
        self.assertEqual(
            {name: data.resets for name, data in found.items()},
            {"toy": default, "own": ("--num-envs=8",), "plain": ()},
        )
        for entry, words in (
            ("data = 3", "defaults, data and runs must be tables"),
            ("data.toy = 3", r"data\.toy is 3, expected an object"),
            ("", "missing: data"),
        ):
            self.assertRaisesRegex(
                FileFormatError, words, read_study, self.file(f"{entry}\n{HEAD}{text}")
            )

    def test_every_study_that_ships_can_be_read(self):
        files = sorted(SHIPPED.glob("*.toml"))
        self.assertIn("nine_objects", [f.stem for f in files])
        for file in files:
            with self.subTest(file.stem):
                self.assertTrue(read_study(study_path(file.stem)).tables)

    def test_the_documentation_counts_their_trainings(self):
        page = (Path(__file__).parents[1] / "docs" / "studies.md").read_text()
        stated = {name: int(n) for name, n in re.findall(r"(?m)^\| `(\w+)` \|.*\| (\d+) \|$", page)}
        found = {}
        for file in SHIPPED.glob("*.toml"):
            runs = [run for run in read_study(file).runs.values() if run.policy is None]
            each = [len(run.seeds) * (len(run.objects) if run.alone else 1) for run in runs]
            found[file.stem] = sum(each)
        self.assertEqual(stated, found)


class PaperTest(TestCase):
    def test_averages_are_those_of_the_rows(self):
        """So a figure that is copied wrongly is found, where the paper gives an average."""
        tables = paper_tables()
        nine = tables["I"]
        methods = zip(*nine.values.values(), strict=True)
        for (*each, average), two in zip(methods, tables["II"].values.values(), strict=True):
            self.assertAlmostEqual(sum(each) / 9, average, delta=0.06)
            self.assertEqual(average, two[0])
        for table in tables.values():
            for row in table.values.values():
                self.assertTrue(all(0 <= value <= 100 for value in row))
        figure = nine.figures()["Ours", SOUP, "task_progress"]
        self.assertEqual(figure, ", paper 90.8 \N{PLUS-MINUS SIGN} 1.5")


class PlanTest(Studied):
    def test_runs_by_object_and_seed(self):
        runs = "[runs.a]\nseeds = [3, 4]\n[runs.b]\nalone = true\nweights = 'a'\nseeds = [3]\n[runs.ik]\npolicy = 'ik'\n"
        plan = self.plan(BASE + runs)
        names = ["a-seed3", "a-seed4", "b-tomato_soup_can-seed3", "b-potted_meat_can-seed3", "ik"]
        self.assertEqual([r.folder.name for r in plan.runs], names)
        step = plan.steps["train b-tomato_soup_can-seed3"]
        self.assertEqual(step.needs, ["data toy-tomato_soup_can openarm", "train a-seed3"])
        (command,) = step.todo()[1]
        self.assertEqual(command[command.index("--weights") + 1], f"{self.out}/a-seed3")
        both = "data toy-tomato_soup_can+potted_meat_can openarm"
        self.assertEqual(plan.steps["eval ik"].needs, [both])
        self.assertFalse(self.out.exists())
        self.assertEqual(len(self.plan(BASE + runs, only=("ik",)).runs), 1)

    def given_to_train(self, plan):
        """What the command of the plan's one training passes on."""
        (train,) = (s for s in plan.steps.values() if s.kind == "train")
        (command,) = train.todo()[1]
        with calls_of(verbs, "train") as calls:
            main(command[len(XRESET) :])
        return calls[0]

    def test_changes_of_the_recipe_are_flags(self):
        changes = "task.reset = { random_gravity = false, demo_probability = 0.25, object_share = { 010_potted_meat_can = 3.0 } }\nmodel.pointnet = [8, 6]\ntask.action.hand = 'relative'\n"
        plan = self.plan(f"{BASE}[runs.a]\nsteps = 1e6\nnum_envs = 64\n[runs.a.config]\n{changes}")
        (planned,) = plan.runs
        reset = TrainConfig().task.reset
        self.assertEqual(planned.config.iterations, 977)
        shares = {"010_potted_meat_can": 3.0}
        changed = replace(reset, random_gravity=False, demo_probability=0.25, object_share=shares)
        self.assertEqual(planned.config.task.reset, changed)
        given = self.given_to_train(plan)
        self.assertEqual(replace(given["config"], iterations=given["iterations"]), planned.config)
        self.assertEqual(list(flags({"config": {"a": {"b_c": True}}})), ["--config.a.b-c"])

    def test_changes_of_terms_are_flags(self):
        changes = """
            [runs.a.config.task.reward]
            terms.reach.width = 0.3
            terms.reach_near = false
            terms.wide = { function = "reach", weight = 0.5, width = 1.0 }
            terms.action.limited = true
            gate = { opposing = false, touching = { force = 0.2 } }
            [runs.a.config.task.observation]
            proprio.joint_mask = {}
            policy.object_rotation = { function = "object_quat", noise = 0.02 }
        """
        plan = self.plan(f"{BASE}[runs.a]\nsteps = 1e6\nnum_envs = 64\n{changes}")
        task = self.given_to_train(plan)["config"].task
        (planned,) = plan.runs
        self.assertEqual(
            (task.reward.terms["reach"]["width"], "wide" in task.reward.terms), (0.3, True)
        )
        for part in ("reward", "observation"):
            found, wanted = (
                json.dumps(asdict(getattr(t, part))) for t in (task, planned.config.task)
            )
            self.assertEqual(found, wanted, "in the same order, which is that of the columns")

    def test_what_does_not_fit_is_refused(self):
        own = "terms = { 'module:term' = { weight = 1.0 } }\n"
        gravity = r"runs\.a\.config\.task\.reset.*unknown: gravity"
        for text, error, message in (
            (
                f"[runs.a.config.task.reward]\n{own}",
                RunError,
                "a.config.task.reward.terms names code .module:term",
            ),
            ("[runs.a.config.task.reset]\ngravity = 1\n", FileFormatError, gravity),
            ("[runs.a]\nobjects = ['cup']\n", ObjectError, "Unknown object 'cup'"),
            ("[runs.a]\n[runs.a-seed0]\npolicy = 'ik'\n", RunError, "would both write .*/a-seed0"),
            ("[runs.reports]\npolicy = 'ik'\n", RunError, "would both write .*/reports"),
        ):
            with refuses(self, message, error):
                self.plan(BASE + text)
        with self.assertRaisesRegex(RunError, "has no runs b; it has a"):
            self.plan(BASE + "[runs.a]\n", only=("b",))
        climbing = f"{HEAD}[data.toy]\ndemos = 'climbs.npz'\n[runs.a]\ndata = 'toy'\nalone = true\n"
        words = r"The archive .*climbs\.npz of the study does not exist\. .*\(--data\)"
        self.assertRaisesRegex(FileFormatError, words, self.plan, climbing)
        share = "[runs.a]\nconfig.task.reset.object_share = { mug = 3.0 }\n"
        with self.assertRaisesRegex(XResetError, "object_share names mug, but the objects are"):
            self.plan(BASE + share)
        names = np.array(["../../elsewhere"])
        demos = replace(synthesize(["soup"], 1, 0), object_name=names)
        write_demos(f"{self.folder}/climbs.npz", demos)
        plan = self.plan(climbing)
        out = self.out.resolve()
        self.assertEqual([run.folder.resolve().parent for run in plan.runs], [out])
        self.assertEqual({s.folder.resolve().parent for s in plan.subsets()}, {out / "data"})


class LaunchTest(Studied):
    def step(self, name, command, *needs):
        """Return a step whose shell command runs in a folder; it is done when the folder holds ``done``."""
        folder = self.folder / name

        def todo():
            if (folder / "done").exists():
                return "", []
            return "to do", [["sh", "-c", f"mkdir -p {folder} && cd {folder} && {command}"]]

        return Step(name=name, kind="data", folder=folder, todo=todo, needs=needs)

    def test_steps_are_done_in_their_order_and_failures_are_named(self):
        steps = [
            self.step("a", "touch done"),
            self.step("b", "test -e ../a/done && touch done", "a"),
            self.step("c", "exit 3"),
            self.step("d", "touch done", "c"),
            self.step("e", "touch done"),
            self.step("f", "exit 3", "c"),
        ]
        (self.folder / "f").mkdir()
        (self.folder / "f" / "done").touch()
        plan = Mock(spec=Plan, steps={s.name: s for s in steps})
        said: list[str] = []
        problems = launch(plan, steps, said.append)
        self.assertEqual(problems, ["c: to do", "d cannot start: c is not done."])
        self.assertEqual([step.left() for step in steps], ["", "", "to do", "to do", "", ""])
        self.assertEqual(len(said), 4)

    def test_a_step_imports_nothing_from_the_current_folder(self):
        for name in ("tyro", "xreset", "queue"):
            (self.folder / f"{name}.py").write_text("open('imported', 'w')")
        step = self.plan(BASE + "[runs.a]\n").steps["train a-seed0"]
        (command,) = step.todo()[1]
        self.assertEqual(tuple(command[: len(XRESET)]), XRESET)
        words = (*XRESET, "demos", "synth", "--help")  # sooner than a training
        subprocess.run(words, cwd=self.folder, check=True, capture_output=True)
        self.assertFalse((self.folder / "imported").exists())


class TablesTest(Studied):
    TEXT = HEAD + DATA + RUN + (
        "seeds = [0, 1]\n[evaluations.eval]\nepisodes = 2\nengines = ['mujoco']\n[runs.ours]\n[runs.x-sim]\n[runs.ik]\npolicy = 'ik'\n"
        "[[tables]]\npaper = 'I'\nruns = { ik = 'IK Oracle', x-sim = 'X-Sim', ours = 'Ours' }\n"
        "[[tables]]\nmetric = 'grasp'\nruns = { ours = 'X-RESET' }\n"
    )  # fmt: skip

    def write(self, name, *progress, first=0, **changes):
        """Results of the toy's episodes from the first on, with other task progress."""
        toy = toy_rollouts()
        own = toy.episodes[first : first + len(progress)]
        episodes = tuple(replace(e, task_progress=p) for e, p in zip(own, progress, strict=True))
        rollouts = replace(toy, episodes=episodes)
        result = toy_result("mujoco", rollouts, robot="openarm", seed=0, **changes)
        write_result(self.out / name / "eval", result, rollouts.traces, ("a", "b", "c"))

    def rows(self, plan, number=0):
        """The rows of one of the study's tables."""
        return fill(plan, plan.study.tables[number]).engines["mujoco"]

    def test_our_figures_are_next_to_the_papers(self):
        self.write("ours-seed0", 1.0, 1.0, 0.33, 0.33)
        self.write("ours-seed1", 0.66, 0.66, 0.33, 0.33)
        self.write("ik", 0.33, 0.33, 0.33, 0.33)
        plan = self.plan(self.TEXT)
        table, grasps = (fill(plan, t) for t in plan.study.tables)
        rows = table.engines["mujoco"]
        self.assertEqual(rows[0], ("%", "IK Oracle", "X-Sim", "Ours"))
        self.assertEqual(
            [r[0] for r in rows[1:]], ["tomato soup can", "potted meat can", "all of them"]
        )
        soup, _, everything = (dict(zip(rows[0], r, strict=True)) for r in rows[1:])
        self.assertEqual(soup["X-Sim"], "-, paper 35.0 \N{PLUS-MINUS SIGN} 0.8")
        self.assertRegex(
            soup["Ours"],
            r"^83\.0 \(66-100\), paper 90\.8 . 1\.5$",
            "the interval is over the seeds, too",
        )
        self.assertRegex(
            everything["Ours"], r"^58\.0 \(33-100\)$", "the paper's mean is over nine objects"
        )
        self.assertEqual(len(paper_tables()["II"].objects), 9)
        self.assertEqual(grasps.engines["mujoco"][0], ("%", "X-RESET"))
        report = write_page(plan, self.folder / "page")
        notes = report.notes
        text = report.page.read_text()
        self.assertIn("<h2>Table I", text)
        self.assertIn("83.0 (66-100), paper 90.8", text)
        self.assertIn("Episodes / demonstrations / seeds: ik 4 / 2 / 1, ours 8 / 2 / 2.", text)
        self.assertIn("The paper&#39;s figures follow", text)
        self.assertIn("Runs side by side", text)
        for note in (
            "The training ours-seed0 is not finished: not begun",
            "Not evaluated yet: eval ours-seed0, eval ours-seed1, eval x-sim-seed0, eval x-sim-seed1",
            "10,000 iterations",
        ):
            self.assertTrue(any(note in n for n in notes), note)
        lines = (self.folder / "page" / "results.csv").read_text().splitlines()
        (soup,) = [x for x in lines if x.startswith(f"ours-seed1,mujoco,{SOUP},task_progress,")]
        self.assertEqual(float(soup.split(",")[4]), 0.66)

    def test_the_page_has_all_runs_whichever_is_taken(self):
        self.write("ours-seed0", 1.0, 1.0, 0.33, 0.33)
        self.write("ik", 0.33, 0.33, 0.33, 0.33)
        words = ("--out", self.out, "--only tables --run ik")
        succeeds("study", self.file(self.TEXT), *words)
        self.assertIn("ours", (self.out / "reports" / "study" / "results.csv").read_text())

    def test_the_unit_is_that_of_the_metric(self):
        self.write("ours-seed0", 1.0, 1.0, 0.33, 0.33)
        lengths = "[[tables]]\nmetric = 'least_distance'\nruns = { ours = 'A' }\n"
        plan = self.plan(self.TEXT + lengths)
        tables = [fill(plan, spec) for spec in plan.study.tables]
        self.assertEqual([table.unit for table in tables], ["%", "%", "cm"])
        heads = [table.engines["mujoco"][0][0] for table in tables]
        self.assertEqual(heads, ["%", "%", "cm"])
        notes = [each.note.split(",")[0] for each in write_page(plan, self.folder / "page").tables]
        self.assertEqual(notes, ["Percent", "Percent", "Centimetres"])

    def test_a_mean_over_some_objects_is_not_shown_as_one_over_all(self):
        self.write("ours-tomato_soup_can-seed0", 1.0, 0.33)
        text = self.TEXT.replace("[runs.ours]\n", "[runs.ours]\nalone = true\n")
        plan = self.plan(text)
        rows = self.rows(plan)
        self.assertRegex(rows[1][3], r"^66\.5 ")
        self.assertEqual([r[3][0] for r in rows[2:]], ["-", "-"])
        # now seed 0 lacks an object, seed 1 does not
        self.write("ours-tomato_soup_can-seed1", 1.0, 0.33)
        self.write("ours-potted_meat_can-seed1", 0.66, 0.0, first=2)
        rows = self.rows(plan)
        self.assertRegex(rows[1][3], r"^66\.5 \(24-92\)", "one demonstration is little")
        self.assertRegex(rows[3][3], r"^49\.8 ", "seed 1 alone")
        notes = write_page(plan, self.folder / "page").notes
        self.assertFalse(
            [note for note in notes if "comparable" in note], "objects alone are not compared"
        )

    def test_results_of_an_engine_that_is_missing_here_are_shown(self):
        self.write("ours-seed0", 1.0, 1.0, 0.33, 0.33)
        missing = Mock(reason="not installed")
        with patch("xreset.eval.study.plan.backend_status", return_value=missing):
            plan = self.plan(self.TEXT)
        rows = self.rows(plan, 1)
        self.assertEqual(
            [row[0] for row in rows[1:]], ["tomato soup can", "potted meat can", "all of them"]
        )
        notes = write_page(plan, self.folder / "page").notes
        self.assertIn("Not evaluated in mujoco on this machine: not installed", notes)

    def test_results_that_no_run_plays_any_more_fill_no_table(self):
        self.write("ours-seed0", 1.0, 1.0, 0.33, 0.33)
        other = "[evaluations.eval]\nobjects = ['mustard']\n"
        plan = self.plan(self.TEXT.replace("[evaluations.eval]\n", other))
        self.assertEqual(fill(plan, plan.study.tables[1]).engines, {})
        report = write_page(plan, self.folder / "page")
        self.assertIn("nothing is evaluated yet", report.page.read_text())

    def test_seeds_that_were_evaluated_differently_have_no_mean(self):
        self.write("ours-seed0", 1.0, 1.0, 0.33, 0.33)
        plan = self.plan(self.TEXT)
        for *progress, inputs in ((0.6, 0.6, 0.6, {}), (0.6, 0.6, 0.6, 0.6, {"demos": "other"})):
            self.write("ours-seed1", *progress, **({"inputs": inputs} if inputs else {}))
            rows = self.rows(plan)
            self.assertTrue(all(row[-1].startswith("-") for row in rows[1:]), rows)
            notes = write_page(plan, self.folder / "page").notes
            self.assertTrue(any("These results are not comparable" in n for n in notes), notes)

    def test_results_of_other_episodes_do_not_count(self):
        self.write("ik", 0.33, 0.33, 0.33, 0.33)

        def step(entries):
            return self.plan(self.TEXT.replace("episodes = 2\n", entries)).steps["eval ik"]

        two = "episodes = 2\n"
        for entries, left in (
            (two, ""),
            (f"{two}seed = 7\n", "in mujoco"),
            ("episodes = 3\n", "in mujoco"),
            (f"{two}episode_seconds = 5.0\n", ""),
            (f"{two}episode_seconds = 12.0\n", "in mujoco"),
        ):
            self.assertEqual(step(entries).left(), left)
        with self.assertRaisesRegex(XResetError, "episode_seconds is 0.01, expected a number from"):
            step(f"{two}episode_seconds = 0.01\n")
        self.write("ik", 0.33, 0.33, 0.33, 0.33, episode_seconds=12.0)
        self.assertEqual(step(f"{two}episode_seconds = 12.0\n").left(), "")
        for entries, is_passed_on in ((two, False), (f"{two}episode_seconds = 5.0\n", True)):
            found = step(entries)
            self.assertEqual(found.left(), "in mujoco")
            (command,) = found.todo()[1]
            self.assertEqual("--episode-seconds" in command, is_passed_on)


class WholeTest(InOneFolder):
    """The study of seconds, from the command line."""

    @classmethod
    def setUpClass(cls):
        super().setUpClass()
        cls.out = cls.folder / "out"
        # another interpreter for each command takes longer than most commands; LaunchTest starts some
        here = patch("xreset.eval.study.launch._run", lambda command: main(command[len(XRESET) :]))
        with here, retargets_quickly(), patch("xreset.eval.report.clips.SIZE", (80, 60)):
            cls.said = succeeds("study seconds --out", cls.out)
        cls.text = study_path("seconds").read_text()

    def plan(self, *changes):
        text = self.text
        for old, new in changes:
            self.assertIn(old, text)
            text = text.replace(old, new)
        file = self.folder / "changed.toml"
        file.write_text(text)
        return make_plan(read_study(file), "changed", given=self.folder, out=self.out)

    def test_it_trains_evaluates_and_writes_the_table(self):
        self.assertRegex(
            self.said,
            r"(?s)xreset retarget .*xreset resets .*xreset train .*x-reset-seed0.*xreset eval .*x-reset-seed0",
        )
        text = (self.out / "reports" / "seconds" / "index.html").read_text()
        self.assertRegex(text, r"tomato soup can</th><td>\d.* paper 33\.0 .*<td>\d.* paper 90\.8 ")
        self.assertIn("one seed only of x-reset", text)
        self.assertIn("<svg", text)

    def test_what_is_done_is_not_done_again(self):
        before = {f: f.stat().st_mtime_ns for f in self.out.glob("*-seed0/**/*") if f.is_file()}
        with patch("xreset.eval.study.report.write_page", return_value=Mock(notes=())):
            said = succeeds("study seconds --out", self.out)
        self.assertNotIn("+ xreset", said)
        self.assertEqual({f: f.stat().st_mtime_ns for f in before}, before)
        self.assertEqual({s.name for s in self.plan().steps.values() if s.left()}, set())

    def test_a_run_goes_on_when_it_is_to_be_longer(self):
        plan = self.plan(("steps = 128", "steps = 256"))
        step = plan.steps["train x-reset-seed0"]
        self.assertTrue(step.left())
        (command,) = step.todo()[1]
        self.assertEqual(
            command[len(XRESET) :],
            ["train", "--out", f"{self.out}/x-reset-seed0", "--iterations", "4"],
        )
        left = plan.steps["eval x-reset-seed0"].left()
        self.assertEqual(left, "in mujoco", "the policy will be another one")

    def test_another_configuration_under_the_same_name_is_refused(self):
        before = latest_checkpoint(self.out / "x-reset-seed0").read_bytes()
        for change, message in (
            (
                ("lstm = 12", "lstm = 16"),
                r"x-reset-seed0 holds a run of another configuration: config\.model\.lstm is 12 there and 16",
            ),
            (("num_envs = 8", "num_envs = 16"), "num_envs is 8 there and 16 in the study"),
            (
                ("synthetic_per_object = 1", "synthetic_per_object = 2"),
                r"was made otherwise: synthetic_per_object is 1 there and 2 in",
            ),
        ):
            with refuses(self, message, RunError):
                self.plan(change)
        self.assertEqual(latest_checkpoint(self.out / "x-reset-seed0").read_bytes(), before)
        run = self.plan().runs[0]
        begun = replace(read_run(run.folder), weights="runs/a-seed0/checkpoints/000002.pt")
        with patch("xreset.eval.study.steps.read_run", return_value=begun):
            replace(run, weights=self.out / "a-seed0").check()
            with refuses(self, "networks of is 'a-seed0' there and 'b-seed0' in", RunError):
                replace(run, weights=self.out / "b-seed0").check()

    def test_other_meshes_are_refused_also_before_their_bank_is_made(self):
        other = ("[data.", "[data.meshes]\nsynthetic_per_object = 1\nmeshes = 'meshes'\n\n[data.")
        with self.assertRaisesRegex(RunError, "stand-ins is True there and False in the study"):
            self.plan(other, ('data = "', 'data = "meshes" #'))

    def test_a_policy_that_was_brought_without_checkpoints_counts(self):
        plan = self.plan()
        folder = self.out / "x-reset-seed0"
        (folder / "checkpoints").rename(folder / "elsewhere")
        self.addCleanup((folder / "elsewhere").rename, folder / "checkpoints")
        self.assertEqual(checkpoints(folder), [])
        self.assertEqual(plan.steps["eval x-reset-seed0"].left(), "")
        policy = folder / "policy.onnx"
        content = policy.read_bytes()
        self.addCleanup(policy.write_bytes, content)
        policy.write_bytes(content + b" ")
        self.assertEqual(
            plan.steps["eval x-reset-seed0"].left(),
            "in mujoco",
            "another policy is evaluated again",
        )
        self.assertEqual(plan.steps["train x-reset-seed0"].left(), "")

    def test_a_dry_run_prints_the_plan(self):
        said = succeeds("study seconds --out", f"{self.folder}/none", "--dry-run")
        self.assertRegex(
            said,
            r"(?s)train x-reset-seed0: not begun \(after data .*\n    xreset train --out .*/none/x-reset-seed0 --iterations 2",
        )
        self.assertIn("none/reports/seconds/index.html", said.splitlines()[-1])
        only = succeeds("study seconds --out", f"{self.folder}/none", "--dry-run --only tables")
        self.assertEqual(only, said.splitlines(keepends=True)[-1])
        self.assertFalse((self.folder / "none").exists())
