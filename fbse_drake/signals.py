"""The table of signals: ports of a station, channels of a log that they become, units and shapes.

Sensors and estimators of a user's own add their rows with `register`.
"""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from fbse_drake.errors import InputError

# Sizes of one sample's axes: a number, "n" for all joints, "m" for any number.
Shape = tuple[int | str, ...]


@dataclass(frozen=True)
class Signal:
    """One row of the table: a channel of a log and the port that it comes from.

    A port with several channels has a row for each; its vector is their samples one after the
    other.
    """

    # Pattern of the channel's name (a regular expression); empty for a port that is recorded but
    # for which no channel stands: others are computed from it.
    channel: str
    # Of a revolute joint where it is one for each joint.
    unit: str = "1"
    shape: Shape = ()
    # Name of the station's output port; empty for what no port gives.
    port: str = ""
    # Does a simulation record the port?
    recorded: bool = True
    # Does the port tell at a tick what the channel has of the step that ended then?
    late: bool = False
    # Of an estimate: the estimator of the chain and the field of its posterior.
    estimator: str = ""
    field: str = ""

    @property
    def text(self) -> str:
        """The channel's name for messages, as `foot/<side>/pad_force`."""
        return self.channel.replace(r"\w+", "<side>")

    def sample_shape(self, joints: int, size: int) -> tuple[int, ...]:
        """Shape of a sample that has `size` numbers in all."""
        shape = tuple(joints if axis == "n" else axis for axis in self.shape)
        known = math.prod(int(axis) for axis in shape if axis != "m")
        return tuple(size // known if axis == "m" else int(axis) for axis in shape)


def estimated(
    channel: str,
    estimator: str,
    field: str,
    unit: str = "-",
    shape: Shape = ("m",),
) -> Signal:
    """A row for a field of an estimator's posterior, whose port is named like its channel.

    Args:
        channel: its name, without `estimate/`.
        estimator: name of the system in its chain.
        unit: "-" for that of the filter's own states, see its LeafSystem.
    """
    name = f"estimate/{channel}"
    return Signal(name, unit, shape, name, estimator=estimator, field=field)


def _own(estimator: str, field: str, unit: str = "-", shape: Shape = ("m",)) -> Signal:
    """A field whose channel is named like its estimator and itself."""
    return estimated(f"{estimator}/{field}", estimator, field, unit, shape)


def _status(estimator: str) -> Signal:
    return _own(estimator, "status", "1", ())


# The first row that fits a channel counts. Ports are exported in this order.
_TABLE: list[Signal] = [
    Signal("time", "s"),
    # What sensors measure.
    Signal("joint/position", "rad", ("n",), "measured_joint_state"),
    Signal("joint/velocity", "rad/s", ("n",), "measured_joint_state"),
    Signal("imu/linear_acceleration", "m/s^2", (3,), "measured_imu"),
    Signal("imu/angular_velocity", "rad/s", (3,), "measured_imu"),
    Signal(r"foot/\w+/pad_force", "N", ("m", 3), "measured_pad_force"),
    Signal(r"foot/\w+/wrench", "Nm, N", (6,), "measured_pad_force"),
    Signal("joint/torque_measured", "Nm", ("n",), "measured_torque"),
    # Of the motors, on the joints' side of the gears: as much as the joints turn if nothing gives.
    Signal("joint/motor_position", "rad", ("n",), "measured_motor_position"),
    Signal("joint/temperature", "degC", ("n",), "measured_temperature"),
    # [moment, force] of the ground on a fixed base, at its origin in its axes.
    Signal("base/wrench", "Nm, N", (6,), "measured_base_wrench"),
    Signal("joint/voltage_command", "V", ("n",)),
    # 1 where a motor is driven, 0 where its bridge is open.
    Signal("joint/enabled", "1", ("n",)),
    # Controller and reference, of which the log has what was planned.
    Signal("joint/torque_command", "Nm", ("n",), "torque_command"),
    Signal("reference/joint/position", "rad", ("n",), "desired_state", recorded=False),
    Signal("reference/joint/velocity", "rad/s", ("n",), "desired_state", recorded=False),
    Signal(
        "reference/joint/feedforward_torque",
        "Nm",
        ("n",),
        "feedforward_torque",
        recorded=False,
    ),
    # What a real robot would not tell.
    Signal("", port="plant_state"),
    Signal("", port="generalized_acceleration"),
    Signal("", port="net_actuation"),
    Signal("", port="explicit_force"),
    Signal(r"truth/foot/\w+/pad_force", "N", ("m", 3), "true_pad_force"),
    Signal(r"truth/foot/\w+/wrench", "Nm, N", (6,), "true_pad_force"),
    # Computed from the ports above: to read it at every tick takes longer.
    Signal(
        "truth/joint/friction_torque",
        "Nm",
        ("n",),
        "torque_loss",
        recorded=False,
        late=True,
    ),
    # What it is by the effects' laws, at the velocity that came out of the step.
    Signal("truth/joint/friction_law_torque", "Nm", ("n",)),
    # Estimates.
    estimated("sensors/status", "sensor_monitor", "trust", "1"),
    estimated("support", "sensor_monitor", "support", "1"),
    _status("attitude"),
    estimated("base/orientation", "attitude", "orientation", "1", (4,)),
    estimated("imu/angular_velocity_bias", "attitude", "angular_velocity_bias", "rad/s", (3,)),
    estimated("imu/acceleration_bias", "attitude", "acceleration_bias", "m/s^2", (3,)),
    _own("attitude", "covariance"),
    _own("attitude", "innovation"),
    _own("attitude", "innovation_variance"),
    _status("base_state"),
    estimated("base/position", "base_state", "base_position", "m", (3,)),
    estimated("base/velocity", "base_state", "base_velocity", "m/s", (3,)),
    estimated("com/position", "base_state", "com_position", "m", (3,)),
    estimated("com/velocity", "base_state", "com_velocity", "m/s", (3,)),
    estimated("zmp", "base_state", "zmp", "m", (2,)),
    # Standard deviations along the world's axes; of the attitude, of a rotation vector.
    estimated("base/attitude_std", "base_state", "attitude_std", "rad", (3,)),
    estimated("base/velocity_std", "base_state", "velocity_std", "m/s", (3,)),
    estimated("base/position_std", "base_state", "position_std", "m", (3,)),
    _own("base_state", "foot_innovation"),
    _own("base_state", "foot_innovation_variance"),
    _own("base_state", "force_innovation"),
    _own("base_state", "force_innovation_variance"),
    _own("base_state", "covariance"),
    _own("base_state", "innovation"),
    _own("base_state", "innovation_variance"),
    _status("joint_acceleration"),
    estimated("joint/acceleration", "joint_acceleration", "joint_acceleration", "rad/s^2", ("n",)),
    _own("joint_acceleration", "innovation"),
    _own("joint_acceleration", "innovation_variance"),
    _status("link_torque"),
    estimated("joint/link_torque", "link_torque", "link_torque", "Nm", ("n",)),
    estimated("joint/residual_torque", "link_torque", "residual", "Nm", ("n",)),
    _status("friction"),
    estimated("joint/friction_torque", "friction", "friction", "Nm", ("n",)),
    estimated("joint/friction_torque_std", "friction", "friction_std", "Nm", ("n",)),
    # 1 where an actuator is called faulty.
    estimated("joint/fault", "friction", "fault", "1", ("n",)),
    # Reflected inertia that the model lacks.
    estimated("joint/missing_inertia", "friction", "missing_inertia", "kg m^2", ("n",)),
    estimated("joint/missing_inertia_std", "friction", "missing_inertia_std", "kg m^2", ("n",)),
    _own("friction", "parameters", shape=("n", "m")),
    _own("friction", "parameter_variance", shape=("n", "m")),
    _own("friction", "innovation"),
    _own("friction", "innovation_variance"),
    # What is computed from the above, planned, or comes with recordings of other robots.
    Signal(r"(truth|reference|estimate)/joint/position", "rad", ("n",)),
    Signal(r"(truth|reference|estimate)/joint/velocity", "rad/s", ("n",)),
    Signal(r"((truth|reference|estimate)/)?joint/acceleration", "rad/s^2", ("n",)),
    Signal(r"((truth|reference|estimate)/)?joint/\w*torque\w*", "Nm", ("n",)),
    Signal(r"\w+/foot/\w+/position", "m", (3,)),
    Signal(r"\w+/foot/\w+/support", "1", ()),
    # Turn to the left, where a foot turns.
    Signal(r"\w+/foot/\w+/yaw", "rad", ()),
    Signal(r"\w+/(base|com)/position", "m", (3,)),
    Signal(r"\w+/base/orientation", "1", (4,)),
    Signal(r"\w+/(base|com)/velocity", "m/s", (3,)),
    Signal(r"\w+/(base|com)/acceleration", "m/s^2", (3,)),
    Signal(r"\w+/base/angular_velocity", "rad/s", (3,)),
    Signal(r"\w+/base/angular_acceleration", "rad/s^2", (3,)),
    Signal(r"\w+/zmp", "m", (2,)),
    Signal(r"estimate/\w+/status", "1", ()),
    Signal(r"estimate/\w+/(covariance|innovation|innovation_variance)", "-", ("m",)),
]


def register(*signals: Signal) -> None:
    """Adds rows to the table; such as are in it already stay.

    Raises:
        InputError: a channel or a port that the table has already, with another meaning.
    """
    new = [signal for signal in signals if signal not in _TABLE]
    for signal in new:
        kind = (signal.unit, signal.shape)
        for row in _TABLE:
            # A channel that comes from nowhere yet can have a port.
            is_free = not row.port and (row.unit, row.shape) == kind
            if re.fullmatch(row.channel, signal.channel) and not is_free:
                raise InputError(f"channel {signal.channel}: there is one of this name already")
        if signal.port in ports():
            raise InputError(f"port {signal.port}: there is one of this name already")
    _TABLE.extend(new)


def ports(*, recorded: bool = False) -> list[str]:
    """Names of the ports of all stations, in order; or of those that a simulation records."""
    rows = [row for row in _TABLE if row.port and (row.recorded or not recorded)]
    return list(dict.fromkeys(row.port for row in rows))


def signals_of(port: str) -> tuple[Signal, ...]:
    """The rows of a port."""
    return tuple(row for row in _TABLE if row.port == port)


def is_late(port: str) -> bool:
    """Does the port tell of the step that ended what its channels have in the row where it
    began?"""
    return any(row.late for row in signals_of(port))


def estimates() -> list[Signal]:
    """The rows of the estimators' posteriors."""
    return [row for row in _TABLE if row.estimator]


def channel_kind(channel: str) -> tuple[str, Shape]:
    """Unit of a channel (of a revolute joint) and the shape of a sample.

    Raises:
        InputError: no such channel.
    """
    for row in _TABLE:
        if re.fullmatch(row.channel, channel):
            return row.unit, row.shape
    own = "that of a sensor or estimator of your own is one once its module is imported"
    hint = f"see fbse_drake.signals; {own}"
    raise InputError(f"channel {channel}: not a channel of a log ({hint})")


def is_channel(name: str) -> bool:
    """Is there a channel of this name?"""
    return any(re.fullmatch(row.channel, name) for row in _TABLE)


def channels_of(port: str, values: np.ndarray, joints: int) -> dict[str, np.ndarray]:
    """Channels that a port's recorded values become.

    Args:
        values: (N, size).
        joints: how many the robot has.

    Returns:
        By channel, (N, ...) each; nothing where none stands for the port.
    """
    rows = [row for row in signals_of(port) if row.channel]
    fixed = [int(np.prod(row.sample_shape(joints, 0))) for row in rows]
    left = values.shape[1] - sum(fixed)
    channels, start = {}, 0
    for row, size in zip(rows, fixed, strict=True):
        stop = start + size + ("m" in row.shape) * left
        shape = row.sample_shape(joints, stop - start)
        channels[row.channel] = values[:, start:stop].reshape(len(values), *shape)
        start = stop
    return channels


def port_values(port: str, log: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """What a port told when a log was recorded, (N, size); None where the log lacks it."""
    rows = [row for row in signals_of(port) if row.channel]
    if not rows or any(row.channel not in log for row in rows):
        return None
    values = np.hstack([log[row.channel].reshape(len(log[row.channel]), -1) for row in rows])
    return np.vstack([np.zeros_like(values[:1]), values[:-1]]) if is_late(port) else values
