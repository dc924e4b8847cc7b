"""Hand retargeting over whole trajectories. ``solve`` is the entry; it uses ``cost``, ``terms``, ``clearance``,
``model`` and ``config``."""
