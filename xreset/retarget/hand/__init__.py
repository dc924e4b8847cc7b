"""Hand retargeting over whole trajectories: ``solve``, on ``cost``, ``terms``, ``clearance``, ``model`` and
``config``."""
