"""The documentation names commands and options that exist, and fits on the page."""

import ast
import re
import shlex
import sys
import tomllib
from functools import cache
from pathlib import Path
from unittest import TestCase

from tests.command import succeeds
from xreset.cli import COMMANDS
from xreset.cli.engines import COMMAND as ENGINES

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "AGENTS.md", "SECURITY.md"))]
PAGES += sorted((ROOT / "docs").glob("*.md"))
GROUPS = ("demos", "objects", "robots", "policies", "export")
"""Commands whose second word is a verb."""


def blocks(page):
    """Return the lines of the page's code blocks, without the indentation that makes them one; continued lines are joined."""
    lines = [line[4:] for line in page.read_text().splitlines() if line.startswith("    ")]
    return re.sub(r"\\\n *", " ", "\n".join(lines)).splitlines()


def commands(page):
    """Return the words of the page's `xreset` commands: in code blocks, and in running text."""
    text = page.read_text()
    found = [line.strip() for line in blocks(page)]
    found += re.findall(r"`(xreset [^`]+)`", text)
    found = [re.sub(r"^.*-m (?=xreset )", "", line) for line in found]
    return [shlex.split(line, comments=True)[1:] for line in found if line.startswith("xreset ")]


@cache
def help_of(words):
    """Return the help text of a command."""
    out = succeeds(*words, "--help")
    assert not re.search(r":[a-z]+:`", out), f"a reference that only the site shows: {out}"
    return out


def command_of(words):
    """Return the words that name a command: one, or two or three in a group."""
    if words[0] in GROUPS:
        return tuple(words[:3] if words[:2] == ["demos", "import"] else words[:2])
    return tuple(words[:2] if words[0] == "engines" else words[:1])


class DocumentedCommandsTest(TestCase):
    def test_every_command_and_option_exists(self):
        seen = 0
        for page in PAGES:
            for words in commands(page):
                if (
                    not words
                    or not re.fullmatch(r"[a-z]+", words[0])
                    or (words[0] in GROUPS and len(words) < 2)
                ):
                    continue
                with self.subTest(page=page.name, command=" ".join(words)):
                    self.assertIn(words[0], COMMANDS)
                    if words[0] == "engines" and len(words) > 1:
                        self.assertIn(words[1], ENGINES)
                    options = {
                        word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)
                    }
                    if options:
                        help_text = help_of(command_of(words))
                        missing = {
                            option
                            for option in options
                            if not re.search(rf"{option}(?![\w-])", help_text)
                        }
                        self.assertFalse(missing)
                        seen += len(options)
        self.assertGreater(seen, 100)


class PageTest(TestCase):
    def test_code_blocks_fit_on_the_page(self):
        for page in PAGES:
            for line in page.read_text().splitlines():
                if line.startswith("    ") and not line.lstrip().startswith(("-", "|")):
                    self.assertLessEqual(len(line) - 4, 100, f"{page.name}: {line}")

    def test_code_blocks_begin_after_an_empty_line(self):
        # otherwise the site shows them as running text
        for page in PAGES:
            text = re.sub(r"(?ms)^```.*?^```", "", page.read_text())
            for start in re.findall(r"(?m)^[^-\s].*\n {4}\S.*", text):
                self.fail(f"{page.name}: {start}")

    def test_classes_and_files_exist(self):
        folders = ("xreset", "backends", "robots", "eval", "examples", "tests", "ci")
        sources = [file for folder in folders for file in (ROOT / folder).rglob("*.py")]
        defined = {"DataFrame"}  # of pandas
        for file in sources:
            defined.update(re.findall(r"(?m)(?:class |import |^)(\w+)", file.read_text()))
        files = 0
        for page in PAGES:
            text = re.sub(r"(?ms)^```.*?^```|^    .*?$", "", page.read_text())
            classes = set(re.findall(r"`(?:xreset\.)?([A-Z][a-z]+[A-Z]\w+)`", text))
            self.assertEqual(classes - defined, set(), page.name)
            for name in re.findall(rf"`((?:{'|'.join(folders)})/[a-z_/]+\.[a-z]+)`", text):
                self.assertTrue((ROOT / name).is_file(), f"{page.name}: {name}")
                files += 1
        self.assertGreater(files, 20)

    def test_the_citation_is_of_this_version(self):
        version = re.search(r'(?m)^version = "(.*)"$', (ROOT / "pyproject.toml").read_text())
        assert version
        self.assertIn(f"\nversion: {version[1]}\n", (ROOT / "CITATION.cff").read_text())

    def test_what_an_environment_imports_is_installed_without_extras(self):
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        names = {re.split(r"\W", text)[0] for text in project["dependencies"]}
        imported = set()
        for node in ast.walk(ast.parse((ROOT / "xreset/env.py").read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module)
        packages = {name.partition(".")[0] for name in imported} - {"xreset"}
        self.assertLessEqual(packages - sys.stdlib_module_names, names)

    def test_every_public_name_is_in_the_reference(self):
        import xreset

        headings = set(
            re.findall(
                r"^::: xreset\.(\w+)$", (ROOT / "docs/reference.md").read_text(), re.MULTILINE
            )
        )
        self.assertEqual(headings, {*xreset.__all__})
