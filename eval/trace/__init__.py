"""When, where and by how much engines part: one action sequence from one state, replayed in each of them."""

from xreset.eval.trace.actions import Actions, grasp_and_lift, play_policy, read_actions, write_actions
from xreset.eval.trace.partings import Parting, Thresholds
from xreset.eval.trace.replay import EngineTrace, TraceResult, trace

__all__ = [
    "Actions",
    "EngineTrace",
    "Parting",
    "Thresholds",
    "TraceResult",
    "grasp_and_lift",
    "play_policy",
    "read_actions",
    "trace",
    "write_actions",
]
