"""What the closed loop of a scenario costs, against its bare plant and at other plant steps:
`python -m benchmarks.closed_loop [SCENARIO]`.

The bare plant goes through the same motion, with contact and with the recorded torques (command
minus friction) from a C++ source, in windows that each start from the recorded state; nothing is
measured, controlled or recorded. The closed loop is run in two ways: by itself (robot, friction,
encoders, controller, reference; Drake evaluates only what is read, so the IMU and the foot sensors
rest), and as `fbse simulate` does it, with every sensor read and recorded at every tick. Each takes
turns with the bare plant over short windows of the motion, so that whatever else the computer does
slows down both alike, and the medians over the windows are printed: of times, and of ratios within
a window.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Mapping

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from fbse_drake import Log, Scenario, build_station, load_scenario, simulate
from fbse_drake.robot.plant import make_robot
from fbse_drake.sampling import state_views
from fbse_drake.sensors.errors import held_signal
from fbse_drake.simulation import add_record, recorded_ports

# Of the motion, as much as this [s].
_DURATION = 6.0
# Without control a walking robot leaves its path slowly at first; a window is short enough not to
# notice. A whole number of steps [s].
_WINDOW = 0.04
# The plant's [ms]; all is compared with the middle one.
_STEPS = (0.5, 1.0, 2.0)
_BASE = 1.0
# Goes through the window that begins at this time [s]; returns how long that took [s].
Timer = Callable[[float], float]


def bare_plant(scenario: Scenario, log: Log) -> Timer:
    """Times the scenario's plant in a logged motion; setting the state is not counted."""
    builder = DiagramBuilder()
    config = scenario.robot
    robot, _ = make_robot(
        config.description,
        rotor_inertia=config.rotor_inertia,
        builder=builder,
        config=scenario.plant,
        ground=scenario.ground,
    )
    torque = log["joint/torque_command"] - log["truth/joint/friction_torque"]
    source = builder.AddSystem(held_signal(torque, scenario.log.period))
    gain = builder.AddSystem(MatrixGain(robot.actuation_selector))
    builder.Connect(source.get_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), robot.plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant_context = robot.plant.GetMyMutableContextFromRoot(context)

    def run(begin: float) -> float:
        row = round(begin / scenario.log.period)
        now = {name: values[row] for name, values in log.channels.items()}
        orientation = Quaternion(now["truth/base/orientation"])
        X_WB = RigidTransform(orientation, now["truth/base/position"])
        V_WB = [now["truth/base/angular_velocity"], now["truth/base/velocity"]]
        joints = (now["truth/joint/position"], now["truth/joint/velocity"])
        context.SetTime(begin)
        robot.set_state(plant_context, *joints, X_WB, np.concatenate(V_WB))
        simulator.Initialize()
        return advance(simulator, begin)

    return run


def closed_loop(scenario: Scenario, *, recorded: bool) -> Timer:
    """Times the closed loop, by itself or with all that a log has."""
    builder = DiagramBuilder()
    station = builder.AddSystem(build_station(scenario))
    if recorded:
        add_record(builder, station, recorded_ports(station), scenario.plant.time_step)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.Initialize()
    # The views are kept as long as the timer, as `simulate` keeps them.
    views = state_views(diagram, simulator.get_context())
    return lambda begin, _views=views: advance(simulator, begin)


def advance(simulator: Simulator, begin: float) -> float:
    """Simulates a window; returns how long that took [s]."""
    start = time.perf_counter()
    simulator.AdvanceTo(begin + _WINDOW)
    return time.perf_counter() - start


def in_turn(timers: Mapping[str, Timer], duration: float) -> dict[str, np.ndarray]:
    """Times of all timers over the same windows, (windows,) each, per simulated second [1]."""
    times: dict[str, list[float]] = {what: [] for what in timers}
    for window in range(int(duration / _WINDOW)):
        for what, timer in timers.items():
            times[what].append(timer(window * _WINDOW) / _WINDOW)
    return {what: np.array(values) for what, values in times.items()}


def at_step(name: str, step: float) -> Scenario:
    """The scenario at a plant step [ms], not longer than is timed."""
    scenario = load_scenario(name, overrides=[f"plant.time_step={step}e-3"])
    return dataclasses.replace(scenario, duration=min(scenario.duration, _DURATION))


def main() -> None:
    """Prints real time factors and ratios of costs."""
    name = sys.argv[1] if len(sys.argv) > 1 else "paper_walk"
    base = at_step(name, _BASE)
    bare = bare_plant(base, simulate(base, name=name).log)
    print(f"{name}, plant step {_BASE:g} ms unless said, medians of windows in turn")
    loops = {"closed loop": (base, False)}
    loops |= {f"closed loop, recorded, at {h:g} ms": (at_step(name, h), True) for h in _STEPS}
    twice = {h: dataclasses.replace(at_step(name, h), solve_twice=True) for h in _STEPS[1:]}
    loops |= {f"the same, solved twice, at {h:g} ms": (loop, True) for h, loop in twice.items()}
    ratios: dict[str, float] = {}
    for what, (scenario, recorded) in loops.items():
        timers = {"bare plant": bare, what: closed_loop(scenario, recorded=recorded)}
        times = in_turn(timers, base.duration)
        ratios[what] = float(np.median(times[what] / times["bare plant"]))
        print(
            f"{what:34} {1 / np.median(times[what]):5.2f} x real time, the bare plant "
            f"{1 / np.median(times['bare plant']):5.2f} x   {ratios[what]:5.2f} x its cost"
        )
    base_ratio = ratios[f"closed loop, recorded, at {_BASE:g} ms"]
    for what, (_, recorded) in loops.items():
        if recorded:
            print(f"{what}: {base_ratio / ratios[what]:.2f} x the speed of {_BASE:g} ms")


if __name__ == "__main__":
    main()
