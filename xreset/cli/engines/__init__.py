"""``xreset engines``: list, check, compare and trace physics engines."""

COMMANDS = {
    "list": "List physics engines and whether they can be used here.",
    "check": "Test whether a physics engine keeps its contract.",
    "compare": "Measure how far physics engines agree on grasps.",
    "trace": "Replay the same actions in several engines, and show when and by how much they diverge.",
    "attribute": "Find the physical difference between two engines that costs a policy its skill.",
    "page": "Make a Markdown page of what was measured of the engines.",
}
"""Command -> one line of help."""
