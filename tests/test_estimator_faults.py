"""Sensors that fail: what is not a number, repeats itself, shows no load, contradicts the others.

Nothing of it may reach the estimates.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from rig import TICK, Replay, Rig, diagram, inputs_of, numbers
from scipy.spatial.transform import Rotation

from fbse_drake import Log, load_scenario
from fbse_drake.effects.friction import CoulombViscousFriction
from fbse_drake.estimation import estimate
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver
from fbse_drake.estimators.estimator import Estimator
from fbse_drake.estimators.fbse import Fbse
from fbse_drake.estimators.fixed_friction import FixedFriction
from fbse_drake.estimators.model_aided import ModelAided
from fbse_drake.estimators.recursive import RecursiveEstimator, Status
from fbse_drake.estimators.sensor_monitor import SensorMonitorConfig
from fbse_drake.report.metrics import friction_error

Run = Callable[..., Log]

ESTIMATORS: dict[str, Estimator] = {
    "best": Fbse(),
    "joint by joint": Fbse(friction=ModelAided()),
    "paper": load_scenario("paper_walk_fbse", "paper_method").estimator,
    "observer": DisturbanceObserver(),
    "fixed": FixedFriction(CoulombViscousFriction(coulomb={"all": 1.0}, viscous={"all": 1.0})),
}
# The fault falls into the first single support, when the left foot carries everything; 0.5 s later
# the estimates are looked at.
START, END, HEALED, LAST = 700, 900, 1400, 1600
# Input port, channels and place in the status of each sensor.
SENSORS = {
    "joints": ("measured_joint_state", slice(0, 24), 0),
    "imu": ("measured_imu", slice(0, 6), 1),
    "left foot": ("measured_pad_force", slice(0, 12), 2),
    "one pad axis": ("measured_pad_force", slice(2, 3), 2),
}
FAULTS = [
    (sensor, kind)
    for sensor in SENSORS
    for kind in ("not finite", "stuck", "lost")
    if kind != "lost" or sensor == "left foot"
]


def spoilt(inputs: dict[str, np.ndarray], sensor: str, kind: str) -> dict[str, np.ndarray]:
    """Inputs with a fault from START to END."""
    port, part, _ = SENSORS[sensor]
    values = inputs[port].copy()
    if kind == "not finite":
        for k, bad in enumerate((np.nan, np.inf, -np.inf)):
            values[START + k : END : 3, part] = bad
    else:
        values[START:END, part] = values[START - 1, part] if kind == "stuck" else 0.0
    return {**inputs, port: values}


def from_start(inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {name: values[START:LAST] for name, values in inputs.items()}


@pytest.fixture(scope="module")
def walk(run: Run) -> Log:
    return run("paper_walk_fbse", "duration=3")


@pytest.fixture(scope="module")
def before(walk: Log) -> Callable[[str], tuple[Replay, dict[str, np.ndarray]]]:
    """An estimator just before the fault, and what it makes of the time after without one."""
    known: dict[str, tuple[Replay, dict[str, np.ndarray]]] = {}

    def until_start(name: str) -> tuple[Replay, dict[str, np.ndarray]]:
        if name not in known:
            inputs = inputs_of(walk)
            replay = Replay(diagram(ESTIMATORS[name], scenario("paper_walk_fbse", "duration=3")))
            replay.run(walk.time[:START], inputs, "friction_estimate")
            known[name] = replay, replay.fork().run(walk.time[START:LAST], from_start(inputs))
        return known[name]

    return until_start


def tilt(result: dict[str, np.ndarray]) -> np.ndarray:
    """The vertical in base axes; yaw, which no sensor restores, is not in it."""
    return (
        Rotation.from_quat(result["estimate/base/orientation"], scalar_first=True)
        .inv()
        .apply([0, 0, 1])
    )


# How many systems they are.
SYSTEMS = {"best": 4, "joint by joint": 6, "paper": 7, "observer": 4, "fixed": 2}
# What the estimates differ by from those without the fault [Nm], [m/s], [rad]: friction just after
# it and when healed, velocity, tilt. Measured with margins of two or more. Filters that nobody
# tells the vertical but gravity need longer to find it again.
TOLERANCE = {
    "best": (6.0, 0.4, 2e-3, 5e-3),
    "joint by joint": (6.0, 0.4, 2e-3, 5e-3),
    "paper": (6.0, 1.0, 0.1, 0.025),
    "observer": (12.0, 0.2, 2e-3, 5e-3),
    "fixed": (1e-12, 1e-12, None, None),
}


@pytest.mark.parametrize(("sensor", "kind"), FAULTS)
@pytest.mark.parametrize("name", ESTIMATORS)
def test_estimator_survives(
    walk: Log, before: Callable[..., tuple], name: str, sensor: str, kind: str
):
    replay, undisturbed = before(name)
    result = replay.fork().run(
        walk.time[START:LAST], from_start(spoilt(inputs_of(walk), sensor, kind))
    )
    for channel, values in result.items():
        assert np.isfinite(values).all(), channel
    # It is noticed in time, and so is its end.
    place, monitor = SENSORS[sensor][2], SensorMonitorConfig()
    expected, delay = {
        "not finite": (Status.NOT_FINITE, 0.0),
        "stuck": (Status.STUCK, monitor.stuck_after),
        "lost": (Status.LOST, monitor.lost_after),
    }[kind]
    status, faulty = result["estimate/sensors/status"], END - START
    noticed = round(delay / TICK) + 1
    assert (status[noticed:faulty, place] == expected).all()
    # What is compared over some time takes as long to agree again.
    over = faulty + (100 if kind == "stuck" else 0)
    assert (status[over:] == 0).all()
    others = [k for k in range(4) if k != place and (kind != "lost" or k == 1)]
    assert (status[:, others] == 0).all()
    # Each stage says so whose inputs are concerned.
    concerned = {"friction": sensor == "joints" if name == "fixed" else True}
    if name != "fixed":
        # By default the base's filter estimates the attitude, too.
        concerned |= {"base_state": True, "attitude": sensor == "imu" or name != "paper"}
    if name in ("best", "joint by joint", "paper"):
        # By default one filter, which hears the feet, does all of it.
        concerned |= {"joint_acceleration": name == "best" or place < 2, "link_torque": True}
    for stage, is_concerned in concerned.items():
        assert (result[f"estimate/{stage}/status"][noticed:faulty] > 0).all() == is_concerned, stage
    # It leaves no trace.
    after, healed, velocity, vertical = TOLERANCE[name]
    difference = np.abs(result["friction_estimate"] - undisturbed["friction_estimate"])
    assert difference[over:].max() < after
    assert difference[HEALED - START :].max() < healed
    if velocity is not None:
        moved = result["estimate/base/velocity"] - undisturbed["estimate/base/velocity"]
        assert np.abs(moved[HEALED - START :]).max() < velocity
        assert np.abs(tilt(result) - tilt(undisturbed))[HEALED - START :].max() < vertical


# What is finite and wrong: port, channels, places in the status that may tell, and what is read.
KNEE = 9
WRONG = {
    "angle jumps": ("measured_joint_state", slice(KNEE, KNEE + 1), 0, lambda x: x + 0.02),
    "angle doubled": ("measured_joint_state", slice(KNEE, KNEE + 1), 0, lambda x: 2 * x),
    "angle spikes": (
        "measured_joint_state",
        slice(KNEE, KNEE + 1),
        0,
        lambda x: x + np.where(np.arange(len(x)) % 50 == 0, 1.5, 0.0)[:, None],
    ),
    "velocity at full scale": (
        "measured_joint_state",
        slice(12 + KNEE, 13 + KNEE),
        0,
        lambda x: np.full_like(x, 20.0),
    ),
    "velocity off": ("measured_joint_state", slice(12 + KNEE, 13 + KNEE), 0, lambda x: x + 0.1),
    "knee dead": ("measured_joint_state", slice(KNEE, 13 + KNEE, 12), 0, lambda x: 0 * x),
    "joints flipped": ("measured_joint_state", slice(0, 24), 0, lambda x: -x),
    "accelerometer off": ("measured_imu", slice(0, 1), 1, lambda x: x + 1.5),
    "gyro off": ("measured_imu", slice(3, 6), 1, lambda x: x + 0.1),
    "IMU at full scale": ("measured_imu", slice(0, 6), 1, lambda x: np.full_like(x, 35.0)),
    "foot doubled": ("measured_pad_force", slice(0, 12), 2, lambda x: 2 * x),
    "pad off": ("measured_pad_force", slice(2, 3), 2, lambda x: x + 150.0),
}


@pytest.mark.parametrize("kind", WRONG)
def test_wrong_reading_is_noticed(walk: Log, before: Callable[..., tuple], kind: str):
    """Within 50 ms, as long as it lasts, and never after; the friction is soon what it was."""
    replay, undisturbed = before("best")
    port, part, place, wrong = WRONG[kind]
    inputs = inputs_of(walk)
    inputs[port] = inputs[port].copy()
    inputs[port][START:END, part] = wrong(inputs[port][START:END, part])
    result = replay.fork().run(walk.time[START:LAST], from_start(inputs))
    for channel, values in result.items():
        assert np.isfinite(values).all(), channel
    status, faulty = result["estimate/sensors/status"], END - START
    assert (status[:50, place] == Status.IMPLAUSIBLE).any()
    assert (status[:faulty, place] == Status.IMPLAUSIBLE).mean() > 0.2
    # Joints of which both readings jumped back are believed last.
    assert (status[faulty + 350 :] == 0).all()
    deviation = undisturbed["estimate/joint/friction_torque_std"]
    moved = np.abs(result["friction_estimate"] - undisturbed["friction_estimate"])
    assert (moved < 3 * deviation)[HEALED - START :].all()


# Wrong pushes, of which no sensor is called wrong, or too late.
MISLEADING = {
    "accelerometer late": ("measured_imu", slice(0, 3), lambda x: np.roll(x, 20, axis=0)),
    "pad at full scale": ("measured_pad_force", slice(0, 3), lambda x: np.full_like(x, 5000.0)),
    "pad spikes": (
        "measured_pad_force",
        slice(0, 3),
        lambda x: x + np.where(np.arange(len(x)) % 50 == 0, 2500.0, 0.0)[:, None],
    ),
}


@pytest.mark.parametrize("kind", MISLEADING)
def test_wrong_pushes_teach_nothing(walk: Log, before: Callable[..., tuple], kind: str):
    """They accelerate the model and not the joints. Soon after them, friction and missing inertia
    are within the deviations that are stated of them from what they are without."""
    replay, undisturbed = before("best")
    port, part, wrong = MISLEADING[kind]
    inputs = inputs_of(walk)
    inputs[port] = inputs[port].copy()
    inputs[port][START:END, part] = wrong(inputs[port][START:END, part])
    result = replay.fork().run(walk.time[START:LAST], from_start(inputs))
    for name in ("missing_inertia", "friction_torque"):
        channel = f"estimate/joint/{name}"
        moved = np.abs(result[channel] - undisturbed[channel])[HEALED - START :]
        assert (moved < 3 * result[f"{channel}_std"][HEALED - START :]).all(), name


def test_unexplained_friction_is_doubted(walk: Log, before: Callable[..., tuple]):
    """A wrong torque command looks like friction; that it moves the estimate is stated."""
    replay, undisturbed = before("best")
    inputs = inputs_of(walk)
    inputs["torque_command"] = inputs["torque_command"].copy()
    inputs["torque_command"][START:END, KNEE] += 10.0
    result = replay.fork().run(walk.time[START:LAST], from_start(inputs))
    moved = np.abs(result["friction_estimate"] - undisturbed["friction_estimate"])[:, KNEE]
    stated = result["estimate/joint/friction_torque_std"][:, KNEE]
    assert moved.max() > 5.0
    assert (moved < 3 * np.maximum(stated, 0.1)).all()
    assert moved[HEALED - START :].max() < 0.3


@pytest.mark.parametrize("name", ["best", "observer"])
def test_torque_command_that_is_no_number(walk: Log, before: Callable[..., tuple], name: str):
    replay, undisturbed = before(name)
    inputs = inputs_of(walk)
    inputs["torque_command"] = inputs["torque_command"].copy()
    inputs["torque_command"][START:END, 3] = np.nan
    result = replay.fork().run(walk.time[START:LAST], from_start(inputs))
    for channel, values in result.items():
        assert np.isfinite(values).all(), channel
    difference = np.abs(result["friction_estimate"] - undisturbed["friction_estimate"])
    assert difference[END - START :].max() < 15.0
    assert difference[HEALED - START :].max() < 0.5


@pytest.mark.parametrize("name", ESTIMATORS)
def test_nothing_to_start_from(walk: Log, name: str):
    """The first readings are no numbers; the estimator starts with the first good ones."""
    config = ESTIMATORS[name]
    inputs = {port: values[:150].copy() for port, values in inputs_of(walk).items()}
    late = Replay(diagram(config, scenario("paper_walk_fbse", "duration=3")))
    for port in ("measured_joint_state", "measured_imu", "measured_pad_force"):
        inputs[port][:20] = np.nan
    result = late.run(walk.time[:150], inputs)
    for channel, values in result.items():
        assert np.isfinite(values).all(), channel
    assert (result["estimate/sensors/status"][:20] == Status.NOT_FINITE).all()
    assert (result["estimate/sensors/status"][20:] == 0).all()
    assert np.abs(result["friction_estimate"]).max() < 10
    if "estimate/base/position" in result:
        # The paper's filter takes longer to settle.
        atol = 0.03 if name == "paper" else 3e-3
        np.testing.assert_allclose(
            result["estimate/base/position"][-1], walk["truth/base/position"][149], atol=atol
        )
        started = {channel: values[20:] for channel, values in result.items()}
        np.testing.assert_allclose(tilt(started)[-1], [0, 0, 1], atol=0.02)


def test_healthy_sensors_are_trusted(run: Run):
    """No false alarm, neither in a walk with noise nor without: a sensor that is exact may rest at
    zero."""
    noisy = run("paper_walk_fbse", "duration=3")
    exact = run("paper_walk", "duration=3", noise=False)
    channel = "estimate/sensors/status"
    assert (noisy[channel] == 0).all()
    for log, config in ((noisy, FixedFriction()), (exact, FixedFriction()), (exact, Fbse())):
        replay = Replay(diagram(config, scenario("paper_walk", "duration=3")))
        assert (replay.run(log.time, inputs_of(log), channel)[channel] == 0).all()


@pytest.mark.parametrize(
    "overrides",
    [
        ("duration=3", "reference.single_support=0.4", "reference.double_support=0.3"),
        ("duration=2", "ground.slope=[0.0, 0.0349]"),
        ("duration=2", "ground.stiffness=1.0e5"),
    ],
    ids=["fast", "slope", "soft"],
)
def test_hard_walks_are_trusted(run: Run, overrides: tuple[str, ...]):
    """No false alarm where feet land hard and roll."""
    assert (run("paper_walk_fbse", *overrides)["estimate/sensors/status"] == 0).all()


def recorded(
    walk: Log, config: Estimator, ticks: int
) -> tuple[Replay, dict[RecursiveEstimator, dict[str, np.ndarray]]]:
    """The diagram's systems, each with samples (ticks, size) of all its input ports. They live as
    long as the diagram."""
    replay = Replay(diagram(config, scenario("paper_walk_fbse", "duration=3")))
    systems = [
        system for system in replay.estimator.GetSystems() if isinstance(system, RecursiveEstimator)
    ]
    samples: dict[RecursiveEstimator, dict[str, list]] = {system: {} for system in systems}
    inputs = inputs_of(walk)
    for k in range(ticks):
        replay.fix({name: values[k] for name, values in inputs.items()}, walk.time[k])
        for system in systems:
            context = system.GetMyContextFromRoot(replay.context)
            for i in range(system.num_input_ports()):
                port = system.get_input_port(i)
                samples[system].setdefault(port.get_name(), []).append(port.Eval(context).copy())
        replay.estimator.ExecuteForcedEvents(replay.context, publish=False)
    return replay, {
        system: {port: np.array(rows) for port, rows in ports.items()}
        for system, ports in samples.items()
    }


# What of a posterior is compared, and how far it may be off [its unit] 35 ticks after the fault.
REMAINS = {
    "friction": 0.3,
    "residual": 1e-4,
    "base_velocity": 3e-3,
    "rotation": 1e-3,
    "joint_acceleration": 0.15,
    "bias": 0.02,
    "support": 0,
    "joint_position": 0,
}


@pytest.mark.parametrize("name", ["best", "paper", "observer", "fixed"])
def test_each_system_alone_survives_what_is_no_number(walk: Log, name: str):
    """On each of its input ports in turn: the posterior stays finite, the status says so, and all
    is forgotten soon.

    A support that is no number counts as none; the paper's attitude does not look at the feet, its
    friction takes the model instead.
    """
    ticks, bad = 90, range(50, 55)
    _, systems = recorded(walk, ESTIMATORS[name], ticks)
    assert len(systems) == SYSTEMS[name]
    for system, inputs in systems.items():
        good = Rig(system)
        for k in range(ticks):
            undisturbed = good.tick(**{port: rows[k] for port, rows in inputs.items()})
        assert undisturbed["status"] == 0
        for bad_port in inputs:
            rig, noticed = Rig(system), []
            where = f"{system.get_name()}.{bad_port}"
            for k in range(ticks):
                values = {port: rows[k] for port, rows in inputs.items()}
                if k in bad:
                    values[bad_port] = np.full_like(values[bad_port], np.nan)
                posterior = rig.tick(**values)
                assert np.isfinite(numbers(posterior)).all(), where
                noticed.append(bool(posterior["status"] > 0))
            unused = bad_port == "planned_support" or (
                name == "paper" and where in ("attitude.model", "friction.link_torque")
            )
            # A command counts in the tick after its own.
            assert noticed[bad.start + (bad_port == "torque_command")] or unused, where
            assert posterior["status"] == 0, where
            for field, tolerance in REMAINS.items():
                if field in posterior.dtype.names:
                    np.testing.assert_allclose(
                        posterior[field],
                        undisturbed[field],
                        atol=tolerance,
                        err_msg=f"{where}: {field}",
                    )


def test_a_law_is_not_believed_at_speeds_that_never_taught_it(walk: Log) -> None:
    """The IMU is gone before the left knee swings for the first time, at six times the speed at
    which its friction was learned. What the law says there is off by more than a Nm; so it says."""
    gone = (walk.time > 1.785) & (walk.time < 2.841)
    stuck = {
        name: np.where(gone[:, None], walk[name][gone][0], walk[name])
        for name in ("imu/linear_acceleration", "imu/angular_velocity")
    }
    log = replace(walk, channels=walk.channels | stuck)
    result = estimate(scenario("paper_walk_fbse", "duration=3"), log).log
    knee = walk.joints.index("left_knee_pitch")
    speed = np.abs(walk["joint/velocity"][:, knee])
    error = np.abs(friction_error(result)[:, knee])
    deviation = result["estimate/joint/friction_torque_std"][:, knee]
    swings = gone & (speed > 2.0 * speed[walk.time < 1.785].max())
    assert swings.sum() > 100
    assert error[swings].max() > 1.0
    assert (error < 1.96 * deviation)[gone].mean() > 0.95
