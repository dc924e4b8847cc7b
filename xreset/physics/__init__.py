"""Physics engines: the contract that every engine keeps, and the plugins that keep it.

The names of the contract are imported from ``contract`` when they are first used, so that a list of plugins loads no
torch.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from xreset.physics.contract import Backend as Backend
    from xreset.physics.contract import Capability as Capability
    from xreset.physics.contract import Contacts as Contacts
    from xreset.physics.contract import Health as Health
    from xreset.physics.contract import KnownDifference as KnownDifference
    from xreset.physics.contract import Links as Links
    from xreset.physics.contract import MassProperties as MassProperties
    from xreset.physics.contract import Parameter as Parameter
    from xreset.physics.contract import Parameters as Parameters
    from xreset.physics.contract import State as State
    from xreset.physics.contract import no_readings as no_readings
    from xreset.physics.contract import unavailable as unavailable


def __getattr__(name: str) -> Any:
    if name.startswith("_"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("xreset.physics.contract"), name)
