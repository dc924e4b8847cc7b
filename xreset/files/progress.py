"""What callers of long functions may pass to see how far they are."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, int], None]
"""Called with what is done and what is to be done in all."""
NamedProgress = Callable[[str, float, int], None]
"""Called with the name of what runs, what is done of it and what is to be done in all."""


def unseen(*done: object) -> None:
    """Show nothing."""
