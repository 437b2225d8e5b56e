"""What soles that stand read of the ground: that it gives way, lets them creep, and slopes.

The rows of a residual that soles have to do with are those of their own motion, and of that
between them; see `fbse_drake.discrepancy.residual.rows`.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from pydrake.math import RotationMatrix
from scipy.ndimage import binary_dilation, shift
from scipy.spatial.transform import Rotation

from fbse_drake.discrepancy.residual.blocks import block_means
from fbse_drake.discrepancy.residual.memory import Memory
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion
from fbse_drake.discrepancy.residual.residual import Residual, rms
from fbse_drake.discrepancy.residual.rows import foot_pairs
from fbse_drake.effects.contact import (
    ContactEffect,
    FootCreep,
    GroundCompliance,
    PadContact,
    pad_contact,
    spring_force,
)
from fbse_drake.robot.plant import gravity_on_slope
from fbse_drake.scenario import Scenario
from fbse_drake.sensors.foot_force import force_noise

# After so many times that by which they sink late, soles have sunk in; a load is more than this
# [N]. A robot whose joints are slower than this share of what they usually are is at rest.
_SINKING, _LEAST_LOAD, _AT_REST = 3.0, 1.0, 0.1
# A sole whose tangential force is this share of the largest that friction holds may slide, and does
# not stand for this long before and after [s].
_AT_LIMIT, _SLIDING_ON = 0.9, 0.03
# So many predictions of an effect are kept.
_KEPT = 4


class StandingSoles:
    """The feet of a robot over one log, on the ground that a scenario believes in."""

    def __init__(self, motion: RecordedMotion, scenario: Scenario):
        self._motion, self._scenario, self._robot = motion, scenario, motion.robot
        # Blocks and rows of the residual.
        self._shape = len(motion.time), len(motion.rows)
        # By effect and retardation: a search for one asks for the model's own again and again.
        self._predicted: Memory[np.ndarray] = Memory(_KEPT)

    def columns(self, effect: type[ContactEffect], nonlinear: np.ndarray) -> np.ndarray:
        """What an effect adds to the residual per unit of each of its linear parameters, by the
        motion of the standing soles that it predicts, (B, R, p).

        Args:
            nonlinear: values of its nonlinear parameters, shape (m,).
        """
        late = effect.retardation_of(nonlinear, self.contact)
        force = self._motion.signals.pad_force
        return self._predicted.or_made((effect, late), lambda: self._columns(effect, late, force))

    def offset(self, effect: type[ContactEffect], nonlinear: np.ndarray) -> np.ndarray:
        """What an effect adds whatever its linear parameters are, (B, R): the soles sink into
        the model's ground with another retardation.

        Args:
            nonlinear: values of its nonlinear parameters, shape (m,).
        """
        retardation = effect.retardation_of(nonlinear, self.contact)
        if retardation == self.contact.retardation or not self._robot.has_floating_base:
            return np.zeros(self._shape)
        late, usual = (
            self.columns(GroundCompliance, values)[:, :, 0]
            for values in (np.array([retardation]), GroundCompliance.usual(self.contact))
        )
        return (late - usual) / self.contact.stiffness

    def noise_in(self, effect: type[ContactEffect], nonlinear: np.ndarray) -> np.ndarray:
        """What noise that is added to the measured forces once more adds to these columns."""
        late = effect.retardation_of(nonlinear, self.contact)
        return self._columns(effect, late, self._noisier_force) - self.columns(effect, nonlinear)

    def _columns(
        self, effect: type[ContactEffect], retardation: float, pad_force: np.ndarray
    ) -> np.ndarray:
        if not self._robot.has_floating_base:
            linear = [parameter for parameter in effect.parameters.values() if parameter.linear]
            return np.zeros((*self._shape, len(linear)))
        forces = self._split_feet(pad_force, retardation)
        motions = [effect.sole_motion(force, pads, self._sample_time) for force, pads in forces]
        columns = [
            self._sole_rows([(r[k], d[k]) for r, d in motions]) for k in range(len(motions[0][0]))
        ]
        return np.stack(columns, axis=2)

    @cached_property
    def _first_row(self) -> int:
        """Place of the soles' first row; the others follow."""
        return next(k for k, row in enumerate(self._motion.rows) if row.kind == "kinematic")

    @cached_property
    def _sample_time(self) -> np.ndarray:
        samples = np.arange(len(self._motion.signals.joint_position))
        return self._motion.start + samples * self._motion.period

    @cached_property
    def _noisier_force(self) -> np.ndarray:
        force = self._motion.signals.pad_force
        noise = force_noise(
            self._motion.sensors_by_row.foot_force,
            self._robot,
            len(force),
            np.random.default_rng(0),
        )
        return force + noise

    def _split_feet(
        self, pad_force: np.ndarray, retardation: float
    ) -> list[tuple[np.ndarray, np.ndarray]]:
        """Force (N, P, 3) on the pads of each foot, of which the normal component is their springs'
        share, and places (P, 3) of these; in the axes of its contact, see `_contact_rotations`.

        Args:
            retardation: see `spring_force`.
        """
        pads, force = self._motion.equation.pads, pad_force.copy()
        for foot, R_LF in self._point_feet.items():
            of_foot = pads.foot == foot
            force[:, of_foot] = np.einsum("nij,npj->npi", R_LF, force[:, of_foot])
        force[:, :, 2] = spring_force(force[:, :, 2], retardation, self._motion.period)
        return list(zip(pads.split(force), pads.split(pads.position), strict=True))

    def _sole_rows(self, motions: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """Kinematic rows for soles that move like this.

        Args:
            motions: rotation vector and displacement of each sole against level, still ground, in
                the axes of its contact, (N, 3) each.
        """
        motion, gravity = self._motion, self._motion.equation.gravity
        length, period = motion.length, motion.period
        result = np.zeros(self._shape)
        # A force that is the mean over some time before its row tells of a sole in that time, a
        # sampled one of that instant; where that is in a step of the residual, and the motion's
        # rate there.
        reading, step = (t / period for t in (motion.timing.reading, motion.timing.integration))
        posture, rate = 0.5 + 0.5 * reading - step, 0.5 * reading - 1.5 * step
        place = self._first_row
        velocities = []
        for rotation, displacement in motions:
            turning, moving = (
                np.diff(values, axis=0, append=values[-1:]) / period
                for values in (rotation, displacement)
            )
            # R_WF^T g z for a sole turned by the rotation vector, less g z.
            around_x, around_y, _ = rotation.T
            tilt = gravity * np.stack([-around_y, around_x, 0 * around_x], axis=1)
            change = _later(moving, posture) - _later(moving, posture - 1)
            result[:, place : place + 3] = block_means(_later(turning, rate)[:-1], length)
            result[:, place + 3 : place + 6] = block_means(
                (_later(tilt, posture) + change / period)[:-1], length
            )
            velocities.append(block_means(_later(moving, rate)[:-1], length))
            place += 6
        in_base = [
            np.einsum("bij,bj->bi", R_BC, v)
            for R_BC, v in zip(self._contact_rotations, velocities, strict=True)
        ]
        for one, other in foot_pairs(self._robot):
            result[:, place : place + 3] = in_base[one] - in_base[other]
            place += 3
        return result

    @cached_property
    def _contact_rotations(self) -> list[np.ndarray]:
        """Axes of each foot's contact in every block, (B, 3, 3), in base axes: those of its sole;
        of a point foot, which stands at any angle, level ones."""
        rotations = self._motion.equation.sole_rotations(self._motion.blocks.joint_position)
        for foot in self._point_feet:
            rotations[foot] = np.broadcast_to(self._level, rotations[foot].shape)
        return rotations

    @cached_property
    def _point_feet(self) -> dict[int, np.ndarray]:
        """R_LF of every point foot in level axes L, (N, 3, 3)."""
        points = [k for k, leg in enumerate(self._robot.description.legs.values()) if leg.is_point]
        if not points:
            return {}
        equation = self._motion.equation
        rotations = equation.sole_rotations(self._motion.signals.joint_position)
        return {foot: self._level.T @ rotations[foot] for foot in points}

    @cached_property
    def _level(self) -> np.ndarray:
        """R_BL of axes whose z is up in the mean over the log; a base without tilt has them
        itself."""
        motion = self._motion
        up = motion.equation.R_BI @ motion.signals.specific_force.mean(axis=0)
        return RotationMatrix.MakeFromOneVector(up, 2).matrix()

    @cached_property
    def contact(self) -> PadContact:
        """Of the pads under the feet with the ground; without feet, the ground's own."""
        ground = self._scenario.ground
        if not self._robot.description.legs:
            return PadContact(ground.stiffness, ground.dissipation, 0.0, ground.friction)
        return pad_contact(self._scenario.believed.description, ground, self._scenario.plant)

    @cached_property
    def _headings(self) -> np.ndarray:
        """Angle about the vertical by which each sole is turned from where the base headed when the
        log began, (B, feet) [rad]; by the gyro, and the vertical of a base that does not tilt."""
        equation, blocks, up = self._motion.equation, self._motion.blocks, self._level[:, 2]
        rate = blocks.angular_velocity @ equation.R_BI.T @ up
        turned = (np.cumsum(rate) - 0.5 * rate) * self._motion.length * self._motion.period
        ahead = np.array([1.0, 0.0, 0.0]) - up[0] * up
        headings = [
            np.arctan2(R_BF[:, :, 0] @ np.cross(up, ahead), R_BF[:, :, 0] @ ahead)
            for R_BF in equation.sole_rotations(blocks.joint_position)
        ]
        return turned[:, None] + np.stack(headings, axis=1)

    def on_slope(self, slope: np.ndarray) -> np.ndarray:
        """What standing soles read beyond what they do on level ground, (B, R).

        Args:
            slope: see `Ground.slope`, (2,) [rad].
        """
        result = np.zeros(self._shape)
        if not self._robot.has_floating_base or not slope.any():
            return result
        up = np.array([0.0, 0.0, self._motion.equation.gravity])
        more = gravity_on_slope(up, slope.tolist()) - up
        place = self._first_row
        for heading in self._headings.T:
            R_FW = Rotation.from_euler("z", -heading[:, None])
            result[:, place + 3 : place + 6] = R_FW.apply(more)
            place += 6
        return result

    def on_believed_ground(self) -> np.ndarray:
        """What the model's own ground adds: it gives way a little under the soles and lets them
        creep, (B, R)."""
        sinking, creeping = (
            self.columns(effect, effect.usual(self.contact))[:, :, 0]
            for effect in (GroundCompliance, FootCreep)
        )
        return sinking / self.contact.stiffness + self.contact.creep * creeping

    def settled(self, residual: Residual, retardation: float) -> Residual:
        """A residual in which rows of soles are not known before these have sunk in, if the robot
        moved when the recording began: how far they had then nothing tells.

        Args:
            retardation: of the contact, see `PadContact` [s/N].
        """
        motion = self._motion
        force = np.maximum(motion.signals.pad_force[:, :, 2], 0.0)
        load = (force**2).sum() / max(force.sum(), _LEAST_LOAD)
        speed = np.linalg.norm(motion.blocks.joint_velocity, axis=1)
        moves = speed > _AT_REST * np.sqrt(np.mean(speed**2))
        first = np.searchsorted(motion.time, motion.time - motion.since_start)
        sinking = moves[first] & (motion.since_start < _SINKING * retardation * load)
        of_soles = np.array([row.kind == "kinematic" for row in residual.rows])
        return replace(residual, known=residual.known & ~(sinking[:, None] & of_soles))

    def held(self, residual: Residual) -> Residual:
        """A residual in which rows of soles are not known while their forces are at the limit of
        friction, where they slide as fast as they like."""
        motion = self._motion
        margin = 2 * round(_SLIDING_ON / (motion.length * motion.period)) + 1
        known = residual.known.copy()
        feet = self._split_feet(motion.signals.pad_force, retardation=0.0)
        for side, (force, _) in zip(self._robot.description.sides, feet, strict=True):
            x, y, normal = force[:-1].sum(axis=1).T
            at_limit = np.hypot(x, y) > _AT_LIMIT * self.contact.friction * normal
            slides = block_means((at_limit & (normal > _LEAST_LOAD)).astype(float), motion.length)
            near = binary_dilation(slides > 0.5, np.ones(margin))
            known[:, [side in row.feet for row in residual.rows]] &= ~near[:, None]
        return replace(residual, known=known)

    def sinking_variance(self, retardation: float) -> np.ndarray:
        """What the noise of the force sensors puts into the predicted sinking of the soles, per
        unit of compliance squared, (R,).

        A robot that does not stand has no soles that sink.

        Args:
            retardation: of the contact, see `PadContact` [s/N].
        """
        noise = self.noise_in(GroundCompliance, np.array([retardation]))[:, :, 0]
        return np.nan_to_num(rms(noise, self._motion.known) ** 2)


def _later(values: np.ndarray, samples: float) -> np.ndarray:
    """Samples (N, 3) so much later, interpolated; the ends are held."""
    return shift(values, (-samples, 0), order=1, mode="nearest")
