"""The rows of a log pair a held torque with the motion that it belongs to, whatever made the
motion."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.discrepancy.residual.integration import integration_step
from fbse_drake.effects.friction import ViscousFriction
from fbse_drake.log import Log
from fbse_drake.scenario import RecordingConfig, RobotConfig, Scenario, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig

# Of models/pendulum.urdf: inertia about the axis [kg m^2] and mass times g times lever [Nm].
INERTIA, WEIGHT = 0.49 * 0.1**2 + 1.5e-4, 0.49 * 9.81 * 0.1
DAMPING = 0.02
SAMPLES = 1500


@cache
def pendulum(
    period: float,
    steps: int,
    damping: float = DAMPING,
    samples: int = SAMPLES,
    trembling: float = 0.0,
) -> dict[str, np.ndarray]:
    """A damped pendulum under torques that are held over a period.

    Args:
        steps: of semi-implicit Euler in a period, with implicit damping; 0 for the exact motion.
        trembling: standard deviation of the torques' white part [Nm].
    """
    time = np.arange(samples) * period
    torque = 0.35 * np.sin(9 * time) + 0.2 * np.sin(23 * time + 1)
    torque += trembling * np.random.default_rng(1).standard_normal(samples)
    state = np.zeros((samples, 2))

    def exact(_time: float, x: np.ndarray, held: float) -> list[float]:
        return [x[1], (held - WEIGHT * np.sin(x[0]) - damping * x[1]) / INERTIA]

    for k in range(samples - 1):
        if steps == 0:
            solution = solve_ivp(exact, (0, period), state[k], "DOP853", args=(torque[k],))
            state[k + 1] = solution.y[:, -1]
            continue
        (q, v), step = state[k], period / steps
        for _ in range(steps):
            pull = torque[k] - WEIGHT * np.sin(q)
            v = (v + step * pull / INERTIA) / (1 + step * damping / INERTIA)
            q = q + step * v
        state[k + 1] = q, v
    return {
        "time": time,
        "joint/position": state[:, :1],
        "joint/velocity": state[:, 1:],
        "joint/torque_command": torque[:, None],
    }


def scenario(period: float, **encoders: float) -> Scenario:
    """A model that knows all of the pendulum."""
    body = RobotConfig("pendulum", effects={"bearing": ViscousFriction({"servo": DAMPING})})
    return Scenario(
        robot=body,
        model=body,
        sensors=SensorsConfig(encoders=EncoderConfig(period=period, **encoders)),
        recording=RecordingConfig(block=10 * period),
    )


def log_of(channels: dict[str, np.ndarray], period: float) -> Log:
    return Log(channels, {"joints": ["servo"], "sides": [], "period": period})


@pytest.mark.parametrize("period", [1e-3, 5e-3])
@pytest.mark.parametrize("steps", [0, 1, 2, 5])
def test_nothing_is_left_whatever_integrated_the_motion(period: float, steps: int) -> None:
    """Half a step of the posture is a hundred times what is left at 5 ms."""
    channels = pendulum(period, steps)
    predictor = Predictor(scenario(period), log_of(channels, period))
    told = predictor.motion.timing.integration
    assert told == pytest.approx(period / steps if steps else 0.0, abs=0.02 * period)
    left = np.sqrt((predictor.residual.value**2).mean())
    half = 0.5 * period * channels["joint/velocity"] * WEIGHT * np.cos(channels["joint/position"])
    # What is averaged over a step and what is taken in its middle differ in the second order.
    curvature = np.sqrt((channels["joint/torque_command"] ** 2).mean()) * (23 * period) ** 2 / 12
    assert left < 1.5 * curvature + 1e-6
    if period == 5e-3:
        assert left < 0.1 * np.sqrt((half**2).mean())


@pytest.mark.parametrize("steps", [0, 1, 2])
def test_nothing_is_left_of_a_log_that_is_rarer_than_the_control(steps: int) -> None:
    """A command that acts for a fifth of the time between rows is not held for all of it."""
    control, period = 1e-3, 5e-3
    channels = {name: values[::5] for name, values in pendulum(control, steps).items()}

    def left(**said: float) -> float:
        log = log_of(channels, period)
        predictor = Predictor(scenario(period), replace(log, meta=log.meta | said))
        told = predictor.motion.timing.integration
        assert told == pytest.approx(control / steps if steps else 0.0, abs=0.02 * period)
        return float(np.sqrt((predictor.residual.value**2).mean()))

    torque = channels["joint/torque_command"]
    # Between the rows it is taken to change evenly.
    curvature = np.sqrt((torque**2).mean()) * (23 * period) ** 2 / 12
    assert left(command_time=control) < 1.5 * curvature
    held = 0.4 * np.sqrt((np.diff(torque, axis=0) ** 2).mean())
    assert left() == pytest.approx(held, rel=0.1)


def test_what_commands_do_between_rows_is_noise_of_known_size() -> None:
    """A controller that answers the noise of its sensors trembles in every period."""
    control, every, trembling, noise = 1e-3, 4, 0.05, 2e-2
    channels = pendulum(control, 1, damping=0.0, samples=16_000, trembling=trembling)
    rare, period = {name: values[::every] for name, values in channels.items()}, control * every
    velocity = rare["joint/velocity"]
    rare["joint/velocity"] = velocity + noise * np.random.default_rng(2).normal(size=velocity.shape)
    log = log_of(rare, period)
    believed = scenario(period, velocity_noise=noise)
    recording = RecordingConfig(block=2 * period)
    believed = replace(believed, model=RobotConfig("pendulum"), recording=recording)

    def predictor(**said: float) -> Predictor:
        return Predictor(believed, replace(log, meta=log.meta | said))

    told = predictor(command_time=control)
    assert told.noise.white[0] == pytest.approx((1 - 1 / every) * trembling**2, rel=0.15)
    assert told.noise.factor[0] == 1.0
    white = WhitenedResidual(told.residual)
    assert np.sqrt(white.sse / white.count) == pytest.approx(1.0, abs=0.1)
    # What is slow in it would be taken for something that is missing.
    unseen = Predictor(believed, told.log, replace(told.noise, white=np.zeros(1)))
    white = WhitenedResidual(unseen.residual)
    assert np.sqrt(white.sse / white.count) > 10


@pytest.mark.parametrize("steps", [0, 1])
def test_what_is_left_is_the_noise_of_the_sensors(steps: int) -> None:
    period, random = 2e-3, np.random.default_rng(steps)
    believed = replace(
        scenario(period, velocity_noise=1e-3, noise=2e-5), model=RobotConfig("pendulum")
    )
    channels = dict(pendulum(period, steps, damping=0.0))
    for name, noise in (("position", 2e-5), ("velocity", 1e-3)):
        values = channels[f"joint/{name}"]
        channels[f"joint/{name}"] = values + noise * random.standard_normal(values.shape)

    def ratio(log: Log) -> float:
        white = WhitenedResidual(Predictor(believed, log).residual)
        return float(np.sqrt(white.sse.sum() / white.count.sum()))

    assert ratio(log_of(channels, period)) == pytest.approx(1.0, abs=0.2)
    # A row off, it is not.
    later = channels | {"joint/torque_command": np.roll(channels["joint/torque_command"], 1)}
    assert ratio(log_of(later, period)) > 3


def test_step_is_told_beside_gaps_offsets_and_a_sensor_that_fails() -> None:
    period = 2e-3
    q, v = (pendulum(period, 1)[f"joint/{name}"] for name in ("position", "velocity"))
    known = np.ones(SAMPLES, dtype=bool)
    known[400:420] = False
    offset = np.where(known[:, None], v + 0.05, 3.0)
    assert integration_step(q + 0.3, offset, period, known) == pytest.approx(period, rel=0.02)
    # One joint of three has a velocity that comes 10 ms late.
    late = np.concatenate([np.repeat(v[:1], 5, axis=0), v[:-5]])
    three = np.hstack([v, late, v])
    whole = np.ones(SAMPLES, dtype=bool)
    assert integration_step(np.hstack([q, q, q]), three, period, whole) == pytest.approx(
        period, rel=0.02
    )
    # If all do, it is no integration.
    assert integration_step(q, late, period, whole) == 0.0


def test_a_robot_at_rest_tells_no_step() -> None:
    random = np.random.default_rng(3)
    q, v = 1e-5 * random.standard_normal((2, 3000, 2)) + 1e-4 * random.standard_normal((1, 3000, 2))
    assert integration_step(q, v, 1e-3, np.ones(3000, dtype=bool)) == 0.0


def test_friction_is_that_of_the_velocity_where_its_step_ended() -> None:
    period = 5e-3
    for steps, share in ((0, 0.5), (1, 1.0), (5, 0.6)):
        predictor = Predictor(scenario(period), log_of(pendulum(period, steps), period))
        assert predictor.motion.timing.law_share == pytest.approx(share, abs=0.01)
        assert predictor.motion.timing.motion_share == pytest.approx(1 - share, abs=0.01)
        velocity = predictor.motion.signals.joint_velocity
        expected = (1 - share) * velocity[:-1] + share * velocity[1:]
        found = predictor.joint_motion.velocity
        assert np.abs(found - expected)[20:-20].max() < 0.02 * np.abs(velocity).max()
