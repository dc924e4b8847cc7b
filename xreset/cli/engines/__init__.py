"""``xreset engines``: which engines there are, what they can do, and how far they agree."""

COMMANDS = {
    "list": "List physics engines and whether they can be used here.",
    "check": "Test that a physics engine keeps the interface's contracts.",
    "compare": "Measure how far physics engines agree on grasps.",
    "trace": "Replay one action sequence in several engines, and see when, where and by how much they diverge.",
    "attribute": "Tell which physical difference between two engines costs a policy its skill.",
    "page": "Make the support matrix: what every engine can do and how far they agree, from measured results.",
}
"""Command -> one line of help."""
