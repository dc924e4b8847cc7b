"""An engine of your own: one world in numpy, of which a pool makes N. `examples/xreset-drake` is a real one, with forces."""

import numpy as np

from xreset.backends import conformance
from xreset.backends.pool import PoolBackend, World


class KinematicWorld(World):
    """A robot that follows its targets at once, next to an object that nothing moves."""

    def __init__(self, scene, object_index):
        self._joints = len(scene.robot.joints)

    def set_state(self, state):
        self._state = {name: np.array(value) for name, value in state.items()}

    def get_state(self):
        return self._state

    def set_joint_targets(self, targets):
        self._state["joint_target"] = np.array(targets)

    def step(self, n):
        self._state |= {
            "joint_pos": self._state["joint_target"],
            "joint_vel": np.zeros(self._joints),
        }

    def contacts(self):
        return []

    set_object_inertia = set_friction = lambda self, *_: None  # they move nothing here


class KinematicBackend(PoolBackend):
    name = "kinematic"
    capabilities = frozenset()
    world_class = KinematicWorld
    engine_version = classmethod(lambda cls: "1")


def main() -> None:
    """Do what `xreset engines check` does. The first two checks pass; the third fails, because nothing falls in this engine."""
    make = lambda *scene, **options: KinematicBackend(*scene, workers=0, **options)  # noqa: E731 (in this process)
    checks = ("state_round_trip", "links_after_set", "free_fall")
    for result in conformance.run(make, only=checks):
        print(f"{result.verdict:8} {result.check.statement}")


if __name__ == "__main__":
    main()
