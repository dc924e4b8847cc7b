"""Hooks of mkdocs that change the site's pages."""

import re
from pathlib import Path
from typing import Any

_STUBS = Path(__file__).parents[1] / "xreset/__init__.pyi"
_MODULE_OF = {
    name: module for module, name in re.findall(r"from (\S+) import (\w+)", _STUBS.read_text())
}
_INTERVAL = re.compile(r"\((-?[\d.]+(?:-| to )[-+]?[\d.]+)\)(?![^<]*>)")
_SHORT_CODE = re.compile(r"<code>([^<\n]{1,36})</code>")
_ROLE = re.compile(r":(?:func|class|mod|data|attr|meth):<code>~?([^<]*)</code>")


def on_page_content(html: str, **_: Any) -> str:
    """Replace Sphinx's roles of docstrings by names, and keep short code and intervals in one line."""
    html = _ROLE.sub(r"<code>\1</code>", html)
    html = _SHORT_CODE.sub(r'<code class="whole">\1</code>', html)
    return _INTERVAL.sub(r'<span class="whole">(\1)</span>', html)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Replace `xreset.NAME` in the reference by the module that `import xreset` takes the name from."""

    def place(match: re.Match[str]) -> str:
        name = match[1]
        return f"::: {_MODULE_OF[name]}.{name}\n    options:\n      heading: xreset.{name}"

    return re.sub(r"^::: xreset\.(\w+)$", place, markdown, flags=re.MULTILINE)
