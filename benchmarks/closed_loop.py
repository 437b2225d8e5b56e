"""What the closed loop of a scenario costs, against its bare plant: `python -m benchmarks.closed_loop [SCENARIO]`.

The bare plant goes through the same motion, with contact and with the recorded torques (command minus friction) from a C++ source, in
windows that each start from the recorded state; nothing is measured, controlled or recorded. The closed loop is run in two ways: by
itself (robot, friction, encoders, controller, reference; Drake evaluates only what is read, so the IMU and the foot sensors rest), and
as `fbse simulate` does it, with every sensor read and recorded at every tick. All are run in turn several times and the fastest counts.
"""

import sys
import time
from collections.abc import Callable

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import MatrixGain

from fbse_drake import Log, Scenario, build_station, load_scenario, simulate
from fbse_drake.robot.plant import make_robot
from fbse_drake.sensors.errors import held_signal

_REPETITIONS = 4
# Without control a walking robot leaves its path slowly at first; a window is short enough not to notice.
_WINDOW = 100


def bare_plant(scenario: Scenario, log: Log) -> Callable[[], float]:
    """A function that steps the scenario's plant through a logged motion and returns the time per step [s]."""
    builder = DiagramBuilder()
    config = scenario.robot
    robot, _ = make_robot(
        config.description, rotor_inertia=config.rotor_inertia, builder=builder, config=scenario.plant, ground=scenario.ground
    )
    torque = log["joint/torque_command"] - log["truth/joint/friction_torque"]
    source = builder.AddSystem(held_signal(torque, scenario.log.period))
    gain = builder.AddSystem(MatrixGain(robot.actuation_selector))
    builder.Connect(source.get_output_port(), gain.get_input_port())
    builder.Connect(gain.get_output_port(), robot.plant.get_actuation_input_port())
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    plant_context = robot.plant.GetMyMutableContextFromRoot(context)

    def run() -> float:
        elapsed, steps = 0.0, 0
        for row in range(0, len(log.time) - _WINDOW, _WINDOW):
            X_WB = RigidTransform(Quaternion(log["truth/base/orientation"][row]), log["truth/base/position"][row])
            V_WB = np.concatenate([log["truth/base/angular_velocity"][row], log["truth/base/velocity"][row]])
            context.SetTime(log.time[row])
            robot.set_state(plant_context, log["truth/joint/position"][row], log["truth/joint/velocity"][row], X_WB, V_WB)
            simulator.Initialize()
            start = time.perf_counter()
            simulator.AdvanceTo(log.time[row + _WINDOW])
            elapsed += time.perf_counter() - start
            steps += round((log.time[row + _WINDOW] - log.time[row]) / scenario.plant.time_step)
        return elapsed / steps

    return run


def closed_loop(scenario: Scenario) -> float:
    """Time per plant step of the closed loop by itself [s]."""
    simulator = Simulator(build_station(scenario))
    simulator.Initialize()
    start = time.perf_counter()
    simulator.AdvanceTo(scenario.duration)
    return (time.perf_counter() - start) * scenario.plant.time_step / scenario.duration


def main() -> None:
    """Prints the cost per plant step of each, as a multiple of the bare plant's and as a real time factor."""
    name = sys.argv[1] if len(sys.argv) > 1 else "paper_walk"
    scenario = load_scenario(name)
    step = scenario.plant.time_step
    first = simulate(scenario, name=name)
    bare = bare_plant(scenario, first.log)
    costs: dict[str, list[float]] = {"bare plant": [], "closed loop": [], "closed loop, recorded": []}
    for _ in range(_REPETITIONS):
        costs["bare plant"].append(bare())
        costs["closed loop"].append(closed_loop(scenario))
        costs["closed loop, recorded"].append(simulate(scenario, name=name).wall_time * step / scenario.duration)
    alone = min(costs["bare plant"])
    print(f"{name}, plant step {1e3 * step:g} ms, fastest of {_REPETITIONS} runs of each")
    for what, values in costs.items():
        cost = min(values)
        print(f"{what:22} {1e6 * cost:5.0f} us per step   {cost / alone:5.2f} x bare plant   {step / cost:5.2f} x real time")


if __name__ == "__main__":
    main()
