"""Draw with matplotlib in the project's style, without windows and global state.

Drawings become SVG with the page's text color.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from xreset.errors import needs

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a6d3b", "#666666")
"""Color of each engine: the palette of Okabe and Ito, for color-blind readers and for light and dark pages."""
INK = "#010203"
"""Text color; in an SVG it is replaced by ``currentColor``."""


def svg(draw: Callable[[Figure], None], size: tuple[float, float], salt: str) -> str:
    """Return an ``<svg>`` element that scales with the page and has its text color.

    Args:
        size: width and height [inches].
        salt: keeps its identifiers apart from those of other figures on the page; the same salt and drawing give the
            same text.
    """
    with needs("matplotlib", "eval"):
        from matplotlib import style
        from matplotlib.figure import Figure
    own = {"svg.hashsalt": salt, "svg.fonttype": "none"}
    with style.context([Path(__file__).with_name("project.mplstyle"), own]):
        figure = Figure(figsize=size, layout="constrained")
        draw(figure)
        buffer = io.StringIO()
        figure.savefig(
            buffer,
            format="svg",
            transparent=True,
            metadata={"Date": None, "Creator": None, "Format": None, "Type": None},
        )
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for attribute in ("width", "height"):
        text = re.sub(rf'(<svg[^>]*?) {attribute}="[^"]*"', r"\1", text, count=1)
    return text.strip()
