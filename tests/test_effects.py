import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, MatrixGain, Multiplexer, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from fbse_drake.effects.friction import CoulombViscousFriction, DirectionalFriction, StribeckFriction
from fbse_drake.effects.joint_torque import JointMotion, JointTorqueEffect, ResolvedJointTorque
from fbse_drake.effects.system import JointTorqueEffects, conservative_inertia, solve_implicit_step
from fbse_drake.effects.transmission import Backlash, PreslidingHysteresis
from fbse_drake.errors import InputError
from fbse_drake.robot.description import load_description
from fbse_drake.robot.plant import make_robot

NAMES, _ = load_description("biped")
TABLE_1 = StribeckFriction(gamma1={"all": 0.7}, gamma4={"all": 0.6}, gamma6={"all": 0.9})
# Coulomb 40 Nm with a slope of 5000 Nm s/rad at rest.
HARMONIC_DRIVE = CoulombViscousFriction(coulomb={"all": 40.0}, viscous={"all": 20.0}, transition={"all": 40.0 / 4980.0})


def resolved(effect: JointTorqueEffect, joints: int = 12) -> ResolvedJointTorque:
    whole = effect.resolve(NAMES)
    return ResolvedJointTorque(type(effect), whole.targets[:joints], whole.linear[:, :joints], whole.nonlinear[:, :joints])


def test_equation_56_at_table_1():
    w = np.full(12, 0.02)
    by_hand = 0.7 * (np.tanh(100 * 0.02) - np.tanh(10 * 0.02)) + 0.6 * np.tanh(100 * 0.02) + 0.9 * 0.02
    np.testing.assert_allclose(resolved(TABLE_1).torque_and_slope(JointMotion(w))[0], by_hand, rtol=1e-12)


@pytest.mark.parametrize("effect", [TABLE_1, HARMONIC_DRIVE])
def test_slope_is_the_derivative(effect: JointTorqueEffect):
    w, h = np.linspace(-0.3, 0.3, 12), 1e-6
    law = resolved(effect)
    difference = (law.torque_and_slope(JointMotion(w + h))[0] - law.torque_and_slope(JointMotion(w - h))[0]) / (2 * h)
    np.testing.assert_allclose(law.torque_and_slope(JointMotion(w))[1], difference, rtol=1e-5, atol=1e-5)


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
    theta, *_ = np.linalg.lstsq(np.stack([b[:, 3] for b in basis], axis=1), torque[:, 3], rcond=None)
    np.testing.assert_allclose(theta, law.linear[:, 3], rtol=1e-9)


@pytest.mark.parametrize("effect", [TABLE_1, HARMONIC_DRIVE])
def test_implicit_step_solves_its_equation(effect: JointTorqueEffect):
    generator = np.random.default_rng(2)
    law, mobility = resolved(effect, 1), np.array([1e-3 / 0.05])

    def torque_at(v: float) -> float:
        return float(law.torque_and_slope(JointMotion(np.array([v])))[0][0])

    largest = torque_at(10.0)
    for _ in range(300):
        free = generator.normal(scale=10 ** generator.uniform(-4, 1), size=1)
        exact = brentq(lambda v, free=free: v + mobility[0] * torque_at(v) - free[0], -abs(free[0]), abs(free[0]), xtol=1e-14)
        torque = solve_implicit_step(lambda v: law.torque_and_slope(JointMotion(v)), free, mobility, generator.normal(size=1)).torque
        assert torque[0] == pytest.approx(torque_at(exact), abs=1e-3 * largest)
        assert torque[0] * exact >= 0


@pytest.mark.parametrize("start", [-0.5, 0.0, 0.03, 2.0])
def test_friction_that_falls_too_steeply_for_the_step_is_solved_all_the_same(start: float):
    """Stribeck friction whose slope times the mobility is below -1: the left side rises, falls and rises again."""
    law = resolved(StribeckFriction(gamma1={"all": 4.2}, gamma2={"all": 131.0}, gamma3={"all": 6.5}, gamma4={"all": 5.0}), 1)
    mobility = np.full(1, 0.25)
    velocities = np.linspace(0.0, 0.3, 3000)
    slopes = law.torque_and_slope(JointMotion(velocities[:, None]))[1]
    assert 1 + mobility[0] * slopes.min() < -2
    for free in np.linspace(-3.0, 3.0, 61):
        solution = solve_implicit_step(lambda v: law.torque_and_slope(JointMotion(v)), np.full(1, free), mobility, np.full(1, start))
        torque, slope = law.torque_and_slope(JointMotion(solution.velocity))
        # To the first order that the last step of Newton's method leaves.
        assert abs(solution.velocity + mobility * torque - free) < 1e-3 * (1 + mobility * abs(slope))
        assert solution.torque == pytest.approx(torque, abs=0.05)


class Flywheel:
    """A wheel on a revolute joint with an effect, a commanded torque, and nothing else."""

    def __init__(
        self, effect: JointTorqueEffect, inertia: float, time_step: float, drive: float | PiecewisePolynomial, believed: float = 1.0
    ):
        builder = DiagramBuilder()
        self.plant = builder.AddSystem(MultibodyPlant(time_step))
        body = self.plant.AddRigidBody("wheel", SpatialInertia.SolidBoxWithMass(6.0 * inertia, 1.0, 1.0, 1.0))
        self.plant.AddJoint(RevoluteJoint("axis", self.plant.world_frame(), body.body_frame(), [0, 0, 1]))
        self.plant.Finalize()
        effects = builder.AddSystem(JointTorqueEffects([resolved(effect, 1)], np.array([believed * inertia]), time_step))
        total = builder.AddSystem(MatrixGain(np.array([[1.0, -1.0]])))
        drive = drive if isinstance(drive, PiecewisePolynomial) else PiecewisePolynomial([[drive]])
        source = builder.AddSystem(TrajectorySource(drive))
        torques = builder.AddSystem(Multiplexer(2))
        builder.Connect(self.plant.get_state_output_port(), effects.GetInputPort("joint_state"))
        builder.Connect(source.get_output_port(), effects.GetInputPort("torque_command"))
        builder.Connect(source.get_output_port(), torques.get_input_port(0))
        builder.Connect(effects.get_output_port(), torques.get_input_port(1))
        builder.Connect(torques.get_output_port(), total.get_input_port())
        builder.Connect(total.get_output_port(), self.plant.get_applied_generalized_force_input_port())
        self.state = LogVectorOutput(self.plant.get_state_output_port(), builder, time_step)
        self.loss = LogVectorOutput(effects.get_output_port(), builder, time_step)
        self.diagram = builder.Build()

    def run(self, speed: float, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Velocity and torque loss over time from a start speed."""
        simulator = Simulator(self.diagram)
        context = simulator.get_mutable_context()
        self.plant.SetVelocities(self.plant.GetMyMutableContextFromRoot(context), [speed])
        simulator.AdvanceTo(duration)
        return self.state.FindLog(context).data()[1], self.loss.FindLog(context).data()[0]


def exact_velocity(effect: JointTorqueEffect, inertia: float, drive: float, speed: float, duration: float) -> float:
    """Final velocity of the flywheel from scipy's stiff integrator."""
    law = resolved(effect, 1)
    solution = solve_ivp(
        lambda _, v: (drive - law.torque_and_slope(JointMotion(v))[0]) / inertia,
        (0, duration),
        [speed],
        method="Radau",
        rtol=1e-9,
        atol=1e-12,
    )
    return float(solution.y[0, -1])


@pytest.mark.parametrize(("effect", "inertia", "drive", "speed"), [(TABLE_1, 0.1, 0.8, 0.5), (HARMONIC_DRIVE, 0.05, 60.0, 3.0)])
def test_moving_joint_converges_under_step_halving(effect: JointTorqueEffect, inertia: float, drive: float, speed: float):
    truth = exact_velocity(effect, inertia, drive, speed, 0.02)
    errors = [abs(Flywheel(effect, inertia, h, drive).run(speed, 0.02)[0][-1] - truth) for h in (1e-3, 5e-4, 2.5e-4)]
    assert errors[1] < 0.65 * errors[0]
    assert errors[2] < 0.65 * errors[1]
    assert errors[2] < 0.01 * speed


@pytest.mark.parametrize("time_step", [2e-3, 1e-3, 5e-4])
@pytest.mark.parametrize("believed", [1.0, 0.3])
def test_stiff_joint_comes_to_rest_without_ringing(time_step: float, believed: float):
    """Slope times step over inertia is 100 at 1 ms; an explicit torque would throw the joint about."""
    velocity, loss = Flywheel(HARMONIC_DRIVE, 0.05, time_step, drive=30.0, believed=believed).run(2.0, 0.4)
    law = resolved(HARMONIC_DRIVE, 1)
    settled = velocity[-20:]
    assert np.ptp(settled) < 1e-6
    assert law.torque_and_slope(JointMotion(settled[-1:]))[0][0] == pytest.approx(30.0, rel=1e-3)
    assert loss[-1] == pytest.approx(30.0, rel=1e-3)


@pytest.mark.parametrize("time_step", [1e-3, 5e-4])
def test_stiff_joint_at_rest_stays_at_rest(time_step: float):
    velocity, loss = Flywheel(HARMONIC_DRIVE, 0.05, time_step, drive=0.0).run(0.0, 0.1)
    assert np.all(velocity == 0)
    assert np.all(loss == 0)


def test_explicit_friction_would_ring():
    """The negative case: the same joint with the torque of its present velocity does not come to rest."""
    law, v = resolved(HARMONIC_DRIVE, 1), np.array([2.0])
    for _ in range(400):
        v = v - 1e-3 / 0.05 * law.torque_and_slope(JointMotion(v))[0]
    assert abs(v[0]) > 0.3


def test_conservative_inertia_keeps_coupled_joints_stable():
    robot, _ = make_robot("biped")
    context = robot.plant.CreateDefaultContext()
    generator = np.random.default_rng(5)
    inertia = conservative_inertia(robot.joint_compliance(context))
    for _ in range(20):
        robot.set_joint_positions(context, np.tile([0, 0, -0.4, 0.8, -0.4, 0], 2) + generator.uniform(-0.3, 0.3, size=12))
        eigenvalues = np.linalg.eigvals(np.diag(inertia) @ robot.joint_compliance(context))
        assert np.all((eigenvalues.real > 0) & (eigenvalues.real < 4 / 3))


def test_unknown_joint_and_bad_value_are_refused():
    with pytest.raises(InputError, match=r"gamma1\.hip_yw: unknown joint \(allowed: all, hip_yaw"):
        StribeckFriction(gamma1={"hip_yw": 1.0}).resolve(NAMES)
    with pytest.raises(InputError, match=r"gamma4: expected values in \[0, inf\] Nm"):
        StribeckFriction(gamma4={"all": -1.0}).resolve(NAMES, key="f")


@pytest.mark.parametrize("time_step", [2e-3, 1e-3, 5e-4])
@pytest.mark.parametrize("displacement", [2e-4, 5e-3])
@pytest.mark.parametrize("believed", [1.0, 0.3])
def test_bristles_hold_a_joint_without_ringing(time_step: float, displacement: float, believed: float):
    """40 Nm over 0.2 mrad is a spring that is stiffer than a plant step can follow."""
    effect = PreslidingHysteresis(coulomb={"all": 40.0}, displacement={"all": displacement})
    ramp = PiecewisePolynomial.FirstOrderHold([0.0, 1.0, 2.0], np.array([[0.0, 30.0, 30.0]]))
    velocity, loss = Flywheel(effect, 0.05, time_step, ramp, believed).run(0.0, 1.2)
    assert loss[-1] == pytest.approx(30.0, rel=1e-2)
    # Dahl's law at rest: the torque is coulomb (1 - exp(-angle / displacement)). What is too stiff for the step gives way by h^2/I more.
    angle, exact = velocity.sum() * time_step, -displacement * np.log(1 - 30.0 / 40.0)
    assert 0.98 * exact < angle < 1.05 * exact + 30.0 * time_step**2 / (0.05 * believed)


def test_motor_crosses_the_gap_before_the_link_feels_it():
    gap, inertia, drive = 0.01, 0.25, 5.0
    effect = Backlash(gap={"all": gap}, rotor_inertia={"all": inertia})
    turned = PiecewisePolynomial.ZeroOrderHold([0.0, 0.1, 1.0], np.array([[drive, -drive, -drive]]))
    velocity, loss = Flywheel(effect, 0.05, 1e-3, turned).run(0.0, 0.3)
    crossing = np.sqrt(2 * gap * inertia / drive)
    assert np.all(loss[:100] == 0)
    assert loss[101] == -drive
    # The impulse that never arrives is the drive's over the crossing.
    assert -loss.sum() * 1e-3 == pytest.approx(drive * crossing, rel=0.03)
    assert np.all(loss[100 + round(crossing / 1e-3) + 2 :] == 0)
    assert velocity[-1] == pytest.approx(drive / 0.05 * (0.1 - 0.2 + crossing), rel=0.02)


def test_directional_friction_alone_stays_bounded():
    """It drives the joint one way, up to its own size, and the step has more than one solution there."""
    effect = DirectionalFriction(asymmetry={"all": -5.0}, transition={"all": 1e-3})
    velocity, loss = Flywheel(effect, 0.05, 1e-3, drive=1.0).run(0.0, 0.1)
    assert np.all((loss <= 0) & (loss >= -5.0 - 1e-9))
    assert velocity[-1] == pytest.approx(0.1 * 6.0 / 0.05, rel=0.03)
