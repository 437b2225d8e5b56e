"""Check of the mount: does gravity pull a machine on a fixed base the way its model says?

A machine on a wall, under a ceiling or on a slanted pedestal, whose model stands upright, has
torques that look like wrong signs and scales in one joint after the other. One direction of gravity
that explains the torques of all joints is likelier than any of that.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fbse_drake.discrepancy.hygiene.torque_readings import JointTorques, Reading, chance, gain
from fbse_drake.discrepancy.residual.evidence import Evidence
from fbse_drake.robot.plant import slope_of_gravity

# Tilts below this are looked for as an effect, about the upright model [rad].
_LARGE_TILT = 0.35
# By how much the gravity that fits best may be too strong or too weak.
_STRENGTH = 0.1
# Another direction of gravity leaves at most this share of the variance of what any other reading
# of each torque leaves, in the mean of the joints.
_BETTER = 0.5
# Directions of gravity that show less than this share of the others do not show.
_INVISIBLE = 1e-3


@dataclass(frozen=True)
class Mount:
    """How a machine seems to be mounted."""

    # Rotation vector about world x and y, see `fbse_drake.BaseTilt`, (2,) [rad].
    tilt: np.ndarray

    @property
    def angle(self) -> float:
        """Between the mount and that of the model [rad]."""
        return float(np.linalg.norm(self.tilt))


def another_mount(
    evidence: Evidence, torques: JointTorques, places: Sequence[int], level: float
) -> Mount | None:
    """The mount that the torques of some joints show, where it is far from the model's.

    Args:
        places: of joints whose torque is looked at.
        level: largest probability of a false alarm.
    """
    if evidence.robot.has_floating_base or not places:
        return None
    believed = evidence.robot.plant.gravity_field().gravity_vector()
    strength = float(np.linalg.norm(believed))
    per_gravity = evidence.motion.equation.gravity_torques(evidence.motion.blocks)
    change = _fitted_change(torques, places, per_gravity)
    fitted = believed + change
    if abs(np.linalg.norm(fitted) / strength - 1.0) > _STRENGTH:
        return None
    gravity = fitted * strength / np.linalg.norm(fitted)
    if np.arccos(np.clip(gravity @ believed / strength**2, -1.0, 1.0)) < _LARGE_TILT:
        return None
    elsewhere = torques.with_more(-per_gravity @ (gravity - believed))
    pairs = [
        (_best_reading(torques, k), elsewhere.as_recorded(k, elsewhere.columns(k))) for k in places
    ]
    shares = [after.left.var() / max(before.left.var(), 1e-300) for before, after in pairs]
    gains = np.concatenate([gain(before.left, after.left) for before, after in pairs])
    stretch = np.concatenate([torques.stretches(k) for k in places])
    if np.mean(shares) > _BETTER or chance(gains, stretch) > level:
        return None
    return Mount(slope_of_gravity(gravity))


def _fitted_change(
    torques: JointTorques, places: Sequence[int], per_gravity: np.ndarray
) -> np.ndarray:
    """By how much gravity differs from the model's, (3,) [m/s^2]: least squares of all joints, each
    weighed by what is left of it, beside whatever else its torque may consist of."""
    values, targets = [], []
    for k in places:
        known, beside = torques.known[:, k], torques.columns(k).values
        missing, pulls = (torques.torque - torques.needed)[known, k], -per_gravity[known, k]
        q, _ = np.linalg.qr(beside[known] / np.linalg.norm(beside[known], axis=0).clip(1e-300))
        missing, pulls = (part - q @ (q.T @ part) for part in (missing, pulls))
        left = missing - pulls @ np.linalg.lstsq(pulls, missing)[0]
        deviation = max(float(left.std()), 1e-300)
        values.append(pulls / deviation)
        targets.append(missing / deviation)
    return np.linalg.lstsq(np.concatenate(values), np.concatenate(targets), rcond=_INVISIBLE)[0]


def _best_reading(torques: JointTorques, k: int) -> Reading:
    """Of a joint's torque where gravity is the model's: in its unit or another, of either sign."""
    columns = torques.columns(k)
    readings = [torques.scaled(k, columns, sign=sign) for sign in (1.0, -1.0)]
    return min(readings, key=lambda reading: float(reading.left.var()))
