"""A small goal set for tests: soup and spam upright, two goals each, 0.2 m above the start and turned about z."""

import numpy as np

from tests.toy_bank import SOUP, SPAM
from xreset import GoalSet, load_object
from xreset.objects.rest import rest_height
from xreset.resets.bank import no_states

UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def toy_goals(robot, **changes):
    """Return the goal set; ``changes`` replace fields."""
    owners = [SOUP, SOUP, SPAM, SPAM]
    heights = [rest_height(load_object(name), UPRIGHT) for name in owners]
    start = np.array(
        [[0.5 + 0.03 * i, 0.3, height] for i, height in enumerate(heights)], np.float32
    )
    fields = no_states(robot) | {
        "sequence_name": np.array([f"{name}/lift_{i:03d}" for i, name in enumerate(owners)]),
        "sequence_object": np.array(owners),
        "family": np.array(["lift"] * 4),
        "start_pos": start,
        "start_quat_wxyz": np.tile(UPRIGHT, (4, 1)).astype(np.float32),
        "goal_pos": start + np.float32([0.0, 0.0, 0.2]),
        "goal_quat_wxyz": np.tile([np.cos(0.3), 0.0, 0.0, np.sin(0.3)], (4, 1)).astype(np.float32),
        "object_names": (SOUP, SPAM),
        "object_sources": ("stand-in", "stand-in"),
    }
    return GoalSet(**(fields | changes))
