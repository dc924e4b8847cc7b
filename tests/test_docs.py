"""The documentation names commands, options, functions and files that exist, and fits on the page."""

import ast
import builtins
import importlib
import inspect
import re
import shlex
import sys
import tomllib
from functools import cache
from pathlib import Path
from textwrap import dedent
from types import ModuleType
from unittest import TestCase

import xreset
import xreset.runtime
from tests.command import succeeds
from xreset.cli import COMMANDS
from xreset.cli._terms import take_terms
from xreset.learning.config import TrainConfig

ROOT = Path(__file__).resolve().parents[1]
PAGES = [*(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "AGENTS.md", "SECURITY.md"))]
PAGES += sorted((ROOT / "docs").glob("*.md"))


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
    words = [shlex.split(line, comments=True)[1:] for line in found if line.startswith("xreset ")]
    return [each for each in words if each and re.fullmatch(r"[a-z]+", each[0])]


def command_of(words):
    """Return the words that name a command: one, or two or three in a group; or those of a group alone."""
    name, *others = words
    command = getattr(importlib.import_module(f"xreset.cli.{name}"), "COMMAND", None)
    if not isinstance(command, dict) or not others:
        return (name,)
    if others[0].startswith("-") and "" in command:
        return (name, "list")  # the command without a verb
    known = [verb.split() for verb in command if verb]
    verbs = [" ".join(verb) for verb in known if verb == others[: len(verb)]]
    group = [verb for verb in known if verb[0] == others[0]] if len(others) == 1 else []
    assert verbs or group, f"xreset {' '.join(words)}: there is no such command"
    return (name, *(verbs[0].split() if verbs else others))


@cache
def help_of(words):
    """Return the help text of a command."""
    out = succeeds(*words, "--help")
    if tuple(words) == ("train",):
        out += succeeds("train --help-config all")
    assert not re.search(r":[a-z]+:`", out), f"a reference that only the site shows: {out}"
    return out


def programs(page):
    """Return the page's Python programs: blocks that are called Python, and others that begin with an import."""
    text = page.read_text()
    found = re.findall(r"(?ms)^```python\n(.*?)^```", text)
    indented = [dedent(block) for block in re.findall(r"(?m)(?:^    .*\n|^\n)+", text)]
    return found + [block for block in indented if re.match(r"\s*(import|from) ", block)]


def unknown_names(program):
    """Return the names that xreset lacks: what a program imports, attributes of modules, arguments of functions."""
    known = {"xreset": xreset, "runtime": xreset.runtime}
    nodes = list(ast.walk(ast.parse(program)))
    for node in nodes:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("xreset"):
            module = importlib.import_module(node.module)
            for alias in node.names:
                known[alias.name] = getattr(module, alias.name, None)
    unknown = [name for name, value in known.items() if value is None]

    def value_of(node):
        """Return the value of a name or of a module's attribute; None: unknown."""
        if isinstance(node, ast.Name):
            return known.get(node.id)
        if isinstance(node, ast.Attribute):
            owner = value_of(node.value)
            return getattr(owner, node.attr, None) if isinstance(owner, ModuleType) else None
        return None

    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(value_of(node.value), ModuleType):
            module = value_of(node.value)
            public = getattr(module, "__all__", dir(module))
            if node.attr not in public and not isinstance(value_of(node), ModuleType):
                unknown.append(f"{module.__name__}.{node.attr}")
        if isinstance(node, ast.Call) and callable(value_of(node.func)):
            accepted = inspect.signature(value_of(node.func)).parameters
            given = {keyword.arg for keyword in node.keywords if keyword.arg}
            unknown += [f"{ast.unparse(node.func)}({name}=)" for name in given - set(accepted)]
    return unknown


GIVEN = {"live.md": {"goal_pos", "goal_quat"}}
"""Names that the text of a page gives to its programs."""


def undefined_names(texts):
    """Return the names that the programs of a page use, and none of them defines."""
    used = set()
    defined = set(dir(builtins))
    for text in texts:
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Name):
                (used if isinstance(node.ctx, ast.Load) else defined).add(node.id)
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                defined.add(node.name)
            elif isinstance(node, ast.arg):
                defined.add(node.arg)
            elif isinstance(node, ast.alias):
                defined.add((node.asname or node.name).partition(".")[0])
    return used - defined


class DocumentedTest(TestCase):
    def test_every_command_and_option_exists(self):
        seen = 0
        for page in PAGES:
            for words in commands(page):
                with self.subTest(page=page.name, command=" ".join(words)):
                    self.assertIn(words[0], COMMANDS)
                    help_text = help_of(command_of(words))
                    if words[0] == "train":
                        take_terms(TrainConfig(), words)  # these options are not in the help
                    options = {
                        word.partition("=")[0] for word in words if re.match(r"--[a-z]", word)
                    }
                    missing = {
                        option
                        for option in options
                        if not re.search(rf"{option}(?![\w-])", help_text)
                    }
                    self.assertFalse(missing)
                    seen += len(options)
        self.assertGreater(seen, 100)

    def test_every_name_and_argument_of_a_program_exists(self):
        seen = 0
        for page in PAGES:
            for program in programs(page):
                seen += 1
                with self.subTest(page=page.name, program=program[:60]):
                    self.assertEqual(unknown_names(program), [])
            with self.subTest(page=page.name):
                undefined = undefined_names(programs(page))
                self.assertEqual(undefined, GIVEN.get(page.name, set()))
        self.assertGreater(seen, 6)


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
        defined = {"DataFrame"}  # of pandas
        for folder in folders:
            for file in (ROOT / folder).rglob("*.py"):
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

    def test_what_an_environment_imports_is_installed_with_the_extra_torch(self):
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        installed = project["dependencies"] + project["optional-dependencies"]["torch"]
        names = {re.split(r"\W", text)[0] for text in installed}
        imported = set()
        for node in ast.walk(ast.parse((ROOT / "xreset/env/manipulation.py").read_text())):
            if isinstance(node, ast.Import):
                imported |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                imported.add(node.module)
        packages = {name.partition(".")[0] for name in imported} - {"xreset"}
        self.assertLessEqual(packages - sys.stdlib_module_names, names)

    def test_the_help_of_a_public_function_begins_on_the_first_screen(self):
        for name in xreset.__all__:
            value = getattr(xreset, name)
            if inspect.isfunction(value):
                self.assertLess(len(str(inspect.signature(value))), 1000, name)

    def test_every_public_name_is_in_the_reference(self):
        headings = set(
            re.findall(
                r"^::: xreset\.(\w+)$", (ROOT / "docs/reference.md").read_text(), re.MULTILINE
            )
        )
        self.assertEqual(headings, {*xreset.__all__})
