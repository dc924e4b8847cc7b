"""What a comparison is made of: each training's configuration, learning curves and evaluations, as read from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from xreset.errors import FileFormatError, RunError
from xreset.eval.report.data import Curve, name_of, read_scalars, results_in
from xreset.eval.report.plots import short_name
from xreset.eval.results import EvalResult, read_episodes, read_results
from xreset.eval.rollout import Episode
from xreset.files import read_json
from xreset.learning.clock import FILE as LIFT_FILE
from xreset.learning.clock import Lift, read_lift
from xreset.learning.run import SCHEMA as RUN_SCHEMA
from xreset.policies import results_folder, shipped


class Fact(NamedTuple):
    """One property of a training."""

    value: Any
    """Two trainings agree in it if these are equal."""
    text: str
    """As shown."""


@dataclass(frozen=True, kw_only=True)
class Training:
    """One of the trainings, or baselines, that are compared."""

    label: str
    folder: Path
    facts: dict[str, Fact]
    """Its configuration by name of the field, such as ``task.reset.demo_probability``; empty where there is no ``run.json``."""
    scalars: dict[str, Curve]
    """TensorBoard tag -> curve; empty where there are no event files."""
    summaries: dict[str, EvalResult]
    """Engine -> ``BACKEND.json``."""
    episodes: dict[str, tuple[Episode, ...]]
    """Engine -> its episodes."""
    lift: Lift | None = None
    """When it first succeeded from home; None where there is no ``lift.json``."""


def read_trainings(runs: Sequence[str]) -> tuple[Training, ...]:
    """Read them all.

    Args:
        runs: as ``FOLDER`` or ``LABEL=FOLDER``: run folders, folders of results, or names of shipped policies (their ``runs/NAME``).

    Raises:
        RunError: none is given, a folder does not exist or holds nothing, or two have the same label or are the same folder.
        FileFormatError: a file is damaged or of another version.
    """
    if not runs:
        raise RunError("there is nothing to compare. Give run folders, or folders that xreset eval wrote results into.")
    named: dict[str, Path] = {}
    for text in runs:
        label, folder = _split(text)
        if label in named:
            raise RunError(
                f"{named[label]} and {folder} would both be called {label!r}. Name them: {label}-1={named[label]} {label}-2={folder}"
            )
        for other, known in named.items():
            if folder.resolve() == known.resolve():
                raise RunError(f"{other!r} and {label!r} are the same folder {folder}. Give every run once.")
        named[label] = folder
    return tuple(read_training(label, folder) for label, folder in named.items())


def read_training(label: str, folder: Path, results: Path | None = None) -> Training:
    """Read one; what is missing (configuration, curves or evaluations) is empty, but not all of them.

    Args:
        label: what to call it.
        folder: run folder, or folder of results.
        results: where its evaluations lie; default: as ``xreset eval`` puts them.

    Raises:
        RunError: the folder does not exist, or holds neither learning curves nor results.
        FileFormatError: a file is damaged or of another version.
    """
    results = results or results_in(folder)
    summaries = {}
    for summary in read_results(results):
        summaries[summary.backend] = summary
    episodes = {engine: read_episodes(results, engine) for engine in summaries}
    for engine, found in episodes.items():
        if not found or len(found) != summaries[engine].episodes:
            raise FileFormatError(
                f"{results / engine}.json tells of {summaries[engine].episodes} episodes, {engine}.episodes.json holds {len(found)}. "
                "They are not of the same evaluation; evaluate again."
            )
    scalars = read_scalars(folder)
    if not scalars and any(folder.glob("events.out.tfevents.*")):
        raise FileFormatError(
            f"the event files in {folder} hold no learning curve: they are damaged, or the training has not finished an iteration. "
            + (f"Compare its evaluations alone: {label}={results}" if summaries else "Leave it out, or compare later.")
        )
    lift = read_lift(folder) if (folder / LIFT_FILE).is_file() else None
    if not summaries and not scalars and lift is None:
        raise RunError(
            f"{folder} holds neither learning curves (events.out.tfevents.*) nor evaluation results. "
            f"Evaluate it first: xreset eval {folder} --backend mujoco --demos DEMOS"
        )
    file = folder / "run.json"
    facts = run_facts(read_json(file, RUN_SCHEMA), file) if file.is_file() else {}
    return Training(label=label, folder=folder, facts=facts, scalars=scalars, summaries=summaries, episodes=episodes, lift=lift)


def run_facts(run: dict[str, Any], file: Path) -> dict[str, Fact]:
    """The content of ``run.json``, flat.

    It is taken as it is, so that trainings of different versions of xreset can be compared. A reset bank is known by its hash, wherever
    the file lies; it was made with certain meshes, so their folder is known by whether there is one. A device is known by its kind: which
    of several GPUs it was says nothing.

    Args:
        run: content.
        file: named in messages.
    """
    kinds = {"robot": str, "resets": str, "resets_hash": str, "device": str, "seed": int, "config": dict}
    wrong = [name for name, kind in kinds.items() if not isinstance(run.get(name), kind)]
    contract, meshes, device = run.get("contract") or {}, run.get("objects"), str(run.get("device"))
    names = contract.get("objects") or [] if isinstance(contract, dict) else None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        wrong.append("contract")
    if wrong:
        raise FileFormatError(f"{file} lacks {', '.join(wrong)}, or holds it as another type. Train again, or leave this run out.")
    bank = str(run["resets_hash"])
    facts = {
        "robot": Fact((run["robot"], contract.get("robot_fingerprint")), str(run["robot"])),
        "objects": Fact(names, ", ".join(map(short_name, names or ())) or "-"),
        "meshes": Fact(meshes is None, "stand-ins" if meshes is None else str(meshes)),
        "bank": Fact(bank, f"{Path(run['resets']).name} ({bank[:8]})"),
        "weights": Fact(run.get("weights_hash"), str(run.get("weights") or "new")),
        "backend": _fact(f"{run.get('backend')} {run.get('backend_version')}"),
        "device": Fact(device.partition(":")[0], device),
        "num_envs": _fact(run.get("num_envs")),
        "seed": _fact(run["seed"]),
        "xreset": _fact(run.get("xreset")),
    }
    return facts | _flat(run["config"], "")


def _split(text: str) -> tuple[str, Path]:
    """Label and folder of an argument; a folder with a ``=`` in its name is one, too."""
    label, equals, rest = text.partition("=")
    if not equals or Path(text).is_dir():
        label, rest = "", text
    elif not label or not rest:
        raise RunError(f"{text!r} is not NAME=FOLDER: {'a name' if not label else 'a folder'} is missing.")
    folder = Path(rest)
    if not folder.exists() and rest in shipped():
        folder = results_folder(rest)
    return label or name_of(folder), folder


def _flat(data: dict[str, Any], prefix: str) -> dict[str, Fact]:
    facts = {}
    for name, value in data.items():
        facts |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: _fact(value)}
    return facts


def _fact(value: Any) -> Fact:
    if isinstance(value, list):
        return Fact(tuple(map(str, value)), ", ".join(_text(item) for item in value))
    return Fact(value, _text(value))


def _text(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.6g}" if isinstance(value, float) else str(value)
