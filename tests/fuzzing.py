"""Every reader with a valid file, ways to damage it, and what must hold then: an error that the user can mend, or sound content.

A reader may read several files, of which one is damaged and contradicts the others.
"""

import io
import json
import logging
import pickle
import re
import tempfile
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from hypothesis import strategies as st

from tests.test_import_robot import HAND, MJCF
from tests.test_keypoints import PLAIN, write_csv
from tests.test_view import toy_demos, toy_retargeted
from tests.toy_bank import SOUP, toy_bank
from tests.toy_policy import write_policy
from tests.toy_results import toy_rollouts, toy_summary
from tests.toy_robot import toy_hand_arm
from xreset import (
    TrainConfig,
    XResetError,
    merge_demos,
    read_bank,
    read_demos,
    read_retargeted,
    write_bank,
    write_demos,
    write_retargeted,
)
from xreset.files import read_json, write_json
from xreset.geometry import urdf
from xreset.learning.run import RunInfo, read_run, write_run
from xreset.physics import State
from xreset.records import Field

SECONDS = 20.0
"""Most time of a processor that a reader may take over a file."""

Damage = Callable[[bytes], bytes]


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
    """All of them, over files in a temporary folder."""
    from scipy.spatial.transform import Rotation
    from torch.utils.tensorboard import SummaryWriter

    from xreset.backends.conformance import SCHEMA as CONFORMANCE
    from xreset.demos.dexycb import _read_extrinsics, _read_meta, _read_npz
    from xreset.demos.ho3d import _read_frame
    from xreset.demos.keypoints import read_keypoints, read_transform
    from xreset.demos.synth import synthesize
    from xreset.description import load_robot, read_description
    from xreset.eval.engines.actions import Actions, read_actions, write_actions
    from xreset.eval.engines.page import page
    from xreset.eval.engines.page import read as read_page
    from xreset.eval.report.read import read_curves, run_facts
    from xreset.eval.results import (
        read_episodes,
        read_evaluation,
        read_result,
        read_traces,
        write_results,
    )
    from xreset.eval.study.file import SHIPPED, read_study
    from xreset.learning.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
    from xreset.learning.clock import Lift, read_lift, write_lift
    from xreset.objects.catalogue import load_object
    from xreset.objects.meshes import read_mesh
    from xreset.objects.properties import properties_of
    from xreset.pictures.view.load import load_view
    from xreset.policy import OnnxPolicy, policy_contract
    from xreset.robot_tools.sources import read_source
    from xreset.spec import SceneSpec
    from xreset.task.config import ObservationConfig, TaskConfig

    # readers log what they leave out of a file; here they would log it ten thousand times
    logging.disable(logging.WARNING)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = toy_hand_arm(folder)
        openarm = load_robot("openarm")
        found: dict[str, Reader] = {}

        def add(what, file, read, kind, may_hold=(), slow=False):
            found[what] = Reader(folder / file, read, kind, may_hold, slow)
            return folder / file

        path = add(
            "demonstrations", "demos.npz", read_demos, "npz", ("hand_keypoints", "wrist_quat_wxyz")
        )
        write_demos(path, toy_demos())
        path = add(
            "retargeted", "retargeted.npz", read_retargeted, "npz", ("hand_error", "wrist_error")
        )
        write_retargeted(path, toy_retargeted(openarm))
        path = add("reset bank", "bank.npz", lambda p: read_bank(p, robot=robot), "npz")
        write_bank(path, toy_bank(robot), config={"steps": 8}, inputs={"retargeted": "ab"})

        soup = load_object("soup")
        home = torch.as_tensor(openarm.home, dtype=torch.float32)[None]
        start = State.at_rest(home, torch.tensor([[0.5, 0.3, 0.1]]), torch.tensor([[1.0, 0, 0, 0]]))
        path = add(
            "actions", "actions.npz", lambda p: read_actions(p, openarm, lambda _: soup), "npz"
        )
        write_actions(
            path,
            Actions(
                scene=SceneSpec(robot=openarm, objects=(soup,)),
                label="x",
                start=start,
                joint_target=home.repeat(3, 1),
            ),
        )

        rollouts = toy_rollouts()
        write_results(folder, toy_summary(rollouts=rollouts), rollouts, ("a", "b", "c"))
        add("result", "mujoco.json", read_result, "json")
        add("episodes", "mujoco.episodes.json", lambda p: read_episodes(p.parent, "mujoco"), "json")
        may = ("joint_pos", "object_pos", "object_quat", "joint_target")
        add(
            "trace",
            "mujoco.trace.npz",
            lambda p: read_traces(p.parent, "mujoco", ("a", "b", "c")),
            "npz",
            may,
        )

        contract = policy_contract(
            robot, TaskConfig(observation=ObservationConfig(cloud_points=16)), (SOUP,)
        )
        info = RunInfo(
            robot="toy", resets="b.npz", resets_hash="ab", objects=None, backend="mujoco", backend_version="4", device="cpu", num_envs=4,
            seed=3, config=TrainConfig(), contract=contract,
        )  # fmt: skip
        write_run(folder, info)
        add("run.json", "run.json", lambda p: read_run(p.parent), "json")
        (folder / "compared.json").write_bytes((folder / "run.json").read_bytes())
        add("run.json, compared", "compared.json", lambda p: run_facts(read_json(p), p), "json")
        add("lift.json", "lift.json", lambda p: read_lift(p.parent), "json")
        write_lift(folder, Lift().after(0.2, iteration=10, env_steps=1000, seconds=60.0))
        writer = SummaryWriter(log_dir=f"{folder}/curves")
        for step in range(4):
            writer.add_scalar("episode/return", 0.1 * step, step)
        writer.close()
        (events,) = (folder / "curves").iterdir()
        add(
            "event file",
            f"curves/{events.name}",
            lambda p: read_curves(p.parent),
            "bytes",
            may_hold=("value",),
        )
        add("study", "study.toml", read_study, "text", ("config",)).write_bytes(
            (SHIPPED / "first_grasp.toml").read_bytes()
        )

        stored = json.loads((Path(__file__).with_name("engines") / "conformance.json").read_text())
        stored["runs"] = [run | {"checks": run["checks"][:4]} for run in stored["runs"][:2]]
        assert stored["schema"] == CONFORMANCE
        write_json(
            add("conformance", "conformance.json", lambda p: page(read_page([p])), "json"), stored
        )

        write_policy(add("policy", "policy.onnx", OnnxPolicy, "bytes"), asdict(contract))
        weights = {"weight": torch.ones(2, requires_grad=True)}
        optimizer = torch.optim.Adam(weights.values())
        weights["weight"].sum().backward()
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
        path = add("checkpoint", "000001.pt", lambda p: vars(read_checkpoint(p)), "checkpoint")
        write_checkpoint(path, checkpoint)

        add("robot.toml", "toy.toml", read_description, "text")
        add("URDF", robot.urdf.name, urdf.load_urdf, "text")
        add("URDF, imported", "hand.urdf", lambda p: read_source(p, []), "text").write_text(HAND)
        sizes = '<size nkey="1" nuser_body="1"/><asset><texture name="t" type="2d" builtin="flat" width="8" height="8"/></asset>'
        with_sizes = MJCF.replace("<worldbody>", f"{sizes}<worldbody>")
        add("MJCF, imported", "hand.xml", lambda p: read_source(p, []), "text").write_text(
            with_sizes
        )

        calibration = folder / "calibration" / "extrinsics_1" / "extrinsics.yml"
        calibration.parent.mkdir(parents=True)
        poses = {"apriltag": np.eye(4)[:3].ravel().tolist(), "837": np.eye(4)[:3].ravel().tolist()}
        calibration.write_text(yaml.safe_dump({"extrinsics": poses, "master": "837"}))
        found["DexYCB calibration"] = Reader(
            calibration, lambda p: _read_extrinsics(folder, "1"), "yaml"
        )
        meta = {
            "extrinsics": "1",
            "mano_sides": ["right"],
            "num_frames": 4,
            "serials": ["837"],
            "ycb_grasp_ind": 0,
            "ycb_ids": [2],
        }
        add("DexYCB meta", "meta.yml", _read_meta, "yaml").write_text(yaml.safe_dump(meta))
        np.savez(
            add(
                "DexYCB poses",
                "pose.npz",
                lambda p: {"pose_y": _read_npz(p, {"pose_y": Field((4, 1, 7), "fi", within=None)})},
                "npz",
                ("pose_y",),
            ),
            pose_y=np.zeros((4, 1, 7)),
        )

        once = synthesize(["soup"], per_object=1, fps=5)
        turn = Rotation.from_quat(once.object_quat_wxyz, scalar_first=True)
        may = ("hand_keypoints", "wrist_quat_wxyz")
        path = add("tracker's npz", "tracked.npz", lambda p: read_keypoints(p, PLAIN), "npz", may)
        texts = {"object": np.array(SOUP), "side": np.array("right")}
        arrays = {
            "keypoints": once.hand_keypoints,
            "object_pos": once.object_pos,
            "object_quat_wxyz": once.object_quat_wxyz,
        }
        np.savez(path, **arrays, **texts)
        path = add("tracker's CSV", "tracked.csv", lambda p: read_keypoints(p, PLAIN), "text", may)
        times = np.arange(len(once.object_pos)) / once.fps
        columns = {"object": SOUP, "side": "right", "time": times}
        write_csv(path, once.hand_keypoints, once.object_pos, turn, columns=columns)
        np.savetxt(add("camera, text", "camera.txt", read_transform, "text"), np.eye(4))

        import trimesh

        for suffix in ("stl", "obj", "ply", "off", "glb", "gltf"):
            kind = {"stl": "bytes", "glb": "bytes", "gltf": "json"}.get(suffix, "text")
            path = add(f"mesh .{suffix}", f"box.{suffix}", read_mesh, kind)
            box = trimesh.creation.box((0.1, 0.06, 0.04))
            content = (trimesh.Scene(box) if suffix.startswith("gl") else box).export(
                file_type=suffix
            )
            if isinstance(content, dict):  # glTF: a text, and a file with the numbers
                for name, part in content.items():
                    (folder / name).write_bytes(part)
                content = content["model.gltf"]
            path.write_bytes(content.encode() if isinstance(content, str) else content)
        (folder / "box.toml").write_text("mass = 0.1\ntolerance = 0.002\n")
        add("properties", "box.toml", lambda p: properties_of(p.with_suffix(".obj")), "text")
        frame = {
            "handJoints3D": None,
            "objRot": np.zeros((3, 1)),
            "objTrans": np.zeros(3),
            "objName": SOUP,
        }
        path = add(
            "pickle",
            "0000.pkl",
            lambda p: dict(zip(("joints", "pose"), _read_frame(p))),
            "bytes",
            ("joints", "pose"),
        )
        path.write_bytes(pickle.dumps(frame, protocol=2))

        # several files that contradict each other
        others = toy_demos()
        others = replace(
            others, sequence_name=np.array([f"other-{name}" for name in others.sequence_name])
        )
        may = ("hand_keypoints", "wrist_quat_wxyz", "hand_error", "wrist_error")
        path = add(
            "two archives", "more.npz", lambda p: merge_demos([read_demos(p), others]), "npz", may
        )
        write_demos(path, toy_demos())
        path = add(
            "motion and archive",
            "seen.npz",
            lambda p: load_view(p, demos=folder / "demos.npz"),
            "npz",
            (*may, "human_keypoints"),
            slow=True,
        )
        write_retargeted(path, toy_retargeted(openarm))
        (folder / "both").mkdir()
        write_results(folder / "both", toy_summary(rollouts=rollouts), rollouts, ("a", "b", "c"))
        for what, file in (
            ("result and episodes", "mujoco.json"),
            ("episodes and result", "mujoco.episodes.json"),
        ):
            add(what, f"both/{file}", lambda p: read_evaluation(p.parent) and None, "json")

        with_mesh = folder / "meshed" / "robot.urdf"
        with_mesh.parent.mkdir()
        geometry = '<collision><geometry><mesh filename="box.stl"/></geometry></collision>'
        with_mesh.write_text(f'<robot name="x"><link name="a">{geometry}</link></robot>')
        path = add("mesh of a URDF", "meshed/box.stl", lambda p: _fresh_urdf(with_mesh), "bytes")
        path.write_bytes((folder / "box.stl").read_bytes())
        try:
            yield found
        finally:
            logging.disable(logging.NOTSET)


def _fresh_urdf(path):
    urdf._load.cache_clear()  # which goes by the URDF alone
    return urdf.load_urdf(path)


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
        found = (unsound(part, may_hold, str(n)) for n, part in parts if n not in may_hold)
        return next(filter(None, found), None)
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


# Damage ----------------------------------------------------------------------------------------------------------------------------------

JUNK = (
    None, True, 0, -1, 5, 2**63, 10**400, 0.5, -7.25, 1e308, -1e30, "", "x", "\x1b[31m", "[/bold]",
    "<script>alert(1)</script>", "\ud800", "x" * 5000,
    [], [1], ["x"], {}, {"x": 1}, [[[[]]]],
)  # fmt: skip
NUMBERS = (np.nan, np.inf, -np.inf, 1e30, -1e30, 1e-300, -1.0, 0.0, 2.0**63)
TYPES = [
    "u1",
    "u4",
    "u8",
    ">u4",
    ">i8",
    "i2",
    "f2",
    ">f4",
    ">f8",
    "longdouble",
    "complex64",
    "U3",
    "S3",
    "bool",
    "M8[s]",
]


def damages(kind):
    """Ways to damage a file of that kind; any file may also be damaged byte by byte."""
    own = {
        "npz": [_arrays],
        "json": [_tree(json.loads, lambda data: json.dumps(data).encode())],
        "yaml": [
            _tree(yaml.safe_load, lambda data: yaml.dump(data).encode("utf-8", "surrogatepass"))
        ],
        "checkpoint": [_tree(_load_checkpoint, _dump_checkpoint)],
        "text": [_words],
    }
    return st.one_of(*(make() if callable(make) else make for make in own.get(kind, [])), _bytes())


def _bytes():
    def flip(places):
        def damage(whole):
            content = bytearray(whole)
            for where, value in places:
                content[int(where * len(content))] = value
            return bytes(content)

        return damage

    where = st.floats(0, 1, exclude_max=True)

    def put(at, text):
        def damage(whole):
            place = int(at * len(whole))
            return whole[:place] + text + whole[place:]

        return damage

    cut = where.map(lambda at: lambda whole: whole[: int(at * len(whole))])
    insert = st.builds(put, where, st.binary(min_size=1, max_size=40))
    twice = where.map(lambda at: lambda whole: whole + whole[int(at * len(whole)) :])
    flips = st.lists(st.tuples(where, st.integers(0, 255)), min_size=1, max_size=8).map(flip)
    return st.one_of(cut, insert, twice, flips, flips)


def _words():
    """Replaces one number or quoted text of a text file by junk."""
    junk = (
        "nan", "inf", "-1", "1e300", "0", "", "x", "1 2", '"', "\x00", "\x9b", "../../etc/passwd", "100000000",
        "1" * 5000, "[" * 2000,
    )  # fmt: skip

    def replaced(at, text):
        def damage(whole):
            content = whole.decode("latin-1")
            found = list(re.finditer(r"[-+.\w]+", content))
            if not found:
                return whole
            m = found[int(at * len(found))]
            return (content[: m.start()] + text + content[m.end() :]).encode("latin-1")

        return damage

    def grown(at):
        def damage(whole):
            lines = whole.splitlines(keepends=True)
            if lines:
                lines[int(at * len(lines))] *= 20_000
            return b"".join(lines)

        return damage

    where = st.floats(0, 1, exclude_max=True)
    return st.one_of(*[st.builds(replaced, where, st.sampled_from(junk))] * 9, where.map(grown))


def _arrays():
    """Changes one array of an npz file: its numbers, its type, its shape, its being there."""

    def changed(at, how, number, kind, place):
        def damage(whole):
            arrays = dict(np.load(io.BytesIO(whole)))
            names = sorted(arrays)
            name = names[int(at * len(names))]
            array = arrays[name]
            with np.errstate(all="ignore"):
                try:
                    if how == "number" and array.dtype.kind in "fiu" and array.size:
                        array = array.copy()
                        array.ravel()[int(place * array.size)] = np.array(number).astype(
                            array.dtype
                        )
                    elif how == "all" and array.dtype.kind == "f":
                        array = np.full(array.shape, number)
                    elif how == "all":
                        array = np.zeros_like(array)
                    elif how == "type":
                        array = array.astype(kind)
                    elif how == "shape" and place < 0.3:
                        array = array[..., None]
                    elif how == "shape":
                        array = array.reshape(-1)[: int(place * array.size)]
                    elif how == "text":
                        array = np.full(array.shape, "\x1b[31m[/bold]")
                    elif how == "grow" and array.dtype.kind != "U" and array.ndim:
                        array = np.tile(array, (1000,) + (1,) * (array.ndim - 1))
                    elif how == "swap" and array.ndim:
                        array = array[::-1]
                except (ValueError, TypeError, OverflowError):
                    return whole[: int(place * len(whole))]
            if how == "drop":
                del arrays[name]
            else:
                arrays[name] = array
            if how == "bomb":
                arrays["x"] = np.zeros(1_000_000, dtype=np.uint8)
            out = io.BytesIO()
            np.savez_compressed(out, **arrays)
            return out.getvalue()

        return damage

    hows = st.sampled_from(
        ["number", "number", "all", "type", "type", "shape", "text", "drop", "swap", "bomb", "grow"]
    )
    where = st.floats(0, 1, exclude_max=True)
    return st.builds(changed, where, hows, st.sampled_from(NUMBERS), st.sampled_from(TYPES), where)


def _tree(load, dump):
    """Replaces, removes or adds an entry anywhere in nested objects and lists."""

    def key_at(node, share):
        keys = list(node) if isinstance(node, dict) else range(len(node))
        return keys[int(share * len(keys))] if keys else None

    def changed(path, how, junk):
        def damage(whole):
            data = load(whole)
            node = data
            for step in path:
                key = key_at(node, step)
                if key is None or not isinstance(node[key], dict | list) or not node[key]:
                    break
                node = node[key]
            key = key_at(node, path[-1])
            if how == "drop" and key is not None:
                del node[key]
            elif how == "add" and isinstance(node, dict):
                node["later"] = junk
            elif how == "grow" and key is not None:
                node[key] = [node[key]] * 20_000
            elif key is not None:
                node[key] = junk
            return dump(data)

        return damage

    where = st.floats(0, 1, exclude_max=True)
    hows = st.sampled_from(["replace", "replace", "replace", "drop", "add", "grow"])
    return st.builds(changed, st.lists(where, min_size=1, max_size=6), hows, st.sampled_from(JUNK))


def _load_checkpoint(whole):
    return torch.load(io.BytesIO(whole), weights_only=True)


def _dump_checkpoint(data):
    out = io.BytesIO()
    torch.save(data, out)
    return out.getvalue()
