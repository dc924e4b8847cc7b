"""What mkdocs does not do by itself."""

import re
from pathlib import Path
from typing import Any

_STUBS = Path(__file__).parents[1] / "xreset/__init__.pyi"
_MODULE_OF = {
    name: module for module, name in re.findall(r"from (\S+) import (\w+)", _STUBS.read_text())
}
_ROLE = re.compile(r":(?:func|class|mod|data|attr|meth):<code>~?([^<]*)</code>")


def on_page_content(html: str, **_: Any) -> str:
    """Docstrings name things by Sphinx's roles: what is left of one is its name."""
    return _ROLE.sub(r"<code>\1</code>", html)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The reference names `xreset.NAME`; its docstring is in the module that `import xreset` takes it from."""

    def place(match: re.Match[str]) -> str:
        name = match[1]
        return f"::: {_MODULE_OF[name]}.{name}\n    options:\n      heading: xreset.{name}"

    return re.sub(r"^::: xreset\.(\w+)$", place, markdown, flags=re.MULTILINE)
