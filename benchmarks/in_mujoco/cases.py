"""Runs in MuJoCo: with physics that the model lacks, with nothing hidden, with strangers."""

import math
import time
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from benchmarks.cases import judged, sources_checksum
from benchmarks.in_mujoco.loop import Run, record
from benchmarks.in_mujoco.physics import (
    AccelerometerBias,
    CentreOfMass,
    Drag,
    Elasticity,
    EncoderOffset,
    EncoderScale,
    FootGain,
    GyroscopeBias,
    JointProperty,
    LongLink,
    Mass,
    Misalignment,
    MotorBias,
    MotorDelay,
    MotorGain,
    MotorLag,
    MotorLimit,
    MovedImu,
    Nothing,
    Payload,
    Physics,
    Play,
    Ripple,
    Spring,
    Tether,
)
from benchmarks.in_mujoco.robot import make_machine
from fbse_drake import load_scenario
from fbse_drake.campaign.steps import Material
from fbse_drake.control.position_loop import PositionLoopConfig
from fbse_drake.discrepancy.diagnosis.diagnose import diagnose, diagnosis_json
from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.exercises.hidden import Answer, HiddenEffect, Score, score
from fbse_drake.robot.plant import Ground, Robot
from fbse_drake.scenario import (
    RecordingConfig,
    RobotConfig,
    Scenario,
    SensorsConfig,
    build_robot,
    planned_reference,
)
from fbse_drake.sensors.encoders import EncoderConfig
from fbse_drake.walking.plan import PointMotion
from fbse_drake.walking.reference import Recorded, Reference
from fbse_drake.walking.stand import smooth_sine

# Of the arm's axes, from the ground to the tool.
_ROTOR_INERTIA = (2.0, 2.0, 1.0, 0.2, 0.2, 0.1)
_KP = (8000.0, 8000.0, 5000.0, 1000.0, 1000.0, 500.0)
_KD = (200.0, 200.0, 100.0, 20.0, 20.0, 8.0)
_ARM_TORQUE_NOISE = (1.0, 1.0, 0.5, 0.2, 0.2, 0.1)
_POSTURE = (0.0, 0.5, 0.2, 0.0, 0.3, 0.0)
_AMPLITUDE = (1.2, 0.5, 0.6, 1.2, 1.0, 1.5)
# Every axis swings with so many sines: near the multiples of a frequency in this range [Hz].
_SINES = 3
_LOWEST_FREQUENCY = (0.1, 0.25)
# The arm moves for this long, and from rest to rest [s].
_ARM_DURATION, _RAMP = 10.0, 1.5
# Of a torque that is measured or had from the motor's current [Nm].
_LEGS_TORQUE_NOISE = {"all": 0.5}
_WALK = (
    "duration=5.5",
    "reference.single_supports=3",
    "robot.rotor_inertia={all: 0.1}",
    # Without friction in the joints, more damping than the paper's.
    "control.kd={all: 10}",
)
_TROT = ("duration=5", "estimator=!NoEstimator {}")


@dataclass(frozen=True)
class Case:
    """One run in MuJoCo and its diagnosis."""

    name: str
    group: Literal["effect", "decoy", "stranger"]
    robot: Literal["arm", "biped", "quadruped"]
    physics: Physics = field(default_factory=Nothing)
    # What is known of the run: another motion of the arm, other words of the walk's scenario,
    # another noise of the torques.
    motion: int = 0
    overrides: tuple[str, ...] = ()
    torque_noise: float = 1.0
    # What is not known: see `Run`.
    gain: float = 1.0
    ground: Ground | None = None
    integrator: str = "implicitfast"
    # Effects that rightly stand for a decoy's difference.
    allowed: tuple[str, ...] = ()

    @property
    def seed(self) -> int:
        """Of the sensors' noise."""
        return zlib.crc32(self.name.encode())


def effects() -> list[Case]:
    """Hidden effects that the library has."""

    def arm(name: str, physics: Physics) -> Case:
        return Case(f"arm-{name}", "effect", "arm", physics, motion=zlib.crc32(name.encode()))

    def biped(name: str, physics: Physics, torque_noise: float = 0.0) -> Case:
        noisy = "-noisy" if torque_noise else ""
        return Case(f"biped-{name}{noisy}", "effect", "biped", physics, torque_noise=torque_noise)

    axes = tuple(f"axis_{number}" for number in range(1, 7))
    return [
        arm("friction-axis_3", JointProperty("dof_frictionloss", ("axis_3",), 8.0)),
        arm("friction-axis_5", JointProperty("dof_frictionloss", ("axis_5",), 0.4)),
        arm("damping-axis_2", JointProperty("dof_damping", ("axis_2",), 12.0)),
        arm("damping-axis_4", JointProperty("dof_damping", ("axis_4",), 1.0)),
        arm("damping-all", JointProperty("dof_damping", axes, 2.0)),
        arm("armature-axis_1", JointProperty("dof_armature", ("axis_1",), 0.6)),
        arm("armature-axis_6", JointProperty("dof_armature", ("axis_6",), 0.1)),
        arm("mass-link_3", Mass("link_3", 1.5)),
        arm("mass-link_5", Mass("link_5", 0.6)),
        arm("com-link_2", CentreOfMass("link_2", (0.03, 0.0, 0.02))),
        arm("payload", Payload("link_6", 2.0, (0.12, 0.03, 0.0))),
        arm("gain-axis_2", MotorGain("axis_2", 0.92)),
        arm("gain-axis_3", MotorGain("axis_3", 1.06)),
        arm("lag-axis_2", MotorLag("axis_2", 0.008)),
        arm("delay-axis_3", MotorDelay("axis_3", 0.006)),
        arm("bias-axis_3", MotorBias("axis_3", 4.0)),
        arm("limit-axis_1", MotorLimit("axis_1", 45.0)),
        arm("drag-axis_1", Drag("axis_1", 15.0)),
        arm("offset-axis_2", EncoderOffset("axis_2", 0.03)),
        arm("offset-axis_3", EncoderOffset("axis_3", 0.02)),
        arm("spring-axis_2", Spring("axis_2", 30.0, rest=0.5)),
        arm("spring-axis_5", Spring("axis_5", 3.0)),
        arm("ripple-axis_1", Ripple("axis_1", 3.0, cycles=20.0)),
        arm("ripple-axis_3", Ripple("axis_3", 4.0, cycles=12.0)),
        arm("elasticity-axis_2", Elasticity("axis_2", 4000.0, damping=40.0)),
        arm("play-axis_1", Play("axis_1", 0.01)),
        biped("damping-left_knee", JointProperty("dof_damping", ("left_knee_pitch",), 6.0)),
        biped("damping-right_hip", JointProperty("dof_damping", ("right_hip_pitch",), 6.0)),
        biped("friction-left_ankle", JointProperty("dof_frictionloss", ("left_ankle_pitch",), 3.0)),
        biped("friction-right_hip", JointProperty("dof_frictionloss", ("right_hip_roll",), 4.0), 1),
        biped("armature-left_knee", JointProperty("dof_armature", ("left_knee_pitch",), 0.25)),
        biped("mass-trunk", Mass("trunk", 4.0)),
        biped("mass-left_thigh", Mass("left_thigh", 2.0), 1),
        biped("com-trunk", CentreOfMass("trunk", (0.02, 0.01, 0.0))),
        biped("length-left_shank", LongLink("left_shank", 0.004)),
        biped("length-right_thigh", LongLink("right_thigh", -0.003), 1),
        biped("gain-left_knee", MotorGain("left_knee_pitch", 0.9)),
        biped("gain-right_hip", MotorGain("right_hip_roll", 1.1), 1),
        biped("lag-right_knee", MotorLag("right_knee_pitch", 0.004)),
        biped("delay-left_hip", MotorDelay("left_hip_pitch", 0.003)),
        biped("bias-right_hip", MotorBias("right_hip_pitch", 5.0)),
        biped("spring-left_hip", Spring("left_hip_pitch", 40.0, rest=-0.4)),
        biped("ripple-right_knee", Ripple("right_knee_pitch", 3.0, cycles=40.0)),
        biped("offset-right_ankle", EncoderOffset("right_ankle_pitch", 0.01)),
        biped("offset-left_knee", EncoderOffset("left_knee_pitch", 0.015), 1),
        biped("accelerometer-bias", AccelerometerBias((0.2, 0.1, 0.0))),
        biped("gyroscope-bias", GyroscopeBias((0.02, -0.01, 0.0))),
        biped("misalignment", Misalignment((0.02, 0.01, 0.0))),
        biped("moved-imu", MovedImu((0.03, -0.02, 0.04))),
        biped("foot-gain", FootGain("left", 1.05)),
    ]


def decoys() -> list[Case]:
    """Nothing hidden: other noise, motions, controllers, grounds and integrators."""

    def decoy(robot: Literal["arm", "biped"], name: str, **differences: Any) -> Case:
        return Case(f"decoy-{robot}-{name}", "decoy", robot, **differences)

    ground = ("GroundCompliance", "FootCreep")
    return [
        *(decoy("arm", f"motion-{number}", motion=number) for number in range(1, 5)),
        decoy("arm", "exact-torque", torque_noise=0.0),
        decoy("arm", "exact-torque-rk4", torque_noise=0.0, integrator="rk4"),
        decoy("arm", "noisy-torque", torque_noise=3.0),
        decoy("arm", "low-gain", gain=0.4),
        decoy("arm", "euler", integrator="euler"),
        decoy("arm", "rk4", integrator="rk4"),
        *(decoy("biped", f"seed-{number}", torque_noise=0.0) for number in range(2)),
        *(decoy("biped", f"noisy-torque-{number}") for number in range(2)),
        decoy("biped", "short-steps", torque_noise=0.0, overrides=("reference.step_length=0.05",)),
        decoy(
            "biped",
            "high-steps",
            torque_noise=0.0,
            overrides=("reference.step_height=0.06", "reference.com_height=0.64"),
        ),
        decoy("biped", "high-gain", torque_noise=0.0, gain=1.5),
        decoy(
            "biped", "soft-ground", torque_noise=0.0, ground=Ground(stiffness=5e5), allowed=ground
        ),
        decoy(
            "biped",
            "less-damped-ground",
            torque_noise=0.0,
            ground=Ground(dissipation=30.0),
            allowed=ground,
        ),
        decoy("biped", "euler", torque_noise=0.0, integrator="euler"),
        decoy("biped", "rk4", torque_noise=0.0, integrator="rk4"),
    ]


def strangers() -> list[Case]:
    """What the library does not have."""
    lift = ("axis_1", "axis_2", "axis_3")
    rope = Tether("link_4", (0.6, 0.9, 0.2), stiffness=40.0, length=0.3, joints=lift)
    return [
        Case("stranger-arm-tether", "stranger", "arm", rope),
        Case("stranger-arm-scale-axis_3", "stranger", "arm", EncoderScale("axis_3", 1.05)),
        Case(
            "stranger-biped-tether",
            "stranger",
            "biped",
            Tether("trunk", (-1.0, 0.0, 0.8), stiffness=40.0, length=0.5),
            torque_noise=0.0,
        ),
    ]


def all_cases() -> tuple[list[Case], list[Case], list[Case]]:
    """Effects, decoys and strangers."""
    return effects(), decoys(), strangers()


def judge(material: Material) -> dict[str, str]:
    """Runs the case of this name; see `benchmarks.store.Store`."""
    name = material.values["case"]["name"]
    (case,) = (case for group in all_cases() for case in group if case.name == name)
    return run_and_judge(case)


def setting(case: Case) -> tuple[Scenario, Reference]:
    """What is believed of a case's robot and sensors, and the motion that it is to follow."""
    return {"arm": _arm, "biped": _biped, "quadruped": _quadruped}[case.robot](case)


def run_and_judge(case: Case) -> dict[str, str]:
    """Runs a case and diagnoses its log; see `benchmarks.cases.judged`."""
    return judged(case, _run(case), sources())


def _run(case: Case) -> dict[str, Any]:
    scenario, reference = setting(case)
    run = Run(
        scenario,
        case.seed,
        case.physics,
        gain=case.gain,
        ground=case.ground,
        integrator=case.integrator,
    )
    log = record(run, reference, case.robot)
    start = time.perf_counter()
    diagnoses = [diagnosis_json(diagnose(Predictor(scenario, log)))]
    duration = time.perf_counter() - start
    answer, best = best_score(case, diagnoses)
    return {
        "answer": asdict(answer),
        "score": asdict(best),
        "wall_time": duration,
        "steps": [],
        "diagnoses": diagnoses,
    }


def best_score(case: Case, diagnoses: Sequence[dict[str, Any]]) -> tuple[Answer, Score]:
    """The answer that the diagnoses come nearest to, of those that say the hidden physics truly."""
    if case.group == "effect":
        answers = [Answer("library", "medium", 1.0, (hidden,)) for hidden in case.physics.answers]
    elif case.group == "stranger":
        name = type(case.physics).__name__
        hidden = HiddenEffect(name, case.physics.targets, math.nan, {})
        answers = [Answer("stranger", "medium", 1.0, (hidden,))]
    else:
        answers = [Answer("decoy", "medium", 1.0, ())]
    scored = [(answer, score(answer, diagnoses)) for answer in answers]
    best, of_best = max(
        scored,
        key=lambda pair: (
            pair[1].first,
            any(pair[1].found.values()),
            any(pair[1].confusable.values()),
        ),
    )
    true = {hidden.effect for hidden in case.physics.answers}
    return best, replace(of_best, wrong=tuple(name for name in of_best.wrong if name not in true))


def arm_scenario(torque_noise: float = 1.0) -> Scenario:
    """The arm that the model believes in, which is the arm without what is hidden."""

    def by_axis(values: Sequence[float], factor: float = 1.0) -> dict[str, float]:
        return {f"axis_{k}": factor * value for k, value in enumerate(values, 1)}

    body = RobotConfig(description="arm", rotor_inertia=by_axis(_ROTOR_INERTIA))
    return Scenario(
        title="A six-axis arm in MuJoCo.",
        duration=_ARM_DURATION,
        robot=body,
        model=body,
        reference=Recorded(),
        sensors=SensorsConfig(
            encoders=EncoderConfig(resolution=4.8e-5, velocity_noise=5e-4),
        ),
        control=PositionLoopConfig(kp=by_axis(_KP), kd=by_axis(_KD), torque_limit={"all": 1000.0}),
        recording=RecordingConfig(torque_noise=by_axis(_ARM_TORQUE_NOISE, torque_noise)),
    )


def arm_motion(robot: Robot, seed: int, period: float) -> Reference:
    """Every axis swings with several sines, from rest to rest; with the torques that a robot
    without faults needs.

    Args:
        robot: the model.
        seed: of frequencies, phases and shares of the amplitude.
        period: of the samples [s].
    """
    random = np.random.default_rng(seed)
    times = np.arange(round(_ARM_DURATION / period) + 1) * period
    motion = np.zeros((3, len(times), len(_POSTURE)))
    motion[0] += _POSTURE
    for axis, amplitude in enumerate(_AMPLITUDE):
        shares = random.uniform(0.4, 1.0, _SINES)
        for k, share in enumerate(shares / shares.sum(), 1):
            frequency, phase = random.uniform(*_LOWEST_FREQUENCY), random.uniform(0, 2 * np.pi)
            sine = smooth_sine(times, k * frequency, _RAMP, _ARM_DURATION, phase)
            motion[:, :, axis] += amplitude * share * np.array(sine)
    torque = make_machine(robot).inverse_dynamics(*motion)
    still = np.zeros((len(times), 3))
    return Reference(times, *motion, torque, PointMotion(still, still, still), None)


def sources() -> str:
    """Checksum of what decides on a case."""
    folder = Path(__file__).parent
    return sources_checksum(*sorted(folder.glob("*.py")), note=mujoco.__version__)


def _arm(case: Case) -> tuple[Scenario, Reference]:
    scenario = arm_scenario(case.torque_noise)
    robot = build_robot(scenario.believed)
    return scenario, arm_motion(robot, case.motion, scenario.control.period)


def _biped(case: Case) -> tuple[Scenario, Reference]:
    scenario = load_scenario("frictionless_walk", overrides=(*_WALK, *case.overrides))
    return _walking(scenario, case, "The paper's walk in MuJoCo.")


def _quadruped(case: Case) -> tuple[Scenario, Reference]:
    scenario = load_scenario("quadruped_trot", overrides=(*_TROT, *case.overrides))
    bare = replace(scenario, robot=replace(scenario.robot, effects={}))
    return _walking(bare, case, "A trot in MuJoCo.")


def _walking(scenario: Scenario, case: Case, title: str) -> tuple[Scenario, Reference]:
    noise = {joint: case.torque_noise * value for joint, value in _LEGS_TORQUE_NOISE.items()}
    scenario = replace(
        scenario,
        title=title,
        model=scenario.robot,
        recording=replace(scenario.recording, torque_noise=noise),
    )
    return scenario, planned_reference(scenario, build_robot(scenario.believed))
