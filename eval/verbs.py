"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from xreset.errors import RunError, XResetError
from xreset.eval.conditions import (
    FAULTS,
    SWEPT,
    Condition,
    chosen_properties,
    nominal_task,
    plays_on_robot,
)
from xreset.files.checks import (
    Mp4,
    Option,
    Output,
    Port,
    PositiveInt,
    Seed,
    obeys_rules,
)
from xreset.files.progress import NamedProgress, Progress, unseen
from xreset.files.records import replaces
from xreset.files.storage import claim_folder, must_be_new
from xreset.files.text import quantity, texts
from xreset.physics.plugins import Device, EngineName, RobotName

if TYPE_CHECKING:
    from xreset.eval.export.recorded import RecordedEpisodes
    from xreset.eval.policy_spec import PolicySpec
    from xreset.eval.report.make import Report
    from xreset.eval.results import Evaluation
    from xreset.eval.rollout import Engine
    from xreset.resets.inputs import Data
else:  # a command has texts in place of these
    RecordedEpisodes = PolicySpec = Report = Evaluation = Engine = Data = Any

_warn = logging.getLogger(__name__).warning


@obeys_rules
def evaluate(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data,
    engine: EngineName | Engine | Sequence[EngineName | Engine] = "mujoco",
    *,
    episodes: PositiveInt = 5,
    episode_seconds: float | None = None,
    robot: RobotName | None = None,
    meshes: str | Path | None = None,
    seed: Seed = 0,
    device: Device = "cpu",
    num_envs: PositiveInt = 64,
    out: Output | None = None,
    progress: NamedProgress = unseen,
) -> Evaluation:
    """Evaluate a policy or a baseline in one or several engines, from the same starts.

    A task progress of the baseline ik near 33 % means that the hand gets to the object and does not grasp it.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported or deployed policy (.onnx), or name of a policy that
            ships with xreset (xreset policies); or a baseline: zero, ik (open-loop kinematic retargeting).
        demos: starts and goals, and the path of ik: demonstrations (xreset demos), retargeted motion (xreset retarget)
            or a goal set (xreset goals).
        engine: physics engine to play in; several are played from the same starts.
        episodes: episodes of each demonstration, each with another perturbation of robot and object.
        episode_seconds: length of an episode [s], such as 12, as in the published paper; default: as in the policy's
            training.
        robot: name or folder of the robot; default: the policy's own. Baselines need it.
        meshes: folder of real meshes; default: what the file states or the policy was trained with, else the stand-ins.
        seed: seed of the perturbations, which are the same in every engine.
        device: where engines run that can use a GPU: cpu or cuda.
        num_envs: worlds that run at the same time.
        out: folder for the results and recorded episodes; the command's default: eval/ in the run folder or next to the
            policy, runs/NAME/eval for a policy that ships with xreset, runs/BASELINE-ROBOT/eval for a baseline.
        progress: called with (engine, control steps done, control steps in all).

    Returns:
        The results, in the order of the engines. They print as a table; ``to_frame()`` has a row for each episode.

    Raises:
        PolicyError: the policy is unknown.
        XResetError: another process is writing the folder, the folder has results of another policy or of other
            episodes, or a number is out of range.
    """
    from xreset.eval import experiment
    from xreset.eval.policy_spec import load_policy
    from xreset.eval.rollout import chosen_engines, load_trial

    spec = load_policy(policy, robot=robot)
    chosen = chosen_engines(engine, device)
    trial = load_trial(
        spec,
        demos,
        meshes=meshes,
        seed=seed,
        num_envs=num_envs,
        episode_seconds=episode_seconds,
    )
    return experiment.play(
        spec,
        trial,
        chosen,
        [Condition(task=trial.task)],
        Path(out) if out else None,
        episodes=episodes,
        progress=progress,
    )


@obeys_rules
def stress(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data | None = None,
    engine: EngineName | Engine | Sequence[EngineName | Engine] = "mujoco",
    *,
    properties: Annotated[str | Sequence[str], Option("property")] = (),
    faults: bool = False,
    episodes: PositiveInt = 2,
    robot: RobotName | None = None,
    meshes: str | Path | None = None,
    seed: Seed = 0,
    device: Device = "cpu",
    num_envs: PositiveInt = 64,
    out: Output | None = None,
    progress: NamedProgress = unseen,
) -> Evaluation:
    """Measure robustness: the same episodes with changed stiffness, latency, friction, mass and more, one at a time.

    With faults, a robot's control loop plays, also the unchanged episodes: late and wrong poses, late actions, lost
    frames, pushes. The result says whether the policy may be tried on a robot. xreset report draws every curve.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported policy (.onnx), name of a policy that ships with
            xreset (xreset policies), or a baseline, which has no faults.
        demos: demonstrations whose starts and goals are played; default: two synthetic demonstrations of each of the
            policy's objects.
        engine: physics engine to play in, or several.
        properties: property or fault to change, or NAME=VALUE,VALUE... for values of your own (factors, s, m, rad; the
            table shows each unit). Default: all physical properties.
        faults: change the faults of a robot by default, in place of physics.
        episodes: episodes of each demonstration, the same for every value.
        robot: name or folder of the robot; default: the policy's own. Baselines need it.
        meshes: folder of real meshes; default: what the file states or the policy was trained with, else the stand-ins.
        seed: seed of starts and faults, which are the same in every engine.
        device: where engines run that can use a GPU: cpu or cuda.
        num_envs: worlds that run at the same time.
        out: folder for the results; the command's default: stress/ in the run folder or next to the policy, faults/ if
            there are faults.
        progress: called with (engine, conditions done, conditions in all).

    Returns:
        The results in the order of the engines: the unchanged episodes, and those of every value.
        :mod:`xreset.eval.effects` compares them.

    Raises:
        PolicyError: the policy is unknown, or a baseline shall have faults.
        XResetError: a property is unknown or cannot have a value; nothing was played then.
    """
    wanted = chosen_properties(properties, FAULTS if faults else SWEPT)
    on_robot = plays_on_robot(properties, faults)
    if on_robot and any(prop.in_steps for prop in wanted):
        raise XResetError(
            "A robot's control loop, which plays faults, has no latencies of the task. Choose action-delay in place of "
            "action-latency and pose-delay in place of observation-latency, or try latencies without faults."
        )
    from xreset.demos.verbs import synthesize
    from xreset.eval import experiment
    from xreset.eval.policy_spec import load_policy
    from xreset.eval.rollout import chosen_engines, load_trial

    spec = load_policy(policy, robot=robot)
    chosen = chosen_engines(engine, device)
    if on_robot:
        spec.exported()  # refuses a baseline
    if demos is None:
        own_meshes = spec.meshes_folder(meshes)
        demos = synthesize(spec.objects_of(own_meshes), 2, meshes=own_meshes)
    trial = load_trial(spec, demos, meshes=meshes, seed=seed, num_envs=num_envs)
    if not trial.task.vision.cameras:
        wanted = tuple(prop for prop in wanted if not prop.of_cameras)
        if not wanted:
            raise XResetError(
                f"The policy {spec.name!r} has no cameras to change. Choose other properties."
            )
    task = nominal_task(trial.task)
    conditions = [Condition(task=task)]
    for prop in wanted:
        tried = [prop.at(value, task) for value in prop.values]
        conditions += {condition.value: condition for condition in tried}.values()
    return experiment.play(
        spec,
        trial,
        chosen,
        conditions,
        Path(out) if out else None,
        episodes=episodes,
        on_robot=on_robot,
        progress=progress,
    )


@obeys_rules
def make_report(
    runs: str | Path | Sequence[str | Path],
    out: Annotated[Output, replaces("xreset-report", "index.html")] | None = None,
    *,
    robot: RobotName | None = None,
    meshes: str | Path | None = None,
    film: Mp4 | None = None,
    progress: NamedProgress = unseen,
) -> Report:
    """Make a self-contained HTML page of a run's evaluations, or of several runs side by side, and its figures as CSV.

    Runs that differ only in their seed share a row of the table and a curve, with a band from the lowest to the highest
    run. Notes say what makes runs incomparable, such as different demonstrations or versions of an engine. TensorBoard
    shows all learning curves; the page has success, success from home, grasps and return.

    Args:
        runs: run folders, folders of results (of a baseline, for example) or names of policies that ship with xreset
            (then runs/NAME); LABEL=FOLDER gives one a name.
        out: folder for index.html and results.csv; default: report/ in the folder of a single run, runs/report for
            several.
        robot: name or folder of the robot, for the films; default: as the run and the results name it.
        meshes: folder of real meshes, for the films; default: as the results name it.
        film: MP4 to write as well: every object in every run and engine, next to each other.
        progress: called with the name of what is drawn, and for the film with (objects drawn, objects in all).

    Returns:
        What the page shows.

    Raises:
        RunError: there is nothing to report, labels are not unique, or nothing can be filmed.
        FileFormatError: a file is damaged.
        XResetError: the page cannot be written, another command is writing it, or a package for plots is missing.
    """
    from xreset.eval.report import clips, make
    from xreset.eval.report.read import read_trainings

    if isinstance(runs, str | Path):
        runs = [runs]
    trainings = read_trainings(runs)
    if out is None:
        out = trainings[0].folder / "report" if len(trainings) == 1 else "runs/report"
    films = {"robot": str(robot) if robot else None, "meshes": Path(meshes) if meshes else None}
    with claim_folder(Path(out)):
        found = make.collect(trainings)
        progress("drawing films", 0, 0)
        found = make.write_report(found, Path(out), **films)
    if film is not None:
        moved = partial(progress, "drawing the film")
        filmed = clips.make_film(found.evaluated, Path(film), **films, progress=moved)
        found = replace(found, filmed=filmed)
    return found


@obeys_rules
def run_study(
    study: str | Path,
    *,
    data: str | Path = Path("data"),
    out: Output = Path("runs/studies"),
    runs: Annotated[str | Sequence[str], Option("run")] = (),
    only: Literal["all", "data", "train", "eval", "tables"] = "all",
    dry_run: bool = False,
    say: Callable[[str], None] = print,
    note: Callable[[str], None] = _warn,
) -> None:
    """Run the missing steps of a study: reset banks, trainings, evaluations, and tables next to the paper's.

    Steps run one after another. After a stop, the same command continues; finished steps are not repeated. Studies with
    the same --out share their runs.

    Args:
        study: study file, or name of a study that ships with xreset.
        data: folder with the study's demonstrations and meshes.
        out: folder for all output.
        runs: only this run of the study, or several; default: all. The page has all runs.
        only: kind of steps to run: reset banks, trainings, evaluations or tables.
        dry_run: print the plan and its commands, and run nothing.
        say: called with a line before each command, and with the lines of the plan.
        note: called with what makes figures incomparable, doubtful or incomplete.

    Raises:
        RunError: the study or a run of it is unknown, or steps failed; finished steps are kept.
    """
    from xreset.eval.study import launch, plan, report
    from xreset.eval.study.file import read_study, study_path

    path = study_path(str(study))

    def planned(chosen: Sequence[str] = ()) -> plan.Plan:
        return plan.make_plan(
            read_study(path), path.stem, given=Path(data), out=Path(out), only=chosen
        )

    todo = planned(texts(runs))
    wanted = [step for step in todo.steps.values() if only in ("all", step.kind)]
    report_folder = Path(out) / "reports" / todo.name
    if dry_run:
        for step in wanted:
            left, commands = step.todo()
            after = [need for need in step.needs if todo.steps[need].left()]
            waits = f" (after {', '.join(after)})" if after else ""
            say(f"{step.name}: {left or 'done'}{waits}")
            for command in commands:
                say(f"    {launch.shown_command(command)}")
        if only in ("all", "tables"):
            say(f"page: {report_folder / 'index.html'}")
        return
    problems = []
    if only != "tables":
        for subset in todo.subsets():
            subset.make()
        problems = launch.launch(todo, wanted, say)
    if only in ("all", "tables"):
        written = report.write_page(planned(), report_folder)
        for text in written.notes:
            note(text)
        say(f"page: {written.page}")
    if problems:
        raise RunError(
            "\n".join(
                [f"{quantity(len(problems), 'step')} failed. Finished steps are kept.", *problems]
            )
        )


@obeys_rules
def export_deploy(
    policy: str | Path | PolicySpec,
    out: Output,
    *,
    robot: RobotName | None = None,
    meshes: str | Path | None = None,
    only: Annotated[Sequence[str], Option("object")] = (),
) -> Path:
    """Write a policy for a robot: one ONNX graph from readings to joint targets, and a runtime.

    The runtime needs Python, numpy and onnxruntime (docs/live.md). The graph of a run is exported from torch's code;
    those of policies that ship with xreset are there.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported policy (.onnx), or name of a policy that ships with
            xreset (xreset policies).
        out: folder to write; must not exist, or be empty.
        robot: name or folder of the robot; default: the policy's own.
        meshes: folder of real meshes; default: what the policy was trained with, else the stand-ins.
        only: object whose points the contract lists, or several; default: the objects of the training.

    Returns:
        The folder.

    Raises:
        PolicyError: the policy is a baseline or looks through cameras.
        XResetError: the folder is not empty.
        ObjectError: there is neither a stand-in nor a mesh of an object.
    """
    from xreset.eval.policy_spec import load_policy
    from xreset.live.deploy import with_objects, write_deployed
    from xreset.objects.catalogue import load_objects

    must_be_new(Path(out))  # before the graph is made, which takes half a minute
    spec = load_policy(policy, robot=robot)
    folder = spec.meshes_folder(meshes)
    listed = load_objects(only or spec.objects_of(folder), folder)
    write_deployed(with_objects(spec.graph, listed), Path(out))
    return Path(out)


@obeys_rules
def export_episodes(
    folders: str | Path | Sequence[str | Path],
    out: Annotated[Output, replaces("xreset-rollouts/")],
    *,
    engine: str | Sequence[str] = (),
    robot: RobotName | None = None,
    meshes: str | Path | None = None,
    task: str | None = None,
    video: bool = True,
    size: tuple[int, int] = (320, 240),
    cameras: Annotated[Sequence[str], Option("camera")] = (),
    progress: Progress = unseen,
) -> RecordedEpisodes:
    """Write recorded evaluation episodes as a LeRobot data set (v3.0), or as plain arrays in an npz file.

    The first episode of each demonstration and engine is recorded; docs/rollouts.md has both formats.

    Args:
        folders: run folders, or folders that xreset eval wrote into.
        out: folder of the data set, which must not exist or be empty; or a file FILE.npz of plain arrays.
        engine: only episodes of this engine, or of several; default: all.
        robot: name or folder of the robot; default: as the results name it.
        meshes: folder of meshes; default: as the results name it.
        task: the task in words; {object} is replaced by the object's name.
        video: draw a film of each episode, in a data set.
        size: width and height of the films, pixels, even.
        cameras: also draw films of this depth camera: front, side or wrist.
        progress: called with (episodes written, episodes in all).

    Returns:
        What was written.

    Raises:
        RunError: a folder does not exist, none holds episodes of the engines, robots or rates differ, or the task has
            another placeholder.
        XResetError: pyarrow or the encoder of films is missing, the folder is not empty, or it cannot be written.
    """
    from xreset.eval.export.lerobot import write_lerobot
    from xreset.eval.export.recorded import read_recorded, write_arrays

    out = Path(out)
    if out.suffix == ".npz" and cameras:
        raise XResetError(
            f"{out} cannot hold films of cameras. Omit the cameras, or name a folder."
        )
    recording = read_recorded(folders, engines=engine, robot=robot, meshes=meshes, task=task)
    if out.suffix == ".npz":
        write_arrays(out, recording)
    else:
        write_lerobot(out, recording, video=video, size=size, cameras=cameras, progress=progress)
    return recording


@obeys_rules
def play(
    policy: str | Path | PolicySpec | None = None,
    *,
    object_name: Annotated[str | None, Option("object")] = None,
    engine: EngineName = "mujoco",
    robot: RobotName | None = None,
    demos: str | Path | None = None,
    meshes: str | Path | None = None,
    host: str = "127.0.0.1",
    port: Port = 8080,
) -> None:
    """Play with a policy in a browser: drag the goal, push the object or the robot, change the engine. Ctrl-C ends.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported policy (.onnx), or name of a policy that ships with
            xreset (xreset policies); default: the one that ships for the robot, without a robot many-objects.
        object_name: object to begin with; default: the soup can, or else the first one.
        engine: physics engine to begin with.
        robot: name or folder of the robot; default: the policy's own.
        demos: starts and goals: demonstrations, robot motion, reset states or a goal set; default: synthetic
            demonstrations.
        meshes: folder of real meshes; default: what the file states or the policy was trained with, else the stand-ins.
        host: address to serve at; 0.0.0.0 allows other machines.
        port: port to serve at; if it is taken, the next free one.

    Raises:
        XResetError: something cannot be loaded, or the server does not start.
    """
    from xreset.eval.play.page import serve

    serve(
        policy,
        object_name=object_name,
        engine=engine,
        robot=robot,
        demos=Path(demos) if demos else None,
        meshes=Path(meshes) if meshes else None,
        host=host,
        port=port,
    )
