"""The documentation: its commands are understood, its code has names that exist, its links lead
somewhere."""

import ast
import importlib
import pkgutil
import re
import shlex
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml

import fbse_drake
from fbse_drake import ViscousFriction
from fbse_drake.cli import _parser

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOKS = [path.name for path in (ROOT / "notebooks").glob("*.ipynb")]

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
        if not target.startswith(("http", "reference/", "tutorials/")):
            assert (page.parent / target).exists(), target


def test_every_page_is_in_the_navigation():
    names = re.findall(r"[\w/]+\.md", (ROOT / "mkdocs.yml").read_text())
    assert {page.name for page in PAGES if page.parent == ROOT / "docs"} <= set(names)
    hooks = (ROOT / "docs/hooks.py").read_text()
    for name in names:
        if name.startswith("reference/"):
            assert f'"{Path(name).stem}": ' in hooks
        elif name.startswith("tutorials/"):
            assert (ROOT / "notebooks" / name).with_suffix(".ipynb").name in NOTEBOOKS
        else:
            assert (ROOT / "docs" / name).is_file()
    assert {f"tutorials/{Path(name).stem}.md" for name in NOTEBOOKS} <= set(names)


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


@pytest.fixture
def hooks(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    for needed in ("mkdocs", "nbconvert"):
        pytest.importorskip(needed, reason=f"{needed} is not installed (extra docs)")
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("hooks")


def test_a_new_effect_is_in_the_library_by_itself(hooks: ModuleType, monkeypatch):
    """With its law as code, and a picture that shows it over the velocity."""
    wind = type("Wind", (ViscousFriction,), {"__doc__": "Of the air: u = viscous w, or less."})
    monkeypatch.setattr(hooks, "effects_by_name", lambda: {"Wind": wind})
    page = hooks.effects()
    assert "### Wind" in page
    assert "Of the air: `u = viscous w`, or less." in page
    assert f"![{wind.signature}](Wind.svg)" in page
    assert wind.experiment in page
    assert b"velocity [rad/s]" in hooks.signature(wind)


def test_a_viscous_torque_is_drawn_as_a_line_over_the_velocity_alone(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    figure = importlib.import_module("signatures").drawn(ViscousFriction)
    _, over_velocity, over_angle, _ = (axes.lines[0].get_xydata() for axes in figure.axes)
    assert abs(np.corrcoef(over_velocity.T)[0, 1]) > 1 - 1e-12
    assert abs(np.corrcoef(over_angle.T)[0, 1]) < 0.1


def test_a_notebook_becomes_a_page_with_its_pictures(hooks: ModuleType):
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        made = dict(hooks.tutorial(path))
        page = made[f"tutorials/{path.stem}.md"]
        assert page.startswith("# ")
        linked = {name for name in re.findall(r"\]\(([^)]+)\)", page) if "//" not in name}
        pictures = {name.removeprefix("tutorials/") for name in made if name.endswith(".png")}
        assert pictures <= linked
        assert linked - pictures <= {f"{Path(name).stem}.md" for name in NOTEBOOKS}
