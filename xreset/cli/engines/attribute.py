"""``xreset engines attribute``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from xreset.checks import Options
from xreset.cli._common import Flat, PolicyOrBaseline, Several
from xreset.cli._terminal import Progress, console
from xreset.errors import DemoError, XResetError
from xreset.eval import policy_spec, trial
from xreset.eval.engines import attribution, attribution_view
from xreset.eval.setting import Setting
from xreset.files import write_json


@dataclass(frozen=True, kw_only=True)
class Played(Options):
    """Episodes to play."""

    demos: Path
    """Demonstrations (xreset demos) or retargeted trajectories (xreset retarget): starts and goals, and the path of ik.
    """
    object: Several = ()
    """Object to play with; give it again for more. Default: all."""
    max_demos: int | None = None
    """Largest number of demonstrations, spread over all."""
    episodes: int = 1
    """Episodes per demonstration."""


def attribute(
    policy: PolicyOrBaseline,
    *,
    played: Flat[Played],
    towards: str,
    backend: str = "mujoco",
    only: Several = (),
    setting: Flat[Setting] = Setting(),
    out: Path | None = None,
) -> None:
    """Find the physical difference between two engines that costs a policy its skill.

    First both engines are measured through their interface: friction, object mass and inertia, drive stiffness and
    damping, timestep, contact softness, latency. Then the policy plays the same episodes in one engine, in that engine
    with one property changed to the value of the other engine, with all properties changed, and in the other engine.

    Args:
        played: Demonstrations and episodes.
        towards: Engine towards which the properties are changed, usually the one in which the policy does worse.
        backend: Engine in which they are changed.
        only: Property to change; give it again for more. Default: all in which the engines differ.
        setting: Robot, meshes, seed of the perturbations of the starts, device and worlds.
        out: Folder for attribution.json and attribution.png; default: attribute/ next to the policy's results.
    """
    if backend == towards:
        raise XResetError(f"--backend and --towards are both {backend!r}. Choose two engines.")
    demos = played.demos
    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    a, b = (trial.engine(name, device=setting.device) for name in (backend, towards))
    played_trial = trial.load_trial(spec, demos, objects=setting.objects, seed=setting.seed, num_envs=setting.num_envs)
    if unknown := sorted(set(played.object) - set(played_trial.names)):
        raise DemoError(f"{demos} has no {', '.join(unknown)}; it has {', '.join(played_trial.names)}.")
    objects = tuple(o for o in played_trial.objects if o.name in (played.object or played_trial.names))
    chosen = np.flatnonzero(np.isin(played_trial.bank.sequence_object, [o.name for o in objects]))
    if played.max_demos is not None and played.max_demos < len(chosen):
        chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, played.max_demos).round().astype(int))]
    objects = tuple(o for o in objects if o.name in played_trial.bank.sequence_object[chosen])
    out = out or spec.folder.parent / "attribute"
    folder = played_trial.objects_folder
    with Progress() as bar:
        task = bar.add_task("", total=None)
        found = attribution.attribute(
            spec, a, b, replace(played_trial, objects=objects),
            episodes=played.episodes, sequences=chosen, only=only,
            progress=lambda run, done, total: bar.update(task, description=run, completed=done, total=total or None),
        )  # fmt: skip
    count = f"{len(found.rows[0].episodes)} episodes of {len(chosen)} demonstrations, seed {setting.seed}"
    title = f"{spec.name} on {spec.robot.name}: what costs the skill between {backend} and {towards}\n{count}"
    content = found.as_dict() | {
        "policy": spec.name,
        "robot": spec.robot.name,
        "seed": setting.seed,
        "demonstrations": len(chosen),
        "versions": {a.name: a.version, b.name: b.version},
        "objects_folder": str(folder) if folder else None,
        "inputs": played_trial.inputs,
    }
    write_json(out / "attribution.json", content)
    attribution_view.write_plot(out / "attribution.png", found, title)
    console.print(attribution_view.rich_table(found, title))
    for line in attribution_view.not_tried(found):
        console.print(line, style="dim")
    console.print(attribution_view.verdict(found))
    console.print(f"results in {out}")


COMMAND = attribute
