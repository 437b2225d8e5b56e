"""What sensor faults do to the friction estimate: `python -m benchmarks.faults [--only TEXT]...`.

The default estimator runs over the log of a walk. At a time in single support and at one in double
support it is forked, once for every fault: a group of channels, and what is wrong with them for a
second. Its estimates are compared with those without the fault until 0.7 s after its end. A fault
is

- harmless if no joint's friction moves by more than three of its stated standard deviations,
- covered if the deviations that are stated with the fault are as much larger,
- flagged if `estimate/sensors/status` is nonzero at most 50 ms after friction has left its bound
  (and for at most 0.5 s after the last flag, which is what recovery may take),
- silent and wrong if it moves friction otherwise,
- not recovered if friction is out of the undisturbed bound later than 0.5 s after the fault,
- not finite if any estimate ever is.

An estimator that states no `estimate/joint/friction_torque_std` is judged by the rms of its error
without faults, joint by joint. A torque command that is wrong by a little cannot be told from
friction; its faults are counted with the rest, and summed up by themselves. --only keeps the faults
whose `group: kind` has this text, --set KEY=VALUE changes the scenario. Prints counts and the
faults that are silent, not recovered or not finite, and writes DIR/faults.json. It is one process;
a fault takes half a second or more.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path

import numpy as np
from pydrake.systems.framework import Context
from rich.console import Console
from rich.progress import track
from scipy.ndimage import binary_dilation
from scipy.signal import lfilter

from benchmarks.console import print_table
from fbse_drake import Log, Scenario, load_scenario, simulate
from fbse_drake.estimation import Replay
from fbse_drake.estimators.estimator import EstimatorDiagram, NoEstimator
from fbse_drake.files import write_json
from fbse_drake.report.html import Table
from fbse_drake.report.metrics import ended_step

_SCENARIO = "paper_walk_fbse"
# The leg that has the faults; it stands in the first of the two supports.
_SIDE = "right"
_STARTS = {"single support": 2.1, "double support": 2.8}
_LENGTH, _RECOVERY, _AFTERWARDS = 1.0, 0.5, 0.7
_NOTICE = 0.05
_DURATION = max(_STARTS.values()) + _LENGTH + _AFTERWARDS
# Stated standard deviations that an estimate may move by.
_BOUND = 3.0
# The filters have settled [s].
_SETTLED = 1.0
_FRICTION, _STATUS = "estimate/joint/friction_torque", "estimate/sensors/status"
_DEVIATION = "estimate/joint/friction_torque_std"


@dataclass(frozen=True)
class Quantity:
    """Sizes that faults of a kind of channel have, in its unit."""

    noise: float
    offset: float
    full_scale: float


_ANGLE = Quantity(5e-5, 0.02, np.pi)
_VELOCITY = Quantity(5e-4, 0.1, 20.0)
_ACCELERATION = Quantity(0.02, 1.0, 160.0)
_RATE = Quantity(1e-3, 0.1, 35.0)
_FORCE = Quantity(0.5, 50.0, 5000.0)
_TORQUE = Quantity(0.5, 10.0, 500.0)


@dataclass(frozen=True)
class Channels:
    """Some components of one of the estimator's input ports."""

    port: str
    columns: list[int]
    quantity: Quantity


def groups(log: Log) -> dict[str, list[Channels]]:
    """Channels that fail together."""
    n, sides = len(log.joints), log.sides
    pads = {side: log[f"foot/{side}/pad_force"].shape[1] for side in sides}
    first_pad = sum(pads[side] for side in sides[: sides.index(_SIDE)])
    names = ("hip_pitch", "knee_pitch", "ankle_pitch")
    joint = {name: log.joints.index(f"{_SIDE}_{name}") for name in names}

    def angles(*joints: int) -> Channels:
        return Channels("measured_joint_state", list(joints), _ANGLE)

    def velocities(*joints: int) -> Channels:
        return Channels("measured_joint_state", [n + joint for joint in joints], _VELOCITY)

    def accelerometer(*axes: int) -> Channels:
        return Channels("measured_imu", list(axes), _ACCELERATION)

    def gyro(*axes: int) -> Channels:
        return Channels("measured_imu", [3 + axis for axis in axes], _RATE)

    def forces(first: int, count: int) -> Channels:
        return Channels("measured_pad_force", list(range(first, first + count)), _FORCE)

    def commands(*joints: int) -> Channels:
        return Channels("torque_command", list(joints), _TORQUE)

    every, axes, knee = range(n), range(3), joint["knee_pitch"]
    return {
        "all joint angles": [angles(*every)],
        **{f"{name} angle": [angles(number)] for name, number in joint.items()},
        "all joint velocities": [velocities(*every)],
        "knee velocity": [velocities(knee)],
        "knee angle and velocity": [angles(knee), velocities(knee)],
        "accelerometer": [accelerometer(*axes)],
        "accelerometer x": [accelerometer(0)],
        "gyro": [gyro(*axes)],
        "gyro y": [gyro(1)],
        "IMU": [accelerometer(*axes), gyro(*axes)],
        "a foot": [forces(3 * first_pad, 3 * pads[_SIDE])],
        "both feet": [forces(0, 3 * sum(pads.values()))],
        "a pad": [forces(3 * first_pad, 3)],
        "a pad's vertical axis": [forces(3 * first_pad + 2, 1)],
        "knee torque command": [commands(knee)],
        "all torque commands": [commands(*every)],
    }


@dataclass(frozen=True)
class Reading:
    """What channels would read in the whole log, and what goes wrong when."""

    # Shape (N, channels).
    values: np.ndarray
    quantity: Quantity
    # Samples of the fault, and period [s].
    start: int
    length: int
    period: float
    random: np.random.Generator

    def of(self, values: np.ndarray) -> np.ndarray:
        """The part of a log-long signal in which the fault is."""
        return values[self.start : self.start + self.length]

    @property
    def good(self) -> np.ndarray:
        return self.of(self.values)

    @property
    def last(self) -> np.ndarray:
        """The last reading before the fault, as often as it lasts."""
        return np.repeat(self.values[self.start - 1][None], self.length, axis=0)

    def ticks(self, time: float) -> int:
        return round(time / self.period)

    def noise(self) -> np.ndarray:
        """White noise of standard deviation 1."""
        return self.random.standard_normal(self.good.shape)

    def signs(self) -> np.ndarray:
        return self.random.choice([-1.0, 1.0], self.good.shape)

    def late(self, time: float) -> np.ndarray:
        return self.values[self.start - self.ticks(time) :][: self.length]

    def every(self, time: float) -> np.ndarray:
        """Number of the stretch of this length [s] that each sample is in, shape (length, 1)."""
        return (np.arange(self.length) // self.ticks(time))[:, None]

    def clipped(self, share: float) -> np.ndarray:
        limit = share * np.abs(self.values).max(axis=0)
        return np.clip(self.good, -limit, limit)

    def held(self, time: float) -> np.ndarray:
        return self.good[self.every(time)[:, 0] * self.ticks(time)]

    def repeated(self, time: float) -> np.ndarray:
        """The last readings before the fault, over and over."""
        count = self.ticks(time)
        return self.values[self.start - count + np.arange(self.length) % count]

    def low_passed(self, cutoff: float) -> np.ndarray:
        """Behind a low-pass of first order [Hz]."""
        keep = np.exp(-2 * np.pi * cutoff * self.period)
        start = keep * self.values[:1]
        return self.of(lfilter([1 - keep], [1, -keep], self.values, axis=0, zi=start)[0])

    def rare(self, per_second: float) -> np.ndarray:
        """Samples at random times, all channels together, bool (length, 1)."""
        return self.random.random((self.length, 1)) < per_second * self.period

    @property
    def ramp(self) -> np.ndarray:
        """From 0 to 1 over the fault, shape (length, 1)."""
        return np.linspace(0.0, 1.0, self.length)[:, None]


# What a fault makes of readings, shape (length, channels).
KINDS: dict[str, Callable[[Reading], np.ndarray]] = {
    "not a number": lambda r: np.full_like(r.good, np.nan),
    "infinite": lambda r: r.signs() * np.inf,
    "zero": lambda r: np.zeros_like(r.good),
    "stuck": lambda r: r.last,
    "stuck, last digit flickers": lambda r: r.last + 0.01 * r.quantity.noise * r.signs(),
    "5 ms late": lambda r: r.late(0.005),
    "20 ms late": lambda r: r.late(0.020),
    "repeats its last 20 ms": lambda r: r.repeated(0.020),
    "sampled every 10 ms": lambda r: r.held(0.010),
    "low-passed at 5 Hz": lambda r: r.low_passed(5.0),
    "at full scale": lambda r: np.full_like(r.good, r.quantity.full_scale),
    "clipped at half its range": lambda r: r.clipped(0.5),
    "spikes": lambda r: np.where(r.rare(20.0), r.signs() * r.quantity.full_scale / 2, r.good),
    "drops samples": lambda r: np.where(r.rare(100.0), np.nan, r.good),
    "loose contact": lambda r: np.where(r.every(0.020) % 2 == 0, 0.0, r.good),
    "sign flipped": lambda r: -r.good,
    "doubled": lambda r: 2.0 * r.good,
    "5 % too large": lambda r: 1.05 * r.good,
    "offset": lambda r: r.good + r.quantity.offset,
    "drift": lambda r: r.good + r.quantity.offset * r.ramp,
    "noise x 10": lambda r: r.good + 10.0 * r.quantity.noise * r.noise(),
    "coarse": lambda r: r.quantity.offset * np.round(r.good / r.quantity.offset),
}


class Branch:
    """An estimator that goes on from a context with samples that need not be finite."""

    def __init__(self, estimator: EstimatorDiagram, context: Context):
        self._estimator, self._context = estimator, context.Clone()
        self._next_context = estimator.CreateDefaultContext()
        self._next = self._next_context.get_mutable_state()

    def fork(self) -> "Branch":
        """Another one that goes on from here."""
        return Branch(self._estimator, self._context)

    def run(self, time: np.ndarray, inputs: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Estimates by channel, each (T, size).

        Args:
            time: shape (T,) [s].
            inputs: samples (T, size) by input port.
        """
        estimator, context = self._estimator, self._context
        fixed = []
        for name, samples in inputs.items():
            value = estimator.GetInputPort(name).FixValue(context, samples[0])
            fixed.append((value, samples))
        ports = {name: estimator.GetOutputPort(name) for name in estimator.channels}
        estimates = {name: np.empty((len(time), port.size())) for name, port in ports.items()}
        for k, now in enumerate(time):
            context.SetTime(now)
            for value, samples in fixed:
                value.GetMutableData().get_mutable_value().SetFromVector(samples[k])
            for name, port in ports.items():
                estimates[name][k] = port.Eval(context)
            estimator.CalcForcedUnrestrictedUpdate(context, self._next)
            context.SetDiscreteState(self._next_context.get_discrete_state())
        return estimates


def _inputs(replay: Replay) -> dict[str, np.ndarray]:
    """What an estimator reads of a log, (N, size) by input port."""
    estimator, context = replay.estimator, replay.context
    ports = [estimator.get_input_port(number) for number in range(estimator.num_input_ports())]
    samples: dict[str, list[np.ndarray]] = {port.get_name(): [] for port in ports}
    for sample in range(len(replay.time)):
        replay.feed(sample)
        for port in ports:
            samples[port.get_name()].append(port.Eval(context).copy())
    return {name: np.array(values) for name, values in samples.items()}


@dataclass(frozen=True)
class Walk:
    """A walk, what the estimator read and made of it, and the estimator where faults begin."""

    log: Log
    # Samples of every input port, and estimates by channel; (N, size) each.
    inputs: dict[str, np.ndarray]
    estimates: dict[str, np.ndarray]
    # By support, before the first tick of a fault.
    branches: dict[str, Branch]

    def ticks(self, time: float) -> int:
        return round(time / float(self.log.meta["period"]))

    @staticmethod
    def of(scenario: Scenario, log: Log) -> "Walk":
        """Runs the scenario's estimator over the log."""
        replay = Replay(scenario, log)
        inputs, branch = _inputs(replay), Branch(replay.estimator, replay.context)
        walk, parts, first = Walk(log, inputs, {}, {}), [], 0
        for support, start in _STARTS.items():
            parts.append(branch.run(*walk.part(slice(first, walk.ticks(start)))))
            walk.branches[support], first = branch.fork(), walk.ticks(start)
        parts.append(branch.run(*walk.part(slice(first, None))))
        for name in parts[0]:
            walk.estimates[name] = np.concatenate([part[name] for part in parts])
        return walk

    def part(self, rows: slice) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Some of its times and inputs."""
        return self.log.time[rows], {name: values[rows] for name, values in self.inputs.items()}

    def deviation(self) -> np.ndarray:
        """Standard deviation of the friction, stated or (if it is not) measured, (N, n) [Nm]."""
        if _DEVIATION in self.estimates:
            return self.estimates[_DEVIATION]
        error = self.estimates[_FRICTION] - ended_step(self.log, "truth/joint/friction_torque")
        rms = np.sqrt(np.mean(error[self.ticks(_SETTLED) :] ** 2, axis=0))
        return np.broadcast_to(rms, error.shape)


class Outcome(StrEnum):
    """What a fault does; see the module."""

    HARMLESS = "harmless"
    COVERED = "covered"
    FLAGGED = "flagged"
    SILENT = "silent and wrong"
    NOT_RECOVERED = "not recovered"
    NOT_FINITE = "not finite"


# Groups of faults that nothing but the friction shows have this in their name.
_UNTOLD = "torque command"
_BAD = (Outcome.SILENT, Outcome.NOT_RECOVERED, Outcome.NOT_FINITE)


@dataclass(frozen=True)
class Fault:
    """A fault of some channels that begins in a support phase."""

    group: str
    kind: str
    support: str

    @property
    def name(self) -> str:
        return f"{self.group}: {self.kind}"


@dataclass(frozen=True)
class Verdict:
    """What a fault does to the friction estimate."""

    group: str
    kind: str
    support: str
    outcome: Outcome
    # How far it moves the estimate at most [Nm], in undisturbed standard deviations, and of whom.
    largest: float
    largest_in_std: float
    joint: str
    # What is left of it later than 0.5 s after the fault, in the same.
    left_in_std: float
    # Share of the fault's time in which a sensor is flagged [1].
    flagged: float


def spoilt(walk: Walk, fault: Fault) -> Walk:
    """The walk with the inputs that it has with a fault."""
    start, length = walk.ticks(_STARTS[fault.support]), walk.ticks(_LENGTH)
    inputs, random = dict(walk.inputs), np.random.default_rng(0)
    period = float(walk.log.meta["period"])
    for part in groups(walk.log)[fault.group]:
        values, healthy = inputs[part.port].copy(), walk.inputs[part.port][:, part.columns]
        reading = Reading(healthy, part.quantity, start, length, period, random)
        values[start : start + length, part.columns] = KINDS[fault.kind](reading)
        inputs[part.port] = values
    return replace(walk, inputs=inputs)


def verdict_on(walk: Walk, fault: Fault) -> Verdict:
    """Runs the estimator with a fault, and judges it."""
    start = walk.ticks(_STARTS[fault.support])
    rows = slice(start, start + walk.ticks(_LENGTH + _AFTERWARDS))
    estimates = walk.branches[fault.support].fork().run(*spoilt(walk, fault).part(rows))
    is_finite = all(np.isfinite(values).all() for values in estimates.values())

    deviation = walk.deviation()[rows]
    stated = estimates.get(_DEVIATION, deviation)
    moved = np.abs(estimates[_FRICTION] - walk.estimates[_FRICTION][rows])
    in_std = moved / deviation
    flags = (estimates[_STATUS] != 0).any(axis=1)
    is_wrong = (in_std > _BOUND).any(axis=1)
    is_open = (moved > _BOUND * np.maximum(deviation, stated)).any(axis=1)
    healed = walk.ticks(_LENGTH + _RECOVERY)
    if not is_finite:
        outcome = Outcome.NOT_FINITE
    elif is_wrong[healed:].any():
        outcome = Outcome.NOT_RECOVERED
    elif not is_wrong.any():
        outcome = Outcome.HARMLESS
    elif not is_open.any():
        outcome = Outcome.COVERED
    elif (is_open & ~_noticed(flags, walk)).any():
        outcome = Outcome.SILENT
    else:
        outcome = Outcome.FLAGGED
    return Verdict(
        fault.group,
        fault.kind,
        fault.support,
        outcome,
        float(moved.max()),
        float(in_std.max()),
        walk.log.joints[int(in_std.max(axis=0).argmax())],
        float(in_std[healed:].max()),
        float(flags[: walk.ticks(_LENGTH)].mean()),
    )


def _noticed(flags: np.ndarray, walk: Walk) -> np.ndarray:
    """Samples that a flag answers for: those of 50 ms before it and of 0.5 s after it."""
    before, after = walk.ticks(_NOTICE), walk.ticks(_RECOVERY)
    answered = np.zeros(2 * max(before, after) + 1, dtype=bool)
    middle = len(answered) // 2
    answered[middle - before : middle + after + 1] = True
    return binary_dilation(flags, answered)


def all_faults(log: Log) -> Iterator[Fault]:
    """The whole matrix."""
    for group in groups(log):
        for kind in KINDS:
            for support in _STARTS:
                yield Fault(group, kind, support)


def count_table(verdicts: Sequence[Verdict], by: str) -> Table:
    """How many faults have which outcome, by a field of `Verdict`; all of them in the last row."""
    counts: dict[str, Counter[Outcome]] = defaultdict(Counter)
    for verdict in verdicts:
        counts[getattr(verdict, by)][verdict.outcome] += 1
    counts["all"] = Counter(verdict.outcome for verdict in verdicts)
    rows = [(name, *(count[outcome] for outcome in Outcome)) for name, count in counts.items()]
    return Table((by.capitalize(), *Outcome), tuple(rows))


def summary(name: str, verdicts: Sequence[Verdict]) -> str:
    """Shares of faults that are stated while they last, and over in time after them."""
    number = max(1, len(verdicts))
    lasting = (Outcome.NOT_RECOVERED, Outcome.NOT_FINITE)
    stated = sum(verdict.outcome not in _BAD for verdict in verdicts) / number
    healed = sum(verdict.outcome not in lasting for verdict in verdicts) / number
    shares = f"{100 * stated:.1f} % harmless, covered or flagged; {100 * healed:.1f} % recovered"
    return f"{name}: {len(verdicts)} faults, {shares}"


def bad_table(verdicts: Sequence[Verdict]) -> Table:
    """The faults that nobody is told of or that last, worst first."""
    bad = [verdict for verdict in verdicts if verdict.outcome in _BAD]
    bad.sort(key=lambda verdict: (_BAD.index(verdict.outcome), -verdict.largest_in_std))
    rows = [(*list(vars(v).values())[:-1], 100 * v.flagged) for v in bad]
    header = ("Group", "kind", "begins in", "outcome", "largest [Nm]", "largest [std]", "joint")
    return Table((*header, "left after 0.5 s [std]", "flagged [%]"), tuple(rows))


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the matrix and prints what comes of it."""
    parser = argparse.ArgumentParser(description="What sensor faults do to the friction estimate.")
    only = "faults with this in their name; may be repeated"
    parser.add_argument("--only", action="append", metavar="TEXT", help=only)
    parser.add_argument("--out", type=Path, default=Path("out/fbse"), help="default out/fbse")
    overrides = "of the scenario, as 'estimator.friction=!WholeBody {}'; may be repeated"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=overrides)
    options = parser.parse_args(arguments)
    console = Console(width=190, highlight=False)
    scenario = load_scenario(_SCENARIO, overrides=[f"duration={_DURATION}", *options.set])
    log = simulate(replace(scenario, estimator=NoEstimator())).log
    walk = Walk.of(scenario, log)
    faults = [f for f in all_faults(log) if any(text in f.name for text in options.only or [""])]
    if not faults:
        parser.error(f"--only: no such fault (all: {', '.join(f.name for f in all_faults(log))})")
    shown = {"description": "faults", "total": len(faults), "console": console}
    verdicts = list(track((verdict_on(walk, fault) for fault in faults), **shown))

    alarms = (walk.estimates[_STATUS] != 0).any(axis=1).mean()
    deviation = walk.deviation()[walk.ticks(_SETTLED) :]
    source = "stated" if _DEVIATION in walk.estimates else "rms error"
    spread = f"{deviation.min():.3f} to {deviation.max():.3f} Nm, mean {deviation.mean():.3f} Nm"
    bad = bad_table(verdicts)
    if bad.rows:
        print_table(console, "Silent, not recovered or not finite", bad)
    for by in ("group", "kind", "support"):
        print_table(console, f"Sensor faults by {by}", count_table(verdicts, by))
    untold = [verdict for verdict in verdicts if _UNTOLD in verdict.group]
    console.print(summary("Sensors", [v for v in verdicts if v not in untold]))
    console.print(summary("Torque commands", untold))
    console.print(f"Friction's standard deviation without faults ({source}): {spread}")
    console.print(f"Flagged without a fault: {100 * alarms:.2f} % of the time")
    counts = Counter(verdict.outcome for verdict in verdicts)
    content = {"counts": counts, "faults": list(map(asdict, verdicts))}
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(options.out / "faults.json", content)
    console.print(f"All faults: {options.out / 'faults.json'}")


if __name__ == "__main__":
    main()
