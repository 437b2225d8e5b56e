"""The public names of the package, and where they come from."""

# Scenarios: read from a file, or built of these.
from .scenario import Scenario as Scenario
from .scenario import RobotConfig as RobotConfig
from .scenario import SensorsConfig as SensorsConfig
from .scenario import FallConfig as FallConfig
from .scenario import IdentifyConfig as IdentifyConfig
from .scenario import LogConfig as LogConfig
from .scenario import RecordingConfig as RecordingConfig
from .scenario import build_robot as build_robot
from .scenario import dump_scenario as dump_scenario
from .scenario import load_scenario as load_scenario
from .control.position_loop import PositionLoopConfig as PositionLoopConfig
from .robot.description import Leg as Leg
from .robot.description import RobotDescription as RobotDescription
from .robot.description import load_description as load_description
from .robot.plant import Ground as Ground
from .robot.plant import Robot as Robot
from .robot.plant import make_robot as make_robot
from .robot.push import Push as Push
from .walking.reference import JointSines as JointSines
from .walking.reference import Recorded as Recorded
from .walking.stand import Squat as Squat
from .walking.stand import Sway as Sway
from .walking.walk import Trot as Trot
from .walking.walk import Walk as Walk

# Simulate, estimate.
from .simulation import SimulationResult as SimulationResult
from .simulation import simulate as simulate
from .estimation import EstimationResult as EstimationResult
from .estimation import estimate as estimate
from .station import Station as Station
from .station import build_station as build_station

# Logs.
from .log import Log as Log
from .analysis import convert as convert

# What a model lacks.
from .analysis import ComparisonResult as ComparisonResult
from .analysis import DiagnosisResult as DiagnosisResult
from .analysis import IdentificationResult as IdentificationResult
from .analysis import StudyResult as StudyResult
from .analysis import add as add
from .analysis import compare as compare
from .analysis import diagnose as diagnose
from .analysis import identify as identify
from .analysis import study as study
from .discrepancy.diagnosis.compare import Bin as Bin
from .discrepancy.diagnosis.compare import Channel as Channel
from .discrepancy.diagnosis.compare import Failure as Failure
from .discrepancy.diagnosis.compare import words as words
from .discrepancy.diagnosis.diagnose import EffectStatus as EffectStatus
from .discrepancy.diagnosis.diagnose import Estimate as Estimate
from .discrepancy.diagnosis.diagnose import Finding as Finding
from .discrepancy.diagnosis.prediction import Predictor as Predictor
from .discrepancy.diagnosis.study import StudyStep as StudyStep
from .discrepancy.diagnosis.study import train_and_rest as train_and_rest
from .discrepancy.diagnosis.validation import ModelError as ModelError
from .discrepancy.diagnosis.validation import Validation as Validation
from .discrepancy.diagnosis.validation import model_error as model_error
from .discrepancy.hygiene.hygiene import Hygiene as Hygiene
from .discrepancy.residual.residual import Residual as Residual
from .discrepancy.residual.rollout import RolloutError as RolloutError
from .discrepancy.residual.rollout import rollout as rollout

# Exercises.
from .analysis import hide as hide
from .analysis import reveal as reveal
from .discrepancy.exercises.hidden import Answer as Answer
from .discrepancy.exercises.hidden import Exercise as Exercise
from .discrepancy.exercises.hidden import Revealed as Revealed
from .discrepancy.exercises.hidden import Score as Score

# Physical effects, and what one of your own is made of.
from .effects.effect import Effect as Effect
from .effects.effect import Parameter as Parameter
from .effects.effect import in_library as in_library
from .effects.contact import ContactEffect as ContactEffect
from .effects.contact import FootCreep as FootCreep
from .effects.contact import GroundCompliance as GroundCompliance
from .effects.contact import GroundSlope as GroundSlope
from .effects.counterbalance import Counterbalance as Counterbalance
from .effects.geometry import BaseTilt as BaseTilt
from .effects.geometry import GeometryEffect as GeometryEffect
from .effects.geometry import ImuPosition as ImuPosition
from .effects.geometry import LinkLength as LinkLength
from .robot.plant import Shifts as Shifts
from .effects.inertia import InertiaEffect as InertiaEffect
from .effects.inertia import BodyCentreOfMass as BodyCentreOfMass
from .effects.inertia import BodyMass as BodyMass
from .effects.inertia import InertialParameters as InertialParameters
from .effects.inertia import Payload as Payload
from .effects.inertia import ReflectedInertia as ReflectedInertia
from .effects.joint_torque import JointMotion as JointMotion
from .effects.joint_torque import JointTorqueEffect as JointTorqueEffect
from .effects.joint_torque import Rise as Rise
from .effects.actuation import DcMotor as DcMotor
from .effects.actuation import TorqueBias as TorqueBias
from .effects.actuation import TorqueDelay as TorqueDelay
from .effects.actuation import TorqueGain as TorqueGain
from .effects.actuation import TorqueLag as TorqueLag
from .effects.actuation import TorqueReadingLag as TorqueReadingLag
from .effects.actuation import TorqueRollOff as TorqueRollOff
from .effects.actuation import TorqueSaturation as TorqueSaturation
from .effects.friction import CoulombFriction as CoulombFriction
from .effects.friction import CoulombViscousFriction as CoulombViscousFriction
from .effects.friction import DirectionalFriction as DirectionalFriction
from .effects.friction import DirectionalViscousFriction as DirectionalViscousFriction
from .effects.friction import LoadDependentFriction as LoadDependentFriction
from .effects.friction import QuadraticDrag as QuadraticDrag
from .effects.friction import StribeckFriction as StribeckFriction
from .effects.friction import ThermalDrift as ThermalDrift
from .effects.friction import ViscousFriction as ViscousFriction
from .effects.sensor import SensorEffect as SensorEffect
from .effects.sensor import AccelerometerBias as AccelerometerBias
from .effects.sensor import AccelerometerGain as AccelerometerGain
from .effects.sensor import EncoderOffset as EncoderOffset
from .effects.sensor import FootForceBias as FootForceBias
from .effects.sensor import FootForceGain as FootForceGain
from .effects.sensor import FootForceLag as FootForceLag
from .effects.sensor import FootForceMisalignment as FootForceMisalignment
from .effects.sensor import FootMomentBias as FootMomentBias
from .effects.sensor import GyroscopeBias as GyroscopeBias
from .effects.sensor import ImuMisalignment as ImuMisalignment
from .effects.sensor import MotorEncoderOffset as MotorEncoderOffset
from .effects.sensor import TransmissionElasticity as TransmissionElasticity
from .effects.transmission import Backlash as Backlash
from .effects.transmission import JointSpring as JointSpring
from .effects.transmission import PreslidingHysteresis as PreslidingHysteresis
from .effects.transmission import TorqueRipple as TorqueRipple

# Sensors.
from .sensors.sensor import Sensor as Sensor
from .sensors.encoders import EncoderConfig as EncoderConfig
from .sensors.foot_force import FootForceConfig as FootForceConfig
from .sensors.imu import ImuConfig as ImuConfig
from .sensors.base_wrench import BaseWrench as BaseWrench
from .sensors.joint_temperature import JointTemperature as JointTemperature
from .sensors.joint_torque import JointTorqueConfig as JointTorqueConfig
from .sensors.motor_encoders import MotorEncoderConfig as MotorEncoderConfig

# Estimators, and stages of `Fbse` for diagrams of your own.
from .estimators.estimator import Estimator as Estimator
from .estimators.estimator import NoEstimator as NoEstimator
from .estimators.beliefs import USUAL_SENSORS as USUAL_SENSORS
from .estimators.beliefs import SensorBeliefs as SensorBeliefs
from .estimators.actuator_fault import ActuatorFault as ActuatorFault
from .estimators.base_sensor import BaseSensor as BaseSensor
from .estimators.adaptive_friction import AdaptiveFriction as AdaptiveFriction
from .estimators.attitude import AttitudeEstimator as AttitudeEstimator
from .estimators.disturbance_observer import DisturbanceObserver as DisturbanceObserver
from .estimators.extended_state import ExtendedState as ExtendedState
from .estimators.q_filter import FilteredDisturbance as FilteredDisturbance
from .estimators.fbse import Fbse as Fbse
from .estimators.filtered_model import FilteredModel as FilteredModel
from .estimators.fixed_friction import FixedFriction as FixedFriction
from .estimators.floating_base import ImuMount as ImuMount
from .estimators.model_aided import ModelAided as ModelAided
from .estimators.model_aided import ModelAidedEstimator as ModelAidedEstimator
from .estimators.fuzzy import FuzzyFriction as FuzzyFriction
from .estimators.lugre import LuGreFriction as LuGreFriction
from .estimators.network_friction import NetworkFriction as NetworkFriction
from .estimators.radial_basis import RadialBasisFriction as RadialBasisFriction
from .estimators.torque_sensor import TorqueSensor as TorqueSensor
from .estimators.true_friction import TrueFriction as TrueFriction

# What the controller makes of an estimate.
from .control.compensation import Compensation as Compensation
from .control.compensation import FaultReconfiguration as FaultReconfiguration
from .control.compensation import FeedforwardCompensation as FeedforwardCompensation
from .control.compensation import IntegralCompensation as IntegralCompensation
from .control.compensation import NoCompensation as NoCompensation

# The libraries, by class name.
from .libraries import compensations_by_name as compensations_by_name
from .libraries import effects_by_name as effects_by_name
from .libraries import estimators_by_name as estimators_by_name
from .libraries import sensors_by_name as sensors_by_name

# Figures and numbers, each of a log or of a result.
from .report import discrepancy_figures as discrepancy_figures
from .report import figures as figures
from .report import metrics as metrics
from .report.sentences import parameters_text as parameters_text

# Command line, errors, progress.
from .cli import main as main
from .errors import InputError as InputError
from .progress import Interrupted as Interrupted
from .progress import ProgressLines as ProgressLines

__version__: str
