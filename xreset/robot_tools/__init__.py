"""Tools for whoever brings a robot: ``importer`` makes its description, ``check`` checks it, ``picture`` draws it,
``place`` finds a place for its base, and ``judge`` says what it can hold."""
