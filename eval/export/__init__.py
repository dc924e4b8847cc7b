"""Evaluation episodes for others: as a LeRobot data set, or as plain arrays."""

from xreset.eval.export.arrays import write_arrays
from xreset.eval.export.lerobot import write_lerobot
from xreset.eval.export.recorded import Recorded, Recording, read_recorded

__all__ = ["Recorded", "Recording", "read_recorded", "write_arrays", "write_lerobot"]
