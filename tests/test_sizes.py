"""What is plausible of a robot depends on how large it is, and what is found of it does not."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded_arm import ARM, Machine

from fbse_drake import resources
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.effects.effect import Parameter, library

# Powers of the mass with which quantities grow from a robot to one of the same shape and density.
GROWS = {"kg": 1.0, "N": 1.0, "Nm": 4 / 3, "m": 1 / 3, "s": 0.0, "rad": 0.0}
# Of sensors and electronics, speeds, and pitches of gears, which do not.
OF_THEIR_OWN = {"m/s^2", "Nm/A", "m/s", "s/m", "rad/m"}


def heavier(factor: float, folder: Path) -> Machine:
    """The arm with bodies and rotors that are so many times as heavy."""
    shutil.copytree(resources.folder("models"), folder / "models")
    urdf = folder / "models" / "arm.urdf"
    number = re.compile(r'(<mass value=|\bi[xyz][xyz]=)"([^"]*)"')
    multiplied = number.sub(lambda m: f'{m[1]}"{factor * float(m[2]):.15g}"', urdf.read_text())
    urdf.write_text(multiplied)
    return replace(
        ARM,
        description=str(folder / "models" / "arm.yaml"),
        rotor_inertia=tuple(factor * inertia for inertia in ARM.rotor_inertia),
        torque_noise=tuple(factor * noise for noise in ARM.torque_noise),
    )


def diagnosed(arm: Machine, factor: float) -> Diagnosis:
    """Friction, a rotor and an offset that the model lacks, so many times as large."""
    course = arm.course()
    hidden = np.zeros_like(course.torque)
    hidden[:, 0] = 3.0 * course.acceleration[:, 0]
    hidden[:, 1] = 8.0 * np.tanh(course.velocity[:, 1] / 0.01)
    hidden[:, 2] = 4.0
    return diagnose(arm.predictor(arm.log(course, course.torque + factor * hidden)))


@pytest.fixture(scope="module")
def of_the_arm() -> Diagnosis:
    return diagnosed(ARM, 1.0)


def test_a_rotor_may_be_felt_as_much_as_what_the_joint_moves(of_the_arm: Diagnosis) -> None:
    """A humanoid's rotors have no 3 kg m^2; those of an arm whose shoulder moves 10 kg m^2 do."""
    found = {(f.effect, *f.targets): f.parameters for f in of_the_arm.chosen}
    assert set(found) == {
        ("ReflectedInertia", "axis_1"),
        ("CoulombFriction", "axis_2"),
        ("TorqueBias", "axis_3"),
    }
    assert found["ReflectedInertia", "axis_1"]["inertia"].value == pytest.approx(3.0, abs=0.1)


def test_what_is_found_of_a_heavy_robot_is_what_is_found_of_a_light_one(
    of_the_arm: Diagnosis, tmp_path: Path
) -> None:
    """An arm of 1.4 t whose torques are all thirty times as large: nothing else is different."""
    factor = 30.0
    found = diagnosed(heavier(factor, tmp_path), factor)
    assert found.verdict == of_the_arm.verdict == "effect_found"
    light = {(f.effect, *f.targets): f for f in of_the_arm.chosen}
    assert {(f.effect, *f.targets) for f in found.chosen} == set(light)
    for finding in found.chosen:
        of_light = light[(finding.effect, *finding.targets)]
        for name, estimate in finding.parameters.items():
            expected = (1.0 if name == "transition" else factor) * of_light.parameters[name].value
            assert estimate.value == pytest.approx(expected, rel=1e-3), name


def test_plausible_values_grow_as_quantities_of_a_robot_do() -> None:
    """By the dimensions of their units, of revolute and of prismatic joints; those of a robot of up
    to 100 kg are as they are given."""

    def power(unit: str) -> float:
        above, _, below = unit.partition("/")
        return sum(
            sign * GROWS[factor] * float(exponent or 1)
            for sign, part in ((1, above), (-1, below))
            for factor, _, exponent in (one.partition("^") for one in part.split())
            if factor in GROWS
        )

    parameters: list[Parameter] = [p for e in library().values() for p in e.parameters.values()]
    parameters += [p.at_prismatic_joint for p in parameters]
    grown = set()
    for parameter in parameters:
        expected = 0.0 if parameter.unit in OF_THEIR_OWN else power(parameter.unit)
        assert parameter.factor_with(800.0) == pytest.approx(8.0**expected), parameter.unit
        assert parameter.factor_with(50.0) == 1.0
        grown |= {parameter.unit} if expected else set()
    assert {"kg", "N", "m", "Nm", "kg m^2", "rad/Nm", "m/N"} <= grown
