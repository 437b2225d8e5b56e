"""Loads at any body: found by their mass and place, without being told where. Truth: models with
one more link, through Drake's inverse dynamics."""

import dataclasses
import os
from pathlib import Path

import numpy as np
import pytest
import yaml
from pydrake.multibody.tree import MultibodyForces
from recorded_arm import ARM
from rig import robot_copy

from fbse_drake import Log, Scenario, load_scenario, resources
from fbse_drake.discrepancy.diagnosis.diagnose import Diagnosis, diagnose
from fbse_drake.discrepancy.diagnosis.dictionary import Dictionary
from fbse_drake.discrepancy.diagnosis.experiment import planned_log
from fbse_drake.discrepancy.diagnosis.fits import Fits
from fbse_drake.discrepancy.diagnosis.identify import identify
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.diagnosis.selection import is_significant
from fbse_drake.discrepancy.identification.inertial import PARAMETERS, untrusted_inertia
from fbse_drake.discrepancy.identification.regression import WhitenedResidual
from fbse_drake.effects.effect import library
from fbse_drake.effects.inertia import (
    BodyCentreOfMass,
    BodyMass,
    Payload,
    inertial_parameters,
    pseudo_inertia,
)
from fbse_drake.robot.plant import Robot, make_robot
from fbse_drake.scenario import IdentifyConfig, RecordingConfig, RobotConfig, SensorsConfig
from fbse_drake.sensors.encoders import EncoderConfig

PERIOD = 0.004
ROTOR_INERTIA = (2.0, 2.0, 1.0, 0.2, 0.2, 0.1)
TORQUE_NOISE = np.array([1.0, 1.0, 0.5, 0.2, 0.2, 0.1])
POSTURE, AMPLITUDE = (0.0, 0.5, 0.2, 0.0, 0.3, 0.0), (1.2, 0.5, 0.6, 1.2, 1.0, 1.5)
# What else might explain a load.
EFFECTS = [
    library()[name]
    for name in (
        "Payload",
        "BodyMass",
        "BodyCentreOfMass",
        "ReflectedInertia",
        "TorqueGain",
        "TorqueBias",
        "TorqueLag",
        "JointSpring",
        "CoulombFriction",
        "ViscousFriction",
        "EncoderOffset",
    )
]


@dataclasses.dataclass(frozen=True)
class Load:
    """A box that is welded to a link of a URDF."""

    body: str
    mass: float
    place: tuple[float, float, float]
    # About its own centre, ixx, iyy, izz.
    inertia: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def xml(self) -> str:
        ixx, iyy, izz = self.inertia
        x, y, z = self.place
        return (
            f'<link name="load"><inertial><mass value="{self.mass}"/>'
            f'<inertia ixx="{ixx}" iyy="{iyy}" izz="{izz}" ixy="0" ixz="0" iyz="0"/>'
            '</inertial></link><joint name="holds" type="fixed">'
            f'<parent link="{self.body}"/><child link="load"/>'
            f'<origin xyz="{x} {y} {z}"/></joint>'
        )


def described(folder: Path, name: str, urdf: str, joints: list[str]) -> str:
    (folder / f"{name}.urdf").write_text(urdf)
    content = {
        "urdf": f"{name}.urdf",
        "base": "base_link",
        "fixed_base": True,
        "joints": joints,
    }
    (folder / f"{name}.yaml").write_text(yaml.safe_dump(content))
    return str(folder / f"{name}.yaml")


def arm(name: str) -> tuple[str, list[str]]:
    """URDF and joints of an arm; `light_hand` is the `arm` with a last link of a tenth of the
    mass."""
    if name == "ur10":
        folder = os.environ.get("FBSE_DATA_DIR")
        if not folder:
            pytest.skip("FBSE_DATA_DIR is not set")
        joints = ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"]
        urdf = (Path(folder) / "ur10" / "ur10_robot.urdf").read_text()
        return urdf, [f"{joint}_joint" for joint in joints]
    urdf = (resources.folder("models") / "arm.urdf").read_text()
    if name == "light_hand":
        own = '<mass value="1.2"/>\n      <inertia ixx="0.001" iyy="0.00136" izz="0.00164"'
        assert own in urdf
        urdf = urdf.replace(
            own, '<mass value="0.12"/>\n      <inertia ixx="0.0001" iyy="0.000136" izz="0.000164"'
        )
    return urdf, [f"axis_{number}" for number in range(1, 7)]


def swung(
    folder: Path,
    name: str,
    load: Load | None,
    *,
    seed: int,
    noise: float = 1.0,
    still: tuple[int, ...] = (),
    duration: float = 6.0,
    speed: float = 1.0,
) -> tuple[Scenario, Log]:
    """An arm that swings all axes, some of them held still, with noise in torques and encoders; and
    what is believed of it."""
    urdf, joints = arm(name)
    believed = described(folder, "believed", urdf, joints)
    true = described(
        folder, "true", urdf.replace("</robot>", f"{load.xml if load else ''}</robot>"), joints
    )
    rotors = dict(zip(joints, ROTOR_INERTIA, strict=True))
    random = np.random.default_rng(seed)
    time = np.arange(round(duration / PERIOD) + 1) * PERIOD
    motion = np.zeros((3, len(time), 6))
    motion[0] += POSTURE
    for axis, amplitude in enumerate(AMPLITUDE):
        for k in (1, 2, 3):
            rate = 2 * np.pi * k * speed * random.uniform(0.1, 0.25)
            phase = random.uniform(0, 6.28)
            if axis not in still:
                for order in range(3):
                    wave = np.sin(rate * time + phase + order * np.pi / 2)
                    motion[order, :, axis] += amplitude / 3 * rate**order * wave
    torque = inverse_dynamics(make_robot(true, rotor_inertia=rotors)[0], motion)
    deviation = noise * TORQUE_NOISE
    channels = {
        "time": time,
        "joint/position": motion[0] + 2e-5 * random.standard_normal(torque.shape),
        "joint/velocity": motion[1] + 5e-4 * random.standard_normal(torque.shape),
        "joint/torque_command": torque + deviation * random.standard_normal(torque.shape),
    }
    meta = {"joints": joints, "sides": [], "period": PERIOD, "source": "closed form"}
    robot = RobotConfig(believed, rotor_inertia=rotors)
    scenario = Scenario(
        robot=robot,
        model=robot,
        sensors=SensorsConfig(encoders=EncoderConfig(resolution=4.8e-5, velocity_noise=5e-4)),
        recording=RecordingConfig(
            rows="instantaneous",
            block=0.02,
            torque_noise=dict(zip(joints, deviation.tolist(), strict=True)),
        ),
    )
    return scenario, Log(channels, meta)


def inverse_dynamics(robot: Robot, motion: np.ndarray) -> np.ndarray:
    """Torques (N, n) for positions, velocities and accelerations (3, N, n) under gravity."""
    plant, context, forces = (
        robot.plant,
        robot.plant.CreateDefaultContext(),
        MultibodyForces(robot.plant),
    )
    result = np.empty(motion[0].shape)
    for k, (q, v, a) in enumerate(zip(*motion, strict=True)):
        plant.SetPositionsAndVelocities(context, np.concatenate([q, v]))
        plant.CalcForceElementsContribution(context, forces)
        result[k] = plant.CalcInverseDynamics(context, a, forces)
    return result


def assert_found(diagnosis: Diagnosis, load: Load) -> None:
    """Alone and first, mass within 2 %, place within 2 cm, and within what the intervals say."""
    assert diagnosis.verdict == "effect_found"
    (found,) = diagnosis.chosen
    assert (found.effect, found.targets) == ("Payload", (load.body,))
    assert found.parameters["mass"].value == pytest.approx(load.mass, rel=0.02)
    place = np.array([found.parameters[axis].value for axis in "xyz"])
    assert np.linalg.norm(place - load.place) < 0.02
    for axis, truth in zip("xyz", load.place, strict=True):
        low, high = found.parameters[axis].interval
        margin = 0.5 * (high - low)
        assert low - margin <= truth <= high + margin, axis


@pytest.mark.parametrize(
    ("name", "load"),
    [
        ("arm", Load("link_6", 5.0, (0.2, -0.03, 0.02), (0.01, 0.03, 0.03))),
        ("light_hand", Load("link_6", 3.0, (0.1, 0.03, 0.05))),
        ("ur10", Load("wrist_3_link", 1.0, (0.0, 0.05, 0.1))),
        ("arm", Load("link_4", 2.0, (0.2, 0.0, 0.1))),
    ],
    ids=["box_5kg", "light_hand_3kg", "ur10_1kg", "forearm_2kg"],
)
def test_a_load_is_found_with_its_place(name: str, load: Load, tmp_path: Path) -> None:
    scenario, log = swung(tmp_path, name, load, seed=len(name) + int(load.mass))
    diagnosis = diagnose(Predictor(scenario, log), EFFECTS)
    assert_found(diagnosis, load)
    if any(load.inertia):
        # Second moments of a box whose rotational inertia is known: sxx = (iyy + izz - ixx) / 2.
        found = diagnosis.chosen[0].parameters
        truth = 0.5 * sum(load.inertia) - np.array(load.inertia)
        for axis, moment in zip("xyz", truth, strict=True):
            low, high = found[f"s{axis}{axis}"].interval
            assert low <= moment <= high


def test_a_load_on_a_shank_of_a_walking_robot_is_found(tmp_path: Path) -> None:
    """Of a floating base: its weight is in the forces under the feet, its place in joints and
    moments."""
    load = Load("left_shank", 2.0, (0.05, 0.03, -0.15))
    scenario = load_scenario(
        "frictionless_walk", overrides=["duration=3.0", "reference.single_supports=2"]
    )
    scenario = dataclasses.replace(
        scenario,
        model=scenario.robot,
        # The plan is coarse in how soles turn.
        recording=dataclasses.replace(
            scenario.recording, torque_noise={"all": 0.5}, unused_rows=["*sole*"]
        ),
    )
    description = robot_copy(
        tmp_path / "copy", lambda urdf: urdf.replace("</robot>", f"{load.xml}</robot>")
    )
    robot = dataclasses.replace(scenario.robot, description=description)
    log = planned_log(dataclasses.replace(scenario, robot=robot, model=robot))
    random = np.random.default_rng(2)
    noise = {
        "joint/torque_command": 0.5,
        "joint/velocity": 5e-4,
        "imu/linear_acceleration": 0.02,
        "imu/angular_velocity": 1e-3,
    }
    noisy = {
        name: log[name] + deviation * random.standard_normal(log[name].shape)
        for name, deviation in noise.items()
    }
    log = dataclasses.replace(log, channels=log.channels | noisy)
    bodies = [Payload, BodyMass, BodyCentreOfMass, library()["FootForceGain"]]
    found = diagnose(Predictor(scenario, log), bodies).chosen[0]
    assert (found.effect, found.targets) == ("Payload", (load.body,))
    assert found.parameters["mass"].value == pytest.approx(load.mass, rel=0.02)
    place = np.array([found.parameters[axis].value for axis in "xyz"])
    assert np.linalg.norm(place - load.place) < 0.02


def test_an_arm_that_carries_nothing_has_no_load(tmp_path: Path) -> None:
    scenario, log = swung(tmp_path, "light_hand", None, seed=5)
    diagnosis = diagnose(Predictor(scenario, log), EFFECTS)
    assert diagnosis.verdict == "nothing_missing"
    smallest = diagnosis.effects["Payload"].smallest_detectable
    assert set(smallest) == {f"link_{number}" for number in range(1, 7)}
    assert smallest["link_6"] < 0.1


def test_what_a_slow_arm_does_not_show_of_a_load_stays_small(tmp_path: Path) -> None:
    """Its mass and place are seen by their weight; how it is spread is not, and does not make it
    implausible."""
    load = Load("link_6", 2.0, (0.1, -0.05, 0.02))
    scenario, log = swung(tmp_path, "arm", load, seed=6, speed=0.2)
    diagnosis = diagnose(Predictor(scenario, log), EFFECTS)
    assert_found(diagnosis, load)
    found = diagnosis.chosen[0]
    for name in ("sxx", "syy", "szz"):
        moment, largest = found.parameters[name], Payload.parameters[name].plausible[1]
        low, high = moment.interval
        assert moment.value < 0.1 * largest
        assert low == 0.0
        assert high < largest


def test_a_joint_at_rest_does_not_tell_which_of_its_bodies_carries_a_load(tmp_path: Path) -> None:
    # On the axis of the last joint, so that this joint does not bear it.
    load = Load("link_6", 2.0, (0.1, 0.0, 0.0))
    scenario, log = swung(tmp_path, "arm", load, seed=3, still=(5,))
    (found,) = diagnose(Predictor(scenario, log), EFFECTS).chosen
    pair = {found.targets[0], *(name.removeprefix("Payload on ") for name in found.confusable_with)}
    assert found.effect == "Payload"
    assert {"link_5", "link_6"} <= pair
    assert found.parameters["mass"].value == pytest.approx(load.mass, rel=0.02)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_load_whose_mass_does_not_show_is_none_that_is_ruled_out(seed: int, tmp_path: Path):
    """Of one near the axis that bears it only the first moment shows, as of a centre of mass."""
    load = Load("link_2", 2.0, (0.05, 0.1, 0.0))
    scenario, log = swung(tmp_path, "arm", load, seed=seed)
    diagnosis = diagnose(Predictor(scenario, log), EFFECTS)
    assert diagnosis.verdict == "effect_found"
    (found,) = diagnosis.chosen
    assert "Payload" in found.confusable_with
    (rival,) = (f for f in diagnosis.ranking if (f.effect, f.targets) == ("Payload", ("link_2",)))
    # What it has of a mass is one that it can have at its place.
    mass = rival.parameters["mass"].value
    place = np.array([rival.parameters[axis].value for axis in "xyz"])
    assert 0.0 < mass < 20.0
    assert np.linalg.norm(place) < 0.5


def test_identification_is_not_held_back_by_the_model(tmp_path: Path) -> None:
    """A load of 25 times the hand's own mass: as least squares on the same rows, whose columns
    nobody believes anything of."""
    load = Load("link_6", 3.0, (0.1, 0.03, 0.05))
    scenario, log = swung(tmp_path, "light_hand", load, seed=4)
    scenario = dataclasses.replace(scenario, identify=IdentifyConfig(["link_6"]))
    identified = identify(scenario, log).inertia
    predictor = Predictor(scenario, log)
    white = WhitenedResidual(predictor.residual)
    inertia = untrusted_inertia(predictor.motion, ["link_6"])
    columns = white.whiten_signature(inertia.signature()).values.reshape(-1, 10)
    z, (left,), *_ = np.linalg.lstsq(columns, white.y.ravel())
    deviation = np.sqrt(
        np.diag(inertia.scale @ np.linalg.inv(columns.T @ columns) @ inertia.scale.T)
    )
    assert left < 1.1 * white.y.size
    # Friction is fitted along, which costs some of the sharpness.
    assert np.abs(identified.change[0] - inertia.scale @ z).max() < 5 * deviation.max()
    assert identified.change[0, 0] == pytest.approx(3.0, rel=0.01)
    first_moment = dict(zip(PARAMETERS, identified.change[0], strict=True))
    place = np.array([first_moment[f"m{axis}"] for axis in "xyz"]) / identified.change[0, 0]
    assert place == pytest.approx(load.place, abs=2e-3)


def test_a_payload_is_the_mass_that_it_says() -> None:
    """Pseudo-inertia in closed form: (m p p^T + second moments, m p, m)."""
    robot, _ = make_robot("arm")
    mass, place, moments = 2.0, np.array([0.1, -0.2, 0.3]), np.array([0.01, 0.02, 0.0])
    points = Payload.point_masses(robot.body("link_6"), np.array([mass, *place, *moments]))
    J = pseudo_inertia(sum(inertial_parameters(point.inertia) for point in points))
    expected = mass * np.outer(np.append(place, 1.0), np.append(place, 1.0))
    expected[:3, :3] += np.diag(moments)
    np.testing.assert_allclose(J, expected, atol=1e-12)


def test_bodies_that_are_fixed_to_each_other_carry_one_load(tmp_path: Path) -> None:
    """And what is fixed to the world carries none; a mass is suspected where there is more of it
    than a hundredth."""
    urdf, joints = arm("light_hand")
    grip = Load("link_6", 0.1, (0.05, 0.0, 0.0)).xml
    description = described(tmp_path, "grip", urdf.replace("</robot>", f"{grip}</robot>"), joints)
    robot, _ = make_robot(description)
    links = [f"link_{number}" for number in range(1, 7)]
    assert "load" in robot.body_names
    assert Payload.suspected_bodies(robot) == links
    assert BodyMass.suspected_bodies(robot) == links[:5]


def test_a_fit_takes_no_more_mass_off_a_body_than_it_has() -> None:
    robot, _ = make_robot("arm")
    assert BodyMass.lowest_values(robot, "link_5").tolist() == [-2.0]
    assert Payload.lowest_values(robot, "link_5")[0] == 0.0


def test_a_load_lies_within_reach_of_its_body() -> None:
    """However well one a body's length away would fit, as it may where feet are measured
    wrongly."""
    unsure = dataclasses.replace(ARM, torque_noise=tuple(20 * noise for noise in ARM.torque_noise))
    predictor = unsure.predictor(unsure.log(unsure.course()))
    fits = Fits(Dictionary(predictor, [Payload]))
    base, load = fits.explain([]), fits.fixed_candidates[-1]
    fitted = fits.explain([load])

    def is_found(x: float) -> bool:
        fit = dataclasses.replace(fitted.fit, parameters=np.array([2.0, x, 0, 0, 0, 0, 0]))
        wider = dataclasses.replace(fitted, fit=fit, deviance=base.deviance - 1e4)
        return is_significant(fits, base, wider, load)

    assert [is_found(x) for x in (0.4, 1.2, 1.51)] == [True, True, False]
