"""Pages from the templates in ``eval/templates``."""

from __future__ import annotations

from functools import cache
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from xreset.files.storage import code_version
from xreset.files.text import short_name


def cell(text: str) -> str:
    """Return Markdown for a cell of a table, in one line."""
    return " ".join(text.replace("|", "\\|").split())


def percent(share: float) -> str:
    """Return a share as percent: ``0.345`` is ``34%``."""
    return f"{share:.0%}"


@cache
def _environment() -> Environment:
    made = Environment(
        loader=PackageLoader("xreset.eval"),
        autoescape=lambda name: name is not None and ".html" in name,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    made.filters |= {"percent": percent, "short_name": short_name, "cell": cell}
    made.globals["version"] = code_version()
    return made


def render(template: str, **values: Any) -> str:
    """Return a page; in HTML, text that could be read as markup is escaped."""
    return _environment().get_template(template).render(values)
