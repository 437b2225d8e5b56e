"""A law whose parameters leave a smaller one possible is not told from it."""

from dataclasses import dataclass

import numpy as np
import pytest
from conftest import pendulum

from fbse_drake import Log, Scenario
from fbse_drake.discrepancy.diagnosis.diagnose import (
    Diagnosis,
    Estimate,
    diagnose,
    smaller_laws,
)
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.effects.effect import Parameter, library
from fbse_drake.effects.friction import StribeckFriction, ThermalDrift
from fbse_drake.effects.joint_torque import JointTorqueEffect
from fbse_drake.effects.transmission import JointSpring, PreslidingHysteresis
from fbse_drake.scenario import RecordingConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig

# Of a rod that hangs: mass [kg], half its length [m], moment of inertia there
# [kg m^2]; friction [Nm]; a step of the simulation and of the log [s].
MASS, AWAY, INERTIA, COULOMB, VISCOUS, GRAVITY = 1.2, 0.2, 0.07, 0.3, 0.05, 9.81
STEP, PERIOD, NOISE, RESOLUTION = 2.5e-4, 4e-3, 0.005, 1e-4
VISCOUS_TOO = ("CoulombViscousFriction",)
TRIED = ("CoulombFriction", "ViscousFriction", "StribeckFriction", "PreslidingHysteresis")


@pytest.fixture(scope="module")
def scenario(tmp_path_factory: pytest.TempPathFactory) -> Scenario:
    return Scenario(
        duration=16.0,
        robot=pendulum(tmp_path_factory.mktemp("pendulum"), MASS, AWAY, INERTIA),
        sensors=SensorsConfig(encoders=EncoderConfig(resolution=RESOLUTION)),
        recording=RecordingConfig(rows="instantaneous", torque_noise={"all": NOISE}),
    )


def recording(displacement: float) -> Log:
    """A rod that a position loop moves to a place, where it rests, and on to the next.

    Args:
        displacement: over which friction builds up [rad]; 0 for Coulomb's, which holds at rest
            whatever there is up to its size: an impulse that may stop the rod, never turn it back.
    """
    time, random = np.arange(0.0, 16.0, STEP), np.random.default_rng(3)
    places = np.concatenate([[0.0], random.uniform(-1.2, 1.2, 8)])
    number, on = (time // 2.0).astype(int), np.minimum(time % 2.0, 1.0)
    way = places[number + 1] - places[number]
    planned = places[number] + way * 0.5 * (1.0 - np.cos(np.pi * on))
    speed = way * 0.5 * np.pi * np.sin(np.pi * on)
    q, w, z, torque, rows = 0.0, 0.0, 0.0, 0.0, []
    for k in range(len(time)):
        if k % round(1e-3 / STEP) == 0:
            seen = RESOLUTION * np.round(q / RESOLUTION)
            torque = 60.0 * (planned[k] - seen) + 3.0 * (speed[k] - w)
            torque += MASS * GRAVITY * AWAY * np.sin(planned[k])
        rows.append((q, torque))
        pull = torque - MASS * GRAVITY * AWAY * np.sin(q) - VISCOUS * w
        free = w + STEP / INERTIA * pull
        if displacement > 0.0:
            z += STEP * w / displacement * (1.0 - z * np.sign(w))
            w = free - STEP / INERTIA * COULOMB * z
        else:
            w = np.sign(free) * max(0.0, abs(free) - STEP / INERTIA * COULOMB)
        q += STEP * w
    angle, torques = np.array(rows)[:: round(PERIOD / STEP)].T[..., None]
    angle = RESOLUTION * np.round(angle / RESOLUTION)
    channels = {
        "time": time[:: round(PERIOD / STEP)],
        "joint/position": angle,
        "joint/velocity": np.gradient(angle, PERIOD, axis=0),
        "joint/torque_command": torques + NOISE * random.standard_normal(angle.shape),
    }
    return Log(channels, {"joints": ["pivot"], "period": PERIOD, "sides": []})


def found(scenario: Scenario, log: Log) -> Diagnosis:
    return diagnose(Predictor(scenario, log), [library()[name] for name in TRIED])


def test_stiction_is_no_more_than_coulomb_friction(scenario: Scenario) -> None:
    """Hysteresis over less than any gear bends would fit a joint that rests better than friction
    that follows the velocity; what holds it there is that friction all the same."""
    diagnosis = found(scenario, recording(0.0))
    assert {f.effect for f in diagnosis.chosen} == {"CoulombFriction", "ViscousFriction"}
    (coulomb,) = (f for f in diagnosis.chosen if f.effect == "CoulombFriction")
    assert coulomb.parameters["coulomb"].value == pytest.approx(COULOMB, rel=0.05)
    assert "PreslidingHysteresis" not in coulomb.confusable_with


@dataclass(frozen=True)
class Member:
    """What of a candidate is asked."""

    effect: type[JointTorqueEffect]

    @property
    def parameters(self) -> dict[str, Parameter]:
        return dict(self.effect.parameters)


@pytest.mark.parametrize(
    ("effect", "found", "smaller"),
    [
        (PreslidingHysteresis, {"displacement": (1e-4, 5e-5, 1.5e-4)}, ("CoulombFriction",)),
        (PreslidingHysteresis, {"displacement": (2e-3, 1e-9, 5e-3)}, ("CoulombFriction",)),
        (PreslidingHysteresis, {"displacement": (5e-3, 4e-3, 6e-3)}, ()),
        (ThermalDrift, {"warm_up": (1.5, 1e-9, 4.0)}, ("CoulombFriction",)),
        (StribeckFriction, {"gamma1": (2.9, 0.0, 11.0), "gamma4": (1.0, 0.9, 1.1)}, VISCOUS_TOO),
        (StribeckFriction, {"gamma1": (0.5, 0.4, 0.6), "gamma4": (1.0, 0.9, 1.1)}, ()),
        (JointSpring, {"stiffness": (0.5, -1.0, 2.0)}, ("TorqueBias",)),
        (JointSpring, {"stiffness": (-3.0, -4.0, -2.0)}, ()),
    ],
)
def test_values_that_the_log_does_not_exclude(
    effect: type[JointTorqueEffect],
    found: dict[str, tuple[float, float, float]],
    smaller: tuple[str, ...],
) -> None:
    """Value and interval of the parameters that count; the others are far from where it changes."""
    far = {name: Estimate(2.0, (1.9, 2.1), "") for name in effect.parameters}
    told = {name: Estimate(value, (low, high), "") for name, (value, low, high) in found.items()}
    assert smaller_laws(Member(effect), far | told) == smaller  # type: ignore[arg-type]


def test_friction_that_builds_up_is_told_from_it(scenario: Scenario) -> None:
    chosen = {f.effect: f for f in found(scenario, recording(0.02)).chosen}
    finding = chosen[PreslidingHysteresis.__name__]
    assert "CoulombFriction" not in finding.confusable_with
    assert finding.parameters["displacement"].value == pytest.approx(0.02, rel=0.1)
