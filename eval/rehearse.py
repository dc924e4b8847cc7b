"""Rehearse a policy for a robot: play the same episodes through a robot's control loop, with one fault at a time.

The loop is that of a real robot (:mod:`xreset.runtime`), and an engine takes the place of the robot's driver. Faults
happen between the loop and the driver (:mod:`xreset.live.faults`). The results are curves as in
:mod:`xreset.eval.stress`.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import Any

from xreset.demos.synth import synthesize
from xreset.eval.pages import render
from xreset.eval.plots import COLORS, svg
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.eval.results import Episode
from xreset.eval.rollout import Engine, Round, Trial, chosen_engines, load_trial, play_rounds
from xreset.eval.sensitivity import REHEARSED, Property, amount, chosen, nominal_task
from xreset.eval.stress import (
    COSTLY,
    Curve,
    Point,
    Stress,
    by_property,
    draw_curves,
    plot_size,
    sweep,
    write_card,
)
from xreset.files.checks import PositiveInt, Seed, frozen
from xreset.files.progress import unseen
from xreset.files.storage import claim_folder, write_whole
from xreset.live.engine import make_controller
from xreset.live.faults import Faults, FaultyDriver
from xreset.resets.inputs import Data
from xreset.runtime import OnnxActor, Runner

SCHEMA = "xreset-rehearsal/1"


@frozen
class Rehearsal(Stress):
    """Contents of ``rehearsal/ENGINE.json``."""

    schema: str = SCHEMA
    stopped: dict[str, int] = field(default_factory=dict)
    """Reason why the runner stopped robots -> number of episodes that it stopped for this reason."""


CRITERIA = (
    ("pose-delay", 200, 0.03),
    ("action-delay", 67, 0.04),
    ("action-delay", 133, 0.10),
    ("published-faults", 1.0, 0.10),
)
"""Fault, its value, and the largest acceptable loss of task progress. The values are those of the published training;
the losses are this project's choice."""
LEAST = 0.5
"""Least task progress without faults of a policy that may be tried on a robot."""


def rehearse(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data | None = None,
    engines: str | Engine | Sequence[str | Engine] = "mujoco",
    *,
    faults: str | Sequence[str] = (),
    episodes: PositiveInt = 1,
    seed: Seed = 0,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    num_envs: PositiveInt = 64,
    device: str = "cpu",
    real_time: bool = False,
    out: str | Path | None = None,
    progress: Callable[[str, float, int], None] = unseen,
) -> list[Rehearsal]:
    """Rehearse a policy for a robot: play the same episodes with each fault in each engine, and write the results.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`; not a baseline.
        demos: demonstrations or retargeted motion, or a file of them: starts and goals. None: two synthetic
            demonstrations of each of the policy's objects.
        engines: a physics engine or its name, or several.
        faults: faults to try, as ``NAME`` or ``NAME=VALUE,VALUE...``; default: all that
            :data:`~xreset.eval.sensitivity.REHEARSED` lists.
        episodes: episodes of each demonstration, the same for every fault.
        seed: seed of starts and faults.
        robot: name or folder of the robot; default: the policy's own.
        meshes: folder of object meshes; default: the folder of the policy's training.
        num_envs: worlds that run at the same time.
        device: where GPU engines run: cpu or cuda.
        real_time: whether the simulation waits for the wall clock.
        out: folder for ``ENGINE.json`` and ``index.html``; default: ``rehearsal`` next to the policy's evaluations.
        progress: called with (engine, runs done, runs in all).

    Returns:
        The results that were written, in the order of the engines.

    Raises:
        PolicyError: the policy is a baseline, or the seed chose this checkpoint.
        XResetError: a fault is unknown or cannot have a value; nothing was played then.
    """
    properties = chosen(faults, REHEARSED)
    spec = load_policy(policy, robot=robot, seed=seed)
    spec.check_seed(seed)
    actor = OnnxActor(spec.exported())
    if demos is None:
        folder = spec.meshes_folder(meshes)
        demos = synthesize(spec.objects_of(folder), 2, meshes=folder)
    trial = load_trial(spec, demos, meshes=meshes, seed=seed, num_envs=num_envs)
    for prop in properties:
        for value in prop.values:
            _setting(trial, prop, value)
    played_engines = chosen_engines(engines, device)
    folder = Path(out) if out else spec.folder.parent / "rehearsal"
    found: list[Rehearsal] = []
    stopped: dict[str, Counter[str]] = defaultdict(Counter)

    def play(engine: Engine, prop: Property | None, value: float) -> tuple[Episode, ...]:
        changed, fault = _setting(trial, prop, value)
        return _play(actor, engine, changed, fault, episodes, real_time, stopped[engine.name])

    with claim_folder(folder):
        for engine in played_engines:
            card = sweep(Rehearsal, spec, trial, engine, properties, play, folder, progress)
            card = replace(card, stopped=dict(stopped[engine.name]))
            write_card(folder, card)
            found.append(card)
            write_whole(folder / "index.html", page(found))
    return found


def _setting(trial: Trial, prop: Property | None, value: float) -> tuple[Trial, Faults]:
    """Return the trial and the faults of one property at a value; None: nothing is changed.

    Raises:
        XResetError: the property cannot have the value.
    """
    task = nominal_task(trial.task)
    if prop is None:
        return replace(trial, task=task), Faults()
    if not prop.scaled:
        return replace(trial, task=prop.set_in(task, value)), Faults()
    sizes: dict[str, Any] = {name: factor * value for name, factor in prop.scaled.items()}
    try:
        return replace(trial, task=task), Faults(**prop.fixed, **sizes)
    except ValueError as error:
        raise prop.impossible(value, error) from None


class SimulatedRunner(Runner):
    """Runs simulated robots: Ctrl-C is raised, because an episode that it cuts short must not count."""

    def _interrupted(self) -> None:
        raise KeyboardInterrupt


def _play(
    actor: OnnxActor,
    engine: Engine,
    trial: Trial,
    fault: Faults,
    episodes: int,
    real_time: bool,
    stopped: Counter[str],
) -> tuple[Episode, ...]:
    """Play every demonstration through the loop with a fault; count in ``stopped`` why the runner stopped robots."""

    def play(played: Round) -> None:
        env = played.env
        controller = make_controller(env, actor)
        seeds = [
            (trial.seed, int(sequence), int(repetition))
            for sequence, repetition in zip(played.sequence, played.repetition, strict=True)
        ]
        driver = FaultyDriver(
            env, fault, seeds, lambda: played.update_metrics(env.reading()), real_time=real_time
        )
        outcome = SimulatedRunner(controller, driver).run(env.max_episode_length * controller.dt)
        for world in played.fresh:
            reason = outcome.reasons[world]
            if reason is not None:
                stopped[re.sub(r"-?\d+\.\d+", "...", reason)] += 1

    return play_rounds(engine, trial, episodes, play)


def judge(found: Sequence[Rehearsal]) -> tuple[str, list[str]]:
    """Return a sentence that says whether the policy may be tried on a robot, and the reasons against it.

    It may if every engine shows at least :data:`LEAST` without faults, and no loss beyond :data:`CRITERIA`.
    """
    against = []
    unsure = []
    tried = 0
    for card in found:
        if card.task_progress < LEAST:
            against.append(
                f"{card.engine}: only {100 * card.task_progress:.0f} % without any fault."
            )
        for curve, point, most in _deciding_points(card):
            tried += 1
            if -point.difference <= most:
                continue
            low, high = (-100 * bound for bound in reversed(point.difference_ci95))
            text = (
                f"{card.engine}: {curve.property.replace('-', ' ')} {amount(curve.unit, point.value)} costs "
                f"{-100 * point.difference:.1f} points (95 %: {round(low)} to {round(high)}). "
                f"At most {100 * most:.0f} are wanted."
            )
            reasons = against if low > 100 * most else unsure
            reasons.append(text)
    sentence = "Ready for a first, careful trial on a robot."
    if against:
        sentence = "Not ready for a robot."
    elif unsure:
        sentence = "Not shown to be ready: some losses may be too large. Play more episodes."
    elif tried < len(CRITERIA) * len(found):
        sentence = "No verdict: not every fault that decides was tried."
    return sentence, [*against, *unsure]


def _deciding_points(card: Rehearsal) -> Iterator[tuple[Curve, Point, float]]:
    """Yield the curve, the point and the largest acceptable loss of each of the :data:`CRITERIA` that was tried."""
    curves = {curve.property: curve for curve in card.curves}
    for option, value, most in CRITERIA:
        if option in curves:
            for point in curves[option].points:
                if point.value == value:
                    yield curves[option], point, most


def limits(found: Sequence[Stress]) -> list[tuple[str, list[str]]]:
    """Return a row for each fault: its name and, for each engine, the smallest value that costs ten points, as text."""
    rows = []
    for name, curves in by_property(found).items():
        rows.append(
            (name.replace("-", " "), [each.costs() if each else "cannot be set" for each in curves])
        )
    return rows


def page(found: Sequence[Rehearsal]) -> str:
    """Return the page of a rehearsal, in HTML."""
    sentence, reasons = judge(found)
    return render(
        "rehearsal.html.j2",
        sentence=sentence,
        reasons=reasons,
        found=found,
        colors=COLORS,
        limits=limits(found),
        chart=svg(lambda figure: draw_curves(figure, found), plot_size(found), "rehearsal"),
        costly=COSTLY,
    )
