"""The runs and steps of a study, in an order in which they can be done."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from xreset.demos.archive import read_demos
from xreset.errors import FileFormatError, RunError
from xreset.eval.study.file import Data, Study
from xreset.eval.study.steps import Run, Step, Subset, bank_todo, eval_todo, train_todo
from xreset.files.checks import from_dict, merged
from xreset.files.text import short_name
from xreset.learning.config import TrainConfig
from xreset.learning.recipes import starting_config
from xreset.objects.catalogue import canonical_names, object_names
from xreset.physics.plugins import backend_status
from xreset.resets.schedule import shared_worlds
from xreset.task.config import TaskConfig, with_episodes_of


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
    played: dict[tuple[str, str], set[str]] = field(default_factory=dict)
    """Run of the study and evaluation -> the objects that it is evaluated with."""
    parts: dict[Path, object] = field(default_factory=dict)
    """Folder -> the part of the study that writes into it."""

    def own(self, folder: Path, part: object) -> None:
        """Note which part of the study writes into a folder; refuse a second part with ``RunError``."""
        if self.parts.setdefault(folder, part) != part:
            raise RunError(
                f"Two parts of the study would both write {folder}. Give one of them another name."
            )

    def add(self, step: Step) -> str:
        """Add a step, and return its name."""
        self.steps[step.name] = step
        return step.name

    def subsets(self) -> list[Subset]:
        """Return the demonstrations that the study needs."""
        return [part for part in self.parts.values() if isinstance(part, Subset)]

    def subset(self, name: str, objects: Iterable[str], per_object: int | None) -> Subset:
        """Return the demonstrations of some objects of the data."""
        data = self.study.data[name]
        chosen = tuple(sorted(objects))
        if data.demos is not None and chosen == self.objects[name]:
            chosen = ()
        shown = "+".join(short_name(each, "_") for each in chosen).replace("/", "_")
        parts = filter(None, [name, shown, str(per_object or "")])
        folder = self.out / "data" / "-".join(parts)
        made = Subset(
            folder=folder, data=data, given=self.given, objects=chosen, per_object=per_object
        )
        self.own(folder, made)
        return made

    def bank(self, subset: Subset, robot: str) -> str:
        """Add the step to a reset bank, and return its name."""
        folder = subset.robot(robot)
        self.own(folder, robot)
        name = f"data {subset.folder.name} {folder.name}"
        return self.add(Step(name, "data", folder, partial(bank_todo, subset, robot)))

    def train(self, run: Run) -> None:
        """Add the steps of a training."""
        needs = [self.bank(run.subset, run.spec.robot)]
        earlier = f"train {run.weights.name}" if run.weights else ""
        if earlier in self.steps:
            needs.append(earlier)
        name = f"train {run.folder.name}"
        self.add(Step(name, "train", run.folder, partial(train_todo, run), needs))

    def evaluate(self, run: Run, key: str) -> None:
        """Add the step of an evaluation, if the run can play some of its objects and an engine is installed."""
        spec = self.study.evaluations[key]
        data = spec.data or run.spec.data
        known = self.objects[data]
        wanted = canonical_names(spec.objects, known) or known
        objects = [name for name in wanted if name in run.objects]
        engines = [engine for engine in spec.engines if engine not in self.unavailable]
        if not objects:
            return
        if spec.episode_seconds is not None:
            task = TaskConfig() if run.config is None else run.config.task
            with_episodes_of(task, spec.episode_seconds)  # refuses less than a control step
        self.played.setdefault((run.group, key), set()).update(objects)
        if not engines:
            return
        per_object = spec.per_object
        if per_object is None and data == run.spec.data:
            per_object = run.spec.per_object
        subset = self.subset(data, objects, per_object)
        needs = [] if run.spec.policy else [f"train {run.folder.name}"]
        if run.spec.policy == "ik":
            needs.append(self.bank(subset, run.spec.robot))
        name = f"{key} {run.folder.name}"
        folder = run.folder / key
        todo = partial(eval_todo, run, folder, spec, subset, engines)
        self.add(Step(name, "eval", folder, todo, needs))


def make_plan(study: Study, name: str, *, given: Path, out: Path, only: Iterable[str] = ()) -> Plan:
    """Find the runs and steps of a study, and refuse what does not fit the files in ``out``.

    Args:
        given: folder that the study's data are relative to.
        only: names of runs; empty: all.

    Raises:
        RunError: a run is unknown, or the folder of a run or an evaluation has another configuration.
        FileFormatError: a file of the data is missing or damaged, or a change of the recipe names an unknown key.
        ObjectError: the data do not have an object.
        XResetError: a run cannot share its worlds among its objects as configured, or an evaluation's episodes are too
            short.
    """
    unknown = sorted(set(only) - set(study.runs))
    if unknown:
        raise RunError(
            f"the study has no runs {', '.join(unknown)}; it has {', '.join(study.runs)}."
        )
    objects = {key: _objects_of(data, given) for key, data in study.data.items()}
    unavailable = {}
    for evaluation in study.evaluations.values():
        for engine in evaluation.engines:
            if reason := backend_status(engine).reason:
                unavailable[engine] = reason
    plan = Plan(
        study=study,
        name=name,
        given=given,
        out=out,
        objects=objects,
        unavailable=unavailable,
        parts={out / folder: None for folder in ("data", "reports")},
    )
    for group in study.runs:
        if not only or group in only:
            plan.runs += _runs(plan, group)
    for run in plan.runs:
        plan.own(run.folder, run)
        run.check()
        if run.config is not None:
            plan.train(run)
    for run in plan.runs:
        for key in study.evaluations:
            plan.evaluate(run, key)
    for subset in plan.subsets():
        subset.is_made()
    return plan


def _objects_of(data: Data, given: Path) -> tuple[str, ...]:
    """Return the names of the objects of the data."""
    if data.demos is None:
        return object_names()
    if not (given / data.demos).is_file():
        raise FileFormatError(
            f"The archive {given / data.demos} of the study does not exist. Put it there, or give the folder of the "
            "study's data (--data). docs/studies.md says how archives are made."
        )
    return tuple(sorted(set(read_demos(given / data.demos).object_name.tolist())))


def _runs(plan: Plan, group: str) -> Iterator[Run]:
    """Yield the runs of a group."""
    spec = plan.study.runs[group]
    known = plan.objects[spec.data]
    objects = canonical_names(spec.objects, known) or known
    if spec.policy is not None:
        subset = plan.subset(spec.data, objects, spec.per_object)
        yield Run(group=group, spec=spec, objects=objects, subset=subset, folder=plan.out / group)
        return
    changed = merged(asdict(starting_config(spec.recipe)), spec.config)
    config = from_dict(TrainConfig, changed, f"runs.{group}.config")
    if own := ", ".join(config.task.reward.own):
        raise RunError(
            f"runs.{group}.config.task.reward.terms names code ({own}), which a study may not. Use xreset train."
        )
    if spec.steps is not None:
        iterations = round(spec.steps / (spec.num_envs * config.ppo.horizon))
        config = replace(config, iterations=max(1, iterations))
    trained_together = [(name,) for name in objects] if spec.alone else [objects]
    for chosen in trained_together:
        share = config.task.reset.object_share
        shared_worlds(chosen, spec.num_envs, share)  # refuses an unknown object
        for seed in spec.seeds:
            yield Run(
                group=group,
                spec=spec,
                objects=chosen,
                subset=plan.subset(spec.data, chosen, spec.per_object),
                folder=_folder(plan, group, chosen, seed),
                seed=seed,
                config=config,
                weights=_folder(plan, spec.weights, chosen, seed) if spec.weights else None,
            )


def _folder(plan: Plan, group: str, objects: tuple[str, ...], seed: int) -> Path:
    parts = [group]
    if plan.study.runs[group].alone:
        parts += [short_name(name, "_").replace("/", "_") for name in objects]
    return plan.out / "-".join([*parts, f"seed{seed}"])
