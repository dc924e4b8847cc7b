"""Depth cameras: what they are (``config``), what they hit (``rays``), and what they deliver (``sensor``)."""
