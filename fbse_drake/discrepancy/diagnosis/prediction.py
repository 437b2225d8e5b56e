"""What effects add to the residual of a log: signatures for the regression to fit, and predictions
of effects whose values are known."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial

import numpy as np
from scipy.ndimage import binary_propagation, maximum_filter1d, minimum_filter1d

from fbse_drake.discrepancy.diagnosis.reading import (
    Reading,
    friction_laws,
    in_steps,
    is_read,
)
from fbse_drake.discrepancy.diagnosis.regressors import Regressors, noisier_signals
from fbse_drake.discrepancy.diagnosis.standing_soles import StandingSoles
from fbse_drake.discrepancy.identification.inertial import inertia_addition
from fbse_drake.discrepancy.identification.regression import Signature
from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.equation_of_motion import (
    EquationOfMotion,
    joint_velocity_noise,
)
from fbse_drake.discrepancy.residual.noise import Noise, measured_noise
from fbse_drake.discrepancy.residual.recorded_velocity import velocity_error
from fbse_drake.discrepancy.residual.residual import Residual
from fbse_drake.effects.actuation import TorqueReadingLag
from fbse_drake.effects.contact import (
    ContactEffect,
    GroundCompliance,
    GroundSlope,
    PadContact,
)
from fbse_drake.effects.effect import Effect, ResolvedEffect
from fbse_drake.effects.geometry import GeometryEffect
from fbse_drake.effects.inertia import InertiaEffect
from fbse_drake.effects.joint_torque import (
    JointMotion,
    JointTorqueEffect,
    ResolvedJointTorque,
    basis_over_time,
    deflection_over_time,
)
from fbse_drake.effects.sensor import ResolvedSensorEffect, SensorEffect, SensorSignals
from fbse_drake.errors import InputError
from fbse_drake.log import Log
from fbse_drake.scenario import RecordingConfig, Scenario, build_robot

# What is uncertain about the velocity at which a law holds, as a multiple of the velocity's change
# within the step, squared.
_LAW_DOUBT = 8.0
# Of a row's variance; where no block has more it is not worth weighing the row anew.
_NEGLIGIBLE_DOUBT = 0.25
# A joint rests if its velocity is less than so many standard deviations of its error for so long
# [s], and it moves by less than this share of what it could so without being seen to.
_RESTS, _WHILE, _STAYS = 5.0, 0.2, 0.1
# A column that is smaller than this share of the others is rounding.
_ROUNDING = 1e-9
# A law without memory is evaluated at least so often in a block, if the log has that many samples.
_EVALUATIONS = 8
# Most numbers that one array of columns may have before it is averaged over blocks.
_CHUNK = 250_000


class Predictor:
    """A scenario's model over one log: its residual, and what further effects would add to it."""

    def __init__(
        self,
        scenario: Scenario,
        log: Log,
        noise: Noise | None = None,
        left_out: Sequence[tuple[float, float]] = (),
        reading: Reading | None = None,
        more_noise: Noise | None = None,
    ):
        """Reads the log.

        Args:
            noise: of the rows, beyond what is believed; by default it is measured.
            left_out: start and end [s] of stretches of which nothing is said.
            reading: of this log without these stretches; read again if it does not serve the
                scenario.
            more_noise: of the rows, beyond that.

        Raises:
            InputError: a log that does not fit the model.
        """
        self.scenario, self.log, self.left_out = scenario, log, tuple(left_out)
        if reading is None or not reading.serves(scenario):
            reading = Reading(scenario, log, self.left_out)
        self.reading, self.robot, self.motion = reading, reading.robot, reading.motion
        self._known = [
            effect.resolve(self.robot.description, key=f"model.effects.{key}")
            for key, effect in scenario.believed.effects.items()
        ]
        self._given_noise, self._more_noise = noise, more_noise
        self._memories: dict[tuple[type[SensorEffect], bytes], np.ndarray] = {}
        self._motions_of_joint: dict[tuple[int, int, bool], JointMotion] = {}

    def of(self, scenario: Scenario) -> "Predictor":
        """Another scenario's model over the same log, which is read again only if need be; its
        noise is measured anew."""
        if scenario == self.scenario and self._given_noise is None:
            return self
        return Predictor(scenario, self.log, None, self.left_out, self.reading, self._more_noise)

    def noisier(self, more: Noise) -> "Predictor":
        """The same with noise beyond what was measured of it."""
        more = more if self._more_noise is None else self._more_noise.with_more(more)
        return Predictor(
            self.scenario, self.log, self._measured_noise, self.left_out, self.reading, more
        )

    def is_like(self, other: "Predictor") -> bool:
        """Does another one predict the same?"""
        return (
            self.log is other.log
            and self.scenario == other.scenario
            and self.left_out == other.left_out
            and self._given_noise is other._given_noise
            and self._more_noise is other._more_noise
        )

    def without(self, stretches: Sequence[tuple[float, float]]) -> "Predictor":
        """The same without some stretches [s] of the log."""
        left_out = (*self.left_out, *stretches)
        return Predictor(
            self.scenario, self.log, self._given_noise, left_out, more_noise=self._more_noise
        )

    def trusting_inertia(self) -> "Predictor":
        """The same where the inertia of all bodies is trusted."""
        identify = replace(self.scenario.identify, inertia=[])
        scenario = replace(self.scenario, identify=identify)
        return Predictor(
            scenario, self.log, self._given_noise, self.left_out, self.reading, self._more_noise
        )

    def believed_amount(self, effect: type[JointTorqueEffect], name: str, joint: str) -> float:
        """How much of a linear parameter of an effect the model's effects have in a joint, see
        `JointTorqueEffect.shares`."""
        return sum(
            known.linear_values(name)[known.targets.index(joint)]
            for known in self._known
            if effect.shares(name, known.effect)
        )

    @property
    def rows(self) -> int:
        """Number of the residual's rows."""
        return len(self.motion.rows)

    @cached_property
    def residual(self) -> Residual:
        """What the model, with its effects, leaves over; with the noise that the log shows where
        that is more than is believed."""
        return self.noise.added_to(self._believed_residual, self.motion.length)

    @cached_property
    def noise(self) -> Noise:
        """Of the rows, beyond what is believed."""
        measured, more = self._measured_noise, self._more_noise
        return measured if more is None else measured.with_more(more)

    @cached_property
    def _measured_noise(self) -> Noise:
        """Without what the rows themselves do not show."""
        if self._given_noise is not None:
            return self._given_noise
        return measured_noise(self.motion, self._believed_residual, self.reading.noisier_channels)

    @cached_property
    def _believed_residual(self) -> Residual:
        residual = self.motion.residual
        for known in self._known:
            if not is_read(known.effect, self.motion.recording):
                residual = residual.minus(self.predict(known))
        if self.robot.has_floating_base:
            residual = residual.minus(self._soles.on_slope(self._believed_slope))
            residual = residual.minus(self._soles.on_believed_ground())
            contact = self.pad_contact
            sinking = self._soles.sinking_variance(contact.retardation) / contact.stiffness**2
            residual = replace(residual, variance=residual.variance + sinking)
            residual = self._soles.held(self._soles.settled(residual, contact.retardation))
        return self.doubted(residual, self._known)

    @cached_property
    def _soles(self) -> StandingSoles:
        return StandingSoles(self.motion, self.scenario)

    @property
    def pad_contact(self) -> PadContact:
        """Of the pads under the model's feet with its ground."""
        return self._soles.contact

    @cached_property
    def _believed_slope(self) -> np.ndarray:
        """Of the model's ground, (2,) [rad], see `Ground.slope`."""
        known = [e.linear[:, 0] for e in self._known if issubclass(e.effect, GroundSlope)]
        return np.sum([np.array(self.scenario.ground.slope), *known], axis=0)

    def doubted(
        self,
        residual: Residual,
        effects: Iterable[ResolvedEffect],
        left: np.ndarray | None = None,
    ) -> Residual:
        """A residual that is less certain because effects were taken off it.

        Friction laws are doubtful, see `law_variance`, and the sinking of soles is predicted from
        forces that are measured with noise.

        Args:
            left: what the effects leave of it, (B, R), if they may not be all; dry friction that is
                in there holds joints at rest as well.
        """
        effects = list(effects)
        laws = [e for e in effects if isinstance(e, ResolvedJointTorque)]
        doubt = np.zeros_like(residual.variance)
        doubt[:, : len(self.robot.joint_names)] = self.law_variance(laws, left)
        soles, contact = self._soles, self.pad_contact
        for effect in effects:
            if effect.effect is GroundCompliance:
                (softer,), firm = effect.linear[:, 0], 1.0 / contact.stiffness
                late = GroundCompliance.retardation_of(effect.nonlinear[:, 0], contact)
                sinking = (firm + softer) ** 2 * soles.sinking_variance(late)
                usual = firm**2 * soles.sinking_variance(contact.retardation)
                doubt += np.maximum(sinking - usual, 0.0)
                residual = soles.settled(residual, late)
        return replace(residual, variance=residual.variance + doubt, doubt=residual.doubt + doubt)

    def law_variance(
        self, laws: Sequence[ResolvedJointTorque], left: np.ndarray | None = None
    ) -> np.ndarray:
        """What friction laws that are taken off add to the noise, (B, n) [Nm^2].

        A law of the velocity does not say at which velocity within a step it holds: its torque is
        uncertain by its slope times what the velocity changes in the step. This counts where a
        sticking joint trembles. Of rows that are sampled at an instant it is uncertain by the error
        of the velocity (effective variance, Orear 1982), which counts where a joint turns; where
        one rests, friction holds it by as much as is needed.

        Args:
            left: see `doubted`.
        """
        motion, joint_motion = self.motion, self.joint_motion
        if motion.recording.is_sampled:
            of_velocity = [law for law in laws if not law.effect.has_memory]
            return self._variance_by_velocity(of_velocity) + self._variance_at_rest(laws, left)
        slope = np.zeros(joint_motion.velocity.shape)
        for law in laws:
            if not law.effect.has_memory:
                slope += law.torque_and_slope(joint_motion)[1]
        noise = joint_velocity_noise(motion.sensors)
        change = np.diff(motion.signals.joint_velocity, axis=0) ** 2
        real = np.maximum(block_means(change, motion.length) - 2 * noise**2, 0.0)
        return _LAW_DOUBT * block_means(slope**2, motion.length) * real / motion.length

    def _variance_by_velocity(self, laws: Sequence[ResolvedJointTorque]) -> np.ndarray:
        """Of the torque of laws whose velocity errs, (B, n) [Nm^2]; 0 for joints in which it is
        next to nothing beside the noise, and where the recording's low-pass averages it.

        Torques that were read earlier err by what the laws change meanwhile: the filter that they
        come from smears a jump.
        """
        motion = self.motion
        if not laws or motion.recording.recorded_cutoff > 0:
            return np.zeros(motion.blocks.joint_position.shape)
        here, late = self.joint_motion, self.reading.late_torques
        pairs = [[here.velocity + error for error in (self._velocity_error, -self._velocity_error)]]
        if late.any():
            pairs.append(
                [TorqueReadingLag.in_time(here.velocity, t, motion.period) for t in (late, -late)]
            )

        def torque(velocity: np.ndarray) -> np.ndarray:
            """Of the laws at another velocity, (N, n)."""
            moved = here._replace(velocity=velocity)
            return sum((law.torque_and_slope(moved)[0] for law in laws), start=0.0 * velocity)

        def change(velocity: np.ndarray) -> np.ndarray:
            """Of that torque, (B, n)."""
            return self._means_of_samples(torque(velocity) - torque_here)

        torque_here = torque(here.velocity)
        doubt = sum(np.square([change(v) for v in either_way]).mean(axis=0) for either_way in pairs)
        noise = motion.residual.variance[:, : doubt.shape[1]]
        matters = doubt.max(axis=0) > _NEGLIGIBLE_DOUBT * noise.mean(axis=0)
        return np.where(matters, doubt, 0.0)

    def _means_of_samples(self, values: np.ndarray) -> np.ndarray:
        """Averages over blocks, (B, n), of what was sampled, (N, n)."""
        return block_means(in_steps(self.motion.recording, values), self.motion.length)

    def _variance_at_rest(
        self, laws: Sequence[ResolvedJointTorque], left: np.ndarray | None
    ) -> np.ndarray:
        """Of the torque of laws that hold joints which rest, (B, n) [Nm^2]."""
        rests, motion = self._rests, self.joint_motion
        if not rests.any():
            return np.zeros(rests.shape)
        left_dry = 0.0 if left is None else self._dry_friction_in(left)
        held = left_dry + sum(law.held_at_rest(motion) for law in laws)
        held = np.broadcast_to(held, motion.velocity.shape)
        return np.where(rests, self._means_of_samples(np.square(held)), 0.0)

    def _dry_friction_in(self, left: np.ndarray) -> np.ndarray:
        """What follows the sign of the velocity, beside a constant and what is proportional to it,
        where joints move, (n,) [Nm]."""
        velocity, known = self._mean_velocity, self.motion.residual.known
        moves = known[:, : velocity.shape[1]] & (np.abs(velocity) > _RESTS * self._velocity_error)
        dry = np.zeros(velocity.shape[1])
        for joint, there in enumerate(moves.T):
            v = velocity[there, joint]
            regressor = np.stack([np.sign(v), v, np.ones(len(v))], axis=1)
            dry[joint] = np.linalg.lstsq(regressor, left[there, joint], rcond=None)[0][0]
        return dry

    @cached_property
    def _mean_velocity(self) -> np.ndarray:
        """Of the joints in each block, (B, n) [rad/s]."""
        return self._means_of_samples(self.joint_motion.velocity)

    @cached_property
    def _rests(self) -> np.ndarray:
        """In which blocks joints rest, (B, n) bool: they are not seen to move, and for a while
        their angles stay where they are."""
        position = self._means_of_samples(self.motion.signals.joint_position)
        unseen = _RESTS * self._velocity_error
        size = max(3, round(_WHILE / (self.motion.length * self.motion.period)))
        slow = np.abs(self._mean_velocity) <= unseen
        long = minimum_filter1d(slow, size, axis=0, mode="constant")
        path = maximum_filter1d(position, size, axis=0) - minimum_filter1d(position, size, axis=0)
        stays = long & (path <= _STAYS * unseen * _WHILE + _ROUNDING)
        return binary_propagation(stays, structure=[[0, 1, 0]] * 3, mask=slow)

    @cached_property
    def _velocity_error(self) -> np.ndarray:
        """Of that by which laws are evaluated, see `velocity_error`, (n,)."""
        motion, velocity = self.motion, self.joint_motion.velocity
        return velocity_error(
            motion.signals.joint_position, velocity, motion.period, motion.stretches, motion.length
        )

    def predict(self, effect: ResolvedEffect) -> np.ndarray:
        """What an effect adds to the residual, (B, R). Inertia and sensor effects and slopes of the
        model are in the residual already."""
        result = np.zeros((len(self.motion.time), self.rows))
        if issubclass(effect.effect, JointTorqueEffect):
            rows = self.rows_of(effect.effect, np.arange(len(effect.targets)))
            joint = self.joints_of(rows)
            columns = self.joint_columns(effect.effect, effect.nonlinear[:, joint], rows)
            amounts = effect.linear if len(effect.linear) else np.ones((1, len(effect.targets)))
            result[:, rows] = np.einsum("pbn,pn->bn", columns, amounts[:, joint])
        elif issubclass(effect.effect, ContactEffect):
            signature = self.signature(effect.effect, "robot", effect.nonlinear[:, 0])
            amounts = effect.linear[:, 0]
            result[:, signature.rows] = signature.values @ amounts + signature.offset
        return result

    @cached_property
    def joint_motion(self) -> JointMotion:
        """What joint torque effects depend on, see `Reading.joint_motion`."""
        return self.reading.joint_motion

    @cached_property
    def _joint_motions(self) -> Callable[[int], JointMotion]:
        """The same averaged over so many steps."""
        return cache(partial(_joined, self.motion.recording, self.joint_motion))

    @cached_property
    def _noisier_joint_motion(self) -> JointMotion:
        """The same if the sensors' noise were in it once more."""
        return self.reading.joint_motion_of(self._noisier_regressors.signals)

    @cached_property
    def _loaded(self) -> SensorSignals:
        """The log's signals with what passes the gears, see `Reading.loaded`."""
        laws, signals = friction_laws(self._known), self._regressors.signals
        return self.reading.loaded(signals, self.joint_motion, laws)

    @cached_property
    def _noisier_loaded(self) -> SensorSignals:
        """The same if the sensors' noise were in them once more."""
        laws, signals = friction_laws(self._known), self._noisier_regressors.signals
        return self.reading.loaded(signals, self._noisier_joint_motion, laws)

    @cached_property
    def _noisier_joint_motions(self) -> Callable[[int], JointMotion]:
        """That averaged over so many steps."""
        return cache(partial(_joined, self.motion.recording, self._noisier_joint_motion))

    @cached_property
    def is_driven(self) -> np.ndarray:
        """Which joints get any torque, (n,) bool: the others show nothing of a motor."""
        return np.any(self.motion.signals.torque_command, axis=0)

    def rows_of(self, effect: type[JointTorqueEffect], joints: np.ndarray) -> np.ndarray:
        """Places of the rows in which a joint effect on some joints (T,) shows: their torques, and
        the deflections of their transmissions where it has any and they are measured."""
        motors = self.motion.signals.motor_position.shape[1]
        if not (effect.deflects and motors):
            return joints
        return np.concatenate([joints, self.rows - motors + joints])

    def joints_of(self, rows: np.ndarray) -> np.ndarray:
        """Places of the joints of such rows."""
        n = len(self.robot.joint_names)
        return np.where(rows < n, rows, rows - self.rows + n)

    def joint_columns(
        self,
        effect: type[JointTorqueEffect],
        nonlinear: np.ndarray,
        rows: np.ndarray,
        *,
        noisier: bool = False,
    ) -> np.ndarray:
        """What a joint effect adds to rows of its joints per unit of each linear parameter, block
        by block.

        Args:
            nonlinear: (m, T), or (m, G, T) for G sets of values, for the rows.
            rows: their places, see `rows_of`, shape (T,).
            noisier: with the sensors' noise once more.

        Returns:
            Shape (p, B, T), or (p, G, B, T); zero where the effect needs a motor and none is known
            to drive the joint.
        """
        torques = rows < len(self.robot.joint_names)
        parts = [
            columns(effect, nonlinear[..., of], self.joints_of(rows[of]), noisier=noisier)
            for of, columns in ((torques, self._torques), (~torques, self._deflections))
            if of.any()
        ]
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=-1)

    def _deflections(
        self,
        effect: type[JointTorqueEffect],
        nonlinear: np.ndarray,
        joints: np.ndarray,
        *,
        noisier: bool,
    ) -> np.ndarray:
        """Of the deflections of these joints."""
        motion = self._motion_of(joints, 1, noisier=noisier)
        is_sampled = self.motion.recording.is_sampled
        read = self.motion.signals if is_sampled else self.motion.steps
        motion = motion._replace(command=read.torque_command[:, joints])
        begin = deflection_over_time(effect, motion, nonlinear)
        if is_sampled:
            return self.is_driven[joints] * self._averages(begin[None], 1)
        end = np.concatenate([begin[..., 1:, :], begin[..., -1:, :]], axis=-2)
        share = self.motion.timing.motion_share
        amid = (1.0 - share) * begin + share * end
        return self.is_driven[joints] * self._averages(amid[None], 1)

    def _motion_of(self, joints: np.ndarray, step: int, *, noisier: bool) -> JointMotion:
        """What effects on some joints depend on, averaged over so many steps."""
        whole = (self._noisier_joint_motions if noisier else self._joint_motions)(step)
        if len(joints) > 1:
            return whole.of_joints(joints)
        key = (int(joints[0]), step, noisier)
        if key not in self._motions_of_joint:
            self._motions_of_joint[key] = whole.of_joints(joints)
        return self._motions_of_joint[key]

    def _torques(
        self,
        effect: type[JointTorqueEffect],
        nonlinear: np.ndarray,
        joints: np.ndarray,
        *,
        noisier: bool,
    ) -> np.ndarray:
        """Of the torques of these joints."""
        # What remembers must see every step.
        step = 1 if effect.has_memory else self._joined_steps
        motion = self._motion_of(joints, step, noisier=noisier)
        acts = self.is_driven[joints].astype(float) if effect.needs_motor else 1.0
        if nonlinear.ndim == 2:
            return acts * self._averages(basis_over_time(effect, motion, nonlinear), step)
        sets = max(1, _CHUNK // motion.velocity.size)
        parts = [
            self._averages(
                basis_over_time(effect, motion, nonlinear[:, start : start + sets]), step
            )
            for start in range(0, nonlinear.shape[1], sets)
        ]
        return acts * np.concatenate(parts, axis=1)

    def _averages(self, columns: np.ndarray, step: int) -> np.ndarray:
        """Averages over blocks of columns (..., M, T) that were evaluated once for so many steps,
        all at once."""
        first = np.moveaxis(columns, -2, 0)
        if step > 1:
            return np.moveaxis(block_means(first, self.motion.length // step), 0, -2)
        return np.moveaxis(self.motion.averages(in_steps(self.motion.recording, first)), 0, -2)

    @property
    def _joined_steps(self) -> int:
        """How many steps may be averaged before a law is evaluated: in long blocks a law is
        evaluated often enough all the same."""
        motion = self.motion
        if motion.recording.recorded_cutoff > 0:
            return 1
        return max(
            step
            for step in range(1, max(1, motion.length // _EVALUATIONS) + 1)
            if motion.length % step == 0
        )

    def signature(self, effect: type[Effect], target: str, nonlinear: np.ndarray) -> Signature:
        """What an effect on one target adds to the residual per unit of each linear parameter.

        Args:
            nonlinear: values of the nonlinear parameters, shape (m,).
        """
        if issubclass(effect, JointTorqueEffect):
            joint = self.robot.joint_names.index(target)
            rows = self.rows_of(effect, np.array([joint]))
            values = np.repeat(nonlinear[:, None], len(rows), axis=1)
            return Signature(rows, np.moveaxis(self.joint_columns(effect, values, rows), 0, 2))
        point = self._expansion_point(effect, target)
        if issubclass(effect, ContactEffect):
            values = self._soles.columns(effect, nonlinear)
            offset = self._soles.offset(effect, nonlinear)
        else:
            values, offset = self._slopes(effect, target, point, nonlinear)
        rows = np.flatnonzero(np.abs(values).max(axis=(0, 2)) > 0)
        return Signature(
            rows,
            values[:, rows],
            offset[:, rows] if np.any(offset) else 0.0,
            about=0.0 if point is None else point,
        )

    @cached_property
    def _regressors(self) -> Regressors:
        return Regressors(self.motion, self.motion.signals)

    @cached_property
    def _noisier_regressors(self) -> Regressors:
        """The same if the sensors' noise were in the signals once more."""
        return Regressors(self.motion, noisier_signals(self.motion, self.noise))

    @cached_property
    def noise_realization(self) -> np.ndarray:
        """What that noise adds to the residual, (B, R)."""
        return self._noisier_regressors.residual - self._regressors.residual

    def _expansion_point(self, effect: type[Effect], target: str) -> np.ndarray | None:
        """Values about which the signature of an effect is taken first, (p,); None for zeros."""
        if not issubclass(effect, InertiaEffect) or effect.acts_on != "body":
            return None
        return effect.expansion_point(self.robot.body(target))

    def noise_in(
        self,
        effect: type[Effect],
        target: str,
        nonlinear: np.ndarray,
        clean: Signature,
    ) -> Signature:
        """What that noise adds to the signature of an effect: regressors are measured too."""
        if issubclass(effect, ContactEffect):
            return replace(clean, values=self._soles.noise_in(effect, nonlinear)[:, clean.rows])
        if np.any(clean.about):
            about = np.asarray(clean.about)
            values, _ = self._slopes(effect, target, about, nonlinear, noisier=True)
            return replace(clean, values=values[:, clean.rows] - clean.values, offset=0.0)
        values, _ = self._slopes(effect, target, None, nonlinear, noisier=True)
        return replace(clean, values=values[:, clean.rows] - clean.values)

    def is_possible(self, effect: type[Effect], target: str, linear: np.ndarray) -> bool:
        """Can a robot have an effect with these values? Not every inertia is that of a body."""
        if not issubclass(effect, InertiaEffect) or effect.acts_on != "body":
            return True
        values = dict(zip(effect.parameters, ([value] for value in linear), strict=True))
        return self.can_have([effect.from_values([target], values)])

    def can_have(self, effects: Iterable[Effect]) -> bool:
        """Can a robot have these effects beside those of the model?"""
        try:
            self._with(*effects)
        except InputError:
            return False
        return True

    def _with(self, *changes: Effect) -> EquationOfMotion:
        """Of a model that has some effects as well.

        Raises:
            InputError: no robot has them.
        """
        believed = self.scenario.believed
        more = {f"_change_{k}": change for k, change in enumerate(changes)}
        return EquationOfMotion(build_robot(replace(believed, effects=believed.effects | more)))

    def _inertia_addition(self, effect: InertiaEffect, *, noisier: bool = False) -> np.ndarray:
        """What an inertia effect adds to the residual, (B, R)."""
        regressors = self._noisier_regressors if noisier else self._regressors
        added = inertia_addition(
            self.motion.equation, regressors.smooth_blocks, effect, regressors.of_body
        )
        return np.pad(added, ((0, 0), (0, self.rows - added.shape[1])))

    def signature_near(
        self,
        effect: type[Effect],
        target: str,
        linear: np.ndarray,
        nonlinear: np.ndarray,
        elsewhere: Signature,
    ) -> Signature:
        """The signature of an effect about values of its parameters, where what it adds is not
        quite linear.

        Args:
            linear, nonlinear: values of the parameters, shapes (p,) and (m,).
            elsewhere: the signature about zero; it stays that of any other effect.
        """
        if issubclass(effect, JointTorqueEffect):
            return elsewhere
        if issubclass(effect, ContactEffect):
            at, soles = elsewhere.rows, self._soles
            values, offset = soles.columns(effect, nonlinear), soles.offset(effect, nonlinear)
            return replace(elsewhere, values=values[:, at], offset=offset[:, at])
        values, offset = self._slopes(effect, target, linear, nonlinear)
        rows, lowest = elsewhere.rows, elsewhere.lowest
        if issubclass(effect, InertiaEffect):
            lowest = np.maximum(lowest, effect.lowest_nearby(linear))
        return replace(
            elsewhere,
            values=values[:, rows],
            offset=offset[:, rows],
            lowest=lowest,
            about=linear,
        )

    def _slopes(
        self,
        effect: type[Effect],
        target: str,
        about: np.ndarray | None,
        nonlinear: np.ndarray,
        *,
        noisier: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """What one of these effects adds per unit of each linear parameter about some values (None
        for zeros), (B, R, p), and what it adds with these values beyond that, (B, R).

        Of a shape that is linear only nearby by central differences: a tilt to the left and one to
        the right do the same to a pendulum, and a slope that is not there would promise anything.
        """

        def addition(values: np.ndarray) -> np.ndarray:
            return self._addition(effect, target, values, nonlinear, noisier=noisier)

        probes = probes_of(effect)
        linear = np.zeros(len(probes)) if about is None else about
        here = np.zeros_like(self.residual.value) if about is None else addition(linear)
        if issubclass(effect, GeometryEffect) and effect.linear_nearby:
            differences = [addition(linear + d) - addition(linear - d) for d in np.diag(probes)]
            probes = 2.0 * probes
        else:
            differences = [addition(linear + d) - here for d in np.diag(probes)]
        values = _without_rounding(np.stack(differences, axis=2) / probes)
        return values, here - values @ linear

    def _addition(
        self,
        effect: type[Effect],
        target: str,
        linear: np.ndarray,
        nonlinear: np.ndarray,
        *,
        noisier: bool = False,
    ) -> np.ndarray:
        """What one of these effects with these values adds to the residual, (B, R), also if the
        sensors' noise were in its regressors once more."""
        names = [name for name, parameter in effect.parameters.items() if parameter.linear]
        fixed = [name for name in effect.parameters if name not in names]
        values = {
            name: [value]
            for name, value in (
                *zip(names, linear, strict=True),
                *zip(fixed, nonlinear, strict=True),
            )
        }
        changed = effect.from_values([target], values)
        if isinstance(changed, InertiaEffect):
            return self._inertia_addition(changed, noisier=noisier)
        if issubclass(effect, GroundSlope):
            here = self._believed_slope
            return self._soles.on_slope(here + linear) - self._soles.on_slope(here)
        regressors = self._noisier_regressors if noisier else self._regressors
        if issubclass(effect, GeometryEffect):
            return regressors.impact_residual - self._with(changed).residual(
                regressors.impact_blocks
            )
        # By taking the effect off the signals.
        assert isinstance(changed, SensorEffect)
        resolved = changed.resolve(self.robot.description)
        read = self._noisier_loaded if noisier else self._loaded
        memory = self.reading.remembered(resolved, read) if noisier else self._memory(resolved)
        signals = self.reading.undone(resolved, memory, read)
        return regressors.smooth_residual - Regressors(self.motion, signals).smooth_residual

    def _memory(self, resolved: ResolvedSensorEffect) -> np.ndarray:
        """What an effect remembers over the log. It depends on the nonlinear parameters alone,
        where `undone` needs it."""
        key = (resolved.effect, resolved.nonlinear.tobytes())
        if key not in self._memories:
            self._memories[key] = self.reading.remembered(resolved, self._loaded)
        return self._memories[key]


def _joined(recording: RecordingConfig, motion: JointMotion, steps: int) -> JointMotion:
    """Averages over so many steps; as it is for one."""
    if steps == 1:
        return motion
    joined = {
        name: block_means(in_steps(recording, getattr(motion, name)), steps)
        for name in ("velocity", "position", "command", "time", "load")
    }
    return motion._replace(**joined, time_step=steps * motion.time_step)


def _without_rounding(values: np.ndarray) -> np.ndarray:
    """Columns (..., p) in which nothing but the rounding of the others is left, made zero: they
    would ask for boundless parameters."""
    largest = np.abs(values).max(axis=tuple(range(values.ndim - 1)))
    return np.where(largest > _ROUNDING * largest.max(), values, 0.0)


def probes_of(effect: type[Effect]) -> np.ndarray:
    """Small values of an effect's linear parameters, to take derivatives with, (p,)."""
    linear = [parameter for parameter in effect.parameters.values() if parameter.linear]
    return np.array([0.01 * max(abs(bound) for bound in p.plausible) for p in linear])
