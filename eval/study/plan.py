"""The runs and steps of a study: a step has a name, the steps it needs, what is left to do, and the commands that do
it.

    OUT/data/SUBSET/demos.npz               demonstrations of a subset of the data, and its definition (subset.json)
    OUT/data/SUBSET/ROBOT/resets.npz        reset bank, made by xreset retarget and xreset resets
    OUT/RUN/                                run folder of xreset train; eval/ and eval-NAME/ are its evaluations
    OUT/logs/STEP.log                       output of the commands of a step

Studies with the same OUT share its content: a run of the same name and configuration is trained once.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from xreset.checks import from_dict, merged
from xreset.demos.archive import read_demos
from xreset.errors import RunError
from xreset.eval.results import EvalResult, read_result
from xreset.eval.study.file import Data, Evaluation, Runs, Study
from xreset.eval.study.subset import Subset, refuse_other
from xreset.files import file_hash, is_claimed
from xreset.learning.clock import Lift, read_lift
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import starting_config
from xreset.learning.run import checkpoints, read_run
from xreset.objects.catalogue import canonical_names, object_names
from xreset.plugins import backend_status
from xreset.text import short_name

_ENOUGH = 0.97
"""Share of the minutes from which a training counts as done: to start again would cost more than what is left."""
_XRESET = [sys.executable, "-m", "xreset"]


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training, or one baseline."""

    group: str
    """Name of the run in the study; trainings with other seeds and objects share it."""
    runs: Runs
    seed: int
    objects: tuple[str, ...]
    folder: Path
    subset: Subset
    config: TrainConfig | None = None
    """None: a baseline."""
    weights: Path | None = None

    @property
    def name(self) -> str:
        """Name of the run's folder."""
        return self.folder.name

    @property
    def bank(self) -> Path:
        """The run's reset bank."""
        return self.subset.folder / Path(self.runs.robot).name / "resets.npz"

    def trained(self) -> Lift:
        """Return how far the training has come, which it notes with every checkpoint."""
        return read_lift(self.folder)

    def left(self) -> str:
        """Return how far an unfinished training has come, in words; empty if it is finished."""
        assert self.config is not None
        now = self.trained()
        minutes = self.runs.minutes
        if now.iteration >= self.config.iterations or (
            minutes is not None and now.minutes >= _ENOUGH * minutes
        ):
            return ""
        if not now.iteration:
            return "not begun"
        text = f"{now.iteration} of {self.config.iterations} iterations"
        return text if minutes is None else f"{text}, {now.minutes:.1f} of {minutes:g} minutes"

    def check(self) -> None:
        """Refuse a folder with a run of another configuration. The length may differ: a run can be continued."""
        if self.config is None or not (self.folder / "run.json").is_file():
            return
        info = read_run(self.folder)
        wanted = {name: getattr(self.runs, name) for name in ("robot", "backend", "num_envs")} | {
            "seed": self.seed
        }
        found: dict[str, Any] = {name: getattr(info, name) for name in wanted}
        found["stand-ins"] = info.objects is None
        found["other networks to begin with"] = info.weights is not None
        found["config"] = _without_length(info.config)
        wanted |= {
            "stand-ins": self.subset.data.meshes is None,
            "other networks to begin with": self.weights is not None,
            "config": _without_length(self.config),
        }
        if self.bank.is_file():
            found["reset bank"] = info.resets_hash[:12]
            wanted["reset bank"] = file_hash(self.bank)[:12]
        refuse_other(f"{self.folder} holds a run of another configuration", "runs", found, wanted)


def _without_length(config: TrainConfig) -> dict[str, Any]:
    return asdict(replace(config, iterations=1, save_interval=1))


@dataclass(frozen=True, kw_only=True)
class Step:
    """A part of a study that commands of ``xreset`` do."""

    name: str
    kind: Literal["data", "train", "eval"]
    writes: Path
    """Folder that the commands write."""
    left: Callable[[], str]
    """Returns what is left to do, in words; empty if the step is done."""
    commands: Callable[[], list[list[str]]]
    """Returns the commands to run next, in order."""
    needs: tuple[str, ...] = ()
    """Names of the steps before it."""
    gpu: bool = False
    run: Run | None = None
    """The run that is trained or evaluated."""
    objects: tuple[str, ...] = ()
    """Objects of an evaluation."""

    def done(self) -> bool:
        """Return whether nothing is left to do."""
        return not self.left()

    def busy(self) -> bool:
        """Return whether another process is writing this step's folder."""
        return is_claimed(self.writes)


# Steps ----------------------------------------------------------------------------------------------------------------


def bank_step(subset: Subset, robot: str) -> Step:
    """Return the step from demonstrations to a reset bank for one robot."""
    folder = subset.folder / Path(robot).name
    motion = folder / "retargeted.npz"
    bank = folder / "resets.npz"

    def commands() -> list[list[str]]:
        retarget = [*_XRESET, "retarget", str(subset.demos), "--robot", robot, "--out", str(motion)]
        resets = [*_XRESET, "resets", str(motion), "--out", str(bank)]
        if Path(robot).is_dir():
            resets += ["--robot", robot]
        resets += [*subset.mesh_options, *subset.data.resets]
        if motion.is_file():
            return [resets]
        return [[*retarget, *subset.mesh_options, *subset.data.retarget], resets]

    return Step(
        name=f"data {subset.folder.name} {folder.name}",
        kind="data",
        writes=folder,
        left=lambda: "" if bank.is_file() else "to do",
        commands=commands,
    )


def train_step(run: Run, needs: tuple[str, ...]) -> Step:
    """Return the step of a training, from the beginning or from its newest checkpoint."""
    spec = run.runs
    config = run.config
    assert config is not None

    def commands() -> list[list[str]]:
        options: dict[str, Any] = {"out": run.folder, "iterations": config.iterations}
        if spec.minutes is not None:
            options["minutes"] = f"{spec.minutes - run.trained().minutes:.4g}"
        more = ["--resume"]
        if not checkpoints(run.folder):
            options |= {
                "robot": spec.robot,
                "resets": run.bank,
                "backend": spec.backend,
                "device": spec.device,
                "num-envs": spec.num_envs,
                "seed": run.seed,
                "like": spec.recipe,
            }
            if run.weights is not None:
                options["weights"] = run.weights
            more = [*run.subset.mesh_options, *config_flags(spec.config)]
        return [[*_XRESET, "train", *config_flags(options, "--"), *more]]

    return Step(
        name=f"train {run.name}",
        kind="train",
        writes=run.folder,
        left=run.left,
        commands=commands,
        needs=needs,
        gpu=spec.device == "cuda",
        run=run,
    )


def config_flags(changes: dict[str, Any], prefix: str = "--config.") -> Iterator[str]:
    """Yield values, by default changes of a configuration, as options of a command."""
    for name, value in changes.items():
        flag = name.replace("_", "-")
        if isinstance(value, dict):
            yield from config_flags(value, f"{prefix}{flag}.")
        elif isinstance(value, bool):
            yield f"{prefix}{flag}" if value else f"{prefix}no-{flag}"
        else:
            yield prefix + flag
            yield from map(str, value if isinstance(value, list | tuple) else [value])


def eval_step(
    run: Run,
    key: str,
    evaluation: Evaluation,
    subset: Subset,
    engines: tuple[str, ...],
    needs: tuple[str, ...],
) -> Step:
    """Return the step of one evaluation of one run.

    Args:
        key: name of the evaluation.
        engines: engines of the evaluation that are installed.
    """
    folder = run.folder / key
    demos = subset.demos
    if run.runs.policy == "ik":
        demos = subset.folder / Path(run.runs.robot).name / "retargeted.npz"

    def missing() -> list[str]:
        """Return the engines without a result of this policy and evaluation."""
        policy = run.folder / "policy.onnx"
        inputs = {"policy": policy} if run.config is not None and policy.is_file() else {}
        hashes = {
            name: file_hash(file)
            for name, file in (inputs | {"demos": demos}).items()
            if file.is_file()
        }
        engines_left = []
        for engine in engines:
            file = folder / f"{engine}.json"
            result = read_result(file) if file.is_file() else None
            if result is None or not _is_of(result, evaluation, hashes):
                engines_left.append(engine)
        return engines_left

    def commands() -> list[list[str]]:
        policy = [str(run.folder)]
        if run.runs.policy:
            policy = [run.runs.policy, "--robot", run.runs.robot]
        options = {
            "demos": demos,
            "episodes": evaluation.episodes,
            "seed": evaluation.seed,
            "num-envs": evaluation.num_envs,
            "out": folder,
        }
        command = [*_XRESET, "eval", *policy, *config_flags(options, "--"), *subset.mesh_options]
        for engine in missing():
            command += ["--backend", engine]
        return [command]

    def left() -> str:
        engines_left = missing()
        return f"in {', '.join(engines_left)}" if engines_left else ""

    return Step(
        name=f"{key} {run.name}",
        kind="eval",
        writes=folder,
        left=left,
        commands=commands,
        needs=needs,
        run=run,
        objects=subset.objects or run.objects,
    )


def _is_of(result: EvalResult, evaluation: Evaluation, hashes: dict[str, str]) -> bool:
    """Return whether a result is of these episodes, and of files with these hashes."""
    same = result.seed == evaluation.seed and result.episodes_per_demo == evaluation.episodes
    return same and hashes.items() <= result.inputs.items()


# The plan -------------------------------------------------------------------------------------------------------------


@dataclass(kw_only=True)
class Plan:
    """A study's runs and steps."""

    study: Study
    name: str
    given: Path
    """Folder that the study's data are relative to."""
    out: Path
    objects: dict[str, tuple[str, ...]]
    """Data -> names of its objects."""
    unavailable: dict[str, str]
    """Engines that the study asks for and that cannot be used here -> why."""
    runs: list[Run] = field(default_factory=list)
    steps: dict[str, Step] = field(default_factory=dict)
    """Steps by name, in an order in which they can be done."""
    subsets: list[Subset] = field(default_factory=list)

    def subset(self, name: str, objects: Iterable[str], per_object: int | None) -> Subset:
        """Return the subset with the given objects; equal ones are the same."""
        data = self.study.data[name]
        chosen = tuple(sorted(objects))
        if data.demos is not None and chosen == self.objects[name]:
            chosen = ()
        made = Subset(
            name=name,
            data=data,
            given=self.given,
            out=self.out,
            objects=chosen,
            per_object=per_object,
        )
        if made not in self.subsets:
            self.subsets.append(made)
        return made

    def add(self, step: Step) -> str:
        """Add a step, unless there is one of its name, and return the name."""
        return self.steps.setdefault(step.name, step).name


def make_plan(study: Study, name: str, *, given: Path, out: Path, only: Iterable[str] = ()) -> Plan:
    """Find the runs and steps of a study, and refuse what does not fit the files in ``out``.

    Args:
        given: folder that the study's data are relative to.
        only: names of runs; empty: all.

    Raises:
        RunError: a run is unknown, or the folder of a run or an evaluation has another configuration.
        FileFormatError: a file of the data is missing or damaged, or a change of the recipe names an unknown key.
        ObjectError: the data do not have an object.
    """
    unknown = sorted(set(only) - set(study.runs))
    if unknown:
        raise RunError(
            f"the study has no runs {', '.join(unknown)}; it has {', '.join(study.runs)}."
        )
    engines: dict[str, None] = {}
    for evaluation in study.evaluations.values():
        engines |= dict.fromkeys(evaluation.engines)
    reasons = {engine: backend_status(engine).reason for engine in engines}
    plan = Plan(
        study=study,
        name=name,
        given=given,
        out=out,
        objects={key: _objects_of(data, given) for key, data in study.data.items()},
        unavailable={engine: reason for engine, reason in reasons.items() if reason is not None},
    )
    for group in study.runs:
        if not only or group in only:
            plan.runs += _runs(plan, group)
    trained: dict[Path, str] = {}
    for run in plan.runs:
        run.check()
        if run.config is not None:
            needs = [plan.add(bank_step(run.subset, run.runs.robot))]
            if run.weights in trained:
                needs.append(trained[run.weights])
            trained[run.folder] = plan.add(train_step(run, tuple(needs)))
    for run in plan.runs:
        for key in run.runs.evaluations or study.evaluations:
            _add_evaluation(plan, run, key, trained.get(run.folder))
    _check_folders(plan)
    for subset in plan.subsets:
        subset.check()
    return plan


def _check_folders(plan: Plan) -> None:
    """Raise ``RunError`` if two parts of the study would have the same folder."""
    owned = [(plan.out / name, "the study") for name in ("data", "logs", "reports")]
    owned += [(subset.folder, f"data.{subset.name}") for subset in plan.subsets]
    for run in plan.runs:
        owned += [
            (run.folder, f"runs.{run.group}"),
            (run.bank.parent, f"the robot {run.runs.robot}"),
        ]
    owners: dict[Path, str] = {}
    for folder, owner in owned:
        first = owners.setdefault(folder, owner)
        if first != owner:
            raise RunError(
                f"{first} and {owner} would both write {folder}. Give one of them another name."
            )


def _add_evaluation(plan: Plan, run: Run, key: str, training: str | None) -> None:
    """Add the step of an evaluation, if the run has objects of it and an engine is installed."""
    evaluation = plan.study.evaluations[key]
    data = evaluation.data or run.runs.data
    known = plan.objects[data]
    wanted = canonical_names(evaluation.objects, known) or known
    objects = [name for name in wanted if evaluation.unseen or name in run.objects]
    if not objects:
        return
    per_object = evaluation.per_object
    if per_object is None and data == run.runs.data:
        per_object = run.runs.per_object
    subset = plan.subset(data, objects, per_object)
    needs = [training] if training else []
    if run.runs.policy == "ik":
        needs = [plan.add(bank_step(subset, run.runs.robot))]
    engines = tuple(engine for engine in evaluation.engines if engine not in plan.unavailable)
    step = eval_step(run, key, evaluation, subset, engines, tuple(needs))
    if engines:
        plan.add(step)


def _objects_of(data: Data, given: Path) -> tuple[str, ...]:
    """Return the names of the objects of the data."""
    if data.demos is None:
        return object_names()
    return tuple(sorted(set(read_demos(given / data.demos).object_name.tolist())))


def _runs(plan: Plan, group: str) -> Iterator[Run]:
    """Yield the runs of a group."""
    spec = plan.study.runs[group]
    known = plan.objects[spec.data]
    objects = canonical_names(spec.objects, known) or known
    if spec.policy is not None:
        subset = plan.subset(spec.data, objects, spec.per_object)
        yield Run(
            group=group, runs=spec, seed=0, objects=objects, folder=plan.out / group, subset=subset
        )
        return
    changed = merged(asdict(starting_config(spec.recipe)), spec.config)
    config = from_dict(TrainConfig, changed, f"runs.{group}.config")
    if config.task.reward.own:
        raise RunError(
            f"runs.{group}.config.task.reward.own names code, which a study may not. Use xreset train."
        )
    if spec.steps is not None:
        iterations = round(spec.steps / (spec.num_envs * config.ppo.horizon))
        config = replace(config, iterations=max(1, iterations))
    for chosen in [(name,) for name in objects] if spec.alone else [objects]:
        for seed in spec.seeds:
            yield Run(
                group=group,
                runs=spec,
                seed=seed,
                objects=chosen,
                folder=_folder(plan, group, chosen, seed),
                subset=plan.subset(spec.data, chosen, spec.per_object),
                config=config,
                weights=_folder(plan, spec.weights, chosen, seed) if spec.weights else None,
            )


def _folder(plan: Plan, group: str, objects: tuple[str, ...], seed: int) -> Path:
    parts = [group]
    if plan.study.runs[group].alone:
        parts += [short_name(name, "_").replace("/", "_") for name in objects]
    return plan.out / "-".join([*parts, f"seed{seed}"])
