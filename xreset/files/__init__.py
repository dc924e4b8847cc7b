"""Files and records: atomic writes, claims, checked formats, progress and texts."""
