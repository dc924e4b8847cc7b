"""Rehearse a policy for a robot: the same episodes through the loop of a robot, with one of its faults at a time.

The loop is that of a real robot (:mod:`xreset.runtime`), the engines are its drivers, and the faults happen between the
two (:mod:`xreset.live.faults`). The results are curves as in :mod:`xreset.eval.stress`.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from xreset.demos.synth import synthesize
from xreset.errors import XResetError
from xreset.eval.metrics import EpisodeMetrics, MetricsConfig
from xreset.eval.pages import render
from xreset.eval.plots import COLORS, svg
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.eval.rollout import Episode, Round, episode_of, episode_starts, play_rounds
from xreset.eval.sensitivity import SWEEPS, Property, amount, chosen, nominal_task
from xreset.eval.stress import COSTLY, Curve, Point, Stress, curve, draw_curves, plot_size
from xreset.eval.trial import Engine, Trial, engine, load_trial
from xreset.files import claim_folder, write_json, write_whole
from xreset.inputs import Data
from xreset.live.engine import begin, make_controller
from xreset.live.faults import Faults, FaultyDriver
from xreset.plugins import backend_class
from xreset.resets.distribution import Reset
from xreset.runtime import Controller, OnnxActor, Runner
from xreset.task.terminations import out_of_bounds

SCHEMA = "xreset-rehearsal/1"
_FRAME = 1 / 30
"""Time between the poses of a tracker in all faults of trackers [s]."""
_DEGREE = math.pi / 180


def _tracked(**changes: float) -> Faults:
    return replace(Faults(tracker_interval=_FRAME), **changes)


def _published(share: float) -> Faults:
    """Return the faults of the published training (table A3) at once, at a share of their ranges.

    The sizes of pushes are those of the recipe ``live``, because a push in that table has no duration.
    """
    return Faults(
        tracker_interval=_FRAME,
        pose_delay=0.2 * share,
        pose_jitter=_FRAME / 2 * share,
        position_noise=0.005 * share,
        position_bias=0.005 * share,
        angle_noise=3.75 * _DEGREE * share,
        angle_bias=3.75 * _DEGREE * share,
        arm_delay=0.05 * share,
        hand_delay=0.133 * share,
        object_push=0.5 * share,
        arm_push=0.25 * share,
        drawn_delays=True,
    )


def _fault(name: str, unit: str, *values: float, needs_wrench: bool = False) -> Property:
    return Property(name=name, unit=unit, values=values, nominal=0.0, needs="object_wrench" if needs_wrench else None)


LOOP: dict[Property, Callable[[float], Faults]] = {
    _fault("tracker interval", "ms", 33, 67, 100): lambda x: Faults(tracker_interval=x / 1000),
    _fault("pose delay", "ms", 33, 100, 200): lambda x: _tracked(pose_delay=x / 1000, pose_jitter=0.2 * x / 1000),
    _fault("position noise", "mm", 5, 10): lambda x: _tracked(position_noise=x / 1000),
    _fault("position bias", "mm", 5, 10): lambda x: _tracked(position_bias=x / 1000),
    _fault("angle noise", "degrees", 3.75, 7.5): lambda x: _tracked(angle_noise=x * _DEGREE),
    _fault("angle bias", "degrees", 3.75, 7.5): lambda x: _tracked(angle_bias=x * _DEGREE),
    _fault("lost frames", "s", 0.25, 0.5): lambda x: _tracked(lost_frames=x),
    _fault("action delay", "ms", 17, 33, 67, 133): lambda x: Faults(arm_delay=x / 1000, hand_delay=x / 1000),
    _fault("missed deadlines", "% of the steps", 5, 20): lambda x: Faults(missed_deadlines=x / 100),
    _fault("object push", "m/s", 0.25, 0.5, 1.0, needs_wrench=True): lambda x: Faults(object_push=x),
    _fault("arm push", "of the torque", 0.25, 0.5, 1.0): lambda x: Faults(arm_push=x),
    _fault("published faults", "times their ranges", 0.5, 1.0, needs_wrench=True): _published,
}
"""Faults of the loop, and what makes them of a value in the property's unit."""
_MAKERS = {prop.name: make for prop, make in LOOP.items()}


def _physical() -> tuple[Property, ...]:
    by_name = {prop.name: prop for prop in SWEEPS}
    gain = replace(by_name["force gain"], values=(0.0, 0.5, 2.0))
    return by_name["object mass"], by_name["object friction"], gain


PROPERTIES = (*LOOP, *_physical())
"""All that is tried, in the order of the page. The physical properties are those of :mod:`xreset.eval.sensitivity`; a
force gain of 0 is a robot that does not measure forces."""


@dataclass(frozen=True, kw_only=True)
class Rehearsal(Stress):
    """Contents of ``rehearsal/BACKEND.json``."""

    schema: str = SCHEMA
    stopped: dict[str, int] = field(default_factory=dict)
    """Why the runner stopped robots, and how many episodes it stopped for this reason."""


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """What a policy may lose at most, to be tried on a robot."""

    option: str
    value: float
    most: float
    """Points of task progress, as a share."""


CRITERIA = (
    Criterion(option="pose-delay", value=200, most=0.03),
    Criterion(option="action-delay", value=67, most=0.04),
    Criterion(option="action-delay", value=133, most=0.10),
    Criterion(option="published-faults", value=1.0, most=0.10),
)
"""The ranges are those of the published training; the bounds are this project's choice."""
LEAST = 0.5
"""Task progress without faults, below which a policy is not worth a robot."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Whether a policy may be tried on a robot, and why."""

    sentence: str
    reasons: tuple[str, ...]


def rehearse(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data | None = None,
    engines: str | Sequence[str | Engine] = "mujoco",
    *,
    faults: Sequence[str] = (),
    episodes: int = 1,
    seed: int = 0,
    robot: str | Path | None = None,
    objects: str | Path | None = None,
    num_envs: int = 64,
    device: str = "cpu",
    real_time: bool = False,
    out: str | Path | None = None,
    progress: Callable[[str, int, int], None] = lambda name, done, total: None,
) -> list[Rehearsal]:
    """Rehearse a policy for a robot: play the same episodes with each fault in each engine, and write the results.

    Args:
        policy: the policy or its name, as for :func:`~xreset.eval.policy_spec.load_policy`; no baseline.
        demos: demonstrations or retargeted motion, or a file of them: starts and goals. None: two synthetic
            demonstrations of each of the policy's objects.
        engines: name of a physics engine, or several.
        faults: faults to try, as ``NAME`` or ``NAME=VALUE,VALUE...``; default: all of :data:`PROPERTIES`.
        episodes: episodes of each demonstration, the same for every fault.
        seed: seed of starts and faults.
        robot: name or folder of the robot; default: the policy's own.
        objects: folder of object meshes; default: the folder of the policy's training.
        num_envs: worlds that run at the same time.
        device: where GPU engines run: cpu or cuda.
        real_time: whether the simulation waits for the wall clock.
        out: folder for ``ENGINE.json`` and ``index.html``; default: ``rehearsal`` next to the policy's evaluations.
        progress: called with (engine, episodes done, episodes in all).

    Returns:
        The results that were written, in the order of the engines. :func:`judge` has the verdict.

    Raises:
        PolicyError: the policy is a baseline, or the seed chose this checkpoint.
        XResetError: a fault is unknown or cannot have a value; nothing was played then.
    """
    properties = chosen(faults, PROPERTIES)
    spec = policy if isinstance(policy, PolicySpec) else load_policy(policy, robot=robot, seed=seed)
    spec.check_seed(seed)
    actor = OnnxActor(spec.exported().read_bytes())
    if demos is None:
        demos = synthesize(spec.objects or (), 2, meshes=objects or spec.objects_folder)
    trial = load_trial(spec, demos, objects=objects, seed=seed, num_envs=num_envs)
    for prop in properties:
        for value in prop.values:
            _setting(trial, prop, value)
    wanted = (engines,) if isinstance(engines, str) else engines
    opened = [engine(each, device=device) if isinstance(each, str) else each for each in wanted]
    folder = Path(out) if out else spec.folder.parent / "rehearsal"
    with claim_folder(folder):
        return _rehearsed(spec, actor, trial, opened, properties, episodes, real_time, folder, progress)


def _rehearsed(
    policy: PolicySpec,
    actor: OnnxActor,
    trial: Trial,
    engines: Sequence[Engine],
    properties: Sequence[Property],
    repetitions: int,
    real_time: bool,
    out: Path,
    progress: Callable[[str, int, int], None],
) -> list[Rehearsal]:
    found: list[Rehearsal] = []
    for place in engines:
        able = backend_class(place.name).capabilities
        usable = [prop for prop in properties if prop.needs is None or prop.needs in able]
        settings: list[tuple[Property, float]] = []
        for prop in usable:
            settings += [(prop, value) for value in prop.values]
        total = (1 + len(settings)) * repetitions * len(trial.bank.sequence_name)

        def count(done: int, name: str = place.name, total: int = total) -> None:
            progress(name, done, total)

        player = _Player(actor, place, repetitions, real_time, count)
        # Faults of the loop can differ from world to world, so they are played together.
        in_loop = [(prop, value) for prop, value in settings if prop.name in _MAKERS]
        faults = [Faults(), *(_setting(trial, prop, value)[1] for prop, value in in_loop)]
        nominal, *others = player.play(replace(trial, task=nominal_task(trial.task)), faults)
        episodes = dict(zip(in_loop, others, strict=True))
        for prop, value in settings:
            if (prop, value) not in episodes:
                changed, fault = _setting(trial, prop, value)
                (episodes[prop, value],) = player.play(changed, [fault])
        curves = []
        for prop in usable:
            swept = {value: episodes[prop, value] for value in prop.values}
            curves.append(curve(prop, nominal, swept))
        card = Rehearsal.of(
            policy,
            trial,
            place,
            nominal,
            curves=tuple(curves),
            left_out=tuple(prop.option for prop in properties if prop not in usable),
            stopped=dict(player.stopped),
        )
        write_json(out / f"{place.name}.json", asdict(card))
        found.append(card)
        write_whole(out / "index.html", page(found))
    return found


def _setting(trial: Trial, prop: Property, value: float) -> tuple[Trial, Faults]:
    """Return what is played with one property at a value.

    Raises:
        XResetError: the property cannot have the value.
    """
    make = _MAKERS.get(prop.name)
    if make is None:
        return replace(trial, task=prop.set_in(nominal_task(trial.task), value)), Faults()
    try:
        return replace(trial, task=nominal_task(trial.task)), make(value)
    except ValueError as error:
        raise XResetError(f"{prop.option} {amount(prop.unit, value)} cannot be tried: {error}.") from None


class _Player:
    """Plays episodes through the loop in one engine."""

    def __init__(
        self,
        actor: OnnxActor,
        engine: Engine,
        repetitions: int,
        real_time: bool,
        count: Callable[[int], None],
    ) -> None:
        self._actor = actor
        self._engine = engine
        self._repetitions = repetitions
        self._real_time = real_time
        self._count = count
        self._done = 0
        self.stopped: Counter[str] = Counter()

    def play(self, trial: Trial, faults: Sequence[Faults]) -> list[tuple[Episode, ...]]:
        """Play every demonstration with each of the faults; return the episodes of each."""
        bank = trial.bank
        demonstrations = np.repeat(np.arange(len(bank.sequence_name)), self._repetitions)
        sequence = np.tile(demonstrations, len(faults))
        repetition = np.tile(np.arange(self._repetitions), len(sequence) // self._repetitions)
        objects = [trial.names.index(name) for name in bank.sequence_object[sequence]]
        starts = trial.starts()
        found: dict[int, Episode] = {}
        controller = None

        def start(items: np.ndarray) -> Reset:
            return episode_starts(starts, sequence[items], repetition[items], trial.seed)

        with closing(play_rounds(self._engine, trial, objects, start)) as rounds:
            for r in rounds:
                if controller is None:
                    controller = make_controller(r.env, self._actor)
                begin(controller, r.env)
                of_items = [faults[item // len(demonstrations)] for item in r.items]
                seeds = [(trial.seed, int(sequence[item]), int(repetition[item])) for item in r.items]
                result = self._play_round(r, controller, of_items, seeds)
                for world in r.fresh:
                    item = int(r.items[world])
                    found[item] = episode_of(result, world, bank, int(sequence[item]), int(repetition[item]))
                self._done += len(r.fresh)
                self._count(self._done)
        ordered = [found[item] for item in sorted(found)]
        size = len(demonstrations)
        return [tuple(ordered[i * size : (i + 1) * size]) for i in range(len(faults))]

    def _play_round(
        self, r: Round, controller: Controller, faults: list[Faults], seeds: Sequence[Sequence[int]]
    ) -> EpisodeMetrics:
        env = r.env
        result = EpisodeMetrics(env.reading(), env.goal_pos, env.goal_quat, r.points, MetricsConfig())

        def look(step: int) -> None:
            reading = env.reading()
            table = env.backend.scene.table
            result.update(reading, out_of_bounds(reading.task_state.object_pos, table, env.task.termination))

        driver = FaultyDriver(env, faults, seeds, look, real_time=self._real_time)
        outcome = Runner(controller, driver).run(env.max_episode_length * controller.dt)
        for world in r.fresh:
            reason = outcome.reasons[world]
            if reason is not None:
                self.stopped[re.sub(r"-?\d+\.\d+", "...", reason)] += 1
        return result


def judge(found: Sequence[Rehearsal]) -> Verdict:
    """Return whether the policy may be tried on a robot.

    It may if no engine shows a loss beyond :data:`CRITERIA`, and each at least :data:`LEAST` without faults.
    """
    against = []
    unsure = []
    tried = 0
    for card in found:
        if card.task_progress < LEAST:
            against.append(f"{card.backend}: only {100 * card.task_progress:.0f} % without any fault.")
        for criterion in CRITERIA:
            point = _point(card, criterion)
            tried += point is not None
            if point is None or -point.difference <= criterion.most:
                continue
            low, high = (-100 * bound for bound in reversed(point.difference_ci95))
            fault = f"{criterion.option.replace('-', ' ')} {amount(_unit(criterion), criterion.value)}"
            text = (
                f"{card.backend}: {fault} costs {-100 * point.difference:.1f} points (95 %: {low:.0f} to {high:.0f}). "
                f"At most {100 * criterion.most:.0f} are wanted."
            )
            if -point.difference_ci95[1] > criterion.most:
                against.append(text)
            else:
                unsure.append(text)
    if against:
        return Verdict(sentence="Not ready for a robot.", reasons=(*against, *unsure))
    if unsure:
        return Verdict(
            sentence="Not shown to be ready: some losses are too large, or chance. Play more episodes.",
            reasons=tuple(unsure),
        )
    if tried < len(CRITERIA) * len(found):
        return Verdict(sentence="No verdict: not every fault that decides was tried.", reasons=())
    return Verdict(sentence="Ready for a first, careful trial on a robot.", reasons=())


def _unit(criterion: Criterion) -> str:
    return next(prop.unit for prop in PROPERTIES if prop.option == criterion.option)


def _point(card: Stress, criterion: Criterion) -> Point | None:
    for each in card.curves:
        for point in each.points:
            if each.property == criterion.option and point.value == criterion.value:
                return point
    return None


def limits(found: Sequence[Rehearsal]) -> list[tuple[str, list[str]]]:
    """Return name and, for each engine, the smallest value in words of every fault that costs ten points."""
    rows = []
    for name in _names(found):
        rows.append((name.replace("-", " "), [_limit(each) for each in _curves(found, name)]))
    return rows


def _names(found: Sequence[Rehearsal]) -> list[str]:
    names: dict[str, None] = {}
    for card in found:
        names |= dict.fromkeys(each.property for each in card.curves)
    return list(names)


def _curves(found: Sequence[Rehearsal], name: str) -> list[Curve | None]:
    """Return the curve of a property in each engine; None where the engine cannot set it."""
    by_name = []
    for card in found:
        by_name.append({each.property: each for each in card.curves}.get(name))
    return by_name


def _limit(found: Curve | None) -> str:
    if found is None:
        return "cannot be set"
    values = [value for value in (found.lower, found.upper) if value is not None]
    if not values:
        return "none that was tried"
    chance = "" if all(found.is_certain(value) for value in values) else ", or chance"
    return " and ".join(amount(found.unit, float(f"{value:.2g}")) for value in values) + chance


def page(found: Sequence[Rehearsal]) -> str:
    """Return the page of a rehearsal, in HTML."""
    rows = []
    for name in _names(found):
        curves = _curves(found, name)
        unit = next(each.unit for each in curves if each is not None)
        points: dict[float, list[Point | None]] = {}
        for i, each in enumerate(curves):
            for point in () if each is None else each.points:
                if each is not None and point.value != each.nominal:
                    points.setdefault(point.value, [None] * len(found))[i] = point
        for value in sorted(points):
            rows.append((name.replace("-", " "), amount(unit, value), points[value]))
    return render(
        "rehearsal.html.j2",
        verdict=judge(found),
        found=found,
        colors=COLORS,
        limits=limits(found),
        rows=rows,
        chart=svg(lambda figure: draw_curves(figure, found), plot_size(found), "rehearsal"),
        costly=COSTLY,
    )
