"""``xreset rehearse``."""

from __future__ import annotations

from pathlib import Path

from xreset.cli._common import Flat, Policy, Several, quick_engines
from xreset.cli._terminal import Progress, console, show_table
from xreset.eval.setting import Setting


def rehearse(
    policy: Policy,
    *,
    demos: Path | None = None,
    engine: Several = (),
    fault: Several = (),
    episodes: int = 1,
    real_time: bool = False,
    setting: Flat[Setting] = Setting(),
    out: Path | None = None,
) -> None:
    """Rehearse a policy for a robot: late and wrong poses, late actions, lost frames, pushes, one fault at a time.

    Args:
        demos: Demonstrations whose starts and goals are played. Default: two synthetic demonstrations of each of the
            policy's objects.
        engine: Physics engine; give it again for more engines. Default: all that can be used here, but not
            MuJoCo-Warp on a CPU, where it is slow.
        fault: Fault to try, or NAME=VALUE,VALUE... for values of your own (delays in ms, errors in mm or degrees,
            pushes of the object in m/s); give it again for more. Default: all.
        episodes: Episodes of each demonstration, the same for every fault.
        real_time: Let the simulation wait for the wall clock.
        setting: Robot, meshes, seed, device and worlds.
        out: Folder for the results; default: rehearsal/ in the run folder or next to the policy.
    """
    from xreset.eval import sensitivity

    sensitivity.chosen(fault, sensitivity.REHEARSED)  # refuses wrong ones before torch is loaded
    from xreset.eval import policy_spec
    from xreset.eval import rehearse as rehearsal

    engines = quick_engines(engine, setting.device)
    spec = policy_spec.load_policy(policy, robot=setting.robot, seed=setting.seed)
    folder = out or spec.folder.parent / "rehearsal"
    with Progress() as bar:
        found = rehearsal.rehearse(
            spec,
            demos,
            engines,
            faults=fault,
            episodes=episodes,
            real_time=real_time,
            out=folder,
            progress=bar.stages(),
            **vars(setting),
        )
    table = [
        ("fault", *(f"{card.engine}, {100 * card.task_progress:.0f} % without" for card in found))
    ]
    table += [(name, *limits) for name, limits in rehearsal.limits(found)]
    show_table(
        table, title=f"{spec.name}: the smallest fault that costs ten points of task progress"
    )
    sentence, reasons = rehearsal.judge(found)
    console.print(sentence, style="bold")
    for reason in reasons:
        console.print(reason)
    console.print(f"page and results in {folder}")


COMMAND = rehearse
