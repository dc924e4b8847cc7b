"""Physics engines behind one interface: :class:`~xreset.physics.Backend`.

Backends are found by the entry-point group ``xreset.backends``; those of this package are listed in ``pyproject.toml``,
like those of any other package. An engine is imported when it is first used.
"""
