"""Runs that several tests look at, made once per session."""

import ctypes
import dataclasses
import gc
import os
from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from pathlib import Path

import pytest
import yaml
from matplotlib.figure import Figure

from fbse_drake import Log, Scenario, load_scenario, simulate
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.scenario import RecordingConfig, RobotConfig, SensorsConfig

# A file that takes long and starts last would keep a single worker busy; one that needs much room
# for a while finds it best before a worker has grown.
_FIRST = (
    "test_notebooks",
    "test_physics",
    "test_real_icub",
    "test_motor_encoders",
    "test_whole_body",
    "test_report_browser",
    "test_real_emps",
    "test_validation",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take longest, or most room, come first."""
    places = {name: place for place, name in enumerate(_FIRST)}
    items.sort(key=lambda item: places.get(item.path.stem, len(places)))


def pytest_collection_finish() -> None:
    """What is imported by now stays: the garbage collector need not look at it again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(trylast=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """What functions of a file remember for its tests, and what these leave in circles, is not
    kept for the next file, nor by the C library where it can give it back."""
    if nextitem is None or nextitem.path != item.path:
        for function in vars(item.getparent(pytest.Module).obj).values():
            if hasattr(function, "cache_clear") and function.__module__ == item.path.stem:
                function.cache_clear()
        gc.collect()
        if trim := getattr(ctypes.CDLL(None), "malloc_trim", None):
            trim(0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Log]:
    """Simulates a shipped scenario: run("squat", "duration=2", noise=False).

    Logs are files, so that the files of tests and the workers of a session share them; the last
    ones of a file of tests are in memory as well, some 3 MiB for each second.
    """
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent

    @lru_cache(maxsize=2)
    def simulated(name: str, *overrides: str, noise: bool = True) -> Log:
        key = sha256(repr((name, overrides, noise)).encode()).hexdigest()
        path = folder / f"run_{key}.npz"
        if not path.exists():
            simulate(scenario(name, *overrides, noise=noise), name=name).log.save(path)
        return Log.load(path)

    return simulated


@pytest.fixture
def blank_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures in reports are empty: making them of figures takes most of the time of a short
    run."""

    def blank(draw: Callable[[], Figure]) -> str:
        draw()
        return "data:image/png;base64,"

    monkeypatch.setattr("fbse_drake.report.html._png_uri", blank)


def scenario(name: str, *overrides: str, noise: bool = True) -> Scenario:
    """A shipped scenario, without sensor errors if so wished."""
    result = load_scenario(name, overrides=overrides)
    return result if noise else dataclasses.replace(result, sensors=SensorsConfig())


def pendulum(folder: Path, mass: float, away: float, inertia: float) -> RobotConfig:
    """A rod that hangs in a joint called `pivot`; files of it are written into a folder.

    Args:
        away: its centre of mass from the pivot [m]; inertia: about the pivot [kg m^2].
    """
    own = inertia - mass * away**2
    (folder / "pendulum.urdf").write_text(
        f'''<robot name="pendulum"><link name="stand"/><link name="arm"><inertial>
        <origin xyz="0 0 {-away}"/><mass value="{mass}"/>
        <inertia ixx="{own}" iyy="{own}" izz="{own}" ixy="0" ixz="0" iyz="0"/></inertial></link>
        <joint name="pivot" type="revolute"><parent link="stand"/><child link="arm"/>
        <axis xyz="0 -1 0"/><limit lower="-9" upper="9" effort="99" velocity="99"/></joint></robot>
        '''
    )
    description = {"urdf": "pendulum.urdf", "base": "stand", "fixed_base": True}
    (folder / "pendulum.yaml").write_text(yaml.safe_dump(description | {"joints": ["pivot"]}))
    return RobotConfig(str(folder / "pendulum.yaml"))


def swinging_legs(duration: float, noise: float, *changes: str) -> tuple[Scenario, Log]:
    """Legs that swing in a gantry without any friction, as planned; believed to be noisy [Nm]."""
    overrides = [f"duration={duration}", "log.period=0.01", *changes]
    scenario = load_scenario("leg_swing_gantry", overrides=overrides)
    bare = dataclasses.replace(scenario.robot, effects={})
    believed = dataclasses.replace(scenario, robot=bare, model=bare)
    recording = RecordingConfig(rows="instantaneous", block=0.02, torque_noise={"all": noise})
    return dataclasses.replace(believed, recording=recording), planned_log(believed)
