"""The documentation: its commands are understood, its code has names that exist, its links lead
somewhere."""

import ast
import pkgutil
import re
import shlex
from pathlib import Path

import pytest
import yaml

import fbse_drake
from fbse_drake.cli import _parser

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

each_page = pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)


def commands(text: str) -> list[str]:
    """Of indented blocks and of code within lines."""
    lines = re.findall(r"^    (?:\S+/)?(fbse .*)$", text, re.MULTILINE)
    return [line for line in lines if "--help" not in line]


@each_page
def test_every_command_is_understood(page: Path):
    for command in commands(page.read_text()):
        _, *arguments = shlex.split(command, comments=True)
        # A brace stands for several files, as a shell has it.
        _parser().parse_args(arguments)


def test_there_are_commands():
    assert sum(len(commands(page.read_text())) for page in PAGES) > 30


@each_page
def test_python_code_is_code_and_its_names_exist(page: Path):
    for block in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL):
        for node in ast.walk(ast.parse(block)):
            if isinstance(node, ast.ImportFrom) and node.module == "fbse_drake":
                missing = [a.name for a in node.names if a.name not in fbse_drake.__all__]
                assert missing == []


@each_page
def test_links_lead_somewhere(page: Path):
    for target in re.findall(r"\]\(([^)#]+)[)#]", page.read_text()):
        if not target.startswith(("http", "reference/")):
            assert (page.parent / target).exists(), target


def test_every_page_is_in_the_navigation():
    names = re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text())
    assert {page.name for page in PAGES if page.parent.name == "docs"} <= set(names)
    hooks = (ROOT / "docs/hooks.py").read_text()
    for name in names:
        made = f'"{Path(name).stem}": ' in hooks
        assert made if name.startswith("reference/") else (ROOT / "docs" / name).is_file()


def test_what_is_cited_is_a_citation():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    project = (ROOT / "pyproject.toml").read_text()
    assert f'version = "{cited["version"]}"' in project
    assert f'license = "{cited["license"]}"' in project


def test_functions_that_hold_equations_exist():
    """The modules and attributes that the page of equations names."""
    text = (ROOT / "docs/theory.md").read_text()
    names = re.findall(r"`(fbse_drake(?:\.\w+)+)`", text)
    assert len(names) > 20
    for name in names:
        pkgutil.resolve_name(name)
