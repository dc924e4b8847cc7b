"""What mkdocs does not do by itself."""

import re
from typing import Any

_ROLE = re.compile(r":(?:func|class|mod|data|attr|meth):<code>~?([^<]*)</code>")


def on_page_content(html: str, **_: Any) -> str:
    """Docstrings name things by Sphinx's roles: what is left of one is its name."""
    return _ROLE.sub(r"<code>\1</code>", html)
