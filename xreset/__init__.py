"""xreset: dexterous robot policies from human demonstrations used as reset states.

    import xreset

    robot = xreset.load_robot("ur7e-sharpa")
    can = xreset.load_object("soup")
    demos = xreset.synthesize([can.name], 4)                       # or xreset.read_demos("demos.npz")
    motion = xreset.retarget_demos(demos, robot, [can])            # robot states that follow the human's hand
    bank = xreset.make_bank(motion, robot, [can], ["mujoco"])      # those that a physics engine finds stable
    env = xreset.make_env(robot, [can], bank, engine="mujoco")     # N worlds that begin there

Importing this package loads nothing heavy: no torch, no physics engine, no display. A name is imported when it is first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from xreset.demos.archive import read_demos
    from xreset.demos.synth import synthesize
    from xreset.description import load_robot
    from xreset.env import ManipulationEnv, make_env
    from xreset.eval.evaluate import evaluate
    from xreset.learning.train import train
    from xreset.objects.catalogue import load_object
    from xreset.plugins import make_backend
    from xreset.policy import OnnxPolicy
    from xreset.resets.bank import read_bank
    from xreset.resets.filter import make_bank
    from xreset.retarget.pipeline import retarget as retarget_demos
    from xreset.vector_env import VectorEnv

__version__ = "0.1.0"

_HOMES = {
    "ManipulationEnv": "xreset.env",
    "OnnxPolicy": "xreset.policy",
    "evaluate": "xreset.eval.evaluate",
    "load_object": "xreset.objects.catalogue",
    "load_robot": "xreset.description",
    "make_backend": "xreset.plugins",
    "make_bank": "xreset.resets.filter",
    "make_env": "xreset.env",
    "read_bank": "xreset.resets.bank",
    "read_demos": "xreset.demos.archive",
    "retarget_demos": "xreset.retarget.pipeline",  # xreset.retarget is the package
    "synthesize": "xreset.demos.synth",
    "train": "xreset.learning.train",
    "VectorEnv": "xreset.vector_env",
}
_OWN_NAMES = {"retarget_demos": "retarget"}

__all__ = [
    "ManipulationEnv",
    "OnnxPolicy",
    "VectorEnv",
    "evaluate",
    "load_object",
    "load_robot",
    "make_backend",
    "make_bank",
    "make_env",
    "read_bank",
    "read_demos",
    "retarget_demos",
    "synthesize",
    "train",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'xreset' has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_HOMES[name]), _OWN_NAMES.get(name, name))
    return value


def __dir__() -> list[str]:
    return [*globals(), *__all__]
