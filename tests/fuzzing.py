"""Every reader with a valid file, and what must hold when the file is damaged: an error that the user can mend, or sound content.

A reader may read several files, of which one is damaged and contradicts the others. :mod:`tests.damage` has the ways to damage a file.
"""

import logging
import tempfile
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
import yaml
from scipy.spatial.transform import Rotation
from torch.utils.tensorboard import SummaryWriter

from tests.test_import_robot import HAND, MJCF
from tests.test_keypoints import PLAIN, write_csv
from tests.test_view import toy_demos, toy_retargeted
from tests.toy_bank import SOUP, toy_bank
from tests.toy_goals import toy_goals
from tests.toy_policy import toy_graph, write_policy
from tests.toy_results import toy_result, toy_rollouts
from tests.toy_robot import toy_hand_arm
from xreset import (
    TrainConfig,
    XResetError,
    load_object,
    merge_demos,
    read_bank,
    read_demos,
    read_goals,
    read_retargeted,
    synthesize,
    write_bank,
    write_demos,
    write_goals,
    write_retargeted,
)
from xreset.demos.dexycb import _read_extrinsics, _read_meta, _read_npz
from xreset.demos.keypoints import read_keypoints, read_transform
from xreset.eval.effects import curves, verdict
from xreset.eval.report.read import read_curves, run_facts
from xreset.eval.results import read_result, read_traces, write_result
from xreset.eval.study.file import SHIPPED, read_study
from xreset.files.records import Field
from xreset.files.storage import read_json, write_json
from xreset.geometry import urdf
from xreset.geometry.description import load_robot, read_description
from xreset.learning.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from xreset.learning.clock import Lift, read_lift, write_lift
from xreset.learning.recipes import read_recipe
from xreset.learning.run import RunInfo, read_run, write_run
from xreset.live.deploy import deploy_contract
from xreset.objects.meshes import read_mesh
from xreset.objects.properties import properties_of
from xreset.pictures.view.load import load_view
from xreset.policy.onnx_policy import OnnxPolicy, policy_contract
from xreset.robot_tools.sources import completed, read_source
from xreset.runtime import load_controller
from xreset.runtime.contract import KEY, parse_contract
from xreset.task.config import ObservationConfig, TaskConfig

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
SECONDS = 20.0
"""Most time of a processor that a reader may take over a file."""
HAND_MAY = ("hand_keypoints", "wrist_quat_wxyz")
"""Fields of demonstrations that hold NaN where no hand was found."""
ERRORS_MAY = ("hand_error", "wrist_error")
"""Fields of retargeted motion that are infinite where there is no hand."""
JOINTS = ("a", "b", "c")
"""Names of the joints in traces."""


@dataclass(frozen=True)
class Reader:
    """One kind of file."""

    file: Path
    """A valid one."""
    read: Callable[[Path], Any]
    """Reads a file of that name; the other files of its folder are valid."""
    kind: str
    """``npz``, ``json``, ``yaml``, ``checkpoint``, ``text`` or ``bytes``: what damage understands of it."""
    may_hold: tuple[str, ...] = ()
    """Fields that may hold numbers that are not finite."""
    slow: bool = False
    """Whether the tests try few files."""


@contextmanager
def readers():
    """All of them by name, over files in a temporary folder."""
    # readers log what they leave out of a file; here they would log it ten thousand times
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as folder:
        every = Readers(Path(folder))
        for add_some in (
            add_records,
            add_evaluation,
            add_run,
            add_curves,
            add_studies,
            add_networks,
            add_deployed,
            add_robots,
            add_dexycb,
            add_keypoints,
            add_meshes,
            add_pairs,
            add_mesh_of_urdf,
        ):
            add_some(every)
        try:
            yield every.found
        finally:
            logging.disable(logging.NOTSET)


class Readers:
    """Readers by name, their folder, and two robots."""

    def __init__(self, folder):
        self.folder = folder
        self.found: dict[str, Reader] = {}
        self.toy = toy_hand_arm(folder)
        self.openarm = load_robot("openarm")
        observation = ObservationConfig(cloud_points=16)
        self.contract = policy_contract(self.toy, TaskConfig(observation=observation), (SOUP,))

    def add(self, what, file, read, kind, may_hold=(), slow=False):
        """The place of the reader's file, which the caller writes."""
        path = self.folder / file
        self.found[what] = Reader(path, read, kind, may_hold, slow)
        return path


# Files of xreset -------------------------------------------------------------------------------------------------------------------------


def add_records(every):
    path = every.add("demonstrations", "demos.npz", read_demos, "npz", HAND_MAY)
    write_demos(path, toy_demos())
    path = every.add("retargeted", "retargeted.npz", read_retargeted, "npz", ERRORS_MAY)
    write_retargeted(path, toy_retargeted(every.openarm))
    path = every.add("reset bank", "bank.npz", lambda p: read_bank(p, robot=every.toy), "npz")
    write_bank(path, toy_bank(every.toy), config={"steps": 8}, inputs={"retargeted": "ab"})
    write_goals(every.add("goal set", "goals.npz", read_goals, "npz"), toy_goals(every.toy))


def add_evaluation(every):
    rollouts = toy_rollouts()
    sweep = {("object-mass", 2.0): rollouts.episodes}
    result = toy_result(sweep=sweep, left_out={"arm-stiffness": "why"})
    write_result(every.folder, result, rollouts.traces, JOINTS)

    def evaluated(path):
        found = read_result(path)
        curves(found)
        return verdict([found])

    every.add("result", "mujoco.json", evaluated, "json")

    def traces(path):
        return read_traces(path.parent, "mujoco", JOINTS)

    # the two files of 0.1 to 0.3
    (every.folder / "both").mkdir()
    summary = every.add("earlier result", "both/mujoco.json", read_result, "json")
    path = every.add(
        "earlier episodes", "both/mujoco.episodes.json", lambda _: read_result(summary), "json"
    )
    header = {
        name: getattr(result, name) for name in ("engine", "engine_version", "robot", "policy")
    }
    header |= {"seed": 3, "inputs": {"demos": "ab"}, "meshes": None, "control_steps_per_second": 9}
    write_json(summary, {"schema": "xreset-eval/1", "episodes": 4} | header)
    rows = [vars(episode) for episode in rollouts.episodes]
    write_json(path, {"schema": "xreset-episodes/1", "episodes": rows})
    may = ("joint_pos", "object_pos", "object_quat", "joint_target")
    every.add("trace", "mujoco.trace.npz", traces, "npz", may)


def add_run(every):
    info = RunInfo(
        robot="toy", resets="b.npz", resets_hash="ab", meshes=None, engine="mujoco", engine_version="4", device="cpu", num_envs=4,
        seed=3, config=TrainConfig(), contract=every.contract,
    )  # fmt: skip
    write_run(every.folder, info)
    run = every.add("run.json", "run.json", lambda p: read_run(p.parent), "json")
    path = every.add(
        "run.json, compared", "compared.json", lambda p: run_facts(read_json(p), p), "json"
    )
    path.write_bytes(run.read_bytes())
    path = every.add("lift", "lift/run.json", lambda p: read_lift(p.parent), "json")
    path.parent.mkdir()
    path.write_bytes(run.read_bytes())
    write_lift(path.parent, Lift().after(0.2, iteration=10, env_steps=1000, seconds=60.0))
    recipe = every.add("recipe", "mine.toml", read_recipe, "text")
    recipe.write_bytes((EXAMPLES / "cluster" / "mine.toml").read_bytes())


def add_curves(every):
    with SummaryWriter(log_dir=f"{every.folder}/curves") as writer:
        for step in range(4):
            writer.add_scalar("episode/return", 0.1 * step, step)
    (events,) = (every.folder / "curves").iterdir()
    every.add(
        "event file",
        f"curves/{events.name}",
        lambda p: read_curves(p.parent),
        "bytes",
        may_hold=("value",),
    )


def add_studies(every):
    path = every.add("study", "study.toml", read_study, "text", ("config",))
    path.write_bytes((SHIPPED / "nine_objects.toml").read_bytes())


def add_networks(every):
    path = every.add("policy", "policy.onnx", OnnxPolicy, "bytes")
    write_policy(path, asdict(every.contract))
    weight = torch.ones(2, requires_grad=True)
    optimizer = torch.optim.Adam([weight])
    weight.sum().backward()
    optimizer.step()
    checkpoint = Checkpoint(
        actor_state_dict={"weight": torch.ones(2)},
        critic_state_dict={"weight": torch.ones(2)},
        optimizer_state_dict=optimizer.state_dict(),
        iteration=1,
        env_steps=1,
        elapsed=0.1,
        learning_rate=1e-3,
    )
    path = every.add("checkpoint", "000001.pt", lambda p: vars(read_checkpoint(p)), "checkpoint")
    write_checkpoint(path, checkpoint)


def add_deployed(every):
    path = every.add("deployed policy", "deployed.onnx", load_controller, "bytes")
    path.write_bytes(toy_graph()[1])

    def read(path):
        return parse_contract({KEY: path.read_text(errors="replace")}, str(path))

    contract = deploy_contract(every.toy, every.contract.task, [load_object("soup")])
    write_json(every.add("contract", "contract.json", read, "json"), contract)


def add_robots(every):
    def imported(path):
        return completed(read_source(path, []), path, [])

    every.add("robot.toml", "toy.toml", read_description, "text")
    every.add("URDF", every.toy.urdf.name, urdf.load_urdf, "text")
    every.add("URDF, imported", "hand.urdf", imported, "text").write_text(HAND)
    sizes = '<size nkey="1" nuser_body="1"/><asset><texture name="t" type="2d" builtin="flat" width="8" height="8"/></asset>'
    with_sizes = MJCF.replace("<worldbody>", f"{sizes}<worldbody>")
    every.add("MJCF, imported", "hand.xml", imported, "text").write_text(with_sizes)


# Files of others -------------------------------------------------------------------------------------------------------------------------


def add_dexycb(every):
    path = every.add(
        "DexYCB calibration",
        "calibration/extrinsics_1/extrinsics.yml",
        lambda p: _read_extrinsics(every.folder, "1"),
        "yaml",
    )
    path.parent.mkdir(parents=True)
    pose = np.eye(4)[:3].ravel().tolist()
    calibration = {"extrinsics": {"apriltag": pose, "837": pose.copy()}, "master": "837"}
    path.write_text(yaml.safe_dump(calibration))
    meta = {
        "extrinsics": "1",
        "mano_sides": ["right"],
        "num_frames": 4,
        "serials": ["837"],
        "ycb_grasp_ind": 0,
        "ycb_ids": [2],
    }
    every.add("DexYCB meta", "meta.yml", _read_meta, "yaml").write_text(yaml.safe_dump(meta))

    def poses(path):
        return {"pose_y": _read_npz(path, {"pose_y": Field((4, 1, 7), "fi", within=None)})}

    path = every.add("DexYCB poses", "pose.npz", poses, "npz", ("pose_y",))
    np.savez(path, pose_y=np.zeros((4, 1, 7)))


def add_keypoints(every):
    def read(path):
        return read_keypoints(path, PLAIN)

    demos = synthesize(["soup"], per_object=1, fps=5)
    np.savez(
        every.add("tracker's npz", "tracked.npz", read, "npz", HAND_MAY),
        keypoints=demos.hand_keypoints,
        object_pos=demos.object_pos,
        object_quat_wxyz=demos.object_quat_wxyz,
        object=np.array(SOUP),
        side=np.array("right"),
    )
    path = every.add("tracker's CSV", "tracked.csv", read, "text", HAND_MAY)
    turn = Rotation.from_quat(demos.object_quat_wxyz, scalar_first=True)
    times = np.arange(len(demos.object_pos)) / demos.fps
    columns = {"object": SOUP, "side": "right", "time": times}
    write_csv(path, demos.hand_keypoints, demos.object_pos, turn, columns=columns)
    np.savetxt(every.add("camera, text", "camera.txt", read_transform, "text"), np.eye(4))


def add_meshes(every):
    box = trimesh.creation.box((0.1, 0.06, 0.04))
    for suffix in ("stl", "obj", "ply", "off", "glb", "gltf"):
        kind = {"stl": "bytes", "glb": "bytes", "gltf": "json"}.get(suffix, "text")
        path = every.add(f"mesh .{suffix}", f"box.{suffix}", read_mesh, kind)
        shape = trimesh.Scene(box) if suffix.startswith("gl") else box
        content = shape.export(file_type=suffix)
        if isinstance(content, dict):  # glTF: a text, and a file with the numbers
            for name, part in content.items():
                (every.folder / name).write_bytes(part)
            content = content["model.gltf"]
        path.write_bytes(content.encode() if isinstance(content, str) else content)
    path = every.add(
        "properties", "box.toml", lambda p: properties_of(p.with_suffix(".obj")), "text"
    )
    path.write_text("mass = 0.1\ntolerance = 0.002\n")


# Several files that contradict each other ------------------------------------------------------------------------------------------------


def add_pairs(every):
    others = toy_demos()
    names = [f"other-{name}" for name in others.sequence_name]
    others = replace(others, sequence_name=np.array(names))

    def merged(path):
        return merge_demos([read_demos(path), others])

    may = (*HAND_MAY, *ERRORS_MAY)
    path = every.add("two archives", "more.npz", merged, "npz", may)
    write_demos(path, toy_demos())

    def viewed(path):
        return load_view(path, demos=every.folder / "demos.npz")

    may = (*may, "human_keypoints")
    path = every.add("motion and archive", "seen.npz", viewed, "npz", may, slow=True)
    write_retargeted(path, toy_retargeted(every.openarm))


def add_mesh_of_urdf(every):
    robot = every.folder / "meshed" / "robot.urdf"

    def read(_):
        urdf._load.cache_clear()  # which goes by the URDF alone
        return urdf.load_urdf(robot)

    robot.parent.mkdir()
    geometry = '<collision><geometry><mesh filename="box.stl"/></geometry></collision>'
    robot.write_text(f'<robot name="x"><link name="a">{geometry}</link></robot>')
    path = every.add("mesh of a URDF", "meshed/box.stl", read, "bytes")
    path.write_bytes((every.folder / "box.stl").read_bytes())


# Verdicts --------------------------------------------------------------------------------------------------------------------------------


def outcome(reader, damaged):
    """``refused`` or ``read``; raises ``AssertionError`` if the reader broke, took too long, or took what is wrong."""
    whole = reader.file.read_bytes()
    began = time.process_time()
    try:
        reader.file.write_bytes(damaged)
        content = reader.read(reader.file)
    except XResetError as error:
        assert len(str(error)) < 20_000, f"a message of {len(str(error))} characters"
        verdict = "refused"
    except MemoryError:
        raise
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}") from error
    else:
        verdict = "read"
        problem = unsound(content, reader.may_hold)
        assert not problem, f"it took {problem}"
    finally:
        reader.file.write_bytes(whole)
    seconds = time.process_time() - began
    assert seconds < SECONDS, f"it took {seconds:.0f} s"
    return verdict


def unsound(content, may_hold, name="content"):
    """The first number in what was read that is not finite, or the first quaternion that is not unit, by its name."""
    parts: Any = None
    if is_dataclass(content) and not isinstance(content, type):
        parts = ((f.name, getattr(content, f.name)) for f in fields(content))
    elif isinstance(content, dict):
        parts = content.items()
    elif isinstance(content, tuple | list):
        parts = ((name, part) for part in content)
    if parts is not None:
        for part_name, part in parts:
            problem = part_name not in may_hold and unsound(part, may_hold, str(part_name))
            if problem:
                return problem
        return None
    if not isinstance(content, np.ndarray | float) and type(content).__name__ != "Tensor":
        return None
    array = np.asarray(content)
    if array.dtype.kind != "f":
        return None
    wrong = array[~np.isfinite(array)]
    if wrong.size and name not in ("within", "velocity", "lower", "upper"):
        return f"{name} = {wrong[0]}"
    is_quat = "quat" in name and array.shape[-1:] == (4,)
    if is_quat and (np.abs(np.linalg.norm(array, axis=-1) - 1) > 2e-3).any():
        return f"{name}, which is not unit"
    return None
