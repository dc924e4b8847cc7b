"""``xreset engines page``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from xreset.files import write_whole


def page(
    *,
    source: Annotated[tuple[Path, ...], tyro.conf.arg(name="from"), tyro.conf.UseAppendAction],
    out: Path | None = None,
) -> None:
    """Make a Markdown page of what was measured of the engines.

    Args:
        source: File of `xreset engines check --json`; give it again for more. Of two results of the same check,
            engine, device and robot, the later one counts.
        out: File to write; default: print it.
    """
    from xreset.eval.engines import page as matrix

    text = matrix.page(matrix.read(source))
    if out is None:
        print(text, end="")
        return
    write_whole(out, text)
    print(f"wrote {out}")


COMMAND = page
