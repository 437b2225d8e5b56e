"""Sensor effects in diagrams: put into the readings of a simulated robot, and taken off those that
an estimator gets."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import (
    BasicVector,
    Context,
    InputPort,
    LeafSystem,
    State,
    ValueProducer,
)

from fbse_drake.effects.sensor import ResolvedSensorEffect, SensorSignals
from fbse_drake.robot.plant import Robot
from fbse_drake.wiring import weakly


class _Readings(LeafSystem):
    """Passes readings through effects, one after the other.

    Inputs are `joint_state` [positions, velocities], shape (2n,) [rad, rad/s]; `imu` [specific
    force, angular velocity], shape (6,) [m/s^2, rad/s]; `pad_force` three components pad by pad
    [N]; `motor_position` (n,) [rad] of second encoders; each where the robot has it; and
    `torque_command` of the step that begins and `friction`, what the joints' effects took of it in
    the step that ended, (n,) [Nm]; none where that port is left open. The output, all of the
    readings in this order, does not depend on the command of its own tick, which is computed from
    it. Discrete state: the torque that passes the gears as far as it is known before the next
    tick, the velocity of the rotors, and each effect's memory.
    """

    # Name of the output port.
    _gives: str

    def __init__(
        self,
        effects: Sequence[ResolvedSensorEffect],
        robot: Robot,
        period: float,
        *,
        imu: bool = True,
        motor_encoders: bool = False,
    ):
        """Declares ports, state and the update.

        Args:
            effects: sensor effects, in the order in which they act.
            robot: whose sensors these are.
            period: of the control [s].
            imu: is there an IMU?
            motor_encoders: are there second encoders?
        """
        super().__init__()
        n = len(robot.joint_names)
        pads = sum(leg.points for leg in robot.description.legs.values())
        self._effects, self._robot, self._period = list(effects), robot, period
        self._rotor_inertia = robot.rotor_inertias
        sizes = {
            "joint_state": 2 * n,
            "imu": 6 if imu else 0,
            "pad_force": 3 * pads,
            "motor_position": n if motor_encoders else 0,
        }
        # Those that the robot has.
        self.sizes = {name: size for name, size in sizes.items() if size > 0}
        at_once = self._declare_inputs(n)
        # Before the first tick nothing passed the gears.
        self._load = self.DeclareDiscreteState(n)
        self._rotor_velocity = self.DeclareDiscreteState(np.full(n, np.nan))
        self._memories = [
            self.DeclareDiscreteState(effect.effect.memory_size * len(effect.targets))
            for effect in effects
        ]
        sources = {self.input_port_ticket(port.get_index()) for port in at_once}
        sources |= {self.xd_ticket()}
        # What effects are given, and the velocity of the rotors (n,), found once a tick.
        producer = ValueProducer(AbstractValue.Make(()).Clone, weakly(self._calc_given))
        self._given = self.DeclareCacheEntry("given", producer, sources)
        size = sum(self.sizes.values())
        self.DeclareVectorOutputPort(self._gives, size, weakly(self._calc), sources)
        if any(effect.effect.memory_size for effect in effects):
            self.DeclarePeriodicUnrestrictedUpdateEvent(period, 0.0, weakly(self._remember))
            self.DeclareForcedUnrestrictedUpdateEvent(weakly(self._remember))

    def _declare_inputs(self, joints: int) -> list[InputPort]:
        """Declares the input ports; returns those that the output depends on at once."""
        self._readings = {
            name: self.DeclareVectorInputPort(name, size) for name, size in self.sizes.items()
        }
        self._torque_command = self.DeclareVectorInputPort("torque_command", joints)
        self._friction = self.DeclareVectorInputPort("friction", joints)
        return [*self._readings.values()]

    def _friction_in(self, context: Context) -> np.ndarray:
        """Friction, as far as it is known, (n,) [Nm]."""
        if not self._friction.HasValue(context):
            return np.zeros(self._friction.size())
        return np.nan_to_num(self._friction.Eval(context))

    @abstractmethod
    def _gear_now(self, context: Context, signals: SensorSignals) -> tuple[np.ndarray, np.ndarray]:
        """Torque that passed the gears in the step that ended, (n,) [Nm], and the velocity of the
        rotors at its end, (n,) [rad/s].

        Args:
            signals: the readings; neither their load nor the command is known yet.
        """

    def _calc_given(self, context: Context, output: AbstractValue) -> None:
        signals = self._read(context)
        load, rotor_velocity = self._gear_now(context, signals)
        output.set_value((replace(signals, load_begin=load, load_end=load), rotor_velocity))

    def _less_rotors(
        self, context: Context, torque: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """A torque less what rotors took to get to this velocity in the step that ended, (n,)
        [Nm]."""
        change = velocity - context.get_discrete_state(self._rotor_velocity).value()
        return torque - self._rotor_inertia * np.nan_to_num(change) / self._period

    @abstractmethod
    def _load_of(self, context: Context, command: np.ndarray) -> np.ndarray:
        """What is known to pass the gears of a command in the step that begins, (n,) [Nm]."""

    @abstractmethod
    def _passed(
        self, signals: SensorSignals, memories: Sequence[np.ndarray]
    ) -> tuple[SensorSignals, list[SensorSignals]]:
        """Signals behind all effects, and for each effect those that it finds to be true.

        Args:
            memories: of each effect, (memory_size, targets).
        """

    def _read(self, context: Context) -> SensorSignals:
        """The readings; their load and the command are not known."""
        read = {name: port.Eval(context) for name, port in self._readings.items()}
        position, velocity = np.split(read["joint_state"], 2)
        imu = read.get("imu", np.zeros(6))
        pads = read.get("pad_force", np.zeros(0)).reshape(-1, 3)
        motors = read.get("motor_position", np.zeros(0))
        unknown = np.full(len(position), np.nan)
        return SensorSignals(
            position, velocity, imu[:3], imu[3:], pads, unknown, motors, unknown, unknown
        )

    def _memory(self, context: Context) -> list[np.ndarray]:
        return [
            context.get_discrete_state(place).value().reshape(-1, len(effect.targets))
            for place, effect in zip(self._memories, self._effects, strict=True)
        ]

    def _calc(self, context: Context, output: BasicVector) -> None:
        given: Any = self._given.Eval(context)
        signals, _ = self._passed(given[0], self._memory(context))
        read = {
            "joint_state": np.concatenate([signals.joint_position, signals.joint_velocity]),
            "imu": np.concatenate([signals.specific_force, signals.angular_velocity]),
            "pad_force": signals.pad_force.ravel(),
            "motor_position": signals.motor_position,
        }
        output.SetFromVector(np.concatenate([read[name] for name in self.sizes]))

    def _remember(self, context: Context, state: State) -> None:
        memories = self._memory(context)
        command = self._torque_command.Eval(context)
        given: Any = self._given.Eval(context)
        signals, rotor_velocity = given
        signals = replace(signals, torque_command=command)
        state.get_mutable_discrete_state(self._rotor_velocity).set_value(rotor_velocity)
        if np.isfinite(command).all():
            load = self._load_of(context, command)
            state.get_mutable_discrete_state(self._load).set_value(load)
        _, found = self._passed(signals, memories)
        for i, effect in enumerate(self._effects):
            if effect.effect.memory_size:
                later = effect.effect.remembered(
                    found[i], memories[i], effect, self._robot, self._period
                )
                spoilt = ~np.isfinite(later).all(axis=0)
                later[:, spoilt] = memories[i][:, spoilt] if _is_read(found[i]) else 0.0
                state.get_mutable_discrete_state(self._memories[i]).set_value(later.ravel())


def _is_read(signals: SensorSignals) -> bool:
    """Are all readings numbers? Without a command memories stay, without a reading they begin
    anew."""
    readings = replace(signals, torque_command=np.zeros(0))
    return all(np.isfinite(channel).all() for channel in vars(readings).values())


class SensorEffects(_Readings):
    """Distorts the readings of the sensors by effects, one after the other.

    .. pydrake_system::

        name: SensorEffects
        input_ports:
        - joint_state
        - imu
        - pad_force
        - motor_position
        - torque_command
        - friction (optional)
        - true_joint_state (optional)
        output_ports:
        - measured

    See `_Readings`; `measured` is what is read then. `true_joint_state` [positions, velocities] is
    of the links, (2n,) [rad, rad/s]; where that port is left open rotors take no torque.
    """

    _gives = "measured"

    def _declare_inputs(self, joints: int) -> list[InputPort]:
        at_once = super()._declare_inputs(joints)
        self._links = self.DeclareVectorInputPort("true_joint_state", 2 * joints)
        return [*at_once, self._friction, self._links]

    def _gear_now(self, context: Context, signals: SensorSignals) -> tuple[np.ndarray, np.ndarray]:
        load = context.get_discrete_state(self._load).value() - self._friction_in(context)
        if not self._links.HasValue(context):
            return load, np.full(len(load), np.nan)
        _, link_velocity = np.split(self._links.Eval(context), 2)
        if not any(effect.effect.follows_load() for effect in self._effects):
            return self._less_rotors(context, load, link_velocity), link_velocity
        exact, memories = replace(signals, joint_velocity=link_velocity), self._memory(context)

        def rotor_velocity(load: np.ndarray) -> np.ndarray:
            passed, _ = self._passed(replace(exact, load_begin=load, load_end=load), memories)
            return passed.joint_velocity

        # How fast a rotor is ahead of its link depends on the load, and the load on that.
        velocity = rotor_velocity(load)
        rise = rotor_velocity(load + 1.0) - velocity
        change = self._less_rotors(context, load, velocity) - load
        change /= 1.0 + self._rotor_inertia * rise / self._period
        return load + change, velocity + rise * change

    def _load_of(self, context: Context, command: np.ndarray) -> np.ndarray:  # noqa: ARG002
        return command

    def _passed(
        self, signals: SensorSignals, memories: Sequence[np.ndarray]
    ) -> tuple[SensorSignals, list[SensorSignals]]:
        found = []
        for effect, memory in zip(self._effects, memories, strict=True):
            found.append(signals)
            signals = effect.effect.reading(signals, memory, effect, self._robot)
        return signals, found


class SensorCorrections(_Readings):
    """Takes off readings what effects of the sensors, which are known, have put into them.

    .. pydrake_system::

        name: SensorCorrections
        input_ports:
        - joint_state
        - imu
        - pad_force
        - torque_command
        - friction (optional)
        output_ports:
        - corrected

    See `_Readings`. What is noise in a reading stays, and grows where an effect smoothed it.
    """

    _gives = "corrected"

    # What is known of the friction may come from what is corrected: it is that of the step before.
    def _gear_now(self, context: Context, signals: SensorSignals) -> tuple[np.ndarray, np.ndarray]:
        load = context.get_discrete_state(self._load).value()
        return self._less_rotors(context, load, signals.joint_velocity), signals.joint_velocity

    def _load_of(self, context: Context, command: np.ndarray) -> np.ndarray:
        return command - self._friction_in(context)

    def _passed(
        self, signals: SensorSignals, memories: Sequence[np.ndarray]
    ) -> tuple[SensorSignals, list[SensorSignals]]:
        found = []
        for effect, memory in reversed(list(zip(self._effects, memories, strict=True))):
            signals = effect.effect.undone_now(signals, memory, effect, self._robot, self._period)
            found.append(signals)
        return signals, found[::-1]
