"""Functions that are commands as well: their signatures are the options, and their docstrings the help.

They import most of what they need when they are called, because the help of a command is shown at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from xreset.errors import XResetError
from xreset.files.checks import NonNegativeInt, Option, Output, PositiveInt, Seed, obeys_rules
from xreset.files.progress import unseen
from xreset.files.storage import file_hash, measured, write_json, write_whole
from xreset.physics.plugins import Device

if TYPE_CHECKING:
    from xreset.eval.engines.agreement import Parity
    from xreset.eval.engines.attribution import Attribution
    from xreset.eval.engines.replay import TraceResult
    from xreset.eval.policy_spec import PolicySpec
    from xreset.eval.rollout import Engine
    from xreset.resets.inputs import Data
else:  # a command has texts in place of these
    Attribution = Parity = TraceResult = PolicySpec = Engine = Data = Any


@obeys_rules
def check_engines(
    engines: Annotated[str | Sequence[str], Option("engine")],
    *,
    robot: str | Path | None = None,
    device: Device = "cpu",
    only: Annotated[Sequence[str], Option("check")] = (),
    json: Output | None = None,
    page: Output | None = None,
    verbose: bool = False,
    say: Callable[[Any], None] = print,
) -> list[dict[str, Any]]:
    """Test whether physics engines keep their contract. The command exits with 1 if one does not.

    Args:
        engines: physics engine, or several; the command's default: all that can be used here.
        robot: name or folder of the robot to test with; default: a gripper, with which every check can run.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        only: check to run, or several; default: all.
        json: file to write the results to.
        page: Markdown page to write, with a table of the results.
        verbose: show every measured number, not only the one nearest to its tolerance.
        say: called with lines about each check.

    Returns:
        The runs of the file of results (:mod:`xreset.backends.conformance.results`), one for each engine.

    Raises:
        XResetError: an engine or a check is unknown, or an engine cannot be used here.
    """
    from xreset.backends import conformance
    from xreset.eval.engines import contract
    from xreset.eval.engines import page as pages
    from xreset.geometry.description import load_robot

    spec = load_robot(robot) if robot else conformance.scene().robot
    runs = []
    for name in [engines] if isinstance(engines, str) else dict.fromkeys(engines):
        runs.append(contract.check(name, spec, device, only or None, verbose, say))
    found = measured({"schema": conformance.SCHEMA, "runs": runs})
    if json is not None:
        write_json(json, found)
    if page is not None:
        write_whole(page, pages.page([found]))
    return runs


@obeys_rules
def compare_engines(
    motion: str | Path,
    engines: Annotated[str | Engine | Sequence[str | Engine], Option("engine")],
    *,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    names: Annotated[Sequence[str], Option("object")] = (),
    grasps: PositiveInt = 48,
    device: Device = "cpu",
    json: Output | None = None,
    progress: Callable[[str, float, int], None] = unseen,
) -> Parity:
    """Measure how far physics engines agree with MuJoCo on grasps. The command exits with 1 if one misses a target.

    Press: a hand closes on an object that cannot move. Closing: a hand closes on an object on the table, lifts and
    shakes it. Hold: lift and shake from a common state. The column of MuJoCo at half the timestep shows how far two
    solutions of the same equations differ. The command leaves out MuJoCo-Warp on a CPU, where it is slow, unless it is
    named.

    Args:
        motion: file with the grasps: of xreset retarget, or of xreset demos, which is retargeted first.
        engines: physics engine to measure, or several; the command's default: all that can be used here.
        robot: name or folder of the robot; default: the file's.
        meshes: folder of real meshes; default: as the file names it, else the stand-ins.
        names: object to use, or several; default: all objects of the file.
        grasps: number of closings, and of holds.
        device: where engines run that can use a GPU: cpu or cuda; the others run on the CPU.
        json: file to write the results to.
        progress: called with (current try, tries done, tries in all).

    Raises:
        DemoError: the file shows no grasp.
        XResetError: an engine is unknown or cannot be used here.
    """
    from xreset.eval.engines import agreement
    from xreset.eval.rollout import chosen_engines
    from xreset.resets.inputs import load_inputs

    tested = [each for each in chosen_engines(engines, device) if each.name != agreement.REFERENCE]
    inputs = load_inputs(motion, robot=robot, meshes=meshes, only=names, accept=("demos", "motion"))
    grasped = inputs.motion(partial(progress, "retargeting"))
    # hashed now, because after minutes of work the file may have changed
    hashes = {"motion": file_hash(motion)}
    found = agreement.compare(
        inputs.robot, inputs.objects, grasped, tested, grasps=grasps, progress=progress
    )
    if json is not None:
        write_json(json, measured(asdict(found) | {"ok": not found.missed, "inputs": hashes}))
    return found


@obeys_rules
def trace_engines(
    source: str | Path,
    engines: Annotated[str | Sequence[str], Option("engine")],
    *,
    reference: str = "mujoco",
    object_name: Annotated[str | None, Option("object")] = None,
    episode: NonNegativeInt = 0,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    seed: Seed = 0,
    device: Device = "cpu",
    out: Output = Path("runs/trace"),
    progress: Callable[[str, float, int], None] = unseen,
) -> TraceResult:
    """Replay the same actions from the same state in several engines, and show when and by how much they diverge.

    Args:
        source: source of the actions. Demonstrations or robot motion: an open-loop grasp and lift. The trace of an
            evaluation (eval/ENGINE.trace.npz): an episode of the policy.
        engines: engine to compare with the reference, or several; the command's default: all that can be used here.
        reference: engine that the others are compared with.
        object_name: object, if the source has several; default: the first.
        episode: which of the object's grasps or recorded episodes.
        robot: name or folder of the robot; default: the policy's, or the file's.
        meshes: folder of real meshes; default: what the policy was trained with, else the stand-ins.
        seed: seed of the perturbed starts, which are the same in every engine.
        device: where engines run that can use a GPU: cpu or cuda.
        out: folder for trace.json.
        progress: called with the name of each engine as it begins.

    Raises:
        DemoError: the file has no such object, grasp or episode.
        XResetError: the reference itself does not stay finite, or an engine cannot be used here.
    """
    from xreset.eval import rollout
    from xreset.eval.engines import actions, replay

    base = rollout.engine(reference, device=device)
    chosen = (engines,) if isinstance(engines, str) else dict.fromkeys(engines)
    others = [rollout.engine(name, device=device) for name in chosen if name != reference]
    progress("actions", 0, 0)
    played = actions.from_file(Path(source), object_name, episode, robot=robot, meshes=meshes)
    found = replay.trace(
        played, base, others, seed=seed, progress=lambda name: progress(name, 0, 0)
    )
    write_json(Path(out) / "trace.json", measured(found.as_dict()))
    return found


@obeys_rules
def attribute(
    policy: str | Path | PolicySpec,
    demos: str | Path | Data,
    towards: str | Engine,
    engine: str | Engine = "mujoco",
    *,
    properties: Annotated[str | Sequence[str], Option("property")] = (),
    episodes: PositiveInt = 1,
    robot: str | Path | None = None,
    meshes: str | Path | None = None,
    seed: Seed = 0,
    device: Device = "cpu",
    num_envs: PositiveInt = 64,
    out: Output | None = None,
    progress: Callable[[str, float, int], None] = unseen,
) -> Attribution:
    """Find the physical difference between two engines that costs a policy its skill.

    First both engines are measured through their interface: friction, drive stiffness and damping, timestep. Then the
    policy plays the same episodes in one engine, in that engine with one property changed to the value of the other
    engine, with all properties changed, and in the other engine.

    Args:
        policy: run folder, one of its checkpoints (.pt), exported policy (.onnx), name of a policy that ships with
            xreset (xreset policies), or a baseline: zero, ik (open-loop kinematic retargeting).
        demos: demonstrations (xreset demos) or retargeted motion (xreset retarget): starts and goals, and the path of
            ik. xreset demos select makes a file of some objects.
        towards: engine towards which the properties are changed, usually the one in which the policy does worse.
        engine: engine in which the properties are changed.
        properties: property to change, or several; default: all in which the engines differ.
        episodes: episodes of each demonstration.
        robot: name or folder of the robot; default: the policy's own. Baselines need it.
        meshes: folder of real meshes; default: what the policy was trained with, else the stand-ins.
        seed: seed of the perturbations of the starts, which are the same in every engine.
        device: where engines run that can use a GPU: cpu or cuda.
        num_envs: worlds that run at the same time.
        out: folder for the results, one file for each engine; default: attribute/ next to the policy's results.
        progress: called with (engine, conditions done, conditions in all).

    Returns:
        The results in both engines, and what each property costs.

    Raises:
        PolicyError: the policy is unknown.
        XResetError: an engine is unknown or cannot be measured, or both are the same.
    """
    from xreset.eval.engines import attribution
    from xreset.eval.policy_spec import load_policy
    from xreset.eval.rollout import chosen_engines, load_trial

    if engine == towards:
        raise XResetError(f"engine and towards are both {engine!r}. Choose two engines.")
    spec = load_policy(policy, robot=robot)
    a, b = chosen_engines([engine, towards], device)
    trial = load_trial(spec, demos, meshes=meshes, seed=seed, num_envs=num_envs)
    folder = Path(out) if out else spec.folder.parent / "attribute"
    wanted = [properties] if isinstance(properties, str) else properties
    return attribution.attribute(
        spec, a, b, trial, folder, episodes=episodes, only=wanted, progress=progress
    )
