import numpy as np
import pytest

from fbse_drake.effects.friction import CoulombViscousFriction, StribeckFriction
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, ResolvedJointTorque
from fbse_drake.errors import InputError
from fbse_drake.robot.description import load_description

NAMES, _ = load_description("biped")
TABLE_1 = StribeckFriction(gamma1={"all": 0.7}, gamma4={"all": 0.6}, gamma6={"all": 0.9})
# Coulomb 40 Nm with a slope of 5000 Nm s/rad at rest.
HARMONIC_DRIVE = CoulombViscousFriction(
    coulomb={"all": 40.0}, viscous={"all": 20.0}, transition={"all": 40.0 / 4980.0}
)


def resolved(effect: JointTorqueEffect, joints: int = 12) -> ResolvedJointTorque:
    whole = effect.resolve(NAMES)
    return ResolvedJointTorque(
        type(effect), whole.targets[:joints], whole.linear[:, :joints], whole.nonlinear[:, :joints]
    )


@pytest.mark.parametrize(
    ("gammas", "reached", "falls"),
    [
        ((0.7, 100.0, 10.0, 0.6, 100.0, 0.9), 1.0, True),
        ((0.0, 100.0, 10.0, 0.6, 100.0, 0.9), 1.0, False),
        # Rises from 1.6 to 2.7 Nm as it would fall.
        ((1.6, 1000.0, 14.0, 2.7, 14.0, 1.0), 1.0, False),
        ((1.6, 1000.0, 14.0, 2.7, 1000.0, 1.0), 1.0, True),
        ((0.02, 1000.0, 14.0, 2.7, 1000.0, 1.0), 1.0, False),
        # What falls over all speeds alike is less viscous friction, of a joint that is no faster.
        ((0.4, 600.0, 0.5, 1.2, 80.0, 1.0), 1.0, False),
        ((0.4, 600.0, 0.5, 1.2, 80.0, 1.0), 6.0, True),
    ],
)
def test_friction_that_does_not_fall_with_speed_is_no_stribeck_friction(
    gammas: tuple[float, ...], reached: float, falls: bool
):
    values = {f"gamma{k}": value for k, value in enumerate(gammas, 1)}
    assert StribeckFriction.is_itself(values, reached) is falls
    speed = np.linspace(0.0, reached, 20001)
    one, two, three, four, five, _ = gammas
    law = one * (np.tanh(two * speed) - np.tanh(three * speed)) + four * np.tanh(five * speed)

    def slope(amount: float, gamma: float) -> float:
        return amount * gamma * (1.0 - np.tanh(gamma * reached) ** 2)

    # But for the straight line that a viscous friction would be.
    law -= (slope(one, two) - slope(one, three) + slope(four, five)) * speed
    assert (np.ptp(law[law.argmax() :]) > 0.05 * law[-1]) is np.bool_(falls)


def test_equation_56_at_table_1():
    w = np.full(12, 0.02)
    by_hand = (
        0.7 * (np.tanh(100 * 0.02) - np.tanh(10 * 0.02)) + 0.6 * np.tanh(100 * 0.02) + 0.9 * 0.02
    )
    np.testing.assert_allclose(
        resolved(TABLE_1).torque_and_slope(JointMotion(w))[0], by_hand, rtol=1e-12
    )


@pytest.mark.parametrize("effect", [TABLE_1, HARMONIC_DRIVE])
def test_slope_is_the_derivative(effect: JointTorqueEffect):
    w, h = np.linspace(-0.3, 0.3, 12), 1e-6
    law = resolved(effect)
    difference = (
        law.torque_and_slope(JointMotion(w + h))[0] - law.torque_and_slope(JointMotion(w - h))[0]
    ) / (2 * h)
    np.testing.assert_allclose(
        law.torque_and_slope(JointMotion(w))[1], difference, rtol=1e-5, atol=1e-5
    )


@pytest.mark.parametrize("effect", [TABLE_1, HARMONIC_DRIVE])
def test_friction_always_dissipates(effect: JointTorqueEffect):
    w = np.concatenate([-np.logspace(-8, 2, 200), np.logspace(-8, 2, 200)])[:, None] * np.ones(12)
    assert np.all(resolved(effect).torque_and_slope(JointMotion(w))[0] * w > 0)
    assert np.all(resolved(effect).torque_and_slope(JointMotion(0 * w))[0] == 0)


@pytest.mark.parametrize("effect", [TABLE_1, HARMONIC_DRIVE])
def test_a_whole_log_at_once_equals_row_by_row(effect: JointTorqueEffect):
    w = np.random.default_rng(0).normal(size=(50, 12))
    law = resolved(effect)
    rows = [law.torque_and_slope(JointMotion(row))[0] for row in w]
    np.testing.assert_array_equal(law.torque_and_slope(JointMotion(w))[0], rows)


@pytest.mark.parametrize("effect", [TABLE_1, HARMONIC_DRIVE])
def test_linear_parameters_are_recovered_from_the_basis(effect: JointTorqueEffect):
    """The basis that simulates is the regressor that identifies."""
    law = resolved(effect)
    w = np.random.default_rng(1).normal(scale=0.2, size=(400, 12))
    torque = law.torque_and_slope(JointMotion(w))[0]
    basis, _ = law.effect.basis(JointMotion(w), law.nonlinear[:, None, :])
    theta, *_ = np.linalg.lstsq(
        np.stack([b[:, 3] for b in basis], axis=1), torque[:, 3], rcond=None
    )
    np.testing.assert_allclose(theta, law.linear[:, 3], rtol=1e-9)


def test_unknown_joint_and_bad_value_are_refused():
    with pytest.raises(InputError, match=r"gamma1\.hip_yw: unknown joint \(allowed: all, hip_yaw"):
        StribeckFriction(gamma1={"hip_yw": 1.0}).resolve(NAMES)
    with pytest.raises(InputError, match=r"gamma4: expected values in \[0, inf\] Nm"):
        StribeckFriction(gamma4={"all": -1.0}).resolve(NAMES, key="f")
