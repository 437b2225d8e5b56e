"""The public names of the package, and where they come from."""

# Scenarios: read from a file, or built of these.
from fbse_drake.scenario import Scenario as Scenario
from fbse_drake.scenario import RobotConfig as RobotConfig
from fbse_drake.scenario import SensorsConfig as SensorsConfig
from fbse_drake.scenario import FallConfig as FallConfig
from fbse_drake.scenario import IdentifyConfig as IdentifyConfig
from fbse_drake.scenario import LogConfig as LogConfig
from fbse_drake.scenario import RecordingConfig as RecordingConfig
from fbse_drake.scenario import build_robot as build_robot
from fbse_drake.scenario import dump_scenario as dump_scenario
from fbse_drake.scenario import load_scenario as load_scenario
from fbse_drake.control.position_loop import PositionLoopConfig as PositionLoopConfig
from fbse_drake.robot.description import Leg as Leg
from fbse_drake.robot.description import RobotDescription as RobotDescription
from fbse_drake.robot.description import load_description as load_description
from fbse_drake.robot.plant import Ground as Ground
from fbse_drake.robot.plant import Robot as Robot
from fbse_drake.robot.plant import make_robot as make_robot
from fbse_drake.robot.push import Push as Push
from fbse_drake.walking.reference import JointSines as JointSines
from fbse_drake.walking.reference import Recorded as Recorded
from fbse_drake.walking.stand import Squat as Squat
from fbse_drake.walking.stand import Sway as Sway
from fbse_drake.walking.walk import Trot as Trot
from fbse_drake.walking.walk import Walk as Walk

# Simulate, estimate.
from fbse_drake.simulate import SimulationResult as SimulationResult
from fbse_drake.simulate import simulate as simulate
from fbse_drake.estimate import EstimationResult as EstimationResult
from fbse_drake.estimate import estimate as estimate
from fbse_drake.station import Station as Station
from fbse_drake.station import build_station as build_station

# Logs.
from fbse_drake.log import Log as Log
from fbse_drake.analysis import convert as convert

# What a model lacks.
from fbse_drake.analysis import ComparisonResult as ComparisonResult
from fbse_drake.analysis import DiagnosisResult as DiagnosisResult
from fbse_drake.analysis import IdentificationResult as IdentificationResult
from fbse_drake.analysis import StudyResult as StudyResult
from fbse_drake.analysis import add as add
from fbse_drake.analysis import compare as compare
from fbse_drake.analysis import diagnose as diagnose
from fbse_drake.analysis import identify as identify
from fbse_drake.analysis import study as study
from fbse_drake.discrepancy.diagnosis.compare import Bin as Bin
from fbse_drake.discrepancy.diagnosis.compare import Channel as Channel
from fbse_drake.discrepancy.diagnosis.compare import Failure as Failure
from fbse_drake.discrepancy.diagnosis.compare import words as words
from fbse_drake.discrepancy.diagnosis.diagnose import EffectStatus as EffectStatus
from fbse_drake.discrepancy.diagnosis.diagnose import Estimate as Estimate
from fbse_drake.discrepancy.diagnosis.diagnose import Finding as Finding
from fbse_drake.discrepancy.diagnosis.prediction import Predictor as Predictor
from fbse_drake.discrepancy.diagnosis.study import StudyStep as StudyStep
from fbse_drake.discrepancy.diagnosis.study import train_and_rest as train_and_rest
from fbse_drake.discrepancy.diagnosis.validation import ModelError as ModelError
from fbse_drake.discrepancy.diagnosis.validation import Validation as Validation
from fbse_drake.discrepancy.diagnosis.validation import model_error as model_error
from fbse_drake.discrepancy.hygiene.hygiene import Hygiene as Hygiene
from fbse_drake.discrepancy.residual.residual import Residual as Residual
from fbse_drake.discrepancy.residual.rollout import RolloutError as RolloutError
from fbse_drake.discrepancy.residual.rollout import rollout as rollout

# Exercises.
from fbse_drake.analysis import hide as hide
from fbse_drake.analysis import reveal as reveal
from fbse_drake.discrepancy.exercises.hidden import Answer as Answer
from fbse_drake.discrepancy.exercises.hidden import Exercise as Exercise
from fbse_drake.discrepancy.exercises.hidden import Revealed as Revealed
from fbse_drake.discrepancy.exercises.hidden import Score as Score

# Physical effects, and what one of your own is made of.
from fbse_drake.effects.effect import Effect as Effect
from fbse_drake.effects.effect import Parameter as Parameter
from fbse_drake.effects.effect import in_library as in_library
from fbse_drake.effects.contact import ContactEffect as ContactEffect
from fbse_drake.effects.contact import FootCreep as FootCreep
from fbse_drake.effects.contact import GroundCompliance as GroundCompliance
from fbse_drake.effects.contact import GroundSlope as GroundSlope
from fbse_drake.effects.geometry import GeometryEffect as GeometryEffect
from fbse_drake.effects.geometry import LinkLength as LinkLength
from fbse_drake.effects.inertia import InertiaEffect as InertiaEffect
from fbse_drake.effects.inertia import BodyCentreOfMass as BodyCentreOfMass
from fbse_drake.effects.inertia import BodyMass as BodyMass
from fbse_drake.effects.inertia import InertialParameters as InertialParameters
from fbse_drake.effects.inertia import Payload as Payload
from fbse_drake.effects.inertia import ReflectedInertia as ReflectedInertia
from fbse_drake.effects.joint_torque import JointMotion as JointMotion
from fbse_drake.effects.joint_torque import JointTorqueEffect as JointTorqueEffect
from fbse_drake.effects.joint_torque import Rise as Rise
from fbse_drake.effects.actuation import DcMotor as DcMotor
from fbse_drake.effects.actuation import TorqueBias as TorqueBias
from fbse_drake.effects.actuation import TorqueDelay as TorqueDelay
from fbse_drake.effects.actuation import TorqueGain as TorqueGain
from fbse_drake.effects.actuation import TorqueLag as TorqueLag
from fbse_drake.effects.actuation import TorqueRollOff as TorqueRollOff
from fbse_drake.effects.actuation import TorqueSaturation as TorqueSaturation
from fbse_drake.effects.friction import CoulombFriction as CoulombFriction
from fbse_drake.effects.friction import CoulombViscousFriction as CoulombViscousFriction
from fbse_drake.effects.friction import DirectionalFriction as DirectionalFriction
from fbse_drake.effects.friction import DirectionalViscousFriction as DirectionalViscousFriction
from fbse_drake.effects.friction import LoadDependentFriction as LoadDependentFriction
from fbse_drake.effects.friction import QuadraticDrag as QuadraticDrag
from fbse_drake.effects.friction import StribeckFriction as StribeckFriction
from fbse_drake.effects.friction import ThermalDrift as ThermalDrift
from fbse_drake.effects.friction import ViscousFriction as ViscousFriction
from fbse_drake.effects.sensor import SensorEffect as SensorEffect
from fbse_drake.effects.sensor import AccelerometerBias as AccelerometerBias
from fbse_drake.effects.sensor import AccelerometerGain as AccelerometerGain
from fbse_drake.effects.sensor import EncoderOffset as EncoderOffset
from fbse_drake.effects.sensor import FootForceBias as FootForceBias
from fbse_drake.effects.sensor import FootForceGain as FootForceGain
from fbse_drake.effects.sensor import FootForceLag as FootForceLag
from fbse_drake.effects.sensor import FootForceMisalignment as FootForceMisalignment
from fbse_drake.effects.sensor import FootMomentBias as FootMomentBias
from fbse_drake.effects.sensor import GyroscopeBias as GyroscopeBias
from fbse_drake.effects.sensor import ImuMisalignment as ImuMisalignment
from fbse_drake.effects.sensor import TransmissionElasticity as TransmissionElasticity
from fbse_drake.effects.transmission import Backlash as Backlash
from fbse_drake.effects.transmission import JointSpring as JointSpring
from fbse_drake.effects.transmission import PreslidingHysteresis as PreslidingHysteresis
from fbse_drake.effects.transmission import TorqueRipple as TorqueRipple

# Sensors.
from fbse_drake.sensors.sensor import Sensor as Sensor
from fbse_drake.sensors.encoders import EncoderConfig as EncoderConfig
from fbse_drake.sensors.foot_force import FootForceConfig as FootForceConfig
from fbse_drake.sensors.imu import ImuConfig as ImuConfig
from fbse_drake.sensors.base_wrench import BaseWrench as BaseWrench
from fbse_drake.sensors.joint_temperature import JointTemperature as JointTemperature
from fbse_drake.sensors.joint_torque import JointTorqueConfig as JointTorqueConfig

# Estimators, and stages of `Fbse` for diagrams of your own.
from fbse_drake.estimators.estimator import Estimator as Estimator
from fbse_drake.estimators.estimator import NoEstimator as NoEstimator
from fbse_drake.estimators.beliefs import USUAL_SENSORS as USUAL_SENSORS
from fbse_drake.estimators.beliefs import SensorBeliefs as SensorBeliefs
from fbse_drake.estimators.actuator_fault import ActuatorFault as ActuatorFault
from fbse_drake.estimators.base_sensor import BaseSensor as BaseSensor
from fbse_drake.estimators.adaptive_friction import AdaptiveFriction as AdaptiveFriction
from fbse_drake.estimators.attitude import AttitudeEstimator as AttitudeEstimator
from fbse_drake.estimators.disturbance_observer import DisturbanceObserver as DisturbanceObserver
from fbse_drake.estimators.disturbance_observers import ExtendedState as ExtendedState
from fbse_drake.estimators.disturbance_observers import FilteredDisturbance as FilteredDisturbance
from fbse_drake.estimators.fbse import Fbse as Fbse
from fbse_drake.estimators.filtered_model import FilteredModel as FilteredModel
from fbse_drake.estimators.fixed_friction import FixedFriction as FixedFriction
from fbse_drake.estimators.floating_base import ImuMount as ImuMount
from fbse_drake.estimators.friction import ModelAided as ModelAided
from fbse_drake.estimators.friction import ModelAidedEstimator as ModelAidedEstimator
from fbse_drake.estimators.fuzzy import FuzzyFriction as FuzzyFriction
from fbse_drake.estimators.lugre import LuGreFriction as LuGreFriction
from fbse_drake.estimators.radial_basis import RadialBasisFriction as RadialBasisFriction
from fbse_drake.estimators.torque_sensor import TorqueSensor as TorqueSensor
from fbse_drake.estimators.true_friction import TrueFriction as TrueFriction

# What the controller makes of an estimate.
from fbse_drake.control.compensation import Compensation as Compensation
from fbse_drake.control.compensation import FaultReconfiguration as FaultReconfiguration
from fbse_drake.control.compensation import FeedforwardCompensation as FeedforwardCompensation
from fbse_drake.control.compensation import IntegralCompensation as IntegralCompensation
from fbse_drake.control.compensation import NoCompensation as NoCompensation

# The libraries, by class name.
from fbse_drake.libraries import compensations_by_name as compensations_by_name
from fbse_drake.libraries import effects_by_name as effects_by_name
from fbse_drake.libraries import estimators_by_name as estimators_by_name
from fbse_drake.libraries import sensors_by_name as sensors_by_name

# Figures and numbers, each of a log or of a result.
from fbse_drake.report import discrepancy_figures as discrepancy_figures
from fbse_drake.report import figures as figures
from fbse_drake.report import metrics as metrics
from fbse_drake.report.sentences import parameters_text as parameters_text

# Command line, errors, progress.
from fbse_drake.cli import main as main
from fbse_drake.errors import InputError as InputError
from fbse_drake.progress import Interrupted as Interrupted
from fbse_drake.progress import ProgressLines as ProgressLines

__version__: str
