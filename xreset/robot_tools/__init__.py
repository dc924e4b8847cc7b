"""Tools for whoever writes a robot's description: check it, place its base, look at it."""
