"""The residual is what the sensors' noise makes it when nothing is missing, and shows what is
missing when something is."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.hygiene.hygiene import inspect
from fbse_drake.discrepancy.hygiene.sanity import check_sensors
from fbse_drake.discrepancy.identification.regression import Regression, Signature, WhitenedResidual
from fbse_drake.discrepancy.identification.structure import EXCESS, leftover_structure
from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.residual import Residual, rms
from fbse_drake.discrepancy.residual.rows import Row
from fbse_drake.effects.effect import library
from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.scenario import Scenario, load_scenario
from fbse_drake.simulation import simulate


def believed(scenario: Scenario) -> Scenario:
    """The scenario with a model that knows all of the robot."""
    return replace(scenario, model=scenario.robot)


@pytest.fixture(scope="module")
def walk() -> tuple[Scenario, Log]:
    scenario = load_scenario("paper_walk", overrides=["duration=3", "seed=5"])
    return believed(scenario), simulate(scenario).log


def changed(log: Log, **channels: np.ndarray) -> Log:
    return replace(
        log,
        channels=log.channels
        | {name.replace("__", "/"): values for name, values in channels.items()},
    )


def kinds(residual: Residual, kind: str) -> list[int]:
    return [k for k, row in enumerate(residual.rows) if row.kind == kind]


def test_nothing_but_noise_is_left_where_nothing_is_missing(walk: tuple[Scenario, Log]) -> None:
    white = WhitenedResidual(Predictor(*walk).residual)
    ratio = np.sqrt(white.sse / white.count)
    assert np.all((0.85 < ratio) & (ratio < 1.2)), dict(
        zip((r.name for r in white.residual.rows), ratio.round(2), strict=True)
    )
    # White: no block knows anything of the next.
    y = white.y[:, kinds(white.residual, "joint") + kinds(white.residual, "base")]
    correlation = (y[1:] * y[:-1]).sum(axis=0) / (y**2).sum(axis=0)
    assert np.abs(correlation).max() < 4 / np.sqrt(len(y))


def test_the_noise_floor_follows_the_sensors(walk: tuple[Scenario, Log]) -> None:
    scenario, log = walk
    floor = Predictor(scenario, log).residual.noise_floor
    sensors = scenario.sensors
    forces = replace(
        scenario, sensors=replace(sensors, foot_force=replace(sensors.foot_force, noise=50.0))
    )
    by_forces = Predictor(forces, log).residual.noise_floor / floor
    rows = Predictor(scenario, log).residual.row_index
    # Vertical force on the base: the accelerometer's noise is nothing beside that of eight pads.
    assert by_forces[rows["base/force_z"]] > 20
    # How a sole tilts is predicted from the forces, how it turns about the vertical is not.
    assert by_forces[rows["left_sole/angular_velocity_x"]] > 5
    assert by_forces[rows["left_sole/angular_velocity_z"]] == pytest.approx(1.0, abs=1e-9)
    # Eight pads of 50 N each, averaged over ten samples.
    assert Predictor(forces, log).residual.noise_floor[rows["base/force_z"]] == pytest.approx(
        50 * np.sqrt(8 / 10), rel=0.02
    )


def test_soft_ground_is_nothing_to_a_robot_that_hangs(run: Callable[..., Log]) -> None:
    """Neither its soles sink nor does that add noise, whatever the model says of the ground."""
    log, scenario = run("leg_swing_gantry", "duration=0.5"), load_scenario("leg_swing_gantry")
    soft = {"ground": library()["GroundCompliance"](compliance=1e-5)}
    model = replace(scenario.believed, effects=scenario.believed.effects | soft)
    hard, soft = (Predictor(s, log).residual for s in (scenario, replace(scenario, model=model)))
    np.testing.assert_array_equal(soft.value, hard.value)
    np.testing.assert_array_equal(soft.variance, hard.variance)


def test_more_noise_of_the_feet_than_is_believed_is_measured_and_no_structure(
    walk: tuple[Scenario, Log],
) -> None:
    scenario, log = walk
    random, deviation = np.random.default_rng(1), scenario.sensors.foot_force.noise
    names = [f"foot/{side}/pad_force" for side in ("left", "right")]
    # Twice the noise that is in the log.
    forces = {
        n: log[n] + np.sqrt(3) * deviation * random.standard_normal(log[n].shape) for n in names
    }
    noisier = replace(log, channels=log.channels | forces)
    predictor = Predictor(scenario, noisier)
    residual, motion = predictor.residual, predictor.motion
    (finding,) = (f for f in inspect(motion, predictor.noise).findings if f.kind == "noise_level")
    assert finding.where == tuple(names)
    assert finding.size == pytest.approx(2.0, rel=0.1)
    white = WhitenedResidual(residual)
    assert not leftover_structure(motion, white, white.y)


def rows_told(predictor: Predictor, left: np.ndarray) -> list[int]:
    """Rows in which structure is found, if this is left, (B, R)."""
    white = WhitenedResidual(predictor.residual)
    left = np.where(white.residual.known, left, 0.0)
    return [structure.index for structure in leftover_structure(predictor.motion, white, left)]


def test_structure_tells_of_what_comes_later(
    walk: tuple[Scenario, Log],
) -> None:
    """Of as much beyond the sensors' noise, white or of a single impact, nothing is said: it is the
    noise of impacts, or of what happens between rare samples. Nor where more noise is white, or
    more of it differenced, than was believed, for then only neighbours are correlated."""
    predictor = Predictor(*walk)
    rows = [k for k, row in enumerate(predictor.residual.rows) if row.kind != "kinematic"]
    noise = np.random.default_rng(2).standard_normal(predictor.residual.known.shape)
    impact = noise.copy()
    impact[len(impact) // 2] += 30.0
    drifting = lfilter([np.sqrt(1 - 0.8**2)], [1.0, -0.8], noise, axis=0)

    def found(left: np.ndarray) -> int:
        return sum(row in rows for row in rows_told(predictor, left))

    assert EXCESS < 1.5 < np.sqrt((impact**2).mean(axis=0)).min()
    assert found(noise) == found(1.5 * noise) == found(impact) == 0
    for share in (0.25, -0.25):
        mixture = lfilter([1.0, share], [1.0], noise, axis=0)
        assert found(1.5 * mixture) == 0
    assert found(drifting) < found(1.5 * drifting) == len(rows)


def test_a_robot_that_stands_on_no_feet_has_no_impacts(walk: tuple[Scenario, Log]) -> None:
    """Hits that are few, and last for some averages, tell of a gap in a gear where no foot lands;
    a single one, as of somebody who touches the arm, is noise in both."""
    arm = load_scenario("bsc_arm", overrides=["duration=3"])
    for scenario, log, tells in ((*walk, 0), (believed(arm), simulate(arm).log, 6)):
        predictor = Predictor(scenario, log)
        noise = np.random.default_rng(3).standard_normal(predictor.residual.known.shape)
        joints, block = range(len(predictor.robot.joint_names)), np.arange(len(noise))[:, None]
        lasting, single = np.isin(block % 150, [70, 71, 72, 73]), block == 150
        assert sum(row in joints for row in rows_told(predictor, noise + 20.0 * lasting)) == tells
        assert not any(row in joints for row in rows_told(predictor, noise + 20.0 * single))


def test_residual_of_a_model_without_friction_is_the_friction(walk: tuple[Scenario, Log]) -> None:
    scenario, _ = walk
    scenario = replace(scenario, sensors=type(scenario.sensors)(), duration=1.5)
    log = simulate(scenario).log
    residual = Predictor(replace(scenario, model=None), log).residual
    friction = block_means(log["truth/joint/friction_torque"][:-1], 10)
    n = friction.shape[1]
    # What is left is the contact solver's tolerance.
    assert np.abs(residual.value[:, :n] - friction).max() < 1e-2
    # No joint effect appears in the base rows, where the robot's weight is 850 N.
    assert np.abs(residual.value[:, n : n + 6]).max() < 0.2


def test_soles_give_way_as_the_contact_says(walk: tuple[Scenario, Log]) -> None:
    """Without noise next to nothing is left of what a standing sole turns and sinks."""
    scenario, _ = walk
    scenario = replace(scenario, sensors=type(scenario.sensors)(), duration=3.0)
    predictor = Predictor(scenario, simulate(scenario).log)
    before, after = predictor.motion.residual, predictor.residual
    largest = {"angular_velocity_x": 0.01, "angular_velocity_y": 0.01, "specific_force_z": 0.05}
    for foot in predictor.robot.description.sides:
        for name, share in largest.items():
            row = after.row_index[f"{foot}_sole/{name}"]
            assert (
                rms(after.value, after.known)[row] < share * rms(before.value, before.known)[row]
            ), name


def test_joints_that_cancel_each_other_keep_a_standing_sole_level(
    walk: tuple[Scenario, Log],
) -> None:
    """All joints together turn it as the trunk does not; single ones turn it far more."""
    scenario, _ = walk
    scenario = replace(scenario, sensors=type(scenario.sensors)(), duration=0.4)
    predictor = Predictor(scenario, simulate(scenario).log)
    motion = predictor.motion
    shares = motion.equation.joint_shares(motion.blocks)[..., :3, :]
    trunk = np.linalg.norm(motion.blocks.angular_velocity, axis=1)
    for foot, side in enumerate(predictor.robot.description.sides):
        first = motion.residual.row_index[f"{side}_sole/angular_velocity_x"]
        turned = motion.residual.value[:, first : first + 3] - shares[foot].sum(axis=2)
        np.testing.assert_allclose(np.linalg.norm(turned, axis=1), trunk, atol=1e-4)
    assert (shares[0] ** 2).sum(axis=(1, 2)).mean() > 25 * (trunk**2).mean()


def test_a_force_at_the_end_of_the_range_is_not_known(walk: tuple[Scenario, Log]) -> None:
    scenario, log = walk
    force = log["foot/left/pad_force"].copy()
    force[1234, 2, 2] = scenario.sensors.foot_force.range
    clipped = Predictor(scenario, changed(log, foot__left__pad_force=force)).residual
    assert np.flatnonzero(~clipped.known[:, 0]).tolist() == [123]
    force[1234, 2, 2] -= 1.0
    assert Predictor(scenario, changed(log, foot__left__pad_force=force)).residual.known[:, 0].all()


def test_gaps_are_left_out_and_touch_nothing_else(
    walk: tuple[Scenario, Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario, log = walk
    intact = Predictor(scenario, log)
    whole = intact.residual
    # The one thing that is found from the log as a whole.
    step = intact.motion.timing.integration
    monkeypatch.setattr(
        "fbse_drake.discrepancy.residual.recorded_motion.integration_step", lambda *_: step
    )
    keep = np.ones(len(log.time), dtype=bool)
    keep[1234:1240] = False
    torn = Predictor(
        scenario,
        replace(log, channels={name: values[keep] for name, values in log.channels.items()}),
    ).residual
    lost = np.flatnonzero(~torn.known[:, 0])
    assert lost.tolist() == [123]
    others = np.delete(np.arange(len(whole.time)), [122, 123, 124])
    np.testing.assert_allclose(torn.value[others, :18], whole.value[others, :18], atol=1e-9)


def test_a_sole_rests_only_while_its_foot_stands_before_and_after(
    walk: tuple[Scenario, Log],
) -> None:
    """Right after touch-down and right before lift-off a foot may roll over an edge."""
    motion = Predictor(*walk).motion
    rows = [row.name for row in motion.residual.rows]
    for foot, side in enumerate(motion.robot.description.sides):
        known = motion.known[:, rows.index(f"{side}_sole/specific_force_z")]
        assert 0.2 < known.mean() < motion.standing[:, foot].mean()
        for block in np.flatnonzero(known):
            around = abs(motion.time - motion.time[block]) < 0.031
            assert motion.standing[around, foot].all()


def test_a_long_log_is_computed_piece_by_piece(
    walk: tuple[Scenario, Log], monkeypatch: pytest.MonkeyPatch
) -> None:
    motion = Predictor(*walk).motion
    whole = motion.equation.residual(motion.steps)
    monkeypatch.setattr("fbse_drake.discrepancy.residual.equation_of_motion._MOST_INSTANTS", 700)
    np.testing.assert_array_equal(motion.equation.residual(motion.steps), whole)


def test_whitening_makes_differenced_noise_white() -> None:
    rng = np.random.default_rng(1)
    blocks, white, differenced = 4000, 0.3, 2.0
    integral = rng.normal(scale=differenced, size=blocks + 1)
    y = rng.normal(scale=white, size=blocks) + np.diff(integral)
    one = np.ones((blocks, 1))
    residual = Residual(
        [Row("joint", "joint", "Nm")],
        0.01 * np.arange(blocks),
        y[:, None],
        one > 0,
        (white**2 + 2 * differenced**2) * one,
        -(differenced**2) * one,
        one > 0,
        signals=None,
    )
    result = WhitenedResidual(residual)
    assert (result.y**2).mean() == pytest.approx(1.0, abs=0.1)
    assert np.abs((result.y[1:] * result.y[:-1]).mean()) < 0.07


def test_intervals_cover_the_truth_also_where_errors_are_correlated() -> None:
    rng = np.random.default_rng(2)
    blocks, runs, covered, naive = 1000, 200, 0, 0
    time = 0.01 * np.arange(blocks)
    one = np.ones((blocks, 1))
    column = np.sin(2 * np.pi * time / 1.5)
    for _ in range(runs):
        # Beside the white noise, an error that lasts for a fifth of a second.
        lasting = np.repeat(rng.normal(size=blocks // 20), 20)
        y = 0.7 * column + rng.normal(size=blocks) + lasting
        residual = Residual(
            [Row("joint", "joint", "Nm")],
            time,
            y[:, None],
            one > 0,
            one,
            0 * one,
            one > 0,
            signals=None,
        )
        white = WhitenedResidual(residual)
        fit = Regression(white).fit(
            [white.whiten_signature(Signature(np.array([0]), column[:, None, None]))]
        )
        low, high = fit.interval()[0]
        covered += low < 0.7 < high
        naive += abs(fit.parameters[0] - 0.7) < 1.96 * np.sqrt(2.0 / (column**2).sum())
    assert naive < 0.75 * runs, "the errors are not correlated enough for this test"
    assert 0.88 * runs <= covered <= 0.99 * runs


def test_a_column_of_noise_explains_nothing_on_held_out_data() -> None:
    rng = np.random.default_rng(3)
    blocks = 1000
    one = np.ones((blocks, 1))
    residual = Residual(
        [Row("joint", "joint", "Nm")],
        0.01 * np.arange(blocks),
        rng.normal(size=(blocks, 1)),
        one > 0,
        one,
        0 * one,
        one > 0,
        signals=None,
    )
    white = WhitenedResidual(residual)
    fit = Regression(white).fit([Signature(np.array([0]), rng.normal(size=(blocks, 1, 20)))])
    assert fit.sse[0] < white.sse[0] < fit.held_out_sse[0]


@pytest.mark.parametrize(
    ("channel", "change", "words"),
    [
        ("imu__linear_acceleration", lambda x: x - [0, 0, 9.81], "gravity is missing"),
        ("imu__linear_acceleration", lambda x: -x, "sign is reversed"),
        ("imu__linear_acceleration", lambda x: x[:, [2, 1, 0]], "frame is wrong"),
        ("imu__linear_acceleration", lambda x: x / 9.81, "gravity is missing"),
        (
            "foot__left__pad_force",
            lambda x: -x,
            "foot/left: this foot pulls at the ground.*sign is reversed",
        ),
        ("joint__torque_command", lambda x: -x, "sign is reversed"),
        ("joint__torque_command", lambda x: 1000 * x, "unit is wrong"),
        ("joint__position", np.rad2deg, "degrees"),
        ("joint__velocity", lambda x: -x, "sign is reversed"),
        ("joint__velocity", np.rad2deg, "degrees per second"),
    ],
)
def test_a_log_that_does_not_fit_is_said_in_one_line(
    walk: tuple[Scenario, Log], channel: str, change: object, words: str
) -> None:
    scenario, log = walk
    wrong = changed(log, **{channel: change(log[channel.replace("__", "/")])})
    with pytest.raises(InputError, match=words) as error:
        check_sensors(Predictor(scenario, wrong).motion)
    assert "\n" not in str(error.value)
    assert channel.replace("__", "/").split("/")[0] in str(error.value)


def test_a_log_that_tells_nothing_is_said_in_one_line() -> None:
    scenario = load_scenario("leg_swing_gantry", overrides=["duration=1"])
    log = simulate(scenario).log
    silent = replace(
        log,
        channels={
            name: values for name, values in log.channels.items() if name != "joint/torque_command"
        },
    )
    with pytest.raises(
        InputError, match=r"nothing to compare a model with, joint/torque_command is missing"
    ):
        _ = Predictor(scenario, silent).residual
    recording = replace(scenario.recording, unused_rows=["*"])
    with pytest.raises(InputError, match="nothing to compare a model with"):
        _ = Predictor(replace(scenario, recording=recording), log).residual


def test_feet_read_upside_down_or_sideways(walk: tuple[Scenario, Log]) -> None:
    scenario, log = walk
    feet = [f"foot__{side}__pad_force" for side in log.sides]
    for change, words in (
        (lambda x: -x, "sign is reversed"),
        (lambda x: x[:, :, [2, 1, 0]], "frame is wrong"),
    ):
        wrong = changed(log, **{name: change(log[name.replace("__", "/")]) for name in feet})
        with pytest.raises(InputError, match=words):
            check_sensors(Predictor(scenario, wrong).motion)


def test_a_good_log_passes_and_a_missing_channel_is_named(walk: tuple[Scenario, Log]) -> None:
    scenario, log = walk
    check_sensors(Predictor(scenario, log).motion)
    for name in ("imu/angular_velocity", "foot/right/pad_force"):
        with pytest.raises(InputError, match=name):
            Predictor(
                scenario,
                replace(log, channels={k: v for k, v in log.channels.items() if k != name}),
            )


def test_the_larger_noise_of_two_models_is_at_least_that_of_both(
    walk: tuple[Scenario, Log],
) -> None:
    """As matrices, row by row: noise that is differenced moves together from block to block, and
    what is larger here may be smaller there."""
    one = Predictor(*walk).residual
    rng = np.random.default_rng(4)
    more = 10.0 ** rng.uniform(-1, 1, one.variance.shape[1])
    doubt = one.variance * rng.uniform(0, 1, one.variance.shape)
    other = replace(
        one, variance=more * one.variance + doubt, covariance=more * one.covariance, doubt=doubt
    )
    both = one.by_larger_noise(other)
    assert both.by_larger_noise(one).variance == pytest.approx(both.variance)

    def matrix(residual: Residual, row: int) -> np.ndarray:
        beside = np.diag(residual.covariance[:-1, row], 1)
        return np.diag(residual.variance[:, row]) + beside + beside.T

    for row in kinds(one, "joint")[:3] + kinds(one, "base")[:3]:
        larger = max(one, other, key=lambda residual: residual.noise_floor[row])
        least = np.linalg.eigvalsh(matrix(both, row) - matrix(larger, row)).min()
        assert least > -1e-12 * both.variance[:, row].max()
        assert np.all(both.variance[:, row] >= one.variance[:, row])
