"""xreset: dexterous robot policies from human demonstrations used as reset states.

    import xreset

    can = xreset.load_object("soup")
    demos = xreset.synthesize([can.name], 4)                               # or xreset.read_demos("demos.npz")
    policy = xreset.load_policy("many-objects")                            # or a run folder, or an .onnx file

    motion = xreset.retarget_demos(demos, policy.robot, [can])             # robot states that follow the human hand
    bank = xreset.make_bank(motion, policy.robot, [can], engine="mujoco")  # those that a physics engine finds stable
    with policy.make_env([can], bank, engine="mujoco") as env:             # the task that the policy was trained for
        xreset.film(policy, env, "can.mp4")

Importing this package loads nothing heavy: no torch, no physics engine, no display. A name is imported when it is first
used.
"""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

__version__ = "0.3.0"

_STUB = Path(__file__).with_suffix(".pyi").read_text()
_HOMES = {
    name: module
    for module, name in re.findall(r"^from (\S+) import (\w+) as \w+$", _STUB, re.MULTILINE)
}
"""Public name -> its module. The stub, which editors read, is the one list of them."""
__all__ = sorted(_HOMES)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'xreset' has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return ["__version__", *__all__]
