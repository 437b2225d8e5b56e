"""The effects of the library: their laws against closed forms, and the simulated torque against the
law over the recorded motion."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from conftest import scenario
from pydrake.multibody.tree import MultibodyForces
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from fbse_drake import InputError, Log, Scenario, load_scenario, simulate
from fbse_drake.effects.actuation import (
    TorqueBias,
    TorqueDelay,
    TorqueGain,
    TorqueLag,
    TorqueReadingLag,
    TorqueSaturation,
)
from fbse_drake.effects.counterbalance import Counterbalance
from fbse_drake.effects.effect import Effect, in_library, library
from fbse_drake.effects.friction import (
    CoulombFriction,
    CoulombViscousFriction,
    DirectionalFriction,
    DirectionalViscousFriction,
    LoadDependentFriction,
    QuadraticDrag,
    ThermalDrift,
    ViscousFriction,
)
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, basis_over_time
from fbse_drake.effects.transmission import (
    Backlash,
    JointSpring,
    PreslidingHysteresis,
    TorqueRipple,
)
from fbse_drake.robot.description import load_description
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import RobotConfig, dump_scenario

NAMES, _ = load_description("biped")
JOINT_EFFECTS = [effect for effect in library().values() if issubclass(effect, JointTorqueEffect)]
H = 1e-3


def recorded(samples: int = 300, joints: int = 2) -> JointMotion:
    """A made-up motion: fast and slow, to and fro, under a command that changes sign."""
    generator = np.random.default_rng(3)
    time = np.arange(samples)[:, None] * H
    rate, phase = (
        generator.uniform(10, 40, size=(2, joints)),
        generator.uniform(0, 6, size=(2, joints)),
    )
    velocity = 0.3 * np.sin(rate[0] * time + phase[0])
    position = 0.1 + np.cumsum(velocity, axis=0) * H
    command = 20.0 * np.sin(rate[1] * time + phase[1]) + generator.normal(size=(samples, joints))
    return JointMotion(velocity, position, command, time + 2.0, H, load=0.8 * command)


def law(effect: JointTorqueEffect, motion: JointMotion) -> np.ndarray:
    """Torque loss of an effect of which all joints have the same values, (N, n)."""
    whole, n = effect.resolve(NAMES), motion.velocity.shape[1]
    return np.einsum(
        "pn,pNn->Nn",
        whole.linear[:, :n],
        basis_over_time(type(effect), motion, whole.nonlinear[:, :n]),
    )


M = recorded()
SIGN = np.tanh(M.velocity / 0.02)
TRANSITION = {"all": 0.02}


@pytest.mark.parametrize(
    ("effect", "torque"),
    [
        (CoulombFriction(coulomb={"all": 3.0}, transition=TRANSITION), 3.0 * SIGN),
        (ViscousFriction(viscous={"all": 2.0}), 2.0 * M.velocity),
        (
            CoulombViscousFriction({"all": 3.0}, {"all": 2.0}, TRANSITION),
            3.0 * SIGN + 2.0 * M.velocity,
        ),
        (DirectionalFriction(asymmetry={"all": -1.5}, transition=TRANSITION), -1.5 * SIGN**2),
        (DirectionalViscousFriction(asymmetry={"all": -0.7}), -0.7 * np.abs(M.velocity)),
        (
            LoadDependentFriction(coefficient={"all": 0.1}, transition=TRANSITION),
            0.1 * np.abs(M.load) * SIGN,
        ),
        (QuadraticDrag(drag={"all": 4.0}), 4.0 * M.velocity**2 * np.sign(M.velocity)),
        (
            ThermalDrift({"all": -2.0}, {"all": 30.0}, TRANSITION),
            -2.0 * (1 - np.exp(-M.time / 30.0)) * SIGN,
        ),
        (
            TorqueRipple({"all": 1.0}, {"all": -0.5}, {"all": 80.0}),
            np.sin(80 * M.position) - 0.5 * np.cos(80 * M.position),
        ),
        (Counterbalance({"all": 3.0}, {"all": 4.0}), 5.0 * np.cos(M.position - np.arctan2(4, 3))),
        (JointSpring(stiffness={"all": 50.0}, preload={"all": -3.0}), 50.0 * M.position - 3.0),
        (TorqueGain(shortfall={"all": 0.1}), 0.1 * M.command),
        (TorqueBias(bias={"all": -2.0}), -2.0 + 0 * M.command),
        (
            TorqueSaturation(limit={"all": 12.0}),
            np.where(np.abs(M.command) > 12, M.command - 12 * np.sign(M.command), 0.0),
        ),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Effect) else "",
)
def test_law_is_the_closed_form(effect: JointTorqueEffect, torque: np.ndarray):
    np.testing.assert_allclose(law(effect, M), torque, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("steps", [0, 1, 7, 7.25, 29.5])
def test_delay_shifts_the_command(steps: float):
    whole, share = int(steps), steps - int(steps)
    before = np.concatenate([np.repeat(M.command[:1], 31, axis=0), M.command])
    late = (1 - share) * before[31 - whole :][:300] + share * before[30 - whole :][:300]
    np.testing.assert_allclose(
        law(TorqueDelay(delay={"all": steps * H}), M), M.command - late, atol=1e-9
    )


@pytest.mark.parametrize(
    ("effect", "sets"),
    [
        (TorqueDelay, [[[0.0, 2e-3], [7.3e-3, 2.9e-2]]]),
        (
            Backlash,
            [
                [[1e-3, 2e-3], [0.0, 2e-2]],
                [[0.1, 0.3], [0.02, 1.0]],
                [[0.0, 4e-3], [1e-3, 1e-2]],
            ],
        ),
    ],
)
def test_memory_at_once_is_that_of_the_steps(
    monkeypatch: pytest.MonkeyPatch, effect: type[JointTorqueEffect], sets: list
):
    at_once = basis_over_time(effect, M, np.array(sets))
    monkeypatch.setattr(effect, "memory_over_time", JointTorqueEffect.memory_over_time)
    np.testing.assert_array_equal(at_once, basis_over_time(effect, M, np.array(sets)))


@pytest.mark.parametrize("time_constant", [2e-4, 5e-3, 5e-2])
def test_lag_is_a_low_pass(time_constant: float):
    """Over each step the mean of the exact solution, which scipy's filter gives at the steps'
    ends."""
    keep = np.exp(-H / time_constant)
    ends = lfilter([1 - keep], [1, -keep], M.command - M.command[0], axis=0) + M.command[0]
    starts = np.concatenate([M.command[:1], ends[:-1]])
    # The integral of y' = (command - y) / T over the step.
    mean = M.command - time_constant * (ends - starts) / H
    np.testing.assert_allclose(
        law(TorqueLag(time_constant={"all": time_constant}), M),
        M.command - mean,
        rtol=1e-9,
        atol=1e-12,
    )


def test_a_reading_that_lags_is_a_low_pass_of_what_is_given():
    """The command is what is read: what the joint gets, low-passed in steps, is the command."""
    time_constant = 5e-3
    given = M.command - law(TorqueReadingLag(time_constant={"all": time_constant}), M)
    kept = time_constant / (time_constant + H)
    start = kept * M.command[0]
    read, _ = lfilter([1 - kept], [1, -kept], given, axis=0, zi=start[None])
    np.testing.assert_allclose(read, M.command, rtol=1e-9, atol=1e-9)


def test_bristles_bend_like_a_spring_and_slip_like_coulomb_friction():
    effect = PreslidingHysteresis(coulomb={"all": 3.0}, displacement={"all": 1e-3})
    creep = JointMotion(np.full((10, 1), 1e-3), time_step=H)
    np.testing.assert_allclose(
        np.diff(law(effect, creep), axis=0) / (1e-3 * H), 3.0 / 1e-3, rtol=0.02
    )
    slip = JointMotion(np.full((100, 1), -0.1), time_step=H)
    angle = 0.1 * H * np.arange(1, 101)[:, None]
    np.testing.assert_allclose(law(effect, slip), -3.0 * (1 - np.exp(-angle / 1e-3)), rtol=1e-9)


@pytest.mark.parametrize("amplitude", [2e-4, 5e-3])
def test_hysteresis_loop_encloses_what_it_dissipates(amplitude: float):
    effect = PreslidingHysteresis(coulomb={"all": 3.0}, displacement={"all": 1e-3})
    time = np.arange(1, 4001) * H
    position = amplitude * np.sin(2 * np.pi * time)
    velocity = np.diff(position, prepend=0.0) / H
    torque = law(effect, JointMotion(velocity[:, None], time_step=H))[:, 0]
    by_cycle = (torque * velocity * H).reshape(4, -1).sum(axis=1)
    assert np.all(by_cycle > 0)
    # The loop closes once it has settled, inside the rectangle of Coulomb friction, which it fills
    # when it slips.
    assert by_cycle[3] == pytest.approx(by_cycle[2], rel=0.05)
    rectangle = 4 * amplitude * 3.0
    assert by_cycle[3] < rectangle
    assert (by_cycle[3] > 0.7 * rectangle) == (amplitude > 1e-3)


def test_gap_is_crossed_with_the_rotor_s_acceleration():
    command = np.where(np.arange(200) < 50, 4.0, -4.0)[:, None]
    effect = Backlash(gap={"all": 0.01}, rotor_inertia={"all": 0.25})
    torque = law(effect, JointMotion(np.zeros((200, 1)), command=command, time_step=H))[:, 0]
    crossing = np.sqrt(2 * 0.01 * 0.25 / 4.0)
    assert np.all(torque[:50] == 0)
    assert np.all(torque[50 : 50 + round(crossing / H) - 2] == -4.0)
    # The momentum that the rotor had in the gap is the link's within a step or two.
    impact = np.flatnonzero(torque > 0)
    assert impact[-1] * H == pytest.approx(50 * H + crossing, abs=2 * H)
    assert torque[impact].sum() * H == pytest.approx(4.0 * crossing, rel=0.05)
    assert torque.sum() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("attached", [0.0, 0.25])
@pytest.mark.parametrize("contact_time", [0.0, 0.003])
def test_what_the_link_does_not_get_the_rotor_has_or_gives_it_back(
    attached: float, contact_time: float
):
    """Its momentum against the link and what is still to come is the impulse that was taken, also
    of a link that is shaken."""
    time, random = np.arange(3000)[:, None] * H, np.random.default_rng(2)
    command = 6.0 * np.sin(20.0 * time) + 3.0 * np.sin(47.0 * time)
    velocity = np.cumsum(0.02 * random.standard_normal(time.shape), axis=0)
    motion = JointMotion(velocity, command=command, time_step=H, rotor_inertia=np.array([attached]))
    nonlinear, inertia = np.array([[0.01], [0.25], [contact_time]]), 0.25
    (taken,) = basis_over_time(Backlash, motion, nonlinear)
    offset, rate, coming, *_ = Backlash.memory_over_time(motion, nonlinear[:, None])
    impulse = np.cumsum(taken[:-1], axis=0) * H
    np.testing.assert_allclose(impulse, (inertia * rate + coming)[1:], atol=1e-9)
    if contact_time == 0.0:
        assert np.abs(offset).max() == pytest.approx(0.005)
        assert np.mean(rate == 0.0) > 0.1
    else:
        assert 0.005 < np.abs(offset).max() < 0.007
    assert np.abs(impulse).max() > 0.05


def test_sides_that_give_stop_a_rotor_as_springs_and_dampers_do():
    """Against a link that is held it lands with the speed that it has from crossing the gap, swings
    as a damped oscillator whose damping ratio is 0.7 would, as long as the side pushes, and comes
    to rest where the command bends the side."""
    gap, inertia, contact_time, drive, h = 0.01, 0.25, 0.01, 4.0, 1e-4
    command = np.where(np.arange(4000) < 1500, drive, -drive)[:, None]
    motion = JointMotion(np.zeros_like(command), command=command, time_step=h)
    nonlinear = np.array([[gap], [inertia], [contact_time]])
    offset = Backlash.memory_over_time(motion, nonlinear[:, None])[0, :, 0]
    at_rest = gap / 2 + drive / inertia * contact_time**2
    assert offset[1499] == pytest.approx(at_rest, rel=1e-3)
    assert offset[-1] == pytest.approx(-at_rest, rel=1e-3)
    start = int(np.argmax(offset < -gap / 2))
    speed = np.sqrt(2.0 * (gap / 2 + at_rest) * drive / inertia)

    def pushed_back(_: float, y: np.ndarray) -> list[float]:
        push = max(0.0, y[0] / contact_time**2 + 1.4 * y[1] / contact_time)
        return [y[1], drive / inertia - push]

    times = h * np.arange(600)
    expected = solve_ivp(pushed_back, (0.0, times[-1]), [0.0, speed], t_eval=times, rtol=1e-8)
    deepest = expected.y[0].max()
    found = -offset[start : start + len(times)] - gap / 2
    # Leaving the other side, it was pushed a little: it lands by less than a step's travel off.
    assert found.max() == pytest.approx(deepest, rel=0.15)
    assert np.argmax(found) * h == pytest.approx(times[np.argmax(expected.y[0])], abs=0.002)


@pytest.mark.parametrize("contact_time", [0.0, 0.005])
def test_without_a_gap_there_is_no_contact(contact_time: float):
    """As in the joints of a robot that one value for all is given for."""
    command = 6.0 * np.sin(np.arange(500) * H * 20.0)[:, None]
    effect = Backlash(gap={"all": 0.0}, contact_time={"all": contact_time})
    torque = law(effect, JointMotion(0.1 * command, command=command, time_step=H))
    np.testing.assert_array_equal(torque, 0.0)


@pytest.mark.parametrize("attached", [0.0, 0.25])
def test_a_contact_of_less_than_a_step_is_an_impact(attached: float):
    time = np.arange(3000)[:, None] * H
    command = 6.0 * np.sin(20.0 * time) + 3.0 * np.sin(47.0 * time)
    velocity = 0.1 * np.sin(13.0 * time)
    motion = JointMotion(velocity, command=command, time_step=H, rotor_inertia=np.array([attached]))
    quick, none, soft = (
        basis_over_time(Backlash, motion, np.array([[0.01], [0.25], [contact]]))
        for contact in (H, 0.0, 2 * H)
    )
    np.testing.assert_array_equal(quick, none)
    assert np.abs(soft - none).max() > 1.0


def test_an_impact_moves_smoothly_with_the_gap():
    """A fit follows slopes: a little more gap is a little later, not a step later or not at all."""
    command = np.where(np.arange(200) < 50, 4.0, -4.0)[:, None]
    motion = JointMotion(np.zeros((200, 1)), command=command, time_step=H)
    gaps = 0.01 * (1 + 0.002 * np.arange(50))
    late = [
        law(Backlash(gap={"all": gap}, rotor_inertia={"all": 0.25}), motion)[:, 0] @ np.arange(200)
        for gap in gaps
    ]
    steps = np.diff(late)
    assert np.all(steps > 0)
    assert np.all(np.abs(steps / steps.mean() - 1) < 0.6)


@pytest.mark.parametrize(("swings", "shows"), [(0.5, False), (1, False), (2, True)])
def test_time_is_told_from_place_where_a_motion_is_repeated(swings: float, shows: bool) -> None:
    """Of k equal swings 1 - 1 / k^2 of the scatter of time lies between them: none of it in one
    way there and back, however long the joint rests before and after."""
    swing = np.linspace(0.0, 2 * np.pi * swings, 4000)
    resting = np.zeros(3000)
    position = np.concatenate([resting, 1.0 - np.cos(swing), resting + 1.0 - np.cos(swing[-1])])
    velocity = np.gradient(position, H) + 1e-4 * np.random.default_rng(0).normal(size=10_000)
    motion = JointMotion(velocity, position, time=np.arange(10_000) * H, time_step=H)
    assert ThermalDrift.shows_in(motion) == shows


def sample(effect: type[JointTorqueEffect], joints: dict[str, float]) -> JointTorqueEffect:
    """An effect with plausible values, different for each joint; `joints` gives a factor near 1."""
    middle = {}
    for name, parameter in effect.parameters.items():
        low, high = parameter.plausible
        middle[name] = 0.3 * high if parameter.linear else np.sqrt(low * high)
    values = {
        name: [value * factor for factor in joints.values()] for name, value in middle.items()
    }
    if effect is TorqueSaturation:
        values["limit"] = [8.0 * factor for factor in joints.values()]
    every = {
        name: {"all": value}
        for name, value in middle.items()
        if effect.parameters[name].neutral is None
    }
    chosen = effect.from_values(list(joints), values)
    nonlinear = [
        name
        for name, parameter in effect.parameters.items()
        if not parameter.linear and parameter.neutral is None
    ]
    return dataclasses.replace(
        chosen, **{name: every[name] | getattr(chosen, name) for name in nonlinear}
    )


@pytest.mark.parametrize("effect", JOINT_EFFECTS, ids=lambda effect: effect.__name__)
def test_slope_is_the_derivative(effect: type[JointTorqueEffect]):
    resolved = sample(effect, dict.fromkeys(NAMES.joint_names, 1.0)).resolve(NAMES)
    nonlinear, generator, e = resolved.nonlinear, np.random.default_rng(7), 1e-7
    motion = JointMotion(
        generator.normal(scale=0.02, size=12),
        generator.normal(size=12),
        generator.normal(size=12),
        5.0,
        H,
    )
    if effect.has_memory:
        memory = effect.start(motion, nonlinear)
        motion = motion._replace(memory=memory)
        for _ in range(3):
            motion = motion._replace(
                memory=effect.advance(motion, nonlinear), command=generator.normal(size=12)
            )
    after, before = (
        resolved.torque_and_slope(motion._replace(velocity=motion.velocity + d))[0] for d in (e, -e)
    )
    np.testing.assert_allclose(
        resolved.torque_and_slope(motion)[1], (after - before) / (2 * e), rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("effect", JOINT_EFFECTS, ids=lambda effect: effect.__name__)
def test_many_values_at_once_are_each_by_itself(effect: type[JointTorqueEffect]):
    motion = recorded(40, 2)
    low = np.array(
        [parameter.plausible for parameter in effect.parameters.values() if not parameter.linear]
    ).reshape(-1, 2)
    sets = np.exp(
        np.random.default_rng(1).uniform(*np.log(low).T[:, :, None, None], size=(len(low), 3, 2))
    )
    together = basis_over_time(effect, motion, sets)
    assert together.shape[1:] == (3, 40, 2)
    for k in range(3):
        np.testing.assert_allclose(
            together[:, k], basis_over_time(effect, motion, sets[:, k]), rtol=1e-12, atol=1e-12
        )


def swinging(effects: dict[str, Effect], *overrides: str) -> Log:
    """The legs swinging free with these effects."""
    base = scenario("leg_swing_gantry", "duration=0.6", *overrides, noise=False)
    return simulate(
        dataclasses.replace(base, robot=dataclasses.replace(base.robot, effects=effects))
    ).log


def by_the_law(effects: dict[str, Effect], log: Log) -> np.ndarray:
    """Torque of each step from the recorded motion, shape (N - 1, n)."""
    command, loss = log["joint/torque_command"], log["truth/joint/friction_torque"]
    motion = JointMotion(
        log["truth/joint/velocity"][1:],
        log["truth/joint/position"][:-1],
        command[:-1],
        log.time[:-1, None],
        log.meta["period"],
        # What passed the gear in the step before.
        load=np.concatenate([command[:1], (command - loss)[:-2]]),
    )
    return sum(law(effect, motion) for effect in effects.values())


FOUR = {
    "left_hip_yaw": 1.0,
    "left_knee_pitch": 0.8,
    "right_hip_pitch": 0.9,
    "right_ankle_roll": 0.7,
}


def test_simulated_torque_is_the_law_where_it_does_not_depend_on_velocity():
    kinds = (
        TorqueGain,
        TorqueBias,
        TorqueDelay,
        TorqueLag,
        TorqueReadingLag,
        TorqueSaturation,
        TorqueRipple,
        JointSpring,
        Counterbalance,
        Backlash,
    )
    effects = {kind.__name__: sample(kind, FOUR) for kind in kinds}
    log = swinging(effects)
    loss = log["truth/joint/friction_torque"]
    np.testing.assert_allclose(loss[:-1], by_the_law(effects, log), rtol=0, atol=1e-9)
    named = [joint in FOUR for joint in NAMES.joint_names]
    assert np.all(np.abs(loss[:, named]).max(axis=0) > 1.0)
    assert np.all(loss[:, np.logical_not(named)] == 0)


@pytest.mark.parametrize(
    "kind",
    [effect for effect in JOINT_EFFECTS if effect is not Backlash],
    ids=lambda effect: effect.__name__,
)
def test_every_effect_alone_spares_the_joints_that_are_not_named(kind: type[JointTorqueEffect]):
    motion = recorded(60, 12)
    loss = law(sample(kind, FOUR), motion)
    named = np.array([joint in FOUR for joint in NAMES.joint_names])
    assert np.all(np.abs(loss[:, named]).max(axis=0) > 0)
    assert np.all(loss[:, ~named] == 0)


@pytest.mark.parametrize(
    "effect",
    [
        CoulombFriction(coulomb={"all": 2.0}),
        LoadDependentFriction(coefficient={"all": 0.1}),
        QuadraticDrag(drag={"all": 2.0}),
        ThermalDrift(change={"all": 4.0}, warm_up={"all": 0.3}),
        PreslidingHysteresis(coulomb={"all": 2.0}),
        DirectionalViscousFriction(asymmetry={"all": -2.0}),
    ],
    ids=lambda effect: type(effect).__name__,
)
def test_simulated_torque_follows_the_law_of_the_velocity_that_comes_out(effect: JointTorqueEffect):
    """In all joints of freely swinging legs, some of them light, under a command that is not
    smooth."""
    log = swinging({"effect": effect}, "duration=1.5")
    loss, predicted = log["truth/joint/friction_torque"][:-1], by_the_law({"effect": effect}, log)
    np.testing.assert_allclose(predicted, log["truth/joint/friction_law_torque"][:-1], atol=1e-9)
    error = np.sqrt(((loss - predicted) ** 2).mean(axis=0) / (loss**2).mean(axis=0))
    assert error.max() < 2e-2


def test_links_get_what_is_commanded_less_the_loss():
    """Drake's inverse dynamics of the motion that came out: (1 - shortfall)
    command - bias - stiffness angle."""
    effects = {
        "gain": TorqueGain(shortfall={"all": 0.1}),
        "bias": TorqueBias(bias={"all": -1.0}),
        "spring": JointSpring({"all": 20.0}),
    }
    log = swinging(effects)
    robot, _ = make_robot("biped", gantry_height=1.2)
    plant, context, forces = (
        robot.plant,
        robot.plant.CreateDefaultContext(),
        MultibodyForces(robot.plant),
    )
    q, v, a = (log[f"truth/joint/{name}"] for name in ("position", "velocity", "acceleration"))
    for k in range(0, len(q) - 1, 25):
        robot.set_state(context, q[k], v[k])
        acceleration = np.zeros(plant.num_velocities())
        acceleration[robot.velocity_index] = a[k + 1]
        plant.CalcForceElementsContribution(context, forces)
        needed = plant.CalcInverseDynamics(context, acceleration, forces)[robot.velocity_index]
        np.testing.assert_allclose(
            needed, 0.9 * log["joint/torque_command"][k] + 1.0 - 20.0 * q[k], atol=1e-9
        )


def test_a_held_command_is_delayed_by_time_not_by_ticks():
    """Control every second plant step, logged every step."""
    log = swinging({"delay": TorqueDelay(delay={"all": 3e-3})}, "control.period=0.002")
    command, loss = log["joint/torque_command"], log["truth/joint/friction_torque"]
    np.testing.assert_allclose(loss[3:], command[3:] - command[:-3], atol=1e-9)
    assert np.abs(loss).max() > 0.1


@pytest.mark.parametrize("effect", list(library().values()), ids=lambda effect: effect.__name__)
def test_values_survive_resolving(effect: type[Effect]):
    targets = {
        "joint": NAMES.joint_names,
        "foot": NAMES.sides,
        "body": ["trunk", "left_foot"],
        "robot": ["robot"],
    }[effect.acts_on]
    generator = np.random.default_rng(5)
    values = {
        name: generator.uniform(*parameter.plausible, size=len(targets))
        for name, parameter in effect.parameters.items()
    }
    resolved = effect.from_values(targets, values).resolve(NAMES)
    assert resolved.targets == targets
    for linear, rows in ((True, resolved.linear), (False, resolved.nonlinear)):
        expected = [
            values[name]
            for name, parameter in effect.parameters.items()
            if parameter.linear == linear
        ]
        np.testing.assert_array_equal(
            rows, expected or (np.ones((1, 12)) if linear else np.zeros((0, len(targets))))
        )


@pytest.mark.parametrize("effect", list(library().values()), ids=lambda effect: effect.__name__)
def test_every_effect_says_what_it_is(effect: type[Effect]):
    for sentence in (effect.description, effect.signature, effect.experiment):
        assert sentence[0].isupper()
        assert sentence.endswith(".")
    for name, parameter in effect.parameters.items():
        low, high = parameter.plausible
        assert parameter.bounds[0] <= low < high <= parameter.bounds[1], name
        # Searches go over the logarithm of nonlinear parameters.
        assert parameter.linear or low > 0, name


@pytest.mark.parametrize("effect", list(library().values()), ids=lambda effect: effect.__name__)
def test_every_effect_survives_being_written_and_read(effect: type[Effect], tmp_path: Path):
    target = {"joint": "left_knee_pitch", "foot": "left", "body": "trunk", "robot": "robot"}[
        effect.acts_on
    ]
    value = effect.from_values(
        [target], {name: [0.5 * sum(p.plausible) + 0.125] for name, p in effect.parameters.items()}
    )
    nonlinear = [
        name
        for name, p in effect.parameters.items()
        if not p.linear and p.neutral is None and effect.acts_on == "joint"
    ]
    value = dataclasses.replace(
        value, **{name: {"all": 1.0, **getattr(value, name)} for name in nonlinear}
    )
    original = Scenario(
        robot=RobotConfig(effects={"hidden": value}), model=RobotConfig(effects={"found": value})
    )
    path = tmp_path / "mine.yaml"
    path.write_text(dump_scenario(original, "mine"))
    again = load_scenario(path)
    assert again.robot.effects == {"hidden": value}
    assert again.model.effects == {"found": value}
    assert type(again.robot.effects["hidden"]) is effect


MINE = '''
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from fbse_drake.effects.effect import Parameter, in_library
from fbse_drake.effects.joint_torque import JointTorqueEffect


@in_library
@dataclass(frozen=True)
class GravityOfACable(JointTorqueEffect):
    """u = weight cos(q)."""

    description: ClassVar[str] = "A cable hangs on the joint."
    signature: ClassVar[str] = "Torque like the cosine of the angle."
    experiment: ClassVar[str] = "Hold the joint at several angles."
    parameters: ClassVar[dict[str, Parameter]] = {
        "weight": Parameter("Nm", linear=True, plausible=(0.0, 10.0))
    }

    weight: dict[str, float] = field(default_factory=dict)

    @staticmethod
    def basis(motion, nonlinear):
        return (np.cos(motion.position),), (0.0,)
'''


@pytest.fixture
def _library_as_before(monkeypatch: pytest.MonkeyPatch):
    """Takes out again what a test puts into the library."""
    monkeypatch.setattr("fbse_drake.effects.effect._LIBRARY", library())


@pytest.mark.usefixtures("_library_as_before")
def test_an_effect_of_a_user_s_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "cable.py").write_text(MINE)
    path, copy = tmp_path / "mine.yaml", tmp_path / "elsewhere" / "copy.yaml"
    path.write_text(
        "mine:\n  duration: 0.05\n  effect_modules: [cable.py]\n"
        "  robot: {gantry_height: 1.2, effects: {cable: !GravityOfACable {weight: "
        "{left_knee_pitch: 3.0}}}}\n"
        "  reference: !JointSines {amplitude: {knee_pitch: 0.1}, frequency: {all: 1.0}}\n"
    )
    monkeypatch.chdir("/")
    mine = load_scenario(path)
    log = simulate(mine).log
    knee = NAMES.joint_names.index("left_knee_pitch")
    np.testing.assert_allclose(
        log["truth/joint/friction_torque"][:, knee],
        3.0 * np.cos(log["truth/joint/position"][:, knee]),
        rtol=1e-12,
    )
    # The scenario of the log can be read from anywhere.
    copy.parent.mkdir()
    copy.write_text(log.meta["scenario"])
    again = load_scenario(copy)
    assert again.robot == mine.robot
    assert again.effect_modules == [str(tmp_path / "cable.py")]


@pytest.mark.usefixtures("_library_as_before")
@pytest.mark.parametrize(
    ("module", "message"),
    [
        (None, r"effect_modules: .*mine\.py: cannot be imported: FileNotFoundError"),
        ("def", r"effect_modules: .*mine\.py: cannot be imported: SyntaxError: .*line 1"),
        (
            "import no_such_thing",
            r"cannot be imported: ModuleNotFoundError: No module named 'no_such_thing'",
        ),
        (
            MINE.replace("GravityOfACable", "TorqueGain"),
            r"effect TorqueGain: the library has another effect of this name",
        ),
        (
            MINE.replace("    weight: dict[str, float] = field(default_factory=dict)\n", ""),
            r"expected a dataclass with the fields",
        ),
        (
            MINE.replace("    signature:", "    sign:"),
            r"effect GravityOfACable: the class variable signature is missing",
        ),
        (
            MINE.replace("def basis", "def bases"),
            r"effect GravityOfACable: the method basis is missing",
        ),
    ],
)
def test_a_bad_module_gets_one_line(tmp_path: Path, module: str | None, message: str):
    if module is not None:
        (tmp_path / "mine.py").write_text(module)
    path = tmp_path / "mine.yaml"
    path.write_text("mine: {effect_modules: [mine.py]}\n")
    with pytest.raises(InputError, match=message) as error:
        load_scenario(path)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("effect_modules: cable.py", r"effect_modules: expected a list, found 'cable\.py'"),
        (
            "effect_modules: [no.such.module]",
            r"effect_modules: no\.such\.module: cannot be imported: ModuleNotFoundError",
        ),
        (
            "robot: {effects: {f: !Magic {}}}",
            r"robot\.effects\.f: expected one of .*!TorqueGain.*, found the tag !Magic",
        ),
        (
            "robot: {effects: {f: !TorqueGain {shortfal: {}}}}",
            r"f\.shortfal: unknown key, did you mean shortfall\?",
        ),
        (
            "robot: {effects: {f: !TorqueGain {shortfall: {knee: 1}}}}",
            r"robot\.effects\.f\.shortfall\.knee: unknown joint",
        ),
        (
            "robot: {effects: {f: !TorqueDelay {delay: {all: -1}}}}",
            r"robot\.effects\.f\.delay: expected values in \[0, inf\] s",
        ),
        (
            "model: {effects: {f: !Backlash {gap: {foot: 1}}}}",
            r"model\.effects\.f\.gap\.foot: unknown joint",
        ),
    ],
)
def test_bad_effects_get_one_line(tmp_path: Path, text: str, message: str):
    path = tmp_path / "mine.yaml"
    path.write_text(f"mine: {{{text}}}\n")
    with pytest.raises(InputError, match=message) as error:
        load_scenario(path)
    assert "\n" not in str(error.value)


def test_a_nonlinear_value_that_is_not_given_is_refused():
    with pytest.raises(InputError, match=r"f\.transition: no value for left_hip_yaw"):
        CoulombFriction(coulomb={"all": 1.0}, transition={"knee_pitch": 0.1}).resolve(
            NAMES, key="f"
        )


def test_the_same_class_can_be_registered_again():
    assert in_library(TorqueGain) is TorqueGain
