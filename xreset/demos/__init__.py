"""Human hand-object demonstrations: the archive, DexYCB, and synthetic ones."""
