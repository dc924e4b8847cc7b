"""Evaluation from files: a policy and demonstrations in, one result per engine out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from xreset.description import load_robot
from xreset.errors import PolicyError
from xreset.eval.baselines import KinematicRetargeting
from xreset.eval.results import EvalResult, mesh_folder, summarize, write_results
from xreset.eval.rollout import roll_out
from xreset.eval.setting import Setting
from xreset.eval.trial import Engine, Trial
from xreset.files import claim_folder, file_hash
from xreset.inputs import load_inputs
from xreset.learning.choice import read_choice
from xreset.learning.run import read_run
from xreset.objects.catalogue import load_objects
from xreset.policies import results_folder, shipped
from xreset.policy import OnnxPolicy, Policy, RandomPolicy, ZeroPolicy, check_contract
from xreset.resets.bank import ResetBank
from xreset.retarget.file import Retargeted
from xreset.spec import RobotSpec
from xreset.task.config import TaskConfig, evaluation_task
from xreset.typed import from_dict

BASELINES = ("zero", "random", "ik")
"""Policies that are known by name."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What is to be evaluated."""

    policy: Callable[[RobotSpec, Retargeted | None], Policy]
    """Makes the policy (a fresh one for each engine)."""
    label: str
    robot: RobotSpec
    task: TaskConfig
    """The policy's own task, as trained."""
    folder: Path
    """Where results go by default."""
    objects_folder: str | None
    """Folder of meshes that it was trained with."""
    inputs: dict[str, str]
    trained_on: tuple[str, ...] | None = None
    """Names of the objects that it was trained with; None: a baseline, which was not trained."""

    def unseen(self, names: Sequence[str]) -> tuple[str, ...]:
        """Those of some objects that are outside of its training, sorted."""
        return () if self.trained_on is None else tuple(sorted({*names} - {*self.trained_on}))

    def meshes(self, given: Path | None) -> Path | None:
        """The folder of meshes to use: the given one, else its own; None: the stand-ins."""
        return mesh_folder(given, self.objects_folder)

    def trial(self, bank: ResetBank, setting: Setting) -> Trial:
        """Its own task as evaluations play it, with the objects of a bank."""
        objects = load_objects(sorted({*map(str, bank.sequence_object)}), self.meshes(setting.objects))
        task = evaluation_task(self.task)
        return Trial(
            robot=self.robot, objects=tuple(objects), bank=bank, task=task, seed=setting.seed, num_envs=setting.num_envs
        )

    def episodes(self, demos: Path, setting: Setting) -> tuple[Trial, Retargeted | None]:
        """The episodes of a file of demonstrations, and the trajectories that the ik baseline follows."""
        inputs = load_inputs(demos, robot=self.robot, objects=self.meshes(setting.objects), accept=("demos", "motion"))
        motion = inputs.motion() if self.label == "ik" else None
        return self.trial(inputs.bank, setting), motion


def resolve(policy: str, robot: str | None, seed: int) -> Subject:
    """Find out what ``RUN | POLICY.onnx | NAME | zero | random | ik`` means, where NAME is a policy that ships with xreset.

    What lies at a path wins over a shipped policy of that name.

    Raises:
        PolicyError: there is no such policy, or it does not fit the robot.
    """
    if policy in BASELINES:
        if robot is None:
            raise PolicyError(f"the baseline {policy!r} needs --robot.")
        spec = load_robot(robot)
        makers: dict[str, Callable[[RobotSpec, Retargeted | None], Policy]] = {
            "zero": lambda r, _: ZeroPolicy(len(r.joints)),
            "random": lambda r, _: RandomPolicy(len(r.joints), seed),
            "ik": lambda _, trajectories: KinematicRetargeting(_given(trajectories)),
        }
        folder = Path("runs") / f"{policy}-{spec.name}" / "eval"
        return Subject(
            policy=makers[policy],
            label=policy,
            robot=spec,
            task=TaskConfig(),
            folder=folder,
            objects_folder=None,
            inputs={},
        )
    path, ours = Path(policy), shipped()
    objects_folder = None
    if path.is_dir():
        from xreset.learning.train import ensure_policy

        run = read_run(path)
        file, folder, objects_folder, robot = ensure_policy(path), path / "eval", run.objects, robot or run.robot
        label = path.name
    elif path.suffix == ".onnx" or path.exists():
        file, folder, label = path, path.parent / "eval", path.stem
    elif policy in ours:
        file, folder, label = ours[policy], results_folder(policy) / "eval", policy
    else:
        known = ", ".join(BASELINES) + (f", or a policy that ships with xreset: {', '.join(ours)}" if ours else "")
        raise PolicyError(
            f"there is no policy {policy!r}: expected a run folder, a .onnx file, or one of {known}. Check the name or path."
        )
    contract = OnnxPolicy(file).contract
    spec = load_robot(robot or contract["robot"])
    task = from_dict(TaskConfig, contract["task"], f"{file}: task")
    check_contract(str(file), contract, spec, task)
    return Subject(
        policy=lambda *_: OnnxPolicy(file),
        label=label,
        robot=spec,
        task=task,
        folder=folder,
        objects_folder=objects_folder,
        inputs={"policy": file_hash(file)},
        trained_on=tuple(contract["objects"]),
    )


def evaluate(
    subject: Subject,
    engines: Sequence[Engine],
    demos: Path,
    setting: Setting,
    out: Path,
    *,
    episodes: int,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[EvalResult]:
    """Evaluate in each engine and write the results.

    Args:
        demos: demonstrations or retargeted trajectories.
        setting: meshes, seed of the perturbations, worlds at a time.
        progress: called with (engine, control steps done, control steps in all).

    Returns:
        The summaries that were written, in the order of the engines.

    Raises:
        XResetError: another command is writing into the folder.
    """
    choice = read_choice(subject.folder.parent) if subject.inputs else None
    if choice is not None and choice.policy_hash == subject.inputs["policy"] and choice.seed == setting.seed:
        raise PolicyError(
            f"the starts of seed {setting.seed} are those by which this policy was chosen: evaluate it with another --seed."
        )
    trial, trajectories = subject.episodes(demos, setting)
    folder, inputs = subject.meshes(setting.objects), subject.inputs | {"demos": file_hash(demos)}
    summaries = []
    with claim_folder(out):
        for engine in engines:
            policy = subject.policy(subject.robot, trajectories)
            rollouts = roll_out(policy, engine, trial, repetitions=episodes, progress=partial(progress, engine.name))
            summary = summarize(
                rollouts,
                backend=engine.name,
                backend_version=engine.version,
                robot=subject.robot.name,
                policy=subject.label,
                seed=setting.seed,
                inputs=inputs,
                objects_folder=str(folder) if folder else None,
                unseen=subject.unseen(trial.names),
            )
            write_results(out, summary, rollouts, subject.robot.joint_names)
            summaries.append(summary)
    return summaries


def _given(trajectories: Retargeted | None) -> Retargeted:
    assert trajectories is not None, "the ik baseline needs trajectories"
    return trajectories
