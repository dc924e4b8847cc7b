"""Builds the page that plays a policy in a browser without an install: ci/try_page.py FOLDER [OBJECT ...]

FOLDER then has everything that the page needs, as static files:

- the sources in ``docs/try``;
- ``lib``: MuJoCo, onnxruntime and three.js from npm, in the versions of ``docs/try/package-lock.json``;
- ``robot.json``: the robot's drawn meshes by MuJoCo body, the table, colors, and the names of all objects;
- ``scenes/OBJECT.json``: MJCF of the robot with the object (:attr:`SceneModel.spec`), the arrays of the
  compiled model that the text does not give exactly, addresses of joints and sensors, and starts and goals;
- ``policy.onnx``: the policy, from readings to joint targets (:mod:`xreset.live.graph`).
"""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from xreset.backends.mjcf import compile_scene
from xreset.backends.mjcf_model import MOST_BRAKING, SceneModel, body_name
from xreset.backends.rigid import mechanism
from xreset.eval.play.session import Session
from xreset.eval.policy_spec import PolicySpec, load_policy
from xreset.files.text import short_name
from xreset.geometry.dynamics import drive_values
from xreset.geometry.shapes import transformed
from xreset.geometry.urdf import link_meshes
from xreset.objects.catalogue import object_names
from xreset.pictures.meshes import (
    GOAL_COLOR,
    OBJECT_COLOR,
    TABLE_COLORS,
    link_colors,
    object_mesh,
    rgb,
    shade_smoothly,
)
from xreset.resets.bank import ResetBank
from xreset.spec import ObjectSpec, RobotSpec, SceneSpec

POLICY = "many-objects"
ROOT = Path(__file__).parents[1]
SOURCES = ROOT / "docs/try"
PACKAGES = ROOT / "build/npm"
"""Where npm installs."""
LIBRARIES = (
    "@mujoco/mujoco/mujoco.js",
    "@mujoco/mujoco/mujoco.wasm",
    "onnxruntime-web/dist/ort.wasm.min.mjs",
    "onnxruntime-web/dist/ort-wasm-simd-threaded.mjs",
    "onnxruntime-web/dist/ort-wasm-simd-threaded.wasm",
    "three/build/three.module.js",
    "three/build/three.core.js",
    "three/examples/jsm/controls/OrbitControls.js",
    "three/examples/jsm/controls/TransformControls.js",
)
"""Files of the page from packages of npm."""
KINDS = {"float64": "d", "float32": "f", "int32": "i", "uint8": "B", "bool": "B"}


def install() -> None:
    """Let npm install the packages of the lock file, unless it has."""
    lock = (SOURCES / "package-lock.json").read_bytes()
    done = PACKAGES / "installed-lock.json"
    if done.is_file() and done.read_bytes() == lock:
        return
    PACKAGES.mkdir(parents=True, exist_ok=True)
    for name in ("package.json", "package-lock.json"):
        shutil.copy(SOURCES / name, PACKAGES)
    subprocess.run(
        ["npm", "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--silent"],
        cwd=PACKAGES,
        check=True,
    )
    done.write_bytes(lock)


def copy_sources(folder: Path) -> None:
    """Copy the page's own files and those of the packages."""
    library = folder / "lib"
    library.mkdir(parents=True, exist_ok=True)
    for file in SOURCES.iterdir():
        if file.suffix in (".html", ".css", ".js"):
            shutil.copy(file, folder)
    for name in LIBRARIES:
        shutil.copy(PACKAGES / "node_modules" / name, library)


def encoded(array: np.ndarray) -> dict[str, str]:
    """Return an array for ``decoded`` of docs/try/physics.js."""
    content = np.ascontiguousarray(array).tobytes()
    return {"kind": KINDS[str(array.dtype)], "data": base64.b64encode(content).decode()}


def inexact(model: mujoco.MjModel, xml: str) -> dict[str, dict[str, str]]:
    """Return the arrays of a model that differ from those of the model that MuJoCo makes from the text."""
    from_text = mujoco.MjModel.from_xml_string(xml)
    found = {}
    for name in dir(model):
        exact = getattr(model, name)
        if isinstance(exact, np.ndarray) and not np.array_equal(exact, getattr(from_text, name)):
            found[name] = encoded(exact)
    return found


def addresses(at: SceneModel) -> dict[str, Any]:
    """Return where joints, object and fingertip sensors are in MuJoCo's arrays."""
    model = at.model
    first = model.nsensordata - 3 * len(at.sensed_tip)
    tips = [{"sensor": first + 3 * i, "tip": int(tip)} for i, tip in enumerate(at.sensed_tip)]
    driven = at.joints.driven
    return {
        "qpos": at.qpos[driven].tolist(),
        "dof": at.dof[driven].tolist(),
        "object": {"body": at.object_body, "qpos": at.object_qpos, "dof": at.object_dof},
        "tips": tips,
    }


def mimics(at: SceneModel) -> list[dict[str, float]]:
    """Return the joints that follow others, with their address in qpos."""
    joints = at.joints
    rows = []
    for i, place in enumerate(joints.mimic):
        row = {
            "qpos": int(at.qpos[place]),
            "source": int(joints.source[i]),
            "multiplier": float(joints.multiplier[i]),
            "offset": float(joints.offset[i]),
        }
        rows.append(row)
    return rows


def drawn(mesh: Any) -> dict[str, dict[str, str]]:
    """Return a mesh with the normals of its corners, for WebGL."""
    smooth = shade_smoothly(mesh)
    return {
        "vertices": encoded(smooth.vertices.astype(np.float32).ravel()),
        "normals": encoded(smooth.vertex_normals.astype(np.float32).ravel()),
        "faces": encoded(np.asarray(smooth.faces, dtype=np.int32).ravel()),
    }


def robot_parts(robot: RobotSpec, at: SceneModel) -> list[dict[str, Any]]:
    """Return the drawn meshes of the links, each in the frame of its MuJoCo body."""
    parts = mechanism(robot)
    colors = link_colors(robot)
    rows = []
    for link, mesh in link_meshes(robot).items():
        index, T_body_link = parts.frames[link]
        mesh.vertices = transformed(mesh.vertices, T_body_link)
        body = at.model.body(body_name(parts.bodies[index])).id
        rows.append({"link": link, "body": body, "color": rgb(colors[link]), "mesh": drawn(mesh)})
    return rows


def body_poses(at: SceneModel) -> list[list[list[float]]]:
    """Return position and orientation of each MuJoCo body while the robot is at home."""
    data = mujoco.MjData(at.model)
    home = np.asarray(at.scene.robot.home)
    data.qpos[at.qpos], _ = at.joints.spread(home, np.zeros_like(home))
    mujoco.mj_kinematics(at.model, data)
    return [[list(pos), list(quat)] for pos, quat in zip(data.xpos, data.xquat, strict=True)]


def physics_part(scene: SceneSpec, object_index: int) -> dict[str, Any]:
    """Return what docs/try/physics.js needs of a scene with one of its objects."""
    at = compile_scene(scene, object_index, sensors=True)
    xml = at.spec.to_xml()
    robot = scene.robot
    return {
        "xml": xml,
        "numbers": inexact(at.model, xml),
        "timestep": scene.timestep,
        "substeps": scene.substeps,
        "mostBraking": MOST_BRAKING,
        "fingertips": robot.fingertip_names,
        "home": np.asarray(robot.home, dtype=float).tolist(),
        "stiffness": drive_values(robot, "kp").tolist(),
        "mimics": mimics(at),
        "addresses": addresses(at),
    }


def object_part(obj: ObjectSpec, known: dict[str, np.ndarray]) -> dict[str, Any]:
    """Return what the picture, the policy (:attr:`Session.known`) and a pull need of an object."""
    return {
        **{name: value.ravel().tolist() for name, value in known.items()},
        "mass": obj.mass,
        "com": np.asarray(obj.com).tolist(),
        "inertia": float(np.linalg.eigvalsh(obj.inertia)[-1]),
        "corners": encoded(np.asarray(obj.vertices, dtype=np.float64).ravel()),
        "mesh": drawn(object_mesh(obj)),
    }


def starts_of(bank: ResetBank) -> list[dict[str, Any]]:
    """Return where an object begins, and its goals."""
    rows = []
    for i in range(len(bank.start_pos)):
        row = {
            "objectPos": bank.start_pos[i].tolist(),
            "objectQuat": bank.start_quat_wxyz[i].tolist(),
            "goalPos": bank.goal_pos[i].tolist(),
            "goalQuat": bank.goal_quat_wxyz[i].tolist(),
        }
        rows.append(row)
    return rows


def scene_of(name: str, policy: PolicySpec) -> tuple[SceneSpec, dict[str, Any]]:
    """Return the scene that ``xreset play`` plays with an object, and the content of its file."""
    session = Session(policy, object_name=name)
    session.close()
    content = physics_part(session.scene, 0)
    content["object"] = object_part(session.scene.objects[0], session.known)
    content["starts"] = starts_of(session.bank)
    return session.scene, content


def write_data(folder: Path, names: Sequence[str]) -> None:
    """Write the robot and the objects of these names."""
    policy = load_policy(POLICY)
    scenes = folder / "scenes"
    scenes.mkdir(parents=True, exist_ok=True)
    for name in names:
        scene, content = scene_of(name, policy)
        (scenes / f"{name}.json").write_text(json.dumps(content))
    at = compile_scene(scene, 0, sensors=True)
    content = {
        "parts": robot_parts(policy.robot, at),
        "home": body_poses(at),
        "table": {"center": scene.table.center, "halfSize": scene.table.half_size},
        "colors": {
            "object": rgb(OBJECT_COLOR),
            "goal": rgb(GOAL_COLOR),
            "table": [rgb(color) for color in TABLE_COLORS],
        },
        "objects": {name: short_name(name).replace("_", " ") for name in names},
    }
    (folder / "robot.json").write_text(json.dumps(content))


def write_policy(folder: Path) -> None:
    """Write the policy as one graph from readings to joint targets."""
    (folder / "policy.onnx").write_bytes(load_policy(POLICY).graph)


def build(folder: Path, names: Sequence[str]) -> None:
    """Build the page with the objects of these names."""
    install()
    copy_sources(folder)
    write_data(folder, names)
    write_policy(folder)


if __name__ == "__main__":
    build(Path(sys.argv[1]), sys.argv[2:] or object_names())
