"""How fast the motion of a log is, and averages that are no finer than that asks for."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import welch

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.residual.recorded_motion import RecordedMotion

# A log of no more blocks than this is not averaged further.
_MOST_BLOCKS = 2500
# Most bandwidth times length of a block: two blocks in the period of what is fastest (Nyquist).
_SHARE = 0.5
# Length of the windows of a spectrum [s].
_WINDOW = 4.0
# The bandwidth holds this share of a signal's power.
_HELD = 0.999


@dataclass(frozen=True)
class Averaging:
    """Blocks over which the equation of motion is averaged in a diagnosis."""

    # Their length, and that which the scenario asks for [s].
    block: float
    asked: float
    # Below this frequency lies the motion [Hz]; infinite where nobody looked.
    bandwidth: float

    @property
    def text(self) -> str:
        """One sentence, empty if the blocks are those of the scenario."""
        if self.block == self.asked:
            return ""
        return (
            f"The log is long and its motion slow ({100 * _HELD:g} % of it below "
            f"{self.bandwidth:.2g} Hz), so it was averaged over {1e3 * self.block:.3g} ms, not "
            f"{1e3 * self.asked:.3g} ms."
        )


def averaged_to_bandwidth(predictor: Predictor) -> tuple[Predictor, Averaging]:
    """A predictor over longer blocks if the log has many and its motion does not need them; else
    the same one."""
    motion, recording = predictor.motion, predictor.scenario.recording
    asked = motion.length * motion.period
    blocks = len(motion.signals.joint_position) // motion.length
    if blocks <= _MOST_BLOCKS:
        return predictor, Averaging(asked, asked, np.inf)
    fastest = bandwidth(motion)
    times = min(
        -(-blocks // _MOST_BLOCKS), int(_SHARE / fastest / asked) if fastest > 0 else blocks
    )
    if times < 2:
        return predictor, Averaging(asked, asked, fastest)
    longer = replace(recording, block=times * asked)
    # In longer blocks differences of neighbours are motion as well as noise.
    wider = Predictor(replace(predictor.scenario, recording=longer), predictor.log, predictor.noise)
    return wider, Averaging(times * asked, asked, fastest)


def bandwidth(motion: RecordedMotion) -> float:
    """Frequency below which the motion in a log lies, by the fastest of its channels [Hz]; 0 if
    nothing moves."""
    signals, rate = motion.signals, 1.0 / motion.period
    fastest = 0.0
    for name in (
        "joint_velocity",
        "torque_command",
        "specific_force",
        "angular_velocity",
        "pad_force",
    ):
        values = getattr(signals, name).reshape(len(signals.joint_position), -1)
        if values.shape[1] == 0:
            continue
        window = min(len(values), round(_WINDOW * rate))
        frequency, power = welch(values, rate, nperseg=window, axis=0)
        # Motion does not reach up to half the rate, where noise in the loop may be loudest.
        floor = power[len(power) // 2 :].max(axis=0)
        signal = np.where(power > floor, power, 0.0)
        for component in signal[:, signal.sum(axis=0) > 0].T:
            held = np.cumsum(component) >= _HELD * component.sum()
            fastest = max(fastest, float(frequency[int(held.argmax())]))
    return fastest
