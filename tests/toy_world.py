"""A world without an engine, and the pool of its worlds. Workers import this module: it does without torch."""

import os
import signal
from dataclasses import replace

import numpy as np

from xreset.backends.pool import PoolBackend, World, is_finite
from xreset.errors import RobotError
from xreset.spec import SceneSpec


class ToyWorld(World):
    """Joints jump to their targets; the object moves at its velocity plus force / mass; readings follow the state."""

    def __init__(self, scene, object_index, *, gain=1.0):
        self.gain = float(gain)
        self.scene = scene
        self.object_index = object_index
        self.mass = scene.objects[object_index].mass
        self.friction = np.zeros(3)

    def set_state(self, state):
        self.state = {name: value.copy() for name, value in state.items()}
        self.contact = np.zeros(3)

    def get_state(self):
        return self.state

    def set_joint_targets(self, targets):
        if targets[0] == 666.0:
            os.kill(os.getpid(), signal.SIGKILL)
        if targets[0] == 13.0:
            raise ZeroDivisionError("unlucky")
        if targets[0] == 14.0:
            raise RobotError("not like that")
        self.state["joint_target"] = targets

    def step(self, n):
        self.state["joint_pos"] = self.gain * self.state["joint_target"]
        self.state["object_linvel"] = self.state["object_linvel"] + n * self.force / self.mass
        self.state["object_pos"] = self.state["object_pos"] + n * self.state["object_linvel"]
        self.contact = np.array([0.0, 0.0, float(n)])

    def links(self):
        k = len(self.scene.robot.tracked_links)
        values = (self.state["joint_pos"][0], self.friction[0], float(self.object_index))
        pos, linvel, angvel = (np.full((k, 3), value) for value in values)
        return pos, np.tile([1.0, 0.0, 0.0, 0.0], (k, 1)), linvel, angvel

    def contacts(self):
        return np.tile(self.contact, (2, 1)), np.array([self.contact[2] > 0, False]), -self.contact

    def health(self, state):
        return not is_finite(state), bool(state["joint_target"][0] == 5.0)

    def set_object_inertia(self, inertia):
        self.mass = inertia.mass

    def set_friction(self, friction):
        self.friction = friction

    def set_object_gravity(self, fraction):
        raise NotImplementedError


class ToyBackend(PoolBackend):
    name = "toy"
    capabilities = frozenset({"object_mass", "friction", "object_wrench"})
    world_class = ToyWorld

    @classmethod
    def engine_version(cls):
        return "1"


def toy_scene():
    # workers start sooner without it
    from xreset.backends.conformance.scene import ball, gripper

    robot = replace(gripper(), joints=gripper().joints[:2], mimics=())
    return SceneSpec(robot=robot, objects=(replace(ball(), mass=1.0), replace(ball(), mass=2.0)))
