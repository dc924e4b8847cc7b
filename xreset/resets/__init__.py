"""Where episodes begin: reset banks and goal sets.

Modules: ``filter`` makes a bank from retargeted motion, with ``closing`` (states between frames), ``fingers`` (targets
that press) and ``probe`` (tries states in an engine); ``bank`` is its file; ``distribution`` draws the start of each
episode; ``goals`` makes starts and goals without demonstrations, with ``reach``; ``settle`` lets objects come to rest.
"""
