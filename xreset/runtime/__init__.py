"""Run an exported policy on a robot: observations, forward kinematics, the policy, and the loop around a driver.

This package needs numpy and onnxruntime, and nothing else of xreset: ``xreset export deploy`` copies it next to a
policy. It has not been tried on hardware. Read ``docs/live.md`` before a robot moves.
"""

from .contract import LiveError, check_contract, read_contract
from .controller import Controller, OnnxActor, load_controller
from .driver import Driver, Links, Reading
from .remote import RemoteController
from .runner import Limits, Outcome, Runner

__all__ = [
    "Controller",
    "Driver",
    "Limits",
    "Links",
    "LiveError",
    "OnnxActor",
    "Outcome",
    "Reading",
    "RemoteController",
    "Runner",
    "check_contract",
    "load_controller",
    "read_contract",
]
