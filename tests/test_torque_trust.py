"""What is said of torques that are not what they are called, and what is not said where a machine's
own physics looks alike."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from recorded_arm import ARM, PENDULUM, Course, Machine, inverse_dynamics
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from fbse_drake.discrepancy.diagnosis.diagnose import diagnose
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene, inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.discrepancy.hygiene.torque_readings import JointTorques, chance, gain
from fbse_drake.discrepancy.residual.evidence import Evidence, HygieneFinding
from fbse_drake.effects.friction import CoulombFriction, ViscousFriction
from fbse_drake.effects.transmission import TorqueRipple
from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.report.sentences import diagnosis_outcome

AXIS = 1
TORQUE_KINDS = {
    "clock_offset",
    "dead_torque",
    "not_a_torque",
    "swapped_joints",
    "torque_or_model",
    "torque_scale",
    "torque_sign",
}


def said(machine: Machine, log: Log) -> list[HygieneFinding]:
    """What is said of the torques."""
    found = inspect(machine.predictor(log).motion).findings
    return [finding for finding in found if finding.kind in TORQUE_KINDS]


def only(found: list[HygieneFinding]) -> HygieneFinding:
    assert len(found) == 1, [finding.text for finding in found]
    return found[0]


@pytest.fixture(scope="module")
def arm() -> Course:
    return ARM.course(1)


@pytest.fixture(scope="module")
def pendulum() -> Course:
    return PENDULUM.course(1)


def rubbing(course: Course) -> np.ndarray:
    """Torques with Coulomb friction, a sixth of what each joint needs."""
    return course.torque + np.tanh(course.velocity / 0.01) * course.torque.std(axis=0) / 6


def of_one(
    course: Course, change: Callable[[np.ndarray], np.ndarray], joint: int = AXIS
) -> np.ndarray:
    """Torques of which one joint's is another."""
    torque = course.torque.copy()
    torque[:, joint] = change(torque[:, joint])
    return torque


def shifted(course: Course, torque: np.ndarray, seconds: float) -> np.ndarray:
    """Torques that much later."""
    at = course.time - seconds
    return np.stack([np.interp(at, course.time, column) for column in torque.T], axis=1)


def test_a_lost_sign_is_noticed_in_every_joint(arm: Course, pendulum: Course) -> None:
    for machine, course in ((ARM, arm), (PENDULUM, pendulum)):
        for torque in (course.torque, rubbing(course)):
            log = machine.log(course, torque, read=np.abs)
            finding = only(said(machine, log))
            assert (finding.kind, finding.severity) == ("torque_sign", "untrustworthy")
            assert "sign is lost" in finding.text
            assert len(finding.where) == len(log.joints)
            with pytest.raises(InputError, match="sign is lost"):
                check_sensors(machine.predictor(log).motion)


def test_a_filter_that_settles_loses_no_sign() -> None:
    """Velocities behind a filter begin with a jump, for which the model needs a torque of the other
    sign than that which carries the arm at all other times."""
    machine = replace(ARM, posture=(0.0, 1.2, 0.2, 0.0, 0.3, 0.0), amplitude=(1.2, 0.2, 0.2) * 2)
    course = machine.course(2)
    log = machine.log(course)
    kept = np.exp(-1.0)
    settling = lfilter([1 - kept], [1, -kept], log["joint/velocity"] + 1.0, axis=0) - 1.0
    log = replace(log, channels=log.channels | {"joint/velocity": settling})
    motion = machine.predictor(log).motion
    needed = motion.blocks.torque_command[:, AXIS] - motion.residual.value[:, AXIS]
    assert (log["joint/torque_command"][:, AXIS] < 0).all()
    assert 0 < (needed > 0).sum() < 10
    assert "torque_sign" not in {finding.kind for finding in said(machine, log)}
    check_sensors(motion)


def test_a_reversed_sign_is_told_from_a_lost_one(arm: Course, pendulum: Course) -> None:
    for machine, course, joint in ((ARM, arm, AXIS), (PENDULUM, pendulum, 0)):
        log = machine.log(course, of_one(course, np.negative, joint))
        finding = only(said(machine, log))
        assert finding.where == (log.joints[joint],)
        assert finding.size == pytest.approx(-1, abs=0.02)
        with pytest.raises(InputError, match="sign is reversed"):
            check_sensors(machine.predictor(log).motion)


def test_a_dead_channel_is_dead_and_nobody_is_swapped(arm: Course, pendulum: Course) -> None:
    """Its own noise is all that it has, which may be a sixth of the torque's range."""
    for machine, course, joint in ((ARM, arm, AXIS), (PENDULUM, pendulum, 0)):
        finding = only(said(machine, machine.log(course, of_one(course, np.zeros_like, joint))))
        assert (finding.kind, finding.where) == ("dead_torque", (machine.joints[joint],))


@pytest.mark.parametrize("scale", [0.1, 0.6, 1.6, 5.0])
def test_a_scale_is_asserted_where_nothing_else_explains_it(arm: Course, scale: float) -> None:
    """Axis 2 drives all others: neither inertia nor springs of its own make its torque larger."""
    finding = only(said(ARM, ARM.log(arm, of_one(arm, lambda torque: scale * torque))))
    assert finding.kind == "torque_scale"
    assert finding.where == ("axis_2",)
    assert finding.size == pytest.approx(scale, rel=0.02)
    hopeless = not 1 / 3 < scale < 3
    assert finding.severity == ("untrustworthy" if hopeless else "warning")


def test_noise_in_what_the_model_needs_is_no_scale(arm: Course) -> None:
    """It makes a regression of the torque find too small a scale, and noise in the torque one by
    the torque too large a scale; between them is the true one."""
    torques = JointTorques(Evidence(ARM.predictor(ARM.log(arm, arm.torque)).motion))
    columns, random = torques.columns(AXIS), np.random.default_rng(0)

    def scales() -> tuple[float, float]:
        return torques.scaled(AXIS, columns).amounts[-1], torques.largest_scale(AXIS, columns)

    assert scales() == pytest.approx((1.0, 1.0), abs=0.01)
    size = torques.needed[:, AXIS].std()
    for column in (torques.needed, torques.torque):
        exact = column[:, AXIS].copy()
        column[:, AXIS] += size * random.standard_normal(len(exact))
        least, largest = scales()
        assert 0.99 * least < 1.0 < 1.01 * largest
        assert largest > 1.4 * least
        column[:, AXIS] = exact


def test_a_pendulum_s_scale_may_be_its_weight(pendulum: Course) -> None:
    """A heavier or longer weight needs a torque in proportion: nothing tells it from another
    unit."""
    finding = only(said(PENDULUM, PENDULUM.log(pendulum, 1.6 * pendulum.torque)))
    assert (finding.kind, finding.severity) == ("torque_or_model", "note")
    assert finding.size == pytest.approx(1.6, rel=0.02)
    assert "a load" in finding.text


def test_missing_rotor_inertia_is_no_torque_constant() -> None:
    heavier = tuple(3 * inertia for inertia in ARM.rotor_inertia)
    finding = only(said(ARM, ARM.log(ARM.course(1, heavier))))
    assert (finding.kind, finding.severity) == ("torque_or_model", "note")
    assert "reflected inertia" in finding.text


@pytest.mark.parametrize("cause", ["counterbalance", "bungee", "offset"])
def test_what_the_model_lacks_is_no_reversed_sign_and_no_swap(
    arm: Course, pendulum: Course, cause: str
) -> None:
    for machine, course, joint in ((ARM, arm, AXIS), (PENDULUM, pendulum, 0)):
        angle, own = course.position[:, joint], course.torque[:, joint]
        pull = {
            "counterbalance": -1.3 * np.abs(own).max() * np.cos(angle - 0.2),
            "bungee": -3 * own.std() * np.maximum(angle, 0.0),
            "offset": 0.0,
        }[cause]
        moved = course.position.copy()
        moved[:, joint] += 0.3 * (cause == "offset")
        recorded = replace(course, position=moved)
        torque = of_one(recorded, lambda torque, pull=pull: torque + pull, joint)
        log = machine.log(recorded, torque)
        check_sensors(machine.predictor(log).motion)
        assert {finding.severity for finding in said(machine, log)} <= {"note"}


@pytest.mark.parametrize(
    ("late", "severity"),
    [(-0.02, "note"), (-0.008, "note"), (0.0065, "warning"), (0.02, "untrustworthy")],
)
def test_torque_that_is_late_or_early_whatever_rubs(
    arm: Course, late: float, severity: str
) -> None:
    """An effect allows for what is late by less than a block."""
    finding = only(
        [
            finding
            for finding in inspect(
                ARM.predictor(ARM.log(arm, shifted(arm, rubbing(arm), late))).motion
            ).findings
            if finding.kind in ("clock_offset", "command_ahead")
        ]
    )
    assert finding.kind == ("clock_offset" if late > 0 else "command_ahead")
    assert finding.severity == severity
    assert finding.size == pytest.approx(abs(late), rel=0.15)


@pytest.mark.parametrize("machine", [ARM, PENDULUM], ids=["arm", "pendulum"])
def test_good_torques_with_friction_are_good(machine: Machine) -> None:
    for seed in range(2):
        course = machine.course(seed)
        assert said(machine, machine.log(course, rubbing(course), seed)) == []


def test_saturated_torque_is_clipped_and_of_no_other_scale(arm: Course) -> None:
    limit = 0.6 * np.abs(arm.torque[:, AXIS]).max()

    def clipped(torque: np.ndarray) -> np.ndarray:
        limits = np.where(np.arange(torque.shape[1]) == AXIS, limit, np.inf)
        return np.clip(torque, -limits, limits)

    log = ARM.log(arm, read=clipped)
    assert said(ARM, log) == []
    assert "clipped" in {f.kind for f in inspect(ARM.predictor(log).motion).findings}


def test_chances_are_what_they_say() -> None:
    """Of two readings that are equally good the one is called better than the other as often as
    stated."""
    random, blocks, alarms = np.random.default_rng(3), 300, []
    stretch = np.arange(blocks) // 15
    for _ in range(2000):
        # Errors that last, of changing size, as long as a stretch or less.
        drift = np.repeat(random.standard_normal((2, blocks // 5)), 5, axis=1)
        size = np.repeat(random.uniform(0.5, 1.5, blocks // 15), 15)
        common = random.standard_normal(blocks)
        before, after = size * (common + 0.5 * drift)
        alarms.append(chance(gain(before, after), stretch))
    for level in (0.2, 0.05, 0.01):
        # Three deviations of a count of 2000; one of the two has to seem better.
        expected = level + 3 * np.sqrt(level / 2000)
        assert 0.3 * level < np.mean(np.array(alarms) < level) < expected


def test_rows_that_are_not_to_be_trusted_are_not_explained(arm: Course) -> None:
    """A dead torque is no motor of which a share of -700 % arrives; friction of its neighbour is
    found all the same."""
    torque = of_one(arm, np.zeros_like)
    torque[:, 2] += 6.0 * np.tanh(arm.velocity[:, 2] / 0.01)
    log = ARM.log(arm, torque)
    predictor = ARM.predictor(log)
    hygiene = inspect(predictor.motion)
    assert hygiene.untrusted_joints() == ["axis_2"]
    trusted = hygiene.trusted(ARM.scenario, predictor.robot)
    effects = [CoulombFriction, ViscousFriction]
    diagnosis = diagnose(Predictor(trusted, log), effects)
    assert {target for f in diagnosis.ranking for target in f.targets} == {"axis_3"}


def test_where_no_torque_is_to_be_trusted_nothing_is_explained(pendulum: Course) -> None:
    predictor = PENDULUM.predictor(PENDULUM.log(pendulum, 0 * pendulum.torque))
    hygiene = inspect(predictor.motion)
    with pytest.raises(InputError, match=r"nothing is left that could be explained: .*dead"):
        hygiene.trusted(PENDULUM.scenario, predictor.robot)
    good = Hygiene().trusted(PENDULUM.scenario, predictor.robot)
    assert good.recording == PENDULUM.scenario.recording


def test_a_pendulum_that_is_held_still_is_not_stuck(pendulum: Course) -> None:
    """Its angle has noise while its torque is held, or steps while a tachometer has an offset."""
    held = slice(600, 1100)
    random = np.random.default_rng(5)
    log = PENDULUM.log(pendulum)
    position, torque = (log[f"joint/{name}"].copy() for name in ("position", "torque_command"))
    position[held], torque[held] = position[held.start], torque[held.start]
    noisy = position + 2e-3 * random.standard_normal(position.shape)
    coarse = 1.5e-3 * np.rint(position / 1.5e-3)
    velocity = log["joint/velocity"].copy()
    velocity[held] = 0.015 + 5e-4 * random.standard_normal(velocity[held].shape)
    for angles in (noisy, coarse):
        channels = {
            "joint/position": angles,
            "joint/velocity": velocity,
            "joint/torque_command": torque,
        }
        found = inspect(
            PENDULUM.predictor(replace(log, channels=log.channels | channels)).motion
        ).findings
        assert "stuck" not in {finding.kind for finding in found}
    # An angle that stays where it is while the joint moves is stuck.
    stuck = log["joint/position"].copy()
    stuck[held] = stuck[held.start]
    changed = replace(log, channels=log.channels | {"joint/position": stuck})
    found = inspect(PENDULUM.predictor(changed).motion).findings
    assert "stuck" in {finding.kind for finding in found}


CHAIN = Machine(
    "double_pendulum",
    posture=(0.0, 0.0),
    amplitude=(1.2, 1.5),
    rotor_inertia=(0.003, 0.003),
    torque_noise=(0.02, 0.02),
)
RELEASED = 4.0


def let_go(machine: Machine, course: Course) -> Course:
    """The same until its drives are switched off; then it swings with friction of its own."""
    robot, rubs = machine.robot(machine.by_joint(machine.rotor_inertia)), 0.05 * np.ones(2)
    n, free = len(rubs), course.time >= RELEASED

    def torque_needed(q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return inverse_dynamics(robot, q[None], v[None], a[None])[0]

    def rate(_: float, state: np.ndarray) -> np.ndarray:
        q, v = state[:n], state[n:]
        without = torque_needed(q, v, np.zeros(n))
        mass = np.stack([torque_needed(q, v, unit) - without for unit in np.eye(n)], axis=1)
        return np.concatenate([v, np.linalg.solve(mass, -rubs * np.tanh(v / 0.05) - without)])

    start = np.flatnonzero(free)[0]
    state = np.concatenate([course.position[start], course.velocity[start]])
    times = course.time[free]
    swing = solve_ivp(rate, (times[0], times[-1]), state, t_eval=times, rtol=1e-8, atol=1e-8).y
    position, velocity, torque = (
        array.copy() for array in (course.position, course.velocity, course.torque)
    )
    position[free], velocity[free], torque[free] = swing[:n].T, swing[n:].T, 0.0
    return replace(course, position=position, velocity=velocity, torque=torque)


def when_free(values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Reads exactly zero from when the drives are off."""
    return lambda measured: np.where((values >= RELEASED)[:, None], 0.0, measured)


def test_drives_that_are_switched_off_are_not_stuck() -> None:
    """A machine that swings out loses energy. One that goes on as before, or is let down, is
    driven: that its torque is zero is what its sensor says."""
    driven = CHAIN.course(2)
    read = when_free(driven.time)
    after = driven.time[driven.time >= RELEASED] - RELEASED
    down = {name: getattr(driven, name).copy() for name in ("position", "velocity")}
    free = driven.time >= RELEASED
    down["position"][free] = 1.4 * np.array([[1.0, 0.2]]) * np.exp(-after / 2.0)[:, None]
    down["velocity"][free] = -down["position"][free] / 2.0
    for course, is_stuck in (
        (let_go(CHAIN, driven), False),
        (driven, True),
        (replace(driven, **down), True),
    ):
        findings = inspect(CHAIN.predictor(CHAIN.log(course, read=read)).motion).findings
        stuck = [f for f in findings if f.kind == "stuck" and f.channel == "joint/torque_command"]
        assert bool(stuck) == is_stuck, [finding.text for finding in findings]


@pytest.mark.parametrize(
    ("hidden", "block", "verdict"),
    [
        (0.04, 0.2, "not_visible"),
        (0.04, 0.05, "unknown_effect"),
        (0.0, 0.2, "nothing_missing"),
    ],
)
def test_forty_averages_do_not_say_that_what_is_left_is_noise(
    pendulum: Course, hidden: float, block: float, verdict: str
) -> None:
    """A torque that comes and goes with time is no law of the library: 8 s show it in averages of
    0.05 s, and not in averages of 0.2 s, which are too few to tell it from noise."""
    torque = pendulum.torque + hidden * np.sin(7.0 * pendulum.time)[:, None]
    scenario = replace(
        PENDULUM.scenario, recording=replace(PENDULUM.scenario.recording, block=block)
    )
    log = PENDULUM.log(pendulum, torque)
    diagnosis = diagnose(Predictor(scenario, log), [CoulombFriction, ViscousFriction])
    assert (diagnosis.verdict, diagnosis.chosen) == (verdict, [])
    assert bool(diagnosis.untested) == (verdict == "not_visible")
    assert ("too short to tell" in diagnosis_outcome(diagnosis)) == (verdict == "not_visible")


def test_a_test_that_sees_little_acquits_nothing(pendulum: Course) -> None:
    """What lasts for a quarter of a second and comes by chance: in 80 averages it is seen or it is
    not; that it is noise is never said. In 8 logs either happens."""
    recording = replace(PENDULUM.scenario.recording, block=0.1)
    scenario, verdicts = replace(PENDULUM.scenario, recording=recording), set()
    for seed in range(8):
        white = np.random.default_rng([seed, 3]).normal(size=pendulum.torque.shape)
        lasting = lfilter([1.0], [1.0, -np.exp(-pendulum.period / 0.12)], white, axis=0)
        torque = pendulum.torque + 0.01 * lasting / lasting.std()
        log = PENDULUM.log(pendulum, torque, seed)
        verdicts.add(diagnose(Predictor(scenario, log), [CoulombFriction]).verdict)
    assert verdicts == {"not_visible", "unknown_effect"}


@pytest.mark.parametrize(
    ("kick", "verdict"), [(0.0, "nothing_missing"), (0.02, "nothing_missing"), (3.0, "not_visible")]
)
def test_far_more_than_noise_is_not_acquitted_for_telling_nothing(
    pendulum: Course, kick: float, verdict: str
) -> None:
    """Kicks of a hundredth of a second at random, as of play: what comes later does not show in
    them, and no law is behind them. Small ones pass for noise."""
    random, lasting = np.random.default_rng(5), 3
    kicks = kick * random.normal(size=(len(pendulum.torque) // lasting + 1, 1))
    kicks[random.random(size=kicks.shape) > 0.05] = 0.0
    kicks = kicks.repeat(lasting, axis=0)[: len(pendulum.torque)]
    log = PENDULUM.log(pendulum, pendulum.torque + kicks)
    diagnosis = diagnose(PENDULUM.predictor(log), [CoulombFriction, ViscousFriction])
    assert (diagnosis.verdict, diagnosis.chosen) == (verdict, [])
    is_noisy = verdict == "not_visible"
    assert diagnosis.noisy == ((PENDULUM.joints[0],) if is_noisy else ())
    assert ("follows nothing that was measured" in diagnosis_outcome(diagnosis)) == is_noisy
    expected = "not_visible" if is_noisy else "absent"
    assert {status.verdict for status in diagnosis.effects.values()} == {expected}


def test_what_follows_the_angle_is_no_drift_in_time(pendulum: Course) -> None:
    """One way up and down: friction that grows with the load does so with time. Where the motion is
    repeated a drift is named."""
    drifting = 0.1 * (1.0 - np.exp(-pendulum.time / 20.0))
    once = 0.5 * np.pi * np.sin(np.pi * pendulum.time / pendulum.time[-1]) ** 2
    rate = np.gradient(once, pendulum.period)
    motion = [values[:, None] for values in (once, rate, np.gradient(rate, pendulum.period))]
    up_and_down = Course(
        pendulum.time,
        *motion,
        inverse_dynamics(PENDULUM.robot(PENDULUM.by_joint(PENDULUM.rotor_inertia)), *motion),
    )
    loaded = 0.2 * np.abs(up_and_down.torque[:, 0])
    for course, friction, named in (
        (up_and_down, loaded, False),
        (up_and_down, drifting, False),
        (pendulum, drifting, True),
    ):
        torque = course.torque + friction[:, None] * np.tanh(course.velocity / 0.01)
        diagnosis = diagnose(PENDULUM.predictor(PENDULUM.log(course, torque)))
        assert ("ThermalDrift" in {finding.effect for finding in diagnosis.chosen}) == named
        allowed = {"present"} if named else {"confusable", "not_visible"}
        assert diagnosis.effects["ThermalDrift"].verdict in allowed


def test_a_low_pass_beyond_half_the_rate_leaves_all(pendulum: Course) -> None:
    """A scenario for a log of 250 Hz reads every tenth row of it as well."""
    recording = replace(PENDULUM.scenario.recording, cutoff=40.0, block=0.2)
    scenario, rare = replace(PENDULUM.scenario, recording=recording), slice(None, None, 10)
    log = PENDULUM.log(pendulum).part(rare)
    motion = Predictor(scenario, log).motion
    torque = motion.signals.torque_command
    assert np.array_equal(motion.low_passed(torque, 12.5), torque)
    assert not np.allclose(motion.low_passed(torque, 12.0), torque, atol=1e-6)
    assert diagnose(Predictor(scenario, log), [CoulombFriction]).verdict == "nothing_missing"


@pytest.mark.parametrize(("cycles", "is_ripple"), [(4.5, False), (12.0, True)])
def test_a_wave_longer_than_any_gear_makes_is_no_ripple(
    arm: Course, cycles: float, is_ripple: bool
) -> None:
    """What an encoder of another scale leaves looks like a piece of such a wave."""
    size = 0.1 * arm.torque[:, AXIS].std()
    torque = arm.torque.copy()
    torque[:, AXIS] += size * np.sin(cycles * arm.position[:, AXIS])
    found = diagnose(ARM.predictor(ARM.log(arm, torque)), [TorqueRipple])
    named = [finding.effect for finding in found.chosen]
    assert named == (["TorqueRipple"] if is_ripple else [])
    assert found.verdict == ("effect_found" if is_ripple else "unknown_effect")
