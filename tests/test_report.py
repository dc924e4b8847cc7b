"""The report: what it reads, which episode it shows, and a page that needs nothing else."""

import re
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from unittest import mock

import numpy as np
import pandas as pd
from numpy.testing import assert_allclose

from tests.command import refused, succeeds
from tests.toy_bank import SOUP, SPAM, toy_bank
from tests.toy_results import (
    ENGINES,
    InFolder,
    rollouts_with,
    swept,
    toy_result,
    toy_rollouts,
)
from tests.toy_robot import toy_hand_arm
from xreset import TrainConfig, load_object, robots
from xreset.cameras.config import FRONT, VisionConfig
from xreset.errors import FileFormatError, RunError
from xreset.eval.report.clips import (
    Clip,
    at_one_rate,
    best_everywhere,
    camera_for,
    draw_clips,
    make_film,
    worst_episodes,
)
from xreset.eval.report.curves import draw_training
from xreset.eval.report.goals import goal_distances
from xreset.eval.report.make import collect, count_failures, headline, page
from xreset.eval.report.read import read_trainings
from xreset.eval.results import read_evaluation, recorded, write_result
from xreset.eval.table import table_text
from xreset.eval.verbs import make_report
from xreset.files.storage import claim_folder, file_hash
from xreset.geometry.description import load_robot
from xreset.geometry.shapes import pose_matrix
from xreset.learning.clock import Lift, Passing, write_lift
from xreset.learning.run import read_run
from xreset.pictures.render import encode_mp4
from xreset.resets.bank import write_bank

VOID = {"meta", "br", "link", "img", "input", "hr"}


SEEING = VisionConfig(cameras=(FRONT,), width=16, height=16)


class Reported(InFolder):
    """A run folder "soup" with results."""

    def setUp(self):
        super().setUp()
        self.folder = self.folder / "soup"

    def write(self, engines=ENGINES, rollouts=None, **changes):
        self.write_results("", rollouts, engines, **changes)

    def write_soup(self):
        self.write_run("", TrainConfig(iterations=500), num_envs=4096, seed=7)

    def read(self):
        return read_trainings([self.folder])

    def collect(self):
        return collect(self.read())


def table_of(*episodes, engine="mujoco"):
    return toy_result(engine, replace(toy_rollouts(), episodes=episodes)).to_frame()


def row_of(index):
    return list(table_of(*toy_rollouts().episodes).itertuples())[index]


class Outline(HTMLParser):
    """What a test wants to know of a page."""

    def __init__(self, text):
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open and self.open[-1] == tag, f"</{tag}> closes {self.open[-3:]}"
        self.open.pop()

    def handle_data(self, data):
        if not self.open or self.open[-1] not in ("style", "script"):
            self.text += data

    def of(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


class CollectTest(Reported):
    def test_a_run_a_baseline_and_a_bare_folder(self):
        self.write()
        self.assertIsNone(self.read()[0].run)
        self.write_soup()
        (training,) = self.read()
        self.assertEqual((training.label, training.run.num_envs), ("soup", 4096))
        self.assertEqual(self.collect().notes, ())
        self.assertEqual(tuple(training.results), ENGINES)

    def test_progress_by_the_angle_that_the_object_must_turn(self):
        """Demonstration 0 turns its object by 10 degrees, 1 by 100; results of before state no angle."""
        self.write()
        self.assertNotIn("must turn", page(self.collect()))
        rollouts = toy_rollouts()
        turned = []
        for episode in rollouts.episodes:
            turned.append(replace(episode, turn=np.radians((10.0, 100.0)[episode.sequence])))
        self.write(rollouts=replace(rollouts, episodes=tuple(turned)))
        text = Outline(page(self.collect())).text
        progress = pd.DataFrame(turned).groupby("sequence")["task_progress"].mean()
        for sequence, name in enumerate(("under 20°", "90 to 120°")):
            one_demonstration = f"{100 * progress[sequence]:.0f}%1"
            self.assertIn(name + one_demonstration * len(ENGINES), text)
        self.assertNotIn("45 to 90°", text)

    def test_progress_by_the_distance_from_the_goals_of_the_training(self):
        """Demonstration 0 has a goal of the training, that of 1 is 3 cm away; results in another folder have it, too."""
        bank = toy_bank(load_robot("ur7e-sharpa"))
        traces = []
        for trace, shift in zip(toy_rollouts().traces, (0.0, 0.03), strict=True):
            goal = bank.goal_pos[trace.sequence] + np.array([0.0, shift, 0.0])
            quat = bank.goal_quat_wxyz[trace.sequence]
            traces.append(replace(trace, goal_pos=goal, goal_quat=quat))
        rollouts = replace(toy_rollouts(), traces=tuple(traces))
        self.write(rollouts=rollouts, inputs={"policy": "cd"})
        self.write_results("elsewhere", rollouts, inputs={"policy": "cd"})
        file = self.folder / "bank.npz"
        write_bank(file, bank)
        self.write_run("", robot=bank.robot, resets=str(file), resets_hash=file_hash(file))
        run, other = read_trainings([self.folder, self.folder / "elsewhere"])
        info = read_run(self.folder)
        assert_allclose(goal_distances(other, info), [0.0, 0.0, 0.03, 0.03], atol=1e-6)
        text = Outline(page(collect([run, other]))).text
        self.assertIn("under 2 cm" + "66%1" * (len(ENGINES) + 1), text)
        self.assertIn("2 to 5 cm" + "33%1" * (len(ENGINES) + 1), text)
        self.assertNotIn("5 to 10 cm", text)
        self.assertNotIn("under 2 cm", page(collect([other])))
        turned = [replace(t, goal_quat=np.array([1.0, 0, 0, 0])) for t in traces]
        self.write_results("elsewhere", replace(rollouts, traces=tuple(turned)))
        (other,) = read_trainings([self.folder / "elsewhere"])
        self.assertGreater(goal_distances(other, info).min(), 0.03)
        of_other_bank = replace(info, resets_hash="ef" * 32)
        self.assertTrue(np.isnan(goal_distances(other, of_other_bank)).all())
        file.unlink()
        self.assertTrue(np.isnan(goal_distances(other, info)).all())

    def test_the_page_says_where_nothing_is_to_be_expected(self):
        self.write(policy="ik")
        [note] = self.collect().notes
        self.assertRegex(note, "^ik is a baseline without a policy: it plays the robot motion")
        self.write_soup()
        reached = toy_rollouts()
        short = replace(reached, episodes=reached.episodes[1:])
        for passed, rollouts, expected in (
            ((), short, True),
            ((), reached, False),  # a training that began with the networks of another one
            ((0.01,), short, False),
        ):
            self.write(rollouts=rollouts)
            passings = [
                Passing(share=share, iteration=9, env_steps=90, minutes=0.5) for share in passed
            ]
            write_lift(self.folder, Lift(passed=tuple(passings), iteration=10, minutes=0.6))
            said = " ".join(self.collect().notes)
            with self.subTest(passed=passed, expected=expected):
                words = "No object gets to its goal, as expected: in 10 iterations (0.6 min)"
                self.assertEqual(words in said, expected, said)

    def test_a_policy_that_sees_needs_no_run(self):
        self.write(vision=SEEING)
        self.assertEqual(self.read()[0].vision, SEEING)
        self.assertEqual(self.collect().notes, ())
        self.write_soup()
        self.assertIsNone(self.read()[0].vision, "the run's configuration has no camera")

    def test_nothing_to_report(self):
        self.folder.mkdir()
        words = f"nor evaluation results.*xreset eval POLICY.*--out {self.folder}"
        self.assertRaisesRegex(RunError, words, self.read)
        self.write_soup()
        write_lift(self.folder, Lift(iteration=1))
        [note] = self.collect().notes
        self.assertRegex(note, f"soup has no results.*xreset eval {self.folder} --demos")

    def test_results_outlive_the_description_of_their_training(self):
        self.write()
        self.write_soup()
        file = self.folder / "run.json"
        file.write_text(file.read_text().replace('"iterations"', '"cycles"'))
        training = self.read()[0]
        self.assertIsNone(training.run)
        self.assertEqual(training.facts["cycles"], "500")
        self.assertEqual(training.facts["task.randomization.friction"], "[0.5, 1.0]")
        words = "training is not described here: .*unknown: cycles"
        self.assertRegex(self.collect().notes[0], words)

    def test_the_page_has_what_it_tolerates(self):
        policy = {"policy": "ab12"}
        self.write(inputs=policy)
        sweep = {("force-gain", 2.0): 3 * [0.2, 0.2, 1.0, 1.0]}
        lost = {("pose-delay", 0.2): [0.1] * 12}
        stopped = {"The pose is old.": 2}
        for name, conditions in (("stress", sweep), ("faults", lost)):
            found = swept([0.8] * 12, conditions, inputs=policy, stopped=stopped)
            write_result(self.folder / name, found, (), ())
        # cards of 0.1 to 0.3 had no episodes
        (self.folder / "stress" / "sapien.json").write_text('{"schema": "xreset-stress/1"}')
        html = page(self.collect())
        text = Outline(html).text
        for words in (
            "What it tolerates",
            "x 1.5, or chance",
            "Not ready for a robot.",
            "pose delay 0.2 s costs 70.0 points",
            "The pose is old.",
            "not tried on hardware",
            "sapien.json is of an earlier version, without episodes",
        ):
            self.assertIn(words, text)
        self.assertEqual(html.count("<svg"), 2)
        words = "did not play the same episodes, so what they show is not comparable"
        self.assertNotIn(words, text)
        for changes in ({"seed": 4}, {"inputs": policy | {"demos": "cd"}}):
            other = swept([0.8] * 12, lost, "sapien", **({"inputs": policy} | changes))
            write_result(self.folder / "faults", other, (), ())
            self.assertIn(words, " ".join(self.collect().notes))
        self.write(inputs={"policy": "retrained"})
        (training,) = self.read()
        self.assertEqual(training.sweeps, ())


class ClipTest(Reported):
    ROLLOUTS = toy_rollouts()

    def test_the_episode_that_went_best_over_all_engines_is_shown(self):
        first, second = self.ROLLOUTS.traces
        whole = self.ROLLOUTS.episodes[::-1]
        alike = pd.concat([table_of(*whole, engine=engine) for engine in ENGINES])
        mixed = alike.copy()
        is_worse = alike["engine"].isin(ENGINES[2:]) & (alike["sequence"] == 0)
        mixed.loc[is_worse, "task_progress"] = 0.0
        traces = dict.fromkeys(ENGINES, (first, second))
        for table, shown, expected in (
            (alike, traces, [0] * 4),
            (mixed, traces, [1] * 4),
            (alike, {"mujoco": (first,), "sapien": (second,)}, []),
        ):
            parts = [recorded(table, engine, found) for engine, found in shown.items()]
            best = best_everywhere(pd.concat(parts, ignore_index=True))
            self.assertEqual(best["sequence"].tolist(), expected)
            self.assertFalse(best["repetition"].any())
        with self.subTest("the same demonstrations in another order"):
            other = alike.assign(run="other", sequence=1 - alike["sequence"])
            found = traces["mujoco"]
            swapped = [replace(trace, sequence=1 - trace.sequence) for trace in found]
            parts = [recorded(alike, "mujoco", found), recorded(other, "mujoco", swapped)]
            best = best_everywhere(pd.concat(parts, ignore_index=True))
            self.assertEqual(best["sequence_name"].tolist(), ["demo_0", "demo_0"])
        words = "mujoco.trace.npz has a trace of demonstration 1000000"
        with self.assertRaisesRegex(FileFormatError, words):
            recorded(alike, "mujoco", [replace(first, sequence=1_000_000)])

    def draw(self, strip=False, is_broken=False):
        self.folder.mkdir(exist_ok=True)
        robot = toy_hand_arm(self.folder)
        trace = toy_rollouts(robot.home).traces[0]
        if is_broken:
            trace.object_pos[3:] = np.nan
        episodes = table_of(self.ROLLOUTS.episodes[0]).assign(trace=[trace])
        (clip,) = draw_clips(episodes, robot, None, strips=strip)
        return clip

    def test_a_clip_shows_the_object_on_its_way_at_the_right_speed(self):
        clip = self.draw()
        # 5 states of 0.05 s, every second one
        self.assertEqual(clip.frames.shape, (3, 300, 400, 3))
        self.assertAlmostEqual(clip.fps, 10.0)
        self.assertTrue(clip.finite)
        is_orange = (clip.frames[..., 0] > 180) & (clip.frames[..., 2] < 100)
        before, after, _ = (np.argwhere(frame)[:, 0].mean() for frame in is_orange)
        self.assertLess(after, before - 3, "the object rises in the picture")

    def test_the_camera_does_not_depend_on_the_origin_of_the_mesh(self):
        trace = toy_rollouts().traces[0]
        obj = load_object(SOUP)
        shift = np.array([0.4, -0.3, 0.9, 0.0])
        turns = map(pose_matrix, trace.object_pos, trace.object_quat)
        goal_shift = pose_matrix(trace.goal_pos, trace.goal_quat) @ shift
        moved = replace(
            trace,
            object_pos=trace.object_pos - [(turn @ shift)[:3] for turn in turns],
            goal_pos=trace.goal_pos - goal_shift[:3],
        )
        camera = camera_for(trace, obj)
        other = camera_for(moved, replace(obj, com=obj.com + shift[:3]))
        assert_allclose(other.eye, camera.eye, atol=1e-6)
        assert_allclose(other.target, camera.target, atol=1e-6)

    def test_a_clip_freezes_once_a_state_is_not_finite(self):
        clip = self.draw(is_broken=True)
        self.assertEqual((clip.finite, len(clip.frames)), (False, 3))
        strip = self.draw(strip=True, is_broken=True)
        self.assertEqual(strip.frames.shape, (6, 180, 240, 3))
        assert_allclose(strip.times, [0, 0.05, 0.1, 0.1, 0.15, 0.2], atol=0.051)
        first, _, third, *_, last = strip.frames
        self.assertTrue((third == last).all() and (first != third).any())

    def test_the_film_holds_every_frame(self):
        import imageio_ffmpeg

        colors = np.uint8([[200, 40, 40], [40, 200, 40], [40, 40, 200], [220, 220, 40]])
        frames = np.broadcast_to(colors[:, None, None], (4, 48, 64, 3))
        file = self.folder.with_suffix(".mp4")
        file.write_bytes(encode_mp4(frames, 10.0))
        options = f"-i {file} -f rawvideo -pix_fmt rgb24 -".split()
        command = [imageio_ffmpeg.get_ffmpeg_exe(), *options]
        decoded = subprocess.run(command, capture_output=True, check=True)
        # what browsers play
        self.assertRegex(decoded.stderr.decode(), r"Video: h264.*yuv420p.*64x48.*10 fps")
        found = np.frombuffer(decoded.stdout, np.uint8).reshape(-1, 48, 64, 3).mean(axis=(1, 2))
        assert_allclose(found, colors, atol=12)

    def test_a_film_of_all_objects_in_all_engines_shows_what_the_policy_sees(self):
        self.folder.mkdir()
        robot = toy_hand_arm(self.folder)
        rollouts = toy_rollouts(robot.home)
        self.write(rollouts=rollouts, joints=robot.joint_names, vision=SEEING)
        drawn = []
        with (
            mock.patch("xreset.eval.report.read.load_robot", lambda _: robot),
            mock.patch("xreset.eval.report.clips.load_robot", lambda _: robot),
            mock.patch("xreset.eval.report.clips.encode_mp4") as encode,
        ):
            encode.return_value = b"film"
            (training,) = self.read()
            file = self.folder / "film.mp4"
            objects = make_film([training], file, progress=lambda *done: drawn.append(done))
        frames, fps = encode.call_args.args
        names = tuple(sorted({trace.object for trace in rollouts.traces}))
        self.assertEqual((set(training.results), objects), (set(ENGINES), names))
        self.assertEqual(drawn, [(i, len(names)) for i in range(len(names))])
        self.assertEqual((len(frames), *frames.shape[2:]), (3, len(names) * 200, 3))
        self.assertEqual(round(fps), 10)
        self.assertEqual(frames.shape[1] % 4, 0)
        self.assertEqual(frames.shape[1] // 4 - 24, 150 + 200, "without its label")

    def test_episodes_of_two_control_rates_keep_their_speed_in_one_film(self):
        """All last 0.4 s, but one."""
        clips = []
        for count, fps in ((4, 7.5), (5, 10.0), (2, 10.0)):
            frames = np.zeros((count, 2, 2, 3), np.uint8)
            clips.append(
                Clip(
                    episode=None, frames=frames, times=np.arange(count) / fps, fps=fps, finite=True
                )
            )
        shown, fps = at_one_rate(clips)
        expected = [[0, 1, 2, 2, 3], [0, 1, 2, 3, 4], [0, 1, 1, 1, 1]]
        self.assertEqual(([each.tolist() for each in shown], fps), (expected, 10.0))


class FailureTest(Reported):
    def test_the_worst_come_first_and_objects_take_turns(self):
        rollouts = toy_rollouts()
        mixed = (SOUP, SOUP, SOUP, SPAM)
        for progress, objects, count, expected in (
            ((0.66, 1.0, 0.33, 0.66), (SOUP,) * 4, 4, [2, 0, 3]),
            ((0.0, 0.0, 0.0, 0.66), mixed, 2, [0, 3]),
            ((0.0, 0.0, 0.0, 0.66), mixed, 4, [0, 1, 2, 3]),
        ):
            episodes = []
            traces = []
            for i, (value, name) in enumerate(zip(progress, objects, strict=True)):
                outcome = {
                    "task_progress": value,
                    "reorient": value == 1.0,
                    "reorientation_progress": 0.1 * i,
                }
                episodes.append(replace(rollouts.episodes[0], sequence=i, object=name, **outcome))
                traces.append(replace(rollouts.traces[0], sequence=i, object=name))
            found = worst_episodes(recorded(table_of(*episodes), "mujoco", traces), count)
            with self.subTest(progress=progress, count=count):
                self.assertEqual(found["sequence"].tolist(), expected)

    def test_every_episode_that_missed_its_goal_is_counted_once(self):
        at_goal, near, lifted, broken = toy_rollouts().episodes
        counts = count_failures(
            table_of(at_goal, near, near, lifted, replace(at_goal, reorient=False), broken)
        )
        self.assertEqual(list(counts.values()), [1, 2, 1, 1])
        pushed = replace(at_goal, grasp=False)
        self.assertEqual(sum(count_failures(table_of(pushed)).values()), 0)
        counts = count_failures(table_of(replace(pushed, reorient=False)))
        self.assertEqual(list(counts.values()), [0, 0, 0, 1], "an episode fails once")


class PlotTest(Reported):
    def test_a_drawing_takes_the_pages_colour_and_size(self):
        self.write(("mujoco",))
        (training,) = self.read()
        groups = {"run": [replace(training, curves=CURVES)]}
        drawing = draw_training(groups, "iterations")
        self.assertTrue(drawing.startswith("<svg") and drawing.endswith("</svg>"))
        opening = drawing[: drawing.index(">")]
        self.assertIn("viewBox", opening)
        self.assertNotRegex(opening, r"\b(width|height)=")
        self.assertIn("currentColor", drawing)
        self.assertNotIn("#010203", drawing)
        again = draw_training(groups, "iterations")
        self.assertEqual(drawing, again)


CURVES = pd.DataFrame({"episode/return": [0.5, 2.0]}, index=[1, 50])


class PageTest(Reported):
    @classmethod
    def setUpClass(cls):
        cls.clips = []
        frames = np.zeros((2, 48, 64, 3), dtype=np.uint8)
        shown = {"frames": frames, "times": np.arange(2.0), "fps": 10.0}
        for name in ENGINES:
            episode = row_of(0)._replace(engine=name)
            cls.clips.append(Clip(episode=episode, finite=name != "sapien", **shown))
        cls.strips = [Clip(episode=row_of(2)._replace(engine=""), finite=True, **shown)]

    def report(self, **changes):
        """The report of the folder, with films; ``changes`` replace its fields."""
        return replace(self.collect(), clips=self.clips, strips=self.strips, **changes)

    def whole(self):
        """The report of a run with results and learning curves."""
        self.write()
        self.write_soup()
        (training,) = self.read()
        report = collect([replace(training, curves=CURVES)])
        return replace(report, clips=self.clips, strips=self.strips)

    def test_the_page(self):
        text = page(self.whole())
        self.assertEqual(text, page(self.whole()), "the same results give the same page")
        outline = Outline(text)
        with self.subTest("well formed, with unique identifiers"):
            self.assertEqual(outline.open, [])
            names = [a["id"] for _, a in outline.tags if "id" in a]
            self.assertEqual(len(names), len(set(names)))
            targets = {a["xlink:href"][1:] for _, a in outline.tags if "xlink:href" in a}
            self.assertLessEqual(targets, set(names))
        with self.subTest("needs nothing from outside"):
            for tag, attributes in outline.tags:
                for name in ("src", "href", "xlink:href", "poster", "srcset", "action", "data"):
                    if attributes.get(name) is not None:
                        self.assertRegex(attributes[name], "^(data:|#)", f"<{tag} {name}>")
            self.assertNotIn("@import", text)
            for target in re.findall(r"url\(([^)]*)\)", text):
                self.assertTrue(target.startswith("#"), target)
            policy = next(
                a["content"]
                for a in outline.of("meta")
                if a.get("http-equiv") == "Content-Security-Policy"
            )
            self.assertIn("default-src 'none'", policy)
        with self.subTest("says in words what it shows"):
            charts = [
                a.get("aria-label") or "" for a in outline.of("figure") if a.get("role") == "img"
            ]
            films = [a.get("aria-label") or "" for a in outline.of("video")]
            self.assertEqual((len(charts), len(films)), (1, 4))
            for words in (*charts, *films):
                self.assertGreater(len(words), 20)
            self.assertIn("object at its goal", films[0])
            self.assertIn("stopped being finite", films[3])
            (strip,) = outline.of("img")
            self.assertRegex(
                strip["alt"], "at 0.0, 1.0 s: .*demo_1: grasped and lifted, 50% of the way"
            )
            self.assertEqual(outline.of("html")[0]["lang"], "en")
            self.assertEqual(len(outline.of("caption")), 3)
        for expected in (
            "zero on toy", "mujoco-warp 4.0.0 on cuda, 4,096 worlds", "50 of 500 iterations, seed 7", "49.8%", "33-66%", "37.5%",
            "tomato soup can", "demo_1", "4 in each engine: 2 demonstrations, 2 starts each", "trained here",
            "Of 4 episodes in mujoco: 1 never near the object; 1 near it, but no grasp; 1 grasped, never at the goal.",
        ):  # fmt: skip
            with self.subTest(expected):
                self.assertIn(expected, outline.text)

    def test_the_page_tells_what_the_cameras_see(self):
        words = "the depth that the cameras see"
        self.assertNotIn(words, page(self.whole()))
        self.write(vision=SEEING)
        (self.folder / "run.json").unlink()
        self.assertIn(words, page(self.report()))

    def test_without_clips_curves_and_run(self):
        self.write(engines=("pybullet",), episode_seconds=12.0)
        text = page(self.collect())
        self.assertIn("4 of 12 s in each engine: 2 demonstrations", Outline(text).text)
        self.write(engines=("mujoco",), episode_seconds=5.0)
        both = Outline(page(self.collect())).text
        self.assertIn(
            "4 in each engine, of 5 s in mujoco, of 12 s in pybullet: 2 demonstrations", both
        )
        table = table_text(read_evaluation(self.folder / "eval"))
        self.assertRegex(table, r"episodes: 4, demonstrations: 2")
        self.assertRegex(table, r"episode length +│ +5 s │ +12 s")
        self.assertEqual(text.count('<td class="bad">1</td>'), 2, "faults of an engine stand out")
        self.assertNotIn("<video", text)
        self.assertNotIn("Training", Outline(text).text)

    def test_names_cannot_inject_anything(self):
        hostile = '<script>alert("x")</script>'
        report = self.whole()
        (training,) = report.trainings
        named = (replace(training, label=hostile),)
        text = page(replace(report, trainings=named, notes=(hostile,)))
        self.assertNotIn("<script>alert", text)
        self.write(policy=hostile)
        text = page(self.collect())
        self.assertNotIn("<script>alert", text)
        self.assertIn(hostile, Outline(text).text)

    def test_the_headline_begins_with_the_best(self):
        means = {"mujoco": 0.4, "mujoco-warp": 0.9, "pybullet": 0.1, "sapien": 0.5}
        for engine, mean in means.items():
            self.write((engine,), rollouts_with(*[mean] * 4))
        self.write_soup()
        self.assertEqual(
            headline(self.read()),
            "Task progress is 90% in mujoco-warp, 50% in sapien, 40% in mujoco, 10% in pybullet. "
            "The policy was trained in mujoco-warp.",
        )


class SeveralTest(Reported):
    def test_films_of_several_runs_are_of_one_episode_in_one_engine(self):
        """Each run is drawn with its own robot."""
        names = ["openarm", "ur7e-robotiq"]
        runs = []
        for name in names:
            robot = load_robot(name)
            rollouts = toy_rollouts(robot.home)
            engines = ("mujoco", "sapien")
            runs.append(self.write_results(name, rollouts, engines, robot.joint_names, robot=name))
        report = make_report(runs, self.folder / "both")
        first, second = report.clips
        self.assertEqual([clip.episode.run for clip in report.clips], names)
        self.assertEqual((first.episode.engine, second.episode.engine), ("mujoco", "mujoco"))
        self.assertTrue((first.frames != second.frames).any())
        self.assertEqual(report.page.read_text().count("<video"), 2)
        self.write_results(names[1], robot=names[1], inputs={"demos": "cd"})
        report = make_report(runs, self.folder / "both")
        self.assertIn("no films: the runs were evaluated with different", report.notes[-1])


class CommandTest(Reported):
    def test_from_results_to_page_and_picture(self):
        robot = robots.load("openarm")
        self.write(
            ("mujoco", "sapien"),
            rollouts=toy_rollouts(robot.home),
            joints=robot.joint_names,
            robot="openarm",
        )
        printed = succeeds("report", self.folder)
        for word in ("50% in mujoco", "50% in sapien", "index.html"):
            self.assertIn(word, printed)
        self.assertNotIn("note:", printed)
        self.assertNotIn("49.8%", printed, "the table of xreset eval")
        html = (self.folder / "report" / "index.html").read_text()
        self.assertEqual(html.count("<video"), 2)

    def test_numbers_are_reported_even_where_no_clip_can_be_drawn(self):
        self.write(("mujoco",), robot="a-robot-that-is-not-installed")
        for _ in range(2):  # the second page replaces the first
            report = make_report(self.folder, self.folder / "elsewhere")
        self.assertRegex(
            " ".join(report.notes), "no films: Unknown robot 'a-robot-that-is-not-installed'"
        )
        self.assertEqual(report.page, self.folder / "elsewhere" / "index.html")
        self.assertIn("There are no films", report.page.read_text())

    def test_two_reports_are_not_written_into_one_folder(self):
        self.write(("mujoco",))
        never = mock.patch("xreset.eval.report.make.draw_report", side_effect=AssertionError)
        with claim_folder(self.folder / "report"), never:
            printed = refused("report", self.folder)
        self.assertEqual(list((self.folder / "report").iterdir()), [])
        self.assertRegex(
            printed, "xreset report: another command is writing .*report. Wait for its end, or"
        )
