"""Checks the links of pages outside of docs/: each must lead to a file or heading of the project. mkdocs checks docs/."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

_LINK = re.compile(r"\]\(([^)\s#]*)(?:#([^)\s]*))?\)")


def anchors(page: Path) -> set[str]:
    """Return the names of a page's headings in links, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(), re.MULTILINE)
    return {
        re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings
    }


def broken(page: Path) -> list[str]:
    """Return the links of a page that lead nowhere."""
    found = []
    for target, anchor in _LINK.findall(page.read_text()):
        if "://" in target or target.startswith("mailto:"):
            continue
        file = (page.parent / target).resolve() if target else page
        if not file.exists() or (anchor and file.suffix == ".md" and anchor not in anchors(file)):
            found.append(f"{page}: {target}{'#' + anchor if anchor else ''} leads nowhere")
    return found


def main() -> None:
    """Print what is broken, and exit with 1 if anything is."""
    pages = subprocess.run(
        ["git", "ls-files", "*.md"], capture_output=True, text=True, check=True
    ).stdout.split()
    problems = []
    for page in pages:
        if not page.startswith("docs/") and Path(page).exists():
            problems += broken(Path(page))
    print("\n".join(problems), file=sys.stderr, end="\n" if problems else "")
    raise SystemExit(bool(problems))


if __name__ == "__main__":
    main()
