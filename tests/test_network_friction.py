"""Friction by networks that are trained offline: what they learn, and that they say what they do
not know."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import scenario
from rig import estimated

from fbse_drake import InputError, Log
from fbse_drake.estimators.network_friction import (
    JointNetworks,
    NetworkFriction,
    NetworkLaw,
    trained,
)
from fbse_drake.rivals.methods import Method
from fbse_drake.robot.plant import make_robot

# Constant, but for a tanh of asinh(w / 0.01 rad/s).
ONE = JointNetworks([[2.0]], [[0.5]], [[3.0]], [0.25], seen=[-0.5, 0.5], deviation=0.1)


def law(networks: JointNetworks) -> NetworkLaw:
    return NetworkLaw(NetworkFriction({"knee": networks}), ["knee"])


def at(networks: JointNetworks, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Friction and deviation at velocities (N,), (N,) each."""
    told = law(networks)
    torque, deviation = np.array([told(w[None]) for w in velocity])[:, :, 0].T
    return torque, deviation


def test_a_network_is_what_its_weights_say():
    velocity = np.array([-0.4, -0.003, 0.0, 0.02, 0.5])
    torque, deviation = at(ONE, velocity)
    # asinh by its logarithm.
    x = np.log(velocity / 0.01 + np.sqrt((velocity / 0.01) ** 2 + 1))
    np.testing.assert_allclose(torque, 0.25 + 3 * np.tanh(2 * x + 0.5), rtol=1e-12)
    np.testing.assert_allclose(deviation, 0.1)


def test_beyond_what_was_seen_it_is_less_and_less_sure():
    """The deviation is that of friction which may go on in proportion to the velocity."""
    (edge,), _ = at(ONE, np.array([0.5]))
    torque, deviation = at(ONE, np.array([0.55, 1.0, 5.0]))
    np.testing.assert_allclose(torque, edge)
    np.testing.assert_allclose(deviation, np.hypot(0.1, edge * np.array([0.1, 1.0, 9.0])))


def test_networks_that_differ_are_less_sure():
    two = replace(
        ONE,
        slopes=[[2.0], [2.0]],
        shifts=[[0.5], [0.5]],
        torques=[[3.0], [3.0]],
        offsets=[0.25, 0.75],
    )
    velocity = np.array([0.1])
    one, both = at(ONE, velocity), at(two, velocity)
    np.testing.assert_allclose(both[0], one[0] + 0.25)
    np.testing.assert_allclose(both[1], np.hypot(0.1, 0.25))


def test_of_a_joint_without_networks_nothing_is_known():
    torque, deviation = NetworkLaw(NetworkFriction({"knee": ONE}), ["hip", "knee"])(
        np.array([0.1, 0.1])
    )
    assert torque[0] == 0.0
    assert deviation[0] >= 50.0
    assert deviation[1] == pytest.approx(0.1)


def test_bad_networks_get_one_line():
    with pytest.raises(InputError, match="offsets: expected as many of each"):
        replace(ONE, shifts=[[0.5, 0.5]])
    with pytest.raises(InputError, match="seen: expected the slowest and the fastest"):
        replace(ONE, seen=[0.5, -0.5])
    two = replace(ONE, slopes=[[1.0, 2.0]], shifts=[[0.0, 0.5]], torques=[[1.0, 3.0]])
    with pytest.raises(InputError, match="expected networks of one size in all joints"):
        NetworkLaw(NetworkFriction({"hip": ONE, "knee": two}), ["hip", "knee"])
    tail = NetworkFriction({"tail": ONE})
    with pytest.raises(InputError, match="networks: tail: the robot has no such joint"):
        tail.check(make_robot("biped")[0].description)


def samples(seed: int, speed: float = 0.8) -> tuple[np.ndarray, np.ndarray]:
    """Velocity and torque with noise of 20 s of a Stribeck law with an offset."""
    random, time = np.random.default_rng(seed), np.arange(0, 20, 0.01)
    velocity = speed * np.sin(2 * np.pi * 0.3 * time) * np.sin(2 * np.pi * 0.05 * time)
    return velocity, stribeck(velocity) + 0.2 * random.standard_normal(len(time))


def stribeck(velocity: np.ndarray) -> np.ndarray:
    hump = 1.0 + 0.6 * np.exp(-np.abs(velocity) / 0.1)
    return 1.5 * hump * np.tanh(velocity / 0.02) + 0.8 * velocity + 0.3


def test_a_law_of_no_known_shape_is_learned():
    pytest.importorskip("sklearn")
    networks = trained(*samples(0))
    velocity = np.linspace(-0.75, 0.75, 301)
    torque, deviation = at(networks, velocity)
    error = torque - stribeck(velocity)
    # A line, which is what least squares without a shape has, is off by a third.
    line = np.polyval(np.polyfit(velocity, stribeck(velocity), 1), velocity)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.std(line - stribeck(velocity))
    assert networks.deviation == pytest.approx(0.2, rel=0.15)
    assert np.all(np.abs(error) < 3 * deviation)
    # What it has not seen, faster, it does not pretend to know.
    fast = np.array([2.0, 4.0])
    torque, deviation = at(networks, fast)
    assert np.all(np.abs(torque - stribeck(fast)) < deviation)
    assert np.all(deviation > 5 * networks.deviation)


def test_noise_is_not_learned():
    """Of a joint without friction nothing but noise is left, and that is what it says."""
    pytest.importorskip("sklearn")
    velocity, torque = samples(1)
    networks = trained(velocity, torque - stribeck(velocity))
    torque, deviation = at(networks, np.linspace(-0.7, 0.7, 101))
    assert np.abs(torque).max() < 0.08
    assert np.all(deviation > 0.15)


def test_a_robot_is_trained_on_its_own_log():
    """Every joint learns its own law, and what is written down is what is read."""
    pytest.importorskip("sklearn")
    velocity, torque = samples(2)
    time = np.arange(len(velocity)) * 0.01
    channels = {
        "time": time,
        "joint/position": np.zeros((len(time), 2)),
        "joint/velocity": np.stack([velocity, velocity], axis=1),
        "estimate/joint/friction_torque": np.stack([torque, -2 * torque], axis=1),
    }
    log = Log(channels, {"joints": ["hip", "knee"], "period": 0.01})
    found = NetworkFriction().identified(log)
    hip, knee = NetworkLaw(found, ["hip", "knee"])(np.array([0.3, 0.3]))[0]
    assert hip == pytest.approx(stribeck(np.array(0.3)), abs=0.1)
    assert knee == pytest.approx(-2 * stribeck(np.array(0.3)), abs=0.2)
    assert Method.read(Method(found).text) == Method(found)


def test_it_runs_in_the_slot_of_an_estimator(run):
    log = run("paper_walk", "duration=0.3")
    one = replace(ONE, seen=[-0.05, 0.05])
    config = NetworkFriction(dict.fromkeys(log.joints[1:], one))
    told = estimated(log, scenario("paper_walk"), config)
    friction, deviation = law(one)(log["joint/velocity"][-1])
    np.testing.assert_allclose(told["estimate/joint/friction_torque"][-1, 1:], friction[1:])
    stated = told["estimate/joint/friction_torque_std"][-1]
    np.testing.assert_allclose(stated[1:], deviation[1:])
    assert stated[0] >= 50.0
