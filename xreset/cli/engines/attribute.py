"""``xreset engines attribute``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Flat, PolicyOrBaseline, Several
from xreset.cli._terminal import Progress, console
from xreset.errors import XResetError
from xreset.eval.setting import Setting
from xreset.files import write_json


def attribute(
    policy: PolicyOrBaseline,
    *,
    demos: Path,
    towards: str,
    backend: str = "mujoco",
    only: Several = (),
    episodes: int = 1,
    setting: Flat[Setting] = Setting(),
    out: Path | None = None,
) -> None:
    """Find the physical difference between two engines that costs a policy its skill.

    First both engines are measured through their interface: friction, drive stiffness and damping, timestep. Then the
    policy plays the same episodes in one engine, in that engine with one property changed to the value of the other
    engine, with all properties changed, and in the other engine.

    Args:
        demos: Demonstrations (xreset demos) or retargeted trajectories (xreset retarget): starts and goals, and the
            path of ik. `xreset demos select` makes a file of some objects.
        towards: Engine towards which the properties are changed, usually the one in which the policy does worse.
        backend: Engine in which they are changed.
        only: Property to change; give it again for more. Default: all in which the engines differ.
        episodes: Episodes per demonstration.
        setting: Robot, meshes, seed of the perturbations of the starts, device and worlds.
        out: Folder for attribution.json; default: attribute/ next to the policy's results.
    """
    from xreset.eval import policy_spec, trial
    from xreset.eval.engines import attribution, attribution_view

    if backend == towards:
        raise XResetError(f"--backend and --towards are both {backend!r}. Choose two engines.")
    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    a, b = (trial.engine(name, device=setting.device) for name in (backend, towards))
    played = trial.load_trial(
        spec, demos, objects=setting.objects, seed=setting.seed, num_envs=setting.num_envs
    )
    out = out or spec.folder.parent / "attribute"
    folder = played.objects_folder
    with Progress() as bar:
        task = bar.add_task("", total=None)
        found = attribution.attribute(
            spec, a, b, played, episodes=episodes, only=only,
            progress=lambda run, done, total: bar.update(task, description=run, completed=done, total=total or None),
        )  # fmt: skip
    demonstrations = len(played.bank.sequence_name)
    count = f"{len(found.rows[0].episodes)} episodes of {demonstrations} demonstrations, seed {setting.seed}"
    title = f"{spec.name} on {spec.robot.name}: what costs the skill between {backend} and {towards}\n{count}"
    content = found.as_dict() | {
        "policy": spec.name,
        "robot": spec.robot.name,
        "seed": setting.seed,
        "demonstrations": demonstrations,
        "versions": {a.name: a.version, b.name: b.version},
        "objects_folder": str(folder) if folder else None,
        "inputs": played.inputs,
    }
    write_json(out / "attribution.json", content)
    console.print(attribution_view.rich_table(found, title))
    for line in attribution_view.not_tried(found):
        console.print(line, style="dim")
    console.print(attribution_view.verdict(found))
    console.print(f"results in {out}")


COMMAND = attribute
