"""How well joint torque effects are simulated, and what they cost: `python -m benchmarks.effects`
(some minutes).

HRP-2's walk with one more effect in every joint. Its torque loss is compared with its law, at the
velocity that comes out, and its closed loop with that of the walk without it, in short windows in
turn.
"""

import dataclasses

import numpy as np

from benchmarks.closed_loop import closed_loop, in_turn
from fbse_drake import Scenario, load_scenario, simulate
from fbse_drake.effects.actuation import TorqueDelay, TorqueLag
from fbse_drake.effects.counterbalance import Counterbalance
from fbse_drake.effects.effect import Effect
from fbse_drake.effects.friction import (
    CoulombFriction,
    DirectionalFriction,
    DirectionalViscousFriction,
    LoadDependentFriction,
    QuadraticDrag,
    StribeckFriction,
    ThermalDrift,
    ViscousFriction,
)
from fbse_drake.effects.inertia import ReflectedInertia
from fbse_drake.effects.sensor import TransmissionElasticity
from fbse_drake.effects.transmission import (
    Backlash,
    JointSpring,
    PreslidingHysteresis,
    TorqueRipple,
)
from fbse_drake.report.metrics import friction_law_error

_WALK, _DURATION = "hrp2_friction_walk", 3.0
_EFFECTS: tuple[Effect, ...] = (
    ViscousFriction(viscous={"all": 5.0}),
    CoulombFriction(coulomb={"all": 4.0}, transition={"all": 0.005}),
    StribeckFriction(gamma1={"all": 3.0}, gamma4={"all": 3.0}, gamma6={"all": 1.0}),
    LoadDependentFriction(coefficient={"all": 0.1}),
    DirectionalFriction(asymmetry={"all": 2.0}),
    DirectionalViscousFriction(asymmetry={"all": 1.5}),
    QuadraticDrag(drag={"all": 3.0}),
    ThermalDrift(change={"all": 4.0}, warm_up={"all": 5.0}),
    PreslidingHysteresis(coulomb={"all": 4.0}, displacement={"all": 0.002}),
    TorqueRipple(sine={"all": 2.0}, cycles={"all": 50.0}),
    JointSpring(stiffness={"all": 20.0}),
    Counterbalance(cosine={"all": 20.0}),
    TorqueDelay(delay={"all": 1e-3}),
    TorqueLag(time_constant={"all": 1e-3}),
    Backlash(gap={"all": 5e-4}),
    ReflectedInertia(inertia={"all": 0.1}),
    TransmissionElasticity(compliance={"all": 1e-5}, time_constant={"all": 0.01}),
)


def walk(effect: Effect | None, step: float) -> Scenario:
    """The walk with one more effect at a plant step [ms]."""
    scenario = load_scenario(_WALK, overrides=[f"plant.time_step={step}e-3"])
    more = {} if effect is None else {"more": effect}
    robot = dataclasses.replace(scenario.robot, effects=scenario.robot.effects | more)
    return dataclasses.replace(scenario, robot=robot, duration=_DURATION)


def law_error(scenario: Scenario) -> str:
    """Friction law error of the worst joint, for print."""
    log = simulate(scenario, name=_WALK).log
    worst = np.nanmax(list(friction_law_error(log).values()))
    return f"{1e2 * worst:.2f} %" + (" (fell)" if log.meta["outcome"]["fell"] else "")


def main() -> None:
    """Prints a line for each effect."""
    print(f"{_WALK}, {_DURATION:g} s, with one more effect in every joint")
    print(f"{'':28}{'law error, worst joint':^36}{'cost of the loop':>20}")
    print(f"{'':28}{'at 1 ms':>18}{'at 2 ms':>18}{'against none':>20}")
    for effect in (None, *_EFFECTS):
        errors = (law_error(walk(effect, step)) for step in (1.0, 2.0))
        pair = {"none": walk(None, 1.0), "with": walk(effect, 1.0)}
        timers = {name: closed_loop(scenario, recorded=False) for name, scenario in pair.items()}
        times = in_turn(timers, _DURATION)
        cost = np.median(times["with"] / times["none"])
        name = "none" if effect is None else type(effect).__name__
        print(f"{name:28}" + "".join(f"{error:>18}" for error in errors) + f"{cost:>20.2f}")


if __name__ == "__main__":
    main()
