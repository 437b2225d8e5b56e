"""Inertial parameters from motion: what a log shows, and values that a body can have. Truth: closed
forms of a planar two-link arm."""

import dataclasses
import re
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import MultibodyForces
from recorded_arm import PENDULUM
from scipy.signal import butter, sosfiltfilt

from fbse_drake import InputError, Log, Scenario, load_scenario
from fbse_drake.discrepancy.diagnosis.add import add
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.identify import Identification, identification_json, identify
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.study import model_error, study
from fbse_drake.discrepancy.identification.inertial import (
    PARAMETERS,
    base_columns,
    body_wrench,
    consistent_parameters,
    inertial_regressor,
)
from fbse_drake.discrepancy.residual.equation_of_motion import EquationOfMotion
from fbse_drake.discrepancy.residual.recorded_signals import Instants
from fbse_drake.effects.effect import library
from fbse_drake.effects.friction import CoulombFriction
from fbse_drake.effects.inertia import (
    InertialParameters,
    equal_point_masses,
    inertial_parameters,
    pseudo_inertia,
)
from fbse_drake.progress import Interrupted
from fbse_drake.report.identification import write_identification_report
from fbse_drake.report.identification_figures import combinations, errors_by_joint
from fbse_drake.report.sentences import Inputs
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import IdentifyConfig, RecordingConfig, RobotConfig, build_robot

G, LENGTH, PERIOD = 9.81, 0.4, 0.005
BODIES = ("upper", "lower")
# Mass, centre of mass in the plane, and rotational inertia about the centre of mass of each link:
# as believed, and as they are.
BELIEVED = {"upper": (4.0, 0.20, 0.0, 0.06), "lower": (2.5, 0.15, 0.0, 0.03)}
TRUE = {"upper": (5.0, 0.17, 0.03, 0.09), "lower": (1.8, 0.22, -0.02, 0.02)}
COULOMB, VISCOUS = np.array([1.5, 0.8]), np.array([0.6, 0.9])
# Noise of the torque of each joint [Nm].
NOISE = 0.05


def urdf(links: dict[str, tuple[float, float, float, float]]) -> str:
    """Two links in the x-z plane; a positive angle lifts x towards z."""
    bodies = "".join(
        f'<link name="{name}"><inertial><origin xyz="{x} 0 {z}"/><mass value="{m}"/>'
        f'<inertia ixx="{i}" iyy="{i}" izz="{i}" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name, (m, x, z, i) in links.items()
    )
    joints = "".join(
        f'<joint name="{joint}" type="revolute"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{x} 0 0"/>'
        '<axis xyz="0 -1 0"/><limit lower="-9" upper="9" effort="99" velocity="99"/></joint>'
        for joint, parent, child, x in (
            ("shoulder", "stand", "upper", 0.0),
            ("elbow", "upper", "lower", LENGTH),
        )
    )
    return f'<robot name="arm"><link name="stand"/>{bodies}{joints}</robot>'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("arm")
    for name, links in (("believed", BELIEVED), ("true", TRUE)):
        (folder / f"{name}.urdf").write_text(urdf(links))
        description = {
            "urdf": f"{name}.urdf",
            "base": "stand",
            "fixed_base": True,
            "joints": ["shoulder", "elbow"],
        }
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(description))
    return folder


def scenario(folder: Path, **recording: object) -> Scenario:
    """Believes in the wrong links and in no friction."""
    believed = RobotConfig(str(folder / "believed.yaml"))
    reading = RecordingConfig(
        **({"rows": "instantaneous", "block": 0.05, "torque_noise": {"all": NOISE}} | recording)
    )
    return Scenario(
        robot=believed, model=believed, recording=reading, identify=IdentifyConfig(["all"])
    )


@cache
def motion(duration: float = 16.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Time (N,), angles, velocities and accelerations (N, 2) of an exciting motion."""
    t = np.arange(round(duration / PERIOD)) * PERIOD
    waves = [
        [(0.9, 2.1, 0.0), (0.5, 4.7, 1.0), (0.2, 9.1, 2.0)],
        [(1.1, 2.9, 0.5), (0.6, 5.3, 2.0), (0.2, 8.3, 0.3)],
    ]
    q, v, a = (
        np.stack(
            [
                sum(size * w**k * np.sin(w * t + p + k * np.pi / 2) for size, w, p in joint)
                for joint in waves
            ],
            axis=1,
        )
        for k in range(3)
    )
    return t, q, v, a


def planar(links: dict[str, tuple[float, float, float, float]]) -> np.ndarray:
    """The six combinations that a planar arm shows: mx1 + m2 l, mz1, I1 + m2 l^2, mx2, mz2, I2,
    about the joints."""
    (m1, x1, z1, i1), (m2, x2, z2, i2) = links.values()
    first = [m1 * x1 + m2 * LENGTH, m1 * z1, i1 + m1 * (x1**2 + z1**2) + m2 * LENGTH**2]
    return np.array([*first, m2 * x2, m2 * z2, i2 + m2 * (x2**2 + z2**2)])


def torque(combinations: np.ndarray, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Lagrange's equations of the arm, (N, 2) [Nm]."""
    X1, Z1, J1, X2, Z2, J2 = combinations
    (q1, q2), (v1, v2), (a1, a2) = q.T, v.T, a.T
    along, across = X2 * np.cos(q2) - Z2 * np.sin(q2), X2 * np.sin(q2) + Z2 * np.cos(q2)
    lower = G * (X2 * np.cos(q1 + q2) - Z2 * np.sin(q1 + q2)) + J2 * (a1 + a2)
    shoulder = J1 * a1 + lower + G * (X1 * np.cos(q1) - Z1 * np.sin(q1))
    shoulder += LENGTH * (along * (2 * a1 + a2) - across * v2 * (2 * v1 + v2))
    return np.stack([shoulder, lower + LENGTH * (along * a1 + across * v1**2)], axis=1)


def recording(
    *, friction: bool = True, cutoff: float = 0.0, bias: float = 0.0, duration: float = 16.0
) -> Log:
    """What a robot with the true links records."""
    t, q, v, a = motion(duration)
    tau = torque(planar(TRUE), q, v, a) + bias
    if friction:
        tau += COULOMB * np.tanh(v / 0.01) + VISCOUS * v
    tau += NOISE * np.random.default_rng(3).standard_normal(tau.shape)
    if cutoff:
        tau = sosfiltfilt(butter(4, cutoff, fs=1 / PERIOD, output="sos"), tau, axis=0)
    channels = {"time": t, "joint/position": q, "joint/velocity": v, "joint/torque_command": tau}
    return Log(
        channels,
        {"joints": ["shoulder", "elbow"], "sides": [], "period": PERIOD, "source": "closed form"},
    )


@pytest.fixture(scope="module")
def identified(folder: Path) -> Identification:
    log = recording()
    half = len(log.time) // 2
    return identify(
        scenario(folder), log.part(slice(0, half)), {"rest": log.part(slice(half, None))}
    )


def test_base_parameters_are_those_of_the_closed_form(identified: Identification) -> None:
    base = identified.inertia.base_parameters
    assert [(b.body, b.parameter) for b in base] == [
        (body, name) for body in BODIES for name in ("mx", "mz", "iyy")
    ]
    assert base[0].others == pytest.approx({("lower", "mass"): LENGTH}, rel=1e-3)
    assert base[2].others == pytest.approx({("lower", "mass"): LENGTH**2}, rel=1e-3)
    assert [b.model for b in base] == pytest.approx(planar(BELIEVED), abs=1e-3)
    assert all(b.identified for b in base)


def test_true_combinations_and_friction_lie_in_their_intervals(identified: Identification) -> None:
    for base, truth in zip(identified.inertia.base_parameters, planar(TRUE), strict=True):
        assert base.interval[0] <= truth <= base.interval[1], base.text
        assert base.value == pytest.approx(truth, rel=0.02, abs=2e-3)
    friction = {
        f.targets[0]: f.parameters
        for f in identified.findings
        if f.effect == "CoulombViscousFriction"
    }
    for joint, coulomb, viscous in zip(("shoulder", "elbow"), COULOMB, VISCOUS, strict=True):
        assert friction[joint]["coulomb"].value == pytest.approx(coulomb, rel=0.03)
        assert friction[joint]["viscous"].value == pytest.approx(viscous, rel=0.05)


def test_the_completed_model_predicts_what_was_not_fitted(identified: Identification) -> None:
    """Down to the noise of the torque, averaged over a block, and the friction's jumps within
    one."""
    assert identified.before["rest"].relative > 0.2
    assert identified.after["rest"].relative < 0.01
    assert max(identified.after["rest"].rms.values()) < 3 * NOISE / np.sqrt(10)


def test_what_the_plane_does_not_show_stays_with_the_model(identified: Identification) -> None:
    inertia = identified.inertia
    assert inertia.uncertainty.shape == (2, 10)
    # What leans out of the plane moves nothing, and has nothing to do with what does.
    for name in ("my", "ixy", "iyz"):
        assert inertia.uncertainty[:, PARAMETERS.index(name)].min() > 0.999, name
        assert np.abs(inertia.change[:, PARAMETERS.index(name)]).max() < 1e-6
    # Masses are seen only with moments, and inertia about the other axes only as far as all belong
    # to one distribution of mass.
    for name in ("mass", "ixx", "izz", "ixz"):
        assert inertia.uncertainty[:, PARAMETERS.index(name)].min() > 0.1, name
    assert not inertia.at_the_edge


def test_identified_bodies_are_physical_and_the_scenario_holds_them(
    identified: Identification,
) -> None:
    inertia = identified.inertia
    assert np.linalg.eigvalsh(pseudo_inertia(inertia.model + inertia.change)).min() > 0
    effects = identified.scenario.believed.effects
    changes = next(e for e in effects.values() if isinstance(e, InertialParameters))
    assert changes.mass == pytest.approx(dict(zip(BODIES, inertia.change[:, 0], strict=True)))
    content = identification_json(identified)
    assert content["identifiability"]["combinations"] == 6
    assert content["bodies"]["lower"]["mass"]["model"] == BELIEVED["lower"][0]


def test_pictures_show_what_the_tables_say(identified: Identification) -> None:
    """Where an interval drawn does not reach the model's mark, the log contradicts the model."""
    found = identified.inertia.base_parameters
    shown: dict[str, object] = {}
    for axes in combinations(identified).axes:
        names = [label.get_text() for label in axes.get_yticklabels()]
        marks = {line.get_label(): line.get_xdata() for line in axes.lines}
        shown |= dict(zip(names, marks["model"], strict=True))
        for name, line in zip(names, axes.collections, strict=True):
            shown[name] = (shown[name], tuple(line.get_segments()[0][:, 0]))
    assert shown == {base.short: (base.model, base.interval) for base in found}
    panels = errors_by_joint(identified).axes
    assert [axes.get_title("left") for axes in panels] == ["train", "rest"]
    for axes, (name, after) in zip(panels, identified.after.items(), strict=True):
        before, last = axes.lines[0].get_xdata(), axes.lines[1].get_xdata()
        assert last == pytest.approx(
            [100 * after.relative, *(100 * s for s in after.relative_by_joint.values())]
        )
        assert before[0] == pytest.approx(100 * identified.before[name].relative)
        assert axes.lines[1].get_label() == "identified"
    # Of no torque nothing is a share.
    silent = dataclasses.replace(identified.after["train"], relative=np.inf)
    drawn = errors_by_joint(dataclasses.replace(identified, after={"train": silent}))
    assert np.isfinite(drawn.axes[0].get_xlim()).all()


def test_bodies_at_the_edge_of_what_is_physical(folder: Path) -> None:
    """Torques of a lower link with a moment but next to no inertia: least squares alone gives a
    body that cannot be."""
    impossible = {**TRUE, "lower": (1.8, 0.22, 0.0, 0.02 - 1.8 * 0.22**2)}
    _, q, v, a = motion()
    log = recording()
    channels = {name: log[name] for name in log} | {
        "joint/torque_command": torque(planar(impossible), q, v, a)
    }
    log = Log(channels, log.meta)
    result = identify(scenario(folder), log)
    assert "lower" in result.inertia.at_the_edge
    J = pseudo_inertia(result.inertia.model + result.inertia.change)
    assert np.linalg.eigvalsh(J).min() > 0
    build_robot(result.scenario.believed)


def test_consistent_parameters_against_a_closed_form() -> None:
    """One body, of which only the mass is seen, and wrong by more than it has: the least mass that
    is allowed. And one that is inside."""
    own = np.eye(4)[None]
    X = np.zeros((1, 11))
    # The last coordinate is the lower right element of Z.
    X[0, 10] = 100.0
    prior = np.concatenate([[1.0], np.full(10, 1e-2)])
    _, z = consistent_parameters(X, np.array([-300.0]), prior, np.array([-np.inf]), own)
    assert z[9] == pytest.approx(-1.0, abs=2e-3)
    _, z = consistent_parameters(X, np.array([50.0]), prior, np.array([-np.inf]), own)
    assert z == pytest.approx(np.array([*np.zeros(9), 0.5]), abs=1e-3)


@pytest.mark.parametrize("lowest", [0.0, -3.0, -1e3, -1e6])
def test_bounds_of_consistent_parameters_hold_and_do_nothing_where_they_are_far(
    lowest: float,
) -> None:
    random = np.random.default_rng(0)
    X = random.standard_normal((2000, 12)) * np.array([30.0, 30.0, *np.full(10, 3.0)])
    own, prior = 0.1 * np.eye(4)[None], np.full(12, 1e-4)
    y = X @ np.array([2.0, -2.5, *np.zeros(10)]) + random.standard_normal(2000)
    found, _ = consistent_parameters(X, y, prior, np.full(2, lowest), own)
    if lowest < -2.5:
        assert found == pytest.approx([2.0, -2.5], abs=5e-3)
    else:
        # Above its bound by no more than the solver's tolerance.
        assert found[1] == pytest.approx(lowest, abs=1e-4)


def test_base_columns_say_what_the_others_are() -> None:
    W = np.random.default_rng(0).standard_normal((50, 3)) * 100
    W = np.column_stack([W[:, 0], W[:, 1], 2 * W[:, 0] - W[:, 1], 1e-6 * W[:, 2], W[:, 2]])
    kept, factors = base_columns(W, np.ones(5))
    assert kept == [0, 1, 4]
    assert factors == pytest.approx(
        np.array([[1, 0, 2, 0, 0], [0, 1, -1, 0, 0], [0, 0, 0, 1e-6, 1]]), abs=1e-9
    )


def test_an_inertia_effect_makes_the_body_that_another_file_describes(folder: Path) -> None:
    """Drake's inverse dynamics of a URDF with the true links, and of the believed ones with the
    changes."""
    changes = {name: {} for name in PARAMETERS}
    robots = [make_robot(str(folder / f"{name}.yaml"))[0] for name in ("believed", "true")]
    for body in BODIES:
        old, new = (
            inertial_parameters(robot.body(body).default_spatial_inertia()) for robot in robots
        )
        for name, value in zip(PARAMETERS, new - old, strict=True):
            changes[name][body] = float(value)
    changed = build_robot(
        RobotConfig(
            str(folder / "believed.yaml"), effects={"inertia": InertialParameters(**changes)}
        )
    )
    assert _inverse_dynamics(changed.plant) == pytest.approx(
        _inverse_dynamics(robots[1].plant), abs=1e-9
    )
    assert _inverse_dynamics(changed.plant) != pytest.approx(
        _inverse_dynamics(robots[0].plant), abs=0.1
    )


def _inverse_dynamics(plant: MultibodyPlant) -> np.ndarray:
    context, forces = plant.CreateDefaultContext(), MultibodyForces(plant)
    plant.SetPositionsAndVelocities(context, [0.4, -1.1, 2.0, -3.0])
    plant.CalcForceElementsContribution(context, forces)
    return plant.CalcInverseDynamics(context, np.array([5.0, -7.0]), forces)


def test_an_impossible_body_is_refused_in_one_line(folder: Path) -> None:
    config = RobotConfig(
        str(folder / "believed.yaml"), effects={"inertia": InertialParameters(iyy={"lower": -0.2})}
    )
    with pytest.raises(
        InputError, match=r"effects\.inertia: lower: expected the inertia of a body"
    ):
        build_robot(config)
    with pytest.raises(InputError, match=r"identify\.inertia"):
        identify(
            dataclasses.replace(scenario(folder), identify=IdentifyConfig()),
            recording(duration=2.0),
        )
    with pytest.raises(InputError, match="hand: the model has no body"):
        identify(
            dataclasses.replace(scenario(folder), identify=IdentifyConfig(["hand"])),
            recording(duration=2.0),
        )


def test_four_point_masses_have_any_inertia() -> None:
    random = np.random.default_rng(1)
    L = np.tril(random.uniform(0.1, 1.0, (4, 4)))
    masses = equal_point_masses(L @ L.T, "body")
    points = [(mass, np.append(place, 1.0)) for mass, place in masses]
    assert sum(mass * np.outer(p, p) for mass, p in points) == pytest.approx(L @ L.T, abs=1e-12)
    assert len({mass for mass, _ in masses}) == 1


def test_wrench_of_a_spinning_dumbbell() -> None:
    """Two equal masses at +-r on x that spin about z: no force, no moment; turning faster needs 2 m
    r^2 alpha, lifting 2 m a."""
    m, r, spin = 1.5, 0.3, 4.0
    phi = np.zeros(10)
    phi[[PARAMETERS.index(n) for n in ("mass", "iyy", "izz")]] = 2 * m, 2 * m * r**2, 2 * m * r**2
    w, alpha, a = (
        np.array([[0.0, 0.0, spin]]),
        np.array([[0.0, 0.0, 2.0]]),
        np.array([[0.0, 0.0, 9.81]]),
    )
    assert body_wrench(w, alpha, a)[0] @ phi == pytest.approx(
        [0, 0, 2 * m * r**2 * 2.0, 0, 0, 2 * m * 9.81]
    )
    # About an axis between, the dumbbell wants to stand across: w x I w.
    tilted = np.array([[spin, spin, 0.0]])
    assert (body_wrench(tilted, 0 * alpha, 0 * a)[0] @ phi)[:3] == pytest.approx(
        [0, 0, 2 * m * r**2 * spin**2]
    )


def test_columns_of_a_floating_robot_are_what_changing_the_model_does() -> None:
    """All rows of the biped, base rows too: the residual's change with the inertia effect, which
    goes through Drake's inverse dynamics."""
    random = np.random.default_rng(4)
    bare = build_robot(RobotConfig("biped"))
    n, body = len(bare.joint_names), "trunk"
    equation = EquationOfMotion(bare)
    vectors = (random.standard_normal((5, k)) for k in (n, n, n, 3, 3, 3))
    at = Instants(
        *vectors, np.zeros((5, len(equation.pads.foot), 3)), np.zeros((5, n)), np.zeros((5, 0))
    )
    delta = random.uniform(-1e-3, 1e-3, 10)
    effect = InertialParameters.from_values(
        [body], dict(zip(PARAMETERS, delta[:, None], strict=True))
    )
    changed = EquationOfMotion(build_robot(RobotConfig("biped", effects={"change": effect})))
    expected = equation.residual(at, kinematic=False) - changed.residual(at, kinematic=False)
    assert inertial_regressor(equation, at, body) @ delta == pytest.approx(expected, abs=1e-9)
    assert np.abs(expected).max() > 1e-3


FRICTION = ("CoulombFriction", "ViscousFriction", "CoulombViscousFriction", "LoadDependentFriction")
EFFECTS = (*FRICTION, "TorqueBias", "TorqueGain", "JointSpring")


@pytest.fixture(scope="module")
def diagnosis(folder: Path) -> Diagnosis:
    return diagnose(Predictor(scenario(folder), recording()), [library()[name] for name in EFFECTS])


def test_friction_is_found_beside_inertia_that_is_not_trusted(
    folder: Path, diagnosis: Diagnosis
) -> None:
    assert diagnosis.verdict == "effect_found"
    friction = [f for f in diagnosis.chosen if f.effect != "InertialParameters"]
    assert {(f.effect, f.targets) for f in friction} == {
        ("CoulombViscousFriction", (joint,)) for joint in ("shoulder", "elbow")
    }
    for f, coulomb in zip(
        sorted(friction, key=lambda f: f.targets, reverse=True), COULOMB, strict=True
    ):
        low, high = f.parameters["coulomb"].interval
        assert low <= coulomb <= high
    completed = add(scenario(folder), diagnosis.chosen)
    assert model_error(Predictor(completed, recording())).relative < 0.01
    assert diagnosis.held_out_before > 10 * diagnosis.held_out_after


def test_friction_that_is_trusted_away_is_not_named(folder: Path) -> None:
    """A robot without friction, whose inertia is wrong: inertia alone explains it, and nothing else
    is named."""
    result = diagnose(
        Predictor(scenario(folder), recording(friction=False)),
        [library()[name] for name in EFFECTS],
    )
    assert {f.effect for f in result.chosen} == {"InertialParameters"}
    assert result.held_out_after < 1.2


def test_load_dependent_friction_is_told_from_torque_that_explains_itself(folder: Path) -> None:
    """Friction of 12 % of the load in the shoulder. A share of the measured torque near 1 would
    explain any log, inertia being free."""
    _, q, v, a = motion()
    sign = np.tanh(v / 0.01)
    tau = torque(planar(TRUE), q, v, a) + COULOMB * sign + VISCOUS * v
    # What the motor needs so that this is left when a share of it is lost.
    tau[:, 0] /= 1 - 0.12 * sign[:, 0] * np.sign(tau[:, 0])
    tau += NOISE * np.random.default_rng(5).standard_normal(tau.shape)
    log = recording()
    log = Log({name: log[name] for name in log} | {"joint/torque_command": tau}, log.meta)
    result = diagnose(Predictor(scenario(folder), log), [library()[name] for name in EFFECTS])
    found = {(f.effect, f.targets): f.parameters for f in result.chosen}
    assert found["LoadDependentFriction", ("shoulder",)]["coefficient"].value == pytest.approx(
        0.12, abs=0.02
    )
    assert {effect for effect, _ in found} <= {*FRICTION, "InertialParameters"}
    assert model_error(Predictor(add(scenario(folder), result.chosen), log)).relative < 0.015


def test_inertia_that_is_as_believed_is_no_finding(folder: Path) -> None:
    """Bodies are not trusted, but right: what is named is the friction alone."""
    right = RobotConfig(str(folder / "true.yaml"))
    doubting = dataclasses.replace(scenario(folder), robot=right, model=right)
    result = diagnose(Predictor(doubting, recording()), [library()[name] for name in EFFECTS])
    assert result.inertia is None
    assert {f.effect for f in result.chosen} <= set(FRICTION)
    assert {joint for f in result.chosen for joint in f.targets} == {"shoulder", "elbow"}
    assert result.held_out_after < 1.2


def test_inertia_that_is_trusted_stays(folder: Path) -> None:
    trusting = dataclasses.replace(scenario(folder), identify=IdentifyConfig())
    result = diagnose(Predictor(trusting, recording()), [library()[name] for name in EFFECTS])
    assert result.inertia is None
    assert "InertialParameters" not in {f.effect for f in result.ranking}


def test_a_study_ends_with_one_change_of_inertia(folder: Path) -> None:
    result = study(
        scenario(folder), recording(), [library()[name] for name in EFFECTS], rollouts=False
    )
    changes = [
        e for e in result.scenario.believed.effects.values() if isinstance(e, InertialParameters)
    ]
    assert len(changes) == 1
    assert result.steps[-1].held_out_rmse < 0.01 * result.steps[0].held_out_rmse


def test_a_study_that_is_stopped_at_inertia_keeps_what_it_knows(folder: Path) -> None:
    def stop_at_inertia(what: str, share: float | None = None) -> None:  # noqa: ARG001
        if what == "predicting what each parameter would do":
            raise Interrupted("the time limit was reached")

    effects = [library()["CoulombViscousFriction"]]
    result = study(scenario(folder), recording(), effects, rollouts=False, progress=stop_at_inertia)
    assert result.partial
    assert result.stopped_because == "the time limit was reached"
    assert result.steps[-1].held_out_rmse < 0.1 * result.steps[0].held_out_rmse


@pytest.mark.usefixtures("blank_pictures")
def test_the_report_says_no_digits_that_nobody_knows(
    identified: Identification, tmp_path: Path
) -> None:
    """What the log does not show stays with the model, to within rounding, which is not printed."""
    inputs = Inputs("arm", "arm.yaml", ("log.npz",), str(tmp_path))
    write_identification_report(tmp_path / "report.html", identified, inputs)
    cells = re.findall(r"<td[^>]*>([^<]*)</td>", (tmp_path / "report.html").read_text())
    shares = [cell for cell in cells if re.fullmatch(r"\d.* %", cell)]
    assert len(shares) == 6 + 20
    assert all(re.fullmatch(r"[\d.]{1,6} %", share) for share in shares)
    assert [cell for cell in cells if re.search(r"0\.0{7}", cell)] == []


def test_torques_that_were_filtered_by_who_recorded_them(folder: Path) -> None:
    """Friction jumps, recorded torques do not: read as they are the rest is many times larger than
    through the same low-pass."""
    log = recording(cutoff=3.0)
    as_is, through = (
        identify(scenario(folder, recorded_cutoff=corner), log) for corner in (0.0, 3.0)
    )
    assert through.after["train"].relative < 0.01
    assert as_is.after["train"].relative > 3 * through.after["train"].relative
    friction = {
        f.targets[0]: f.parameters for f in through.findings if f.effect == "CoulombViscousFriction"
    }
    assert friction["shoulder"]["coulomb"].value == pytest.approx(COULOMB[0], rel=0.05)


def test_a_walking_robot_can_doubt_a_body(run: Callable[..., Log]) -> None:
    """The mass of the trunk is told by the base rows, its product of inertia by nothing much."""
    log = run("squat", "duration=1.5")
    believed = dataclasses.replace(
        load_scenario("squat", overrides=["duration=1.5"]), identify=IdentifyConfig(["trunk"])
    )
    believed = dataclasses.replace(believed, model=believed.robot)
    result = identify(believed, log)
    mass = PARAMETERS.index("mass")
    assert result.inertia.uncertainty[0, mass] < 0.1
    assert abs(result.inertia.change[0, mass]) < result.inertia.half_width[0, mass] + 0.05


def test_where_nothing_of_the_inertia_shows_there_is_nothing_to_identify() -> None:
    """Torques that are known to 1000 Nm of a pendulum that weighs some newtons."""
    machine = dataclasses.replace(PENDULUM, torque_noise=(1e3,), duration=2.0)
    scenario = dataclasses.replace(machine.scenario, identify=IdentifyConfig(inertia=["all"]))
    log = machine.log(machine.course())
    with pytest.raises(InputError, match="shows nothing of the inertia of these bodies"):
        identify(scenario, log)
    diagnosis = diagnose(Predictor(scenario, log), [CoulombFriction])
    assert (diagnosis.verdict, diagnosis.ranking) == ("not_visible", ())
