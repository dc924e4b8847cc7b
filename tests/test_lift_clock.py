"""The lift clock: when success from home first passed its marks, over restarts too. Curves that are sent elsewhere."""

import errno
import io
import os
import threading
from contextlib import redirect_stderr
from dataclasses import asdict
from unittest import mock

import torch

from tests.data import InFolder, refuses
from xreset.errors import FileFormatError, XResetError
from xreset.eval.report.read import read_curves
from xreset.files.storage import write_json
from xreset.learning.clock import Lift, read_lift, write_lift
from xreset.learning.log import TrainingLog
from xreset.learning.run import training_left


def marks(lift):
    """Shares that were passed, and the iterations in which they were."""
    return [(p.share, p.iteration) for p in lift.passed]


class LiftTest(InFolder):
    def after(self, lift, shares, begin=0):
        for i, share in enumerate(shares, begin + 1):
            lift = lift.after(share, iteration=i, env_steps=1000 * i, seconds=30.0 * i)
        return lift

    def test_the_first_passing_of_each_mark_is_kept(self):
        write_json(self.folder / "run.json", {"seed": 3})
        write_lift(self.folder, self.after(Lift(), [0.0, 0.009, 0.2, 0.05, 0.11, 0.6, 0.3]))
        lift = read_lift(self.folder)
        self.assertEqual([(p.share, p.iteration, p.env_steps, p.minutes) for p in lift.passed],
                         [(0.01, 3, 3000, 1.5), (0.1, 3, 3000, 1.5), (0.5, 6, 6000, 3.0)])  # fmt: skip
        self.assertEqual(
            (lift.iteration, lift.env_steps, lift.minutes, lift.success_from_home),
            (7, 7000, 3.5, 0.3),
        )

    def test_a_resumed_run_forgets_what_came_after_its_checkpoint(self):
        again = self.after(Lift(), [0.0, 0.02, 0.0, 0.3]).up_to(3)
        self.assertEqual(marks(again), [(0.01, 2)])
        at_checkpoint = self.after(Lift(), [0.0, 0.02]).up_to(2)
        self.assertEqual(marks(at_checkpoint), [(0.01, 2)])
        again = self.after(again, [0.0, 0.4], begin=3)
        self.assertEqual(marks(again), [(0.01, 2), (0.1, 5)])

    def test_what_is_left_counts_iterations_and_minutes_of_the_whole_training(self):
        self.assertEqual(training_left(self.folder, 10), "not begun")
        write_lift(self.folder, self.after(Lift(), [0.0] * 4))  # 2 minutes
        self.assertEqual(training_left(self.folder, 10), "4 of 10 iterations")
        left = training_left(self.folder, 10, 3.0)
        self.assertEqual(left, "4 of 10 iterations, 2.0 of 3 minutes")
        self.assertEqual(training_left(self.folder, 10, 2.05), "", "a start would take longer")
        self.assertEqual(training_left(self.folder, 4), "")
        (self.folder / "checkpoints").mkdir()
        (self.folder / "checkpoints/000003.pt").touch()
        self.assertEqual(training_left(self.folder, 4), "3 of 4 iterations")

    def test_earlier_runs_and_damaged_files(self):
        self.assertEqual(read_lift(self.folder), Lift())
        passing = {"share": 1e308, "iteration": 3, "env_steps": 30, "minutes": 0.5}
        for words, changes in (
            ("passed is 3, expected a list", {"passed": 3}),
            ("minutes is 1e.300, expected a", {"minutes": 1e300}),
            ("iteration is -5, expected a", {"iteration": -5}),
            ("share is 1e.308, expected a", {"passed": [passing]}),
        ):
            write_json(self.folder / "lift.json", {"schema": "xreset-lift/1"} | changes)
            with refuses(self, words, FileFormatError):
                read_lift(self.folder)
            write_json(self.folder / "run.json", {"lift": changes})
            with refuses(self, f"run.json: .*{words}", FileFormatError, words):
                read_lift(self.folder)
            (self.folder / "run.json").unlink()
        write_json(self.folder / "lift.json", {"schema": "xreset-lift/1", "iteration": 4})
        self.assertEqual(read_lift(self.folder).iteration, 4)


LOG = {
    "task/success_from_home": torch.tensor(0.5),
    "task/grasped": torch.ones(()),
    "task/success": torch.ones(()),
}


def learn(log, iteration=1, **numbers):
    """Let a log write an iteration of one step, in which no world ends."""
    log.add(torch.ones(2), torch.zeros(2), LOG)
    log.write(iteration, 10, 60.0, {"speed/env_steps_per_second": 2.0} | numbers)


class CurvesTest(InFolder):
    def test_while_a_teacher_acts_success_is_not_the_students(self):
        curves = TrainingLog(self.folder, 2, "cpu", 5)
        for iteration, share in ((1, 0.5), (2, 0.0)):
            learn(curves, iteration, **{"policy/teacher_share": share})
            found = (curves.lift.iteration, curves.lift.minutes, curves.lift.success_from_home)
            self.assertEqual(found, (iteration, 1.0, 0.0 if share else 0.5))
            self.assertEqual({p.iteration for p in curves.lift.passed}, set() if share else {2})
        curves.close()

    def test_a_run_that_is_stopped_before_its_next_iteration_keeps_its_record(self):
        done = Lift(iteration=4, env_steps=40, minutes=3.0, success_from_home=0.5)
        write_json(self.folder / "run.json", {"lift": asdict(done)})
        TrainingLog(self.folder, 2, "cpu", 5, done=4).close()
        self.assertEqual(read_lift(self.folder), done)

    def test_episodes_that_a_break_cuts_short_are_in_no_curve(self):
        """World 0 ends after two steps, and after three more; world 1 after four."""
        for done, expected in ((0, [2.0, 3.0]), (4, [3.0])):
            folder = self.folder / str(done)
            log = TrainingLog(folder, 2, "cpu", None, done=done)
            for iteration, ends in enumerate(([(0, 0), (1, 0)], [(0, 0), (0, 1), (1, 0)])):
                for end in ends:
                    log.add(torch.ones(2), torch.tensor(end), LOG)
                log.write(done + iteration, 10, 60.0, {"speed/env_steps_per_second": 2.0})
            log.close()
            curves = read_curves(folder)
            for name in ("episode/length", "episode/return"):
                self.assertEqual(curves[name].dropna().tolist(), expected)

    def test_each_iteration_is_on_disk_at_once_and_open_logs_share_nothing(self):
        hook = threading.excepthook
        threads = threading.active_count()
        first = TrainingLog(self.folder, 2, "cpu", 5)
        second = TrainingLog(self.folder, 2, "cpu", 5)
        for iteration, log in enumerate((first, second), 1):
            learn(log, iteration)
        self.assertEqual(threading.active_count(), threads)
        self.assertIs(threading.excepthook, hook)
        found = read_curves(self.folder)
        self.assertEqual(found["task/success_from_home"].to_dict(), {1: 0.5, 2: 0.5})
        first.close()
        second.close()
        self.assertIs(threading.excepthook, hook)

    def test_a_full_disk_is_said_in_one_message(self):
        said = io.StringIO()
        full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        curves = TrainingLog(self.folder, 2, "cpu", None)
        write = "tensorboard.summary.writer.record_writer.RecordWriter.write"
        with (
            mock.patch(write, side_effect=full),
            redirect_stderr(said),
            self.assertRaisesRegex(
                XResetError, "learning curves into .*No space left.*same command"
            ),
        ):
            learn(curves)
        self.assertEqual(said.getvalue(), "")
        curves.close()

    def test_curves_are_sent_only_if_a_project_is_named(self):
        online = mock.Mock()
        folder = self.folder
        with mock.patch.dict("sys.modules", {"wandb": online}):
            for project in (None, "project"):
                write_json(f"{folder}/run.json", {"a": 1})
                curves = TrainingLog(folder, 2, "cpu", 5, project)
                learn(curves, 3)
                self.assertEqual(len(read_lift(folder).passed), 3, "a passing is on disk at once")
                curves.close()
                self.assertEqual(online.init.called, project is not None)
            self.assertEqual(online.init.call_args.kwargs["project"], "project")
            self.assertEqual(online.init.call_args.kwargs["config"], {"a": 1})
            sent = online.init.return_value.log.call_args
            self.assertEqual(
                (sent.args[0]["task/success_from_home"], sent.kwargs), (0.5, {"step": 3})
            )
            online.init.return_value.finish.assert_called_once_with()
            with (
                mock.patch.dict("sys.modules", {"wandb": None}),
                self.assertRaisesRegex(XResetError, r"xreset\[wandb\]"),
            ):
                TrainingLog(folder, 2, "cpu", 5, "project")
