"""Physics engines behind one interface: :class:`~xreset.physics.Backend`.

A backend is named by the entry-point group ``xreset.backends``; this package's own are listed in ``pyproject.toml`` like anyone else's.
Nothing here imports an engine until one is asked for.
"""
