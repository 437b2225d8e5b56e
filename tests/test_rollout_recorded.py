"""A model simulated against a recording, with the recording's own reference: exact for the true
model, closed forms for others."""

import dataclasses
import multiprocessing
import os
import signal
from pathlib import Path

import numpy as np
import pytest
import yaml

from fbse_drake import InputError, Log, Scenario, load_scenario, simulate
from fbse_drake.control.compensation import FeedforwardCompensation, NoCompensation
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.residual.rollout import RolloutError, rollout
from fbse_drake.effects.actuation import DcMotor
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import CoulombFriction, CoulombViscousFriction
from fbse_drake.effects.sensor import EncoderOffset
from fbse_drake.estimators.fixed_friction import FixedFriction
from fbse_drake.progress import Interrupted, ProgressLines
from fbse_drake.scenario import RobotConfig
from fbse_drake.walking.reference import JointSines, Recorded

# Of models/pendulum.urdf.
MASS, LENGTH, INERTIA, G = 0.49, 0.1, 1.5e-4, 9.81
KP, KD = 8.0, 0.1


def pendulum(
    model: dict[str, Effect], robot: dict[str, Effect] | None = None, kp: float = KP, gain: str = ""
) -> Scenario:
    """A pendulum with a position loop and a recorded reference, or (with effects of a robot) one
    that swings slowly."""
    return Scenario(
        duration=4.0,
        robot=RobotConfig("pendulum", effects=robot or {}),
        model=RobotConfig("pendulum", effects=model),
        control=PositionLoopConfig(kp={"servo": kp}, kd={"servo": kp / KP * KD}, feedforward=False),
        reference=Recorded(gain)
        if robot is None
        else JointSines(amplitude={"servo": 0.5}, frequency={"servo": 0.5}, ramp=0.5),
    )


def recording(robot: dict[str, Effect], kp: float = KP) -> Log:
    return simulate(pendulum({}, robot, kp)).log


def by_hand(time: np.ndarray, position: np.ndarray, reference: float, **more: np.ndarray) -> Log:
    """A recording of one joint that was made up: (N,) each."""
    channels = {
        "joint/position": position,
        "reference/joint/position": np.full(len(time), reference),
        **more,
    }
    return Log(
        {"time": time} | {name: values[:, None] for name, values in channels.items()},
        {"joints": ["servo"], "period": 0.01},
    )


def worst(error: RolloutError | None) -> float:
    assert error is not None
    assert error.failure is None
    return float(np.abs(error.position_error).max())


TRUE = {
    "friction": CoulombFriction(coulomb={"servo": 0.08}),
    "motor": DcMotor(kt={"servo": 0.35}, resistance={"servo": 3.4}),
}


@pytest.fixture(scope="module")
def log() -> Log:
    return recording(TRUE)


def test_the_true_model_does_what_the_robot_did(log: Log):
    error = rollout(pendulum(TRUE), log)
    assert worst(error) < 1e-9
    assert error.torque_command["servo"] < 1e-8
    assert error.velocity["servo"] < 1e-7
    assert error.sample_time[-1] == log.time[-1]


def test_a_missing_friction_costs_its_torque_over_the_stiffness(log: Log):
    """Slow motion: kp (reference - q) = m g l sin q + friction, so that friction is worth
    friction / (kp + m g l cos q) of position."""
    error = rollout(pendulum({"motor": TRUE["motor"]}), log)
    moving = np.abs(log["joint/velocity"][:, 0]) > 0.2
    late = np.abs(error.position_error[moving, 0])
    q = log["joint/position"][moving, 0]
    np.testing.assert_allclose(
        np.median(late), np.median(0.08 / (KP + MASS * G * LENGTH * np.cos(q))), rtol=0.05
    )
    # In the direction of the motion: the model goes ahead.
    assert np.all(
        np.sign(error.position_error[moving, 0]) == np.sign(log["joint/velocity"][moving, 0])
    )


def test_summaries_are_of_the_error_over_time(log: Log):
    error = rollout(pendulum({}), log)
    e = error.position_error[:, 0]
    assert error.position["servo"] == pytest.approx(np.sqrt(np.mean(e**2)))
    assert error.mean_absolute_position["servo"] == pytest.approx(np.abs(e).mean())
    assert error.relative_position["servo"] == pytest.approx(
        np.linalg.norm(e) / np.linalg.norm(log["joint/position"])
    )


def test_every_stretch_has_its_own_gain_and_starts_where_it_started():
    """Two records in one log, of a servo that was twice as stiff in the second."""
    parts = [recording(TRUE, factor * KP) for factor in (1.0, 2.0)]
    second = dataclasses.replace(
        parts[1], channels={**parts[1].channels, "time": parts[1].time + 5.0}
    )
    # The second one begins in the middle of the motion.
    second = second.part(slice(700, None))
    segments = [
        {"start": float(part.time[0]), "end": float(part.time[-1]), "source": "a", "kp": kp}
        for part, kp in ((parts[0], 1.0), (second, 2.0))
    ]
    both = Log(
        {name: np.concatenate([parts[0][name], second[name]]) for name in second},
        {**second.meta, "segments": segments},
    )
    assert worst(rollout(pendulum(TRUE, gain="kp"), both)) < 1e-3
    assert worst(rollout(pendulum(TRUE), both)) > 0.01
    with pytest.raises(
        InputError, match=r"gain stiffness: expected a number .* \(there are: start, end, kp\)"
    ):
        rollout(pendulum(TRUE, gain="stiffness"), both)


def test_a_drive_that_is_switched_off_lets_the_pendulum_swing():
    time = np.arange(0, 2.0, 0.01)
    frequency = np.sqrt(MASS * G * LENGTH / (MASS * LENGTH**2 + INERTIA))
    swing = 0.02 * np.cos(frequency * time)
    off = by_hand(time, swing, 0.02, **{"joint/enabled": np.zeros(len(time))})
    motor = {"motor": TRUE["motor"]}
    # The step of 1 ms costs a little in phase.
    assert worst(rollout(pendulum(motor), off)) < 0.02 * 0.03
    on = by_hand(time, swing, 0.02, **{"joint/enabled": np.ones(len(time))})
    assert worst(rollout(pendulum(motor), on)) > 0.01


def test_the_model_reads_its_angle_as_the_robot_does(log: Log):
    """An encoder whose zero is off: the loop acts on what is read, and so is compared."""
    shifted = TRUE | {"zero": EncoderOffset(offset={"servo": 0.03})}
    # Then it is asked for an angle that is as much off.
    log = Log(
        {name: values + 0.03 * name.endswith("joint/position") for name, values in log.items()},
        log.meta,
    )
    assert worst(rollout(pendulum(shifted), log)) < 1e-9
    assert worst(rollout(pendulum(TRUE), log)) > 5e-4


def test_nobody_knows_what_was_asked_for():
    log = by_hand(np.arange(0, 1.0, 0.01), np.zeros(100), 0.0)
    unknown = Log(
        {name: values for name, values in log.items() if not name.startswith("reference")}, log.meta
    )
    assert rollout(pendulum({}), unknown) is None
    with pytest.raises(InputError, match="a recorded motion is not simulated without its log"):
        simulate(pendulum({}))


def test_a_dc_motor_spins_up_to_its_no_load_speed(tmp_path: Path):
    """A flywheel at full voltage: w = V / kt (1 - exp(-t / tau)) with tau = J R / kt^2, from the
    stall torque kt V / R on."""
    kt, resistance, voltage, inertia = 0.35, 3.4, 7.4, 0.02
    (tmp_path / "wheel.urdf").write_text(f"""
<robot name="wheel">
  <link name="stand"/>
  <link name="disc"><inertial><mass value="1"/>
    <inertia ixx="1" iyy="1" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="servo" type="revolute">
    <parent link="stand"/><child link="disc"/><axis xyz="0 0 1"/>
    <limit lower="-1e6" upper="1e6" effort="1" velocity="1e3"/>
  </joint>
</robot>
""")
    (tmp_path / "wheel.yaml").write_text(
        yaml.safe_dump(
            {"urdf": "wheel.urdf", "base": "stand", "fixed_base": True, "joints": ["servo"]}
        )
    )
    stall, no_load, tau = kt * voltage / resistance, voltage / kt, inertia * resistance / kt**2
    time = np.arange(0, 5 * tau, 0.01)
    angle = no_load * (time - tau * (1 - np.exp(-time / tau)))
    effects = {"motor": DcMotor(kt={"servo": kt}, resistance={"servo": resistance})}
    scenario = Scenario(
        model=RobotConfig(str(tmp_path / "wheel.yaml"), effects=effects),
        robot=RobotConfig(str(tmp_path / "wheel.yaml")),
        control=PositionLoopConfig(
            kp={"servo": 1e6}, kd={"servo": 0.0}, torque_limit={"servo": stall}
        ),
        reference=Recorded(),
    )
    log = by_hand(
        time,
        angle,
        1e6,
        **{
            "joint/velocity": no_load * (1 - np.exp(-time / tau)),
            "joint/torque_command": np.full(len(time), stall),
        },
    )
    error = rollout(scenario, log)
    assert worst(error) < 2e-3 * angle[-1]
    assert error.velocity["servo"] < 2e-3 * no_load
    assert error.torque_command["servo"] < 1e-12


def test_what_compensates_friction_moves_the_model_too():
    """The robot's friction was fed forward: the true model does the same, one that is not
    compensated does not."""
    law = CoulombViscousFriction(
        coulomb={"all": 0.08}, viscous={"all": 0.0}, transition={"all": 0.02}
    )
    friction = {"friction": law}
    compensated = dataclasses.replace(
        pendulum({}, friction),
        estimator=FixedFriction(law),
        compensation=FeedforwardCompensation(cutoff=50.0),
    )
    log = simulate(compensated).log
    model = dataclasses.replace(
        compensated, model=RobotConfig("pendulum", effects=friction), reference=Recorded()
    )
    assert worst(rollout(model, log)) < 1e-9
    only_watched = dataclasses.replace(model, compensation=NoCompensation())
    assert worst(rollout(only_watched, log)) > 1e-3


def test_an_estimate_that_is_only_watched_is_left_out_of_a_rollout(
    log: Log, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("fbse_drake.estimators.estimator.EstimatorDiagram", None)
    watched = dataclasses.replace(
        pendulum(TRUE), estimator=FixedFriction(CoulombViscousFriction(transition={"all": 0.02}))
    )
    assert worst(rollout(watched, log)) < 1e-9


def test_a_walk_is_simulated_with_its_estimator_and_compensation():
    """The estimator of a rollout believes what it believed when the log was made: frictionless
    joints."""
    walk = load_scenario("hrp2_walk_fbse", overrides=("duration=0.3",))
    log = simulate(walk).log
    model = dataclasses.replace(walk, model=walk.robot)
    error = rollout(model, log, planned_with=walk.believed)
    uncompensated = dataclasses.replace(model, compensation=NoCompensation())
    other = rollout(uncompensated, log, planned_with=walk.believed)
    assert error.failure is None
    assert error.time == pytest.approx(0.3)
    assert error.mean_torque_command < 0.5 * other.mean_torque_command
    assert error.mean_position < other.mean_position


def test_simulations_side_by_side_say_what_they_say_one_after_another():
    squat = load_scenario("squat", overrides=("duration=0.1",))
    log = simulate(squat).log
    side_by_side, one_by_one = rollout(squat, log, jobs=3), rollout(squat, log)
    assert side_by_side.position == one_by_one.position
    assert side_by_side.torque_command == one_by_one.torque_command


def test_simulations_side_by_side_end_with_the_work():
    """And leave no process behind."""
    squat = load_scenario("squat", overrides=("duration=0.1",))
    log = simulate(squat).log

    work = ProgressLines(str)
    work.stop("enough")
    with pytest.raises(Interrupted, match="enough"):
        rollout(squat, log, progress=work, jobs=2)
    for process in multiprocessing.active_children():
        process.join(10.0)
    assert not multiprocessing.active_children()


def test_a_simulation_that_is_stopped_at_the_keyboard_has_no_error():
    """What was simulated until then would be taken for all of it."""
    squat = load_scenario("squat", overrides=("duration=0.1",))
    log = simulate(squat).log

    def stop(text: str, share: float = 0.0) -> None:  # noqa: ARG001
        os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(Interrupted):
        rollout(squat, log, progress=stop)
