"""Run a deployed policy on a robot: its graph, and the loop around a driver.

This package needs numpy and onnxruntime, and nothing else of xreset: ``xreset export deploy`` copies it next to a
policy. It has not been tried on hardware. Read ``docs/live.md`` before a robot moves.
"""

from .contract import LiveError
from .controller import Controller, load_controller
from .driver import Driver, Reading
from .runner import Limits, Outcome, Runner

__all__ = [
    "Controller",
    "Driver",
    "Limits",
    "LiveError",
    "Outcome",
    "Reading",
    "Runner",
    "load_controller",
]
