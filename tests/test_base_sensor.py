"""Base sensor control: the friction of a fixed robot's joints from the wrench under its base."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from conftest import scenario
from rig import estimated

from fbse_drake import InputError, Log, build_station
from fbse_drake.effects.inertia import BodyMass
from fbse_drake.estimators.base_sensor import BaseSensor, LinkModel
from fbse_drake.robot.plant import make_robot
from fbse_drake.scenario import RobotConfig
from fbse_drake.sensors.base_wrench import BaseWrench

Run = Callable[..., Log]
# Its motion swells faster than the scenario's, so that a moment is enough.
SHORT = ("duration=1.4", "reference.ramp=0.3")
# A tool that nobody knows of, beyond all joints.
TOOL = "robot.effects.tool=!BodyMass {mass: {link_6: 3.0}}"


def nrmse(log: Log, channel: str = "estimate/joint/friction_torque") -> np.ndarray:
    """Of each joint, from 0.5 s on."""
    truth, found = log["truth/joint/friction_torque"][500:-1], log[channel][501:]
    return np.sqrt(((found - truth) ** 2).mean(axis=0) / (truth**2).mean(axis=0))


def test_friction_of_six_joints_from_the_base_alone(run: Run):
    """As asked of the shipped scenario: within 5 %; what the tool weighs need not be known."""
    log = run("bsc_arm", *SHORT)
    assert nrmse(log).max() < 0.05
    # Nobody doubts an IMU that there is not.
    assert not log["estimate/friction/status"].any()
    assert nrmse(run("bsc_arm", *SHORT, TOOL)).max() < 0.05


def test_links_before_a_joint_must_be_known(run: Run):
    """With another upper arm in the model, what is wrong is wrong beyond it only."""
    log = run("bsc_arm", *SHORT, TOOL)
    walk = scenario("bsc_arm", *SHORT)
    heavy = {"upper arm": BodyMass(mass={"link_2": 3.0})}
    model = RobotConfig("arm", rotor_inertia=walk.robot.rotor_inertia, effects=heavy)
    found = estimated(log, walk, BaseSensor(), model=model)
    known = estimated(log, walk, BaseSensor())
    before, after = (nrmse(of, "estimate/joint/residual_torque") for of in (known, found))
    np.testing.assert_allclose(after[:2], before[:2], rtol=1e-6)
    assert np.all(after[2:] > before[2:] + 0.2)


def test_at_rest_the_base_carries_the_weight():
    """Closed form: the total mass at the centre of mass, whatever the posture; and no joint is
    asked to move the links before it."""
    robot, _ = make_robot("arm")
    context = robot.plant.CreateDefaultContext()
    robot.set_joint_positions(context, np.array([0.3, -0.5, 0.8, 0.2, -0.4, 1.0]))
    model = LinkModel(robot)
    links = model.links(context)
    mass = robot.plant.CalcTotalMass(context)
    c = robot.plant.CalcCenterOfMassPositionInWorld(context)
    weight = np.array([0.0, 0.0, -9.81 * mass])
    np.testing.assert_allclose(links.weight.sum(axis=0)[3:], weight, atol=1e-9)
    np.testing.assert_allclose(links.weight.sum(axis=0)[:3], np.cross(c, weight), atol=1e-9)
    # What passes the joints then is Drake's gravity compensation.
    carried = -links.weight.sum(axis=0) + model.before @ links.weight
    expected = -robot.plant.CalcGravityGeneralizedForces(context)[robot.velocity_index]
    np.testing.assert_allclose((links.axes * carried).sum(axis=1), expected, atol=1e-9)
    np.testing.assert_array_equal(model.before, np.tril(np.ones((6, 6)), -1))


def test_the_links_momenta_are_those_of_drake():
    """Together they are the mechanism's, and their energy is the joints' without rotors."""
    robot, _ = make_robot("arm")
    plant, context = robot.plant, robot.plant.CreateDefaultContext()
    q, v = np.random.default_rng(0).normal(size=(2, 6))
    robot.set_state(context, q, v)
    links = LinkModel(robot).links(context)
    expected = plant.CalcSpatialMomentumInWorldAboutPoint(context, np.zeros(3)).get_coeffs()
    np.testing.assert_allclose((links.momentum @ v).sum(axis=0), expected, atol=1e-9)
    M = plant.CalcMassMatrix(context)[np.ix_(robot.velocity_index, robot.velocity_index)]
    beyond = 1.0 - LinkModel(robot).before
    found = np.einsum("ik,ib,bkj->ij", links.axes, beyond, links.momentum)
    np.testing.assert_allclose(found, M, atol=1e-9)


def test_what_does_not_fit_gets_one_line():
    arm, walk = scenario("bsc_arm"), scenario("paper_walk", "duration=0.1")
    without = dataclasses.replace(arm.sensors, more={})
    with pytest.raises(InputError, match=r"!BaseSensor needs a sensor under the base \(as in"):
        dataclasses.replace(arm, sensors=without)
    under = dataclasses.replace(walk.sensors, more={"base": BaseWrench(period=0.001)})
    with pytest.raises(InputError, match="a base wrench needs a robot whose base is fixed"):
        build_station(dataclasses.replace(walk, sensors=under))
    with pytest.raises(InputError, match="force_noise: expected a number > 0, found 0"):
        BaseSensor(force_noise=0.0)
