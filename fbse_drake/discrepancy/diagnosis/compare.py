"""Where does a model fail? Its residual on a log by joint, phase, velocity, position, load and
time, beside the sensors' noise."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtri, stdtrit
from scipy.stats import norm

from fbse_drake.discrepancy.diagnosis.prediction import Predictor
from fbse_drake.discrepancy.identification.regression import FOLDS, WhitenedResidual
from fbse_drake.discrepancy.residual.residual import Residual, rms
from fbse_drake.discrepancy.residual.rows import Row
from fbse_drake.robot.description import RobotDescription

# Probability that a log of noise alone shows any failure.
_FALSE_ALARM = 1e-3
# An error below this share of the noise of one block, or of what the zero predictor leaves, is no
# failure however sure it is.
_SMALLEST_NOISE_SHARE = 0.3
_SMALLEST_SHARE = 1e-3
# Quantiles that bins lie between: of speeds, and of other variables.
_SPEED_QUANTILES = (0.2, 0.4, 0.6, 0.8)
_QUANTILES = (1 / 6, 2 / 6, 3 / 6, 4 / 6, 5 / 6)
# Shortest bins of time [s].
_TIME_BIN = 1.0
_MOST_TIME_BINS = 6
# An error that follows no variable is a failure if it is larger than the noise by this factor.
_EXCESS = 1.5
# A bin is looked at if it has this many blocks, from this many stretches.
_FEWEST_BLOCKS, _FEWEST_STRETCHES = 10, 3
# A simpler division of a log is preferred to a finer one if it leaves at most this times as much
# (sum of squares).
_WORTHWHILE = 1.25
# Neighbouring bins are one failure if the smaller error is at least this share of the larger one.
_SIMILAR = 0.5


@dataclass(frozen=True)
class Bin:
    """Mean error in part of a log: in a phase, and in a range of a variable. Errors in the
    channel's unit.

    Where the variable is `speed`, an error counts positive along the motion.
    """

    # As `stance`; `all` for the whole log.
    phase: str
    # As `velocity`; `none` for the whole range; `scatter` for a root mean square instead of a mean.
    variable: str
    # Range of the variable; infinite at its ends.
    low: float
    high: float
    # Mean of the variable, and number of blocks.
    centre: float
    count: int
    error: float
    # 95 % confidence interval of the mean; stretches of time may be correlated in any way within.
    interval: tuple[float, float]
    # Standard deviation of the mean that the sensors' noise alone gives it.
    noise_floor: float

    @property
    def ratio(self) -> float:
        """Size of the error in multiples of the noise."""
        return (
            float(np.inf)
            if self.noise_floor == 0 and self.error != 0
            else abs(self.error) / max(self.noise_floor, 1e-300)
        )


def error_over_noise(error: float, noise: float) -> float:
    """Of root mean squares; NaN without noise."""
    return error / noise if noise > 0 else float(np.nan)


@dataclass(frozen=True)
class Channel:
    """Error of one row of the residual."""

    row: Row
    # Root mean square, of the error and of the sensors' noise in it.
    rmse: float
    noise_floor: float
    # `rmse` over that of the zero predictor: a model without any forces (joint and base rows; NaN
    # for kinematic ones, which are zero).
    nrmse: float
    # `rmse` and `noise_floor` by phase; NaN for a phase that never occurs.
    by_phase: dict[str, tuple[float, float]]
    # Mean errors by variable, over all phases.
    bins: dict[str, tuple[Bin, ...]]

    @property
    def ratio(self) -> float:
        """Error over noise; NaN without noise."""
        return error_over_noise(self.rmse, self.noise_floor)

    @property
    def worst(self) -> Bin | None:
        """The bin that stands out most from the noise."""
        return max(
            (b for bins in self.bins.values() for b in bins), key=lambda b: b.ratio, default=None
        )


@dataclass(frozen=True)
class Failure:
    """One way in which a model fails."""

    row: Row
    where: Bin
    # In plain words, one line.
    text: str


@dataclass(frozen=True)
class Comparison:
    """A model against a log.

    Total errors are root mean squares over all rows in multiples of the sensors' noise (whitened),
    so that the noise floor is 1.
    """

    rmse: float
    # What is left on held-out data if every row gets a constant, its mean over the other data: how
    # much of the error is a mere offset.
    held_out_rmse: float
    channels: tuple[Channel, ...]
    # Worst first.
    failures: tuple[Failure, ...]


def compare(predictor: Predictor) -> Comparison:
    """Compares a scenario's model with a log."""
    robot, equation, blocks = predictor.robot, predictor.motion.equation, predictor.motion.blocks
    n = len(robot.joint_names)
    zero = np.full(predictor.residual.value.shape, np.nan)
    zero[:, :n] = blocks.torque_command
    foot_load = {}
    if robot.has_floating_base:
        # Without masses the base's rows are the wrench of the feet.
        unloaded = replace(blocks, pad_force=np.zeros_like(blocks.pad_force))
        wrench = equation.residual(blocks, kinematic=False) - equation.residual(
            unloaded, kinematic=False
        )
        zero[:, n : n + 6] = wrench[:, n:]
        foot_load = {
            side: w[:, 5]
            for side, w in zip(
                robot.description.sides, equation.wrenches(blocks.pad_force), strict=True
            )
        }
    return compare_residual(
        predictor.residual, robot.description, rms(zero, predictor.residual.known), foot_load
    )


def compare_residual(
    residual: Residual,
    description: RobotDescription,
    zero_rmse: np.ndarray,
    foot_load: Mapping[str, np.ndarray],
) -> Comparison:
    """Compares a residual with its noise.

    Args:
        description: whose joints are the residual's first rows.
        zero_rmse: root mean square error of the zero predictor in each row, shape (R,); NaN where
            there is none.
        foot_load: vertical force on each sole [N], shape (B,), by side.
    """
    white = WhitenedResidual(residual)
    rows = [
        _RowErrors(residual, white, k, description, foot_load) for k in range(len(residual.rows))
    ]
    tests = sum(
        len(division.phases) * (len(division.variable.edges) - 1)
        for row in rows
        for division in row.divisions
    )
    threshold = float(norm.isf(_FALSE_ALARM / 2 / max(1, tests)))
    smallest = np.fmax(_SMALLEST_NOISE_SHARE * residual.noise_floor, _SMALLEST_SHARE * zero_rmse)
    failures = [
        failure
        for row, size in zip(rows, smallest, strict=True)
        for failure in row.failures(threshold, size)
    ]
    total = max(1, white.count.sum())
    return Comparison(
        float(np.sqrt(white.sse.sum() / total)),
        float(
            np.sqrt(
                sum(_held_out_sse(white.y[:, k], *_constant(white, k)) for k in range(len(rows)))
                / total
            )
        ),
        tuple(row.channel(zero) for row, zero in zip(rows, zero_rmse, strict=True)),
        tuple(sorted(failures, key=lambda failure: failure.where.ratio, reverse=True)),
    )


@dataclass(frozen=True)
class _Variable:
    """What an error may depend on; (B,) each."""

    name: str
    values: np.ndarray
    # Errors are multiplied with it.
    sign: np.ndarray
    # Of its bins.
    edges: np.ndarray


@dataclass(frozen=True)
class _Division:
    """A way to cut a log into parts in which the error may differ."""

    variable: _Variable
    phases: Mapping[str, np.ndarray]


class _RowErrors:
    """Errors of one row and where they occur."""

    def __init__(
        self,
        residual: Residual,
        white: WhitenedResidual,
        place: int,
        description: RobotDescription,
        foot_load: Mapping[str, np.ndarray],
    ):
        self.row, self.time = residual.rows[place], residual.time
        self.known, self.error = residual.known[:, place], residual.value[:, place]
        self.variance, self.covariance = residual.variance[:, place], residual.covariance[:, place]
        self.stretch, self.fold = white.stretch, white.fold
        self._rmse, self._noise_floor = (
            float(rms(self.error, self.known)),
            float(residual.noise_floor[place]),
        )
        self.phases, self._exclusive = self._phases(residual.standing, description)
        self.variables = self._variables(residual, place, foot_load)

    def _phases(
        self, standing: np.ndarray, description: RobotDescription
    ) -> tuple[dict[str, np.ndarray], list[str]]:
        """When each phase is, and the names of those that exclude each other."""
        sides, single = description.sides, standing.sum(axis=1) == 1
        own = next(
            (k for k, leg in enumerate(description.legs.values()) if self.row.joint in leg.joints),
            None,
        )
        both = {"double_support": standing.all(axis=1)} if len(sides) == 2 else {}
        if own is None:
            phases = {
                f"{side}_support": standing[:, k] & single for k, side in enumerate(sides)
            } | both
            return phases, list(phases)
        phases = {"stance": standing[:, own], "swing": ~standing[:, own]}
        return phases | both, list(phases)

    def _variables(
        self, residual: Residual, place: int, foot_load: Mapping[str, np.ndarray]
    ) -> dict[str, _Variable]:
        plus, signals = np.ones(len(self.time)), residual.signals
        found = [_Variable("none", 0 * plus, plus, np.array([-np.inf, np.inf]))]
        if self.row.joint:
            place = residual.row_index[self.row.joint]
            velocity = signals.joint_velocity[:, place]
            speeds = self._edges(np.abs(velocity), _SPEED_QUANTILES)[1:-1]
            speeds = speeds[speeds > 0]
            found += [
                _Variable(
                    "speed", np.abs(velocity), np.sign(velocity), np.array([0.0, *speeds, np.inf])
                ),
                _Variable(
                    "velocity",
                    velocity,
                    plus,
                    np.array([-np.inf, *-speeds[::-1], 0.0, *speeds, np.inf]),
                ),
            ]
            by_name = {
                "position": signals.joint_position[:, place],
                "load": signals.torque_command[:, place],
            }
        else:
            by_name = {f"{side} foot load": load for side, load in foot_load.items()}
            if self.row.kind == "kinematic":
                by_name = {
                    name: load
                    for name, load in by_name.items()
                    if name.removesuffix(" foot load") in self.row.feet
                }
        found += [
            _Variable(name, values, plus, self._edges(values, _QUANTILES))
            for name, values in by_name.items()
        ]
        bins = int(np.clip((self.time[-1] - self.time[0]) / _TIME_BIN, 1, _MOST_TIME_BINS))
        inner = np.linspace(self.time[0], self.time[-1], bins + 1)[1:-1]
        found.append(
            _Variable("time", self.time, plus, np.array([-np.inf, *np.round(inner, 1), np.inf]))
        )
        return {variable.name: variable for variable in found}

    def _edges(self, values: np.ndarray, quantiles: Sequence[float]) -> np.ndarray:
        """Infinite at the ends, and between numbers that are round against their spread, so that
        texts read well."""
        if not self.known.any():
            return np.array([-np.inf, np.inf])
        inner = np.quantile(values[self.known], quantiles)
        spread = float(np.ptp(inner))
        decimals = 1 - math.floor(math.log10(spread)) if spread > 0 else 0
        return np.array([-np.inf, *np.unique(np.round(inner, decimals)), np.inf])

    @property
    def divisions(self) -> list[_Division]:
        """Simple ones first."""
        everywhere = {"all": np.ones_like(self.known)}
        exclusive = {name: self.phases[name] for name in self._exclusive}
        used = [
            name
            for name, phase in exclusive.items()
            if (phase & self.known).sum() >= _FEWEST_BLOCKS
        ]
        variables = self.variables.values()
        undivided = [_Division(variable, everywhere) for variable in variables]
        if len(used) < 2:
            return undivided
        none, *others = [
            _Division(variable, {name: exclusive[name] for name in used}) for variable in variables
        ]
        return [undivided[0], none, *undivided[1:], *others]

    def bins(self, division: _Division) -> list[Bin]:
        """Mean errors, phase by phase, in order of the variable."""
        variable = division.variable
        ranges = list(itertools.pairwise(variable.edges))
        found = [
            self._bin(name, phase, variable, low, high)
            for name, phase in division.phases.items()
            for low, high in ranges
        ]
        return [b for b in found if b is not None]

    def _bin(
        self, phase: str, when: np.ndarray, variable: _Variable, low: float, high: float
    ) -> Bin | None:
        inside = self.known & when & (variable.values >= low) & (variable.values < high)
        places, count = np.flatnonzero(inside), int(inside.sum())
        if count < _FEWEST_BLOCKS or len(np.unique(self.stretch[places])) < _FEWEST_STRETCHES:
            return None
        # Neighbouring blocks have correlated noise.
        weight = np.where(inside, variable.sign, 0.0)
        noise = (
            np.sqrt(
                max(
                    0.0,
                    (weight**2 * self.variance).sum()
                    + 2 * (weight[:-1] * weight[1:] * self.covariance[:-1]).sum(),
                )
            )
            / count
        )
        mean, half = self._mean(self.error[places] * variable.sign[places], places)
        half = max(half, ndtri(0.975) * noise)
        centre = float(variable.values[places].mean())
        return Bin(
            phase,
            variable.name,
            float(low),
            float(high),
            centre,
            count,
            mean,
            (mean - half, mean + half),
            float(noise),
        )

    def _mean(self, values: np.ndarray, places: np.ndarray) -> tuple[float, float]:
        """Mean of values at some blocks, (m,) each, and half of its 95 % interval by the scatter
        between stretches; infinite where there is one stretch only, whose scatter nobody knows."""
        mean, count = float(values.mean()), len(places)
        stretches, stretch = np.unique(self.stretch[places], return_inverse=True)
        if len(stretches) < 2:
            return mean, np.inf
        sums, sizes = np.bincount(stretch, values - mean), np.bincount(stretch)
        scatter = np.sqrt((sums**2).sum() * len(stretches) / (len(stretches) - 1)) / count
        freedom = max(1.0, count**2 / (sizes**2).sum() - 1)
        return mean, float(stdtrit(freedom, 0.975) * scatter)

    def channel(self, zero: float) -> Channel:
        """What is said of the row beside its failures."""
        noise, everywhere = np.sqrt(self.variance), {"all": np.ones_like(self.known)}
        by_phase = {
            name: (
                float(rms(self.error, self.known & phase)),
                float(rms(noise, self.known & phase)),
            )
            for name, phase in self.phases.items()
        }
        bins = {
            name: tuple(self.bins(_Division(variable, everywhere)))
            for name, variable in self.variables.items()
        }
        nrmse = self._rmse / float(zero) if zero > 0 else np.nan
        return Channel(self.row, self._rmse, self._noise_floor, nrmse, by_phase, bins)

    def failures(self, threshold: float, smallest: float) -> list[Failure]:
        """Failures in the division of the log that explains most of the error on held-out data.

        Args:
            threshold: of the ratio to the noise.
            smallest: error that counts.
        """
        if self.known.sum() < _FEWEST_BLOCKS:
            return []
        divisions = self.divisions
        unexplained = np.array(
            [
                _held_out_sse(self.error, self._cells(division), self.known, self.fold)
                for division in divisions
            ]
        )
        best = divisions[int(np.argmax(unexplained <= _WORTHWHILE * unexplained.min()))]
        found = [
            where
            for phase in best.phases
            for where in self._outstanding(best, phase, threshold, smallest)
        ]
        if not found and self._rmse > max(_EXCESS * self._noise_floor, smallest):
            found = [self._scatter()]
        return [
            Failure(self.row, where, _text(self.row, where, has_phases=bool(self.phases)))
            for where in found
        ]

    def _scatter(self) -> Bin:
        """The root mean square of the whole row."""
        places = np.flatnonzero(self.known)
        mean, half = self._mean(self.error[places] ** 2, places)
        low, high = np.sqrt([max(0.0, mean - half), mean + half]).tolist()
        return Bin(
            "all",
            "scatter",
            -np.inf,
            np.inf,
            0.0,
            len(places),
            self._rmse,
            (low, high),
            self._noise_floor,
        )

    def _cells(self, division: _Division) -> np.ndarray:
        """Columns of the parts of a division, (B, cells): the sign of the error's variable inside,
        0 outside."""
        place = np.digitize(division.variable.values, division.variable.edges[1:-1])
        inside = np.eye(len(division.variable.edges) - 1)[place] * division.variable.sign[:, None]
        return np.concatenate(
            [inside * phase[:, None] for phase in division.phases.values()], axis=1
        )

    def _outstanding(
        self, division: _Division, phase: str, threshold: float, smallest: float
    ) -> list[Bin]:
        """Runs of bins of one phase whose errors have one sign and stand out from the noise: at
        most one for each sign."""
        bins = self.bins(replace(division, phases={phase: division.phases[phase]}))
        found = []
        for sign in (1, -1):
            size = [
                sign * b.error
                if b.ratio > threshold and b.interval[0] * b.interval[1] > 0
                else -np.inf
                for b in bins
            ]
            if not bins or max(size) < smallest or max(size) <= 0:
                continue
            first = last = int(np.argmax(size))
            while first > 0 and size[first - 1] >= _SIMILAR * max(size):
                first -= 1
            while last + 1 < len(bins) and size[last + 1] >= _SIMILAR * max(size):
                last += 1
            whole = self._bin(
                phase,
                division.phases[phase],
                division.variable,
                bins[first].low,
                bins[last].high,
            )
            if whole is not None:
                found.append(whole)
        return found


def _constant(white: WhitenedResidual, row: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A row's whitened constant (B, 1), which blocks are known, and their folds."""
    ones = white.whiten(row, np.ones((len(white.y), 1)))
    return ones, white.residual.known[:, row], white.fold


def _held_out_sse(
    error: np.ndarray, columns: np.ndarray, known: np.ndarray, fold: np.ndarray
) -> float:
    """Sum of squares of an error (B,) after orthogonal columns (B, p) that are fitted to the other
    folds."""
    inside = (fold == np.arange(FOLDS)[:, None]) & known
    power, product = inside @ columns**2, inside @ (columns * error[:, None])
    other_power, other_product = power.sum(axis=0) - power, product.sum(axis=0) - product
    theta = np.divide(other_product, other_power, out=np.zeros_like(power), where=other_power > 0)
    return float((error[known] ** 2).sum() - 2 * (theta * product).sum() + (theta**2 * power).sum())


_QUANTITY = {
    "speed": ("|velocity|", "rad/s"),
    "velocity": ("velocity", "rad/s"),
    "position": ("angle", "rad"),
    "load": ("torque command", "Nm"),
    "time": ("time", "s"),
}
# Of a prismatic joint.
_QUANTITY_ALONG = _QUANTITY | {
    "speed": ("|velocity|", "m/s"),
    "velocity": ("velocity", "m/s"),
    "position": ("position", "m"),
    "load": ("force command", "N"),
}
_WAYS = {"x": ("forwards", "backwards"), "y": ("to the left", "to the right")}
_UNITS = {"m/s^2": "m/s²"}


def words(name: str) -> str:
    """A channel's or phase's name for reading: `base/force_z` -> `base force z`."""
    return name.replace("/", " ").replace("_", " ")


def range_text(row: Row, where: Bin) -> str:
    """The range of a bin's variable, as `|velocity| < 0.1 rad/s`; empty if it is the whole
    range."""
    slides = bool(row.joint) and row.unit in ("N", "m")
    quantities = _QUANTITY_ALONG if slides else _QUANTITY
    name, unit = quantities.get(where.variable, (where.variable, "N"))
    low, high = (f"{bound:.4g}" for bound in (where.low, where.high))
    from_below = np.isinf(where.low) or (where.variable == "speed" and where.low == 0)
    if from_below and np.isinf(where.high):
        return ""
    if where.variable == "time":
        return (
            f"until {high} s"
            if from_below
            else f"from {low} s on"
            if np.isinf(where.high)
            else f"from {low} to {high} s"
        )
    if from_below:
        return f"{name} < {high} {unit}"
    return f"{name} > {low} {unit}" if np.isinf(where.high) else f"{low} < {name} < {high} {unit}"


def _place(row: Row, where: Bin) -> str:
    """Channel, phase and range, as `left knee pitch, swing, |velocity| < 0.1 rad/s`."""
    channel = words(row.name if row.kind == "joint" else row.name.split("/")[0])
    return ", ".join(
        part
        for part in (
            channel,
            words(where.phase) if where.phase != "all" else "",
            range_text(row, where),
        )
        if part
    )


def _digits(value: float) -> str:
    """Two significant digits."""
    return f"{float(f'{value:.1e}'):g}"


def _text(row: Row, where: Bin, *, has_phases: bool) -> str:
    size, unit = _digits(abs(where.error)), _UNITS.get(row.unit, row.unit)
    # As force, z in base/force_z.
    kind, _, axis = row.name.split("/")[-1].rpartition("_")
    more = where.error > 0
    if where.variable == "scatter":
        nothing = "neither phase nor any" if has_phases else "none"
        what = (
            f"an error of {size} {unit} (root mean square) that follows {nothing} of the variables"
        )
    elif row.kind == "joint":
        along = " along the motion" if where.variable == "speed" else ""
        what = (
            f"model {'force' if row.unit == 'N' else 'torque'} {size} {unit} too "
            f"{'low' if more else 'high'}{along}"
        )
    elif row.kind == "transmission":
        along = " in the direction of motion" if where.variable == "speed" else ""
        what = f"motor {size} {unit} {'ahead of' if more else 'behind'} its link{along}"
    elif kind == "force" and axis == "z":
        what = (
            f"the feet push {size} N {'more' if more else 'less'} upwards "
            "than the model's masses need"
        )
    elif kind == "force":
        what = (
            f"the feet push {size} N more {_WAYS[axis][0 if more else 1]} "
            "than the model's masses need"
        )
    elif kind == "moment":
        what = (
            f"the feet's moment about the {axis} axis is {size} Nm "
            f"{'larger' if more else 'smaller'} than the model's masses need"
        )
    elif kind == "angular_velocity":
        what = f"turns at {size} {unit} about its {axis} axis although it stands"
    elif kind == "specific_force":
        what = f"{size} {unit} along its {axis} axis that a level sole at rest has not"
    else:
        what = f"move at {size} {unit} along {axis} against each other although both stand"
    return f"{_place(row, where)}: {what}"


def comparison_json(comparison: Comparison) -> dict[str, Any]:
    """Contents of compare.json. Ranges without a bound have null there."""
    return {
        "total": {
            "rmse": comparison.rmse,
            "noise_floor": 1.0,
            "held_out_rmse": comparison.held_out_rmse,
        },
        "unit": "multiples of the sensors' noise",
        "channels": {
            channel.row.name: {
                "unit": channel.row.unit,
                "rmse": channel.rmse,
                "nrmse": channel.nrmse,
                "noise_floor": channel.noise_floor,
                "by_phase": {
                    name: {"rmse": rmse, "noise_floor": floor}
                    for name, (rmse, floor) in channel.by_phase.items()
                },
                "worst": None if channel.worst is None else _bin_json(channel.worst),
            }
            for channel in comparison.channels
        },
        "failures": [
            {"channel": f.row.name, **_bin_json(f.where), "unit": f.row.unit, "text": f.text}
            for f in comparison.failures
        ],
    }


def _bin_json(where: Bin) -> dict[str, Any]:
    return {
        "phase": where.phase,
        "variable": where.variable,
        "range": [bound if np.isfinite(bound) else None for bound in (where.low, where.high)],
        "error": where.error,
        "interval": list(where.interval),
        "noise_floor": where.noise_floor,
        "ratio": where.ratio,
    }
