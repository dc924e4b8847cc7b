"""The physics of the page in docs/try as an engine: MuJoCo's WebAssembly build in Node.

Episodes in the page's engine next to others:

    python -m tests.wasm_engine --per-object 4
"""

import argparse
import atexit
import json
import shutil
import subprocess
from dataclasses import replace
from functools import cache
from pathlib import Path
from unittest import SkipTest

import numpy as np

from ci import try_page
from xreset import evaluate
from xreset.backends.pool import PoolBackend, World
from xreset.demos.verbs import synthesize
from xreset.eval.rollout import Engine


def installed():
    """Install the packages of the page; skips the test without Node or without a registry."""
    if shutil.which("node") is None or shutil.which("npm") is None:
        raise SkipTest("no Node here (looked for node and npm)")
    try:
        try_page.install()
    except subprocess.CalledProcessError:
        raise SkipTest("npm cannot install the packages of docs/try here") from None


@cache
def _node():
    installed()
    script = Path(__file__).with_suffix(".mjs")
    command = ["node", str(script), str(try_page.PACKAGES / "node_modules"), str(try_page.SOURCES)]
    node = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(node.communicate)  # the end of its input ends it
    return node


def ask(**command):
    """Return what Node answers."""
    node = _node()
    node.stdin.write(json.dumps(command) + "\n")
    node.stdin.flush()
    answer = node.stdout.readline()
    assert answer, "Node has stopped: its message is above"
    return json.loads(answer)


def with_friction(scene, friction):
    """Return a scene in which the pairs object-fingertip, object-link and object-table have this friction."""
    tip, link, table = map(float, friction)
    return replace(scene, friction=replace(scene.friction, tip=tip, link=link, table=table))


class WasmWorld(World):
    """Begins at rest, with nominal parameters."""

    def __init__(self, scene, object_index):
        self._scene = scene
        self._object_index = object_index
        self.number = None
        self.set_friction((scene.friction.tip, scene.friction.link, scene.friction.table))

    def set_state(self, state):
        moving = [state[name].any() for name in ("joint_vel", "object_linvel", "object_angvel")]
        assert not any(moving), "the page begins episodes at rest"
        self._target = state["joint_target"].copy()
        self._reading = ask(
            do="begin",
            world=self.number,
            jointPos=state["joint_pos"].tolist(),
            jointTarget=self._target.tolist(),
            objectPos=state["object_pos"].tolist(),
            objectQuat=state["object_quat"].tolist(),
        )

    def get_state(self):
        read = {name: np.array(value, dtype=float) for name, value in self._reading.items()}
        return {
            "joint_pos": read["jointPos"],
            "joint_vel": read["jointVel"],
            "joint_target": self._target,
            "object_pos": read["objectPos"],
            "object_quat": read["objectQuat"],
            "object_linvel": read["objectLinvel"],
            "object_angvel": read["objectAngvel"],
        }

    def set_joint_targets(self, targets):
        self._target = targets.copy()

    def step(self, n):
        self._reading = ask(
            do="step",
            world=self.number,
            count=n,
            targets=self._target.tolist(),
            force=self.force.tolist(),
            torque=self.torque.tolist(),
        )

    def contacts(self):
        force = np.array(self._reading["tipForce"], dtype=float).reshape(-1, 3)
        return force, force.any(axis=1), np.zeros(3)  # policies and metrics ignore the table's

    def set_object_inertia(self, inertia):
        nominal = self._scene.objects[self._object_index].mass
        assert np.isclose(inertia.mass, nominal), "the page has nominal masses"

    def set_friction(self, friction):
        scene = with_friction(self._scene, friction)
        part = try_page.physics_part(scene, self._object_index)
        self.number = ask(do="build", scene=part, instead=self.number)

    def set_object_gravity(self, fraction):
        assert fraction == 1.0, "the page has full weight"


class WasmBackend(PoolBackend):
    name = "wasm"
    capabilities = frozenset({"friction", "object_mass", "object_gravity", "object_wrench"})
    world_class = WasmWorld

    @classmethod
    def engine_version(cls):
        lock = json.loads((try_page.SOURCES / "package-lock.json").read_text())
        return lock["packages"]["node_modules/@mujoco/mujoco"]["version"]


def wasm_engine():
    """The engine for :func:`xreset.evaluate`."""

    def make(scene, num_worlds, object_index):
        return WasmBackend(scene, num_worlds, object_index=object_index, workers=0)

    return Engine(name="wasm", make=make, version=WasmBackend.engine_version())


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--per-object", type=int, default=4)
    demos = synthesize(None, parser.parse_args().per_object, seed=1)
    engines = ["mujoco", "pybullet", "sapien", wasm_engine()]
    print(evaluate("many-objects", demos, engines, episodes=1))


if __name__ == "__main__":
    main()
