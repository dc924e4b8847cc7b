"""Whether engines agree on grasps: the same hand, object and joint targets in each, and how far what happens differs."""
