"""Friction by small neural networks that were trained from a log, to be compared with FBSE."""

import warnings
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from pydrake.systems.framework import Context

from fbse_drake.errors import InputError, require_positive
from fbse_drake.estimators.chain import Chain
from fbse_drake.estimators.estimator import Estimator, in_library
from fbse_drake.estimators.records import record_type
from fbse_drake.estimators.recursive import Clock, RecursiveEstimator
from fbse_drake.estimators.sensor_monitor import SensorMonitorConfig
from fbse_drake.log import Log
from fbse_drake.robot.description import RobotDescription

if TYPE_CHECKING:
    from sklearn.neural_network import MLPRegressor

# Beginning of a log that nothing is learned from, and time between samples that are [s].
_SETTLING_TIME, _SAMPLE_TIME = 0.5, 0.004
# Share of a log, at its end, that decides how much weights are penalised; and what is tried.
_HELD_OUT = 0.2
_PENALTIES = (1e-3, 1e-2, 1e-1, 1.0)
# Networks of a joint, hidden units of each, and steps of the optimisation.
_MEMBERS, _UNITS, _STEPS = 3, 8, 300
# Velocity below which the input of a network is linear, above logarithmic [rad/s].
_FINEST = 0.01


@dataclass(frozen=True)
class JointNetworks:
    """Networks of one joint, each from another start; the friction is the mean of what they say.

    Each has one hidden layer: a + b tanh(c asinh(w / 0.01 rad/s) + d) over the velocity w.
    """

    # c and d of each network's hidden units [1], b of each [Nm], and a of each network [Nm].
    slopes: list[list[float]]
    shifts: list[list[float]]
    torques: list[list[float]]
    offsets: list[float]
    # Slowest and fastest velocity that was seen [rad/s].
    seen: list[float]
    # Standard deviation of what they left of torques that they had not seen [Nm].
    deviation: float

    def __post_init__(self) -> None:
        require_positive(self, "deviation")
        if len(self.seen) != 2 or self.seen[0] > self.seen[1]:
            raise InputError("seen: expected the slowest and the fastest velocity")
        shapes = {tuple(map(len, of)) for of in (self.slopes, self.shifts, self.torques)}
        sizes = next(iter(shapes))
        if len(shapes) > 1 or len(set(sizes)) != 1 or len(sizes) != len(self.offsets):
            raise InputError("slopes, shifts, torques, offsets: expected as many of each")


@in_library
@dataclass(frozen=True)
class NetworkFriction(Estimator):
    """A law of the velocity that small neural networks learned beforehand (Selmic and Lewis 2002).

    `identified` trains them on a log with scikit-learn (extra `learn`); numpy executes them. How
    strongly weights are penalised is decided on the last fifth of the log. A network knows nothing
    of what it did not see: there its law stays what it is at the last velocity that was seen, and
    its stated deviation, elsewhere that on the last fifth together with the spread of networks
    from several starts (Lakshminarayanan et al. 2017), grows as if friction could go on in
    proportion to the velocity. Of a joint without networks the friction is zero and `unknown`.
    """

    knows: ClassVar[str] = "a walk of the robot, to be trained on beforehand"
    measures: ClassVar[str] = "nothing, once it is trained"

    # By joint.
    networks: dict[str, JointNetworks] = field(default_factory=dict)
    # Deviation of the friction of a joint without networks [Nm].
    unknown: float = 50.0

    def __post_init__(self) -> None:
        require_positive(self, "unknown")

    def identified(self, log: Log) -> "NetworkFriction":
        """Networks of all joints, of the velocities and the estimated friction of a log, behind the
        filters' settling. (Friction as it is measured in a tick is mostly noise.)

        Raises:
            InputError: scikit-learn is not installed.
        """
        step = max(1, round(_SAMPLE_TIME / float(log.meta["period"])))
        rows = np.flatnonzero(log.time > log.time[0] + _SETTLING_TIME)[::step]
        velocity, torque = log["joint/velocity"][rows], log["estimate/joint/friction_torque"][rows]
        networks = {
            joint: trained(velocity[:, j], torque[:, j]) for j, joint in enumerate(log.joints)
        }
        return NetworkFriction(networks, self.unknown)

    def check(self, names: RobotDescription) -> None:
        unknown = ", ".join(self.networks.keys() - set(names.joint_names))
        if unknown:
            raise InputError(f"estimator.networks: {unknown}: the robot has no such joint")

    def add(self, chain: Chain) -> None:
        SensorMonitorConfig().add(chain)
        law = NetworkLaw(self, chain.robot.joint_names)
        chain.add(
            "friction",
            partial(NetworkFrictionModel, law, chain.robot.description),
            measurements="sensor_monitor",
        )


def trained(velocity: np.ndarray, torque: np.ndarray) -> JointNetworks:
    """Networks that give the torque (N,) [Nm] of a joint at its velocity (N,) [rad/s].

    Args:
        velocity, torque: in the order of time, of which the end decides on the penalty.

    Raises:
        InputError: scikit-learn is not installed, or there are next to no samples.
    """
    if len(velocity) < 10 * _UNITS:
        raise InputError(f"to train on: expected {10 * _UNITS} samples, found {len(velocity)}")
    inputs, scale = _input(velocity)[:, None], float(np.std(torque)) or 1.0
    targets, end = torque / scale, round(len(torque) * (1 - _HELD_OUT))
    left = {}
    for penalty in _PENALTIES:
        network = _fitted(inputs[:end], targets[:end], penalty, seed=0)
        left[penalty] = scale * _rms(network.predict(inputs[end:]) - targets[end:])
    penalty = min(left, key=left.__getitem__)
    members = [_fitted(inputs, targets, penalty, seed) for seed in range(_MEMBERS)]
    return JointNetworks(
        slopes=[of.coefs_[0][0].tolist() for of in members],
        shifts=[of.intercepts_[0].tolist() for of in members],
        torques=[(scale * of.coefs_[1][:, 0]).tolist() for of in members],
        offsets=[float(scale * of.intercepts_[1][0]) for of in members],
        seen=[float(velocity.min()), float(velocity.max())],
        deviation=max(left[penalty], float(np.finfo(float).tiny)),
    )


def _fitted(inputs: np.ndarray, targets: np.ndarray, penalty: float, seed: int) -> "MLPRegressor":
    """One network, (N, 1) to (N,)."""
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.neural_network import MLPRegressor
    except ImportError:
        needed = "pip install 'fbse_drake[learn]'"
        raise InputError(f"training networks needs scikit-learn: {needed}") from None
    network = MLPRegressor(
        hidden_layer_sizes=(_UNITS,),
        activation="tanh",
        solver="lbfgs",
        alpha=penalty,
        max_iter=_STEPS,
        random_state=seed,
    )
    with warnings.catch_warnings():
        # The last digits are not worth more steps.
        warnings.simplefilter("ignore", ConvergenceWarning)
        return network.fit(inputs, targets)


def _input(velocity: np.ndarray) -> np.ndarray:
    return np.arcsinh(velocity / _FINEST)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


class NetworkLaw:
    """The networks of all joints, in numpy."""

    def __init__(self, config: NetworkFriction, joints: list[str]):
        """Stacks the weights.

        Raises:
            InputError: joints have networks of different sizes.
        """
        given = config.networks.values()
        sizes = {(len(of.slopes), len(of.slopes[0])) for of in given} or {(1, 1)}
        if len(sizes) > 1:
            raise InputError("estimator.networks: expected networks of one size in all joints")
        nothing = np.zeros(next(iter(sizes))).tolist()
        offsets = [0.0] * len(nothing)
        none = JointNetworks(nothing, nothing, nothing, offsets, [0.0, 0.0], config.unknown)
        of_joint = [config.networks.get(joint, none) for joint in joints]
        # (n, members, units) each, and (n, members).
        self._slopes, self._shifts, self._torques, self._offsets = (
            np.array([getattr(of, name) for of in of_joint])
            for name in ("slopes", "shifts", "torques", "offsets")
        )
        self._slowest, self._fastest = np.array([of.seen for of in of_joint]).T
        self._variance = np.array([of.deviation for of in of_joint]) ** 2

    def __call__(self, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Friction and its standard deviation at velocities [rad/s], (n,) each [Nm]."""
        known = velocity.clip(self._slowest, self._fastest)
        hidden = np.tanh(self._slopes * _input(known)[:, None, None] + self._shifts)
        torques = (self._torques * hidden).sum(axis=2) + self._offsets
        torque = torques.mean(axis=1)
        variance = self._variance + torques.var(axis=1)
        # Of a joint that was only seen at rest nothing is in proportion to anything.
        beyond = np.abs(velocity - known) / np.maximum(np.abs(known), _FINEST)
        return torque, np.sqrt(variance + beyond**2 * np.maximum(torque**2, variance))


class NetworkFrictionModel(RecursiveEstimator):
    """Friction of networks at the measured velocity.

    .. pydrake_system::

        name: NetworkFrictionModel
        input_ports:
        - measurements
        output_ports:
        - posterior
        - (one for each field)

    `measurements` is the posterior of a `SensorMonitor`; fields `friction` and `friction_std` (n,)
    [Nm].
    """

    def __init__(
        self, law: NetworkLaw, names: RobotDescription, measurements: np.dtype, clock: Clock
    ):
        n = len(names.joint_names)
        kind = record_type(time=(), status=(), friction=(n,), friction_std=(n,))
        super().__init__(kind, clock)
        self._law = law
        self._measurements = self._declare_record_input("measurements", measurements)
        self._declare_posterior()

    def _tick(
        self,
        context: Context,
        last: np.ndarray,  # noqa: ARG002
        elapsed: float,  # noqa: ARG002
        posterior: np.ndarray,
    ) -> None:
        measured = self._measurements.Eval(context)
        posterior["status"] = measured["trust"][0]
        posterior["friction"], posterior["friction_std"] = self._law(measured["joint_velocity"])
