"""What joint torque effects do in a plant: against their laws, and against closed forms."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlantConfig
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import LogVectorOutput, MatrixGain, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
from scipy.integrate import solve_ivp

from fbse_drake.effects.effect import Parameter
from fbse_drake.effects.friction import (
    CoulombViscousFriction,
    DirectionalFriction,
    LoadDependentFriction,
    QuadraticDrag,
    StribeckFriction,
    ThermalDrift,
    ViscousFriction,
)
from fbse_drake.effects.implicit import implicit_law
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    Rise,
    basis_over_time,
    law_over_time,
)
from fbse_drake.effects.law_table import LawTable, law_table, look_up
from fbse_drake.effects.system import loss_over_time
from fbse_drake.effects.transmission import Backlash, PreslidingHysteresis
from fbse_drake.robot.description import RobotDescription, load_description
from fbse_drake.robot.plant import make_robot
from fbse_drake.station import add_joint_torques

H = 1e-3
TABLE_1 = StribeckFriction(gamma1={"all": 0.7}, gamma4={"all": 0.6}, gamma6={"all": 0.9})
# Coulomb 40 Nm with a slope of 5000 Nm s/rad at rest.
HARMONIC_DRIVE = CoulombViscousFriction(
    coulomb={"all": 40.0},
    viscous={"all": 20.0},
    transition={"all": 40.0 / 4980.0},
)
_WHEEL = """<robot name="wheel"><link name="bench"/><link name="wheel"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="axis" type="continuous"><parent link="bench"/><child link="wheel"/><axis xyz="0 0 1"/>
</joint></robot>"""


@dataclass(frozen=True)
class ClippedFriction(JointTorqueEffect):
    """Coulomb friction that rises linearly: u = coulomb clip(w / transition, -1, 1)."""

    of_velocity_alone: ClassVar[bool] = True
    parameters: ClassVar[dict[str, Parameter]] = {
        "coulomb": Parameter("Nm", linear=True, plausible=(0.0, 50.0)),
        "transition": Parameter("rad/s", linear=False, plausible=(1e-3, 5e-2)),
    }

    coulomb: dict[str, float] = field(default_factory=dict)
    transition: dict[str, float] = field(default_factory=lambda: {"all": 0.01})

    @staticmethod
    def basis(motion: JointMotion, nonlinear: np.ndarray) -> tuple[Sequence, Sequence]:
        x = motion.velocity / nonlinear[0]
        return (np.clip(x, -1.0, 1.0),), ((np.abs(x) < 1.0) / nonlinear[0],)

    @staticmethod
    def rise(linear, nonlinear, typical) -> Rise:  # noqa: ARG004
        return Rise(corners=(nonlinear[0],))


class Wheel:
    """A wheel on a bench with effects in its axis, a commanded torque, and nothing else."""

    def __init__(
        self,
        folder: Path,
        effects: Sequence[JointTorqueEffect],
        drive: float | PiecewisePolynomial,
        *,
        inertia: float = 0.05,
        rotor_inertia: float = 0.0,
        time_step: float = H,
        speed: float = 1.0,
        load: float = 10.0,
        contact: str = "lagged",
    ):
        """Builds it.

        Args:
            speed, load: what is planned.
        """
        (folder / "wheel.urdf").write_text(_WHEEL.format(inertia=inertia))
        path = folder / "wheel.yaml"
        path.write_text("{urdf: wheel.urdf, base: bench, fixed_base: true, joints: [axis]}")
        names, _ = load_description(path)
        drive = drive if isinstance(drive, PiecewisePolynomial) else PiecewisePolynomial([[drive]])
        time = np.arange(0.0, 2.0, 0.01)[:, None]
        planned = JointMotion(
            velocity=speed * np.sin(6 * time),
            position=-speed / 6 * np.cos(6 * time),
            time=time,
            time_step=time_step,
            load=np.full_like(time, load),
        )
        self.law = implicit_law([effect.resolve(names) for effect in effects], planned)
        builder, config = DiagramBuilder(), MultibodyPlantConfig(time_step=time_step)
        config.discrete_contact_approximation = contact
        self.robot, _ = make_robot(
            path,
            builder=builder,
            config=config,
            rotor_inertia={"axis": rotor_inertia},
            implicit=self.law.torque,
        )
        self.plant, self.time_step = self.robot.plant, time_step
        state = builder.AddSystem(MatrixGain(self.robot.joint_state_selector))
        builder.Connect(self.plant.get_state_output_port(), state.get_input_port())
        source = builder.AddSystem(TrajectorySource(drive))
        ports = {
            "joint_state": state.get_output_port(),
            "torque_command": source.get_output_port(),
            "net_actuation": self.plant.get_net_actuation_output_port(),
        }
        ports |= add_joint_torques(builder, self.robot, self.law, time_step, ports)
        record = [LogVectorOutput(port, builder, time_step) for port in ports.values()]
        self.sinks = dict(zip(ports, record, strict=True))
        self.diagram = builder.Build()

    def run(self, speed: float, duration: float) -> dict[str, np.ndarray]:
        """Of N steps from a start speed: `position` and `command` at their start, `velocity` at
        their end, `loss` in them, and the `law` of it."""
        simulator = Simulator(self.diagram)
        context = simulator.get_mutable_context()
        self.plant.SetVelocities(self.plant.GetMyMutableContextFromRoot(context), [speed])
        simulator.AdvanceTo(duration + self.time_step)
        data = {name: sink.FindLog(context).data().T for name, sink in self.sinks.items()}
        position, velocity = np.split(data["joint_state"], 2, axis=1)
        command, loss = data["torque_command"][:-1], data["torque_loss"][1:]
        forces = (data["net_actuation"], data["explicit_force"])
        over_time = loss_over_time(self.robot, velocity, *forces)
        np.testing.assert_allclose(over_time, data["torque_loss"], rtol=0, atol=0)
        motion = JointMotion(
            velocity=velocity[1:],
            position=position[:-1],
            command=command,
            time=self.time_step * np.arange(len(command))[:, None],
            time_step=self.time_step,
            load=np.vstack([command[:1], (command - loss)[:-1]]),
        )
        law = law_over_time(self.law.effects, motion)
        found = {"position": position, "velocity": velocity, "command": command, "loss": loss}
        return {name: values[:, 0] for name, values in {**found, "law": law}.items()}


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def swing(size: float, frequency: float = 3.0) -> PiecewisePolynomial:
    time = np.linspace(0.0, 2.0, 2001)
    torque = size * np.sin(2 * np.pi * frequency * time)
    return PiecewisePolynomial.FirstOrderHold(time, torque[None])


def jerk(size: float) -> PiecewisePolynomial:
    """Torque that jumps every 20 ms."""
    time = np.arange(0.0, 2.0, 0.02)
    torque = size * np.random.default_rng(4).uniform(-1.0, 1.0, len(time))
    return PiecewisePolynomial.ZeroOrderHold(time, torque[None])


@pytest.mark.parametrize("contact", ["lagged", "similar", "sap"])
@pytest.mark.parametrize("time_step", [5e-4, 1e-3, 2e-3])
@pytest.mark.parametrize("drive", [swing(60.0), jerk(120.0)], ids=["swing", "jerk"])
@pytest.mark.parametrize(
    "effects",
    [
        [ViscousFriction(viscous={"all": 200.0})],
        [ClippedFriction(coulomb={"all": 40.0}, transition={"all": 0.008})],
        [ClippedFriction(coulomb={"all": 40.0}), ViscousFriction(viscous={"all": 5.0})],
    ],
    ids=["viscous", "clipped", "both"],
)
def test_what_the_solver_holds_itself_is_exact_at_any_slope(
    tmp_path: Path,
    effects: list[JointTorqueEffect],
    drive: PiecewisePolynomial,
    time_step: float,
    contact: str,
):
    wheel = Wheel(tmp_path, effects, drive, time_step=time_step, contact=contact)
    found = wheel.run(0.3, 1.0)
    assert rms(found["loss"] - found["law"]) < 1e-6 * rms(found["law"])


@pytest.mark.parametrize("time_step", [1e-3, 2e-3])
@pytest.mark.parametrize(
    ("effects", "size", "asked"),
    [
        ([HARMONIC_DRIVE], 60.0, 1e-2),
        ([TABLE_1], 2.0, 2e-2),
        ([HARMONIC_DRIVE, LoadDependentFriction(coefficient={"all": 0.1})], 60.0, 2e-2),
        ([LoadDependentFriction(coefficient={"all": 0.2})], 60.0, 2e-2),
        ([HARMONIC_DRIVE, DirectionalFriction(asymmetry={"all": 10.0})], 60.0, 2e-2),
        ([PreslidingHysteresis(coulomb={"all": 40.0}, displacement={"all": 5e-3})], 60.0, 2e-2),
        ([PreslidingHysteresis(coulomb={"all": 40.0}, displacement={"all": 2e-4})], 60.0, 2e-2),
        ([QuadraticDrag(drag={"all": 5.0})], 30.0, 2e-2),
        ([ThermalDrift(change={"all": 20.0}, warm_up={"all": 2.0})], 60.0, 2e-2),
    ],
    ids=[
        "tanh",
        "stribeck",
        "load beside",
        "load",
        "directional",
        "soft bristle",
        "hard bristle",
        "drag",
        "warm-up",
    ],
)
def test_the_torque_that_acts_is_that_of_the_law(
    tmp_path: Path,
    effects: list[JointTorqueEffect],
    size: float,
    asked: float,
    time_step: float,
):
    """At 2 ms within twice what it is within at 1 ms; a slope times the step over the inertia is up
    to 50 here, ten times that of a walk."""
    wheel = Wheel(tmp_path, effects, swing(size), inertia=0.2, time_step=time_step, load=size)
    found = wheel.run(0.0, 1.5)
    assert rms(found["loss"] - found["law"]) < asked * (time_step / H) * rms(found["law"])
    spectrum = np.abs(np.fft.rfft(found["loss"] - found["loss"].mean())) ** 2
    # Nothing rings: little power above a quarter of the tick rate.
    assert spectrum[len(spectrum) // 2 :].sum() < 0.01 * (time_step / H) * spectrum.sum()


def test_a_joint_gets_the_clamps_that_its_motion_and_its_law_need():
    """Slow ones the most; those whose law falls beyond its hump the least."""
    names = RobotDescription(base="bench", urdf="wheel.urdf", joints=["axis"])
    time = np.arange(0.0, 2.0, H)[:, None]

    def clamps(effect: JointTorqueEffect, speed: float) -> int:
        velocity = speed * np.sin(3.0 * time)
        planned = JointMotion(velocity, time=time, time_step=H, load=np.ones_like(time))
        return int(implicit_law([effect.resolve(names)], planned).torque.has_clamp.sum())

    assert clamps(TABLE_1, 1.0) < clamps(HARMONIC_DRIVE, 1.0) < clamps(HARMONIC_DRIVE, 0.01)
    assert clamps(HARMONIC_DRIVE, 0.0) == clamps(HARMONIC_DRIVE, 0.01)
    assert clamps(TABLE_1, 0.0) > clamps(HARMONIC_DRIVE, 1.0)


def test_a_law_that_rises_unsaid_rings_and_shows_it(tmp_path: Path):
    """The negative case: the same law, but nothing tells how it rises."""

    class Unsaid(CoulombViscousFriction):
        rise = staticmethod(JointTorqueEffect.rise)

    values = (HARMONIC_DRIVE.coulomb, HARMONIC_DRIVE.viscous, HARMONIC_DRIVE.transition)
    found = Wheel(tmp_path, [Unsaid(*values)], 30.0).run(2.0, 0.4)
    assert rms(found["loss"] - found["law"]) > 0.5 * rms(found["law"])


def exact_velocity(
    law: Callable[[np.ndarray], np.ndarray],
    inertia: float,
    drive: float,
    speed: float,
    duration: float,
) -> float:
    """Final velocity of the wheel from scipy's stiff integrator."""
    solution = solve_ivp(
        lambda _, v: (drive - law(v)) / inertia,
        (0, duration),
        [speed],
        method="Radau",
        rtol=1e-9,
        atol=1e-12,
    )
    return float(solution.y[0, -1])


@pytest.mark.parametrize(
    ("effect", "inertia", "drive", "speed"),
    [(TABLE_1, 0.1, 0.8, 0.5), (HARMONIC_DRIVE, 0.05, 60.0, 3.0)],
)
def test_moving_joint_converges_under_step_halving(
    tmp_path: Path,
    effect: JointTorqueEffect,
    inertia: float,
    drive: float,
    speed: float,
):
    steps = (H, H / 2, H / 4)
    wheels = [Wheel(tmp_path, [effect], drive, inertia=inertia, time_step=h) for h in steps]
    law = wheels[0].law.effects[0]
    motion = (inertia, drive, speed, 0.02)
    truth = exact_velocity(lambda v: law.torque_and_slope(JointMotion(v))[0], *motion)
    errors = [abs(wheel.run(speed, 0.02)["velocity"][-2] - truth) for wheel in wheels]
    assert errors[1] < 0.65 * errors[0]
    assert errors[2] < 0.65 * errors[1]
    assert errors[2] < 0.01 * speed


@pytest.mark.parametrize("time_step", [2e-3, 1e-3, 5e-4])
def test_stiff_joint_comes_to_rest_without_ringing(tmp_path: Path, time_step: float):
    """Slope times step over inertia is 100 at 1 ms: an explicit torque would throw it about."""
    wheel = Wheel(tmp_path, [HARMONIC_DRIVE], 30.0, time_step=time_step)
    found = wheel.run(2.0, 0.4)
    assert np.ptp(found["velocity"][-20:]) < 1e-6
    assert found["law"][-1] == pytest.approx(30.0, rel=1e-3)
    assert found["loss"][-1] == pytest.approx(30.0, rel=1e-3)


@pytest.mark.parametrize("time_step", [1e-3, 5e-4])
def test_stiff_joint_at_rest_stays_at_rest(tmp_path: Path, time_step: float):
    found = Wheel(tmp_path, [HARMONIC_DRIVE], 0.0, time_step=time_step).run(0.0, 0.1)
    assert np.all(found["velocity"] == 0)
    assert np.all(found["loss"] == 0)


def test_links_get_what_the_motor_gives_less_the_loss(tmp_path: Path):
    """Angular momentum, with several clamps and a rotor in one joint: nothing is counted twice."""
    wheel = Wheel(tmp_path, [TABLE_1, HARMONIC_DRIVE], swing(60.0), rotor_inertia=0.3)
    assert wheel.law.torque.has_clamp.sum() > 2
    found = wheel.run(0.5, 0.5)
    impulse = (found["command"] - found["loss"]) * H
    np.testing.assert_allclose(0.35 * np.diff(found["velocity"]), impulse, atol=1e-10)


@pytest.mark.parametrize("displacement", [2e-4, 5e-3])
@pytest.mark.parametrize("time_step", [2e-3, 1e-3, 5e-4])
def test_bristles_hold_a_joint_without_ringing(
    tmp_path: Path,
    time_step: float,
    displacement: float,
):
    """40 Nm over 0.2 mrad is a spring that is stiffer than a plant step can follow."""
    effect = PreslidingHysteresis(coulomb={"all": 40.0}, displacement={"all": displacement})
    ramp = PiecewisePolynomial.FirstOrderHold([0.0, 1.0, 2.0], np.array([[0.0, 30.0, 30.0]]))
    found = Wheel(tmp_path, [effect], ramp, time_step=time_step).run(0.0, 1.2)
    assert found["loss"][-1] == pytest.approx(30.0, rel=1e-2)
    # Dahl's law at rest: the torque is coulomb (1 - exp(-angle / displacement)).
    exact = -displacement * np.log(1 - 30.0 / 40.0)
    assert 0.98 * exact < found["position"][-1] < 1.05 * exact


def test_motor_crosses_the_gap_before_the_link_feels_it(tmp_path: Path):
    gap, inertia, drive = 0.01, 0.25, 5.0
    effect = Backlash(gap={"all": gap}, rotor_inertia={"all": inertia})
    turned = PiecewisePolynomial.ZeroOrderHold([0.0, 0.1, 1.0], np.array([[drive, -drive, -drive]]))
    found = Wheel(tmp_path, [effect], turned).run(0.0, 0.3)
    loss, crossing = found["loss"], np.sqrt(2 * gap * inertia / drive)
    assert np.all(loss[:100] == 0)
    assert loss[101] == -drive
    # What the drive gives the rotor meanwhile the link gets when it is hit.
    closed = 100 + round(crossing / H) + 2
    speed = drive / 0.05 * 0.1
    assert found["velocity"][closed - 5] == pytest.approx(speed, rel=0.01)
    assert np.all(loss[closed:] == 0)
    assert loss.sum() == pytest.approx(0.0, abs=1e-9)
    assert found["velocity"][300] == pytest.approx(drive / 0.05 * (0.1 - 0.2), rel=0.02)


def test_directional_friction_alone_stays_bounded(tmp_path: Path):
    """It drives the joint one way, up to its own size; a step has more than one solution there."""
    effect = DirectionalFriction(asymmetry={"all": -5.0}, transition={"all": 1e-3})
    found = Wheel(tmp_path, [effect], 1.0).run(0.0, 0.1)
    assert np.abs(found["loss"]).max() < 5.0 + 1e-9
    assert found["velocity"][100] == pytest.approx(0.1 * 6.0 / 0.05, rel=0.03)


@pytest.mark.parametrize(
    "effects",
    [[HARMONIC_DRIVE], [TABLE_1], [TABLE_1, QuadraticDrag(drag={"all": 5.0})]],
    ids=["tanh", "stribeck", "both"],
)
def test_a_table_is_as_good_as_the_law(effects: list[JointTorqueEffect]):
    names = RobotDescription(base="bench", urdf="wheel.urdf", joints=["axis"])
    resolved = [effect.resolve(names) for effect in effects]
    table = law_table(resolved, 1)
    assert isinstance(table, LawTable)
    for speed in np.geomspace(1e-6, 50.0, 300):
        for v in (np.array([speed]), np.array([-speed])):
            exact = sum(effect.torque_and_slope(JointMotion(v))[0] for effect in resolved)
            np.testing.assert_allclose(look_up(table, v), exact, rtol=1e-6)
    assert look_up(table, np.zeros(1)) == 0.0


def test_a_law_over_time_is_the_sum_of_its_effects():
    names = RobotDescription(base="bench", urdf="wheel.urdf", joints=["axis"])
    effects = [PreslidingHysteresis(coulomb={"all": 2.0}).resolve(names), TABLE_1.resolve(names)]
    velocity = np.sin(np.linspace(0, 9, 400))[:, None]
    motion = JointMotion(velocity, time=np.arange(400)[:, None] * H, time_step=H)
    bases = [basis_over_time(effect.effect, motion, effect.nonlinear) for effect in effects]
    pairs = zip(effects, bases, strict=True)
    parts = [np.einsum("pn,pNn->Nn", effect.linear, basis) for effect, basis in pairs]
    np.testing.assert_allclose(law_over_time(effects, motion), sum(parts), rtol=1e-12)
