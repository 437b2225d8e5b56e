"""What one tick of a scenario's estimator costs, against the bare Drake calls it needs:
`python -m benchmarks.estimator_tick [SCENARIO]`.

The scenario is simulated for a few seconds and its estimator runs over the log, as `fbse estimate`
does. A tick is the evaluation of the friction estimate and the update of all states. The bare calls
are those that a model-based estimator cannot do without, in the same postures: mass matrix, bias,
gravity, and Jacobian and bias acceleration of every sole. Both take turns over short stretches of
the log, so that whatever else the computer does slows down both alike.
"""

import dataclasses
import gc
import sys
import time
from collections.abc import Callable

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.tree import JacobianWrtVariable

from fbse_drake import Log, Scenario, load_scenario, simulate
from fbse_drake.estimation import Replay
from fbse_drake.estimators.recursive import RecursiveEstimator
from fbse_drake.robot.plant import make_robot

_DURATION = 8.0
_STRETCH = 1
# Times a sample of the log, in order; returns durations [s].
Timer = Callable[[int], list[float]]


def bare_calls(scenario: Scenario, log: Log) -> Timer:
    """Times the bare Drake calls in a posture of the log; setting the state is not counted."""
    believed = scenario.believed
    robot, _ = make_robot(believed.description, rotor_inertia=believed.rotor_inertia)
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    world, origin, kind = plant.world_frame(), np.zeros(3), JacobianWrtVariable.kV
    soles = [robot.sole(side) for side in robot.description.sides]
    state = np.concatenate(
        [robot.base_pose_positions(RigidTransform()), np.zeros(plant.num_velocities())]
    )
    joints = np.concatenate([robot.position_index, plant.num_positions() + robot.velocity_index])
    motion = np.hstack([log["joint/position"], log["joint/velocity"]])

    def run(sample: int) -> list[float]:
        state[joints] = motion[sample]
        plant.SetPositionsAndVelocities(context, state)
        start = time.perf_counter()
        plant.CalcMassMatrix(context)
        plant.CalcBiasTerm(context)
        plant.CalcGravityGeneralizedForces(context)
        for sole in soles:
            plant.CalcJacobianSpatialVelocity(context, kind, sole, origin, world, sole)
            plant.CalcBiasSpatialAcceleration(context, kind, sole, origin, world, sole)
        return [time.perf_counter() - start]

    return run


def whole_tick(scenario: Scenario, log: Log) -> Timer:
    """Times a tick of the estimator."""
    replay = Replay(scenario, log)
    friction = replay.estimator.GetOutputPort("friction_estimate")

    def run(sample: int) -> list[float]:
        replay.feed(sample)
        start = time.perf_counter()
        friction.Eval(replay.context)
        replay.update()
        return [time.perf_counter() - start]

    return run


def single_systems(scenario: Scenario, log: Log) -> tuple[list[str], Timer]:
    """Names of the estimator's LeafSystems; times the output of each, its inputs known, and then
    the update of each."""
    replay = Replay(scenario, log)
    systems = [
        system for system in replay.estimator.GetSystems() if isinstance(system, RecursiveEstimator)
    ]
    outputs = [
        (system.GetOutputPort("posterior"), system.GetMyContextFromRoot(replay.context))
        for system in systems
    ]
    other = replay.estimator.CreateDefaultContext()
    updates = [
        (system, context, system.GetMyMutableContextFromRoot(other).get_mutable_state())
        for system, (_, context) in zip(systems, outputs, strict=True)
    ]

    def run(sample: int) -> list[float]:
        replay.feed(sample)
        times = [time.perf_counter()]
        for port, context in outputs:
            port.Eval(context)
            times.append(time.perf_counter())
        for system, context, state in updates:
            system.CalcForcedUnrestrictedUpdate(context, state)
            times.append(time.perf_counter())
        replay.update()
        return np.diff(times).tolist()

    return [system.get_name() for system in systems], run


def main() -> None:
    """Prints the cost of the bare calls, of the whole tick, and of each system."""
    name = sys.argv[1] if len(sys.argv) > 1 else "paper_walk_fbse"
    scenario = load_scenario(name)
    scenario = dataclasses.replace(scenario, duration=min(_DURATION, scenario.duration))
    log = simulate(scenario, name=name).log
    systems, time_systems = single_systems(scenario, log)
    timers = [bare_calls(scenario, log), whole_tick(scenario, log), time_systems]
    durations: list[list[list[float]]] = [[], [], []]
    gc.disable()
    for start in range(0, len(log.time), _STRETCH):
        for timer, values in zip(timers, durations, strict=True):
            values.extend(
                timer(sample) for sample in range(start, min(start + _STRETCH, len(log.time)))
            )
    # The first stretch compiles and warms up.
    bare, tick, shares = (1e6 * np.array(values[100:]) for values in durations)
    print(f"{name}, {len(tick)} ticks [us]")
    print(f"bare Drake calls   median {np.median(bare):6.1f}")
    p99, ratio = np.percentile(tick, 99), np.median(tick) / np.median(bare)
    print(f"estimator tick     median {np.median(tick):6.1f}   p99 {p99:6.1f}   {ratio:.2f} x bare")
    print("each system by itself, median       output  update")
    for system, output, update in zip(
        systems, *np.median(shares, axis=0).reshape(2, -1), strict=True
    ):
        print(f"  {system:32} {output:7.1f} {update:7.1f}")


if __name__ == "__main__":
    main()
