"""``xreset engines``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def engines(
    *,
    source: Annotated[tuple[Path, ...], tyro.conf.arg(name="from"), tyro.conf.UseAppendAction],
    out: Path | None = None,
) -> None:
    """Make the support matrix: a Markdown page of what was measured of the engines.

    Args:
        source: File that `xreset conformance --json` or `xreset parity --json` wrote; give it again for several. Where two have the same
            check of the same engine, device and robot, the later one counts.
        out: File to write; default: print it.
    """
    from xreset.eval.engines.page import page, read
    from xreset.files import atomic_write

    text = page(read(source))
    if out is None:
        print(text, end="")
        return
    with atomic_write(out, "w") as file:
        file.write(text)
    print(f"wrote {out}")


COMMAND = engines
