"""Checks two habits that ruff has no rule for: packed assignments and nested comprehensions.

usage: style.py [FOLDER ...]      (default: all code but the examples, which must be short)

A packed assignment is ``a, b = x, y`` where a plain pair of statements would do; swapping two names is allowed.
A nested comprehension has two ``for`` or holds another comprehension. ``# noqa: XR001`` or ``XR002`` on the line allows one.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

FOLDERS = ("xreset", "backends", "robots", "eval", "ci", "tests")
COMPREHENSIONS = (ast.ListComp, ast.SetComp, ast.DictComp, ast.GeneratorExp)


def is_packed(node: ast.AST) -> bool:
    """Whether this is ``a, b = x, y`` and not a swap."""
    if not isinstance(node, ast.Assign) or not isinstance(node.value, ast.Tuple):
        return False
    target = node.targets[0]
    if not isinstance(target, ast.Tuple):
        return False
    names = {ast.unparse(element) for element in target.elts}
    values = {ast.unparse(element) for element in node.value.elts}
    return names != values


def is_nested(node: ast.AST) -> bool:
    """Whether this comprehension has two loops or holds another comprehension."""
    if not isinstance(node, COMPREHENSIONS):
        return False
    if len(node.generators) > 1:
        return True
    inner = (child for child in ast.walk(node) if child is not node)
    return any(isinstance(child, COMPREHENSIONS) for child in inner)


def problems(path: Path) -> Iterator[str]:
    """Yield one line for each finding in a file."""
    text = path.read_text()
    lines = text.splitlines()
    for node in ast.walk(ast.parse(text)):
        for found, code, sentence in (
            (is_packed(node), "XR001", "packed assignment: write one assignment a line"),
            (is_nested(node), "XR002", "nested comprehension: write a loop or name the inner part"),
        ):
            if found and code not in lines[node.lineno - 1]:
                yield f"{path}:{node.lineno}: {code} {sentence}"


def python_files(folder: Path) -> Iterator[Path]:
    """Yield the Python files of a folder without its links, whose files are checked where they are."""
    for path in sorted(folder.rglob("*.py")):
        if not any(part.is_symlink() for part in (path, *path.parents)):
            yield path


def main() -> int:
    folders = sys.argv[1:] or FOLDERS
    found = []
    for folder in folders:
        for path in python_files(Path(folder)):
            found.extend(problems(path))
    print("\n".join(found) if found else "no packed assignment, no nested comprehension")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
