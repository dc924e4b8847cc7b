"""What a study consists of: trainings by object and seed, and the steps that make them; each knows whether it is done.

    OUT/data/SUBSET/demos.npz               demonstrations of a subset of the data, and of what it was made (subset.json)
    OUT/data/SUBSET/ROBOT/resets.npz        what xreset retarget and xreset resets made of them
    OUT/RUN/                                the run folder of xreset train; eval/ and eval-NAME/ are its evaluations
    OUT/logs/STEP.log                       what the commands of a step printed

Studies that share OUT share what is in it: a run of the same name and configuration is trained once.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from xreset.checks import from_dict
from xreset.demos.archive import read_demos
from xreset.errors import DemoError, FileFormatError, RunError, XResetError
from xreset.eval.study.file import Data, Evaluation, Runs, Study, merged
from xreset.eval.study.subset import Subset, refuse_other
from xreset.files import file_hash, is_claimed
from xreset.learning.clock import Lift, read_lift
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import starting_config
from xreset.learning.run import checkpoints, latest_checkpoint, read_run
from xreset.objects.catalogue import canonical_name, object_names
from xreset.plugins import backend_status
from xreset.text import short_name, shown

if TYPE_CHECKING:
    from xreset.eval.results import EvalResult

Kind = Literal["data", "train", "eval"]
_ENOUGH = 0.97
"""Share of the minutes from which a training counts as done: what is left would cost more to start than it is."""
_XRESET = [sys.executable, "-m", "xreset"]


@dataclass(frozen=True, kw_only=True)
class Run:
    """One training, or one baseline."""

    group: str
    """Its name in the study, shared with those of other seeds and objects."""
    runs: Runs
    seed: int
    objects: tuple[str, ...]
    folder: Path
    subset: Subset
    config: TrainConfig | None
    """None: a baseline."""
    weights: Path | None

    @property
    def name(self) -> str:
        """Of its folder."""
        return self.folder.name

    @property
    def bank(self) -> Path:
        """Its reset bank."""
        return self.subset.folder / Path(self.runs.robot).name / "resets.npz"

    @property
    def begun(self) -> bool:
        """Whether there is anything of the training; a policy that was brought here without its checkpoints is."""
        return bool(checkpoints(self.folder)) or (self.folder / "policy.onnx").is_file()

    def trained(self) -> Lift:
        """How far it has come: what its newest checkpoint says, or else its lift clock."""
        if not checkpoints(self.folder):
            return read_lift(self.folder)
        from xreset.learning.checkpoint import read_checkpoint

        content = read_checkpoint(latest_checkpoint(self.folder))
        return Lift(
            iteration=int(content["iteration"]),
            env_steps=int(content["env_steps"]),
            minutes=float(content["elapsed"]) / 60,
        )

    def check(self) -> None:
        """Refuse a folder with a run of another configuration. Its length is no part of that: it can go on."""
        if self.config is None or not self.begun:
            return
        info = read_run(self.folder)
        both = {  # there, and wanted
            "robot": (info.robot, self.runs.robot),
            "backend": (info.backend, self.runs.backend),
            "num_envs": (info.num_envs, self.runs.num_envs),
            "seed": (info.seed, self.seed),
            "stand-ins": (info.objects is None, self.subset.data.meshes is None),
            "other networks to begin with": (info.weights is not None, self.weights is not None),
            "config": (_lasting(info.config), _lasting(self.config)),
        }
        if self.bank.is_file():
            both["reset bank"] = info.resets_hash[:12], file_hash(self.bank)[:12]
        there, wanted = ({name: values[i] for name, values in both.items()} for i in (0, 1))
        refuse_other(f"{self.folder} holds a run of another configuration", "runs", there, wanted)


def _lasting(config: TrainConfig) -> dict[str, Any]:
    return asdict(replace(config, iterations=1, save_interval=1))


@dataclass(frozen=True, kw_only=True)
class Step:
    """Something that commands of ``xreset`` make."""

    name: str
    needs: tuple[str, ...]
    """Names of the steps before it."""
    writes: Path
    """Folder that its commands keep to themselves meanwhile."""
    kind: Kind
    gpus: int = 0

    def done(self) -> bool:
        """Whether there is nothing to do."""
        raise NotImplementedError

    def commands(self) -> list[list[str]]:
        """What is to be done now, in order."""
        raise NotImplementedError

    def busy(self) -> bool:
        """Return whether another process is writing this step's folder."""
        return is_claimed(self.writes)


@dataclass(frozen=True, kw_only=True)
class BankStep(Step):
    """Demonstrations to reset bank, for one robot."""

    subset: Subset
    robot: str

    def done(self) -> bool:
        return (self.writes / "resets.npz").is_file()

    def commands(self) -> list[list[str]]:
        retargeted, data = self.writes / "retargeted.npz", self.subset.data
        retarget = [*_XRESET, "retarget", str(self.subset.demos), "--robot", self.robot, "--out", str(retargeted)]
        resets = [*_XRESET, "resets", str(retargeted), "--out", str(self.writes / "resets.npz")]
        if Path(self.robot).is_dir():
            resets += ["--robot", self.robot]
        found = [] if retargeted.is_file() else [[*retarget, *self.subset.meshes, *data.retarget]]
        return [*found, [*resets, *self.subset.meshes, *data.resets]]


@dataclass(frozen=True, kw_only=True)
class TrainStep(Step):
    """A training, from the beginning or from where it was."""

    run: Run

    def done(self) -> bool:
        run = self.run
        assert run.config is not None
        now = run.trained()
        return now.iteration >= run.config.iterations or (
            run.runs.minutes is not None and now.minutes >= _ENOUGH * run.runs.minutes
        )

    def commands(self) -> list[list[str]]:
        run, spec = self.run, self.run.runs
        assert run.config is not None
        command = [*_XRESET, "train", "--out", str(run.folder), "--iterations", str(run.config.iterations)]
        if spec.gpus > 1:
            processes = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(spec.gpus)]
            command = [sys.executable, *processes, *command[1:]]
        if spec.minutes is not None:
            command += ["--minutes", f"{spec.minutes - run.trained().minutes:.4g}"]
        if checkpoints(run.folder):
            return [[*command, "--resume"]]
        if run.begun:
            raise RunError(
                f"{run.folder} cannot go on: it has a policy and no checkpoint. Bring its checkpoints, or choose another --out."
            )
        command += ["--robot", spec.robot, "--resets", str(run.bank), *run.subset.meshes, "--backend", spec.backend]
        command += [
            "--device",
            spec.device,
            "--num-envs",
            str(spec.num_envs),
            "--seed",
            str(run.seed),
            "--like",
            spec.recipe,
        ]
        if run.weights is not None:
            command += ["--weights", str(run.weights)]
        return [command + list(flags(spec.config))]


def flags(changes: dict[str, Any], prefix: str = "--config.") -> Iterator[str]:
    """Changes of a configuration as ``xreset train`` takes them."""
    for name, value in changes.items():
        flag = name.replace("_", "-")
        if isinstance(value, dict):
            yield from flags(value, f"{prefix}{flag}.")
        elif isinstance(value, bool):
            yield f"{prefix}{flag}" if value else f"{prefix}no-{flag}"
        else:
            yield prefix + flag
            yield from map(str, value if isinstance(value, list | tuple) else [value])


def _result(folder: Path, engine: str) -> EvalResult | None:
    from xreset.eval.results import read_result  # imports torch, which a job does not need

    file = folder / f"{engine}.json"
    return read_result(file) if file.is_file() else None


@dataclass(frozen=True, kw_only=True)
class EvalStep(Step):
    """An evaluation of one run in the engines that are there."""

    run: Run
    evaluation: Evaluation
    subset: Subset
    engines: tuple[str, ...]
    """Those that can be used here."""

    @property
    def demos(self) -> Path:
        """Starts and goals; for ik, the trajectories too."""
        folder = self.subset.folder
        return (
            folder / Path(self.run.runs.robot).name / "retargeted.npz"
            if self.run.runs.policy == "ik"
            else self.subset.demos
        )

    def check(self) -> None:
        """Refuse results of other episodes under this name."""
        for engine in self.evaluation.engines:
            if (result := _result(self.writes, engine)) is None:
                continue
            settings: dict[str, Any] = {
                "robot": result.robot,
                "seed": result.seed,
                "episodes_per_demo": result.episodes_per_demo,
            }
            wanted: dict[str, Any] = {
                "robot": Path(self.run.runs.robot).name, "seed": self.evaluation.seed, "episodes_per_demo": self.evaluation.episodes,
            }  # fmt: skip
            if self.demos.is_file():
                settings["demos"], wanted["demos"] = result.inputs.get("demos", "")[:12], file_hash(self.demos)[:12]
            refuse_other(
                f"{self.writes / engine}.json is an evaluation of another kind", "evaluation", settings, wanted
            )

    def missing(self) -> list[str]:
        """Engines that are there and have no result of this policy."""
        policy = self.run.folder / "policy.onnx"
        digest = file_hash(policy) if self.run.config is not None and policy.is_file() else None
        found = {engine: _result(self.writes, engine) for engine in self.engines}
        return [e for e, result in found.items() if result is None or result.inputs.get("policy") != digest]

    def done(self) -> bool:
        return not self.missing()

    def commands(self) -> list[list[str]]:
        run, e = self.run, self.evaluation
        policy = run.folder / "policy.onnx" if run.begun and not checkpoints(run.folder) else run.folder
        command = [
            *_XRESET,
            "eval",
            *([run.runs.policy, "--robot", run.runs.robot] if run.runs.policy else [str(policy)]),
        ]
        command += [
            "--demos",
            str(self.demos),
            "--episodes",
            str(e.episodes),
            "--seed",
            str(e.seed),
            "--num-envs",
            str(e.num_envs),
        ]
        for engine in self.missing():
            command += ["--backend", engine]
        return [[*command, *self.subset.meshes, "--out", str(self.writes)]]


@dataclass(frozen=True, kw_only=True)
class Plan:
    """A study's runs and steps."""

    study: Study
    name: str
    out: Path
    runs: tuple[Run, ...]
    steps: dict[str, Step]
    """By name, in the order in which they can be done."""
    subsets: tuple[Subset, ...]
    unavailable: dict[str, str]
    """Engines that the study asks for and that are not there -> why not."""


def make_plan(study: Study, name: str, *, given: Path, out: Path, only: Iterable[str] = ()) -> Plan:
    """Find out what a study consists of, and refuse what does not fit what is there.

    Args:
        given: folder that the study's data are relative to.
        only: names of runs; none: all.

    Raises:
        RunError: there is no such run, or what is there under a run's name, or an evaluation's, is of another configuration.
        FileFormatError: a file of the data is missing or damaged, or a change of the recipe names an unknown key.
        DemoError: the data do not have an object.
    """
    if unknown := sorted(set(only) - set(study.runs)):
        raise RunError(f"the study has no runs {', '.join(unknown)}; it has {', '.join(study.runs)}.")
    there = {name: _objects_of(name, data, given) for name, data in study.data.items()}
    subsets: dict[Path, Subset] = {}

    def subset(name: str, objects: Iterable[str], per_object: int | None) -> Subset:
        chosen = tuple(sorted(objects))
        whole = chosen == there[name] and study.data[name].demos is not None
        made = Subset(
            name=name, data=study.data[name], given=given, out=out, objects=() if whole else chosen, per_object=per_object,
        )  # fmt: skip
        return subsets.setdefault(made.folder, made)

    runs = tuple(
        run
        for group, spec in study.runs.items()
        if not only or group in only
        for run in _runs(study, group, spec, _named(f"runs.{group}", spec.objects, there[spec.data]), out, subset)
    )
    available, unavailable = _engines(engine for e in study.evaluations.values() for engine in e.engines)
    steps: dict[str, Step] = {}

    def add(step: Step) -> str:
        return steps.setdefault(step.name, step).name

    def bank(of: Subset, robot: str) -> str:
        writes = of.folder / Path(robot).name
        return add(
            BankStep(
                name=f"data {of.folder.name} {writes.name}",
                needs=(),
                writes=writes,
                kind="data",
                subset=of,
                robot=robot,
            )
        )

    evaluations = []
    trained = {run.folder: f"train {run.name}" for run in runs if run.config is not None}
    for run in sorted(runs, key=lambda run: run.weights is not None):
        run.check()
        if run.config is not None:
            needs = (bank(run.subset, run.runs.robot), *([trained[run.weights]] if run.weights in trained else []))
            gpus = run.runs.gpus if run.runs.device == "cuda" else 0
            add(TrainStep(name=f"train {run.name}", needs=needs, writes=run.folder, kind="train", gpus=gpus, run=run))
    for run in runs:
        for key in run.runs.evaluations or study.evaluations:
            evaluation = study.evaluations[key]
            data = evaluation.data or run.runs.data
            wanted = _named(f"evaluations.{key}", evaluation.objects, there[data])
            objects = [name for name in run.objects if name in wanted]
            if not objects:
                continue
            own = data == run.runs.data
            of = subset(data, objects, evaluation.per_object or (run.runs.per_object if own else None))
            needs = (
                (bank(of, run.runs.robot),)
                if run.runs.policy == "ik"
                else (trained[run.folder],)
                if run.config is not None
                else ()
            )
            step = EvalStep(
                name=f"{key} {run.name}", needs=needs, writes=run.folder / key, kind="eval", run=run, evaluation=evaluation, subset=of,
                engines=tuple(e for e in evaluation.engines if e in available),
            )  # fmt: skip
            evaluations.append(step)
    for step in evaluations:
        step.check()
        if step.engines:
            add(step)
    for made in subsets.values():
        made.check()
    return Plan(
        study=study,
        name=name,
        out=out,
        runs=runs,
        steps=steps,
        subsets=tuple(subsets.values()),
        unavailable=unavailable,
    )


def _objects_of(name: str, data: Data, given: Path) -> tuple[str, ...]:
    if data.demos is None:
        return object_names()
    for what, file in (("demos", data.demos), ("meshes", data.meshes)):
        if file is not None and not (given / file).exists():
            raise FileFormatError(
                f"there is no {given / file} (data.{name}.{what}). Put it there, or say with --data where it is."
            )
    names = tuple(sorted(set(read_demos(given / data.demos).object_name.tolist())))
    for object_name in names:
        if "/" in object_name:
            raise FileFormatError(
                f"{given / data.demos} (data.{name}.demos) has the object {shown(object_name)}: "
                "a name with a slash cannot become the name of a folder. Rename the object."
            )
    return names


def _named(where: str, objects: tuple[str, ...], there: tuple[str, ...]) -> tuple[str, ...]:
    try:
        return tuple(canonical_name(name, there) for name in objects) or there
    except XResetError as error:
        raise DemoError(f"{where}.objects: {error}") from None


def _runs(study: Study, group: str, spec: Runs, objects: tuple[str, ...], out: Path, subset: Any) -> Iterator[Run]:
    """The runs of a group."""
    config, seeds = None, (0,)
    if spec.policy is None:
        base = asdict(starting_config(spec.recipe))
        config, seeds = from_dict(TrainConfig, merged(base, spec.config), f"runs.{group}.config"), spec.seeds
        if spec.steps is not None:
            config = replace(
                config, iterations=max(1, round(spec.steps / (spec.num_envs * spec.gpus * config.ppo.horizon)))
            )
    weights = study.runs[spec.weights] if spec.weights and config else None
    for chosen in [(name,) for name in objects] if spec.alone and config else [objects]:
        for seed in seeds:
            yield Run(
                group=group,
                runs=spec,
                seed=seed,
                objects=chosen,
                folder=_folder(out, group, spec, chosen, seed) if config else out / group,
                subset=subset(spec.data, chosen, spec.per_object),
                config=config,
                weights=_folder(out, str(spec.weights), weights, chosen, seed) if weights else None,
            )


def _folder(out: Path, group: str, spec: Runs, objects: tuple[str, ...], seed: int) -> Path:
    return out / "-".join([group, *(short_name(name, "_") for name in (objects if spec.alone else ())), f"seed{seed}"])


def _engines(wanted: Iterable[str]) -> tuple[list[str], dict[str, str]]:
    statuses = [backend_status(name) for name in dict.fromkeys(wanted)]
    return [s.name for s in statuses if s.reason is None], {s.name: s.reason for s in statuses if s.reason is not None}
