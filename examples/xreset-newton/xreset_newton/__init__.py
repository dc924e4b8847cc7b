"""Newton's Steel solver as a backend of xreset: an example of an engine plugin. See ``docs/add-an-engine.md`` of xreset."""
