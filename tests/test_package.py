import subprocess
import sys
import zipfile
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The package as it is in a wheel, unpacked away from the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    command = [
        sys.executable,
        "-m",
        "pip",
        "wheel",
        "--quiet",
        "--no-deps",
        "--wheel-dir",
        str(folder),
        str(ROOT),
    ]
    subprocess.run(command, check=True, capture_output=True, timeout=300)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    return folder / "site"


def test_models_and_scenarios_are_found_by_name_from_an_installed_package(
    installed: Path, tmp_path: Path
):
    program = (
        "import fbse_drake, fbse_drake.resources as r;"
        "s = fbse_drake.load_scenario('paper_walk', overrides=['duration=0.05']);"
        "fbse_drake.simulate(s);"
        "print(r.folder('models'), r.folder('scenarios'))"
    )
    run = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        # Nothing is compiled there, which would take longer than all the rest.
        env={"PYTHONPATH": str(installed), "PATH": "", "NUMBA_DISABLE_JIT": "1"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [
        str(installed / "fbse_drake/models"),
        str(installed / "fbse_drake/scenarios"),
    ]


def test_the_wheel_holds_every_model_scenario_and_template(installed: Path):
    for name in ("models", "scenarios"):
        shipped = {path.name for path in (installed / "fbse_drake" / name).iterdir()}
        assert shipped == {path.name for path in (ROOT / name).iterdir()}
    assert (installed / "fbse_drake/report/templates/report.html.j2").is_file()


def test_the_oldest_versions_that_are_tried_are_the_lower_bounds():
    tomllib = pytest.importorskip("tomllib")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = map(
        Requirement,
        [*project["dependencies"], *chain(*project["optional-dependencies"].values())],
    )
    bounds = {
        canonicalize_name(needed.name): Version(bound.version)
        for needed in asked
        for bound in needed.specifier
        if bound.operator == ">="
    }
    lines = (ROOT / "constraints-minimum.txt").read_text().splitlines()
    tried = dict(line.split("==") for line in lines if not line.startswith("#"))
    assert {canonicalize_name(name): Version(text) for name, text in tried.items()} == bounds
